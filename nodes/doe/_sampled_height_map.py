"""A height map read from a file, or a smooth random height map at which a training starts."""

from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.doe._height_map_files import map_header, read_height_map
from neusee.nodes.doe._map_resampling import (
    Between,
    coarser,
    jump,
    resampled,
    resampling_error,
    too_small,
)
from neusee.nodes.doe._refractive_index import height_checks
from neusee.nodes.input_files import once_per_version
from neusee.nodes.optics._pupil_grid import PupilGrid, grid_of
from neusee.nodes.optics._zernike import screen
from neusee.nodes.units import DataFile, Depth, LengthUnit, PupilPitch
from neusee.nodes.values import Stop

Scale = Annotated[float, Field(gt=0, le=1)]  #: share of the pupil's diameter
_DEPTH = 1.2e-6  #: m, height of white where neither the recipe nor the file says
_ROUNDED = 1e-3  #: relative difference of a pitch that is written with four digits
_SAME = 1e-6  #: relative difference of two pitches that counts as rounding
_TALLEST = 0.01  #: m; a higher mask is a mistake of the unit


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
        random_screen = screen(grid_of(stop), scale, rng)
        return (height_range(None, depth) * torch.sigmoid(1.5 * random_screen)).to(torch.float32)
    lengths = _lengths(file, depth, unit, pitch)
    file_pitch = _fits(file, grid_of(stop), lengths["pitch"], pupil_pitch)
    height = read_height_map(file, lengths["depth"], lengths["unit"])
    if problem := _wrong(file, height):
        raise ValueError(problem)
    return height if file_pitch is None else resampled(height, file_pitch, grid_of(stop), between)


def height_map(
    file: Path, *, depth: float | None = None, unit: float | None = None, pitch: float | None = None
) -> tuple[Tensor, float | None]:
    """Read a height map in m as its file samples it, and the distance of its samples in m, None if
    nothing states it.

    The parameters are those of `pixelwise`.
    """
    lengths = _lengths(file, depth, unit, pitch)
    return read_height_map(file, lengths["depth"], lengths["unit"]), lengths["pitch"]


def height_range(file: Path | None, depth: float | None) -> float:
    """Return the largest height in m that `doe.pixelwise` draws or learns: that stated, or 1.2
    um.
    """
    if file is None:
        return _DEPTH if depth is None else depth
    depth_in_file: float = _lengths(file, depth, None, None)["depth"]
    return depth_in_file


def _lengths(
    file: Path, depth: float | None, unit: float | None, pitch: float | None
) -> dict[str, Any]:
    """Return the lengths that the recipe or the header of the file states, in m.

    Raises ParameterError where recipe and header differ.
    """
    stated = map_header(file).stated
    lengths: dict[str, Any] = {"depth": _DEPTH, "unit": 1.0, "pitch": None} | stated
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


def _fits(
    file: Path, grid: PupilGrid, pitch: float | None, pupil_pitch: float | None
) -> float | None:
    """Return the pitch from which a height map is interpolated, or None if it has the samples of
    the pupil grid.

    Raises ParameterError for another size than the pupil needs, and for a size that nothing states.
    """
    samples, shape = grid.samples, map_header(file).shape
    has_pupil_samples = shape == (samples, samples)
    if has_pupil_samples and pitch is None:
        _refuse_unknown_size(file, grid, pupil_pitch)
    if has_pupil_samples and (pitch is None or abs(pitch / grid.pitch - 1) <= _SAME):
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
    if problem := too_small(shape, pitch, grid):
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
    file_pitch = None if stop is None else _fits(file, grid_of(stop), lengths["pitch"], pupil_pitch)
    if problem := _wrong_heights(file, lengths["depth"], lengths["unit"]):
        raise ParameterError("file", problem)
    notes = _white_note(file, depth) + _size_note(file, stop, lengths["pitch"], pupil_pitch)
    if file_pitch is None or stop is None:
        return notes
    if between == "linear" and (
        step := _jump(file, lengths["depth"], lengths["unit"], file_pitch, grid_of(stop))
    ):
        fix = "unwrap a wrapped map, or set between: nearest to keep the steps"
        raise ParameterError(
            "file", f"{file.name}: {step}, which linear interpolation makes a ramp: {fix}"
        )
    note = coarser(file_pitch, grid_of(stop))
    return [*notes, *([f"{file.name}: {note}"] if note else [])]


def _refuse_unknown_size(file: Path, grid: PupilGrid, pupil_pitch: float | None) -> None:
    """Raise ParameterError for a file without a pitch where the pupil has another pitch than the
    recipe writes.
    """
    if pupil_pitch is None or abs(pupil_pitch / grid.pitch - 1) <= _ROUNDED:
        return
    setting_text = f"written as {pupil_pitch * 1e6:.4g} um"
    pitch_text = f"the samples of the pupil are {grid.pitch * 1e6:.4g} um apart and {setting_text}"
    fix = f"give pitch, {grid.pitch * 1e6:.6g} um for a map as wide as the pupil"
    raise ParameterError("pitch", f"{file.name} states no pitch, and {pitch_text}: {fix}")


def _size(grid: PupilGrid) -> str:
    """Return the pitch and the width of a pupil grid as text."""
    return f"{grid.pitch * 1e6:.4g} um apart, {grid.samples * grid.pitch * 1e3:.4g} mm wide"


def _size_note(
    file: Path, stop: Stop | None, pitch: float | None, pupil_pitch: float | None
) -> list[str]:
    """Return a note on a file of which nothing states the distance of its samples."""
    if stop is None or pitch is not None or pupil_pitch is not None:
        return []
    return [
        f"{file.name} states no pitch: its samples count as those of the pupil,"
        f" {_size(grid_of(stop))}"
    ]


def _white_note(file: Path, depth: float | None) -> list[str]:
    """Return a note on a picture of which nothing states the height of white."""
    if file.suffix.lower() != ".png" or depth is not None or "depth" in map_header(file).stated:
        return []
    return [
        f"{file.name}: white counts as {_DEPTH * 1e6:g} um high, because nothing states its height:"
        " give depth"
    ]


def _refuse_unused(file: Path, depth: float | None, unit: float | None) -> None:
    """Raise ParameterError for a length that does not apply to the kind of file."""
    if file.suffix.lower() == ".png" and unit is not None:
        raise ParameterError(
            "unit", f"{file.name} holds grey levels: give depth, the height of white"
        )


@once_per_version
def _wrong_heights(file: Path, depth: float, unit: float) -> str:
    """Return a message for a file whose heights cannot be read or are wrong, else an empty text."""
    try:
        return _wrong(file, read_height_map(file, depth, unit))
    except (OSError, ValueError, SyntaxError) as error:
        return f"{file.name} cannot be read as a height map: {error}"


def _wrong(file: Path, height: Tensor) -> str:
    """Return a message for heights that are not finite, negative, or higher than any mask, else
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
    if high > _TALLEST:
        return (
            f"{file.name}: highest height {high:.3g} m: state the unit of the file, such as unit:"
            " 1 um"
        )
    return ""


@once_per_version
def _jump(file: Path, depth: float, unit: float, pitch: float, grid: PupilGrid) -> str:
    """Return where a file has a step that interpolation would make a ramp, or an empty text."""
    return jump(read_height_map(file, depth, unit), pitch, grid)


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
    own = _fits(file, grid, lengths["pitch"], pupil_pitch)
    if own is None:
        return [
            *checks,
            Check(f"{file.name}: {grid.samples} x {grid.samples} samples, {_size(grid)}"),
        ]
    shape = map_header(file).shape
    height = read_height_map(file, lengths["depth"], lengths["unit"])
    text = (
        f"{file.name} resampled from {' x '.join(map(str, shape))} samples {own * 1e6:.4g} um apart"
    )
    if between == "linear":
        text += f", rms error {resampling_error(height, own, grid) * 1e9:.2g} nm"
    return [*checks, Check(text)]
