"""The page of a calibration: parameters with intervals or limits, identifiability, checks and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from neusee.nodes.calibrate import Budget, FrameTest, Rings
from neusee.workflows.calibration.budget_page import budget_picture, budget_sections
from neusee.workflows.calibration.frame_validity import frame_section
from neusee.workflows.calibration.identifiability import KINDS, Identifiability
from neusee.workflows.calibration.laboratory import RELATIVE, stated
from neusee.workflows.calibration.level_misfit import is_camera
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.model_spread import IntervalEstimate, ModelSpread
from neusee.workflows.calibration.picture_sections import chains_section, corner_section, curve_section, words
from neusee.workflows.calibration.posterior_checks import Check, count_failures
from neusee.workflows.calibration.posterior_mode import LaplaceFit
from neusee.workflows.calibration.standard_fit import Comparison, comparisons, least_squares_section
from neusee.workflows.report.study_page import Mark, Section, with_uncertainty

if TYPE_CHECKING:
    from neusee.workflows.calibration.emcee_sampler import Chains
    from neusee.workflows.calibration.log_posterior import FloatArray

#: by kind of a result: the numbers that the frames do not give
NOT_TOLD = {
    "estimate": (),
    "between": ("mean", "sd"),
    "upper": ("mean", "sd", "low"),
    "lower": ("mean", "sd", "high"),
    "none": ("mean", "sd", "low", "high"),
}
#: without a unit
_PURE = ("quantum_efficiency", "spread", "scatter", "lamp", "bend", "twist", "l", "s", "core")


@dataclass(frozen=True)
class ParameterEstimate:
    """The posterior of one parameter: mean, standard deviation and interval, compared with the recipe's own value."""

    name: str
    unit: str
    kind: str  #: one of `KINDS`
    mean: float
    sd: float
    low: float  #: 5 %
    high: float  #: 95 %
    nominal: float  #: the recipe's own value
    share: float  #: of the draws that lie below ``nominal``
    narrower: float  #: width of the posterior over that of the prior

    @property
    def text(self) -> str:
        """Return the estimate or limit of a parameter as text with its unit, or say that the frames give neither."""
        if self.kind == "estimate":
            return f"{with_uncertainty(self.mean, self.sd)} {self.unit}".rstrip()
        if self.kind == "none":
            return KINDS["none"]
        if self.kind == "between":
            return f"{self.low:.3g} to {self.high:.3g} {self.unit}".rstrip() + " (90 %, depends on the prior)"
        limit = f"below {self.high:.3g}" if self.kind == "upper" else f"above {self.low:.3g}"
        return f"{limit} {self.unit}".rstrip() + " (95 %, depends on the prior)"

    def end(self, which: Literal["low", "high"]) -> str:
        """Return the 5 % or the 95 % end of the interval as text, or a dash where only the prior gives it."""
        return "–" if which in NOT_TOLD[self.kind] else f"{getattr(self, which):.6g}"


@dataclass(frozen=True)
class CalibrationResult:
    """The results of a calibration: posterior mode, identifiability, Markov chains, checks and camera responses."""

    problem: SensorPosterior
    mode: LaplaceFit
    identifiability: Identifiability
    chains: Chains
    checks: Sequence[Check]
    models: Sequence[ModelSpread] = ()  #: of a camera of unknown response
    frames: Sequence[FrameTest] = ()  #: the tests of the frames
    walk: Chains | None = None  #: the draws of the walkers, where `chains` also has what the frames may hide
    budgets: Sequence[Budget] = ()  #: the uncertainty budgets of the estimates

    @cached_property
    def budget_picture(self) -> bytes | None:
        """Return the picture of the uncertainty budgets, or None where nothing has a value."""
        return budget_picture(self.budgets) if self.budgets else None

    @cached_property
    def beside(self) -> Sequence[Comparison]:
        """Return the least squares of EMVA 1288 beside the posterior; none for a lens."""
        if self.problem.measured is None:
            return []
        camera = self.params if is_camera(self.problem) else None
        return comparisons(self.problem.measured, self.rows(), camera)

    @property
    def walked(self) -> Chains:
        """Return the draws of the walkers themselves, which the levels alone determine."""
        return self.walk or self.chains

    @cached_property
    def unwidened(self) -> Mapping[str, float]:
        """Return the standard deviation of each parameter in the draws of the walkers."""
        return {name: float(x.std()) for name, x in self.problem.parameters(self.walked.draws).items()}

    @property
    def params(self) -> Mapping[str, Any]:
        """Return the parameters that the recipe gives to the step that computes the likelihood."""
        return self.problem.recipe.steps[self.problem.step].params

    @property
    def draws(self) -> Mapping[str, FloatArray]:
        """Return the posterior draws (ensemble, step, walker) of each sensor parameter by name."""
        return {name: x.numpy() for name, x in self.problem.parameters(self.chains.draws).items()}

    def rows(self) -> list[ParameterEstimate]:
        """Return the posterior estimate of each sensor parameter."""
        rows = zip(self.draws.items(), self.mode.shares.tolist(), strict=True)
        return [self._estimate(name, draws, narrower) for (name, draws), narrower in rows]

    def _estimate(self, name: str, draws: FloatArray, narrower: float) -> ParameterEstimate:
        low, high = np.quantile(draws, [0.05, 0.95]).tolist()
        nominal, kind = float(self.params[name]), self.identifiability.kinds[name]
        below, unit = float((draws < nominal).mean()), unit_of(name, self.params)
        mean, sd = float(draws.mean()), float(draws.std())
        return ParameterEstimate(name, unit, kind, mean, sd, low, high, nominal, below, narrower)


def unit_of(name: str, params: Mapping[str, Any]) -> str:
    """Return the unit of a parameter of the likelihood: `calibrate.density`, `.camera` or `.stray_light`."""
    if name == "gain":
        return "DN/e-"
    if name == "dark_current":
        return f"e- in {params['dark_exposure']:g} s"
    return {"dark_signal": "DN", "drift": "DN", "b0": "1/sr", **dict.fromkeys(_PURE, "")}.get(name, "e-")


def banner(result: CalibrationResult) -> str:
    """Return a warning that names the failed checks, or an empty text if no check fails."""
    wrong = [f"{check.name}: {check.found}" for check in result.checks if check.mark == "fail"]
    if not wrong:
        return ""
    count = f"{len(wrong)} of {len(result.checks)} checks fail{'s' * (len(wrong) == 1)}"
    return f"Not fit for use: {count}. {'; '.join(wrong)}."


def lead(result: CalibrationResult) -> str:
    """Return the opening of a calibration's page: estimates, values to report, and undetermined parameters."""
    values = [f"{words(row.name)} {row.text}" for row in result.rows()]
    stated = [f"{words(m.name)} {_between(m.stated)}" for m in estimated_models(result)]
    return "\n\n".join(
        f"{opening}{'; '.join(parts)}."
        for opening, parts in (
            ("", values),
            ("To be stated, with 90 % intervals that include the difference between models of the response: ", stated),
            ("Not determined by these frames: ", result.identifiability.directions),
        )
        if parts
    )


def estimated_models(result: CalibrationResult) -> list[ModelSpread]:
    """Return the models of the response for each parameter that the frames determine; others have no value."""
    return [model for model in result.models if result.identifiability.kinds[model.name] == "estimate"]


def sections(result: CalibrationResult) -> list[Section]:
    """Return the sections of a calibration's page: parameters, checks, identifiability and pictures."""
    models = (_models,) if result.models else ()
    frames = (_frames,) if result.frames else ()
    standard = (_standard,) if result.problem.measured is not None else ()
    parts = (_checks, *frames, _not_determined, curve_section, corner_section, chains_section)
    budget = budget_sections(result.budgets, stated(result.problem.recipe), result.budget_picture)
    return [*(part(result) for part in (_parameters, *standard, *models)), *budget, *(part(result) for part in parts)]


def _standard(result: CalibrationResult) -> Section:
    assert result.problem.measured is not None
    return least_squares_section(result.problem.measured, result.rows(), result.beside)


def _frames(result: CalibrationResult) -> Section:
    return frame_section(result.frames)


def _parameters(result: CalibrationResult) -> Section:
    text = """A value is given only if the posterior is less than a third as wide as the prior. Otherwise there is a
        limit, which depends on the prior, and a dash stands for an end that only the prior gives. The last columns
        show the share of the draws below the recipe's own value,
        and the width of the posterior divided by the width of the prior."""
    columns = ("parameter", "posterior", "5 %", "95 %", "unit", "recipe", "draws below it", "width / prior")
    estimates = result.rows()
    rows = [
        (words(r.name), r.text, r.end("low"), r.end("high"), r.unit, f"{r.nominal:.6g}", r.share, r.narrower)
        for r in estimates
    ]
    marks: dict[tuple[int, int], Mark] = {
        (i, 6): "pass" if 0.005 <= r.share <= 0.995 else "warn" for i, r in enumerate(estimates) if r.kind == "estimate"
    }
    return Section(
        "The lens" if isinstance(result.problem.levels, Rings) else "The sensor", text, columns, rows, marks=marks
    )


def _models(result: CalibrationResult) -> Section:
    text = """The posterior with a linear response, and with responses of one and of two more terms, each with its 90 %
        interval. The stated value is the mean of the two models with the most terms. The stated standard deviation is
        the larger one of both models and half the distance of both values, added in quadrature. The interval of a
        single model is too narrow."""
    columns = (
        "parameter",
        *(f"{n} term{'s' * (n != 1)}" for n in range(len(result.models[0].models))),
        "stated",
        "unit",
    )
    rows = [
        (words(m.name), *map(_between, (*m.models, m.stated)), unit_of(m.name, result.params))
        for m in estimated_models(result)
    ]
    return Section("How models of the response differ", text, columns, rows)


def _between(interval: IntervalEstimate) -> str:
    return f"{interval.value:.5g} ({interval.low:.5g} to {interval.high:.5g})"


def _checks(result: CalibrationResult) -> Section:
    rows = [(check.name, check.found, check.bar, check.mark) for check in result.checks]
    marks: dict[tuple[int, int], Mark] = {(i, 3): check.mark for i, check in enumerate(result.checks)}
    count = count_failures(result.checks)
    text = f"{count} fail: the posterior is not fit for use." if count else "No check fails."
    return Section("Checks", text, ("check", "found", "bar", "holds"), rows, marks=marks)


def _not_determined(result: CalibrationResult) -> Section:
    text = """Singular values of the derivatives of the levels per standard deviation of the prior, computed before any
        sampling. In a direction below 3 the prior constrains the parameters more than the frames do."""
    strengths = result.identifiability.strengths
    directions = [line for line in result.identifiability.directions if line != RELATIVE]
    rows = list(zip(strengths, [""] * (len(strengths) - len(directions)) + [*directions], strict=True))
    marks: dict[tuple[int, int], Mark] = {(i, 0): "warn" if text else "pass" for i, (_, text) in enumerate(rows)}
    return Section("What the levels determine", text, ("strength", "not determined"), rows, marks=marks)
