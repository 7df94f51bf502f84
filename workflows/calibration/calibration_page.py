"""The page of a calibration: parameters with intervals or limits, identifiability, checks and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from neusee.nodes.calibrate import Budget, FrameTest, Rings, Sufficient
from neusee.nodes.values import Levels
from neusee.workflows.calibration import calibration_figures as figures
from neusee.workflows.calibration.budget_page import budget_picture, budget_sections
from neusee.workflows.calibration.corner_figure import corners
from neusee.workflows.calibration.frame_validity import frame_section
from neusee.workflows.calibration.identifiability import KINDS, Identifiability
from neusee.workflows.calibration.laboratory import RELATIVE, stated
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.model_spread import IntervalEstimate, ModelSpread
from neusee.workflows.calibration.posterior_checks import Check, count_failures
from neusee.workflows.calibration.posterior_mode import LaplaceFit
from neusee.workflows.calibration.standard_fit import least_squares_section
from neusee.workflows.report.study_page import Mark, Section, with_uncertainty

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.emcee_sampler import Chains
    from neusee.workflows.calibration.log_posterior import FloatArray

_PREDICTED = 400  #: draws for the band of the predicted variance
_CORNER = 20_000  #: draws for the picture of pairs
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
    unwidened: Mapping[str, float] = field(default_factory=dict)  #: sd of each parameter in the draws of the walk
    budgets: Sequence[Budget] = ()  #: the uncertainty budgets of the estimates

    @cached_property
    def budget_picture(self) -> bytes | None:
        """Return the picture of the uncertainty budgets, or None where nothing has a value."""
        return budget_picture(self.budgets) if self.budgets else None

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
    return f"Not fit for use: {len(wrong)} of {len(result.checks)} checks fail. {'; '.join(wrong)}."


def lead(result: CalibrationResult) -> str:
    """Return the opening of a calibration's page: estimates, values to report, and undetermined parameters."""
    values = [f"{_words(row.name)} {row.text}" for row in result.rows()]
    stated = [f"{_words(m.name)} {_between(m.stated)}" for m in estimated_models(result)]
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


def _words(name: str) -> str:
    return name.replace("_", " ")


def sections(result: CalibrationResult) -> list[Section]:
    """Return the sections of a calibration's page: parameters, checks, identifiability and pictures."""
    models = (_models,) if result.models else ()
    frames = (_frames,) if result.frames else ()
    standard = (_standard,) if result.problem.measured is not None else ()
    parts = (_checks, *frames, _not_determined, _curve, _corner, _chains)
    budget = budget_sections(result.budgets, stated(result.problem.recipe), result.budget_picture)
    return [*(part(result) for part in (_parameters, *standard, *models)), *budget, *(part(result) for part in parts)]


def _standard(result: CalibrationResult) -> Section:
    assert result.problem.measured is not None
    return least_squares_section(result.problem.measured, result.rows())


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
        (_words(r.name), r.text, r.end("low"), r.end("high"), r.unit, f"{r.nominal:.6g}", r.share, r.narrower)
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
    columns = ("parameter", *(f"{n} terms" for n in range(len(result.models[0].models))), "stated", "unit")
    rows = [
        (_words(m.name), *map(_between, (*m.models, m.stated)), unit_of(m.name, result.params))
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


def _curve(result: CalibrationResult) -> Section:
    if isinstance(result.problem.levels, Rings):
        return _rings(result, result.problem.levels)
    rng = np.random.default_rng(1)
    flat = result.chains.flat
    look = result.problem.likelihood(flat[rng.integers(len(flat), size=_PREDICTED)])
    levels: Any = result.problem.levels
    mean, variance, freedom = look.mean.numpy(), look.variance.numpy(), levels.degrees_of_freedom.numpy()
    chance = rng.standard_normal(variance.shape) * np.sqrt(2 / freedom.clip(1))
    whole: NDArray[np.bool_] = np.asarray((variance > 0).all(0))
    whole[levels.cell_level.numpy()] = False
    picture = figures.transfer(np.stack(_moments(levels)), np.stack([mean, variance * (1 + chance)]), whole)
    text = """The measured variance of each level against its mean, and the prediction of the posterior for a repeated
        measurement. If a level is clipped by the well or the converter, or too coarse for a mean and a variance, each
        of its digital numbers enters the likelihood, and the level has no prediction here."""
    return Section("Photon-transfer curve", text, picture=picture)


def _rings(result: CalibrationResult, rings: Rings) -> Section:
    rng, flat = np.random.default_rng(1), result.chains.flat
    look = result.problem.likelihood(flat[rng.integers(len(flat), size=_PREDICTED)])
    picture = figures.rings(*ring_radii(rings), rings.mean.numpy(), look.mean.numpy(), look.variance.numpy())
    text = """The mean signal of each ring about the source, and the prediction of the posterior for a repeated
        measurement. Rings whose every pixel is cut off only bound the signal from below."""
    return Section("Rings about the source", text, picture=picture)


def ring_radii(rings: Rings) -> tuple[FloatArray, FloatArray]:
    """Return the root mean square radius of each averaged ring, and of each ring that is cut off, in pixels."""
    at, count = rings.ring.numpy(), rings.weight.numpy()
    square = np.bincount(at, count * rings.square.numpy()) / np.bincount(at, count)
    return np.sqrt(square), np.sqrt(rings.cut_square.numpy())


def _moments(levels: Sufficient | Levels) -> tuple[FloatArray, FloatArray]:
    """Return the mean and the variance of all digital numbers of each light level, including histograms."""
    if isinstance(levels, Levels):
        return levels.mean.numpy(), levels.variance.numpy()
    at, value, count = (x.numpy() for x in levels[-3:])
    total, mean, variance = (x.numpy() for x in (levels.pixels, levels.mean, levels.variance))
    sums = [np.bincount(at, count * value**n, minlength=len(total)) for n in range(3)]
    every = total + sums[0]
    middle = (total * mean + sums[1]) / every
    square = total * (variance + mean**2) + sums[2]
    return middle, square / every - middle**2


def _corner(result: CalibrationResult) -> Section:
    every = max(1, result.chains.flat.shape[0] // _CORNER)
    told = [r for r in result.rows() if r.kind != "none"]
    shown = np.stack([result.draws[r.name].reshape(-1)[::every] for r in told], -1)
    text = """Every pair of parameters of which the frames tell a value or a limit; the recipe's own values are orange.
        Gain, offset, noise and efficiency correlate."""
    picture = corners(shown, [f"{_words(r.name)}\n{r.unit}" for r in told], [r.nominal for r in told])
    return Section("Parameters in pairs", text, picture=picture)


def _chains(result: CalibrationResult) -> Section:
    text = "Four independent ensembles of walkers, in the coordinates of the posterior."
    picture = figures.traces(result.chains.draws, result.problem.coordinates.labels)
    return Section("Chains", text, picture=picture)
