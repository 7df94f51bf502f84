"""Origin of a stored result, and its differences from the most similar earlier result of its step.

The store alone is read: neither torch nor a recipe is needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from neusee.workflows.explain.change_causes import Comparison, Pair, Roots, spoken
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.store.result_store import Store

_CANDIDATES = 200  #: earlier results of a step, the newest, that are compared
_PAIRS = 20_000  #: comparisons after which no further earlier result is examined
_SHOWN = 10  #: causes that are listed
_LINKS = 6  #: steps of a chain that are named


def why_key_lines(store: Store, prefix: str) -> list[str]:
    """Return text lines on the origin of the result with key ``prefix...``, and on differences from
    earlier results.

    Raises `LookupError` if no key or more than one key begins with ``prefix``.
    """
    keys = sorted(
        dict.fromkeys(row["key"] for row in rows_of(store) if row["key"].startswith(prefix))
    )
    if len(keys) != 1:
        some = f"; there are {', '.join(key[:12] for key in keys[:5])}" if keys else ""
        raise LookupError(
            f"{len(keys) or 'no'} results have a key that begins with {prefix!r}{some}"
        )
    key, about = keys[0], store.about(keys[0])
    if about is None:
        raise LookupError(f"the result {keys[0]} is no longer in the store")
    comparison = Comparison(store)
    head = f"{about['step']} of {about.get('recipe') or 'a recipe'}: {state_of(about)}, key {key}"
    return [head, *_made_of(comparison, key), *because(comparison, about["step"], key, about)]


def state_of(about: Mapping[str, Any] | None) -> str:
    if about is None:
        return "not stored, so it would run where it is needed"
    made = f"{_date(about)}, computed in {about.get('seconds', 0.0):.3g} s"
    return (
        f"stored since {made}"
        if about.get("kept", True)
        else f"ran {made}, but its value was not kept"
    )


def because(
    comparison: Comparison, label: str, key: Key, about: Mapping[str, Any] | None, maker: str = ""
) -> Iterator[str]:
    """Yield lines with the differences of a result from the most similar earlier result."""
    rows = rows_of(comparison.store, label) or rows_of(comparison.store, maker or label)
    keys = keys_in(rows)
    earlier = keys[: keys.index(key)] if key in keys else keys
    nearest = _nearest(comparison, label, key, earlier)
    if nearest is None:
        yield (
            f"  no earlier result to compare with: {'the first' if key in keys else 'no'} result of"
            " this step"
        )
        return
    old, roots = nearest
    for text in list(roots.found)[:_SHOWN]:
        yield f"  {_chain(roots.chain(text))}: {text}"
    if len(roots.found) > _SHOWN:
        yield f"  and {len(roots.found) - _SHOWN} more"
    which = (
        "the earlier result"
        if len(earlier) == 1
        else f"the nearest of {len(earlier)} earlier results"
    )
    yield f"  compared with {which}, {old[:8]} of {_date(comparison.about(old) or {})}"


def _nearest(
    comparison: Comparison, label: str, key: Key, earlier: list[Key]
) -> tuple[Key, Roots] | None:
    """Return the earlier result with the fewest differences, and these differences; prefer the
    newest result.
    """
    best: tuple[Key, Roots] | None = None
    for old in earlier[: -_CANDIDATES - 1 : -1]:
        if comparison.origin(old) is None:
            continue
        limit = len(best[1].found) - 1 if best else float("inf")
        roots = comparison.roots(Pair(label, key, old), limit)
        best = (old, roots) if roots is not None else best
        if best and (len(best[1].found) <= 1 or len(comparison.seen) > _PAIRS):
            break
    return best


def _made_of(comparison: Comparison, key: Key) -> Iterator[str]:
    """Yield one text line for each part of a cache key: node, parameters, inputs and random
    stream.
    """
    origin = comparison.origin(key)
    if origin is None:
        return
    yield f"  node    {origin['node']}, code {origin['code'][:8]}"
    for name, value in origin["params"].items():
        yield f"  with    {name} = {spoken(value)}"
    for inputs in origin["inputs"]:
        for source in [inputs] if isinstance(inputs, str) else inputs or ():
            yield f"  from    {comparison.step(source) or 'an unknown step'}, {source[:8]}"
    if stream := origin.get("stream"):
        yield f"  noise   seed {stream[0]}, of {stream[1]}, on {stream[2]}"


def _chain(names: list[str]) -> str:
    """Return names of steps as a chain such as ``restored <- raw <- read``, shortened if the
    chain is long.
    """
    if len(names) > _LINKS:
        names = [*names[: _LINKS - 2], f"({len(names) - _LINKS + 1} more)", names[-1]]
    return " <- ".join(names)


def keys_in(rows: Iterable[dict[str, Any]]) -> list[Key]:
    return list(dict.fromkeys(row["key"] for row in rows))


def _date(about: Mapping[str, Any]) -> str:
    return str(about.get("date", "an unknown day"))[:19].replace("T", " ")


def rows_of(store: Store, step: str | None = None) -> list[dict[str, Any]]:
    """Return the lines on one step or on all steps from the journal of a result store, in order
    of time.
    """
    return store.journal.rows() if step is None else store.journal.of_step(step)
