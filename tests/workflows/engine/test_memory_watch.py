"""The limit of the memory of a process while steps run."""

import mmap
import subprocess
import sys
import threading

import pytest
import torch

from neusee.nodes import node
from neusee.workflows.engine import machine_resources
from neusee.workflows.engine.local_executor import program_memory
from neusee.workflows.engine.machine_resources import (
    MemoryLimit,
    PeakMemory,
    free_memory,
    guarded,
    limited,
    process_memory,
    process_peak,
)
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location, RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.store.result_store import Store

MB = 10**6
LOOKED = threading.Event()  #: is set whenever the memory is looked at


@node()
def start() -> torch.Tensor:
    return torch.ones(8)


@start.shape
def _():
    return torch.empty(8, device="meta")


@node()
def hoard(x: torch.Tensor) -> torch.Tensor:
    """Take far more memory than the rule of its shape tells, one piece after each look at it,
    until told to stop.
    """
    held = []
    for _ in range(150):
        held.append(torch.ones(5_000_000))
        LOOKED.clear()
        LOOKED.wait(300)
    raise AssertionError("nobody stopped it")


@hoard.shape
def _(x):
    return torch.empty(8, device="meta")


def recipe():
    at = Location("t.yaml", 1, 1)
    steps = {"a": Step("a", start, {}, {}, at, {}), "b": Step("b", hoard, {}, {"x": "a"}, at, {})}
    return Recipe("t", "", 1, 0.0, ("b",), steps)


def test_a_step_that_takes_more_than_the_limit_is_stopped_by_name_and_the_finished_work_stays(
    tmp_path, monkeypatch
):
    seen = []

    def look():
        # not the peak of the process: an earlier test may have held more
        seen.append(process_memory())
        LOOKED.set()
        return seen[-1]

    monkeypatch.setattr(machine_resources, "process_memory", look)
    store = Store(tmp_path)
    limit = program_memory() + 300 * MB
    with pytest.raises(
        RunError, match=r"b \(.*hoard\): MemoryLimit: the process holds .* the limit is "
    ) as caught:
        run(recipe(), store, memory=limit)
    assert caught.value.step == "b"
    assert limit < max(seen) < limit + 100 * MB  # of pieces of 20 MB
    done = run(recipe(), Store(tmp_path), ("a",)).done
    assert done["a"].state == "cached"


def test_a_limit_below_the_program_itself_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(RunError, match=r"TooLarge: .* of which the program itself holds"):
        run(recipe(), Store(tmp_path), memory=MB)
    assert list(Store(tmp_path).journal.rows()) == []


def test_without_a_limit_nothing_is_watched():
    with guarded():
        assert not [t for t in threading.enumerate() if t.name == "neusee memory" and not t.daemon]


def stay(pauses):
    """Be a step that computes nothing for ``pauses`` hundredths of a second."""
    for _ in range(pauses):
        threading.Event().wait(0.01)


def test_an_error_that_comes_too_late_for_the_step_is_raised_at_its_end():
    with limited(1.0), pytest.raises(MemoryLimit), guarded():
        stay(30_000)
    with limited(1e15), guarded():
        stay(5)


TRACED = """
import sys, threading
from neusee.workflows.engine import machine_resources
from neusee.workflows.engine.machine_resources import MemoryLimit, guarded, limited

def step():
    return lambda: here

try:
    with limited(1e15), guarded():
        here = threading.get_ident()
        machine_resources._watched_threads[here] = True  # told to stop when the step has ended
except MemoryLimit:
    sys.settrace(lambda *_: None)
    step()
    print("went on")
"""


def test_nothing_is_left_to_be_delivered_to_a_thread_that_was_told_too_late():
    """What is left makes every call of CPython 3.11 slow, and hangs a program that is traced, as
    by a debugger.
    """
    found = subprocess.run(
        [sys.executable, "-c", TRACED], capture_output=True, text=True, check=True, timeout=300
    )
    assert found.stdout == "went on\n"


def test_the_peak_of_the_process_is_not_forgotten_when_a_step_is_measured():
    # returned at once when it is closed
    block = mmap.mmap(-1, process_peak() - process_memory() + 200 * MB)
    for _ in range(len(block) // MB):
        block.write(b"1" * MB)
    before = process_peak()
    assert before >= process_memory() - MB
    block.close()
    with PeakMemory("cpu"):
        pass
    assert process_peak() >= before - MB
    assert process_memory() < before - 150 * MB


def test_runs_that_follow_at_once_look_at_the_free_memory_once(monkeypatch):
    looks, now = [], [100.0]
    monkeypatch.setattr(machine_resources, "_free_memory", lambda: looks.append(1) or len(looks))
    monkeypatch.setattr(machine_resources.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(machine_resources, "_newest_free", [-1.0, 0.0])
    assert [free_memory(), free_memory()] == [1, 1]
    now[0] += 1.01 * machine_resources.FRESH_SECONDS
    assert free_memory() == 2
    now[0] = 1.0  # a clock of another boot
    assert free_memory() == 3


def test_free_memory_is_what_the_machine_can_give():
    assert 0 < free_memory() < 1 << 50
