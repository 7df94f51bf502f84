"""What the engine costs beside the physics: `python tests/benchmarks/bench_engine.py [FOLDER]`.

Prints a table in Markdown. The last column is the same work without the engine, or the figure
that was set as the aim, so that a loaded machine does not pass for a slow engine.
"""

import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from ruamel.yaml import YAML

from neusee import recipes
from neusee.nodes import node
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.cache_key import key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.text import yaml_values
from neusee.workflows.store import serialization
from neusee.workflows.store.result_store import Store

MB = 1e6
STACK = 31 * 2048 * 2048


@node()
def start(*, count: int = 4):
    return torch.zeros(count)


@node()
def add(x, *, k: float = 1.0):
    return x + k


@node()
def mean(x):
    return x.mean(dtype=torch.float64)


# shapes, as a node of the package has them: without, 1000 results count as 69 MB each, and the run
# is refused
@start.shape
def _(*, count):
    return torch.empty(count, device="meta")


@add.shape
def _(x, *, k):
    return x


@mean.shape
def _(x):
    return torch.empty((), dtype=torch.float64, device="meta")


def recipe(outputs: tuple[str, ...], *steps: Step) -> Recipe:
    return Recipe("bench", "", 1, 0.0, outputs, {s.name: s for s in steps})


def step(name: str, what, source: str | None = None, **params) -> Step:
    return Step(
        name, what, params, {"x": source} if source else {}, Location("bench.yaml", 1, 1), {}
    )


def chain(n: int, count: int = 4, changed: int = -1) -> Recipe:
    """``n`` additions and a mean; the addition ``changed`` adds another number."""
    steps = [step("s0", start, count=count)]
    steps += [step(f"s{i}", add, f"s{i - 1}", k=float(i) + (i == changed) / 2) for i in range(1, n)]
    return recipe(("mean",), *steps, step("mean", mean, f"s{n - 1}"))


def wide(n: int) -> Recipe:
    steps = [step(f"s{i}", add, "head", k=float(i)) for i in range(n)]
    return recipe(tuple(s.name for s in steps), step("head", start, count=4), *steps)


def timed(work: Callable[[], object], repeat: int = 1) -> float:
    found = []
    for _ in range(repeat):
        began = time.perf_counter()
        work()
        found.append(time.perf_counter() - began)
    return min(found)


def row(what: str, value: str, beside: str) -> None:
    print(f"| {what} | {value} | {beside} |", flush=True)


def new_run(what: Recipe, folder: Path) -> None:
    """As the next process would run it: with nothing in memory."""
    run(what, Store(folder))


def one_file(folder: Path) -> None:
    (folder / "part").write_bytes(b"x" * 1000)
    os.replace(folder / "part", folder / "whole")


def overhead(folder: Path) -> None:
    """Per trivial step, and the price of one small file written and named."""
    file = timed(lambda: [one_file(folder) for _ in range(1000)], 3)
    for name, what in (("chain", chain(1000)), ("side by side", wide(1000))):
        cold = min(timed(partial(new_run, what, folder / f"{name}{i}")) for i in range(3))
        cached = timed(partial(new_run, what, folder / f"{name}0"), 3)
        row(
            f"1000 trivial steps, {name}: cold",
            f"{cold:.3f} ms a step",
            f"one small file {file:.3f} ms; aim 0.5",
        )
        row(f"1000 trivial steps, {name}: cached", f"{cached:.3f} ms a step", "aim 0.1")
    long = partial(new_run, chain(10_000), folder / "long")
    row(
        "chain of 10 000 steps, cold and cached",
        f"{timed(long):.2f} and {timed(long):.2f} s",
        "no recursion",
    )


def keys(folder: Path) -> None:
    steps = [step(f"s{i}", add, f"s{i - 1}", k=float(i)) for i in range(1, 41)]

    def forty() -> None:
        found, code = {"s0": "0" * 32}, Code(folder / "code.json")
        for item in steps:
            found[item.name] = key_of(item, found, 1, code)[0]
        code.save()

    row(
        "40 keys, first and later",
        f"{timed(forty) * 1e3:.1f} and {timed(forty, 5) * 1e3:.1f} ms",
        "aim 30 ms",
    )


def recipe_texts(_: Path) -> None:
    """Read the twelve largest recipe files, with the place of each value; the library gives
    plain values.
    """
    files = sorted(
        Path(recipes.__path__[0]).rglob("*.yaml"), key=lambda path: -path.stat().st_size
    )[:12]

    def ours() -> None:
        yaml_values._document.cache_clear()
        for path in files:
            yaml_values.read(path, path.name)

    def theirs() -> None:
        for path in files:
            YAML(typ="safe").load(path)

    pairs = [(timed(ours), timed(theirs)) for _ in range(15)]
    ratios = sorted(a / b for a, b in pairs)
    value = f"{ratios[7]:.2f} times ruamel.yaml ({ratios[0]:.2f} to {ratios[-1]:.2f})"
    row(
        "12 recipe files, with places",
        value,
        f"the library alone {min(b for _, b in pairs) * 1e3:.0f} ms",
    )


def gigabyte(folder: Path) -> None:
    """Nine results of 111 MB and a number."""
    loads: list[int] = []
    read = serialization.read
    serialization.read = lambda path, xxh3: loads.append(os.path.getsize(path)) or read(path, xxh3)  # type: ignore
    count, place = int(111e6 / 4), folder / "gigabyte"
    row("10 steps, 1 GB: cold", f"{timed(partial(new_run, chain(9, count), place)):.2f} s", "")
    for what, changed, aim in (
        ("cached", -1, "aim 50 ms, 0 MB"),
        ("last two changed", 8, ""),
        ("middle changed", 4, ""),
    ):
        loads.clear()
        seconds = timed(partial(new_run, chain(9, count, changed), place))
        row(
            f"10 steps, 1 GB: {what}", f"{seconds * 1e3:.0f} ms, {sum(loads) / MB:.0f} MB read", aim
        )
    serialization.read = read


def stack(folder: Path) -> None:
    """One value of 2048 x 2048 in 31 bands, there and back."""
    x, store, key = torch.rand(STACK), Store(folder / "stack"), "a" * 32
    copy = timed(lambda: x.clone(), 3)
    write = timed(lambda: store.put(key, x, {}))
    sync = timed(lambda: (folder / "raw").write_bytes(x.numpy().data))
    load = timed(lambda: Store(folder / "stack").get(key), 3)
    touch = timed(lambda: Store(folder / "stack").get(key).sum(), 3)
    row(
        "520 MB: put, with checksum and fsync",
        f"{write:.2f} s",
        f"plain write without fsync {sync:.2f} s",
    )
    row("520 MB: get, verified", f"{load:.3f} s", f"copy in memory {copy:.3f} s")
    row("520 MB: get and sum", f"{touch:.3f} s", f"sum alone {timed(lambda: x.sum(), 3):.3f} s")


def memory(folder: Path) -> None:
    """A chain of eight stacks holds two at a time; the mean at its end makes one of twice the
    size.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    seconds = timed(partial(new_run, chain(8, STACK), folder / "memory"))
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    row(
        "8 steps of 520 MB: peak memory",
        f"{grown / MB:.0f} MB, {seconds:.1f} s",
        "a stack and its float64 copy: 1560 MB",
    )


def function(folder: Path) -> None:
    what = chain(100)
    live = as_function(what, "s1.k", store=Store(folder / "function"))
    x = torch.zeros(4)

    def bare() -> None:
        y = x
        for i in range(1, 100):
            y = add(y, k=float(i))

    calls, alone = timed(lambda: live({"s1.k": 1.0}), 20), timed(bare, 20)
    row(
        "as_function, 99 live steps",
        f"{calls * 1e4:.1f} µs a step",
        f"the bare calls {alone * 1e4:.1f} µs",
    )


if __name__ == "__main__":
    torch.set_num_threads(2)
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as place:
        print("| what | measured | beside it |\n|---|---|---|")
        for part in (memory, overhead, keys, recipe_texts, gigabyte, stack, function):
            part(Path(place))
