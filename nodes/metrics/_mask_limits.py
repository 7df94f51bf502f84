"""Physical limits of any mask: the lowest laser suppression ratio, and the highest contrast for a given peak."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.optics._lens_band import cut_off
from neusee.nodes.values import Psf

_DARK = 1e-30  #: share of the light below which a band counts as dark


class Limits(NamedTuple):
    """Bounds of laser suppression and contrast for a PSF, and the root mean square contrast of this PSF."""

    floor: Tensor  #: (band,) float64, LSR if the light in the window is spread evenly over the window
    rms: Tensor  #: (band,) float64, root mean square contrast over all frequencies that the pixels sample
    bound: Tensor  #: (band,) float64, upper bound of `rms`: sqrt(LSR p0 / light)
    passed: Tensor  #: (band,) float64, upper bound of the root mean square over the frequencies of the clear aperture
    median: Tensor  #: (band,) float64, upper bound of the median over the same frequencies


@node(rtol=1e-6)
def limits(psf: Psf) -> Limits:
    """Compute a bound of laser suppression for evenly spread light, and bounds of contrast by Parseval's theorem.

    Light E in N pixels has a peak of at least E / N, and LSR = peak / p0. The mean of |OTF|**2 over all frequencies is
    the sum of PSF**2, which is at most peak times light. Over a share s of the frequencies the mean is at most 1 / s
    times as large. Half of these frequencies lie above the median: median <= sqrt(2 LSR p0 / (E s)).

    Shapes: psf.intensity (band, y, x) -> five of (band,) float64.
    Units:  none.
    Error:  1e-6 in float32. The floor holds for the window: a wider field has a lower floor. Without light (1e-30) all
            five bounds are 0.
    Source: Parseval's theorem; the cut-off of the clear aperture as in `metrics.mtf`.
    """
    rows = [_contrast_bound(one.double()) for one in psf.intensity]
    light, rms, bound = (torch.stack(column) for column in zip(*rows, strict=True))
    passed = bound / shares(psf).to(bound).sqrt()
    return Limits(light * least_lsr(psf).to(light), rms, bound, passed, math.sqrt(2.0) * passed)


def _contrast_bound(kernel: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the light in the PSF of one band, the rms contrast of this PSF, and an upper bound of the contrast."""
    dark = kernel.sum() <= _DARK  # false for NaN, so that NaN reaches the result
    kernel = kernel.where(~dark, 1.0)  # a root has no gradient at 0
    light, peak = kernel.sum(), kernel.amax()
    rms, bound = kernel.square().sum().sqrt() / light, (peak / light).sqrt()
    return light.where(~dark, 0.0), rms.where(~dark, 0.0), bound.where(~dark, 0.0)


@limits.check
def _(result: Limits, psf: Psf) -> list[Check]:
    low, high = float(result.floor.min()), float(result.floor.max())
    bounded = bool((result.rms <= result.bound * (1 + 1e-6)).all())
    return [Check(f"LSR {low:.3g} to {high:.3g} for even light; rms contrast {float(result.rms.mean()):.3g}, "
                  f"upper bound {float(result.bound.mean()):.3g}", bounded)]  # fmt: skip


# --- limits of any mask on this lens ----------------------------------------------------------------------------------


def least_lsr(psf: Psf) -> Tensor:
    """Return the laser suppression ratio of light that is spread evenly over the field: (band,) float64.

    The field has N pixels, and the clear lens puts a share p0 of the light into the brightest pixel. With a mask that
    keeps all light in the field, the brightest pixel has at least 1/N of the light, so that LSR >= 1 / (N p0). A mask
    that scatters light out of the field lowers this bound by the share of the light that the mask keeps.
    """
    pixels = psf.intensity.shape[-2] * psf.intensity.shape[-1]
    return 1.0 / (pixels * psf.clear_peak.double())


def most_unsuppressed(psf: Psf) -> Tensor:
    """Return the upper bound (band,) of the rms contrast of a lossless mask that does not suppress the laser.

    The laser suppression ratio (LSR) of this mask is 1. For another ratio, the bound scales with sqrt(LSR).
    """
    clear_peak = psf.clear_peak.double()
    return (clear_peak / shares(psf).to(clear_peak)).sqrt()


def shares(psf: Psf) -> Tensor:
    """Return the share of the sampled spatial frequencies below the cut-off of the lens: (band,) float64."""
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in psf.intensity.shape[-2:])
    radius = torch.hypot(fy[:, None], fx)
    return torch.stack([(radius <= cut).double().mean() for cut in cut_off(psf).tolist()])


def most_contrast(unsuppressed: float, lsr: Tensor) -> Tensor:
    """Return the upper bound of the rms contrast of a mask for each laser suppression ratio in ``lsr``."""
    return (unsuppressed * lsr.sqrt()).clamp_max(1.0)
