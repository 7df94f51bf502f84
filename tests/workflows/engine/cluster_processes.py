"""Real processes for the tests of clusters: a recipe of long steps, the command that runs it,
and what it printed.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

from safetensors.numpy import load_file

ROOT = Path(__file__).parents[3]
PATIENCE = 300  #: s until a test gives up waiting for a process

#: the program, with other seconds until it gives up a scheduler that is gone, and one that is not
#: there when it begins
IMPATIENT = """
from neusee.workflows.engine import dask_executor

dask_executor.PATIENCE = {patience[0]}
dask_executor.connected.__defaults__ = ({patience[1]},)

from neusee.__main__ import main

main()
"""

NODES = '''
"""Nodes that take their time, and hardly a processor."""

import time

import torch
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.units import Real


@node()
def start(*, size: Real) -> Tensor:
    """Make numbers."""
    return torch.full((3,), size)


@node()
def work(x: Tensor, *, pause: Real, add: Real) -> Tensor:
    """Rest, then add."""
    time.sleep(pause)
    return x + add


@node()
def both(x: Tensor, y: Tensor) -> Tensor:
    """Sum."""
    return x + y
'''


def write_lab(folder: Path, steps: int = 4, pause: float = 0.4) -> None:
    """Write a recipe ``lab.yaml`` of two chains of long steps, whose sum is the output."""
    (folder / "slow_lab.py").write_text(textwrap.dedent(NODES).lstrip())
    lines = ["  first: {node: slow_lab.start, with: {size: 2}}"]
    for chain in "ab":
        for number in range(steps):
            above = f"{chain}{number - 1}" if number else "first"
            values = f"{{pause: {pause}, add: {number + (chain == 'b')}}}"
            lines.append(
                f"  {chain}{number}: {{node: slow_lab.work, from: {{x: {above}}}, with: {values}}}"
            )
    lines.append(f"  last: {{node: slow_lab.both, from: {{x: a{steps - 1}, y: b{steps - 1}}}}}")
    # each a task of its own
    all_steps = ", ".join(f"{chain}{number}" for chain in "ab" for number in range(steps))
    head = (
        "# Long steps.\nnodes: [slow_lab.py]\nseed: 1\ntolerance: 0\noutputs: [last,"
        f" {all_steps}]\nsteps:\n"
    )
    (folder / "lab.yaml").write_text(head + "\n".join(lines) + "\n")


class Command:
    """A command of neusee that runs in a process, whose lines are read as they come."""

    def __init__(
        self,
        folder: Path,
        *words: str,
        within: tuple[str, ...] = (),
        patience: tuple[float, float] | None = None,
        **environment: str,
    ) -> None:
        program = ["-m", "neusee"]
        if patience is not None:
            program = ["-c", IMPATIENT.format(patience=patience)]
        path = f"{ROOT / '.src'}:{os.environ.get('PYTHONPATH', '')}"
        own = {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "NEUSEE_CACHE": str(folder / "cache")}
        own["DASK_CONFIG"] = str(folder / "dask")  # else dask-jobqueue writes into the home folder
        self.process = subprocess.Popen(
            [*within, sys.executable, *program, *words],
            cwd=folder,
            env={**os.environ, **own, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        self.text, self._closed = "", False
        self._more = threading.Condition()
        threading.Thread(target=self._read, daemon=True).start()

    def waits_for(self, pattern: str) -> None:
        """Wait until the command has printed a text."""
        with self._more:
            found = self._more.wait_for(
                lambda: self._ended() or re.search(pattern, self.text), PATIENCE
            )
        assert found, self.text
        assert re.search(pattern, self.text), self.text

    def end(self) -> tuple[int, str]:
        """Wait for the end of the command; return its exit code and all that it printed."""
        with self._more:
            assert self._more.wait_for(self._ended, PATIENCE), self.text
        return self.process.wait(PATIENCE), self.text

    def stop(self) -> None:
        """Kill the command if it still runs."""
        self.process.kill()
        self.process.wait(PATIENCE)
        with self._more:
            self._more.wait_for(self._ended, PATIENCE)

    def _ended(self) -> bool:
        return self._closed

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                with self._more:
                    self.text += line
                    self._more.notify_all()
        with self._more:
            self._closed = True
            self._more.notify_all()


def states_of(folder: Path) -> dict[str, str]:
    """Return what the newest run of a folder did with each step."""
    newest = max((folder / "runs").glob("*/provenance.json"), key=lambda path: path.stat().st_mtime)
    return {step["step"]: step["state"] for step in json.loads(newest.read_text())["steps"]}


def output_of(folder: Path) -> list[float]:
    """Return the output that the newest run of a folder exported."""
    newest = max((folder / "runs").glob("*/data"), key=lambda path: path.stat().st_mtime)
    values: list[float] = load_file(newest / "outputs.safetensors")["last"].tolist()
    return values


def expected(steps: int = 4) -> list[float]:
    """Return the output of the recipe: each chain begins with 2 and adds its numbers."""
    one = 2.0 + sum(range(steps))
    return [2 * one + steps] * 3


def no_page_of_errors(text: str) -> None:
    """Assert that a command printed sentences: no traceback, and no log of dask."""
    for word in (
        "Traceback",
        "distributed.",
        "Exception ignored",
        "was never retrieved",
        "tornado",
    ):
        assert word not in text, text
