"""Table of renamed recipe keys, nodes and parameters, with which messages give the new name for
an old one.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from importlib import resources
from itertools import product

_TABLE = tomllib.loads(
    resources.files(__package__).joinpath("renamed_keys.toml").read_text(encoding="utf-8")
)
_CALLED: dict[str, str] = _TABLE["called"]
_GRID, _ON_A_GRID = _TABLE["pupil_grid"]["parameters"], _TABLE["pupil_grid"]["nodes"]
_REMOVED: dict[str, str] = {
    **dict.fromkeys(
        (f"{node}.{name}" for node, name in product(_ON_A_GRID, _GRID)),
        _TABLE["pupil_grid"]["instead"],
    ),
    **_TABLE["removed"],
}
#: present name by that of version 0.1, of a parameter
POSTERIOR_NAMES: dict[str, str] = _TABLE["posterior"]


def new_name(old: str) -> str | None:
    """Return the present name of an old recipe path, or None for a path that was never renamed."""
    keys = old.split(".")
    for length in range(len(keys), 0, -1):
        if present_name := _CALLED.get(".".join(keys[:length])):
            return ".".join([present_name, *keys[length:]])
    return None


def instead(old: str) -> str:
    """Return a message that says what to write instead of an old recipe path, or an empty text
    for any other path.
    """
    if present_name := new_name(old):
        return f"is called {present_name} now"
    return _REMOVED.get(old, "")


def became_input(node: str, parameters: Iterable[str]) -> bool:
    """Return True if a node's ``parameters`` contain those of the pupil grid, which is now an
    input of the node.
    """
    return node in _ON_A_GRID and not set(_GRID).isdisjoint(parameters)


def old_names() -> tuple[str, ...]:
    """Return the old names of all renamed or removed recipe keys, nodes and parameters."""
    return (*_CALLED, *_REMOVED)
