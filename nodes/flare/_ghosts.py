"""Ghosts: reflections between the surfaces of the lens, in paraxial approximation, without a lens
prescription.
"""

import math
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, TensorStats, node
from neusee.nodes.precision import single
from neusee.nodes.units import FocalLength, Fraction, PixelPitch, SensorLength
from neusee.nodes.values import Bands

_SMALLEST_RADIUS = 0.1  #: ratio of smallest to largest radius of a ghost


class _Ghost(NamedTuple):
    magnification: float  #: distance of the ghost from the axis, relative to the source
    radius: float  #: m
    share: float  #: share of the energy of all ghosts, before the colour of the coatings
    tuned: tuple[float, float]  #: m, design wavelengths of the two reflecting coatings


@node()
def ghosts(
    spot: Tensor,
    bands: Bands,
    direction: Tensor,
    *,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    count: Annotated[int, Field(ge=0, le=1000)] = 8,
    energy: Fraction = 1e-4,
    spread: Annotated[float, Field(gt=0, le=10)] = 2.0,
    radius: SensorLength = 300e-6,
    rng: torch.Generator,
) -> Tensor:
    """Return the reflections of a laser spot in the lens: discs on the line through the spot and
    the optical axis.

    Ghost j is a defocused image of the round stop: a disc of radius r_j (U(0.1, 1) * ``radius``),
    centred at s_j times the position of the source, with s_j from U(-``spread``, ``spread``), and
    coloured by two quarter-wave coatings. All ghosts together carry ``energy`` times the energy of
    the spot inside the window, over all bands; light that falls outside the window is lost. The
    spot itself is not dimmed.

    Shapes: (band, y, x), bands, direction (2,) (n_y, n_x) -> (band, y, x).
    Units:  as the spot (W/m2); direction rad.
    Error:  energy of a ghost inside the window 1e-6; the edge of a ghost is one pixel wide, and no
            ghost is smaller than one pixel.
    Raises: ValueError where spot and bands differ in the number of bands.
    Source: Hullin et al., ACM Trans. Graph. 30, 108 (2011), reduced to first order; coatings:
        Hecht, Optics, single quarter-wave layer.
    """
    if spot.ndim != 3 or spot.shape[0] != bands.centres.numel():
        raise ValueError(
            f"spot is {tuple(spot.shape)}, bands {bands.centres.numel()}: "
            "the numbers of bands differ, so compute both from one `line` step"
        )
    drawn_ghosts = _random_ghosts(count, spread, radius, rng)
    spot = single(spot)
    # a float64 copy of the spot would be twice as large
    flux = spot.sum(-1).sum(-1, dtype=torch.float64)
    # position of the laser in pixels from the axis
    y, x = (focal_length * n / pixel_pitch for n in direction.tolist())
    light_of_ghosts = torch.zeros_like(spot)
    for ghost, colour in zip(
        drawn_ghosts, _gains_of_bands(drawn_ghosts, bands.centres, flux), strict=True
    ):
        centre = (ghost.magnification * y, ghost.magnification * x)
        _add_disc(
            light_of_ghosts,
            (energy * colour * flux).to(spot.dtype),
            centre,
            _in_pixels(ghost.radius, pixel_pitch),
        )
    return light_of_ghosts


def _random_ghosts(count: int, spread: float, radius: float, rng: torch.Generator) -> list[_Ghost]:
    """Draw ``count`` random ghosts; their shares of the energy add up to 1.

    Each ghost uses five random numbers: position, radius, energy and the wavelengths of two
    coatings.
    """
    random_numbers = torch.rand(
        count, 5, generator=rng, device=rng.device, dtype=torch.float64
    ).tolist()
    weights = [math.exp(2 * energy) for _, _, energy, *_ in random_numbers]
    drawn = []
    # design wavelengths of the coatings between 400 and 700 nm
    for (position, r, _, *coating_draws), weight in zip(random_numbers, weights, strict=True):
        first, second = (400e-9 + 300e-9 * coating_draw for coating_draw in coating_draws)
        magnification, drawn_radius = (
            spread * (2 * position - 1),
            radius * (_SMALLEST_RADIUS + (1 - _SMALLEST_RADIUS) * r),
        )
        drawn.append(_Ghost(magnification, drawn_radius, weight / sum(weights), (first, second)))
    return drawn


def _reflectance(wavelengths: Tensor, tuned: float) -> Tensor:
    """Return the relative reflectance of a quarter-wave layer: 0.05 at its design wavelength
    ``tuned``, at most 1 elsewhere.
    """
    return 0.05 + 0.95 * torch.cos(torch.pi / 2 * tuned / wavelengths).square()


def _gains_of_bands(drawn: list[_Ghost], wavelengths: Tensor, flux: Tensor) -> list[Tensor]:
    """Return the gain (band,) of each ghost, scaled so that all ghosts together carry the flux of
    the spot.
    """
    gains = []
    for ghost in drawn:
        first, second = (_reflectance(wavelengths, tuned) for tuned in ghost.tuned)
        gains.append(ghost.share * first * second)
    reflected_light = torch.stack(gains).sum(0).mul(flux).sum() if gains else flux.sum()
    no_light = reflected_light <= 0  # false for NaN, so that NaN reaches the result
    scale = torch.where(no_light, 0.0, flux.sum() / reflected_light.where(~no_light, 1.0))
    return [gain * scale for gain in gains]


def _in_pixels(radius: float, pixel_pitch: float) -> float:
    """Return the radius of a ghost in pixels, at least 0.5, so that every ghost covers the
    centre of a pixel.
    """
    return max(radius / pixel_pitch, 0.5)


def _add_disc(total: Tensor, energy: Tensor, centre: tuple[float, float], radius: float) -> None:
    """Add the part of a ghost's disc that lies inside the image to ``total``; the whole disc
    carries ``energy``.
    """
    height, width = total.shape[-2:]
    y, x = centre[0] + height // 2, centre[1] + width // 2
    rows, columns = _touched_pixels(y, radius), _touched_pixels(x, radius)
    # the edge is one pixel wide
    disc = (radius + 0.5 - torch.hypot((rows - y)[:, None], (columns - x)[None, :])).clamp(0, 1)
    # normalise the whole disc, even if the image cuts it off
    visible_disc = (disc / disc.sum())[
        _inside_image(rows, height), _inside_image(columns, width)
    ].to(total)
    if visible_disc.numel():
        top, left = max(int(rows[0]), 0), max(int(columns[0]), 0)
        total[:, top : top + visible_disc.shape[0], left : left + visible_disc.shape[1]] += (
            energy[:, None, None] * visible_disc
        )


def _touched_pixels(middle: float, radius: float) -> Tensor:
    """Return the pixel indices along one axis that a ghost's disc can touch, also outside the
    image, float64.
    """
    first, last = math.floor(middle - radius) - 1, math.ceil(middle + radius) + 1
    return torch.arange(first, last + 1, dtype=torch.float64)


def _inside_image(numbers: Tensor, samples: int) -> slice:
    """Return the slice of the consecutive pixel indices ``numbers`` that lies inside the image; it
    may be empty.
    """
    first = int(numbers[0])
    return slice(min(max(-first, 0), len(numbers)), max(samples - first, 0))


@ghosts.zero_bound
def _(
    spot: TensorStats,
    *_: Any,
    pixel_pitch: float,
    count: int,
    energy: float,
    radius: float,
    **__: Any,
) -> float:
    """Return an upper bound of the brightest pixel of the ghosts: all reflected light in one band
    and in the smallest ghost.

    The samples of a disc of half a pixel or more sum to the area of the disc, pi (r^2 + 1 / 12),
    within 16 %.
    """
    if count == 0 or energy == 0:
        return 0.0
    # area of the smallest ghost; the factor 0.8 covers the 16 %
    area = 0.8 * math.pi * (_in_pixels(_SMALLEST_RADIUS * radius, pixel_pitch) ** 2 + 1 / 12)
    return energy * spot.sum / area


@ghosts.expected_range
def _(
    spot: TensorStats, *_: Any, pixel_pitch: float, energy: float, radius: float, **__: Any
) -> tuple[float, float]:
    """Return the expected range: up to the brightness of a medium-sized ghost, if all light of the
    spot fell on one pixel.
    """
    return 0.0, energy * spot.max / max(1.0, math.pi * _in_pixels(radius / 2, pixel_pitch) ** 2)


@ghosts.check
def _(result: Tensor, spot: Tensor, *_: Any, energy: float, **__: Any) -> list[Check]:
    spot_energy, ghost_energy = (float(x.sum(-1).sum(dtype=torch.float64)) for x in (spot, result))
    ghost_share = ghost_energy / spot_energy if spot_energy > 0 else 0.0
    is_bounded = ghost_share <= energy * (1 + 1e-3)
    return [
        Check(
            f"ghosts in the window have {ghost_share:.3g} of the spot's energy; {energy:.3g} is"
            " reflected",
            is_bounded,
        )
    ]
