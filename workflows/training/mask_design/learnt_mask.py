"""The mask that an optimisation found, as both optimisers return it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from neusee.nodes.values import Stop


@dataclass
class LearntMask:
    """The best mask that an optimisation found, with its parameters, and the losses at all iterations."""

    height: Callable[[Stop], Tensor]
    loss: float
    numbers: dict[str, Any]  #: the parameters, if the mask has few parameters
    history: list[dict[str, float]]
    diameter: float | None = None  #: of a learnt stop, as a share of that of the lens
