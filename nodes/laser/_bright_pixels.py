"""The distribution of a laser's light over the pixels of a sensor, and the peak of a sampled
spot.
"""

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
from neusee.nodes.laser._dazzle import mean_over_feature, peak_light
from neusee.nodes.laser._round_spot import legendre, round_spot
from neusee.nodes.sensor._digitization import crop
from neusee.nodes.units import Count, PixelPitch, Shape
from neusee.nodes.values import Bands, Psf

# --- bright pixels --------------------------------------------------------------------------------

# The distribution of a laser's light over pixels, by their distance from the spot, behind any mask
# or behind a clear round lens.


RINGS = 160  #: number of rings around the spot, with equal ratios of their radii
PARTS = 48  #: groups of equally many pixels in each ring, sorted by brightness
_LIGHT_LEVELS = 3000  #: classes of light, at equal ratios, into which pixels are sorted
#: decades of light covered below the brightest pixel; fainter pixels count as 0
_LIGHT_DECADES = 24.0
#: safety factor on the light outside by the radial law, since the wings of a PSF are not smooth
_WING_FACTOR = 1.5
_INNER_PIXELS = 48  #: pixels on each side of the spot that are computed one by one
_SHELL_COUNT = 3000  #: number of rings beyond these pixels
_FRINGE_STEP = 0.06  #: step of v = pi x / (lambda N) that resolves the fringes of a spot
#: largest number of quadrature points across a pixel, except for the brightest pixels
_MOST_PIXEL_POINTS = 24


class BrightPixels(NamedTuple):
    """The light of a laser in groups of pixels that have about the same distance from the spot and
    the same brightness.

    Light scattered by the lens depends on this distance alone, so that it can be added to each
    group before pixels are ranked by brightness.
    """

    #: (group,) float64, pixels, root mean square distance from the spot
    radius: Tensor
    pixels: Tensor  #: (group,) float64, number of pixels
    light: Tensor  #: (group,) float64, share of the light per pixel
    #: (group,) float64, the same for the image averaged over a feature around each pixel
    smooth: Tensor
    #: (3,) float64: distance and mean light of the window's rim where the sensor extends beyond it,
    #: else 0 and 0; and the light in the window and, by the radial law of `with_frame`, outside it
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
    # weights by number of photons, because wells count photons
    weights = (bands.weights * bands.centres).double()
    weights = weights / weights.sum()
    samples_across = _samples_across(pixel_pitch, sample_pitch)
    bands_of_pixels = (
        _light_of_pixels(band.detach().double(), samples_across) for band in psf.intensity
    )
    image = torch.as_tensor(
        sum(w * band for w, band in zip(weights.tolist(), bands_of_pixels, strict=True))
    )
    # True for the axes along which the window of the PSF is smaller than the sensor
    window_smaller = [m < n for m, n in zip(image.shape, shape, strict=True)]
    rim = _rim(image.cpu(), window_smaller)
    image = crop(image, shape=(min(shape[0], image.shape[0]), min(shape[1], image.shape[1])))
    smooth = image if feature == 1 else mean_over_feature(image[None], feature)[0]
    groups = _pixel_groups(image.cpu(), smooth.cpu())
    return BrightPixels(*groups, rim)


def _samples_across(pixel_pitch: float, sample_pitch: float | None) -> int:
    """Return the number of samples along the side of a pixel."""
    ratio = pixel_pitch / (sample_pitch or pixel_pitch)
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
        raise ParameterError(
            "sample_pitch",
            f"{ratio:.5g} samples fit into a pixel of {pixel_pitch * 1e6:.5g} um: give a whole"
            f" fraction of the pixel, such as {pixel_pitch / max(1, round(ratio)) * 1e6:.5g} um",
        )
    return round(ratio)


def _light_of_pixels(light: Tensor, samples: int) -> Tensor:
    """Return the light (y, x) of each pixel, the sum of its ``samples`` x ``samples`` samples;
    incomplete pixels at the end are left out.
    """
    if min(light.shape) < samples:
        size = f"{light.shape[0]} x {light.shape[1]}"
        raise ValueError(
            f"a PSF of {size} samples holds no pixel, which is {samples} samples wide: enlarge its"
            " window"
        )
    # the mean over a pixel times its samples is their sum
    return light if samples == 1 else avg_pool2d(light[None], samples)[0] * samples**2


def _pixel_groups(image: Tensor, smooth: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return radius, number of pixels, light per pixel and smoothed light per pixel (group,) of the
    groups of pixels, `PARTS` per ring.
    """
    rows, columns = image.shape
    rings = _rings(rows, columns)
    ring_lights = [
        _quantiles(picture.double().numpy().ravel(), rings).ravel() for picture in (image, smooth)
    ]
    # all groups of a ring have the same radius and the same number of pixels
    radius, pixels = np.repeat(rings.radius, PARTS), np.repeat(rings.pixels / PARTS, PARTS)
    groups = [torch.from_numpy(column) for column in (radius, pixels, *ring_lights)]
    return groups[0], groups[1], groups[2], groups[3]


class _Rings(NamedTuple):
    """The rings around the middle of a window."""

    number: NDArray[np.int64]  #: (pixel,) index of its ring, times (number of light levels + 1)
    radius: NDArray[np.float64]  #: (ring,) pixels, root mean square
    pixels: NDArray[np.float64]  #: (ring,)


@functools.lru_cache(maxsize=1)
def _rings(rows: int, columns: int) -> _Rings:
    """Return the rings of a window of rows x columns pixels; the last result is cached, since
    successive spots often have windows of the same size.
    """
    y, x = ((np.arange(n) - n // 2).astype(np.float64) ** 2 for n in (rows, columns))
    squared_distance = (y[:, None] + x).ravel()
    log_largest = math.log(max(squared_distance.max(), 1.0)) + 1e-9
    # ring 0 is the pixel of the spot; the radii of the rings k > 0 have equal ratios
    ring_number = np.zeros(squared_distance.size, np.int64)
    off_spot = squared_distance > 0
    ring_number[off_spot] = 1 + (
        np.log(squared_distance[off_spot]) * ((RINGS - 1) / log_largest)
    ).astype(np.int64)
    pixels = np.bincount(ring_number, minlength=RINGS).astype(np.float64)
    radius = np.sqrt(
        np.bincount(ring_number, squared_distance, minlength=RINGS) / np.maximum(pixels, 1)
    )
    return _Rings(ring_number * (_LIGHT_LEVELS + 1), radius, pixels)


def _quantiles(light: np.ndarray, rings: _Rings) -> np.ndarray:
    """Return the median light (ring, group) of each of the `PARTS` groups of a ring, from the
    brightest group to the faintest.

    The pixels are sorted into `_LIGHT_LEVELS` classes of light at equal ratios: a histogram of each
    ring then gives the quantiles.
    """
    brightest = float(light.max(initial=0.0))
    if not brightest > 0:
        return np.zeros((RINGS, PARTS))
    log_step = _LIGHT_DECADES * math.log(10) / _LIGHT_LEVELS
    faintest = brightest * math.exp(-(_LIGHT_LEVELS + 1) * log_step)
    steps_below = np.log(np.maximum(light, faintest) / brightest) * (-1 / log_step)
    level = np.minimum(steps_below, _LIGHT_LEVELS).astype(np.int64)
    # one histogram per ring: `number` is the ring times the number of classes
    counts = np.bincount(rings.number + level, minlength=RINGS * (_LIGHT_LEVELS + 1)).reshape(
        RINGS, -1
    )
    brighter_counts = counts.cumsum(1)
    middle_ranks = (np.arange(PARTS) + 0.5) / PARTS * rings.pixels[:, None]
    levels_at_ranks = np.stack(
        [
            np.searchsorted(ring_counts, ring_ranks)
            for ring_counts, ring_ranks in zip(brighter_counts, middle_ranks, strict=True)
        ]
    )
    # the middle of a class; the last class has the pixels that count as 0
    return np.where(
        levels_at_ranks < _LIGHT_LEVELS,
        brightest * np.exp(-(levels_at_ranks + 0.5) * log_step),
        0.0,
    )


def _rim(image: Tensor, narrow: list[bool]) -> Tensor:
    """Return (distance, light of the rim, known light) of a window; ``narrow`` (y, x) is True for
    an axis along which the sensor extends beyond the window.

    The distance, in pixels, is that of the nearest such side. The light of the rim is the mean over
    the pixels of these sides, each scaled to this distance by the law 1 / r^3. The known light is
    that in the window plus `_WING_FACTOR` times that of the radial law outside it. If the window
    covers the sensor, distance and light of the rim are 0.
    """
    light_of_window = image.double().sum()
    if not any(narrow):
        return torch.stack([0 * light_of_window, 0 * light_of_window, light_of_window])
    distance = float(
        max(1, min((n - 1) // 2 for n, cut in zip(image.shape, narrow, strict=True) if cut))
    )
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in image.shape)
    end_rows = [image[end].double() * torch.hypot(y[end], x).pow(3) for end in (0, -1)]
    end_columns = [image[:, end].double() * torch.hypot(y, x[end]).pow(3) for end in (0, -1)]
    # a list times False is empty: only sides beyond which the sensor extends count
    sides = end_rows * narrow[0] + end_columns * narrow[1]
    light_times_cube = torch.cat(sides).mean()
    half_sides = [n / 2 for n in image.shape]
    # the integral of 1 / r^3 outside a rectangle
    outside_light = 4 * light_times_cube * math.hypot(*half_sides) / (half_sides[0] * half_sides[1])
    rim_distance = torch.tensor(distance, dtype=torch.float64)
    return torch.stack(
        [
            rim_distance,
            light_times_cube / distance**3,
            light_of_window + _WING_FACTOR * outside_light,
        ]
    )


def light_with_wings(image: Tensor) -> Tensor:
    """Return the light in a window (y, x) plus `_WING_FACTOR` times that of the radial law outside
    it.
    """
    return _rim(image, [True, True])[2]


@bright_pixels.preflight
def _(*, pixel_pitch: float, sample_pitch: float | None = None, **_: Any) -> list[str]:
    _samples_across(pixel_pitch, sample_pitch)
    return []


@bright_pixels.check
def _(result: BrightPixels, *inputs: Any, **params: Any) -> list[Check]:
    brightest, pixels = float(result.light.max()), float(result.pixels.sum())
    return [
        Check(
            f"{brightest:.3g} of the light in the brightest of {pixels:.0f} pixels", brightest > 0
        )
    ]


def with_frame(groups: BrightPixels, shape: tuple[int, int]) -> BrightPixels:
    """Add the pixels of a sensor of ``shape`` (y, x) that lie outside the window of the PSF, with
    light by a radial law.

    Far from the spot the light of any aperture with edges falls on average as 1 / r^3. The added
    pixels continue the light of the rim by this law.
    """
    missing_pixels = shape[0] * shape[1] - float(groups.pixels.sum())
    if not (missing_pixels >= 1 and float(groups.rim[0]) > 0):
        return groups
    distance, light, _ = groups.rim.tolist()
    radius, pixels = _outer_rings(
        shape,
        shape[0] * shape[1] - missing_pixels,
        torch.full((1, 2), distance, dtype=torch.float64),
    )
    outer_light = light * (distance / radius).pow(3)
    return BrightPixels(
        radius=torch.cat([groups.radius, radius]),
        pixels=torch.cat([groups.pixels, pixels]),
        light=torch.cat([groups.light, outer_light]),
        smooth=torch.cat([groups.smooth, outer_light]),
        rim=groups.rim,
    )


def hidden_light(groups: BrightPixels) -> float:
    """Return the share of the light that is neither in the window of the PSF nor in the radial law
    of `with_frame`.

    A mask may send this light into a ring or diffraction orders outside the window, onto any pixel
    there.
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
    # power of the Gaussian beam through the lens, over that of an even beam of the same axis
    # irradiance
    passing_share = 1.0 if fill < 1e-9 else -math.expm1(-2 * fill) / (2 * fill)
    # light of a pixel with the peak irradiance, as a share of the light through the lens
    scale = peak_light(spread) / passing_share
    positions, alike_pixels = _inner_pixels(shape, spread)
    inner_light = scale * _over_squares(positions, fill, waves, spread)
    shell_radii, shell_pixels = _outer_rings(shape, float(alike_pixels.sum()), positions)
    outer_light = scale * _over_rings(shell_radii, fill, waves, spread)
    radius = torch.cat([positions.square().sum(1).sqrt(), shell_radii])
    pixels, light = torch.cat([alike_pixels, shell_pixels]), torch.cat([inner_light, outer_light])
    smooth = light if feature <= 1 else _smoothed(radius, pixels, light, feature)
    # (distance, light of the rim, known light): the whole sensor counts, all light is known
    rim = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return BrightPixels(radius, pixels, light, smooth, rim)


def _inner_pixels(shape: tuple[int, int], spread: float) -> tuple[Tensor, Tensor]:
    """Return the positions (pixel, (y, x)) of the pixels around the spot, one for each set of
    symmetric pixels, and the number of pixels in each set.

    Positions are in pixels from the spot, in one quadrant, or in half of it if the area is square.
    """
    half_sides = [min(_INNER_PIXELS, (n - 1) // 2) for n in shape]
    y, x = torch.meshgrid(
        *(torch.arange(half_side + 1.0, dtype=torch.float64) for half_side in half_sides),
        indexing="ij",
    )
    # a pixel off an axis has a mirror image across it
    alike_pixels = torch.where(y > 0, 2.0, 1.0) * torch.where(x > 0, 2.0, 1.0)
    if half_sides[0] == half_sides[1]:  # keep one side of the quadrant's diagonal
        alike_pixels = torch.where(y < x, 2 * alike_pixels, alike_pixels)
        half_quadrant = y <= x
        y, x, alike_pixels = y[half_quadrant], x[half_quadrant], alike_pixels[half_quadrant]
    return torch.stack([y.flatten(), x.flatten()], 1), alike_pixels.flatten().double()


def _outer_rings(shape: tuple[int, int], counted: float, places: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radii in pixels of the rings outside the inner pixels, and the number of sensor
    pixels in each ring.

    The ``counted`` inner pixels at ``places`` are excluded; with the rings they make up the whole
    sensor.
    """
    outer_pixels = shape[0] * shape[1] - counted
    if outer_pixels <= 0:
        return torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    half_sides = torch.tensor(shape, dtype=torch.float64) / 2
    inner_half = places.amax(0) + 0.5
    start = float(torch.minimum(inner_half, half_sides).min())
    edges = torch.logspace(
        math.log10(start),
        math.log10(float(half_sides.norm())),
        _SHELL_COUNT + 1,
        dtype=torch.float64,
    )
    radii = (edges[1:] + edges[:-1]) / 2
    # the area of a ring inside the sensor and outside the inner rectangle
    ring_pixels = (_arc_inside(radii, half_sides) - _arc_inside(radii, inner_half)).clamp_min(
        0
    ) * edges.diff()
    not_empty = ring_pixels > 0
    radii, ring_pixels = radii[not_empty], ring_pixels[not_empty]
    # scaled so that the numbers add up to the number of outer pixels
    return radii, ring_pixels * (outer_pixels / ring_pixels.sum())


def _arc_inside(radius: Tensor, half: Tensor) -> Tensor:
    """Return the arc length of each circle that lies inside a rectangle with the half sides
    ``half`` (y, x).
    """
    # in one quadrant: the angles at which the circle is outside one of the two sides
    angle_outside = sum(torch.acos((h / radius).clamp_max(1.0)) for h in half)
    return 4 * radius * (math.pi / 2 - torch.as_tensor(angle_outside)).clamp_min(0)


def _over_squares(places: Tensor, fill: float, waves: float, spread: float) -> Tensor:
    """Return the irradiance averaged over each pixel at ``places``, from a table over the
    radius.
    """
    # the corner of a pixel is 0.71 pixels from its middle
    table_end = float(places.square().sum(1).max().sqrt()) + 0.75
    steps = math.ceil(table_end * math.pi / spread / _FRINGE_STEP)
    radii = torch.linspace(0.0, table_end, min(max(steps, 400), 40_000), dtype=torch.float64)
    # the argument is v = pi x / (lambda N), with x in pixels
    table = round_spot(radii * (math.pi / spread), fill, waves)
    mean_irradiance = torch.zeros(len(places), dtype=torch.float64)
    near_spot = places.amax(1) <= 2
    # the nearest pixels need more points, because the spot may be far smaller than a pixel
    for pixels_of_group, node_limit in (
        (near_spot, 16 * _MOST_PIXEL_POINTS),
        (~near_spot, _MOST_PIXEL_POINTS),
    ):
        points, weights = (
            torch.from_numpy(values)
            for values in legendre(min(node_limit, 3 + math.ceil(5 / spread)))
        )
        # scale from the interval -1 to 1 to a pixel, -1/2 to 1/2
        mean_irradiance[pixels_of_group] = _mean_of_squares(
            places[pixels_of_group], points / 2, weights / 2, radii, table
        )
    return mean_irradiance


def _mean_of_squares(
    places: Tensor, points: Tensor, weights: Tensor, radii: Tensor, table: Tensor
) -> Tensor:
    """Return the average over each pixel's square (pixel,) of a function of the distance from the
    spot.

    ``places`` are the middles of the pixels, ``points`` and ``weights`` a quadrature rule on -1/2
    to 1/2 along each axis, and ``table`` the values of the function at evenly spaced ``radii`` from
    0.
    """
    means = torch.zeros(len(places), dtype=torch.float64)
    step, values = radii[1].item(), table.numpy()
    for y, weight in zip(points.tolist(), weights.tolist(), strict=True):
        radius = torch.hypot(places[:, :1] + y, places[:, 1:] + points)
        irradiance = torch.from_numpy(
            np.interp(radius.numpy() / step, np.arange(len(values)), values)
        )
        means += weight * (irradiance @ weights)
    return means


def _over_rings(radius: Tensor, fill: float, waves: float, spread: float) -> Tensor:
    """Return the irradiance averaged over pixels at the distances ``radius`` from the spot, where
    fringes are nearly straight lines.

    The average then runs over one direction only and depends on the azimuth of the pixel, which is
    drawn at random for each radius.
    """
    if not len(radius):
        return radius
    random_share = torch.rand(
        len(radius), 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    # random, since regular steps could coincide with the fringes at some radii
    azimuth = random_share * (math.pi / 4)
    cosine, sine = azimuth.cos(), azimuth.sin()
    point_count = min(_MOST_PIXEL_POINTS, 5 + math.ceil(6 / spread))
    # across the fringes the square pixel is cos + sin wide
    offset = ((torch.arange(point_count, dtype=torch.float64) + 0.5) / point_count - 0.5) * (
        cosine + sine
    )
    # length of the pixel along a fringe: a trapezium that falls to 0 at the corners
    chord = ((cosine + sine) / 2 - offset.abs()).minimum(sine.clamp_min(1e-3))
    reaches = (radius[:, None] + offset) * (math.pi / spread)
    return (round_spot(reaches, fill, waves) * chord).sum(1) / chord.sum(1)


def _smoothed(radius: Tensor, pixels: Tensor, light: Tensor, feature: float) -> Tensor:
    """Return the light averaged over a disc with the area of a feature, around the pixels at each
    radius.

    Near the spot it is the larger of two means, that of the disc centred on the spot and that over
    the radii that the disc covers; elsewhere the latter.
    """
    order = radius.argsort()
    radii = radius[order]
    # cumulative light and pixels up to each radius, starting with 0
    enclosed_light = torch.cat(
        [torch.zeros(1, dtype=torch.float64), (light * pixels)[order].cumsum(0)]
    )
    enclosed_pixels = torch.cat([torch.zeros(1, dtype=torch.float64), pixels[order].cumsum(0)])
    # radius of a disc with the area of the feature
    disc_radius = feature / math.sqrt(math.pi)
    first_index = torch.searchsorted(radii, (radii - disc_radius).clamp_min(-1.0))
    end_index = torch.searchsorted(radii, radii + disc_radius, right=True)
    # mean over the radii that the disc covers, from differences of the cumulative sums
    ring_mean = (enclosed_light[end_index] - enclosed_light[first_index]) / (
        enclosed_pixels[end_index] - enclosed_pixels[first_index]
    ).clamp_min(1e-300)
    spot_mean = (
        # all light within the disc centred on the spot
        enclosed_light[torch.searchsorted(radii, torch.full_like(radii, disc_radius), right=True)]
        / feature**2
    )
    smooth = torch.empty_like(light)
    smooth[order] = torch.where(
        radii <= disc_radius, torch.maximum(spot_mean, ring_mean), ring_mean
    )
    return smooth


# --- summit ---------------------------------------------------------------------------------------

# The peak of a sampled spot, between its samples, and the light outside its window, which may have
# a higher peak.


#: lobes above this share of the brightest sample are interpolated, since their peak may exceed it
_LOBE_SHARE = 0.5
_DARK_SHARE = 1e-30  #: share of the brightest sample below which light counts as dark
#: offsets (y, x) of a sample and its four neighbours
_NEIGHBOUR_OFFSETS = ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))
#: largest share of light outside a window that the wings of the spot may explain
_WINGS_SHARE = 0.03


def summit_gain(image: Tensor) -> Tensor:
    """Return the interpolated peak of a spot over its brightest sample, from parabolas through its
    lobes.

    A lobe is a sample that none of its four neighbours exceeds. Its peak is interpolated by
    parabolas of the logarithm along y and along x, which is exact for a Gaussian lobe.

    Shapes: image (y, x) -> ().
    Units:  any -> none.
    Error:  0.4 % of the peak for the lobes of a round pupil with 4 samples in wavelength times
            f-number, which is up to 7.5 % above the brightest sample.
    Raises: nothing.
    Source: by definition.
    """
    brightest = image.max()
    if min(image.shape) < 3 or not brightest > 0:
        return torch.ones((), dtype=torch.float64)
    inner = image[1:-1, 1:-1]
    # only these few samples can have the peak
    y, x = (inner > _LOBE_SHARE * brightest).nonzero(as_tuple=True)
    log_light, above, below, left, right = (
        (image[y + 1 + dy, x + 1 + dx].double() / brightest).clamp_min(_DARK_SHARE).log()
        for dy, dx in _NEIGHBOUR_OFFSETS
    )
    is_lobe, log_gain = torch.ones_like(log_light, dtype=torch.bool), torch.zeros_like(log_light)
    for before, after in ((above, below), (left, right)):
        is_lobe = is_lobe & (log_light >= before) & (log_light >= after)
        curvature = (2 * log_light - before - after).clamp_min(_DARK_SHARE)
        # peak of the parabola through three points, above the middle one
        log_gain = log_gain + (after - before).square() / (8 * curvature)
    summits = torch.where(is_lobe, log_light + log_gain, 0.0)
    return torch.cat([summits, summits.new_zeros(1)]).max().clamp_min(0).exp()


def unseen_light(image: Tensor, passing: float) -> Tensor:
    """Return an upper bound of the share of a beam's light that may form another spot outside the
    window.

    If the window contains nearly all light, the wings outside it follow the radial law of
    `with_frame`, and their light forms no spot. If the window lacks more, it may lack a part of the
    spot itself, and all missing light counts. ``passing`` is the light through the lens, in the
    unit of the image. A spot with the share s of the light has at most s times the peak of the
    clear, focused lens with the same beam.

    Shapes: image (y, x) -> ().
    Units:  share of the light through the clear pupil -> none.
    Error:  an upper bound for light that the mask takes from a part of the pupil, or from all of it
            evenly; a spot that the border of the window cuts has up to 10 % more.
    Raises: nothing.
    Source: Cauchy-Schwarz inequality for the field in the pupil; our derivation.
    """
    missing_share = 1 - image.double().sum() / passing
    share_beyond_wings = 1 - light_with_wings(image) / passing
    return torch.where(missing_share > _WINGS_SHARE, missing_share, share_beyond_wings).clamp_min(0)
