"""The loss of a training in float64, against its gradient by finite differences; and the limit
of the gradient norm.
"""

import numpy as np
import pytest
import torch
from PIL import Image

from neusee.nodes import losses
from neusee.nodes.scene import Photographs
from neusee.workflows import Store, load
from neusee.workflows.training.training_iteration import Learner
from neusee.workflows.training.training_pictures import PictureSource, TrainingStream

TINY = [
    "optics.samples=64",
    "optics.pitch=126.2 um",
    "optics.bands=3",
    "optics.window=[32, 32]",
    "scene.shape=[32, 32]",
    "sensor.shape=[32, 32]",
    "doe.grid=32",
    "train.network.kind=unet",
    "train.network.width=4",
    "train.critics.width=4",
    # before the converter, because rounding to digital numbers has no derivative
    "train.picture=charge[mask]",
]
pytestmark = pytest.mark.usefixtures("one_thread")


class Trial:
    """One training iteration with learning rates of 0, for any values of the parameters."""

    def __init__(self, folder, *words):
        rng = np.random.default_rng(5)
        (folder / "photographs").mkdir()
        coarse = Image.fromarray(rng.integers(0, 256, (5, 5, 3), dtype=np.uint8))
        coarse.resize((40, 40), Image.Resampling.BICUBIC).save(folder / "photographs" / "one.png")
        recipe = load("train_small", [*TINY, *words, f"train.photographs={folder / 'photographs'}"])
        sources = Photographs.under(recipe.training.photographs)
        self.pictures = TrainingStream(
            recipe, recipe.training, PictureSource(sources, Store(folder / "store"))
        )
        self.learner = Learner(recipe, recipe.training, "cpu")
        self.learner.begin(recipe.training.stages[1], learns=True)

    def loss(self):
        """Return the weighted sum of the loss terms in float64; the gradient is left in the
        parameters.
        """
        for optimiser in (self.learner.generator_optimizer, self.learner.critic_optimizer):
            for group in optimiser.param_groups:
                group["lr"] = 0.0
        peaks, original = {}, losses.suppression_loss

        def recorded(psf, **params):
            value = original(psf, **params)
            peaks[float(psf.clear_peak)] = float(value.detach())
            return value

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(losses, "suppression_loss", recorded)
            found, _ = self.learner.iterate(self.pictures, 1, 0)
        stage = self.learner.stage
        weights = {
            "BSR": stage.bsr,
            "reconstruction": stage.reconstruction,
            "adversarial": stage.adversarial,
        }
        total = stage.lsr * sum(peaks.values()) + sum(
            w * found[name] for name, w in weights.items() if w
        )
        return total, found

    def moved(self, module, step):
        """Return the loss with the parameters of ``module`` moved by ``step`` along a fixed
        random direction.
        """
        rng = torch.Generator().manual_seed(3)
        before = [p.detach().clone() for p in module.parameters()]
        with torch.no_grad():
            for p in module.parameters():
                p.add_(step * torch.randn(p.shape, generator=rng, dtype=torch.float64).to(p))
        total, _ = self.loss()
        slope = self.slope(module)
        with torch.no_grad():
            for p, old in zip(module.parameters(), before, strict=True):
                p.copy_(old)
        return total, slope

    @staticmethod
    def slope(module):
        rng = torch.Generator().manual_seed(3)
        each = (
            (p.grad.double() * torch.randn(p.shape, generator=rng, dtype=torch.float64)).sum()
            for p in module.parameters()
        )
        return float(sum(each))


@pytest.mark.slow
@pytest.mark.parametrize("part", ["mask", "net"])
def test_the_loss_in_float64_has_no_step_of_single_precision(tmp_path, part):
    trial = Trial(tmp_path, "train.precision=float64", "train.clip=null", "train.stages.1.batch=1")
    # within 1e-6 a rectifier of this network has its kink
    module, h = getattr(trial.learner, part), 1e-7
    values = [trial.moved(module, n * h)[0] for n in range(-2, 3)]
    slope = trial.moved(module, 0.0)[1]
    # five points of a smooth function: the fourth difference is of order h^4, so it shows the
    # round-off of the values
    noise = abs(np.dot([1, -4, 6, -4, 1], values)) / np.sqrt(70)
    assert noise < 1e-11 * abs(values[2])
    central = np.dot([1, -8, 0, 8, -1], values) / (12 * h)
    assert central == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize(
    ("preset", "clip"), [("recommended", 10.0), ("as_printed", None), ("recommended", 0.5)]
)
def test_the_gradient_of_each_module_has_at_most_the_norm_clip(tmp_path, preset, clip):
    words = [f"train={preset}", "train.stages.1.batch=1", "train.stages.1.lsr=1000"]
    trial = Trial(tmp_path, *words, *([f"train.clip={clip}"] if clip == 0.5 else []))
    assert trial.learner.settings.clip == clip
    _, found = trial.loss()
    parts = [trial.learner.mask, trial.learner.net]
    norms = [
        float(torch.cat([p.grad.flatten() for p in part.parameters()]).norm()) for part in parts
    ]
    assert found["slope"] > 10
    if clip is None:
        assert max(norms) == pytest.approx(found["slope"], rel=1e-3)  # float32
    else:
        assert max(norms) == pytest.approx(clip, rel=1e-4)


@pytest.mark.parametrize("value", ["0", "-1", "none"])
def test_a_limit_of_the_gradient_that_is_not_positive_is_refused(value):
    from neusee.workflows import RecipeError

    with pytest.raises(RecipeError, match=r"train\.clip"):
        load("train_small", [f"train.clip={value}"])
