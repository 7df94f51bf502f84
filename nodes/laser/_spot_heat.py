"""The steady heat at the hottest point of a spot: the integral of the irradiance over the distance to that point.

A light spot on a half-space warms a point of its surface, in the steady state, by the integral of E dA / (2 pi r),
where r is the distance to the point. A wide spot of low irradiance may warm as much as a small bright one, so that
the heat decides about damage by continuous light. Units and symbols are those of `round_spot`.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from neusee.nodes.laser._round_spot import bilinear, legendre

_AIRY = 16 / (3 * math.pi)  #: of the even, focused pupil: integral of (2 J1(v) / v)^2 over v from 0 on
_TABLE_WAVES, _TABLE_FILL = 8.0, 8.0  #: defocus and fill up to which the heat is interpolated in a table
_WAVE_STEPS, _FILL_STEPS = 401, 33
_EDGE = 8 * math.pi * _TABLE_WAVES  #: reach up to which irradiance is summed, twice that of the geometric edge
_STEP = 0.1  #: of the reach, between its samples
_HOTTEST = 6.0  #: reach within which the hottest point is looked for: farther out the heat of a spot only falls
_POINTS = 25  #: of them
_PARTS = 32  #: of a step, over which the inverse distance is averaged
_NODES = 256  #: of the quadrature over the pupil
_NEAR = 9.0  #: what keeps the heat of straight rays finite and flat near focus, and is as good as nothing elsewhere
_FALL = 0.9  #: power of the defocus with which the heat of the rings falls beyond the table, where it is found 0.93


def spot_heat(fill: Tensor, waves: Tensor) -> Tensor:
    """Return the steady heat at the hottest point of the spot of a beam, over that of the even and focused beam.

    Both beams have the same irradiance on their axis at the lens. ``fill`` is (D / (2 w))^2 of a Gaussian beam of 1/e2
    radius w behind a clear round lens of diameter D, and ``waves`` the defocus at the rim of the lens.

    Shapes: fill, waves, of one shape or of shapes that broadcast -> that shape, float64.
    Units:  none.
    Error:  0.2 % below to 0.5 % above; beyond 8 waves or a fill of 8 an upper bound, at most 2.5 % above.
    Raises: nothing.
    Source: Carslaw, Jaeger, Conduction of Heat in Solids, 2nd ed., section 10.5, for the heat; `round_spot` for the
            irradiance; geometric optics beyond 8 waves.
    """
    alike = torch.zeros_like(fill.double() + waves.double())
    fill, waves = fill.double() + alike, waves.double().abs() + alike
    row = (waves / _TABLE_WAVES * (_WAVE_STEPS - 1)).clamp(0, _WAVE_STEPS)
    column = (fill / _TABLE_FILL * (_FILL_STEPS - 1)).clamp(0, _FILL_STEPS - 1)
    share = bilinear(_heat_table(), row, column)
    rings = (share - 1).clamp_min(0) * (_TABLE_WAVES / waves.clamp_min(_TABLE_WAVES)) ** _FALL
    return _even_disc(fill, waves) * share.where(waves <= _TABLE_WAVES, 1 + rings) / _AIRY


def _even_disc(fill: Tensor, waves: Tensor) -> Tensor:
    """Return the heat in the middle of the spot of straight rays; near focus a smooth function that stays finite."""
    near = _NEAR / (1 + waves.square() + fill.square() / 4)
    size = torch.sqrt(fill.square() + (2 * math.pi * waves).square() + near)
    root = torch.sqrt(2 * fill).clamp_min(1e-6)
    taper = math.sqrt(math.pi) / 2 * torch.erf(root) / root  # mean of exp(-2 fill rho^2) along a radius
    return 2 / size * taper


@functools.lru_cache(maxsize=1)
def _heat_table() -> Tensor:
    """Return the heat of the hottest point over `_even_disc`, (waves, fill); last the largest of the last wave."""
    waves = torch.linspace(0, _TABLE_WAVES, _WAVE_STEPS, dtype=torch.float64)
    fills = torch.linspace(0, _TABLE_FILL, _FILL_STEPS, dtype=torch.float64)
    reach = (torch.arange(round(_EDGE / _STEP), dtype=torch.float64) + 0.5) * _STEP
    inverse = _mean_inverse_distance(reach)
    at, weights = (torch.from_numpy(x) for x in legendre(_NODES))
    square = (at + 1) / 2
    bessel = torch.special.bessel_j0(reach[:, None] * square.sqrt())
    taper = torch.exp(-fills[:, None] * square) * weights / 4
    wings = 4 * torch.exp(-2 * fills) / (math.pi * _EDGE**2) * 0.5  # mean of 4 exp(-2 fill) J1(v)^2 / v^2 from there on
    rows = []
    for each in waves.tolist():
        turns = 2 * math.pi * each * square
        parts = [(taper * wave) @ bessel.T for wave in (torch.cos(turns), torch.sin(turns))]
        irradiance = 4 * (parts[0].square() + parts[1].square())
        hottest = (irradiance @ inverse.T).amax(1) + wings
        rows.append(hottest / _even_disc(fills, torch.full_like(fills, each)))
    last_wave = rows[-round(_WAVE_STEPS / _TABLE_WAVES) :]
    return torch.stack([*rows, torch.stack(last_wave).amax(0)])


def _mean_inverse_distance(reach: Tensor) -> Tensor:
    """Return the weights (point, reach) of the heat at points: the integral of dA / (2 pi r) over a ring of a step.

    A ring of radius v warms a point at the distance u from its middle by 2 / pi v / (u + v) K(m), with the complete
    elliptic integral K and m = 4 u v / (u + v)^2.
    """
    from scipy.special import ellipkm1

    points = torch.linspace(0, _HOTTEST, _POINTS, dtype=torch.float64)[:, None, None]
    within = ((torch.arange(_PARTS, dtype=torch.float64) + 0.5) / _PARTS - 0.5) * _STEP
    ring = reach[:, None] + within
    apart = ((points - ring) / (points + ring)).square().clamp_min(1e-14)  # 1 - m
    kernel = 2 / math.pi * ring / (points + ring) * torch.from_numpy(ellipkm1(apart.numpy()))
    return kernel.mean(-1) * _STEP
