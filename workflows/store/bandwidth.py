"""Read and write speed of a store of results, measured in normal use and saved in a file of the store."""

from __future__ import annotations

from contextlib import suppress
from typing import Literal

from neusee.workflows.keys.seal import seal_record, unseal_record
from neusee.workflows.store.metadata import INLINE
from neusee.workflows.store.shared_folder import Disk, read_file

Direction = Literal["read", "write"]
_FILE = "speeds.json"
LARGE = 1_000_000  #: bytes from which a transfer updates the speed
_USUAL: dict[Direction, float] = {"read": 8e9, "write": 0.4e9}  #: bytes / s
#: s for each transfer, whatever its size; to write is to make a file, which takes 0.5 to 2 ms
_SETUP: dict[Direction, float] = {"read": 5e-5, "write": 1e-3}
_SYNC = 3e-3  #: s until the disk has a file, for each result that is written to a file of its own
_LEARN = 0.3  #: weight of the newest transfer
_NEWS = 1.25  #: factor by which a speed must differ from the stored speed to be written to the file


class Speeds:
    """Read and write speed of one store in bytes per second."""

    def __init__(self, disk: Disk) -> None:
        self._disk = disk
        self._now: dict[Direction, float] = {}
        self._written: dict[Direction, float] = {}

    def seconds(self, way: Direction, size: float) -> float:
        """Return the predicted time in seconds for reading or writing ``size`` bytes in the store."""
        return _setup(way, size) + size / self._speed(way)

    def learn(self, way: Direction, size: int, seconds: float) -> None:
        """Update the estimated read or write speed of the store with the measured ``seconds`` of one transfer."""
        if size < LARGE:
            return
        newest = size / max(seconds - _setup(way, size), 1e-6)
        self._now[way] = self._speed(way) ** (1 - _LEARN) * newest**_LEARN
        written = self._written.get(way, _USUAL[way])
        if not written / _NEWS < self._now[way] < written * _NEWS:
            self._written = dict(self._now)
            with suppress(OSError):
                self._disk.replace(_FILE, seal_record("speeds", {str(way): speed for way, speed in self._now.items()}))

    def _speed(self, way: Direction) -> float:
        if not self._now:
            self._written = self._stored()
            self._now = {**_USUAL, **self._written}
        return self._now[way]

    def _stored(self) -> dict[Direction, float]:
        try:
            speeds = unseal_record("speeds", read_file(f"{self._disk.folder}/{_FILE}"))
            return {way: float(speeds[way]) for way in _USUAL if 1e3 < speeds[way] < 1e13}
        except (OSError, ValueError, LookupError, TypeError):
            return {}


def _setup(way: Direction, size: float) -> float:
    return _SETUP[way] + (_SYNC if way == "write" and size > INLINE else 0.0)
