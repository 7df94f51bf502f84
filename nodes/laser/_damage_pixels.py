"""Dead pixels in the raw frame of a sensor that a laser has damaged: points, lines, crosses and whole frames."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.laser._damage_laws import KINDS, Kind
from neusee.nodes.laser._damage_spot import SpotDamage
from neusee.nodes.sensor._digitization import Bits, crop
from neusee.nodes.sensor._room_for_light import refuse_without_steps
from neusee.nodes.sensor._saturation import Well
from neusee.nodes.units import Gain


@node(rtol=0.0)
def damaged_pixels(
    raw: Tensor,
    damages: list[SpotDamage] | None = None,
    *,
    full_well: Well,
    gain: Gain,
    bits: Bits = 16,
    device: str = "CMOS",
) -> Tensor:
    """Draw the pixels that lasers have destroyed in a raw frame, from the patterns of the step `laser.damage`.

    `point` is a white pixel, `destruction` a black pixel, `line` a black row of a CMOS or a white column of a CCD,
    `cross` a black row and a black column, and `frame` a black frame. What stands later here covers what stands before.

    Shapes: raw (channel, y, x), each pattern (y, x) of at least that size -> (channel, y, x), float32 for half
            precision, which cannot hold the white of 16 bits.
    Units:  DN.
    Error:  a drawing of the published kinds of damage. Which neighbours a line takes with it, how bright a dead column
            is, and what changes later are left out.
    Source: Schwarz et al., Opt. Eng. 56, 034108 (2017), abstract (dead pixels, columns and rows); Bi et al., Opt.
            Express 32, 4709 (2024), abstract (point, line, cross); Photonics 12, 790 (2025), abstract (white points,
            black lines in both directions, no valid frame). That lines of a CCD are white columns is ours.
    """
    shape = (raw.shape[-2], raw.shape[-1])
    pattern = torch.zeros(shape, dtype=torch.uint8, device=raw.device)
    for each in damages or ():
        pattern |= crop(each.pattern, shape=shape).to(raw.device)
    white = float(max(1, min(2**bits - 1, int(full_well * gain - 0.5))))
    drawn = single(raw).masked_fill(_of(pattern, "point"), white).masked_fill(_of(pattern, "destruction"), 0.0)
    if device.casefold() == "ccd":
        drawn = drawn.masked_fill(_of(pattern, "line").any(-2, keepdim=True), white)
    else:
        drawn = drawn.masked_fill(_of(pattern, "line").any(-1, keepdim=True), 0.0)
    cross = _of(pattern, "cross")
    drawn = drawn.masked_fill(cross.any(-1, keepdim=True) | cross.any(-2, keepdim=True), 0.0)
    return drawn.masked_fill(_of(pattern, "frame").any(), 0.0)


def _of(pattern: Tensor, kind: Kind) -> Tensor:
    """Return True for the pixels (y, x) of a pattern that have a kind of damage."""
    return (pattern & (1 << KINDS.index(kind))) > 0


@damaged_pixels.preflight
def _(*, full_well: float, gain: float, bits: int = 16, **params: object) -> list[str]:
    refuse_without_steps(full_well, gain=gain, bits=bits)
    return []


@damaged_pixels.check
def _(result: Tensor, raw: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    changed = int((result != raw).any(-3).sum())
    return [Check(f"damage changes {changed} pixels of the frame", changed == 0)]
