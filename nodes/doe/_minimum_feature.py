"""The least feature that a tool can make: a relief seen through the spot that writes it."""

import math
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import refuse_half
from neusee.nodes.doe._height_from_phase import height_checks
from neusee.nodes.optics._pupil_grid import Aperture, stop
from neusee.nodes.units import Count, PositiveLength

_REACH = 6.0  #: standard deviations beyond which the spot holds 1e-9 of its dose


@node(rtol=1e-5)
def smooth(
    height: Tensor,
    *,
    feature: PositiveLength,
    samples: Count,
    pitch: PositiveLength,
    diameter: PositiveLength,
    aperture: Aperture = "inscribed",
) -> Tensor:
    """Write the relief with a round Gaussian spot whose full width at half maximum is ``feature``.

    Depth follows dose, and dose is the wanted relief averaged over the spot: steps get flanks of ``feature``, pillars
    narrower than it vanish, planes and everything wide stay. An average lies between the least and the greatest
    of what it averages, so a relief that keeps to its depth still does. At the edge of the grid the average is over
    what there is. A Gaussian and not a disc, for its transfer function has no negative lobes: features too
    small to be made fade, and none comes out upside down.

    Shapes: (v, u) -> (v, u).
    Units:  m.
    Error:  1e-6 of the deepest height (float32). A spot narrower than a sample and a half is the samples' own.
    Raises: ValueError for a height in half precision, or of another shape than the pupil grid.
    Source: Gaussian spot of laser lithography: Gale et al., Opt. Eng. 33, 3556 (1994).
    """
    refuse_half(height=height)
    if tuple(height.shape) != (samples, samples):
        raise ValueError(f"height is {tuple(height.shape)}, the pupil grid ({samples}, {samples}): give both alike")
    spread = _spread(samples, feature / stop(samples, pitch, diameter, aperture).pitch).to(height)
    return spread @ height @ spread.T


def _spread(samples: int, feature: float) -> Tensor:
    """Matrix of averages along an axis, rows of sum 1, float64; ``feature`` in samples."""
    sigma = feature / math.sqrt(8 * math.log(2))
    place = torch.arange(samples, dtype=torch.float64)
    weights = torch.exp(-((place[:, None] - place) ** 2) / (2 * sigma**2))
    weights = weights.where((place[:, None] - place).abs() <= _REACH * sigma + 0.5, 0.0)
    return weights / weights.sum(1, keepdim=True)


@smooth.reference
def _(
    height: Tensor, *, feature: float, samples: int, pitch: float, diameter: float, aperture: Aperture = "inscribed"
) -> Tensor:
    """The average at each place over all others, one place after another."""
    sigma = feature / stop(samples, pitch, diameter, aperture).pitch / math.sqrt(8 * math.log(2))
    x, place = height.double(), torch.arange(samples, dtype=torch.float64)
    made = torch.empty_like(x)
    for v in range(samples):
        for u in range(samples):
            square = (place[:, None] - v).square() + (place - u).square()
            spot = torch.exp(-square / (2 * sigma**2))
            made[v, u] = (spot * x).sum() / spot.sum()
    return made


@smooth.preflight
def _(*, feature: float, samples: int, pitch: float, diameter: float, aperture: Aperture) -> list[str]:
    own = stop(samples, pitch, diameter, aperture).pitch
    if feature < 1.5 * own:
        return [
            f"feature {feature * 1e6:.3g} um is less than 1.5 samples of {own * 1e6:.3g} um: the samples' own shows"
        ]
    return []


@smooth.check
def _(result: Tensor, height: Tensor, *_: Any, feature: float, **__: Any) -> list[Check]:
    moved = float((result - height).detach().double().square().mean().sqrt())
    text = f"features below {feature * 1e6:.3g} um smoothed: {moved * 1e9:.3g} nm root mean square"
    return [Check(text), *height_checks(result)]
