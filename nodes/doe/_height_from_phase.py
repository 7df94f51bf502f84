"""The height map of a mask that produces a given phase, and the check of a height map."""

import math
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check
from neusee.nodes.doe._refractive_index import AnyGlass, wave_height
from neusee.nodes.optics._pupil_grid import PupilGrid, inside


def height_from_phase(phase: Tensor, grid: PupilGrid, wavelength: float, material: AnyGlass) -> Tensor:
    """Return the height map (float32, m) that delays ``wavelength`` by ``phase``; the least height is 0.

    The height outside the stop is 0 too.
    """
    open_ = inside(grid, phase.device)
    raised = phase - torch.where(open_, phase, math.inf).min()
    return torch.where(open_, raised * (wave_height(material, wavelength) / (2 * math.pi)), 0.0).to(torch.float32)


def height_checks(height: Tensor, *_: Any, **__: Any) -> list[Check]:
    """Check that all heights are finite and at least 0, and state the least and the greatest height."""
    low, high = (float(value) for value in torch.aminmax(height))
    sound = math.isfinite(low) and math.isfinite(high) and low >= 0
    return [Check(f"height map from {low * 1e6:.3g} to {high * 1e6:.4g} um", sound)]
