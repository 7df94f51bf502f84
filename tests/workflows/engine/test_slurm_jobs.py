"""SLURM by one command, with a stand-in that starts each job script as a process of this
machine.
"""

from __future__ import annotations

import os
import signal
import stat
import time

import pytest

from neusee.workflows.cli import app
from neusee.workflows.engine.dask_cluster import SlurmOptions
from tests.workflows.engine.cluster_processes import (
    PATIENCE,
    Command,
    expected,
    no_page_of_errors,
    output_of,
    write_lab,
)

pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is not installed")

SBATCH = """#!/bin/bash
if [ -n "$REFUSES" ]; then echo "sbatch: error: $REFUSES" >&2; exit 1; fi
id=100
while ! mkdir "$QUEUE/$id" 2>/dev/null; do id=$((id + 1)); done
cp "$1" "$QUEUE/$id/script"
if [ -z "$PENDING" ]; then
    setsid bash "$QUEUE/$id/script" >"$QUEUE/$id/log" 2>&1 </dev/null &
    echo $! >"$QUEUE/$id/pid"
fi
echo "Submitted batch job $id"
"""
SCANCEL = """#!/bin/bash
for id in "$@"; do
    touch "$QUEUE/$id/cancelled"
    [ -f "$QUEUE/$id/pid" ] && kill -TERM -- "-$(cat "$QUEUE/$id/pid")" 2>/dev/null
done
exit 0
"""
SQUEUE = """#!/bin/bash
for job in "$QUEUE"/*; do
    [ -f "$job/cancelled" ] && continue
    if [ ! -f "$job/pid" ]; then echo "PENDING (Resources)"
    elif kill -0 "$(cat "$job/pid")" 2>/dev/null; then echo "RUNNING (None)"; fi
done
exit 0
"""


@pytest.fixture
def lab(tmp_path):
    """A folder with a recipe, and the commands of SLURM in ``bin``."""
    write_lab(tmp_path)
    (tmp_path / "queue").mkdir()
    (tmp_path / "bin").mkdir()
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL), ("squeue", SQUEUE)):
        file = tmp_path / "bin" / name
        file.write_text(text)
        file.chmod(file.stat().st_mode | stat.S_IXUSR)
    return tmp_path


@pytest.fixture
def slurm(lab):
    """Start ``neusee run lab.yaml`` on jobs of SLURM."""
    begun = []

    def start(*words: str, **environment: str) -> Command:
        path = f"{lab / 'bin'}:{os.environ['PATH']}"
        begun.append(
            Command(
                lab, "run", "lab.yaml", *words, PATH=path, QUEUE=str(lab / "queue"), **environment
            )
        )
        return begun[-1]

    yield start
    for command in begun:
        command.stop()


def jobs_are_gone(lab):
    """Return True once no process of a job is left; every job was cancelled."""
    pids = [int(file.read_text()) for file in (lab / "queue").glob("*/pid")]
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if not any(os.path.exists(f"/proc/{pid}") for pid in pids):
            return True
        time.sleep(0.1)
    return False


# options


def test_options_of_a_job():
    words = [
        "queue=gpu",
        "cores=4",
        "memory=16 GB",
        "walltime=02:00:00",
        "wait=30",
        "directive=--gres=gpu:1",
    ]
    found = SlurmOptions.read([*words, "directive=--exclusive", "prologue=module load cuda"])
    assert (found.queue, found.cores, found.wait) == ("gpu", 4, 30.0)
    assert found.directive == ("--gres=gpu:1", "--exclusive")


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("queu=gpu", "did you mean queue?"),
        ("gpu", "write NAME=VALUE"),
        ("cores=0", "whole number of at least 1"),
        ("cores=two", "whole number of at least 1"),
        ("memory=much", "must be a size"),
        ("walltime=soon", "must be a time of SLURM"),
        ("wait=0", "minutes"),
        ("queue=a\nb", "one line"),
    ],
)
def test_an_option_that_cannot_be_is_refused(word, said):
    with pytest.raises(ValueError, match=said.replace("?", r"\?")):
        SlurmOptions.read([word])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--executor", "slurm:2"), "--executor slurm:2: this machine has no command sbatch"),
        (("--executor", "slurm:0"), "--executor slurm:0: write local"),
        (("--executor", "dask:2", "--job", "queue=gpu"), "--job is for jobs of SLURM"),
        (("--executor", "slurm:2", "--job", "core=2"), "--job core=2"),
    ],
)
def test_what_cannot_be_is_refused_before_any_work(words, said, lab, monkeypatch, capsys):
    monkeypatch.chdir(lab)
    monkeypatch.setenv("PATH", str(lab))
    with pytest.raises(SystemExit) as end:
        app.main(["run", "lab.yaml", *words])
    assert end.value.code == 2
    assert said in capsys.readouterr().err


def test_the_package_is_named_where_it_is_missing(lab, monkeypatch, capsys):
    from neusee.workflows.cli import command_frame

    monkeypatch.chdir(lab)
    monkeypatch.setattr(command_frame, "find_spec", lambda name: None)
    with pytest.raises(SystemExit) as end:
        app.main(["run", "lab.yaml", "--executor", "slurm:2"])
    assert end.value.code == 2
    assert 'dask_jobqueue is not installed: pip install "neusee[slurm]"' in capsys.readouterr().err


# jobs


@pytest.mark.slow
def test_one_command_submits_computes_and_cancels(lab, slurm):
    options = (
        "--job",
        "queue=gpu",
        "--job",
        "cores=1",
        "--job",
        "directive=--gres=gpu:1",
        "--job",
        "walltime=10",
    )
    code, text = slurm("--executor", "slurm:2", *options).end()
    assert code == 0, text
    no_page_of_errors(text)
    assert output_of(lab) == expected()
    assert len(list((lab / "queue").glob("*/cancelled"))) == 2
    script = (lab / "queue" / "100" / "script").read_text()
    for line in ("-p gpu", "--cpus-per-task=1", "--mem=8G", "-t 10", "--gres=gpu:1"):
        assert f"#SBATCH {line}\n" in script
    assert jobs_are_gone(lab)


@pytest.mark.slow
def test_what_sbatch_refuses_is_one_sentence(lab, slurm):
    code, text = slurm("--executor", "slurm:2", REFUSES="invalid partition specified: gpu").end()
    assert code == 1
    assert "sbatch refused a job: invalid partition specified: gpu\nfailed: 0 steps" in text
    no_page_of_errors(text)


@pytest.mark.slow
def test_without_a_worker_the_queue_is_told(lab, slurm):
    code, text = slurm("--executor", "slurm:2", "--job", "wait=0.02", PENDING="1").end()
    assert code == 1
    assert (
        "no worker came within 0.02 min; squeue says: 2 PENDING (Resources)\nfailed: 0 steps"
        in text
    )
    assert len(list((lab / "queue").glob("*/cancelled"))) == 2
    no_page_of_errors(text)


@pytest.mark.slow
def test_a_job_that_ends_at_once_is_told(lab, slurm):
    code, text = slurm("--executor", "slurm:1", "--job", "prologue=exit 1").end()
    assert code == 1
    assert "the jobs 100 ended before a worker came: see slurm_logs/" in text
    no_page_of_errors(text)


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["waiting up to", "first "])
def test_ctrl_c_cancels_the_jobs(lab, slurm, moment):
    write_lab(lab, steps=40)
    command = slurm("--executor", "slurm:2")
    command.waits_for(moment)
    command.process.send_signal(signal.SIGINT)
    code, text = command.end()
    assert code == 130, text
    assert "stopped: " in text
    no_page_of_errors(text)
    assert len(list((lab / "queue").glob("*/cancelled"))) == 2
    assert jobs_are_gone(lab)


@pytest.mark.slow
def test_a_killed_command_leaves_no_worker(lab, slurm):
    write_lab(lab, steps=40)
    command = slurm("--executor", "slurm:1")
    command.waits_for("first ")
    command.stop()
    assert jobs_are_gone(lab)
