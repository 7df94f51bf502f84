"""Dirt on the window: grains, scratches and films that are the same at any sampling of the
pupil.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, TensorStats, node
from neusee.nodes.optics._pupil import phase_screen_factors, zernike_surface
from neusee.nodes.optics._pupil_grid import PupilGrid, grid_of, inside_stop, row_stripes
from neusee.nodes.units import Fraction, Waves
from neusee.nodes.values import Dirt, Stop

# --- grains and scratches -------------------------------------------------------------------------

# Round grains and scratches on glass, rendered with their correct area at any sampling of the
# pupil.


class Grain(NamedTuple):
    """A round grain; position from the centre and radius are in diameters of the stop."""

    v: float
    u: float
    radius: float
    opacity: float  #: 1 - transmittance of the field; 1 is opaque


class Scratch(NamedTuple):
    """A scratch along a line through points; positions from the centre and width are in diameters
    of the stop.
    """

    points: Sequence[tuple[float, float]]  #: (v, u)
    width: float
    opacity: float


def stamp(amplitude: Tensor, marks: Sequence[Grain | Scratch], grid: PupilGrid) -> Tensor:
    """Multiply the pupil amplitude (v, u) in place by the transmission of each grain and scratch,
    and return it.
    """
    scale, middle_sample = grid.diameter / grid.pitch, (grid.samples - 1) / 2
    for mark in marks:
        points = [(mark.v, mark.u)] if isinstance(mark, Grain) else list(mark.points)
        positions = [(v * scale + middle_sample, u * scale + middle_sample) for v, u in points]
        width_in_samples = scale * (2 * mark.radius if isinstance(mark, Grain) else mark.width)
        _darken(amplitude, positions, width_in_samples, mark.opacity)
    return amplitude


def _darken(
    amplitude: Tensor, places: list[tuple[float, float]], size: float, opacity: float
) -> None:
    """Multiply the amplitude in place by 1 - opacity x (covered share of each sample) of a grain or
    scratch.

    ``places`` (v, u) are the points of its line in samples (one point for a grain), ``size`` its
    width in samples. Where segments overlap, the larger covered share is used.
    """
    window = _touched_samples(places, size / 2 + 1, amplitude.shape[-1])
    if window is None:
        return
    rows, columns = window
    y = torch.arange(rows.start, rows.stop, dtype=torch.float32, device=amplitude.device)[:, None]
    x = torch.arange(columns.start, columns.stop, dtype=torch.float32, device=amplitude.device)[
        None, :
    ]
    cover = amplitude.new_zeros(len(y), x.shape[1])
    # a grain is a segment of length 0
    for start, end in zip(places, places[1:] or places, strict=False):
        segment_window = _touched_samples([start, end], size / 2 + 1, amplitude.shape[-1])
        if segment_window is None:
            continue
        v, u = (
            slice(inner.start - outer.start, inner.stop - outer.start)
            for inner, outer in zip(segment_window, window, strict=True)
        )
        segment_cover = _covered_share(
            _distance_to_line(y[v], x[:, u], start, end), size, len(places) == 1
        )
        cover[v, u] = torch.maximum(cover[v, u], segment_cover)
    amplitude[rows, columns] *= 1 - opacity * cover


def _touched_samples(
    places: list[tuple[float, float]], margin: float, samples: int
) -> tuple[slice, slice] | None:
    """Return the rows and columns of the bounding box of a grain or scratch, widened by ``margin``
    samples, or None if it is outside the grid.
    """
    spans = []
    for axis in (0, 1):
        low = max(int(min(place[axis] for place in places) - margin), 0)
        high = min(int(max(place[axis] for place in places) + margin) + 2, samples)
        if high <= low:
            return None
        spans.append(slice(low, high))
    return spans[0], spans[1]


def _distance_to_line(
    y: Tensor, x: Tensor, start: tuple[float, float], end: tuple[float, float]
) -> Tensor:
    """Return the distance of each sample from the segment between two points, in samples."""
    (start_y, start_x), (end_y, end_x) = start, end
    line_y, line_x = end_y - start_y, end_x - start_x
    squared_length = line_y**2 + line_x**2
    line_share = torch.zeros_like(y + x)
    if squared_length > 0:
        line_share = ((y - start_y) * line_y + (x - start_x) * line_x) / squared_length
    line_share = line_share.clamp(0, 1)
    return torch.hypot(y - start_y - line_share * line_y, x - start_x - line_share * line_x)


def _covered_share(distance: Tensor, size: float, is_grain: bool) -> Tensor:
    """Return the covered share of each sample under a grain or scratch ``size`` samples wide,
    normalised so that the shares add up to its area.
    """
    if is_grain:
        squared_radius = size**2 / 4
        # a disc of radius r with a linear edge one sample wide has the area pi (r^2 + 1 / 12)
        edge_radius = math.sqrt(max(squared_radius - 1 / 12, 1 / 4))
        return min(3 * squared_radius, 1.0) * (edge_radius + 0.5 - distance).clamp(0, 1)
    return ((size + 1) / 2 - distance).clamp(0, min(size, 1.0))


# --- dirt -----------------------------------------------------------------------------------------

# Dirt on the window in front of the lens; its statistics do not depend on the sampling of the
# pupil.


Mean = Annotated[float, Field(ge=0, le=10_000)]  #: expected number
Part = Annotated[float, Field(gt=0, le=1)]  #: relative to the diameter of the pupil
Rms = Annotated[Waves, Field(ge=0)]  #: root mean square optical path, in waves at 550 nm
WAVE = 550e-9  #: m
_VIOLET = 400e-9  #: m, shortest wavelength, for which a path gives the largest phase
_ROUNDING = 6e-8  #: round-off of an amplitude near 1, float32
DENT_TERMS = range(4, 16)  #: Noll numbers from defocus to the fourth radial order


@node()
def dirt(
    stop: Stop,
    *,
    dust: Mean = 0.0,
    dust_radius: Part = 1 / 60,
    scratches: Mean = 0.0,
    scratch_length: Part = 0.1,
    scratch_width: Part = 1 / 300,
    grease: Rms = 0.0,
    grease_scale: Part = 0.05,
    smudges: Fraction = 0.0,
    smudge_scale: Part = 0.15,
    dents: Rms = 0.0,
    rng: torch.Generator,
) -> Dirt:
    """Add the dirt of a windshield to the pupil: grains of dust, scratches, a greasy film, smudges
    and dents.

    dust, scratches: expected numbers (Wu et al.: 30 each). The radius of the largest grain is drawn
        about ``dust_radius``, the width of the widest scratch about ``scratch_width``. A scratch
        has up to 16 steps, none longer than ``scratch_length``. All lengths are relative to the
        diameter.
    grease: root mean square of a phase screen with correlation length ``grease_scale`` (0.02 to
    0.2). smudges: opacity of the field under the thickest of the soft patches, whose size is
    ``smudge_scale``. dents: root mean square of Zernike terms 4 to 15 (0.1 to 2 waves). With all
    five at zero the glass is clean.

    Shapes: stop -> Dirt (v, u).
    Units:  grease, dents waves at 550 nm; result amplitude 1, path m.
    Error:  covered area of a mark: 1 % from 3 samples across, 10 % at 1 sample, unbiased at any
            size.
    Source: numbers, sizes and opacities of dust and scratches: Wu et al., ICCV 2021 (arXiv
        2011.12485), relative to their 6000 samples; grease, smudges and dents are ours.
    """
    grid = grid_of(stop)
    grains_rng, lines_rng, film_rng, patches_rng, dents_rng = _generators(5, rng)
    grains = _grains(dust, dust_radius, grains_rng)
    scratch_lines = _scratches(scratches, scratch_length, scratch_width, lines_rng)
    # each random field is the matrix product of a factor for the rows and one for the columns
    film_rows, film_columns = phase_screen_factors(grid, grease_scale, film_rng)
    patch_rows, patch_columns = phase_screen_factors(grid, smudge_scale, patches_rng)
    dent_terms = _dents(WAVE * dents, dents_rng)
    amplitude, path = (torch.empty(grid.samples, grid.samples) for _ in range(2))
    for rows in row_stripes(grid):
        amplitude[rows] = 1.0
        if smudges:
            amplitude[rows] = 1 - smudges * torch.sigmoid(3 * (patch_rows[rows] @ patch_columns))
        path[rows] = 0.0
        if grease:
            path[rows] = WAVE * grease * (film_rows[rows] @ film_columns)
        if dent_terms:
            path[rows] += zernike_surface(dent_terms, grid, rows=rows)
    return Dirt(stamp(amplitude, [*grains, *scratch_lines], grid), path)


def _generators(count: int, rng: torch.Generator) -> list[torch.Generator]:
    """Create one random generator for each kind of dirt, so that more dust does not change the
    scratches.
    """
    seeds = torch.randint(2**62, (count,), generator=rng, device=rng.device).tolist()
    return [torch.Generator(rng.device).manual_seed(seed) for seed in seeds]


def _uniform(rng: torch.Generator, low: float = 0.0, high: float = 1.0) -> float:
    """Draw a uniformly distributed number between ``low`` and ``high``."""
    return low + (high - low) * float(
        torch.rand((), generator=rng, device=rng.device, dtype=torch.float64)
    )


def _normal_number(mean: float, spread: float, rng: torch.Generator) -> float:
    """Draw a normally distributed number; a negative one becomes 0."""
    return max(
        mean
        + spread * float(torch.randn((), generator=rng, device=rng.device, dtype=torch.float64)),
        0.0,
    )


def _grains(mean: float, radius: float, rng: torch.Generator) -> list[Grain]:
    """Return random dust grains: their number is drawn about ``mean``, their radii up to a largest
    radius drawn about ``radius``.
    """
    largest = _normal_number(radius, radius / 2, rng)
    return [
        Grain(
            _uniform(rng, -0.5, 0.5),
            _uniform(rng, -0.5, 0.5),
            _uniform(rng) * largest,
            _uniform(rng, 0.5, 1.0),
        )
        for _ in range(round(_normal_number(mean, mean / 6, rng)))
    ]


def _scratches(mean: float, length: float, width: float, rng: torch.Generator) -> list[Scratch]:
    """Return random scratches: their number is drawn about ``mean``, their widths up to a largest
    width drawn about ``width``.
    """
    number, widest = (
        round(_normal_number(mean, mean / 6, rng)),
        _normal_number(width, width / 4, rng),
    )
    return [_scratch(length, widest, rng) for _ in range(number)]


def _scratch(length: float, widest: float, rng: torch.Generator) -> Scratch:
    """Return a random scratch: a random walk of 1 to 16 steps, each no longer than ``length``."""
    points = [(_uniform(rng, -0.5, 0.5), _uniform(rng, -0.5, 0.5))]
    stride = length * _uniform(rng)
    for _ in range(1 + int(16 * _uniform(rng))):
        step, direction = stride * _uniform(rng), 2 * torch.pi * torch.tensor(_uniform(rng))
        v, u = points[-1]
        points.append((v + step * float(direction.sin()), u + step * float(direction.cos())))
    return Scratch(points, widest * _uniform(rng, 0.05, 1.0), _uniform(rng, 0.5, 1.0))


def _dents(rms: float, rng: torch.Generator) -> dict[int, float]:
    """Return random Zernike coefficients, by Noll number, of the dents in a window; their root sum
    of squares is ``rms``.
    """
    normal_numbers = torch.randn(
        len(DENT_TERMS), generator=rng, device=rng.device, dtype=torch.float64
    )
    coefficients = (rms * normal_numbers / normal_numbers.norm()).tolist()
    return dict(zip(DENT_TERMS, coefficients, strict=True)) if rms else {}


@dirt.zero_bound
def _(
    stop: TensorStats,
    *,
    dust: float,
    scratches: float,
    grease: float,
    smudges: float,
    dents: float,
    **_: Any,
) -> float:
    """Return an upper bound of the change of the pupil field by dirt at wavelengths from 400 nm; 0
    for a clean window.

    A grain or a scratch may be opaque. A film is a weighted sum of normal random numbers, which the
    generator keeps below 8.6, so that the film stays below 31 times its root mean square. The
    twelve terms of the dents together reach at most sqrt(50) times their root mean square, at the
    rim.
    """
    if not any((dust, scratches, grease, smudges, dents)):
        return 0.0
    blocked = 1.0 if dust or scratches else smudges
    waves = (31 * grease + math.sqrt(50) * dents) * WAVE / _VIOLET
    return min(2.0, _ROUNDING + blocked + 2 * math.pi * waves)


@dirt.check
def _(result: Dirt, stop: Stop, **_: Any) -> list[Check]:
    passed, rms = _light_and_path(result, grid_of(stop))
    text = (
        f"dirt passes {passed:.4f} of the light, bends it by {rms:.3g} waves root mean square at"
        " 550 nm"
    )
    low, high = (float(x) for x in torch.aminmax(result.amplitude))
    return [
        Check(text, passed > 0),
        Check(f"amplitude behind the dirt from {low:.3g} to {high:.3g}", low >= 0 and high <= 1),
    ]


def _light_and_path(dirt: Dirt, grid: PupilGrid) -> tuple[float, float]:
    """Return the share of the light that passes the dirt, and the standard deviation of its optical
    path over the pupil, in waves at 550 nm.
    """
    pupil_sums = torch.zeros(4, dtype=torch.float64)
    for rows in row_stripes(grid):
        in_pupil = inside_stop(grid, dirt.path.device, rows)
        amplitude, path_waves = (
            dirt.amplitude[rows][in_pupil].double(),
            dirt.path[rows][in_pupil].double() / WAVE,
        )
        # sums over the pupil of samples, light, path and squared path, stripe by stripe
        pupil_sums += torch.stack(
            [in_pupil.sum(), amplitude.square().sum(), path_waves.sum(), path_waves.square().sum()]
        ).cpu()
    passed, mean_path, mean_square = (pupil_sums[1:] / pupil_sums[0]).tolist()
    return passed, math.sqrt(max(mean_square - mean_path**2, 0.0))
