"""The light of a laser in the pixels of a sensor, and the peak of a sampled spot."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.laser._dazzle import _over_feature, peak_light
from neusee.nodes.laser._round_spot import legendre, round_spot
from neusee.nodes.sensor._digitization import crop
from neusee.nodes.units import Count, PixelPitch, Shape
from neusee.nodes.values import Bands, Psf

# --- bright pixels --------------------------------------------------------------------------------

# The light of a laser in the pixels of a sensor, by their distance from the spot: behind any mask,
# or a round lens.


RINGS = 160  #: rings about the spot, at equal ratios of their radii
PARTS = 48  #: groups of as many pixels in each ring, from the faintest to the brightest
_LEVELS = 3000  #: of light, at equal ratios, into which pixels are sorted
_DECADES = 24.0  #: of light below the brightest pixel; fainter pixels count as 0
_LAW = 1.5  #: factor on the light of the radial law outside, since wings of a PSF are no smooth law
_INNER = 48  #: pixels from the spot to each side that are computed one by one
_SHELLS = 3000  #: radii beyond these pixels
_FRINGE = 0.06  #: step of v = pi x / (lambda N) in which no fringe of a spot changes much
_FINEST = 24  #: points across a pixel, at most, but for the brightest ones


class BrightPixels(NamedTuple):
    """The light of a laser in groups of pixels, each at about one distance from the spot and about
    equally bright.

    The light that a lens scatters depends on this distance alone, so that it can be added before
    pixels are ranked.
    """

    #: (group,) float64, pixels, from the spot to the pixels of a group, root mean square
    radius: Tensor
    pixels: Tensor  #: (group,) float64, number of pixels
    light: Tensor  #: (group,) float64, share of the light in a pixel
    smooth: Tensor  #: (group,) float64, the same of the mean over a feature around each pixel
    #: (3,) float64: distance and mean light of the rim where the sensor goes on, else 0 and 0; and
    #: the light that the window and the radial law of `with_frame` account for
    rim: Tensor


@node(rtol=1e-6)
def bright_pixels(
    psf: Psf,
    bands: Bands,
    *,
    shape: Shape,
    pixel_pitch: PixelPitch,
    sample_pitch: PixelPitch | None = None,
    feature: Count = 1,
) -> BrightPixels:
    """Group the pixels of a sensor by their distance from the spot of a laser and by its light in
    them.

    ``sample_pitch`` is that of the PSF, a whole fraction of the pixel, over which its samples are
    averaged; without a value the PSF has one sample a pixel. ``shape`` is that of the sensor:
    pixels beyond it do not count, and `rim` says how bright the last ones are that the PSF holds
    where the sensor goes on. `smooth` has the mean over ``feature`` x ``feature`` pixels, which
    veils a feature of that size. The spot is in the middle of the window.

    Shapes: psf.intensity (band, y, x), bands (band,) -> four of (group,) float64, and (3,).
    Units:  pixels, and share of the light through the clear pupil, in photons.
    Error:  0.5 % of the light of a pixel, and 2 % of its distance. Far from the axis, at n
            wavelengths times f-number, a pupil of M samples across repeats light of its stepped
            edges: 1 to 2 % too bright at n = M / 8, 5 % at n = M / 6 and 9 to 14 % at n = M / 4. An
            average of samples up to lambda N / 2 apart is that of the pixel to 1 %.
    Raises: ParameterError before the run for a sample pitch that is no whole fraction of the pixel;
            ValueError for a PSF that is narrower than a pixel.
    Source: by definition.
    """
    # photons of each wavelength, which fill wells
    weights = (bands.weights * bands.centres).double()
    weights = weights / weights.sum()
    samples = _samples(pixel_pitch, sample_pitch)
    bands_of_pixels = (_pixels(band.detach().double(), samples) for band in psf.intensity)
    image = torch.as_tensor(
        sum(w * band for w, band in zip(weights.tolist(), bands_of_pixels, strict=True))
    )
    narrow = [m < n for m, n in zip(image.shape, shape, strict=True)]
    rim = _rim(image.cpu(), narrow)
    image = crop(image, shape=(min(shape[0], image.shape[0]), min(shape[1], image.shape[1])))
    smooth = image if feature == 1 else _over_feature(image[None], feature)[0]
    groups = _grouped(image.cpu(), smooth.cpu())
    return BrightPixels(*groups, rim)


def _samples(pixel_pitch: float, sample_pitch: float | None) -> int:
    """Return the number of samples along the side of a pixel."""
    ratio = pixel_pitch / (sample_pitch or pixel_pitch)
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
        raise ParameterError(
            "sample_pitch",
            f"{ratio:.5g} samples fit into a pixel of {pixel_pitch * 1e6:.5g} um: give a whole"
            f" fraction of the pixel, such as {pixel_pitch / max(1, round(ratio)) * 1e6:.5g} um",
        )
    return round(ratio)


def _pixels(light: Tensor, samples: int) -> Tensor:
    """Return the light (y, x) of each pixel from that of its samples; a part of a pixel at the
    end is left out.
    """
    if min(light.shape) < samples:
        size = f"{light.shape[0]} x {light.shape[1]}"
        raise ValueError(
            f"a PSF of {size} samples holds no pixel, which is {samples} samples wide: enlarge its"
            " window"
        )
    return light if samples == 1 else avg_pool2d(light[None], samples)[0] * samples**2


def _grouped(image: Tensor, smooth: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return radius, pixels, light and smoothed light of groups of pixels, `PARTS` in each ring."""
    rows, columns = image.shape
    rings = _rings(rows, columns)
    light = [
        _quantiles(picture.double().numpy().ravel(), rings).ravel() for picture in (image, smooth)
    ]
    radius, pixels = np.repeat(rings.radius, PARTS), np.repeat(rings.pixels / PARTS, PARTS)
    groups = [torch.from_numpy(column) for column in (radius, pixels, *light)]
    return groups[0], groups[1], groups[2], groups[3]


class _Rings(NamedTuple):
    """The rings about the middle of a window."""

    number: NDArray[np.int64]  #: (pixel,) number of its ring, times the number of levels and one
    radius: NDArray[np.float64]  #: (ring,) pixels, root mean square
    pixels: NDArray[np.float64]  #: (ring,)


@functools.lru_cache(maxsize=1)
def _rings(rows: int, columns: int) -> _Rings:
    """Return the rings of a window; those of the last one are kept, since many spots in turn
    have the same window.
    """
    y, x = ((np.arange(n) - n // 2).astype(np.float64) ** 2 for n in (rows, columns))
    square = (y[:, None] + x).ravel()
    last = math.log(max(square.max(), 1.0)) + 1e-9
    # ring 0 is the pixel of the spot; ring k > 0 ends at equal ratios of the radius
    ring = np.zeros(square.size, np.int64)
    around = square > 0
    ring[around] = 1 + (np.log(square[around]) * ((RINGS - 1) / last)).astype(np.int64)
    pixels = np.bincount(ring, minlength=RINGS).astype(np.float64)
    radius = np.sqrt(np.bincount(ring, square, minlength=RINGS) / np.maximum(pixels, 1))
    return _Rings(ring * (_LEVELS + 1), radius, pixels)


def _quantiles(light: np.ndarray, rings: _Rings) -> np.ndarray:
    """Return the light (ring, part) of the pixels in the middle of each of `PARTS` groups of a
    ring.
    """
    top = float(light.max(initial=0.0))
    if not top > 0:
        return np.zeros((RINGS, PARTS))
    step = _DECADES * math.log(10) / _LEVELS
    faintest = top * math.exp(-(_LEVELS + 1) * step)
    depth = np.log(np.maximum(light, faintest) / top) * (-1 / step)
    level = np.minimum(depth, _LEVELS).astype(np.int64)
    table = np.bincount(rings.number + level, minlength=RINGS * (_LEVELS + 1)).reshape(RINGS, -1)
    rising = table.cumsum(1)
    ranks = (np.arange(PARTS) + 0.5) / PARTS * rings.pixels[:, None]
    levels = np.stack([np.searchsorted(row, want) for row, want in zip(rising, ranks, strict=True)])
    return np.where(levels < _LEVELS, top * np.exp(-(levels + 0.5) * step), 0.0)


def _rim(image: Tensor, narrow: list[bool]) -> Tensor:
    """Return distance and light of the rim of a window on the sides where the sensor goes on, and
    the light known.

    The light of the rim is the mean of all its pixels, each brought to this distance by the third
    power of its own. The light known is that of the window and, `_LAW` times, that of the radial
    law on the plane outside.
    """
    total = image.double().sum()
    if not any(narrow):
        return torch.stack([0 * total, 0 * total, total])
    distance = float(
        max(1, min((n - 1) // 2 for n, cut in zip(image.shape, narrow, strict=True) if cut))
    )
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in image.shape)
    across = [image[end].double() * torch.hypot(y[end], x).pow(3) for end in (0, -1)]
    along = [image[:, end].double() * torch.hypot(y, x[end]).pow(3) for end in (0, -1)]
    sides = across * narrow[0] + along * narrow[1]
    cube = torch.cat(sides).mean()
    half = [n / 2 for n in image.shape]
    # the integral of cube / r^3 outside of a rectangle
    outside = 4 * cube * math.hypot(*half) / (half[0] * half[1])
    place = torch.tensor(distance, dtype=torch.float64)
    return torch.stack([place, cube / distance**3, total + _LAW * outside])


def light_with_wings(image: Tensor) -> Tensor:
    """Return the light of a window (y, x) and of the plane outside, there `_LAW` times that of
    the radial law.
    """
    return _rim(image, [True, True])[2]


@bright_pixels.preflight
def _(*, pixel_pitch: float, sample_pitch: float | None = None, **_: Any) -> list[str]:
    _samples(pixel_pitch, sample_pitch)
    return []


@bright_pixels.check
def _(result: BrightPixels, *inputs: Any, **params: Any) -> list[Check]:
    top, pixels = float(result.light.max()), float(result.pixels.sum())
    return [Check(f"{top:.3g} of the light in the brightest of {pixels:.0f} pixels", top > 0)]


def with_frame(groups: BrightPixels, shape: tuple[int, int]) -> BrightPixels:
    """Add the pixels of a sensor of a ``shape`` that the window of the PSF did not hold, by a
    radial law.

    Far from the spot the light of any aperture with edges falls as the third power of the distance,
    on average. The added pixels have the light of the rim times this power.
    """
    lacking = shape[0] * shape[1] - float(groups.pixels.sum())
    if not (lacking >= 1 and float(groups.rim[0]) > 0):
        return groups
    distance, light, _ = groups.rim.tolist()
    radius, pixels = _shells(
        shape, shape[0] * shape[1] - lacking, torch.full((1, 2), distance, dtype=torch.float64)
    )
    faint = light * (distance / radius).pow(3)
    return BrightPixels(
        radius=torch.cat([groups.radius, radius]),
        pixels=torch.cat([groups.pixels, pixels]),
        light=torch.cat([groups.light, faint]),
        smooth=torch.cat([groups.smooth, faint]),
        rim=groups.rim,
    )


def hidden_light(groups: BrightPixels) -> float:
    """Return the share of the light that neither the window of the PSF nor the radial law of
    `with_frame` has.

    A mask may send it to a ring or to orders of diffraction beyond the window: it may fall on any
    pixel there.
    """
    return max(0.0, 1 - float(groups.rim[2])) if float(groups.rim[0]) > 0 else 0.0


# --- a clear round lens ---------------------------------------------------------------------------


def round_pixels(
    fill: float, waves: float, spread: float, shape: tuple[int, int], feature: float = 1.0
) -> BrightPixels:
    """Group the pixels of a sensor behind a clear round lens by their distance from the spot of a
    Gaussian beam.

    ``fill`` is (D / (2 w))^2, ``waves`` the defocus at the rim of the lens, and ``spread`` is
    lambda N / p. The spot is in the middle of the pixel in the middle of the sensor; every pixel
    averages over its area. The whole sensor counts.

    Shapes: -> four of (group,) float64, and (3,).
    Units:  pixels, and share of the light that passes the lens.
    Error:  0.3 % of the light of a pixel beside the mean over the azimuths of its square.
    Raises: nothing.
    Source: Born and Wolf, Principles of Optics, 7th ed., section 8.8, integrated over the pixel.
    """
    through = 1.0 if fill < 1e-9 else -math.expm1(-2 * fill) / (2 * fill)
    scale = peak_light(spread) / through
    places, number = _inner(shape, spread)
    inner = scale * _over_squares(places, fill, waves, spread)
    edges, shells = _shells(shape, float(number.sum()), places)
    outer = scale * _over_rings(edges, fill, waves, spread)
    radius = torch.cat([places.square().sum(1).sqrt(), edges])
    pixels, light = torch.cat([number, shells]), torch.cat([inner, outer])
    smooth = light if feature <= 1 else _smoothed(radius, pixels, light, feature)
    rim = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return BrightPixels(radius, pixels, light, smooth, rim)


def _inner(shape: tuple[int, int], spread: float) -> tuple[Tensor, Tensor]:
    """Return the places (pixel, (y, x)) of a part of the pixels around the spot, and how many
    look like each.
    """
    half = [min(_INNER, (n - 1) // 2) for n in shape]
    y, x = torch.meshgrid(
        *(torch.arange(h + 1.0, dtype=torch.float64) for h in half), indexing="ij"
    )
    number = torch.where(y > 0, 2.0, 1.0) * torch.where(x > 0, 2.0, 1.0)
    if half[0] == half[1]:  # of a quadrant, one side of its diagonal
        number = torch.where(y < x, 2 * number, number)
        side = y <= x
        y, x, number = y[side], x[side], number[side]
    return torch.stack([y.flatten(), x.flatten()], 1), number.flatten().double()


def _shells(shape: tuple[int, int], counted: float, places: Tensor) -> tuple[Tensor, Tensor]:
    """Return radii beyond the inner pixels, and the number of pixels of the sensor about each of
    them.
    """
    outer = shape[0] * shape[1] - counted
    if outer <= 0:
        return torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    half = torch.tensor(shape, dtype=torch.float64) / 2
    taken = places.amax(0) + 0.5
    start = float(torch.minimum(taken, half).min())
    edges = torch.logspace(
        math.log10(start), math.log10(float(half.norm())), _SHELLS + 1, dtype=torch.float64
    )
    middle = (edges[1:] + edges[:-1]) / 2
    number = (_arc(middle, half) - _arc(middle, taken)).clamp_min(0) * edges.diff()
    shown = number > 0
    middle, number = middle[shown], number[shown]
    return middle, number * (outer / number.sum())


def _arc(radius: Tensor, half: Tensor) -> Tensor:
    """Return the length of the circle of each radius that lies inside a rectangle of half sides
    (y, x).
    """
    outside = sum(torch.acos((h / radius).clamp_max(1.0)) for h in half)
    return 4 * radius * (math.pi / 2 - torch.as_tensor(outside)).clamp_min(0)


def _over_squares(places: Tensor, fill: float, waves: float, spread: float) -> Tensor:
    """Return the mean irradiance of the pixels at ``places``, from a table over the radius."""
    reach = float(places.square().sum(1).max().sqrt()) + 0.75
    steps = math.ceil(reach * math.pi / spread / _FRINGE)
    radii = torch.linspace(0.0, reach, min(max(steps, 400), 40_000), dtype=torch.float64)
    table = round_spot(radii * (math.pi / spread), fill, waves)
    total = torch.zeros(len(places), dtype=torch.float64)
    near = places.amax(1) <= 2
    for group, node_limit in ((near, 4 * _FINEST * 4), (~near, _FINEST)):
        points, weights = (
            torch.from_numpy(values)
            for values in legendre(min(node_limit, 3 + math.ceil(5 / spread)))
        )
        total[group] = _mean_of_squares(places[group], points / 2, weights / 2, radii, table)
    return total


def _mean_of_squares(
    places: Tensor, points: Tensor, weights: Tensor, radii: Tensor, table: Tensor
) -> Tensor:
    """Return the weighted mean over points of each square of a function of the radius, which a
    table gives.
    """
    total = torch.zeros(len(places), dtype=torch.float64)
    step, values = radii[1].item(), table.numpy()
    for y, weight in zip(points.tolist(), weights.tolist(), strict=True):
        radius = torch.hypot(places[:, :1] + y, places[:, 1:] + points)
        irradiance = torch.from_numpy(
            np.interp(radius.numpy() / step, np.arange(len(values)), values)
        )
        total += weight * (irradiance @ weights)
    return total


def _over_rings(radius: Tensor, fill: float, waves: float, spread: float) -> Tensor:
    """Return the mean irradiance of pixels far from the spot, where rings are nearly straight.

    How much a pixel averages over the rings depends on how its square lies to them: each radius has
    another azimuth.
    """
    if not len(radius):
        return radius
    drawn = torch.rand(
        len(radius), 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    # by chance, since even steps are in step with the fringes at some radii
    azimuth = drawn * (math.pi / 4)
    across, along = azimuth.cos(), azimuth.sin()
    count = min(_FINEST, 5 + math.ceil(6 / spread))
    offset = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * (across + along)
    weight = ((across + along) / 2 - offset.abs()).minimum(along.clamp_min(1e-3))
    reach = (radius[:, None] + offset) * (math.pi / spread)
    return (round_spot(reach, fill, waves) * weight).sum(1) / weight.sum(1)


def _smoothed(radius: Tensor, pixels: Tensor, light: Tensor, feature: float) -> Tensor:
    """Return the mean light over a disc of the area of a feature around the pixels at each radius.

    A spot inside the disc counts with all of its light; elsewhere the mean over the radii that the
    disc covers counts.
    """
    order = radius.argsort()
    radii = radius[order]
    enclosed = torch.cat([torch.zeros(1, dtype=torch.float64), (light * pixels)[order].cumsum(0)])
    number = torch.cat([torch.zeros(1, dtype=torch.float64), pixels[order].cumsum(0)])
    half = feature / math.sqrt(math.pi)
    low = torch.searchsorted(radii, (radii - half).clamp_min(-1.0))
    high = torch.searchsorted(radii, radii + half, right=True)
    ring = (enclosed[high] - enclosed[low]) / (number[high] - number[low]).clamp_min(1e-300)
    spot = (
        enclosed[torch.searchsorted(radii, torch.full_like(radii, half), right=True)] / feature**2
    )
    smooth = torch.empty_like(light)
    smooth[order] = torch.where(radii <= half, torch.maximum(spot, ring), ring)
    return smooth


# --- summit ---------------------------------------------------------------------------------------

# The peak of a sampled spot: between its samples, and the light outside its window that may hold a
# higher one.


_NEAR = 0.5  #: of the brightest sample, from which the summit of a lobe may be higher than it
_FLOOR = 1e-30  #: of the brightest sample, below which light is dark
#: a sample and its four neighbours, in samples along y and x
_CROSS = ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))
#: share of the light outside a window, at most, that the wings of a spot in the window explain
_WINGS = 0.03


def summit_gain(image: Tensor) -> Tensor:
    """Return the peak of a spot over its brightest sample: the highest summit of the parabolas
    through its lobes.

    A lobe is a sample that none of its four neighbours exceeds. Its summit is that of a parabola
    along y and of one along x, in logarithms, for which a Gaussian lobe is exact.

    Shapes: image (y, x) -> ().
    Units:  any -> none.
    Error:  0.4 % of the peak for the lobes of a round pupil with 4 samples in wavelength times
            f-number, which is up to 7.5 % above the brightest sample.
    Raises: nothing.
    Source: by definition.
    """
    top = image.max()
    if min(image.shape) < 3 or not top > 0:
        return torch.ones((), dtype=torch.float64)
    inner = image[1:-1, 1:-1]
    y, x = (inner > _NEAR * top).nonzero(as_tuple=True)  # a few: no other sample is a summit
    here, above, below, left, right = (
        (image[y + 1 + dy, x + 1 + dx].double() / top).clamp_min(_FLOOR).log() for dy, dx in _CROSS
    )
    lobe, gain = torch.ones_like(here, dtype=torch.bool), torch.zeros_like(here)
    for before, after in ((above, below), (left, right)):
        lobe = lobe & (here >= before) & (here >= after)
        bend = (2 * here - before - after).clamp_min(_FLOOR)
        gain = gain + (after - before).square() / (8 * bend)
    summits = torch.where(lobe, here + gain, 0.0)
    return torch.cat([summits, summits.new_zeros(1)]).max().clamp_min(0).exp()


def unseen_light(image: Tensor, passing: float) -> Tensor:
    """Return the share of a beam's light outside the window of its spot that may be in one spot
    there.

    Of a window that holds nearly all light, the wings go on outside by the radial law of
    `with_frame`: what they explain is in no spot. A window that lacks more may lack a part of the
    spot itself, so that no law counts. ``passing`` is the light through the lens, in the unit of
    the image. A spot of the share s of the light has at most s times the peak of the clear lens in
    focus with the same beam.

    Shapes: image (y, x) -> ().
    Units:  share of the light through the clear pupil -> none.
    Error:  an upper bound for light that the mask takes from a part of the pupil, or from all of it
            evenly; a spot that the border of the window cuts has up to 10 % more.
    Raises: nothing.
    Source: Cauchy-Schwarz inequality for the field in the pupil; our derivation.
    """
    lacking = 1 - image.double().sum() / passing
    beyond_wings = 1 - light_with_wings(image) / passing
    return torch.where(lacking > _WINGS, lacking, beyond_wings).clamp_min(0)
