"""Fabrication limits of a mask: wrapping, limited depth, discrete heights."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, TensorStats, node
from neusee.nodes._half_precision import refuse_half
from neusee.nodes.doe._refractive_index import AnyGlass, Glass, nearest_known, refuse_material, wave_height
from neusee.nodes.units import Depth, Wavelength

Levels = Annotated[int, Field(ge=2, le=65536)]
_VIOLET = 400e-9  #: m, wavelength at which a change of height is converted to a change of phase


def _quantize(height: Tensor, step: float, levels: int, cyclic: bool) -> Tensor:
    """Round each height to the nearest of ``levels`` discrete heights; the gradient passes through unchanged."""
    with torch.no_grad():
        level = (height / step).round()
        level = level.remainder(levels) if cyclic else level.clamp(0, levels - 1)
        change = level * step - height
    return height + change.detach()  # without a tangent too


def _refuse(material: AnyGlass, wrap_at: float | None, levels: int | None, max_height: float | None) -> None:
    if wrap_at is not None and max_height is not None and wave_height(material, wrap_at) > max_height:
        wave = f"{wave_height(material, wrap_at) * 1e6:.3f} um"
        text = f"{max_height * 1e6:.3g} um is less than one wave of wrap_at in {_name(material)}: needs at least {wave}"
        raise ParameterError("max_height", text)
    if levels is not None and wrap_at is None and max_height is None:
        raise ParameterError("levels", f"{levels} levels need a total depth: set wrap_at or max_height")


def _name(material: AnyGlass) -> str:
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
    """Wrap the height map at one wave of ``wrap_at`` or limit it to ``max_height``, then round to ``levels`` heights.

    The levels of a wrapped height map divide one wave, whose top equals its bottom. The levels of a limited height map
    run from 0 to ``max_height`` inclusive. Wrapping and rounding have the gradient 1; a height that is cut off has 0.

    Shapes: (v, u) -> (v, u).
    Units:  m.
    Error:  1e-7 of the result (float32), for any number of wraps.
    Raises: ParameterError where one wave is deeper than ``max_height``, or levels have no depth to divide; ValueError
            for a height in half precision.
    Source: Swanson, MIT Lincoln Laboratory Technical Report 854 (1989), for multi-level elements.
    """
    _refuse(material, wrap_at, levels, max_height)
    refuse_half(height=height)
    if wrap_at is not None:
        period = wave_height(material, wrap_at)
        wrapped = height.double().remainder(period).to(height.dtype)  # the period too is rounded in float32
        return wrapped if levels is None else _quantize(wrapped, period / levels, levels, cyclic=True)
    if max_height is None:
        return height
    limited = height.clamp(0, max_height)
    return limited if levels is None else _quantize(limited, max_height / (levels - 1), levels, cyclic=False)


@fabricate.reference
def _(
    height: Tensor, *, material: AnyGlass, wrap_at: float | None, levels: int | None, max_height: float | None
) -> Tensor:
    """Compare each height with every allowed height, and return the nearest allowed height."""
    wave = None if wrap_at is None else wave_height(material, wrap_at)
    x = height.to(torch.float64)
    x = x if wave is None else x - wave * (x / wave).floor()
    x = x if max_height is None else torch.minimum(x, torch.full_like(x, max_height)).clamp(min=0)
    top = wave or max_height
    if levels is None or top is None:
        return x
    allowed = [top * k / (levels if wave else levels - 1) for k in range(levels + 1 if wave else levels)]
    table = torch.tensor(allowed, dtype=torch.float64, device=x.device)
    nearest = table[(x[..., None] - table).abs().argmin(-1)]
    return nearest if wave is None else torch.where(nearest == wave, 0.0, nearest)


@fabricate.skip_bound
def _(
    height: TensorStats, *, material: AnyGlass, wrap_at: float | None, levels: int | None, max_height: float | None
) -> float:
    """Return an upper bound of the relative change of a height map by fabrication; 0 if every height fits.

    A small change of height may be a large phase: the bound is never below the phase, in radians, of that change at
    400 nm, or at the nearest wavelength at which the glass is known. Wrapping turns no phase at ``wrap_at``, and counts
    in full all the same.
    """
    top = max_height if wrap_at is None else wave_height(material, wrap_at)
    if not height.finite or top is None:
        return 0.0 if height.finite else math.inf
    ends = torch.tensor([height.min, height.max], dtype=getattr(torch, height.dtype))
    change = _largest_change(ends, top, levels, cyclic=wrap_at is not None)
    if change == 0:
        return 0.0
    fabricated = fabricate(ends, material=material, wrap_at=wrap_at, levels=levels, max_height=max_height)
    deepest, phase = (
        float(fabricated.abs().max()),
        2 * math.pi * change / wave_height(material, nearest_known(material, _VIOLET)),
    )
    return max(phase, change / deepest if deepest > 0 else math.inf)


def _largest_change(ends: Tensor, top: float, levels: int | None, cyclic: bool) -> float:
    """Return an upper bound, in m, of the change of any height within ``ends`` by fabrication; exact without levels."""
    low, high = (float(end) for end in ends)
    if not cyclic:
        top = float(torch.tensor(top, dtype=ends.dtype))  # the limit in the precision of the height map
        return max(high - top, -low, 0.0 if levels is None else top / (levels - 1) / 2)
    waves = max(abs(math.floor(low / top)), abs(math.floor(high / top)))
    if levels is None:
        return top * waves
    rounded_up = high >= top * (1 - 0.5 / levels) * (1 - 4 * torch.finfo(ends.dtype).eps)  # to a whole wave, which is 0
    return top * (waves + rounded_up + 0.5 / levels)


@fabricate.preflight
def _(*, material: AnyGlass, wrap_at: float | None, levels: int | None, max_height: float | None) -> list[str]:
    refuse_material("wrap_at", material, None if wrap_at is None else torch.tensor([wrap_at], dtype=torch.float64))
    _refuse(material, wrap_at, levels, max_height)
    if max_height is not None and wrap_at is None:
        return [
            f"heights above max_height {max_height * 1e6:.3g} um are cut flat: set wrap_at to wrap the heights instead"
        ]
    return []


@fabricate.check
def _(result: Tensor, height: Tensor, *, wrap_at: float | None, max_height: float | None, **_: Any) -> list[Check]:
    checks = [Check(f"mask {float(height.max()) * 1e6:.4g} um deep, {float(result.max()) * 1e6:.4g} um as fabricated")]
    if max_height is not None and wrap_at is None:
        share = float((height > max_height).double().mean())
        checks.append(Check(f"heights cut flat at max_height: {share:.2%} of the pupil grid", share == 0))
    return checks
