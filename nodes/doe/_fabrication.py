"""Fabrication of a mask: wrapping, limited depth, discrete levels, smallest feature, height
errors.
"""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, TensorStats, node
from neusee.nodes.doe._refractive_index import (
    AnyGlass,
    Glass,
    height_checks,
    nearest_known,
    refuse_material,
    wave_height,
)
from neusee.nodes.optics._pupil import phase_screen_factors
from neusee.nodes.optics._pupil_grid import grid_of, refuse_other_grid, row_stripes
from neusee.nodes.precision import refuse_half
from neusee.nodes.units import Depth, Length, PupilPitch, Wavelength
from neusee.nodes.values import Stop

# --- fabrication limits ---------------------------------------------------------------------------

# Fabrication limits of a mask: wrapping, limited depth, discrete heights.


Levels = Annotated[int, Field(ge=2, le=65536)]
_VIOLET = 400e-9  #: m, wavelength at which a change of height is converted to a change of phase


def _quantize(height: Tensor, step: float, levels: int, cyclic: bool) -> Tensor:
    """Round each height to the nearest of ``levels`` discrete heights; the gradient is that of the
    identity.
    """
    with torch.no_grad():
        level_number = (height / step).round()
        level_number = (
            level_number.remainder(levels) if cyclic else level_number.clamp(0, levels - 1)
        )
        change = level_number * step - height
    return height + change.detach()  # detached: no gradient, and no forward-mode tangent


def _refuse_impossible_limits(
    material: AnyGlass, wrap_at: float | None, levels: int | None, max_height: float | None
) -> None:
    """Raise ParameterError for impossible limits: a depth below one wave, or levels without a
    depth.
    """
    if (
        wrap_at is not None
        and max_height is not None
        and wave_height(material, wrap_at) > max_height
    ):
        wave_text = f"{wave_height(material, wrap_at) * 1e6:.3f} um"
        text = (
            f"{max_height * 1e6:.3g} um is less than one wave of wrap_at in"
            f" {_material_name(material)}: needs at least {wave_text}"
        )
        raise ParameterError("max_height", text)
    if levels is not None and wrap_at is None and max_height is None:
        raise ParameterError(
            "levels", f"{levels} levels need a total depth: set wrap_at or max_height"
        )


def _material_name(material: AnyGlass) -> str:
    return material if isinstance(material, str) else "this glass"


@node(rtol=1e-5)
def fabricate(
    height: Tensor,
    *,
    material: Glass = "fused silica",
    wrap_at: Wavelength | None = None,
    levels: Levels | None = None,
    max_height: Depth | None = None,
) -> Tensor:
    """Wrap the height map at one wave of ``wrap_at`` or limit it to ``max_height``, then round to
    ``levels`` heights.

    The levels of a wrapped height map divide one wave, whose top equals its bottom. The levels of a
    limited height map run from 0 to ``max_height`` inclusive. Wrapping and rounding have the
    gradient 1; a height that is cut off has 0.

    Shapes: (v, u) -> (v, u).
    Units:  m.
    Error:  1e-7 of the result (float32), for any number of wraps.
    Raises: ParameterError where one wave is deeper than ``max_height``, or levels have no depth to
            divide; ValueError for a height in half precision.
    Source: Swanson, MIT Lincoln Laboratory Technical Report 854 (1989), for multi-level elements.
    """
    _refuse_impossible_limits(material, wrap_at, levels, max_height)
    refuse_half(height=height)
    if wrap_at is not None:
        period = wave_height(material, wrap_at)
        # in float64, because a period rounded to float32 would add an error for each wrap
        wrapped = height.double().remainder(period).to(height.dtype)
        return (
            wrapped if levels is None else _quantize(wrapped, period / levels, levels, cyclic=True)
        )
    if max_height is None:
        return height
    clipped = height.clamp(0, max_height)
    return (
        clipped
        if levels is None
        else _quantize(clipped, max_height / (levels - 1), levels, cyclic=False)
    )


@fabricate.reference
def _(
    height: Tensor,
    *,
    material: AnyGlass,
    wrap_at: float | None,
    levels: int | None,
    max_height: float | None,
) -> Tensor:
    """Compare each height with every allowed height, and return the nearest allowed height."""
    wave = None if wrap_at is None else wave_height(material, wrap_at)
    limited = height.to(torch.float64)
    limited = limited if wave is None else limited - wave * (limited / wave).floor()
    limited = (
        limited
        if max_height is None
        else torch.minimum(limited, torch.full_like(limited, max_height)).clamp(min=0)
    )
    depth = wave or max_height
    if levels is None or depth is None:
        return limited
    steps = levels if wave else levels - 1
    allowed_heights = [depth * k / steps for k in range(steps + 1)]
    table = torch.tensor(allowed_heights, dtype=torch.float64, device=limited.device)
    nearest = table[(limited[..., None] - table).abs().argmin(-1)]
    # the height of a whole wave is equivalent to 0
    return nearest if wave is None else torch.where(nearest == wave, 0.0, nearest)


@fabricate.skip_bound
def _(
    height: TensorStats,
    *,
    material: AnyGlass,
    wrap_at: float | None,
    levels: int | None,
    max_height: float | None,
) -> float:
    """Return an upper bound of the relative change of a height map by fabrication; 0 if every
    height fits.

    A small change of height may be a large phase: the bound is at least the phase of that change in
    radians at 400 nm, or at the nearest wavelength at which the index is known. Wrapping changes no
    phase at ``wrap_at`` but is counted in full.
    """
    depth = max_height if wrap_at is None else wave_height(material, wrap_at)
    if not height.finite or depth is None:
        return 0.0 if height.finite else math.inf
    extremes = torch.tensor([height.min, height.max], dtype=getattr(torch, height.dtype))
    change = _largest_change(extremes, depth, levels, cyclic=wrap_at is not None)
    if change == 0:
        return 0.0
    fabricated = fabricate(
        extremes, material=material, wrap_at=wrap_at, levels=levels, max_height=max_height
    )
    deepest = float(fabricated.abs().max())
    phase = 2 * math.pi * change / wave_height(material, nearest_known(material, _VIOLET))
    relative_change = change / deepest if deepest > 0 else math.inf
    return max(phase, relative_change)


def _largest_change(ends: Tensor, top: float, levels: int | None, cyclic: bool) -> float:
    """Return an upper bound in m of the change by fabrication of any height between ``ends``; exact
    if there are no levels.
    """
    lowest, highest = (float(end) for end in ends)
    if not cyclic:
        # the limit, rounded to the precision of the height map
        top = float(torch.tensor(top, dtype=ends.dtype))
        half_step = 0.0 if levels is None else top / (levels - 1) / 2
        # the largest clipping above or below, or half a step between levels
        return max(highest - top, -lowest, half_step)
    waves = max(abs(math.floor(lowest / top)), abs(math.floor(highest / top)))
    if levels is None:
        return top * waves
    # True if the highest heights are rounded up to a whole wave, which is 0
    is_rounded_up = highest >= top * (1 - 0.5 / levels) * (1 - 4 * torch.finfo(ends.dtype).eps)
    return top * (waves + is_rounded_up + 0.5 / levels)


@fabricate.preflight
def _(
    *, material: AnyGlass, wrap_at: float | None, levels: int | None, max_height: float | None
) -> list[str]:
    wavelengths = None if wrap_at is None else torch.tensor([wrap_at], dtype=torch.float64)
    refuse_material("wrap_at", material, wavelengths)
    _refuse_impossible_limits(material, wrap_at, levels, max_height)
    if max_height is not None and wrap_at is None:
        return [
            f"heights above max_height {max_height * 1e6:.3g} um are cut flat: set wrap_at to wrap"
            " the heights instead"
        ]
    return []


@fabricate.check
def _(
    result: Tensor, height: Tensor, *, wrap_at: float | None, max_height: float | None, **_: Any
) -> list[Check]:
    checks = [
        Check(
            f"mask {float(height.max()) * 1e6:.4g} um deep, {float(result.max()) * 1e6:.4g} um as"
            " fabricated"
        )
    ]
    if max_height is not None and wrap_at is None:
        share = float((height > max_height).double().mean())
        checks.append(
            Check(f"heights cut flat at max_height: {share:.2%} of the pupil grid", share == 0)
        )
    return checks


# --- minimum feature ------------------------------------------------------------------------------

# The smallest feature of a fabrication tool: the height map averaged over the spot of the tool.


_SPOT_REACH = 6.0  #: standard deviations; beyond this radius the spot has only 1e-9 of its dose


@node(rtol=1e-5)
def smooth(height: Tensor, stop: Stop, *, feature: PupilPitch) -> Tensor:
    """Average the height map over the round Gaussian spot of a tool, whose full width at half
    maximum is ``feature``.

    Depth follows dose, and dose is the wanted height averaged over the spot: steps get flanks of
    ``feature``, pillars that are narrower vanish, planes and wide features stay. An average lies
    between the least and the greatest height under the spot, so the mask does not become deeper. At
    the edge of the grid, the average covers only the samples inside the grid. The spot is a
    Gaussian and not a disc, whose transfer function has negative lobes: with a Gaussian, features
    that are too small fade, and no feature is inverted.

    Shapes: (v, u), stop -> (v, u).
    Units:  m.
    Error:  1e-6 of the deepest height (float32). A spot below 1.5 samples is not resolved by the
            grid.
    Raises: ValueError for a height in half precision, or of another shape than the pupil grid.
    Source: Gaussian spot of laser lithography: Gale et al., Opt. Eng. 33, 3556 (1994).
    """
    refuse_half(height=height)
    grid = grid_of(stop)
    refuse_other_grid(height, grid)
    average = _averaging_matrix(grid.samples, feature / grid.pitch).to(height)
    return average @ height @ average.T


def _averaging_matrix(samples: int, feature: float) -> Tensor:
    """Return the matrix, float64, that averages along one axis over a tool spot with a full width
    at half maximum of ``feature`` samples; each row sums to 1.
    """
    # full width at half maximum = sqrt(8 ln 2) standard deviations
    spot_deviation = feature / math.sqrt(8 * math.log(2))
    index = torch.arange(samples, dtype=torch.float64)
    weights = torch.exp(-((index[:, None] - index) ** 2) / (2 * spot_deviation**2))
    weights = weights.where(
        (index[:, None] - index).abs() <= _SPOT_REACH * spot_deviation + 0.5, 0.0
    )
    return weights / weights.sum(1, keepdim=True)


@smooth.reference
def _(height: Tensor, stop: Stop, *, feature: float) -> Tensor:
    """Return the height map averaged over the tool's spot, computed row by row."""
    samples, pitch, _ = grid_of(stop)
    sigma = feature / pitch / math.sqrt(8 * math.log(2))
    height_map, index = height.double(), torch.arange(samples, dtype=torch.float64)
    # squared distances along the columns
    squared_column_distance = (index[:, None, None] - index).square()
    rows = []
    for v in range(samples):
        spot_weights = torch.exp(
            -((index[:, None] - v).square() + squared_column_distance) / (2 * sigma**2)
        )
        rows.append((spot_weights * height_map).sum((1, 2)) / spot_weights.sum((1, 2)))
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


# --- height error ---------------------------------------------------------------------------------

# The height error of a fabricated mask: a relative error of the depth, and a smooth random error.


Rms = Annotated[Length, Field(ge=0, le=1e-3)]
Scale = Annotated[float, Field(ge=0.01, le=1)]  #: share of the pupil's diameter
Excess = Annotated[float, Field(gt=-1, le=1)]  #: share of the height
_ROUNDING_SHARE = 1.2e-7  #: relative round-off of a height in float32
#: bound of every sample of a smooth random field, in standard deviations; as for `flare.dirt`
_LARGEST_SIGMA = 31


@node()
def height_error(
    height: Tensor,
    stop: Stop,
    *,
    rms: Rms = 0.0,
    scale: Scale = 0.1,
    depth: Excess = 0.0,
    rng: torch.Generator,
) -> Tensor:
    """Return the height map as it was made: ``depth`` deeper as a whole, with a smooth random error
    of the height.

    An etching that takes too long, or a dose that is too high, makes every height greater by the
    same share ``depth``. The random error is a Gaussian field with the root mean square ``rms``
    over many masks and the correlation exp(-(d / ``scale``)**2) at the distance d, both in
    diameters of the pupil. Its draw does not depend on the sampling of the pupil. It may make a
    height negative, which moves the surface below the substrate and not the light.

    Shapes: (v, u), stop -> (v, u).
    Units:  rms m; scale in diameters of the pupil; depth as a share of the height; result m.
    Error:  1e-7 of the deepest height (float32); the correlation is exact to 1e-4 on a lattice of
            half a ``scale``.
    Raises: ValueError for a height in half precision, or of another shape than the pupil grid.
    Source: by definition; a depth error as a share of the depth: Swanson, MIT Lincoln Laboratory
            Technical Report 854 (1989), section on fabrication errors.
    """
    refuse_half(height=height)
    grid = grid_of(stop)
    refuse_other_grid(height, grid)
    deepened = height if depth == 0 else height * (1 + depth)
    if rms == 0:
        return deepened
    rows, columns = phase_screen_factors(grid, scale, rng, height.device)
    random_error = torch.cat(
        [(rms * (rows[stripe] @ columns)).to(height.dtype) for stripe in row_stripes(grid)]
    )
    return deepened + random_error


@height_error.skip_bound
def _(height: TensorStats, *_: Any, rms: float, depth: float, **__: Any) -> float:
    """Return an upper bound of the relative change of a height map; at least the phase of the
    change at 400 nm in rad.

    The phase assumes that the optical path changes by the change of height, as for a refractive
    index of 2.
    """
    if not (height.finite and math.isfinite(rms)):
        return math.inf
    deepest = max(abs(height.min), abs(height.max))
    if not (depth and deepest) and not rms:
        return 0.0
    change = (abs(depth) + _ROUNDING_SHARE) * deepest + _LARGEST_SIGMA * rms
    phase = 2 * math.pi * change / _VIOLET
    relative_change = change / (deepest - change) if deepest > change else math.inf
    return max(phase, relative_change)


@height_error.check
def _(result: Tensor, height: Tensor, *_: Any, **__: Any) -> list[Check]:
    change = (result - height).detach().double()
    text = (
        f"{float(change.square().mean().sqrt()) * 1e9:.3g} nm root mean square from the height of"
        " the design"
    )
    return [Check(text, bool(torch.isfinite(change).all()))]
