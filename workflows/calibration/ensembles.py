"""Ensembles of walkers that advance together, so that one call evaluates the proposals of all ensembles.

Each ensemble has emcee's moves and its own random stream. The draws are exactly those of emcee's `EnsembleSampler`,
which evaluates one ensemble after another in a loop over walkers. A likelihood of few numbers takes as long for one
ensemble as for four, and less time than the loop of emcee.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import emcee
import numpy as np

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

Weigh = Callable[["FloatArray"], "FloatArray"]  #: returns the log density (walker,) at (walker, free), never NaN


class Walk:
    """An ensemble of walkers, with the draws, the move and the random stream of the ensemble."""

    def __init__(
        self, backend: Any, move: Any, random: np.random.RandomState, initial_theta: FloatArray | None
    ) -> None:
        self.backend = backend  #: emcee's backend in memory, with all steps so far
        self.move, self.random = move, random
        self.initial_theta = initial_theta  #: (walker, free) before the first step; None after it

    @property
    def iteration(self) -> int:
        """Return the number of steps that the walkers have made."""
        return int(self.backend.iteration)

    def prepare(self, steps: int, weigh: Weigh) -> None:
        """Reserve memory for ``steps`` more steps of the walkers, and load their state after the last step."""
        if self.initial_theta is not None and self.iteration == 0:
            self._state = emcee.State(self.initial_theta.copy(), log_prob=weigh(self.initial_theta))
        else:
            self._state = emcee.State(self.backend.get_last_sample(), copy=True)
        self.backend.grow(steps, None)

    def begin_step(self) -> None:
        """Split the walkers into parts for one step; the proposals for each part depend on the other parts."""
        self.random.random_sample()  # emcee draws one of several moves with this number
        self.move.setup(self._state.coords)
        self._part = np.arange(len(self._state.coords)) % self.move.nsplits
        if self.move.randomize_split:
            self.random.shuffle(self._part)
        self._accepted = np.zeros(len(self._part), dtype=bool)

    def propose(self, part: int) -> FloatArray:
        """Return the proposed coordinates (walker, free parameter) for one part of the walkers."""
        sets = [self._state.coords[self._part == other] for other in range(self.move.nsplits)]
        others = sets[:part] + sets[part + 1 :]
        self._proposed, self._factors = self.move.get_proposal(sets[part], others, self.random)
        proposed: FloatArray = self._proposed
        return proposed

    def decide(self, part: int, log: FloatArray) -> None:
        """Accept or reject the proposed coordinates of one part of the walkers."""
        own = np.flatnonzero(self._part == part)
        gain = self._factors + log - self._state.log_prob[own]
        accepted = gain > np.log(self.random.rand(len(own)))
        at = own[accepted]
        self._state.coords[at], self._state.log_prob[at] = self._proposed[accepted], log[accepted]
        self._accepted[at] = True

    def end_step(self) -> None:
        """Add the walkers' coordinates after this step to the draws."""
        self.backend.save_step(self._state, self._accepted)

    def rest(self) -> None:
        """Store the state of the random stream, so that a later run can continue from this state."""
        self.backend.random_state = self.random.get_state()


def walk_until(walks: Sequence[Walk], steps: int, weigh: Weigh) -> None:
    """Advance the ensembles until each has ``steps`` steps; ensembles with the fewest steps go first."""
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
