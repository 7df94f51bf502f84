"""Threads beside other work: waiting threads sleep, busy processors are left alone, and what the
user set stays.
"""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from neusee.workflows.cli.app import settle_threads
from neusee.workflows.engine import machine_resources
from neusee.workflows.engine.machine_resources import threads_for


@pytest.fixture
def before_torch(monkeypatch):
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setattr(machine_resources, "free_processors", lambda: 3)


@pytest.mark.parametrize(
    ("processors", "load", "threads"),
    [(2, 0.0, 2), (2, 0.4, 2), (2, 1.0, 1), (2, 9.0, 1), (64, 12.3, 52), (1, 0.0, 1)],
)
def test_threads_leave_busy_processors_alone(processors, load, threads):
    assert threads_for(processors, load) == threads


@pytest.mark.usefixtures("before_torch")
@pytest.mark.parametrize(
    ("command", "given", "added"),
    [
        ("calibrate", {}, {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": "3"}),
        ("run", {}, {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": "2"}),
        ("run", {"OMP_WAIT_POLICY": "ACTIVE"}, {"OMP_NUM_THREADS": "2"}),
        ("run", {"GOMP_SPINCOUNT": "5", "MKL_NUM_THREADS": "7"}, {}),
        ("run", {"KMP_BLOCKTIME": "1", "OMP_NUM_THREADS": "7"}, {}),
        ("study", {}, {"OMP_WAIT_POLICY": "PASSIVE"}),
    ],
)
def test_what_the_user_has_set_stays(command, given, added):
    environ = dict(given)
    settle_threads(command, environ)
    assert environ == given | added


@pytest.mark.usefixtures("before_torch")
def test_a_single_free_processor_is_not_given_away(monkeypatch):
    monkeypatch.setattr(machine_resources, "free_processors", lambda: 1)
    environ: dict[str, str] = {}
    settle_threads("run", environ)
    assert environ["OMP_NUM_THREADS"] == "1"


def test_nothing_changes_where_torch_is_imported():
    import torch  # noqa: F401

    environ: dict[str, str] = {}
    settle_threads("run", environ)
    assert environ == {}


def test_a_machine_that_tells_no_load_keeps_its_threads(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert machine_resources.free_processors() is None


def test_a_command_decides_before_torch_is_imported():
    code = (
        "import os, sys, neusee.workflows.cli.app as app\n"
        "try: app.main(['validate', 'no_such_recipe'])\n"
        "except SystemExit: print(os.environ['OMP_WAIT_POLICY'])"
    )
    free = {k: v for k, v in os.environ.items() if not k.startswith(("OMP", "GOMP", "KMP", "MKL"))}
    done = subprocess.run(
        [sys.executable, "-c", code], env=free, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["PASSIVE"]
