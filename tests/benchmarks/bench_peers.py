"""The engine beside joblib.Memory and Hamilton: `python tests/benchmarks/bench_peers.py [FOLDER]`.

Prints a table in Markdown. All three take turns in one process, so that a loaded machine slows them
alike; figures are medians. joblib and Hamilton are given floats and NumPy arrays, with which they
are at their best; ours works on tensors. Every cached run begins with nothing in memory, as the
next process would; building Hamilton's driver, like our recipe, is not counted. Hamilton runs with
the recursion limit raised to 30 000, without which it fails on a chain of 1000.
"""

import importlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from bench_engine import MB, chain, new_run, wide
from hamilton import driver

from neusee.workflows.store import serialization

STEPS, LONG = 1000, 10_000
COUNT = int(111e6 / 4)  #: numbers in one of nine arrays that make 1 GB
Work = Callable[[], object]


def seconds(work: Work) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def row(what: str, *cells: str) -> None:
    print("| " + " | ".join([what, *cells]) + " |", flush=True)


# joblib


def begin(count: int) -> Any:
    return np.zeros(count, np.float32) if count else 0.0


def add(x: Any, k: float) -> Any:
    return x + np.float32(k) if isinstance(x, np.ndarray) else x + k


def mean(x: Any) -> float:
    return float(np.mean(x))


def joblib_chain(n: int, folder: Path, count: int = 0, changed: int = -1) -> None:
    memory = joblib.Memory(folder, verbose=0)
    first, then, last = (memory.cache(f) for f in (begin, add, mean))
    x = first(count)
    for i in range(1, n):
        x = then(x, float(i) + (i == changed) / 2)
    last(x)


def joblib_wide(n: int, folder: Path) -> None:
    memory = joblib.Memory(folder, verbose=0)
    first, then = memory.cache(begin), memory.cache(add)
    x = first(0)
    for i in range(n):
        then(x, float(i))


# Hamilton

ARRAYS = """
import numpy as np


def s0() -> np.ndarray:
    return np.zeros({count}, np.float32)
"""


def module(name: str, text: str, folder: Path) -> Any:
    (folder / f"{name}.py").write_text(text)
    importlib.invalidate_caches()
    sys.modules.pop(name, None)
    return importlib.import_module(name)


def small_chain(n: int, folder: Path) -> tuple[Any, list[str]]:
    text = "def s0() -> float:\n    return 0.0\n"
    for i in range(1, n):
        text += f"\n\ndef s{i}(s{i - 1}: float) -> float:\n    return s{i - 1} + {float(i)}\n"
    return module("peer_chain", text, folder), [f"s{n - 1}"]


def small_wide(n: int, folder: Path) -> tuple[Any, list[str]]:
    text = "def head() -> float:\n    return 0.0\n"
    for i in range(n):
        text += f"\n\ndef s{i}(head: float) -> float:\n    return head + {float(i)}\n"
    return module("peer_wide", text, folder), [f"s{i}" for i in range(n)]


def large_chain(n: int, folder: Path, changed: int = -1) -> tuple[Any, list[str]]:
    text = ARRAYS.format(count=COUNT)
    for i in range(1, n):
        k = float(i) + (i == changed) / 2
        text += (
            f"\n\ndef s{i}(s{i - 1}: np.ndarray) -> np.ndarray:\n    return s{i - 1} +"
            f" np.float32({k})\n"
        )
    text += f"\n\ndef mean(s{n - 1}: np.ndarray) -> float:\n    return float(np.mean(s{n - 1}))\n"
    return module(f"peer_large{changed + 1}", text, folder), ["mean"]


def hamilton(graph: tuple[Any, list[str]], folder: Path) -> Work:
    """An execution by a new driver, whose making is not counted."""
    built = driver.Builder().with_modules(graph[0]).with_cache(path=str(folder)).build()
    return partial(built.execute, graph[1])


# what is compared


def overhead(folder: Path) -> None:
    """Per trivial step."""
    for name, ours, theirs, graph in (
        ("chain", chain(STEPS), joblib_chain, small_chain(STEPS, folder)),
        ("side by side", wide(STEPS), joblib_wide, small_wide(STEPS, folder)),
    ):
        for state, repeat, place in (("cold", 3, "{name}{i}"), ("cached", 5, "{name}0")):
            found = []
            for i in range(repeat):
                at = folder / place.format(name=name, i=i)
                peer = hamilton(graph, at / "hamilton")
                works = [
                    partial(new_run, ours, at / "ours"),
                    partial(theirs, STEPS, at / "joblib"),
                    peer,
                ]
                found.append([seconds(work) for work in works])
            cells = [
                f"{statistics.median(c) / STEPS * 1e3:.3f} ms a step"
                for c in zip(*found, strict=True)
            ]
            row(f"{STEPS} trivial steps, {name}: {state}", *cells)


def long_chain(folder: Path) -> None:
    works = (
        partial(new_run, chain(LONG), folder / "long"),
        partial(joblib_chain, LONG, folder / "long-joblib"),
    )
    cells = [f"{seconds(work):.2f} and {seconds(work):.2f} s" for work in works]
    row(f"chain of {LONG} steps, cold and cached", *cells, unraised(folder))


def unraised(folder: Path) -> str:
    """What becomes of Hamilton on a chain of 1000 with Python's own recursion limit."""
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(1000)
    try:
        hamilton(small_chain(STEPS, folder), folder / "unraised")()
    except RecursionError:
        return f"{STEPS} steps: RecursionError, unless the limit is raised"
    finally:
        sys.setrecursionlimit(limit)
    return f"{STEPS} steps: done"


def bytes_read() -> int:
    """Bytes that this process has asked the system to read, maps aside."""
    return int(Path("/proc/self/io").read_text().split()[1])


def gigabyte(folder: Path) -> None:
    """Nine arrays of 111 MB and a number."""
    loads: list[int] = []
    read = serialization.read
    serialization.read = lambda path, *rest: (
        loads.append(os.path.getsize(path)) or read(path, *rest)
    )  # type: ignore
    ours, theirs, place = (
        folder / "gigabyte",
        folder / "gigabyte-joblib",
        folder / "gigabyte-hamilton",
    )
    for what, changed, repeat in (("cold", -1, 1), ("cached", -1, 3), ("last two changed", 8, 1)):
        graph, recipe = large_chain(9, folder, changed), chain(9, COUNT, changed)
        cells: list[list[tuple[float, float]]] = [[], [], []]
        for _ in range(repeat):
            works = [
                partial(new_run, recipe, ours),
                partial(joblib_chain, 9, theirs, COUNT, changed),
            ]
            for cell, work in zip(cells, [*works, hamilton(graph, place)], strict=True):
                loads.clear()
                before = bytes_read()
                cell.append((seconds(work), bytes_read() - before + sum(loads)))
        texts = (tuple(statistics.median(c) for c in zip(*cell, strict=True)) for cell in cells)
        row(
            f"10 steps, 1 GB: {what}",
            *(f"{t * 1e3:.0f} ms, {size / MB:.1f} MB read" for t, size in texts),
        )
    serialization.read = read


# what is right

CASE = """
import torch
{imports}


def tensor({x}) -> torch.Tensor:
    print("computed")
    return {read}.sum()


def network({net}) -> torch.Tensor:
    return {apply}.sum()


def helped({one}) -> torch.Tensor:
    return scale() * torch.ones(1)
"""
OURS = {
    "imports": (
        "from pathlib import Path\nfrom neusee.nodes import node\nfrom neusee.nodes.peer_helper"
        " import scale"
    ),
    "x": "*, x: Path",
    "read": "torch.load(x)",
    "net": "*, net: Path",
    "apply": 'torch.nn.functional.linear(torch.full((1,), 2.0), torch.load(net)["weight"])',
    "one": "*, one: float",
}
THEIRS = {
    "imports": "from peer_helper import scale",
    "x": "x: torch.Tensor",
    "read": "x",
    "net": "net: torch.nn.Linear",
    "apply": "net(torch.full((1,), 2.0))",
    "one": "one: float",
}
GIVEN = """
import sys
import torch
folder, name, weight = sys.argv[1], sys.argv[2], float(sys.argv[3])
net = torch.nn.Linear(1, 1, bias=False).requires_grad_(False)
net.weight.fill_(weight)
given = {"tensor": {"x": torch.ones(3)}, "network": {"net": net}, "helped": {"one": 1.0}}[name]
"""
RUNS = {
    "ours": (
        """
import neusee.nodes
from pathlib import Path
neusee.nodes.__path__ = [*neusee.nodes.__path__, folder]
from neusee.nodes import peer_case as case
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.graph.errors import Location
from neusee.workflows.engine.runner import run
from neusee.workflows.store.result_store import Store
for key, value in given.items():
    if not isinstance(value, float):
        torch.save(value.state_dict() if key == "net" else value, f"{folder}/{key}.pt")
        given[key] = Path(f"{folder}/{key}.pt")
step = Step("y", getattr(case, name), given, {}, Location("peer.yaml", 1, 1), {})
found = run(Recipe("peer", "", 1, 0.0, ("y",), {"y": step}), Store(Path(folder) / "ours")).values["y"]
"""
    ),
    "joblib": (
        """
sys.path.insert(0, folder)
import joblib, peer_case as case
found = joblib.Memory(folder + "/joblib", verbose=0).cache(getattr(case, name))(**given)
"""
    ),
    "hamilton": (
        """
sys.path.insert(0, folder)
import peer_case as case
from hamilton import driver
built = driver.Builder().with_modules(case).with_cache(path=folder + "/hamilton").build()
found = built.execute([name], inputs=given)[name]
"""
    ),
}


def right(folder: Path) -> None:
    """What further processes give after the first: for the same tensor, other weights, another
    helper.
    """
    hits, weights, helpers = [], [], []
    for engine, script in RUNS.items():
        place = folder / f"right-{engine}"
        place.mkdir()
        text = CASE.format(**(OURS if engine == "ours" else THEIRS))
        (place / "peer_case.py").write_text(
            text.replace("def ", "@node()\ndef ") if engine == "ours" else text
        )
        (place / "peer_helper.py").write_text("def scale():\n    return 2.0\n")
        told = partial(new_process, GIVEN + script + "print(f'{float(found):g}')", place)
        told("tensor", 0)
        hits.append("computed again" if "computed" in told("tensor", 0) else "found")
        weights.append(", ".join(told("network", w)[-1] for w in (1, 2, 3)))
        told("helped", 0)
        (place / "peer_helper.py").write_text("def scale():\n    return 3.0\n")
        helpers.append(told("helped", 0)[-1])
    row("the same torch tensor in the next process", *hits)
    row("weights 1, 2, 3 (2, 4, 6 is right)", *weights)
    row("after a helper was edited (3 is right)", *helpers)


def new_process(script: str, place: Path, name: str, weight: float) -> list[str]:
    """What a new process says, its value last."""
    command = [sys.executable, "-B", "-c", script, str(place), name, str(weight)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()


if __name__ == "__main__":
    torch.set_num_threads(2)
    sys.setrecursionlimit(30_000)
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as place:
        sys.path.insert(0, place)
        row(
            "what",
            "neusee",
            f"joblib {version('joblib')}",
            f"Hamilton {version('apache-hamilton')}",
        )
        row("---", "---", "---", "---")
        for part in (overhead, long_chain, gigabyte, right):
            part(Path(place))
