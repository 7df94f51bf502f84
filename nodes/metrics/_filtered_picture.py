"""The error and the information of a picture after a Wiener filter, from its noise equivalent quanta (NEQ)."""

import math
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.restore._inverse._grey_psf import grey_shares
from neusee.nodes.units import Electrons, Fraction
from neusee.nodes.values import Bands, Psf

Light = Annotated[Electrons, Field(gt=0)]  #: electrons a pixel
_LEAST = 1e-30  #: NEQ below which a frequency counts as lost
HighestFrequency = Annotated[float, Field(gt=0, le=0.71)]  #: cycles per pixel; 0.71 is the corner of the spectrum
Variance = Annotated[float, Field(gt=0, le=10)]  #: of the contrast of a scene, relative to its squared mean


class Filtered(NamedTuple):
    """What a Wiener filter makes of a noisy picture of a natural scene, by channel of the sensor."""

    error: Tensor  #: (channel,) float64, error variance after the filter over the variance of the scene
    information: Tensor  #: (channel,) float64, bits a pixel
    log_neq: Tensor  #: (channel,) float64, mean of the natural logarithm of the NEQ up to `up_to`
    light: Tensor  #: (channel,) float64, share of the scene's light that reaches the sensor


@node(rtol=1e-6)
def filtered_picture(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    *,
    electrons: Light,
    read_noise: Electrons,
    glare: Electrons = 0.0,
    prnu: Fraction = 0.0,
    residual_glare: Fraction = 0.0,
    variance: Variance = 0.1,
    up_to: HighestFrequency = 0.12,
) -> Filtered:
    """Compute the error, the information and the NEQ of a natural scene behind a lens, after the best linear filter.

    The scene has a mean of ``electrons`` behind the plain lens and a contrast whose power S falls with the square of
    the frequency. NEQ = (electrons |OTF|)**2 / noise. The error is the mean of S / (1 + NEQ S) over that of S, the
    information the mean of log2(1 + NEQ S) / 2, both over all sampled frequencies. The noise of a pixel is that of
    `noise_variance`. A shade lowers the OTF at frequency 0, so that its loss of light counts.

    Shapes: psf.intensity (band, y, x), illuminant (band,), responses (channel, band) -> four of (channel,) float64.
    Units:  electrons, read_noise and glare e- a pixel; prnu and residual_glare shares; up_to cycles per pixel.
    Error:  1e-6 in float32. The scene is grey: one spectrum everywhere. Edges and clipped pixels are left out.
    Raises: ValueError where PSF, illuminant and responses differ in the number of bands.
    Source: Barrett and Myers, Foundations of Image Science, section 13.2 (NEQ); Goodman, Introduction to Fourier
        Optics, 4th ed., ch. 8 (Wiener filter).
    """
    spectra = torch.fft.fft2(channel_psf(psf, illuminant, responses, bands))
    light = spectra[:, 0, 0].real
    level = noise_variance(electrons * light, glare, read_noise, prnu, residual_glare)
    neq = (electrons * spectra.abs()).square() / level[:, None, None]
    power, counted = _on(neq, natural_power(tuple(neq.shape[-2:]), variance), low_frequencies(neq.shape[-2:], up_to))
    error = (power / (1 + neq * power)).sum((-2, -1)) / power.sum()
    information = 0.5 * torch.log2(1 + neq * power).mean((-2, -1))
    logs = neq[:, counted].clamp_min(_LEAST).log().mean(-1)
    return Filtered(error, information, logs, light)


@filtered_picture.reference
def _(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    *,
    electrons: float,
    read_noise: float,
    glare: float = 0.0,
    prnu: float = 0.0,
    residual_glare: float = 0.0,
    variance: float = 0.1,
    up_to: float = 0.12,
) -> Filtered:
    """Sum the same means over half of the spectrum in rows, with the PSF of each channel summed band by band."""
    y, x = psf.intensity.shape[-2:]
    photons = illuminant.double() * bands.centres
    rows = []
    for response in responses.double():
        share = response * photons / (response * photons).sum()
        otf = sum(w * torch.fft.fft2(one.double()) for w, one in zip(share, psf.intensity, strict=True))
        passed = float(abs(otf[0, 0]))
        noise = electrons * passed + glare + read_noise**2 + (prnu * (electrons * passed + glare)) ** 2
        noise += (residual_glare * glare) ** 2
        fy, fx = torch.fft.fftfreq(y, dtype=torch.float64), torch.fft.fftfreq(x, dtype=torch.float64)
        square = fy[:, None] ** 2 + fx**2
        power = torch.where(square > 0, 1 / square, 0.0)
        power = power * (variance / power.mean())
        neq = electrons**2 * abs(otf) ** 2 / noise
        low = (square > 0) & (square <= up_to**2)
        rows.append(
            (
                float((power / (1 + neq * power)).sum() / power.sum()),
                float(torch.log2(1 + neq * power).mean() / 2),
                float(torch.log(neq[low].clamp_min(_LEAST)).mean()),
                passed,
            )
        )
    return Filtered(*torch.tensor(rows, dtype=torch.float64).T)


@filtered_picture.check
def _(result: Filtered, *inputs: Any, electrons: float, **params: Any) -> list[Check]:
    error, bits = float(result.error.mean()), float(result.information.mean())
    ok = bool(((result.error >= 0) & (result.error <= 1 + 1e-6)).all())
    text = f"{electrons:.4g} e- a pixel: error after the filter {error:.3g} of the scene, {bits:.3g} bits a pixel"
    return [Check(text, ok)]


def _on(like: Tensor, *tensors: Tensor) -> list[Tensor]:
    return [x.to(like.device) for x in tensors]


def channel_psf(psf: Psf, illuminant: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return the PSF of each channel for a grey scene in float64, (channel, y, x); its sum is the light that passes."""
    lengths = {len(psf.intensity), len(illuminant), responses.shape[-1], len(bands.centres)}
    if len(lengths) > 1:
        raise ValueError(f"PSF, illuminant, responses and bands have {sorted(lengths)} bands: use one `bands` step")
    shares = grey_shares(illuminant, responses, bands).to(psf.intensity.device)
    whole: Tensor = torch.tensordot(shares, psf.intensity.double(), 1)
    return whole


def noise_variance(light: Any, glare: Any, read_noise: float, prnu: float = 0.0, residual_glare: float = 0.0) -> Any:
    """Return the noise variance of a pixel in e-**2: shot noise, read noise, PRNU, and wrongly subtracted glare.

    light + glare + read_noise**2 + (prnu (light + glare))**2 + (residual_glare glare)**2, with light and glare in e-.
    """
    whole = light + glare
    return whole + read_noise**2 + (prnu * whole) ** 2 + (residual_glare * glare) ** 2


def natural_power(shape: tuple[int, ...], variance: float) -> Tensor:
    """Return the power of the contrast of natural scenes at each frequency of an FFT: (y, x) float64.

    The power falls with the square of the frequency, is 0 at frequency 0, and its mean over all frequencies is
    ``variance``.
    """
    square = _square_frequency(shape)
    power = torch.where(square > 0, 1.0 / square.where(square > 0, 1.0), 0.0)
    scaled: Tensor = power * (variance / power.mean())
    return scaled


def low_frequencies(shape: tuple[int, ...], up_to: float) -> Tensor:
    """Return True at the frequencies above 0 and up to ``up_to`` cycles per pixel, in the layout of an FFT: (y, x)."""
    square = _square_frequency(shape)
    inside: Tensor = (square > 0) & (square <= up_to**2)
    return inside


def _square_frequency(shape: tuple[int, ...]) -> Tensor:
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in shape)
    square: Tensor = fy[:, None].square() + fx.square()
    return square


def decibels(ratio: float) -> float:
    """Return a ratio of variances or of powers in dB, 10 log10."""
    return 10.0 * math.log10(ratio)
