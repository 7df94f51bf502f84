"""Loss functions of a mask combined with a grey filter that limits the peak of a laser."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.losses._mask_losses import HighestFrequency
from neusee.nodes.optics._lens import averaged_side, cut_off, round_lens, stop_width
from neusee.nodes.precision import single
from neusee.nodes.restore.inverse._masked_blur import effective_psf, grey_shares, times
from neusee.nodes.units import Electrons, Fraction
from neusee.nodes.values import Bands, Psf

# --- filtered picture -----------------------------------------------------------------------------

# The quality of a picture after an ideal linear filter: noise equivalent quanta, error and
# information.
#
# All spectra are half spectra, as `torch.fft.rfft2` returns them. A natural scene has a power
# spectrum 1 / frequency^2.


_DARK = 1e-30  #: ratio below which a band counts as dark
#: entries of the table of contrast over frequency, up to the corner of the spectrum
_TABLE_RADII = 8192


class GreyScene(NamedTuple):
    """The quantities that determine the weight of each band in each camera channel for a grey
    scene.
    """

    illuminant: Tensor  #: (band,)
    responses: Tensor  #: (channel, band)
    bands: Bands


class ProtectedPicture(NamedTuple):
    """Light, noise and contrast of a picture of a natural scene, and the limit of a laser's peak in
    it.
    """

    light: float  #: e- per pixel behind the clear lens, mean of the scene
    read_noise: float  #: e-, standard deviation
    veil: float = 0.0  #: e- per pixel, uniform veil of laser light
    limit: float | None = None  #: largest laser suppression ratio (LSR); None for no limit
    contrast: float = 0.1  #: variance of the relative brightness of the scene
    up_to: float | None = None  #: cycles per pixel, highest frequency that counts; None for all


class Exposure(NamedTuple):
    """Light and read noise per pixel, as behind the clear lens, and the transmittance of the
    mask.
    """

    light: float  #: e-, mean of the scene
    read: float  #: e-, standard deviation
    veil: float  #: e-, uniform veil of laser light
    passed: float  #: share of the light that the pupil of the mask lets through


def frequencies(size: tuple[int, int], like: Tensor) -> Tensor:
    """Return the absolute spatial frequency in cycles per pixel of each element of a half
    spectrum.
    """
    fy = torch.fft.fftfreq(size[0], dtype=torch.float64, device=like.device)
    fx = torch.fft.rfftfreq(size[1], dtype=torch.float64, device=like.device)
    return torch.hypot(fy[:, None], fx)


def natural_spectrum(size: tuple[int, int], contrast: float, like: Tensor) -> Tensor:
    """Return the power spectrum 1 / frequency^2 of a natural scene, scaled to the mean ``contrast``
    over all frequencies.
    """
    frequency = frequencies(size, like)
    power = torch.where(frequency > 0, frequency, torch.inf).pow(-2.0)
    mean_power = (power.sum(0) * times(size, power)).sum() / (size[0] * size[1])
    return power * (contrast / mean_power.where(mean_power > 0, 1.0))


def noise_equivalent_quanta(passed: Tensor, exposure: Exposure, filtered: Tensor) -> Tensor:
    """Return the noise equivalent quanta (T n MTF)^2 / (T n + veil + read^2) behind a filter of
    transmittance T.

    ``passed`` is the squared modulus of the OTF (1 at frequency 0 if all light reaches the window)
    and ``filtered`` the transmittance T.
    """
    filtered_light = filtered * exposure.light
    # variance in e-^2: shot noise of scene and veil, and read noise
    noise = filtered_light * exposure.passed + filtered * exposure.veil + exposure.read**2
    return filtered_light.square() * passed / noise.clamp_min(_DARK)


def spectrum_mean(values: Tensor, size: tuple[int, int], counted: Tensor) -> Tensor:
    """Return the mean of a half spectrum over the frequencies ``counted`` of the full spectrum."""
    frequency_counts = counted * times(size, values)
    mean: Tensor = (values * frequency_counts).sum((-2, -1)) / frequency_counts.sum()
    return mean


def error_share(snr: Tensor, spectrum: Tensor, size: tuple[int, int], counted: Tensor) -> Tensor:
    """Return the error variance after a Wiener filter relative to the variance of the scene, over
    the frequencies ``counted``.
    """
    return spectrum_mean(spectrum / (1 + snr), size, counted) / spectrum_mean(
        spectrum, size, counted
    )


def information_share(snr: Tensor, size: tuple[int, int], counted: Tensor) -> Tensor:
    """Return the mean of log2(1 + SNR) over the frequencies ``counted``."""
    return spectrum_mean(torch.log2(1 + snr), size, counted)


def peak_share(intensity: Tensor, clear_peak: Tensor, power: float | None) -> Tensor:
    """Return the largest laser suppression ratio of all bands; with ``power``, a p-norm over pixels
    and bands replaces the maximum.
    """
    ratio = intensity.double() / clear_peak.to(intensity.device).double()[:, None, None]
    largest_ratio = ratio.detach().amax()
    if power is None:
        return ratio.amax()
    # the p-norm of ratios over the largest one, so that no power overflows; without light the peak
    # is 0 and has no gradient
    scale = torch.where(largest_ratio > _DARK, largest_ratio, 1.0)
    power_sums = (ratio / scale).pow(power).sum()
    smooth_peak: Tensor = torch.where(largest_ratio > _DARK, power_sums, 1.0).pow(
        1 / power
    ) * torch.where(largest_ratio > _DARK, largest_ratio, 0.0)
    return smooth_peak


def filter_transmittance(peak: Tensor, limit: float | None) -> Tensor:
    """Return the transmittance of the grey filter that lowers a peak to ``limit``; 1 if the peak is
    below it.
    """
    if limit is None:
        return torch.ones_like(peak)
    return (limit / peak.clamp_min(_DARK)).clamp_max(1.0)


def round_mtf(frequency: Tensor, cuts: Tensor, shares: Tensor) -> Tensor:
    """Return the MTF of a round aperture for each channel at the spatial frequencies ``frequency``;
    ``cuts`` are the cut-off frequencies of the bands.

    ``shares`` (channel, band) are the weights of the bands in each channel. Values are interpolated
    linearly in a fine table.
    """
    # 0.75 is above the highest frequency of the spectrum, sqrt(1/2) cycles per pixel at its corner
    radii = torch.linspace(0.0, 0.75, _TABLE_RADII, dtype=torch.float64)
    share_of_cut = (radii / cuts[:, None]).clamp_max(1.0)
    # transfer function of an aberration-free round pupil, summed over the bands
    table = shares @ (
        (torch.acos(share_of_cut) - share_of_cut * (1 - share_of_cut.square()).sqrt())
        * (2 / math.pi)
    )
    table_place = frequency * ((_TABLE_RADII - 1) / 0.75)
    row_below = table_place.long().clamp_max(_TABLE_RADII - 2)
    return torch.lerp(
        table[:, row_below],
        table[:, row_below + 1],
        (table_place - row_below).expand(len(shares), *frequency.shape),
    )


# --- protected losses -----------------------------------------------------------------------------

# Loss functions of a mask combined with a grey filter that limits the peak of a laser: error and
# information of a picture.


PeakLimit = Annotated[float, Field(gt=0, le=1)]  #: largest laser suppression ratio (LSR)
ContrastVariance = Annotated[float, Field(gt=0, le=1)]
SceneLight = Annotated[Electrons, Field(gt=0)]
_TRIED_STOPS = 24  #: number of diameters tried at first, and then on each side of the best
NormPower = Annotated[float, Field(ge=8, le=256)]


@node()
def filtered_error(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    *,
    light: SceneLight,
    read_noise: Electrons,
    veil: Electrons = 0.0,
    limit: PeakLimit | None = None,
    transmittance: Fraction = 1.0,
    contrast: ContrastVariance = 0.1,
    up_to: HighestFrequency | None = None,
    power: NormPower | None = None,
) -> Tensor:
    """Average over channels the logarithm of the error of a natural picture after a Wiener filter,
    over its variance.

    Behind a mask with a grey filter that lowers the peak of a laser to ``limit`` times that of the
    clear lens, in every band. The scene has a power spectrum 1 / frequency^2 and a variance
    ``contrast`` of relative brightness; frequency 0 does not count. A pixel has the noise of its
    light, of an even ``veil`` of the laser, and of reading. The Wiener filter of a channel knows
    the PSF of a grey scene. The transmittance of the grey filter follows from the mask: the largest
    that keeps the limit is the best. ``power`` replaces the maximum over pixels by a norm, whose
    gradient reaches every bright pixel. ``up_to`` excludes finer frequencies.

    Shapes: psf.intensity (band, y, x), responses (channel, band) -> ().
    Units:  none; natural logarithm of a share, 0 if nothing is seen. light, veil and read_noise e-
            in a pixel behind the clear lens without a filter; transmittance: share of the light
            that the pupil behind the mask lets through, a tensor () if it is learnt; up_to cycles
            per pixel.
    Error:  1e-6 in float32. Clipped pixels, edges and unknown glare are neglected. Light that
            leaves the window counts as noise, because as much comes from outside. The norm is up to
            n^(1/power) above the maximum.
    Raises: ValueError where the inputs differ in the number of bands.
    Source: Wiener filter as in Goodman, Introduction to Fourier Optics, 4th ed., ch. 8; NEQ as in
            Barrett and Myers, Foundations of Image Science, 2004, ch. 13; spectrum of natural
            scenes: Field, J. Opt. Soc. Am. A 4, 2379 (1987). The limit by a filter is ours.
    """
    scene = GreyScene(illuminant, responses, bands)
    picture = ProtectedPicture(light, read_noise, veil, limit, contrast, up_to)
    snr, spectrum, counted = _snr_behind_mask(psf, scene, picture, transmittance, power)
    error_variance = error_share(snr, spectrum, _window_of(psf), counted)
    return error_variance.clamp_min(1e-30).log().mean().to(single(psf.intensity))


@node()
def information(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    *,
    light: SceneLight,
    read_noise: Electrons,
    veil: Electrons = 0.0,
    limit: PeakLimit | None = None,
    transmittance: Fraction = 1.0,
    contrast: ContrastVariance = 0.1,
    up_to: HighestFrequency | None = None,
    power: NormPower | None = None,
) -> Tensor:
    """Average over channels and frequencies the negative information log2(1 + NEQ S) about a
    natural picture.

    S is the power spectrum of the scene, and NEQ = (T n MTF)^2 / (T n + veil + read^2) are the
    noise equivalent quanta behind mask and grey filter. Scene, filter and parameters are those of
    `losses.filtered_error`. Fine detail counts here as much as coarse detail, whereas the error is
    that of coarse detail.

    Shapes: psf.intensity (band, y, x), responses (channel, band) -> ().
    Units:  bits per frequency, negative; the parameters as in `losses.filtered_error`.
    Error:  1e-6 in float32. Neglects what `losses.filtered_error` neglects.
    Raises: ValueError where the inputs differ in the number of bands.
    Source: Shannon, Proc. IRE 37, 10 (1949), for Gaussian signals and noise; NEQ as in Barrett and
            Myers, Foundations of Image Science, 2004, ch. 13.
    """
    scene = GreyScene(illuminant, responses, bands)
    picture = ProtectedPicture(light, read_noise, veil, limit, contrast, up_to)
    snr, _, counted = _snr_behind_mask(psf, scene, picture, transmittance, power)
    return -information_share(snr, _window_of(psf), counted).mean().to(single(psf.intensity))


def _snr_behind_mask(
    psf: Psf,
    scene: GreyScene,
    picture: ProtectedPicture,
    transmittance: float,
    power: float | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return NEQ x S of each channel behind mask and filter, S, and the mask of the counted
    frequencies. NEQ are the noise equivalent quanta, S the power spectrum of the scene.

    ``transmittance`` is the share of the light that the pupil of the mask transmits, and ``power``
    the exponent of the p-norm that replaces the maximum over pixels.
    """
    size, kernels = _window_of(psf), effective_psf(psf, *scene, torch.float64).double()
    otf = torch.fft.rfft2(kernels)
    spectrum = natural_spectrum(size, picture.contrast, kernels)
    filtered = filter_transmittance(peak_share(psf.intensity, psf.clear_peak, power), picture.limit)
    exposure = Exposure(picture.light, picture.read_noise, picture.veil, transmittance)
    noise_quanta = noise_equivalent_quanta(
        otf.real.square() + otf.imag.square(), exposure, filtered
    )
    return noise_quanta * spectrum, spectrum, _counted_frequencies(size, picture.up_to, kernels)


def _counted_frequencies(size: tuple[int, int], up_to: float | None, like: Tensor) -> Tensor:
    """Return a mask of the frequencies of a half spectrum above 0 and up to ``up_to`` (None:
    all).
    """
    frequency = frequencies(size, like)
    return (frequency > 0) & (frequency <= (1.0 if up_to is None else up_to))


def _window_of(psf: Psf) -> tuple[int, int]:
    """Return the size (y, x) of the window of a PSF."""
    return psf.intensity.shape[-2], psf.intensity.shape[-1]


@filtered_error.reference
def _(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    *,
    transmittance: float = 1.0,
    power: float | None = None,
    **settings: Any,
) -> Tensor:
    scene, picture = GreyScene(illuminant, responses, bands), ProtectedPicture(**settings)
    logs = [
        (spectrum / (1 + snr))[counted].sum().div(spectrum[counted].sum()).clamp_min(1e-30).log()
        for snr, spectrum, counted in _by_definition(psf, scene, picture, transmittance, power)
    ]
    return torch.stack(logs).mean()


@information.reference
def _(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    *,
    transmittance: float = 1.0,
    power: float | None = None,
    **settings: Any,
) -> Tensor:
    scene, picture = GreyScene(illuminant, responses, bands), ProtectedPicture(**settings)
    channels = _by_definition(psf, scene, picture, transmittance, power)
    return -torch.stack(
        [snr[counted].log1p().mean() / math.log(2) for snr, _, counted in channels]
    ).mean()


def _by_definition(
    psf: Psf,
    scene: GreyScene,
    picture: ProtectedPicture,
    transmittance: float,
    power: float | None,
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield NEQ x S, S and the mask of the counted frequencies for each channel, on the full
    spectrum.
    """
    y, x = psf.intensity.shape[-2:]
    fy, fx = torch.fft.fftfreq(y, dtype=torch.float64), torch.fft.fftfreq(x, dtype=torch.float64)
    squared_frequency = fy[:, None].square() + fx.square()
    spectrum = torch.where(squared_frequency > 0, 1 / squared_frequency, 0.0)
    spectrum = spectrum * (picture.contrast * x * y / spectrum.sum().clamp_min(1e-300))
    lsr = (psf.intensity.double() / psf.clear_peak[:, None, None]).flatten()
    peak = (
        lsr.max()
        if power is None
        else (power * lsr.clamp_min(1e-300).log()).logsumexp(0).div(power).exp()
    )
    transmittance_of_filter = torch.ones(())
    if picture.limit is not None:
        transmittance_of_filter = torch.minimum(transmittance_of_filter, picture.limit / peak)
    sensitivity = scene.responses.double() * (scene.illuminant.double() * scene.bands.centres)
    for share in sensitivity / sensitivity.sum(-1, keepdim=True):
        transfer = torch.fft.fft2(torch.tensordot(share, psf.intensity.double(), 1)).abs()
        light_and_veil = picture.light * transmittance + picture.veil
        noise = transmittance_of_filter * light_and_veil + picture.read_noise**2
        counted = (squared_frequency > 0) & (squared_frequency <= (picture.up_to or 1.0) ** 2)
        yield (
            (transmittance_of_filter * picture.light * transfer).square() / noise * spectrum,
            spectrum,
            counted,
        )


def best_stop(
    plain: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    picture: ProtectedPicture,
    measure: Literal["filtered_error", "information"] = "filtered_error",
) -> tuple[float, float, float]:
    """Return the smallest loss that a circular stop with a grey filter reaches under the same
    limit, with the diameter of the stop and the transmittance of the filter.

    The diameter is relative to that of the clear aperture, whose cut-off is that of ``plain``. The
    peak behind a stop falls with the fourth power of its diameter, apart from averaging over
    pixels, and its light with the second power. ``measure`` names the loss: ``filtered_error`` or
    ``information``.
    """
    size, grey = _window_of(plain), grey_shares(illuminant, responses, bands)
    cut_offs, sides = cut_off(plain).cpu(), averaged_side(plain).cpu()
    pixel_contrast = _pixel_contrast(size, float(sides.max()))
    spectrum = natural_spectrum(size, picture.contrast, cut_offs)
    counted, frequency = (
        _counted_frequencies(size, picture.up_to, cut_offs),
        frequencies(size, cut_offs),
    )

    def loss_of(width: float) -> tuple[float, float, float]:
        filtered = filter_transmittance(_stop_peak(width, cut_offs, sides), picture.limit)
        exposure = Exposure(picture.light, picture.read_noise, picture.veil, width**2)
        snr = (
            noise_equivalent_quanta(
                (width**2 * pixel_contrast * round_mtf(frequency, width * cut_offs, grey)).square(),
                exposure,
                filtered,
            )
            * spectrum
        )
        log_error = error_share(snr, spectrum, size, counted).clamp_min(1e-30).log()
        loss = log_error if measure == "filtered_error" else -information_share(snr, size, counted)
        return float(loss.mean()), width, float(filtered)

    # a narrower stop would protect more than the limit demands, and lose light and contrast
    narrowest = float(
        stop_width(torch.full_like(cut_offs, picture.limit or 1.0), cut_offs, sides).min()
    )
    # evenly spaced diameters, then finer steps on each side of the best
    coarse_best = min(
        loss_of(1.0 + i / (_TRIED_STOPS - 1) * (narrowest - 1.0)) for i in range(_TRIED_STOPS)
    )
    width_step = (1.0 - narrowest) / (_TRIED_STOPS - 1)
    finer_widths = (
        coarse_best[1] + i / (_TRIED_STOPS - 1) * width_step
        for i in range(1 - _TRIED_STOPS, _TRIED_STOPS)
    )
    return min(
        [coarse_best, *(loss_of(width) for width in finer_widths if narrowest <= width <= 1.0)]
    )


def _stop_peak(width: float, cuts: Tensor, sides: Tensor) -> Tensor:
    """Return the largest laser suppression ratio of all bands of a stop; the wider spot loses less
    of its peak to averaging over pixels.
    """
    ratios = round_lens(width * cuts, sides).peak / round_lens(cuts, sides).peak
    return width**4 * ratios.max()


def _pixel_contrast(size: tuple[int, int], side: float) -> Tensor | float:
    """Return the transfer function of pixels that average over a square of ``side`` pixels, at the
    frequencies of `frequencies`.
    """
    if not side:
        return 1.0
    fy, fx = (
        torch.fft.fftfreq(size[0], dtype=torch.float64),
        torch.fft.rfftfreq(size[1], dtype=torch.float64),
    )
    return torch.sinc(side * fy)[:, None] * torch.sinc(side * fx)
