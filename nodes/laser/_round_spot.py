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

#: fill above which the rim of the lens is dark: amplitude exp(-40) of that on the axis
_DARK = 40.0
_SMALL = 60.0  #: |2 kappa| below which the field is computed by quadrature, except in the far wings
_APART = 1.5  #: least ratio of v to |2 kappa|, or inverse, at which a series converges fast
_LARGE = 120.0  #: |2 kappa| above which the edge of the spot is approximated by a straight edge
_TERMS = 44  #: largest number of terms of a series; 1.5^-44 = 2e-8
#: logarithm of the smallest term of a series that counts, relative to the first
_SMALLEST = math.log(2e-8)
#: ratios |2 kappa| / v that separate groups of places with different numbers of terms
_RATIOS = (0.3, 0.1, 0.03)
_PIECE = 1 << 21  #: values of Bessel functions computed at once in a quadrature
_RING = 3.8317059702075125  #: first zero of J1, where J0 has its largest negative value
_TROUGH = -0.4027593957025531  #: J0 there
#: largest defocus in waves, and largest fill, of the table of the bright ring
_TABLE_WAVES, _TABLE_FILL = 8.0, 8.0
_FIRST = 0.5  #: waves of defocus above which a ring may be brighter than the axis
_WAVE_STEPS, _FILL_STEPS = 751, 33
_STEP = 0.05  #: step of the reach in the search for the brightest ring
_SURE = 1.002  #: factor that makes the brightest ring an upper bound
#: upper bound of irradiance x |kappa|^2 in the rings of an even beam near its geometric edge
_EDGE = 1.5
#: largest reach of the rings in the table; a ring farther out is never the brightest
_WIDEST = 45.0


def round_spot(reach: Tensor, fill: float, waves: float) -> Tensor:
    """Return the irradiance in the spot of a Gaussian beam, relative to the peak of an even,
    focused beam with the same irradiance on the axis at the lens.

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
    # the sign of the defocus only conjugates the field and does not change the irradiance
    kappa = complex(fill, -2 * math.pi * abs(waves))
    double_kappa = 2 * abs(kappa)
    # the lens does not cut the beam off: a Gaussian spot
    if fill > _DARK:
        return _irradiance(_field_without_rim(v, kappa), reach)
    # in each region the series that converges there; between them quadrature, or for a wide spot
    # the straight-edge approximation
    is_beyond = v > max(_APART * double_kappa, _SMALL / 2) + _SMALL / 2
    is_within = (
        (v * _APART < double_kappa) if double_kappa > _SMALL else torch.zeros_like(is_beyond)
    )
    field = torch.zeros(len(v), dtype=torch.complex128)
    field[is_beyond] = _field_beyond(v[is_beyond], kappa)
    if bool(is_within.any()):
        field[is_within] = _field_within(v[is_within], kappa)
    is_between = ~(is_beyond | is_within)
    field[is_between] = (
        _field_at_edge(v[is_between], kappa)
        if double_kappa > _LARGE
        else _field_by_quadrature(v[is_between], kappa)
    )
    return _irradiance(field, reach)


def _irradiance(field: Tensor, reach: Tensor) -> Tensor:
    """Return the irradiance of a field relative to the peak of an even pupil in focus, whose field
    is 1/2 on the axis.
    """
    irradiance: Tensor = field.abs().square() * 4
    return irradiance.reshape(reach.shape)


def _field_without_rim(v: Tensor, kappa: complex) -> Tensor:
    """Return the field of a beam that no rim cuts off."""
    return torch.exp(-v.square() / (4 * kappa)) / (2 * kappa)


def _field_beyond(v: Tensor, kappa: complex) -> Tensor:
    """Return the field for v above |2 kappa|: exp(-kappa) sum of (2 kappa / v)^n J(n + 1, v) / v.

    Farther out fewer terms are needed, so that places are processed in groups.
    """
    field = torch.empty(len(v), dtype=torch.complex128)
    ratio = 2 * abs(kappa) / v
    for upper, lower in itertools.pairwise((math.inf, *_RATIOS, -1.0)):
        in_range = (ratio <= upper) & (ratio > lower)
        if bool(in_range.any()):
            largest = float(ratio[in_range].max())
            terms = (
                # terms fall as ratio^n: number of terms until the smallest one that counts, for the
                # largest ratio
                _TERMS
                if largest > 1 / _APART
                else math.ceil(_SMALLEST / math.log(max(largest, 1e-9))) + 1
            )
            field[in_range] = _far_series(v[in_range], kappa, min(terms, _TERMS))
    return field


def _far_series(v: Tensor, kappa: complex, terms: int) -> Tensor:
    """Return the field for v above |2 kappa| by the first terms of its series, with J(n + 1, v) = 2
    n / v J(n, v) - J(n - 1, v).
    """
    previous_bessel, bessel = torch.special.bessel_j0(v), torch.special.bessel_j1(v)
    ratio, power = 2 * kappa / v, torch.ones(len(v), dtype=torch.complex128)
    series = power * bessel
    for n in range(1, terms):
        previous_bessel, bessel = bessel, 2 * n / v * bessel - previous_bessel
        power = power * ratio
        series = series + power * bessel
    field: Tensor = _complex_exp(-kappa) * series / v
    return field


def _field_within(v: Tensor, kappa: complex) -> Tensor:
    """Return the field for v below |2 kappa|: that of a beam without a rim, less the wave
    diffracted at the rim, a series in (-v / (2 kappa))^n J(n, v).
    """
    safe_v = v.clamp_min(1e-9)
    bessel_n, bessel_next = torch.special.bessel_j0(safe_v), torch.special.bessel_j1(safe_v)
    ratio, power = -safe_v / (2 * kappa), torch.ones(len(v), dtype=torch.complex128)
    series = power * bessel_n
    for n in range(1, _TERMS):
        power = power * ratio
        series = series + power * bessel_next
        bessel_n, bessel_next = bessel_next, _next_bessel(n, safe_v, bessel_n, bessel_next)
    field: Tensor = _field_without_rim(v, kappa) - _complex_exp(-kappa) / (2 * kappa) * series
    return field


def _next_bessel(n: int, v: Tensor, last: Tensor, bessel: Tensor) -> Tensor:
    """Return J(n + 1, v) from J(n - 1, v) (``last``) and J(n, v) (``bessel``).

    For orders above v the recurrence is unstable, and J falls fast: return 0 there.
    """
    following = 2 * n / v * bessel - last
    return torch.where((v > n + 1) | (following.abs() < bessel.abs()), following, 0.0)


def _field_by_quadrature(v: Tensor, kappa: complex) -> Tensor:
    """Return the field by Gauss-Legendre quadrature over the square of the radius."""
    if not len(v):
        return torch.zeros(0, dtype=torch.complex128)
    # cycles of the defocus phase and of J0 between axis and rim; a cycle needs about two nodes
    phase_cycles = abs(kappa) / math.pi + float(v.max()) / (2 * math.pi)
    nodes, weights = (
        torch.from_numpy(x) for x in legendre(1 << math.ceil(math.log2(24 + 2.2 * phase_cycles)))
    )
    squared_radius = (nodes + 1) / 2
    # r dr = d(r^2) / 2, and another 1/2 from the interval -1 to 1 to 0 to 1
    pupil = torch.exp(-kappa * squared_radius) * weights / 4
    radius, piece_length = squared_radius.sqrt(), max(1, _PIECE // len(squared_radius))
    pieces = torch.split(v, piece_length)
    fields = [
        torch.special.bessel_j0(piece[:, None] * radius).to(pupil.dtype) @ pupil for piece in pieces
    ]
    return torch.cat(fields)


def _field_at_edge(v: Tensor, kappa: complex) -> Tensor:
    """Return the field around the geometric edge of a wide spot, in the straight-edge
    approximation, to first order in 1/v.

    J0 is the sum of two waves. The wave of the beam towards the place is cut off by the rim as by a
    straight edge, which gives a complementary error function. The other wave, and the correction of
    the first, come from the rim.
    """
    from scipy.special import wofz

    # saddle point: radius in the pupil (complex for a tapered beam) from which a ray reaches v
    saddle = -1j * v / (2 * kappa)
    edge_depth = (complex(kappa) ** 0.5 * (saddle - 1)).numpy()
    is_lit = torch.from_numpy(edge_depth.real < 0)
    lit_sign = torch.where(is_lit, -1.0, 1.0)
    # wofz(i z) = exp(z^2) erfc(z), which neither overflows nor cancels on this side
    edge_wave = torch.from_numpy(wofz(1j * lit_sign.numpy() * edge_depth)) * lit_sign / (4 * kappa)
    eighth_turn = complex(math.cos(math.pi / 4), math.sin(math.pi / 4))
    amplitude, inward_wave = 1 / torch.sqrt(2 * math.pi * v), torch.exp(-1j * v)
    ones = torch.ones_like(saddle)
    edge_rest = eighth_turn * amplitude / (-2 * kappa * (ones + saddle.sqrt()))
    outward_wave = amplitude / eighth_turn / (1j * v - 2 * kappa) * inward_wave.conj()
    unobstructed = torch.where(is_lit, _field_without_rim(v, kappa), 0.0)
    return unobstructed + _complex_exp(-kappa) * (
        (edge_wave + edge_rest) * inward_wave + outward_wave
    )


def _complex_exp(z: complex) -> complex:
    """Return exp(z) of a complex number."""
    return math.exp(z.real) * complex(math.cos(z.imag), math.sin(z.imag))


@functools.lru_cache(maxsize=16)
def legendre(count: int) -> tuple[Any, Any]:
    """Return the nodes and the weights of a Gauss-Legendre quadrature between -1 and 1."""
    import numpy as np

    return np.polynomial.legendre.leggauss(count)


# --- the brightest point --------------------------------------------------------------------------


def spot_peak(fill: Tensor, waves: Tensor, within: float = 0.0) -> Tensor:
    """Return a tight upper bound of the irradiance at any radius in the spot of a beam, in the unit
    of `round_spot`.

    On the axis the irradiance is |1 - exp(-kappa)|^2 / |kappa|^2, which has minima at whole waves
    of defocus, where a bright ring exceeds it. With ``within``, the result is the largest value
    while the defocus varies by that share to either side, so that a peak over a short range of
    distance is not missed. The result is continuous.

    Shapes: fill, waves, of one shape or of shapes that broadcast -> that shape, float64.
    Units:  none.
    Error:  an upper bound, to 1e-4: 0.5 % above up to 8 waves, 6 % above beyond 8 waves where the
            rings of an even beam near its geometric edge are as bright as its axis.
            `defocused_peak` is exact.
    Raises: nothing.
    Source: Born and Wolf, Principles of Optics, 7th ed., section 8.8; our derivation for the
            tapered beam.
    """
    zeros = torch.zeros_like(fill.double() + waves.double())
    fill, phase = fill.double() + zeros, 2 * math.pi * waves.double().abs() + zeros
    least_phase, largest_phase = phase * (1 - within), phase * (1 + within)
    rim = torch.exp(-fill)
    largest = _axis_irradiance(fill, rim, phase)
    if within:
        # phase at which the sine in the axis irradiance is largest: an odd multiple of pi
        odd_phase = math.pi * (2 * torch.ceil(least_phase / (2 * math.pi) - 0.5) + 1)
        # position of the maximum, shifted because 1 / |kappa|^2 falls
        phase_of_peak = odd_phase - (1 + rim).square() / (rim * odd_phase).clamp_min(1e-12)
        for angle in (least_phase, largest_phase, odd_phase, phase_of_peak):
            largest = torch.maximum(
                largest, _axis_irradiance(fill, rim, angle.clamp(least_phase, largest_phase))
            )
    may_ring = (largest_phase > 2 * math.pi * _FIRST) & (fill < _TABLE_FILL)
    if bool(may_ring.any()):
        largest = largest.clone()
        largest[may_ring] = torch.maximum(
            largest[may_ring],
            _brightest_ring(fill[may_ring], least_phase[may_ring], largest_phase[may_ring]),
        )
    return largest


def _axis_irradiance(fill: Tensor, rim: Tensor, phase: Tensor) -> Tensor:
    """Return the irradiance on the axis, |1 - exp(-kappa)|^2 / |kappa|^2, for a fill and a
    ``phase`` 2 pi W at the rim; ``rim`` is exp(-fill).
    """
    kappa_squared = fill.square() + phase.square()
    numerator = torch.expm1(-fill).square() + 4 * rim * torch.sin(phase / 2).square()
    # near kappa = 0: first terms of the Taylor series
    return torch.where(
        kappa_squared > 1e-8, numerator / kappa_squared.where(kappa_squared > 1e-8, 1.0), 1 - fill
    )


def _brightest_ring(fill: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the largest irradiance of the brightest ring over all phases 2 pi W at the rim from
    ``low`` to ``high``.
    """
    rim = torch.exp(-fill)
    largest = torch.zeros_like(fill)
    phases = [low] if bool((low == high).all()) else [low, high]
    if len(phases) == 2:
        # phase in the range at which the cosine below is largest: with the phase of the ring it
        # adds up to a multiple of 2 pi
        ring_phase = _RING**2 / (4 * low.clamp_min(1.0))
        phases.append(
            (2 * math.pi * torch.ceil((low + ring_phase) / (2 * math.pi)) - ring_phase).clamp(
                low, high
            )
        )
    for phase in phases:
        kappa_squared = fill.square() + phase.square()
        cosine = torch.cos(phase + phase * _RING**2 / (4 * kappa_squared))
        waves = phase / (2 * math.pi)
        ring_irradiance = _ring_limit(rim, fill, phase, cosine) * _ring_share(fill, waves)
        ring_irradiance = (
            torch.where(
                waves > _TABLE_WAVES, torch.maximum(ring_irradiance, _EDGE * rim), ring_irradiance
            )
            / kappa_squared
        )
        largest = torch.maximum(largest, ring_irradiance.where(waves > _FIRST, 0.0))
    return largest


def _ring_limit(rim: Tensor, fill: Tensor, phase: Tensor, cosine: Tensor) -> Tensor:
    """Return irradiance x |kappa|^2 at the first zero of J1 for strong defocus: the beam |exp(-v^2
    / (4 kappa))|, the wave from the rim J0 exp(-fill), and their interference.

    ``rim`` is exp(-fill), ``phase`` 2 pi W, and ``cosine`` that of the phase between both waves.
    """
    kappa_squared = (fill.square() + phase.square()).clamp_min(1e-300)
    beam = torch.exp(-fill * _RING**2 / (4 * kappa_squared))
    return beam.square() - 2 * beam * rim * _TROUGH * cosine + (rim * _TROUGH).square()


def defocused_peak(waves: float, fill: float = 0.0) -> float:
    """Return the largest irradiance behind a clear, defocused round lens, relative to the peak of
    the even, focused pupil.

    It is the largest value at any radius, not that on the axis, which is sinc^2(waves) for an even
    beam and has zeros. ``fill`` is (D / (2 w))^2 of a Gaussian beam of 1/e2 radius w: 0 for an even
    beam. Error: 1e-4, at any defocus.
    """
    waves = abs(waves)
    on_axis = float(round_spot(torch.zeros(1), fill, waves))
    if waves <= _FIRST or fill > _DARK:
        return on_axis
    largest_reach = 4.4 * math.pi * waves + 8  # a little beyond the geometric edge of the spot
    reaches = torch.linspace(
        0.0, largest_reach, 64 + math.ceil(largest_reach / _STEP), dtype=torch.float64
    )
    return max(on_axis, float(_summit(round_spot(reaches, fill, waves)[None])[0]))


def _ring_share(fill: Tensor, waves: Tensor) -> Tensor:
    """Return the ratio of the irradiance of the brightest ring to `_ring_limit`; it tends to 1 for
    strong defocus.
    """
    table_row = ((waves - _FIRST) / (_TABLE_WAVES - _FIRST) * (_WAVE_STEPS - 1)).clamp(
        0, _WAVE_STEPS - 1
    )
    table_column = (fill / _TABLE_FILL * (_FILL_STEPS - 1)).clamp(0, _FILL_STEPS - 1)
    ring_ratio = _SURE * bilinear(_ring_table(), table_row, table_column)
    return ring_ratio.where(waves < _TABLE_WAVES, ring_ratio.clamp_min(1.0))


def bilinear(table: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Return a table interpolated between its entries, at fractional rows and columns."""
    top = row.floor().long().clamp_max(table.shape[0] - 2)
    left = column.floor().long().clamp_max(table.shape[1] - 2)
    row_share, column_share = row - top, column - left
    upper_value = table[top, left] * (1 - column_share) + table[top, left + 1] * column_share
    lower_value = (
        table[top + 1, left] * (1 - column_share) + table[top + 1, left + 1] * column_share
    )
    return upper_value * (1 - row_share) + lower_value * row_share


@functools.lru_cache(maxsize=1)
def _ring_table() -> Tensor:
    """Return a table (waves, fill) of the irradiance of the brightest ring over its limit for
    strong defocus.
    """
    waves = torch.linspace(_FIRST, _TABLE_WAVES, _WAVE_STEPS, dtype=torch.float64)
    fills = torch.linspace(0, _TABLE_FILL, _FILL_STEPS, dtype=torch.float64)
    reach = torch.linspace(1.5, _WIDEST, 436, dtype=torch.float64)
    nodes, weights = (torch.from_numpy(x) for x in legendre(64))
    # the quadrature is over the squared radius in the pupil, from 0 to 1
    squared_radius = (nodes + 1) / 2
    bessel = torch.special.bessel_j0(reach[:, None] * squared_radius.sqrt())
    taper = torch.exp(-fills[:, None] * squared_radius) * weights / 4
    rows = []
    for wave_count in waves.tolist():
        phase_in_pupil = 2 * math.pi * wave_count * squared_radius
        field_parts = [
            (taper * wave) @ bessel.T
            for wave in (torch.cos(phase_in_pupil), torch.sin(phase_in_pupil))
        ]
        brightest = _summit(4 * (field_parts[0].square() + field_parts[1].square()))
        phase = torch.full_like(fills, 2 * math.pi * wave_count)
        kappa_squared = fills.square() + phase.square()
        cosine = torch.cos(phase + phase * _RING**2 / (4 * kappa_squared))
        rows.append(
            brightest * kappa_squared / _ring_limit(torch.exp(-fills), fills, phase, cosine)
        )
    return torch.stack(rows)


def _summit(values: Tensor) -> Tensor:
    """Return the maximum of each row, interpolated by a parabola through the largest value and its
    neighbours.
    """
    index_of_peak = values[:, 1:-1].argmax(1) + 1
    row = torch.arange(len(values))
    previous, peak_value, following = (
        values[row, index_of_peak - 1],
        values[row, index_of_peak],
        values[row, index_of_peak + 1],
    )
    curvature = (2 * peak_value - previous - following).clamp_min(1e-300)
    is_peak = (peak_value >= previous) & (peak_value >= following)
    # maximum of the parabola through three points, above the middle one
    return torch.where(
        is_peak, peak_value + (following - previous).square() / (8 * curvature), values.amax(1)
    )
