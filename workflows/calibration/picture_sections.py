"""The sections of a calibration's page with its pictures: curve or rings, parameters in pairs, and chains."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.nodes.calibrate import Rings, Sufficient
from neusee.nodes.values import Levels
from neusee.workflows.calibration import calibration_figures as figures
from neusee.workflows.calibration.corner_figure import corners
from neusee.workflows.calibration.level_misfit import is_camera
from neusee.workflows.report.study_page import Section

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.calibration_page import CalibrationResult
    from neusee.workflows.calibration.log_posterior import FloatArray

_PREDICTED = 400  #: draws for the band of the predicted variance
_COUNTED = """The measured variance of each level against its mean, and the prediction of the posterior for a repeated
    measurement, before corrections for what the frames show or may hide. If a level is clipped by the well or the
    converter, or too coarse for a mean and a variance, each of its digital numbers enters the likelihood, and the level
    has no prediction here."""
_EXCLUDED = """The measured variance of each level against its mean, and the prediction of the posterior for a repeated
    measurement, before corrections for what the frames show or may hide. Below it, how far each variance, and each mean
    from what the stated light gives, lies from the prediction. Levels above {share}, and levels that are clipped, are
    not used and have no prediction."""
_CORNER = 20_000  #: draws for the picture of pairs


def words(name: str) -> str:
    """Return the name of a parameter as words."""
    return name.replace("_", " ")


def curve_section(result: CalibrationResult) -> Section:
    """Return the section with the photon-transfer curve, or with the rings about a point source."""
    if isinstance(result.problem.levels, Rings):
        return _rings(result, result.problem.levels)
    levels: Any = result.problem.levels
    mean, variance, away = _repeated(result)
    whole: NDArray[np.bool_] = np.asarray((variance > 0).all(0))
    whole[levels.cell_level.numpy()] = False
    text, label = _COUNTED, figures.COUNTED
    if is_camera(result.problem):
        share = f"{result.params['share']:.0%} of saturation"
        text, label = _EXCLUDED.format(share=share), f"not used: above {share}, or clipped"
    picture = figures.transfer(np.stack(_moments(levels)), np.stack([mean, variance]), whole, label, away)
    return Section("Photon-transfer curve", text, picture=picture)


def _repeated(result: CalibrationResult) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return mean and variance (draw, level) of a repeated measurement, with what scatters beyond chance.

    For a real camera also the distances (level,) of the means from those that the light gives, in standard deviations.
    """
    rng = np.random.default_rng(1)
    flat = result.walked.flat
    drawn = flat[rng.integers(len(flat), size=_PREDICTED)]
    levels: Any = result.problem.levels
    look = result.problem.likelihood(drawn)
    freedom = levels.degrees_of_freedom.numpy().clip(1)
    values = {**result.params, **result.problem.parameters(drawn)}
    scatter = np.broadcast_to(np.asarray(values.get("scatter", 0.0)), len(drawn))
    width = np.sqrt(2 / freedom + scatter[:, None] ** 2)
    variance, away = look.variance.numpy() * (1 + width * rng.standard_normal(width.shape)), None
    if is_camera(result.problem):
        away = np.full(len(freedom), np.nan)
        away[look.degrees_of_freedom.numpy() > 0] = np.split(look.scaled.numpy(), 4, axis=-1)[2].mean(0)
    return look.mean.numpy(), variance, away


def _rings(result: CalibrationResult, rings: Rings) -> Section:
    rng, flat = np.random.default_rng(1), result.walked.flat
    look = result.problem.likelihood(flat[rng.integers(len(flat), size=_PREDICTED)])
    picture = figures.rings(*ring_radii(rings), rings.mean.numpy(), look.mean.numpy(), look.variance.numpy())
    text = """The mean signal of each ring about the source, and the prediction of the posterior for a repeated
        measurement. Rings whose every pixel is cut off only bound the signal from below."""
    return Section("Rings about the source", text, picture=picture)


def ring_radii(rings: Rings) -> tuple[FloatArray, FloatArray]:
    """Return the root mean square radius of each averaged ring, and of each ring that is cut off, in pixels."""
    at, count = rings.ring.numpy(), rings.weight.numpy()
    square = np.bincount(at, count * rings.square.numpy()) / np.bincount(at, count)
    return np.sqrt(square), np.sqrt(rings.cut_square.numpy())


def _moments(levels: Sufficient | Levels) -> tuple[FloatArray, FloatArray]:
    """Return the mean and the variance of all digital numbers of each light level, including histograms."""
    if isinstance(levels, Levels):
        return levels.mean.numpy(), levels.variance.numpy()
    at, value, count = (x.numpy() for x in levels[-3:])
    total, mean, variance = (x.numpy() for x in (levels.pixels, levels.mean, levels.variance))
    sums = [np.bincount(at, count * value**n, minlength=len(total)) for n in range(3)]
    every = total + sums[0]
    middle = (total * mean + sums[1]) / every
    square = total * (variance + mean**2) + sums[2]
    return middle, square / every - middle**2


def corner_section(result: CalibrationResult) -> Section:
    """Return the section with the distribution of every pair of parameters."""
    every = max(1, result.chains.flat.shape[0] // _CORNER)
    told = [r for r in result.rows() if r.kind != "none"]
    shown = np.stack([result.draws[r.name].reshape(-1)[::every] for r in told], -1)
    text = """Every pair of parameters of which the frames tell a value or a limit; the recipe's own values are orange.
        Gain, offset, noise and efficiency correlate."""
    picture = corners(shown, [f"{words(r.name)}\n{r.unit}" for r in told], [r.nominal for r in told])
    return Section("Parameters in pairs", text, picture=picture)


def chains_section(result: CalibrationResult) -> Section:
    """Return the section with the traces of the walkers."""
    text = """Four independent ensembles of walkers, in the coordinates of the posterior, before corrections for what
        the frames show or may hide."""
    picture = figures.traces(result.walked.draws, result.problem.coordinates.labels)
    return Section("Chains", text, picture=picture)
