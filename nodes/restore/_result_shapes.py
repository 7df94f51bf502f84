"""Shapes of the results of the restoring nodes, and memory and operations of the slow ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.own_modules import Architecture
from neusee.nodes.restore._electrons_and_colour import (
    clipped,
    colour,
    colour_matrix,
    electrons,
    white_level,
)
from neusee.nodes.restore._measured_psf import measured_psf
from neusee.nodes.restore._point_frames import points_in
from neusee.nodes.restore._wiener_by_field import spread_by_field, wiener_by_field
from neusee.nodes.restore.inverse._conjugate_gradients import LOWEST, MODES, SHARE
from neusee.nodes.restore.inverse._glare import nearby_glare
from neusee.nodes.restore.inverse._hidden_pixels import MOST, STEPS
from neusee.nodes.restore.inverse._masked_blur import bordered, halvings, torus
from neusee.nodes.restore.inverse._posterior_spread import wiener_spread
from neusee.nodes.restore.inverse._richardson_lucy import richardson_lucy
from neusee.nodes.restore.inverse._wiener import (
    MAPS,
    MAPS_OF_CHANNEL,
    PRECISE,
    filter_facts,
    wiener,
    wiener_problem,
)
from neusee.nodes.restore.lasers._find_lasers import find_lasers, found_glare, found_nearby
from neusee.nodes.restore.networks._convolutional_networks import nafnet, unet
from neusee.nodes.restore.networks._fft_mamba import fft_mamba
from neusee.nodes.restore.networks._network_files import network
from neusee.nodes.restore.networks._own_network import tried
from neusee.nodes.restore.networks._wiener_networks import informed, unrolled
from neusee.nodes.shape_rules import (
    at_least_single,
    blank,
    double,
    like_first,
    transform_operations,
)
from neusee.nodes.values import (
    Bands,
    FilterFacts,
    FoundLasers,
    MeasuredPsf,
    Psf,
    Pupil,
    WienerProblem,
)

# --- result shapes --------------------------------------------------------------------------------

# Shapes of the results of the restoring nodes, and memory and operations of the deconvolution and
# of the networks. "Operations" are those of the transforms: other work is converted to the number
# of operations of a transform that takes the same time.


_SYSTEM_BYTES = (
    35.0  #: bytes for each element of a dense system: the matrix, its factors and copies
)
#: operations per n^3 for the inversion of a matrix of side n
_INVERTED = 0.30
#: side of the dense system that needs as much memory as the inversion of a matrix, per side of it
_WHITENED = 0.94
#: operations for each element of a covariance matrix
_FILLED = 790.0
#: time of one band of a PSF, in transforms of the size of pupil and window together
_FOCUS = 2.0
#: bytes for each pixel of each ``nearby`` pattern of the glare: its scaled and weighted copies
_MODE_BYTES = 24.0
#: bytes for each pixel of a frame in which lasers are sought: patterns, and derivatives of a fit
_SEARCH_BYTES = 150.0
_LINES_TRIED = 61  #: number of spectral lines that a search tries, each with five transforms
#: bytes of the usual memory of a node that correspond to a byte of a network's intermediate results
_KEPT = 1 / 8
_LAYER = 1e-3  #: operations for each operation of a layer of a network

for node in (
    electrons,
    wiener,
    wiener_by_field,
    richardson_lucy,
    fft_mamba,
    informed,
    nafnet,
    network,
    unet,
    unrolled,
):
    node.shape(like_first)


@clipped.shape
def _(raw: Tensor, **params: Any) -> Tensor:
    return blank(*raw.shape, dtype=torch.bool)


@colour.shape
def _(channels: Tensor, matrix: Tensor, **params: Any) -> Tensor:
    return blank(*channels.shape[:-3], 3, *channels.shape[-2:], dtype=at_least_single(channels))


@colour_matrix.shape
def _(bands: Any, illuminant: Any, responses: Tensor, *inputs: Any, **params: Any) -> Tensor:
    return double(3, len(responses))


@nearby_glare.shape
def _(glare: Tensor, *inputs: Any, patterns: int = 12, **params: Any) -> Tensor:
    return blank(patterns, *glare.shape, dtype=at_least_single(glare))


@nearby_glare.work
def _(
    result: Tensor, glare: Tensor, pupil: Pupil, *others: Any, **params: Any
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    # the transform of a PSF has the size of pupil and window together
    y, x = (n + k for n, k in zip(glare.shape[-2:], pupil.height.shape, strict=True))
    psf_count = (len(result) + 1) * len(pupil.wavelengths)
    return 16.0 * (pupil.height.numel() + y * x), _FOCUS * psf_count * transform_operations(y, x)


@find_lasers.shape
def _(electrons: Tensor, *inputs: Any, most: int = 3, **params: Any) -> FoundLasers:
    channels = len(electrons)
    # in the order of the fields of `FoundLasers`
    shapes = ((2,), (), (), (channels,), (2, 2), (2,), (channels, 2))
    values = [double(most, *shape) for shape in shapes]
    identifiable, correlation = (
        blank(most, 2, dtype=torch.bool),
        double(most, 3 + channels, 3 + channels),
    )
    (
        directions,
        wavelengths,
        widths,
        strengths,
        direction_intervals,
        wavelength_intervals,
        strength_intervals,
    ) = values
    number, gain = blank(dtype=torch.int64), double(most, 2)
    straight = (double(most, channels), double(most, channels))
    return FoundLasers(
        number,
        directions,
        wavelengths,
        widths,
        strengths,
        direction_intervals,
        wavelength_intervals,
        strength_intervals,
        identifiable,
        gain,
        correlation,
        *straight,
    )


@find_lasers.work
def _(result: FoundLasers, electrons: Tensor, *others: Any, **params: Any) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    y, x = electrons.shape[-2:]
    # one search for each laser, and a last one that finds none
    rounds = 1 + len(result.direction)
    # five transforms for each line in each round
    return _SEARCH_BYTES * y * x, 5.0 * _LINES_TRIED * rounds * transform_operations(2 * y, 2 * x)


@found_glare.shape
def _(found: Any, pupil: Any, electrons: Tensor, **params: Any) -> Tensor:
    return blank(*electrons.shape, dtype=at_least_single(electrons))


@found_nearby.shape
def _(found: Any, pupil: Any, electrons: Tensor, *, patterns: int = 12, **params: Any) -> Tensor:
    return blank(patterns, *electrons.shape, dtype=at_least_single(electrons))


def _summed(
    result: Tensor, lasers: Any, pupil: Pupil, electrons: Tensor, **params: Any
) -> tuple[float, float]:
    """Return peak memory in bytes, and operations, of the far field of the pupil, computed as two
    matrix products, one for each axis.
    """
    pupil_side, (y, x) = max(pupil.height.shape), electrons.shape[-2:]
    pattern_count = len(result) if result.ndim > electrons.ndim else 1
    return 64.0 * (pupil_side**2 + pupil_side * (y + x)), pattern_count * float(
        pupil_side * pupil_side * y + pupil_side * y * x
    )


for node in (found_glare, found_nearby):
    node.work(_summed)


@wiener.work
def _(
    result: Tensor, electrons: Tensor, psf: Psf, *others: Any, **params: Any
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    border = params.get("border", 1.0)
    y, x = _torus(electrons, psf, border)
    # the frame is halved until the coarsest grid can be solved as a dense system
    coarsest_side = max(electrons.shape[-2:]) / 2 ** halvings(
        (electrons.shape[-2], electrons.shape[-1])
    )
    unknowns = len(electrons) * coarsest_side**2
    step_operations, lowest_side = _descent(electrons, psf, border)
    operations = step_operations + _FILLED * unknowns**2
    largest_system = max(unknowns, _WHITENED * lowest_side)
    nearby_memory = (
        _MODE_BYTES
        * sum(
            # `others`: illuminant, responses, bands, clipped, glare, then `nearby` at index 5
            len(patterns_drawn)
            for patterns_drawn in (others[5] if len(others) > 5 else None) or ()
        )
        * electrons.numel()
    )
    # 31 bytes for each pixel of the transforms, or the bytes of the dense system if more
    return max(
        31.0 * len(electrons) * y * x, _SYSTEM_BYTES * largest_system**2
    ) + nearby_memory, operations


@wiener_spread.shape
def _(
    electrons: Tensor,
    psf: Any,
    illuminant: Any,
    responses: Any,
    bands: Any,
    clipped: Any,
    matrix: Tensor,
    *glare: Any,
    **params: Any,
) -> Tensor:
    return blank(len(matrix), *electrons.shape[-2:], dtype=at_least_single(electrons))


@spread_by_field.shape
def _(
    electrons: Tensor, measured: Any, clipped: Any, matrix: Tensor, *others: Any, **params: Any
) -> Tensor:
    return blank(len(matrix), *electrons.shape[-2:], dtype=at_least_single(electrons))


@wiener_spread.work
def _(
    result: Tensor, electrons: Tensor, psf: Psf, *others: Any, draws: int = 8, **params: Any
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    inputs_of_filter = (*others[:4], *others[5:])  # without the matrix
    memory, operations = wiener.hooks.work(result, electrons, psf, *inputs_of_filter, **params)  # type: ignore[misc]
    # draws and details need half as much memory again; each draw is one deconvolution
    return 1.5 * memory, draws * operations


@wiener_problem.shape
def _(
    electrons: Tensor,
    psf: Psf,
    illuminant: Any,
    responses: Any,
    bands: Any,
    clipped: Any,
    glare: Any = None,
    nearby: Any = None,
    ghosts: Any = None,
    **params: Any,
) -> WienerProblem:
    kind = torch.float64 if max(electrons.shape[-2:]) <= PRECISE else at_least_single(electrons)
    mode_count = sum(len(other) for other in nearby or ())
    count, frame, by_channel = len(electrons), tuple(electrons.shape), (len(electrons), 1, 1)
    kernels = (count, *psf.intensity.shape[-2:])
    patterns = [(number, *frame) for number in (len(glare or ()) + len(ghosts or ()), mode_count)]
    # in the order of the fields of `WienerProblem`
    shapes = (frame, frame, kernels, *patterns, frame, frame, by_channel, by_channel)
    return WienerProblem._make(blank(*shape, dtype=kind) for shape in shapes)


@wiener_problem.work
def _(result: WienerProblem, *inputs: Any, **params: Any) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    work: tuple[float, float] = wiener.hooks.work(result.picture, *inputs)  # type: ignore[misc]
    return work


@filter_facts.shape
def _(electrons: Tensor, *inputs: Any, **params: Any) -> FilterFacts:
    kind = torch.float64 if max(electrons.shape[-2:]) <= PRECISE else at_least_single(electrons)
    frame, by_channel = tuple(electrons.shape), (len(electrons), 1, 1)
    # `MAPS` is the number of maps for three channels: each further channel adds `MAPS_OF_CHANNEL`
    maps = (MAPS + MAPS_OF_CHANNEL * (len(electrons) - 3), *frame[1:])
    return FilterFacts._make(
        blank(*shape, dtype=kind) for shape in (frame, frame, maps, by_channel, by_channel)
    )


@filter_facts.work
def _(result: FilterFacts, *inputs: Any, **params: Any) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    work: tuple[float, float] = wiener.hooks.work(result.answer, *inputs)  # type: ignore[misc]
    return work


@informed.work
def _(
    result: Tensor, electrons: Tensor, psf: Psf, *others: Any, width: int = 16, **params: Any
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    memory, operations = wiener.hooks.work(result, electrons, psf, *others)  # type: ignore[misc]
    # bytes and operations of the network behind the filter
    of_layers, layers = _layers(result, width=width)
    return memory + of_layers, operations + layers


@unrolled.work
def _(
    result: Tensor,
    electrons: Tensor,
    psf: Psf,
    *others: Any,
    width: int = 16,
    steps: int = 2,
    **params: Any,
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    memory, operations = wiener.hooks.work(result, electrons, psf, *others)  # type: ignore[misc]
    # bytes and operations of one network
    of_layers, layers = _layers(result, width=width)
    # one deconvolution for the start and one for each step; each step has its own layers
    return memory + of_layers, (1 + steps) * operations + steps * layers


@white_level.shape
def _(signal: Any, clipped: Any, psf: Any, bands: Bands, *others: Any, **params: Any) -> Tensor:
    return double(len(bands.centres))


def _descent(electrons: Tensor, psf: Psf, border: float) -> tuple[float, float]:
    """Return the operations of the conjugate gradient steps on all grids but the coarsest, and the
    side of the largest matrix of their preconditioners.
    """
    channels, *picture = electrons.shape
    psf_radii = [
        min(k // 2, max(256, n // 2), n)
        for n, k in zip(picture, psf.intensity.shape[-2:], strict=True)
    ]
    size = torus((picture[0], picture[1]), bordered((psf_radii[0], psf_radii[1]), border))
    operations, largest, steps = 0.0, 0.0, STEPS
    for level in range(halvings((picture[0], picture[1]))):
        y, x = (n >> level for n in size)
        operations += steps * channels * transform_operations(y, x)
        if max(picture) / 2**level <= LOWEST:
            unknowns = float(min(channels * MODES, 3 * MODES, channels * y * x / SHARE))
            operations, largest = operations + _INVERTED * unknowns**3, max(largest, unknowns)
        steps = min(4 * steps, MOST)
    return operations, largest


@richardson_lucy.work
def _(
    result: Tensor, electrons: Tensor, psf: Psf, *others: Any, iterations: int = 40, **params: Any
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    y, x = _torus(electrons, psf)
    # four transforms of each channel in each iteration
    return 4.0 * len(electrons) * y * x, 4.0 * (iterations + 1) * len(
        electrons
    ) * transform_operations(y, x)


def _torus(picture: Tensor, psf: Psf, border: float = 1.0) -> tuple[int, int]:
    """Return the size (y, x) of the transforms for the deconvolution of a picture: its own size
    plus a border as wide as ``border`` times the PSF.
    """
    sides = zip(picture.shape[-2:], psf.intensity.shape[-2:], strict=True)
    y, x = (n + math.ceil(border * min(k, 2 * n)) for n, k in sides)
    return y, x


def _layers(result: Tensor, *inputs: Any, width: int = 32, **params: Any) -> tuple[float, float]:
    """Return peak memory in bytes, and operations, of a network whose layers have ``width``
    channels.
    """
    pixels = float(result[0].numel())
    return 4.0 * width * pixels, width**2 * pixels


for node in (fft_mamba, nafnet, unet):
    node.work(_layers)


@network.work
def _(
    result: Tensor,
    picture: Tensor,
    *,
    architecture: Architecture | None = None,
    parameters: dict[str, Any] | None = None,
    multiple: int | None = None,
    tile: int | None = None,
    reduce: int = 1,
    **params: Any,
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    if architecture is None:
        return _layers(result)
    # memory and operations per pixel were measured in a call on a small picture
    trial, pixels = tried(architecture, parameters, multiple), result[0].numel() / reduce**2
    return _KEPT * trial.memory * min(
        pixels, tile**2 if tile else math.inf
    ), _LAYER * trial.operations * pixels


# --- result shapes --------------------------------------------------------------------------------

# The shape of a measured PSF, and memory and operations of measuring it and of restoring with it.


_FIT_STEPS = (
    6  #: usual number of Gauss-Newton steps of a fit, each with as many operations as a draw
)
#: bytes for each pixel of each window: images of the points, their derivatives, arrays of a step
_HELD = 80.0
_POINTS_BYTES = 40.0  #: bytes for each pixel of a frame while it is searched for points


@measured_psf.shape
def _(
    responses: Tensor,
    *,
    files: Sequence[Path],
    window: Sequence[int],
    zones: Sequence[int],
    draws: int = 24,
    gain: float,
    offset: float,
    full_well: float,
    read_noise: float,
    bits: int = 16,
    **params: Any,
) -> MeasuredPsf:
    channels, (y, x), (rows, columns) = len(responses), window, zones
    kernels = rows, columns, channels, y, x
    points = points_in(files, (y, x), (gain, offset, full_well, bits, read_noise))
    per_zone = [double(rows, columns) for _ in range(2)]
    # in the order of the fields of `MeasuredPsf`
    return MeasuredPsf(
        double(*kernels),
        double(*kernels),
        blank(draws, *kernels),
        double(points, 4),
        double(channels),
        double(channels),
        *per_zone,
    )


@measured_psf.work
def _(
    result: MeasuredPsf,
    *inputs: Any,
    files: Sequence[Path] = (),
    shape: Sequence[int],
    **params: Any,
) -> tuple[float, float]:
    """Return the bytes of the windows and of a frame, and the operations of the shift matrices in
    all fits and draws.

    The number of steps grows with the number of nodes: a point between nodes depends on several
    PSFs at once, so that the iteration converges more slowly.
    """
    rows, columns, channels, y, x = result.kernels.shape
    windows = float(len(result.places) * channels * y * x)
    pixels = float(channels * math.prod(shape))
    steps = rows * columns * (_FIT_STEPS + len(result.draws))
    return _HELD * windows + _POINTS_BYTES * pixels, steps * windows * (y + x) + len(files) * pixels


@wiener_by_field.work
def _(
    result: Tensor,
    electrons: Tensor,
    measured: MeasuredPsf,
    clipped: Any = None,
    glare: Any = None,
    nearby: Sequence[Tensor] | None = None,
    **params: Any,
) -> tuple[float, float]:
    """Return the memory of the filter for the largest part of the frame, and its operations for all
    parts.
    """
    rows, columns = (
        _sides(n, count, size)
        for n, count, size in zip(
            electrons.shape[-2:],
            measured.kernels.shape[:2],
            measured.kernels.shape[-2:],
            strict=True,
        )
    )
    psf, memory, operations = Psf(measured.kernels[0, 0], measured.fit), 0.0, 0.0
    for y in rows:
        for x in columns:
            part_frame = blank(len(electrons), y, x)
            doubts = [
                blank(len(patterns_drawn), *part_frame.shape) for patterns_drawn in nearby or ()
            ]
            part_memory, part_operations = wiener.hooks.work(
                part_frame, part_frame, psf, None, None, None, None, None, doubts
            )  # type: ignore[misc]
            memory, operations = max(memory, part_memory), operations + part_operations
    return memory, operations


@spread_by_field.work
def _(
    result: Tensor,
    electrons: Tensor,
    measured: MeasuredPsf,
    clipped: Any,
    matrix: Any,
    *others: Any,
    draws: int = 8,
    **params: Any,
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    memory, operations = wiener_by_field.hooks.work(  # type: ignore[misc]
        result, electrons, measured, clipped, *others[:2]
    )
    return memory, draws * operations


def _sides(size: int, count: int, window: int) -> list[int]:
    """Return for each of ``count`` nodes the largest number of pixels that its part of the frame
    has along one axis.
    """
    if count == 1:
        return [size]
    end_side = math.ceil(1.5 * size / count) + window // 2
    inner_side = math.ceil(2.0 * size / count) + 2 * (window // 2)
    return [min(side, size) for side in (end_side, *[inner_side] * (count - 2), end_side)]
