"""What the engine decides for itself: what to keep, what to read, who computes, where, and
whether there is room.
"""

import subprocess
import sys
import threading
import time

import pytest
import torch

from neusee.nodes import node
from neusee.workflows.engine import step_job
from neusee.workflows.engine.local_executor import program_memory
from neusee.workflows.engine.machine_resources import process_memory
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location, RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.store.result_store import Store

BIG = 1 << 20
CALLS = []
LANES = []


class Ticks:
    """A clock by which every step takes 0.3 s, however long it takes."""

    now = 1.9e9

    def time(self):
        return self.now

    def perf_counter(self):
        self.now += 0.3
        return self.now


@node()
def make(*, n: int = BIG, value: float = 1.0):
    CALLS.append("make")
    return torch.full((n,), value)


@node()
def slow(x=None, *, n: int = BIG, seconds: float = 0.3):
    CALLS.append("slow")
    LANES.append(threading.current_thread().name)
    time.sleep(seconds)
    return torch.ones(n) if x is None else x + 1


@node()
def add(x, *, k: float = 1.0):
    CALLS.append("add")
    return x + k


@node()
def shaped(*, n: int = BIG):
    CALLS.append("make")
    return torch.ones(n)


@shaped.shape
def _(*, n):
    return torch.empty(n, device="meta")


@node()
def glow(x, *, amount: float = 0.0):
    return x + amount


@glow.skip_bound
def _(x, *, amount):
    return abs(amount) / x.max


@node()
def mean(x, y=None):
    CALLS.append("mean")
    return x.mean() if y is None else x.mean() + y.mean()


@node()
def noise(x, *, rng: torch.Generator):
    return x + torch.randn(x.shape, generator=rng, device=rng.device)


@pytest.fixture(autouse=True)
def _fresh():
    CALLS.clear()
    LANES.clear()


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


class Dear(Store):
    """A store in which writing takes so long that nothing pays but what one asks for."""

    def write_seconds(self, size):
        return 60.0


def recipe(outputs, **steps):
    made = {}
    for i, (name, (what, wires, params)) in enumerate(steps.items()):
        full = {**{p.name: p.default for p in what._keyword_only}, **params}
        made[name] = Step(name, what, full, wires, Location("t.yaml", i + 1, 1), {})
    return Recipe("t", "", 1, 0.0, tuple(outputs.split()), made)


def states(result):
    return {name: done.state for name, done in result.done.items()}


CHEAP = {"a": (make, {}, {}), "b": (add, {"x": "a"}, {}), "m": (mean, {"x": "b"}, {})}
DEAR = {"a": (slow, {}, {}), "b": (add, {"x": "a"}, {}), "m": (mean, {"x": "b"}, {})}


def test_what_is_quicker_to_compute_than_to_keep_is_not_kept_but_remembered(store):
    first = run(recipe("m", **CHEAP), Dear(store.root))
    assert {name: done.kept for name, done in first.done.items()} == {
        "a": False,
        "b": False,
        "m": True,
    }
    fresh = Store(store.root)
    assert not fresh.has(first.keys["a"])
    assert fresh.about(first.keys["a"])["facts"]["sum"] == BIG
    again = run(recipe("m", **CHEAP), fresh)
    assert states(again) == {"a": "not needed", "b": "not needed", "m": "cached"}


def test_what_took_long_is_kept_and_a_change_below_it_runs_no_more_than_it_must(store):
    run(recipe("m", **DEAR), store)
    CALLS.clear()
    changed = run(recipe("m", **{**DEAR, "b": (add, {"x": "a"}, {"k": 5.0})}), Store(store.root))
    assert changed.values["m"] == 6
    assert CALLS == ["add", "mean"]


def test_what_is_asked_for_is_always_kept(store):
    run(recipe("b m", **CHEAP), store)
    again = run(recipe("b m", **CHEAP), Store(store.root))
    assert states(again)["b"] == "cached"
    assert torch.equal(again.values["b"], torch.full((BIG,), 2.0))


@pytest.mark.parametrize(
    ("n", "room", "kept"),
    [(BIG, None, False), (4 * BIG, None, True), (BIG, 400_000_000, True)],
    ids=["small", "large", "little room"],
)
def test_a_small_value_that_a_verdict_alone_asks_for_is_kept_only_where_it_pays(
    store, n, room, kept
):
    steps = {
        "a": (shaped, {}, {"n": n}),
        "g": (glow, {"x": "a"}, {"amount": 0.5}),
        "m": (mean, {"x": "g"}, {}),
    }
    first = run(recipe("m", **steps), Dear(store.root), memory=room and process_memory() + room)
    assert first.done["g"].state == "run"
    assert CALLS == ["make", "mean"]  # the value stays in memory between verdict and use
    assert Store(store.root).has(first.keys["a"]) is kept
    CALLS.clear()
    again = run(recipe("m", **steps), Store(store.root))
    assert (states(again)["m"], again.values["m"], CALLS) == ("cached", 1.5, [])


def test_a_value_that_was_not_kept_is_computed_again_and_says_why(store):
    first = run(recipe("m", **CHEAP), Dear(store.root))
    again = run(recipe("b", **CHEAP), Store(store.root))
    assert states(again) == {"a": "run", "b": "run"}
    assert again.done["a"].why == "faster to compute than to store"
    assert again.keys["b"] == first.keys["b"]


def test_cheap_steps_after_one_another_are_kept_once_together_they_are_dear(store, monkeypatch):
    monkeypatch.setattr(step_job, "time", Ticks())

    class Slow(Store):
        def write_seconds(self, size):
            return 0.5

        def read_seconds(self, size):
            return 0.0

    steps = {"s0": (slow, {}, {"seconds": 0.0})}
    steps |= {f"s{i}": (slow, {"x": f"s{i - 1}"}, {"seconds": 0.0}) for i in range(1, 4)}
    done = run(recipe("m", **steps, m=(mean, {"x": "s3"}, {})), Slow(store.root)).done
    assert [done[f"s{i}"].kept for i in range(4)] == [False, True] * 2


def test_a_stored_value_is_loaded_however_long_reading_takes(store):
    class RemoteFiles(Store):
        def read_seconds(self, size):
            return 500.0

    run(recipe("b m", **CHEAP), store)
    CALLS.clear()
    changed = {**CHEAP, "m": (mean, {"x": "b", "y": "b"}, {})}
    result = run(recipe("m", **changed), RemoteFiles(store.root))
    assert result.values["m"] == 4
    assert states(result) == {"a": "not needed", "b": "cached", "m": "run"}


def test_branches_run_side_by_side_on_two_lanes_and_give_the_same_bits(
    store, tmp_path, monkeypatch
):
    steps = {
        "a": (slow, {}, {"seconds": 0.05}),
        "b": (slow, {}, {"seconds": 0.051}),
        "n": (noise, {"x": "a"}, {}),
        "m": (mean, {"x": "n", "y": "b"}, {}),
    }
    both_sleep, asleep = threading.Barrier(2, timeout=300), time.sleep

    def together(seconds):
        asleep(seconds) if threading.current_thread().name == "neusee-leases" else both_sleep.wait()

    with monkeypatch.context() as patch:
        patch.setattr(time, "sleep", together)
        both = run(recipe("n m", **steps), store, device="cpu:0,cpu:1")
    assert len(set(LANES)) == 2
    spans = [(d.began, d.began + d.seconds) for d in (both.done["a"], both.done["b"])]
    assert max(s for s, _ in spans) < min(e for _, e in spans), "they overlap in time"
    one = run(recipe("n m", **steps), Store(tmp_path / "one"))
    assert one.keys == both.keys
    assert all(torch.equal(one.values[name], both.values[name]) for name in one.values)


def test_a_failure_on_one_lane_keeps_what_the_other_finished(store):
    @node()
    def broken(x=None):
        raise ValueError("no light")

    steps = {
        "a": (slow, {}, {}),
        "b": (add, {"x": "a"}, {"k": "no number"}),
        "c": (slow, {}, {"seconds": 0.5}),
    }
    with pytest.raises(RunError, match="b \\("):
        run(recipe("b c", **steps), store, device="cpu:0,cpu:1")
    CALLS.clear()
    run(recipe("c", **steps), Store(store.root))
    assert CALLS == []


def test_memory_that_cannot_do_is_refused_before_anything_runs(store):
    steps = {
        "a": (slow, {}, {"seconds": 0.0}),
        "b": (add, {"x": "a"}, {}),
        "m": (mean, {"x": "b"}, {}),
    }
    run(recipe("m", **steps), store)
    CALLS.clear()
    other = {**steps, "a": (slow, {}, {"seconds": 0.001})}
    with pytest.raises(RunError, match="needs "):
        run(recipe("m", **other), Store(store.root), memory=program_memory() + BIG)
    assert CALLS == []
    enough = program_memory() + 100 * BIG
    assert run(recipe("m", **other), Store(store.root), memory=enough).values["m"] == 2


def test_the_account_says_what_was_expected(store, monkeypatch):
    monkeypatch.setattr(step_job, "time", Ticks())
    monkeypatch.setattr(step_job, "thread_seconds", Ticks().perf_counter)
    monkeypatch.setattr(step_job, "process_seconds", Ticks().perf_counter)
    run(recipe("m", **DEAR), store)
    other = {**DEAR, "a": (slow, {}, {"seconds": 0.25})}
    result = run(recipe("m", **other), Store(store.root))
    assert result.done["a"].predicted == pytest.approx(0.3)
    assert [slot.task for slot in result.schedule.slots] == ["a", "b", "m"]
    assert result.done["b"].began >= result.done["a"].began + result.done["a"].seconds - 1e-3


OTHER = """
import sys, time, torch
from pathlib import Path
sys.path.insert(0, sys.argv[2])
import test_engine_choices as t
from neusee.workflows.keys import cache_key
cache_key.PROVEN = ("neusee.", "test_engine_choices.")
print("ready", flush=True)
t.run(t.recipe("m", a=(t.slow, {}, {"seconds": 1.0}), m=(t.mean, {"x": "a"}, {})), t.Store(Path(sys.argv[1])))
print(t.CALLS, flush=True)
"""


@pytest.mark.slow
def test_of_two_processes_one_computes_and_the_other_waits(store):
    from pathlib import Path

    command = [sys.executable, "-c", OTHER, str(store.root), str(Path(__file__).parent)]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate(timeout=120)[0] for process in both]
    assert sum(text.count("slow") for text in said) == 1
