"""The heating of the hottest point of a sensor behind a mask, relative to the clear lens."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.units import PixelPitch, Time
from neusee.nodes.values import Psf

Diffusivity = Annotated[float, Field(ge=1e-9, le=1)]  #: m2/s
SILICON = 8.8e-5  #: m2/s, thermal diffusivity of silicon at 300 K


@node(rtol=1e-6)
def heat_ratio(
    psf: Psf, plain_psf: Psf, *, pixel_pitch: PixelPitch, dwell: Time, diffusivity: Diffusivity = SILICON
) -> Tensor:
    """Compute the temperature rise of the hottest pixel after a dwell time, divided by that behind the clear lens.

    A half-space that absorbs at its surface warms by the sum of irradiance times erfc(r / w) / r over distances r,
    with w = sqrt(4 diffusivity dwell). For a pulse of nanoseconds w is shorter than a pixel, and the ratio is that of
    the peaks (`metrics.lsr`). For continuous light a small spot cools faster: at one peak, the wider spot is hotter.

    Shapes: psf.intensity (band, y, x), plain_psf.intensity (band, y, x) -> (band,) float64.
    Units:  pixel_pitch m; dwell s; diffusivity m2/s; result 1 for the clear lens.
    Error:  heat from outside the window is left out; within a pixel the light counts as even: 3 % for lambda f / D
            above 2 pixels. Silicon's thin layers on top, and melting, are left out.
    Raises: ValueError where the PSFs differ in shape.
    Source: Carslaw and Jaeger, Conduction of Heat in Solids, 2nd ed., section 10.4 (continuous point source).
    """
    if psf.intensity.shape != plain_psf.intensity.shape:
        shapes = f"{tuple(psf.intensity.shape)} and {tuple(plain_psf.intensity.shape)}"
        raise ValueError(
            f"the PSFs with and without the mask have the shapes {shapes}: use one window and one `bands` step"
        )
    y, x = psf.intensity.shape[-2:]
    kernel = _kernel((2 * y, 2 * x), pixel_pitch, math.sqrt(4 * diffusivity * dwell)).to(psf.intensity.device)
    spectrum = torch.fft.rfft2(kernel)
    hottest = [
        torch.stack([_warmed(one, spectrum).amax() for one in each.intensity.double()]) for each in (psf, plain_psf)
    ]
    return hottest[0] / hottest[1]


def _warmed(light: Tensor, spectrum: Tensor) -> Tensor:
    y, x = light.shape
    whole: Tensor = torch.fft.irfft2(torch.fft.rfft2(light, s=(2 * y, 2 * x)) * spectrum, s=(2 * y, 2 * x))
    return whole[:y, :x]


def _kernel(shape: tuple[int, int], pitch: float, reach: float) -> Tensor:
    """Return erfc(r / w) / r over the pixels of an FFT, with the mean over a disc of one pixel's area in the middle."""
    fy, fx = (torch.fft.fftfreq(n, 1 / n, dtype=torch.float64) * pitch for n in shape)
    r = torch.hypot(fy[:, None], fx)
    kernel = torch.erfc(r / reach) / r.where(r > 0, 1.0)
    disc = pitch / math.sqrt(math.pi)
    inner = disc * math.erfc(disc / reach) + reach * (1 - math.exp(-((disc / reach) ** 2))) / math.sqrt(math.pi)
    kernel[0, 0] = 2 * math.pi * inner / pitch**2
    return kernel


@heat_ratio.reference
def _(psf: Psf, plain_psf: Psf, *, pixel_pitch: float, dwell: float, diffusivity: float = SILICON) -> Tensor:
    """Sum the heat of every pixel at every pixel, row by row of the window."""
    reach = math.sqrt(4 * diffusivity * dwell)
    disc = pixel_pitch / math.sqrt(math.pi)
    fine = (torch.arange(20000, dtype=torch.float64) + 0.5) * (disc / 20000)
    middle = float(2 * torch.special.erfc(fine / reach).mean() / disc)  # 2 pi r erfc / r over the area of the disc
    y, x = psf.intensity.shape[-2:]
    at = torch.cartesian_prod(torch.arange(y), torch.arange(x)).double() * pixel_pitch
    apart = torch.cdist(at, at, compute_mode="donot_use_mm_for_euclid_dist")
    heat = torch.where(apart > 0, torch.special.erfc(apart / reach) / apart.where(apart > 0, 1.0), middle)
    hottest = [(one.intensity.double().flatten(1) @ heat).amax(1) for one in (psf, plain_psf)]
    return hottest[0] / hottest[1]


@heat_ratio.check
def _(result: Tensor, *inputs: Any, dwell: float, **params: Any) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [Check(f"after {dwell:.3g} s the hottest pixel is {low:.3g} to {high:.3g} times as hot", high < 1.01)]
