"""The result of the uncertainty study, and the page that shows the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from neusee.workflows.engine.runner import run
from neusee.workflows.recipe.distributions.uncertain_inputs import InputDraws, Inputs
from neusee.workflows.report.contents import BANDS
from neusee.workflows.report.study_page import Mark, Section, with_uncertainty
from neusee.workflows.studies.uncertainty import uncertainty_figures as figures
from neusee.workflows.studies.uncertainty.scatter_estimate import FloatArray, Scatter, worst_known
from neusee.workflows.studies.uncertainty.sobol_indices import IndexInterval, SobolIndices

_MOST = 12  #: numbers in the pictures and in the lead
_LITTLE = 0.01  #: share of a variance; inputs with a smaller share have no row
_TOO_LITTLE = 0.5  #: share of a variance that a polynomial must predict for a row of indices
_TRANSFER = "sensor.photon_transfer"
_CONSTRAINT = {"upper": "only an upper limit", "lower": "only a lower limit", "none": "nothing"}


@dataclass(frozen=True)
class UncertaintyResult:
    """The result of the uncertainty study: draws of all inputs, and values and statistics of each quantity."""

    inputs: Inputs
    points: InputDraws  #: the used draws
    values: Mapping[str, FloatArray]  #: by quantity (draw, element)
    scatter: Mapping[str, Scatter]
    middle: Mapping[str, Sequence[float]]  #: by quantity, with every input at its median
    swings: Mapping[str, Sequence[tuple[str, float, float]]]  #: by number: input, value at its 5 %, value at its 95 %
    shares: Mapping[str, SobolIndices]  #: by number
    pictures: Mapping[str, tuple[Tensor, Tensor]]  #: mean and standard deviation by output
    is_constant: tuple[str, ...]  #: outputs that depend on no input
    wanted: float  #: the requested relative error
    sequences: int  #: number of Sobol sequences; 0 for independent draws
    deciding: tuple[str, ...]  #: quantities whose standard deviations decided when to stop
    left_out: str  #: draws whose values the recipe does not allow together; empty for none

    @property
    def worst(self) -> str:
        """Return the name of the deciding quantity whose standard deviation has the largest relative error."""
        return worst_known({name: self.scatter[name] for name in self.deciding})

    @property
    def error(self) -> float:
        """Return the largest relative error of the standard deviations that decided when to stop."""
        return self.scatter[self.worst].error

    @property
    def strange(self) -> list[str]:
        """Return the names of output quantities that are NaN or infinite in at least one draw."""
        return [name for name, x in self.values.items() if not np.isfinite(x).all()]

    @property
    def failed(self) -> int:
        """Return the number of quantities with NaN or infinity, plus 1 if a standard deviation is too inaccurate."""
        return len(self.strange) + (not self.error <= self.wanted)

    @property
    def input_rows(self) -> list[dict[str, Any]]:
        """Return the name, label, distribution, mean and standard deviation of each uncertain input."""
        said, columns = self.inputs.uncertain.said, self.points.values.T
        return [
            {"name": name, "label": label, "law": said(name), "mean": float(x.mean()), "sd": float(x.std(ddof=1))}
            for name, label, x in zip(self.inputs.names, self.inputs.labels, columns, strict=True)
        ]

    @property
    def numbers(self) -> list[str]:
        """Return the names of scalar quantities that vary between draws, one from each group of proportional ones."""
        return list(self.swings)


def draw_pictures(result: UncertaintyResult) -> dict[str, bytes]:
    """Draw the pictures of the uncertainty study's page, and return the pictures by name as PNG bytes."""
    shown = {}
    numbers = result.numbers[:_MOST]
    if numbers:
        middle = {name: result.middle[name][0] for name in numbers}
        shown["tornado"] = figures.tornado({name: result.swings[name] for name in numbers}, middle)
        shown["numbers"] = figures.histograms({name: result.values[name][:, 0] for name in numbers}, middle)
    if curves := _curves(result):
        shown["bands"] = figures.bands(*curves)
    for name, values in result.values.items():
        if _node_of(result, name) == _TRANSFER and np.isfinite(values).all():
            shown["transfer"] = figures.transfer(values.reshape(len(values), -1, 3))
    if result.pictures:
        shown["pictures"] = figures.pictures(result.pictures)
    return shown


def _curves(result: UncertaintyResult) -> tuple[dict[str, tuple[FloatArray, dict[str, FloatArray]]], str] | None:
    """Return the curves that vary between draws, with their abscissas, by step, and the label of the abscissa."""
    wavelengths = _wavelengths_nm(result)
    curves: dict[str, tuple[FloatArray, dict[str, FloatArray]]] = {}
    spectral = True
    for name, values in result.values.items():
        count = values.shape[1]
        known = np.isfinite(values).all() and not result.scatter[name].is_constant
        if count < 3 or not known or _node_of(result, name) == _TRANSFER:
            continue
        over_bands = len(wavelengths) == count
        spectral &= over_bands
        x = wavelengths if over_bands else np.arange(count, dtype=np.float64)
        family, _, arm = name.partition("[")
        curves.setdefault(family, (x, {}))[1][arm.rstrip("]") or family] = values
    return (curves, "wavelength (nm)" if spectral else "element") if curves else None


def _wavelengths_nm(result: UncertaintyResult) -> FloatArray:
    recipe = result.inputs.recipe
    if BANDS not in recipe.steps:
        return np.zeros(0)
    centres: FloatArray = run(recipe, None, [BANDS])[BANDS].centres.double().numpy()
    return centres * 1e9


def _node_of(result: UncertaintyResult, quantity: str) -> str:
    steps = result.inputs.recipe.steps
    step = steps.get(quantity) or steps.get(quantity.rpartition(".")[0])
    return step.node.path if step else ""


def lead(result: UncertaintyResult) -> str:
    """Return the summary of the uncertainty study in a few sentences."""
    count, kind = len(result.points.z), "Sobol points" if result.sequences else "independent draws"
    numbers = {name: result.scatter[name] for name in result.numbers[:_MOST]}
    values = [f"{name} {with_uncertainty(float(s.mean[0]), float(s.sd[0]))}" for name, s in numbers.items()]
    strange = f" NaN or infinite in some draw: {', '.join(result.strange)}." if result.strange else ""
    known = "; ".join([*_known(result), *_exceptions(result)])
    return f"{count} {kind} of {', '.join(result.inputs.names)}: {known}.{strange}\n\n{'; '.join(values)}."


def _known(result: UncertaintyResult) -> list[str]:
    """Return how well the standard deviations are known."""
    if len(result.deciding) == len(result.scatter):
        which, others = "every standard deviation", []
    else:
        which, other = f"the standard deviation of {', '.join(result.deciding)}", worst_known(result.scatter)
        others = [f"others did not decide, the least known is {other} to {result.scatter[other].error:.1%}"]
    if result.error <= result.wanted:
        return [f"{which} is known to {result.error:.1%}", *others]
    known = f"the standard deviation of {result.worst} is known to {result.error:.1%} only"
    return [known, f"{result.wanted:.1%} was requested", *others]


def _exceptions(result: UncertaintyResult) -> list[str]:
    """Return which numbers do not vary, and how many draws were left out."""
    constant = [name for name, s in result.scatter.items() if s.is_constant]
    parts = [f"{', '.join(constant)} {'does' if len(constant) == 1 else 'do'} not vary"] if constant else []
    return [*parts, f"left out: {result.left_out}"] if result.left_out else parts


def sections(result: UncertaintyResult, shown: Mapping[str, bytes]) -> list[Section]:
    """Return the sections of the uncertainty study's page; ``shown`` has the PNG bytes of each picture by name."""
    parts = [_inputs(result), *_posterior(result), _numbers(result, shown.get("numbers"))]
    parts += _moves(result, shown.get("tornado"))
    if "bands" in shown:
        parts.append(Section("Curves", "The middle 90 % of the draws, element by element.", picture=shown["bands"]))
    if "transfer" in shown:
        text = """The curves that a laboratory would measure with the drawn sensors, simulated by the recipe's steps.
            The prediction has no noise. Flat fields have the noise of their pixels, because each draw has its own
            light."""
        parts.append(Section("Photon-transfer curve", text, picture=shown["transfer"]))
    if "pictures" in shown:
        text = """Mean and standard deviation of each pixel over the first 32 draws; the standard deviation is known to
            13 %. The noise is the same in all draws, so only the inputs matter. pictures.npz has the numbers."""
        parts.append(Section("Pictures", text, picture=shown["pictures"]))
    return [*parts, *_rest(result)]


def _inputs(result: UncertaintyResult) -> Section:
    text = """The drawn values, in SI units. A joint distribution is drawn from independent inputs: the first input
        moves all correlated values, and each further input the part of its value that the inputs before it leave free.
        The same noise is drawn every time, so that only the inputs make a difference."""
    notes = result.inputs.notes
    cut = [f"{name} = {result.inputs.uncertain.said(name)}: {note}." for name, note in notes.items()]
    if result.left_out:
        cut.append(f"Left out: {result.left_out}; all numbers hold for the other draws.")
    text = "\n\n".join([text, *cut])
    rows = [(r["name"], r["label"], r["law"], f"{r['mean']:.6g}", r["sd"]) for r in result.input_rows]
    return Section("Inputs", text, ("value", "drawn as", "law", "mean", "sd"), rows)


def _posterior(result: UncertaintyResult) -> list[Section]:
    standings = [s for s in result.inputs.uncertain.standings if s.path in result.inputs.names]
    if not standings:
        return []
    text = """The position of the recipe's own value in the posterior. A value that the frames only limit, or do not
        determine, is drawn mostly from the prior of the calibration."""
    rows, marks = [], dict[tuple[int, int], Mark]()
    for i, s in enumerate(standings):
        rows.append((s.path, s.own, f"{s.mean:.6g}", s.sd, s.below, _CONSTRAINT.get(s.kind, "estimate")))
        if s.kind == "estimate":
            marks[i, 4] = "warn" if s.far else "pass"
        else:
            marks[i, 5] = "warn"
    columns = ("value", "recipe", "posterior mean", "sd", "posterior below it", "told")
    return [Section("The recipe beside its posterior", text, columns, rows, marks=marks)]


def _numbers(result: UncertaintyResult, picture: bytes | None) -> Section:
    how = f"from {result.sequences} scrambled Sobol sequences" if result.sequences else "by the jackknife"
    text = f"Error: the relative error of the standard deviation, {how}. For a curve, the worst element counts."
    columns = ("quantity", "at the medians", "mean", "sd", "error", "5 %", "95 %")
    rows, marks = list[Sequence[Any]](), dict[tuple[int, int], Mark]()
    for name, s in result.scatter.items():
        i = int(s.sd.argmax())
        label = name if len(s.sd) == 1 else f"{name}, element {i}"
        numbers = (f"{result.middle[name][i]:.6g}", f"{s.mean[i]:.6g}", float(s.sd[i]))
        marks[len(rows), 4] = "pass" if s.error <= result.wanted and name not in result.strange else "fail"
        error = "does not vary" if s.is_constant else f"{s.error:.1%}"
        rows.append((label, *numbers, error, f"{s.low[i]:.6g}", f"{s.high[i]:.6g}"))
    return Section("Numbers", text, columns, rows, picture, marks)


def _moves(result: UncertaintyResult, picture: bytes | None) -> list[Section]:
    if picture is None:
        return []
    text = f"""Each input alone at its 5 % and its 95 % quantile, all others at their medians. The table has Sobol
        indices, the shares of the inputs in the variance, with 95 % intervals. First: the effect of the input alone.
        Total: the effect alone and together with other inputs. Both are those of one polynomial, fitted to the draws.
        Explained: the share of the variance that this polynomial predicts for draws outside its fit. What is
        left may belong to any input, so that every interval contains it; below {_TOO_LITTLE:.0%} the inputs are not
        judged. Inputs with a total of less than {_LITTLE:.0%} have no row; provenance.json has all."""
    columns = ("quantity", "input", "first", "interval", "total", "interval", "explained")
    rows: list[Sequence[Any]] = []
    marks: dict[tuple[int, int], Mark] = {}
    for name, shares in result.shares.items():
        if not shares.explains_enough:
            marks[len(rows), 6] = "warn"
        if shares.explained < _TOO_LITTLE:
            rows.append((name, "not judged", None, None, None, None, f"{shares.explained:.0%}"))
            continue
        for label, first, total in zip(result.inputs.labels, shares.first, shares.total, strict=True):
            if total.value > _LITTLE:
                explained = f"{shares.explained:.1%}"
                rows.append((name, label, first.value, _between(first), total.value, _between(total), explained))
    return [Section("Influence of the inputs", text, columns, rows, picture, marks)]


def _between(index: IndexInterval) -> str:
    return f"{index.low:.2g} to {index.high:.2g}"


def _rest(result: UncertaintyResult) -> list[Section]:
    sentences = [f"Outputs that depend on no input: {', '.join(result.is_constant)}."] if result.is_constant else []
    if result.inputs.idle:
        sentences.append(f"Inputs that change no output and were not drawn: {', '.join(result.inputs.idle)}.")
    return [Section("What does not vary", "\n\n".join(sentences))] if sentences else []
