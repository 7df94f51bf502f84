"""Height map computed by a network from the pupil coordinates alone: smooth, with a million
parameters.
"""

from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from neusee.nodes import node
from neusee.nodes.doe._refractive_index import height_checks
from neusee.nodes.network_weights import loaded, same_layout
from neusee.nodes.resampling import enlarge
from neusee.nodes.units import Count, DataFile, Depth, Layers
from neusee.nodes.values import Stop

#: frequency of the first layer's sines: about four periods across the pupil at the start
PITCH = 15.0


class HeightNet(nn.Module):
    """A network of four downsampling and four upsampling convolutions, from (u, v) to one logit for
    each sample.

    Sines follow the first convolution, so that the height map can be less smooth than the
    coordinates.
    """

    def __init__(self, width: int = 32) -> None:
        """Build the network with ``width`` channels after its first layer, doubled at each of three
        halvings.
        """
        super().__init__()
        sizes = [2, width, 2 * width, 4 * width, 8 * width]
        pairs = zip(pairwise(sizes), [1, 2, 2, 2], strict=True)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, stride=s) for (a, b), s in pairs)
        self.up = nn.ModuleList(nn.Conv2d(3 * b, b, 3) for b in sizes[3:0:-1])
        self.last = nn.Conv2d(width, 1, 3)

    def forward(self, coordinates: Tensor) -> Tensor:
        """Return the logits (y, x) at the coordinates (2, y, x)."""
        level_outputs = [torch.sin(PITCH * self.down[0](_edged(coordinates[None])))]
        for layer in self.down[1:]:
            level_outputs.append(F.silu(layer(_edged(level_outputs[-1]))))
        features = level_outputs[-1]
        for layer, skip in zip(self.up, level_outputs[-2::-1], strict=True):
            features = F.silu(
                layer(
                    _edged(
                        torch.cat([enlarge(features, skip.shape[-2], skip.shape[-1]), skip], dim=1)
                    )
                )
            )
        logits: Tensor = self.last(_edged(features))[0, 0]
        return logits


def _edged(x: Tensor) -> Tensor:
    """Pad a tensor with its outermost rows and columns, because zeros would add a frame to the
    height map.
    """
    x = torch.cat([x[..., :1, :], x, x[..., -1:, :]], dim=-2)
    return torch.cat([x[..., :1], x, x[..., -1:]], dim=-1)


def coordinates(grid: int, device: torch.device | None = None) -> Tensor:
    """Return the input (2, grid, grid) of the height network: u and v from -1 to 1 across the
    pupil grid.
    """
    line = (torch.arange(grid, dtype=torch.float64, device=device) - (grid - 1) / 2) * (2 / grid)
    v, u = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([u, v]).to(torch.float32)


def height_of(net: nn.Module, samples: int, grid: int, max_height: float) -> Tensor:
    """Return the height map (samples, samples) of a network, 0 to ``max_height``, differentiable
    in the weights.
    """
    like = next(net.parameters())
    logits = net(coordinates(min(grid, samples), like.device).to(like))
    return max_height * torch.sigmoid(enlarge(logits, samples, samples))


def fresh(width: int, grid: int, rng: torch.Generator) -> HeightNet:
    """Return a new height network with random orthogonal weights and zero biases.

    The last layer is scaled to logits of mean 0 and standard deviation 1, so that the height map is
    far from flat.
    """
    net = HeightNet(width).to(rng.device)
    with torch.no_grad():
        for name, parameter in net.named_parameters():
            if name.endswith("bias"):
                parameter.zero_()
            else:
                nn.init.orthogonal_(parameter, gain=2**0.5, generator=rng)
        logits = net(coordinates(grid, rng.device))
        logit_deviation = logits.std(correction=0).clamp(min=1e-12)
        net.last.weight.div_(logit_deviation)
        net.last.bias = nn.Parameter((-logits.mean() / logit_deviation)[None])
    return net


@node()
def unet(
    stop: Stop,
    *,
    max_height: Depth = 1.2e-6,
    grid: Count = 270,
    width: Layers = 32,
    weights: DataFile | None = None,
    rng: torch.Generator,
) -> Tensor:
    """Compute the height map by a UNet of the pupil coordinates: max_height * sigmoid(UNet(u, v)).

    The network has ``grid`` samples. The bicubic resampling precedes the sigmoid, which keeps all
    heights in range. The coordinates are relative, so that the height map is as wide as the pupil:
    ``weights`` state no size.

    Shapes: stop -> (v, u).
    Units:  m.
    Error:  1e-6 of max_height (float32).
    Source: "Learning to See Through Flare", "Neural Representation of the DOE"; the layer widths
            are ours.
    """
    samples = int(stop.samples)
    net = (
        fresh(width, min(grid, samples), rng)
        if weights is None
        else loaded(partial(HeightNet, width), weights)
    )
    return height_of(net, samples, grid, max_height).detach()


@unet.preflight
def _(*, width: int, weights: Path | None, stop: Stop | None = None, **_: Any) -> list[str]:
    if weights is None:
        return []
    same_layout(partial(HeightNet, width), weights, width)
    if stop is None or stop.pitch.is_meta:
        return []
    span = float(stop.samples * stop.pitch) * 1e3
    return [f"{weights.name} states no size: its height map is as wide as the pupil, {span:.4g} mm"]


unet.check(height_checks)
