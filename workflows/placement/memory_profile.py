"""The memory of one device over all time, as promised to the tasks placed so far."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np

Hold = tuple[float, float, float]  #: from, until (infinity if nobody knows yet), bytes


class MemoryProfile:
    """Bytes in use as a step function of time that never rises above ``limit``.

    What still has readers to be placed is held for ever, and given back when the last of them has its
    place. So promises only ever shrink, apart from what `wait` has looked at, and no later placement,
    not even one in an earlier gap, can break what was found to fit.
    """

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self.times = [-math.inf]
        self.level = np.zeros(64)
        self.kept = 0.0  # at the end of time

    def add(self, start: float, end: float, size: float) -> None:
        """Hold ``size`` bytes (give them back, if negative) from ``start`` until ``end``."""
        if size and start < end:
            first = self._cut(start)
            self.level[first : self._cut(end) if end < math.inf else len(self.times)] += size
            self.kept += size if end == math.inf else 0.0

    def highest(self, start: float, end: float) -> float:
        """Most bytes in use at any moment in [start, end)."""
        return float(self.level[self._within(start, end)].max())

    def free(self) -> float:
        """Bytes that are free when all that was placed is over."""
        return self.limit - self.kept

    def wait(self, holds: Iterable[Hold]) -> float:
        """By how many seconds all holds must come later to fit, at least: 0 if they fit as they are."""
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
        """Index of the step that begins at ``time``, made if there is none."""
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
    """Overlapping holds as spans that follow one another, each with the sum of its bytes."""
    steps: dict[float, float] = {}
    for start, end, size in holds:
        if start < end and size:
            steps[start] = steps.get(start, 0.0) + size
            steps[end] = steps.get(end, 0.0) - size
    times, now = sorted(steps), 0.0
    for start, end in pairwise(times):
        now += steps[start]
        if now > 0:
            yield start, end, now


def without(start: float, end: float, taken: Iterable[tuple[float, float]]) -> Iterator[tuple[float, float]]:
    """What of [start, end) the ``taken`` spans, sorted and apart, leave uncovered."""
    for first, last in taken:
        if first < end and last > start:
            if start < first:
                yield start, first
            start = max(start, last)
    if start < end:
        yield start, end
