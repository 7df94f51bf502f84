"""Record what each command does on a cache that fails, with exit code, seconds and message, in
RESULTS.md.

    python tests/benchmarks/bench_cache_faults.py [COMMAND=FAULT,FAULT...]

Each row is a process of its own, in an empty folder, with a cache that fails as `cache_faults.py`
says (mounts need root). `run` computes the recipe first_light as shipped, the other commands the
small recipes of `test_cache_faults.py`. Without arguments, `run` meets every fault and each other
command those in `SOME`. The section of RESULTS.md is written anew, with the rows of the commands
that were not asked for as they were.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

HERE = Path(__file__).resolve()
CLI = HERE.parents[1] / "workflows" / "cli"
RESULTS = HERE.with_name("RESULTS.md")
HEAD = "## A cache that fails, by command and fault (`bench_cache_faults.py`)"
SOME = ("a full disk", "a file in its place", "errors of the device")
FULL = ["run", "first_light", "--json"]
MIDDLE = "a disk that fills up in the middle"  #: a fault for results of a full size alone
COLUMNS = "| command | cache | exit code | s | numbers | message |\n|---|---|---|---|---|---|\n"
ABOUT = """\
`run` is `neusee run first_light` as shipped, and computes every step. These runs take more than ten minutes altogether,
so the other commands run the small recipes of `test_cache_faults.py`, where every fault meets every command. Each row
is one process; its seconds include the start of the program and the report, and are those of a machine that others
used too, so that they tell no price of a fault. *numbers* says what a run says of the expected numbers of its recipe.
"""


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


def row(command: str, fault: str, words: Sequence[str], recipe: str) -> str:
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
    return f"| {command} | {fault} | {done.returncode} | {seconds:.0f} | {verdict} | {told} |\n"


def rows(text: str) -> dict[str, str]:
    """Return the rows in a section of RESULTS.md by command and fault."""
    found = re.finditer(r"^\| (\w[^|]*) \| ([^|]+) \| \d+ \|.*\n", text, re.MULTILINE)
    return {f"{match[1]}: {match[2]}": match[0] for match in found}


def write(made: dict[str, str]) -> None:
    """Write rows to the section of this script in RESULTS.md, and keep its other rows."""
    text = RESULTS.read_text(encoding="utf-8")
    before, _, rest = text.partition(HEAD)
    old, mark, after = rest.partition("\n## ")
    all_rows = rows(old) | made
    body = "".join(all_rows[key] for key in sorted(all_rows, key=lambda key: key.partition(":")[0]))
    section = f"{HEAD}\n\n{ABOUT}\n{COLUMNS}{body}"
    RESULTS.write_text(f"{before.rstrip()}\n\n{section}{mark}{after}", encoding="utf-8")


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
            print(made, end="", flush=True)
            write({f"{command}: {fault}": made})


if __name__ == "__main__":
    if sys.argv[1:2] == ["child"]:
        child(sys.argv[2], sys.argv[3:])
    else:
        main(sys.argv[1:])
