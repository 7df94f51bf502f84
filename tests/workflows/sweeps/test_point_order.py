"""The order of the points: what is costly and shared is made once, even where only one point's
results are held.
"""

import itertools
import random

import pytest

from neusee.workflows.sweeps.sweep_points import PointJob, best_order, filled, sharing, work_left

REACH = {"pupil": "a", "psf": "ab", "scene": "b", "sensor": "abc", "noise": "c", "fixed": ""}
CHAIN = {
    "fixed": (),
    "pupil": ("fixed",),
    "psf": ("pupil",),
    "scene": (),
    "sensor": ("psf", "scene"),
    "noise": ("sensor",),
}


def jobs_of(sizes, reach=REACH):
    """One job a point; a step's key is its name and the values of the axes that reach it."""
    names = "abcdef"[: len(sizes)]
    found = []
    for place in itertools.product(*map(range, sizes)):
        value = dict(zip(names, place, strict=True))
        keys = {
            step: f"{step}:" + ",".join(f"{n}{value[n]}" for n in names if n in axes)
            for step, axes in reach.items()
        }
        found.append(PointJob(place, keys, CHAIN, ("noise",)))
    return found


def work(jobs, order, costs):
    """Work when only the results of the point before are held."""
    held, total = {}, 0.0
    for job in (jobs[i] for i in order):
        total += sum(costs[step] for step, key in job.keys.items() if held.get(step) != key)
        held = job.keys
    return total


@pytest.mark.parametrize("sizes", [(3, 2), (2, 3), (2, 2, 2), (7,), (1, 3, 2), (2, 1, 3)])
@pytest.mark.parametrize("seed", range(4))
def test_no_order_of_a_small_sweep_needs_less(sizes, seed):
    draw = random.Random(seed)
    costs = {step: draw.choice([0.1, 1.0, 3.0, 50.0]) * draw.random() for step in REACH}
    jobs = jobs_of(sizes)
    order = best_order(jobs, costs)
    assert sorted(order) == list(range(len(jobs)))
    # any point may be first: only differences count
    orders = itertools.permutations(range(1, len(jobs)))
    best = min(work(jobs, (0, *rest), costs) for rest in orders)
    assert work(jobs, order, costs) <= best * (1 + 1e-12)


def test_the_axis_that_reaches_the_costly_step_varies_slowest():
    jobs = jobs_of((3, 4))
    slow_a = best_order(jobs, {**dict.fromkeys(REACH, 0.01), "pupil": 100.0})
    slow_b = best_order(jobs, {**dict.fromkeys(REACH, 0.01), "scene": 100.0})
    changes = [
        [
            sum(jobs[i].place[n] != jobs[j].place[n] for i, j in itertools.pairwise(order))
            for n in (0, 1)
        ]
        for order in (slow_a, slow_b)
    ]
    assert changes == [[2, 9], [8, 3]]


def test_every_move_is_along_one_axis_by_one_value():
    jobs = jobs_of((3, 4, 2))
    for i, j in itertools.pairwise(best_order(jobs, {})):
        assert sum(abs(x - y) for x, y in zip(jobs[i].place, jobs[j].place, strict=True)) == 1


def test_without_costs_the_axis_that_reaches_more_steps_varies_slowest():
    jobs = jobs_of((2, 2), {"one": "a", "two": "b", "three": "b"})
    assert [jobs[i].place for i in best_order(jobs, {})] == [(0, 0), (1, 0), (1, 1), (0, 1)]


def test_paired_points_with_the_same_costly_result_stand_together():
    keys = [("x", 1), ("y", 2), ("x", 3), ("y", 4)]
    jobs = [
        PointJob((i, i), {"pupil": p, "noise": f"n{n}"}, {}, ("noise",))
        for i, (p, n) in enumerate(keys)
    ]
    assert best_order(jobs, {"pupil": 5.0, "noise": 9.0}, paired=True) == [0, 2, 1, 3]


def test_a_step_without_a_cost_counts_as_the_usual_one():
    assert filled({"a": 1.0, "b": 5.0, "c": 6.0}, "abcd") == {
        "a": 1.0,
        "b": 5.0,
        "c": 6.0,
        "d": 5.0,
    }
    assert filled({}, "ab") == {"a": 1.0, "b": 1.0}


def test_sharing_counts_different_results_and_the_work_that_they_save():
    costs = {"fixed": 100.0, "pupil": 10.0, "psf": 1.0, "scene": 0.0, "sensor": 0.0, "noise": 0.0}
    found = sharing(jobs_of((3, 2, 2)), costs)
    assert found.distinct == {
        "pupil": 3,
        "psf": 6,
        "scene": 2,
        "sensor": 12,
        "noise": 2,
        "fixed": 1,
    }
    assert (found.points, found.steps, found.made) == (12, 72, 26)
    assert (found.alone, found.together) == (12 * 111.0, 100.0 + 30.0 + 6.0)
    assert found.saved == pytest.approx(1 - 136 / 1332)


def test_work_left_stops_at_what_is_stored_and_at_what_a_point_before_made():
    costs = {"fixed": 100.0, "pupil": 10.0, "psf": 1.0, "scene": 2.0, "sensor": 0.5, "noise": 0.25}
    jobs = jobs_of((2, 2), {**REACH, "sensor": "ab", "noise": "ab"})
    assert work_left(jobs, costs, lambda key: False) == [113.75, 3.75, 11.75, 1.75]
    assert work_left(jobs, costs, lambda key: key.startswith("psf")) == [2.75, 2.75, 0.75, 0.75]
    assert work_left(jobs, costs, lambda key: key.startswith("noise")) == [0, 0, 0, 0]


def test_a_chain_of_ten_thousand_steps_is_walked():
    names = [f"s{i}" for i in range(10_000)]
    sources = {name: (before,) for before, name in itertools.pairwise(names)} | {"s0": ()}
    jobs = [
        PointJob(
            (i,), {n: n if n != names[-1] else f"last{i}" for n in names}, sources, (names[-1],)
        )
        for i in (0, 1)
    ]
    assert work_left(jobs, {}, lambda key: False) == [10_000.0, 1.0]
