"""Photographs from a folder, cut at random: which, where and which way round depend on a seed and a number alone."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from torch import Tensor

_KINDS = {".png", ".jpg", ".jpeg"}
_KEPT = 64  #: decoded photographs that a process keeps
_TRIES = 100  #: broken ones in a row, after which a folder is given up


@dataclass
class Photographs:
    """Files that are or seem photographs, and those that turned out not to be."""

    paths: tuple[Path, ...]  #: in the order of their names
    broken: dict[Path, str] = field(default_factory=dict)  #: what cannot be read, and why

    @classmethod
    def under(cls, root: Path) -> Photographs:
        """All below a folder, however deep; of each its header is read. Raises ValueError where there is none."""
        from neusee.nodes.scene import photograph

        good, broken = [], {}
        looked = photograph.before or (lambda **_: ())
        for path in sorted(p for p in root.rglob("*") if p.suffix.lower() in _KINDS and p.is_file()):
            try:
                looked(file=path)
            except (OSError, ValueError, SyntaxError) as error:
                broken[path] = str(error)
            else:
                good.append(path)
        if not good:
            why = f"; {len(broken)} cannot be read, such as {min(broken)}: {broken[min(broken)]}" if broken else ""
            raise ValueError(f"no photograph (.png, .jpg) below {root}{why}")
        return cls(tuple(good), broken)

    def crop(self, shape: tuple[int, int], seed: Sequence[int]) -> Tensor:
        """One photograph, one place in it, either way round: (3, y, x) linear light, as `scene.photograph` reads it.

        One that is smaller than ``shape`` is enlarged to cover it; for one that proves broken another is drawn. The
        same ``seed`` gives the same, in whatever order and in however many processes.
        """
        rng = np.random.default_rng(seed)
        for _ in range(_TRIES):
            path = self.paths[int(rng.integers(len(self.paths)))]
            try:
                picture = _whole(path, shape)
            except (OSError, ValueError, SyntaxError) as error:
                self.broken[path] = str(error)
                continue
            top, left = (int(rng.integers(n - m + 1)) for n, m in zip(picture.shape[-2:], shape, strict=True))
            picture = picture[:, top : top + shape[0], left : left + shape[1]]
            return (picture.flip(-1) if rng.random() < 0.5 else picture).contiguous()
        path = next(iter(self.broken))
        raise ValueError(f"{_TRIES} photographs in a row cannot be read, such as {path}: {self.broken[path]}")


@functools.lru_cache(maxsize=_KEPT)
def _whole(path: Path, shape: tuple[int, int]) -> Tensor:
    """All of a photograph, enlarged where it would not cover the shape."""
    from neusee.nodes.scene import photograph

    found: Tensor = photograph(file=path)
    y, x = found.shape[-2:]
    if y >= shape[0] and x >= shape[1]:
        return found
    times = max(shape[0] / y, shape[1] / x)
    return photograph(file=path, shape=(max(shape[0], round(y * times)), max(shape[1], round(x * times))))  # type: ignore[no-any-return]
