"""Purely convolutional networks: a standard UNet, a small NAFNet, and critics of pictures."""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor, nn

from neusee.nodes import node
from neusee.nodes.precision import single
from neusee.nodes.restore.networks._restorer import (
    LEAK,
    LEAKY,
    ChannelNorm,
    Flat,
    Scale,
    Tile,
    fitting,
    restored,
    restorer_checks,
    start_network,
)
from neusee.nodes.units import Count, DataFile, Layers

# --- unet -----------------------------------------------------------------------------------------

# A standard UNet: a baseline for restoration networks with spectra and selective scans.


class UNet(Flat):
    """A network whose encoder halves size and doubles channels three times, with skips to a
    mirrored decoder.
    """

    multiple, gain = 8, LEAKY

    def __init__(self, width: int = 32) -> None:
        """Build the network with ``width`` channels at full size, doubled at each of three
        halvings.
        """
        super().__init__()
        sizes = [width, 2 * width, 4 * width, 8 * width]
        self.down = nn.ModuleList(_pair(a, b) for a, b in pairwise([3, *sizes]))
        self.shrink = nn.MaxPool2d(2)
        self.grow = nn.ModuleList(nn.ConvTranspose2d(2 * b, b, 2, 2) for b in sizes[2::-1])
        self.up = nn.ModuleList(_pair(2 * b, b) for b in sizes[2::-1])
        self.last = nn.Conv2d(width, 3, 1)

    def change(self, picture: Tensor) -> Tensor:
        level_outputs = [self.down[0](picture)]
        for convolutions in self.down[1:]:
            level_outputs.append(convolutions(self.shrink(level_outputs[-1])))
        features = level_outputs[-1]
        for grow, convolutions, skip in zip(self.grow, self.up, level_outputs[-2::-1], strict=True):
            features = convolutions(torch.cat([grow(features), skip], 1))
        result: Tensor = self.last(features)
        return result


def _pair(inputs: int, outputs: int) -> nn.Sequential:
    """Return two convolutions of 3 x 3 pixels, each with a leaky activation."""
    first, second = (
        nn.Conv2d(inputs, outputs, 3, padding=1),
        nn.Conv2d(outputs, outputs, 3, padding=1),
    )
    return nn.Sequential(first, nn.LeakyReLU(LEAK), second, nn.LeakyReLU(LEAK))


@node()
def unet(
    picture: Tensor,
    *,
    weights: DataFile | None = None,
    width: Layers = 32,
    tile: Tile | None = None,
    reduce: Count = 1,
    detail: bool = False,
) -> Tensor:
    """Restore a colour picture with a standard UNet, a baseline.

    ``tile``, ``reduce`` and ``detail`` as in `fft_mamba`.

    Shapes: picture (3, y, x) of any size -> (3, y, x).
    Units:  linear sRGB, as in the training of the weights.
    Error:  float32, 1e-5; of the restoration, the error that the training reached.
    Raises: ParameterError before the run without weights, or where the weights do not fit;
            ValueError for a picture that is not a colour picture or not finite.
    Source: Ronneberger et al., U-Net, MICCAI 2015; four levels, padded convolutions and the added
            picture are ours.
    """
    return restored(picture, partial(UNet, width), weights, tile, reduce, detail)


unet.preflight(partial(fitting, UNet))
unet.check(restorer_checks)


# --- nafnet ---------------------------------------------------------------------------------------

# A small NAFNet: a restoration network without activation functions.


class NAFBlock(nn.Module):
    """A block that multiplies pairs of channels in place of an activation function, and scales
    channels by a function of their means.
    """

    def __init__(self, width: int) -> None:
        """Build a block for ``width`` channels."""
        super().__init__()
        self.norm, self.second_norm = ChannelNorm(width), ChannelNorm(width)
        self.widen = nn.Conv2d(width, 2 * width, 1)
        self.mix = nn.Conv2d(2 * width, 2 * width, 3, padding=1, groups=2 * width)
        self.attend = nn.Conv2d(width, width, 1)
        self.narrow = nn.Conv2d(width, width, 1)
        self.feed, self.fed = nn.Conv2d(width, 2 * width, 1), nn.Conv2d(width, width, 1)
        self.scale, self.second_scale = Scale(width), Scale(width)

    def forward(self, x: Tensor) -> Tensor:
        features = _multiplied(self.mix(self.widen(self.norm(x))))
        features = self.narrow(features * self.attend(features.mean((-2, -1), keepdim=True)))
        x = x + self.scale(features)
        result: Tensor = x + self.second_scale(
            self.fed(_multiplied(self.feed(self.second_norm(x))))
        )
        return result


class NAFNet(Flat):
    """A network whose encoder levels halve the size and double the channels, with skips to a
    mirrored decoder.
    """

    def __init__(
        self,
        width: int = 16,
        levels: Sequence[int] = (1, 1, 2, 4),
        middle: int = 2,
        inputs: int = 3,
        outputs: int = 3,
    ) -> None:
        """Build the network with ``width`` channels at full size, doubled at each of its
        ``levels``.

        ``levels`` are the numbers of blocks at each level of the encoder, ``middle`` is the number
        at the smallest size. ``inputs`` and ``outputs`` are the numbers of channels.
        """
        super().__init__()
        self.multiple = 2 ** len(levels)
        widths = [width * 2**i for i in range(len(levels))]
        self.enter, self.last = (
            nn.Conv2d(inputs, width, 3, padding=1),
            nn.Conv2d(width, outputs, 3, padding=1),
        )
        self.down = nn.ModuleList(_blocks(c, n) for c, n in zip(widths, levels, strict=True))
        self.shrink = nn.ModuleList(nn.Conv2d(c, 2 * c, 2, 2) for c in widths)
        self.middle = _blocks(2 * widths[-1], middle)
        self.grow = nn.ModuleList(
            nn.Sequential(nn.Conv2d(2 * c, 4 * c, 1, bias=False), nn.PixelShuffle(2))
            for c in widths[::-1]
        )
        self.up = nn.ModuleList(_blocks(c, 1) for c in widths[::-1])

    def change(self, picture: Tensor) -> Tensor:
        features, level_outputs = self.enter(picture), []
        for blocks, shrink in zip(self.down, self.shrink, strict=True):
            level_outputs.append(blocks(features))
            features = shrink(level_outputs[-1])
        features = self.middle(features)
        for grow, blocks, skip in zip(self.grow, self.up, level_outputs[::-1], strict=True):
            features = blocks(grow(features) + skip)
        result: Tensor = self.last(features)
        return result


def _blocks(width: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(NAFBlock(width) for _ in range(count)))


def _multiplied(x: Tensor) -> Tensor:
    first, second = x.chunk(2, 1)
    return first * second


@node()
def nafnet(
    picture: Tensor,
    *,
    weights: DataFile | None = None,
    width: Layers = 16,
    tile: Tile | None = None,
    reduce: Count = 1,
    detail: bool = False,
) -> Tensor:
    """Restore a colour picture with a small NAFNet, a strong baseline.

    ``tile``, ``reduce`` and ``detail`` as in `fft_mamba`.

    Shapes: picture (3, y, x) of any size -> (3, y, x).
    Units:  linear sRGB, as in the training of the weights.
    Error:  float32, 1e-5; of the restoration, the error that the training reached. Channels are
            scaled by a function of their mean over the whole picture, so a crop is not restored
            like the whole picture.
    Raises: ParameterError before the run without weights, or where the weights do not fit;
            ValueError for a picture that is not a colour picture or not finite.
    Source: Chen et al., Simple Baselines for Image Restoration, ECCV 2022; fewer blocks, and
            factors that start at 0.1.
    """
    return restored(picture, partial(NAFNet, width), weights, tile, reduce, detail)


nafnet.preflight(partial(fitting, NAFNet))
nafnet.check(restorer_checks)


# --- critics --------------------------------------------------------------------------------------

# Networks that are trained to score the distance of a restored picture from true pictures.
#
# They are plain convolutions that are run uncompiled: their gradients are differentiated again, and
# a compiled or hand-written derivative may return a wrong second derivative without an error.

SMALLEST = 16  #: smallest side in pixels: four halvings leave one pixel


class Critic(nn.Module):
    """A network that scores pictures: (n, 3, y, x) -> (n,). It halves the size four times, and
    averages its scores over all positions.

    The network has no norm, so each picture is scored independently.
    """

    gain = LEAKY

    def __init__(self, width: int = 64) -> None:
        """Build a critic with ``width`` channels at half size, doubled at each further halving, up
        to 8 x ``width``.
        """
        super().__init__()
        sizes = [3, width, 2 * width, 4 * width, 8 * width]
        layers: list[nn.Module] = []
        for a, b in pairwise(sizes):
            layers += [nn.Conv2d(a, b, 4, 2, 1), nn.LeakyReLU(LEAK)]
        self.layers = nn.Sequential(*layers, nn.Conv2d(sizes[-1], 1, 3, padding=1))

    def forward(self, picture: Tensor) -> Tensor:
        if min(picture.shape[-2:]) < SMALLEST:
            raise ValueError(
                f"a picture {tuple(picture.shape)} is too small for the critic: give {SMALLEST}"
                " pixels a side"
            )
        scores: Tensor = self.layers(picture)
        return scores.mean((1, 2, 3))


def critics(rng: torch.Generator, width: int = 64) -> tuple[Critic, Critic]:
    """Return two critics with random orthogonal weights: D0 for coarse and D1 for fine estimates
    of pictures.
    """
    first, second = (start_network(partial(Critic, width), rng) for _ in range(2))
    return first, second


def skip_critic_draws(rng: torch.Generator, count: int = 1) -> None:
    """Advance ``rng`` as `critic_slopes` does for ``count`` pictures; another process computes
    their gradients.
    """
    torch.rand(count, 1, 1, 1, generator=rng, device=rng.device)


def critic_slopes(
    critic: nn.Module, truth: Tensor, estimate: Tensor, rng: torch.Generator
) -> Tensor:
    """Return the gradient of the critic at a random mixture of each true picture and the estimate
    of the picture.

    The gradient is at least float32 and can be differentiated again, as `losses.gradient_penalty`
    does. The pictures receive no gradient.
    """
    truth, estimate = single(truth.detach()), single(estimate.detach())
    share = torch.rand(len(truth), 1, 1, 1, generator=rng, device=rng.device).to(truth)
    between = torch.lerp(estimate, truth, share).requires_grad_()
    with torch.enable_grad(), torch.autocast(truth.device.type, enabled=False):
        (slopes,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
    return slopes
