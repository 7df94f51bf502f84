"""The linear camera model of EMVA 1288, fitted as the standard prescribes: a first estimate, and a start for others."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.values import Levels

Share = Annotated[float, Field(gt=0, le=1)]
_QUANTIZATION = 1.0 / 12.0  #: DN2, of rounding to the nearest number


class LeastSquares(NamedTuple):
    """The results of a photon-transfer measurement; all () float64, errors are standard errors from the noise alone."""

    gain: Tensor  #: K, DN/e-
    efficiency: Tensor  #: electrons per photon
    temporal_dark_noise: Tensor  #: sigma_d, e-
    dark_signal: Tensor  #: dark signal of the shortest exposure, DN
    dark_current: Tensor  #: e-/s; NaN where all dark levels have the same exposure
    saturation: Tensor  #: electrons in the level of the largest variance, without the dark signal
    gain_error: Tensor
    efficiency_error: Tensor
    temporal_dark_noise_error: Tensor
    fitted: Tensor  #: number of lit levels in both fits


@node(rtol=1e-9)
def least_squares(levels: Levels, *, share: Share = 0.7) -> LeastSquares:
    """Fit gain, quantum efficiency and temporal dark noise: lines through the origin, up to a share of saturation.

    The level of the greatest variance marks saturation. The slope of mean over photons is the responsivity, and the
    slope of variance over mean is the gain, after subtraction of the dark level of the nearest exposure.

    Shapes: levels (level,) -> ten scalars.
    Units:  K DN/e-; temporal dark noise, saturation e-; dark current e-/s.
    Error:  valid as far as the camera is linear and the light is Poisson. Every level has the same weight, as in the
            standard, so that the brightest levels dominate. Rounding in the converter is assumed to add 1/12 DN2;
            dithered rounding adds up to 1/6. The errors omit the scatter of means in x, drift and non-linearity,
            which are larger in real cameras.
    Raises: ValueError without a dark level, without two lit levels of different light below saturation, and for a
            camera without response.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 6.6 to 6.8.
    """
    dark = levels.photons == 0
    if not bool(dark.any()):
        raise ValueError("no dark frames, so that the offset of the camera is not known: give frames without light")
    if int((~dark).sum()) < 2:
        raise ValueError(f"{int((~dark).sum())} lit level: a line needs at least two of different light")
    nearest = (levels.exposure[~dark, None] - levels.exposure[dark]).abs().argmin(1)
    lit, below = _only(levels, ~dark), _only(levels, dark.nonzero().squeeze(1)[nearest])
    mean, variance = lit.mean - below.mean, lit.variance - below.variance
    full = mean[lit.variance.argmax()]
    used = (mean <= share * full).nonzero().squeeze(1)
    if len(set(lit.photons[used].tolist())) < 2:
        raise ValueError(f"{len(used)} lit level(s) below {share:.0%} of saturation, {float(full):.4g} DN above the "
                         "dark: give two or more of different light there")  # fmt: skip
    gain, response = _slope(mean[used], variance[used]), _slope(lit.photons[used], mean[used])
    if not (float(gain) > 0 and float(response) > 0):
        raise ValueError(f"slopes {float(gain):.3g} DN/e- and {float(response):.3g} DN/photon: brighter frames must "
                         "be brighter and noisier; check that the light belongs to the levels")  # fmt: skip
    scatter = 2 * lit.variance.square() / lit.degrees_of_freedom
    dim = 2 * below.variance.square() / below.degrees_of_freedom
    off = _error(mean[used], scatter[used], dim[used], nearest[used]) / gain
    faint = lit.variance / lit.pixels, below.variance / below.pixels
    weak = _error(lit.photons[used], faint[0][used], faint[1][used], nearest[used]) / response
    noise, doubt = _dark_noise(levels, dark)
    efficiency = response / gain
    return LeastSquares(
        gain,
        efficiency,
        noise / gain,
        levels.mean[_first(levels, dark)],
        _dark_current(levels, dark) / gain,
        full / gain,
        off * gain,
        efficiency * torch.hypot(off, weak),
        torch.hypot(doubt, off * noise) / gain,
        torch.tensor(float(len(used)), dtype=torch.float64),
    )


@least_squares.check
def _(result: LeastSquares, levels: Levels, **params: float) -> list[Check]:
    text = (
        f"K {float(result.gain):.4g} DN/e-, QE {float(result.efficiency):.3g}, temporal dark noise "
        f"{float(result.temporal_dark_noise):.4g} e-, from {int(result.fitted)} of {len(levels.mean)} levels"
    )
    return [Check(text, 0.0 < float(result.efficiency) <= 1.0)]


def _only(levels: Levels, which: Tensor) -> Levels:
    """Select some of the levels, without their histograms."""
    return Levels._make([*(x[which] for x in levels[:6]), *(x[:0] for x in levels[6:])])


def _slope(x: Tensor, y: Tensor) -> Tensor:
    """Return the slope of the line through the origin."""
    return (x @ y) / (x @ x)


def _error(x: Tensor, own: Tensor, dark: Tensor, which: Tensor) -> Tensor:
    """Return the standard error of that slope, where several levels may share the dark level subtracted from y."""
    shared = torch.zeros(int(which.max()) + 1, dtype=x.dtype, device=x.device).index_add_(0, which, x * dark.sqrt())
    return (x.square() @ own + shared.square().sum()).sqrt() / (x @ x)


def _first(levels: Levels, dark: Tensor) -> Tensor:
    """Return the index of the dark level of the shortest exposure."""
    return torch.where(dark, levels.exposure, math.inf).argmin()


def _dark_noise(levels: Levels, dark: Tensor) -> tuple[Tensor, Tensor]:
    """Return the temporal dark noise without rounding, and its standard error, DN; infinite without other noise."""
    variance, freedom = (x[_first(levels, dark)] for x in (levels.variance, levels.degrees_of_freedom))
    noise = (variance - _QUANTIZATION).clamp_min(0.0).sqrt()
    return noise, torch.where(noise > 0, variance / (2 * freedom).sqrt() / noise, math.inf)


def _dark_current(levels: Levels, dark: Tensor) -> Tensor:
    """Return the slope of the dark signal over exposure, DN/s."""
    time, signal = levels.exposure[dark], levels.mean[dark]
    apart = time - time.mean()
    return torch.where(time.max() > time.min(), (apart @ signal) / (apart @ apart), math.nan)
