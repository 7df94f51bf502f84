"""Trainable height maps of few numbers: products of Legendre polynomials, and polynomials along one direction.

A module is called with the stop and returns the height map (v, u), float32 in m, at least 0, for any sampling.
"""

import math
from collections.abc import Iterator
from functools import lru_cache

import torch
from torch import Tensor, nn

from neusee.nodes.doe._height_from_phase import height_from_phase
from neusee.nodes.doe._refractive_index import Material
from neusee.nodes.optics._pupil_grid import PupilGrid, axes, grid_of
from neusee.nodes.values import Stop


def legendre(at: Tensor, degree: int) -> list[Tensor]:
    """Return the Legendre polynomials of degree 0 to ``degree``, with a root mean square of 1 over [-1, 1]."""
    plain = [torch.ones_like(at), at]
    for k in range(1, degree):
        plain.append(((2 * k + 1) * at * plain[k] - k * plain[k - 1]) / (k + 1))
    return [math.sqrt(2 * k + 1) * one for k, one in enumerate(plain[: degree + 1])]


class Polynomials(nn.Module):
    """A trainable height map of products of Legendre polynomials in both axes of the pupil, up to a total degree.

    Piston and tilt are absent: piston changes nothing, and tilt only shifts the spot. Defocus, astigmatism, coma and
    the cubic mask are special cases. The numbers are root mean squares in waves over the square about the stop; the
    start is a random sum of ``waves`` root mean square.
    """

    def __init__(self, degree: int, waves: float, wavelength: float, material: Material, rng: torch.Generator) -> None:
        super().__init__()
        self.degree, self.wavelength, self.material = degree, wavelength, material
        drawn = torch.randn(len(list(self._exponents())), generator=rng, dtype=torch.float64)
        self.waves = nn.Parameter((waves * drawn / drawn.norm()).to(torch.float32))
        self._products = lru_cache(maxsize=1)(self._products_on)

    def _exponents(self) -> Iterator[tuple[int, int]]:
        for total in range(2, self.degree + 1):
            for i in range(total + 1):
                yield i, total - i

    def _products_on(self, grid: PupilGrid) -> Tensor:
        rows, columns = (legendre(one, self.degree) for one in axes(grid, self.waves.device))
        return torch.stack([rows[i] * columns[j] for i, j in self._exponents()]).to(torch.float32)

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        grid = grid_of(stop)
        phase = torch.tensordot(2 * math.pi * self.waves, self._products(grid), 1)
        return height_from_phase(phase, grid, self.wavelength, self.material)


class Streak(nn.Module):
    """A trainable height map that varies along one direction and throws the light into a line, as cylinders do.

    The phase is a sum of Legendre polynomials of degree 2 to ``degree`` in t = u cos a + v sin a. Learnt are the angle
    ``a`` in radians and the root mean square of each polynomial in waves. The start has a random angle and a random sum
    of ``waves`` root mean square.
    """

    def __init__(self, degree: int, waves: float, wavelength: float, material: Material, rng: torch.Generator) -> None:
        super().__init__()
        self.wavelength, self.material = wavelength, material
        drawn = torch.randn(degree - 1, generator=rng, dtype=torch.float64)
        self.waves = nn.Parameter((waves * drawn / drawn.norm()).to(torch.float32))
        self.angle = nn.Parameter((math.pi * torch.rand(1, generator=rng, dtype=torch.float64)).to(torch.float32))

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        grid = grid_of(stop)
        v, u = axes(grid, self.waves.device)
        along = u * self.angle.cos() + v * self.angle.sin()
        each = legendre(along, len(self.waves) + 1)[2:]
        phase = torch.tensordot(2 * math.pi * self.waves.to(along), torch.stack(each), 1)
        return height_from_phase(phase, grid, self.wavelength, self.material)


class LearntStop(nn.Module):
    """A round stop whose diameter is learnt, as a share of that of the lens, above ``least`` and at most 1.

    The rim is one sample wide, so that the amplitude has a gradient; `doe.shade` has a sharp rim.
    """

    def __init__(self, diameter: float = 0.95, least: float = 0.1) -> None:
        super().__init__()
        self.least = least
        share = torch.tensor((diameter - least) / (1 - least), dtype=torch.float64)
        self.logit = nn.Parameter(torch.logit(share).to(torch.float32).reshape(1))

    def diameter(self) -> Tensor:
        """Return the diameter of the stop over that of the lens, ()."""
        share: Tensor = torch.sigmoid(self.logit)[0]
        return self.least + (1 - self.least) * share

    def forward(self, stop: Stop) -> Tensor:
        """Return the amplitude (v, u) that the stop lets through on the pupil grid of ``stop``, float32 in [0, 1]."""
        grid = grid_of(stop)
        v, u = axes(grid, self.logit.device)
        samples = grid.diameter / grid.pitch
        rim = self.diameter().double() * (1 + 1 / samples)  # a stop of diameter 1 is open up to the rim of the lens
        return (0.5 + (rim - torch.hypot(v, u)) * (samples / 2)).clamp(0, 1).to(torch.float32)
