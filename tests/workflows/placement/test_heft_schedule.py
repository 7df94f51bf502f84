"""Placement: the published example, an exact search, and a referee who replays a thousand
schedules.
"""

from __future__ import annotations

import importlib.util
import math
import random
from collections import Counter
from dataclasses import replace
from itertools import pairwise, permutations, product
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.workflows.placement.heft_schedule import Cluster, Device, Link, Task, TooLarge, heft
from neusee.workflows.placement.tasks_and_devices import Graph, frugal, upward


def helper(name):
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[1] / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


plans, cpop = helper("plans"), helper("cpop")


def lanes(schedule):
    found = {}
    for slot in schedule.slots:
        found.setdefault(slot.device, []).append((slot.task, slot.start, slot.end))
    return found


def one(memory=math.inf, name="cpu"):
    return Cluster((Device(name, "cpu", memory),))


def on(seconds, *names, **costs):
    """Tasks by name on ``cpu``; each reads the one before."""
    return [
        Task(n, names[i - 1 : i] if i else (), {"cpu": seconds}, **costs)
        for i, n in enumerate(names)
    ]


def placed(tasks, cluster, keep):
    """The schedule, or why there is none."""
    try:
        return heft(tasks, cluster, keep), None
    except TooLarge as error:
        return None, error


# --- the published example ------------------------------------------------------------------------


def test_heft_gives_every_slot_of_the_published_schedule():
    tasks, cluster = plans.published()
    schedule = heft(tasks, cluster)
    assert schedule.makespan == 80
    assert lanes(schedule) == {
        "P1": [("2", 27, 40), ("8", 57, 62)],
        "P2": [("4", 18, 26), ("6", 26, 42), ("9", 56, 68), ("10", 73, 80)],
        "P3": [("1", 0, 9), ("3", 9, 28), ("5", 28, 38), ("7", 38, 49)],
    }
    assert not plans.fouls(tasks, cluster, schedule)


def test_the_ranks_are_the_published_ones():
    tasks, cluster = plans.published()
    assert upward(Graph(tasks, cluster)) == pytest.approx(plans.RANKS, rel=1e-12)


def test_the_other_heuristic_gives_its_published_makespan():
    tasks, cluster = plans.published()
    slots = cpop.cpop(tasks, cluster)
    assert max(end for _, _, end in slots.values()) == 86
    assert {name for name, (device, *_) in slots.items() if device == "P2"} >= {"1", "2", "9", "10"}


def test_heft_is_shorter_than_the_other_heuristic_on_the_mean():
    ratios = []
    for seed in range(60):
        tasks, cluster = plans.layered(seed, 12)
        other = max(end for _, _, end in cpop.cpop(tasks, cluster).values())
        ratios.append(heft(tasks, cluster).makespan / other)
    assert sum(ratios) / len(ratios) < 0.98


def test_the_exact_search_finds_the_known_optimum():
    tasks, cluster = plans.published()
    best = plans.Exact(tasks, cluster, 80.0).best
    assert best == pytest.approx(73)
    assert best <= heft(tasks, cluster).makespan <= 80


def test_tasks_that_tie_but_for_rounding_go_by_name():
    tasks, cluster = plans.published()
    schedules = {
        heft(list(order), cluster).slots for order in (tasks, tasks[::-1], tasks[5:] + tasks[:5])
    }
    assert len(schedules) == 1


def test_where_links_are_slow_one_device_does_it_alone():
    sooner = 0
    for seed in range(40):
        tasks, cluster = plans.layered(seed, 9, talk=3.0)
        alone = min(sum(t.seconds[d.name] for t in tasks) for d in cluster.devices)
        schedule = heft(tasks, cluster)
        assert schedule.makespan <= alone + 1e-9
        assert not plans.fouls(tasks, cluster, schedule)
        sooner += len({slot.device for slot in schedule.slots}) == 1
    assert sooner > 4


@pytest.mark.parametrize("seed", range(16))
def test_heft_lies_between_the_optimum_and_half_as_much_again(seed):
    tasks, cluster = plans.layered(seed, 8, talk=(0.3, 1.0)[seed % 2])
    schedule = heft(tasks, cluster)
    best = plans.Exact(tasks, cluster, schedule.makespan).best
    assert best - 1e-6 <= schedule.makespan <= 1.5 * best


# --- the referee ----------------------------------------------------------------------------------


@pytest.mark.slow
@settings(max_examples=1000, deadline=None)
@given(st.integers(0, 2**40))
def test_no_schedule_breaks_a_rule(seed):
    tasks, cluster, keep = plans.crowded(seed)
    schedule, refused = placed(tasks, cluster, keep)
    if schedule:
        assert plans.fouls(tasks, cluster, schedule, keep) == []
    else:
        assert refused.needed > refused.memory == plans.memory(cluster)[refused.device]


def test_the_thousand_schedules_are_no_easy_ones():
    """Some must be refused, many be cut, and many end later than they would with all the memory
    there is.
    """
    count = Counter()
    for seed in range(300):
        tasks, cluster, keep = plans.crowded(seed)
        free = heft(
            tasks, plans.sized(cluster, dict.fromkeys(plans.memory(cluster), math.inf)), keep
        )
        count["short"] += any(
            free.peak[name] > memory for name, memory in plans.memory(cluster).items()
        )
        schedule, _ = placed(tasks, cluster, keep)
        if schedule is None:
            count["refused"] += 1
            continue
        count["cut"] += any(slot.parts > 1 for slot in schedule.slots)
        count["later"] += schedule.makespan > free.makespan
        count["sent again"] += len(schedule.moves) > len(
            {(m.task, m.bytes, m.device) for m in schedule.moves}
        )
    assert count["short"] > 100
    assert count["refused"] > 30
    assert count["cut"] > 20
    assert count["later"] > 20


def test_the_referee_sees_every_foul():
    tasks, cluster = plans.published()
    good = heft(tasks, cluster)
    slots = {slot.task: slot for slot in good.slots}

    def swapped(**changed):
        return replace(good, slots=tuple(changed.get(f"t{s.task}", s) for s in good.slots))

    assert plans.fouls(tasks, cluster, swapped(t7=replace(slots["7"], start=30.0, end=41.0)))
    assert plans.fouls(tasks, cluster, swapped(t4=replace(slots["4"], start=17.0, end=25.0)))
    assert plans.fouls(tasks, cluster, swapped(t4=replace(slots["4"], parts=2)))
    assert plans.fouls(tasks, cluster, replace(good, moves=good.moves[1:]))
    assert plans.fouls(tasks, cluster, replace(good, slots=good.slots[1:]))
    assert plans.fouls(tasks, plans.sized(cluster, {"P1": 1.0}), good)
    held_too_short = tuple(replace(m, until=m.end) for m in good.moves)
    assert plans.fouls(tasks, cluster, replace(good, moves=held_too_short))


# --- memory ---------------------------------------------------------------------------------------


def test_results_go_at_their_last_use_but_those_that_are_kept():
    chain = on(1.0, "a", "b", "c", "d", bytes=10.0)
    assert heft(chain, one()).peak == {"cpu": 20}
    assert heft(chain, one(), keep=["a", "d"]).peak == {"cpu": 30}
    assert heft(chain, one(20.0)).makespan == 4


def test_a_task_that_does_not_fit_is_cut_into_as_few_parts_as_do():
    (task,) = on(1.0, "psf", bytes=10.0, work=90.0, parts=31)
    parts = {m: heft([task], one(float(m))).slots[0].parts for m in (100, 99, 55, 54, 40, 13)}
    assert parts == {100: 1, 99: 2, 55: 2, 54: 3, 40: 3, 13: 30}
    with pytest.raises(
        TooLarge, match=r"psf does not fit: .* need 13 B on cpu in 31 parts, which has 12 B"
    ):
        heft([task], one(12.0))


def test_a_task_waits_for_memory():
    """The device is free at once, but until ``far`` has its copy there is no room beside ``a``."""
    tasks = [
        Task("a", (), {"gpu": 1.0}, bytes=60.0),
        Task("far", ("a",), {"cpu": 9.0}),
        Task("late", (), {"gpu": 1.0}, work=50.0),
    ]
    for memory, start in ((110.0, 1.0), (109.0, 4.0)):
        cluster = Cluster((Device("cpu"), Device("gpu", "cuda", memory)), bus=Link(20.0))
        slots = {s.task: s for s in heft(tasks, cluster).slots}
        assert slots["late"].start == start
        assert slots["far"].start == 4.0


def test_a_task_goes_where_there_is_memory():
    tasks = [Task("a", (), {"cpu": 10.0, "gpu": 1.0}, bytes=50.0, work=60.0)]
    small = Cluster((Device("cpu"), Device("gpu", "cuda", 100.0)))
    assert heft(tasks, small).slots[0].device == "cpu"
    assert heft([replace(tasks[0], parts=2)], small).slots[0].device == "gpu"


def depth_first(sources, i):
    """Every order of the tree below task i that finishes one source, with all before it, before
    it begins the next.
    """
    below = [list(depth_first(sources, j)) for j in sources[i]]
    for places in permutations(range(len(below))):
        for orders in product(*(below[p] for p in places)):
            yield [*(j for order in orders for j in order), i]


def held_at_once(graph, order):
    """The most bytes of results, and of the work that is in progress, at any time."""
    held, most = 0.0, 0.0
    for i in order:
        held += graph.own[i]
        most = max(most, held + graph.work(i, 1))
        held -= sum(graph.own[j] for j in graph.sources[i])
    return most


@pytest.mark.parametrize("seed", range(40))
def test_no_other_depth_first_order_of_a_tree_holds_less(seed):
    rng = random.Random(seed)
    readers = [rng.randint(max(0, i - 3), i - 1) for i in range(1, 8)]
    sources = [[str(j) for j, reader in enumerate(readers, 1) if reader == i] for i in range(8)]
    costs = [
        {"bytes": rng.randint(0, 100), "work": rng.choice([0, rng.randint(0, 200)])}
        for _ in range(8)
    ]
    tasks = [Task(str(i), tuple(sources[i]), {"cpu": 1.0}, **costs[i]) for i in reversed(range(8))]
    graph = Graph(tasks, one())
    (root,) = (i for i, task in enumerate(tasks) if task.name == "0")
    least = min(held_at_once(graph, order) for order in depth_first(graph.sources, root))
    assert held_at_once(graph, frugal(graph)) == least


def test_an_order_that_holds_less_is_found():
    """Four branches, each of a large and a small result: breadth first holds four large ones,
    depth first one.
    """
    tasks = [Task(f"big{i}", (), {"cpu": 1.0}, bytes=100.0) for i in range(4)]
    tasks += [Task(f"small{i}", (f"big{i}",), {"cpu": 1.0}, bytes=1.0) for i in range(4)]
    tasks.append(Task("sum", tuple(f"small{i}" for i in range(4)), {"cpu": 1.0}))
    assert heft(tasks, one()).peak["cpu"] > 400
    assert heft(tasks, one(104.0)).peak["cpu"] == 104
    with pytest.raises(TooLarge) as caught:
        heft(tasks, one(103.0))
    assert caught.value.needed == 104


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**40))
def test_on_one_device_the_number_of_a_refusal_is_the_least_that_is_accepted(seed):
    tasks, _, keep = plans.crowded(seed)
    tasks = [replace(t, seconds={"cpu": 1.0}) for t in tasks]
    with pytest.raises(TooLarge) as caught:
        heft(tasks, one(-1.0), keep)
    needed = caught.value.needed
    assert heft(tasks, one(needed), keep).peak["cpu"] <= needed
    with pytest.raises(TooLarge) as again:
        heft(tasks, one(needed - 1), keep)
    assert again.value.needed == needed


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**40))
def test_no_order_of_all_needs_less_than_the_exact_search_says(seed):
    tasks, _, keep = plans.crowded(seed)
    tasks = [replace(t, seconds={"cpu": 1.0}) for t in tasks[:9]]
    keep = [name for name in keep if name in {t.name for t in tasks}]
    with pytest.raises(TooLarge) as caught:
        heft(tasks, one(-1.0), keep)
    assert caught.value.needed >= plans.least_memory(tasks, keep)


def test_the_frugal_order_takes_first_what_leaves_most_free():
    wide = Task("wide", (), {"cpu": 1.0}, bytes=1.0, work=100.0)
    long = Task("long", (), {"cpu": 1.0}, bytes=50.0)
    both = Task("both", ("long", "wide"), {"cpu": 1.0})
    graph = Graph([long, wide, both], one())
    assert [graph.tasks[i].name for i in frugal(graph)] == ["wide", "long", "both"]
    assert plans.least_memory([long, wide, both], []) == 101
    assert heft([long, wide, both], one(101.0)).peak["cpu"] == 101


@pytest.mark.parametrize("seed", range(40))
def test_more_memory_as_a_refusal_asks_for_is_enough_in_the_end(seed):
    tasks, cluster, keep = plans.crowded(seed)
    cluster = plans.sized(cluster, dict.fromkeys(plans.memory(cluster), 60.0))
    for _ in range(40):
        schedule, refused = placed(tasks, cluster, keep)
        if schedule:
            break
        assert refused.needed > refused.memory
        cluster = plans.sized(cluster, {refused.device: refused.needed})
    assert schedule
    assert not plans.fouls(tasks, cluster, schedule, keep)


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**40))
def test_what_one_device_can_run_alone_is_not_refused_where_there_are_more(seed):
    tasks, cluster, keep = plans.crowded(seed)
    tasks = [
        replace(t, seconds={d.name: 1.0 + k for k, d in enumerate(cluster.devices)}, takes={})
        for t in tasks
    ]
    alone = [placed(tasks, Cluster((device,)), keep)[0] for device in cluster.devices]
    together, _ = placed(tasks, cluster, keep)
    assert together or not any(alone)


@pytest.mark.parametrize("seed", [180, 308, 615, 652, 712])
def test_a_refusal_tells_what_one_device_alone_would_need_if_that_is_less(seed):
    tasks, cluster, keep = plans.crowded(seed)
    _, refused = placed(tasks, cluster, keep)
    device = Device(refused.device, memory=refused.needed)
    assert heft(tasks, Cluster((device,)), keep).peak == {device.name: refused.needed}
    assert heft(tasks, plans.sized(cluster, {device.name: device.memory}), keep)


def test_a_refusal_says_bytes_as_people_read_them_too():
    with pytest.raises(
        TooLarge,
        match=r"need 12,500,000,000 B \(12.5 GB\) on cpu, which has 8,000,000,000 B \(8 GB\)",
    ):
        heft(on(1.0, "stack", bytes=12.5e9), one(8e9))


# --- transfers ------------------------------------------------------------------------------------


def two(link):
    return Cluster((Device("cpu"), Device("cuda:0", "cuda")), {("cuda", "cpu"): link})


def test_a_copy_is_sent_once_for_all_its_readers():
    tasks = [Task("a", (), {"cpu": 1.0}, bytes=100.0)]
    tasks += [Task(f"b{i}", ("a",), {"cuda:0": 1.0}) for i in range(3)]
    schedule = heft(tasks, two(Link(50.0, 0.5)))
    assert schedule.makespan == 1 + 2.5 + 3
    assert schedule.transferred == 100
    assert [(m.start, m.end, m.until) for m in schedule.moves] == [(1.0, 3.5, 6.5)]


def test_where_memory_is_short_a_copy_is_sent_again():
    tasks = [
        Task("a", (), {"cpu": 1.0}, bytes=60.0),
        Task("b", ("a",), {"cuda:0": 1.0}, bytes=1.0),
        Task("c", ("b",), {"cuda:0": 1.0}, bytes=1.0, work=90.0),
        Task("d", ("c", "a"), {"cuda:0": 1.0}),
    ]
    cluster = two(Link(60.0, 0.0))
    assert heft(tasks, cluster).transferred == 60
    small = replace(
        cluster, devices=(cluster.devices[0], replace(cluster.devices[1], memory=100.0))
    )
    schedule = heft(tasks, small)
    assert schedule.transferred == 120
    assert plans.fouls(tasks, small, schedule) == []


def test_links_go_by_kind_within_a_machine_and_by_network_between():
    devices = tuple(
        Device(f"{m}/{n}", n[:4]) for m in ("a", "b") for n in ("cpu", "cuda:0", "cuda:1")
    )
    cluster = Cluster(devices, {("cuda", "cuda"): Link(300.0)}, Link(20.0), Link(10.0, 1.0))
    assert cluster.link("a/cuda:0", "a/cuda:0").seconds(600) == 0
    assert cluster.link("a/cuda:0", "a/cuda:1").seconds(600) == 2
    assert cluster.link("a/cpu", "a/cuda:1") == Link(20.0)
    assert cluster.link("a/cuda:0", "b/cuda:1").seconds(600) == 61


def test_a_slow_link_keeps_a_chain_together():
    chain = [
        replace(t, seconds={"cpu": 3.0, "cuda:0": 1.0}) for t in on(1.0, "a", "b", "c", bytes=100.0)
    ]
    pinned = [replace(chain[0], seconds={"cpu": 3.0}), *chain[1:]]
    assert {s.device for s in heft(pinned, two(Link(1e9))).slots[1:]} == {"cuda:0"}
    assert {s.device for s in heft(pinned, two(Link(10.0))).slots} == {"cpu"}


# --- the account ----------------------------------------------------------------------------------


def test_the_critical_path_says_what_each_task_waited_for():
    tasks, cluster = plans.published()
    path = heft(tasks, cluster).critical_path()
    assert [slot.task for slot in path] == ["1", "4", "6", "8", "10"]
    assert path[0].start == 0
    assert path[-1].end == 80


def test_the_critical_path_leads_from_the_last_task_back_to_one_that_waited_for_none():
    crowds = [plans.crowded(seed) for seed in range(60)]
    schedules = [found for crowd in crowds if (found := placed(*crowd)[0])]
    assert len(schedules) > 30
    for schedule in schedules:
        path = schedule.critical_path()
        assert path[-1].end == schedule.makespan
        assert path[0].after == ""
        for before, slot in pairwise(path):
            assert slot.after == before.task
            assert before.end <= slot.start


def test_utilisation_is_the_share_of_the_makespan():
    tasks = [Task("a", (), {"cpu": 4.0}), Task("b", (), {"cuda:0": 1.0})]
    assert heft(tasks, two(Link())).utilisation() == {"cpu": 1.0, "cuda:0": 0.25}
    assert heft([], two(Link())).utilisation() == {"cpu": 0.0, "cuda:0": 0.0}


# --- what cannot be placed ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        ([Task("a", (), {"cuda:1": 1.0})], "a needs cuda:1; the cluster has cpu"),
        (
            [Task("a", ("pfs",), {"cpu": 1.0}), Task("psf", (), {"cpu": 1.0})],
            "there is no task pfs; did you mean psf?",
        ),
        (
            [Task("a", ("b",), {"cpu": 1.0}), Task("b", ("a",), {"cpu": 1.0})],
            "depend on each other in a cycle",
        ),
        ([Task("a", (), {"cpu": 1.0}), Task("a", (), {"cpu": 1.0})], "two tasks have the name a"),
        ([Task("a", (), {"cpu": math.nan})], "a must take a finite time of 0 s or more"),
    ],
)
def test_what_is_no_graph_is_refused(tasks, message):
    with pytest.raises(ValueError, match=message):
        heft(tasks, one())


def test_a_cluster_has_devices_with_names_of_their_own():
    with pytest.raises(ValueError, match="none"):
        Cluster(())
    with pytest.raises(ValueError, match="cpu, cpu"):
        Cluster((Device("cpu"), Device("cpu")))


def test_a_chain_of_ten_thousand_is_placed():
    names = [f"t{i}" for i in range(10_000)]
    seconds = {"cpu": 1.0, "cuda:0": 1.0}
    tasks = [Task(n, (names[i - 1],) if i else (), seconds, bytes=1.0) for i, n in enumerate(names)]
    assert heft(tasks, two(Link())).makespan == 10_000
    schedule = heft([replace(t, seconds={"cpu": 1.0}) for t in tasks], one(2.0))
    assert schedule.peak == {"cpu": 2}
    assert len(schedule.critical_path()) == 10_000


def test_placing_needs_no_torch():
    import subprocess
    import sys

    code = (
        "import sys; from neusee.workflows.placement import heft_schedule, machine_file;"
        " print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
