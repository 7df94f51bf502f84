"""Zernike polynomials and smooth random phase screens over the stop."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from neusee.nodes.optics._pupil_grid import PupilGrid, axes, inside

# --- zernike --------------------------------------------------------------------------------------

# Zernike polynomials over the stop, of unit root mean square, in Noll's numbering.


_ALL = slice(None)


def noll(index: int) -> tuple[int, int]:
    """Return the radial order n and the signed azimuthal order m (positive: cosine) of a Noll
    number.
    """
    if index < 1:
        raise ValueError(f"Zernike index {index}: Noll numbers begin at 1 (piston)")
    # order n begins after n (n + 1) / 2 smaller numbers
    n = (math.isqrt(8 * index - 7) - 1) // 2
    position = index - n * (n + 1) // 2 - 1
    m = 2 * ((position + (n + 1) % 2) // 2) + n % 2
    return n, (m if index % 2 == 0 else -m)


def _radial(n: int, m: int) -> list[float]:
    """Return the coefficients of the orthonormal radial polynomial R(n, m)(r) / r**m in rising
    powers of r squared.
    """
    lower, upper, factorial = (n - m) // 2, (n + m) // 2, math.factorial
    norm = math.sqrt((n + 1) * (1 if m == 0 else 2))
    terms = reversed(range(lower + 1))
    return [
        norm
        * (-1) ** k
        * factorial(n - k)
        / (factorial(k) * factorial(upper - k) * factorial(lower - k))
        for k in terms
    ]


def _by_azimuth(coefficients: Mapping[int, float]) -> dict[int, list[float]]:
    """Return one radial polynomial for each signed azimuthal order, summed over the terms of
    that order.
    """
    sums: dict[int, list[float]] = {}
    for index, rms in coefficients.items():
        n, m = noll(index)
        new_terms, earlier_terms = _radial(n, abs(m)), sums.get(m, [])
        term_count = max(len(new_terms), len(earlier_terms))
        padded = [row + [0.0] * (term_count - len(row)) for row in (new_terms, earlier_terms)]
        sums[m] = [rms * a + b for a, b in zip(*padded, strict=True)]
    return sums


def _horner(coefficients: list[float], x: Tensor) -> Tensor:
    """Return the polynomial with coefficients in rising powers at x, by Horner's rule."""
    value = torch.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value.mul_(x).add_(coefficient)
    return value


def combine(coefficients: Mapping[int, float], v: Tensor, u: Tensor) -> Tensor:
    """Return the weighted sum of Zernike polynomials at (v, u), in units of the radius; the weights
    are by Noll number.

    The sum is written in powers of u + iv, so neither the centre nor the cut of the azimuth needs
    special treatment.
    Source: Noll, J. Opt. Soc. Am. 66, 207 (1976), Eqs. 1 and 2.
    """
    sums = _by_azimuth(coefficients)
    square = v.square() + u.square()
    total, cosine, sine = (
        torch.zeros_like(square),
        torch.ones_like(square),
        torch.zeros_like(square),
    )
    for order in range(max(map(abs, sums), default=-1) + 1):
        for m, wave in ((order, cosine), (-order, sine)):
            if m in sums and (order or wave is cosine):
                total.addcmul_(_horner(sums[m], square), wave)
        # (u + i v)^m = r^m exp(i m phi), a power more each time
        cosine, sine = cosine * u - sine * v, cosine * v + sine * u
    return total


def surface(
    coefficients: Mapping[int, float],
    grid: PupilGrid,
    device: torch.device | None = None,
    rows: slice = _ALL,
) -> Tensor:
    """Return a weighted sum of Zernike polynomials on the pupil grid (v, u), float64, 0 outside
    the stop.
    """
    v, u = axes(grid, device)
    return torch.where(inside(grid, device, rows), combine(coefficients, v[rows], u), 0.0)


# --- phase screen ---------------------------------------------------------------------------------

# Smooth random phase screens over the pupil, the same at every sampling of the pupil.


def screen(
    grid: PupilGrid, scale: float, rng: torch.Generator, device: torch.device | None = None
) -> Tensor:
    """Return a random phase screen (v, u), float64: Gaussian noise with variance 1 and correlation
    exp(-(d / scale)**2).
    """
    rows, columns = factors(grid, scale, rng, device)
    return rows @ columns


def factors(
    grid: PupilGrid, scale: float, rng: torch.Generator, device: torch.device | None = None
) -> tuple[Tensor, Tensor]:
    """Return matrices (v, n) and (n, u) whose product is a random phase screen, so that single rows
    can be computed.

    ``scale`` is in units of the diameter. Gaussians of width scale / 2 smooth white noise on a
    lattice. The lattice does not depend on the sampling of the pupil, so the screen does not depend
    on the sampling either.
    """
    # noise of spots exp(-x^2 / (2 w^2)) has the correlation exp(-d^2 / (4 w^2)): w = scale / 2
    spot_width = scale / 2
    half_width = max(0.5, grid.samples * grid.pitch / (2 * grid.diameter)) + 4 * spot_width
    count = 2 * math.ceil(half_width / spot_width) + 1
    white_noise = torch.randn(count, count, generator=rng, device=rng.device, dtype=torch.float64)
    positions = axes(grid, device)[0] / 2
    centres = (
        torch.arange(count, dtype=torch.float64, device=positions.device) - count // 2
    ) * spot_width
    spot_weights = torch.exp(-((positions - centres) ** 2) / (2 * spot_width**2))
    # each sample has variance 1
    spot_weights = spot_weights / spot_weights.square().sum(1, keepdim=True).sqrt()
    return spot_weights @ white_noise.to(positions.device), spot_weights.T
