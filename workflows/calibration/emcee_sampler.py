"""Draws from the posterior of a sensor with emcee: four ensembles, which end when they are long and agree.

This file and `ensembles` are the only ones that import emcee. Draws are kept in emcee's HDF5 format and written whole
after each round. A killed run goes on from the last round, to the last bit as if it had never stopped.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import emcee
import numpy as np

from neusee.workflows.calibration.ensembles import Walk, walk_until
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import LaplaceFit

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

ENSEMBLES = 4
STRANDED = 20.0  #: nats by which the median of a stranded walker lies below that of all walkers
_FIRST, _GROWTH, _LONGEST = 250, 1.25, 32_000  #: steps of the first round; growth by round; most steps
_TAUS, _SURELY, _CHANGE = (
    50.0,
    100.0,
    0.01,
)  #: least length in tau; length from which a change of tau counts no more; most change
_BESIDE = 5.0  #: nats for each parameter by which a starting point may lie below the mode
_BURN = 10.0  #: autocorrelation times that are discarded
_MOVES = {"de": emcee.moves.DEMove, "stretch": emcee.moves.StretchMove}

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Chains:
    """The draws of all ensembles."""

    draws: FloatArray  #: (ensemble, step, walker, free) coordinates, without the discarded steps
    log: FloatArray  #: (ensemble, step, walker)
    accepted: float  #: share of the moves
    tau: float  #: steps, the longest autocorrelation time of any coordinate
    steps: int  #: the discarded ones included
    long: bool  #: whether the chains are long enough

    @property
    def flat(self) -> FloatArray:
        """Return the draws (draw, free) of all ensembles."""
        return self.draws.reshape(-1, self.draws.shape[-1])


def move(name: str) -> Any:
    """Return the move of walkers, `de` or `stretch`; raise `ValueError` for any other, and explain the snooker."""
    if name in _MOVES:
        return _MOVES[name]()
    if "snooker" in name.lower():
        raise ValueError(
            "DESnookerMove of emcee up to 3.1.6 draws from a distribution that is 18 % too narrow (emcee's pull "
            "request 531 corrects it): use de or stretch"
        )
    raise ValueError(f"no move {name!r}: de or stretch")


def sample(
    problem: SensorPosterior,
    mode: LaplaceFit,
    file: Path,
    *,
    seed: int,
    walkers: int = 64,
    how: str = "de",
    wanted: int = 1000,
    progress: Progress = lambda line: None,
) -> Chains:
    """Draw until every chain is 50 autocorrelation times long and the effective sample size is ``wanted``.

    ``file`` keeps the draws; where it exists, the chains continue from it.
    """
    moves, runs = move(how), []
    for index in range(ENSEMBLES):
        runs.append(start_ensemble(problem, mode, file, index, seed, walkers, moves))
    before, steps = _round(min(run.iteration for run in runs))
    tau_before = max(autocorrelation_time(run.backend.get_chain()[:before]) for run in runs) if before else np.inf
    while True:
        walk_until(runs, steps, problem.log_posterior)
        _keep(file, [run.backend for run in runs], progress)
        tau = max(autocorrelation_time(run.backend.get_chain()) for run in runs)
        change = abs(tau - tau_before) / tau
        long = steps >= (_TAUS + _BURN) * tau and (change < _CHANGE or steps >= (_SURELY + _BURN) * tau)
        found = _gathered(runs, tau, steps, long)
        effective = found.flat.shape[0] / tau
        progress(
            f"{steps} steps of {ENSEMBLES} x {walkers} walkers: tau {tau:.1f}, effective sample size {effective:.0f}"
        )
        if (long and effective >= wanted) or steps >= _LONGEST:
            return found
        tau_before, steps = tau, int(_GROWTH * steps)


def _round(iteration: int) -> tuple[int, int]:
    """Return the round that ends at ``iteration`` and the one before: a stopped chain ends as if never stopped."""
    before, steps = 0, _FIRST
    while steps < iteration:
        before, steps = steps, int(_GROWTH * steps)
    return before, steps


def start_ensemble(
    problem: SensorPosterior, mode: LaplaceFit, file: Path, index: int, seed: int, walkers: int, moves: Any
) -> Walk:
    """Return an ensemble that starts from the normal distribution about the mode, or continues where it stopped."""
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
    return Walk(backend, moves, random, _alive(problem, mode, walkers, rng))


def _alive(problem: SensorPosterior, mode: LaplaceFit, walkers: int, rng: np.random.Generator) -> FloatArray:
    """Return likely starting points: beside the number of a full well the posterior is next to nothing."""
    found = np.empty((0, len(mode.theta)))
    for _ in range(50):
        drawn = mode.draw(4 * walkers, rng)
        likely = problem.log_posterior(drawn) > mode.log - _BESIDE * (1 + len(mode.theta))
        found = np.concatenate([found, drawn[likely]])
        if len(found) >= walkers:
            return found[:walkers]
    raise ValueError(
        "the normal distribution about the mode hardly overlaps the posterior, so no chain can start from it"
    )


def autocorrelation_time(chain: FloatArray) -> float:
    with np.errstate(invalid="ignore"):
        found = float(np.max(emcee.autocorr.integrated_time(chain, tol=0, has_walkers=True)))
    return found if np.isfinite(found) else float(len(chain))  # of walkers that never moved


def stranded(log: FloatArray) -> int:
    """Return how many walkers of (..., step, walker) stay where the posterior is next to nothing."""
    middle = np.median(log, -2)
    return int((middle < np.median(middle) - STRANDED).sum())


def _gathered(runs: Sequence[Walk], tau: float, steps: int, long: bool) -> Chains:
    burn = min(int(_BURN * tau) + 1, steps // 2)
    draws = np.stack([run.backend.get_chain(discard=burn) for run in runs])
    log = np.stack([run.backend.get_log_prob(discard=burn) for run in runs])
    accepted = float(np.mean([run.backend.accepted / run.iteration for run in runs]))
    return Chains(draws, log, accepted, tau, steps, long)


def _read(file: Path, index: int) -> Any:
    """Return the draws of an ensemble, in memory; None where no file can be read."""
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
    """Write the draws; where that fails, as on a full disk, report it and go on."""
    try:
        _write(file, backends)
    except (OSError, RuntimeError) as error:  # h5py raises both
        progress(f"draws are not kept, so a stop would lose them: {error}")


def _write(file: Path, backends: Sequence[Any]) -> None:
    """Write all ensembles to one file, which gets its name by an atomic rename."""
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
