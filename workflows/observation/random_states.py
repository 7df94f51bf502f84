"""Generators of the process, before and after a call, and the sources of chance that the call asks meanwhile."""

from __future__ import annotations

import os
import random
import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from neusee.workflows.observation.drawn_names import draws_name
from neusee.workflows.observation.python_watch import watch_here


class RandomStates:
    """States of the generators that all code of a process shares."""

    def __init__(self) -> None:
        self._torch = torch.default_generator.get_state()
        self._cuda = _of_cuda()
        self._numpy = np.random.get_state()
        self._python = random.getstate()

    def changed(self) -> list[str]:
        """Return the names of the generators whose states changed since."""
        numpy: Any = np.random.get_state()
        before: Any = self._numpy
        changes = {
            "torch": not torch.equal(self._torch, torch.default_generator.get_state()),
            "torch.cuda": any(state != self._cuda.get(name, (state[0], 0)) for name, state in _of_cuda().items()),
            "numpy.random": not np.array_equal(before[1], numpy[1]) or before[2:] != numpy[2:],
            "random": self._python != random.getstate(),
        }
        return [name for name, is_changed in changes.items() if is_changed]


def _of_cuda() -> dict[int, tuple[int, int]]:
    """Return seed and count of the draws of each graphics processor in use; a new one has drawn nothing."""
    generators = torch.cuda.default_generators if torch.cuda.is_initialized() else ()  # type: ignore[no-untyped-call]
    return {number: (each.initial_seed(), each.get_offset()) for number, each in enumerate(generators)}


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
