"""The light levels in a folder of frames: which files belong together, and what is missing or does not fit."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from neusee.nodes.calibrate import FrameHeader, frame_header
from neusee.workflows.frames.frame_names import NamedFrame, read_name
from neusee.workflows.frames.frame_table import TableRow, find_table, read_table
from neusee.workflows.frames.odd_frames import misplaced_frames
from neusee.workflows.report.study_folder import Progress, silent

SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr", ".fits", ".fit", ".fts")
#: suffixes of pictures that hold no raw grey numbers, or that nothing here reads
NOT_READ = (".jpg", ".jpeg", ".jpe", ".jp2", ".heic", ".heif", ".webp", ".gif", ".bmp", ".dng", ".cr2", ".cr3", ".nef",
            ".arw", ".raf", ".rw2", ".orf", ".avi", ".mp4", ".mov")  # fmt: skip
_LOSSY = (".jpg", ".jpeg", ".jpe", ".jp2", ".heic", ".heif", ".webp")
_SHOWN = 3  #: files that a message names
_LIT = 4  #: lit levels: a gain, a bend, a twist and the lamp are told from fewer only by their priors
_SAME = 1e-6  #: relative difference of two exposures that are one
_HOW = """name files such as dark_10ms_1.png and lit_10ms_5000ph_1.png (exposure, photons of a pixel, number of the
frame), or write a table frames.csv with the columns file, exposure and photons, or light for light that is known up to
a factor""".replace("\n", " ")

Light = Literal["photons", "relative", "exposure"]  #: how the light of the levels is known


class FolderRefused(ValueError):
    """Error raised if the frames of a folder are no measurement; the text has all reasons, one a line."""


@dataclass(frozen=True)
class Frame:
    """A file of frames with what its name, its header or a table tells."""

    file: Path
    header: FrameHeader
    level: str
    dark: bool
    exposure: float | None  #: s
    photons: float | None  #: per pixel and exposure
    light: float | None = None  #: relative
    told: str = ""  #: what said the exposure, such as ``1-200s`` of a name


class FolderLevel(NamedTuple):
    """Frames of one illumination."""

    name: str
    files: tuple[Path, ...]
    dark: bool
    exposure: float  #: s
    light: float  #: photons, or relative light; 0 in the dark


class FolderLevels(NamedTuple):
    """The light levels of a folder, and how their light is known."""

    levels: tuple[FolderLevel, ...]
    light: Light
    source: str  #: what told exposure and light, in words


def find_levels(folder: Path, progress: Progress = silent) -> FolderLevels:
    """Return the light levels that the files of a folder hold.

    ``progress`` receives a line for each exposure that was read, before any frame is read.

    Raises: `FolderRefused` with every reason why they are no measurement.
    """
    frames, source, problems = _found(folder)
    unread = sorted(path for path in folder.rglob("*") if path.suffix.lower() in NOT_READ)
    problems += [*_sizes(frames, folder), *_unknown(frames, folder)]
    if problems or not frames:
        raise FolderRefused("\n".join(problems or [_no_frames(folder, unread)]))
    for line in (*_exposures(frames, folder), *_left(unread, folder)):
        progress(line)
    light = _kind_of_light(frames)
    groups = _groups(frames, light)
    levels = tuple(_named(groups))
    problems = [*_numbers(groups, levels, folder), *_light_problems(levels, light)]
    if not problems:
        problems = list(misplaced_frames([(level.name, level.dark, level.files) for level in levels], folder))
    if problems:
        raise FolderRefused("\n".join(problems))
    return FolderLevels(levels, light, source)


def _no_frames(folder: Path, unread: Sequence[Path]) -> str:
    """Return why a folder has no frames: it is empty, or its pictures are of other kinds."""
    if not unread:
        return f"{folder}: no frames: {_HOW}"
    kinds = "/".join(sorted({path.suffix.lower() for path in unread}))
    lossy = all(path.suffix.lower() in _LOSSY for path in unread)
    why = "JPEG and its like change the noise of each pixel" if lossy else "no raw grey numbers are read from them"
    return (f"{_some(unread, folder)}: {kinds} cannot be calibrated: {why}; save the raw frames of one channel as PNG "
            f"or TIFF of 16 bits, FITS or NumPy, and {_HOW}")  # fmt: skip


def _exposures(frames: Sequence[Frame], folder: Path) -> Iterator[str]:
    """Yield a line for each exposure with what said it, so that a wrong one is seen before the work."""
    told: dict[tuple[bool, float, str], list[Path]] = defaultdict(list)
    for frame in frames:
        told[not frame.dark, frame.exposure or 0.0, frame.told].append(frame.file)
    for (lit, seconds, text), files in sorted(told.items()):
        kind, count = "lit" if lit else "dark", f"{len(files)} file{'s' * (len(files) != 1)}"
        yield f"{kind}: exposure {_readable(seconds)}, from {text}: {count} such as {_short(files[0], folder)}"


def _readable(seconds: float) -> str:
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= scale:
            return f"{seconds / scale:.6g} {unit}"
    return f"{seconds / 1e-9:.6g} ns"


def _left(unread: Sequence[Path], folder: Path) -> Iterator[str]:
    if unread:
        yield f"not read: {_some(unread, folder)}"


def _found(folder: Path) -> tuple[list[Frame], str, list[str]]:
    """Return the frames of a folder, what told of them, and the problems of single files."""
    frames, problems = list[Frame](), list[str]()
    try:
        table = find_table(folder)
        rows = read_table(table) if table else []
    except ValueError as error:
        return [], "", [str(error)]
    listed = {row.file.resolve(): row for row in rows}
    files = [row.file for row in rows] or sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES)
    for file in files:
        name, row = read_name(file, folder), listed.get(file.resolve())
        try:
            header = frame_header(file)
        except ValueError as error:
            problems.append(str(error))
            continue
        frames.append(_frame(file, name, row, header, table))
        problems += _contradiction(frames[-1], name, row, table, folder)
        if row is None or row.exposure is None:
            problems += _doubt(frames[-1], name, files, folder)
    return frames, f"the table {table.name}" if table else "names and headers of the files", problems


def _frame(file: Path, name: NamedFrame, row: TableRow | None, header: FrameHeader, table: Path | None) -> Frame:
    """Return a frame with what a table says of it, else its name, else its header."""
    photons, exposure = (row.photons, row.exposure) if row else (name.photons, name.exposure)
    light = row.light if row else None
    dark = 0.0 in (photons, light, header.photons) or (name.dark and not photons and not light)
    told = "the header"
    if exposure is not None:
        told = table.name if row and table else f"{name.written} of the name"
    return Frame(
        file=file,
        header=header,
        level=name.level,
        dark=dark,
        exposure=header.exposure if exposure is None else exposure,
        photons=header.photons if photons is None else photons,
        light=light,
        told=told,
    )


def _contradiction(
    frame: Frame, name: NamedFrame, row: TableRow | None, table: Path | None, folder: Path
) -> Iterator[str]:
    """Yield a problem where a name or a table says another exposure than the header."""
    said, header = row.exposure if row else name.exposure, frame.header.exposure
    if said is None or header is None or abs(said - header) <= 0.01 * header:
        return
    who = f"{table.name}:{row.line}" if table and row else "its name"
    yield f"{_short(frame.file, folder)}: {who} says {said:g} s, its header {header:g} s"


def _doubt(frame: Frame, name: NamedFrame, files: Sequence[Path], folder: Path) -> Iterator[str]:
    """Yield a problem for a name such as ``dark_1_200s``, unless a frame 2 shows that the 1 is a number of frames."""
    if not name.doubtful or frame.header.exposure is not None:
        return
    text = str(frame.file.relative_to(folder)).lower()
    second = text.replace(name.doubtful, "2" + name.doubtful[1:])
    if second in (str(path.relative_to(folder)).lower() for path in files):
        return
    seconds = float(re.findall(r"\d+", name.doubtful)[-1])
    yield (f"{_short(frame.file, folder)}: {name.doubtful} may be 1/{seconds:g} s, or number 1 of {seconds:g} s: write "
           f"{_readable(1 / seconds).replace(' ', '')} or {seconds:g}s, or a table frames.csv")  # fmt: skip


def _short(file: Path, folder: Path) -> str:
    return str(file.resolve().relative_to(folder.resolve())) if file.is_relative_to(folder) else str(file)


def _some(files: Sequence[Path], folder: Path) -> str:
    names = ", ".join(_short(file, folder) for file in files[:_SHOWN])
    return names + f" and {len(files) - _SHOWN} more" * (len(files) > _SHOWN)


def _sizes(frames: Sequence[Frame], folder: Path) -> Iterator[str]:
    """Yield a problem where frames differ in size or in the bits of a number from most others."""
    sizes = [f"{frame.header.shape[1]} x {frame.header.shape[0]}" for frame in frames]
    for what, has in (("pixels", sizes), ("bits", [str(frame.header.bits) for frame in frames])):
        counts = Counter(has)
        if len(counts) > 1:
            usual = counts.most_common(1)[0][0]
            odd = [frame.file for frame, text in zip(frames, has, strict=True) if text != usual]
            others = ", ".join(sorted(counts.keys() - {usual}))
            yield (f"{_some(odd, folder)}: {others} {what}, but {counts[usual]} files have {usual} {what}: give frames "
                   "of one sensor and one setting")  # fmt: skip


def _unknown(frames: Sequence[Frame], folder: Path) -> Iterator[str]:
    """Yield what is not known of the frames: exposures, darks, or the light of some."""
    if timeless := [frame.file for frame in frames if frame.exposure is None]:
        yield f"{_some(timeless, folder)}: the exposure is unknown: {_HOW}"
    lit = [frame for frame in frames if not frame.dark]
    if frames and len(lit) == len(frames):
        yield f"{folder}: no dark frames: cover the lens, take two or more, and name them such as dark_10ms_1.png"
    for name in ("photons", "light"):
        missing = [frame.file for frame in lit if getattr(frame, name) is None]
        if 0 < len(missing) < len(lit):
            yield f"{_some(missing, folder)}: no {name}, which {len(lit) - len(missing)} other lit files have: {_HOW}"


def _kind_of_light(frames: Sequence[Frame]) -> Light:
    lit = [frame for frame in frames if not frame.dark]
    if all(frame.photons is not None for frame in lit):
        return "photons"
    return "relative" if all(frame.light is not None for frame in lit) else "exposure"


_Key = tuple[bool, float, float, str]


def _groups(frames: Sequence[Frame], light: Light) -> dict[_Key, list[Frame]]:
    """Return the frames of each level, in rising order of light and exposure, by what they have in common.

    Where only exposures tell the light, frames of one exposure are one level if their names agree too.
    """
    groups: dict[_Key, list[Frame]] = defaultdict(list)
    for frame in frames:
        assert frame.exposure is not None
        time = float(f"{frame.exposure:.6g}")
        if frame.dark:
            groups[True, 0.0, time, ""].append(frame)
        elif light == "exposure":
            groups[False, time, time, frame.level].append(frame)
        else:
            told = frame.photons if light == "photons" else frame.light
            groups[False, float(told or 0.0), time, ""].append(frame)
    return dict(sorted(groups.items(), key=lambda item: (not item[0][0], *item[0][1:])))


def _named(groups: dict[_Key, list[Frame]]) -> Iterator[FolderLevel]:
    lit = 0
    for (dark, light, time, _), frames in groups.items():
        lit += not dark
        name = f"dark_{_time(time)}" if dark else f"lit_{lit:02d}"
        yield FolderLevel(name, tuple(frame.file for frame in frames), dark, time, light)


def _time(seconds: float) -> str:
    return f"{1e3 * seconds:.6g}ms".replace(".", "p").replace("+", "")


def _numbers(groups: dict[_Key, list[Frame]], levels: Sequence[FolderLevel], folder: Path) -> Iterator[str]:
    """Yield a problem for levels of one frame, and for too few lit levels."""
    single = [f[0].file for f in groups.values() if sum(frame.header.frames for frame in f) < 2]
    if single:
        yield (f"{_some(single, folder)}: one frame of its level: take two or more frames of each exposure and light, "
               "or give frames of one level one name with a number at its end, such as _1 and _2")  # fmt: skip
    lit = len({level.light for level in levels if not level.dark})
    if lit < _LIT:
        yield f"{folder}: {lit} lit level{'s' * (lit != 1)}: take {_LIT} or more of different light, up to saturation"


def _light_problems(levels: Sequence[FolderLevel], light: Light) -> Iterator[str]:
    if light != "exposure":
        return
    times = [level.exposure for level in levels if not level.dark]
    if len(set(times)) < len(times):
        yield f"the light of levels of one exposure is unknown: {_HOW}"
