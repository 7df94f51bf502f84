"""The base of all restoration networks: initial weights, and restoration of a picture in tiles."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, TypeVar

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional as F

from neusee.nodes import Check, ParameterError
from neusee.nodes.network_weights import empty, loaded, same_layout
from neusee.nodes.precision import exact_convolutions, refuse_not_finite, single
from neusee.nodes.resampling import mirrored, resize
from neusee.nodes.units import Count

# --- tiles ----------------------------------------------------------------------------------------

# Restoration of a picture in tiles of the size of the training pictures, blended without seams.


_OVERLAP = 0.25  #: smallest overlap of neighbouring tiles, relative to the side of a tile


def tiled(change: Callable[[Tensor], Tensor], picture: Tensor, side: int) -> Tensor:
    """Apply ``change`` to a picture (n, 3, y, x) tile by tile, and return the weighted mean of
    overlapping tiles.

    The weights fall linearly towards an edge that overlaps another tile, so that there is no step
    between tiles. Tiles lie inside the picture. A picture not larger than a tile is changed as a
    whole.
    """
    size = (picture.shape[-2], picture.shape[-1])
    if max(size) <= side:
        return change(picture)
    weighted_sum, weights = torch.zeros_like(picture), picture.new_zeros(size)
    rows, columns = (_starts(n, side) for n in size)
    for top, left in product(rows, columns):
        window = (..., slice(top, top + side), slice(left, left + side))
        weight = torch.outer(
            *(_ramp(start, side, n, picture) for start, n in zip((top, left), size, strict=True))
        )
        weighted_sum[window] += change(picture[window]) * weight
        weights[window] += weight
    return weighted_sum / weights


def _starts(length: int, side: int) -> list[int]:
    """Return the first pixel of each tile along an axis: the smallest number of equally spaced
    tiles that overlap by at least `_OVERLAP`.
    """
    if length <= side:
        return [0]
    count = 1 + math.ceil((length - side) / (side * (1 - _OVERLAP)))
    return [round(i * (length - side) / (count - 1)) for i in range(count)]


def _ramp(start: int, side: int, length: int, like: Tensor) -> Tensor:
    """Return the blending weights of a tile along one axis: 1, falling to almost 0 at tile edges
    inside the picture.
    """
    side = min(side, length)
    position = torch.arange(side, dtype=like.dtype, device=like.device) + 0.5
    rising = (position / (side * _OVERLAP)).clamp(max=1.0)
    ramp = torch.ones_like(position)
    if start > 0:
        ramp = ramp * rising
    if start + side < length:
        ramp = ramp * rising.flip(0)
    return ramp


# --- restorer -------------------------------------------------------------------------------------

# The common base of all restoration networks, with their initial weights and their application to a
# picture.


Net = TypeVar("Net", bound=nn.Module)
Tile = Annotated[Count, Field(ge=32)]  #: side of a tile, pixels
LEAK = 0.2  #: slope of a leaky ReLU for negative inputs
LEAKY = nn.init.calculate_gain("leaky_relu", LEAK)
LAYERS = (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)


class Restorer(nn.Module, ABC):
    """A network that restores pictures (n, 3, y, x) of any size, at full and at half size.

    ``conditions`` are further inputs besides the pixels of a picture; most networks have none.
    """

    multiple: int  #: divisor of the height and width inside the network

    @abstractmethod
    def pyramid(self, picture: Tensor, *conditions: Any) -> tuple[Tensor, Tensor]:
        """Return the restored picture at half the size, rounded up, and at the full size."""

    def forward(self, picture: Tensor, *conditions: Any) -> Tensor:
        return self.pyramid(picture, *conditions)[1]

    @abstractmethod
    def begin(self) -> None:
        """Change the initial weights so that the network at first returns almost the same
        picture.
        """

    @property
    def stored(self) -> nn.Module:
        """Return the module whose tensors are stored in a file of weights."""
        return self


class PictureRestorer(Restorer):
    """A restoration network whose only input is the picture."""

    last: nn.Conv2d  #: layer that computes the change that is added to the picture

    @abstractmethod
    def scales(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """Return the restored picture at half and full size, for a picture whose sides are
        multiples of `multiple`.
        """

    def pyramid(self, picture: Tensor, *conditions: Any) -> tuple[Tensor, Tensor]:
        y, x = picture.shape[-2:]
        coarse, fine = self.scales(mirrored(picture, -y % self.multiple, -x % self.multiple))
        return coarse[..., : -(-y // 2), : -(-x // 2)], fine[..., :y, :x]

    def begin(self) -> None:
        self.last.weight.mul_(0.1)


class Flat(PictureRestorer):
    """A restoration network that works at full size only; its coarse estimate is the fine estimate
    at half size.
    """

    @abstractmethod
    def change(self, picture: Tensor) -> Tensor:
        """Return the restored picture minus ``picture``, whose sides are multiples of
        `multiple`.
        """

    def scales(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        fine = picture + self.change(picture)
        return resize(fine, picture.shape[-2] // 2, picture.shape[-1] // 2), fine


class ChannelNorm(nn.LayerNorm):
    """A layer norm over the channels of a picture (n, channel, y, x), computed in float32 or
    better.
    """

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(single(input).movedim(1, -1)).movedim(-1, 1)


class Scale(nn.Module):
    """A trainable factor for each channel of the output of a network block; it starts at 0.1."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.empty(channels, 1, 1))

    def start(self, rng: torch.Generator) -> None:
        nn.init.constant_(self.factor, 0.1)

    def forward(self, x: Tensor) -> Tensor:
        return x * self.factor


def start_network(make: Callable[[], Net], rng: torch.Generator) -> Net:
    """Return a network with initial values: random orthogonal weights and zero biases for linear
    and convolution layers.

    Norms, decays and factors have other initial values. The weights of a network with leaky layers
    are multiplied by its `gain`, so that the power stays the same from layer to layer.
    `Restorer.begin` makes the change of a picture small, so that the network at first returns
    almost the same picture.
    """
    net = empty(make).to_empty(device=rng.device)
    gain = getattr(net, "gain", 1.0)
    with torch.no_grad():
        for module in net.modules():
            if isinstance(module, LAYERS):
                nn.init.orthogonal_(module.weight, gain, generator=rng)
                if module.bias is not None:
                    module.bias.zero_()
            elif isinstance(module, nn.LayerNorm):
                module.reset_parameters()
            elif callable(start := getattr(module, "start", None)):
                start(rng)
        if isinstance(net, Restorer):
            net.begin()
    return net


def parameter_groups(
    net: nn.Module, weights: float = 2e-4, biases: float = 4e-4
) -> list[dict[str, Any]]:
    """Return the network's parameters in two groups for an optimiser: the second group are the
    biases of layers, with their own learning rate.
    """
    layer_biases = [m.bias for m in net.modules() if isinstance(m, LAYERS) and m.bias is not None]
    # by identity: `in` would compare the values of tensors
    bias_ids = set(map(id, layer_biases))
    others = [p for p in net.parameters() if id(p) not in bias_ids]
    return [{"params": others, "lr": weights}, {"params": layer_biases, "lr": biases}]


def restored(
    picture: Tensor,
    make: Callable[[], Restorer],
    weights: Path | None,
    tile: int | None = None,
    reduce: int = 1,
    detail: bool = False,
) -> Tensor:
    """Restore a picture in float32 by a network with weights read from a file; only the picture
    receives gradients.

    ``tile``: the side of the pieces in which a larger picture is restored. ``reduce``: the factor
    by which the picture is first reduced and afterwards enlarged, antialiased; ``detail`` adds the
    detail that the reduction loses.
    """
    return restored_by(lambda: loaded(make, _needed(weights)), picture, tile, reduce, detail)


def restored_by(
    ready: Callable[[], nn.Module],
    picture: Tensor,
    tile: int | None = None,
    reduce: int = 1,
    detail: bool = False,
) -> Tensor:
    """Restore a picture as `restored` does, by the network with weights that ``ready`` returns."""
    if picture.ndim != 3 or len(picture) != 3:
        raise ValueError(
            f"a picture {tuple(picture.shape)} is not a colour picture: give (3, y, x)"
        )
    refuse_not_finite("the network would spread them to every pixel", picture=picture)
    net = ready().requires_grad_(False).eval().to(picture.device)
    with (
        exact_convolutions(picture, deterministic=True),
        torch.autocast(picture.device.type, enabled=False),
    ):
        y, x = picture.shape[-2:]
        batch = picture.float()[None]
        reduced = batch if reduce == 1 else resize(batch, -(-y // reduce), -(-x // reduce))
        result: Tensor = net(reduced) if tile is None else tiled(net, reduced, tile)
        if reduce > 1:
            result = batch + resize(result - reduced, y, x) if detail else resize(result, y, x)
    return result[0]


def fitting(
    network: Callable[..., Restorer],
    *,
    weights: Path | None = None,
    tile: int | None = None,
    reduce: int = 1,
    detail: bool = False,
    width: int,
    **sizes: Any,
) -> list[str]:
    """Raise ParameterError if the file of weights is absent or belongs to another network;
    return no warnings.
    """
    same_layout(partial(network, width, **sizes), _needed(weights), width)
    return []


def _needed(weights: Path | None) -> Path:
    """Return the file of weights; raise ParameterError for none."""
    if weights is None:
        text = (
            "a network needs trained weights: give the .safetensors file of its weights, or choose"
            " restore: wiener"
        )
        raise ParameterError("weights", text)
    return weights


def restorer_checks(result: Tensor, picture: Tensor, **params: Any) -> list[Check]:
    """Return a check that shows the rms change of a picture by a network; it fails if the change is
    not finite.
    """
    change = float((result - picture).square().mean(dtype=torch.float64).sqrt())
    picture_rms = float(picture.square().mean(dtype=torch.float64).sqrt())
    return [
        Check(
            f"network changed the picture by {change:.3g} rms, of {picture_rms:.3g} rms before",
            math.isfinite(change),
        )
    ]


def gated(x: Tensor) -> Tensor:
    """Return the first half of the channels, multiplied by GELU of the second half."""
    value, gate = x.chunk(2, 1)
    return F.gelu(gate) * value
