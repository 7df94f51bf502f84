"""Record what each command does on a cache that fails, with exit code, seconds and message, in
RESULTS.md.

    python tests/benchmarks/bench_cache_faults.py [COMMAND=FAULT,FAULT...]

Each row is a process of its own, in an empty folder, with a cache that fails as `cache_faults.py`
says (mounts need root). `run` computes the recipe first_light as shipped, the other commands the
small recipes of `test_cache_faults.py`. Without arguments, `run` meets every fault and each other
command those in `SOME`. The stored table is written anew, with the rows of the commands
that were not asked for as they were.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from stored_results import store_rows, stored

HERE = Path(__file__).resolve()
CLI = HERE.parents[1] / "workflows" / "cli"
DOCUMENT = "cache_faults"  #: in `results/`
SOME = ("a full disk", "a file in its place", "errors of the device")
FULL = ["run", "first_light", "--json"]
MIDDLE = "a disk that fills up in the middle"  #: a fault for results of a full size alone
ABOUT = """\
`run` is `neusee run first_light` as shipped, and computes every step. These runs take more than ten minutes \
altogether, so the other commands run the small recipes of `test_cache_faults.py`, where every fault meets every \
command. Each row is one process; its seconds include the start of the program and the report, and are those of a \
machine that others used too, so that they tell no price of a fault. *numbers* says what a run says of the expected \
numbers of its recipe."""


def module(file: Path) -> Any:
    """Return a module of the tests, loaded from its file."""
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


@contextmanager
def failing(fault: str, folder: Path) -> Iterator[Path]:
    """Yield a cache that fails as a fault says."""
    faults = module(CLI / "cache_faults.py")
    made = (
        faults.mounted(folder, "size=100m")
        if fault == MIDDLE
        else faults.failing_cache(fault, folder)
    )
    with made as cache:
        yield cache


def child(fault: str, words: Sequence[str]) -> None:
    """Run a command of neusee in this process with a failing cache in the working folder."""
    from neusee.workflows.cli import app

    with failing(fault, Path.cwd() / "cache") as cache:
        os.environ["NEUSEE_CACHE"] = str(cache)
        app.main(list(words))


def row(command: str, fault: str, words: Sequence[str], recipe: str) -> list[str]:
    """Return the row of the table for a command that was run on a cache with a fault."""
    with TemporaryDirectory(prefix="neusee-") as folder:
        (Path(folder) / "mine.yaml").write_text(recipe, encoding="utf-8")
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, HERE, "child", fault, *words],
            cwd=folder,
            capture_output=True,
            text=True,
        )
        seconds = time.perf_counter() - start
        messages = [
            line for line in (done.stderr + done.stdout).splitlines() if line.startswith("warning")
        ]
        told = (
            messages[0].removeprefix("warning").strip(": ")
            if messages
            else done.stderr.strip()[-200:] or "none"
        )
        told = told.replace(f"{folder}/cache", "CACHE").replace("|", "/")
    verdict = (
        json.loads(done.stdout)["verdict"] if "--json" in words and done.returncode == 0 else ""
    )
    return [command, fault, str(done.returncode), f"{seconds:.0f}", verdict, told]


def write(made: list[str]) -> None:
    """Store a row in the place of the one of the same command and fault, and keep the others."""
    [table] = stored(DOCUMENT)["tables"]
    others = [old for old in table["rows"] if old[:2] != made[:2]]
    store_rows(DOCUMENT, sorted([*others, made], key=lambda cells: cells[0]), ABOUT)


def main(words: Sequence[str]) -> None:
    """Run the commands with the faults that are asked for, and record each as soon as it has
    ended.
    """
    small, faults = module(CLI / "test_cache_faults.py"), module(CLI / "cache_faults.py")
    plan = {name: SOME for name in small.COMMANDS} | {"run": (*faults.FAULTS, MIDDLE)}
    asked = dict(word.split("=") for word in words) or {
        name: ",".join(each) for name, each in plan.items()
    }
    for command, names in asked.items():
        for fault in names.split(",") if names else plan[command]:
            given = FULL if command == "run" else small.COMMANDS[command]
            made = row(command, fault, given, small.RECIPE)
            print(*made, sep=" | ", flush=True)
            write(made)


if __name__ == "__main__":
    if sys.argv[1:2] == ["child"]:
        child(sys.argv[2], sys.argv[3:])
    else:
        main(sys.argv[1:])
