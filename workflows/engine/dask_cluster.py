"""Clusters that the command line uses: worker processes on this machine, an existing scheduler, or
SLURM jobs.
"""

from __future__ import annotations

import asyncio
import re
import shlex
import shutil
import signal
import subprocess
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import torch

from neusee.workflows.engine.dask_executor import ClusterLost, Dask, connected, silence_logs
from neusee.workflows.graph.errors import nearest
from neusee.workflows.store.cache_settings import parse_size
from neusee.workflows.store.result_store import Store

# --- slurm options --------------------------------------------------------------------------------

# Options of the SLURM jobs of a run, in the form of the command line: ``queue=gpu``, ``cores=4``.


_COMMANDS = ("sbatch", "scancel")
N = TypeVar("N", int, float)
#: format of a SLURM time: minutes, hours:minutes:seconds, or days-hours:minutes:seconds
_TIME = re.compile(r"(\d+-)?\d+(:\d+){0,2}")


@dataclass(frozen=True)
class SlurmOptions:
    """Requirements of one SLURM job; an empty text leaves the default of the site."""

    queue: str = ""  #: partition
    account: str = ""
    #: processors of a job, and threads of its worker; 0: as many as the threads of this program
    cores: int = 0
    memory: str = "8 GB"  #: memory of a job; the worker is ended at 95 % of it
    walltime: str = ""  #: time limit such as 02:00:00; half an hour if empty
    wait: float = 5.0  #: time (min) within which the first job must start
    interface: str = ""  #: network between scheduler and workers, such as ib0
    python: str = ""  #: Python executable of the workers; if empty, that of this program
    logs: str = "slurm_logs"  #: folder
    directive: tuple[str, ...] = ()  #: further lines of #SBATCH, such as --gres=gpu:1
    prologue: tuple[str, ...] = ()  #: commands before the worker, such as module load cuda

    @classmethod
    def read(cls, words: Sequence[str]) -> SlurmOptions:
        """Return the options in words such as ``queue=gpu``; raise ValueError for a word that is no
        option.
        """
        options = cls()
        for word in words:
            name, equals_sign, value = word.partition("=")
            values_so_far = {field.name: getattr(options, field.name) for field in fields(cls)}
            if not equals_sign or name not in values_so_far:
                hint = nearest(name, values_so_far) or f"write one of {', '.join(values_so_far)}"
                raise ValueError(f"{word}: write NAME=VALUE, such as queue=gpu; {hint}")
            options = replace(options, **{name: _value(name, value, values_so_far[name])})
        return options


def missing_command() -> str:
    """Return the name of the first command of SLURM that this machine lacks, or an empty text."""
    return next((name for name in _COMMANDS if not shutil.which(name)), "")


def _value(name: str, text: str, before: Any) -> Any:
    """Return the value of an option; raise ValueError for one that SLURM cannot read."""
    # an option that may be given several times
    if isinstance(before, tuple):
        return (*before, text)
    try:
        if name == "memory":
            parse_size(text)
        # each option has the type of its default
        if isinstance(before, int):
            return _at_least_one(int(text))
        if isinstance(before, float):
            # at least 1 s; the option is in minutes
            return _at_least_one(float(text.removesuffix("min").strip()) * 60) / 60
    except ValueError:
        raise ValueError(f"{name}={text}: must be {_KINDS[name]}") from None
    if name == "walltime" and not _TIME.fullmatch(text):
        raise ValueError(f"{name}={text}: must be a time of SLURM, such as 02:00:00")
    if "\n" in text or not text:
        raise ValueError(f"{name}={text!r}: must be one line of text")
    return text


_KINDS = {
    "memory": 'a size such as "16 GB"',
    "cores": "a whole number of at least 1",
    "wait": "minutes, such as 30",
}


def _at_least_one(number: N) -> N:
    if not number >= 1:
        raise ValueError
    return number


# --- slurm jobs -----------------------------------------------------------------------------------

# SLURM jobs whose workers compute a run: they are submitted through dask-jobqueue, waited for, and
# cancelled at the end.


_LOOK = 5.0  #: interval (s) between two queries of the queue
_CLOSING = 10.0  #: s for dask to close


@dataclass
class SlurmJobs:
    """The jobs of one run."""

    cluster: Any = None  #: `dask_jobqueue.SLURMCluster`
    ids: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)  #: error messages of sbatch

    async def submit(self, command: str, script: str) -> str:
        """Run the command that submits a script, and return its output; note a refusal."""
        process = await asyncio.create_subprocess_exec(
            *shlex.split(command), script, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        printed, error_text = (
            text.decode(errors="replace") for text in await process.communicate()
        )
        # sbatch prints "Submitted batch job 17", or "17;cluster"
        job_number = next(
            (word for word in printed.replace(";", " ").split() if word.isdecimal()), ""
        )
        if process.returncode or not job_number:
            refusal = " ".join(
                (error_text.strip() or printed.strip() or f"exit code {process.returncode}").split()
            )
            refusal = refusal.removeprefix("sbatch: error: ")
            self.refused.append(refusal)
            raise ClusterLost(refusal)
        self.ids.append(job_number)
        return printed

    def queue(self) -> str:
        """Return the states of the jobs that squeue reports, such as ``2 PENDING (Resources)``; an
        empty text if no job is left.
        """
        try:
            command = ["squeue", "--noheader", "--jobs", ",".join(self.ids), "--format", "%T (%r)"]
            finished = subprocess.run(command, capture_output=True, text=True, timeout=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"nothing: {error}"
        lines = [line.strip() for line in finished.stdout.splitlines() if line.strip()]
        if finished.returncode and "invalid job id" not in finished.stderr.lower():
            return f"nothing: {' '.join(finished.stderr.split())}"
        return ", ".join(f"{lines.count(line)} {line}" for line in dict.fromkeys(lines))

    def cancel(self) -> None:
        """Cancel all jobs; jobs that have ended are not affected."""
        if self.ids:
            with suppress(OSError, subprocess.TimeoutExpired):
                subprocess.run(["scancel", *self.ids], capture_output=True, timeout=60)


@contextmanager
def slurm_cluster(count: int, options: SlurmOptions) -> Iterator[SlurmJobs]:
    """Submit ``count`` jobs, and cancel them after the ``with`` block, however it ends."""
    cluster_class, job_class = _dask_jobqueue()
    jobs = SlurmJobs()
    try:
        jobs.cluster = cluster_class(
            job_cls=_with_job_reports(job_class, jobs), **_settings(options)
        )
        jobs.cluster.scale(jobs=count)
        yield jobs
    finally:
        jobs.cancel()
        if jobs.cluster is not None:
            with suppress(Exception):
                jobs.cluster.close(timeout=_CLOSING)


def wait_for_job(
    jobs: SlurmJobs, client: Any, options: SlurmOptions, say: Callable[[str], None]
) -> None:
    """Wait until a worker of the jobs is connected; raise `ClusterLost` if sbatch refuses, or if
    none comes in time.
    """
    began = last_look = time.monotonic()
    is_announced = False
    while not client.nthreads():
        present_time = time.monotonic()
        if jobs.refused:
            raise ClusterLost(f"sbatch refused a job: {jobs.refused[0]}")
        # reported once, as soon as a job has a number
        if jobs.ids and not is_announced:
            is_announced = True
            say(
                f"jobs     {', '.join(jobs.ids)}: waiting up to {options.wait:g} min for the first"
                " worker"
            )
        if present_time - last_look > _LOOK and jobs.ids:
            last_look = present_time
            # no job is left in the queue
            if not (queue := jobs.queue()):
                raise ClusterLost(
                    f"the jobs {', '.join(jobs.ids)} ended before a worker came: see"
                    f" {options.logs}/"
                )
            if present_time - began > 60 * options.wait:
                raise ClusterLost(
                    f"no worker came within {options.wait:g} min; squeue says: {queue}"
                )
        time.sleep(0.2)


def _dask_jobqueue() -> tuple[type[Any], type[Any]]:
    """Return the classes of a cluster and of a job, and restore the handler of Ctrl-C, which the
    package replaces by an exit with 0.
    """
    interrupt_handler = signal.getsignal(signal.SIGINT)
    from dask_jobqueue.slurm import SLURMCluster, SLURMJob

    if threading.current_thread() is threading.main_thread():
        # Python lets only the main thread set a handler
        signal.signal(signal.SIGINT, interrupt_handler)
    return SLURMCluster, SLURMJob


def _with_job_reports(job_class: type[Any], jobs: SlurmJobs) -> type[Any]:
    """Return a class of jobs that report their numbers and the refusals of sbatch to ``jobs``."""

    async def submit(self: Any, script: str) -> str:
        return await jobs.submit(self.submit_command, script)

    return type("Job", (job_class,), {"_submit_job": submit})


def _settings(options: SlurmOptions) -> dict[str, Any]:
    """Return the arguments of a cluster; options that are not stated keep the configuration of the
    site.
    """
    site_options = {
        name: getattr(options, name)
        for name in ("queue", "account", "walltime", "interface", "python")
    }
    return {
        # number of steps that dask computes at once; torch uses the threads inside a step
        "cores": 1,
        "processes": 1,
        "job_cpu": options.cores or torch.get_num_threads(),
        "memory": parse_size(options.memory),
        "job_name": "neusee",
        "log_directory": options.logs,
        "job_extra_directives": list(options.directive),
        "job_script_prologue": list(options.prologue),
        "scheduler_options": {"dashboard_address": ":0", "dashboard": False},
        "silence_logs": False,
        **{name: value for name, value in site_options.items() if value},
    }


# --- dask cluster ---------------------------------------------------------------------------------

# The clusters on which the command line computes: workers on this machine, workers of a scheduler,
# or SLURM jobs.


#: environment of workers that share the user's terminal
_QUIET = {"DASK_LOGGING__DISTRIBUTED": "critical"}


@contextmanager
def cluster(
    where: str,
    store: Store,
    job: Sequence[str] = (),
    say: Callable[[str], None] = lambda line: None,
    warn: Callable[[str], None] = warnings.warn,
) -> Iterator[Dask]:
    """Yield an executor for the workers that the text ``where`` describes.

    ``dask:4`` means four local workers, ``dask:here`` this process, ``slurm:4`` four jobs of
    SLURM with the options ``job``, such as ``queue=gpu``; anything else is the address of a
    scheduler. ``say`` is called with a line while it waits, and ``warn`` if the scheduler is
    silent. Raises `ClusterLost` if no scheduler or no worker comes.
    """
    silence_logs()
    kind, _, worker_count = where.partition(":")
    with ExitStack() as clusters:
        # 0: as many threads on a worker as in this process
        threads, address = 0, where
        if kind == "dask":
            address = clusters.enter_context(_local(worker_count))
        if kind == "slurm":
            options = SlurmOptions.read(job)
            jobs = clusters.enter_context(slurm_cluster(int(worker_count or 1), options))
            address, threads = jobs.cluster, options.cores or 0
        client = connected(address)
        executor = Dask(client, store, threads, warn)
        clusters.callback(executor.link.close)
        if kind == "slurm":
            wait_for_job(jobs, client, options, say)
        yield executor


@contextmanager
def _local(count: str) -> Iterator[Any]:
    """Yield a cluster of worker processes on this machine, or one of this process alone."""
    from distributed import LocalCluster

    in_this_process = count == "here"
    worker_count = 1 if in_this_process or not count else int(count)
    log_settings = {} if in_this_process else {"env": _QUIET}
    with LocalCluster(
        n_workers=worker_count,
        threads_per_worker=1,
        processes=not in_this_process,
        dashboard_address=":0",
        silence_logs=50,
        **log_settings,
    ) as local:
        yield local
