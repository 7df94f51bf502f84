"""The uncertainty budget of each parameter of a calibration, whose sources add up to what the calibration states."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from neusee.nodes.calibrate import (
    MODEL,
    NOT_INVOLVED,
    NOT_STATED,
    STATISTICS,
    Budget,
    Contribution,
    Laboratory,
    camera_sources,
    laboratory_contributions,
    source_freedom,
    variance_shares,
)
from neusee.nodes.values import Levels
from neusee.workflows.calibration.frame_validity import errors_of_parameters
from neusee.workflows.calibration.laboratory import EFFICIENCY
from neusee.workflows.calibration.model_spread import TERMS, width_of_mean
from neusee.workflows.recipe.distributions.joint import Z_90

if TYPE_CHECKING:
    from neusee.workflows.calibration.calibration_page import CalibrationResult, ParameterEstimate
    from neusee.workflows.calibration.log_posterior import FloatArray

_TESTS = "what the tests of the frames leave open"
_PRIOR = "prior of the recipe"
_STEP = 1e-4  #: standard deviations of the prior, step of a derivative


class _Estimate(NamedTuple):
    """What is stated of a parameter, and the standard uncertainty that its posterior and its models give."""

    value: float
    posterior: float  #: of the mean of two models, before any widening
    model: float | None  #: half the distance of two models of the response; None where there is one model


def budgets(result: CalibrationResult, laboratory: Laboratory) -> list[Budget]:
    """Return the uncertainty budget of each parameter of which the calibration states a value.

    The variance of the posterior is split among the sources of the levels' scatter by the linear law of propagation.
    """
    rows = [row for row in result.rows() if row.kind == "estimate"]
    shares = _shares(result)
    freedom = _freedom(result)
    return [_budget(result, row, shares[row.name], freedom, laboratory) for row in rows]


def _budget(
    result: CalibrationResult,
    row: ParameterEstimate,
    shares: Mapping[str, float],
    freedom: Mapping[str, float],
    laboratory: Laboratory,
) -> Budget:
    found = _estimate(result, row)
    photons = -found.value if row.name == EFFICIENCY else 0.0
    lines = (
        *_of_posterior(found, row.unit, shares, freedom),
        _of_model(row.name, found, row.unit),
        _of_tests(result, row, found.value),
        *laboratory_contributions(row.name, found.value, photons, laboratory),
    )
    return Budget(row.name, row.name.replace("_", " "), "", row.unit, found.value, lines)


def _of_posterior(
    found: _Estimate, unit: str, shares: Mapping[str, float], freedom: Mapping[str, float]
) -> Iterator[Contribution]:
    for source, share in shares.items():
        kind, nu = ("B", math.inf) if source == _PRIOR else ("A", freedom.get(source, math.inf))
        yield Contribution(source, kind, "normal", found.posterior * math.sqrt(share), unit, 1.0, nu)  # type: ignore[arg-type]


def _of_model(name: str, found: _Estimate, unit: str) -> Contribution:
    if name in TERMS:
        return Contribution(MODEL, "B", reason=NOT_INVOLVED)
    if found.model is None:
        return Contribution(MODEL, "B", reason=f"{NOT_STATED}: one model only")
    return Contribution(MODEL, "B", "two points", found.model, unit)


def _of_tests(result: CalibrationResult, row: ParameterEstimate, value: float) -> Contribution:
    if len(result.frames) < 2:
        return Contribution(_TESTS, "B", reason=f"{NOT_STATED}: only moments are given")
    errors = errors_of_parameters(result.frames, result.problem.coordinates.prior.may_hide)
    width = errors.get(row.name, 0.0)
    if not width:
        return Contribution(_TESTS, "B", reason=NOT_INVOLVED)
    return Contribution(_TESTS, "B", "normal", width, "relative", value)


def _estimate(result: CalibrationResult, row: ParameterEstimate) -> _Estimate:
    models = {model.name: model for model in result.models}
    if row.name not in models:
        return _Estimate(row.mean, result.unwidened[row.name], None)
    model = models[row.name]
    linear = row.name in result.problem.coordinates.linear
    pairs = [_centre_and_width(each.value, each.low, each.high, linear) for each in model.models[-2:]]
    (fewer, narrow), (more, wide) = pairs[0], pairs[-1]
    scale = 1.0 if linear else model.stated.value
    apart = abs(fewer - more) / 2
    return _Estimate(model.stated.value, scale * width_of_mean(narrow, wide), scale * apart)


def _centre_and_width(value: float, low: float, high: float, linear: bool) -> tuple[float, float]:
    if linear:
        return value, (high - low) / (2 * Z_90)
    return math.log(value), math.log(high / low) / (2 * Z_90)


def _shares(result: CalibrationResult) -> dict[str, dict[str, float]]:
    """Return the share of each source in the variance of the posterior of each parameter."""
    problem, mode = result.problem, result.mode
    slopes = torch.from_numpy(mode.scaled_slopes)
    found = {STATISTICS: torch.ones(len(slopes), dtype=torch.float64)}
    if isinstance(problem.levels, Levels):
        values = {name: float(x) for name, x in problem.parameters(mode.theta).items()}
        found = camera_sources(problem.levels, {**result.params, **values})
    z = torch.from_numpy(problem.whitened(mode.theta))
    return {
        name: {(_PRIOR if source == "prior" else source): share for source, share in
               variance_shares(slopes, found, torch.from_numpy(along)).items()}
        for name, along in _derivatives(result, z.numpy()).items()
    }  # fmt: skip


def _derivatives(result: CalibrationResult, z: FloatArray) -> dict[str, FloatArray]:
    """Return the derivative (free,) of each parameter per standard deviation of each prior, at the mode."""
    coordinates = result.problem.coordinates
    step = _STEP * np.eye(len(z))
    high, low = (coordinates.from_whitened(torch.from_numpy(z + sign * step)) for sign in (1, -1))
    return {name: ((high[name] - low[name]) / (2 * _STEP)).numpy() for name in high}


def _freedom(result: CalibrationResult) -> dict[str, float]:
    levels = result.problem.levels
    if isinstance(levels, Levels):
        return source_freedom(levels, dict(result.params), result.problem.names)
    return {}
