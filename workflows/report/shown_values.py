"""Values that the pictures and data files of a run show, in memory only from their first use to their last."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

from neusee.workflows.engine.memory_use import give_back
from neusee.workflows.engine.node_call import to_device
from neusee.workflows.engine.runner import Result, run


def in_turn(groups: Sequence[Sequence[str]], result: Result) -> Iterator[Mapping[str, Any]]:
    """Yield for each group of steps the values of these steps, on the first device of the run.

    The values of the run itself are used where it has them. Other values are read from the store when their group
    comes, and the few that the store lacks are computed together before the first group. A value is deleted after
    the last group that needs it.
    """
    uses = Counter(step for group in groups for step in group)
    lacking = [step for step in uses if step not in result.values and not result.store.has(result.keys[step])]
    values = dict(_computed(lacking, result))
    for group in groups:
        values |= _read([step for step in group if step not in values], result)
        yield {step: values[step] for step in group}
        uses.subtract(group)
        done = [step for step in values if uses[step] <= 0]
        for step in done:
            del values[step]
        if done:
            give_back()


def _read(steps: Iterable[str], result: Result) -> dict[str, Any]:
    """Return the values of steps from the run, from its store, or computed again if the store has lost them."""
    device, found, lost = result.device.partition(",")[0], {}, list[str]()
    for step in steps:
        if step in result.values:
            found[step] = result.values[step]
            continue
        hint = result.recipe.steps[step].node.hints.get("return", Any)
        with suppress(KeyError):
            found[step] = to_device(result.store.get(result.keys[step], hint), device)
        if step not in found:
            lost.append(step)
    return {**found, **_computed(lost, result)}


def _computed(steps: Sequence[str], result: Result) -> Mapping[str, Any]:
    return run(result.recipe, result.store, sorted(steps), device=result.device).values if steps else {}
