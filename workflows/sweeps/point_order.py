"""The order in which the points of a sweep run, the results that they share, and the work that each has left.

Two points share a step if its key is the same. Points that share much run one after another, so that a costly result
is made once, used at once and dropped: an axis that reaches costly steps varies slowly, and from one point to the next
only one axis changes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from neusee.workflows.graph.recipe_graph import in_order
from neusee.workflows.keys.cache_key import Key


@dataclass(frozen=True, slots=True)
class PointJob:
    """The steps that one point needs."""

    place: tuple[int, ...]  #: index along every axis
    keys: Mapping[str, Key]  #: of every step that the outputs need
    sources: Mapping[str, tuple[str, ...]]  #: by step, the steps that feed it
    outputs: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Sharing:
    """The results that the points of a sweep share."""

    points: int
    distinct: Mapping[str, int]  #: different results by step
    steps: int  #: steps of all points, each point for itself
    made: int  #: different results in all
    alone: float  #: work of all points, each for itself: seconds, or steps where no seconds are known
    together: float  #: work of the different results

    @property
    def saved(self) -> float:
        """Return the share of the work that sharing saves, in [0, 1]."""
        return 1 - self.together / self.alone if self.alone else 0.0


def filled(costs: Mapping[str, float], steps: Iterable[str]) -> dict[str, float]:
    """Return a cost for every step: its known cost, else the median of known costs, else 1."""
    steps = list(steps)
    known = [costs[step] for step in steps if step in costs]
    usual = median(known) if known else 1.0
    return {step: costs.get(step, usual) for step in steps}


def best_order(jobs: Sequence[PointJob], costs: Mapping[str, float], paired: bool = False) -> list[int]:
    """Return an order of ``jobs``, as indices, in which costly shared steps run once although little is held.

    Args: jobs: one for each point, in the order of the product of the axes, the last axis fastest.
    costs: seconds by step, or nothing. paired: the axes vary together, as one axis.

    For a product whose axes each reach a fixed set of steps, no order changes less work from point to point: every
    change costs at least its cheapest axis, and a cheaper axis is used as often as a path through the points can.
    """
    weights = filled(costs, {step for job in jobs for step in job.keys})
    if paired:
        return _grouped(jobs, weights)
    sizes = [1 + max(job.place[n] for job in jobs) for n in range(len(jobs[0].place))]
    reach = [_reach(jobs, weights, sizes, n) for n in range(len(sizes))]
    slowest_first = sorted(range(len(sizes)), key=lambda n: -reach[n])
    index = {job.place: i for i, job in enumerate(jobs)}
    return [index[place] for place in _there_and_back(sizes, slowest_first)]


def sharing(jobs: Sequence[PointJob], costs: Mapping[str, float]) -> Sharing:
    """Count the different results of every step, and the work that sharing saves."""
    weights = filled(costs, {step for job in jobs for step in job.keys})
    found: dict[str, set[Key]] = defaultdict(set)
    cost: dict[Key, float] = {}
    alone, steps = 0.0, 0
    for job in jobs:
        mine = {key: weights[step] for step, key in job.keys.items()}
        for step, key in job.keys.items():
            found[step].add(key)
        cost |= mine
        alone, steps = alone + sum(mine.values()), steps + len(mine)
    distinct = {step: len(keys) for step, keys in found.items()}
    return Sharing(len(jobs), distinct, steps, len(cost), alone, sum(cost.values()))


def work_left(jobs: Iterable[PointJob], costs: Mapping[str, float], stored: Callable[[Key], bool]) -> list[float]:
    """Return the work of each job in turn; a result that is stored, or made by an earlier job, costs nothing."""
    made: set[Key] = set()
    found = []

    def known(key: Key) -> bool:
        return key in made or stored(key)

    for job in jobs:
        weights = filled(costs, job.keys)
        missing = _Missing(job, known)
        names = [name for name in in_order(missing, job.outputs) if name in missing.names]
        fresh = {job.keys[name]: weights[name] for name in names}
        made.update(fresh)
        found.append(sum(fresh.values()))
    return found


class _Missing(dict[str, tuple[str, ...]]):
    """The steps that each step asks for: its sources where its result is missing, none where the result is known."""

    def __init__(self, job: PointJob, known: Callable[[Key], bool]) -> None:
        self.job, self.known, self.names = job, known, set[str]()

    def __missing__(self, name: str) -> tuple[str, ...]:
        self[name] = ()
        if not self.known(self.job.keys[name]):
            self.names.add(name)
            self[name] = self.job.sources[name]
        return self[name]


def _reach(jobs: Sequence[PointJob], weights: Mapping[str, float], sizes: Sequence[int], axis: int) -> float:
    """Return the mean work of one move along an axis."""
    stride = 1
    for size in sizes[axis + 1 :]:
        stride *= size
    changed, moves = 0.0, 0
    for i, job in enumerate(jobs):
        if job.place[axis]:
            before = jobs[i - stride].keys
            changed += sum(weights[step] for step, key in job.keys.items() if before.get(step) != key)
            moves += 1
    return changed / moves if moves else 0.0


def _there_and_back(sizes: Sequence[int], slowest_first: Sequence[int]) -> list[tuple[int, ...]]:
    """Return every place, each one step along one axis away from the place before."""
    rows: list[list[int]] = [[0] * len(sizes)]
    for axis in slowest_first:
        grown = []
        for n, row in enumerate(rows):
            steps = range(sizes[axis]) if n % 2 == 0 else reversed(range(sizes[axis]))
            grown += [[*row[:axis], i, *row[axis + 1 :]] for i in steps]
        rows = grown
    return [tuple(row) for row in rows]


def _grouped(jobs: Sequence[PointJob], weights: Mapping[str, float]) -> list[int]:
    """Order points so that equal costly results come one after another, and otherwise as given."""
    first: dict[str, dict[Key, int]] = defaultdict(dict)
    for i, job in enumerate(jobs):
        for step, key in job.keys.items():
            first[step].setdefault(key, i)
    shared = [step for step, keys in first.items() if 1 < len(keys) < len(jobs)]
    shared.sort(key=lambda step: -weights[step])
    return sorted(range(len(jobs)), key=lambda i: [first[step].get(jobs[i].keys.get(step, ""), -1) for step in shared])
