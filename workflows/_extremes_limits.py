"""Where a node says that it is less accurate: the bound and its own words, which must stand in its docstring."""

from __future__ import annotations

from neusee.nodes import Node

_LIMITS: dict[tuple[str, str], tuple[float, str]] = {}


def limit_of(node: Node, case: str) -> tuple[float, str] | None:
    """The bound of a node in a case and the words that state it; None where it states none."""
    found = _LIMITS.get((node.path, case))
    if found is None or " ".join(found[1].split()) not in " ".join((node.__doc__ or "").split()):
        return None
    return found
