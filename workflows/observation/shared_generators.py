"""Generators that all code of a process shares: did an observed call draw from one before it had set the seed?

``torch.manual_seed(3)`` and ``np.random.seed(3)`` determine all numbers that follow. A call that draws before it
depends on what the process drew earlier, also if it puts the state back at the end, as ``torch.random.fork_rng`` does.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch

from neusee.workflows.observation.python_watch import watch_here

_By = Literal["seed", "state", "system"]  #: what determines the numbers that follow
_TORCH: Any = torch.random
_GENERATOR = "default_generator"  #: what the functions of torch for seeds ask; where it is missing, each draw counts


class Shared:
    """One shared generator during an observed call."""

    def __init__(self, state: Callable[[], Any]) -> None:
        """Watch a generator; ``state`` returns its state, which is the first one now."""
        self._state, self._first = state, state()
        self._seeded = False  #: what it draws now is determined by a seed, or by a state, that the call has set
        self._drew = False

    def drew(self) -> bool:
        """Return True if the call drew, up to now, what no seed of its own decides."""
        self._drew = self._drew or (not self._seeded and _differs(self._state(), self._first))
        return self._drew

    def set(self, change: Callable[[], Any], by: _By) -> Any:
        """Let a call set the generator; the state that it had at the beginning determines nothing."""
        self.drew()
        value, state = change(), self._state()
        disturbed = watch_here() is None and bool(state)  # by a thread that is not of the call
        self._drew = self._drew or by == "system" or disturbed
        self._seeded = by == "seed" or _differs(state, self._first)
        return value


class SharedGenerators:
    """The shared generators during an observed call, with the functions that set their seeds and states wrapped."""

    def __init__(self) -> None:
        self._shared = {
            "torch": Shared(lambda: torch.default_generator.get_state().numpy().tobytes()),
            "torch.cuda": Shared(_of_cuda),
            "numpy.random": Shared(_of_numpy),
            "random": Shared(random.getstate),
        }
        replaced = [each for each in self._replaced() if hasattr(each[0], each[1])]
        self._after = replaced
        self._before = [(place, name, getattr(place, name)) for place, name, _ in replaced]

    def __enter__(self) -> SharedGenerators:
        for place, name, function in self._after:
            setattr(place, name, function)
        return self

    def __exit__(self, *_: object) -> None:
        for place, name, function in self._before:
            setattr(place, name, function)

    def drawn(self) -> list[str]:
        """Return the names of the generators that drew what no seed decides."""
        return [name for name, shared in self._shared.items() if shared.drew()]

    def _replaced(self) -> list[tuple[Any, str, Any]]:
        """Return places, names, and what stands there during the call."""
        cuda, numpy = self._shared["torch.cuda"], self._shared["numpy.random"]
        generator = _Seeded(getattr(_TORCH, _GENERATOR, None), self._shared["torch"])
        of_numpy = {
            "seed": _setting(np.random.seed, numpy, "seed"),
            "set_state": _setting(np.random.set_state, numpy, "state"),
        }
        of_cuda = {
            "manual_seed_all": _setting(torch.cuda.manual_seed_all, cuda, "seed"),
            "set_rng_state": _setting(torch.cuda.set_rng_state, cuda, "state"),
        }
        places = (
            (np.random, of_numpy),
            (np.random.mtrand, of_numpy),
            (torch.cuda, of_cuda),
            (torch.cuda.random, of_cuda),
        )
        wrapped = [(place, name, function) for place, functions in places for name, function in functions.items()]
        return [(_TORCH, _GENERATOR, generator), *wrapped]


class _Seeded:
    """The generator of torch, as the functions that set its seed see it."""

    def __init__(self, generator: Any, shared: Shared) -> None:
        self._generator, self._shared = generator, shared

    def manual_seed(self, seed: int) -> Any:
        return self._shared.set(lambda: self._generator.manual_seed(seed), "seed")

    def set_state(self, state: Any) -> Any:
        return self._shared.set(lambda: self._generator.set_state(state), "state")

    def seed(self) -> Any:
        return self._shared.set(self._generator.seed, "system")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._generator, name)


def _setting(function: Callable[..., Any], shared: Shared, by: _By) -> Callable[..., Any]:
    """Return a function that sets a seed or a state, wrapped; without a value, or with None, the system gives it."""

    def set_generator(*given: Any, **named: Any) -> Any:
        without = next(iter((*given, *named.values())), None) is None
        return shared.set(lambda: function(*given, **named), "system" if without else by)

    return set_generator


def _differs(state: Any, first: Any) -> bool:
    """Return True if a generator has another state; a graphics processor that came into use has drawn nothing yet."""
    if isinstance(state, dict):
        return any(found != first.get(number, (found[0], 0)) for number, found in state.items())
    return bool(state != first)


def _of_numpy() -> tuple[Any, ...]:
    state: Any = np.random.get_state()
    return (state[0], state[1].tobytes(), *state[2:])


def _of_cuda() -> dict[int, tuple[int, int]]:
    """Return seed and count of the draws of each graphics processor in use."""
    generators = torch.cuda.default_generators if torch.cuda.is_initialized() else ()  # type: ignore[no-untyped-call]
    return {number: (each.initial_seed(), each.get_offset()) for number, each in enumerate(generators)}
