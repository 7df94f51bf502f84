"""The clusters on which the command line computes: workers on this machine, those of a scheduler, or jobs of SLURM."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from neusee.workflows.engine.dask_executor import Dask
from neusee.workflows.engine.scheduler_link import connected, silence_logs
from neusee.workflows.engine.slurm_jobs import slurm_cluster, wait_for_job
from neusee.workflows.engine.slurm_options import SlurmOptions
from neusee.workflows.store.result_store import Store

_QUIET = {"DASK_LOGGING__DISTRIBUTED": "critical"}  #: in the environment of workers whose terminal is that of the user


@contextmanager
def cluster(
    where: str,
    store: Store,
    job: Sequence[str] = (),
    say: Callable[[str], None] = lambda line: None,
    warn: Callable[[str], None] = warnings.warn,
) -> Iterator[Dask]:
    """Yield an executor for workers that the text ``where`` names.

    ``dask:4`` are four local workers, ``dask:here`` is this process, ``slurm:4`` are four jobs of SLURM with the
    options ``job``, such as ``queue=gpu``; anything else is the address of a scheduler. ``say`` is told what is waited
    for, and ``warn`` of a scheduler that is silent.
    Raises `ClusterLost` if no scheduler or no worker comes.
    """
    silence_logs()
    kind, _, count = where.partition(":")
    with ExitStack() as open_now:
        threads, address = 0, where
        if kind == "dask":
            address = open_now.enter_context(_local(count))
        if kind == "slurm":
            options = SlurmOptions.read(job)
            jobs = open_now.enter_context(slurm_cluster(int(count or 1), options))
            address, threads = jobs.cluster, options.cores or 0
        client = connected(address)
        executor = Dask(client, store, threads, warn)
        open_now.callback(executor.link.close)
        if kind == "slurm":
            wait_for_job(jobs, client, options, say)
        yield executor


@contextmanager
def _local(count: str) -> Iterator[Any]:
    """Yield a cluster of worker processes on this machine, or one of this process alone."""
    from distributed import LocalCluster

    here = count == "here"
    workers = 1 if here or not count else int(count)
    quiet = {} if here else {"env": _QUIET}
    with LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=not here, dashboard_address=":0", silence_logs=50, **quiet
    ) as local:
        yield local
