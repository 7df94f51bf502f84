"""Smallest feature of a fabrication tool: the average of a height map over the spot of the tool."""

import math
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import refuse_half
from neusee.nodes.doe._height_from_phase import height_checks
from neusee.nodes.optics._pupil_grid import grid_of, refuse_other_grid
from neusee.nodes.units import PupilPitch
from neusee.nodes.values import Stop

_REACH = 6.0  #: standard deviations beyond which the spot holds 1e-9 of its dose


@node(rtol=1e-5)
def smooth(height: Tensor, stop: Stop, *, feature: PupilPitch) -> Tensor:
    """Average the height map over the round Gaussian spot of a tool, whose full width at half maximum is ``feature``.

    Depth follows dose, and dose is the wanted height averaged over the spot: steps get flanks of ``feature``, pillars
    that are narrower vanish, planes and wide features stay. An average lies between the least and the greatest
    height under the spot, so the mask does not become deeper. At the edge of the grid, the average covers only the
    samples inside the grid. The spot is a Gaussian and not a disc, whose transfer function has negative lobes: with a
    Gaussian, features that are too small fade, and no feature is inverted.

    Shapes: (v, u), stop -> (v, u).
    Units:  m.
    Error:  1e-6 of the deepest height (float32). A spot below 1.5 samples is not resolved by the grid.
    Raises: ValueError for a height in half precision, or of another shape than the pupil grid.
    Source: Gaussian spot of laser lithography: Gale et al., Opt. Eng. 33, 3556 (1994).
    """
    refuse_half(height=height)
    grid = grid_of(stop)
    refuse_other_grid(height, grid)
    average = _average(grid.samples, feature / grid.pitch).to(height)
    return average @ height @ average.T


def _average(samples: int, feature: float) -> Tensor:
    """Return the float64 matrix that averages along one axis over a tool spot of ``feature`` samples; each row sums to
    1.
    """
    sigma = feature / math.sqrt(8 * math.log(2))
    index = torch.arange(samples, dtype=torch.float64)
    weights = torch.exp(-((index[:, None] - index) ** 2) / (2 * sigma**2))
    weights = weights.where((index[:, None] - index).abs() <= _REACH * sigma + 0.5, 0.0)
    return weights / weights.sum(1, keepdim=True)


@smooth.reference
def _(height: Tensor, stop: Stop, *, feature: float) -> Tensor:
    """Compute the average of the height map over the tool's spot, for the samples of one row after another."""
    samples, pitch, _ = grid_of(stop)
    sigma = feature / pitch / math.sqrt(8 * math.log(2))
    x, index = height.double(), torch.arange(samples, dtype=torch.float64)
    across = (index[:, None, None] - index).square()  # of each spot, over all columns
    rows = []
    for v in range(samples):
        spots = torch.exp(-((index[:, None] - v).square() + across) / (2 * sigma**2))
        rows.append((spots * x).sum((1, 2)) / spots.sum((1, 2)))
    return torch.stack(rows)


@smooth.preflight
def _(*, stop: Stop | None, feature: float) -> list[str]:
    if stop is not None and feature < 1.5 * float(stop.pitch):
        pitch = f"{float(stop.pitch) * 1e6:.3g} um"
        return [f"feature {feature * 1e6:.3g} um is less than 1.5 samples of {pitch}: not resolved"]
    return []


@smooth.check
def _(result: Tensor, height: Tensor, *_: Any, feature: float, **__: Any) -> list[Check]:
    change = float((result - height).detach().double().square().mean().sqrt())
    text = f"features below {feature * 1e6:.3g} um smoothed: {change * 1e9:.3g} nm root mean square"
    return [Check(text), *height_checks(result)]
