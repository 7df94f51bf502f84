"""Sources of random numbers that an observed call uses: generators of Python, NumPy and torch, and
the system.
"""

from __future__ import annotations

import abc
import os
import pickle
import random
import sys
import tempfile
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch

from neusee.workflows.observation.python_watch import (
    ReplacedFunctions,
    Wrapping,
    watch_here,
    wrapped,
)

# --- drawn names ----------------------------------------------------------------------------------

# Names that libraries draw with ``uuid4`` for internal objects, and that are part of no result.
#
# A library could also draw a seed in this way, or an identifier that it writes into a file. So each
# library is listed here, with the objects that it names, which affect no result.


#: modules, each with the objects that it names
NAMING = {
    "dask": "tasks of a graph, where an object has no token of its own",
    "distributed": "tasks, clients, locks and messages",
    "xarray.backends": "locks, and open files in a cache",
    "fsspec": "temporary files",
    "joblib": "folders of workers, and calls",
    "tempfile": "temporary files",
}
_BETWEEN = ("uuid", "cloudpickle")  #: modules that draw for their caller


def draws_name(depth: int) -> bool:
    """Return True if the function that reads random bytes draws a name; ``depth`` is the number of
    calls between it and this function.
    """
    frame = sys._getframe(depth + 1)
    if _module(frame) != "uuid":
        return False
    # go back to the first caller outside of the modules that draw for others
    while frame.f_back is not None and _module(frame).startswith(_BETWEEN):
        frame = frame.f_back
    return any(f"{_module(frame)}.".startswith(f"{name}.") for name in NAMING)


def _module(frame: object) -> str:
    """Return the name of the module whose code runs in a frame."""
    return str(getattr(frame, "f_globals", {}).get("__name__"))


# --- asked chance ---------------------------------------------------------------------------------

# Sources of random numbers that a call uses, such as the system.


class WatchedChance(ReplacedFunctions):
    """The functions through which Python code reads random bytes or seeds generators, wrapped while
    a call is observed.

    The kernel sees most of it too, except for the C library, which may draw without a system call.
    """

    def __init__(self) -> None:
        # the generator of names of temporary files is made before, since these names are part of no
        # result
        next(tempfile._get_candidate_names())  # type: ignore[attr-defined]
        places: list[Wrapping] = [
            (os, "urandom", _asking),
            (random, "_urandom", _asking),
            (random.Random, "seed", _seeding),
        ]
        super().__init__(wrapped(places))


def _note(source: str) -> None:
    """Note a source of random numbers that the observed call uses. In an import of an installed
    package, only note that it drew.
    """
    watch = watch_here()
    if watch is not None and watch.trusted():
        watch.kept.drew = True
    elif watch is not None:
        watch.draws.add(source)


def _asking(function: Callable[[int], bytes]) -> Callable[[int], bytes]:
    """Return a wrapper of a function that reads random bytes from the system; it notes the use
    unless a name is drawn.
    """

    def urandom(size: int, /) -> bytes:
        watch = watch_here()
        if watch is None or not draws_name(1):
            _note("os.urandom")
            return function(size)
        was_trusted = watch.trust(True)
        try:
            return function(size)
        finally:
            watch.trust(was_trusted)

    return urandom


def _seeding(function: Callable[..., None]) -> Callable[..., None]:
    """Return a wrapper of `random.Random.seed` that notes a call without a seed."""

    def seed(self: random.Random, a: Any = None, *arguments: Any, **named: Any) -> None:
        if a is None:
            _note("random.Random without a seed")
        function(self, a, *arguments, **named)

    return seed


# --- legacy numpy ---------------------------------------------------------------------------------

# Legacy generators of NumPy: ``RandomState(3)`` first reads random bytes, and only then sets its
# seed.
#
# So does every function with an argument ``random_state=3``. While a call is observed, such a
# generator notes whether a seed followed.


_PLACE: Any = np.random.mtrand
#: the class that ``RandomState`` uses first; if it is missing, a seeded generator counts as
#: unseeded too
_NAME = "_MT19937"


class _Replacement(abc.ABCMeta):
    """Metaclass that lets `MT19937` objects pass as instances of the replacement class, which
    ``RandomState`` checks.
    """

    def __instancecheck__(cls, instance: object) -> bool:
        return isinstance(instance, np.random.MT19937)


class LegacyGenerator(np.random.MT19937, metaclass=_Replacement):
    """The bit generator of a ``RandomState`` that an observed call makes."""

    def __init__(self, *seed: Any) -> None:
        """Make the generator. Random bytes from the system count, at the end of the call, only if
        no seed followed.
        """
        self._seeded, self._first = bool(seed), b""
        watch = watch_here()
        if watch is None or seed:
            super().__init__(*seed)
            return
        if watch.trusted():  # in an import of an installed package, which keeps the generator
            watch.kept.keep(self, str(sys._getframe(1).f_globals.get("__name__")))
        else:
            watch.generators.append(self)
        was_trusted = watch.trust(True)
        try:
            super().__init__()
            self._first = pickle.dumps(self.state)
        finally:
            watch.trust(was_trusted)

    def _legacy_seeding(self, seed: Any) -> None:
        """Seed the generator as NumPy does, and note whether there is a seed."""
        self._seeded = self._seeded or seed is not None
        super()._legacy_seeding(seed)

    def is_seeded(self) -> bool:
        """Return True if a seed determines the numbers of the generator."""
        return self._seeded

    def has_drawn_by_chance(self) -> bool:
        """Return True if the generator has drawn numbers without a seed."""
        return not self._seeded and pickle.dumps(self.state) != self._first

    def __reduce__(self) -> Any:
        """Return the pickled form, which names NumPy's own class."""
        parts: tuple[Any, ...] = super().__reduce__()
        function, arguments, *state = parts
        return (
            function,
            tuple(
                np.random.MT19937 if argument is LegacyGenerator else argument
                for argument in arguments
            ),
            *state,
        )


# the state contains the name of the class, and files store the state
LegacyGenerator.__name__ = np.random.MT19937.__name__


class WatchedLegacyGenerators:
    """The generator of ``RandomState``, replaced while a call is observed."""

    def __enter__(self) -> None:
        if getattr(_PLACE, _NAME, None) is np.random.MT19937:
            setattr(_PLACE, _NAME, LegacyGenerator)

    def __exit__(self, *_: object) -> None:
        if getattr(_PLACE, _NAME, None) is LegacyGenerator:
            setattr(_PLACE, _NAME, np.random.MT19937)


# --- shared generators ----------------------------------------------------------------------------

# Generators that all code of a process shares: did an observed call draw from one before it set the
# seed?
#
# ``torch.manual_seed(3)`` and ``np.random.seed(3)`` determine all numbers that follow. A call that
# draws earlier depends on what the process drew before, even if it restores the state at the end,
# as ``torch.random.fork_rng`` does.


_By = Literal["seed", "state", "system"]  #: what determines the numbers that follow
_TORCH: Any = torch.random
#: the attribute that torch's seeding functions use; if it is missing, each draw counts as unseeded
_GENERATOR = "default_generator"


class Shared:
    """One shared generator during an observed call."""

    def __init__(self, state: Callable[[], Any]) -> None:
        """Watch a generator; ``state`` returns its present state."""
        self._state, self._first = state, state()
        #: True if a seed or a state that the call has set determines the next numbers
        self._seeded = False
        self._drew = False

    def drew(self) -> bool:
        """Return True if the call has, up to now, drawn numbers that no seed of its own
        determines.
        """
        self._drew = self._drew or (not self._seeded and _differs(self._state(), self._first))
        return self._drew

    def set(self, change: Callable[[], Any], by: _By) -> Any:
        """Run ``change``, which sets seed or state of the generator, and note whether the next
        numbers are determined by the call.
        """
        # note earlier draws before the change hides them
        self.drew()
        value, state = change(), self._state()
        # changed by a thread outside of the call
        is_disturbed = watch_here() is None and bool(state)
        self._drew = self._drew or by == "system" or is_disturbed
        # a state from before the call determines nothing
        self._seeded = by == "seed" or _differs(state, self._first)
        return value


class SharedGenerators(ReplacedFunctions):
    """The shared generators during an observed call; the functions that set their seeds and states
    are wrapped.
    """

    def __init__(self) -> None:
        self._shared = {
            "torch": Shared(lambda: torch.default_generator.get_state().numpy().tobytes()),
            "torch.cuda": Shared(_of_cuda),
            "numpy.random": Shared(_of_numpy),
            "random": Shared(random.getstate),
        }
        replaced = self._replaced()
        super().__init__([item for item in replaced if hasattr(item[0], item[1])])

    def drawn(self) -> list[str]:
        """Return the names of the generators that drew numbers which no seed of the call
        determines.
        """
        return [name for name, shared in self._shared.items() if shared.drew()]

    def _replaced(self) -> list[tuple[Any, str, Any]]:
        """Return module, name and replacement of each function that sets a seed or a state."""
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
        # each function is an attribute of two modules
        places = (
            (np.random, of_numpy),
            (np.random.mtrand, of_numpy),
            (torch.cuda, of_cuda),
            (torch.cuda.random, of_cuda),
        )
        replacements: list[tuple[Any, str, Any]] = [(_TORCH, _GENERATOR, generator)]
        for holder, functions in places:
            replacements += [(holder, name, function) for name, function in functions.items()]
        return replacements


class _Seeded:
    """The generator of torch in the form that torch's seeding functions use."""

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
    """Return a wrapper of a function that sets a seed or a state. Without a value, or with None,
    the system determines the seed.
    """

    def set_generator(*arguments: Any, **named: Any) -> Any:
        without_value = next(iter((*arguments, *named.values())), None) is None
        determined_by: _By = "system" if without_value else by
        return shared.set(lambda: function(*arguments, **named), determined_by)

    return set_generator


def _differs(state: Any, first: Any) -> bool:
    """Return True if the state of a generator has changed; a graphics processor that came into use
    has drawn nothing yet.
    """
    if isinstance(state, dict):
        # (seed, number of draws): a device without an earlier entry begins with 0 draws
        return any(
            seed_and_count != first.get(number, (seed_and_count[0], 0))
            for number, seed_and_count in state.items()
        )
    return bool(state != first)


def _of_numpy() -> tuple[Any, ...]:
    """Return the state of NumPy's global generator in a form that can be compared."""
    state: Any = np.random.get_state()
    # name, numbers, position, and the spare normal deviate
    return (state[0], state[1].tobytes(), *state[2:])


def _of_cuda() -> dict[int, tuple[int, int]]:
    """Return the seed and the number of draws of each graphics processor in use."""
    generators = torch.cuda.default_generators if torch.cuda.is_initialized() else ()  # type: ignore[no-untyped-call]
    return {
        number: (generator.initial_seed(), generator.get_offset())
        for number, generator in enumerate(generators)
    }
