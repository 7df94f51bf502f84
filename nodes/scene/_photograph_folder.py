"""A folder of photographs as scenes: what can be read of it, and a part of a picture that the seed alone decides."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.bicubic_resize import resize
from neusee.nodes.scene._crop_to_frame import covering
from neusee.nodes.scene._photograph import photograph

_PICTURES = frozenset({".png", ".jpg", ".jpeg", ".jpe", ".webp", ".tif", ".tiff", ".bmp", ".gif"})
_ENDS = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND"}  #: first bytes of a format -> what stands near its end
_TAIL = 1 << 16  #: bytes at the end of a file in which that is looked for: some cameras write more behind it
_ORDER, _CUT, _DRAW = 0, 1, 2  #: streams of one seed
_KEPT = 64  #: decoded photographs that a process keeps
_TRIES = 100  #: broken ones in a row, after which a folder is given up

Index = int | Sequence[int]  #: of a scene; of a sample of training (epoch, index)


def list_photographs(root: Path) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Photographs below a folder in the order of their paths, and those that cannot be read, with the reason.

    Headers and ends of the files are looked at, no picture is decoded. What is hidden, or no picture by its name, is
    passed over.
    """
    paths: list[Path] = []
    broken: list[tuple[Path, str]] = []
    for path in _files(root):
        reason = _wrong(path)
        if reason:
            broken.append((path, reason))
        else:
            paths.append(path)
    return paths, broken


def _files(root: Path) -> list[Path]:
    found = []
    for folder, below, names in os.walk(root, followlinks=True):
        below[:] = sorted(name for name in below if not name.startswith("."))
        found += [Path(folder, n) for n in names if not n.startswith(".") and Path(n).suffix.lower() in _PICTURES]
    return sorted(found, key=lambda path: path.relative_to(root).parts)


def _wrong(path: Path) -> str:
    """Why a file is no photograph that can be read, or nothing."""
    try:
        if photograph.hooks.preflight is not None:
            photograph.hooks.preflight(file=path, shape=None)
        with path.open("rb") as file:
            end = _ENDS[file.read(2)]
            file.seek(max(0, path.stat().st_size - _TAIL))
            return "" if end in file.read() else f"{path.name} stops before its end"
    except (ParameterError, OSError, KeyError, ValueError, SyntaxError) as error:
        return str(error)


def choose_photograph(paths: Sequence[Path], seed: int, index: int) -> Path:
    """The photograph of a scene: all of them in an order that the seed decides, and then from the start again."""
    order: list[int] = np.random.default_rng([seed, _ORDER]).permutation(len(paths)).tolist()
    return paths[order[index % len(paths)]]


def crop_photograph(path: Path, shape: tuple[int, int], seed: int, index: Index) -> Tensor:
    """A part of a photograph, linear sRGB (3, y, x), its place drawn from the seed and the index alone.

    One that is smaller is first enlarged, by the bicubic kernel in linear light, just until it covers ``shape``; what
    the kernel puts below black is black.
    """
    picture = _decoded(path)
    size = (picture.shape[-2], picture.shape[-1])
    if any(have < want for have, want in zip(size, shape, strict=True)):
        size = covering(size, shape)
        picture = resize(picture, *size).clamp_min(0.0)
    at = _place(size, shape, seed, index)
    return picture[:, at[0] : at[0] + shape[0], at[1] : at[1] + shape[1]].contiguous()


@functools.lru_cache(maxsize=_KEPT)
def _decoded(path: Path) -> Tensor:
    found: Tensor = photograph(file=path)
    return found


def _place(size: tuple[int, int], shape: tuple[int, int], seed: int, index: Index) -> tuple[int, int]:
    draw = np.random.default_rng([seed, _CUT, *_indices(index)])
    top, left = (int(draw.integers(0, have - want + 1)) for have, want in zip(size, shape, strict=True))
    return top, left


def _indices(index: Index) -> list[int]:
    return [index] if isinstance(index, int) else list(index)


@dataclass
class Photographs:
    """Photographs to learn from, and files that turned out to be none."""

    paths: tuple[Path, ...]  #: in the order of their names
    broken: dict[Path, str] = field(default_factory=dict)  #: what cannot be read, and why

    @classmethod
    def under(cls, root: Path) -> Photographs:
        """All below a folder, however deep. Raises ValueError where there is none."""
        good, broken = list_photographs(root)
        if not good:
            why = f"; {len(broken)} cannot be read, such as {broken[0][0]}: {broken[0][1]}" if broken else ""
            raise ValueError(f"no photograph below {root}{why}")
        return cls(tuple(good), dict(broken))

    def crop(self, shape: tuple[int, int], seed: int, index: Index) -> Tensor:
        """A part of one of them, either way round; for one that proves broken another is drawn.

        The same ``seed`` and ``index`` give the same part in any order and in any number of processes, whereas the
        random crops and flips of kornia draw from the one random stream of torch.
        """
        rng = np.random.default_rng([seed, _DRAW, *_indices(index)])
        for _ in range(_TRIES):
            path = self.paths[int(rng.integers(len(self.paths)))]
            try:
                picture = crop_photograph(path, shape, seed, index)
            except (OSError, ValueError, SyntaxError) as error:
                self.broken[path] = str(error)
                continue
            return (picture.flip(-1) if rng.random() < 0.5 else picture).contiguous()
        path = next(iter(self.broken))
        raise ValueError(f"{_TRIES} photographs in a row cannot be read, such as {path}: {self.broken[path]}")
