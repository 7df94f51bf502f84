"""Leases: one live owner at a time, taken over as soon as it is dead and never because a clock
jumped.
"""

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from neusee.workflows.store import lease as lease_module
from neusee.workflows.store import shared_folder
from neusee.workflows.store import shared_folder as process_owner
from neusee.workflows.store.lease import Lease
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.shared_folder import Owner, me, owner_of

KEY = "ab" + "0" * 30
FAR = "0123456789ab-77-1234"  #: a process of another machine

# the child uses no other thread
FORKS = pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")

HOLDER = """
import sys, time
from pathlib import Path
from neusee.workflows.store.result_store import Store
store = Store(Path(sys.argv[1]))
lease = store.claim(sys.argv[2])
part = store.disk.temporary(sys.argv[2])
part.__enter__()
print(lease is not None, flush=True)
time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path):
    """Start processes that hold the lease of `KEY` and have a file half written; they are ended
    afterwards.
    """
    started = []

    def start(key=KEY):
        command = [sys.executable, "-c", HOLDER, str(tmp_path), key]
        process = subprocess.Popen(command, stdout=subprocess.PIPE)
        started.append(process)
        assert process.stdout.readline() == b"True\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


def held_by(root, text, key=KEY):
    """The lease of somebody else."""
    (root / "tmp").mkdir(parents=True, exist_ok=True)
    path = root / "tmp" / f"{key}.lease"
    path.write_text(text)
    return path


def temporaries(root):
    return sorted(
        f.name
        for f in (root / "tmp").iterdir()
        if f.name != ".lock" and not f.name.startswith("badge.")
    )


def test_one_holder_at_a_time(tmp_path):
    one, two = Store(tmp_path), Store(tmp_path)
    with one.claim(KEY) as lease:
        assert isinstance(lease, Lease)
        assert two.claim(KEY) is None
        assert one.claim(KEY) is None
        with two.claim("cd" + "0" * 30):
            pass
    with two.claim(KEY):
        assert one.claim(KEY) is None
    assert temporaries(tmp_path) == []


def test_a_lease_is_released_once(tmp_path):
    store = Store(tmp_path)
    first = store.claim(KEY)
    first.release()
    with store.claim(KEY):
        first.release()
        assert store.claim(KEY) is None


def test_many_threads_one_holder(tmp_path):
    store, inside, most = Store(tmp_path), [], []

    def work(i):
        while (lease := store.claim(KEY)) is None:
            time.sleep(0.0005)
        with lease:
            inside.append(i)
            most.append(len(inside))
            time.sleep(0.001)
            inside.remove(i)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(24)))
    assert most == [1] * 24


def test_of_two_who_find_that_a_holder_has_gone_one_is_first(tmp_path, monkeypatch):
    first, second = Store(tmp_path), Store(tmp_path)
    lease = first.claim(KEY)
    monkeypatch.setattr(
        lease_module, "_state_of_lease", lambda path: None
    )  # as it was a moment ago
    assert second.claim(KEY) is None
    monkeypatch.undo()
    with lease:
        assert Store(tmp_path).claim(KEY) is None


def test_a_live_holder_elsewhere_is_waited_for_and_a_killed_one_taken_over(tmp_path, holder):
    process, store = holder(), Store(tmp_path)
    assert store.claim(KEY) is None
    assert len([name for name in temporaries(tmp_path) if name.startswith(KEY)]) == 2
    process.send_signal(signal.SIGKILL)
    process.wait()
    with store.claim(KEY):
        assert temporaries(tmp_path) == [f"{KEY}.lease"]
        assert Store(tmp_path).claim(KEY) is None


def test_a_stopped_holder_is_taken_over_and_may_go_on(tmp_path, holder):
    process, store = holder(), Store(tmp_path)
    process.send_signal(signal.SIGSTOP)
    while (
        Owner(process_owner.host(), process.pid, process_owner._process(process.pid)[1]).state
        == "alive"
    ):
        time.sleep(0.001)
    with store.claim(KEY):
        process.send_signal(signal.SIGCONT)
        assert Store(tmp_path).claim(KEY) is None


def test_what_a_killed_process_left_goes_with_the_next_write(tmp_path, holder):
    killed, alive = holder(), holder("cd" + "0" * 30)
    killed.kill()
    killed.wait()
    Store(tmp_path).put("ef" + "0" * 30, torch.zeros(5000), {})
    left = temporaries(tmp_path)
    assert all(name.startswith("cd") for name in left)
    assert len(left) == 2
    assert alive.poll() is None


def test_a_number_that_another_process_has_now_is_no_owner(tmp_path):
    held_by(tmp_path, f"{process_owner.host()}-{os.getpid()}-1 nonce\n")
    held_by(tmp_path, f"{process_owner.host()}-1-1 nonce\n", "cd" + "0" * 30)
    with Store(tmp_path).claim(KEY), Store(tmp_path).claim("cd" + "0" * 30):
        pass


def test_ended_but_unburied_is_dead():
    process = subprocess.Popen([sys.executable, "-c", ""])
    owner = Owner(process_owner.host(), process.pid, process_owner._process(process.pid)[1])
    while process_owner._process(process.pid)[0] != "Z":
        time.sleep(0.001)
    assert owner.state == "dead"
    process.wait()
    assert owner.state == "dead"


class Clock:
    """A steady clock that one sets; the clock on the wall jumps as it likes."""

    def __init__(self, monkeypatch):
        self.now = 1000.0
        monkeypatch.setattr(lease_module.time, "monotonic", lambda: self.now)
        self.jump = lambda by: monkeypatch.setattr(lease_module.time, "time", lambda: 1.9e9 + by)


@pytest.mark.parametrize("text", [FAR + " nonce\n", "", "\xff\xfe", "not-an-owner", "x" * 10_000])
def test_a_foreign_holder_is_dead_after_a_window_without_a_heartbeat(tmp_path, monkeypatch, text):
    clock, store = Clock(monkeypatch), Store(tmp_path)
    held_by(tmp_path, text)
    assert store.claim(KEY) is None
    clock.now += lease_module.WINDOW - 0.1
    assert store.claim(KEY) is None
    assert Store(tmp_path).claim(KEY) is None
    clock.now += 0.2
    with store.claim(KEY):
        pass


@pytest.mark.parametrize("jump", [-1e9, -3600.0, 3600.0, 1e9])
def test_a_foreign_holder_that_beats_lives_however_the_clocks_jump(tmp_path, monkeypatch, jump):
    clock, store = Clock(monkeypatch), Store(tmp_path)
    path = held_by(tmp_path, FAR + " nonce\n")
    for i in range(5):
        clock.jump(jump * (i % 2))
        os.utime(path, (1e9, 1e9))
        assert store.claim(KEY) is None
        clock.now += lease_module.WINDOW + 1
        shared_folder.append(path, b".")
    assert path.read_text().startswith(FAR)


@pytest.mark.parametrize("jump", [-1e9, -7200.0, 7200.0, 1e9])
def test_no_clock_makes_our_own_files_old(tmp_path, monkeypatch, jump):
    store = Store(tmp_path)
    with store.claim(KEY), store.disk.temporary(KEY) as (part, _):
        os.utime(part, (1e9, 1e9))
        os.utime(tmp_path / "tmp" / f"{KEY}.lease", (1e9, 1e9))
        monkeypatch.setattr(shared_folder.time, "time", lambda: time.perf_counter() + 1.9e9 + jump)
        other = Store(tmp_path)
        assert other.put("cd" + "0" * 30, torch.zeros(5000), {})
        assert other.gc().orphans == 0
        assert other.claim(KEY) is None
        assert os.path.exists(part)


def test_a_value_is_written_again_where_its_half_was_swept(tmp_path, monkeypatch):
    store, flush, tries = Store(tmp_path), os.fsync, []

    def swept(file):
        flush(file)
        tries.append(file)
        if len(tries) == 1:
            for path in (tmp_path / "tmp").glob(f"{KEY}*"):
                path.unlink()

    monkeypatch.setattr(os, "fsync", swept)
    assert store.put(KEY, torch.ones(5000), {})
    assert len(tries) == 2
    assert Store(tmp_path).get(KEY).sum() == 5000


def test_the_store_may_be_removed_under_a_run(tmp_path):
    store = Store(tmp_path / "cache")
    with store.claim(KEY):
        store.put(KEY, torch.ones(5000), {})
        subprocess.run(["rm", "-r", tmp_path / "cache"], check=True)
    with store.claim(KEY):
        assert store.put(KEY, torch.ones(5000), {})
    assert Store(tmp_path / "cache").has(KEY)


def test_a_heartbeat_that_ended_early_starts_again(tmp_path, monkeypatch):
    ended = threading.Thread(target=list, name="neusee-leases ended")
    ended.start()
    ended.join()
    monkeypatch.setattr(lease_module, "_thread", ended)
    with Store(tmp_path).claim(KEY):
        assert lease_module._thread is not ended
        assert lease_module._thread.is_alive()


@pytest.mark.slow
def test_heartbeats_are_seen_while_a_lease_is_held_and_end_after_it(tmp_path, monkeypatch):
    monkeypatch.setattr(lease_module, "BEAT", 0.01)
    while any(t.name == "neusee-leases" for t in threading.enumerate()):
        time.sleep(0.01)  # one of an earlier test
    store = Store(tmp_path)
    with store.claim(KEY), store.claim("cd" + "0" * 30):
        path = tmp_path / "tmp" / f"{KEY}.lease"
        size = path.stat().st_size
        until = time.monotonic() + 120
        while path.stat().st_size < size + 3 and time.monotonic() < until:
            time.sleep(0.005)
        assert path.stat().st_size >= size + 3
        assert sum(t.name == "neusee-leases" for t in threading.enumerate()) == 1
    until = time.monotonic() + 120
    while (
        any(t.name == "neusee-leases" for t in threading.enumerate()) and time.monotonic() < until
    ):
        time.sleep(0.005)
    assert not any(t.name == "neusee-leases" for t in threading.enumerate())
    assert not list((tmp_path / "tmp").glob("badge.*"))
    with store.claim(KEY):
        assert Store(tmp_path).claim(KEY) is None


@FORKS
def test_two_may_clear_the_badges_away_at_once(tmp_path, monkeypatch):
    places = {str(i): str(tmp_path / str(i)) for i in range(3)}
    monkeypatch.setattr(lease_module, "_badges", dict(places))
    removed = []

    def unlink(path):
        removed.append(path)
        if len(removed) == 1:
            lease_module.retire()

    monkeypatch.setattr(lease_module.os, "unlink", unlink)
    lease_module.retire()
    assert sorted(removed) == sorted(places.values())
    assert lease_module._badges == {}


def test_a_forked_child_holds_nothing(tmp_path):
    store = Store(tmp_path)
    with store.claim(KEY) as lease:
        child = os.fork()
        if child == 0:
            lease.release()
            os._exit(
                int(
                    store.claim(KEY) is not None
                    or (tmp_path / "tmp" / f"{KEY}.lease").exists() is False
                )
            )
        assert os.waitpid(child, 0)[1] == 0
        assert Store(tmp_path).claim(KEY) is None


@FORKS
def test_a_child_may_have_leases_of_its_own(tmp_path):
    store, other = Store(tmp_path), "cd" + "0" * 30
    with store.claim(KEY):
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            os.write(writer, b"1" if store.claim(other) is not None else b"0")
            signal.pause()
        assert os.read(reader, 1) == b"1"
        assert store.claim(other) is None
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        with store.claim(other):
            pass
        os.close(reader)
        os.close(writer)


def test_a_folder_that_takes_no_files_gives_leases_that_do_nothing(tmp_path):
    (tmp_path / "file").write_text("in the way")
    store = Store(tmp_path / "file")
    with store.claim(KEY) as one, store.claim(KEY) as two:
        assert isinstance(one, Lease)
        assert isinstance(two, Lease)


@pytest.mark.parametrize(
    "number", [errno.ENOSPC, errno.EROFS, errno.EPERM, errno.EOPNOTSUPP, errno.EMLINK]
)
def test_a_disk_that_fails_gives_leases_that_do_nothing(tmp_path, monkeypatch, number):
    def fail(*args):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "link", fail)
    with Store(tmp_path).claim(KEY) as lease:
        assert isinstance(lease, Lease)
    assert temporaries(tmp_path) == []


def test_two_who_see_the_same_dead_holder_do_not_both_take_over(tmp_path):
    one, two = Store(tmp_path), Store(tmp_path)
    path = held_by(tmp_path, f"{process_owner.host()}-{os.getpid()}-1 nonce\n")
    found = lease_module._state_of_lease(path)
    lease = one._leases._taken_over(KEY, str(path), found)
    with pytest.raises(FileExistsError):
        two._leases._taken_over(KEY, str(path), found)
    lease.release()


def test_a_lease_that_was_taken_over_is_left_to_the_one_who_has_it(tmp_path):
    store = Store(tmp_path)
    lease = store.claim(KEY)
    path = tmp_path / "tmp" / f"{KEY}.lease"
    (tmp_path / "tmp" / "other").write_text(FAR + " nonce\n")
    os.replace(tmp_path / "tmp" / "other", path)
    lease.release()
    assert path.read_text().startswith(FAR)


def test_an_owner_reads_back():
    assert owner_of(str(me())) == me()
    assert me().state == "alive"
    assert owner_of(FAR).state == "foreign"
    for text in (
        "",
        "a-b-c",
        "0123456789ab",
        "0123456789ab-x-1",
        "0123456789ab--",
        KEY,
        "0123456789ab-" + "9" * 50,
    ):
        assert owner_of(text) is None
