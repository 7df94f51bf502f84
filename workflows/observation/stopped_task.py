"""Thread that the kernel has stopped at a system call: its memory, its open files and its folders.

The thread waits, so what it handed to the call is read from the outside, from the files of ``/proc``.
"""

from __future__ import annotations

import os

AT_FDCWD = -100  #: in place of an open folder: the folder of work
_LONGEST = 4096  #: bytes of a path: PATH_MAX


class Task:
    """One thread, by its number."""

    def __init__(self, thread: int) -> None:
        self.thread = thread

    def memory(self, address: int, length: int) -> bytes:
        """Return bytes of the memory of the thread, fewer where its memory ends."""
        file = os.open(f"/proc/{self.thread}/mem", os.O_RDONLY | os.O_CLOEXEC)
        try:
            return os.pread(file, length, address)
        finally:
            os.close(file)

    def text(self, address: int) -> str:
        """Return the path at an address."""
        return os.fsdecode(self.memory(address, _LONGEST).partition(b"\0")[0])

    def link(self, name: str) -> str:
        """Return the path of an open file, ``fd/3``, or of the folder of work, ``cwd``."""
        return os.readlink(f"/proc/{self.thread}/{name}")

    def status(self, word: str) -> int:
        """Return a number of the status of the thread, such as ``Tgid``."""
        with open(f"/proc/{self.thread}/status", encoding="ascii", errors="replace") as lines:
            return next(int(line.split()[1]) for line in lines if line.startswith(f"{word}:"))

    def path(self, text: str, folder: int, follow: bool = True) -> str:
        """Return the real path of a text, which begins at the open folder ``folder`` if it is relative.

        Without ``follow``, a link at the end of the path stays.
        """
        if not text.startswith("/"):
            text = os.path.join(self.link("cwd" if folder == AT_FDCWD else f"fd/{folder}"), text)
        for own in ("/proc/self", "/proc/thread-self"):  # of the thread, not of the process that reads this
            if f"{text}/".startswith(f"{own}/"):
                text = f"/proc/{self.thread}{text.removeprefix(own)}"
        if follow:
            return os.path.realpath(text)
        above, name = os.path.split(text.rstrip("/"))
        return os.path.join(os.path.realpath(above), name)
