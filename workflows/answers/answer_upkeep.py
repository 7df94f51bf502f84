"""Number and size of the stored answers, the check of all of them, and the removal of old ones."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

from neusee.workflows.answers.stored_answer import FOLDER, SUFFIX, read_answer
from neusee.workflows.store.shared_folder import Disk, below

COUNT, BYTES = 200, 64 << 20  #: of answers that stay when a new one is written
_WEEK = 7 * 86400.0  #: s without use after which `neusee cache gc` removes an answer


class Kept(NamedTuple):
    """A stored answer: its name, its bytes and when it was last used (s)."""

    name: str
    path: str
    size: int
    used: float


def answers(disk: Disk) -> list[Kept]:
    """Return all stored answers, the one that was used last first."""
    return sorted(_found(disk), key=lambda each: (-each.used, each.name))


def _found(disk: Disk) -> Iterator[Kept]:
    for entry in below(f"{disk.folder}/{FOLDER}"):
        with suppress(OSError):
            about = entry.stat(follow_symlinks=False)
            yield Kept(entry.name.removesuffix(SUFFIX), entry.path, about.st_size, about.st_mtime)


def make_room(disk: Disk, budget: int | None = None) -> None:
    """Remove the answers that were not used for longest, until at most `COUNT` of them and `BYTES` are left.

    With a ``budget`` of the store in bytes, at most a twentieth of it is left.
    """
    size, most = 0, BYTES if budget is None else min(BYTES, budget // 20)
    for number, each in enumerate(answers(disk)):
        size += each.size
        if number >= COUNT or size > most:
            _remove(disk, each)


def sweep(disk: Disk, dry: bool = False, everything: bool = False) -> list[Kept]:
    """Remove the answers that nobody used for a week, or ``everything``, or only list them if ``dry``; return them."""
    old = [each for each in answers(disk) if everything or time.time() - each.used > _WEEK]
    return old if dry else [each for each in old if _remove(disk, each)]


def check(disk: Disk) -> tuple[list[Kept], list[Kept]]:
    """Return the answers that are as written, and those that are not, which are moved to the folder ``bad/``."""
    whole, damaged = [], []
    for each in answers(disk):
        there = read_answer(disk, each.name) is not None
        if there or os.path.lexists(each.path):  # one of another format or without a signature stays where it is
            whole.append(each)
        else:
            damaged.append(each)
    return whole, damaged


def _remove(disk: Disk, each: Kept) -> bool:
    try:
        disk.unlink(each.path)
    except OSError:
        return False
    return True
