"""A height map read from a file, or a smooth random height map as a start for training.

A height map from a file may have its own pitch; it is then resampled to the pupil grid.
"""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.doe._height_map_files import map_header, read_height_map
from neusee.nodes.doe._refractive_index import height_checks
from neusee.nodes.input_files import once_per_version
from neusee.nodes.optics._pupil import phase_screen
from neusee.nodes.optics._pupil_grid import PupilGrid, grid_of, inside_stop
from neusee.nodes.units import DataFile, Depth, LengthUnit, PupilPitch
from neusee.nodes.values import Stop

# --- resampling -----------------------------------------------------------------------------------

Between = Literal["linear", "nearest"]
_JUMP_SHARE = 0.5  #: largest difference of neighbouring samples, as a share of the range of heights


def resampled(height: Tensor, pitch: float, grid: PupilGrid, between: Between = "linear") -> Tensor:
    """Resample a height map (y, x) with samples ``pitch`` m apart to the pupil grid, (v, u)
    float32.

    The centre of the height map lies on the axis. The outermost samples extend half a pitch beyond
    their positions.
    """
    positions = [_map_positions(n, pitch, grid) for n in height.shape]
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
    positions = [_map_positions(n, pitch, grid) for n in height.shape]
    difference = _interpolated(height, positions, cubic=True) - _interpolated(
        height, positions, cubic=False
    )
    return float(difference[inside_stop(grid)].square().mean().sqrt())


def coverage_problem(shape: tuple[int, ...], pitch: float, grid: PupilGrid) -> str:
    """Return an error message for a height map that does not cover the clear aperture, else an
    empty text.
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


def largest_jump(height: Tensor, pitch: float, grid: PupilGrid) -> str:
    """Return a text on the largest step between neighbouring samples, which linear interpolation
    would turn into a ramp.

    Only samples inside the clear aperture count. The text is empty if the step is at most half of
    their range of heights.
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
    if tallest <= _JUMP_SHARE * (highest - lowest):
        return ""
    return (
        f"the height jumps by {tallest * 1e6:.4g} um of {(highest - lowest) * 1e6:.4g} um {place}"
    )


def _map_positions(count: int, pitch: float, grid: PupilGrid) -> Tensor:
    """Return the position of each pupil sample along one axis, in samples of the height map,
    float64.
    """
    steps = torch.arange(grid.samples, dtype=torch.float64) - (grid.samples - 1) / 2
    return steps * (grid.pitch / pitch) + (count - 1) / 2


def _interpolated(height: Tensor, positions: list[Tensor], cubic: bool) -> Tensor:
    """Interpolate a height map at positions along both axes, in samples of the map, float64."""
    rows, columns = (
        _interpolation_matrix(x, n, cubic) for x, n in zip(positions, height.shape, strict=True)
    )
    return rows @ height.double() @ columns.T


def _interpolation_matrix(position: Tensor, count: int, cubic: bool) -> Tensor:
    """Return the matrix (position, sample) of linear interpolation, or of cubic interpolation
    through four samples.
    """
    point_count = min(4 if cubic else 2, count)
    position = position.clamp(0, count - 1)
    first = (position.floor().long() - (point_count - 2) // 2).clamp(0, count - point_count)
    matrix = torch.zeros(len(position), count, dtype=torch.float64)
    for k in range(point_count):
        others = [j for j in range(point_count) if j != k]
        # Lagrange basis polynomial of each point
        factors = [(position - (first + j)) / (k - j) for j in others]
        share = torch.stack(factors).prod(0) if factors else torch.ones_like(position)
        matrix[torch.arange(len(position)), first + k] = share
    return matrix


def lost_detail(pitch: float, grid: PupilGrid) -> str:
    """Return a note for a height map with a finer pitch than the pupil grid, which loses its finest
    detail; else an empty text.
    """
    ratio = grid.pitch / pitch
    if ratio <= 1 + 1e-6:
        return ""
    fix = f"set samples to {math.ceil(grid.samples * ratio)} to keep it"
    return (
        f"the map has {ratio:.3g} samples for each sample of the pupil, so that its finest detail"
        f" is lost: {fix}"
    )


# --- map of a file, or a random map ---------------------------------------------------------------

Scale = Annotated[float, Field(gt=0, le=1)]  #: share of the pupil's diameter
_DEFAULT_DEPTH = 1.2e-6  #: m, height of white if neither recipe nor file states it
_WRITTEN_PRECISION = 1e-3  #: relative rounding of a pitch written with four digits
_EQUAL_PITCH = 1e-6  #: relative difference of two pitches that counts as rounding
_TALLEST_MASK = 0.01  #: m; a higher mask is taken as a wrong unit


@node()
def pixelwise(
    stop: Stop,
    *,
    file: DataFile | None = None,
    depth: Depth | None = None,
    unit: LengthUnit | None = None,
    pitch: PupilPitch | None = None,
    pupil_pitch: PupilPitch | None = None,
    between: Between = "linear",
    scale: Scale = 0.1,
    rng: torch.Generator,
) -> Tensor:
    """Read a height map from ``file``, or return a smooth random height map between 0 and
    ``depth``.

    The file is a .npy, .safetensors, .exr or .mat file whose value 1 is the height ``unit`` (1 m
    unless stated), or a grey .png whose white is ``depth`` (1.2 um unless stated). A file with
    samples ``pitch`` apart is interpolated to the pupil grid, and keeps its size; without ``pitch``
    it has the samples of the pupil grid. The header of a file other than .npy may state the three.
    ``pupil_pitch`` is the pitch for which a recipe writes its pupil: a file without a pitch is
    refused where the grid has another one, because its size is then not known.

    The features of the random height map are ``scale`` diameters wide. It is a start for training:
    a flat height map is a saddle point, where the suppression has no gradient.

    Shapes: stop -> (v, u).
    Units:  m.
    Error:  exact without ``pitch``. Linear interpolation: h^2 / 8 of the curvature, which the check
            estimates as the difference from cubic interpolation; `nearest` takes the sample whose
            centre is nearest.
    Raises: ParameterError for a file without a height map, of another shape than the pupil grid or
            smaller than the clear aperture, with 16-bit floats, complex values or, before linear
            interpolation, jumps as of a wrapped map; ValueError for a height that is negative or
            not finite.
    Source: by definition.
    """
    if file is None:
        random_screen = phase_screen(grid_of(stop), scale, rng)
        return (height_range(None, depth) * torch.sigmoid(1.5 * random_screen)).to(torch.float32)
    lengths = _lengths(file, depth, unit, pitch)
    file_pitch = _interpolation_pitch(file, grid_of(stop), lengths["pitch"], pupil_pitch)
    height = read_height_map(file, lengths["depth"], lengths["unit"])
    if problem := _height_problem(file, height):
        raise ValueError(problem)
    return height if file_pitch is None else resampled(height, file_pitch, grid_of(stop), between)


def height_map(
    file: Path, *, depth: float | None = None, unit: float | None = None, pitch: float | None = None
) -> tuple[Tensor, float | None]:
    """Return the height map in a file in m, at its own sampling, and its pitch in m (None if not
    stated).

    The parameters are those of `pixelwise`.
    """
    lengths = _lengths(file, depth, unit, pitch)
    return read_height_map(file, lengths["depth"], lengths["unit"]), lengths["pitch"]


def height_range(file: Path | None, depth: float | None) -> float:
    """Return the largest height in m of a random or trainable `doe.pixelwise` map: the stated
    depth, or 1.2 um.
    """
    if file is None:
        return _DEFAULT_DEPTH if depth is None else depth
    depth_in_file: float = _lengths(file, depth, None, None)["depth"]
    return depth_in_file


def _lengths(
    file: Path, depth: float | None, unit: float | None, pitch: float | None
) -> dict[str, Any]:
    """Return the lengths that the recipe or the header of the file states, in m.

    Raises ParameterError where recipe and header differ.
    """
    stated = map_header(file).stated
    lengths: dict[str, Any] = {"depth": _DEFAULT_DEPTH, "unit": 1.0, "pitch": None} | stated
    for name, value in (("depth", depth), ("unit", unit), ("pitch", pitch)):
        if value is None:
            continue
        if name in stated and abs(stated[name] / value - 1) > 1e-6:
            text, stated_text = (f"{x * 1e6:.6g} um" for x in (value, stated[name]))
            raise ParameterError(
                name,
                f"{text}, but the header of {file.name} says {stated_text}: leave one of them out",
            )
        lengths[name] = value
    return lengths


def _interpolation_pitch(
    file: Path, grid: PupilGrid, pitch: float | None, pupil_pitch: float | None
) -> float | None:
    """Return the pitch in m of a height map that must be interpolated, or None if its samples are
    those of the pupil grid.

    Raises ParameterError for a map that does not fit the pupil, and for an unknown size.
    """
    samples, shape = grid.samples, map_header(file).shape
    has_pupil_samples = shape == (samples, samples)
    if has_pupil_samples and pitch is None:
        _refuse_unknown_size(file, grid, pupil_pitch)
    if has_pupil_samples and (pitch is None or abs(pitch / grid.pitch - 1) <= _EQUAL_PITCH):
        return None
    if len(shape) != 2 or min(shape) < 2:
        raise ParameterError(
            "file",
            f"{file.name} is {shape}, not the pupil grid ({samples}, {samples}), nor a height "
            "map that can be resampled: save a map with two axes",
        )
    if pitch is None:
        fix = f"state its pitch to resample it, or set samples to {shape[-1]}"
        raise ParameterError(
            "file", f"{file.name} is {shape}, not the pupil grid ({samples}, {samples}): {fix}"
        )
    if problem := coverage_problem(shape, pitch, grid):
        raise ParameterError("pitch", f"{file.name}: {problem}")
    return pitch


@pixelwise.preflight
def _(
    *,
    stop: Stop | None,
    file: Path | None,
    depth: float | None = None,
    unit: float | None = None,
    pitch: float | None = None,
    pupil_pitch: float | None = None,
    between: Between = "linear",
    **_: Any,
) -> list[str]:
    if file is None:
        return []
    _refuse_unused(file, depth, unit)
    lengths = _lengths(file, depth, unit, pitch)
    file_pitch = (
        None
        if stop is None
        else _interpolation_pitch(file, grid_of(stop), lengths["pitch"], pupil_pitch)
    )
    if problem := _file_problem(file, lengths["depth"], lengths["unit"]):
        raise ParameterError("file", problem)
    notes = _white_note(file, depth) + _size_note(file, stop, lengths["pitch"], pupil_pitch)
    if file_pitch is None or stop is None:
        return notes
    if between == "linear" and (
        step := _jump_in_file(file, lengths["depth"], lengths["unit"], file_pitch, grid_of(stop))
    ):
        fix = "unwrap a wrapped map, or set between: nearest to keep the steps"
        raise ParameterError(
            "file", f"{file.name}: {step}, which linear interpolation makes a ramp: {fix}"
        )
    note = lost_detail(file_pitch, grid_of(stop))
    return [*notes, *([f"{file.name}: {note}"] if note else [])]


def _refuse_unknown_size(file: Path, grid: PupilGrid, pupil_pitch: float | None) -> None:
    """Raise ParameterError for a file without a pitch if the pitch of the pupil differs from the
    one that the recipe states.
    """
    if pupil_pitch is None or abs(pupil_pitch / grid.pitch - 1) <= _WRITTEN_PRECISION:
        return
    setting_text = f"written as {pupil_pitch * 1e6:.4g} um"
    pitch_text = f"the samples of the pupil are {grid.pitch * 1e6:.4g} um apart and {setting_text}"
    fix = f"give pitch, {grid.pitch * 1e6:.6g} um for a map as wide as the pupil"
    raise ParameterError("pitch", f"{file.name} states no pitch, and {pitch_text}: {fix}")


def _size_text(grid: PupilGrid) -> str:
    """Return the pitch and the width of a pupil grid as text."""
    return f"{grid.pitch * 1e6:.4g} um apart, {grid.samples * grid.pitch * 1e3:.4g} mm wide"


def _size_note(
    file: Path, stop: Stop | None, pitch: float | None, pupil_pitch: float | None
) -> list[str]:
    """Return a note if nothing states the pitch of a file, else nothing."""
    if stop is None or pitch is not None or pupil_pitch is not None:
        return []
    return [
        f"{file.name} states no pitch: its samples count as those of the pupil,"
        f" {_size_text(grid_of(stop))}"
    ]


def _white_note(file: Path, depth: float | None) -> list[str]:
    """Return a note if nothing states the height of white in a .png file, else nothing."""
    if file.suffix.lower() != ".png" or depth is not None or "depth" in map_header(file).stated:
        return []
    return [
        f"{file.name}: white counts as {_DEFAULT_DEPTH * 1e6:g} um high, because nothing states"
        " its height: give depth"
    ]


def _refuse_unused(file: Path, depth: float | None, unit: float | None) -> None:
    """Raise ParameterError for a length that does not apply to the kind of file."""
    if file.suffix.lower() == ".png" and unit is not None:
        raise ParameterError(
            "unit", f"{file.name} holds grey levels: give depth, the height of white"
        )


@once_per_version
def _file_problem(file: Path, depth: float, unit: float) -> str:
    """Return an error message for a file whose heights cannot be read or are invalid, else an empty
    text.
    """
    try:
        return _height_problem(file, read_height_map(file, depth, unit))
    except (OSError, ValueError, SyntaxError) as error:
        return f"{file.name} cannot be read as a height map: {error}"


def _height_problem(file: Path, height: Tensor) -> str:
    """Return an error message for heights that are not finite, negative, or implausibly large, else
    an empty text.
    """
    is_finite = torch.isfinite(height)
    if not bool(is_finite.all()):
        row, column = (int(i) for i in (~is_finite).nonzero()[0])
        bad_heights = (
            f"{int((~is_finite).sum())} heights are NaN or infinite, the first in row {row}, column"
            f" {column}"
        )
        return f"{file.name}: {bad_heights}, but every height must be finite and at least 0"
    low, high = (float(x) for x in torch.aminmax(height))
    if low < 0:
        return (
            f"{file.name}: lowest height {low:.3g} m, but every height must be finite and at"
            " least 0"
        )
    if high > _TALLEST_MASK:
        return (
            f"{file.name}: highest height {high:.3g} m: state the unit of the file, such as unit:"
            " 1 um"
        )
    return ""


@once_per_version
def _jump_in_file(file: Path, depth: float, unit: float, pitch: float, grid: PupilGrid) -> str:
    """Return a text on a step in the file that interpolation would turn into a ramp, else an empty
    text.
    """
    return largest_jump(read_height_map(file, depth, unit), pitch, grid)


@pixelwise.check
def _(
    result: Tensor,
    stop: Stop,
    *,
    file: Path | None = None,
    depth: float | None = None,
    unit: float | None = None,
    pitch: float | None = None,
    pupil_pitch: float | None = None,
    between: Between = "linear",
    **_: Any,
) -> list[Check]:
    checks = height_checks(result)
    if file is None:
        return checks
    lengths, grid = _lengths(file, depth, unit, pitch), grid_of(stop)
    own = _interpolation_pitch(file, grid, lengths["pitch"], pupil_pitch)
    if own is None:
        return [
            *checks,
            Check(f"{file.name}: {grid.samples} x {grid.samples} samples, {_size_text(grid)}"),
        ]
    shape = map_header(file).shape
    height = read_height_map(file, lengths["depth"], lengths["unit"])
    text = (
        f"{file.name} resampled from {' x '.join(map(str, shape))} samples {own * 1e6:.4g} um apart"
    )
    if between == "linear":
        text += f", rms error {resampling_error(height, own, grid) * 1e9:.2g} nm"
    return [*checks, Check(text)]
