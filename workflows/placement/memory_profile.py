"""Memory profile of one device: the bytes in use by the scheduled tasks, as a function of time."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np

Hold = tuple[float, float, float]  #: memory reservation: start, end (infinity if not yet known), bytes


class MemoryProfile:
    """Memory in use (bytes) on a device, as a step function of time that never rises above ``limit``.

    The memory of a result is reserved without end until the last reader of the result is placed, and then
    only until this reader ends. Reserved memory therefore only shrinks after `wait` has checked it, and no later
    placement, not even a placement in an earlier gap, can break a placement that fits.
    """

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self.times = [-math.inf]
        self.level = np.zeros(64)
        self.kept = 0.0  # bytes that are reserved without end

    def add(self, start: float, end: float, size: float) -> None:
        """Reserve ``size`` bytes of memory from ``start`` until ``end``; a negative ``size`` frees reserved bytes."""
        if size and start < end:
            first = self._cut(start)
            self.level[first : self._cut(end) if end < math.inf else len(self.times)] += size
            self.kept += size if end == math.inf else 0.0

    def highest(self, start: float, end: float) -> float:
        """Return the peak memory in use (bytes) in the time interval [start, end)."""
        return float(self.level[self._within(start, end)].max())

    def free(self) -> float:
        """Return the number of bytes of memory that are free after all scheduled tasks have ended."""
        return self.limit - self.kept

    def wait(self, holds: Iterable[Hold]) -> float:
        """Return the smallest delay (s) of the reservations ``holds`` that keeps the memory in use within the limit."""
        shift = 0.0
        for start, end, size in stacked(holds):
            span = self._within(start, end)
            level = self.level[span]
            if level.max() > self.limit - size:
                above = span.start + int(np.flatnonzero(level > self.limit - size)[-1]) + 1
                shift = max(shift, (self.times[above] if above < len(self.times) else math.inf) - start)
        return shift

    def _within(self, start: float, end: float) -> slice:
        first = bisect_right(self.times, start) - 1
        return slice(first, len(self.times) if end == math.inf else max(bisect_left(self.times, end), first + 1))

    def _cut(self, time: float) -> int:
        """Return the index of the time interval that begins at ``time``; split an interval at ``time`` if necessary."""
        at, count = bisect_left(self.times, time), len(self.times)
        if at < count and self.times[at] == time:
            return at
        if count == len(self.level):
            self.level = np.concatenate([self.level, np.zeros(count)])
        self.times.insert(at, time)
        self.level[at + 1 : count + 1] = self.level[at:count].copy()
        self.level[at] = self.level[at - 1]
        return at


def stacked(holds: Iterable[Hold]) -> Iterator[Hold]:
    """Yield the total memory reserved by ``holds`` as consecutive time intervals with a constant number of bytes."""
    steps = defaultdict[float, float](float)
    for start, end, size in holds:
        if start < end and size:
            steps[start] += size
            steps[end] -= size
    times, now = sorted(steps), 0.0
    for start, end in pairwise(times):
        now += steps[start]
        if now > 0:
            yield start, end, now


def without(start: float, end: float, taken: Iterable[tuple[float, float]]) -> Iterator[tuple[float, float]]:
    """Yield the parts of the time interval [start, end) outside the sorted, disjoint intervals in ``taken``."""
    for first, last in taken:
        if first < end and last > start:
            if start < first:
                yield start, first
            start = max(start, last)
    if start < end:
        yield start, end
