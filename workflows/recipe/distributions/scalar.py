"""Probability distribution of one recipe value, such as ``normal(10.5 e-, 0.5 e-)`` in place of ``10.5 e-``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from neusee.workflows.recipe.distributions.shapes import Discrete, FloatArray, LogNormal, LogUniform, Shape, Truncated

_PROBES = (0.3, -0.3, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0, 6.0, -6.0)  #: normal scores whose values are tried


@dataclass(frozen=True)
class Law:
    """Probability distribution of a recipe value or, for a gain in e-/DN, of its reciprocal."""

    kind: str
    text: str  #: as written in the recipe
    shape: Shape  #: of the number as written, in SI
    unit: str  #: SI unit of a draw; empty for a number without a unit
    reciprocal: bool = False  #: whether a draw is the reciprocal of a number from the distribution
    file: Path | None = None  #: file of the samples of an empirical distribution
    written_path: str = ""  #: of this file, as in the text

    def at(self, z: FloatArray) -> FloatArray:
        """Return the values of the distribution at the cumulative probabilities of standard normal numbers ``z``."""
        x = self.shape.at(np.asarray(z, np.float64))
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / x if self.reciprocal else x, np.float64)

    @property
    def median(self) -> float:
        """Return the median of the distribution; a run uses the median unless it samples the distribution."""
        return float(self.at(np.zeros(())))

    def other_than(self, value: float) -> float:
        """Return a value of the distribution that differs from ``value``, unless all others are rarer than 1e-9."""
        values = self.at(np.array(_PROBES))
        return float(next((x for x in values if x != value), value))

    @property
    def multiplies(self) -> bool:
        """Return True if a difference with this distribution is a factor, as that of a lognormal distribution."""
        shape = self.shape.shape if isinstance(self.shape, Truncated) else self.shape
        return isinstance(shape, LogNormal | LogUniform)

    @property
    def full_text(self) -> str:
        """Return the text with the absolute path of the file of samples, which is valid in any folder."""
        if self.file is None:
            return self.text
        return self.text.replace(self.written_path, f'"{self.file.resolve()}"', 1)

    @property
    def identity(self) -> str:
        """Return a text that differs for any two distributions, also for samples of a file whose content differs."""
        samples = self.shape.identity if isinstance(self.shape, Discrete) else ""
        return f"{self.text} {samples}".strip()

    def truncated(self, low: float, high: float) -> Law:
        """Return the distribution of numbers as written between two bounds in SI; raise ValueError if none is left."""
        return replace(self, shape=self.shape.truncated(low, high))


def draw_laws(laws: Mapping[str, Law], count: int, seed: Sequence[int], first: int = 0) -> dict[str, list[float]]:
    """Return ``count`` independent draws of each law in SI, from the number ``first`` on, by the name of the law."""
    z = np.random.default_rng(list(seed)).standard_normal((first + count, len(laws)))[first:]
    return {name: law.at(z[:, i]).tolist() for i, (name, law) in enumerate(laws.items())}


def written(value: float, unit: str) -> str | float:
    """Return a value in SI as it is written in a recipe: a number, or a text with the unit."""
    return f"{value!r} {unit}" if unit else value
