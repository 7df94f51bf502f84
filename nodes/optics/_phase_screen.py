"""Smooth random screens over the pupil, the same at every sampling."""

import math

import torch
from torch import Tensor

from neusee.nodes.optics._pupil_grid import Stop, axes


def screen(grid: Stop, scale: float, rng: torch.Generator, device: torch.device | None = None) -> Tensor:
    """Draw Gaussian noise of mean 0, variance 1 and correlation exp(-(d / scale)**2), float64 (v, u)."""
    rows, columns = factors(grid, scale, rng, device)
    return rows @ columns


def factors(
    grid: Stop, scale: float, rng: torch.Generator, device: torch.device | None = None
) -> tuple[Tensor, Tensor]:
    """The same as two matrices (v, few) and (few, u), for a few rows of their product at a time.

    ``scale`` is in units of the diameter. White noise on a lattice is spread by Gaussians of
    width scale / 2; the lattice does not depend on the sampling, so neither does the screen.
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
