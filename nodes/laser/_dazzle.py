"""The dazzled area of a sensor: closed forms, a curve over the strength of a laser, and
pictures.
"""

from __future__ import annotations

import functools
import math
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes import Check, node
from neusee.nodes.optics._lens import cut_off
from neusee.nodes.precision import refuse_not_finite, transformed
from neusee.nodes.sensor._digitization import crop
from neusee.nodes.sensor._saturation import Well, refuse_without_room
from neusee.nodes.units import Count, Efficiency, Electrons, Ratio, Shape
from neusee.nodes.values import Bands, Psf

# --- dazzle area ----------------------------------------------------------------------------------

# The dazzled area behind a clear round pupil, by a closed form and by counting, and the veiling
# light that hides a feature.


Sampling = Literal["integrated", "point"]
Rule = Literal["snr", "contrast"]

_FIRST_ZERO = 3.8317059702075125  #: first zero of J1
_FARTHEST_COUNTED = 1024  #: largest radius, in pixels, at which pixels are counted one by one
_HALVINGS = 60  #: halvings of an interval of the strength


def pixel_share(spread: float) -> float:
    """Return the ratio of the irradiance averaged over the central square pixel of an Airy spot to
    its peak irradiance.

    ``spread`` is lambda N / p: wavelength times f-number over pixel pitch.
    """
    return float(_airy_over_pixels(spread, 1)[0, 0])


def peak_light(spread: float) -> float:
    """Return the share of the light of a clear round pupil that a pixel with the peak irradiance of
    the Airy pattern receives.
    """
    return math.pi / (4 * spread**2)


def dazzled_pixels(strength: float, spread: float, sampling: Sampling = "integrated") -> float:
    """Return the number of pixels that a laser saturates behind a clear round pupil, from the mean
    of the Airy pattern over its fringes.

    Far from the axis the mean of the pattern falls as 4 / (pi v^3), so that the number is about pi
    (spread / pi)^2 (4 S / (pi a))^(2/3) for a laser of ``strength`` S, the irradiance of the
    brightest pixel over saturation. ``spread`` is wavelength x f-number / pixel pitch. ``a`` is 1
    for pixels that sample a point and `pixel_share` for pixels that average over their area. The
    result is within 7 % of `counted_pixels` for S from 1e4 and a spread from 0.35 to 5.2, and
    within 1 % for S from 1e5 and a spread up to 1.3; with a wider spread single rings matter.
    Without a laser, or for S up to 1, it is 0.
    """
    if strength <= 1:
        return 0.0
    mean_over_peak = pixel_share(spread) if sampling == "integrated" else 1.0
    return spread**2 / math.pi * math.pow(4 * strength / (math.pi * mean_over_peak), 2 / 3)


def dazzle_strength(pixels: float, spread: float, sampling: Sampling = "integrated") -> float:
    """Return the strength at which `dazzled_pixels` gives a number of pixels, its inverse; at least
    1.
    """
    mean_over_peak = pixel_share(spread) if sampling == "integrated" else 1.0
    return max(1.0, math.pi * mean_over_peak / 4 * math.pow(math.pi * pixels / spread**2, 1.5))


def counted_pixels(strength: float, spread: float, sampling: Sampling = "integrated") -> int:
    """Return the number of pixels at or above saturation around an Airy spot centred on a pixel,
    counted one by one.

    Raises ValueError where the dazzled area reaches beyond 1024 pixels from the axis:
    `dazzled_pixels` holds there.
    """
    mean_over_peak = pixel_share(spread) if sampling == "integrated" else 1.0
    # radius at which the envelope of the rings, 8 / (pi v^3), falls below saturation, plus 3 pixels
    radius = (
        spread / math.pi * max(_FIRST_ZERO, (8 * strength / (math.pi * mean_over_peak)) ** (1 / 3))
        + 3
    )
    if radius > _FARTHEST_COUNTED:
        raise ValueError(
            f"the dazzled area reaches {radius:.0f} pixels from the axis: use dazzled_pixels"
        )
    quadrant = _airy_over_pixels(spread, math.ceil(radius), sampling)
    is_dazzled = quadrant >= mean_over_peak / strength
    # the central pixel once; the pixels of a half axis and of the rest of the quadrant four times
    return (
        int(is_dazzled[0, 0]) + 4 * int(is_dazzled[0, 1:].sum()) + 4 * int(is_dazzled[1:, 1:].sum())
    )


def dazzle_exposure_limit(
    saturation: float, gain: float, pixels: float, spread: float, sampling: Sampling = "integrated"
) -> float:
    """Return the irradiance in W/m2 at the lens at which a laser dazzles a number of pixels behind
    a clear pupil.

    ``saturation`` is the irradiance that fills a pixel of the channel that saturates first,
    ``gain`` is that of `sensor_gain`, and ``pixels`` is the share of the field that may be lost
    times the number of pixels. It is a maximum dazzle exposure of the sensor, MDE_S, by our
    derivation from the Airy pattern; Ritt (Sensors 19, 3765, 2019) defines the quantity with a
    scatter function of lenses too, which `flare.stray_light` describes.
    """
    mean_over_peak = pixel_share(spread) if sampling == "integrated" else 1.0
    return dazzle_strength(pixels, spread, sampling) * saturation / (mean_over_peak * gain)


def veil_limit(
    background: Tensor,
    *,
    contrast: float,
    feature: float,
    threshold: float,
    rule: Rule,
    read_noise: float = 0.0,
) -> Tensor:
    """Return the largest veiling light, in electrons per pixel, at which a feature is still
    visible.

    A feature of the Weber contrast C covers A = ``feature`` x ``feature`` pixels on a
    ``background`` of n electrons. With the rule `contrast`, light v leaves the contrast C n / (n +
    v), which must not fall below ``threshold``. With `snr`, the feature has the signal-to-noise
    ratio C n sqrt(A) / sqrt(n + v + sigma^2). A result below 0 is a feature that is lost without a
    laser.
    """
    if rule == "contrast":
        return background * (contrast / threshold - 1)
    return (contrast * background * feature / threshold).square() - background - read_noise**2


@functools.lru_cache(maxsize=8)
def _airy_over_pixels(spread: float, count: int, sampling: Sampling = "integrated") -> Tensor:
    """Return the Airy irradiance over its peak for count x count pixels (y, x) of one quadrant that
    starts at the axis.

    ``spread`` is lambda N / p. Pixels average over their squares, or sample the points in their
    middles.
    """
    import numpy as np

    # one point, with the weight 2 of the interval from -1 to 1
    points, weights = np.zeros(1), np.full(1, 2.0)
    if sampling == "integrated":
        points, weights = np.polynomial.legendre.leggauss(3 + math.ceil(4 / spread))
    pixel = torch.arange(count, dtype=torch.float64)
    irradiance = torch.zeros(count, count, dtype=torch.float64)
    for y, weight_y in zip(points.tolist(), weights.tolist(), strict=True):
        for x, weight_x in zip(points.tolist(), weights.tolist(), strict=True):
            reach = torch.hypot((pixel + y / 2)[:, None], pixel + x / 2) * (math.pi / spread)
            irradiance += weight_y * weight_x / 4 * _airy(reach)
    return irradiance


def _airy(reach: Tensor) -> Tensor:
    """Return the Airy pattern (2 J1(v) / v)^2 at the reach v."""
    safe = reach.where(reach > 1e-6, 1.0)
    return torch.where(reach > 1e-6, (2 * torch.special.bessel_j1(safe) / safe).square(), 1.0)


# --- dazzle curve ---------------------------------------------------------------------------------

# The dazzled area as a function of the strength of a laser, counted in the point-spread function.


Strengths = Annotated[tuple[Annotated[float, Field(gt=0, le=1e18)], ...], Field(min_length=1)]
DECADES = tuple(10 ** (k / 4) for k in range(4, 25))  #: 10 to 1e6, four per decade


class DazzleCurve(NamedTuple):
    """The number of dazzled pixels as a function of the strength of a laser."""

    #: (strength,) float64, multiple of saturation at the peak behind the clear lens
    strengths: Tensor
    pixels: Tensor  #: (strength,) float64
    share: Tensor  #: (strength,) float64, of the window of the PSF
    #: (strength,) float64, pixels behind the clear lens by the mean of the Airy pattern
    clear: Tensor


@node(rtol=1e-6)
def dazzle_curve(
    psf: Psf,
    bands: Bands,
    *,
    strengths: Strengths = DECADES,
    level: Ratio = 1.0,
) -> DazzleCurve:
    """Count the pixels in which a laser exceeds saturation, for each of several strengths.

    A strength is the irradiance of the brightest pixel behind the clear lens in multiples of
    saturation. ``level`` is the share of saturation at which a pixel counts: 1 for saturated
    pixels, less for pixels that are veiled. `clear` is the closed form pi (lambda N / (pi p))^2 (4
    S / pi)^(2/3), with lambda N / p from the cut-off of the lens. Where pixels average, S is that
    at a point.

    Shapes: psf.intensity (band, y, x), bands (band,) -> four of (strength,) float64.
    Units:  none, and pixels.
    Error:  light outside the window of the PSF counts nothing: choose a window that holds the area.
            `clear` is within 7 % of the count for S from 1e4 where lambda N / p is above 2.5 or
            pixels sample a point, and is 0 for S up to 1; smaller spots that pixels average need
            `dazzled_pixels`.
    Raises: ValueError for a PSF that is not finite.
    Source: Born and Wolf, Principles of Optics, 7th ed., section 8.5.2 (the Airy pattern and its
            far rings).
    """
    # weights by number of photons, because wells count photons
    weights = bands.weights.double() * bands.centres.double()
    pixel_light = torch.zeros(
        psf.intensity[0].numel(), dtype=torch.float64, device=psf.intensity.device
    )
    for weight, band in zip(weights.tolist(), psf.intensity.detach(), strict=True):
        pixel_light = pixel_light + weight * band.flatten().double()
    peak = float((weights * psf.clear_peak.detach().cpu()).sum())
    if not transformed():
        refuse_not_finite("its pixels cannot be counted", psf=pixel_light.sum(), clear_peak=peak)
    strength_values = torch.tensor(strengths, dtype=torch.float64)
    ordered = pixel_light.sort().values.cpu()
    # number of pixels at or above the limit, from the sorted values
    pixels = (len(ordered) - torch.searchsorted(ordered, level * peak / strength_values)).double()
    cut_off_frequency = float(cut_off(psf).mean())
    point_to_pixel_peak = math.pi / 4 * cut_off_frequency**2 / float(psf.clear_peak.detach().mean())
    clear = (4 / math.pi * strength_values / level * point_to_pixel_peak).pow(2 / 3) / (
        math.pi * cut_off_frequency**2
    )
    return DazzleCurve(
        strength_values, pixels, pixels / len(ordered), clear.where(strength_values > level, 0.0)
    )


@dazzle_curve.check
def _(result: DazzleCurve, *inputs: Any, **params: Any) -> list[Check]:
    top = int(result.strengths.argmax())
    share, strength = float(result.share[top]), float(result.strengths[top])
    text = f"{share:.2%} of the window is dazzled at strength {strength:.3g}"
    if share < 0.5:
        return [Check(text, True)]
    # also for a share that is NaN
    return [Check(f"{text}: the PSF may reach beyond its window", False)]


# --- dazzle picture -------------------------------------------------------------------------------

# Dazzled pixels of a picture: those that a laser saturates, and those where its light hides a
# feature of stated size and contrast.


class Dazzle(NamedTuple):
    """The pixels that are lost to a laser; pixels that are already lost without it are not
    counted.
    """

    saturated: Tensor  #: () float64, pixels with a channel that the laser saturates
    #: () float64, other pixels at which the laser's light hides the feature in every channel
    veiled: Tensor
    share: Tensor  #: () float64, saturated and veiled pixels, relative to all pixels
    #: () float64, share of all pixels at which the feature is visible without the laser
    visible: Tensor


@node(rtol=1e-6)
def dazzle(
    photons: Tensor,
    lasers: list[Tensor] | None = None,
    ghosts: list[Tensor] | None = None,
    *,
    shape: Shape,
    full_well: Well,
    quantum_efficiency: Efficiency,
    read_noise: Electrons,
    offset: Electrons = 0.0,
    feature: Count = 10,
    contrast: Ratio = 0.2,
    rule: Rule = "snr",
    threshold: Ratio = 5.0,
) -> Dazzle:
    """Count the pixels that lasers saturate, and those where their light hides a feature of a
    stated size and contrast.

    The feature covers ``feature`` x ``feature`` pixels and differs by the Weber contrast C from the
    scene, whose mean over these pixels is its background n. The mean of the laser's light over them
    is the veil v. Rule `snr`: the feature is visible where C n sqrt(A) / sqrt(n + v + sigma^2) is
    at least ``threshold`` (5 is Rose's criterion); rule `contrast`: where C n / (n + v) is. One
    channel that shows it is enough.

    Shapes: photons of the scene (channel, y, x), each laser and ghost the same -> four scalars,
            float64.
    Units:  photons, electrons and pixels.
    Error:  mean numbers without noise; 1e-6 of a threshold, so that a pixel there may fall on
            either side. Patterns of the sensor under the veil (PRNU) and the search of a viewer are
            left out.
    Raises: ValueError for light that is not finite.
    Source: Rose, J. Opt. Soc. Am. 38, 196 (1948), for the threshold 5; Weber contrast by
            definition.
    """
    scene = crop(photons.detach(), shape=shape).double() * quantum_efficiency
    veil = torch.zeros_like(scene)
    for light in (*(lasers or ()), *(ghosts or ())):
        veil += crop(light.detach(), shape=shape).double() * quantum_efficiency
    if not transformed():
        refuse_not_finite(
            "its dazzled pixels cannot be counted", photons=scene.sum(), laser=veil.sum()
        )
    free_well = full_well - offset
    lost_before, full_with_laser = (scene >= free_well).any(-3), (scene + veil >= free_well).any(-3)
    background, mean_veil = mean_over_feature(scene, feature), mean_over_feature(veil, feature)
    largest_veil = veil_limit(
        background,
        contrast=contrast,
        feature=feature,
        threshold=threshold,
        rule=rule,
        read_noise=read_noise,
    )
    # a limit below 0 means that the feature is not visible even without a laser
    visible = (largest_veil >= 0).any(-3) & ~lost_before
    saturated = full_with_laser & ~lost_before
    # hidden in every channel
    veiled = visible & ~full_with_laser & ~(mean_veil <= largest_veil).any(-3)
    pixels = visible.numel()
    counts = [mask.sum().double() for mask in (saturated, veiled, visible)]
    return Dazzle(counts[0], counts[1], (counts[0] + counts[1]) / pixels, counts[2] / pixels)


def mean_over_feature(image: Tensor, size: int) -> Tensor:
    """Return the mean of an image (channel, y, x) over a square of ``size`` pixels around each
    pixel.
    """
    rows, columns = image.shape[-2:]
    averaged, half_size = image[None], size // 2
    # along y, then along x; an even size gives one row and one column too many
    for window, padding in (((size, 1), (half_size, 0)), ((1, size), (0, half_size))):
        averaged = avg_pool2d(averaged, window, stride=1, padding=padding, count_include_pad=False)
    return averaged[0, ..., :rows, :columns]


@dazzle.preflight
def _(*, full_well: float, offset: float = 0.0, read_noise: float, **params: object) -> list[str]:
    refuse_without_room(full_well, offset=offset, read_noise=read_noise)
    return []


@dazzle.check
def _(result: Dazzle, *inputs: Any, **params: Any) -> list[Check]:
    text = f"the laser saturates {int(result.saturated)} pixels and veils {int(result.veiled)} more"
    return [
        Check(
            f"{text}, {float(result.share):.2%} of the picture together",
            bool(torch.isfinite(result.share)),
        )
    ]
