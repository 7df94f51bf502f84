"""Round grains and scratches on glass, drawn with their correct area at any sampling of the pupil."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics._pupil_grid import PupilGrid


class Grain(NamedTuple):
    """A round grain; position (from the centre) and radius are in diameters of the stop."""

    v: float
    u: float
    radius: float
    opacity: float  #: opacity for the field; 1 is black


class Scratch(NamedTuple):
    """A scratched line through points; positions (from the centre) and width are in diameters of the stop."""

    points: Sequence[tuple[float, float]]  #: (v, u)
    width: float
    opacity: float


def stamp(amplitude: Tensor, marks: Sequence[Grain | Scratch], grid: PupilGrid) -> Tensor:
    """Darken the pupil amplitude (v, u) in place by each grain and scratch, and return the amplitude."""
    scale, middle = grid.diameter / grid.pitch, (grid.samples - 1) / 2
    for mark in marks:
        points = [(mark.v, mark.u)] if isinstance(mark, Grain) else list(mark.points)
        places = [(v * scale + middle, u * scale + middle) for v, u in points]
        size = scale * (2 * mark.radius if isinstance(mark, Grain) else mark.width)
        _darken(amplitude, places, size, mark.opacity)
    return amplitude


def _darken(amplitude: Tensor, places: list[tuple[float, float]], size: float, opacity: float) -> None:
    window = _window(places, size / 2 + 1, amplitude.shape[-1])
    if window is None:
        return
    rows, columns = window
    y = torch.arange(rows.start, rows.stop, dtype=torch.float32, device=amplitude.device)[:, None]
    x = torch.arange(columns.start, columns.stop, dtype=torch.float32, device=amplitude.device)[None, :]
    cover = amplitude.new_zeros(len(y), x.shape[1])
    for start, end in zip(places, places[1:] or places, strict=False):
        near = _window([start, end], size / 2 + 1, amplitude.shape[-1])
        if near is None:
            continue
        v, u = (slice(n.start - w.start, n.stop - w.start) for n, w in zip(near, window, strict=True))
        new = _cover(_distance(y[v], x[:, u], start, end), size, len(places) == 1)
        cover[v, u] = torch.maximum(cover[v, u], new)
    amplitude[rows, columns] *= 1 - opacity * cover


def _window(places: list[tuple[float, float]], margin: float, samples: int) -> tuple[slice, slice] | None:
    """Return the rows and columns of samples that a grain or scratch can touch, or None if it is outside the grid."""
    spans = []
    for axis in (0, 1):
        low = max(int(min(place[axis] for place in places) - margin), 0)
        high = min(int(max(place[axis] for place in places) + margin) + 2, samples)
        if high <= low:
            return None
        spans.append(slice(low, high))
    return spans[0], spans[1]


def _distance(y: Tensor, x: Tensor, start: tuple[float, float], end: tuple[float, float]) -> Tensor:
    """Return the distance of each sample, in samples, from the line between two points."""
    along_y, along_x = end[0] - start[0], end[1] - start[1]
    length = along_y**2 + along_x**2
    share = ((y - start[0]) * along_y + (x - start[1]) * along_x) / length if length > 0 else torch.zeros_like(y + x)
    share = share.clamp(0, 1)
    return torch.hypot(y - start[0] - share * along_y, x - start[1] - share * along_x)


def _cover(distance: Tensor, size: float, round_: bool) -> Tensor:
    """Return the covered share of each sample under a grain or scratch ``size`` samples wide; the shares sum to the
    area.
    """
    if round_:
        square = size**2 / 4
        edge = math.sqrt(max(square - 1 / 12, 1 / 4))
        return min(3 * square, 1.0) * (edge + 0.5 - distance).clamp(0, 1)
    return ((size + 1) / 2 - distance).clamp(0, min(size, 1.0))
