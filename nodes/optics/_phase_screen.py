"""Smooth random phase screens over the pupil, the same at every sampling of the pupil."""

import math

import torch
from torch import Tensor

from neusee.nodes.optics._pupil_grid import PupilGrid, axes


def screen(grid: PupilGrid, scale: float, rng: torch.Generator, device: torch.device | None = None) -> Tensor:
    """Return a random phase screen (v, u), float64: Gaussian noise with variance 1 and correlation exp(-(d /
    scale)**2).
    """
    rows, columns = factors(grid, scale, rng, device)
    return rows @ columns


def factors(
    grid: PupilGrid, scale: float, rng: torch.Generator, device: torch.device | None = None
) -> tuple[Tensor, Tensor]:
    """Return matrices (v, n) and (n, u) whose product is a random phase screen, so that single rows can be computed.

    ``scale`` is in units of the diameter. Gaussians of width scale / 2 smooth white noise on a lattice. The lattice
    does not depend on the sampling of the pupil, so the screen does not depend on the sampling either.
    """
    width = scale / 2
    half = max(0.5, grid.samples * grid.pitch / (2 * grid.diameter)) + 4 * width
    count = 2 * math.ceil(half / width) + 1
    white = torch.randn(count, count, generator=rng, device=rng.device, dtype=torch.float64)
    line = axes(grid, device)[0] / 2
    centres = (torch.arange(count, dtype=torch.float64, device=line.device) - count // 2) * width
    spread = torch.exp(-((line - centres) ** 2) / (2 * width**2))
    spread = spread / spread.square().sum(1, keepdim=True).sqrt()
    return spread @ white.to(line.device), spread.T
