"""What no element can do better: least peak of light that is kept, most contrast with so low a peak."""

import math

import torch
from torch import Tensor

from neusee.nodes.values import Psf


def least_lsr(psf: Psf) -> Tensor:
    """The laser suppression ratio of light spread evenly over the field: (band,) float64.

    The field has N pixels and the clear lens puts a share p0 of the light into the brightest one, so an element that
    keeps all light in the field has no pixel below 1/N, and LSR >= 1 / (N p0). One that scatters light out of the
    field may go below by the share that it keeps.
    """
    pixels = psf.intensity.shape[-2] * psf.intensity.shape[-1]
    return 1.0 / (pixels * psf.clear_peak.double())


def most_contrast(psf: Psf) -> Tensor:
    """The root mean square contrast, within the band of the clear aperture, that the peak of a PSF allows: (band,).

    Parseval: over all frequencies that the pixels sample, mean |OTF|^2 = sum h^2 <= max h sum h, so that
    the rms contrast is at most sqrt(LSR p0 / light kept). All of it lies in the band, which holds a share 4 p0 of
    these frequencies while it does not reach the edge of what the pixels sample.
    """
    kept = psf.intensity.sum(-1).sum(-1, dtype=torch.float64)
    peak = psf.intensity.amax((-2, -1)).double()
    return (peak / kept / _share(psf.clear_peak.double())).sqrt()


def most_unsuppressed(psf: Psf) -> Tensor:
    """The same of an element with an LSR of 1 that keeps all light: (band,); it goes as the root of the LSR."""
    clear_peak = psf.clear_peak.double()
    return (clear_peak / _share(clear_peak)).sqrt()


def _share(clear_peak: Tensor) -> Tensor:
    """Share of the sampled frequencies within the cut-off sqrt(4 p0 / pi): a disc, cut by the square's edges."""
    radius = (4.0 * clear_peak / math.pi).sqrt()
    over = (radius - 0.5).clamp_min(0.0)
    angle = torch.acos((0.5 / radius).clamp_max(1.0))
    cut = 4.0 * (radius.square() * angle - 0.5 * (over * (radius + 0.5)).sqrt())  # four caps
    whole: Tensor = (4.0 * clear_peak - cut).where(radius < math.sqrt(0.5), 1.0)
    return whole
