"""Shapes of the results of the calibration nodes; where a result has histogram cells, their number
depends on the data and is not known before the run.
"""

from typing import Any

from torch import Tensor

from neusee.nodes.calibrate._emva_sheet import LeastSquares, least_squares
from neusee.nodes.calibrate._light_levels import expose
from neusee.nodes.shape_rules import blank, scalars

least_squares.shape(scalars(LeastSquares))


@expose.shape
def _(*, shape: tuple[int, int], frames: int = 2, **params: Any) -> Tensor:
    return blank(frames, *shape)
