"""Pools in the store: the same bits as simulated ones, another picture for any other camera, and
a kill loses one.
"""

import os

import numpy as np
import pytest
import torch
from PIL import Image

from neusee.nodes.scene import Photographs
from neusee.workflows import Store, load
from neusee.workflows.training.training_pictures import PictureSource, TrainingStream
from tests.workflows.training.noise_photographs import noise_photograph
from tests.workflows.training.test_warm_start import TINY, trained

POOL = ["train.pool=3"]

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def photograph(tmp_path_factory):
    file = tmp_path_factory.mktemp("photographs") / "one.png"
    noise_photograph().save(file)
    return file


def stream(words, photograph, folder):
    recipe = load("train_small", [*TINY, *POOL, *words])
    return TrainingStream(
        recipe, recipe.training, PictureSource(Photographs((photograph,)), Store(folder)), recipe
    )


def pictures(words, photograph, folder):
    samples = stream(words, photograph, folder)
    return [samples({}, 2, number) for number in range(3)], samples


def test_a_second_training_reads_the_bits_that_the_first_one_simulated(tmp_path, photograph):
    simulated, none = pictures(["train.keep_pool=false"], photograph, tmp_path)
    assert none.pool_counts == {}
    first, writer = pictures([], photograph, tmp_path)
    again, reader = pictures(
        ["train.rates.weights=3e-3", "train.network.width=6"], photograph, tmp_path
    )
    assert writer.pool_counts == {"from_store": 0, "simulated": 3}
    assert reader.pool_counts == {"from_store": 3, "simulated": 0}
    for a, b, c in zip(simulated, first, again, strict=True):
        assert a.drawn == b.drawn == c.drawn
        assert all(
            torch.equal(x, b.tensors[n]) and torch.equal(x, c.tensors[n])
            for n, x in a.tensors.items()
        )


OTHERS = [
    "train.patch=[12, 12]",
    "train.laser_free=1",
    "train.augment.exposure=1",
    "seed=8",
    "tolerance=1e-4",
]


@pytest.mark.parametrize(
    "change",
    [
        "optics.samples=64", "sensor.offset=uniform(350 e-, 410 e-)", "doe=axicon",
        *(pytest.param(word, marks=pytest.mark.slow) for word in ["sensor.read_noise=12 e-", *OTHERS]),
    ],
)  # fmt: skip
def test_another_camera_law_or_cut_never_reads_the_old_pool(tmp_path, photograph, change):
    writer = stream([], photograph, tmp_path)
    writer({}, 2, 0)
    other = stream([change], photograph, tmp_path)
    other({}, 2, 0)
    assert other.pool_counts == {"from_store": 0, "simulated": 1}


def test_another_photograph_is_another_picture(tmp_path, photograph):
    stream([], photograph, tmp_path)({}, 2, 0)
    brighter = tmp_path / "brighter.png"
    with Image.open(photograph) as image:
        image.point(lambda x: min(255, x + 1)).save(brighter)
    other = stream([], brighter, tmp_path)
    other({}, 2, 0)
    assert other.pool_counts == {"from_store": 0, "simulated": 1}


def test_another_mask_under_the_same_name_is_another_pool_and_a_renamed_one_is_the_same(
    tmp_path, photograph
):
    """The keys of the first picture, which cover everything that the picture depends on."""

    def key(name):
        samples = stream(
            ["doe=pixelwise", f"doe.file={tmp_path / name}"], photograph, tmp_path / "store"
        )
        theta, noise, _ = samples._drawn(2, 0)
        return samples._stored._key(
            theta["scene"], {reader: theta[reader] for reader in samples._readers}, noise
        )

    np.save(tmp_path / "m.npy", np.random.default_rng(1).uniform(0, 1e-6, (48, 48)))
    first = key("m.npy")
    (tmp_path / "m.npy").rename(tmp_path / "n.npy")
    assert key("n.npy") == first
    about = (tmp_path / "n.npy").stat()
    np.save(tmp_path / "n.npy", np.random.default_rng(2).uniform(0, 1e-6, (48, 48)))
    os.utime(tmp_path / "n.npy", ns=(about.st_atime_ns, about.st_mtime_ns))
    assert key("n.npy") != first


@pytest.mark.slow
def test_a_stopped_training_has_stored_every_finished_picture(tmp_path):
    def stopped(stage, done, found):
        if done == 2:
            raise KeyboardInterrupt

    words = ["train.pool=4", "train.stages.2.batch=1", "train.stages.2.iterations=4"]
    with pytest.raises(KeyboardInterrupt):
        trained(words, tmp_path, watch=stopped)
    lines = []
    trained([*words, "train.rates.weights=1e-3"], tmp_path, lines)
    assert "pictures of the pool: 2 came from the cache, 2 were simulated" in lines
