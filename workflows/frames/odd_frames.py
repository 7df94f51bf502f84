"""Frames whose mean does not fit their level, as where a file has the wrong name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from neusee.nodes.calibrate import frame_means

_OFF, _FLOOR = 0.1, 0.01  #: most difference of two frames: of their signal, and of the brightest signal

_CHANCE = 6.0  #: standard errors of a mean, added to the difference

Files = tuple[str, bool, Sequence[Path]]  #: name of a level, True for a dark one, its files


def misplaced_frames(levels: Sequence[Files], folder: Path) -> Iterator[str]:
    """Yield a sentence for each level whose frames differ too much in their means, or one if darks are not dark."""
    means = [[(file, *found) for file in files for found in frame_means(file)] for _, _, files in levels]
    middles = [float(np.median([mean for _, mean, _ in each])) for each in means]
    darks = [middle for middle, (_, dark, _) in zip(middles, levels, strict=True) if dark]
    lit = float(np.median([middle for middle, (_, dark, _) in zip(middles, levels, strict=True) if not dark]))
    if lit <= max(darks):
        yield (f"{folder}: dark frames have means up to {max(darks):.0f} DN, and half of the lit levels no more than "
               f"{lit:.0f} DN: cover the lens, or check which files are dark")  # fmt: skip
        return
    black, bright = min(darks), max(middles)
    for (_, dark, _), each, middle in zip(levels, means, middles, strict=True):
        room = _OFF * (0.0 if dark else middle - black) + _FLOOR * (bright - black)
        room += _CHANCE * max(error for _, _, error in each)
        values = [mean for _, mean, _ in each]
        if max(values) - min(values) > room:
            yield _odd([(file, mean) for file, mean, _ in each], middle, room, folder)


def _odd(each: Sequence[tuple[Path, float]], middle: float, room: float, folder: Path) -> str:
    """Return which frame of a level does not fit the others, or both of a pair."""
    values = [mean for _, mean in each]
    if len(values) == 2:
        (a, one), (b, other) = each
        both = f"{_name(a, folder)} and {_name(b, folder)} count as one level, but have means of {one:.1f} and"
        return f"{both} {other:.1f} DN: check names and table"
    file, mean = max(each, key=lambda pair: abs(pair[1] - middle))
    return (f"{_name(file, folder)} has a mean of {mean:.1f} DN, but its level {middle:.1f} DN, which may differ by "
            f"{room:.1f} DN: check its name, or remove it")  # fmt: skip


def _name(file: Path, folder: Path) -> str:
    return str(file.relative_to(folder)) if file.is_relative_to(folder) else str(file)
