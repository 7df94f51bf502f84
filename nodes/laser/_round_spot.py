"""The spot of a Gaussian beam behind a clear round lens: narrower than the lens, and out of focus.

A beam of 1/e2 radius w has the amplitude exp(-a r^2) in the pupil, with r = 1 at the rim and the
fill a = (D / (2 w))^2. A lens that is W waves out of focus at the rim adds the phase 2 pi W r^2.
With kappa = a - 2 pi i W the field at the reach v = pi x / (lambda N) from the axis is U = integral
of exp(-kappa r^2) J0(v r) r dr from 0 to 1. Its two series by repeated integration by parts are
those of Lommel (Born and Wolf, section 8.8.1), for a complex argument.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any

import torch
from torch import Tensor

_DARK = 40.0  #: fill from which the rim of the lens is dark: exp(-40) of the amplitude on the axis
_SMALL = 60.0  #: |2 kappa| below which the integral is computed by quadrature up to the far wings
_APART = 1.5  #: least ratio of v and |2 kappa|, or its inverse, at which a series converges fast
_LARGE = 120.0  #: |2 kappa| from which the edge of the spot is that of a straight edge
_TERMS = 44  #: of a series, 1.5^-44 = 2e-8
_SMALLEST = math.log(2e-8)  #: of the logarithm of the last term of a series over the first
_RATIOS = (0.3, 0.1, 0.03)  #: of a series, at which places are parted
_PIECE = 1 << 21  #: Bessel functions at a time in a quadrature
_RING = 3.8317059702075125  #: first zero of J1, where J0 has its largest negative value
_TROUGH = -0.4027593957025531  #: J0 there
#: defocus and fill up to which the bright ring is interpolated in a table
_TABLE_WAVES, _TABLE_FILL = 8.0, 8.0
_FIRST = 0.5  #: waves of defocus from which a ring may be brighter than the axis
_WAVE_STEPS, _FILL_STEPS = 751, 33
_STEP = 0.05  #: of the reach, between which the brightest ring is looked for
_SURE = 1.002  #: factor that makes the brightest ring an upper bound
_EDGE = 1.5  #: times |kappa|^2, of the rings of an even beam near its geometric edge
_WIDEST = 45.0  #: reach of the rings in the table; one farther out is never the brightest


def round_spot(reach: Tensor, fill: float, waves: float) -> Tensor:
    """Return the irradiance in the spot of a beam, over the peak of an even and focused beam of the
    same axis value.

    ``reach`` is v = pi x / (lambda N) at the distance x from the axis, ``fill`` is (D / (2 w))^2
    and ``waves`` the defocus at the rim of the lens.

    Shapes: reach (any) -> the same, float64.
    Units:  none.
    Error:  1e-7 of the local mean, wings included.
    Raises: nothing.
    Source: Born and Wolf, Principles of Optics, 7th ed., section 8.8 (Lommel's series); quadrature
            in between.
    """
    v = reach.double().abs().flatten()
    # the sign of the defocus turns the phase of the field alone
    kappa = complex(fill, -2 * math.pi * abs(waves))
    size = 2 * abs(kappa)
    if fill > _DARK:
        return _irradiance(_geometric(v, kappa), reach)
    far = v > max(_APART * size, _SMALL / 2) + _SMALL / 2
    near = (v * _APART < size) if size > _SMALL else torch.zeros_like(far)
    field = torch.zeros(len(v), dtype=torch.complex128)
    field[far] = _beyond(v[far], kappa)
    if bool(near.any()):
        field[near] = _within(v[near], kappa)
    between = ~(far | near)
    field[between] = (
        _at_the_edge(v[between], kappa) if size > _LARGE else _integrated(v[between], kappa)
    )
    return _irradiance(field, reach)


def _irradiance(field: Tensor, reach: Tensor) -> Tensor:
    """Return the irradiance of a field over that of an even pupil in focus, whose field is 1/2
    on the axis.
    """
    irradiance: Tensor = field.abs().square() * 4
    return irradiance.reshape(reach.shape)


def _geometric(v: Tensor, kappa: complex) -> Tensor:
    """Return the field of a beam that no rim cuts off."""
    return torch.exp(-v.square() / (4 * kappa)) / (2 * kappa)


def _beyond(v: Tensor, kappa: complex) -> Tensor:
    """Return the field for v above |2 kappa|: exp(-kappa) sum of (2 kappa / v)^n J(n + 1, v) / v.

    Far out few terms are needed, so that the places are taken in parts.
    """
    field = torch.empty(len(v), dtype=torch.complex128)
    ratio = 2 * abs(kappa) / v
    for upper, lower in itertools.pairwise((math.inf, *_RATIOS, -1.0)):
        in_range = (ratio <= upper) & (ratio > lower)
        if bool(in_range.any()):
            largest = float(ratio[in_range].max())
            terms = (
                _TERMS
                if largest > 1 / _APART
                else math.ceil(_SMALLEST / math.log(max(largest, 1e-9))) + 1
            )
            field[in_range] = _far_series(v[in_range], kappa, min(terms, _TERMS))
    return field


def _far_series(v: Tensor, kappa: complex, terms: int) -> Tensor:
    """Return the field for v above |2 kappa| by a number of terms."""
    last, bessel = torch.special.bessel_j0(v), torch.special.bessel_j1(v)
    ratio, power = 2 * kappa / v, torch.ones(len(v), dtype=torch.complex128)
    total = power * bessel
    for n in range(1, terms):
        last, bessel = bessel, 2 * n / v * bessel - last
        power = power * ratio
        total = total + power * bessel
    field: Tensor = _exp(-kappa) * total / v
    return field


def _within(v: Tensor, kappa: complex) -> Tensor:
    """Return the field for v below |2 kappa|: that without a rim, less the wave from the rim."""
    safe = v.clamp_min(1e-9)
    last, bessel = torch.special.bessel_j0(safe), torch.special.bessel_j1(safe)
    ratio, power = -safe / (2 * kappa), torch.ones(len(v), dtype=torch.complex128)
    total = power * last
    for n in range(1, _TERMS):
        power = power * ratio
        total = total + power * bessel
        last, bessel = bessel, _next(n, safe, last, bessel)
    field: Tensor = _geometric(v, kappa) - _exp(-kappa) / (2 * kappa) * total
    return field


def _next(n: int, v: Tensor, last: Tensor, bessel: Tensor) -> Tensor:
    """Return J(n + 1, v); beyond the order v, where the recurrence is unstable and J falls fast,
    return 0.
    """
    following = 2 * n / v * bessel - last
    return torch.where((v > n + 1) | (following.abs() < bessel.abs()), following, 0.0)


def _integrated(v: Tensor, kappa: complex) -> Tensor:
    """Return the field by Gauss-Legendre quadrature over the square of the radius."""
    if not len(v):
        return torch.zeros(0, dtype=torch.complex128)
    cycles = abs(kappa) / math.pi + float(v.max()) / (2 * math.pi)
    nodes, weights = (
        torch.from_numpy(x) for x in legendre(1 << math.ceil(math.log2(24 + 2.2 * cycles)))
    )
    square = (nodes + 1) / 2
    pupil = torch.exp(-kappa * square) * weights / 4
    root, rows = square.sqrt(), max(1, _PIECE // len(square))
    pieces = torch.split(v, rows)
    parts = [
        torch.special.bessel_j0(piece[:, None] * root).to(pupil.dtype) @ pupil for piece in pieces
    ]
    return torch.cat(parts)


def _at_the_edge(v: Tensor, kappa: complex) -> Tensor:
    """Return the field around the geometric edge of a wide spot: a beam behind a straight edge, to
    first order in 1/v.

    J0 is the sum of two waves. The one that the beam brings to the place is cut off by an edge: a
    complementary error function. The other one, and what the first misses, come from the rim.
    """
    from scipy.special import wofz

    place = -1j * v / (2 * kappa)
    depth = (complex(kappa) ** 0.5 * (place - 1)).numpy()
    lit = torch.from_numpy(depth.real < 0)
    side = torch.where(lit, -1.0, 1.0)
    edge = torch.from_numpy(wofz(1j * side.numpy() * depth)) * side / (4 * kappa)
    turn = complex(math.cos(math.pi / 4), math.sin(math.pi / 4))
    root, wave = 1 / torch.sqrt(2 * math.pi * v), torch.exp(-1j * v)
    unity = torch.ones_like(place)
    lack = turn * root / (-2 * kappa * (unity + place.sqrt()))
    other = root / turn / (1j * v - 2 * kappa) * wave.conj()
    beam = torch.where(lit, _geometric(v, kappa), 0.0)
    return beam + _exp(-kappa) * ((edge + lack) * wave + other)


def _exp(z: complex) -> complex:
    return math.exp(z.real) * complex(math.cos(z.imag), math.sin(z.imag))


@functools.lru_cache(maxsize=16)
def legendre(count: int) -> tuple[Any, Any]:
    """Return the nodes and the weights of a Gauss-Legendre quadrature between -1 and 1."""
    import numpy as np

    return np.polynomial.legendre.leggauss(count)


# --- the brightest point --------------------------------------------------------------------------


def spot_peak(fill: Tensor, waves: Tensor, within: float = 0.0) -> Tensor:
    """Return the largest irradiance at any radius of the spot of a beam, in the unit of
    `round_spot`, or a bit more.

    On the axis it is |1 - exp(-kappa)|^2 / |kappa|^2, which falls at whole waves of defocus; there
    a bright ring counts. ``within`` makes it the largest value while the defocus changes by up to
    that share to either side, so that a peak which comes and goes over a short distance is not
    missed. The result is continuous.

    Shapes: fill, waves, of one shape or of shapes that broadcast -> that shape, float64.
    Units:  none.
    Error:  an upper bound, to 1e-4: 0.5 % above up to 8 waves, 6 % above beyond 8 waves where the
            rings of an even beam near its geometric edge are as bright as its axis.
            `defocused_peak` is exact.
    Raises: nothing.
    Source: Born and Wolf, Principles of Optics, 7th ed., section 8.8; our derivation for the
            tapered beam.
    """
    alike = torch.zeros_like(fill.double() + waves.double())
    fill, phase = fill.double() + alike, 2 * math.pi * waves.double().abs() + alike
    low, high = phase * (1 - within), phase * (1 + within)
    rim = torch.exp(-fill)
    largest = _on_axis(fill, rim, phase)
    if within:
        trough = math.pi * (2 * torch.ceil(low / (2 * math.pi) - 0.5) + 1)
        # the maximum, as 1 / |kappa|^2 falls
        before = trough - (1 + rim).square() / (rim * trough).clamp_min(1e-12)
        for angle in (low, high, trough, before):
            largest = torch.maximum(largest, _on_axis(fill, rim, angle.clamp(low, high)))
    ringed = (high > 2 * math.pi * _FIRST) & (fill < _TABLE_FILL)
    if bool(ringed.any()):
        largest = largest.clone()
        largest[ringed] = torch.maximum(
            largest[ringed], _brightest_ring(fill[ringed], low[ringed], high[ringed])
        )
    return largest


def _on_axis(fill: Tensor, rim: Tensor, phase: Tensor) -> Tensor:
    """Return the irradiance on the axis for a phase 2 pi W of the rim; ``rim`` is exp(-fill)."""
    size = fill.square() + phase.square()
    axis = torch.expm1(-fill).square() + 4 * rim * torch.sin(phase / 2).square()
    return torch.where(size > 1e-8, axis / size.where(size > 1e-8, 1.0), 1 - fill)


def _brightest_ring(fill: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the irradiance of the brightest ring, the largest for phases of the rim between
    two.
    """
    rim = torch.exp(-fill)
    largest = torch.zeros_like(fill)
    phases = [low] if bool((low == high).all()) else [low, high]
    if len(phases) == 2:
        turn = _RING**2 / (4 * low.clamp_min(1.0))
        phases.append(
            (2 * math.pi * torch.ceil((low + turn) / (2 * math.pi)) - turn).clamp(low, high)
        )
    for phase in phases:
        size = fill.square() + phase.square()
        cosine = torch.cos(phase + phase * _RING**2 / (4 * size))
        waves = phase / (2 * math.pi)
        ring = _ring_limit(rim, fill, phase, cosine) * _ring_share(fill, waves)
        ring = torch.where(waves > _TABLE_WAVES, torch.maximum(ring, _EDGE * rim), ring) / size
        largest = torch.maximum(largest, ring.where(waves > _FIRST, 0.0))
    return largest


def _ring_limit(rim: Tensor, fill: Tensor, phase: Tensor, cosine: Tensor) -> Tensor:
    """Return the irradiance at the first zero of J1 times |kappa|^2 for strong defocus."""
    size = (fill.square() + phase.square()).clamp_min(1e-300)
    beam = torch.exp(-fill * _RING**2 / (4 * size))
    return beam.square() - 2 * beam * rim * _TROUGH * cosine + (rim * _TROUGH).square()


def defocused_peak(waves: float, fill: float = 0.0) -> float:
    """Return the largest irradiance behind a clear round lens with defocus, over that of the even,
    focused pupil.

    It is the largest value at any radius, not that on the axis, which is sinc^2(waves) for an even
    beam and has zeros. ``fill`` is (D / (2 w))^2 of a Gaussian beam of 1/e2 radius w: 0 for an even
    beam. Error: 1e-4, at any defocus.
    """
    waves = abs(waves)
    axis = float(round_spot(torch.zeros(1), fill, waves))
    if waves <= _FIRST or fill > _DARK:
        return axis
    edge = 4.4 * math.pi * waves + 8  # a little beyond the geometric edge of the spot
    reach = torch.linspace(0.0, edge, 64 + math.ceil(edge / _STEP), dtype=torch.float64)
    return max(axis, float(_summit(round_spot(reach, fill, waves)[None])[0]))


def _ring_share(fill: Tensor, waves: Tensor) -> Tensor:
    """Return the irradiance of the brightest ring over `_ring_limit`, which is 1 for strong
    defocus.
    """
    row = ((waves - _FIRST) / (_TABLE_WAVES - _FIRST) * (_WAVE_STEPS - 1)).clamp(0, _WAVE_STEPS - 1)
    column = (fill / _TABLE_FILL * (_FILL_STEPS - 1)).clamp(0, _FILL_STEPS - 1)
    share = _SURE * bilinear(_ring_table(), row, column)
    return share.where(waves < _TABLE_WAVES, share.clamp_min(1.0))


def bilinear(table: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Return a table interpolated between its entries, at fractional rows and columns."""
    top = row.floor().long().clamp_max(table.shape[0] - 2)
    left = column.floor().long().clamp_max(table.shape[1] - 2)
    down, along = row - top, column - left
    upper = table[top, left] * (1 - along) + table[top, left + 1] * along
    lower = table[top + 1, left] * (1 - along) + table[top + 1, left + 1] * along
    return upper * (1 - down) + lower * down


@functools.lru_cache(maxsize=1)
def _ring_table() -> Tensor:
    """Return the irradiance of the brightest ring over its limit for strong defocus, (waves,
    fill).
    """
    waves = torch.linspace(_FIRST, _TABLE_WAVES, _WAVE_STEPS, dtype=torch.float64)
    fills = torch.linspace(0, _TABLE_FILL, _FILL_STEPS, dtype=torch.float64)
    reach = torch.linspace(1.5, _WIDEST, 436, dtype=torch.float64)
    nodes, weights = (torch.from_numpy(x) for x in legendre(64))
    square = (nodes + 1) / 2
    bessel = torch.special.bessel_j0(reach[:, None] * square.sqrt())
    taper = torch.exp(-fills[:, None] * square) * weights / 4
    rows = []
    for wave_count in waves.tolist():
        turns = 2 * math.pi * wave_count * square
        parts = [(taper * wave) @ bessel.T for wave in (torch.cos(turns), torch.sin(turns))]
        brightest = _summit(4 * (parts[0].square() + parts[1].square()))
        phase = torch.full_like(fills, 2 * math.pi * wave_count)
        size = fills.square() + phase.square()
        cosine = torch.cos(phase + phase * _RING**2 / (4 * size))
        rows.append(brightest * size / _ring_limit(torch.exp(-fills), fills, phase, cosine))
    return torch.stack(rows)


def _summit(values: Tensor) -> Tensor:
    """Return the largest value of each row, with a parabola through it and its neighbours."""
    place = values[:, 1:-1].argmax(1) + 1
    row = torch.arange(len(values))
    before, here, after = values[row, place - 1], values[row, place], values[row, place + 1]
    bend = (2 * here - before - after).clamp_min(1e-300)
    top = (here >= before) & (here >= after)
    return torch.where(top, here + (after - before).square() / (8 * bend), values.amax(1))
