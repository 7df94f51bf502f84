"""The section of a calibration's page that sets the least squares of EMVA 1288 beside the posterior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from neusee.nodes.calibrate import LeastSquares, least_squares
from neusee.workflows.report.study_page import Section, with_uncertainty

if TYPE_CHECKING:
    from neusee.nodes.values import Levels
    from neusee.workflows.calibration.calibration_page import ParameterEstimate

#: parameter of the posterior: field of `LeastSquares`, and what the field is called in EMVA 1288
QUANTITIES = {
    "gain": ("gain", "overall system gain K"),
    "quantum_efficiency": ("efficiency", "quantum efficiency \u03b7"),
    "read_noise": ("temporal_dark_noise", "temporal dark noise \u03c3_d"),
}
_TEXT = """The fit of the standard, of lines through the origin up to 70 % of saturation, on the same frames.
    Its error is that of the noise alone. It knows neither a bent response nor the uncertainty of the lamp, and its
    temporal dark noise includes the noise of the dark current, so that the two need not agree. The last column is their
    difference over the standard deviation of the posterior. Only quantities that the frames determine are compared."""


def least_squares_section(measured: Levels, estimates: Sequence[ParameterEstimate]) -> Section:
    """Return the comparison of the standard's least squares with the posterior, or the reason why there is none.

    ``measured`` are the statistics of the frames, ``estimates`` the rows of the posterior. A parameter of which the
    posterior is no estimate has no row: the standard's value would rest on what the frames do not tell.
    """
    heading = "Beside the least squares of EMVA 1288"
    told = {row.name: row for row in estimates if row.name in QUANTITIES and row.kind == "estimate"}
    if not told:
        return Section(heading, "The frames determine none of the quantities that the standard fits.")
    try:
        fit = least_squares(measured)
    except ValueError as reason:
        return Section(heading, f"The standard's fit is not possible: {reason}.")
    columns = ("quantity", "least squares", "posterior", "unit", "difference / sd")
    return Section(heading, _TEXT, columns, [_row(row, fit) for row in told.values()])


def compared(measured: Levels, estimates: Sequence[ParameterEstimate]) -> Mapping[str, Mapping[str, float]]:
    """Return value and standard error of the standard's fit for each parameter that the section compares."""
    try:
        fit = least_squares(measured)
    except ValueError:
        return {}
    names = [row.name for row in estimates if row.name in QUANTITIES and row.kind == "estimate"]
    return {name: dict(zip(("value", "error"), _value(fit, name), strict=True)) for name in names}


def _row(row: ParameterEstimate, fit: LeastSquares) -> tuple[str, str, str, str, float]:
    value, error = _value(fit, row.name)
    text = with_uncertainty(value, error)
    return QUANTITIES[row.name][1], text, with_uncertainty(row.mean, row.sd), row.unit, (value - row.mean) / row.sd


def _value(fit: LeastSquares, name: str) -> tuple[float, float]:
    field = QUANTITIES[name][0]
    return float(getattr(fit, field)), float(getattr(fit, f"{field}_error"))
