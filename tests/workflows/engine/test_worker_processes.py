"""Workers do each piece of work once, and what they cannot do stays with the caller, also after
kill -9.
"""

import os
import signal
import subprocess
import sys
import threading
import time
import warnings

import pytest
import torch

from neusee.workflows.engine import machine_resources as memory_watch
from neusee.workflows.engine import worker_processes
from neusee.workflows.engine.worker_processes import shared, shared_in_order, workers_for

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="workers are forks")


def test_every_piece_is_done_once_by_another_process():
    found = dict(shared(lambda n: (n * n, os.getpid()), range(40), 2))
    assert {n: each[0][0] for n, each in found.items()} == {n: n * n for n in range(40)}
    assert os.getpid() not in {each[0][1] for each in found.values()}


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_results_come_in_order_and_with_the_bits_of_this_process(workers):
    def work(number):
        return (
            torch.rand(1000, generator=torch.Generator().manual_seed(number))
            .exp()
            .sum(0, keepdim=True)
        )

    found = list(shared_in_order(work, 9, workers))
    assert torch.equal(torch.cat(found), torch.cat([work(n) for n in range(9)]))


def test_neighbours_stay_with_one_worker_where_they_are_apart(tmp_path):
    def work(number):
        (tmp_path / str(number)).touch()
        _wait(tmp_path / str((number + 4) % 8))  # so that no worker is ahead of the other
        return os.getpid()

    found = [each[0] for _, each in sorted(shared(work, range(8), 2, apart=True))]
    assert found == [found[0]] * 4 + [found[4]] * 4
    assert found[0] != found[4]


def test_a_worker_that_is_ready_helps_the_other(tmp_path):
    def work(number):
        for other in range(1, 20) if number == 0 else ():
            _wait(tmp_path / str(other))
        (tmp_path / str(number)).touch()
        return os.getpid()

    found = [each[0] for _, each in sorted(shared(work, range(20), 2, apart=True))]
    assert found[1:] == [found[-1]] * 19
    assert found[0] != found[1]


def _wait(path):
    ends = time.monotonic() + 60.0
    while not path.exists():
        assert time.monotonic() < ends
        time.sleep(0.001)


def test_a_piece_that_fails_is_left_to_the_caller():
    def work(number):
        if number == 3:
            raise ValueError("three")
        return number

    assert dict(shared(work, range(6), 2)) == {n: None if n == 3 else (n,) for n in range(6)}
    with pytest.raises(ValueError, match="three"):
        list(shared_in_order(work, 6, 2))


def test_results_before_a_failure_are_given_first():
    def work(number):
        if number == 1:
            raise ValueError("one")
        time.sleep(0.2 if number == 0 else 0.0)
        return number

    found = shared_in_order(work, 4, 2)
    assert next(found) == 0
    with pytest.raises(ValueError, match="one"):
        next(found)


@pytest.mark.parametrize("deadly", [{3}, set(range(12))])
def test_pieces_of_killed_workers_are_left_to_the_caller(deadly):
    mine = os.getpid()

    def work(number):
        if number in deadly and os.getpid() != mine:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    found = dict(shared(work, range(12), 2))
    assert sorted(found) == list(range(12))
    assert {n for n, each in found.items() if each is None} == deadly
    assert list(shared_in_order(work, 12, 2)) == list(range(12))


def test_a_result_that_cannot_be_sent_is_left_to_the_caller():
    assert dict(shared(lambda n: lambda: n, range(3), 2)) == {0: None, 1: None, 2: None}


def test_warnings_of_a_worker_are_given_here():
    def work(number):
        warnings.warn(f"piece {number}", stacklevel=1)

    with pytest.warns(UserWarning, match="piece") as told:
        list(shared(work, range(2), 2))
    assert {str(each.message) for each in told} == {"piece 0", "piece 1"}


def test_workers_have_one_thread():
    assert list(shared_in_order(lambda _: torch.get_num_threads(), 2, 2)) == [1, 1]


def test_the_memory_of_a_worker_is_watched_beside_a_run_of_this_process():
    def work(number):
        with memory_watch.limited(1e6 if number else 1e15), memory_watch.guarded():
            # until the watch stops it, which a busy machine may do late
            for _ in range(30_000 if number else 1):
                time.sleep(0.01)

    with memory_watch.limited(1e15), memory_watch.guarded():  # the thread that looks is in no fork
        assert dict(shared(work, range(2), 2)) == {0: (None,), 1: None}


def test_no_worker_is_left_when_the_caller_stops_early():
    found = shared(lambda n: (time.sleep(5 * (n > 1)), os.getpid()), range(9), 2)
    pid = next(found)[1][0][1]
    found.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.slow
def test_workers_end_with_a_process_that_is_killed():
    code = (
        "import os, time\nfrom neusee.workflows.engine.worker_processes import shared\n"
        "def work(n):\n    print(os.getpid(), flush=True)\n    time.sleep(60)\n"
        "list(shared(work, range(2), 2))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as process:
        pids = [int(process.stdout.readline()) for _ in range(2)]
        process.kill()
    ends = time.monotonic() + 60.0
    while any(map(_runs, pids)):
        assert time.monotonic() < ends
        time.sleep(0.01)


def _runs(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_workers_are_as_many_as_free_processors_pieces_and_wishes_allow(monkeypatch):
    monkeypatch.setattr(worker_processes, "free_processors", lambda: 4)
    monkeypatch.setattr(threading, "enumerate", lambda: [threading.main_thread()])
    assert [workers_for(9), workers_for(3), workers_for(9, 2), workers_for(0)] == [4, 3, 2, 1]
    monkeypatch.setattr(worker_processes, "free_processors", lambda: None)
    assert workers_for(9) == 1


def test_beside_threads_of_others_there_are_workers_only_where_they_are_asked_for(monkeypatch):
    monkeypatch.setattr(worker_processes, "free_processors", lambda: 4)
    own, others = threading.Thread(name="neusee store"), threading.Thread(name="kernel")
    monkeypatch.setattr(threading, "enumerate", lambda: [threading.main_thread(), own])
    assert workers_for(9) == 4
    monkeypatch.setattr(threading, "enumerate", lambda: [threading.main_thread(), own, others])
    assert [workers_for(9), workers_for(9, 3)] == [1, 3]
