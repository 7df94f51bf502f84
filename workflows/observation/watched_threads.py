"""Threads that an observed call starts: their calls are the call's, and those of other threads are not."""

from __future__ import annotations

import _thread
import threading
from collections.abc import Callable
from typing import Any

from neusee.workflows.observation.python_watch import watch_here
from neusee.workflows.observation.recorded_call import Record


class WatchedThreads:
    """The two functions that start a thread, wrapped while a call is observed; audit events tell from Python 3.12."""

    def __init__(self) -> None:
        places: list[tuple[Any, str]] = [(threading.Thread, "start"), (_thread, "start_new_thread")]
        self._before = [(place, name, getattr(place, name)) for place, name in places]

    def __enter__(self) -> None:
        for place, name, function in self._before:
            setattr(place, name, _starting(function) if place is threading.Thread else _starting_nameless(function))

    def __exit__(self, *_: object) -> None:
        for place, name, function in self._before:
            setattr(place, name, function)


def _starting(function: Callable[[threading.Thread], None]) -> Callable[[threading.Thread], None]:
    def start(self: threading.Thread) -> None:
        if (watch := watch_here()) is not None:
            watch.add(self)
        function(self)

    return start


def _starting_nameless(function: Callable[..., int]) -> Callable[..., int]:
    def start_new_thread(*arguments: Any) -> int:
        watch = watch_here()
        if watch is not None and not watch.kernel:  # nobody knows whose calls are its
            watch.records.append(Record("unseen", "a thread that _thread started"))
        return function(*arguments)

    return start_new_thread
