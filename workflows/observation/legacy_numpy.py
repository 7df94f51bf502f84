"""Legacy generators of NumPy: ``RandomState(3)`` asks for chance first, and only then for its seed.

So does all that takes ``random_state=3``. While a call is observed, such a generator says whether a seed followed.
"""

from __future__ import annotations

import abc
import pickle
import sys
from typing import Any

import numpy as np

from neusee.workflows.observation.python_watch import watch_here

_PLACE: Any = np.random.mtrand
_NAME = "_MT19937"  #: what ``RandomState`` begins with; where it is missing, a seeded one counts as chance


class _Replacement(abc.ABCMeta):
    """Class of a class that stands for `MT19937`: a ``RandomState`` asks whether its generator is an instance."""

    def __instancecheck__(cls, instance: object) -> bool:
        return isinstance(instance, np.random.MT19937)


class LegacyGenerator(np.random.MT19937, metaclass=_Replacement):
    """The generator of a ``RandomState`` that an observed call makes."""

    def __init__(self, *seed: Any) -> None:
        """Make the generator; what it takes from the system counts at the end of the call, if no seed followed."""
        self._seeded, self._first = bool(seed), b""
        watch = watch_here()
        if watch is None or seed:
            super().__init__(*seed)
            return
        if watch.trusted():  # an import of a package, which keeps it for itself
            watch.kept.keep(self, str(sys._getframe(1).f_globals.get("__name__")))
        else:
            watch.generators.append(self)
        before = watch.trust(True)
        try:
            super().__init__()
            self._first = pickle.dumps(self.state)
        finally:
            watch.trust(before)

    def _legacy_seeding(self, seed: Any) -> None:
        self._seeded = self._seeded or seed is not None
        super()._legacy_seeding(seed)

    def is_seeded(self) -> bool:
        """Return True if a seed decides what the generator draws."""
        return self._seeded

    def has_drawn_by_chance(self) -> bool:
        """Return True if the generator has drawn without a seed."""
        return not self._seeded and pickle.dumps(self.state) != self._first

    def __reduce__(self) -> Any:
        """Return what a file keeps: the generator of NumPy that this is."""
        made: tuple[Any, ...] = super().__reduce__()
        make, arguments, *rest = made
        return make, tuple(np.random.MT19937 if each is LegacyGenerator else each for each in arguments), *rest


LegacyGenerator.__name__ = np.random.MT19937.__name__  # its state names its class, and a file keeps its state


class WatchedLegacyGenerators:
    """The generator of ``RandomState``, replaced while a call is observed."""

    def __enter__(self) -> None:
        if getattr(_PLACE, _NAME, None) is np.random.MT19937:
            setattr(_PLACE, _NAME, LegacyGenerator)

    def __exit__(self, *_: object) -> None:
        if getattr(_PLACE, _NAME, None) is LegacyGenerator:
            setattr(_PLACE, _NAME, np.random.MT19937)
