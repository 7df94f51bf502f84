"""Commands in processes of their own, forked from one that has only packages of others at hand.

What takes longest in a process of a command is the import of torch. `Commands` starts this file as
a server, which imports packages once; each command runs in a fork of it, imports neusee itself, and
ends as any process of Python does. Torch and matplotlib are not among its modules until it imports
them, because neusee decides by that what a process may do. A job is a JSON object: ``code`` that the child
executes as Python would with ``-c``, its arguments ``words``, the folder ``cwd``, the variables
``env``, and the files ``out`` and ``err`` for what it prints.
"""

from __future__ import annotations

import importlib
import importlib.abc
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

PATIENCE = 3600  #: s after which a command counts as hanging
NEUSEE = "from neusee.__main__ import main; main()"
#: what every command that computes imports of other packages
OTHERS = (
    *("torch", "numpy", "pydantic", "ruamel.yaml", "xxhash", "typer", "shellingham", "jinja2"),
    *("matplotlib.figure", "matplotlib.backends.backend_agg", "matplotlib.backends.backend_svg"),
)
#: and what a run imports of neusee, where it is not the matter what a process has imported
PROGRAM = (
    *("neusee.workflows.cli.app", "neusee.workflows.cli.recipe_commands"),
    *("neusee.workflows.simulation.simulate_recipe", "neusee.workflows.report.run_folder"),
    *("neusee.workflows.report.run_page", "neusee.workflows.report.run_crate"),
    *("neusee.nodes.scene", "neusee.nodes.sensor", "neusee.nodes.spectra"),
)
HELD = ("torch", "matplotlib")  #: packages that neusee looks for among the modules


class Commands:
    """A server of commands; every process it starts has the hash seed ``hash_seed``.

    ``prefix`` starts it, as ``unshare`` does, and ``variables`` join its environment.
    """

    def __init__(
        self,
        hash_seed: str = "0",
        imports: Sequence[str] = OTHERS,
        prefix: Sequence[str] = (),
        variables: Mapping[str, str] | None = None,
    ) -> None:
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed, "OMP_NUM_THREADS": "1"}
        self._server = subprocess.Popen(
            [*prefix, sys.executable, __file__, *imports],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**environment, **(variables or {})},
        )

    def __call__(
        self,
        *words: str,
        cwd: Path | str,
        env: Mapping[str, str],
        code: str = NEUSEE,
        **more: Any,
    ) -> subprocess.CompletedProcess[str]:
        """Run a command and wait for it; ``more`` is ``session``, the ``user`` to become, or a
        ``terminal``.
        """
        pipes = self._server
        assert pipes.stdin is not None
        assert pipes.stdout is not None
        with tempfile.TemporaryDirectory() as place:
            files = {name: f"{place}/{name}" for name in ("out", "err")}
            job = {"code": code, "words": words, "cwd": str(cwd), "env": {**env}, **files, **more}
            pipes.stdin.write(json.dumps(job) + "\n")
            pipes.stdin.flush()
            ready, _, _ = select.select([pipes.stdout], [], [], PATIENCE)
            if not ready:
                pipes.kill()  # its answer would be taken for that of the next command
                raise AssertionError(f"{words} did not end")
            status = int(pipes.stdout.readline())
            said = [
                Path(file).read_text(encoding="utf-8") if "terminal" not in more else ""
                for file in files.values()
            ]
        return subprocess.CompletedProcess(list(words), status, *said)

    def close(self) -> None:
        self._server.communicate()


def serve() -> dict[str, Any]:
    """Fork a child for each line that comes in, and tell how it ended; return the job in a
    child.
    """
    for line in sys.stdin:
        job: dict[str, Any] = json.loads(line)
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            return job
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        print(status, flush=True)
    os._exit(0)


def become(job: dict[str, Any]) -> None:
    """Let this process have what a new one of the job would have."""
    terminal = job.get("terminal")
    for number, place in enumerate((os.devnull, job["out"], job["err"])):
        flags = os.O_WRONLY | os.O_CREAT if number and not terminal else os.O_RDWR
        opened = os.open(terminal or place, flags | os.O_NOCTTY, 0o600)
        os.dup2(opened, number)
        os.close(opened)
    sys.stdin, sys.stdout, sys.stderr = (  # as Python opens them at its start
        open(number, "w" if number else "r", closefd=False)  # noqa: SIM115
        for number in range(3)
    )
    sys.__stdin__, sys.__stdout__, sys.__stderr__ = sys.stdin, sys.stdout, sys.stderr
    if job.get("session"):
        os.setsid()
    if user := job.get("user"):
        os.setgroups(user["groups"])
        os.setgid(user["number"])
        os.setuid(user["number"])
        os.umask(user["umask"])
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.clear()
    os.environ.update(job["env"])
    os.chdir(job["cwd"])
    sys.path[0] = ""
    sys.argv = ["-c", *job["words"]]


class Held(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """A package with its modules, which a process has at hand but has not imported until it does."""

    def __init__(self, package: str) -> None:
        names = [name for name in sys.modules if name.partition(".")[0] == package]
        self._modules = {name: sys.modules.pop(name) for name in names}
        self._package, self._spec = package, self._modules[package].__spec__

    def find_spec(self, name: str, path: object, target: object = None) -> ModuleSpec | None:
        return ModuleSpec(name, self) if name == self._package else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self._modules[self._package]

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec
        sys.modules.update(self._modules)
        sys.meta_path.remove(self)


if __name__ == "__main__":
    for each in sys.argv[1:]:
        importlib.import_module(each)
    importlib.import_module("torch").set_num_threads(1)
    known = any(each.startswith("neusee") for each in sys.modules)  # which keeps its torch
    held = [each for each in HELD if each in sys.modules and not (known and each == "torch")]
    sys.meta_path[:0] = [Held(each) for each in held]
    asked = serve()
    become(asked)
    exec(compile(asked["code"], "<string>", "exec"), {"__name__": "__main__"})
