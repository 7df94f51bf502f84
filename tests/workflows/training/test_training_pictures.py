"""The resize and the crop of training pictures beside those of kornia, and what a picture does
not compute.
"""

import pytest
import torch
from kornia.geometry.transform import crop_by_indices
from kornia.geometry.transform import resize as kornia_resize

from neusee.nodes.resampling import resize
from neusee.nodes.scene import Photographs
from neusee.workflows import Store, load
from neusee.workflows.training.training_pictures import PictureSource, TrainingStream
from tests.workflows.training.test_warm_start import TINY


def contrast(picture):
    inner = picture[..., 4:-4]
    return float(inner.max() - inner.min())


def test_the_finest_stripes_go_grey_but_not_by_kornia():
    stripes = (torch.arange(96) % 2).float().expand(1, 1, 96, 96).contiguous()
    assert contrast(resize(stripes, 64, 64)) < 0.1
    assert contrast(kornia_resize(stripes, (64, 64), interpolation="bicubic", antialias=True)) > 0.6


def test_a_patch_has_the_pixels_of_a_crop_by_kornia():
    pictures = torch.rand(2, 3, 24, 32, generator=torch.Generator().manual_seed(1))
    corners = torch.tensor([[5, 3], [12, 3], [12, 10], [5, 10]]).expand(2, 4, 2)
    assert torch.equal(crop_by_indices(pictures, corners), pictures[..., 3:11, 5:13])


@pytest.mark.parametrize(("weight", "bands"), [(0, 0), (0.001, 3)])
def test_the_light_behind_the_mask_is_computed_where_a_loss_reads_it(tmp_path, weight, bands):
    recipe = load("train_small", [*TINY, f"+train.stages.2.bsr={weight}"])
    photographs = Photographs((recipe.steps["scene"].params["file"],))
    samples = TrainingStream(
        recipe, recipe.training, PictureSource(photographs, Store(tmp_path)), recipe
    )
    assert len(samples({}, 2, 0).light) == bands
    assert ("bsr[mask]" in samples._simulate.live) == bool(bands)
