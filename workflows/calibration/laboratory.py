"""What the laboratory of a recipe states of its light and temperature, and what follows for
draws and intervals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from neusee.nodes.calibrate import Laboratory, Traceability
from neusee.workflows.calibration.frame_validity import ModelSpread, wider
from neusee.workflows.calibration.identifiability import Identifiability
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.graph.diagnostics import nearest
from neusee.workflows.graph.recipe_graph import Recipe

if TYPE_CHECKING:
    from neusee.workflows.calibration.emcee_sampler import Chains
    from neusee.workflows.calibration.log_posterior import FloatArray

EFFICIENCY = "quantum_efficiency"
RELATIVE = "quantum efficiency: not from these frames: the photons are known up to a factor only"
#: quantities that may have a temperature coefficient: what is positive, so that a relative change
#: has a meaning
WITH_COEFFICIENT = frozenset(
    {
        "gain",
        EFFICIENCY,
        "dark_signal",
        "temporal_dark_noise",
        "dark_current",
        "offset",
        "read_noise",
        "full_well",
    }
)
_STREAM = 9  #: of random numbers, apart from those of other draws


def stated(recipe: Recipe) -> Traceability:
    """Return what the recipe states of its light and temperature; nothing for a recipe without
    the block.
    """
    return recipe.traceability or Traceability()


def laboratory_of(recipe: Recipe) -> Laboratory:
    """Return the uncertainties that a recipe states; raise ValueError for a coefficient of an
    unknown quantity.
    """
    statements = stated(recipe)
    stated_names = statements.temperature.coefficients
    unknown_names = [name for name in stated_names if name not in WITH_COEFFICIENT]
    if unknown_names:
        hint = nearest(unknown_names[0], WITH_COEFFICIENT)
        raise ValueError(
            f"traceability.temperature.coefficients: {unknown_names[0]} has no coefficient; {hint}"
        )
    width_in_m = statements.lamp.centroid_uncertainty
    width_in_nm = None if width_in_m is None else 1e9 * width_in_m
    return Laboratory(
        photons=statements.photons.relative_uncertainty,
        photons_distribution=statements.photons.distribution,
        photons_freedom=statements.photons.degrees_of_freedom,
        drift=statements.lamp.drift,
        wavelength=width_in_nm,
        slope=statements.lamp.efficiency_per_nm,
        temperature=statements.temperature.uncertainty,
        coefficients=statements.temperature.coefficients,
    )


def is_relative(recipe: Recipe) -> bool:
    """Return True if the recipe states that its photons are known up to a factor only."""
    return stated(recipe).photons.known == "relative"


def without_efficiency(identifiability: Identifiability) -> Identifiability:
    """Return what frames determine whose photons are known up to a factor: no quantum
    efficiency.
    """
    if EFFICIENCY not in identifiability.kinds:
        return identifiability
    return replace(
        identifiability,
        kinds={**identifiability.kinds, EFFICIENCY: "none"},
        directions=[*identifiability.directions, RELATIVE],
    )


def with_laboratory(
    problem: SensorPosterior, chains: Chains, laboratory: Laboratory, seed: int
) -> Chains:
    """Return the draws of a posterior with the uncertainty of the light and of the temperature.

    The light moves the quantum efficiency alone, by errors that are independent of everything else;
    the temperature moves all parameters with a coefficient together.
    """
    values = problem.parameters(chains.draws)
    factors = _factors(laboratory, list(values), chains.log.shape, seed)
    if not factors:
        return chains
    values |= {name: values[name] * torch.from_numpy(factor) for name, factor in factors.items()}
    return replace(chains, draws=problem.theta(values))


def _factors(
    laboratory: Laboratory, names: Sequence[str], shape: tuple[int, ...], seed: int
) -> dict[str, FloatArray]:
    """Return a factor for each draw of each parameter that light or temperature move, by name."""
    rng = np.random.default_rng([seed, _STREAM])
    factors: dict[str, FloatArray] = {}
    if EFFICIENCY in names:
        for distribution, width in laboratory.light:
            relative_error = _drawn(rng, distribution, width, shape)
            factors[EFFICIENCY] = factors.get(EFFICIENCY, np.ones(shape)) * (1 + relative_error)
    if laboratory.temperature is not None:
        # one error of the temperature moves all parameters together
        kelvin_error = _drawn(rng, "normal", laboratory.temperature, shape)
        for name, coefficient in laboratory.coefficients.items():
            if name in names:
                factors[name] = factors.get(name, np.ones(shape)) * (1 + coefficient * kelvin_error)
    return factors


def _drawn(rng: np.random.Generator, law: str, width: float, shape: tuple[int, ...]) -> FloatArray:
    """Return draws of a law with the mean 0 and the standard deviation ``width``."""
    if law == "rectangular":
        # a rectangle of this half width has the standard deviation `width`
        half_width = math.sqrt(3) * width
        return rng.uniform(-half_width, half_width, shape)
    return width * rng.standard_normal(shape)


def relative_widths(laboratory: Laboratory, names: Sequence[str]) -> Mapping[str, float]:
    """Return the relative standard uncertainty that light and temperature add to each parameter."""
    kelvin_error = laboratory.temperature or 0.0
    light_error = math.hypot(*(uncertainty for _, uncertainty in laboratory.light), 0.0)
    return {
        name: math.hypot(
            light_error * (name == EFFICIENCY),
            kelvin_error * laboratory.coefficients.get(name, 0.0),
        )
        for name in names
    }


def with_laboratory_models(
    models: Sequence[ModelSpread], laboratory: Laboratory
) -> list[ModelSpread]:
    """Return the intervals to report with the uncertainty of the light and of the temperature."""
    widths = relative_widths(laboratory, [model.name for model in models])
    return [replace(model, stated=wider(model.stated, widths[model.name])) for model in models]
