"""Names that libraries draw by ``uuid4`` for things of their own, and that no result has.

A library may as well draw a seed in this way, or an identifier that it writes into a file. So each is listed here,
with the reason why its names decide nothing.
"""

from __future__ import annotations

import sys

#: modules, with what they name
NAMING = {
    "dask": "tasks of a graph, where an object has no token of its own",
    "distributed": "tasks, clients, locks and messages",
    "xarray.backends": "locks, and open files in a cache",
    "fsspec": "temporary files",
    "joblib": "folders of workers, and calls",
    "tempfile": "temporary files",
}
_BETWEEN = ("uuid", "cloudpickle")  #: modules that draw for the one that calls them


def draws_name(depth: int) -> bool:
    """Return True if the function that asks for chance draws a name; ``depth`` counts the calls up to it."""
    frame = sys._getframe(depth + 1)
    if _module(frame) != "uuid":
        return False
    while frame.f_back is not None and _module(frame).startswith(_BETWEEN):
        frame = frame.f_back
    return any(f"{_module(frame)}.".startswith(f"{name}.") for name in NAMING)


def _module(frame: object) -> str:
    return str(getattr(frame, "f_globals", {}).get("__name__"))
