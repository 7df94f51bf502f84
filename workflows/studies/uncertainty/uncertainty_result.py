"""The result of a study of uncertainty: the draws, how each quantity scatters over them, and what moves it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from neusee.workflows.recipe.distributions.uncertain_inputs import Inputs, Points
from neusee.workflows.studies.uncertainty.scatter_estimate import Scatter, worst_known
from neusee.workflows.studies.uncertainty.sobol_indices import Indices

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Places = NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """All that the study measured."""

    inputs: Inputs
    points: Points  #: those that were used
    values: Mapping[str, Places]  #: by quantity (draw, element)
    scatter: Mapping[str, Scatter]
    middle: Mapping[str, Sequence[float]]  #: every input at its median
    swings: Mapping[str, Sequence[tuple[str, float, float]]]  #: by number: input, at its 5 %, at its 95 %
    shares: Mapping[str, Indices]  #: by number
    pictures: Mapping[str, tuple[Tensor, Tensor]]
    is_constant: tuple[str, ...]  #: outputs that no input reaches
    wanted: float  #: relative error
    sequences: int  #: of Sobol's points; 0 for independent draws

    @property
    def error(self) -> float:
        """The greatest relative error of a standard deviation."""
        return worst_known(self.scatter)[1]

    @property
    def worst(self) -> str:
        """The quantity that has it."""
        return worst_known(self.scatter)[0]

    @property
    def strange(self) -> list[str]:
        """Quantities that are not finite in some draw."""
        return [name for name, x in self.values.items() if not np.isfinite(x).all()]

    @property
    def failed(self) -> int:
        """Bars that do not hold: the error that was asked for, and that all is finite."""
        return len(self.strange) + (not self.error <= self.wanted)

    @property
    def numbers(self) -> list[str]:
        """Quantities of one element that vary, without those that are another one in another unit."""
        return list(self.swings)
