"""Suppression ratios of a mask (LSR, BSR), their limits for any mask, and upper bounds of the
advantage of a mask over a grey filter or a smaller stop.
"""

import math
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import conv2d, pad

from neusee.nodes import Check, node
from neusee.nodes.metrics._picture_quality import Light
from neusee.nodes.optics._band_image import light_in_field
from neusee.nodes.optics._lens import (
    averaged_side,
    cut_off,
    passed_by_notches,
    round_lens,
    stop_width,
)
from neusee.nodes.precision import single
from neusee.nodes.units import Electrons
from neusee.nodes.values import Psf, Pupil

# --- mask limits ----------------------------------------------------------------------------------

# Physical limits of any mask: the lowest laser suppression ratio, and the highest contrast for a
# given peak.


_DARK = 1e-30  #: share of the light below which a band counts as dark


class Limits(NamedTuple):
    """Bounds of laser suppression and contrast for a PSF, and the root mean square contrast of
    this PSF.
    """

    #: (band,) float64, LSR if the light in the window is spread evenly over the window
    floor: Tensor
    #: (band,) float64, root mean square contrast over all frequencies that the pixels sample
    rms: Tensor
    bound: Tensor  #: (band,) float64, upper bound of `rms`: sqrt(LSR p0 / light)
    #: (band,) float64, upper bound of the root mean square over the frequencies of the clear
    #: aperture
    passed: Tensor
    median: Tensor  #: (band,) float64, upper bound of the median over the same frequencies


@node(rtol=1e-6)
def limits(psf: Psf) -> Limits:
    """Compute a bound of laser suppression for evenly spread light, and bounds of contrast by
    Parseval's theorem.

    Light E in N pixels has a peak of at least E / N, and LSR = peak / p0. The mean of |OTF|**2 over
    all frequencies is the sum of PSF**2, which is at most peak times light. Over a share s of the
    frequencies the mean is at most 1 / s times as large. Half of these frequencies lie above the
    median: median <= sqrt(2 LSR p0 / (E s)).

    Shapes: psf.intensity (band, y, x) -> five of (band,) float64.
    Units:  none.
    Error:  1e-6 in float32. The floor holds for the window: a wider field has a lower floor.
            Without light (1e-30) all five bounds are 0.
    Source: Parseval's theorem; the cut-off of the clear aperture as in `metrics.mtf`.
    """
    bounds_by_band = [_contrast_bound(kernel.double()) for kernel in psf.intensity]
    light, rms, bound = (torch.stack(column) for column in zip(*bounds_by_band, strict=True))
    # all the contrast may lie within the pass band of the lens
    lens_band_bound = bound / passed_frequency_shares(psf).to(bound).sqrt()
    return Limits(
        light * least_lsr(psf).to(light),
        rms,
        bound,
        lens_band_bound,
        math.sqrt(2.0) * lens_band_bound,
    )


def _contrast_bound(kernel: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the light in the PSF of one band, the rms contrast of this PSF, and an upper bound
    of the contrast.
    """
    is_dark = kernel.sum() <= _DARK  # false for NaN, so that NaN reaches the result
    kernel = kernel.where(~is_dark, 1.0)  # the gradient of sqrt is infinite at 0
    light, peak = kernel.sum(), kernel.amax()
    # Parseval: mean of |OTF|^2 = sum of PSF^2, at most peak x light
    rms, bound = kernel.square().sum().sqrt() / light, (peak / light).sqrt()
    return light.where(~is_dark, 0.0), rms.where(~is_dark, 0.0), bound.where(~is_dark, 0.0)


@limits.check
def _(result: Limits, psf: Psf) -> list[Check]:
    lowest, highest = float(result.floor.min()), float(result.floor.max())
    is_within_bound = bool((result.rms <= result.bound * (1 + 1e-6)).all())
    return [
        Check(
            f"LSR {lowest:.3g} to {highest:.3g} for even light; rms contrast"
            f" {float(result.rms.mean()):.3g}, upper bound {float(result.bound.mean()):.3g}",
            is_within_bound,
        )
    ]


# --- limits of any mask on this lens --------------------------------------------------------------


def least_lsr(psf: Psf) -> Tensor:
    """Return the laser suppression ratio (LSR) of light that is spread uniformly over the field:
    (band,) float64.

    The field has N pixels, and the clear lens puts a share p0 of the light into the brightest
    pixel. With a mask that keeps all light in the field, the brightest pixel has at least 1/N of
    the light, so that LSR >= 1 / (N p0). A mask that scatters light out of the field lowers this
    bound by the share of the light that the mask keeps.
    """
    pixels = psf.intensity.shape[-2] * psf.intensity.shape[-1]
    return 1.0 / (pixels * psf.clear_peak.double())


def most_unsuppressed(psf: Psf) -> Tensor:
    """Return the upper bound (band,) of the rms contrast of a lossless mask that does not suppress
    the laser.

    The laser suppression ratio (LSR) of this mask is 1. For another ratio, the bound scales with
    sqrt(LSR).
    """
    clear_peak = psf.clear_peak.double()
    return (clear_peak / passed_frequency_shares(psf).to(clear_peak)).sqrt()


def passed_frequency_shares(psf: Psf) -> Tensor:
    """Return the share of the sampled spatial frequencies below the cut-off of the lens: (band,)
    float64.
    """
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in psf.intensity.shape[-2:])
    radius = torch.hypot(fy[:, None], fx)
    return torch.stack([(radius <= cut).double().mean() for cut in cut_off(psf).tolist()])


def most_contrast(unsuppressed: float, lsr: Tensor) -> Tensor:
    """Return the upper bound of the rms contrast of a mask for each laser suppression ratio in
    ``lsr``.
    """
    return (unsuppressed * lsr.sqrt()).clamp_max(1.0)


# --- suppression ratios ---------------------------------------------------------------------------

# Suppression ratios of a mask: laser suppression ratio (LSR) and background suppression ratio
# (BSR).

_ROUNDED_LIGHT = 1e-4  #: largest relative excess of light due to sampling and round-off


@node(rtol=1e-6)
def lsr(psf: Psf) -> Tensor:
    """Compute the laser suppression ratio: the peak of the PSF divided by the peak of the PSF of
    the clear lens.

    Shapes: psf.intensity (band, y, x) -> (band,) float64.
    Units:  none; 1 for the clear lens.
    Error:  of the sampling: a spot between two pixels reads up to 20 % low, so that the PSF
            convention matters.
    Source: NeuSee, section Sensor Image (LSR).
    """
    return psf.intensity.amax((-2, -1)).double() / psf.clear_peak.to(psf.intensity.device)


@lsr.check
def _(result: Tensor, *inputs: Psf) -> list[Check]:
    floor = float(least_lsr(inputs[0]).max())
    return [
        Check(
            f"laser suppression ratio {float(result.min()):.3g} to {float(result.max()):.3g}",
            bool((result <= 1.05).all()),
        ),
        Check(
            "light spread evenly over the field would give a laser suppression ratio of"
            f" {floor:.2g}"
        ),
    ]


@node(rtol=1e-6, bands={"psf": 0, "radiance": -3, "return": -1})
def bsr(psf: Psf, radiance: Tensor | None = None) -> Tensor:
    """Compute the background suppression ratio: the share of the scene's light that a mask leaves
    in the field.

    The scene's light is all light that the clear pupil takes from the scene inside the field, which
    an unbounded sensor would collect behind the clear lens. Light counts as lost if it falls
    outside the field, outside the window of the PSF, or is absorbed by dirt. No light enters from
    outside the field, so the border of `optics.image` has no effect, and the ratio of a passive
    mask is at most 1. The ratio of the clear lens is a little below 1, for its own diffraction.
    Without a scene, the ratio is that of a point on the axis: the share of the light in the window.

    Shapes: psf.intensity (band, any, any), radiance (..., band, y, x) -> (..., band) float64.
    Units:  none; 1 where all light stays in the field.
    Error:  1e-6 in float32. A band without light (1e-30) has ratio 1. A PSF sampled at points holds
            more than all light where pixels are wider than lambda f / D, or where the light reaches
            the edge of the alias-free field. Sharpness is not measured.
    Raises: ValueError where scene and PSF have different bands.
    Source: NeuSee, section Sensor Image (BSR), as a ratio of energies; the border is left out.
    """
    if radiance is None:
        return single(psf.intensity).sum(-1).sum(-1, dtype=torch.float64)
    light_kept, scene_light = light_in_field(psf.intensity, radiance)
    is_dark = scene_light <= _DARK  # false for NaN, so that NaN reaches the result
    ratio: Tensor = torch.where(is_dark, 1.0, light_kept / scene_light.where(~is_dark, 1.0))
    return ratio


@bsr.reference
def _(psf: Psf, radiance: Tensor | None = None) -> Tensor:
    """Return the ratio from sums over the pixels of an image whose margin contains all light of the
    PSF.
    """
    kernel = psf.intensity.double()
    if radiance is None:
        return kernel.sum((-2, -1))
    cube = radiance.double()
    scene = cube.reshape(-1, *cube.shape[-3:])
    (m, n), (y, x) = kernel.shape[-2:], scene.shape[-2:]
    padding = (n - 1, n - 1, m - 1, m - 1)
    full_image = conv2d(pad(scene, padding), kernel.flip(-1, -2)[:, None], groups=len(kernel))
    light_kept, scene_light = (
        # the field of the scene within the image with margin
        full_image[..., m // 2 : m // 2 + y, n // 2 : n // 2 + x].sum((-2, -1)),
        scene.sum((-2, -1)),
    )
    is_dark = scene_light <= _DARK
    return torch.where(is_dark, 1.0, light_kept / scene_light.where(~is_dark, 1.0)).reshape(
        cube.shape[:-2]
    )


@bsr.check
def _(result: Tensor, *inputs: Any) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [
        Check(
            f"background suppression ratio {low:.3f} to {high:.3f}",
            bool((result <= 1 + _ROUNDED_LIGHT).all()),
        )
    ]


@node(rtol=1e-6)
def peak_bsr(image: Tensor, plain_image: Tensor) -> Tensor:
    """Compute the ratio of the brightest pixel of the scene with the mask to the brightest pixel
    without the mask.

    The paper scales the peak irradiance of a scene by its background suppression ratio, so that a
    mask that blurs has a low ratio although no light is lost. `metrics.bsr` is the ratio of
    energies.

    Shapes: image and plain_image (..., band, y, x) -> (..., band) float64.
    Units:  none; about 1 for a mask that neither absorbs nor blurs.
    Error:  that of the brightest pixels, 2e-7; a band without light (1e-30) has ratio 1.
    Raises: ValueError for images of different shapes.
    Source: NeuSee, Eq. (peak_irrad_coded).
    """
    if image.shape != plain_image.shape:
        shapes = f"{tuple(image.shape)} with and {tuple(plain_image.shape)} without mask"
        raise ValueError(f"image {shapes} differ in shape: use one scene for both")
    masked_peak, plain_peak = (single(x).amax((-2, -1)).double() for x in (image, plain_image))
    is_dark = plain_peak <= _DARK  # false for NaN, so that NaN reaches the result
    ratio: Tensor = torch.where(is_dark, 1.0, masked_peak / plain_peak.where(~is_dark, 1.0))
    return ratio


@node(rtol=1e-6)
def light_outside(psf: Psf, pupil: Pupil) -> Tensor:
    """Compute the share of the light of a point that falls outside the window of its PSF, by band.

    The light is what the pupil passes, so that light that dirt absorbs does not count. No later
    step knows of the light outside the window: it is lost to the picture of the scene, and to the
    glare of a laser.

    Shapes: psf.intensity (band, y, x), pupil (v, u) -> (band,) float64.
    Units:  none; 0 where the window holds all light.
    Error:  1e-6 of the light. The light of a PSF sampled at points is that of the window only if no
            pixel is wider than lambda f / D. A pupil without light has no light outside: 0. The
            height and the path of the pupil have no effect, not even where they are NaN.
    Source: conservation of energy: Goodman, Introduction to Fourier Optics, 3rd ed., section 2.1.5
            (Parseval).
    """
    pupil_light, clear_light = (
        x.double().square().sum() for x in (pupil.amplitude, pupil.aperture)
    )
    passed_share = pupil_light / clear_light * passed_by_notches(pupil).to(pupil_light.device)
    # band by band, so that only one band is copied to float64
    light_in_window = torch.stack([band.sum(dtype=torch.float64) for band in single(psf.intensity)])
    is_dark = passed_share <= _DARK  # false for NaN, so that NaN reaches the result
    share_outside: Tensor = torch.where(
        is_dark, 0.0, 1.0 - light_in_window / passed_share.where(~is_dark, 1.0)
    )
    return share_outside


@light_outside.check
def _(result: Tensor, *inputs: Any) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [
        Check(
            f"{low:.2%} to {high:.2%} of the light falls outside the window", low >= -_ROUNDED_LIGHT
        )
    ]


# --- bounds relative to a grey filter or a smaller stop -------------------------------------------

#: integral of the squared MTF of a round pupil over all frequencies, divided by the peak of its PSF
CLEAR = 0.45962
_BOUND_ROUNDING = 1e-3  #: relative tolerance for the sampled pass band of the lens and for float32


class ProtectionBounds(NamedTuple):
    """Figures of merit of a mask in each band, each followed by its upper bound for any mask."""

    power: Tensor  #: (band,) mean of |OTF|**2 over the sampled frequencies
    power_bound: Tensor  #: (band,) LSR times the peak of the clear lens
    contrast: Tensor  #: (band,) mean of |OTF|**2 over the lens band, relative to the clear lens
    contrast_bound: Tensor  #: (band,) LSR / 0.4596
    #: (band,) mean NEQ over the lens band, relative to a grey filter of the same peak
    over_filter: Tensor
    over_filter_bound: Tensor  #: (band,) upper bound of `over_filter`
    #: (band,) mean NEQ relative to the better of a filter and a stop of the same peak
    over_both: Tensor
    over_both_bound: Tensor  #: (band,) upper bound of `over_both`
    log_neq: Tensor  #: (band,) mean over the lens band of the logarithm of the NEQ
    log_neq_bound: Tensor  #: (band,) logarithm of the largest mean NEQ

    def broken(self) -> list[str]:
        """Return the names of the values that exceed their bounds by more than sampling and
        rounding explain.
        """
        # the fields alternate: a value, and its bound
        pairs = [
            (name, getattr(self, name), getattr(self, f"{name}_bound"))
            for name in self._fields[::2]
        ]
        return [
            name
            for name, value, bound in pairs
            if bool((value - bound > _BOUND_ROUNDING * (1 + bound.abs())).any())
        ]


@node(rtol=1e-6)
def protection_bounds(
    psf: Psf,
    *,
    electrons: Light,
    read_noise: Electrons,
    glare: Annotated[Electrons, Field(ge=0)] = 0.0,
) -> ProtectionBounds:
    """Compare a mask with the largest gain that any mask of its peak can have over a filter and a
    stop.

    The mean of |OTF|**2 over all frequencies is the sum of PSF**2, at most the peak L p0. A round
    pupil has c p0, with c = 0.4596. A mask therefore has at most L / c of the clear lens's mean
    MTF**2 over the whole lens band. Its mean NEQ over that band is at most (L n + s**2) / (c L (n +
    g + s**2)) times that of a grey filter of the same peak, with n electrons of the scene, g of
    glare and the read noise s. A stop of the diameter L**(1/4) has another such bound. Where pixels
    average, c and the peaks of lens and stop are those behind the pixels. The mean of a logarithm
    is at most the logarithm of the mean.

    Shapes: psf.intensity (band, y, x) -> ten of (band,) float64.
    Units:  electrons, read_noise and glare e- a pixel.
    Error:  1e-3: the lens band in whole frequencies. Assumed: one wavelength a band, PSF as shares
            of the light of the clear pupil (not renormalised within its window), a lens band that
            the pixels resolve, and means over the whole lens band. A part of the band has no such
            bound.
    Source: Parseval's theorem and Jensen's inequality; c by numerical integration of the MTF of a
            round pupil.
    """
    clear_peak = psf.clear_peak.double().cpu()
    peak = psf.intensity.amax((-2, -1)).double().cpu()
    cut_offs, sides = cut_off(psf).cpu(), averaged_side(psf).cpu()
    contrast_by_band = [
        _contrast_means(kernel.double(), float(cut))
        for kernel, cut in zip(psf.intensity.cpu(), cut_offs, strict=True)
    ]
    power, mean_square, log_contrast = (
        torch.stack(column) for column in zip(*contrast_by_band, strict=True)
    )
    lsr, noise = peak / clear_peak, electrons + glare + read_noise**2
    clear_lens = round_lens(cut_offs, sides)
    # for point sampling, the mean over the lens band is exactly CLEAR / 4
    clear_contrast = torch.where(sides > 0, clear_lens.power, CLEAR / 4)
    stop_width_share = stop_width(lsr, cut_offs, sides)
    stop_contrast = torch.where(
        sides > 0,
        stop_width_share**6 * round_lens(stop_width_share * cut_offs, sides).power,
        lsr**1.5 * CLEAR / 4,
    )
    # a filter of the same peak multiplies the OTF by its transmittance, which is the LSR
    filter_neq = _clear_pupil_neq(lsr**2 * clear_contrast, lsr, electrons, read_noise)
    stop_neq = _clear_pupil_neq(stop_contrast, stop_width_share.square(), electrons, read_noise)
    largest_contrast = lsr * clear_lens.peak / 4  # mean of |OTF|**2 over the lens band, by Parseval
    mask_neq, mask_bound = (
        electrons**2 * mean_square / noise,
        electrons**2 * largest_contrast / noise,
    )
    better_neq = torch.maximum(filter_neq, stop_neq)
    contrast = mean_square / clear_contrast
    scale = math.log(electrons**2 / noise)
    return ProtectionBounds(
        power=power,
        power_bound=peak,
        contrast=contrast,
        contrast_bound=largest_contrast / clear_contrast,
        over_filter=mask_neq / filter_neq,
        over_filter_bound=mask_bound / filter_neq,
        over_both=mask_neq / better_neq,
        over_both_bound=mask_bound / better_neq,
        log_neq=log_contrast + scale,
        log_neq_bound=mask_bound.log(),
    )


def _clear_pupil_neq(power: Tensor, passed: Tensor, electrons: float, read_noise: float) -> Tensor:
    """Return the mean NEQ over the lens band of a clear pupil with the mean |OTF|**2 ``power``."""
    return electrons**2 * power / (electrons * passed + read_noise**2)


def stop_diameter(psf: Psf, lsr: float) -> Tensor:
    """Return the diameter of the round stop whose brightest pixel is ``lsr`` times that of the open
    lens.

    For point sampling it is lsr**(1/4). The average over pixels lowers the peak of the lens more
    than the peak of the wider spot of a stop, so that a stop of the diameter lsr**(1/4) would lower
    the brightest pixel too little.

    Shapes: of psf the cut-off and the average over pixels (band,) -> (band,) float64.
    Units:  lsr 1; result 1, the diameter of the lens.
    Error:  1e-4, for a round aperture without aberrations.
    Raises: nothing.
    Source: the peak of a round pupil goes with its area squared, times what `nodes.optics` says
            pixels leave of it.
    """
    cuts, sides = cut_off(psf).cpu(), averaged_side(psf).cpu()
    return stop_width(torch.full_like(cuts, lsr), cuts, sides)


def _contrast_means(kernel: Tensor, cut: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean of |OTF|**2 over all frequencies and over the lens band, and the mean of
    its logarithm there.
    """
    squared_otf = torch.fft.fft2(kernel).abs().square()
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in kernel.shape)
    in_band = torch.hypot(fy[:, None], fx) <= cut
    return (
        squared_otf.mean(),
        squared_otf[in_band].mean(),
        squared_otf[in_band].clamp_min(1e-30).log().mean(),
    )


def largest_glare(lsr: float, electrons: float, read_noise: float) -> float:
    """Return the glare in e- per pixel above which no mask with this LSR can have a higher mean NEQ
    than a filter of the same peak.
    """
    noise = read_noise**2
    return (lsr * electrons + noise) / (CLEAR * lsr) - electrons - noise


@protection_bounds.check
def _(result: ProtectionBounds, *inputs: Any, **params: Any) -> list[Check]:
    broken = result.broken()
    gain, bound = float(result.over_both.mean()), float(result.over_both_bound.mean())
    return [
        Check(
            f"mean NEQ {gain:.3g} times that of the better of filter and stop, at most {bound:.3g}",
            not broken,
        )
    ]
