"""A killed scheduler, killed workers and a cut network: one sentence, or the run goes on;
nothing finished is lost.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import uuid

import pytest

from tests.workflows.engine.cluster_processes import (
    PATIENCE,
    ROOT,
    Command,
    expected,
    no_page_of_errors,
    output_of,
    states_of,
    write_lab,
)
from tests.workflows.program_forks import Programs

pytest.importorskip("distributed", reason="distributed is not installed")
pytestmark = pytest.mark.slow

#: timeouts of dask that are shorter than in use, so that a cut beyond them takes seconds; 11 s is
#: the least
SHORT = {
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP": "12s",
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s",
}
STEPS = 12
#: s until a run gives up, where this is what it shall do; else a minute, as in use
BRIEF = 4.0


class Machine:
    """The processes of a cluster, started with the commands of dask, in a namespace or in this
    one.
    """

    def __init__(self, folder, host="127.0.0.1", within=()):
        self.folder, self.host, self.within = folder, host, within
        self.processes = []
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://{host}:{self.port}"

    def start(self, *words):
        path = f"{ROOT / '.src'}:{os.environ.get('PYTHONPATH', '')}"
        own = {
            "PYTHONPATH": path,
            "OMP_NUM_THREADS": "1",
            "NEUSEE_CACHE": str(self.folder / "cache"),
            **SHORT,
        }
        log = (self.folder / f"log{len(self.processes)}").open("w")
        command = [*self.within, sys.executable, "-m", *words]
        with log:
            self.processes.append(
                subprocess.Popen(
                    command,
                    env={**os.environ, **own},
                    cwd=self.folder,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
            )
        return self.processes[-1]

    def scheduler(self):
        where = ("--host", self.host, "--port", f"{self.port}", "--no-dashboard")
        return self.start("distributed.cli.dask_scheduler", *where)

    def worker(self, *options):
        where = ("--host", self.host, "--nthreads", "1", "--no-dashboard", *options)
        return self.start("distributed.cli.dask_worker", self.address, *where)

    def waits_for_worker(self):
        """Wait until the scheduler has the worker that was started last."""
        log, end = self.folder / f"log{len(self.processes) - 1}", time.monotonic() + PATIENCE
        while "Registered to" not in log.read_text():
            assert self.processes[-1].poll() is None, log.read_text()
            assert time.monotonic() < end, log.read_text()
            time.sleep(0.05)

    def end(self):
        for process in self.processes:
            kill(process)


def kill(process):
    """Kill a process and those that it started."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait(PATIENCE)


@pytest.fixture
def lab(tmp_path):
    write_lab(tmp_path, STEPS)
    return tmp_path


@pytest.fixture
def machine(lab):
    found = Machine(lab)
    yield found
    found.end()


@pytest.fixture
def begin(lab):
    """Start ``neusee run lab.yaml`` on a scheduler."""
    begun = []

    def start(address, patience=None):
        words = ("run", "lab.yaml", "--executor", address)
        begun.append(Command(lab, *words, patience=patience, **SHORT))
        return begun[-1]

    yield start
    for command in begun:
        command.stop()


@pytest.fixture(scope="module")
def programs():
    server = Programs()
    yield server
    server.close()


@pytest.fixture
def goes_on(lab, programs):
    """Run again on this machine: what was finished is not computed again, and the picture is
    right.
    """

    def again(text):
        done = set(re.findall(r"^ +(\w+) +cpu +run ", text, re.MULTILINE))
        assert done, text
        own = {"NEUSEE_CACHE": str(lab / "cache"), "OMP_NUM_THREADS": "1"}
        ended = programs.run(["run", "lab.yaml"], lab, {**os.environ, **own})
        assert ended.returncode == 0, ended
        states = states_of(lab)
        assert all(states[name] in ("cached", "not needed") for name in done), (states, text)
        assert output_of(lab) == expected(STEPS)

    return again


def test_a_killed_scheduler(machine, begin, goes_on):
    scheduler = machine.scheduler()
    machine.worker("--no-nanny")
    machine.waits_for_worker()
    command = begin(machine.address, (BRIEF, 60))
    command.waits_for(r"a1 +cpu")
    kill(scheduler)
    code, text = command.end()
    assert code == 1, text
    assert (
        f"warning: the scheduler {machine.address} does not answer: waiting up to {BRIEF:.0f} s"
        in text
    )
    assert (
        f"the scheduler {machine.address} has ended, or the network to it is cut\nfailed: " in text
    )
    no_page_of_errors(text)
    goes_on(text)


def test_a_scheduler_that_takes_leave(machine, begin, goes_on):
    scheduler = machine.scheduler()
    machine.worker("--no-nanny")
    machine.waits_for_worker()
    command = begin(machine.address, (BRIEF, 60))
    command.waits_for(r"a1 +cpu")
    scheduler.terminate()
    code, text = command.end()
    assert code == 1, text
    assert (
        f"the scheduler {machine.address} has ended, or the network to it is cut\nfailed: " in text
    )
    no_page_of_errors(text)
    goes_on(text)


def test_a_scheduler_that_is_started_again(lab, machine, begin):
    scheduler = machine.scheduler()
    machine.worker("--no-nanny")
    command = begin(machine.address)
    command.waits_for(r"a1 +cpu")
    kill(scheduler)
    command.waits_for("does not answer: waiting up to 60 s")
    machine.scheduler()
    machine.worker()  # a worker of dask ends with its scheduler, and comes after the tasks
    code, text = command.end()
    assert code == 0, text
    no_page_of_errors(text)
    assert output_of(lab) == expected(STEPS)


def test_the_only_worker_is_killed(machine, begin, goes_on):
    machine.scheduler()
    worker = machine.worker("--no-nanny")
    machine.waits_for_worker()
    command = begin(machine.address, (BRIEF, 60))
    command.waits_for(r"a1 +cpu")
    kill(worker)
    code, text = command.end()
    assert code == 1, text
    assert f"the scheduler {machine.address} has had no worker for {BRIEF:.0f} s\nfailed: " in text
    no_page_of_errors(text)
    goes_on(text)


def test_one_of_two_workers_is_killed_then_the_other_one_and_a_third_one_comes(lab, machine, begin):
    machine.scheduler()
    workers = [machine.worker("--no-nanny") for _ in range(2)]
    machine.waits_for_worker()
    command = begin(machine.address)
    command.waits_for(r"a1 +cpu")
    kill(workers[0])
    command.waits_for(r"a3 +cpu")
    kill(workers[1])
    machine.worker("--no-nanny")
    code, text = command.end()
    assert code == 0, text
    no_page_of_errors(text)
    assert output_of(lab) == expected(STEPS)


def test_no_scheduler_is_there(machine, begin):
    code, text = begin(machine.address, (60, BRIEF)).end()
    assert code == 1, text
    assert f"no scheduler of dask answers at {machine.address} within {BRIEF:.0f} s" in text
    no_page_of_errors(text)


# a network that is cut


class Network:
    """A network namespace with the cluster, and a wire to it that can be cut."""

    def __init__(self):
        self.name = f"neusee{uuid.uuid4().hex[:6]}"
        self.wire, self.there = f"n{self.name[6:]}a", f"n{self.name[6:]}b"
        number = int(self.name[6:8], 16)
        self.here_address, self.address = f"10.213.{number}.1", f"10.213.{number}.2"

    def begin(self):
        ip("netns", "add", self.name)
        ip("link", "add", self.wire, "type", "veth", "peer", "name", self.there, "netns", self.name)
        ip("addr", "add", f"{self.here_address}/24", "dev", self.wire)
        ip("link", "set", self.wire, "up")
        for words in (
            ("addr", "add", f"{self.address}/24", "dev", self.there),
            ("link", "set", self.there, "up"),
        ):
            ip("-n", self.name, *words)
        ip("-n", self.name, "link", "set", "lo", "up")

    def cut(self):
        ip("link", "set", self.wire, "down")

    def mend(self):
        ip("link", "set", self.wire, "up")

    def end(self):
        subprocess.run(["ip", "netns", "del", self.name], capture_output=True)
        subprocess.run(["ip", "link", "del", self.wire], capture_output=True)


def ip(*words):
    done = subprocess.run(["ip", *words], capture_output=True, text=True)
    if done.returncode:
        raise OSError(done.stderr.strip())


@pytest.fixture
def network():
    if not shutil.which("ip"):
        pytest.skip("there is no command ip")
    found = Network()
    try:
        found.begin()
    except OSError as error:
        found.end()
        pytest.skip(f"network namespaces are not permitted: {error}")
    yield found
    found.end()


@pytest.fixture
def far(lab, network):
    """A scheduler and a worker behind the wire."""
    found = Machine(lab, network.address, ("ip", "netns", "exec", network.name))
    found.scheduler()
    found.worker("--no-nanny")
    found.waits_for_worker()
    yield found
    found.end()


def test_a_short_cut_of_the_network_and_one_that_is_longer_than_the_timeouts(
    lab, network, far, begin
):
    command = begin(far.address)
    command.waits_for(r"a1 +cpu")
    network.cut()
    network.mend()
    command.waits_for(r"a4 +cpu")
    assert "does not answer" not in command.text
    network.cut()
    command.waits_for("does not answer")
    network.mend()
    code, text = command.end()
    assert code == 0, text
    no_page_of_errors(text)
    assert output_of(lab) == expected(STEPS)


def test_a_cut_that_stays(network, far, begin, goes_on):
    command = begin(far.address, (BRIEF, 60))
    command.waits_for(r"a1 +cpu")
    network.cut()
    code, text = command.end()
    assert code == 1, text
    assert f"the scheduler {far.address} has ended, or the network to it is cut\nfailed: " in text
    no_page_of_errors(text)
    goes_on(text)
