"""Record of the files that this process opens to read and of the folders that it lists, by an audit hook of Python."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from typing import Any

from neusee.workflows.answers.witnesses import Listing, listing

_LISTS = ("os.listdir", "os.scandir")
_WRITES = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
_listeners: list[Opened] = []  #: at most one; the hook of a process cannot be removed
_hooked: list[bool] = []


class Opened:
    """The files that were opened to read and the folders that were listed, as absolute paths."""

    def __init__(self) -> None:
        self.files: dict[str, None] = {}
        self.folders: dict[str, Listing] = {}  #: as each was when it was listed first
        self._lists = False

    def listen(self) -> None:
        """Begin the record; another record of this process ends."""
        _listeners[:] = [self]
        if not _hooked:
            _hooked.append(True)
            sys.addaudithook(_hear)

    def end(self) -> None:
        """End the record."""
        if self in _listeners:
            _listeners.remove(self)

    def hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Note one event of Python's audit; a file descriptor in place of a path says nothing new."""
        path = os.curdir if event in _LISTS and arguments[0] is None else arguments[0]
        if not isinstance(path, str | bytes | os.PathLike):
            return
        if event in _LISTS:
            self._list(os.path.abspath(os.fsdecode(path)))
        elif not _is_written(*arguments[1:3]):
            self.files[os.path.abspath(os.fsdecode(path))] = None

    def _list(self, folder: str) -> None:
        if self._lists or folder in self.folders:
            return
        self._lists = True  # listing is an event too
        try:
            self.folders[folder] = listing(folder)
        finally:
            self._lists = False


class Folders:
    """Some folders with all that is below them."""

    def __init__(self, roots: Iterable[str | os.PathLike[str]]) -> None:
        named = (str(each) for root in roots for each in (os.path.abspath(root), os.path.realpath(root)))
        self._starts = tuple(f"{each.rstrip('/')}/" for each in named)

    def __contains__(self, path: object) -> bool:
        """Return True if a path is one of the folders or below one of them, whatever links lead there."""
        return any(f"{each}/".startswith(self._starts) for each in (str(path), os.path.realpath(str(path))))


def _is_written(mode: Any, flags: Any) -> bool:
    """Return True for a file that is opened to be written anew or made."""
    if isinstance(mode, str):
        return mode[:1] in ("w", "x", "a")
    return isinstance(flags, int) and bool(flags & _WRITES)


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    if _listeners and (event == "open" or event in _LISTS):
        _listeners[0].hear(event, arguments)
