"""Memory of the report of a run: the results that its pictures and data files show, and the copies that are written.

Also of the results that files hold which are made beside the run.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from neusee.workflows.engine.cost_model import Costs
from neusee.workflows.engine.local_executor import program_memory
from neusee.workflows.engine.placement_inputs import prepare
from neusee.workflows.engine.step_job import Lane, StepJob
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.contents import FIGURES, files_of, wanted
from neusee.workflows.report.files_beside import LARGE, ROOM

#: Three numbers that tests/benchmarks/bench_memory.py fits to the measured memory of the reports of shipped recipes.
DRAWING = 74.3e6  #: bytes of the libraries that draw pictures and write files
HELD_BACK = 0.0101  #: share of the memory of the steps that the process does not give back to the system
COPIES = 2.25  #: copies of the results in memory, while a picture or file of them is made
_NEED = re.compile(r"\??(?P<step>[\w.]+(\[[^\]]*\])?)$")  # not a parameter and not a function of a step


def shown_steps(recipe: Recipe) -> list[str]:
    """Return the steps whose results the pictures and data files of a run show, as far as the recipe has them."""
    groups = [recipe.outputs, *(group for job in _jobs(recipe) for group in job)]
    return list(dict.fromkeys(name for group in groups for name in group if name in recipe.steps))


def held_beside(recipe: Recipe, costs: Costs, limit: float) -> float:
    """Return the most bytes of results that files hold which are made beside a run, as `FilesBeside` holds them.

    The values that the run returns are not counted, because they stay in memory with or without files. ``limit`` is the
    memory (bytes) that the process may use; with 0 no file is made beside the run.
    """
    large, room, most = min(LARGE, limit / 32), min(ROOM, limit / 16), limit / 16
    sizes = [costs.size_of(name) for name in shown_steps(recipe) if name not in wanted(recipe)]
    small = sum(size for size in sizes if size <= large)
    return min(small, room) + max((size for size in sizes if large < size <= most), default=0.0)


def report_peak(
    works: list[StepJob],
    recipe: Recipe,
    keys: Mapping[str, str],
    costs: Costs,
    lanes: Mapping[str, Lane],
    running: float = 0.0,
) -> float:
    """Return the predicted peak memory of this process in bytes while the report is written.

    Args: works: the steps that only the report needs. keys: the keys of the results that are shown, by step.
    running: the predicted peak memory of this process while the steps run.
    """
    schedule = prepare(works, costs, {}, lanes, list(keys.values())).schedule if works else None
    made = max(schedule.peak.values(), default=0.0) if schedule else 0.0
    held = max((lane.held for lane in lanes.values()), default=0.0) or program_memory()
    shown = COPIES * shown_at_once(recipe, costs)
    return held + DRAWING + HELD_BACK * max(0.0, running - held) + max(made, shown)


def shown_at_once(recipe: Recipe, costs: Costs) -> float:
    """Return the largest number of bytes of results that are in memory together while pictures and files are made.

    The outputs of the recipe stay in memory. Another result is there from the first picture or file that shows it to
    the last, as `workflows.report.shown_values` holds it.
    """
    most = 0.0
    for groups in _jobs(recipe):
        uses, there = Counter(name for group in groups for name in group), set(recipe.outputs)
        for group in groups:
            there.update(group)
            most = max(most, sum(costs.size_of(name) for name in there if name in recipe.steps))
            uses.subtract(group)
            there = {name for name in there if uses[name] > 0 or name in recipe.outputs}
    return most


def _jobs(recipe: Recipe) -> tuple[Sequence[Sequence[str]], ...]:
    """Return the steps that each picture shows, and the steps that each data file shows."""
    pictures = [list(_found(recipe, figure.needs)) for figure in FIGURES]
    return pictures, [list(_found(recipe, needs)) for _, needs in files_of(recipe).values()]


def _found(recipe: Recipe, needs: Mapping[str, str]) -> Iterator[str]:
    for match in filter(None, map(_NEED.match, needs.values())):
        pattern = re.escape(match["step"]).replace(r"\*", "[^,]*")
        yield from (name for name in recipe.steps if re.fullmatch(pattern, name))
