"""Search of a folder for readable photographs, and random crops of the photographs from a given seed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.input_files import file_version
from neusee.nodes.input_size import opened
from neusee.nodes.scene._crop_to_frame import drawn_crop
from neusee.nodes.scene._photograph import photograph, read_header

__depends__ = ["unaffected:_pictures"]  #: what is in memory changes no result
_PICTURES = frozenset({".png", ".jpg", ".jpeg", ".jpe", ".webp", ".tif", ".tiff", ".bmp", ".gif"})
_ENDS = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND"}  #: first bytes of a format -> end mark of a file of this format
_TAIL = 1 << 16  #: bytes at the end of a file that must contain the end mark: some cameras write more after it
_ORDER, _DRAW = 0, 2  #: random streams of one seed; the position of a part is another
_KEPT = 1 << 30  #: bytes of decoded photographs that a process keeps
_TRIES = 100  #: broken photographs in a row, after which drawing stops with an error

Index = int | Sequence[int]  #: the number of a scene, or (stage, number) of a picture for training


def list_photographs(root: Path) -> tuple[list[Path], list[tuple[Path, str]]]:
    """List the readable photographs below a folder, sorted by path, and the unreadable files with a reason for each.

    Only the header and the end of each file are read; no picture is decoded. Hidden files, hidden folders and
    files without the suffix of a picture are ignored.
    """
    reasons = {path: _problem(path) for path in _files(root)}
    broken = [(path, reason) for path, reason in reasons.items() if reason]
    return [path for path, reason in reasons.items() if not reason], broken


def _files(root: Path) -> list[Path]:
    pictures, above = list[Path](), dict[str, frozenset[tuple[int, int]]]()
    for folder, below, names in os.walk(root, followlinks=True):
        about, around = os.stat(folder), above.get(os.path.dirname(folder), frozenset())
        if (place := (about.st_dev, about.st_ino)) in around:  # a link that leads back
            below.clear()
            continue
        above[folder] = around | {place}
        below[:] = sorted(name for name in below if not name.startswith("."))
        pictures += [Path(folder, n) for n in names if not n.startswith(".") and Path(n).suffix.lower() in _PICTURES]
    return sorted(pictures, key=lambda path: path.relative_to(root).parts)


def _problem(path: Path) -> str:
    """Return the reason why a file cannot be read as a photograph, or an empty text."""
    try:
        read_header(path)
        with opened(path) as file:
            end = _ENDS[file.read(2)]
            file.seek(max(0, path.stat().st_size - _TAIL))
            return "" if end in file.read(_TAIL) else f"{path.name} stops before its end"
    except (ParameterError, OSError, KeyError, ValueError, SyntaxError) as error:
        return str(error)


def choose_photograph(paths: Sequence[Path], seed: int, index: int) -> Path:
    """Return the photograph for scene ``index``, so that every photograph is used once before any is repeated.

    The order of the photographs is drawn from the seed.
    """
    order: list[int] = np.random.default_rng([seed, _ORDER]).permutation(len(paths)).tolist()
    return paths[order[index % len(paths)]]


def crop_photograph(path: Path, shape: tuple[int, int], seed: int, index: Index) -> Tensor:
    """Crop a photograph, linear sRGB (3, y, x), at a position that depends only on the seed and the index.

    A smaller photograph is enlarged first, as `drawn_crop` does. ``scene.photograph`` with ``crop`` gives the same.
    """
    return drawn_crop(_decoded(path), shape, seed, index)


_pictures: dict[tuple[int, ...], Tensor] = {}  #: the decoded photographs by version, the last used one last


def _decoded(path: Path) -> Tensor:
    """Return a photograph as linear sRGB (3, y, x), from memory if it is one of the last that were used.

    A photograph that has changed since is decoded again, whatever its name.
    """
    version = file_version(path)
    if version is None:
        just_changed: Tensor = photograph(file=path)
        return just_changed
    picture: Tensor = _pictures.pop(version) if version in _pictures else photograph(file=path)
    _pictures[version] = picture
    while len(_pictures) > 1 and sum(map(_size, _pictures.values())) > _KEPT:
        del _pictures[next(iter(_pictures))]
    return picture


def _size(picture: Tensor) -> int:
    return picture.numel() * picture.element_size()


def _indices(index: Index) -> list[int]:
    return [index] if isinstance(index, int) else list(index)


@dataclass
class Photographs:
    """The photographs of a folder for training, and the files that cannot be read as photographs."""

    paths: tuple[Path, ...]  #: in the order of their names
    broken: dict[Path, str] = field(default_factory=dict)  #: the reason why each other file cannot be read

    @classmethod
    def under(cls, root: Path) -> Photographs:
        """Find all photographs below a folder at any depth; raise ValueError for a folder without photographs."""
        paths, broken = list_photographs(root)
        if not paths:
            why = f"; {len(broken)} cannot be read, such as {broken[0][0]}: {broken[0][1]}" if broken else ""
            raise ValueError(f"the folder {root} holds no readable photograph{why}")
        return cls(tuple(paths), dict(broken))

    def crop(self, shape: tuple[int, int], seed: int, index: Index) -> Tensor:
        """Return a random crop of a random photograph, mirrored with probability 1/2.

        A broken photograph is replaced by another draw. The same ``seed`` and ``index`` give the same crop in any
        order and in any number of processes, whereas the random crops and flips of kornia draw from the one random
        stream of torch.
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
