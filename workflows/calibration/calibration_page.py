"""The page of a calibration: parameters, checks, and the least-squares fits of EMVA 1288."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from neusee.nodes.calibrate import (
    Budget,
    FrameTest,
    LeastSquares,
    Rings,
    expected_levels,
    least_squares,
)
from neusee.workflows.calibration.calibration_figures import (
    chains_section,
    corner_section,
    curve_section,
)
from neusee.workflows.calibration.frame_validity import IntervalEstimate, ModelSpread, frame_section
from neusee.workflows.calibration.identifiability import KINDS, Identifiability, words_of
from neusee.workflows.calibration.log_posterior import LaplaceFit, SensorPosterior
from neusee.workflows.calibration.posterior_checks import Check, Mark, count_failures, is_camera
from neusee.workflows.calibration.uncertainty_budget import (
    RELATIVE,
    budget_picture,
    budget_sections,
    stated,
)
from neusee.workflows.report.study_report import Marked, Section, with_uncertainty

if TYPE_CHECKING:
    from neusee.nodes.values import Levels
    from neusee.workflows.calibration.emcee_sampler import Chains
    from neusee.workflows.calibration.log_posterior import FloatArray


# --- standard fit ---------------------------------------------------------------------------------

# The least-squares fit of EMVA 1288 next to the posterior: a section of the page, and a check that
# both agree.


#: for each parameter of the posterior: the field of `LeastSquares`, and its name in EMVA 1288
QUANTITIES = {
    "gain": ("gain", "overall system gain K"),
    "quantum_efficiency": ("efficiency", "quantum efficiency \u03b7"),
    "read_noise": ("temporal_dark_noise", "temporal dark noise \u03c3_d"),
    "temporal_dark_noise": ("temporal_dark_noise", "temporal dark noise \u03c3_d"),
}
#: difference between the posterior's own fit and the measured one, in combined standard deviations,
#: above which the posterior is refused
_MOST_COMBINED_SD = 3.0
_TEXT = """The fit of the standard, of lines through the origin up to 70 % of saturation, on the
    same frames. Its error is that of the noise alone. It knows neither a bent response nor the
    uncertainty of the lamp, so that the two need not agree. The column of the posterior's own line
    is the same fit on the levels that the posterior predicts, bend and all: these two must agree.
    The last column is their difference over the combined standard deviation. Only quantities that
    the frames determine are compared."""


class Comparison(NamedTuple):
    """A quantity from the standard's least-squares fit to the frames, and from the same fit to the
    levels that the posterior predicts.
    """

    name: str
    value: float
    error: float  #: standard error of `value` by noise alone
    #: from the fit to the predicted levels, or the posterior's mean if no levels are predicted
    predicted: float
    apart: float  #: difference over the combined standard deviation


def comparisons(
    measured: Levels, estimates: Sequence[ParameterEstimate], camera: Mapping[str, Any] | None
) -> list[Comparison]:
    """Return the comparison of each quantity that the frames determine; empty if the standard's fit
    is impossible.

    ``measured`` are the statistics of the frames, ``estimates`` the rows of the posterior, and
    ``camera`` the parameters of `calibrate.camera`, or None for another likelihood.
    """
    rows = [row for row in estimates if row.name in QUANTITIES and row.kind == "estimate"]
    try:
        fit = least_squares(measured)
    except ValueError:
        return []
    posterior_fit = _own_fit(measured, estimates, camera)
    return [_compared(row, fit, posterior_fit) for row in rows]


def agreement(comparisons: Sequence[Comparison]) -> list[Check]:
    """Return the check that the posterior agrees with the least-squares fit, as a list of one;
    empty without a comparison.
    """
    if not comparisons:
        return []
    worst = max(comparisons, key=lambda comparison: abs(comparison.apart))
    label = QUANTITIES[worst.name][1]
    text = (
        f"{label}: least squares {worst.value:.5g}, by the posterior {worst.predicted:.5g},"
        f" {worst.apart:+.1f} sd"
    )
    agrees = abs(worst.apart) <= _MOST_COMBINED_SD
    if not agrees:
        text += ": refused, because one of the two is wrong, and the frames do not show which"
    mark: Mark = "pass" if agrees else "fail"
    return [
        Check(
            "the posterior agrees with its least squares",
            text,
            f"at most {_MOST_COMBINED_SD:.0f} combined sd",
            mark,
        )
    ]


def least_squares_section(
    measured: Levels, estimates: Sequence[ParameterEstimate], comparisons: Sequence[Comparison]
) -> Section:
    """Return the section that compares the standard's least-squares fit with the posterior, or says
    why it cannot.

    A parameter that the posterior does not estimate has no row: the standard's value would depend
    on quantities that the frames do not determine.
    """
    heading = "Beside the least squares of EMVA 1288"
    rows = {row.name: row for row in estimates if row.name in QUANTITIES and row.kind == "estimate"}
    if not rows:
        return Section(
            heading, "The frames determine none of the quantities that the standard fits."
        )
    if not comparisons:
        return Section(heading, f"The standard's fit is not possible: {_reason(measured)}.")
    columns = (
        "quantity",
        "least squares",
        "posterior's own line",
        "posterior",
        "unit",
        "difference / sd",
    )
    return Section(
        heading,
        _TEXT,
        columns,
        [_row(rows[comparison.name], comparison) for comparison in comparisons],
    )


def compared(comparisons: Sequence[Comparison]) -> Mapping[str, Mapping[str, float]]:
    """Return value and standard error of the standard's fit for each compared parameter."""
    return {
        comparison.name: {"value": comparison.value, "error": comparison.error}
        for comparison in comparisons
    }


def _own_fit(
    measured: Levels, estimates: Sequence[ParameterEstimate], camera: Mapping[str, Any] | None
) -> LeastSquares | None:
    """Return the standard's fit to the levels that the posterior predicts.

    It is None without a camera, and where the fit is impossible.
    """
    if camera is None:
        return None
    values = {**camera, **{row.name: row.mean for row in estimates}}
    try:
        fit: LeastSquares = least_squares(expected_levels(measured, values))
    except ValueError:
        return None
    return fit


def _compared(row: ParameterEstimate, fit: LeastSquares, own: LeastSquares | None) -> Comparison:
    """Return one row of the comparison.

    ``fit`` is the standard's fit to the frames, ``own`` its fit to the levels that the posterior
    predicts, or None.
    """
    value, error = _value(fit, row.name)
    predicted = row.mean if own is None else _value(own, row.name)[0]
    # the relative errors of both values, added in quadrature
    combined_sd = (
        abs(predicted) * math.hypot(row.sd / row.mean, error / value) if value else math.inf
    )
    return Comparison(row.name, value, error, predicted, (value - predicted) / combined_sd)


def _reason(measured: Levels) -> str:
    """Return the reason why the standard's fit to these levels is impossible."""
    try:
        least_squares(measured)
    except ValueError as reason:
        return str(reason)
    return "the fit gives no value"


def _row(row: ParameterEstimate, comparison: Comparison) -> tuple[str, str, str, str, str, float]:
    """Return the cells of a row of the table, in the order of its columns."""
    value = with_uncertainty(comparison.value, comparison.error)
    posterior = with_uncertainty(row.mean, row.sd)
    return (
        QUANTITIES[row.name][1],
        value,
        f"{comparison.predicted:.5g}",
        posterior,
        row.unit,
        comparison.apart,
    )


def _value(fit: LeastSquares, name: str) -> tuple[float, float]:
    field = QUANTITIES[name][0]
    return float(getattr(fit, field)), float(getattr(fit, f"{field}_error"))


# --- calibration page -----------------------------------------------------------------------------

# The page of a calibration: parameters with intervals or limits, identifiability, checks and
# pictures.


#: for each kind of result: the fields that the frames do not determine
NOT_TOLD = {
    "estimate": (),
    "between": ("mean", "sd"),
    "upper": ("mean", "sd", "low"),
    "lower": ("mean", "sd", "high"),
    "none": ("mean", "sd", "low", "high"),
}
#: parameters without a unit
_PURE = ("quantum_efficiency", "spread", "scatter", "lamp", "bend", "twist", "l", "s", "core")


@dataclass(frozen=True)
class ParameterEstimate:
    """The posterior of one parameter: mean, standard deviation and interval, next to the nominal
    value of the recipe.
    """

    name: str
    unit: str
    kind: str  #: one of `KINDS`
    mean: float
    sd: float
    low: float  #: 5 %
    high: float  #: 95 %
    nominal: float  #: the value in the recipe
    share: float  #: share of the draws below ``nominal``
    narrower: float  #: width of the posterior over that of the prior

    @property
    def text(self) -> str:
        """Return the estimate or limit with its unit as text, or a statement that the frames give
        neither.
        """
        if self.kind == "estimate":
            return f"{with_uncertainty(self.mean, self.sd)} {self.unit}".rstrip()
        if self.kind == "none":
            return KINDS["none"]
        if self.kind == "between":
            return (
                f"{self.low:.3g} to {self.high:.3g} {self.unit}".rstrip()
                + " (90 %, depends on the prior)"
            )
        limit = f"below {self.high:.3g}" if self.kind == "upper" else f"above {self.low:.3g}"
        return f"{limit} {self.unit}".rstrip() + " (95 %, depends on the prior)"

    def end(self, which: Literal["low", "high"]) -> str:
        """Return the 5 % or the 95 % end of the interval as text; a dash if it comes only from the
        prior.
        """
        return "–" if which in NOT_TOLD[self.kind] else f"{getattr(self, which):.6g}"


@dataclass(frozen=True)
class CalibrationResult:
    """The results of a calibration: posterior mode, identifiability, Markov chains, checks and
    camera responses.
    """

    problem: SensorPosterior
    mode: LaplaceFit
    identifiability: Identifiability
    chains: Chains
    checks: Sequence[Check]
    models: Sequence[ModelSpread] = ()  #: models of a camera of unknown response
    frames: Sequence[FrameTest] = ()  #: the tests of the frames
    #: draws of the walkers before `chains` was widened by errors that the frames may hide
    walk: Chains | None = None
    budgets: Sequence[Budget] = ()  #: the uncertainty budgets of the estimates

    @cached_property
    def budget_picture(self) -> bytes | None:
        """Return the PNG bytes of the uncertainty budgets, or None without a budget."""
        return budget_picture(self.budgets) if self.budgets else None

    @cached_property
    def beside(self) -> Sequence[Comparison]:
        """Return the comparison of the EMVA 1288 least squares with the posterior; empty for a
        lens.
        """
        if self.problem.measured is None:
            return []
        camera = self.params if is_camera(self.problem) else None
        return comparisons(self.problem.measured, self.rows(), camera)

    @property
    def walked(self) -> Chains:
        """Return the draws of the walkers before any widening, which follow from the levels and
        priors alone.
        """
        return self.walk or self.chains

    @cached_property
    def unwidened(self) -> Mapping[str, float]:
        """Return the standard deviation of each parameter in the draws of the walkers."""
        return {
            name: float(x.std()) for name, x in self.problem.parameters(self.walked.draws).items()
        }

    @property
    def params(self) -> Mapping[str, Any]:
        """Return the parameters of the step that computes the likelihood, as the recipe
        gives them.
        """
        return self.problem.recipe.steps[self.problem.step].params

    @property
    def draws(self) -> Mapping[str, FloatArray]:
        """Return the posterior draws (ensemble, step, walker) of each sensor parameter by name."""
        return {name: x.numpy() for name, x in self.problem.parameters(self.chains.draws).items()}

    def rows(self) -> list[ParameterEstimate]:
        """Return the posterior estimate of each sensor parameter."""
        named_draws = zip(self.draws.items(), self.mode.shares.tolist(), strict=True)
        return [self._estimate(name, draws, narrower) for (name, draws), narrower in named_draws]

    def _estimate(self, name: str, draws: FloatArray, narrower: float) -> ParameterEstimate:
        """Return the estimate of one parameter from its draws.

        ``narrower`` is the ratio of the posterior's width to the prior's.
        """
        interval_low, interval_high = np.quantile(draws, [0.05, 0.95]).tolist()
        nominal, kind = float(self.params[name]), self.identifiability.kinds[name]
        share_below, unit = float((draws < nominal).mean()), unit_of(name, self.params)
        mean, sd = float(draws.mean()), float(draws.std())
        return ParameterEstimate(
            name, unit, kind, mean, sd, interval_low, interval_high, nominal, share_below, narrower
        )


def unit_of(name: str, params: Mapping[str, Any]) -> str:
    """Return the unit of a parameter of the nodes `calibrate.density`, `.camera` or
    `.stray_light`.
    """
    if name == "gain":
        return "DN/e-"
    if name == "dark_current":
        return f"e- in {params['dark_exposure']:g} s"
    return {"dark_signal": "DN", "drift": "DN", "b0": "1/sr", **dict.fromkeys(_PURE, "")}.get(
        name, "e-"
    )


def banner(result: CalibrationResult) -> str:
    """Return a warning that lists the failed checks; empty if no check fails."""
    failures = [f"{check.name}: {check.found}" for check in result.checks if check.mark == "fail"]
    if not failures:
        return ""
    failure_share = (
        f"{len(failures)} of {len(result.checks)} checks fail{'s' * (len(failures) == 1)}"
    )
    return f"Not fit for use: {failure_share}. {'; '.join(failures)}."


def lead(result: CalibrationResult) -> str:
    """Return the opening of a calibration's page: estimates, values to report, and undetermined
    parameters.
    """
    values = [f"{words_of(row.name)} {row.text}" for row in result.rows()]
    stated = [f"{words_of(m.name)} {_between(m.stated)}" for m in estimated_models(result)]
    return "\n\n".join(
        f"{opening}{'; '.join(items)}."
        for opening, items in (
            ("", values),
            (
                (
                    "To be stated, with 90 % intervals that include the difference between models"
                    " of the response: "
                ),
                stated,
            ),
            ("Not determined by these frames: ", result.identifiability.directions),
        )
        if items
    )


def estimated_models(result: CalibrationResult) -> list[ModelSpread]:
    """Return the response models for each parameter that the frames determine."""
    return [
        model for model in result.models if result.identifiability.kinds[model.name] == "estimate"
    ]


def sections(result: CalibrationResult) -> list[Section]:
    """Return the sections of a calibration's page: parameters, checks, identifiability and
    pictures.
    """
    model_sections = (_models,) if result.models else ()
    frame_sections = (_frames,) if result.frames else ()
    standard_sections = (_standard,) if result.problem.measured is not None else ()
    last_sections = (
        _checks,
        *frame_sections,
        _not_determined,
        curve_section,
        corner_section,
        chains_section,
    )
    budget_part = budget_sections(
        result.budgets, stated(result.problem.recipe), result.budget_picture
    )
    return [
        *(section(result) for section in (_parameters, *standard_sections, *model_sections)),
        *budget_part,
        *(section(result) for section in last_sections),
    ]


def _standard(result: CalibrationResult) -> Section:
    assert result.problem.measured is not None
    return least_squares_section(result.problem.measured, result.rows(), result.beside)


def _frames(result: CalibrationResult) -> Section:
    return frame_section(result.frames)


def _parameters(result: CalibrationResult) -> Section:
    """Return the table of all parameters, with estimate or limit, interval and the recipe's value.

    It has estimate or limit, interval, and the recipe's own value.
    """
    text = """A value is given only if the posterior is less than a third as wide as the prior.
        Otherwise there is a limit, which depends on the prior, and a dash stands for an end that
        only the prior gives. The last columns show the share of the draws below the recipe's own
        value, and the width of the posterior divided by the width of the prior."""
    columns = (
        "parameter",
        "posterior",
        "5 %",
        "95 %",
        "unit",
        "recipe",
        "draws below it",
        "width / prior",
    )
    rows = [
        (
            words_of(r.name),
            r.text,
            r.end("low"),
            r.end("high"),
            r.unit,
            f"{r.nominal:.6g}",
            _judged_share(r),
            r.narrower,
        )
        for r in result.rows()
    ]
    heading = "The lens" if isinstance(result.problem.levels, Rings) else "The sensor"
    return Section(heading, text, columns, rows)


def _judged_share(r: ParameterEstimate) -> Marked:
    """Return the share of the draws below the recipe's value, marked if the frames estimate it."""
    if r.kind != "estimate":
        return Marked(r.share)
    return Marked(r.share, "pass" if 0.005 <= r.share <= 0.995 else "warn")


def _models(result: CalibrationResult) -> Section:
    """Return the table that compares models of the response with no, one and two more terms."""
    text = """The posterior with a linear response, and with responses of one and of two more terms,
        each with its 90 % interval. The stated value is the mean of the two models with the most
        terms. The stated standard deviation is the larger one of both models and half the distance
        of both values, added in quadrature. The interval of a single model is too narrow."""
    columns = (
        "parameter",
        *(f"{n} term{'s' * (n != 1)}" for n in range(len(result.models[0].models))),
        "stated",
        "unit",
    )
    rows = [
        (words_of(m.name), *map(_between, (*m.models, m.stated)), unit_of(m.name, result.params))
        for m in estimated_models(result)
    ]
    return Section("How models of the response differ", text, columns, rows)


def _between(interval: IntervalEstimate) -> str:
    return f"{interval.value:.5g} ({interval.low:.5g} to {interval.high:.5g})"


def _checks(result: CalibrationResult) -> Section:
    """Return the table of all checks, with the number of failed ones."""
    rows = [
        (check.name, check.found, check.bar, Marked(check.mark, check.mark))
        for check in result.checks
    ]
    count = count_failures(result.checks)
    summary = f"{count} fail: the posterior is not fit for use." if count else "No check fails."
    return Section("Checks", summary, ("check", "found", "bar", "holds"), rows)


def _not_determined(result: CalibrationResult) -> Section:
    """Return the table of the singular values, with the weakest and their directions last.

    The weakest stand last, named by the direction that each belongs to.
    """
    text = """Singular values of the derivatives of the levels per standard deviation of the prior,
        computed before any sampling. In a direction below 3 the prior constrains the parameters
        more than the frames do."""
    strengths = result.identifiability.strengths
    directions = [line for line in result.identifiability.directions if line != RELATIVE]
    # the weakest directions come last, and only they have a name
    labels = [""] * (len(strengths) - len(directions)) + directions
    rows = [
        (Marked(strength, "warn" if direction else "pass"), direction)
        for strength, direction in zip(strengths, labels, strict=True)
    ]
    return Section("What the levels determine", text, ("strength", "not determined"), rows)
