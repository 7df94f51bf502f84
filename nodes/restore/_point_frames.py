"""Frames of point sources: reading the files, and modelling the frames as a function of the
PSF.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from neusee.nodes import ParameterError
from neusee.nodes.input_files import once_per_version
from neusee.nodes.sensor._digitization import is_clipped
from neusee.nodes.sensor._frame_file import Curve, frame_problem, read_frame

# --- point frames ---------------------------------------------------------------------------------

# Frames of point sources, read from files: where the points are, and the pixels in the windows
# around them.


_SIGNIFICANT_DEVIATIONS = 8.0  #: standard deviations by which a point stands out of the noise
#: fraction of the brightest point of the frame; a fainter peak is a side lobe or a reflection
_FAINTEST_SHARE = 0.03
_RIM_PIXELS = 3  #: pixels from the edge of the frame within which a point is not used
_MOST_POINTS = 400  #: largest number of points that are used in one frame
#: smallest number of pixels outside all windows; the background is estimated from them
_LEAST_BACKGROUND = 500
#: standard deviations from the mean, beyond which a pixel is left out of the background
_OUTLIER_DEVIATIONS = 4.0
_DARK_PREFIX = "dark"  #: the names of dark frames begin with it
Camera = tuple[float, float, float, int, float]  #: gain, offset, full well, bits, read noise


class Seen(NamedTuple):
    """The pixels in the windows of all points, and the background and noise of each frame."""

    light: Tensor  #: (channel, pixel) float64, e-
    clipped: Tensor  #: (channel, pixel) bool
    frame: Tensor  #: (pixel,) int64, the frame of each pixel
    #: (point, y * x) int64, index of the pixel at each place of a window; the number of all pixels
    #: for a place beyond the frame
    pixels: Tensor
    owner: Tensor  #: (point,) int64, the frame of each point
    middle: Tensor  #: (point, 2) int64, the pixel in the middle of each window
    background: Tensor  #: (frame, channel) float64, e-, mean of the pixels outside all windows
    doubt: Tensor  #: (frame, channel) float64, e-2, variance of this mean
    floor: Tensor  #: (frame, channel) float64, e-2, variance of a pixel without light of points
    level: float  #: e-, light at which a pixel clips


def lit_and_dark(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Return the frames with points and the dark frames, whose names begin with `dark`."""
    dark = [file for file in files if file.name.lower().startswith(_DARK_PREFIX)]
    return [file for file in files if file not in dark], dark


class Layout(NamedTuple):
    """Sizes (y, x) of the frames, of the measured PSFs, and of the grid of zones."""

    shape: tuple[int, int]  #: pixels of a frame
    window: tuple[int, int]  #: pixels of a PSF
    zones: tuple[int, int]


def refuse_bad_frames(
    files: Sequence[Path],
    channels: int | None,
    layout: Layout,
    camera: Camera,
    curve: Curve | None = None,
) -> None:
    """Raise ParameterError if frames cannot be used, or if zones have no sharp point; the message
    names all of them.
    """
    lit, dark = lit_and_dark(files)
    if not lit:
        raise ParameterError(
            "files", "there is no frame with points: only names that begin with dark"
        )
    shape, window, zones = layout
    bits = camera[3]
    _refuse_problems(
        files, [frame_problem(file, channels, shape, bits, curve) for file in [*lit, *dark]]
    )
    points = {file: _find_points(file, window, camera) for file in lit}
    _refuse_problems(files, [_unusable(file, points[file], shape, window) for file in lit])
    empty = _empty_zones(points.values(), shape, zones)
    if empty:
        raise ParameterError("zones", _without_point(empty, zones))


def _refuse_problems(files: Sequence[Path], problems: Sequence[str]) -> None:
    """Raise ParameterError with all problems that are not empty texts."""
    stated = [problem for problem in problems if problem]
    if stated:
        beginning = (
            f"{len(stated)} of {len(files)} frames cannot be used: " if len(files) > 1 else ""
        )
        raise ParameterError("files", beginning + "; ".join(stated))


def _empty_zones(
    points_by_file: Iterable[Sequence[tuple[tuple[int, int], bool]]],
    shape: tuple[int, int],
    zones: tuple[int, int],
) -> list[tuple[int, int]]:
    """Return the zones without an unclipped point, as (row, column) counted from 1."""
    zones_with_points = set()
    for points in points_by_file:
        zones_with_points |= {_zone(place, shape, zones) for place, sharp in points if sharp}
    all_zones = itertools.product(range(zones[0]), range(zones[1]))
    return [
        (row + 1, column + 1) for row, column in all_zones if (row, column) not in zones_with_points
    ]


def points_in(files: Sequence[Path], window: tuple[int, int], camera: Camera) -> int:
    """Return the number of points in the frames that are not dark."""
    return sum(len(_find_points(file, window, camera)) for file in lit_and_dark(files)[0])


def read_points(files: Sequence[Path], window: tuple[int, int], camera: Camera) -> Seen:
    """Return the pixels in the windows of the points of all frames, minus the mean dark frame.

    Without dark frames, the offset of the camera is subtracted.
    """
    gain, offset, full_well, bits, read_noise = camera
    lit, dark = lit_and_dark(files)
    dark_level = (
        sum((read_frame(file).values / gain for file in dark), np.zeros(1)) / len(dark)
        if dark
        else offset
    )
    frame_pixels, first_pixel = [], 0
    for number, file in enumerate(lit):
        raw = torch.from_numpy(np.ascontiguousarray(read_frame(file).values, dtype=np.float64))
        clipped_pixels = is_clipped(raw, full_well=full_well, gain=gain, bits=bits)
        light = raw / gain - torch.as_tensor(dark_level)
        places = [place for place, _ in _find_points(file, window, camera)]
        frame_pixels.append(
            _windows_of_points(light, clipped_pixels, places, window, number, first_pixel)
        )
        first_pixel += frame_pixels[-1][0].shape[-1]
    (
        # in the order that `_windows_of_points` returns
        light_by_frame,
        clipped_by_frame,
        frame_by_frame,
        pixels_by_frame,
        middle_by_frame,
        owner_by_frame,
        background_by_frame,
        doubt_by_frame,
        variance_by_frame,
    ) = zip(*frame_pixels, strict=True)
    pixel_index, background_level = torch.cat(pixels_by_frame), torch.stack(background_by_frame)
    level = min(full_well, (2.0**bits - 1) / gain) - float(np.mean(dark_level))
    # the mean dark frame adds its own read noise; rounding has the variance 1 / 12 DN2
    read_variance = read_noise**2 * (1 + (1 / len(dark) if dark else 0)) + 1 / (12 * gain**2)
    floor = torch.maximum(
        torch.stack(variance_by_frame), read_variance + background_level.clamp_min(0.0)
    )
    return Seen(
        torch.cat(light_by_frame, 1),
        torch.cat(clipped_by_frame, 1),
        torch.cat(frame_by_frame),
        # a place beyond the frame gets the index after the last pixel
        torch.where(pixel_index < 0, first_pixel, pixel_index),
        torch.cat(owner_by_frame),
        torch.cat(middle_by_frame),
        background_level,
        torch.stack(doubt_by_frame),
        floor,
        level,
    )


def _windows_of_points(
    light: Tensor,
    ends: Tensor,
    places: list[tuple[int, int]],
    window: tuple[int, int],
    number: int,
    first: int,
) -> tuple[Tensor, ...]:
    """Return the pixels in the windows of the points of one frame, and the background of the frame.

    The result is: light and clipped (channel, pixel), frame (pixel,), pixels of each window,
    middle of each window, frame of each point; then for each channel the mean of the background,
    the variance of this mean, and the variance of one background pixel.

    ``ends`` marks the clipped pixels. ``number`` is the index of the frame, ``first`` the index of
    its first pixel among the pixels of all frames.
    """
    y, x = light.shape[-2:]
    middle = torch.tensor(places, dtype=torch.int64).reshape(-1, 2)
    rows = middle[:, :1] + torch.arange(window[0]) - window[0] // 2
    columns = middle[:, 1:] + torch.arange(window[1]) - window[1] // 2
    in_frame = ((rows >= 0) & (rows < y))[:, :, None] & ((columns >= 0) & (columns < x))[:, None]
    flat_place = rows.clamp(0, y - 1)[:, :, None] * x + columns.clamp(0, x - 1)[:, None]
    covered = _covered((y, x), places, window).flatten()
    widely_covered = _covered((y, x), places, (2 * window[0], 2 * window[1])).flatten()
    # outside windows twice as wide the background has less light of points
    near_points = widely_covered if int((~widely_covered).sum()) >= _LEAST_BACKGROUND else covered
    pixel_number = covered.cumsum(0) - 1 + first
    window_pixels = torch.where(in_frame, pixel_number[flat_place], -1).flatten(1)
    channels = zip(light.flatten(1), ends.flatten(1), strict=True)
    mean_background, mean_variance, pixel_variance = map(
        torch.stack,
        zip(
            *(
                _average(channel_light[~near_points & ~channel_clipped])
                for channel_light, channel_clipped in channels
            ),
            strict=True,
        ),
    )
    return (
        light.flatten(1)[:, covered],
        ends.flatten(1)[:, covered],
        torch.full((int(covered.sum()),), number),
        window_pixels,
        middle,
        torch.full((len(places),), number),
        mean_background,
        mean_variance,
        pixel_variance,
    )


def _covered(
    shape: tuple[int, int], places: list[tuple[int, int]], window: tuple[int, int]
) -> Tensor:
    """Return a mask (y, x) of the pixels that lie in a window around a place."""
    covered, (half_rows, half_columns) = (
        torch.zeros(shape, dtype=torch.bool),
        (n // 2 for n in window),
    )
    for y, x in places:
        covered[
            max(y - half_rows, 0) : y + half_rows + 1,
            max(x - half_columns, 0) : x + half_columns + 1,
        ] = True
    return covered


def _average(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean without outliers, the variance of this mean, and the variance of a pixel."""
    # repeated, because outliers enlarge the standard deviation of the first passes
    for _ in range(4):
        mean, spread = values.mean(), values.std()
        values = values[(values - mean).abs() <= _OUTLIER_DEVIATIONS * spread + 1e-12]
    return values.mean(), values.var() / len(values), values.var()


# --- points ---------------------------------------------------------------------------------------


@once_per_version
def _find_points(
    file: Path, window: tuple[int, int], camera: Camera
) -> list[tuple[tuple[int, int], bool]]:
    """Return the central pixel of each point of a frame, and whether its core is unclipped; the
    brightest point comes first.
    """
    gain, _, full_well, bits, read_noise = camera
    raw = torch.from_numpy(np.ascontiguousarray(read_frame(file).values, dtype=np.float64))
    clipped_pixels = is_clipped(raw, full_well=full_well, gain=gain, bits=bits).any(0)
    light = (raw / gain).sum(0)
    median_picture = _median(light)
    background = median_picture.median()
    # 1.4826: standard deviation of a normal distribution over its median absolute deviation
    noise = 1.4826 * float((light - light.median()).abs().median())
    noise = max(noise, read_noise * math.sqrt(len(raw)), 1e-6)
    above = median_picture - background
    is_significant = above > max(
        _SIGNIFICANT_DEVIATIONS * noise, _FAINTEST_SHARE * float(above.max())
    )
    # a peak is the largest of the 7 x 7 pixels around it
    is_peak = is_significant & (above >= max_pool2d(above[None], 7, 1, 3)[0])
    above = torch.where(is_peak, above, 0.0)
    points = list[tuple[tuple[int, int], bool]]()
    while len(points) < _MOST_POINTS and float(above.max()) > 0:
        y, x = divmod(int(above.argmax()), above.shape[1])
        clipped_near = clipped_pixels[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
        points.append(((y, x), not bool(clipped_near.any())))
        # no other point within the window of this one
        above[
            max(y - window[0] // 2, 0) : y + window[0] // 2 + 1,
            max(x - window[1] // 2, 0) : x + window[1] // 2 + 1,
        ] = 0
    height, width = above.shape
    return [point for point in points if _is_inner(point[0], height, width)]


def _is_inner(place: tuple[int, int], height: int, width: int) -> bool:
    """Return True if a pixel (y, x) is not too close to the edge of a picture."""
    y, x = place
    return _RIM_PIXELS <= y < height - _RIM_PIXELS and _RIM_PIXELS <= x < width - _RIM_PIXELS


def _median(picture: Tensor) -> Tensor:
    """Return the median over the 3 x 3 pixels around each pixel, which removes single hot
    pixels.
    """
    padded = pad(picture[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    return padded.unfold(0, 3, 1).unfold(1, 3, 1).flatten(-2).median(-1).values


def _unusable(
    file: Path,
    points: list[tuple[tuple[int, int], bool]],
    shape: tuple[int, int],
    window: tuple[int, int],
) -> str:
    """Return why the points of a frame cannot be used, or an empty text if they can."""
    if not points:
        return (
            f"{file.name} shows no point source: nothing stands out of the noise by"
            f" {_SIGNIFICANT_DEVIATIONS:g} deviations (a frame without light needs a name that"
            " begins with dark)"
        )
    covered = _covered(shape, [place for place, _ in points], window)
    free = int((~covered).sum())
    if free < _LEAST_BACKGROUND:
        return (
            f"{file.name} has {free} pixels beyond the windows of its {len(points)} points, but its"
            f" background needs {_LEAST_BACKGROUND}: choose a smaller window, or fewer points a"
            " frame"
        )
    return ""


def _zone(
    place: tuple[int, int], shape: tuple[int, int], zones: tuple[int, int]
) -> tuple[int, int]:
    """Return the zone (row, column) in which a pixel (y, x) of a frame lies."""
    row, column = (c * z // n for c, z, n in zip(place, zones, shape, strict=True))
    return row, column


def _without_point(empty: list[tuple[int, int]], zones: tuple[int, int]) -> str:
    """Return the message for zones (row, column) without a sharp point."""
    names = ", ".join(f"({i}, {j})" for i, j in empty)
    return (
        f"{len(empty)} of {zones[0]} x {zones[1]} zones have no point with an unsaturated core,"
        f" (row, column) {names}: take frames with points there, a shorter exposure, or choose"
        " fewer zones"
    )


# --- point model ----------------------------------------------------------------------------------

# The frames of point sources as a function of the PSF at the nodes of a grid, of the place and
# signal of each point, and of the background.


_KERNEL_REACH = 12  #: half width of the interpolation kernel, pixels
_KAISER_BETA = 8.0  #: shape parameter of the Kaiser window


class State(NamedTuple):
    """The fitted quantities; the same type also holds a change of them, or a gradient with respect
    to them.
    """

    kernels: Tensor  #: (node, channel, y, x)
    signal: Tensor  #: (point, channel), e-
    offset: Tensor  #: (point, 2), pixels from the middle of the window
    background: Tensor  #: (frame, channel), e-

    def plus(self, other: State, times: float | Tensor = 1.0) -> State:
        """Return the sum of this state and ``times`` the other."""
        return State(*(a + times * b for a, b in zip(self, other, strict=True)))

    def dot(self, other: State) -> Tensor:
        """Return the scalar product with the other state, over all entries."""
        return torch.stack([(a * b).sum() for a, b in zip(self, other, strict=True)]).sum()

    def times(self, other: State) -> State:
        """Return the product with the other state, entry by entry."""
        return State(*(a * b for a, b in zip(self, other, strict=True)))


def node_weights(places: Tensor, shape: tuple[int, int], zones: tuple[int, int]) -> Tensor:
    """Return the bilinear weights (point, rows * columns) of the nodes at places (point, 2); the
    weights of a point sum to 1.
    """
    down, right = (hats(places[:, k], shape[k], zones[k]) for k in (0, 1))
    return (down[:, :, None] * right[:, None]).flatten(1)


def hats(position: Tensor, size: int, count: int) -> Tensor:
    """Return the weights (place, node) of linear interpolation between ``count`` nodes.

    The nodes lie in the centres of equal parts of ``size`` pixels. Beyond the outer nodes, the
    nearest node has the weight 1.
    """
    position_in_nodes = ((position.double() + 0.5) * count / size - 0.5).clamp(0, count - 1)
    return (
        1.0 - (position_in_nodes[:, None] - torch.arange(count, dtype=torch.float64)).abs()
    ).clamp_min(0.0)


def shifting(offset: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return matrices (point, size, size) that shift samples by ``offset`` (point,), and the
    derivatives of these matrices with respect to the offset.

    The interpolation kernel is a sinc with a Kaiser window: its error is below 1e-4 up to 0.4
    periods per pixel. Beyond their ends the samples are continued with the same slope.
    """
    distance_in_samples = (
        torch.arange(size)[:, None] - torch.arange(size + 2 * _KERNEL_REACH) + _KERNEL_REACH
    )
    distance = distance_in_samples.double() - offset[:, None, None]
    inside_square = (1.0 - (distance / (_KERNEL_REACH + 1.0)).square()).clamp_min(0.0)
    # the Kaiser window i0(beta sqrt(1 - t^2)) / i0(beta); its derivative is `taper_change`
    root = inside_square.sqrt()
    taper = torch.special.i0(_KAISER_BETA * root) / torch.special.i0(
        torch.tensor(_KAISER_BETA, dtype=torch.float64)
    )
    taper_slope = torch.special.i1(_KAISER_BETA * root) / torch.special.i0(
        torch.tensor(_KAISER_BETA, dtype=torch.float64)
    )
    sinc, x = torch.sinc(distance), math.pi * distance
    near_zero = distance.abs() < 1e-4
    sinc_slope = torch.where(
        # near 0, where the quotient loses digits: the first term of its Taylor series
        near_zero,
        -math.pi * x / 3.0,
        (torch.cos(x) - sinc) / torch.where(near_zero, 1.0, distance),
    )
    taper_change = (
        -_KAISER_BETA * distance / (_KERNEL_REACH + 1.0) ** 2 * taper_slope / root.clamp_min(1e-6)
    )
    is_outside = inside_square <= 0
    value = (sinc * taper).masked_fill(is_outside, 0.0)
    # minus: the distance decreases as the shift grows
    slope = -(sinc_slope * taper + sinc * taper_change).masked_fill(is_outside, 0.0)
    return _folded(value), _folded(slope)


def _folded(matrix: Tensor) -> Tensor:
    """Return the matrices without the columns beyond the ends, whose weights are added to the
    samples inside.

    A sample beyond an end is twice the end sample minus its mirror image.
    """
    inner = matrix[..., _KERNEL_REACH:-_KERNEL_REACH].clone()
    reach = min(_KERNEL_REACH, inner.shape[-1] - 1)
    left_columns, right_columns = (
        matrix[..., _KERNEL_REACH - reach : _KERNEL_REACH],
        matrix[..., -_KERNEL_REACH : matrix.shape[-1] - _KERNEL_REACH + reach],
    )
    inner[..., 0] += 2.0 * left_columns.sum(-1)
    inner[..., 1 : reach + 1] -= left_columns.flip(-1)
    inner[..., -1] += 2.0 * right_columns.sum(-1)
    inner[..., -1 - reach : -1] -= right_columns.flip(-1)
    return inner


def moved(kernels: Tensor, offset: Tensor) -> Tensor:
    """Return kernels (kernel, channel, y, x), shifted by ``offset`` (kernel, 2)."""
    row_matrix, _ = shifting(offset[:, 0], kernels.shape[-2])
    column_matrix, _ = shifting(offset[:, 1], kernels.shape[-1])
    return _applied(row_matrix, kernels, column_matrix)


class Linear(NamedTuple):
    """The model of the frames, linearized at a state; its Jacobian is applied and never stored."""

    seen: Seen
    share: Tensor  #: (point, node)
    signal: Tensor  #: (point, channel)
    down: Tensor  #: (point, y, y)
    right: Tensor  #: (point, x, x)
    #: (3, point, channel, y, x): image of each point for signal 1, then the derivatives of the
    #: point's image with respect to y and x
    patterns: Tensor

    def change(self, by: State) -> Tensor:
        """Return the change (channel, pixel) of the frames for a small change of the state: the
        Jacobian applied to it.
        """
        kernels = torch.tensordot(self.share, by.kernels, 1)
        stamps = self.signal[..., None, None] * _applied(self.down, kernels, self.right)
        stamps = stamps + by.signal[..., None, None] * self.patterns[0]
        stamps = stamps + (by.offset.T[:, :, None, None, None] * self.patterns[1:]).sum(0)
        return self._scattered(stamps) + by.background.T[:, self.seen.frame]

    def slope(self, pixels: Tensor) -> State:
        """Return the transposed Jacobian, applied to pixels (channel, pixel)."""
        stamps = self.stamps_of(pixels)
        signal = (stamps * self.patterns[0]).sum((-2, -1))
        offset = (stamps * self.patterns[1:]).sum((-3, -2, -1)).T
        kernel_slope = (
            self.down.mT[:, None] @ (self.signal[..., None, None] * stamps) @ self.right[:, None]
        )
        kernels = torch.tensordot(self.share, kernel_slope, ([0], [0]))
        background = pixels.new_zeros(len(self.seen.background), len(pixels)).index_add(
            0, self.seen.frame, pixels.T
        )
        return State(kernels, signal, offset, background)

    def stamps_of(self, pixels: Tensor) -> Tensor:
        """Return the values of pixels (channel, pixel) in the windows of all points (point,
        channel, y, x); 0 beyond the frame.
        """
        # an extra pixel of value 0 stands for the places beyond the frame
        with_outside = torch.cat([pixels, pixels.new_zeros(len(pixels), 1)], 1)[
            :, self.seen.pixels
        ].transpose(0, 1)
        return with_outside.reshape(*with_outside.shape[:2], *self.patterns.shape[-2:])

    def _scattered(self, stamps: Tensor) -> Tensor:
        """Return frames (channel, pixel), to which the windows (point, channel, y, x) are added at
        their places.
        """
        flat_stamps = stamps.transpose(0, 1).flatten(1)
        count = self.seen.light.shape[-1]
        with_outside = flat_stamps.new_zeros(len(flat_stamps), count + 1).index_add(
            1, self.seen.pixels.flatten(), flat_stamps
        )
        return with_outside[:, :count]

    def model(self, background: Tensor) -> Tensor:
        """Return the expected frames (channel, pixel)."""
        return (
            self._scattered(self.signal[..., None, None] * self.patterns[0])
            + background.T[:, self.seen.frame]
        )


def linear(pixels: Seen, state: State, share: Tensor) -> Linear:
    """Return the model of the frames, linearized at a state."""
    y, x = state.kernels.shape[-2:]
    (row_matrix, row_slope), (column_matrix, column_slope) = (
        shifting(state.offset[:, 0], y),
        shifting(state.offset[:, 1], x),
    )
    kernels, signal = torch.tensordot(share, state.kernels, 1), state.signal[..., None, None]
    patterns = _applied(row_matrix, kernels, column_matrix)
    slopes = (
        signal * _applied(row_slope, kernels, column_matrix),
        signal * _applied(row_matrix, kernels, column_slope),
    )
    return Linear(
        pixels, share, state.signal, row_matrix, column_matrix, torch.stack([patterns, *slopes])
    )


def _applied(down: Tensor, kernels: Tensor, right: Tensor) -> Tensor:
    """Return D k R^T for each kernel k (point, channel, y, x), with the matrices D = ``down`` and R
    = ``right`` of its point.
    """
    products: Tensor = down[:, None] @ kernels @ right.mT[:, None]
    return products
