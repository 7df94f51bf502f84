"""Sampling of a posterior with emcee, by ensembles of walkers, until the chains are long enough."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import emcee
import numpy as np

from neusee.nodes.file_headers import hdf5_needs
from neusee.nodes.input_files import bytes_of
from neusee.workflows.calibration.log_posterior import LaplaceFit, SensorPosterior
from neusee.workflows.calibration.posterior_mixture import Density
from neusee.workflows.keys.sealed_files import seal_file, unseal_file
from neusee.workflows.report.study_report import Progress, silent

if TYPE_CHECKING:
    from neusee.workflows.calibration.importance_sampling import Guide
    from neusee.workflows.calibration.log_posterior import FloatArray


# --- ensembles ------------------------------------------------------------------------------------

# Ensembles of walkers that advance together, so that one call evaluates the proposals of all
# ensembles.
#
# Each ensemble has emcee's moves and its own random stream. The draws are exactly those of emcee's
# `EnsembleSampler`, which evaluates one ensemble after another in a loop over walkers. A likelihood
# of few numbers takes as long for one ensemble as for four, and less time than the loop of emcee.


#: function that returns the log density (walker,) at samples (walker, free); never NaN
Weigh = Callable[["FloatArray"], "FloatArray"]


class Walk:
    """An ensemble of walkers, with its draws, its move and its random stream."""

    def __init__(
        self,
        backend: Any,
        move: Any,
        random: np.random.RandomState,
        initial_theta: FloatArray | None,
    ) -> None:
        self.backend = backend  #: emcee's backend in memory, with all steps so far
        self.move, self.random = move, random
        self.initial_theta = initial_theta  #: (walker, free) before the first step; None after it

    @property
    def iteration(self) -> int:
        """Return the number of steps that the walkers have made."""
        return int(self.backend.iteration)

    def prepare(self, steps: int, weigh: Weigh) -> None:
        """Reserve memory for ``steps`` more steps, and load the state after the last step."""
        if self.initial_theta is not None and self.iteration == 0:
            self._state = emcee.State(self.initial_theta.copy(), log_prob=weigh(self.initial_theta))
        else:
            self._state = emcee.State(self.backend.get_last_sample(), copy=True)
        self.backend.grow(steps, None)

    def begin_step(self) -> None:
        """Split the walkers into parts for one step; the proposals for one part depend on the other
        parts.
        """
        self.random.random_sample()  # emcee draws one of several moves with this number
        self.move.setup(self._state.coords)
        self._part = np.arange(len(self._state.coords)) % self.move.nsplits
        if self.move.randomize_split:
            self.random.shuffle(self._part)
        self._accepted = np.zeros(len(self._part), dtype=bool)

    def propose(self, split: int) -> FloatArray:
        """Return the proposed coordinates (walker, free parameter) for one part of the walkers."""
        sets = [
            self._state.coords[self._part == part_number]
            for part_number in range(self.move.nsplits)
        ]
        other_parts = sets[:split] + sets[split + 1 :]
        self._proposed, self._factors = self.move.get_proposal(
            sets[split], other_parts, self.random
        )
        proposed: FloatArray = self._proposed
        return proposed

    def decide(self, split: int, log: FloatArray) -> None:
        """Accept or reject the proposed coordinates of one part of the walkers."""
        walker_numbers = np.flatnonzero(self._part == split)
        # Metropolis-Hastings rule: ratio of the densities at the new and the old place, times the
        # factor
        log_acceptance = self._factors + log - self._state.log_prob[walker_numbers]
        accepted = log_acceptance > np.log(self.random.rand(len(walker_numbers)))
        moved = walker_numbers[accepted]
        self._state.coords[moved], self._state.log_prob[moved] = (
            self._proposed[accepted],
            log[accepted],
        )
        self._accepted[moved] = True

    def end_step(self) -> None:
        """Add the walkers' coordinates after this step to the draws."""
        self.backend.save_step(self._state, self._accepted)

    def rest(self) -> None:
        """Store the state of the random stream, so that a later run can continue from it."""
        self.backend.random_state = self.random.get_state()


def walk_until(walks: Sequence[Walk], steps: int, weigh: Weigh) -> None:
    """Advance the ensembles until each has ``steps`` steps; those with the fewest steps
    go first.
    """
    while (fewest_steps := min(walk.iteration for walk in walks)) < steps:
        walks_to_advance = [walk for walk in walks if walk.iteration == fewest_steps]
        next_stop = min(
            [steps, *(walk.iteration for walk in walks if walk.iteration > fewest_steps)]
        )
        _together(walks_to_advance, next_stop - fewest_steps, weigh)


def _together(walks: Sequence[Walk], steps: int, weigh: Weigh) -> None:
    """Advance ensembles with equal numbers of steps by ``steps`` steps.

    The log density of the proposals of all ensembles is computed in one call, because many samples
    at once cost little more than one.
    """
    for walk in walks:
        walk.prepare(steps, weigh)
    for _ in range(steps):
        for walk in walks:
            walk.begin_step()
        for split in range(walks[0].move.nsplits):
            log_posteriors = weigh(np.concatenate([walk.propose(split) for walk in walks]))
            for walk, own_log in zip(walks, np.split(log_posteriors, len(walks)), strict=True):
                walk.decide(split, own_log)
        for walk in walks:
            walk.end_step()
    for walk in walks:
        walk.rest()


# --- guided move ----------------------------------------------------------------------------------

# A move of walkers that also proposes places from a density that approximates the posterior,
# independently of the walkers' own places.


_GUIDED_SHARE = 0.8  #: share of the proposals that come from the density


class GuidedMove:
    """A move for emcee that draws some proposals from a density, so that walkers can also jump
    between modes.

    Each proposal has its Metropolis-Hastings factor, so that the chains converge to the posterior
    even if the density approximates it poorly.
    """

    def __init__(self, move: Any, density: Density) -> None:
        self.move, self.density = move, density
        self.nsplits, self.randomize_split = move.nsplits, move.randomize_split

    def setup(self, places: FloatArray) -> None:
        """Prepare emcee's move for walkers at ``places``."""
        self.move.setup(places)

    def get_proposal(
        self, own: FloatArray, others: Sequence[FloatArray], random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Return proposed places (walker, free), and the logarithm of the Metropolis-Hastings
        factor of each.
        """
        proposed, factors = self.move.get_proposal(own, others, random)
        from_density, density_factors = self.density.propose(own, random)
        takes_density = random.random_sample(len(own)) < _GUIDED_SHARE
        return np.where(takes_density[:, None], from_density, proposed), np.where(
            takes_density, density_factors, factors
        )


# --- emcee sampler --------------------------------------------------------------------------------

# Sampling of a sensor's posterior with emcee: four ensembles of walkers, until the chains are long
# enough.
#
# Only this file imports emcee. After each round all draws are written in emcee's
# HDF5 format, behind a seal in the first bytes, which HDF5 leaves to its users. A killed run
# continues from the last round and gives the same draws, to the last bit, as a run that never
# stopped. Chains whose file has no right seal start anew.


ENSEMBLES = 4
#: a walker is stranded if its median log posterior lies this far below that of all walkers
STRANDED = 20.0
#: steps of the first round; growth factor from round to round; most steps
_FIRST_STEPS, _GROWTH, _MOST_STEPS = 250, 1.25, 32_000
#: least length of a chain in autocorrelation times (tau), and largest relative change of tau in its
#: last round
_LEAST_TAUS, _SETTLED_CHANGE = 50.0, 0.01
_SURE_TAUS = 100.0  #: length of a chain in tau from which any change of tau is accepted
#: log posterior below the mode that is allowed for a starting point, per parameter
_START_NATS = 5.0
_SEAL_BYTES = 512  #: bytes of the seal in front of the draws
_DISCARDED_TAUS = 10.0  #: length of the discarded start of a chain, in tau
_MOVES = {"de": emcee.moves.DEMove, "stretch": emcee.moves.StretchMove}


@dataclass(frozen=True)
class Sampling:
    """The random seed, the walkers and their move, and the number of draws to make."""

    seed: int
    walkers: int = 64  #: of each ensemble
    move: str = "de"  #: name of emcee's move, as in `move`
    effective_size: int = 1000  #: least effective sample size of all ensembles together


@dataclass(frozen=True)
class Chains:
    """The draws and log posteriors of all ensembles, and measures of how well the walkers mix."""

    draws: FloatArray  #: (ensemble, step, walker, free) coordinates, without the discarded steps
    log: FloatArray  #: (ensemble, step, walker)
    accepted: float  #: share of accepted moves
    tau: float  #: steps, the longest autocorrelation time of any coordinate
    steps: int  #: number of steps, including the discarded ones
    long: bool  #: True if the chains are long enough

    @property
    def flat(self) -> FloatArray:
        """Return the draws of all ensembles in one array (draw, free parameter)."""
        return self.draws.reshape(-1, self.draws.shape[-1])


def move(name: str) -> Any:
    """Return emcee's move with the name ``de`` or ``stretch``; raise `ValueError` for any other
    name.
    """
    if name in _MOVES:
        return _MOVES[name]()
    if "snooker" in name.lower():
        raise ValueError(
            "DESnookerMove of emcee up to 3.1.6 draws from a distribution that is 18 % too narrow"
            " (emcee's pull request 531 corrects this): use de or stretch"
        )
    raise ValueError(f"unknown move {name!r}: write de or stretch")


def sample(
    problem: SensorPosterior,
    mode: LaplaceFit,
    file: Path,
    sampling: Sampling,
    progress: Progress = silent,
    guide: Guide | None = None,
) -> Chains:
    """Sample until each chain is 50 autocorrelation times long and the effective sample size is at
    least that of ``sampling``.

    ``file`` keeps the draws; if the file exists, the chains continue from its last step. With a
    ``guide`` the walkers start at its samples, and most of their proposals are from its density.
    """
    runs = [
        start_ensemble(problem, mode, file, index, sampling, guide) for index in range(ENSEMBLES)
    ]
    # a continued run ends its rounds at the same steps as an uninterrupted one
    steps_before, round_end = _round(min(run.iteration for run in runs))
    tau_before, is_stored = _longest_time(runs, steps_before) if steps_before else np.inf, True
    while True:
        walk_until(runs, round_end, problem.log_posterior)
        # report a full disk only once
        warn = progress if is_stored else silent
        is_stored = _keep(file, [run.backend for run in runs], warn)
        tau = _longest_time(runs)
        chains = _gathered(runs, tau, round_end, _are_long(round_end, tau, tau_before))
        effective = chains.flat.shape[0] / tau
        is_finished = _are_enough(chains, effective, sampling.effective_size)
        # for the message: the steps so far, or an estimate from the present rates
        needed = (
            round_end
            if is_finished
            else max(
                int(_GROWTH * round_end),
                _steps_needed(round_end, tau, effective, sampling.effective_size),
            )
        )
        progress_text = (
            f"{round_end} of about {needed} steps of {ENSEMBLES} x {sampling.walkers} walkers"
        )
        progress(f"{progress_text}: tau {tau:.1f}, effective sample size {effective:.0f}")
        if is_finished:
            return chains
        tau_before, round_end = tau, int(_GROWTH * round_end)


def _are_long(steps: int, tau: float, tau_before: float) -> bool:
    """Return True if the chains are many autocorrelation times long, and this time is stable."""
    relative_change = abs(tau - tau_before) / tau
    return steps >= (_LEAST_TAUS + _DISCARDED_TAUS) * tau and (
        relative_change < _SETTLED_CHANGE or steps >= (_SURE_TAUS + _DISCARDED_TAUS) * tau
    )


def _are_enough(chains: Chains, size: float, effective_size: int) -> bool:
    """Return True if sampling ends: chains are long and draws numerous, or the largest number of
    steps is reached.
    """
    return (chains.long and size >= effective_size) or chains.steps >= _MOST_STEPS


def _steps_needed(steps: int, tau: float, size: float, effective_size: int) -> int:
    """Return the estimated total number of steps that the chains need, at the present
    autocorrelation time and effective sample size.
    """
    return min(
        int(max((_LEAST_TAUS + _DISCARDED_TAUS) * tau, steps * effective_size / max(size, 1.0))),
        _MOST_STEPS,
    )


def _longest_time(runs: Sequence[Walk], steps: int | None = None) -> float:
    """Return the longest autocorrelation time, in steps, of all ensembles over their first
    ``steps`` steps.
    """
    return max(autocorrelation_time(run.backend.get_chain()[:steps]) for run in runs)


def _round(iteration: int) -> tuple[int, int]:
    """Return the step numbers at which two successive rounds end: the last before ``iteration``,
    and the first at or after it.
    """
    steps_before, steps = 0, _FIRST_STEPS
    while steps < iteration:
        steps_before, steps = steps, int(_GROWTH * steps)
    return steps_before, steps


def start_ensemble(
    problem: SensorPosterior,
    mode: LaplaceFit,
    file: Path,
    index: int,
    sampling: Sampling,
    guide: Guide | None = None,
) -> Walk:
    """Return an ensemble that continues the draws in ``file``, or else starts near the mode or at
    samples of the guide.
    """
    walkers, dimensions = sampling.walkers, len(problem.names)
    own_move = move(sampling.move)
    walker_move = GuidedMove(own_move, guide.density) if guide else own_move
    backend = _read(file, index)
    if backend is not None and backend.shape == (walkers, dimensions):
        random = np.random.RandomState()
        random.set_state(backend.random_state)
        return Walk(backend, walker_move, random, None)
    rng = np.random.default_rng([sampling.seed, index])
    # emcee needs the old kind of generator
    random = np.random.RandomState(rng.integers(1 << 32, size=8, dtype=np.uint32))
    backend = emcee.backends.Backend()
    backend.reset(walkers, dimensions)
    start = guide.starts(walkers, rng) if guide else _alive(problem, mode, walkers, rng)
    return Walk(backend, walker_move, random, start)


def _alive(
    problem: SensorPosterior, mode: LaplaceFit, walkers: int, rng: np.random.Generator
) -> FloatArray:
    """Return starting points (walker, parameter) near the mode, where the posterior density is not
    too low.
    """
    likely_points = np.empty((0, len(mode.theta)))
    # each round draws four times as many candidates as walkers, and keeps the likely ones
    for _ in range(50):
        candidates = mode.draw(4 * walkers, rng)
        is_likely = problem.log_posterior(candidates) > mode.log - _START_NATS * (
            1 + len(mode.theta)
        )
        likely_points = np.concatenate([likely_points, candidates[is_likely]])
        if len(likely_points) >= walkers:
            return likely_points[:walkers]
    raise ValueError(
        "the samples around the mode have almost no posterior density, so no chain can start"
        " there: set narrower priors"
    )


def autocorrelation_time(chain: FloatArray) -> float:
    """Return the longest autocorrelation time of the coordinates in a chain (step, walker,
    parameter).
    """
    with np.errstate(invalid="ignore"):
        tau = float(np.max(emcee.autocorr.integrated_time(chain, tol=0, has_walkers=True)))
    return tau if np.isfinite(tau) else float(len(chain))  # NaN for walkers that never move


def stranded(log: FloatArray) -> int:
    """Return the number of stranded walkers: those whose median ``log`` (..., step, walker) is far
    below that of all walkers.
    """
    walker_medians = np.median(log, -2)
    return int((walker_medians < np.median(walker_medians) - STRANDED).sum())


def _gathered(runs: Sequence[Walk], tau: float, steps: int, long: bool) -> Chains:
    """Return the chains of all ensembles without the discarded steps, with the measures of mixing.

    ``tau`` is the longest autocorrelation time, ``steps`` the length, and ``long`` whether it
    suffices.
    """
    discarded_steps = min(int(_DISCARDED_TAUS * tau) + 1, steps // 2)
    draws = np.stack([run.backend.get_chain(discard=discarded_steps) for run in runs])
    log = np.stack([run.backend.get_log_prob(discard=discarded_steps) for run in runs])
    accepted = float(np.mean([run.backend.accepted / run.iteration for run in runs]))
    return Chains(draws, log, accepted, tau, steps, long)


def _read(file: Path, index: int) -> Any:
    """Read the draws of an ensemble into a backend in memory; return None if the file cannot be
    read or trusted.

    A copy is read, because the file may be replaced after its seal was checked.
    """
    try:
        content = bytes_of(file)
        unseal_file("draws", file.stem, content[:_SEAL_BYTES].rstrip(b"\0"), content[_SEAL_BYTES:])
        with TemporaryDirectory(prefix="neusee-") as folder:
            copy = Path(folder) / "draws.h5"
            copy.write_bytes(content)
            backend = _unpacked(copy, index)
    except (OSError, LookupError, AttributeError, ValueError, TypeError, RuntimeError):
        return None
    return backend if _is_whole(backend) else None


def _unpacked(file: Path, index: int) -> Any:
    """Read the draws of one ensemble from an HDF5 file into a backend of emcee in memory."""
    stored_draws = emcee.backends.HDFBackend(str(file), name=f"ensemble{index}", read_only=True)
    backend = emcee.backends.Backend()
    with stored_draws.open() as hdf5_file:
        # refuses a file whose arrays would not fit into memory
        hdf5_needs(file, [hdf5_file[stored_draws.name]])
    backend.reset(*stored_draws.shape)
    backend.chain, backend.log_prob = stored_draws.get_chain(), stored_draws.get_log_prob()
    backend.accepted, backend.iteration = stored_draws.accepted, stored_draws.iteration
    backend.random_state = stored_draws.random_state
    # raises here if the stored state is no state of a random stream
    np.random.RandomState().set_state(backend.random_state)
    return backend


def _is_whole(memory: Any) -> bool:
    """Return True if draws and log densities are complete and finite for all steps."""
    steps = memory.iteration
    has_all_shapes = memory.chain.shape == (steps, *memory.shape) and memory.log_prob.shape == (
        steps,
        memory.shape[0],
    )
    return (
        steps > 0
        and has_all_shapes
        and bool(np.isfinite(memory.chain).all() and np.isfinite(memory.log_prob).all())
    )


def _keep(file: Path, backends: Sequence[Any], progress: Progress) -> bool:
    """Write the draws to a file and return True; on an error, such as a full disk, report it and
    return False.
    """
    try:
        _write(file, backends)
    except (OSError, RuntimeError) as error:  # h5py raises both
        progress(f"the draws are not on disk, so an interruption would lose them: {error}")
        return False
    return True


def _write(file: Path, backends: Sequence[Any]) -> None:
    """Write the draws of all ensembles to one file with an atomic rename.

    HDF5 writes to a temporary folder first, because after an error of the disk it can no longer
    close its file.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_suffix(f".{os.getpid()}.part")
    try:
        with TemporaryDirectory(prefix="neusee-") as folder:
            draws_file = Path(folder) / "draws.h5"
            _write_draws(draws_file, backends)
            # the first bytes are reserved for the seal, which is computed from the rest
            draws_content = draws_file.read_bytes()[_SEAL_BYTES:]
        with open(temporary, "wb") as temporary_file:
            temporary_file.write(
                seal_file("draws", file.stem, draws_content).ljust(_SEAL_BYTES, b"\0")
                + draws_content
            )
            temporary_file.flush()
            os.fsync(temporary_file.fileno())
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def _write_draws(path: Path, backends: Sequence[Any]) -> None:
    """Write the draws of all ensembles to an HDF5 file whose first bytes are free for the seal."""
    import h5py

    # HDF5 leaves a block of this size before its own content
    with h5py.File(path, "w", userblock_size=_SEAL_BYTES):
        pass
    for index, memory in enumerate(backends):
        backend = emcee.backends.HDFBackend(str(path), name=f"ensemble{index}")
        backend.reset(*memory.shape)
        backend.grow(memory.iteration, None)
        with backend.open("a") as hdf5_file:
            group = hdf5_file[backend.name]
            group["chain"][...], group["log_prob"][...] = memory.chain, memory.log_prob
            group["accepted"][...] = memory.accepted
            group.attrs["iteration"] = memory.iteration
            # the state of the random stream is a tuple, stored entry by entry
            for i, value in enumerate(memory.random_state):
                group.attrs[f"random_state_{i}"] = value
