"""Facts that another moment or machine would change: clocks, addresses, numbers of threads, processors, programs.

The kernel hands most of them out without a call that can be watched, and each library has names of its own for them. So
own code is searched for the last part of a name, whatever library it is of: ``pandas.Timestamp.now`` as well as
``datetime.now``. ``getattr(time, name)`` is no way around it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping

from neusee.workflows.keys.literal_texts import text_of
from neusee.workflows.keys.local_names import dotted
from neusee.workflows.keys.scopes_of_names import last_name
from neusee.workflows.keys.syntax_pass import Kinds, each
from neusee.workflows.keys.unfollowed_constructs import Construct, entry_of

_WHY = "a clock, a process or a machine decides"
_LOOKED_UP = "a name that only a run knows is looked up in a module of Python"
_LAST = frozenset(
    {
        *("now", "utcnow", "today", "formatdate", "default_timer", "Timer", "timeit", "relativeCreated"),
        *("data_ptr", "get_native_id", "native_id", "sched_getaffinity", "process_cpu_count", "getpriority"),
        *("getloadavg", "get_terminal_size", "getswitchinterval", "gettempdir", "gettempdirb"),
        *("isEnabledFor", "getEffectiveLevel", "makeLogRecord"),
    }
)
_FULL = frozenset({"shutil.which", "os.nice", "os.times", "sys.getrefcount", "sys.getsizeof"})
#: modules of Python with such facts
_HOLDING = frozenset(
    {
        *("os", "posix", "nt", "time", "datetime", "sys", "platform", "socket", "threading", "resource", "shutil"),
        *("locale", "random", "uuid", "secrets", "getpass", "gc"),
    }
)
_DATES = frozenset({"datetime64", "Timestamp", "to_datetime", "Time", "DatetimeIndex"})  #: take a text with a date
_PRESENT = frozenset({"now", "today"})  #: such a text


def moments(kinds: Kinds, bound: Mapping[str, str]) -> list[Construct]:
    """Return each use of a fact of the moment; ``bound`` has the full name of each imported name."""
    found = [*_by_name(kinds, bound), *_by_date(kinds), *_looked_up(kinds, bound)]
    return [Construct("state", "", text, why, line) for text, why, line in found]


_Found = Iterator[tuple[str, str, int]]


def _by_name(kinds: Kinds, bound: Mapping[str, str]) -> _Found:
    for item in each(kinds, ast.Attribute, ast.Name):
        if isinstance(item.ctx, ast.Load) and (isinstance(item, ast.Attribute) or item.id in bound):
            full = dotted(item, bound) or last_name(item)
            if full.rpartition(".")[2] in _LAST or full in _FULL:
                yield full, _WHY, item.lineno


def _by_date(kinds: Kinds) -> _Found:
    """Yield ``np.datetime64("now")`` and the like."""
    for call in each(kinds, ast.Call):
        if last_name(call.func) in _DATES and any(text_of(argument) in _PRESENT for argument in call.args):
            yield ast.unparse(call)[:60], _WHY, call.lineno


def _looked_up(kinds: Kinds, bound: Mapping[str, str]) -> _Found:
    """Yield ``getattr(os, name)``, and ``getattr(os, "envi" + "ron")`` with the reason why that is refused."""
    for call in each(kinds, ast.Call):
        if last_name(call.func) != "getattr" or len(call.args) < 2:
            continue
        base, name = dotted(call.args[0], bound), text_of(call.args[1])
        if base.partition(".")[0] not in _HOLDING:
            continue
        known = entry_of(f"{base}.{name}") if name else ("state", _LOOKED_UP)
        if known or name in _LAST:
            yield ast.unparse(call)[:60], known[1] if known else _WHY, call.lineno
