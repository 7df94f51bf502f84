"""Where a node says that it is less accurate, or what it makes of a number that is none: words of its docstring.

A limit that the docstring no longer states is none.
"""

from __future__ import annotations

from neusee.nodes import Node

_LIMITS: dict[tuple[str, str], tuple[float, str]] = {}
_STATED = {
    ("restore.clipped", "NaN"): "so is what is not a number",
    ("metrics.saturated", "NaN"): "so does one that is not a number",
}


def limit_of(node: Node, case: str) -> tuple[float, str] | None:
    """The bound of a node in a case and the words that state it; None where it states none."""
    found = _LIMITS.get((node.path, case))
    return found if found is not None and _says(node, found[1]) else None


def stated_of(node: Node, case: str) -> str | None:
    """What a node says that it makes of a number that is none, where its result cannot show it."""
    words = _STATED.get((node.path, case))
    return words if words is not None and _says(node, words) else None


def _says(node: Node, words: str) -> bool:
    return words in " ".join((node.__doc__ or "").split())
