"""The light levels in a folder of frames: which files belong together, and what is missing or does not fit."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from neusee.nodes.calibrate import FrameHeader, frame_header
from neusee.workflows.frames.frame_names import read_name
from neusee.workflows.frames.frame_table import find_table, read_table
from neusee.workflows.frames.odd_frames import misplaced_frames

SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr", ".fits", ".fit", ".fts")
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


def find_levels(folder: Path) -> FolderLevels:
    """Return the light levels that the files of a folder hold.

    Raises: `FolderRefused` with every reason why they are no measurement.
    """
    frames, source, problems = _found(folder)
    problems += [*_sizes(frames, folder), *_unknown(frames, folder)]
    if problems or not frames:
        raise FolderRefused("\n".join(problems or [f"{folder}: no frames: {_HOW}"]))
    light = _kind_of_light(frames)
    groups = _groups(frames, light)
    levels = tuple(_named(groups))
    problems = [*_numbers(groups, levels, folder), *_light_problems(levels, light)]
    if not problems:
        problems = list(misplaced_frames([(level.name, level.dark, level.files) for level in levels], folder))
    if problems:
        raise FolderRefused("\n".join(problems))
    return FolderLevels(levels, light, source)


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
        photons, exposure = (row.photons, row.exposure) if row else (name.photons, name.exposure)
        light = row.light if row else None
        dark = 0.0 in (photons, light, header.photons) or (name.dark and not photons and not light)
        exposures = [x for x in (exposure, header.exposure) if x is not None]
        if len(exposures) == 2 and abs(exposures[0] - exposures[1]) > 0.01 * exposures[1]:
            who = f"{table.name}:{row.line}" if table and row else "its name"
            problems.append(f"{_short(file, folder)}: {who} says {exposures[0]:g} s, its header {exposures[1]:g} s")
        told = photons if photons is not None else header.photons
        frames.append(Frame(file, header, name.level, dark, next(iter(exposures), None), told, light))
    return frames, f"the table {table.name}" if table else "names and headers of the files", problems


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
