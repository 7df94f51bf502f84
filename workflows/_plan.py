"""What a run would do, without doing it: hits, bytes and seconds, from what earlier runs left behind."""

from __future__ import annotations

from collections import defaultdict
from statistics import median
from typing import Any

from neusee.nodes import Facts
from neusee.workflows._call import RunError, place
from neusee.workflows._code import Code
from neusee.workflows._graph import Recipe
from neusee.workflows._keys import key_of
from neusee.workflows._store import Store
from neusee.workflows._verdict import judge
from neusee.workflows.report import size_of
from neusee.workflows.simulate import steps_of, wanted


def plan_lines(recipe: Recipe, store: Store, device: str = "cpu") -> list[str]:
    """One line a step: stored or to be run, what it reads, its bytes and seconds as far as they are known."""
    order = steps_of(recipe)
    keys, left_out = _resolved(recipe, order, store, device)
    awake, past = _awake(recipe, keys, store), _past(store)
    rows, seconds, size = [], 0.0, 0.0
    for name in order:
        step, about = recipe.steps[name], store.about(keys[name])
        known = about or past.get(name) or past.get(step.node.path) or {}
        state = "left out" if left_out.get(name) else "stored" if about else "run" if name in awake else "not needed"
        if state == "run":
            seconds, size = seconds + known.get("seconds", 0.0), size + known.get("bytes", 0.0)
        cost = ["", ""] if state == "left out" else _cost(known)
        rows.append([name, step.node.path, state, *cost, ", ".join(dict.fromkeys(step.sources))])
    count = sum(row[2] == "run" for row in rows)
    last = f"{count} of {len(rows)} steps would run: about {seconds:.3g} s, {size_of(size)} new, as earlier runs took"
    unsure = [name for name, known in left_out.items() if known is None]
    note = [f"left out or not, only what feeds it will tell: {', '.join(unsure)}"] if unsure else []
    return [*_columns([["step", "node", "state", "seconds", "bytes", "reads"], *rows]), *note, last]


def _cost(known: dict[str, Any]) -> list[str]:
    return [f"{known['seconds']:.3f} s", size_of(known["bytes"])] if known else ["?", "?"]


def cache_lines(store: Store) -> list[str]:
    """Every result: when, bytes, seconds, step, recipe, key; the newest last."""
    found = sorted(store.entries(), key=lambda entry: str(entry[1].get("date", "")))
    rows = [_entry(key, about) for key, about in found]
    total = sum(_size(about) for _, about in found)
    last = f"{len(found)} results, {size_of(total)}, in {store.root}"
    return [*(_columns([["date", "bytes", "seconds", "step", "recipe", "key"], *rows]) if rows else []), last]


def _resolved(
    recipe: Recipe, order: list[str], store: Store, device: str
) -> tuple[dict[str, str], dict[str, bool | None]]:
    """The key of every step, and which are left out; None where the facts that decide are not known yet."""
    keys, left_out, code = dict[str, str](), dict[str, bool | None](), Code(store.code_memo)

    def facts_of(name: str) -> Facts | None:
        found = (store.about(keys[name]) or {}).get("facts")
        if found is None:
            raise LookupError(name)
        return Facts(**{**found, "shape": tuple(found["shape"])})

    for name in order:
        step = recipe.steps[name]
        try:
            verdict = judge(step, step.params, facts_of, recipe.tolerance) if step.node.bound else None
        except RunError:
            verdict, left_out[name] = None, None
        if verdict and verdict.left_out:
            keys[name], left_out[name] = keys[verdict.instead], True
        else:
            keys[name], _ = key_of(step, keys, recipe.seed, code, place(step, device))
    code.save()
    return keys, left_out


def _entry(key: str, about: dict[str, Any]) -> list[str]:
    took, date = f"{about.get('seconds', 0.0):.3f}", about.get("date", "")[:19].replace("T", " ")
    return [date, size_of(_size(about)), took, about.get("step", ""), about.get("recipe", ""), key[:8]]


def _size(about: dict[str, Any]) -> int:
    """Bytes of a result, or of the file that it stands for."""
    size: int = about.get("file_bytes", about["bytes"])
    return size


def _awake(recipe: Recipe, keys: dict[str, str], store: Store) -> set[str]:
    """Steps that a run would have to compute: walking back from what is wanted, stopping at what is stored."""
    found, todo = set[str](), list(wanted(recipe))
    while todo:
        name = todo.pop()
        if name not in found and not store.has(keys[name]):
            found.add(name)
            todo += recipe.steps[name].sources
    return found


def _past(store: Store) -> dict[str, dict[str, Any]]:
    """Median seconds and bytes of earlier results, by step and by node."""
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for _, about in store.entries():
        for name in (about.get("step"), (about.get("origin") or {}).get("node")):
            if name and "seconds" in about:
                rows[name].append(about)
    return {name: {f: median(row[f] for row in all_) for f in ("seconds", "bytes")} for name, all_ in rows.items()}


def _columns(rows: list[list[str]]) -> list[str]:
    """Left-aligned columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(f"{cell:<{wide}}" for cell, wide in zip(row, widths, strict=True)).rstrip() for row in rows]
