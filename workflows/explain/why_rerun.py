"""Reasons why a step runs again: the differences from the most similar earlier result of the step."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from neusee.workflows.engine.resolve_keys import Resolved, resolve
from neusee.workflows.explain.change_causes import Comparison, Origin, Pair, Roots
from neusee.workflows.explain.change_wording import spoken
from neusee.workflows.graph.diagnostics import nearest
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.graph.step_record import Event
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

_CANDIDATES = 200  #: earlier results of a step, the newest, that are compared
_PAIRS = 20_000  #: comparisons after which no further earlier result is examined
_AT_ONCE = 5  #: earlier results that a step is compared with during a run
_SHOWN = 10  #: causes that are listed
_LINKS = 6  #: steps of a chain that are named


def why_lines(recipe: Recipe, store: Store, step: str, device: str = "cpu") -> list[str]:
    """Return lines that explain the state of ``step`` and its differences from earlier results.

    Raises `ValueError` with the nearest name if the step does not exist.
    """
    names = [name for name in recipe.steps if step in (name, name.partition("[")[0])]
    if not names:
        known = {*recipe.steps, *(name.partition("[")[0] for name in recipe.steps)}
        raise ValueError(f"there is no step {step!r}; {nearest(step, known)}")
    recipe = with_substitutions(recipe, [*recipe.outputs, *names])
    resolved = resolve(recipe, needed(recipe, [*recipe.outputs, *names]), store, device)
    comparison = Comparison(store, recipe, resolved)
    return [line for name in names for line in _step_lines(comparison, recipe, recipe.steps[name], resolved)]


def why_key_lines(store: Store, prefix: str) -> list[str]:
    """Return text lines on the origin of the result with key ``prefix...``, and on differences from earlier results.

    Raises `LookupError` if no key or more than one key begins with ``prefix``.
    """
    found = sorted(dict.fromkeys(row["key"] for row in _rows(store) if row["key"].startswith(prefix)))
    if len(found) != 1:
        some = f"; there are {', '.join(key[:12] for key in found[:5])}" if found else ""
        raise LookupError(f"{len(found) or 'no'} results have a key that begins with {prefix!r}{some}")
    key, about = found[0], store.about(found[0])
    if about is None:
        raise LookupError(f"the result {found[0]} is no longer in the store")
    comparison = Comparison(store)
    head = f"{about['step']} of {about.get('recipe') or 'a recipe'}: {_state(about)}, key {key}"
    return [head, *_made_of(comparison, key), *_because(comparison, about["step"], key, about)]


def explained(recipe: Recipe, store: Store, watch: Callable[[Event], None]) -> Callable[[Event], None]:
    """Return a function that adds the reason why a step ran to each event, and then calls ``watch``."""
    comparison = Comparison(store, recipe)
    before: dict[str, list[Key]] = {}

    def tell(event: Event) -> None:
        done = event.done
        if done is None:
            before[event.step] = _keys(_rows(store, event.step))
        elif done.state == "run":
            why = _at_once(comparison, recipe.steps[done.step], done.key, before.pop(done.step, []))
            event = Event(event.step, replace(done, why=why))
        watch(event)

    return tell


def _step_lines(comparison: Comparison, recipe: Recipe, step: Step, resolved: Resolved) -> list[str]:
    """Return lines with the state of one step and its differences from earlier results."""
    key, verdict = resolved.keys[step.name], resolved.verdicts.get(step.name)
    head = f"{step.name} ({step.node.path})"
    if verdict is not None and verdict.left_out:
        return [f"{head}: left out and replaced by {verdict.instead}: {verdict.why}"]
    about = comparison.store.about(key)
    lines = [f"{head}: {_state(about)}, key {key[:8]}"]
    maker = resolved.makers[key]
    if maker != step.name:
        lines.append(f"  same key as {maker}")
    if unsure := [name for name in needed(recipe, [step.name]) if resolved.left_out(name) is None]:
        lines.append(f"  left out or not, depending on the values of the inputs: {', '.join(unsure[:_SHOWN])}")
    return [*lines, *_because(comparison, step.name, key, about, maker)]


def _state(about: Mapping[str, Any] | None) -> str:
    if about is None:
        return "not stored, so it would run where it is needed"
    made = f"{_date(about)}, computed in {about.get('seconds', 0.0):.3g} s"
    return f"stored since {made}" if about.get("kept", True) else f"ran {made}, but its value was not kept"


def _because(
    comparison: Comparison, label: str, key: Key, about: Mapping[str, Any] | None, maker: str = ""
) -> Iterator[str]:
    """Yield lines with the differences of a result from the most similar earlier result."""
    rows = _rows(comparison.store, label) or _rows(comparison.store, maker or label)
    keys = _keys(rows)
    earlier = keys[: keys.index(key)] if key in keys else keys
    found = _nearest(comparison, label, key, earlier)
    if found is None:
        yield f"  no earlier result to compare with: {'the first' if key in keys else 'no'} result of this step"
        return
    old, roots = found
    for text in list(roots.found)[:_SHOWN]:
        yield f"  {_chain(roots.chain(text))}: {text}"
    if len(roots.found) > _SHOWN:
        yield f"  and {len(roots.found) - _SHOWN} more"
    which = "the earlier result" if len(earlier) == 1 else f"the nearest of {len(earlier)} earlier results"
    yield f"  compared with {which}, {old[:8]} of {_date(comparison.about(old) or {})}"


def _nearest(comparison: Comparison, label: str, key: Key, earlier: list[Key]) -> tuple[Key, Roots] | None:
    """Return the earlier result with the fewest differences, and these differences; prefer the newest result."""
    best: tuple[Key, Roots] | None = None
    for old in earlier[: -_CANDIDATES - 1 : -1]:
        if comparison.origin(old) is None:
            continue
        most = len(best[1].found) - 1 if best else float("inf")
        roots = comparison.roots(Pair(label, key, old), most)
        best = (old, roots) if roots is not None else best
        if best and (len(best[1].found) <= 1 or len(comparison.seen) > _PAIRS):
            break
    return best


def _at_once(comparison: Comparison, step: Step, key: Key, earlier: list[Key]) -> str:
    """Return the reason why a step ran, or an empty string if there is no earlier result."""
    if key in earlier:
        return "computed before, but its value is not stored"
    best: list[str] = []
    for old in earlier[: -_AT_ONCE - 1 : -1]:
        before, now = comparison.origin(old), comparison.origin(key)
        found = _direct(comparison, step, before, now) if before and now else []
        best = min(filter(None, (best, found)), key=len, default=[])
        if len(best) == 1:
            break
    return best[0] if best else ""


def _direct(comparison: Comparison, step: Step, old: Origin, new: Origin) -> list[str]:
    """Return the differences between two results of a step, followed by the names of inputs that differ."""
    texts = comparison.own(step.name, old, new)
    if old["node"] != new["node"] or len(old["inputs"]) != len(new["inputs"]):
        return texts
    for name, before, after in zip(step.node.inputs, old["inputs"], new["inputs"], strict=True):
        if before != after:
            wire = step.wires.get(name)
            texts.append(f"after {wire if isinstance(wire, str) else name}")
    return texts or ["nothing changed"]


def _made_of(comparison: Comparison, key: Key) -> Iterator[str]:
    """Yield one text line for each part of a cache key: node, parameters, inputs and random stream."""
    origin = comparison.origin(key)
    if origin is None:
        return
    yield f"  node    {origin['node']}, code {origin['code'][:8]}"
    for name, value in origin["params"].items():
        yield f"  with    {name} = {spoken(value)}"
    for given in origin["inputs"]:
        for source in [given] if isinstance(given, str) else given or ():
            yield f"  from    {comparison.step(source) or 'an unknown step'}, {source[:8]}"
    if stream := origin.get("stream"):
        yield f"  noise   seed {stream[0]}, of {stream[1]}, on {stream[2]}"


def _chain(names: list[str]) -> str:
    """Return names of steps as a chain such as ``restored <- raw <- read``, shortened if the chain is long."""
    if len(names) > _LINKS:
        names = [*names[: _LINKS - 2], f"({len(names) - _LINKS + 1} more)", names[-1]]
    return " <- ".join(names)


def _keys(rows: Iterable[dict[str, Any]]) -> list[Key]:
    return list(dict.fromkeys(row["key"] for row in rows))


def _date(about: Mapping[str, Any]) -> str:
    return str(about.get("date", "an unknown day"))[:19].replace("T", " ")


def _rows(store: Store, step: str | None = None) -> list[dict[str, Any]]:
    """Return the lines on one step or on all steps from the journal of a result store, in order of time."""
    return store.journal.rows() if step is None else store.journal.of_step(step)
