"""The result of a linear propagation, and the page that shows it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from neusee.workflows.recipe.uncertain_inputs import Inputs
from neusee.workflows.report.study_report import Marked, Section, with_uncertainty
from neusee.workflows.studies.linear_propagation import LinearEstimate
from neusee.workflows.studies.uncertainty_page import MOST_NUMBERS, Rung, rung_section, tornado

_LITTLE = 0.01  #: inputs with a smaller share of a variance have no row


@dataclass(frozen=True)
class LinearResult:
    """The linear estimates of all numbers, or the reason why there are none."""

    inputs: Inputs
    deciding: tuple[str, ...]  #: quantities whose standard deviations must be accurate
    wanted: float  #: the requested relative error
    reason: str = ""  #: why nothing was propagated; empty if it was
    estimates: Mapping[str, LinearEstimate] = field(default_factory=dict)
    middle: Mapping[str, Sequence[float]] = field(default_factory=dict)
    #: for each output number: (input, value at its 5 %, value at its 95 %)
    swings: Mapping[str, Sequence[tuple[str, float, float]]] = field(default_factory=dict)
    runs: int = 0
    seconds_a_run: float | None = None
    is_constant: tuple[str, ...] = ()  #: outputs that depend on no input

    @property
    def worst(self) -> str:
        """Return the deciding quantity whose standard deviation has the largest relative error."""
        return max(self.deciding, key=lambda name: self.estimates[name].error)

    @property
    def error(self) -> float:
        """Return the largest relative error of the standard deviations in question."""
        return math.inf if self.reason else self.estimates[self.worst].error

    @property
    def holds(self) -> bool:
        """Return True if the standard deviations are known well enough, and all numbers are
        finite.
        """
        return self.error <= self.wanted and all(
            np.isfinite(estimate.sd).all() for estimate in self.estimates.values()
        )

    @property
    def statement(self) -> str:
        """Return in a sentence how accurate the linear propagation is."""
        if self.reason:
            return f"no linear propagation: {self.reason}; draws go on"
        known = f"{self.runs} runs of a linear propagation: the standard deviation of {self.worst}"
        parts = self.estimates[self.worst].reason
        if self.holds:
            return f"{known} is known to {self.error:.2%} ({parts})"
        return f"{known} is known to {self.error:.2%} only ({parts}); draws go on"

    @property
    def rung(self) -> Rung:
        """Return how accurate the linear propagation is, and what it took."""
        return Rung("linear", self.runs, self.seconds_a_run, self.error, self.holds)

    @property
    def input_rows(self) -> list[dict[str, str]]:
        """Return the name, label and distribution of each uncertain input."""
        law_text_of = self.inputs.uncertain.said
        labels = zip(self.inputs.names, self.inputs.labels, strict=True)
        return [{"name": name, "label": label, "law": law_text_of(name)} for name, label in labels]


def tornado_of_linear(linear: LinearResult) -> bytes | None:
    """Return the tornado diagram of the numbers as PNG; None if no single number varies."""
    swings = dict(list(linear.swings.items())[:MOST_NUMBERS])
    if not swings:
        return None
    diagram: bytes = tornado(swings, {name: linear.middle[name][0] for name in swings})
    return diagram


def lead_of_linear(linear: LinearResult) -> str:
    """Return the summary of a linear propagation in a few sentences."""
    names = ", ".join(linear.inputs.names)
    numbers = [
        f"{name} {_mean_and_sd(linear.estimates[name])}"
        for name in list(linear.swings)[:MOST_NUMBERS]
    ]
    values = f"\n\n{'; '.join(numbers)}." if numbers else ""
    return f"Linear propagation of {names}. {linear.statement}.{values}"


def _mean_and_sd(estimate: LinearEstimate) -> str:
    return with_uncertainty(float(estimate.mean[0]), float(estimate.sd[0]))


def sections_of_linear(linear: LinearResult, diagram: bytes | None) -> list[Section]:
    """Return the sections of the page of a linear propagation."""
    inputs_text = """The outputs are expanded about the medians of these values. A joint
        distribution is expanded along independent inputs: the first input moves all correlated
        values, and each further input the part of its value that the inputs before it leave
        free."""
    notes = linear.inputs.notes.items()
    note_texts = [f"{name} = {linear.inputs.uncertain.said(name)}: {note}." for name, note in notes]
    rows = [tuple(row.values()) for row in linear.input_rows]
    inputs_section = Section(
        "Inputs", "\n\n".join([inputs_text, *note_texts]), ("value", "expanded along", "law"), rows
    )
    return [
        inputs_section,
        _numbers(linear),
        _influence(linear, diagram),
        rung_section([linear.rung]),
        *_constant(linear),
    ]


def _numbers(linear: LinearResult) -> Section:
    """Return the section on the standard deviation of each quantity, and its error."""
    text = """Mean and standard deviation are those of the linear terms. Bias: what the quadratic
        terms add to the mean. The error of the standard deviation is relative; it is the sum of
        what the quadratic terms change, of what they miss at the 0.1 % and 99.9 % quantiles of
        each input, and of what they miss at 8 draws of all inputs together, an upper limit (95 %).
        It is an estimate: a jump that none of the runs meets is not in it. For a curve, the element
        of the largest standard deviation has the row. Quantiles, and the standard deviation of
        pictures, need draws."""
    columns = ("quantity", "at the medians", "mean", "sd", "bias", "error of sd")
    rows: list[Sequence[Any]] = []
    for name, estimate in linear.estimates.items():
        element = int(estimate.sd.argmax())
        label = name if len(estimate.sd) == 1 else f"{name}, element {element}"
        text_of_error = "does not vary" if estimate.is_constant else f"{estimate.error:.2%}"
        holds = estimate.error <= linear.wanted
        rows.append(
            (
                label,
                f"{linear.middle[name][element]:.6g}",
                f"{estimate.mean[element]:.6g}",
                float(estimate.sd[element]),
                float(estimate.bias[element]),
                Marked(text_of_error, "pass" if holds else "warn"),
            )
        )
    return Section("Numbers", text, columns, rows)


def _influence(linear: LinearResult, diagram: bytes | None) -> Section:
    """Return the section on the share of each input in the variance of each number."""
    text = f"""Each input alone at its 5 % and its 95 % quantile, all others at their medians. The
        table has the share of each input in the linear variance; inputs with a share of less than
        {_LITTLE:.0%} have no row."""
    rows: list[Sequence[Any]] = []
    for name in linear.swings:
        shares = linear.estimates[name].shares[:, 0]
        named_shares = zip(linear.inputs.labels, shares, strict=True)
        rows += [(name, label, float(share)) for label, share in named_shares if share > _LITTLE]
    columns = ("quantity", "input", "share of the variance")
    return Section("Influence of the inputs", text, columns, rows, diagram)


def _constant(linear: LinearResult) -> list[Section]:
    """Return the section on outputs and inputs that do not vary; empty if all vary."""
    sentences = []
    if linear.is_constant:
        sentences.append(f"Outputs that depend on no input: {', '.join(linear.is_constant)}.")
    if linear.inputs.idle:
        sentences.append(f"Inputs that change no output: {', '.join(linear.inputs.idle)}.")
    return [Section("What does not vary", "\n\n".join(sentences))] if sentences else []
