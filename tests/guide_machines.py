"""The machines that stand in for those of the guide: a scheduler of dask, and the processes of
`torchrun`.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

from torch.distributed import TCPStore

from tests.guide_commands import ROOT
from tests.guide_stand_ins import StandIn

#: what `torchrun` does, with one process that imports what takes seconds and is forked for each
#: rank
RANKS = """
import os, signal, sys
import colour, matplotlib.figure, torch._dynamo
import neusee.workflows.training.run_training
from neusee.workflows.cli import app
from neusee.workflows.report.figures import style

style.png_of = lambda _: open("no_graph.png", "rb").read()
children = []
for rank in range(int(os.environ["WORLD_SIZE"])):
    if not (child := os.fork()):
        os.environ.update(RANK=str(rank), LOCAL_RANK=str(rank))
        app.main(sys.argv[1:])
    children.append(child)
while children:
    ended, status = os.wait()
    children.remove(ended)
    if status:
        for child in children:
            os.kill(child, signal.SIGKILL)
        sys.exit(1)
"""


@contextlib.contextmanager
def scheduler(found: StandIn | None) -> Iterator[str]:
    """Start a scheduler of dask with one worker on this machine if a stand-in asks for one;
    yield its address.
    """
    if not found or "LOCAL" not in found.instead.values():
        yield ""
        return
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
    ) as cluster:
        yield cluster.scheduler_address


def together(arguments: list[str], count: int) -> None:
    """Run a command in several processes, as `torchrun` starts them."""
    # of this process: its port is its own
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    ranks = {"WORLD_SIZE": f"{count}", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": f"{store.port}"}
    start = {
        "TORCHELASTIC_USE_AGENT_STORE": "True",
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT / ".src"),
    }
    done = subprocess.run(
        [sys.executable, "-c", RANKS, *arguments],
        env={**os.environ, **ranks, **start},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-6000:]
    print(done.stdout)
