"""Folders in which a cache fails, each in its own way: what a disk, a mount, a name or a
permission may do.
"""

from __future__ import annotations

import ctypes
import errno
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

_EVENTS = ("open", "os.mkdir", "os.link", "os.rename", "os.remove", "os.symlink")
_state: dict[str, Any] = {"folder": "", "number": 0, "after": 0, "hooked": False}


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    """Let each use of a file below the broken folder fail, once the given number of uses is
    over.
    """
    if not _state["folder"] or event not in _EVENTS:
        return
    names = [os.fspath(name) for name in arguments[:2] if isinstance(name, str | os.PathLike)]
    if any(name.startswith(_state["folder"]) for name in names):
        _state["after"] -= 1
        if _state["after"] < 0:
            raise OSError(_state["number"], os.strerror(_state["number"]), names[0])


@contextmanager
def broken(folder: Path, number: int, after: int = 0) -> Iterator[Path]:
    """A folder below which every file answers with the error ``number``, from the use ``after``
    on.
    """
    if not _state["hooked"]:
        sys.addaudithook(_hook)
        _state["hooked"] = True
    folder.mkdir()
    _state.update(folder=str(folder), number=number, after=after)
    try:
        yield folder
    finally:
        _state["folder"] = ""


@contextmanager
def mounted(folder: Path, options: str) -> Iterator[Path]:
    """A small disk of its own."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("only root may mount a small disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


@contextmanager
def _read_only(folder: Path) -> Iterator[Path]:
    with mounted(folder, "size=1m") as place:
        subprocess.run(["mount", "-o", "remount,ro", folder], check=True)
        yield place


@contextmanager
def _full(folder: Path, free: int) -> Iterator[Path]:
    with mounted(folder, "size=1m") as place:
        (place / "ballast").write_bytes(bytes((1024 - free) * 1024))
        yield place


@contextmanager
def _file(folder: Path, below: str = "") -> Iterator[Path]:
    folder.write_text("no folder")
    yield folder / below


@contextmanager
def _loop(folder: Path) -> Iterator[Path]:
    folder.symlink_to(folder)
    yield folder


@contextmanager
def _forbidden(folder: Path, mode: int) -> Iterator[Path]:
    folder.mkdir(mode=mode)
    with without_privileges():
        yield folder
    folder.chmod(0o700)


@contextmanager
def without_privileges() -> Iterator[None]:
    """Let permissions hold for root too: without the capabilities that override them, in this
    thread and its own.
    """
    if os.geteuid() != 0:
        yield
        return
    if sys.platform != "linux":
        pytest.skip("only Linux lets root give up single privileges")
    libc = ctypes.CDLL(None, use_errno=True)
    head, data = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    assert libc.capget(head, data) == 0
    before = list(data)
    data[0] &= ~0b110  # CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH
    assert libc.capset(head, data) == 0
    try:
        yield
    finally:
        data[:] = before
        assert libc.capset(head, data) == 0


@contextmanager
def _kernel(folder: Path) -> Iterator[Path]:
    if not os.path.isdir("/proc/self"):
        pytest.skip("there is no /proc")
    yield Path("/proc")


#: by name: a function that makes the cache at a path that is free, and yields its folder
FAULTS: dict[str, Callable[[Path], Any]] = {
    "a read-only mount": _read_only,
    "a full disk": lambda folder: _full(folder, 0),
    "a disk that fills up": lambda folder: _full(folder, 12),
    "a disk without inodes": lambda folder: mounted(folder, "size=1m,nr_inodes=3"),
    "a file in its place": _file,
    "a file above it": lambda folder: _file(folder, "below"),
    "a loop of links": _loop,
    "the folder /proc": _kernel,
    "no permission to write": lambda folder: _forbidden(folder, 0o555),
    "no permission at all": lambda folder: _forbidden(folder, 0o000),
    "errors of the device": lambda folder: broken(folder, errno.EIO),
    "a device that breaks later": lambda folder: broken(folder, errno.EIO, 25),
    "too many open files": lambda folder: broken(folder, errno.EMFILE),
    "a quota": lambda folder: broken(folder, errno.EDQUOT),
    "a server that forgot it": lambda folder: broken(folder, errno.ESTALE),
}


@contextmanager
def failing_cache(name: str, folder: Path) -> Iterator[Path]:
    """The folder of a cache that fails as ``name`` says."""
    with ExitStack() as stack:
        yield stack.enter_context(FAULTS[name](folder))
    with suppress(OSError):
        folder.unlink()
