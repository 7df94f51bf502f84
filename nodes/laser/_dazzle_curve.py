"""The dazzled area against the strength of a laser, counted in the point-spread function."""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import refuse_not_finite
from neusee.nodes.optics._lens_band import cut_off
from neusee.nodes.torch_func import transformed
from neusee.nodes.units import Ratio
from neusee.nodes.values import Bands, Psf

Strengths = Annotated[tuple[Annotated[float, Field(gt=0, le=1e18)], ...], Field(min_length=1)]
DECADES = tuple(10 ** (k / 4) for k in range(4, 25))  #: 10 to 1e6


class DazzleCurve(NamedTuple):
    """The number of dazzled pixels against the strength of a laser."""

    strengths: Tensor  #: (strength,) float64, multiple of saturation at the peak behind the clear lens
    pixels: Tensor  #: (strength,) float64
    share: Tensor  #: (strength,) float64, of the window of the PSF
    clear: Tensor  #: (strength,) float64, pixels behind the clear lens by the mean of the Airy pattern


@node(rtol=1e-6)
def dazzle_curve(
    psf: Psf,
    bands: Bands,
    *,
    strengths: Strengths = DECADES,
    level: Ratio = 1.0,
) -> DazzleCurve:
    """Count the pixels in which a laser exceeds saturation, for each of several strengths.

    A strength is the irradiance of the brightest pixel behind the clear lens in multiples of saturation. ``level`` is
    the share of saturation at which a pixel counts: 1 for saturated pixels, less for pixels that are veiled. `clear` is
    the closed form pi (lambda N / (pi p))^2 (4 S / pi)^(2/3), with lambda N / p from the cut-off of the lens. Where
    pixels average, S is that at a point.

    Shapes: psf.intensity (band, y, x), bands (band,) -> four of (strength,) float64.
    Units:  none, and pixels.
    Error:  light outside the window of the PSF counts nothing: choose a window that holds the area. `clear` is within
            7 % of the count for S from 1e4 where lambda N / p is above 2.5 or pixels sample a point, and is 0 for S up
            to 1; smaller spots that pixels average need `dazzled_pixels`.
    Raises: ValueError for a PSF that is not finite.
    Source: Born and Wolf, Principles of Optics, 7th ed., section 8.5.2 (the Airy pattern and its far rings).
    """
    weights = bands.weights.double() * bands.centres.double()  # photons of each wavelength, whose wells they fill
    light = torch.zeros(psf.intensity[0].numel(), dtype=torch.float64, device=psf.intensity.device)
    for weight, band in zip(weights.tolist(), psf.intensity.detach(), strict=True):
        light = light + weight * band.flatten().double()
    peak = float((weights * psf.clear_peak.detach().cpu()).sum())
    if not transformed():
        refuse_not_finite("its pixels cannot be counted", psf=light.sum(), clear_peak=peak)
    at = torch.tensor(strengths, dtype=torch.float64)
    ordered = light.sort().values.cpu()
    pixels = (len(ordered) - torch.searchsorted(ordered, level * peak / at)).double()
    cut = float(cut_off(psf).mean())
    averaged_away = math.pi / 4 * cut**2 / float(psf.clear_peak.detach().mean())
    clear = (4 / math.pi * at / level * averaged_away).pow(2 / 3) / (math.pi * cut**2)
    return DazzleCurve(at, pixels, pixels / len(ordered), clear.where(at > level, 0.0))


@dazzle_curve.check
def _(result: DazzleCurve, *inputs: Any, **params: Any) -> list[Check]:
    top = int(result.strengths.argmax())
    share, strength = float(result.share[top]), float(result.strengths[top])
    text = f"{share:.2%} of the window is dazzled at strength {strength:.3g}"
    return [Check(text if share < 0.5 else f"{text}: the PSF may reach beyond its window", share < 0.5)]
