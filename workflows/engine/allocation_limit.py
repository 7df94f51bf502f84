"""A hard limit for own nodes: the system refuses an allocation that would take the process far above its limit.

The watch over the memory stops a step between two calls of libraries. One call of an own node may allocate all at once,
and nothing foretells it. While such a node computes on the CPU, the system therefore refuses private memory beyond
`SLACK` times the limit of the run, also in libraries and threads that the node begins. Python and torch turn this into
an error, and the error into a sentence.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from neusee.workflows.engine.memory_use import process_memory, resident
from neusee.workflows.engine.memory_watch import MemoryLimit, limit_now
from neusee.workflows.store.byte_sizes import format_size

SLACK = 1.2  #: share of the limit from which allocations are refused; the rest to 1.3 is for what is mapped already
_WORDS = ("can't allocate memory", "cannot allocate memory", "std::bad_alloc", "not enough memory")


@contextmanager
def refusing_allocations(active: bool) -> Iterator[None]:
    """Let the system refuse allocations beyond the limit of the run in the ``with`` block, if ``active``.

    Raises `MemoryLimit` in the place of the error that such an allocation gives.
    """
    limit, mapped = limit_now(), resident("VmData:")
    if not active or limit is None or mapped is None:
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_DATA)
    allowed = int(mapped + max(0.0, SLACK * limit - process_memory()))
    if before[0] != resource.RLIM_INFINITY and before[0] <= allowed:  # of the user, or of an own node beside this one
        yield
        return
    resource.setrlimit(resource.RLIMIT_DATA, (allowed, before[1]))
    try:
        yield
    except Exception as error:
        if not _is_refused(getattr(error, "cause", error)):
            raise
        text = f"an allocation beside the {format_size(process_memory())} that the process holds was refused"
        raise MemoryLimit(f"{text}, the limit is {format_size(int(limit))}") from error
    finally:
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_DATA, before)


def _is_refused(error: BaseException) -> bool:
    """Return True for the error of an allocation that the system refused."""
    return isinstance(error, MemoryError) or any(word in str(error).lower() for word in _WORDS)
