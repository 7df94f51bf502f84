"""Resampling of a height map with its own pitch to the grid of the pupil."""

import math
from typing import Literal

import torch
from torch import Tensor

from neusee.nodes.optics._pupil_grid import PupilGrid, inside

Between = Literal["linear", "nearest"]
_JUMP = 0.5  #: share of the range of heights by which a sample may differ from its neighbour


def resampled(height: Tensor, pitch: float, grid: PupilGrid, between: Between = "linear") -> Tensor:
    """Return a height map (y, x) with samples ``pitch`` apart on the grid of the pupil, (v, u)
    float32.

    The centre of the height map lies on the axis. Beyond the last samples, within half a pitch,
    their heights continue.
    """
    positions = [_positions(n, pitch, grid) for n in height.shape]
    if between == "nearest":
        rows, columns = (
            x.add(0.5).floor().long().clamp(0, n - 1)
            for x, n in zip(positions, height.shape, strict=True)
        )
        return height[rows][:, columns].to(torch.float32)
    return _interpolated(height, positions, cubic=False).to(torch.float32)


def resampling_error(height: Tensor, pitch: float, grid: PupilGrid) -> float:
    """Estimate the root mean square error, in m, of linear interpolation over the clear aperture.

    The estimate is the difference from cubic interpolation, whose error is of a higher order.
    """
    positions = [_positions(n, pitch, grid) for n in height.shape]
    difference = _interpolated(height, positions, cubic=True) - _interpolated(
        height, positions, cubic=False
    )
    return float(difference[inside(grid)].square().mean().sqrt())


def too_small(shape: tuple[int, ...], pitch: float, grid: PupilGrid) -> str:
    """Return a message for a height map that does not cover the clear aperture, else an empty
    text.
    """
    size = [n * pitch for n in shape]
    if min(size) >= grid.diameter * (1 - 1e-9):
        return ""
    sides = " x ".join(f"{side * 1e3:.4g}" for side in size)
    fix = f"give a larger map, or a pitch of {grid.diameter / min(shape) * 1e6:.4g} um or more"
    return (
        f"the map is {sides} mm (y x), smaller than the clear aperture of {grid.diameter * 1e3:.4g}"
        f" mm: {fix}"
    )


def jump(height: Tensor, pitch: float, grid: PupilGrid) -> str:
    """Return the place of the largest step between neighbours that linear interpolation would turn
    into a ramp.

    Only samples inside the clear aperture count. The text is empty if no step is larger than half
    of their range.
    """
    y, x = (
        (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * (2 * pitch / grid.diameter)
        for n in height.shape
    )
    clear_heights = height.double().where(y[:, None].square() + x.square() <= 1, torch.nan)
    lowest, highest = (float(end) for end in torch.aminmax(clear_heights[~clear_heights.isnan()]))
    tallest, place = 0.0, ""
    for axis, name in ((0, "row"), (1, "column")):
        steps = clear_heights.diff(dim=axis).abs().nan_to_num(0.0)
        if steps.numel() and float(steps.max()) > tallest:
            tallest = float(steps.max())
            worst_step = divmod(int(steps.argmax()), steps.shape[1])
            place = (
                f"from {name} {worst_step[axis]} to {worst_step[axis] + 1}, at"
                f" {('column', 'row')[axis]} {worst_step[1 - axis]}"
            )
    if tallest <= _JUMP * (highest - lowest):
        return ""
    return (
        f"the height jumps by {tallest * 1e6:.4g} um of {(highest - lowest) * 1e6:.4g} um {place}"
    )


def _positions(count: int, pitch: float, grid: PupilGrid) -> Tensor:
    """Return the place of each sample of the pupil along one axis, in samples of the height map,
    float64.
    """
    steps = torch.arange(grid.samples, dtype=torch.float64) - (grid.samples - 1) / 2
    return steps * (grid.pitch / pitch) + (count - 1) / 2


def _interpolated(height: Tensor, positions: list[Tensor], cubic: bool) -> Tensor:
    """Return a height map at positions along both axes, in samples of the map, float64."""
    rows, columns = (_weights(x, n, cubic) for x, n in zip(positions, height.shape, strict=True))
    return rows @ height.double() @ columns.T


def _weights(position: Tensor, count: int, cubic: bool) -> Tensor:
    """Return the matrix (position, sample) of linear interpolation, or of the cubic through four
    samples.
    """
    point_count = min(4 if cubic else 2, count)
    position = position.clamp(0, count - 1)
    first = (position.floor().long() - (point_count - 2) // 2).clamp(0, count - point_count)
    matrix = torch.zeros(len(position), count, dtype=torch.float64)
    for k in range(point_count):
        others = [j for j in range(point_count) if j != k]
        # Lagrange's polynomial of each point
        factors = [(position - (first + j)) / (k - j) for j in others]
        share = torch.stack(factors).prod(0) if factors else torch.ones_like(position)
        matrix[torch.arange(len(position)), first + k] = share
    return matrix


def coarser(pitch: float, grid: PupilGrid) -> str:
    """Return a note for a height map that is finer than the grid of the pupil, which loses its
    finest detail.
    """
    ratio = grid.pitch / pitch
    if ratio <= 1 + 1e-6:
        return ""
    fix = f"set samples to {math.ceil(grid.samples * ratio)} to keep it"
    return (
        f"the map has {ratio:.3g} samples for each sample of the pupil, so that its finest detail"
        f" is lost: {fix}"
    )
