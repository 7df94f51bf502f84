"""A calibration on paper: the parameters with their intervals and limits, what cannot be told, checks and pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.nodes.calibrate import Sufficient
from neusee.nodes.values import Levels
from neusee.workflows.calibration import calibration_figures as figures
from neusee.workflows.calibration.identifiability import KINDS, Known
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.model_spread import Figure, ModelSpread
from neusee.workflows.calibration.posterior_checks import Check, failed
from neusee.workflows.calibration.posterior_mode import LaplaceFit
from neusee.workflows.report.study_page import Mark, Section

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.emcee_sampler import Chains
    from neusee.workflows.calibration.log_posterior import Places

_PREDICTED = 400  #: draws that a band is made of
_CORNER = 20_000  #: draws that a picture is made of
_PURE = ("quantum_efficiency", "spread", "scatter", "lamp", "bend", "twist")  #: parameters without a unit


@dataclass(frozen=True)
class ParameterRow:
    """What is known of one parameter."""

    name: str
    unit: str
    kind: str  #: one of `KINDS`
    mean: float
    sd: float
    low: float  #: 5 %
    high: float  #: 95 %
    nominal: float  #: what the recipe says
    share: float  #: of the draws that lie below that
    narrower: float  #: width over that of the prior

    @property
    def said(self) -> str:
        """The value, a limit, or that there is none."""
        if self.kind == "estimate":
            return f"{beside(self.mean, self.sd)} {self.unit}".rstrip()
        if self.kind == "none":
            return KINDS["none"]
        limit = f"below {self.high:.3g}" if self.kind == "upper" else f"above {self.low:.3g}"
        return f"{limit} {self.unit}".rstrip() + " (95 %, depends on the prior)"


@dataclass(frozen=True)
class Finding:
    """All that a calibration found."""

    problem: SensorPosterior
    peak: LaplaceFit
    known: Known
    chains: Chains
    checks: Sequence[Check]
    models: Sequence[ModelSpread] = ()  #: of a camera whose response is not known

    @property
    def draws(self) -> Mapping[str, Places]:
        """Of each parameter all draws: (ensemble, step, walker)."""
        return {name: x.numpy() for name, x in self.problem.parameters(self.chains.draws).items()}

    def rows(self) -> list[ParameterRow]:
        """One a parameter."""
        params = self.problem.recipe.steps[self.problem.step].params
        found = []
        for (name, draws), share in zip(self.draws.items(), self.peak.shares, strict=True):
            low, high = np.quantile(draws, [0.05, 0.95])
            nominal, kind = float(params[name]), self.known.kinds[name]
            below, unit = float((draws < nominal).mean()), unit_of(name, params)
            mean, sd = float(draws.mean()), float(draws.std())
            found.append(
                ParameterRow(name, unit, kind, mean, sd, float(low), float(high), nominal, below, float(share))
            )
        return found


def beside(mean: float, sd: float) -> str:
    """A mean with as many digits as two of its deviation ask for."""
    if not sd > 0:
        return f"{mean:.6g} ± {sd:g}"
    digits = 1 - math.floor(math.log10(sd))
    return f"{mean:.{digits}f} ± {sd:.{digits}f}" if 0 <= digits <= 12 else f"{mean:.5g} ± {sd:.2g}"


def unit_of(name: str, params: Mapping[str, Any]) -> str:
    """Of a parameter of `density` or of `camera`."""
    if name == "gain":
        return "DN/e-"
    if name == "dark_current":
        return f"e- in {params['dark_exposure']:g} s"
    return {"dark_signal": "DN", "drift": "DN", **dict.fromkeys(_PURE, "")}.get(name, "e-")


def banner(finding: Finding) -> str:
    """What is wrong with it; empty where nothing is."""
    wrong = [f"{check.name}: {check.found}" for check in finding.checks if check.mark == "fail"]
    if not wrong:
        return ""
    return f"Not fit for use: {len(wrong)} of {len(finding.checks)} checks fail. {'; '.join(wrong)}."


def lead(finding: Finding) -> str:
    """What came out."""
    values = [f"{row.name.replace('_', ' ')} {row.said}" for row in finding.rows()]
    untold = f"\n\nNot told by these frames: {'; '.join(finding.known.directions)}." if finding.known.directions else ""
    return "; ".join(values) + "." + _stated(finding) + untold


def _stated(finding: Finding) -> str:
    """What a camera whose response is not known is: wider than one model of it says."""
    known = [m for m in finding.models if finding.known.kinds[m.name] == "estimate"]
    said = [f"{m.name.replace('_', ' ')} {_between(m.stated)}" for m in known]
    how = "To be stated, with 90 % intervals that hold how models of the response differ"
    return f"\n\n{how}: {'; '.join(said)}." if said else ""


def sections(finding: Finding) -> list[Section]:
    """Parameters, checks, what cannot be told, and the pictures."""
    models = (_models,) if finding.models else ()
    return [part(finding) for part in (_parameters, *models, _checks, _untold, _curve, _corner, _chains)]


def _parameters(finding: Finding) -> Section:
    text = """A value stands only where the frames narrow the prior to less than a third; elsewhere a limit, which
        depends on the prior. The last columns: where the recipe's own value lies among the draws, and how much narrower
        than the prior the posterior is."""
    columns = ("parameter", "posterior", "5 %", "95 %", "unit", "recipe", "draws below it", "width / prior")
    rows = [_told(r) for r in finding.rows()]
    marks: dict[tuple[int, int], Mark] = {
        (i, 6): "pass" if 0.005 <= r.share <= 0.995 else "warn"
        for i, r in enumerate(finding.rows())
        if r.kind == "estimate"
    }
    return Section("The sensor", text, columns, rows, marks=marks)


def _told(r: ParameterRow) -> Sequence[Any]:
    numbers = (f"{x:.6g}" for x in (r.low, r.high))
    return r.name.replace("_", " "), r.said, *numbers, r.unit, f"{r.nominal:.6g}", r.share, r.narrower


def _models(finding: Finding) -> Section:
    text = """The same levels by a response that is straight, bent once and bent twice, each with its 90 % interval, and
        what is to be stated: the middle of the two richest, with the wider of both and half their distance. A single
        model is surer than it may be."""
    count = len(finding.models[0].models)
    columns = ("parameter", *(f"{n} terms" for n in range(count)), "stated", "unit")
    params = finding.problem.recipe.steps[finding.problem.step].params
    rows = [
        (m.name.replace("_", " "), *map(_between, (*m.models, m.stated)), unit_of(m.name, params))
        for m in finding.models
    ]
    return Section("How models of the response differ", text, columns, rows)


def _between(figure: Figure) -> str:
    return f"{figure.value:.5g} ({figure.low:.5g} to {figure.high:.5g})"


def _checks(finding: Finding) -> Section:
    rows = [(check.name, check.found, check.bar, check.mark) for check in finding.checks]
    marks: dict[tuple[int, int], Mark] = {(i, 3): check.mark for i, check in enumerate(finding.checks)}
    count = failed(finding.checks)
    text = f"{count} fail: the posterior is not fit for use." if count else "None fails."
    return Section("Checks", text, ("check", "found", "bar", "holds"), rows, marks=marks)


def _untold(finding: Finding) -> Section:
    text = """Before anything is drawn: the singular values of what the levels tell, by standard deviations of the
        prior. In a direction below 3 the prior says more than the frames do."""
    said = list(finding.known.directions)
    weak = len(finding.known.strengths) - len(said)
    rows = [(s, "" if i < weak else said[i - weak]) for i, s in enumerate(finding.known.strengths)]
    marks: dict[tuple[int, int], Mark] = {(i, 0): "warn" if text else "pass" for i, (_, text) in enumerate(rows)}
    return Section("What the levels tell", text, ("strength", "not told"), rows, marks=marks)


def _curve(finding: Finding) -> Section:
    rng = np.random.default_rng(1)
    flat = finding.chains.flat
    look = finding.problem.look(flat[rng.integers(len(flat), size=_PREDICTED)])
    levels = finding.problem.levels
    mean, variance, freedom = look.mean.numpy(), look.variance.numpy(), levels.degrees_of_freedom.numpy()
    chance = rng.standard_normal(variance.shape) * np.sqrt(2 / freedom.clip(1))
    whole: NDArray[np.bool_] = np.asarray((variance > 0).all(0))
    whole[levels.cell_level.numpy()] = False
    measured = np.stack([*_moments(levels), freedom])
    picture = figures.transfer(measured, np.stack([mean, variance * (1 + chance)]), whole)
    text = """The measured variance of each level against its mean, and what the posterior predicts for another such
        measurement. Levels that the well or the converter cuts off, or that are too coarse for a mean and a variance,
        are weighed number by number and have no prediction here."""
    return Section("Photon-transfer curve", text, picture=picture)


def _moments(levels: Sufficient | Levels) -> tuple[Places, Places]:
    """Mean and variance of all numbers of each level, counted or not."""
    if isinstance(levels, Levels):
        return levels.mean.numpy(), levels.variance.numpy()
    at, value, count = (x.numpy() for x in levels[-3:])
    total, mean, variance = (x.numpy() for x in (levels.pixels, levels.mean, levels.variance))
    sums = [np.bincount(at, count * value**n, minlength=len(total)) for n in range(3)]
    every = total + sums[0]
    middle = (total * mean + sums[1]) / every
    square = total * (variance + mean**2) + sums[2]
    return middle, square / every - middle**2


def _corner(finding: Finding) -> Section:
    draws = finding.draws
    every = max(1, finding.chains.flat.shape[0] // _CORNER)
    shown = np.stack([x.reshape(-1)[::every] for x in draws.values()], -1)
    names = [f"{r.name.replace('_', ' ')}\n{r.unit}" for r in finding.rows()]
    text = "Every pair of parameters; in orange what the recipe says. Gain, offset, noise and efficiency go together."
    picture = figures.corners(shown, names, [r.nominal for r in finding.rows()])
    return Section("Parameters in pairs", text, picture=picture)


def _chains(finding: Finding) -> Section:
    text = "Four ensembles that know nothing of each other, in the coordinates in which they walked."
    picture = figures.traces(finding.chains.draws, finding.problem.coordinates.labels)
    return Section("Chains", text, picture=picture)
