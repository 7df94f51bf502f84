"""The posterior of a sensor as a function of its free parameters; its mode and covariance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from neusee.nodes.calibrate import (
    CameraCoordinates,
    Coordinates,
    Likelihood,
    Rings,
    ScatterCoordinates,
    Sufficient,
    guess,
    guess_camera,
    guess_scatter,
)
from neusee.nodes.values import Levels
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.local_executor import one_thread
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]


# --- log posterior --------------------------------------------------------------------------------

# The posterior of a sensor as a function of the sensor's free parameters.


#: from parameters to the likelihood by step name
_Function = Callable[[Mapping[str, Any]], dict[str, Any]]
#: from the node of the likelihood to the node of the prior and the class of the coordinates
_KINDS: dict[
    str, tuple[str, type[Coordinates] | type[CameraCoordinates] | type[ScatterCoordinates]]
] = {
    "calibrate.density": ("calibrate.prior", Coordinates),
    "calibrate.camera": ("calibrate.camera_prior", CameraCoordinates),
    "calibrate.stray_light": ("calibrate.stray_prior", ScatterCoordinates),
}


@dataclass(frozen=True)
class SensorPosterior:
    """The posterior of the sensor of a recipe; a sample has one coordinate for each free
    parameter.
    """

    recipe: Recipe
    step: str  #: name of the step that computes the likelihood
    key: str  #: digest of everything that decides the posterior
    coordinates: Coordinates | CameraCoordinates | ScatterCoordinates
    levels: Sufficient | Levels | Rings  #: the data that the likelihood describes
    weigh: _Function
    weigh_in_full: _Function  #: also returns deviances and derivatives
    #: the statistics of all frames, from which `levels` follow; None for a lens
    measured: Levels | None = None

    @classmethod
    def of(cls, recipe: Recipe, store: Store) -> SensorPosterior:
        """Return the posterior of a recipe; raise `ValueError` unless the recipe has one
        likelihood and one prior.
        """
        density = only_step(recipe, *_KINDS)
        prior_node, kind = _KINDS[density.node.path]
        prior = only_step(recipe, prior_node)
        source = str(density.wires[density.node.inputs[0]])
        levels_step = (
            str(recipe.steps[source].wires["levels"])
            if recipe.steps[source].node.path == "calibrate.sufficient"
            else source
        )
        done = run(recipe, store, (density.name, prior.name, source, levels_step))
        coordinates = kind.of(done[prior.name], density.params)
        if isinstance(coordinates, ScatterCoordinates):
            coordinates = coordinates.seen_by(done[source], density.params)
        free = [f"{density.name}.{name}" for name in coordinates.names]
        quick = replace(density, params={**density.params, "told": False})

        def function(step: Step) -> _Function:
            changed = replace(recipe, steps={**recipe.steps, step.name: step})
            return as_function(changed, *free, outputs=[step.name], store=store)

        key = digest(*(done.keys[step.name] for step in (density, prior)))
        measured = done[levels_step] if isinstance(done[levels_step], Levels) else None
        return cls(
            recipe,
            density.name,
            key,
            coordinates,
            done[source],
            function(quick),
            function(density),
            measured,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the free parameters."""
        return self.coordinates.names

    def parameters(self, samples: FloatArray) -> dict[str, Tensor]:
        """Convert sampler coordinates (..., free parameter) to parameter values by name, each of
        shape (...).
        """
        return self.coordinates.parameters(torch.from_numpy(np.ascontiguousarray(samples)))

    def theta(self, parameters: Mapping[str, float | Tensor]) -> FloatArray:
        """Convert parameter values by name to sampler coordinates (..., free parameter)."""
        coordinates: FloatArray = self.coordinates.place(parameters).numpy()
        return coordinates

    def likelihood(self, samples: FloatArray) -> Likelihood:
        """Return the likelihood of the measured light levels at samples (walker, free
        parameter).
        """
        with torch.no_grad(), one_thread():
            likelihood: Likelihood = self.weigh_in_full(self._named(self.parameters(samples)))[
                self.step
            ]
        return likelihood

    def log_posterior(self, samples: FloatArray) -> FloatArray:
        """Return the log posterior density at samples (walker, free parameter), up to a
        constant.
        """
        with torch.no_grad(), one_thread():
            parameters = self.parameters(samples)
            total = self.weigh(self._named(parameters))[self.step].log + self.coordinates.log_prior(
                parameters
            )
        log: FloatArray = total.nan_to_num(
            nan=-torch.inf, posinf=-torch.inf, neginf=-torch.inf
        ).numpy()
        return log

    def whitened(self, samples: FloatArray) -> FloatArray:
        """Convert samples to distances from the middle of the prior, in standard deviations of
        the prior.
        """
        whitened: FloatArray = self.coordinates.whitened(self.parameters(samples)).numpy()
        return whitened

    def _named(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {f"{self.step}.{name}": x for name, x in parameters.items()}


def only_step(recipe: Recipe, *paths: str) -> Step:
    """Return the only step whose node is in ``paths``; raise `ValueError` if there is no such
    step or more than one.
    """
    steps = [step for step in recipe.steps.values() if step.node.path in paths]
    if len(steps) != 1:
        count = f"{len(steps)} steps" if steps else "no step"
        names = " or ".join(filter(None, (", ".join(paths[:-1]), paths[-1])))
        raise ValueError(
            f"{recipe.name} has {count} of the node {names}, but a calibration needs exactly one:"
            " see `neusee run calibrate`, `neusee run calibrate_camera` and `neusee run"
            " calibrate_stray_light`"
        )
    return steps[0]


# --- posterior mode -------------------------------------------------------------------------------

# The mode and the covariance of a posterior, by Fisher scoring from the least-squares estimate of
# EMVA 1288.


_ROUNDS = 60
_CLOSE = 1e-6  #: twice the nats that one more step may gain at the end of the search
_NEXT = 1e-3  #: twice the nats that one more step may gain at a settled mode beside an edge
_STEP = 1e-3  #: step of a difference, in standard deviations of the coordinate
#: standard deviation of a coordinate that nothing determines, so that a step stays a number
_WIDEST = 1e3
_EDGE = 1e3  #: nats: a step of a difference that costs more crosses an edge
_NARROWER = 0.5 ** np.arange(1, 12)  #: shares of the way from the middle of the prior to the guess
#: draws of the prior, the best to start from, nats that count as higher
_TRIED, _BEST, _HIGHER = 1000, 2, 1.0
#: step before any standard deviation is known: levels may determine a well to a part in a million
_SHORT = 1e-7


@dataclass(frozen=True)
class LaplaceFit:
    """The Laplace approximation of a posterior: the normal distribution about the mode."""

    theta: FloatArray  #: (free,)
    log: float  #: log posterior at the mode
    covariance: FloatArray  #: (free, free), of the coordinates
    #: (row, free) derivatives of the levels per standard deviation of the prior
    scaled_slopes: FloatArray
    shares: FloatArray  #: (free,) standard deviation of each parameter over that of its prior
    settled: bool  #: True if no further step raises the posterior

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw samples (count, free) from the normal distribution about the mode."""
        values, vectors = np.linalg.eigh(self.covariance)
        normal = rng.standard_normal((count, len(self.theta)))
        samples: FloatArray = self.theta + (normal * np.sqrt(values.clip(0))) @ vectors.T
        return samples


def initial_theta(problem: SensorPosterior) -> FloatArray:
    """Return the start of the search for the mode, a point between a first guess and the middle of
    the prior.

    The start is the point closest to the guess at which the posterior is not zero.
    Raises: `ValueError` if the posterior is zero at all points.
    """
    coordinates = problem.coordinates
    middle = coordinates.from_whitened(torch.zeros(len(problem.names), dtype=torch.float64))
    believed = {**coordinates.held, **{name: float(x) for name, x in middle.items()}}
    guessed = _guessed(problem, believed)
    first, last = (
        problem.theta({name: x[name] for name in problem.names}) for x in (guessed, believed)
    )
    samples = np.stack([first, *(last + (first - last) * share for share in _NARROWER), last])
    alive = np.isfinite(problem.log_posterior(samples))
    if not alive.any():
        raise ValueError(
            "no sensor allowed by the priors can produce these numbers: check rounding, bits and"
            " priors, then run least_squares"
        )
    start: FloatArray = samples[int(alive.argmax())]
    return start


def _guessed(problem: SensorPosterior, believed: dict[str, float]) -> dict[str, float]:
    params, levels = problem.recipe.steps[problem.step].params, problem.levels
    if isinstance(levels, Levels):
        return guess_camera(levels, believed, params)
    if isinstance(levels, Rings):
        return guess_scatter(levels, believed, params)
    return guess(levels, believed, params)


def search_mode(problem: SensorPosterior) -> LaplaceFit:
    """Search for the mode from the first guess and from draws of the prior, and return the highest
    that settles.

    A posterior that may be long and bent is also returned without a settled mode: its samples do
    not start there.
    Raises: `ValueError` if no search settles.
    """
    fits = [find_mode(problem, initial_theta(problem))]
    for starts in (_TRIED, 4 * _TRIED):
        fits += [find_mode(problem, theta) for theta in _best_draws(problem, starts)]
        settled = [fit for fit in fits if fit.settled]
        if settled and _highest(fits).log <= _highest(settled).log + _HIGHER:
            return _highest(settled)
    if problem.coordinates.bent:
        return _highest(fits)
    raise ValueError(_unsettled(problem, fits))


def _highest(fits: Sequence[LaplaceFit]) -> LaplaceFit:
    return max(fits, key=lambda fit: fit.log)


def _best_draws(problem: SensorPosterior, starts: int) -> list[FloatArray]:
    """Return the draws of the prior with the highest density of the posterior, of ``starts``."""
    random = torch.Generator().manual_seed(starts)
    drawn = problem.theta(problem.coordinates.draw(starts, random))
    drawn = drawn[np.isfinite(drawn).all(1)]
    logs = problem.log_posterior(drawn)
    return [drawn[row] for row in np.argsort(-logs)[:_BEST] if np.isfinite(logs[row])]


def _unsettled(problem: SensorPosterior, fits: list[LaplaceFit]) -> str:
    best = max(fits, key=lambda fit: fit.log)
    values = ", ".join(
        f"{name} {float(x):.3g}" for name, x in problem.parameters(best.theta).items()
    )
    well = (
        ". If the well of this sensor ends the electrons before the read noise is added, set share:"
        " 0.7 in the step of calibrate.sufficient"
    )
    return (
        f"none of {len(fits)} searches ends at a mode of the posterior (the highest stops at"
        f" {values}), so the model does not describe these levels: run least_squares, and check"
        f" levels, rounding and bits{well if 'full_well' in problem.coordinates.every else ''}"
    )


def find_mode(problem: SensorPosterior, initial_theta: FloatArray) -> LaplaceFit:
    """Search for the mode from ``initial_theta``, and return the normal distribution about the
    mode.

    In a direction that no level constrains, the distribution is as wide as the prior.
    """
    theta, step_of = initial_theta, np.full(len(initial_theta), _SHORT)
    log = float(problem.log_posterior(theta[None])[0])
    if not np.isfinite(log):
        raise ValueError(
            "the sensor at the start of the search cannot produce these levels: run "
            "least_squares, and "
            "check rounding and bits against the camera"
        )
    for _ in range(_ROUNDS):
        rows, prior = _slopes(problem, theta, step_of)
        covariance = _covariance(rows, prior)
        step_of = np.sqrt(covariance.diagonal()).clip(max=_WIDEST) * _STEP
        gradient = _gradient(problem, theta, step_of)
        free = _free(problem, theta, step_of, gradient)
        within = _within(covariance, free != gradient) @ free
        if free @ within < _CLOSE:
            break
        theta, log, moved = _climb(problem, theta, log, covariance @ gradient, within)
        if not moved:
            break
    rows, prior = _slopes(problem, theta, step_of)
    covariance = _covariance(rows, prior)
    gradient = _gradient(problem, theta, step_of)
    free = _free(problem, theta, step_of, gradient)
    settled = bool(free @ _within(covariance, free != gradient) @ free < _NEXT)
    scaled_slopes = rows @ np.linalg.inv(prior)
    shares = np.sqrt((prior @ covariance @ prior.T).diagonal())
    return LaplaceFit(theta, log, covariance, scaled_slopes, shares, settled)


def _climb(
    problem: SensorPosterior, theta: FloatArray, log: float, step: FloatArray, within: FloatArray
) -> tuple[FloatArray, float, bool]:
    """Return the most probable point along ``step``, its log posterior, and True if this is higher
    than at ``theta``.

    The points change all coordinates, or all except one, which may be at an edge; or they lie along
    ``within``, which leaves each coordinate that is at an edge.
    """
    ways = np.concatenate([step[None], within[None], step * (1 - np.eye(len(step)))])
    tries = (theta + ways[:, None] * 0.5 ** np.arange(24)[:, None]).reshape(-1, len(theta))
    logs = problem.log_posterior(tries)
    best = int(logs.argmax())
    return (tries[best], float(logs[best]), True) if logs[best] > log else (theta, log, False)


def _differences(
    function: Callable[[FloatArray], FloatArray],
    theta: FloatArray,
    step: FloatArray,
    sides: FloatArray,
) -> FloatArray:
    """Return the derivatives of ``function`` by finite differences; ``sides`` selects steps up
    and steps down.
    """
    apart = np.diag(step)
    high, low = np.split(
        function(np.concatenate([theta + apart * sides[0], theta - apart * sides[1]])), 2
    )
    slopes: FloatArray = (high - low).T / (step * sides.sum(0).clip(1))
    return slopes


def _sides(problem: SensorPosterior, theta: FloatArray, step: FloatArray) -> FloatArray:
    """Return 1 for each step up or down that meets no edge of the posterior, such as a full
    well, and 0 for others.
    """
    apart = np.diag(step)
    log = problem.log_posterior(np.concatenate([theta[None], theta + apart, theta - apart]))
    possible: FloatArray = (log[1:] > log[0] - _EDGE).reshape(2, -1).astype(np.float64)
    return possible


def _slopes(
    problem: SensorPosterior, theta: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of light levels and prior by coordinate; their Gram matrix is Fisher's
    information.
    """
    rows = _differences(
        lambda p: problem.likelihood(p).scaled.numpy(), theta, step, _sides(problem, theta, step)
    )
    rounded = problem.recipe.steps[problem.step].params.get("rounding") in ("nearest", "truncation")
    for name in problem.coordinates.edged.intersection(problem.names) if rounded else ():
        # levels depend on this parameter only at edges, where they have no derivative
        column = problem.names.index(name)
        rows[:, column] = 0.0
        rows[-1, column] = float(problem.likelihood(theta[None]).scaled[0, -1])
    return rows, _differences(problem.whitened, theta, step, np.ones((2, len(step))))


def _gradient(problem: SensorPosterior, theta: FloatArray, step: FloatArray) -> FloatArray:
    """Return the gradient of the log posterior with respect to the free parameters."""
    sides = _sides(problem, theta, step)
    gradient: FloatArray = _differences(problem.log_posterior, theta, step, sides)
    return gradient


def _free(
    problem: SensorPosterior, theta: FloatArray, step: FloatArray, gradient: FloatArray
) -> FloatArray:
    """Return the gradient, with 0 for each component that leads to parameters where the
    posterior is zero.
    """
    up, down = _sides(problem, theta, step) == 0
    return np.where((up & (gradient > 0)) | (down & (gradient < 0)), 0.0, gradient)


def _within(covariance: FloatArray, held: NDArray[np.bool_]) -> FloatArray:
    """Return the covariance of all coordinates where those that are ``held`` stay as they are."""
    if not held.any():
        return covariance
    across = covariance[:, held]
    within: FloatArray = covariance - across @ np.linalg.solve(across[held], across.T)
    return within


def _covariance(rows: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the covariance of the parameters from an SVD of derivatives, which is more precise
    than an inversion.
    """
    _, s, v = np.linalg.svd(np.concatenate([rows, prior]), full_matrices=False)
    covariance: FloatArray = (v.T / s**2) @ v
    return covariance
