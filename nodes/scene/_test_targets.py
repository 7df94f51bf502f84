"""Synthetic test targets as scenes: flat field, edges, Siemens star and points."""

import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.units import Fraction, Shape

Kind = Literal["flat", "edge", "slanted_edge", "siemens", "points"]
_EDGE_TILT = math.radians(5.0)  #: angle of the slanted edge to the columns
_STAR_CYCLES = 36  #: number of cycles of the star in one full turn
_POINT_SPACING = 64  #: distance between neighbouring points in pixels


@node(rtol=1e-5)
def targets(*, kind: Kind, shape: Shape, low: Fraction = 0.0, high: Fraction = 1.0) -> Tensor:
    """Draw a grey test target: a flat field, a straight or slanted edge, a Siemens star, or points.

    `flat` is `high` everywhere; `edge` is vertical through the axis, bright towards +x;
    `slanted_edge` is an edge tilted by 5 degrees; `siemens` is a sinusoidal star of 36 cycles;
    `points` are single pixels, 64 apart, with one on the axis.

    Shapes: -> (3, y, x) float32, the axis at sample N//2.
    Units:  linear sRGB, grey between `low` and `high`.
    Error:  edges are exact averages over the area of a pixel; the star is sampled at the centre of
            a pixel, and grey where a cycle is shorter than two pixels.
    Raises: ParameterError before the run where low exceeds high.
    Source: slanted edge and sinusoidal star as in ISO 12233:2017.
    """
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in shape)
    share = _BRIGHT_SHARE[kind](y[:, None], x[None, :]).expand(shape)
    return (low + (high - low) * share).float().expand(3, *shape).clone()


@targets.preflight
def _(*, low: float = 0.0, high: float = 1.0, **params: Any) -> list[str]:
    if low > high:
        raise ParameterError("low", f"low {low:g} is above high {high:g}: exchange the two numbers")
    return []


@targets.check
def _(result: Tensor, *, low: float = 0.0, high: float = 1.0, **params: Any) -> list[Check]:
    lowest, highest = float(result.min()), float(result.max())
    return [
        Check(
            f"light of the target from {lowest:.3g} to {highest:.3g}",
            lowest >= low - 1e-6 and highest <= high + 1e-6,
        )
    ]


def _slanted(y: Tensor, x: Tensor) -> Tensor:
    """Return the exact fraction of the area of each pixel on the bright side of a slanted edge
    through the axis.
    """
    cosine, sine = math.cos(_EDGE_TILT), math.sin(_EDGE_TILT)
    distance = x * cosine + y * sine
    far_corner, near_corner = (cosine + sine) / 2, (cosine - sine) / 2
    # area of a pixel on the bright side: sum of +-(distance of a corner from the edge)^2 / 2 over
    # the corners on this side
    corners = [(1, far_corner), (-1, near_corner), (-1, -near_corner), (1, -far_corner)]
    areas = [sign * (distance + offset).clamp_min(0) ** 2 / 2 for sign, offset in corners]
    return (sum(areas, torch.zeros_like(distance)) / (cosine * sine)).clamp(0, 1)


def _siemens(y: Tensor, x: Tensor) -> Tensor:
    """Return the share of the bright grey of a star with `_STAR_CYCLES` cycles: (1 + cos(cycles x
    azimuth)) / 2, and 1/2 where a cycle is shorter than two pixels and beyond the largest circle.
    """
    radius = torch.hypot(y, x)
    largest_radius = min(int(y.numel()), int(x.numel())) / 2 - 1
    resolved_radius = _STAR_CYCLES / math.pi  # radius where a cycle is two pixels long
    star_share = (largest_radius - radius + 0.5).clamp(0, 1) * (
        radius - resolved_radius + 0.5
    ).clamp(0, 1)
    return 0.5 + 0.5 * star_share * torch.cos(_STAR_CYCLES * torch.atan2(y, x))


#: share of `high` in each pixel, as a function of its coordinates y and x from the axis
_BRIGHT_SHARE: dict[Kind, Callable[[Tensor, Tensor], Tensor]] = {
    "flat": lambda y, x: torch.ones_like(y + x),
    "edge": lambda y, x: (x + 0.5 + 0 * y).clamp(0, 1),
    "slanted_edge": _slanted,
    "siemens": _siemens,
    "points": lambda y, x: ((y % _POINT_SPACING == 0) & (x % _POINT_SPACING == 0)).double(),
}
