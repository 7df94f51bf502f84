"""What no mask beats: light that stays in the field shines somewhere, and a low peak leaves little contrast."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.values import Psf

_DARK = 1e-30  #: share of the light that counts as none


class Limits(NamedTuple):
    """Bounds from this PSF's window, light and peak alone, and what it makes of them."""

    floor: Tensor  #: (band,) float64, LSR if the light in the window were spread evenly over it
    rms: Tensor  #: (band,) float64, root mean square contrast over all frequencies that the pixels sample
    bound: Tensor  #: (band,) float64, above which that cannot be: sqrt(LSR p0 / light)
    passed: Tensor  #: (band,) float64, the bound of the root mean square over the frequencies of the clear aperture
    median: Tensor  #: (band,) float64, the bound of the median over these


@node(rtol=1e-6)
def limits(psf: Psf) -> Limits:
    """Find what bounds suppression and contrast: an even spread of the light, and Parseval's theorem.

    Light E in N pixels has a peak of E / N at least, and LSR = peak / p0. The mean of |OTF|**2 over all frequencies is
    the sum of PSF**2, which is no more than peak times light; over a share s of the frequencies it is at most 1 / s
    times that, and half of these lie above the median: median <= sqrt(2 LSR p0 / (E s)).

    Shapes: psf.intensity (band, y, x) -> five of (band,) float64.
    Units:  none.
    Error:  1e-6 in float32. The floor is that of the window: a wider field has a lower one. Without light (1e-30) all
            are 0.
    Source: Parseval's theorem; the cut-off of the clear aperture as in `metrics.mtf`.
    """
    rows = [_limits(one.double()) for one in psf.intensity]
    light, rms, bound = (torch.stack(column) for column in zip(*rows, strict=True))
    passed = bound / shares(psf).to(bound).sqrt()
    return Limits(light * least_lsr(psf).to(light), rms, bound, passed, math.sqrt(2.0) * passed)


def _limits(kernel: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Light, root mean square contrast and its bound."""
    dark = kernel.sum() <= _DARK  # so that what is not a number is seen
    kernel = kernel.where(~dark, 1.0)  # a root has no slope at 0
    light, peak = kernel.sum(), kernel.amax()
    found = (light, kernel.square().sum().sqrt() / light, (peak / light).sqrt())
    return tuple(x.where(~dark, 0.0) for x in found)  # type: ignore[return-value]


@limits.check
def _(result: Limits, psf: Psf) -> list[Check]:
    low, high = float(result.floor.min()), float(result.floor.max())
    held = bool((result.rms <= result.bound * (1 + 1e-6)).all())
    return [Check(f"even light: LSR {low:.3g} to {high:.3g}; rms contrast {float(result.rms.mean()):.3g}, at most "
                  f"{float(result.bound.mean()):.3g}", held)]  # fmt: skip


# --- of any mask behind this lens -------------------------------------------------------------------------------------


def least_lsr(psf: Psf) -> Tensor:
    """The laser suppression ratio of light spread evenly over the field: (band,) float64.

    The field has N pixels and the clear lens puts a share p0 of the light into the brightest one, so an element that
    keeps all light in the field has no pixel below 1/N, and LSR >= 1 / (N p0). One that scatters light out of the
    field may go below by the share that it keeps.
    """
    pixels = psf.intensity.shape[-2] * psf.intensity.shape[-1]
    return 1.0 / (pixels * psf.clear_peak.double())


def most_unsuppressed(psf: Psf) -> Tensor:
    """`Limits.passed` of an element with an LSR of 1 that keeps all light: (band,); it goes as the root of the LSR."""
    clear_peak = psf.clear_peak.double()
    return (clear_peak / shares(psf).to(clear_peak)).sqrt()


def shares(psf: Psf) -> Tensor:
    """Share of the frequencies that the pixels sample within the cut-off sqrt(4 p0 / pi): (band,) float64."""
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in psf.intensity.shape[-2:])
    radius = torch.hypot(fy[:, None], fx)
    return torch.stack([(radius <= math.sqrt(4.0 * float(p) / math.pi)).double().mean() for p in psf.clear_peak])


def most_contrast(unsuppressed: float, lsr: Tensor) -> Tensor:
    """Return the bound of the root mean square contrast at each `lsr`, given the bound at an LSR of 1; at most 1."""
    return (unsuppressed * lsr.sqrt()).clamp_max(1.0)
