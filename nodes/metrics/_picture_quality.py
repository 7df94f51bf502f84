"""Quality of a picture: comparison with the true picture, and expected error and information after
a Wiener filter, also under attack by a laser.
"""

import math
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.precision import exact_convolutions, single
from neusee.nodes.restore.inverse._masked_blur import grey_shares
from neusee.nodes.units import Electrons, Fraction
from neusee.nodes.values import Bands, Psf

_SSIM_WINDOW = 11  #: width in pixels of the Gaussian window of SSIM
_STRIPE_ROWS = 118  #: number of rows compared at a time: 128 with the margin of the window


class Quality(NamedTuple):
    """Three measures of the difference between two pictures, each over all channels together."""

    l1: Tensor  #: () float64, mean absolute difference
    psnr: Tensor  #: () float64, dB, for a white of 1; 200 dB for equal pictures
    ssim: Tensor  #: () float64, at most 1


@node(rtol=3e-4)
def quality(
    estimate: Tensor,
    truth: Tensor,
    *,
    border: Annotated[int, Field(ge=0, le=10**6)] = 0,
    domain: Literal["linear", "encoded"] = "encoded",
) -> Quality:
    """Compare a picture with the true picture by mean absolute difference, PSNR and SSIM.

    Both pictures are clipped to [0, 1], the range of a display. `encoded` compares sRGB-encoded
    values, as is usual for published photographs; `linear` compares light. SSIM is that of kornia
    (Gaussian window, 11 x 11, sigma 1.5), averaged over the RGB channels and over the pixels whose
    window lies inside the picture. The term 1e-12 of kornia's denominator is left out: with this
    term two black pictures have an SSIM of 0.99999. Kornia's PSNR of two equal pictures is
    infinite, and 200 dB here, so that a mean over pictures stays finite.

    Shapes: estimate and truth (3, y, x), linear sRGB -> three scalars, float64.
    Units:  none; PSNR dB. ``border`` pixels at each side do not count.
    Error:  PSNR 2e-5 dB and SSIM 1e-5 against scikit-image. Round-off of SSIM is 1e-7, also where
            an SSIM near 0 is the small sum of positive and negative terms, but up to 3e-4 of an
            SSIM of flat, bright pictures: a variance is the difference of two squares near 1, four
            roundings of 6e-8, beside the constant 9e-4.
    Raises: ValueError for pictures of different shapes, and for pictures smaller than the window of
            SSIM.
    Source: Wang et al., IEEE Trans. Image Process. 13, 600 (2004); sRGB as IEC 61966-2-1.
    """
    require_same_shape(estimate, truth)
    a, b = (_without_border(x, border) for x in (estimate, truth))
    if min(a.shape[-2:]) < _SSIM_WINDOW:
        size = f"{_SSIM_WINDOW} x {_SSIM_WINDOW}"
        raise ValueError(
            f"SSIM needs {size} pixels, not {tuple(a.shape[-2:])} inside the border: give a larger"
            " picture"
        )
    absolute_sum, square_sum, ssim_sum = _difference_sums(a, b, domain)
    psnr = -10.0 * (square_sum / a.numel()).clamp_min(1e-20).log10()
    window_count = a[..., _SSIM_WINDOW - 1 :, _SSIM_WINDOW - 1 :].numel()
    return Quality(absolute_sum / a.numel(), psnr, ssim_sum / window_count)


@quality.check
def _(result: Quality, *inputs: Tensor, **params: object) -> list[Check]:
    l1, psnr, ssim = (float(x) for x in result)
    return [Check(f"L1 {l1:.4f}, PSNR {psnr:.2f} dB, SSIM {ssim:.3f}", math.isfinite(psnr))]


def require_same_shape(
    estimate: Tensor, truth: Tensor, fix: str = "crop the truth to the estimate"
) -> None:
    """Raise ValueError unless the estimate and the true values have the same shape."""
    if estimate.shape != truth.shape:
        raise ValueError(
            f"estimate {tuple(estimate.shape)} and truth {tuple(truth.shape)} differ in shape:"
            f" {fix}"
        )


def _without_border(picture: Tensor, border: int) -> Tensor:
    """Return a picture without a border of ``border`` pixels, at least float32."""
    y, x = picture.shape[-2:]
    return single(picture)[..., border : max(y - border, border), border : max(x - border, border)]


def _displayed(picture: Tensor, domain: str) -> Tensor:
    """Return a picture as a display shows it, clipped to [0, 1] and encoded in sRGB unless
    ``domain`` is linear.
    """
    from kornia.color import linear_rgb_to_rgb

    displayable = picture.clamp(0, 1)
    if domain == "linear":
        return displayable
    encoded: Tensor = linear_rgb_to_rgb(displayable)
    # white is set to exactly 1: float32 rounds 1.055 - 0.055 to less than 1
    return encoded.where(displayable < 1, encoded - encoded.detach() + 1)


def _difference_sums(a: Tensor, b: Tensor, domain: str) -> tuple[Tensor, Tensor, Tensor]:
    """Return the sums of absolute difference, squared difference and SSIM over all pixels, in
    stripes that fit the CPU cache.
    """
    absolute_sum, square_sum, ssim_sum = (
        torch.zeros((), dtype=torch.float64, device=a.device) for _ in range(3)
    )
    rows = a.shape[-2] - _SSIM_WINDOW + 1
    for first in range(0, rows, _STRIPE_ROWS):
        last = min(first + _STRIPE_ROWS, rows)
        estimate_stripe, truth_stripe = (
            _displayed(picture[..., first : last + _SSIM_WINDOW - 1, :], domain)
            for picture in (a, b)
        )
        # the remaining rows of the margin are counted with the next stripe
        counted_rows = None if last == rows else last - first
        difference = (estimate_stripe - truth_stripe)[..., :counted_rows, :]
        absolute_sum = absolute_sum + difference.abs().sum(-1).sum(dtype=torch.float64)
        square_sum = square_sum + difference.square().sum(-1).sum(dtype=torch.float64)
        ssim_sum = ssim_sum + _ssim(estimate_stripe, truth_stripe).sum(-1).sum(dtype=torch.float64)
    return absolute_sum, square_sum, ssim_sum


def _ssim(p: Tensor, q: Tensor) -> Tensor:
    """Return the structural similarity (SSIM) at each pixel whose window lies inside the
    picture.
    """
    from kornia.metrics import ssim

    pictures = (x.reshape(1, -1, *x.shape[-2:]) for x in (p, q))
    with exact_convolutions(p):
        similarity: Tensor = ssim(*pictures, _SSIM_WINDOW, eps=0.0, padding="valid")
    return similarity


# --- filtered picture -----------------------------------------------------------------------------

# The error and the information of a picture after a Wiener filter, from its noise equivalent quanta
# (NEQ).


Light = Annotated[Electrons, Field(gt=0)]  #: electrons per pixel
_LOST_NEQ = 1e-30  #: lower limit of the NEQ in its logarithm
#: cycles per pixel; 0.71 is the corner of the spectrum
HighestFrequency = Annotated[float, Field(gt=0, le=0.71)]
#: variance of a scene, relative to its squared mean
Variance = Annotated[float, Field(gt=0, le=10)]


class Filtered(NamedTuple):
    """Error and information of a noisy picture of a natural scene after a Wiener filter, in each
    channel of the sensor.
    """

    #: (channel,) float64, error variance after the filter / variance of the scene
    error: Tensor
    information: Tensor  #: (channel,) float64, bits per pixel
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
    """Compute the error, the information and the NEQ of a natural scene behind a lens, after the
    best linear filter.

    The scene has a mean of ``electrons`` behind the plain lens and a contrast whose power S falls
    with the square of the frequency. NEQ = (electrons |OTF|)**2 / noise. The error is the mean of S
    / (1 + NEQ S) over that of S, the information the mean of log2(1 + NEQ S) / 2, both over all
    sampled frequencies. The noise of a pixel is that of `noise_variance`. A shade lowers the OTF at
    frequency 0, so that its loss of light counts.

    Shapes: psf.intensity (band, y, x), illuminant (band,), responses (channel, band) -> four of
            (channel,) float64.
    Units:  electrons, read_noise and glare e- a pixel; prnu and residual_glare shares; up_to cycles
            per pixel.
    Error:  1e-6 in float32. The scene is grey: one spectrum everywhere. Edges and clipped pixels
            are left out.
    Raises: ValueError where PSF, illuminant and responses differ in the number of bands.
    Source: Barrett and Myers, Foundations of Image Science, section 13.2 (NEQ); Goodman,
        Introduction to Fourier Optics, 4th ed., ch. 8 (Wiener filter).
    """
    otf = torch.fft.fft2(channel_psf(psf, illuminant, responses, bands))
    light = otf[:, 0, 0].real
    noise_variances = noise_variance(electrons * light, glare, read_noise, prnu, residual_glare)
    neq = (electrons * otf.abs()).square() / noise_variances[:, None, None]
    power, counted = _on_device_of(
        neq, natural_power(tuple(neq.shape[-2:]), variance), low_frequencies(neq.shape[-2:], up_to)
    )
    # error power after the Wiener filter: S / (1 + NEQ S) for a scene with the power S
    error = (power / (1 + neq * power)).sum((-2, -1)) / power.sum()
    information = 0.5 * torch.log2(1 + neq * power).mean((-2, -1))
    logs = neq[:, counted].clamp_min(_LOST_NEQ).log().mean(-1)
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
    """Return the same means from explicit formulas, with the OTF of each channel summed band by
    band.
    """
    y, x = psf.intensity.shape[-2:]
    photons = illuminant.double() * bands.centres
    rows = []
    for response in responses.double():
        band_shares = response * photons / (response * photons).sum()
        otf = sum(
            band_share * torch.fft.fft2(band_psf.double())
            for band_share, band_psf in zip(band_shares, psf.intensity, strict=True)
        )
        light_share = float(abs(otf[0, 0]))
        noise = (
            electrons * light_share
            + glare
            + read_noise**2
            + (prnu * (electrons * light_share + glare)) ** 2
        )
        noise += (residual_glare * glare) ** 2
        fy, fx = (
            torch.fft.fftfreq(y, dtype=torch.float64),
            torch.fft.fftfreq(x, dtype=torch.float64),
        )
        squared_frequency = fy[:, None] ** 2 + fx**2
        power = torch.where(squared_frequency > 0, 1 / squared_frequency, 0.0)
        power = power * (variance / power.mean())
        neq = electrons**2 * abs(otf) ** 2 / noise
        counted = (squared_frequency > 0) & (squared_frequency <= up_to**2)
        rows.append(
            (
                float((power / (1 + neq * power)).sum() / power.sum()),
                float(torch.log2(1 + neq * power).mean() / 2),
                float(torch.log(neq[counted].clamp_min(_LOST_NEQ)).mean()),
                light_share,
            )
        )
    return Filtered(*torch.tensor(rows, dtype=torch.float64).T)


@filtered_picture.check
def _(result: Filtered, *inputs: Any, electrons: float, **params: Any) -> list[Check]:
    error, bits = float(result.error.mean()), float(result.information.mean())
    ok = bool(((result.error >= 0) & (result.error <= 1 + 1e-6)).all())
    text = (
        f"{electrons:.4g} e- a pixel: error after the filter {error:.3g} of the scene, {bits:.3g}"
        " bits a pixel"
    )
    return [Check(text, ok)]


def _on_device_of(like: Tensor, *tensors: Tensor) -> list[Tensor]:
    """Return tensors on the device of the first one."""
    return [x.to(like.device) for x in tensors]


def channel_psf(psf: Psf, illuminant: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return the PSF (channel, y, x) of each channel for a grey scene in float64; its sum is the
    transmitted share of the light.
    """
    lengths = {len(psf.intensity), len(illuminant), responses.shape[-1], len(bands.centres)}
    if len(lengths) > 1:
        raise ValueError(
            f"PSF, illuminant, responses and bands have {sorted(lengths)} bands: use one `bands`"
            " step"
        )
    shares = grey_shares(illuminant, responses, bands).to(psf.intensity.device)
    kernels: Tensor = torch.tensordot(shares, psf.intensity.double(), 1)
    return kernels


def noise_variance(
    light: Any, glare: Any, read_noise: float, prnu: float = 0.0, residual_glare: float = 0.0
) -> Any:
    """Return the noise variance of a pixel in e-**2: shot noise, read noise, PRNU, and wrongly
    subtracted glare.

    light + glare + read_noise**2 + (prnu (light + glare))**2 + (residual_glare glare)**2, with
    light and glare in e-.
    """
    signal = light + glare
    return signal + read_noise**2 + (prnu * signal) ** 2 + (residual_glare * glare) ** 2


def natural_power(shape: tuple[int, ...], variance: float) -> Tensor:
    """Return the power of the contrast of natural scenes at each frequency of an FFT: (y, x)
    float64.

    The power falls with the square of the frequency, is 0 at frequency 0, and its mean over all
    frequencies is ``variance``.
    """
    squared_frequency = _squared_frequency(shape)
    power = torch.where(
        squared_frequency > 0, 1.0 / squared_frequency.where(squared_frequency > 0, 1.0), 0.0
    )
    scaled: Tensor = power * (variance / power.mean())
    return scaled


def low_frequencies(shape: tuple[int, ...], up_to: float) -> Tensor:
    """Return True at the frequencies above 0 and up to ``up_to`` cycles per pixel, in the layout
    of an FFT: (y, x).
    """
    squared_frequency = _squared_frequency(shape)
    low: Tensor = (squared_frequency > 0) & (squared_frequency <= up_to**2)
    return low


def _squared_frequency(shape: tuple[int, ...]) -> Tensor:
    """Return the squared frequencies (y, x) of an FFT, in cycles per pixel."""
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in shape)
    squared: Tensor = fy[:, None].square() + fx.square()
    return squared


def decibels(ratio: float) -> float:
    """Return a ratio of variances or of powers in dB, 10 log10."""
    return 10.0 * math.log10(ratio)


# --- picture spectrum -----------------------------------------------------------------------------

# The spectrum of a picture as a histogram, from which the error for any light, filter and noise is
# computed in microseconds.
#
# A grey filter scales the whole spectrum, and the light scales the scene. So no PSF has to be
# computed for another transmittance, another scene light or another glare.


#: first and last decade of the bins, and bins per decade, which give an error of 1e-4
_FIRST_POWER_DECADE, _LAST_POWER_DECADE, _POWER_BINS_PER_DECADE = -20, 8, 40


class PictureSpectrum(NamedTuple):
    """Sums over the frequencies of a picture, binned by their power p, for each channel of the
    sensor.

    The Wiener filter uses the OTF ``known``, and p is the power of the scene times |known|**2. The
    picture has the OTF ``true``. Without mismatch, both OTFs are equal.
    """

    power: Tensor  #: (channel, bin) mean of p
    signal: Tensor  #: (channel, bin) share of the scene's variance
    real: Tensor  #: (channel, bin) sum of this share times the real part of true / known
    square: Tensor  #: (channel, bin) sum of this share times |true / known|**2
    strength: Tensor  #: (channel, bin) mean of scene power times |true OTF|**2, binned by itself
    rate: Tensor  #: (channel, bin) share of the frequencies in this bin of ``strength``
    contrast: Tensor  #: (channel,) mean of log(|true OTF|**2) up to a highest frequency
    light: Tensor  #: (channel,) share of the scene's light in the picture


def picture_spectrum(
    true: Tensor, assumed: Tensor, variance: float = 0.1, up_to: float = 0.12
) -> PictureSpectrum:
    """Return the spectrum of a picture, with its frequencies binned by power.

    ``true`` and ``assumed`` are PSFs (channel, y, x) of `channel_psf`: the PSF of the picture, and
    the PSF that the filter assumes.
    """
    otf, assumed_otf = torch.fft.fft2(true), torch.fft.fft2(assumed)
    scene = natural_power(tuple(otf.shape[-2:]), variance)
    is_low = low_frequencies(tuple(otf.shape[-2:]), up_to)
    share = scene / scene.sum()
    channel_rows = []
    for channel_otf, assumed_channel_otf in zip(otf, assumed_otf, strict=True):
        assumed_power = assumed_channel_otf.abs().square()
        # true OTF / assumed OTF: the factor of the error of the filter
        ratio = torch.where(
            assumed_power > 0,
            channel_otf * assumed_channel_otf.conj() / assumed_power.clamp_min(1e-300),
            0.0,
        )
        weights = (share, share * ratio.real, share * ratio.abs().square())
        power, *sums = _binned(scene * assumed_power, *weights)
        strength, count = _binned(
            scene * channel_otf.abs().square(), torch.full_like(scene, 1.0 / scene.numel())
        )
        contrast = channel_otf.abs().square()[is_low].clamp_min(1e-30).log().mean()
        channel_rows.append((power, *sums, strength, count, contrast, channel_otf[0, 0].real))
    return PictureSpectrum(*(torch.stack(column) for column in zip(*channel_rows, strict=True)))


def _binned(value: Tensor, *weights: Tensor) -> list[Tensor]:
    """Return the mean of ``value`` in each bin, weighted by the first of ``weights``, and the
    sums of all weights.
    """
    bin_index = (
        ((value.clamp_min(1e-300).log10() - _FIRST_POWER_DECADE) * _POWER_BINS_PER_DECADE)
        .long()
        .clamp(0, (_LAST_POWER_DECADE - _FIRST_POWER_DECADE) * _POWER_BINS_PER_DECADE - 1)
        .flatten()
    )
    zero_bins = torch.zeros(
        (_LAST_POWER_DECADE - _FIRST_POWER_DECADE) * _POWER_BINS_PER_DECADE, dtype=torch.float64
    )
    weight_sums = [zero_bins.index_add(0, bin_index, weight.flatten()) for weight in weights]
    weighted_sum = zero_bins.index_add(0, bin_index, (value * weights[0]).flatten())
    return [
        torch.where(weight_sums[0] > 0, weighted_sum / weight_sums[0].clamp_min(1e-300), 0.0),
        *weight_sums,
    ]


def remaining_error(spectrum: PictureSpectrum, amplitude: float, noise: Tensor) -> Tensor:
    """Return the error variance after the filter / the variance of the scene, (noise, channel).

    ``amplitude`` is the scene light in e- times the transmittance of a filter. ``noise`` (noise,
    channel) is the noise variance of a pixel in e-**2. With u = a**2 p / (a**2 p + noise) for the
    amplitude a, the filter multiplies the scene by u ratio, where ratio = true / known. The error
    is the sum of signal |1 - u ratio|**2 and of the filtered noise, signal u (1 - u).
    """
    signal_power = amplitude**2 * spectrum.power
    wiener_gain = signal_power / (signal_power + noise[:, :, None])
    # |1 - u ratio|^2 for the scene, and u (1 - u) for the noise, by bin
    error = (
        spectrum.signal
        - 2 * wiener_gain * spectrum.real
        + wiener_gain.square() * spectrum.square
        + wiener_gain * (1 - wiener_gain) * spectrum.signal
    )
    return error.sum(-1)


def information_bits(spectrum: PictureSpectrum, amplitude: float, noise: Tensor) -> Tensor:
    """Return the information (noise, channel) in bits per pixel: the mean of log2(1 + NEQ S) / 2
    over all frequencies, with the power S of the scene.
    """
    signal_to_noise = amplitude**2 * spectrum.strength / noise[:, :, None]
    return (spectrum.rate * torch.log2(1 + signal_to_noise)).sum(-1) / 2


def mean_log_neq(spectrum: PictureSpectrum, amplitude: float, noise: Tensor) -> Tensor:
    """Return the mean of log(NEQ) over low frequencies, (noise, channel)."""
    return spectrum.contrast + torch.log(amplitude**2 / noise)


def radial_contrast(
    psf: Psf, illuminant: Tensor, responses: Tensor, bands: Bands, rings: int = 40
) -> tuple[Tensor, Tensor]:
    """Return frequencies up to 1/2 cycle per pixel, and the mean of |OTF|**2 in a ring around each
    of them: (ring,) each.

    The mean is over directions and channels. The OTF is not normalized: |OTF(0)|**2 is the square
    of the transmitted share of the light.
    """
    mean_square_otf = (
        torch.fft.fft2(channel_psf(psf, illuminant, responses, bands)).abs().square().mean(0)
    )
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in mean_square_otf.shape)
    radius = torch.hypot(fy[:, None], fx)
    in_rings = (radius > 0) & (radius < 0.5)
    ring_number = (radius[in_rings] * 2 * rings).long()
    zero_rings = torch.zeros(rings, dtype=torch.float64)
    ring_count = zero_rings.index_add(0, ring_number, torch.ones_like(radius[in_rings])).clamp_min(
        1
    )
    middle = (torch.arange(rings, dtype=torch.float64) + 0.5) / (2 * rings)
    return middle, zero_rings.index_add(0, ring_number, mean_square_otf[in_rings]) / ring_count


# --- attacked picture -----------------------------------------------------------------------------

# A picture under attack: a histogram of the glare of a laser, and the error and information of the
# unsaturated pixels after a Wiener filter.


_FIRST_GLARE_DECADE, _LAST_GLARE_DECADE, _GLARE_BINS_PER_DECADE = (
    -16,
    1,
    20,
)  #: first and last decade of the glare, and bins per decade
_TABLE_NOISES = 48  #: noise levels in the table of errors; interpolation errors are below 1e-4


class GlareLevels(NamedTuple):
    """The light of a laser over the pixels of a field as a histogram, relative to the peak of
    the clear lens.
    """

    level: Tensor  #: (bin,) mean of the light in a bin
    share: Tensor  #: (bin,) share of the pixels


class PixelNoise(NamedTuple):
    """The noise of a pixel and its well."""

    read_noise: float  #: e-
    full_well: float  #: e-
    prnu: float  #: relative spread of the sensitivity of pixels
    residual_glare: float  #: share of the glare that is subtracted wrongly


class Attack(NamedTuple):
    """The lasers that attack a picture, from the weakest to the strongest."""

    #: (strength,); 1 fills one pixel behind the clear lens in the channel that responds most
    strengths: Tensor
    colour: Tensor  #: (channel,) response of each channel relative to the one that responds most


class Attacked(NamedTuple):
    """Error and information of a picture under attack, averaged over pixels and channels."""

    #: () error variance after the filter / variance of the scene; 1 for a saturated pixel
    error: Tensor
    information: Tensor  #: () bits per pixel; 0 for a saturated pixel
    seen: Tensor  #: () share of the pixels that are not saturated


def glare_levels(light: Tensor, clear_peak: float) -> GlareLevels:
    """Return a histogram of the light (y, x) of a laser over the pixels of a field."""
    relative = light.double().flatten() / clear_peak
    bin_index = (
        ((relative.clamp_min(1e-300).log10() - _FIRST_GLARE_DECADE) * _GLARE_BINS_PER_DECADE)
        .long()
        .clamp(0, (_LAST_GLARE_DECADE - _FIRST_GLARE_DECADE) * _GLARE_BINS_PER_DECADE - 1)
    )
    zero_bins = torch.zeros(
        (_LAST_GLARE_DECADE - _FIRST_GLARE_DECADE) * _GLARE_BINS_PER_DECADE,
        dtype=torch.float64,
    )
    count = zero_bins.index_add(0, bin_index, torch.ones_like(relative))
    mean = zero_bins.index_add(0, bin_index, relative) / count.clamp_min(1)
    has_pixels = count > 0
    return GlareLevels(mean[has_pixels], count[has_pixels] / len(relative))


def attacked_picture(
    spectrum: PictureSpectrum,
    glare: GlareLevels,
    noise: PixelNoise,
    attack: Attack,
    *,
    electrons: float,
    transmittance: float,
) -> Attacked:
    """Return error, information and share of unsaturated pixels for each strength of a laser:
    (strength,) each.

    A grey filter of ``transmittance`` attenuates scene and laser equally. The Wiener filter knows
    the noise of each pixel. A pixel is lost if scene and glare fill its well.
    """
    amplitude = electrons * transmittance
    light = amplitude * spectrum.light
    # a strength is in full wells at the peak of the clear lens
    peak_light = noise.full_well * attack.strengths[:, None, None] * transmittance
    laser_light = peak_light * glare.level[:, None] * attack.colour  # (strength, bin, channel)
    not_full = (laser_light + light) < noise.full_well
    noise_without_glare = noise_variance(
        light, 0.0, noise.read_noise, noise.prnu, noise.residual_glare
    )
    noise_at_full_well = noise_variance(
        light, noise.full_well, noise.read_noise, noise.prnu, noise.residual_glare
    )
    noise_steps = torch.linspace(0, 1, _TABLE_NOISES, dtype=torch.float64)[:, None]
    # the error depends only on the noise: table over the logarithm of the noise, (noise, channel)
    log_noise_table = (
        noise_without_glare.log() + noise_steps * (noise_at_full_well / noise_without_glare).log()
    )
    log_noise = noise_variance(
        light, laser_light, noise.read_noise, noise.prnu, noise.residual_glare
    ).log()
    table_place = (
        (log_noise - noise_without_glare.log())
        / (noise_at_full_well / noise_without_glare).log()
        * (_TABLE_NOISES - 1)
    ).clamp(0, _TABLE_NOISES - 1 - 1e-9)
    error, bits = (
        _interpolated_rows(f(spectrum, amplitude, log_noise_table.exp()), table_place)
        for f in (remaining_error, information_bits)
    )
    weights = glare.share[:, None]
    means = (torch.where(not_full, error, 1.0), torch.where(not_full, bits, 0.0), not_full.double())
    return Attacked(*((weights * mean).sum(1).mean(-1) for mean in means))


def _interpolated_rows(table: Tensor, place: Tensor) -> Tensor:
    """Return the values of a table (noise, channel), interpolated at fractional rows ``place``
    (strength, bin, channel).
    """
    row_below = place.floor().long()
    channel = torch.arange(table.shape[1])
    below, above = table[row_below, channel], table[row_below + 1, channel]
    return below + (place - row_below) * (above - below)
