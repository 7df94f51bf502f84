"""Ratios of times of two programs that take turns in one run, with an interval that assumes no
law of the times.
"""

import math
import os
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

Work = Callable[[], object]
OURS = "neusee"


@dataclass(frozen=True)
class Comparison:
    """Processor seconds of one claim: of neusee and of each peer, one value a turn, and remarks
    such as errors.
    """

    what: str
    seconds: Mapping[str, Sequence[float]]
    remarks: Mapping[str, str]
    load: float

    def peers(self) -> list[str]:
        """Return the names of the peers, the fastest first."""
        others = [name for name in self.seconds if name != OURS]
        return sorted(others, key=lambda name: statistics.median(self.seconds[name]))

    def ratio(self, peer: str) -> tuple[float, float, float]:
        """Return the median of the peer's seconds over ours in the same turn, and the interval
        of this median.
        """
        found = sorted(b / a for a, b in zip(self.seconds[OURS], self.seconds[peer], strict=True))
        low, high = median_ranks(len(found))
        return statistics.median(found), found[low], found[high]


def median_ranks(count: int, level: float = 0.95) -> tuple[int, int]:
    """Return the ranks (from 0) of sorted values between which the median lies with a probability
    of ``level``.

    This is the interval of the sign test. Where there are too few values for it, it goes from the
    least to the largest.
    """
    below, rank = 0.0, 0
    for k in range(count // 2):
        below += math.comb(count, k) / 2**count
        if 2 * below > 1 - level:
            break
        rank = k + 1
    return max(rank - 1, 0), count - 1 - max(rank - 1, 0)


@dataclass(frozen=True)
class Figures:
    """A table of numbers that have no peer: its columns, its rows as text, and the load of the
    machine.
    """

    what: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    load: float


def compared(
    what: str,
    works: Mapping[str, Work],
    turns: int,
    remarks: Mapping[str, str] | None = None,
    by_clock: bool = False,
) -> Comparison:
    """Time works that take turns, after a turn that does not count: processor seconds, or those
    of the clock.
    """
    load, seconds = os.getloadavg()[0], {name: list[float]() for name in works}
    for turn in range(turns + 1):
        for name, work in works.items():
            taken = _seconds_by_clock(work) if by_clock else _processor_seconds(work)
            if turn:
                seconds[name].append(taken)
    return Comparison(what, seconds, remarks or {}, load)


def _processor_seconds(work: Work) -> float:
    """Return the processor seconds of this process and of the processes that ended during
    ``work``.
    """
    before = os.times()
    fine = time.process_time()
    work()
    fine, after = time.process_time() - fine, os.times()
    return (
        fine
        + after.children_user
        - before.children_user
        + after.children_system
        - before.children_system
    )


def _seconds_by_clock(work: Work) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def process(command: Sequence[str], environment: Mapping[str, str], folder: str) -> None:
    """Run one program to its end; raise `CalledProcessError` if it fails."""
    subprocess.run(
        command,
        env={**os.environ, **environment},
        cwd=folder,
        check=True,
        stdout=subprocess.DEVNULL,
    )
