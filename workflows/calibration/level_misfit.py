"""Tests of how the levels of a real camera deviate from its model, where fitted widths take up what the model lacks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from neusee.nodes.values import Levels

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.log_posterior import FloatArray, SensorPosterior

ALARM = 1e-3  #: probability with which chance alone fails a test
_DRAWS = 500  #: of the posterior, for the prediction of a level left out
_SLOW = 6  #: slowest waves over the levels
_LEAST = 10  #: lit levels, with fewer of which their order says too little
#: largest standard deviations, relative, of the light and of the variances beyond which the model does not hold
BOUNDS = {"lamp": 0.1, "scatter": 0.05}


class Deviations(NamedTuple):
    """How far each measured level lies from its prediction by the other levels, in standard deviations."""

    variance: FloatArray  #: (level,), of the levels that are used, in rising order of the mean
    mean: FloatArray  #: (level,) as `variance`
    photons: FloatArray  #: (level,)
    exposure: FloatArray  #: (level,) s

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Return (level,) True for a level with light."""
        return self.photons > 0


class Misfit(NamedTuple):
    """The result of one test of the levels: what was found, the criterion, and if it holds."""

    name: str
    found: str
    bar: str
    good: bool


def is_camera(problem: SensorPosterior) -> bool:
    """Return True if the likelihood is that of a real camera, whose widths are fitted to the levels."""
    return problem.recipe.steps[problem.step].node.path == "calibrate.camera"


def misfits(problem: SensorPosterior, samples: FloatArray, weights: FloatArray, theta: FloatArray) -> Iterator[Misfit]:
    """Test the levels of a real camera against posterior ``samples`` (draw, free) with ``weights``.

    ``theta`` (free,) is the mode. The widths of the model grow until its deviance is as expected, so that the deviance
    finds no misfit. What remains is the order of the deviations along the levels, a level that the others do not
    predict, and widths that no lamp and no electronics have.
    """
    found = left_out(problem, samples, weights)
    yield _prediction(found)
    if found.lit.sum() >= _LEAST:
        for name, z in (("variances", found.variance[found.lit]), ("means", found.mean[found.lit])):
            p = min(1.0, 2 * min(runs(z), waves(z)))
            text = f"{_signs(z)} runs of sign over {len(z)} levels, waves of {_strength(z):.1f}; p = {p:.2g}"
            yield Misfit(f"the {name} deviate without a trend", text, f"a p-value above {ALARM}", p >= ALARM)
    yield from _widths(problem, theta)


def _prediction(found: Deviations) -> Misfit:
    """Return the test of the level that deviates most from its prediction by the others."""
    limit = _limit(ALARM / (4 * len(found.variance)))
    what, z = max((("variance", found.variance), ("mean", found.mean)), key=lambda each: np.abs(each[1]).max())
    at = int(np.abs(z).argmax())
    light = f"of {found.photons[at]:.5g} photons" if found.photons[at] else "without light"
    text = f"the {what} of the level {light} and {found.exposure[at]:.4g} s deviates by {z[at]:+.1f} sd from its "
    text, good = f"{text}prediction by the other levels", abs(z[at]) <= limit
    if not good:
        why = "its light or exposure may not be as stated" if what == "mean" else "its frames may be disturbed"
        text += f": {why}; measure it again, or leave it out"
    return Misfit("each level is predicted by the others", text, f"at most {limit:.1f} sd", good)


def _widths(problem: SensorPosterior, theta: FloatArray) -> Iterator[Misfit]:
    """Yield the test of each fitted width, beyond which a misfit is taken for a scatter."""
    params = problem.recipe.steps[problem.step].params
    values = {**params, **{name: float(x) for name, x in problem.parameters(theta).items()}}
    words = {"lamp": "the light scatters from level to level", "scatter": "the variances scatter beyond chance"}
    for name, bound in BOUNDS.items():
        text = f"{words[name]} by {values[name]:.2%}"
        yield Misfit(f"{name} is that of a laboratory", text, f"at most {bound:.0%}", values[name] <= bound)


def left_out(problem: SensorPosterior, samples: FloatArray, weights: FloatArray) -> Deviations:
    """Return how far each level lies from its prediction by all other levels.

    Draws of the posterior are weighted by the inverse of the likelihood of the level. The weighted probability of less
    than was measured is given in standard deviations of a normal distribution.
    """
    from scipy.special import ndtr, ndtri

    rng = np.random.default_rng(3)
    drawn = samples[rng.choice(len(samples), _DRAWS, p=weights)]
    look = problem.likelihood(drawn)
    variance, narrow, mean, width = np.split(look.scaled.numpy(), 4, axis=-1)  # (draw, level)
    log = -0.5 * (variance**2 + mean**2) - narrow - width
    weight = np.exp(-(log - log.min(0)))
    weight = np.minimum(weight, weight.mean(0) * math.sqrt(len(weight)))  # truncated importance sampling
    weight /= weight.sum(0)
    tiny = 1e-12
    z = [ndtri(np.clip((weight * ndtr(x)).sum(0), tiny, 1 - tiny)) for x in (variance, mean)]
    levels = problem.levels
    assert isinstance(levels, Levels)
    used = look.degrees_of_freedom.numpy() > 0
    order = np.argsort(levels.mean.numpy()[used])
    return Deviations(*(x[order] for x in (*z, levels.photons.numpy()[used], levels.exposure.numpy()[used])))


def runs(z: FloatArray) -> float:
    """Return the probability that so few runs of equal sign come by chance (Wald and Wolfowitz 1940)."""
    from scipy.special import ndtr

    up, down = int((z > 0).sum()), int((z <= 0).sum())
    if not up or not down:
        return float(2.0 ** (1 - len(z)))
    expected = 1 + 2 * up * down / len(z)
    variance = (expected - 1) * (expected - 2) / (len(z) - 1)
    return float(ndtr((_signs(z) + 0.5 - expected) / math.sqrt(max(variance, 1e-12))))


def _signs(z: FloatArray) -> int:
    return 1 + int((np.diff(z > 0)).sum())


def _strength(z: FloatArray) -> float:
    """Return the sum of squares of the slowest components of a cosine transform, for deviations of unit size."""
    from scipy.fft import dct

    scale = max(1.0, float(np.square(z).mean()))
    return float((dct(z, norm="ortho")[:_SLOW] ** 2).sum() / scale)


def waves(z: FloatArray) -> float:
    """Return the probability that chance alone gives so strong slow waves over the levels."""
    from scipy.special import betainc

    total = float(np.square(z).sum())
    share = min(1.0, _strength(z) * max(1.0, float(np.square(z).mean())) / total) if total else 0.0
    return float(1 - betainc(_SLOW / 2, (len(z) - _SLOW) / 2, share))


def _limit(probability: float) -> float:
    from scipy.special import ndtri

    return float(-ndtri(probability))
