"""Frames of point sources, read from files: where the points are, and the pixels in the windows around them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from neusee.nodes import ParameterError
from neusee.nodes.input_files import once_per_version
from neusee.nodes.metrics._saturated_pixels import clipped
from neusee.nodes.sensor._frame_file import Curve, frame_problem, read_frame

_SIGNIFICANT = 8.0  #: standard deviations by which a point stands out of the noise
_FAINTEST = 0.03  #: of the brightest point of the frame: what is fainter is a lobe or a reflection
_RIM = 3  #: pixels from the edge of the frame within which a point is not used
_MOST = 400  #: points of a frame
_AROUND = 500  #: pixels beyond all windows that a frame must have, because they give its background
_OUTLIER = 4.0  #: standard deviations beyond which a pixel does not count for the background
_DARK = "dark"  #: beginning of the name of a file without light
Camera = tuple[float, float, float, int, float]  #: gain, offset, full well, bits, read noise


class Seen(NamedTuple):
    """The pixels in the windows of all points, and what is known of each frame."""

    light: Tensor  #: (channel, pixel) float64, e-
    clipped: Tensor  #: (channel, pixel) bool
    frame: Tensor  #: (pixel,) int64, the frame of each pixel
    pixels: Tensor  #: (point, y * x) int64, pixel of each place in a window; their number where there is none
    owner: Tensor  #: (point,) int64, the frame of each point
    middle: Tensor  #: (point, 2) int64, the pixel in the middle of each window
    background: Tensor  #: (frame, channel) float64, e-, mean beyond all windows
    doubt: Tensor  #: (frame, channel) float64, e-2, variance of this mean
    floor: Tensor  #: (frame, channel) float64, e-2, variance of the noise without light of points
    level: float  #: e-, at which a pixel is clipped


def lit_and_dark(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Return the frames with points and the dark frames, whose names begin with `dark`."""
    dark = [file for file in files if file.name.lower().startswith(_DARK)]
    return [file for file in files if file not in dark], dark


def refuse_bad_frames(
    files: Sequence[Path], channels: int | None, shape: tuple[int, int], window: tuple[int, int],
    zones: tuple[int, int], camera: Camera, curve: Curve | None = None,
) -> None:  # fmt: skip
    """Raise ParameterError with the names of all frames that cannot be used, and of all zones without a point."""
    lit, dark = lit_and_dark(files)
    if not lit:
        raise ParameterError("files", "there is no frame with points: only names that begin with dark")
    problems = [p for file in [*lit, *dark] if (p := frame_problem(file, channels, shape, camera[3], curve))]
    found = {}
    if not problems:
        found = {file: _found(file, window, camera) for file in lit}
        problems = [text for file in lit if (text := _unusable(file, found[file], shape, window))]
    if problems:
        head = f"{len(problems)} of {len(files)} frames cannot be used: " if len(files) > 1 else ""
        raise ParameterError("files", head + "; ".join(problems))
    full = {_zone(p, shape, zones) for points in found.values() for p, sharp in points if sharp}
    empty = [(i + 1, j + 1) for i in range(zones[0]) for j in range(zones[1]) if (i, j) not in full]
    if empty:
        raise ParameterError("zones", _without_point(empty, zones))


def points_in(files: Sequence[Path], window: tuple[int, int], camera: Camera) -> int:
    """Return the number of points in the frames that are not dark."""
    return sum(len(_found(file, window, camera)) for file in lit_and_dark(files)[0])


def read_points(files: Sequence[Path], window: tuple[int, int], camera: Camera) -> Seen:
    """Read all frames and keep the pixels in the windows of their points; subtract the mean of the dark frames."""
    gain, offset, full_well, bits, read_noise = camera
    lit, dark = lit_and_dark(files)
    base = sum((read_frame(file).values / gain for file in dark), np.zeros(1)) / len(dark) if dark else offset
    parts, first = [], 0
    for number, file in enumerate(lit):
        raw = torch.from_numpy(np.ascontiguousarray(read_frame(file).values, dtype=np.float64))
        ends = clipped(raw, full_well=full_well, gain=gain, bits=bits)
        light = raw / gain - torch.as_tensor(base)
        places = [place for place, _ in _found(file, window, camera)]
        parts.append(_kept(light, ends, places, window, number, first))
        first += parts[-1][0].shape[-1]
    lights, cut, frames, indices, middle, owner, background, doubt, spread = zip(*parts, strict=True)
    index, ground = torch.cat(indices), torch.stack(background)
    level = min(full_well, (2.0**bits - 1) / gain) - float(np.mean(base))
    least = read_noise**2 * (1 + (1 / len(dark) if dark else 0)) + 1 / (12 * gain**2)
    floor = torch.maximum(torch.stack(spread), least + ground.clamp_min(0.0))
    return Seen(
        torch.cat(lights, 1), torch.cat(cut, 1), torch.cat(frames), torch.where(index < 0, first, index),
        torch.cat(owner), torch.cat(middle), ground, torch.stack(doubt), floor, level,
    )  # fmt: skip


def _kept(
    light: Tensor, ends: Tensor, places: list[tuple[int, int]], window: tuple[int, int], number: int, first: int
) -> tuple[Tensor, ...]:
    """Return the pixels of one frame in the windows of its points, and the background of the frame beyond them."""
    y, x = light.shape[-2:]
    middle = torch.tensor(places, dtype=torch.int64).reshape(-1, 2)
    rows = middle[:, :1] + torch.arange(window[0]) - window[0] // 2
    columns = middle[:, 1:] + torch.arange(window[1]) - window[1] // 2
    inside = ((rows >= 0) & (rows < y))[:, :, None] & ((columns >= 0) & (columns < x))[:, None]
    flat = rows.clamp(0, y - 1)[:, :, None] * x + columns.clamp(0, x - 1)[:, None]
    used = _covered((y, x), places, window).flatten()
    wide = _covered((y, x), places, (2 * window[0], 2 * window[1])).flatten()
    lit = wide if int((~wide).sum()) >= _AROUND else used
    order = used.cumsum(0) - 1 + first
    index = torch.where(inside, order[flat], -1).flatten(1)
    pairs = zip(light.flatten(1), ends.flatten(1), strict=True)
    level, doubt, spread = map(torch.stack, zip(*(_average(c[~lit & ~e]) for c, e in pairs), strict=True))
    return (
        light.flatten(1)[:, used], ends.flatten(1)[:, used], torch.full((int(used.sum()),), number), index, middle,
        torch.full((len(places),), number), level, doubt, spread,
    )  # fmt: skip


def _covered(shape: tuple[int, int], places: list[tuple[int, int]], window: tuple[int, int]) -> Tensor:
    """Return True for the pixels (y, x) in windows around places."""
    used, (down, right) = torch.zeros(shape, dtype=torch.bool), (n // 2 for n in window)
    for y, x in places:
        used[max(y - down, 0) : y + down + 1, max(x - right, 0) : x + right + 1] = True
    return used


def _average(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean without outliers, the variance of this mean, and the variance of a pixel."""
    for _ in range(4):
        mean, spread = values.mean(), values.std()
        values = values[(values - mean).abs() <= _OUTLIER * spread + 1e-12]
    return values.mean(), values.var() / len(values), values.var()


# --- points -----------------------------------------------------------------------------------------------------------


@once_per_version
def _found(file: Path, window: tuple[int, int], camera: Camera) -> list[tuple[tuple[int, int], bool]]:
    """Return the middle pixel of each point of a frame, the brightest first, and True for one that is not clipped."""
    gain, _, full_well, bits, read_noise = camera
    raw = torch.from_numpy(np.ascontiguousarray(read_frame(file).values, dtype=np.float64))
    ends = clipped(raw, full_well=full_well, gain=gain, bits=bits).any(0)
    light = (raw / gain).sum(0)
    calm = _median(light)
    ground = calm.median()
    noise = 1.4826 * float((light - light.median()).abs().median())
    noise = max(noise, read_noise * math.sqrt(len(raw)), 1e-6)
    above = calm - ground
    high = above > max(_SIGNIFICANT * noise, _FAINTEST * float(above.max()))
    top = high & (above >= max_pool2d(above[None], 7, 1, 3)[0])
    above = torch.where(top, above, 0.0)
    points = list[tuple[tuple[int, int], bool]]()
    while len(points) < _MOST and float(above.max()) > 0:
        y, x = divmod(int(above.argmax()), above.shape[1])
        near = ends[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
        points.append(((y, x), not bool(near.any())))
        above[
            max(y - window[0] // 2, 0) : y + window[0] // 2 + 1, max(x - window[1] // 2, 0) : x + window[1] // 2 + 1
        ] = 0
    inner = [p for p in points if all(_RIM <= c < n - _RIM for c, n in zip(p[0], above.shape, strict=True))]
    return inner


def _median(picture: Tensor) -> Tensor:
    """Return the median of three by three pixels, in which a single hot pixel does not show."""
    wide = pad(picture[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    return wide.unfold(0, 3, 1).unfold(1, 3, 1).flatten(-2).median(-1).values


def _unusable(
    file: Path, points: list[tuple[tuple[int, int], bool]], shape: tuple[int, int], window: tuple[int, int]
) -> str:
    """Return why a frame does not show points, or an empty text."""
    if not points:
        return (
            f"{file.name} shows no point source: nothing stands out of the noise by {_SIGNIFICANT:g} deviations "
            "(a frame without light needs a name that begins with dark)"
        )
    if (free := int((~_covered(shape, [place for place, _ in points], window)).sum())) < _AROUND:
        return (
            f"{file.name} has {free} pixels beyond the windows of its {len(points)} points, but its background needs "
            f"{_AROUND}: choose a smaller window, or fewer points a frame"
        )
    return ""


def _zone(place: tuple[int, int], shape: tuple[int, int], zones: tuple[int, int]) -> tuple[int, int]:
    row, column = (c * z // n for c, z, n in zip(place, zones, shape, strict=True))
    return row, column


def _without_point(empty: list[tuple[int, int]], zones: tuple[int, int]) -> str:
    names = ", ".join(f"({i}, {j})" for i, j in empty)
    return (
        f"{len(empty)} of {zones[0]} x {zones[1]} zones have no point with an unsaturated core, (row, column) {names}: "
        "take frames with points there, a shorter exposure, or choose fewer zones"
    )
