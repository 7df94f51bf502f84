"""The observed call itself: its value, its exceptions, what its thread knows, and the death of
its watcher.
"""

import _thread
import contextvars
import ctypes
import gc
import os
import signal
import sys
import threading
import time
import traceback
from pathlib import Path

import pytest
import torch

from neusee.workflows.observation import kernel_layer, python_watch
from neusee.workflows.observation.observed_call import observed
from neusee.workflows.observation.taints import Covered

NOTHING = Covered(frozenset(), lambda name: True)
_word = contextvars.ContextVar("word", default="")


def test_the_value_comes_back_as_it_is(layer):
    value = torch.ones(3)
    assert observed(lambda: value, NOTHING) == (value, ())


def test_an_exception_passes_with_its_traceback(layer):
    error = ValueError("too bright")

    def fails():
        raise error

    with pytest.raises(ValueError, match="too bright") as caught:
        observed(fails, NOTHING)
    assert caught.value is error
    assert "fails" in [frame.name for frame in traceback.extract_tb(error.__traceback__)]
    assert error.__cause__ is error.__context__ is None


@pytest.mark.parametrize("kind", [SystemExit, KeyboardInterrupt, StopIteration, MemoryError])
def test_an_exception_of_any_kind_passes(kind, layer):
    def fails():
        raise kind

    with pytest.raises(kind):
        observed(fails, NOTHING)


def test_the_thread_of_the_step_computes_as_the_caller_would(layer):
    _word.set("said")
    before = torch.get_num_threads()

    def modes():
        return (
            torch.is_grad_enabled(),
            torch.is_inference_mode_enabled(),
            torch.get_num_threads(),
            _word.get(),
        )

    torch.set_num_threads(2)
    try:
        assert observed(modes, NOTHING)[0] == (True, False, 2, "said")
        with torch.no_grad():
            assert observed(modes, NOTHING)[0] == (False, False, 2, "said")
        with torch.inference_mode():
            assert observed(modes, NOTHING)[0] == (False, True, 2, "said")
    finally:
        torch.set_num_threads(before)


def test_gradients_pass_through(layer):
    x = torch.tensor(3.0, requires_grad=True)
    observed(lambda: x**2, NOTHING)[0].backward()
    assert x.grad == 6


def test_a_call_within_a_call_is_a_part_of_it(tmp_path, taints, layer):
    path = tmp_path / "gain.csv"
    path.write_text("2")
    inner = []
    assert taints(lambda: inner.append(observed(path.read_text, NOTHING))) == [("file", "gain.csv")]
    assert inner == [("2", ())]


def test_calls_of_several_threads_take_turns(tmp_path, layer):
    inside, most, taints = [], [], []

    def step(path):
        inside.append(path)
        most.append(len(inside))
        path.write_text("2")
        time.sleep(0.02)
        inside.remove(path)

    def run(path):
        taints.append(observed(lambda: step(path), NOTHING)[1])

    threads = [threading.Thread(target=run, args=(tmp_path / str(i),)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(most) == 1
    assert taints == [()] * 4


def test_garbage_is_collected_again(layer):
    assert gc.isenabled()
    assert observed(gc.isenabled, NOTHING)[0]
    assert gc.isenabled()


@pytest.fixture
def heard():
    """Ctrl-C raises, also in a process that was started in the background and ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_ctrl_c_does_not_wait_and_stops_the_step(layer, heard):
    began, ended = threading.Event(), threading.Event()

    def step():
        try:
            began.set()
            while True:
                time.sleep(0.01)
        finally:
            ended.set()

    def interrupt():
        began.wait()
        _thread.interrupt_main()

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        observed(step, NOTHING)
    assert ended.wait(60)
    assert observed(lambda: 1, NOTHING) == (1, ())


def test_an_exception_that_another_thread_raises_in_the_caller_waits_for_the_step(layer):
    """As the watch over the memory does."""

    class TooLarge(Exception):
        pass

    began, ended, caught = threading.Event(), threading.Event(), []

    def step():
        try:
            began.set()
            while True:
                time.sleep(0.01)
        finally:
            ended.set()

    def call():
        try:
            observed(step, NOTHING)
        except TooLarge:
            caught.append(ended.is_set())

    thread = threading.Thread(target=call)
    thread.start()
    began.wait()
    ctypes.pythonapi.PyThreadState_SetAsyncExc(
        ctypes.c_ulong(thread.ident), ctypes.py_object(TooLarge)
    )
    thread.join(60)
    assert caught == [True]


# --- the process that answers ---------------------------------------------------------------------


def server():
    return kernel_layer.client().server()


def test_one_process_answers_for_all_calls(watched):
    first = server()
    for _ in range(3):
        observed(lambda: os.listdir("/"), NOTHING)
    assert server() == first


def test_a_process_that_died_between_two_calls_is_started_again(tmp_path, taints, watched):
    (tmp_path / "gain.csv").write_text("2")
    first = server()
    os.kill(first, signal.SIGKILL)
    os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)
    assert taints((tmp_path / "gain.csv").read_text) == [("file", "gain.csv")]
    assert server() != first


def test_a_step_whose_watcher_dies_runs_again_and_is_tainted(tmp_path, taints, watched):
    (tmp_path / "gain.csv").write_text("2")
    runs = []

    def step():
        runs.append(0)
        if len(runs) == 1:
            os.kill(server_of_this_call, signal.SIGKILL)
            os.waitid(os.P_PID, server_of_this_call, os.WEXITED | os.WNOWAIT)
        return (tmp_path / "gain.csv").read_text()

    server_of_this_call = server()
    found = taints(step)
    assert len(runs) == 2
    assert found[0] == ("file", "gain.csv")
    assert [kind for kind, _ in found] == ["file", "unknown"]
    assert taints(lambda: None) == []


def test_a_step_whose_watcher_cannot_be_started_is_tainted(taints, watched, monkeypatch):
    observed(lambda: None, NOTHING)
    kernel_layer.give_up()
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    assert [kind for kind, _ in taints(lambda: None)] == ["unknown"]


def test_a_process_that_was_forked_has_a_watcher_of_its_own(tmp_path, taints, watched):
    (tmp_path / "gain.csv").write_text("2")
    first = server()
    code = tmp_path / "code"
    child = os.fork()
    if child == 0:
        try:
            good = (
                taints((tmp_path / "gain.csv").read_text) == [("file", "gain.csv")]
                and server() != first
            )
            code.write_text("good" if good else "bad")
            kernel_layer.give_up()
        except BaseException:
            code.write_text(traceback.format_exc())
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    assert code.read_text() == "good"
    assert server() == first


@pytest.mark.slow
def test_the_watcher_ends_with_its_process_and_with_what_a_step_left_behind(tmp_path, watched):
    """A process that a step started goes on after both, and its calls are answered until it
    ends.
    """
    command = f"sleep 0.3; cat /etc/passwd >{tmp_path}/left; echo $? >{tmp_path}/code"
    child = os.fork()
    if child == 0:
        try:
            observed(lambda: os.posix_spawn("/bin/sh", ["sh", "-c", command], os.environ), NOTHING)
            (tmp_path / "watcher").write_text(str(server()))
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    watcher, end = Path("/proc", (tmp_path / "watcher").read_text()), time.monotonic() + 60
    while watcher.exists() and time.monotonic() < end:
        time.sleep(0.01)
    assert not watcher.exists()
    assert (tmp_path / "code").read_text() == "0\n"
    assert (tmp_path / "left").stat().st_size > 0


def test_a_thread_that_a_step_left_behind_goes_on(tmp_path, taints, watched):
    go, read = threading.Event(), []

    def later():
        go.wait()
        read.append((tmp_path / "gain.csv").read_text())

    (tmp_path / "gain.csv").write_text("2")
    left = threading.Thread(target=later)
    assert taints(left.start) == []
    assert taints(lambda: (go.set(), left.join())) == []  # its reads are not those of the next call
    assert read == ["2"]


def test_nothing_is_watched_between_the_calls(watched):
    def filters():
        lines = Path("/proc/thread-self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("Seccomp_filters"))

    before = filters()
    assert observed(filters, NOTHING)[0] == before + 1
    assert python_watch.watch_here() is None
    assert filters() == before
