"""The clusters on which the command line computes: workers on this machine, or those of a scheduler."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from neusee.workflows.engine.dask_executor import Dask
from neusee.workflows.store.result_store import Store


@contextmanager
def cluster(where: str, store: Store) -> Iterator[Dask]:
    """Yield an executor for ``dask:4`` (four local workers), ``dask:here`` (this process) or a scheduler address."""
    from distributed import Client, LocalCluster

    kind, _, count = where.partition(":")
    address: Any = where
    with ExitStack() as open_now:
        if kind == "dask":
            here = count == "here"
            workers = 1 if here or not count else int(count)
            local = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=not here, dashboard_address=None, silence_logs=40
            )
            address = open_now.enter_context(local)
        yield Dask(open_now.enter_context(Client(address, set_as_default=False)), store)
