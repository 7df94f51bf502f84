"""A killed scheduler, killed workers and a cut network: one sentence, or the run goes on; nothing finished is lost."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
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

pytest.importorskip("distributed", reason="distributed is not installed")
pytestmark = pytest.mark.slow

#: timeouts of dask that are shorter than in use, so that a cut beyond them takes seconds; 11 s is the least
SHORT = {"DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP": "12s", "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s"}
STEPS = 12


class Machine:
    """The processes of a cluster, started with the commands of dask, in a namespace or in this one."""

    def __init__(self, folder, host="127.0.0.1", within=()):
        self.folder, self.host, self.within = folder, host, within
        self.processes = []
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://{host}:{self.port}"

    def start(self, *words):
        path = f"{ROOT / '.src'}:{os.environ.get('PYTHONPATH', '')}"
        own = {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "NEUSEE_CACHE": str(self.folder / "cache"), **SHORT}
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
        where = ("--host", self.host, "--nthreads", "1", "--no-dashboard")
        return self.start("distributed.cli.dask_worker", self.address, *where, *options)

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

    def start(address, within=()):
        words = ("run", "lab.yaml", "--executor", address)
        begun.append(Command(lab, *words, within=within, **SHORT))
        return begun[-1]

    yield start
    for command in begun:
        command.stop()


def goes_on(lab, text):
    """Run again on this machine: what was finished is not computed again, and the picture is right."""
    done = set(re.findall(r"^ +(\w+) +cpu +run ", text, re.MULTILINE))
    assert done, text
    code, again = Command(lab, "run", "lab.yaml").end()
    assert code == 0, again
    states = states_of(lab)
    assert all(states[name] in ("cached", "not needed") for name in done), (states, text)
    assert output_of(lab) == expected(STEPS)


def test_a_killed_scheduler(lab, machine, begin):
    scheduler = machine.scheduler()
    machine.worker()
    command = begin(machine.address)
    command.waits_for(r"a1 +cpu")
    kill(scheduler)
    code, text = command.end()
    assert code == 1, text
    assert f"warning: the scheduler {machine.address} does not answer: waiting up to 60 s" in text
    assert f"the scheduler {machine.address} has ended, or the network to it is cut\nfailed: " in text
    no_page_of_errors(text)
    goes_on(lab, text)


def test_a_scheduler_that_takes_leave(lab, machine, begin):
    scheduler = machine.scheduler()
    machine.worker()
    command = begin(machine.address)
    command.waits_for(r"a1 +cpu")
    scheduler.terminate()
    code, text = command.end()
    assert code == 1, text
    assert f"the scheduler {machine.address} has ended, or the network to it is cut\nfailed: " in text
    no_page_of_errors(text)
    goes_on(lab, text)


def test_a_scheduler_that_is_started_again(lab, machine, begin):
    scheduler = machine.scheduler()
    machine.worker()
    command = begin(machine.address)
    command.waits_for(r"a1 +cpu")
    kill(scheduler)
    command.waits_for("does not answer")
    machine.scheduler()
    machine.worker()  # a worker of dask ends with its scheduler, and comes after the tasks
    code, text = command.end()
    assert code == 0, text
    no_page_of_errors(text)
    assert output_of(lab) == expected(STEPS)


def test_the_only_worker_is_killed(lab, machine, begin):
    machine.scheduler()
    worker = machine.worker("--no-nanny")
    command = begin(machine.address)
    command.waits_for(r"a1 +cpu")
    kill(worker)
    code, text = command.end()
    assert code == 1, text
    assert f"the scheduler {machine.address} has had no worker for 60 s\nfailed: " in text
    no_page_of_errors(text)
    goes_on(lab, text)


def test_the_only_worker_is_killed_and_another_one_comes(lab, machine, begin):
    machine.scheduler()
    worker = machine.worker("--no-nanny")
    command = begin(machine.address)
    command.waits_for(r"a1 +cpu")
    kill(worker)
    machine.worker("--no-nanny")
    code, text = command.end()
    assert code == 0, text
    no_page_of_errors(text)
    assert output_of(lab) == expected(STEPS)


def test_one_of_two_workers_is_killed(lab, machine, begin):
    machine.scheduler()
    workers = [machine.worker("--no-nanny") for _ in range(2)]
    command = begin(machine.address)
    command.waits_for(r"a1 +cpu")
    kill(workers[0])
    code, text = command.end()
    assert code == 0, text
    no_page_of_errors(text)
    assert output_of(lab) == expected(STEPS)


def test_no_scheduler_is_there(lab, machine, begin):
    code, text = begin(machine.address).end()
    assert code == 1, text
    assert f"no scheduler of dask answers at {machine.address} within 60 s" in text
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
        for words in (("addr", "add", f"{self.address}/24", "dev", self.there), ("link", "set", self.there, "up")):
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
    """A scheduler and two workers behind the wire."""
    found = Machine(lab, network.address, ("ip", "netns", "exec", network.name))
    found.scheduler()
    for _ in range(2):
        found.worker()
    yield found
    found.end()


def test_a_short_cut_of_the_network(lab, network, far, begin):
    command = begin(far.address)
    command.waits_for(r"a1 +cpu")
    network.cut()
    network.mend()
    code, text = command.end()
    assert code == 0, text
    assert "does not answer" not in text
    no_page_of_errors(text)
    assert output_of(lab) == expected(STEPS)


def test_a_cut_that_is_longer_than_the_timeouts(lab, network, far, begin):
    command = begin(far.address)
    command.waits_for(r"a1 +cpu")
    network.cut()
    command.waits_for("does not answer")
    network.mend()
    code, text = command.end()
    assert code == 0, text
    no_page_of_errors(text)
    assert output_of(lab) == expected(STEPS)


def test_a_cut_that_stays(lab, network, far, begin):
    command = begin(far.address)
    command.waits_for(r"a1 +cpu")
    network.cut()
    code, text = command.end()
    assert code == 1, text
    assert f"the scheduler {far.address} has ended, or the network to it is cut\nfailed: " in text
    no_page_of_errors(text)
    goes_on(lab, text)
