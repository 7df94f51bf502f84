"""The posterior of a sensor as a function of its free parameters, with its mode and covariance."""

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


#: function from parameter values to the likelihood, both by name
_Function = Callable[[Mapping[str, Any]], dict[str, Any]]
#: for each node of a likelihood: the node of its prior, and the class of its coordinates
_KINDS: dict[
    str, tuple[str, type[Coordinates] | type[CameraCoordinates] | type[ScatterCoordinates]]
] = {
    "calibrate.density": ("calibrate.prior", Coordinates),
    "calibrate.camera": ("calibrate.camera_prior", CameraCoordinates),
    "calibrate.stray_light": ("calibrate.stray_prior", ScatterCoordinates),
}


@dataclass(frozen=True)
class SensorPosterior:
    """The posterior of the sensor in a recipe; a sample is an array with one coordinate for each
    free parameter.
    """

    recipe: Recipe
    step: str  #: name of the step that computes the likelihood
    key: str  #: digest of everything that determines the posterior
    coordinates: Coordinates | CameraCoordinates | ScatterCoordinates
    levels: Sufficient | Levels | Rings  #: the data that the likelihood describes
    weigh: _Function
    weigh_in_full: _Function  #: also returns deviances and derivatives
    #: statistics of all frames, of which `levels` may be a selection; None for a lens
    measured: Levels | None = None

    @classmethod
    def of(cls, recipe: Recipe, store: Store) -> SensorPosterior:
        """Return the posterior of a recipe; raise `ValueError` unless the recipe has one
        likelihood and one prior.
        """
        likelihood_step = only_step(recipe, *_KINDS)
        prior_node, coordinate_kind = _KINDS[likelihood_step.node.path]
        prior_step = only_step(recipe, prior_node)
        source = str(likelihood_step.wires[likelihood_step.node.inputs[0]])
        # statistics of all frames; the likelihood may use a selection of them
        levels_step = (
            str(recipe.steps[source].wires["levels"])
            if recipe.steps[source].node.path == "calibrate.sufficient"
            else source
        )
        results = run(recipe, store, (likelihood_step.name, prior_step.name, source, levels_step))
        coordinates = coordinate_kind.of(results[prior_step.name], likelihood_step.params)
        if isinstance(coordinates, ScatterCoordinates):
            coordinates = coordinates.seen_by(results[source], likelihood_step.params)
        free_inputs = [f"{likelihood_step.name}.{name}" for name in coordinates.names]
        # told=False: skip the deviances and derivatives that only a report needs
        quick_step = replace(likelihood_step, params={**likelihood_step.params, "told": False})

        def function(step: Step) -> _Function:
            changed = replace(recipe, steps={**recipe.steps, step.name: step})
            return as_function(changed, *free_inputs, outputs=[step.name], store=store)

        key = digest(*(results.keys[step.name] for step in (likelihood_step, prior_step)))
        measured = results[levels_step] if isinstance(results[levels_step], Levels) else None
        return cls(
            recipe,
            likelihood_step.name,
            key,
            coordinates,
            results[source],
            function(quick_step),
            function(likelihood_step),
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
            log_sum = self.weigh(self._named(parameters))[
                self.step
            ].log + self.coordinates.log_prior(parameters)
        log_density: FloatArray = log_sum.nan_to_num(
            nan=-torch.inf, posinf=-torch.inf, neginf=-torch.inf
        ).numpy()
        return log_density

    def whitened(self, samples: FloatArray) -> FloatArray:
        """Convert samples to distances from the centre of the prior, in standard deviations of the
        prior.
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
_CLOSE = 1e-6  #: twice the gain in log posterior that ends the search: a further step gains less
#: twice the gain in log posterior that a further step may still promise at a settled mode beside an
#: edge
_NEXT = 1e-3
_STEP = 1e-3  #: step of a finite difference, in standard deviations of the coordinate
#: largest standard deviation of a coordinate, so that the step of an undetermined one stays finite
_WIDEST = 1e3
_EDGE = 1e3  #: a finite-difference step that lowers the log posterior by more crosses an edge
#: distances of trial points from the middle of the prior, as shares of the way to the guess
_NARROWER = 0.5 ** np.arange(1, 12)
#: number of prior draws; number of best draws to start from; difference in log posterior that
#: counts as higher
_PRIOR_DRAWS, _START_POINTS, _HIGHER_NATS = 1000, 2, 1.0
#: step before any standard deviation is known: levels may determine the full well to one part in a
#: million
_SHORT = 1e-7


@dataclass(frozen=True)
class LaplaceFit:
    """The Laplace approximation of a posterior: a normal distribution around its mode."""

    theta: FloatArray  #: (free,)
    log: float  #: log posterior at the mode
    covariance: FloatArray  #: (free, free), of the coordinates
    #: (row, free) derivatives of the levels per standard deviation of the prior
    scaled_slopes: FloatArray
    shares: FloatArray  #: (free,) standard deviation of each parameter over that of its prior
    settled: bool  #: True if no further step raises the posterior

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw samples (count, free) from the normal distribution around the mode."""
        values, vectors = np.linalg.eigh(self.covariance)
        normal = rng.standard_normal((count, len(self.theta)))
        samples: FloatArray = self.theta + (normal * np.sqrt(values.clip(0))) @ vectors.T
        return samples


def initial_theta(problem: SensorPosterior) -> FloatArray:
    """Return the starting point of the search for the mode, on the line from a first guess to the
    middle of the prior.

    The start is the point closest to the guess at which the posterior is not zero.
    Raises: `ValueError` if the posterior is zero at all points.
    """
    coordinates = problem.coordinates
    prior_middle = coordinates.from_whitened(torch.zeros(len(problem.names), dtype=torch.float64))
    believed = {
        **coordinates.held,
        **{name: float(values) for name, values in prior_middle.items()},
    }
    guessed = _guessed(problem, believed)
    guess_theta, middle_theta = (
        problem.theta({name: values[name] for name in problem.names})
        for values in (guessed, believed)
    )
    # points on the line from the guess to the middle of the prior; each is half as far from the
    # middle as the one before
    samples = np.stack(
        [
            guess_theta,
            *(middle_theta + (guess_theta - middle_theta) * share for share in _NARROWER),
            middle_theta,
        ]
    )
    is_possible = np.isfinite(problem.log_posterior(samples))
    if not is_possible.any():
        raise ValueError(
            "no sensor that the priors allow can produce these numbers: check rounding, bits and"
            " priors, then run least_squares"
        )
    start: FloatArray = samples[int(is_possible.argmax())]
    return start


def _guessed(problem: SensorPosterior, believed: dict[str, float]) -> dict[str, float]:
    """Return a rough value of each parameter by name, from which the search starts.

    `believed` are the values in the middle of the prior.
    """
    params, levels = problem.recipe.steps[problem.step].params, problem.levels
    if isinstance(levels, Levels):
        return guess_camera(levels, believed, params)
    if isinstance(levels, Rings):
        return guess_scatter(levels, believed, params)
    return guess(levels, believed, params)


def search_mode(problem: SensorPosterior) -> LaplaceFit:
    """Search for the mode from a first guess and from draws of the prior, and return the highest
    mode that was reached.

    For a long, curved posterior (`bent`) the highest end point is returned even if no search
    settled, because its samples do not start there.
    Raises: `ValueError` for any other posterior if no search settles.
    """
    fits = [find_mode(problem, initial_theta(problem))]
    for starts in (_PRIOR_DRAWS, 4 * _PRIOR_DRAWS):
        fits += [find_mode(problem, theta) for theta in _best_draws(problem, starts)]
        settled = [fit for fit in fits if fit.settled]
        # a search that stopped early at a much higher point asks for more starts
        if settled and _highest(fits).log <= _highest(settled).log + _HIGHER_NATS:
            return _highest(settled)
    if problem.coordinates.bent:
        return _highest(fits)
    raise ValueError(_unsettled(problem, fits))


def _highest(fits: Sequence[LaplaceFit]) -> LaplaceFit:
    return max(fits, key=lambda fit: fit.log)


def _best_draws(problem: SensorPosterior, starts: int) -> list[FloatArray]:
    """Return the `_START_POINTS` draws with the highest posterior density, out of ``starts`` draws
    of the prior.
    """
    random = torch.Generator().manual_seed(starts)
    draws = problem.theta(problem.coordinates.draw(starts, random))
    draws = draws[np.isfinite(draws).all(1)]
    log_posteriors = problem.log_posterior(draws)
    return [
        draws[row]
        for row in np.argsort(-log_posteriors)[:_START_POINTS]
        if np.isfinite(log_posteriors[row])
    ]


def _unsettled(problem: SensorPosterior, fits: list[LaplaceFit]) -> str:
    """Return the error message for a search that found no mode, with the parameter values at the
    highest point reached.

    It has the values at which the highest search stops.
    """
    highest_fit = max(fits, key=lambda fit: fit.log)
    values = ", ".join(
        f"{name} {float(x):.3g}" for name, x in problem.parameters(highest_fit.theta).items()
    )
    well_hint = (
        ". If the well of this sensor limits the electrons before the read noise is added, set"
        " share: 0.7 in the step of calibrate.sufficient"
    )
    return (
        f"none of {len(fits)} searches ends at a mode of the posterior (the highest stops at"
        f" {values}), so the model does not describe these levels: run least_squares, and check"
        f" levels, rounding and bits{well_hint if 'full_well' in problem.coordinates.every else ''}"
    )


def find_mode(problem: SensorPosterior, initial_theta: FloatArray) -> LaplaceFit:
    """Search for the mode from ``initial_theta``, and return the normal distribution around it.

    In a direction that no level constrains, the distribution is as wide as the prior.
    """
    theta, difference_steps = initial_theta, np.full(len(initial_theta), _SHORT)
    log_posterior = float(problem.log_posterior(theta[None])[0])
    if not np.isfinite(log_posterior):
        raise ValueError(
            "the sensor at the start of the search cannot produce these levels: run "
            "least_squares, and "
            "check rounding and bits against the camera"
        )
    for _ in range(_ROUNDS):
        # Fisher's information at this point gives the widths of the posterior
        level_slopes, prior_slopes = _slopes(problem, theta, difference_steps)
        covariance = _covariance(level_slopes, prior_slopes)
        # proportional to the width of the posterior along each coordinate
        difference_steps = np.sqrt(covariance.diagonal()).clip(max=_WIDEST) * _STEP
        gradient = _gradient(problem, theta, difference_steps)
        free_gradient = _free(problem, theta, difference_steps, gradient)
        # a Newton step in the coordinates that are not held at an edge
        free_step = _within(covariance, free_gradient != gradient) @ free_gradient
        # twice the gain in log posterior that a quadratic model predicts
        if free_gradient @ free_step < _CLOSE:
            break
        theta, log_posterior, has_moved = _climb(
            problem, theta, log_posterior, covariance @ gradient, free_step
        )
        if not has_moved:
            break
    level_slopes, prior_slopes = _slopes(problem, theta, difference_steps)
    covariance = _covariance(level_slopes, prior_slopes)
    gradient = _gradient(problem, theta, difference_steps)
    free_gradient = _free(problem, theta, difference_steps, gradient)
    # settled: no step in the free coordinates promises a larger gain
    settled = bool(
        free_gradient @ _within(covariance, free_gradient != gradient) @ free_gradient < _NEXT
    )
    # per standard deviation of the prior
    scaled_slopes = level_slopes @ np.linalg.inv(prior_slopes)
    shares = np.sqrt((prior_slopes @ covariance @ prior_slopes.T).diagonal())
    return LaplaceFit(theta, log_posterior, covariance, scaled_slopes, shares, settled)


def _climb(
    problem: SensorPosterior, theta: FloatArray, log: float, step: FloatArray, within: FloatArray
) -> tuple[FloatArray, float, bool]:
    """Return the most probable trial point, its log posterior, and True if it is higher than at
    ``theta``.

    Trial points lie along ``step``, along ``step`` with one coordinate fixed (it may be at an
    edge), and along ``within``, which moves no coordinate that is at an edge.
    """
    step_directions = np.concatenate([step[None], within[None], step * (1 - np.eye(len(step)))])
    # each direction at 24 lengths: the whole step, half of it, and so on
    candidates = (theta + step_directions[:, None] * 0.5 ** np.arange(24)[:, None]).reshape(
        -1, len(theta)
    )
    log_posteriors = problem.log_posterior(candidates)
    highest = int(log_posteriors.argmax())
    return (
        (candidates[highest], float(log_posteriors[highest]), True)
        if log_posteriors[highest] > log
        else (theta, log, False)
    )


def _differences(
    function: Callable[[FloatArray], FloatArray],
    theta: FloatArray,
    step: FloatArray,
    sides: FloatArray,
) -> FloatArray:
    """Return the derivatives of ``function`` by finite differences; ``sides`` (2, free) marks which
    steps up and down are allowed.
    """
    offsets = np.diag(step)
    upper, lower = np.split(
        function(np.concatenate([theta + offsets * sides[0], theta - offsets * sides[1]])), 2
    )
    # two steps give a central difference, one step a one-sided one
    slopes: FloatArray = (upper - lower).T / (step * sides.sum(0).clip(1))
    return slopes


def _sides(problem: SensorPosterior, theta: FloatArray, step: FloatArray) -> FloatArray:
    """Return an array (2, free) for steps up (row 0) and down (row 1): 1 where the step crosses no
    edge, else 0.

    At an edge the posterior falls abruptly, for example at the full well.
    """
    offsets = np.diag(step)
    log_posteriors = problem.log_posterior(
        np.concatenate([theta[None], theta + offsets, theta - offsets])
    )
    is_possible: FloatArray = (
        (log_posteriors[1:] > log_posteriors[0] - _EDGE).reshape(2, -1).astype(np.float64)
    )
    return is_possible


def _slopes(
    problem: SensorPosterior, theta: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of the scaled level residuals (row, free) and of the whitened prior
    (free, free).

    The sum of their Gram matrices is the Fisher information.
    """
    level_slopes = _differences(
        lambda p: problem.likelihood(p).scaled.numpy(), theta, step, _sides(problem, theta, step)
    )
    is_rounded = problem.recipe.steps[problem.step].params.get("rounding") in (
        "nearest",
        "truncation",
    )
    for name in problem.coordinates.edged.intersection(problem.names) if is_rounded else ():
        # levels depend on this parameter only at edges, where they have no derivative
        column = problem.names.index(name)
        level_slopes[:, column] = 0.0
        level_slopes[-1, column] = float(problem.likelihood(theta[None]).scaled[0, -1])
    return level_slopes, _differences(problem.whitened, theta, step, np.ones((2, len(step))))


def _gradient(problem: SensorPosterior, theta: FloatArray, step: FloatArray) -> FloatArray:
    """Return the gradient of the log posterior with respect to the free parameters."""
    possible_sides = _sides(problem, theta, step)
    gradient: FloatArray = _differences(problem.log_posterior, theta, step, possible_sides)
    return gradient


def _free(
    problem: SensorPosterior, theta: FloatArray, step: FloatArray, gradient: FloatArray
) -> FloatArray:
    """Return the gradient, with 0 for each component that points across an edge, where the
    posterior is zero.
    """
    blocked_up, blocked_down = _sides(problem, theta, step) == 0
    return np.where((blocked_up & (gradient > 0)) | (blocked_down & (gradient < 0)), 0.0, gradient)


def _within(covariance: FloatArray, held: NDArray[np.bool_]) -> FloatArray:
    """Return the covariance of all coordinates conditional on those that are ``held`` fixed."""
    if not held.any():
        return covariance
    held_columns = covariance[:, held]
    # Schur complement: the covariance given the held coordinates
    conditional: FloatArray = covariance - held_columns @ np.linalg.solve(
        held_columns[held], held_columns.T
    )
    return conditional


def _covariance(rows: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the covariance of the parameters from an SVD of the derivatives, which is more
    accurate than inverting the information.
    """
    # the inverse of A'A is V diag(1 / s²) V' for A = U diag(s) V'
    _, singular_values, right_vectors = np.linalg.svd(
        np.concatenate([rows, prior]), full_matrices=False
    )
    covariance: FloatArray = (right_vectors.T / singular_values**2) @ right_vectors
    return covariance
