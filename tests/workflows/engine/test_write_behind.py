"""Large results are written beside the next steps, and a run that has ended has written all of
them.
"""

import importlib.util
import os
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from neusee.workflows.engine import step_job as write_behind
from neusee.workflows.engine.runner import run
from neusee.workflows.engine.step_job import WriteBehind
from neusee.workflows.graph.errors import RunError
from neusee.workflows.store.result_store import Store

SPEC = importlib.util.spec_from_file_location(
    "engine_toys", Path(__file__).with_name("test_engine_choices.py")
)
toys = importlib.util.module_from_spec(SPEC)
sys.modules["engine_toys"] = toys  # the engine looks there for the code of a node
SPEC.loader.exec_module(toys)
add, make, mean, slow, recipe, states = (
    toys.add,
    toys.make,
    toys.mean,
    toys.slow,
    toys.recipe,
    toys.states,
)
N = 1 << 19


class Slow(Store):
    """A store that takes its time to write, and says when."""

    def __init__(self, root, seconds=0.2):
        super().__init__(root)
        self.seconds, self.threads, self.claims = seconds, [], []

    def put(self, key, value, about):
        if about["bytes"] >= write_behind.LARGE:
            self.threads.append(threading.current_thread().name)
            self.claims.append(Store(self.root).claim(key))
            time.sleep(self.seconds)
        return super().put(key, value, about)


STEPS = {
    "a": (make, {}, {"n": N}),
    "b": (slow, {"x": "a"}, {"seconds": 0.1}),
    "m": (mean, {"x": "b"}, {}),
}


def niceness():
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


@pytest.mark.skipif(
    sys.platform != "linux", reason="elsewhere priorities belong to processes, not to threads"
)
def test_who_writes_yields_to_who_computes():
    found, before, later = [], niceness(), WriteBehind()

    def write():
        found.append(niceness())
        with ThreadPoolExecutor(1) as pool:  # as the bands of a stack are written
            found.append(pool.submit(niceness).result())

    later.add("key", 1, write)
    later.finish()
    assert min(found) > before or before >= 19
    assert len(set(found)) == 1
    assert niceness() == before


def test_a_run_that_has_ended_has_written_all(tmp_path):
    store = Slow(tmp_path)
    run(recipe("a b m", **STEPS), store)
    assert all(name != "MainThread" for name in store.threads)
    assert len(store.threads) == 2
    assert set(states(run(recipe("a b m", **STEPS), Store(tmp_path))).values()) == {"cached"}


def test_what_waits_keeps_its_lease(tmp_path):
    store = Slow(tmp_path, 0.0)
    run(recipe("a b m", **STEPS), store)
    assert store.claims == [None, None]
    done = run(recipe("a b m", **STEPS), store)
    for key in done.keys.values():
        with Store(tmp_path).claim(key) as free:
            assert free is not None


def test_writing_and_computing_overlap(tmp_path):
    class Patient(Slow):
        """A store that writes nothing before the second step has begun."""

        def put(self, key, value, about):
            until = time.monotonic() + 300
            while "slow" not in toys.CALLS:
                assert time.monotonic() < until, "b waits until a is written"
                time.sleep(0.001)
            return super().put(key, value, about)

    toys.CALLS.clear()
    done = run(recipe("a b m", **STEPS), Patient(tmp_path, 0.0)).done
    assert {d.state for d in done.values()} == {"run"}


def test_what_waits_is_not_computed_again(tmp_path):
    store = Slow(tmp_path)
    steps = {**STEPS, "c": (add, {"x": "b"}, {})}
    result = run(recipe("a c", **steps), store)
    assert {d.state for d in result.done.values()} == {"run"}
    assert torch.equal(result.values["a"], torch.ones(N))


def test_a_failure_keeps_what_was_finished_before_it(tmp_path):
    steps = {**STEPS, "f": (add, {"x": "b"}, {"k": "no number"})}
    with pytest.raises(RunError, match="f \\("):
        run(recipe("a b f", **steps), Slow(tmp_path))
    assert set(states(run(recipe("a b", **steps), Store(tmp_path))).values()) == {"cached"}


def test_a_disk_that_is_full_costs_one_warning_and_no_value(tmp_path, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.warns(UserWarning, match="cannot be written") as seen:
        result = run(recipe("a b m", **STEPS), Store(tmp_path))
    assert len(seen) == 1
    assert result.values["m"] == 2


def test_an_error_of_the_writer_is_an_error_of_the_run(tmp_path):
    class Broken(Store):
        def put(self, key, value, about):
            raise RuntimeError("the disk speaks in tongues")

    with pytest.raises(RuntimeError, match="tongues"):
        run(recipe("a", **STEPS), Broken(tmp_path))


def test_no_more_waits_than_there_is_room_for(monkeypatch):
    monkeypatch.setattr(write_behind, "_ROOM", 100)
    later, gate, most, order = WriteBehind(), threading.Event(), [], []

    def finish():
        order.append("a is written")
        gate.set()

    later.add("a", 80, lambda: gate.wait(300))
    threading.Timer(0.2, finish).start()
    later.add("b", 80, lambda: most.append("a" in later))
    order.append("b waits to be written")
    later.finish()
    assert order == ["a is written", "b waits to be written"]
    assert most == [False]
    assert "b" not in later
