"""The sources of chance that a call asks, such as the system, a process or a device."""

from __future__ import annotations

import os
import random
import tempfile
from collections.abc import Callable
from typing import Any

from neusee.workflows.observation.drawn_names import draws_name
from neusee.workflows.observation.python_watch import watch_here


class WatchedChance:
    """The functions through which Python code asks for chance, wrapped while a call is observed.

    The kernel sees most of it too, but not where the library of C draws without a system call.
    """

    def __init__(self) -> None:
        # temporary files have drawn names, which no result has: their generator is made before
        next(tempfile._get_candidate_names())  # type: ignore[attr-defined]
        places: list[tuple[Any, str]] = [(os, "urandom"), (random, "_urandom"), (random.Random, "seed")]
        self._before = [(place, name, getattr(place, name)) for place, name in places if hasattr(place, name)]

    def __enter__(self) -> None:
        for place, name, function in self._before:
            setattr(place, name, _seeding(function) if name == "seed" else _asking(function))

    def __exit__(self, *_: object) -> None:
        for place, name, function in self._before:
            setattr(place, name, function)


def _note(source: str) -> None:
    watch = watch_here()
    if watch is not None and watch.trusted():
        watch.kept.drew = True
    elif watch is not None:
        watch.draws.add(source)


def _asking(function: Callable[[int], bytes]) -> Callable[[int], bytes]:
    def urandom(size: int, /) -> bytes:
        watch = watch_here()
        if watch is None or not draws_name(1):
            _note("os.urandom")
            return function(size)
        before = watch.trust(True)
        try:
            return function(size)
        finally:
            watch.trust(before)

    return urandom


def _seeding(function: Callable[..., None]) -> Callable[..., None]:
    def seed(self: random.Random, a: Any = None, *rest: Any, **named: Any) -> None:
        if a is None:
            _note("random.Random without a seed")
        function(self, a, *rest, **named)

    return seed
