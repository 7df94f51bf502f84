"""The dazzled area: closed forms and the exact area for a clear round pupil, and the light that veils a feature."""

from __future__ import annotations

import functools
import math
from typing import Literal

import torch
from torch import Tensor

Sampling = Literal["integrated", "point"]
Rule = Literal["snr", "contrast"]

_FIRST_ZERO = 3.8317059702075125  #: of J1
_WIDEST = 1024  #: pixels from the axis up to which pixels are counted one by one
_HALVINGS = 60  #: of an interval of the strength


def pixel_share(spread: float) -> float:
    """Return the mean irradiance over the square pixel at the centre of an Airy spot, over its peak irradiance.

    ``spread`` is lambda N / p: wavelength times f-number over pixel pitch.
    """
    return float(_airy_over_pixels(spread, 1)[0, 0])


def peak_light(spread: float) -> float:
    """Return the share of the light of a clear round pupil in a pixel as bright everywhere as the Airy peak."""
    return math.pi / (4 * spread**2)


def dazzled_pixels(strength: float, spread: float, sampling: Sampling = "integrated") -> float:
    """Return the number of pixels that a laser behind a clear round pupil fills, by the mean of the Airy pattern.

    Far from the axis the mean of the pattern falls as 4 / (pi v^3), so that N ~ pi (spread / pi)^2 (4 S / (pi a))^(2/3)
    for a laser of ``strength`` S, the irradiance of the brightest pixel over saturation. ``spread`` is lambda N / p.
    ``a`` is 1 for pixels that sample a point and `pixel_share` for pixels that average over their area. Within
    7 % of `counted_pixels` for S from 1e4 and a spread from 0.35 to 5.2, and within 1 % from 1e5 and up to 1.3; a wider
    spread shows single rings. Without a laser, or for S up to 1, the result is 0.
    """
    if strength <= 1:
        return 0.0
    share = pixel_share(spread) if sampling == "integrated" else 1.0
    return spread**2 / math.pi * math.pow(4 * strength / (math.pi * share), 2 / 3)


def dazzle_strength(pixels: float, spread: float, sampling: Sampling = "integrated") -> float:
    """Return the strength at which `dazzled_pixels` gives a number of pixels: its inverse."""
    share = pixel_share(spread) if sampling == "integrated" else 1.0
    return max(1.0, math.pi * share / 4 * math.pow(math.pi * pixels / spread**2, 1.5))


def counted_pixels(strength: float, spread: float, sampling: Sampling = "integrated") -> int:
    """Return the number of pixels at or above saturation around an Airy spot centred on a pixel, counted one by one.

    Raises ValueError where the dazzled area reaches beyond 1024 pixels from the axis: `dazzled_pixels` holds there.
    """
    share = pixel_share(spread) if sampling == "integrated" else 1.0
    radius = spread / math.pi * max(_FIRST_ZERO, (8 * strength / (math.pi * share)) ** (1 / 3)) + 3
    if radius > _WIDEST:
        raise ValueError(f"the dazzled area reaches {radius:.0f} pixels from the axis: use dazzled_pixels")
    rows = _airy_over_pixels(spread, math.ceil(radius), sampling)
    above = rows >= share / strength
    return int(above[0, 0]) + 4 * int(above[0, 1:].sum()) + 4 * int(above[1:, 1:].sum())


def dazzle_exposure_limit(
    saturation: float, gain: float, pixels: float, spread: float, sampling: Sampling = "integrated"
) -> float:
    """Return the irradiance in W/m2 at the lens at which a laser dazzles a number of pixels behind a clear pupil.

    ``saturation`` is the irradiance that fills a pixel of the channel that saturates first, ``gain`` is that of
    `sensor_gain`, and ``pixels`` is the share of the field that may be lost times the number of pixels. It is a maximum
    dazzle exposure of the sensor, MDE_S, by our derivation from the Airy pattern; Ritt (Sensors 19, 3765, 2019) defines
    the quantity with a scatter function of lenses too, which `flare.stray_light` describes.
    """
    share = pixel_share(spread) if sampling == "integrated" else 1.0
    return dazzle_strength(pixels, spread, sampling) * saturation / (share * gain)


def veil_limit(
    background: Tensor, *, contrast: float, feature: float, threshold: float, rule: Rule, read_noise: float = 0.0
) -> Tensor:
    """Return the electrons of veiling light in a pixel above which a feature is lost.

    A feature of the Weber contrast C covers A = ``feature`` x ``feature`` pixels on a ``background`` of n electrons.
    With the rule `contrast`, light v leaves the contrast C n / (n + v), which must not fall below ``threshold``. With
    `snr`, the feature has the signal-to-noise ratio C n sqrt(A) / sqrt(n + v + sigma^2). A result below 0 is a feature
    that is lost without a laser.
    """
    if rule == "contrast":
        return background * (contrast / threshold - 1)
    return (contrast * background * feature / threshold).square() - background - read_noise**2


@functools.lru_cache(maxsize=8)
def _airy_over_pixels(spread: float, count: int, sampling: Sampling = "integrated") -> Tensor:
    """Return the Airy irradiance of the pixels (y, x) of one quadrant from the axis, over the peak of the pattern."""
    import numpy as np

    points, weights = np.zeros(1), np.full(1, 2.0)
    if sampling == "integrated":
        points, weights = np.polynomial.legendre.leggauss(3 + math.ceil(4 / spread))
    at = torch.arange(count, dtype=torch.float64)
    total = torch.zeros(count, count, dtype=torch.float64)
    for y, one in zip(points.tolist(), weights.tolist(), strict=True):
        for x, other in zip(points.tolist(), weights.tolist(), strict=True):
            reach = torch.hypot((at + y / 2)[:, None], at + x / 2) * (math.pi / spread)
            total += one * other / 4 * _airy(reach)
    return total


def _airy(reach: Tensor) -> Tensor:
    """Return (2 J1(v) / v)^2."""
    safe = reach.where(reach > 1e-6, 1.0)
    return torch.where(reach > 1e-6, (2 * torch.special.bessel_j1(safe) / safe).square(), 1.0)
