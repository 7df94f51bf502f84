"""Probability distribution of one recipe value, such as ``normal(10.5 e-, 0.5 e-)`` in place of ``10.5 e-``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neusee.nodes.units import read_written

FloatArray = NDArray[np.float64]

#: meaning of the two arguments of each kind of distribution
KINDS = {
    "normal": ("the mean", "the standard deviation"),
    "lognormal": ("the median", "the factor of one standard deviation"),
    "uniform": ("the least", "the largest value"),
    "loguniform": ("the least", "the largest value"),
}
_BEGIN = re.compile(rf"\s*({'|'.join(KINDS)})\(")
_CALL = re.compile(rf"({'|'.join(KINDS)})\((.*)\)", re.DOTALL)


@dataclass(frozen=True)
class Law:
    """Probability distribution of a recipe value or, for a gain in e-/DN, of its reciprocal, with arguments in SI."""

    kind: str
    text: str  #: as written in the recipe
    first: float
    second: float
    unit: str  #: SI unit of a draw; empty for a number without a unit
    reciprocal: bool = False  #: whether a draw is the reciprocal of a number from the distribution

    def at(self, z: FloatArray) -> FloatArray:
        """Return the values of the distribution at the cumulative probabilities of standard normal numbers ``z``."""
        from scipy.special import ndtr

        a, b = self.first, self.second
        with np.errstate(over="ignore", divide="ignore"):
            if self.kind == "normal":
                x = a + b * z
            elif self.kind == "lognormal":
                x = a * np.exp(np.log(b) * z)
            elif self.kind == "uniform":
                x = a + (b - a) * ndtr(z)
            else:
                x = a * np.exp(np.log(b / a) * ndtr(z))
            return np.asarray(1.0 / x if self.reciprocal else x, np.float64)

    @property
    def median(self) -> float:
        """Return the median of the distribution; a run uses the median unless it samples the distribution."""
        return float(self.at(np.zeros(())))


def is_law(text: Any) -> bool:
    """Return True if a recipe value is a text that begins with the name of a distribution, such as ``normal(``."""
    return isinstance(text, str) and _BEGIN.match(text) is not None


def read_law(text: str) -> Law:
    """Return the probability distribution in a text; raise ValueError with the correct form for an invalid text."""
    match = _CALL.fullmatch(text.strip())
    if match is None:
        raise ValueError("the text is not a complete distribution: write kind(…, …), in quotes inside [ ] or { }")
    kind, arguments = match[1], [part.strip() for part in match[2].split(",")]
    if len(arguments) != 2 or not all(arguments):
        raise ValueError(f"the distribution {kind} needs {' and '.join(KINDS[kind])}: write {kind}(…, …)")
    (first, unit, reciprocal), (second, other, also) = map(read_written, arguments)
    if kind == "lognormal":
        if other:
            raise ValueError(f"{KINDS[kind][1]} is a number without a unit, such as 1.1, not {arguments[1]}")
    elif (unit, reciprocal) != (other, also):
        raise ValueError(f"{arguments[0]} and {arguments[1]} must have the same unit")
    if fault := _fault(kind, first, second):
        raise ValueError(fault)
    return Law(kind, text.strip(), first, second, unit, reciprocal)


def _fault(kind: str, first: float, second: float) -> str:
    if kind == "normal":
        return "" if second > 0 else "the standard deviation must be greater than 0"
    if kind == "lognormal":
        return "" if first > 0 and second > 1 else "the median must be greater than 0, and the factor than 1"
    if not first < second:
        return "the first value must be smaller than the second"
    return "" if kind == "uniform" or first > 0 else "the least value must be greater than 0"


def draw_laws(laws: Mapping[str, Law], count: int, seed: Sequence[int], first: int = 0) -> dict[str, list[float]]:
    """Return ``count`` independent draws of each law in SI, from the number ``first`` on, by the name of the law."""
    z = np.random.default_rng(list(seed)).standard_normal((first + count, len(laws)))[first:]
    return {name: law.at(z[:, i]).tolist() for i, (name, law) in enumerate(laws.items())}


def written(value: float, unit: str) -> str | float:
    """Return a value in SI as it is written in a recipe: a number, or a text with the unit."""
    return f"{value!r} {unit}" if unit else value
