"""Who opens a source file of the user: a message that quotes a line, an import or a compiler, or code that reads it?

The key follows source without its comments, its layout and its docstrings. A warning or a traceback quotes a line for a
reader, and a compiler leaves comments out, so neither makes a result depend on them. Any other reader may.
"""

from __future__ import annotations

import functools
import os
from types import FrameType

from neusee.workflows.observation.covered_paths import is_installed

SOURCES = (".py", ".pyc", ".pyw")
#: modules that quote source in a message, import it, or compile it
_QUIET = (
    *("warnings", "traceback", "logging", "importlib._bootstrap", "importlib._bootstrap_external", "zipimport"),
    *("torch", "numba", "triton", "neusee"),
)


def quotes_source(frame: FrameType | None) -> bool:
    """Return True if the code that opens a source file, down to the code of the user, needs no record."""
    while frame is not None:
        name = str(frame.f_globals.get("__name__", ""))
        if f"{name}.".startswith(_QUIET_STARTS):
            return True
        if _is_own(frame.f_code.co_filename):
            return False
        frame = frame.f_back
    return True


_QUIET_STARTS = tuple(f"{name}." for name in _QUIET)


@functools.lru_cache(1000)
def _is_own(file: str) -> bool:
    """Return True for a file of code that is not installed; code without a file is that of those who call it."""
    return not file.startswith("<") and not is_installed(os.path.realpath(file))
