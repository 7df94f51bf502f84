"""Many runs in one process, and what it holds afterwards: started by ``test_growth`` as a
program of its own.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import json
import logging
import os
import sys
import threading
import tracemalloc
import warnings
from pathlib import Path

import torch

import neusee
from neusee.workflows import Store, load, run
from neusee.workflows.report.notebook import recipe_html, result_html
from neusee.workflows.simulation.simulate_recipe import simulate


def several(path: Path, folder: Path, count: int) -> None:
    """Run a recipe ``count`` times: new values and known ones, on a store that fills and on
    empty ones.
    """
    for i in range(count):
        waves = 1 + i / 100 if i % 2 else 2
        recipe = load(path, [f"mask.waves={waves}"]) if i % 3 else load(path, mask={"waves": waves})
        store = Store(folder / (f"empty {i}" if i % 10 == 0 else "kept"))
        if i % 10 == 0:
            simulate(recipe, store, folder / "runs", ["neusee", "run"])
        elif i % 10 == 5:
            result_html(neusee.run(recipe, store=store))
            recipe_html(recipe)
        elif i % 2:
            neusee.run(recipe, store=store)
        else:
            run(recipe, store, ["made"])


def held() -> dict[str, int]:
    """Everything that a run might leave behind."""
    gc.collect()
    # what the allocator keeps for the next run is not held
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
    loggers = [
        logging.root,
        *(x for x in logging.root.manager.loggerDict.values() if isinstance(x, logging.Logger)),
    ]
    # pyplot, which would count them, is not used
    figure = getattr(sys.modules.get("matplotlib.figure"), "Figure", ())
    return {
        "bytes": tracemalloc.get_traced_memory()[0],
        "resident": int(Path("/proc/self/statm").read_text().split()[1])
        * os.sysconf("SC_PAGE_SIZE"),
        "files": len(os.listdir("/proc/self/fd")),
        "maps": len(Path("/proc/self/maps").read_text().splitlines()),
        "threads": threading.active_count(),
        "handlers": sum(len(logger.handlers) for logger in loggers),
        "loggers": len(loggers),
        "filters": len(warnings.filters),
        "at exit": atexit._ncallbacks(),
        "figures": sum(issubclass(type(x), figure) for x in gc.get_objects()),
        "tensors": sum(issubclass(type(x), torch.Tensor) for x in gc.get_objects()),
        "modules": len(sys.modules),
        "temporary": len(list(Path(os.environ["TMPDIR"]).iterdir())),
    }


def grown(path: Path, folder: Path, warm: int, count: int, times: int) -> dict[str, list[int]]:
    """What is held after ``warm`` runs, and after each further ``count`` of them."""
    tracemalloc.start()
    several(path, folder / "warm", warm)
    seen = [held()]
    for i in range(times):
        several(path, folder / f"then {i}", count)
        seen.append(held())
    return {name: [each[name] for each in seen] for name in seen[0]}


if __name__ == "__main__":
    recipe, folder, *numbers = sys.argv[1:]
    print(json.dumps(grown(Path(recipe), Path(folder), *map(int, numbers))))
