"""Files of measurements by other programs: EMVA 1288 descriptors, and tables of means and
variances.

An EMVA 1288 descriptor lists the image files of a measurement; a table has means and variances that
another program computed from frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BeforeValidator
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.calibrate._light_levels import Temporal, levels, reduce, refuse_unreadable, stack
from neusee.nodes.input_files import csv_rows, once_per_version, text_of
from neusee.nodes.units import DataFile, IsFile
from neusee.nodes.values import Levels

# --- descriptor of EMVA 1288 ----------------------------------------------------------------------

_PAIR_IMAGES = 2  #: images per level in a photon-transfer measurement
_LINE_FORMS = {
    "b": "b EXPOSURE_NS PHOTONS",
    "d": "d EXPOSURE_NS [0]",
    "n": "n BITS WIDTH HEIGHT",
    "v": "v RELEASE",
}


@dataclass
class _DescribedLevel:
    """The entries of an EMVA 1288 descriptor for one light level."""

    line: int
    photons: float
    exposure: float  #: s
    #: each image with its line number in the descriptor
    images: list[tuple[int, Path]] = field(default_factory=list)


@dataclass
class _Measurement:
    bits: int = 24
    shape: tuple[int, int] | None = None
    release: str = ""  #: release of EMVA 1288 that line v states
    levels: list[_DescribedLevel] = field(default_factory=list)

    @property
    def transfer(self) -> list[_DescribedLevel]:
        """The levels of the photon-transfer measurement: those with a pair of images, or all levels
        if none has a pair.
        """
        pairs = [level for level in self.levels if len(level.images) == _PAIR_IMAGES]
        return pairs or self.levels

    @property
    def series(self) -> list[_DescribedLevel]:
        """The levels with more than two images, for spatial quantities (DSNU and PRNU)."""
        return [level for level in self.levels if len(level.images) > _PAIR_IMAGES]


def _with_images(file: Any) -> tuple[Path, ...]:
    """Return the path of the descriptor, followed by the paths of the images that it names."""
    if isinstance(file, tuple):
        return file
    path = Path(file)
    if not path.is_file():
        raise ValueError(f"no such file: {path}")
    images = list(chain.from_iterable(level.images for level in parsed_descriptor(path).levels))
    for line, image in images:
        if not image.is_file():
            raise ValueError(
                f"{path.name}:{line}: no such image: {image}: put the image beside the descriptor"
            )
    return (path, *(image for _, image in images))


DescriptorFile = Annotated[
    tuple[Path, ...], BeforeValidator(_with_images, json_schema_input_type=str), IsFile()
]


@node(rtol=0.0)
def descriptor(*, file: DescriptorFile, scatter: Temporal = "temporal") -> Levels:
    """Read the images that an EMVA 1288 descriptor names, and reduce each level to mean and
    variance as `reduce` does.

    In a descriptor with pairs of images, a level of more images is a series for spatial quantities.
    It is no level of the photon transfer, and `descriptor_series` reads it.

    Shapes: -> (level,), in the order of the descriptor.
    Units:  in the descriptor exposures ns, 0 for the shortest, photons per pixel and exposure; mean
            DN; variance DN2.
    Error:  counted in whole numbers, as in `reduce`. The difference of the means of a pair counts
            as variance, except with `steady`.
    Raises: ValueError, before the run, where the descriptor or an image is missing or cannot be
            read, and for a level of one image; ValueError for images of another size or of more
            bits than the descriptor says.
    Source: EMVA Standard 1288, release 3.0 and 4.0 (data sets of the working group, descriptor
            file).
    """
    files = _with_images(file)
    measurement = parsed_descriptor(files[0])
    joined: Levels = levels(
        [
            _level_statistics(files[0].name, measurement, level, scatter)
            for level in measurement.transfer
        ]
    )
    return joined


@descriptor.preflight
def _(*, file: Sequence[Path], **params: object) -> list[str]:
    return refuse_unreadable("file", file[1:])


@descriptor.check
def _(result: Levels, **params: Any) -> list[Check]:
    dark = int((result.photons == 0).sum())
    return [
        Check(
            f"{len(result.mean)} levels ({dark} dark), exposures up to"
            f" {float(result.exposure.max()):.3g} s",
            dark > 0,
        )
    ]


def descriptor_frames(files: Sequence[Path]) -> Iterator[tuple[str, float, float, Tensor]]:
    """Yield name, photons, exposure (s) and frames (frame, y, x) of each photon-transfer level of a
    descriptor.

    ``files`` is the value of the parameter `file` of `descriptor`, whose first path is the
    descriptor.
    """
    for level in parsed_descriptor(files[0]).transfer:
        frames = torch.from_numpy(stack([image for _, image in level.images]))
        yield f"line {level.line}", level.photons, level.exposure, frames


def descriptor_series(files: Sequence[Path]) -> Iterator[tuple[float, float, Iterator[Tensor]]]:
    """Yield photons, exposure (s) and an iterator of frames (y, x) of each spatial series of a
    descriptor.

    ``files`` is as in `descriptor_frames`. Images are read one at a time.
    """
    for level in parsed_descriptor(files[0]).series:
        yield (
            level.photons,
            level.exposure,
            chain.from_iterable(torch.from_numpy(stack([image])) for _, image in level.images),
        )


def descriptor_release(files: Sequence[Path]) -> str:
    """Return the release of EMVA 1288 from line v of a descriptor, such as ``3.0``; empty if there
    is no such line.

    ``files`` is as in `descriptor_frames`.
    """
    return parsed_descriptor(files[0]).release


def refuse_descriptor(file: Path) -> None:
    """Raise ValueError with the line of the mistake if a descriptor or an image that it names
    cannot be read.
    """
    refuse_unreadable("file", _with_images(file)[1:])


def _level_statistics(
    name: str, measurement: _Measurement, level: _DescribedLevel, scatter: Temporal
) -> Levels:
    """Return the statistics of one level of the descriptor ``name``; raise ValueError for images
    whose size or bits differ from those stated there.
    """
    images = stack([image for _, image in level.images])
    if measurement.shape and images.shape[1:] != measurement.shape:
        raise ValueError(
            f"{name}:{level.line}: image shape {images.shape[1:]}, but descriptor shape"
            f" {measurement.shape} (y, x)"
        )
    if int(images.max()) >= 2**measurement.bits:
        raise ValueError(
            f"{name}:{level.line}: a pixel of {images.max()} DN exceeds the {measurement.bits}"
            " bits given in line n"
        )
    statistics: Levels = reduce(
        torch.from_numpy(images), photons=level.photons, exposure=level.exposure, scatter=scatter
    )
    return statistics


def parsed_descriptor(path: Path) -> _Measurement:
    """Return the parsed content of a descriptor; raise ValueError, with the line number, for a
    mistake.
    """
    measurement = _Measurement()
    for number, line in _lines(path):
        kind, _, content = line.partition(" ")
        try:
            _add_line(measurement, kind, content.strip(), path.parent, number)
        except ValueError as error:
            raise ValueError(f"{path.name}:{number}: {error}") from None
    for level in measurement.levels:
        if len(level.images) < 2:
            raise ValueError(
                f"{path.name}:{level.line}: {len(level.images)} image(s): a light level needs two"
                " or more"
            )
    if not measurement.levels:
        raise ValueError(
            f"{path.name}: no line begins with 'b' or 'd', so there is no light level: give an EMVA"
            " 1288 descriptor"
        )
    return measurement


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each descriptor line that is neither empty nor a comment."""
    text = text_of(path, "utf-8-sig", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.strip().replace("\t", " ")


def _add_line(measurement: _Measurement, kind: str, content: str, folder: Path, line: int) -> None:
    """Add the content of one line of a descriptor to the measurement."""
    if kind == "i":
        if not measurement.levels:
            raise ValueError(
                "an image precedes the first light level: begin the level with a line 'b' or 'd'"
            )
        measurement.levels[-1].images.append((line, folder / content.replace("\\", "/")))
        return
    if kind not in _LINE_FORMS:
        raise ValueError(f"cannot read {kind!r}: begin the line with v, n, b, d, i or #")
    words = content.split()
    try:
        # some laboratories write decimal commas
        numbers = [float(word.replace(",", ".")) for word in words]
        if kind == "n":
            bits, width, height = words[:3]
            measurement.bits, measurement.shape = int(bits), (int(height), int(width))
        elif kind == "v":
            measurement.release = words[0].replace(",", ".")
        else:
            measurement.levels.append(_level_of_line(line, kind, numbers))
    except (ValueError, IndexError):
        raise ValueError(f"cannot read {kind} {content!r}: write {_LINE_FORMS[kind]}") from None


def _level_of_line(line: int, kind: str, numbers: list[float]) -> _DescribedLevel:
    """Return the light level that a descriptor line states; raise ValueError for an invalid
    exposure or number of photons.
    """
    # a dark line may omit its number of photons, 0
    exposure, photons = (*numbers, 0.0)[:2] if kind == "d" else numbers
    if not 0 <= exposure < float("inf") or not (
        0 < photons < float("inf") if kind == "b" else photons == 0
    ):
        raise ValueError
    # from nanoseconds to seconds
    return _DescribedLevel(line, photons, exposure * 1e-9)


# --- table of moments -----------------------------------------------------------------------------

_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_CONDITIONS = {
    "photons": ">= 0",
    "exposure": "> 0",
    "pixels": ">= 1",
    "mean": "finite",
    "variance": ">= 0",
}


@node(rtol=0.0)
def table(
    *,
    file: DataFile,
    photons: str = "photons",
    exposure: str = "exposure_s",
    pixels: str = "pixels",
    mean: str = "mean",
    variance: str = "variance",
    drift: str | None = None,
    exposure_unit: Literal["s", "ms", "us", "ns"] = "s",
) -> Levels:
    """Read the means and variances of pairs of frames from a CSV file with named columns and a line
    per light level.

    ``drift`` names the column with the difference of the two means, for a table whose variance
    excludes that difference. Half the square of the difference is then added, because the variance
    of EMVA 1288 includes that part.

    Shapes: -> (level,), in the order of the file; no histograms.
    Units:  photons per pixel and exposure; exposure in `exposure_unit`; pixels of one frame; mean
            DN; variance DN2.
    Error:  exact.
    Raises: ParameterError before the run for a missing column, another separator than a comma, and
            a cell without a valid number.
    Source: EMVA Standard 1288, release 4.0 Linear, section 6.6 (variance of a pair of frames).
    """
    names = {
        "photons": photons,
        "exposure": exposure,
        "pixels": pixels,
        "mean": mean,
        "variance": variance,
    }
    rows = _rows(file, {**names, **({} if drift is None else {"drift": drift})})
    if not rows:
        raise ValueError(f"{file.name} has no line below the header: give one line per level")
    columns = {
        name: torch.tensor([row[name] for row in rows], dtype=torch.float64) for name in rows[0]
    }
    # the EMVA 1288 variance of a pair includes half the squared difference of its means
    total_variance = columns["variance"] + (
        columns["drift"].square() / 2 if drift is not None else 0.0
    )
    exposures, pixel_count = columns["exposure"] * _SECONDS[exposure_unit], columns["pixels"]
    no_cells = torch.zeros(0, dtype=torch.float64)
    return Levels(
        columns["photons"],
        exposures,
        # pixels of both frames; a pair of frames has one degree of freedom per pixel
        2 * pixel_count,
        columns["mean"],
        total_variance,
        pixel_count,
        no_cells.long(),
        no_cells,
        no_cells,
    )


@table.preflight
def _(*, file: Path, exposure_unit: str = "s", **names: Any) -> list[str]:
    try:
        _, header = next(csv_rows(file), (0, list[str]()))
    except ValueError as error:
        raise ParameterError("file", str(error)) from None
    for parameter, column in names.items():
        if column is not None and column not in header:
            raise ParameterError(
                parameter, f"{file.name} has no column {column!r}: name one of {', '.join(header)}"
            )
    if problem := _wrong_cell(
        file, *sorted((name, column) for name, column in names.items() if column is not None)
    ):
        raise ParameterError("file", problem)
    return []


@once_per_version
def _wrong_cell(file: Path, *columns: tuple[str, str]) -> str:
    """Return an error message for the first cell of a table that is not a valid number, else an
    empty text.
    """
    try:
        rows = _rows(file, dict(columns))
    except ValueError as error:
        return str(error)
    return "" if rows else f"{file.name} has no line below the header: give one line per level"


@table.check
def _(result: Levels, **params: Any) -> list[Check]:
    dark = int((result.photons == 0).sum())
    return [Check(f"{len(result.mean)} levels, {dark} dark", dark > 0)]


def _rows(file: Path, columns: dict[str, str]) -> list[dict[str, float]]:
    """Read each line of a table as numbers by quantity; ``columns`` maps quantities to column
    headings. Raises ValueError, with line and column, for a cell that is no valid number.
    """
    rows = csv_rows(file)
    _, header = next(rows, (0, list[str]()))
    cells_of_line = ((line, dict(zip(header, row, strict=False))) for line, row in rows)
    return [
        {n: _number(row.get(c), n, f"{file.name}:{line}: column {c}") for n, c in columns.items()}
        for line, row in cells_of_line
    ]


def _number(text: str | None, name: str, where: str) -> float:
    """Return the number in a cell of the quantity ``name``; raise ValueError, which names the place
    ``where``, for a text that is no valid number for this quantity.
    """
    condition = _CONDITIONS.get(name, "finite")
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    fulfilled = {
        ">= 0": number >= 0,
        "> 0": number > 0,
        ">= 1": number >= 1 and number.is_integer(),
    }
    if not math.isfinite(number) or not fulfilled.get(condition, True):
        kind = "whole number" if name == "pixels" else "number"
        raise ValueError(f"{where}: {text!r} is not valid for {name}: write a {kind}, {condition}")
    return number
