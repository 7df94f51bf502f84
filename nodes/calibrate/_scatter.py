"""The scatter of a lens, estimated from rings around an overexposed point source.

In this order: rings from frames, their likelihood, the prior, the sampler coordinates.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from torch.special import log_ndtr

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.calibrate._light_levels import refuse_unreadable, stack
from neusee.nodes.calibrate._priors import (
    Factor,
    Free,
    Positive,
    Prior,
    Ridge,
    free_names,
    prior_of_pairs,
)
from neusee.nodes.calibrate._sensor_likelihood import Likelihood, without_details
from neusee.nodes.flare._stray_light import lobe, on_far_pixels, scattered_share
from neusee.nodes.sensor._digitization import Bits
from neusee.nodes.sensor._saturation import Well, refuse_without_room, refuse_without_steps
from neusee.nodes.units import (
    DataFiles,
    Diameter,
    Electrons,
    FocalLength,
    Gain,
    PixelPitch,
    Real,
    Wavelength,
)

# --- point source ---------------------------------------------------------------------------------

# Reduction of overexposed frames of a point source to mean signals in rings of pixels, to which the
# scatter of a lens is fitted.


Place = Annotated[float, Field(ge=0, le=1e6)]  #: pixels, from the middle of the first pixel
Numbers = NDArray[np.float64]
#: share of saturation from which a pixel counts as cut off: its value is only a lower limit
_CUT_SHARE = 0.95
#: standard deviations by which the mean of a ring must lie below this cut to be used
_CUT_SIGMA = 5.0
#: ratio of outer and inner radius of a ring, where that makes it wider than a pixel
_RING_RATIO = 1.04
_PARTS_OF_RING = 4  #: concentric parts of a ring, over which the model is averaged
#: pixels; radius of the first ring, below which pixels are not small against the radius
_FIRST_RADIUS = 16.0
_LEAST_RINGS = 6  #: least number of rings from which the scatter is fitted


class Rings(NamedTuple):
    """The mean signal in rings of pixels around an overexposed point source, and the rings that are
    cut off near saturation.
    """

    mean: Tensor  #: (ring,) float64, e- per pixel and exposure, without offset
    pixels: Tensor  #: (ring,) float64, number of pixels, of all frames
    ring: Tensor  #: (part,) int64, ring of each part
    square: Tensor  #: (part,) float64, pixels², mean squared distance from the source
    weight: Tensor  #: (part,) float64, number of pixels
    #: (cut,) float64, pixels², mean squared distance of each ring in which every pixel is cut off
    cut_square: Tensor
    cut: Tensor  #: () float64, e-: a pixel that is cut off has at least this signal
    centre: Tensor  #: (2,) float64, y and x of the source, from the middle of the first pixel


class PointCamera(NamedTuple):
    gain: float
    offset: float
    full_well: float
    bits: int
    read_noise: float

    @property
    def cut(self) -> float:
        """Return the digital number from which a pixel counts as cut off."""
        return _CUT_SHARE * min(2.0**self.bits - 1, self.full_well * self.gain)


@node()
def point_source(
    *,
    files: DataFiles,
    gain: Gain,
    offset: Electrons,
    full_well: Well,
    read_noise: Electrons,
    bits: Bits = 16,
    centre: tuple[Place, Place] | None = None,
) -> Rings:
    """Average the signal of an overexposed point source over rings about the source, and find the
    rings cut off.

    The source is at ``centre``, or in the middle of the saturated pixels. A pixel above 95 % of
    saturation says only that it holds more. Averaged rings begin beyond 16 pixels, where the mean
    lies five standard deviations below that cut; of the rings inside, those whose every pixel is
    cut off are kept as a limit.

    Shapes: files of (y, x) numbers -> rings (ring,), parts of rings (part,).
    Units:  DN -> e-.
    Error:  the centre from saturated pixels: 0.1 pixels, which changes a ring by (0.1 / r)**2. Lone
            bright pixels beyond the core are left out.
    Raises: ParameterError before the run, or ValueError, for frames without a saturated pixel, a
            source that is not in the frame, numbers above the converter, and too few rings.
    Source: photon-transfer model of EMVA Standard 1288, release 4.0 Linear; Peterson, Proc. SPIE
            5178 (2004), 184.
    """
    camera = PointCamera(gain, offset, full_well, bits, read_noise)
    return reduce_rings(stack(files).astype(np.float64), camera, centre)


@point_source.preflight
def _(*, files: Sequence[Path], centre: tuple[float, float] | None, **params: Any) -> list[str]:
    refuse_unreadable("files", files)
    refuse_without_room(
        params["full_well"], offset=params["offset"], read_noise=params["read_noise"]
    )
    refuse_without_steps(params["full_well"], gain=params["gain"], bits=params["bits"])
    camera = PointCamera(**{name: params[name] for name in PointCamera._fields})
    try:
        reduce_rings(stack(files).astype(np.float64), camera, centre)
    except ValueError as error:
        raise ParameterError("files", str(error)) from None
    return []


@point_source.check
def _(result: Rings, *others: Any, **params: Any) -> list[Check]:
    first, last = (float(result.square[i].sqrt()) for i in (0, -1))
    y, x = result.centre.tolist()
    text = (
        f"{len(result.mean)} rings from {first:.0f} to {last:.0f} pixels about the source at"
        f" ({y:.1f}, {x:.1f})"
    )
    return [Check(text, bool((result.pixels > 0).all()))]


def reduce_rings(frames: Numbers, camera: PointCamera, centre: tuple[float, float] | None) -> Rings:
    """Reduce frames (frame, y, x) of digital numbers to rings; raise ValueError for frames from
    which no scatter can be estimated.
    """
    _refuse_numbers(frames, camera)
    height, width = frames.shape[1:]
    source_y, source_x = _source_centre(frames, camera) if centre is None else centre
    if not (-0.5 <= source_y <= height - 0.5 and -0.5 <= source_x <= width - 0.5):
        raise ValueError(
            f"the source at ({source_y:g}, {source_x:g}) is not in the frame of"
            f" {height} x {width} pixels: give `centre` as y and x, in pixels"
        )
    y, x = np.ogrid[:height, :width]
    squared_distance = ((y - source_y) ** 2 + (x - source_x) ** 2).astype(np.float64)
    sector = _part_numbers(squared_distance)
    signal = frames / camera.gain - camera.offset
    is_cut: NDArray[np.bool_] = np.asarray((frames >= camera.cut).any(0))
    # `sector` is the number of the part of a ring: ring number = part number // `_PARTS_OF_RING`
    first_ring = _first_ring(frames, sector // _PARTS_OF_RING, camera)
    unsaturated = (sector >= first_ring * _PARTS_OF_RING) & ~is_cut
    cut_squares = _cut_rings(squared_distance, sector // _PARTS_OF_RING, is_cut, first_ring)
    # the last three fields of `Rings`: cut_square, cut and centre
    limits = (cut_squares, camera.cut / camera.gain - camera.offset, (source_y, source_x))
    rings = _ring_averages(signal, squared_distance, sector, unsaturated)
    return Rings(*rings, *(torch.as_tensor(x, dtype=torch.float64) for x in limits))


def _refuse_numbers(frames: Numbers, camera: PointCamera) -> None:
    """Raise ValueError for pixel values above the range of the converter, and for frames without a
    saturated pixel.
    """
    brightest = float(frames.max())
    if brightest > 2**camera.bits - 1:
        raise ValueError(
            f"the frames hold {brightest:.0f} DN, which {camera.bits} bits cannot: give the `bits`"
            " of the files"
        )
    if brightest < camera.cut:
        raise ValueError(
            f"no pixel is saturated: the brightest has {brightest:.0f} DN of"
            f" {camera.cut / _CUT_SHARE:.0f} DN: expose longer, or check `bits`, `full_well` and"
            " `gain`"
        )


def _source_centre(frames: Numbers, camera: PointCamera) -> tuple[float, float]:
    """Return the centroid (y, x) of the saturated pixels, without lone pixels far from their
    median.
    """
    y, x = np.nonzero((frames >= camera.cut).all(0))
    if not len(y):
        raise ValueError(
            "no pixel is saturated in every frame: give frames of one exposure, or give `centre`"
        )
    distance = np.hypot(y - np.median(y), x - np.median(x))
    is_near = distance <= 3 * max(float(np.median(distance)), 1.0)
    return float(y[is_near].mean()), float(x[is_near].mean())


def _part_numbers(square: Numbers) -> NDArray[np.int64]:
    """Return the number of the ring part to which each pixel belongs, from its squared distance to
    the source.

    Each ring has `_PARTS_OF_RING` parts. Near the source rings are one pixel wide; farther out the
    radius grows by `_RING_RATIO` from ring to ring.
    """
    radius = np.sqrt(square)
    first_wide_radius = 1 / (_RING_RATIO - 1)  # radius below which rings are one pixel wide
    ring_of_wide = first_wide_radius + np.log(
        np.maximum(radius, first_wide_radius) / first_wide_radius
    ) / math.log(_RING_RATIO)
    part_number: NDArray[np.int64] = np.floor(
        _PARTS_OF_RING * np.where(radius < first_wide_radius, radius, ring_of_wide)
    ).astype(np.int64)
    return part_number


def _first_ring(frames: Numbers, ring: NDArray[np.int64], camera: PointCamera) -> int:
    """Return the number of the first ring from which every ring lies clearly below saturation,
    apart from lone bright pixels; `_FIRST_RADIUS` or more.

    ``ring`` is the ring number of each pixel.
    """
    pixel_count = np.bincount(ring.ravel())
    is_cut = (frames >= camera.cut).any(0)
    mean = np.bincount(ring.ravel(), frames.mean(0).ravel()) / pixel_count.clip(1)
    # DN: shot noise, whose variance is K x mean, and read noise
    noise = np.sqrt(np.maximum(mean * camera.gain, 0) + (camera.read_noise * camera.gain) ** 2)
    many_cut = np.bincount(ring.ravel(), is_cut.ravel()) > 0.05 * pixel_count
    is_bright = (mean + _CUT_SIGMA * noise >= camera.cut) | many_cut
    return max(
        int(np.flatnonzero(is_bright & (pixel_count > 0)).max(initial=-1)) + 1, int(_FIRST_RADIUS)
    )


def _cut_rings(
    square: Numbers, ring: NDArray[np.int64], cut: NDArray[np.bool_], first: int
) -> Numbers:
    """Return the mean squared distance of each ring in which every pixel is cut off, between 16
    pixels and the ring ``first``.
    """
    pixel_count, cut_count, sum_of_squares = (
        np.bincount(ring.ravel(), x.ravel()) for x in (np.ones_like(square), cut, square)
    )
    ring_numbers = np.arange(len(pixel_count))
    all_cut = (
        (ring_numbers < first)
        & (ring_numbers >= _FIRST_RADIUS)
        & (pixel_count > 0)
        & (cut_count == pixel_count)
    )
    mean_squares: Numbers = sum_of_squares[all_cut] / pixel_count[all_cut]
    return mean_squares


def _ring_averages(
    signal: Numbers, square: Numbers, sector: NDArray[np.int64], unsaturated: NDArray[np.bool_]
) -> tuple[Tensor, ...]:
    """Return the first five fields of `Rings`: mean and number of pixels of each ring, and ring,
    mean squared distance and number of pixels of each part.
    """
    part_numbers, part_of_pixel = np.unique(sector[unsaturated], return_inverse=True)
    part_pixels = np.bincount(part_of_pixel).astype(np.float64)
    part_distances, part_means = (
        np.bincount(part_of_pixel, values[unsaturated]) / part_pixels
        for values in (square, signal.mean(0))
    )
    ring_numbers, ring_of_part = np.unique(part_numbers // _PARTS_OF_RING, return_inverse=True)
    if len(ring_numbers) < _LEAST_RINGS:
        raise ValueError(
            f"only {len(ring_numbers)} rings of pixels lie between the saturated pixels and the"
            " edge of the frame: expose less, or give a larger frame with the source in it"
        )
    ring_pixels = np.bincount(ring_of_part, part_pixels)
    columns = (
        np.bincount(ring_of_part, part_pixels * part_means) / ring_pixels,
        # of all frames
        ring_pixels * len(signal),
        ring_of_part.astype(np.int64),
        part_distances,
        part_pixels,
    )
    return tuple(torch.as_tensor(x) for x in columns)


# --- likelihood -----------------------------------------------------------------------------------

# The likelihood of the rings around an overexposed point source, with the Harvey-Shack model of the
# scatter of a lens.


Scattered = Annotated[float, Field(ge=0, le=100)]  #: a standard deviation; 0 for none
#: relative deviation of the diffraction wing in a ring one pixel wide from its mean, by fringes
_FRINGE_DEVIATION = 0.02


@node()
def stray_light(
    rings: Rings,
    *,
    b0: Positive,
    l: Positive,  # noqa: E741 (the symbol of the literature)
    s: Real,
    electrons: Annotated[Electrons, Field(gt=0)],
    background: Real = 0.0,
    core: Scattered = 1.0,
    scatter: Scattered = 0.0,
    read_noise: Electrons,
    gain: Gain,
    focal_length: FocalLength,
    diameter: Diameter,
    pixel_pitch: PixelPitch,
    wavelength: Wavelength,
    told: bool = True,
) -> Likelihood:
    """Compute the likelihood of the rings about a point source under one Harvey-Shack surface at
    the entrance pupil.

    The mean of a pixel is ``electrons`` times ((1 - TIS) core + scattered light) plus
    ``background``; ``electrons`` are those of the whole source in one exposure, and the distance r
    stands for the direction cosine r / focal_length. The core is ``core`` times the mean
    diffraction wing of a round aperture, wavelength N pitch**2 / (pi**3 r**3) with N = focal_length
    / diameter. The mean of a ring is normal, with shot noise, ``read_noise``, rounding, and a
    relative standard deviation ``scatter`` for what the model lacks, such as fringes and unequal
    pixels. The mean of a ring whose every pixel is cut off is at least the cut. Any number may be a
    tensor (walker,).

    Shapes: rings -> log (walker,), deviance (walker, ring), scaled (walker, row).
    Units:  b0 1/sr; electrons, background, read_noise e- of one exposure; log in nats.
    Error:  parts of rings are averaged over squared distance, 1e-4 of a ring. Diffraction fringes
            are averaged; a ring one fringe wide keeps a few per cent of them, which ``scatter``
            must cover.
    Source: Harvey, thesis, Univ. of Arizona (1976); Peterson, Proc. SPIE 5178 (2004), 184; wing of
            the core: Born and Wolf, Principles of Optics, 7th ed., section 8.5.2, the energy
            outside a radius for large radii.
    """
    source_values = {
        "electrons": electrons,
        "background": background,
        "core": core,
        "scatter": scatter,
    }
    scatter_values = {"b0": b0, "l": l, "s": s, **source_values}
    parameters = {
        name: torch.as_tensor(x, dtype=torch.float64)[..., None]
        for name, x in scatter_values.items()
    }
    # wavelength x f-number in pixels, and the direction cosine that one pixel spans
    lens_scales = (wavelength * focal_length / (diameter * pixel_pitch), pixel_pitch / focal_length)
    ring_mean = (
        _averaged_rings(_source_light(parameters, rings.square, *lens_scales), rings)
        + parameters["background"]
    )
    # variance in e-^2: shot noise, read noise and rounding
    pixel_variance = ring_mean.clamp_min(0) + read_noise**2 + 1 / (12 * gain**2)
    variance = (
        pixel_variance / rings.pixels
        + (parameters["scatter"] * (ring_mean - parameters["background"])).square()
    )
    residuals = (rings.mean - ring_mean) / variance.sqrt()
    cut_signal = (
        _source_light(parameters, rings.cut_square, *lens_scales) + parameters["background"]
    )
    # logarithm of the probability that a ring whose every pixel is cut lies above the cut
    log_above = log_ndtr(
        (cut_signal - rings.cut)
        / (
            cut_signal
            * torch.hypot(
                parameters["scatter"], torch.tensor(_FRINGE_DEVIATION, dtype=torch.float64)
            )
        )
    )
    log_likelihood = -0.5 * (residuals.square() + variance.log()).sum(-1) + log_above.sum(-1)
    # a surface cannot scatter all light
    checked_log = log_likelihood.where(_total_scatter(parameters)[..., 0] < 1, -torch.inf)
    if not told:
        return without_details(checked_log)
    # the expected Fisher information is the sum of squared derivatives of each residual and of its
    # log width
    scaled_rows = torch.cat(torch.broadcast_tensors(residuals, 0.5 * variance.log()), -1)  # type: ignore[no-untyped-call]
    return Likelihood(
        checked_log,
        residuals.square(),
        torch.ones_like(rings.mean),
        scaled_rows,
        ring_mean,
        variance,
    )


@stray_light.check
def _(result: Likelihood, rings: Rings, **params: Any) -> list[Check]:
    if not len(result.degrees_of_freedom):
        return []
    return [Check(f"deviance {float(result.deviance.sum()):.4g} of {len(rings.mean)} rings")]


def _total_scatter(numbers: Mapping[str, Tensor]) -> Tensor:
    """Return the total integrated scatter (TIS) of the surface: the share of the light that it
    scatters.
    """
    return scattered_share(numbers["b0"], numbers["l"], numbers["s"])


def _source_light(
    numbers: dict[str, Tensor], square: Tensor, fringe: float, scale: float
) -> Tensor:
    """Return the electrons from the source in pixels at squared distances ``square`` (pixels²);
    ``fringe`` and ``scale`` are as in `share_of_light`.
    """
    light: Tensor = numbers["electrons"] * share_of_light(numbers, square, fringe, scale)
    return light


def share_of_light(
    numbers: Mapping[str, Tensor], square: Tensor, fringe: float, scale: float
) -> Tensor:
    """Return the share of the source's light, diffracted and scattered, in a pixel at squared
    distance ``square`` (pixels²) from the source.

    ``fringe`` is wavelength times f-number in pixels, and ``scale`` the direction cosine that one
    pixel spans.
    """
    b0, l, s = (numbers[name] for name in ("b0", "l", "s"))  # noqa: E741
    veil = on_far_pixels(lobe(b0, l, s, torch.tensor(scale, dtype=torch.float64)), square)
    return (1 - _total_scatter(numbers).clamp_max(1)) * numbers["core"] * diffraction_wing(
        square, fringe
    ) + veil


def diffraction_wing(square: Tensor, fringe: float) -> Tensor:
    """Return the share of the light per pixel in the diffraction wing of a round aperture, averaged
    over the fringes and over the pixel.
    """
    # second factor: average over the pixel, 1 + Laplacian of r^-3 over (24 r^-3)
    return fringe / (math.pi**3 * square**1.5) * (1 + 9 / (24 * square))


def _averaged_rings(parts: Tensor, rings: Rings) -> Tensor:
    """Return the mean of ``parts`` (..., part) over each ring, (..., ring), weighted by numbers of
    pixels.
    """
    share = (
        rings.weight
        / torch.zeros_like(rings.mean).index_add(0, rings.ring, rings.weight)[rings.ring]
    )
    return parts.new_zeros(*parts.shape[:-1], len(rings.mean)).index_add(
        -1, rings.ring, parts * share
    )


def guess_scatter(
    rings: Rings, believed: Mapping[str, float], params: Mapping[str, Any]
) -> dict[str, float]:
    """Return start values of b0, l and s: the best fit to the rings over a grid of l and s, with b0
    and background by linear least squares.

    The fitted background is not returned. Fits that scatter all light or more are excluded.

    Shapes: rings; numbers by name, with the names of ``believed``; ``params`` are those of
            `stray_light`.
    Units:  those of `stray_light`.
    Error:  a start for a search, not an estimate.
    Source: linear least squares.
    """
    cosine_of_pixel, best_values, least_misfit = (
        params["pixel_pitch"] / params["focal_length"],
        dict(believed),
        math.inf,
    )
    # inverse standard error of the mean of each ring, rounding taken as 1 DN
    weight = (
        rings.pixels
        / (rings.mean.clamp_min(0) + params["read_noise"] ** 2 + 1 / params["gain"] ** 2)
    ).sqrt()
    fringe = (
        params["wavelength"] * params["focal_length"] / (params["diameter"] * params["pixel_pitch"])
    )
    wing = diffraction_wing(rings.square, fringe)
    for l in (believed["l"] * 3.0**n for n in range(-4, 5)):  # noqa: E741
        for s in (believed["s"] + 0.35 * n for n in range(-4, 5)):
            unit_lobe = lobe(
                *(torch.tensor(x, dtype=torch.float64) for x in (1.0, l, s, cosine_of_pixel))
            )
            design = torch.stack(
                [
                    _averaged_rings(on_far_pixels(unit_lobe, rings.square), rings),
                    torch.ones_like(rings.mean),
                ],
                1,
            )
            design[:, 0] *= believed["electrons"]
            scattered = rings.mean - believed["electrons"] * believed["core"] * _averaged_rings(
                wing, rings
            )
            # b0 and background enter linearly: weighted linear least squares for each l and s
            solution = torch.linalg.lstsq(
                design * weight[:, None], (scattered * weight)[:, None]
            ).solution[:, 0]
            misfit = float(((design @ solution - scattered) * weight).square().sum())
            scattered_light = float(solution[0]) * float(
                scattered_share(*(torch.tensor(x, dtype=torch.float64) for x in (1.0, l, s)))
            )
            if misfit < least_misfit and 0 < scattered_light < 1:
                least_misfit, best_values = (
                    misfit,
                    best_values | {"b0": float(solution[0]), "l": l, "s": s},
                )
    return best_values


# --- prior and coordinates ------------------------------------------------------------------------

_WIDE_FACTOR = 30.0  #: factor on l between a fit and the lobes that are compared with it
#: a narrower lobe is compared only if it scatters less than this share of the light
_LARGEST_SCATTER = 0.3
_LINEAR_NAMES = frozenset({"s", "background"})


@node()
def stray_prior(
    *,
    b0: tuple[Positive, Factor] | None = None,
    l: tuple[Positive, Factor] | None = None,  # noqa: E741 (the symbol of the literature)
    s: tuple[Real, Positive] | None = None,
    electrons: tuple[Electrons, Factor] | None = None,
    background: tuple[Real, Positive] | None = None,
    core: tuple[Positive, Factor] | None = None,
    scatter: tuple[Positive, Factor] | None = None,
) -> Prior:
    """Collect the priors of the scatter of a lens and of the source; a parameter without a prior is
    held fixed.

    A prior is a median and a factor: [0.4, 10] means a tenth to ten times the median with a
    probability of two thirds. The priors of ``s`` and ``background`` are a mean and a standard
    deviation.

    Shapes: -> (7,).
    Units:  those of `stray_light`.
    Error:  exact.
    Raises: ValueError where no parameter is free, or where a median or width is not positive.
    Source: log-normal and normal distributions.
    """
    return prior_of_pairs(
        dict(zip(SCATTER_NAMES, (b0, l, s, electrons, background, core, scatter), strict=True)),
        _LINEAR_NAMES,
    )


#: the parameters of `stray_light` that may be free
SCATTER_NAMES = tuple(inspect.signature(stray_prior.fn).parameters)


@stray_prior.check
def _(result: Prior, **params: object) -> list[Check]:
    free = free_names(SCATTER_NAMES, result)
    return [Check(f"{len(free)} free: {', '.join(free)}")]


class Sight(NamedTuple):
    """The range of distances that a frame covers: radii of the first and the last ring, with the
    scales of diffraction and angle in pixels.
    """

    inner: float  #: pixels from the source
    outer: float  #: pixels from the source
    fringe: float  #: wavelength times f-number, in pixels
    scale: float  #: direction cosine that one pixel spans

    @classmethod
    def of(cls, rings: Rings, lens: Mapping[str, Any]) -> Sight:
        """Return the range that the rings of a frame cover; ``lens`` holds parameters of
        `stray_light`.
        """
        fringe = (
            lens["wavelength"] * lens["focal_length"] / (lens["diameter"] * lens["pixel_pitch"])
        )
        inner, outer = (
            float(rings.square[rings.ring == ring].mean()) ** 0.5
            for ring in (0, len(rings.mean) - 1)
        )
        return cls(inner, outer, fringe, lens["pixel_pitch"] / lens["focal_length"])


@dataclass(frozen=True)
class ScatterCoordinates(Free):
    """Sampler coordinates of the scatter of a lens, chosen so that quantities that a frame
    determines are separate from those that it does not.

    If b0, l and s are free, their coordinates are ln l, the logarithm of the BSDF at a distance
    between the first and the last ring, and the logarithm of minus the slope d ln BSDF / d ln beta
    there. Rings determine the last two, whatever l is. The coordinate of the electrons is the
    logarithm of the source's signal in the first ring, and that of the background the total signal
    in the last ring; without a ``sight`` they are the logarithm of the electrons, and the
    background. The coordinates of other parameters are logarithms.
    """

    every: ClassVar[tuple[str, ...]] = SCATTER_NAMES
    linear: ClassVar[frozenset[str]] = _LINEAR_NAMES
    bent: ClassVar[bool] = True
    sight: Sight | None = None

    def seen_by(self, rings: Rings, lens: Mapping[str, Any]) -> ScatterCoordinates:
        """Return the coordinates for the rings of a frame; ``lens`` holds parameters of
        `stray_light`.
        """
        return replace(self, sight=Sight.of(rings, lens))

    @property
    def labels(self) -> tuple[str, ...]:
        """Return a readable name of each sampler coordinate."""
        label_of = {"b0": "ln BSDF", "s": "ln slope"} if self._joint else {}
        label_of |= {"electrons": "ln first ring", "background": "last ring"} if self.sight else {}
        return tuple(
            label_of.get(name, ("" if name in self.linear else "ln ") + name) for name in self.names
        )

    def place(self, parameters: Mapping[str, float | Tensor]) -> Tensor:
        """Convert parameters of the scatter to sampler coordinates (..., free parameter)."""
        values = {
            name: torch.as_tensor(parameters[name], dtype=torch.float64) for name in self.names
        }
        columns = dict(zip(self.names, self.scaled(values).unbind(-1), strict=True))
        if self._joint:
            squared_ratio = self._squared_ratio(columns["l"])
            # ln BSDF = ln b0 + s/2 ln(1 + q), with q = (beta / l)^2 between the rings
            columns["b0"] = columns["b0"] + values["s"] / 2 * torch.log1p(squared_ratio)
            # the slope of ln BSDF over ln beta is s q / (1 + q)
            columns["s"] = (-values["s"]).log() + torch.log(squared_ratio / (1 + squared_ratio))
        if self.sight:
            share_in_first, share_in_last = self._shares(self.sight, values)
            if "background" in columns:
                columns["background"] = (
                    columns["background"] + self._value_of("electrons", values) * share_in_last
                )
            if "electrons" in columns:
                columns["electrons"] = columns["electrons"] + share_in_first.log()
        return torch.stack(torch.broadcast_tensors(*(columns[name] for name in self.names)), -1)  # type: ignore[no-untyped-call]

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        """Convert sampler coordinates (..., free parameter) to parameters of the scatter."""
        columns = dict(zip(self.names, place.unbind(-1), strict=True))
        if self._joint:
            squared_ratio = self._squared_ratio(columns["l"])
            # the inverse of `place`
            columns["s"] = -columns["s"].exp() * (1 + squared_ratio) / squared_ratio
            columns["b0"] = columns["b0"] - columns["s"] / 2 * torch.log1p(squared_ratio)
        values = {name: x if name in self.linear else x.exp() for name, x in columns.items()}
        if self.sight:
            share_in_first, share_in_last = self._shares(self.sight, values)
            if "electrons" in values:
                values["electrons"] = values["electrons"] / share_in_first
            if "background" in values:
                values["background"] = (
                    values["background"] - self._value_of("electrons", values) * share_in_last
                )
        return values

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the log prior density per unit of the sampler coordinates, up to a constant.

        The coordinates of electrons and background are shifted by functions of the other
        parameters, whose Jacobian is 1; the Jacobian of the coordinate of s is -s.
        """
        log_density = -0.5 * self.whitened(parameters).square().sum(-1)
        return log_density + (-parameters["s"]).log() if self._joint else log_density

    @property
    def _joint(self) -> bool:
        """Return True if b0, l and s are all free, so that their coordinates are the joint ones."""
        return {"b0", "l", "s"} <= set(self.names)

    def _value_of(self, name: str, values: Mapping[str, Tensor]) -> Tensor:
        """Return the value of a parameter, free or fixed."""
        return (
            values[name] if name in values else torch.tensor(self.held[name], dtype=torch.float64)
        )

    def _shares(self, sight: Sight, values: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the shares of the source's light in a pixel of the first and of the last ring."""
        parameters = {
            name: self._value_of(name, values)[..., None] for name in ("b0", "l", "s", "core")
        }
        squared_radii = torch.tensor([sight.inner**2, sight.outer**2], dtype=torch.float64)
        share_in_first, share_in_last = share_of_light(
            parameters, squared_radii, sight.fringe, sight.scale
        ).unbind(-1)
        return share_in_first, share_in_last

    def _squared_ratio(self, log_l: Tensor) -> Tensor:
        """Return (beta / l)**2, with beta the direction cosine between the first and the last ring,
        or without a ``sight`` the prior median of l.
        """
        if self.sight:
            # direction cosine at the geometric mean of the radii of the first and the last ring
            log_cosine = math.log(self.sight.scale) + 0.5 * math.log(
                self.sight.inner * self.sight.outer
            )
            return (2 * (log_cosine - log_l)).exp()
        return (2 * (self.prior.centre[SCATTER_NAMES.index("l")] - log_l)).exp()

    def ridges(self, place: Tensor) -> list[Ridge]:
        """Return two alternatives that the data may not distinguish: a much wider lobe with the
        same b0, and a much narrower lobe with the same b0 l**(-s).

        At angles far above l the BSDF depends only on b0 l**(-s), and far below l only on b0. The
        core keeps its brightness.
        """
        if not {"b0", "l"} <= set(self.names):
            return []
        lobe_values = {
            **{name: torch.tensor(x) for name, x in self.held.items()},
            **self.parameters(place),
        }
        l, s = lobe_values["l"], lobe_values["s"]  # noqa: E741
        ridges = [
            Ridge(
                self._moved(lobe_values, 1.0, _WIDE_FACTOR),
                {"l": "lower"},
                "l: only a lower limit, beyond the frame",
            )
        ]
        # the narrowest lobe that scatters less than `_LARGEST_SCATTER`
        for factor in (_WIDE_FACTOR, 10.0, 3.0):
            peak_factor = float(factor ** -float(s))
            if (
                float(scattered_share(lobe_values["b0"] * peak_factor, l / factor, s))
                < _LARGEST_SCATTER
            ):
                text = "b0 and l only as b0 l^(-s): l lies within the saturated pixels"
                narrow_lobe = self._moved(lobe_values, peak_factor, 1 / factor)
                return [*ridges, Ridge(narrow_lobe, {"l": "upper", "b0": "lower"}, text)]
        return ridges

    def _moved(self, lobe_values: Mapping[str, Tensor], peak: float, width: float) -> Tensor:
        """Return the coordinates with b0 times ``peak`` and l times ``width``; a free ``core``, or
        else free ``electrons``, are scaled so that the core keeps its brightness.
        """
        b0, l, s = lobe_values["b0"] * peak, lobe_values["l"] * width, lobe_values["s"]  # noqa: E741
        core, electrons = lobe_values["core"], lobe_values["electrons"]
        unscattered_before, unscattered_after = (
            1 - scattered_share(*x) for x in ((lobe_values["b0"], lobe_values["l"], s), (b0, l, s))
        )
        core_factor = unscattered_before / unscattered_after.clamp_min(1 - _LARGEST_SCATTER)
        if "core" in self.names:
            core = core * core_factor
        elif "electrons" in self.names:
            b0, electrons = b0 / core_factor, electrons * core_factor
        return self.place({**lobe_values, "b0": b0, "l": l, "core": core, "electrons": electrons})
