"""Jobs of SLURM whose workers compute a run: submitted through dask-jobqueue, waited for, and cancelled at the end."""

from __future__ import annotations

import asyncio
import shlex
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import torch

from neusee.workflows.engine.scheduler_link import ClusterLost
from neusee.workflows.engine.slurm_options import SlurmOptions
from neusee.workflows.store.byte_sizes import parse_size

_LOOK = 5.0  #: s between two looks at the queue
_CLOSING = 10.0  #: s for dask to close


@dataclass
class SlurmJobs:
    """The jobs of one run."""

    cluster: Any = None  #: `dask_jobqueue.SLURMCluster`
    ids: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)  #: what sbatch said

    async def submit(self, command: str, script: str) -> str:
        """Run the command that submits a script, and return what it prints; note what it refuses."""
        process = await asyncio.create_subprocess_exec(
            *shlex.split(command), script, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        out, error = (text.decode(errors="replace") for text in await process.communicate())
        found = next((word for word in out.replace(";", " ").split() if word.isdecimal()), "")
        if process.returncode or not found:
            said = " ".join((error.strip() or out.strip() or f"exit code {process.returncode}").split())
            said = said.removeprefix("sbatch: error: ")
            self.refused.append(said)
            raise ClusterLost(said)
        self.ids.append(found)
        return out

    def queue(self) -> str:
        """Return what squeue says of the jobs, such as ``2 PENDING (Resources)``; an empty text if none is left."""
        try:
            words = ["squeue", "--noheader", "--jobs", ",".join(self.ids), "--format", "%T (%r)"]
            done = subprocess.run(words, capture_output=True, text=True, timeout=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"nothing: {error}"
        lines = [line.strip() for line in done.stdout.splitlines() if line.strip()]
        if done.returncode and "invalid job id" not in done.stderr.lower():
            return f"nothing: {' '.join(done.stderr.split())}"
        return ", ".join(f"{lines.count(line)} {line}" for line in dict.fromkeys(lines))

    def cancel(self) -> None:
        """Cancel all jobs; a job that has ended already is none to cancel."""
        if self.ids:
            with suppress(OSError, subprocess.TimeoutExpired):
                subprocess.run(["scancel", *self.ids], capture_output=True, timeout=60)


@contextmanager
def slurm_cluster(count: int, options: SlurmOptions) -> Iterator[SlurmJobs]:
    """Submit ``count`` jobs, and cancel them after the ``with`` block, however it ends."""
    cluster_class, job_class = _dask_jobqueue()
    jobs = SlurmJobs()
    try:
        jobs.cluster = cluster_class(job_cls=_told(job_class, jobs), **_settings(options))
        jobs.cluster.scale(jobs=count)
        yield jobs
    finally:
        jobs.cancel()
        if jobs.cluster is not None:
            with suppress(Exception):
                jobs.cluster.close(timeout=_CLOSING)


def wait_for_job(jobs: SlurmJobs, client: Any, options: SlurmOptions, say: Callable[[str], None]) -> None:
    """Wait until a worker of the jobs is connected; raise `ClusterLost` if sbatch refuses, or if none comes in time."""
    began = looked = time.monotonic()
    told = False
    while not client.nthreads():
        now = time.monotonic()
        if jobs.refused:
            raise ClusterLost(f"sbatch refused a job: {jobs.refused[0]}")
        if jobs.ids and not told:
            told = True
            say(f"jobs     {', '.join(jobs.ids)}: waiting up to {options.wait:g} min for the first worker")
        if now - looked > _LOOK and jobs.ids:
            looked = now
            if not (queue := jobs.queue()):
                raise ClusterLost(f"the jobs {', '.join(jobs.ids)} ended before a worker came: see {options.logs}/")
            if now - began > 60 * options.wait:
                raise ClusterLost(f"no worker came within {options.wait:g} min; squeue says: {queue}")
        time.sleep(0.2)


def _dask_jobqueue() -> tuple[type[Any], type[Any]]:
    """Return the classes of a cluster and of a job; leave Ctrl-C as it is, for which the package exits with 0."""
    before = signal.getsignal(signal.SIGINT)
    from dask_jobqueue.slurm import SLURMCluster, SLURMJob

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, before)
    return SLURMCluster, SLURMJob


def _told(job_class: type[Any], jobs: SlurmJobs) -> type[Any]:
    """Return a class of jobs that tell ``jobs`` their numbers and what sbatch refuses."""

    async def submit(self: Any, script: str) -> str:
        return await jobs.submit(self.submit_command, script)

    return type("Job", (job_class,), {"_submit_job": submit})


def _settings(options: SlurmOptions) -> dict[str, Any]:
    """Return the arguments of a cluster; what is not stated is left to the configuration of the site."""
    stated = {name: getattr(options, name) for name in ("queue", "account", "walltime", "interface", "python")}
    return {
        "cores": 1,  # of dask, which would compute as many steps at once: the threads are those of torch
        "processes": 1,
        "job_cpu": options.cores or torch.get_num_threads(),
        "memory": parse_size(options.memory),
        "job_name": "neusee",
        "log_directory": options.logs,
        "job_extra_directives": list(options.directive),
        "job_script_prologue": list(options.prologue),
        "scheduler_options": {"dashboard_address": ":0", "dashboard": False},
        "silence_logs": False,
        **{name: value for name, value in stated.items() if value},
    }
