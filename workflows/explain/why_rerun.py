"""Reasons why a step runs again: the differences from the most similar earlier result of that
step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.resolved_keys import Resolved
from neusee.workflows.explain.change_causes import Comparison, Origin
from neusee.workflows.explain.stored_origin import because, keys_in, state_of
from neusee.workflows.graph.errors import nearest
from neusee.workflows.graph.recipe_graph import Event, Recipe, Step, needed
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

_COMPARED_RESULTS = 5  #: number of earlier results with which a step is compared during a run
_SHOWN_CAUSES = 10  #: greatest number of listed causes


def why_lines(recipe: Recipe, store: Store, step: str, device: str = "cpu") -> list[str]:
    """Return lines that state whether ``step`` is stored, and explain its differences from earlier
    results.

    Raises `ValueError` with the nearest name if the step does not exist.
    """
    names = [name for name in recipe.steps if step in (name, name.partition("[")[0])]
    if not names:
        names_of_steps = {*recipe.steps, *(name.partition("[")[0] for name in recipe.steps)}
        raise ValueError(f"there is no step {step!r}; {nearest(step, names_of_steps)}")
    recipe = with_substitutions(recipe, [*recipe.outputs, *names])
    resolved = resolve(recipe, needed(recipe, [*recipe.outputs, *names]), store, device)
    comparison = Comparison(store, recipe, resolved)
    lines: list[str] = []
    for name in names:
        lines += _step_lines(comparison, recipe, recipe.steps[name], resolved)
    return lines


def explained(
    recipe: Recipe, store: Store, watch: Callable[[Event], None]
) -> Callable[[Event], None]:
    """Return a function that adds the reason why a step ran to each event, and then calls
    ``watch``.
    """
    comparison = Comparison(store, recipe)
    earlier_keys: dict[str, list[Key]] = {}

    def tell(event: Event) -> None:
        record = event.done
        if record is None:
            # read before the step adds its own line to the journal
            earlier_keys[event.step] = keys_in(
                row for row in store.journal.latest() if row["step"] == event.step
            )
        elif record.state == "run":
            reason = _at_once(
                comparison, recipe.steps[record.step], record.key, earlier_keys.pop(record.step, [])
            )
            event = Event(event.step, replace(record, why=reason))
        watch(event)

    return tell


def _step_lines(
    comparison: Comparison, recipe: Recipe, step: Step, resolved: Resolved
) -> list[str]:
    """Return lines with the state of one step and its differences from earlier results."""
    key, verdict = resolved.keys[step.name], resolved.verdicts.get(step.name)
    head_text = f"{step.name} ({step.node.path})"
    if verdict is not None and verdict.left_out:
        return [f"{head_text}: left out and replaced by {verdict.instead}: {verdict.why}"]
    metadata = comparison.store.about(key)
    lines = [f"{head_text}: {state_of(metadata)}, key {key[:8]}"]
    maker = resolved.makers[key]
    if maker != step.name:
        lines.append(f"  same key as {maker}")
    # None means that only the values of its inputs can decide
    if undecided := [
        name for name in needed(recipe, [step.name]) if resolved.left_out(name) is None
    ]:
        lines.append(
            "  left out or not, depending on the values of the inputs:"
            f" {', '.join(undecided[:_SHOWN_CAUSES])}"
        )
    return [*lines, *because(comparison, step.name, key, metadata, maker)]


def _at_once(comparison: Comparison, step: Step, key: Key, earlier: list[Key]) -> str:
    """Return the reason why a step ran, or an empty string if there is no earlier result."""
    if key in earlier:
        return "computed before, but its value is not stored"
    fewest_differences: list[str] = []
    # the newest first
    for earlier_key in earlier[: -_COMPARED_RESULTS - 1 : -1]:
        old_origin, new_origin = comparison.origin(earlier_key), comparison.origin(key)
        differences = (
            _direct(comparison, step, old_origin, new_origin) if old_origin and new_origin else []
        )
        # an empty list means that no comparison was possible
        fewest_differences = min(
            filter(None, (fewest_differences, differences)), key=len, default=[]
        )
        if len(fewest_differences) == 1:
            break
    return fewest_differences[0] if fewest_differences else ""


def _direct(comparison: Comparison, step: Step, old: Origin, new: Origin) -> list[str]:
    """Return the differences between two results of a step, followed by the names of inputs that
    differ.
    """
    texts = comparison.own(step.name, old, new)
    if old["node"] != new["node"] or len(old["inputs"]) != len(new["inputs"]):
        return texts
    for name, old_keys, new_keys in zip(
        step.node.inputs, old["inputs"], new["inputs"], strict=True
    ):
        if old_keys != new_keys:
            wire = step.wires.get(name)
            texts.append(f"after {wire if isinstance(wire, str) else name}")
    return texts or ["nothing changed"]
