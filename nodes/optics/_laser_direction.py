"""The direction of a laser, given in the recipe or sampled at random as in the paper."""

import math
from typing import Any, Literal

import torch
from torch import Generator, Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.units import Angle, FocalLength, Fraction, PixelPitch, Shape

_WIDEST = 1.0  #: rad; an angle counts as its direction cosine, which is below 1
_SMALL = 0.01  #: relative difference of an angle and its sine, above which a note says the difference
Rule = Literal["width_over_focal_length", "focal_length_over_width"]


@node()
def direction(
    *,
    angle: tuple[Angle, Angle] | None = None,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    shape: Shape,
    share: Fraction = 0.36,
    rule: Rule = "width_over_focal_length",
    rng: Generator,
) -> Tensor:
    """Return the direction of a laser: ``angle``, or a normally distributed angle with 3 sigma = share x W / f per
    axis.

    W is the side of the sensor. A draw beyond the edge of the sensor is repeated, so the spot lies on the sensor.
    The paper prints f / W instead: 6.7 rad for its camera, which no lens images. A draw by f / W is refused.

    Shapes: -> (2,), (n_y, n_x) float64.
    Units:  rad (direction cosines; sine and angle agree to 1e-6 at 2 mrad, and to 1 % at 14 degrees).
    Error:  exact.
    Raises: ParameterError before the run where ``rule`` asks for a draw by f / W, and for an angle of 1 rad or more,
            which is no direction cosine.
    Source: NeuSee, section Experiment Setup; by definition.
    """
    if angle is not None:
        return torch.tensor(angle, dtype=torch.float64)
    edges = field_of_view(focal_length, pixel_pitch, shape)
    return torch.stack([_inside(share * edge / 3, edge / 2, rng) for edge in edges])


def field_of_view(focal_length: float, pixel_pitch: float, shape: tuple[int, int]) -> tuple[float, float]:
    """Return the direction cosines (n_y, n_x) between opposite edges of the sensor: side x pitch / f."""
    height, width = (side * pixel_pitch / focal_length for side in shape)
    return height, width


def _inside(sigma: float, edge: float, rng: Generator) -> Tensor:
    """Sample a normal distribution of standard deviation ``sigma``, limited to absolute values of at most ``edge``."""
    while True:
        drawn = sigma * torch.randn((), generator=rng, device=rng.device, dtype=torch.float64)
        if float(drawn.abs()) <= edge:
            return drawn.cpu()


@direction.preflight
def _(
    *,
    angle: tuple[float, float] | None,
    focal_length: float,
    pixel_pitch: float,
    shape: tuple[int, int],
    share: float,
    rule: Rule,
) -> list[str]:
    if angle is not None:
        return angle_notes(angle)
    if rule == "focal_length_over_width":
        wide = share * focal_length / (shape[1] * pixel_pitch)
        raise ParameterError(
            "rule",
            f"{share:g} f / W = {wide:.3g} rad would put the spot {wide * focal_length:.2g} m off the axis: "
            "set `angle`, or set rule: width_over_focal_length",
        )
    return []


def angle_notes(angle: tuple[float, float]) -> list[str]:
    """Return a note for an angle that differs by more than 1 % from its sine.

    Raises ParameterError for an angle of 1 rad or more, because the model takes an angle as its direction cosine.
    """
    size = math.hypot(*angle)
    degrees = f"{math.degrees(size):.4g} deg"
    if size >= _WIDEST:
        raise ParameterError(
            "angle",
            f"{degrees} off the axis is {size:.4g} rad, but the model takes an angle in rad as its direction cosine, "
            "which is below 1: give less than 57.3 deg",
        )
    off = 1 - math.sin(size) / size if size else 0.0
    text = f"{degrees} off the axis: the model takes an angle as its direction cosine, and the two differ by {off:.1%}"
    return [text] if off > _SMALL else []


@direction.check
def _(result: Tensor, *, focal_length: float, pixel_pitch: float, shape: tuple[int, int], **_: Any) -> list[Check]:
    y, x = (float(n) * focal_length / pixel_pitch for n in result)
    seen = abs(y) <= shape[0] / 2 and abs(x) <= shape[1] / 2
    off = math.degrees(math.hypot(*(float(n) for n in result)))
    beyond = "" if seen else ": beyond the sensor, where only glare reaches the picture"
    return [Check(f"spot {y:+.1f}, {x:+.1f} px (y, x) off the axis, {off:.3g} deg{beyond}")]
