"""Reliefs that learn: what is drawn once by the nodes of the same names, with the numbers behind it free."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from neusee.nodes._weights import loaded
from neusee.nodes.doe._masks import axicon, cubic, half_rings, spiral_axicon, vortex, zernike
from neusee.nodes.doe._pixelwise import pixelwise
from neusee.nodes.doe._unet import HeightNet, fresh, height_of

_ROOM = 0.05  #: of a formula's depth, above and below


class FreeRelief(nn.Module):
    """A relief between 0 and ``depth`` of which every sample is free."""

    def __init__(self, start: Tensor, depth: float) -> None:
        super().__init__()
        self.depth = depth
        self.logits = nn.Parameter(torch.logit((start / depth).clamp(1e-4, 1 - 1e-4)))

    def forward(self) -> Tensor:
        """Height (v, u) in m."""
        return self.depth * torch.sigmoid(self.logits)


class DrawnRelief(nn.Module):
    """A relief that a network draws from the pupil coordinates."""

    def __init__(self, net: HeightNet, samples: int, grid: int, max_height: float) -> None:
        super().__init__()
        self.net, self.samples, self.grid, self.max_height = net, samples, grid, max_height

    def forward(self) -> Tensor:
        """Height (v, u) in m."""
        return height_of(self.net, self.samples, self.grid, self.max_height)


def _free(params: Mapping[str, Any], rng: torch.Generator) -> FreeRelief:
    start: Tensor = pixelwise(**params, rng=rng)
    return FreeRelief(start.to(rng.device), params["depth"])


def _freed(make: Callable[..., Tensor]) -> Callable[[Mapping[str, Any], torch.Generator], FreeRelief]:
    """Start as a formula has it, lifted off the ends, where a sigmoid has no slope: a piston is not seen."""

    def start(params: Mapping[str, Any], rng: torch.Generator) -> FreeRelief:
        height = make(**params)
        room = _ROOM * float(height.amax())
        return FreeRelief((height + room).to(rng.device), float(height.amax()) + 2 * room)

    return start


def _drawn(params: Mapping[str, Any], rng: torch.Generator) -> DrawnRelief:
    width, samples, grid, weights = (params[name] for name in ("width", "samples", "grid", "weights"))
    if weights is None:
        net = fresh(width, min(grid, samples), rng)
    else:
        net = loaded(lambda: HeightNet(width), weights).to(rng.device)
    return DrawnRelief(net, samples, grid, params["max_height"])


#: by node: a relief that starts as the node draws it, from the node's own parameters; a flat one has no slope to leave
LEARNT: dict[str, Callable[[Mapping[str, Any], torch.Generator], nn.Module]] = {
    "doe.pixelwise": _free,
    "doe.unet": _drawn,
    **{make.path: _freed(make) for make in (half_rings, axicon, spiral_axicon, vortex, cubic, zernike)},
}
