"""What a node says that it makes of a number that is none, where its result cannot show it: words of its docstring.

What the docstring no longer states is not stated.
"""

from __future__ import annotations

from neusee.nodes import Node

_STATED = {
    ("restore.clipped", "NaN"): "so is what is not a number",
    ("metrics.saturated", "NaN"): "so does one that is not a number",
}


def stated_of(node: Node, case: str) -> str | None:
    """What a node says that it makes of a number that is none, where its result cannot show it."""
    words = _STATED.get((node.path, case))
    return words if words is not None and _says(node, words) else None


def _says(node: Node, words: str) -> bool:
    return words in " ".join((node.__doc__ or "").split())
