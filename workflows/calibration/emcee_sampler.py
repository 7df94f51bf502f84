"""Draw from the posterior of a sensor with emcee: four ensembles, which end when they are long and agree.

This and `_calibrate_walk` are the only rooms that know emcee. Draws are kept as emcee keeps them, in HDF5, and written
whole after each round, so that a killed run goes on from the last round, to the last bit as if it had never stopped.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import emcee
import numpy as np

from neusee.workflows.calibration.ensembles import Walk, go_on
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import LaplaceFit

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import Places

ENSEMBLES = 4
STRANDED = 20.0  #: nats by which a stranded walker's median lies under that of all
_FIRST, _GROWTH, _LONGEST = 250, 1.25, 32_000  #: steps of the first round; more by round; when a chain is given up
_TAUS, _SURELY, _CHANGE = 50.0, 100.0, 0.01  #: autocorrelation times, so many that a change counts no more, of tau
_BESIDE = 5.0  #: nats a parameter, by which no draw from the normal law lies below its peak
_BURN = 10.0  #: autocorrelation times that are thrown away
_MOVES = {"de": emcee.moves.DEMove, "stretch": emcee.moves.StretchMove}

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Chains:
    """All that was drawn."""

    draws: Places  #: (ensemble, step, walker, free) coordinates, without what was thrown away
    log: Places  #: (ensemble, step, walker)
    accepted: float  #: share of the moves
    tau: float  #: steps, the longest autocorrelation time of any coordinate
    steps: int  #: with those thrown away
    long: bool  #: the rule was met

    @property
    def flat(self) -> Places:
        """(draw, free) of all ensembles."""
        return self.draws.reshape(-1, self.draws.shape[-1])


def move(name: str) -> Any:
    """The way walkers move: `de` or `stretch`; raises ValueError for any other, and says why for the snooker."""
    if name in _MOVES:
        return _MOVES[name]()
    if "snooker" in name.lower():
        raise ValueError(
            "DESnookerMove of emcee up to 3.1.6 draws from a law that is 18 % too narrow (emcee's pull request 531 "
            "mends it): take de or stretch"
        )
    raise ValueError(f"no move {name!r}: de or stretch")


def sample(
    problem: SensorPosterior,
    peak: LaplaceFit,
    file: Path,
    *,
    seed: int,
    walkers: int = 64,
    how: str = "de",
    wanted: int = 1000,
    progress: Progress = lambda line: None,
) -> Chains:
    """Draw until every chain is 50 autocorrelation times long and ``wanted`` draws are worth as many independent ones.

    ``file`` keeps what was drawn, and is gone on with where it exists.
    """
    moves, runs = move(how), []
    for index in range(ENSEMBLES):
        runs.append(_begun(problem, peak, file, index, seed, walkers, moves))
    before, steps = _round(min(run.iteration for run in runs))
    tau_before = max(_tau(run.backend.get_chain()[:before]) for run in runs) if before else np.inf
    while True:
        go_on(runs, steps, problem.log_posterior)
        _keep(file, [run.backend for run in runs], progress)
        tau = max(_tau(run.backend.get_chain()) for run in runs)
        change = abs(tau - tau_before) / tau
        long = steps >= (_TAUS + _BURN) * tau and (change < _CHANGE or steps >= (_SURELY + _BURN) * tau)
        found = _gathered(runs, tau, steps, long)
        worth = found.flat.shape[0] / tau
        progress(
            f"{steps} steps of {ENSEMBLES} x {walkers} walkers: tau {tau:.1f}, worth {worth:.0f} independent draws"
        )
        if (long and worth >= wanted) or steps >= _LONGEST:
            return found
        tau_before, steps = tau, int(_GROWTH * steps)


def _round(iteration: int) -> tuple[int, int]:
    """The round that so many steps are the end of, and the one before it: what was stopped ends as if it never was."""
    before, steps = 0, _FIRST
    while steps < iteration:
        before, steps = steps, int(_GROWTH * steps)
    return before, steps


def _begun(
    problem: SensorPosterior, peak: LaplaceFit, file: Path, index: int, seed: int, walkers: int, moves: Any
) -> Walk:
    """An ensemble that starts from the normal law about the peak, or where it stopped."""
    dimensions = len(problem.names)
    backend = _read(file, index)
    if backend is not None and backend.shape == (walkers, dimensions):
        random = np.random.RandomState()
        random.set_state(backend.random_state)
        return Walk(backend, moves, random, None)
    rng = np.random.default_rng([seed, index])
    random = np.random.RandomState(rng.integers(1 << 32, size=8, dtype=np.uint32))
    backend = emcee.backends.Backend()
    backend.reset(walkers, dimensions)
    return Walk(backend, moves, random, _alive(problem, peak, walkers, rng))


def _alive(problem: SensorPosterior, peak: LaplaceFit, walkers: int, rng: np.random.Generator) -> Places:
    """Starting places that the posterior knows: beside the number of a full well there is none, or next to none."""
    found = np.empty((0, len(peak.place)))
    for _ in range(50):
        drawn = peak.draw(4 * walkers, rng)
        likely = problem.log_posterior(drawn) > peak.log - _BESIDE * (1 + len(peak.place))
        found = np.concatenate([found, drawn[likely]])
        if len(found) >= walkers:
            return found[:walkers]
    raise ValueError("the normal law about the best place hardly touches the posterior: it cannot be a start")


def _tau(chain: Places) -> float:
    with np.errstate(invalid="ignore"):
        found = float(np.max(emcee.autocorr.integrated_time(chain, tol=0, has_walkers=True)))
    return found if np.isfinite(found) else float(len(chain))  # of walkers that never moved


def stranded(log: Places) -> int:
    """Walkers of (..., step, walker) that stay where there is hardly any posterior, and that no other one fetches."""
    middle = np.median(log, -2)
    return int((middle < np.median(middle) - STRANDED).sum())


def _gathered(runs: Sequence[Walk], tau: float, steps: int, long: bool) -> Chains:
    burn = min(int(_BURN * tau) + 1, steps // 2)
    draws = np.stack([run.backend.get_chain(discard=burn) for run in runs])
    log = np.stack([run.backend.get_log_prob(discard=burn) for run in runs])
    accepted = float(np.mean([run.backend.accepted / run.iteration for run in runs]))
    return Chains(draws, log, accepted, tau, steps, long)


def _read(file: Path, index: int) -> Any:
    """What was drawn of an ensemble, in memory; None where there is nothing that can be read."""
    if not file.is_file():
        return None
    try:
        kept = emcee.backends.HDFBackend(str(file), name=f"ensemble{index}", read_only=True)
        memory = emcee.backends.Backend()
        memory.reset(*kept.shape)
        memory.chain, memory.log_prob = kept.get_chain(), kept.get_log_prob()
        memory.accepted, memory.iteration = kept.accepted, kept.iteration
        memory.random_state = kept.random_state
    except (OSError, KeyError, AttributeError):
        return None
    return memory


def _keep(file: Path, backends: Sequence[Any], progress: Progress) -> None:
    """Write what was drawn; where that cannot be, as on a full disk, it is said, and drawing goes on."""
    try:
        _write(file, backends)
    except (OSError, RuntimeError) as error:  # h5py raises both
        progress(f"not kept, a stop would lose these draws: {error}")


def _write(file: Path, backends: Sequence[Any]) -> None:
    """All ensembles in one file that is complete when it gets its name."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(f".{os.getpid()}.part")
    try:
        for index, memory in enumerate(backends):
            kept = emcee.backends.HDFBackend(str(part), name=f"ensemble{index}")
            kept.reset(*memory.shape)
            kept.grow(memory.iteration, None)
            with kept.open("a") as opened:
                group = opened[kept.name]
                group["chain"][...], group["log_prob"][...] = memory.chain, memory.log_prob
                group["accepted"][...] = memory.accepted
                group.attrs["iteration"] = memory.iteration
                for i, value in enumerate(memory.random_state):
                    group.attrs[f"random_state_{i}"] = value
        with open(part, "rb") as written:
            os.fsync(written.fileno())
        os.replace(part, file)
    finally:
        part.unlink(missing_ok=True)
