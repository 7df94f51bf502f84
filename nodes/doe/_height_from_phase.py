"""Conversion of a phase to the relief that produces this phase, and the check of a relief."""

import math
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check
from neusee.nodes.doe._refractive_index import Material, wave_height
from neusee.nodes.optics._pupil_grid import PupilGrid, inside


def height_from_phase(phase: Tensor, grid: PupilGrid, wavelength: float, material: Material) -> Tensor:
    """Height, float32 in m, that delays ``wavelength`` by ``phase``: 0 at the lowest point and outside the stop."""
    open_ = inside(grid, phase.device)
    lifted = phase - phase[open_].min()
    return torch.where(open_, lifted * (wave_height(material, wavelength) / (2 * math.pi)), 0.0).to(torch.float32)


def height_checks(height: Tensor, *_: Any, **__: Any) -> list[Check]:
    """How deep the relief is, and that it can be made at all: finite and nowhere below 0."""
    low, high = (float(value) for value in torch.aminmax(height))
    sound = math.isfinite(low) and math.isfinite(high) and low >= 0
    return [Check(f"relief from {low * 1e6:.3g} to {high * 1e6:.4g} um", sound)]
