"""Runs of the program in processes of their own, forked from one that has torch and neusee at hand.

Importing both takes longer than most runs of tests. `Programs` starts this file as a server. A job
is a JSON object: the ``words`` of the command, the folder ``cwd``, the variables ``env``, and the
files ``out`` and ``err`` for what it prints. The server tells how it ended, and its largest memory.
"""

from __future__ import annotations

import json
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple


class Ended(NamedTuple):
    """How a run of the program ended."""

    returncode: int
    stdout: str
    stderr: str
    peak: int  #: bytes


class Programs:
    """A server of runs of the program, each in a new process."""

    def __init__(self) -> None:
        variables = {k: v for k, v in os.environ.items() if not k.startswith("NEUSEE")}
        path = str(Path(__file__).parents[2] / ".src")
        self._server = subprocess.Popen(
            [sys.executable, "-P", __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**variables, "OMP_NUM_THREADS": "1", "PYTHONPATH": path},
        )

    def run(self, words: Sequence[str], cwd: Path | str, env: Mapping[str, str]) -> Ended:
        """Run the program and wait for its end."""
        pipes = self._server
        assert pipes.stdin is not None
        assert pipes.stdout is not None
        with tempfile.TemporaryDirectory() as place:
            files = {name: f"{place}/{name}" for name in ("out", "err")}
            job = {"words": [*words], "cwd": str(cwd), "env": {**env}, **files}
            pipes.stdin.write(json.dumps(job) + "\n")
            pipes.stdin.flush()
            code, peak = json.loads(pipes.stdout.readline())
            out, err = (Path(file).read_text(encoding="utf-8") for file in files.values())
        return Ended(code, out, err, peak)

    def close(self) -> None:
        self._server.communicate()


def serve() -> None:
    """Fork a child for each line that comes in, and tell how it ended."""
    import torch

    import neusee.workflows.cli.recipe_commands
    import neusee.workflows.simulation.simulate_recipe  # noqa: F401

    torch.set_num_threads(1)
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            work(json.loads(line))
        _, status, usage = os.wait4(pid, 0)
        print(json.dumps([os.waitstatus_to_exitcode(status), usage.ru_maxrss * 1024]), flush=True)


def work(job: dict[str, Any]) -> None:
    """Run the program as a new process would, and end this process."""
    for number, place in enumerate((os.devnull, job["out"], job["err"])):
        opened = os.open(place, os.O_RDWR | os.O_CREAT, 0o600)
        os.dup2(opened, number)
        os.close(opened)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115  # the server's lines are not for us
    os.environ.clear()
    os.environ.update(job["env"])
    os.chdir(job["cwd"])
    sys.argv = ["neusee", *job["words"]]
    runpy.run_module("neusee", run_name="__main__")
    sys.exit()


if __name__ == "__main__":
    serve()
