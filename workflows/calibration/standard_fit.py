"""The least squares of EMVA 1288 beside the posterior: a section of the page, and a check that both agree."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from neusee.nodes.calibrate import LeastSquares, expected_levels, least_squares
from neusee.workflows.calibration.posterior_checks import Check, Mark
from neusee.workflows.report.study_page import Section, with_uncertainty

if TYPE_CHECKING:
    from neusee.nodes.values import Levels
    from neusee.workflows.calibration.calibration_page import ParameterEstimate

#: parameter of the posterior: field of `LeastSquares`, and what the field is called in EMVA 1288
QUANTITIES = {
    "gain": ("gain", "overall system gain K"),
    "quantum_efficiency": ("efficiency", "quantum efficiency \u03b7"),
    "read_noise": ("temporal_dark_noise", "temporal dark noise \u03c3_d"),
    "temporal_dark_noise": ("temporal_dark_noise", "temporal dark noise \u03c3_d"),
}
_APART = 3.0  #: combined standard deviations between the posterior and its least squares, above which it is refused
_TEXT = """The fit of the standard, of lines through the origin up to 70 % of saturation, on the same frames.
    Its error is that of the noise alone. It knows neither a bent response nor the uncertainty of the lamp, so that the
    two need not agree. The column of the posterior's own line is the same fit on the levels that the
    posterior predicts, bend and all: these two must agree. The last column is their difference over the combined
    standard deviation. Only quantities that the frames determine are compared."""


class Comparison(NamedTuple):
    """A quantity by the standard's least squares, and by the same fit on the levels that the posterior predicts."""

    name: str
    value: float
    error: float  #: standard error of `value` by noise alone
    predicted: float  #: by the fit on the predicted levels; the value of the posterior where nothing predicts levels
    apart: float  #: difference over the combined standard deviation


def comparisons(
    measured: Levels, estimates: Sequence[ParameterEstimate], camera: Mapping[str, Any] | None
) -> list[Comparison]:
    """Return the comparison of each quantity that the frames determine; none where the standard's fit is impossible.

    ``measured`` are the statistics of the frames, ``estimates`` the rows of the posterior, and ``camera`` the
    parameters of `calibrate.camera`, or None for another likelihood.
    """
    rows = [row for row in estimates if row.name in QUANTITIES and row.kind == "estimate"]
    try:
        fit = least_squares(measured)
    except ValueError:
        return []
    own = _own_fit(measured, estimates, camera)
    return [_compared(row, fit, own) for row in rows]


def agreement(found: Sequence[Comparison]) -> list[Check]:
    """Return if posterior and least squares agree, as a check that refuses the posterior; none without a comparison."""
    if not found:
        return []
    worst = max(found, key=lambda one: abs(one.apart))
    label = QUANTITIES[worst.name][1]
    text = f"{label}: least squares {worst.value:.5g}, by the posterior {worst.predicted:.5g}, {worst.apart:+.1f} sd"
    good = abs(worst.apart) <= _APART
    if not good:
        text += ": refused, one of them is wrong, and the frames do not say which"
    mark: Mark = "pass" if good else "fail"
    return [Check("the posterior agrees with its least squares", text, f"within {_APART:.0f} combined sd", mark)]


def least_squares_section(
    measured: Levels, estimates: Sequence[ParameterEstimate], found: Sequence[Comparison]
) -> Section:
    """Return the comparison of the standard's least squares with the posterior, or the reason why there is none.

    A parameter of which the posterior is no estimate has no row: the standard's value would rest on what the frames do
    not tell.
    """
    heading = "Beside the least squares of EMVA 1288"
    rows = {row.name: row for row in estimates if row.name in QUANTITIES and row.kind == "estimate"}
    if not rows:
        return Section(heading, "The frames determine none of the quantities that the standard fits.")
    if not found:
        return Section(heading, f"The standard's fit is not possible: {_reason(measured)}.")
    columns = ("quantity", "least squares", "posterior's own line", "posterior", "unit", "difference / sd")
    return Section(heading, _TEXT, columns, [_row(rows[comparison.name], comparison) for comparison in found])


def compared(found: Sequence[Comparison]) -> Mapping[str, Mapping[str, float]]:
    """Return value and standard error of the standard's fit for each parameter that the section compares."""
    return {one.name: {"value": one.value, "error": one.error} for one in found}


def _own_fit(
    measured: Levels, estimates: Sequence[ParameterEstimate], camera: Mapping[str, Any] | None
) -> LeastSquares | None:
    if camera is None:
        return None
    values = {**camera, **{row.name: row.mean for row in estimates}}
    try:
        fit: LeastSquares = least_squares(expected_levels(measured, values))
    except ValueError:
        return None
    return fit


def _compared(row: ParameterEstimate, fit: LeastSquares, own: LeastSquares | None) -> Comparison:
    value, error = _value(fit, row.name)
    predicted = row.mean if own is None else _value(own, row.name)[0]
    width = abs(predicted) * math.hypot(row.sd / row.mean, error / value) if value else math.inf
    return Comparison(row.name, value, error, predicted, (value - predicted) / width)


def _reason(measured: Levels) -> str:
    try:
        least_squares(measured)
    except ValueError as reason:
        return str(reason)
    return "it gives no value"


def _row(row: ParameterEstimate, one: Comparison) -> tuple[str, str, str, str, str, float]:
    value, posterior = with_uncertainty(one.value, one.error), with_uncertainty(row.mean, row.sd)
    return QUANTITIES[row.name][1], value, f"{one.predicted:.5g}", posterior, row.unit, one.apart


def _value(fit: LeastSquares, name: str) -> tuple[float, float]:
    field = QUANTITIES[name][0]
    return float(getattr(fit, field)), float(getattr(fit, f"{field}_error"))
