"""Memory of the report of a run: the results that its pictures and data files show, and the copies that are written."""

from __future__ import annotations

import re
from collections.abc import Mapping

from neusee.workflows.engine.cost_model import Costs
from neusee.workflows.engine.local_executor import program_memory
from neusee.workflows.engine.placement_inputs import prepare
from neusee.workflows.engine.step_job import Lane, StepJob
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.contents import FIGURES, FILES

#: Three numbers that tests/benchmarks/bench_memory.py fits to the measured memory of the reports of shipped recipes.
DRAWING = 63e6  #: bytes of the libraries that draw pictures and write files
HELD_BACK = 0.0765  #: share of the memory of the steps that the process does not give back to the system
COPIES = 2.06  #: copies of all results that are shown, while their pictures and files are made
_NEED = re.compile(r"\??(?P<step>[\w.]+(\[[^\]]*\])?)$")  # not a parameter and not a function of a step


def shown_steps(recipe: Recipe) -> list[str]:
    """Return the steps whose results the pictures and data files of a run show, as far as the recipe has them."""
    needs = [need for figure in FIGURES for need in figure.needs.values()]
    needs += [need for _, each in FILES.values() for need in each.values()]
    found: dict[str, None] = dict.fromkeys(name for name in recipe.outputs if name in recipe.steps)
    for need in needs:
        if match := _NEED.match(need):
            pattern = re.escape(match["step"]).replace(r"\*", "[^,]*")
            found.update(dict.fromkeys(name for name in recipe.steps if re.fullmatch(pattern, name)))
    return list(found)


def report_peak(
    works: list[StepJob], kept: Mapping[str, str], costs: Costs, lanes: Mapping[str, Lane], running: float = 0.0
) -> float:
    """Return the predicted peak memory of this process in bytes while the report is written.

    Args: works: the steps that only the report needs. kept: the keys of the results that are shown, by step.
    running: the predicted peak memory of this process while the steps run.
    """
    schedule = prepare(works, costs, {}, lanes, list(kept.values())).schedule if works else None
    made = max(schedule.peak.values(), default=0.0) if schedule else 0.0
    shown = COPIES * sum(costs.size_of(name) for name in kept)
    held = max((lane.held for lane in lanes.values()), default=0.0) or program_memory()
    return held + DRAWING + HELD_BACK * max(0.0, running - held) + max(made, shown)
