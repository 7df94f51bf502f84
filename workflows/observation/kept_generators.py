"""Generators that installed packages make for themselves when they are imported.

No result depends on an import that makes one. A step that draws from one later depends on chance, or on the steps that
drew before it.
"""

from __future__ import annotations

import pickle
import random
import sys
from typing import Any

import numpy as np

from neusee.workflows.observation.covered_paths import is_installed

_kept: dict[int, tuple[str, Any]] = {}  #: module and generator, by id


class KeptGenerators:
    """The generators that packages keep, with their states before an observed call, or after their import in it."""

    def __init__(self) -> None:
        self.drew = False  #: an installed package has asked for chance when it was imported
        self._modules = set(sys.modules)
        self._states = {number: _state(generator) for number, (_, generator) in _kept.items()}
        self._drawn: list[str] = []  #: modules with a generator that drew while they were imported

    def keep(self, generator: Any, module: str) -> None:
        """Remember the bits of NumPy, or a generator of Python, that a module of an installed package makes."""
        _kept[id(generator)] = module, generator

    def note(self) -> None:
        """Take note of the states of what packages have made, at the end of an import."""
        if self.drew:
            self.drew = False
            self._keep_of_modules()
        for number in _kept.keys() - self._states.keys():
            module, generator = _kept[number]
            self._states[number] = _state(generator)
            if getattr(generator, "has_drawn_by_chance", bool)():
                self._drawn.append(module)

    def changed(self) -> list[str]:
        """Return what has drawn since."""
        drawn = [_kept[number][0] for number, state in self._states.items() if _state(_kept[number][1]) != state]
        return [f"a generator that {module} keeps" for module in dict.fromkeys([*self._drawn, *drawn])]

    def _keep_of_modules(self) -> None:
        """Remember the generators that stand in modules of installed packages that were not loaded before."""
        for name, module in sys.modules.copy().items():
            values = getattr(module, "__dict__", {})
            if name not in self._modules and is_installed(str(values.get("__file__"))):
                for value in values.copy().values():
                    if type(value) in (np.random.Generator, np.random.RandomState):
                        self.keep(value._bit_generator, name)
                    elif type(value) is random.Random:
                        self.keep(value, name)


def _state(generator: Any) -> bytes:
    return pickle.dumps(generator.getstate() if isinstance(generator, random.Random) else generator.state)
