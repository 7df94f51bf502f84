"""Ensembles that walk in step: each by emcee's moves and its own random stream, and all weighed in one call.

It is draw for draw the walk of emcee's `EnsembleSampler`, which weighs an ensemble by itself and looks at its walkers
one by one: a likelihood of few numbers takes as long for one ensemble as for four, and less than that loop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import emcee
import numpy as np

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import Places

Weigh = Callable[["Places"], "Places"]  #: of (walker, free) the log density of each, never not a number


class Walk:
    """One ensemble."""

    def __init__(self, backend: Any, move: Any, random: np.random.RandomState, begin: Places | None) -> None:
        self.backend = backend  #: emcee's, in memory: all steps that were walked
        self.move, self.random = move, random
        self.begin = begin  #: (walker, free) before the first step; None where there were some

    @property
    def iteration(self) -> int:
        """Steps that were walked."""
        return int(self.backend.iteration)

    def prepare(self, steps: int, weigh: Weigh) -> None:
        """Make room for so many steps more, and stand where the last one ended."""
        if self.begin is not None and self.iteration == 0:
            self._state = emcee.State(self.begin.copy(), log_prob=weigh(self.begin))
        else:
            self._state = emcee.State(self.backend.get_last_sample(), copy=True)
        self.backend.grow(steps, None)

    def begin_step(self) -> None:
        """Split the walkers: each part is proposed places from the others."""
        self.random.random_sample()  # by which emcee draws one of several moves
        self.move.setup(self._state.coords)
        self._part = np.arange(len(self._state.coords)) % self.move.nsplits
        if self.move.randomize_split:
            self.random.shuffle(self._part)
        self._accepted = np.zeros(len(self._part), dtype=bool)

    def propose(self, part: int) -> Places:
        """(walker, free) where those of one part may go."""
        sets = [self._state.coords[self._part == other] for other in range(self.move.nsplits)]
        others = sets[:part] + sets[part + 1 :]
        self._places, self._factors = self.move.get_proposal(sets[part], others, self.random)
        found: Places = self._places
        return found

    def decide(self, part: int, log: Places) -> None:
        """Go there, or stay."""
        own = np.flatnonzero(self._part == part)
        gain = self._factors + log - self._state.log_prob[own]
        goes = gain > np.log(self.random.rand(len(own)))
        at = own[goes]
        self._state.coords[at], self._state.log_prob[at] = self._places[goes], log[goes]
        self._accepted[at] = True

    def end_step(self) -> None:
        """Keep it."""
        self.backend.save_step(self._state, self._accepted)

    def rest(self) -> None:
        """Keep where the stream stands, which only what goes on asks for."""
        self.backend.random_state = self.random.get_state()


def go_on(walks: Sequence[Walk], steps: int, weigh: Weigh) -> None:
    """Walk by one move until so many steps are there, those that are behind first."""
    while (now := min(walk.iteration for walk in walks)) < steps:
        behind = [walk for walk in walks if walk.iteration == now]
        until = min([steps, *(walk.iteration for walk in walks if walk.iteration > now)])
        _together(behind, until - now, weigh)


def _together(walks: Sequence[Walk], steps: int, weigh: Weigh) -> None:
    for walk in walks:
        walk.prepare(steps, weigh)
    for _ in range(steps):
        for walk in walks:
            walk.begin_step()
        for part in range(walks[0].move.nsplits):
            log = weigh(np.concatenate([walk.propose(part) for walk in walks]))
            for walk, own in zip(walks, np.split(log, len(walks)), strict=True):
                walk.decide(part, own)
        for walk in walks:
            walk.end_step()
    for walk in walks:
        walk.rest()
