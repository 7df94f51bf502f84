"""The light levels in a folder of frames, by file names or a table, and what is missing."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from neusee.nodes.calibrate import FrameHeader, frame_header, frame_means
from neusee.nodes.input_files import csv_rows
from neusee.nodes.units import read_any
from neusee.workflows.report.study_report import Progress, silent

# --- frame names ----------------------------------------------------------------------------------

# Exposure, light and level of a frame by the name of its file.


_NUMBER = r"(\d+(?:[.,p]\d+)?(?:e[-+]?\d+)?)"  #: 10p5 is 10.5, as in names without points
_UNIT = r"(ns|us|µs|μs|ms|s)"
_WORD = r"(?:exposure|exptime|texp|exp|t)"
_SPACE = r"[ =_-]?"
#: 1/200 of a second: a file name has no slash; after a hyphen, and between lone numbers, it may be
#: something else
_FRACTION = re.compile(
    rf"(?<![a-z0-9.,-]){_WORD}?{_SPACE}(?<![\d.,-])1(?:[-⁄]|over|div)([1-9][\d.]*)"
    r" ?s(?:ec)?(?![a-z0-9])"
)
_DOUBTFUL = re.compile(r"(?<![\d.,])(?:(?<=[a-z-])1-|1[_/ ])([1-9]\d*) ?s(?:ec)?(?![a-z0-9])")
_EXPOSURE = re.compile(rf"(?<![a-z0-9.,]){_WORD}?{_SPACE}{_NUMBER}[ _-]?{_UNIT}(?:ec)?(?![a-z0-9])")
_UNIT_FIRST = re.compile(rf"(?<![a-z0-9]){_WORD}{_SPACE}{_UNIT}{_SPACE}{_NUMBER}(?![a-z.,0-9])")
_SHORT_UNIT_FIRST = re.compile(rf"(?<![a-z0-9])(ns|us|µs|μs|ms){_SPACE}{_NUMBER}(?![a-z.,0-9])")
#: number of photons with the unit after it, such as 1200ph, or before it, such as ph_1200
_AFTER = re.compile(rf"(?<![a-z0-9.,]){_NUMBER}[ _-]?(?:photons?|ph)(?![a-z])")
_BEFORE = re.compile(rf"(?<![a-z])(?:photons?|ph)[ =_-]?{_NUMBER}(?![a-z.,0-9])")
_DARK = re.compile(r"(?<![a-z])(?:darks?(?:frames?)?|bias|closed|nolight)(?![a-z])")
_INDEX = re.compile(r"(?:[ ._-]*(?:frame|image|img|shot|no|n|f|#)?[ ._-]*\d+|[ ._-][ab])$")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}


class NamedFrame(NamedTuple):
    """Properties of frames according to the name of their file; None for those that it does not
    state.
    """

    level: str  #: the name without exposure, light and the number of the frame
    dark: bool
    exposure: float | None  #: s
    photons: float | None  #: per pixel and exposure
    written: str = ""  #: the part of the name that is read as the exposure
    doubtful: str = ""  #: a part that may be a fraction of a second, or a number and seconds


class _Exposure(NamedTuple):
    seconds: float
    written: str


def read_name(file: Path, folder: Path) -> NamedFrame:
    """Return the properties that the path of a file below ``folder`` states:
    ``flat_10ms_1200ph_2.tif``.

    Folders count as parts of the name: ``dark/10ms/1.png``. An exposure is a number and its unit in
    either order: ``10ms``, ``10p5ms``, ``exp_ms_10``, or a fraction of a second such as ``1-200s``.
    """
    path_parts = file.relative_to(folder).with_suffix("").parts
    text = "/".join(path_parts).lower()
    exposure_match, light_match = _exposure(text), _last(_AFTER, text) or _last(_BEFORE, text)
    dark = _DARK.search(text) is not None
    photons: float | None = None
    if dark:
        photons = 0.0
    elif light_match is not None:
        photons = _float(light_match[1])
    # the name without exposure, light and number of the frame identifies its level
    remaining_text = text.replace(exposure_match.written, "") if exposure_match else text
    remaining_text = remaining_text.replace(light_match[0], "") if light_match else remaining_text
    level = _INDEX.sub("", remaining_text).strip(" /._-")
    seconds, written = (
        (exposure_match.seconds, exposure_match.written) if exposure_match else (None, "")
    )
    doubtful = _last(_DOUBTFUL, text)
    doubtful_text = doubtful[0] if doubtful and not _last(_FRACTION, text) else ""
    return NamedFrame(
        level, dark or photons == 0, seconds, photons, written.strip(" =_-"), doubtful_text
    )


def _exposure(text: str) -> _Exposure | None:
    """Return the last exposure of a name: a fraction, or else a number before its unit, or else a
    number after its unit.
    """
    if fraction := _last(_FRACTION, text):
        return _Exposure(1 / _float(fraction[1]), fraction[0])
    if match := _last(_EXPOSURE, text):
        return _Exposure(_float(match[1]) * _SECONDS[match[2]], match[0])
    if match := _last(_UNIT_FIRST, text) or _last(_SHORT_UNIT_FIRST, text):
        return _Exposure(_float(match[2]) * _SECONDS[match[1]], match[0])
    return None


def _last(pattern: re.Pattern[str], text: str) -> re.Match[str] | None:
    """Return the last match of a pattern in a text, or None."""
    matches = list(pattern.finditer(text))
    return matches[-1] if matches else None


def _float(number: str) -> float:
    """Return a number of a file name, in which a comma or a p may stand for the point."""
    return float(number.replace(",", ".").replace("p", "."))


# --- frame table ----------------------------------------------------------------------------------

# A table that names the exposure and the light of each file of frames.


_TIMES = {
    "exposure": 0.0,
    "exposure_s": 1.0,
    "exposure_ms": 1e-3,
    "exposure_us": 1e-6,
    "exposure_ns": 1e-9,
}
_FRACTION_IN_TABLE = re.compile(r"\s*(\d+)\s*[/⁄]\s*([1-9]\d*(?:\.\d+)?)\s*(s|sec)?\s*")  #: 1/200 s
_COLUMNS = "file, exposure (such as 10 ms) or exposure_ms, and photons or light"


class TableRow(NamedTuple):
    """A line of a table: a file and its properties; None for an empty cell or a missing column."""

    line: int
    file: Path
    exposure: float | None  #: s
    photons: float | None  #: per pixel and exposure
    light: float | None  #: relative


def find_table(folder: Path) -> Path | None:
    """Return the only CSV file of a folder with a column ``file``, or None; raise ValueError for
    several.
    """
    tables = [path for path in sorted(folder.glob("*.csv")) if "file" in _header(path)]
    if len(tables) > 1:
        raise ValueError(
            f"{folder} has {len(tables)} tables of frames, {', '.join(p.name for p in tables)}:"
            " keep one table"
        )
    return tables[0] if tables else None


def read_table(table: Path) -> list[TableRow]:
    """Return the lines of a table of frames; raise ValueError with all mistakes, each with its
    line.
    """
    items = list(_read(table))
    rows = [item for item in items if isinstance(item, TableRow)]
    if problems := [item for item in items if isinstance(item, str)]:
        raise ValueError("\n".join(problems))
    if not rows:
        raise ValueError(f"{table.name} has no line below its header: write one line for each file")
    return rows


def _header(table: Path) -> list[str]:
    """Return the headings of a table in small letters; none for a file that cannot be read."""
    try:
        return next(([cell.strip().lower() for cell in row] for _, row in csv_rows(table)), [])
    except ValueError:
        return []


def _read(table: Path) -> Iterator[TableRow | str]:
    """Yield each line of a table, or in its place a message with the mistake in it."""
    lines = csv_rows(table)
    names = [cell.strip().lower() for cell in next(lines)[1]]
    time_column = next((name for name in names if name in _TIMES), "")
    if unknown_columns := [
        name for name in names if name not in (*_TIMES, "file", "photons", "light")
    ]:
        yield f"{table.name}:1: column {unknown_columns[0]} is unknown: write {_COLUMNS}"
    for line, cells in lines:
        row = dict(zip(names, (cell.strip() for cell in cells), strict=False))
        try:
            yield _table_row(table, line, row, time_column)
        except ValueError as error:
            yield f"{table.name}:{line}: {error}"


def _table_row(table: Path, line: int, row: Mapping[str, str], time: str) -> TableRow:
    """Return one row of the table of frames.

    Raises ValueError if the file of the row is missing, or if a value is not a number.
    """
    file = table.parent / row.get("file", "")
    if not file.is_file():
        raise ValueError(f"no such file: {row.get('file') or '(empty)'}")
    exposure = _exposure_of_row(row.get(time, ""), time)
    return TableRow(line, file, exposure, _light(row, "photons"), _light(row, "light"))


def _exposure_of_row(text: str, column: str) -> float | None:
    """Return the exposure of a row in s, or None for an empty cell.

    The heading of the column may give the unit, or the text itself, as in ``10 ms`` or ``1/200 s``.
    """
    if not text:
        return None
    scale = _TIMES[column]
    if fraction := _FRACTION_IN_TABLE.fullmatch(text):
        # a fraction has the unit of the column, unless its own s says seconds
        number, unit = float(fraction[1]) / float(fraction[2]), "s" if scale or fraction[3] else ""
        # 0 stands for no unit in the heading: the number is in s already
        scale = 0.0 if fraction[3] else scale
    else:
        number, unit = (float(text), "s") if scale else read_any(text)
    if unit != "s" or not 0 < number < math.inf:
        raise ValueError(
            f"exposure {text}: write a time with a unit, such as 10 ms, or name the column"
            " exposure_ms"
        )
    return number * (scale or 1.0)


def _light(row: Mapping[str, str], column: str) -> float | None:
    """Return the light of a row, or None for an empty cell.

    Raise ValueError for anything but a number of 0 or more.
    """
    text = row.get(column, "")
    if not text:
        return None
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 <= number < math.inf:
        raise ValueError(f"{column} {text}: write a number of 0 or more")
    return number


# --- odd frames -----------------------------------------------------------------------------------

# Frames whose mean does not fit their level, as where a file has the wrong name.


#: largest difference of two frames, relative to their signal, and to the brightest signal
_OFF, _FLOOR = 0.1, 0.01

_CHANCE_ERRORS = 6.0  #: standard errors of a mean, added to the difference

Files = tuple[str, bool, Sequence[Path]]  #: name of a level, True for a dark one, its files


def _means(files: Sequence[Path]) -> list[tuple[Path, float, float]]:
    """Return file, mean and standard error of each frame of a level."""
    means = []
    for file in files:
        means += [(file, mean, error) for mean, error in frame_means(file)]
    return means


def misplaced_frames(levels: Sequence[Files], folder: Path) -> Iterator[str]:
    """Yield a sentence for each level whose frames differ too much in their means, or one sentence
    if the dark frames are not dark.
    """
    frame_means_of_levels = [_means(files) for _, _, files in levels]
    level_medians = [
        float(np.median([mean for _, mean, _ in of_level])) for of_level in frame_means_of_levels
    ]
    dark_medians = _of_kind(level_medians, levels, dark=True)
    lit_medians = _of_kind(level_medians, levels, dark=False)
    # half of the lit levels must be brighter than every dark
    half_of_lit = float(np.median(lit_medians))
    if half_of_lit <= max(dark_medians):
        yield (
            f"{folder}: dark frames have means up to {max(dark_medians):.0f} DN, and half of the"
            f" lit levels have at most {half_of_lit:.0f} DN: cover the lens, or check which files"
            " are dark"
        )
        return
    darkest, brightest = min(dark_medians), max(level_medians)
    for (_, dark, _), of_level, level_median in zip(
        levels, frame_means_of_levels, level_medians, strict=True
    ):
        # a share of the signal of the level, a share of the range of all, and chance
        allowed_difference = _OFF * (0.0 if dark else level_median - darkest) + _FLOOR * (
            brightest - darkest
        )
        allowed_difference += _CHANCE_ERRORS * max(error for _, _, error in of_level)
        frames = [(file, mean) for file, mean, _ in of_level]
        if _spread(frames) > allowed_difference:
            yield _misfit_of_level(frames, level_median, allowed_difference, folder)


def _of_kind(middles: Sequence[float], levels: Sequence[Files], dark: bool) -> list[float]:
    """Return the middle values of the dark or of the lit levels."""
    return [
        level_median
        for level_median, level in zip(middles, levels, strict=True)
        if level[1] == dark
    ]


def _spread(frames: Sequence[tuple[Path, float]]) -> float:
    """Return the difference of the largest and the smallest mean of frames."""
    values = [mean for _, mean in frames]
    return max(values) - min(values)


def _misfit_of_level(
    frames: Sequence[tuple[Path, float]], middle: float, room: float, folder: Path
) -> str:
    """Return a sentence that names the frame that does not fit its level, or both frames
    of a pair.
    """
    values = [mean for _, mean in frames]
    if len(values) == 2:
        (first_file, first_mean), (second_file, second_mean) = frames
        both_named = (
            f"{_name(first_file, folder)} and {_name(second_file, folder)} count as one"
            f" level, but have means of {first_mean:.1f} and"
        )
        return f"{both_named} {second_mean:.1f} DN: check the names and the table"
    file, mean = max(frames, key=lambda pair: abs(pair[1] - middle))
    return (
        f"{_name(file, folder)} has a mean of {mean:.1f} DN, but its level has {middle:.1f} DN"
        f" and may differ by {room:.1f} DN: check the name of the file, or remove the file"
    )


def _name(file: Path, folder: Path) -> str:
    return str(file.relative_to(folder)) if file.is_relative_to(folder) else str(file)


# --- frame folder ---------------------------------------------------------------------------------

# The light levels in a folder of frames: which files belong together, and what is missing or does
# not fit.


SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr", ".fits", ".fit", ".fts")
#: suffixes of pictures that hold no raw grey numbers, or that this program does not read
NOT_READ = (
    ".jpg",
    ".jpeg",
    ".jpe",
    ".jp2",
    ".heic",
    ".heif",
    ".webp",
    ".gif",
    ".bmp",
    ".dng",
    ".cr2",
    ".cr3",
    ".nef",
    ".arw",
    ".raf",
    ".rw2",
    ".orf",
    ".avi",
    ".mp4",
    ".mov",
)
_LOSSY = (".jpg", ".jpeg", ".jpe", ".jp2", ".heic", ".heif", ".webp")
_FILES_SHOWN = 3  #: files that a message names
#: least number of lit levels: from fewer, only the priors determine gain, bend, twist and lamp
_LIT = 4
_HOW_TO_NAME = """name files such as dark_10ms_1.png and lit_10ms_5000ph_1.png (exposure, photons
of a pixel, number of the frame), or write a table frames.csv with the columns file, exposure and
photons, or light for light that is known up to a factor""".replace("\n", " ")

Light = Literal["photons", "relative", "exposure"]  #: how the light of the levels is known


class FolderRefused(ValueError):
    """Error raised if the frames of a folder are no measurement; the text has all reasons, one a
    line.
    """


@dataclass(frozen=True)
class Frame:
    """A file of frames with the properties that its name, its header or a table states."""

    file: Path
    header: FrameHeader
    level: str
    dark: bool
    exposure: float | None  #: s
    photons: float | None  #: per pixel and exposure
    light: float | None = None  #: relative
    told: str = ""  #: source of the exposure, such as ``1-200s`` of a name


class FolderLevel(NamedTuple):
    """Frames with the same illumination."""

    name: str
    files: tuple[Path, ...]
    dark: bool
    exposure: float  #: s
    light: float  #: photons, or relative light; 0 in the dark


class FolderLevels(NamedTuple):
    """The light levels of a folder, and how their light is known."""

    levels: tuple[FolderLevel, ...]
    light: Light
    source: str  #: source of exposure and light, in words


def find_levels(folder: Path, progress: Progress = silent) -> FolderLevels:
    """Return the light levels that the files of a folder hold.

    ``progress`` receives a line for each exposure that was read, before any frame is read.

    Raises: `FolderRefused` with every reason why they are no measurement.
    """
    frames, source, problems = _read_folder(folder)
    unread_files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in NOT_READ)
    problems += [*_sizes(frames, folder), *_unknown(frames, folder)]
    if problems or not frames:
        raise FolderRefused("\n".join(problems or [_no_frames(folder, unread_files)]))
    for line in (*_exposures(frames, folder), *_unread_line(unread_files, folder)):
        progress(line)
    light = _kind_of_light(frames)
    groups = _groups(frames, light)
    levels = tuple(_named(groups))
    problems = [*_numbers(groups, levels, folder), *_light_problems(levels, light)]
    # the frames are read only if everything else is right
    if not problems:
        problems = list(
            misplaced_frames([(level.name, level.dark, level.files) for level in levels], folder)
        )
    if problems:
        raise FolderRefused("\n".join(problems))
    return FolderLevels(levels, light, source)


def _no_frames(folder: Path, unread: Sequence[Path]) -> str:
    """Return why a folder has no frames: it is empty, or its pictures are of other kinds."""
    if not unread:
        return f"{folder}: the folder contains no frames: {_HOW_TO_NAME}"
    kinds = "/".join(sorted({path.suffix.lower() for path in unread}))
    are_lossy = all(path.suffix.lower() in _LOSSY for path in unread)
    reason = (
        "JPEG and similar formats change the noise of each pixel"
        if are_lossy
        else "they contain no raw grey values"
    )
    return (
        f"{_some(unread, folder)}: {kinds} cannot be used for a calibration: {reason}; save the"
        f" raw frames of one channel as PNG or TIFF of 16 bits, FITS or NumPy, and {_HOW_TO_NAME}"
    )


def _exposures(frames: Sequence[Frame], folder: Path) -> Iterator[str]:
    """Yield a line for each exposure with its source, so that the user sees a wrong one before the
    computation.
    """
    by_source: dict[tuple[bool, float, str], list[Path]] = defaultdict(list)
    for frame in frames:
        by_source[not frame.dark, frame.exposure or 0.0, frame.told].append(frame.file)
    for (is_lit, exposure, source), files in sorted(by_source.items()):
        kind, count_text = (
            "lit" if is_lit else "dark",
            f"{len(files)} file{'s' * (len(files) != 1)}",
        )
        yield (
            f"{kind}: exposure {_readable(exposure)}, from {source}: {count_text} such as"
            f" {_short(files[0], folder)}"
        )


def _readable(seconds: float) -> str:
    """Return a time in the largest unit in which it is 1 or more."""
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= scale:
            return f"{seconds / scale:.6g} {unit}"
    return f"{seconds / 1e-9:.6g} ns"


def _unread_line(unread: Sequence[Path], folder: Path) -> Iterator[str]:
    """Yield a line with the pictures of the folder that are of other kinds, if there are any."""
    if unread:
        yield f"not read: {_some(unread, folder)}"


def _read_folder(folder: Path) -> tuple[list[Frame], str, list[str]]:
    """Return the frames of a folder, the source of their properties in words, and the problems of
    single files.
    """
    try:
        table = find_table(folder)
        rows = read_table(table) if table else []
    except ValueError as error:
        return [], "", [str(error)]
    row_of_file = {row.file.resolve(): row for row in rows}
    # a table says which files count
    files = [row.file for row in rows] if rows else _frame_files(folder)
    frames, problems = list[Frame](), list[str]()
    for file in files:
        name, row = read_name(file, folder), row_of_file.get(file.resolve())
        try:
            header = frame_header(file)
        except ValueError as error:
            problems.append(str(error))
            continue
        frames.append(_frame(file, name, row, header, table))
        problems += _contradiction(frames[-1], name, row, table, folder)
        if row is None or row.exposure is None:
            problems += _doubt(frames[-1], name, files, folder)
    return frames, _sources(table), problems


def _sources(table: Path | None) -> str:
    """Return the source of light and exposure of the frames of a folder, in words."""
    return f"the table {table.name}" if table else "names and headers of the files"


def _frame_files(folder: Path) -> list[Path]:
    """Return the files of frames in a folder and the folders within, sorted."""
    return sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)


def _frame(
    file: Path, name: NamedFrame, row: TableRow | None, header: FrameHeader, table: Path | None
) -> Frame:
    """Return a frame with the properties that a table states, or else its name, or else
    its header.
    """
    photons, exposure = (row.photons, row.exposure) if row else (name.photons, name.exposure)
    light = row.light if row else None
    # a light above 0 in the table overrides the word dark in a name
    dark = 0.0 in (photons, light, header.photons) or (name.dark and not photons and not light)
    table_of_row = table if row else None
    source = _source(exposure, name, table_of_row)
    if exposure is None:
        exposure = header.exposure
    if photons is None:
        photons = header.photons
    return Frame(
        file=file,
        header=header,
        level=name.level,
        dark=dark,
        exposure=exposure,
        photons=photons,
        light=light,
        told=source,
    )


def _source(exposure: float | None, name: NamedFrame, table: Path | None) -> str:
    """Return the source of the exposure of a frame, in words."""
    if exposure is None:
        return "the header"
    return table.name if table else f"{name.written} of the name"


def _contradiction(
    frame: Frame, name: NamedFrame, row: TableRow | None, table: Path | None, folder: Path
) -> Iterator[str]:
    """Yield a problem if a name or a table states another exposure than the header."""
    stated_exposure, header_exposure = row.exposure if row else name.exposure, frame.header.exposure
    # 1 %, because names have rounded times
    if (
        stated_exposure is None
        or header_exposure is None
        or abs(stated_exposure - header_exposure) <= 0.01 * header_exposure
    ):
        return
    speaker = f"{table.name}:{row.line}" if table and row else "its name"
    yield (
        f"{_short(frame.file, folder)}: {speaker} says {stated_exposure:g} s, but its header says"
        f" {header_exposure:g} s"
    )


def _doubt(frame: Frame, name: NamedFrame, files: Sequence[Path], folder: Path) -> Iterator[str]:
    """Yield a problem for a name such as ``dark_1_200s``, unless a frame 2 shows that the 1 is the
    number of a frame.
    """
    if not name.doubtful or frame.header.exposure is not None:
        return
    text = str(frame.file.relative_to(folder)).lower()
    # the same name with a 2 in place of the 1
    name_of_second = text.replace(name.doubtful, "2" + name.doubtful[1:])
    if name_of_second in (str(path.relative_to(folder)).lower() for path in files):
        return
    seconds = float(re.findall(r"\d+", name.doubtful)[-1])
    yield (
        f"{_short(frame.file, folder)}: {name.doubtful} may mean 1/{seconds:g} s, or number 1 of"
        f" {seconds:g} s: write {_readable(1 / seconds).replace(' ', '')} or {seconds:g}s, or a"
        " table frames.csv"
    )


def _short(file: Path, folder: Path) -> str:
    """Return the path of a file relative to the folder, if it lies in it."""
    if file.is_relative_to(folder):
        return str(file.resolve().relative_to(folder.resolve()))
    return str(file)


def _some(files: Sequence[Path], folder: Path) -> str:
    """Return the names of the first files, and how many more there are."""
    names = ", ".join(_short(file, folder) for file in files[:_FILES_SHOWN])
    return names + f" and {len(files) - _FILES_SHOWN} more" * (len(files) > _FILES_SHOWN)


def _sizes(frames: Sequence[Frame], folder: Path) -> Iterator[str]:
    """Yield a problem where frames differ in size or in the bits of a number from most others."""
    sizes = [f"{frame.header.shape[1]} x {frame.header.shape[0]}" for frame in frames]
    for quantity, values in (
        ("pixels", sizes),
        ("bits", [str(frame.header.bits) for frame in frames]),
    ):
        counts = Counter(values)
        if len(counts) > 1:
            usual_value = counts.most_common(1)[0][0]
            unusual_files = [
                frame.file
                for frame, text in zip(frames, values, strict=True)
                if text != usual_value
            ]
            other_values = ", ".join(sorted(counts.keys() - {usual_value}))
            yield (
                f"{_some(unusual_files, folder)}: {other_values} {quantity}, but"
                f" {counts[usual_value]} files have {usual_value} {quantity}: give frames of the"
                " same sensor and the same settings"
            )


def _unknown(frames: Sequence[Frame], folder: Path) -> Iterator[str]:
    """Yield a problem for unknown exposures, for missing darks, and for lit frames of which only
    some have a known light.
    """
    if without_exposure := [frame.file for frame in frames if frame.exposure is None]:
        yield f"{_some(without_exposure, folder)}: the exposure is unknown: {_HOW_TO_NAME}"
    lit_frames = [frame for frame in frames if not frame.dark]
    if frames and len(lit_frames) == len(frames):
        yield (
            f"{folder}: there are no dark frames: cover the lens, take two or more frames, and"
            " name them such as dark_10ms_1.png"
        )
    yield from _partly_known("photons", lit_frames, folder)
    yield from _partly_known("light", lit_frames, folder)


def _partly_known(name: str, lit: Sequence[Frame], folder: Path) -> Iterator[str]:
    """Yield a problem if some lit frames lack a light that others have."""
    missing = [frame.file for frame in lit if getattr(frame, name) is None]
    if 0 < len(missing) < len(lit):
        yield (
            f"{_some(missing, folder)}: {name} is missing, which {len(lit) - len(missing)} other"
            f" lit files have: {_HOW_TO_NAME}"
        )


def _kind_of_light(frames: Sequence[Frame]) -> Light:
    """Return how the light of the lit frames is known.

    It is known in photons, relatively, or by the exposure alone.
    """
    lit_frames = [frame for frame in frames if not frame.dark]
    if all(frame.photons is not None for frame in lit_frames):
        return "photons"
    return "relative" if all(frame.light is not None for frame in lit_frames) else "exposure"


_Key = tuple[bool, float, float, str]


def _groups(frames: Sequence[Frame], light: Light) -> dict[_Key, list[Frame]]:
    """Return the frames of each level by their common properties, in rising order of light and
    exposure.

    Where only exposures tell the light, frames of one exposure are one level if their names agree
    too.
    """
    groups: dict[_Key, list[Frame]] = defaultdict(list)
    for frame in frames:
        assert frame.exposure is not None
        # six digits, so that rounding in headers makes no levels of its own
        rounded_exposure = float(f"{frame.exposure:.6g}")
        if frame.dark:
            groups[True, 0.0, rounded_exposure, ""].append(frame)
        elif light == "exposure":
            groups[False, rounded_exposure, rounded_exposure, frame.level].append(frame)
        else:
            light_amount = frame.photons if light == "photons" else frame.light
            groups[False, float(light_amount or 0.0), rounded_exposure, ""].append(frame)
    # darks first
    return dict(sorted(groups.items(), key=lambda item: (not item[0][0], *item[0][1:])))


def _named(groups: dict[_Key, list[Frame]]) -> Iterator[FolderLevel]:
    """Yield each level with a name: darks by their exposure, lit levels by number."""
    lit_count = 0
    for (dark, light, exposure, _), frames in groups.items():
        lit_count += not dark
        name = f"dark_{_time(exposure)}" if dark else f"lit_{lit_count:02d}"
        yield FolderLevel(name, tuple(frame.file for frame in frames), dark, exposure, light)


def _time(seconds: float) -> str:
    """Return a time in ms as part of a name: a word of letters and digits."""
    return f"{1e3 * seconds:.6g}ms".replace(".", "p").replace("+", "")


def _numbers(
    groups: dict[_Key, list[Frame]], levels: Sequence[FolderLevel], folder: Path
) -> Iterator[str]:
    """Yield a problem for levels of one frame, and for too few lit levels."""
    single_frames = [frames[0].file for frames in groups.values() if _count(frames) < 2]
    if single_frames:
        yield (
            f"{_some(single_frames, folder)}: the level has a single frame: take two or more"
            " frames of each exposure and light, or give the frames of a level the same name with"
            " a number at its end, such as _1 and _2"
        )
    lit_count = len({level.light for level in levels if not level.dark})
    if lit_count < _LIT:
        yield (
            f"{folder}: {lit_count} lit level{'s' * (lit_count != 1)}: take {_LIT} or more levels"
            " of different light, up to saturation"
        )


def _count(frames: Sequence[Frame]) -> int:
    """Return the number of frames in the files of a level."""
    return sum(frame.header.frames for frame in frames)


def _light_problems(levels: Sequence[FolderLevel], light: Light) -> Iterator[str]:
    """Yield a problem if the light is known by exposures alone, and two levels have the same
    exposure.
    """
    if light != "exposure":
        return
    lit_exposures = [level.exposure for level in levels if not level.dark]
    if len(set(lit_exposures)) < len(lit_exposures):
        yield f"the light of levels with the same exposure is unknown: {_HOW_TO_NAME}"
