"""Origin of a stored result, and its differences from the most similar earlier result of its step.

Only the store is read: neither torch nor a recipe is needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from neusee.workflows.explain.change_causes import Comparison, Pair, Roots, spoken
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.store.result_store import Store

_CANDIDATES = 200  #: number of the newest earlier results of a step that are compared
_PAIRS = 20_000  #: number of comparisons after which no further earlier result is examined
_SHOWN_CAUSES = 10  #: greatest number of listed causes
_LINKS = 6  #: greatest number of named steps of a chain


def why_key_lines(store: Store, prefix: str) -> list[str]:
    """Return text lines on the origin of the result whose key begins with ``prefix``, and on its
    differences from earlier results.

    Raises `LookupError` if no key or more than one key begins with ``prefix``.
    """
    keys = sorted(
        dict.fromkeys(row["key"] for row in rows_of(store) if row["key"].startswith(prefix))
    )
    # no key begins with the prefix, or several do
    if len(keys) != 1:
        candidates_text = f"; there are {', '.join(key[:12] for key in keys[:5])}" if keys else ""
        raise LookupError(
            f"{len(keys) or 'no'} results have a key that begins with {prefix!r}{candidates_text}"
        )
    key, metadata = keys[0], store.about(keys[0])
    if metadata is None:
        raise LookupError(f"the result {keys[0]} is no longer in the store")
    comparison = Comparison(store)
    head_line = (
        f"{metadata['step']} of {metadata.get('recipe') or 'a recipe'}: {state_of(metadata)},"
        f" key {key}"
    )
    return [
        head_line,
        *_made_of(comparison, key),
        *because(comparison, metadata["step"], key, metadata),
    ]


def state_of(about: Mapping[str, Any] | None) -> str:
    if about is None:
        return "not stored, so it would run where it is needed"
    when_and_how_long = f"{_date(about)}, computed in {about.get('seconds', 0.0):.3g} s"
    return (
        f"stored since {when_and_how_long}"
        if about.get("kept", True)
        else f"ran {when_and_how_long}, but its value was not kept"
    )


def because(
    comparison: Comparison, label: str, key: Key, about: Mapping[str, Any] | None, maker: str = ""
) -> Iterator[str]:
    """Yield lines with the differences of a result from the most similar earlier result."""
    rows = rows_of(comparison.store, label) or rows_of(comparison.store, maker or label)
    keys = keys_in(rows)
    # earlier results; all results if this one is not stored
    earlier = keys[: keys.index(key)] if key in keys else keys
    key_and_roots = _nearest(comparison, label, key, earlier)
    if key_and_roots is None:
        yield (
            f"  no earlier result to compare with: {'the first' if key in keys else 'no'} result of"
            " this step"
        )
        return
    earlier_key, roots = key_and_roots
    for text in list(roots.found)[:_SHOWN_CAUSES]:
        yield f"  {_chain(roots.chain(text))}: {text}"
    if len(roots.found) > _SHOWN_CAUSES:
        yield f"  and {len(roots.found) - _SHOWN_CAUSES} more"
    compared_text = (
        "the earlier result"
        if len(earlier) == 1
        else f"the nearest of {len(earlier)} earlier results"
    )
    yield (
        f"  compared with {compared_text}, {earlier_key[:8]} of"
        f" {_date(comparison.about(earlier_key) or {})}"
    )


def _nearest(
    comparison: Comparison, label: str, key: Key, earlier: list[Key]
) -> tuple[Key, Roots] | None:
    """Return the earlier result with the fewest differences, and these differences; prefer the
    newest result.
    """
    best_match: tuple[Key, Roots] | None = None
    # the newest first
    for earlier_key in earlier[: -_CANDIDATES - 1 : -1]:
        if comparison.origin(earlier_key) is None:
            continue
        # only results with fewer differences than the best so far matter
        limit = len(best_match[1].found) - 1 if best_match else float("inf")
        roots = comparison.roots(Pair(label, key, earlier_key), limit)
        best_match = (earlier_key, roots) if roots is not None else best_match
        # no result can have fewer than one cause
        if best_match and (len(best_match[1].found) <= 1 or len(comparison.seen) > _PAIRS):
            break
    return best_match


def _made_of(comparison: Comparison, key: Key) -> Iterator[str]:
    """Yield one text line for each part of a cache key: node, parameters, inputs and random
    stream.
    """
    origin = comparison.origin(key)
    if origin is None:
        return
    # keys are shown by their first 8 letters
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
        # the first names, the number of omitted names, and the last name
        names = [*names[: _LINKS - 2], f"({len(names) - _LINKS + 1} more)", names[-1]]
    return " <- ".join(names)


def keys_in(rows: Iterable[dict[str, Any]]) -> list[Key]:
    return list(dict.fromkeys(row["key"] for row in rows))


def _date(about: Mapping[str, Any]) -> str:
    """Return the date and time of a result, without the zone."""
    return str(about.get("date", "an unknown day"))[:19].replace("T", " ")


def rows_of(store: Store, step: str | None = None) -> list[dict[str, Any]]:
    """Return the lines on one step or on all steps from the journal of a result store, in order
    of time.
    """
    return store.journal.rows() if step is None else store.journal.of_step(step)
