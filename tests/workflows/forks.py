"""Runs in processes of their own, forked from one that has torch at hand, so that a test can afford
fifty.

`Forks` starts this file as a server. Each job is a JSON object: ``folder`` with a family of nodes,
the ``family``'s name, the ``store``, the ``steps`` as ``[name, node, parameters, wires]``, the
``outputs``, and ``first``, Python that the child executes before it runs. The child writes what
came of it to the file ``out``.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import xxhash


class Child:
    """One run under way in a process of its own."""

    def __init__(self, pid: int, out: Path) -> None:
        self.pid, self.out = pid, out

    def kill(self, how: int = signal.SIGKILL) -> None:
        try:
            os.kill(self.pid, how)
        except ProcessLookupError:
            assert how == signal.SIGKILL  # it was quicker

    def wait(self, seconds: float = 300.0) -> None:
        """Until the process has ended."""
        end = time.monotonic() + seconds
        while _alive(self.pid):
            assert time.monotonic() < end, f"process {self.pid} hangs"
            time.sleep(0.002)

    def result(self, seconds: float = 300.0) -> dict[str, Any]:
        """What the run gave, once the process has ended."""
        self.wait(seconds)
        found: dict[str, Any] = json.loads(self.out.read_text())
        return found


class Forks:
    """A server of jobs; every process it starts has the hash seed ``hash_seed``."""

    def __init__(self, folder: Path, hash_seed: str = "0") -> None:
        self.folder, self._count, self._children = folder, 0, list[Child]()
        folder.mkdir(parents=True, exist_ok=True)
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed, "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-B", __file__]
        pipe = subprocess.PIPE
        self._server = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, text=True, env=environment
        )

    def start(self, **job: Any) -> Child:
        """Start a job and do not wait for it."""
        self._count += 1
        out = self.folder / f"{self._count}.json"
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._server.stdin.write(json.dumps({**job, "out": str(out)}, default=str) + "\n")
        self._server.stdin.flush()
        self._children.append(Child(int(self._server.stdout.readline()), out))
        return self._children[-1]

    def run(self, **job: Any) -> dict[str, Any]:
        return self.start(**job).result()

    def close(self) -> None:
        for child in self._children:
            if _alive(child.pid):
                child.kill(signal.SIGCONT)
                child.kill()
        self._server.communicate()


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def serve() -> None:
    """Fork a child for each line that comes in, and tell its number."""
    import torch

    import neusee.workflows.engine.runner  # noqa: F401  # that no fork imports it again
    from neusee.workflows.engine.cost_model import shipped

    shipped()  # a file that another user may not read

    torch.set_num_threads(1)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody asks for their ends
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            work(json.loads(line))
        print(pid, flush=True)


def work(job: dict[str, Any]) -> None:
    """Do one job and end this process."""
    import warnings

    sys.stdin = open(os.devnull)  # noqa: SIM115  # the server's lines are not for us
    # while it still may
    with warnings.catch_warnings(record=True) as said, open(job["out"], "w") as out:
        warnings.simplefilter("always")
        try:
            found = once(job)
        except BaseException:
            found = {"error": traceback.format_exc()}
        json.dump({**found, "warnings": [str(w.message) for w in said]}, out)
        out.flush()
        os._exit(0)


def once(job: dict[str, Any]) -> dict[str, Any]:
    """Run the job's recipe as a new process would."""
    import importlib

    import neusee.nodes
    from neusee.workflows.engine.runner import run
    from neusee.workflows.graph.errors import Location
    from neusee.workflows.graph.recipe_graph import Recipe, Step
    from neusee.workflows.store.result_store import Store

    neusee.nodes.__path__ = [*neusee.nodes.__path__, job["folder"]]
    family = importlib.import_module(f"neusee.nodes.{job['family']}")
    store = Store(Path(job["store"]))
    scope = {"family": family, "store": store, "job": job}
    exec(job.get("first", ""), scope)
    mark, steps = Location("forks.yaml", 1, 1), {}
    for name, node, params, wires in job["steps"]:
        params = {k: Path(v["file"]) if isinstance(v, dict) else v for k, v in params.items()}
        steps[name] = Step(name, getattr(family, node), params, wires, mark, {})
    result = run(Recipe("forks", "", 1, 0.0, tuple(job["outputs"]), steps), scope["store"])
    exec(job.get("last", ""), scope)
    values = {name: shown(value) for name, value in result.values.items()}
    states = {name: done.state for name, done in result.done.items()}
    return {"values": values, "states": states, "keys": result.keys}


def shown(value: Any) -> Any:
    """A small tensor's numbers; of a large one the digest of its bytes."""
    if value.numel() <= 16:
        return value.flatten().tolist()
    return xxhash.xxh3_128_hexdigest(value.contiguous().numpy())


if __name__ == "__main__":
    serve()
