"""The order in which the points of a sweep run, the results that points share, and the computing
time of each point.

Two points share the result of a step if the step has the same key at both points. An axis that
changes costly steps varies slowly, and only one axis changes from point to point: a costly result
is computed once and released early.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from statistics import median

from neusee.workflows.keys.cache_key import Key


@dataclass(frozen=True, slots=True)
class PointJob:
    """The steps that one point of a sweep needs, with the cache key and the input steps of each
    step.
    """

    place: tuple[int, ...]  #: index of the value on each axis
    keys: Mapping[str, Key]  #: cache key of every step that the outputs need
    sources: Mapping[str, tuple[str, ...]]  #: by step, the steps that it reads
    outputs: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Sharing:
    """The number of results that the points of a sweep share, and the computing time that
    sharing saves.
    """

    points: int
    distinct: Mapping[str, int]  #: number of different results of each step
    steps: int  #: number of steps of all points together
    made: int  #: number of different results of all steps
    #: work of all points without sharing, in seconds, or in steps if no step has run before
    alone: float
    together: float  #: work of the different results, each computed once

    @property
    def saved(self) -> float:
        """Return the fraction of the computing time that shared results save, in [0, 1]."""
        return 1 - self.together / self.alone if self.alone else 0.0


def filled(costs: Mapping[str, float], steps: Iterable[str]) -> dict[str, float]:
    """Return the computing time of each step; a step of unknown time gets the median of the
    known times, or 1.
    """
    steps = list(steps)
    times = [costs[step] for step in steps if step in costs]
    median_time = median(times) if times else 1.0
    return {step: costs.get(step, median_time) for step in steps}


def best_order(
    jobs: Sequence[PointJob], costs: Mapping[str, float], paired: bool = False
) -> list[int]:
    """Return the order of the points of a sweep in which costly shared steps run once and few
    results stay in memory.

    The order is a list of indices of ``jobs``.

    Args: jobs: one job for each point, in the order of the product of the axes, the last axis
            fastest.
    costs: known seconds by step. paired: the axes vary together like one axis.

    If each axis changes a fixed set of steps, no other order recomputes less from point to point.
    """
    weights = filled(costs, _steps(jobs))
    if paired:
        return _grouped(jobs, weights)
    sizes = [1 + max(job.place[axis] for job in jobs) for axis in range(len(jobs[0].place))]
    recompute_times = [_reach(jobs, weights, sizes, axis) for axis in range(len(sizes))]
    slowest_first = sorted(range(len(sizes)), key=lambda n: -recompute_times[n])
    job_of_place = {job.place: i for i, job in enumerate(jobs)}
    return [job_of_place[indices] for indices in _there_and_back(sizes, slowest_first)]


def _steps(jobs: Iterable[PointJob]) -> set[str]:
    """Return the names of all steps of jobs."""
    return set[str]().union(*(job.keys for job in jobs))


def sharing(jobs: Sequence[PointJob], costs: Mapping[str, float]) -> Sharing:
    """Count the different results of every step in a sweep, and sum the computing time with and
    without sharing.
    """
    weights = filled(costs, _steps(jobs))
    weight_of_result: dict[Key, float] = {}
    work_apart, steps = 0.0, 0
    for job in jobs:
        weight_of_key = {key: weights[step] for step, key in job.keys.items()}
        # results that points share count once
        weight_of_result |= weight_of_key
        work_apart, steps = work_apart + sum(weight_of_key.values()), steps + len(weight_of_key)
    pairs = set[tuple[str, Key]]().union(*(job.keys.items() for job in jobs))
    distinct = Counter(step for step, _ in pairs)
    return Sharing(
        len(jobs),
        distinct,
        steps,
        len(weight_of_result),
        work_apart,
        sum(weight_of_result.values()),
    )


def work_left(
    jobs: Iterable[PointJob], costs: Mapping[str, float], stored: Callable[[Key], bool]
) -> list[float]:
    """Return the computing time of each point of a sweep, without results that are stored or
    computed earlier.
    """
    computed: set[Key] = set()
    in_store = cache(stored)
    work_of_points = []
    for job in jobs:
        step_times, seconds, names_left = filled(costs, job.keys), list[float](), list(job.outputs)
        while names_left:
            name = names_left.pop()
            key = job.keys[name]
            if key not in computed and not in_store(key):
                computed.add(key)
                seconds.append(step_times[name])
                names_left += job.sources[name]
        work_of_points.append(sum(seconds))
    return work_of_points


def _reach(
    jobs: Sequence[PointJob], weights: Mapping[str, float], sizes: Sequence[int], axis: int
) -> float:
    """Return the mean computing time of the steps that must run again after a change to the next
    value of ``axis``.
    """
    # jobs are in the order of the product: so far lies the previous value of the axis
    distance = math.prod(sizes[axis + 1 :])
    times = [
        sum(
            weights[step]
            for step, key in job.keys.items()
            if jobs[i - distance].keys.get(step) != key
        )
        for i, job in enumerate(jobs)
        # the first value has no previous one
        if job.place[axis]
    ]
    return sum(times) / len(times) if times else 0.0


def _there_and_back(sizes: Sequence[int], slowest_first: Sequence[int]) -> list[tuple[int, ...]]:
    """Return all points of a sweep as index tuples in serpentine order: successive points differ
    by 1 in one index.
    """
    rows: list[list[int]] = [[0] * len(sizes)]
    for axis in slowest_first:
        longer_rows = []
        for row_number, row in enumerate(rows):
            # each second row backwards
            indices = range(sizes[axis]) if row_number % 2 == 0 else reversed(range(sizes[axis]))
            longer_rows += [[*row[:axis], i, *row[axis + 1 :]] for i in indices]
        rows = longer_rows
    return [tuple(row) for row in rows]


def _grouped(jobs: Sequence[PointJob], weights: Mapping[str, float]) -> list[int]:
    """Return the indices of the points of a sweep, sorted so that points that share costly
    results are neighbours.
    """
    first_job_of_key: dict[str, dict[Key, int]] = defaultdict(dict)
    for i, job in enumerate(jobs):
        for step, key in job.keys.items():
            first_job_of_key[step].setdefault(key, i)
    # steps with one result for all points, or another for each, put nothing together
    shared_steps = [step for step, keys in first_job_of_key.items() if 1 < len(keys) < len(jobs)]
    shared_steps.sort(key=lambda step: -weights[step])
    return sorted(
        range(len(jobs)),
        # the costliest step first: points with equal results of it are neighbours
        key=lambda i: [
            first_job_of_key[step].get(jobs[i].keys.get(step, ""), -1) for step in shared_steps
        ],
    )
