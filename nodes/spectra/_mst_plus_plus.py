"""MST++, a network that reconstructs 31 bands from RGB in three stages of spectral attention.

The modules have the names of the published network, so that the published checkpoint loads unchanged: 1 619 625
parameters in 227 tensors. Architecture: Cai et al., CVPRW 2022; reference code caiyuanhao1998/MST-plus-plus (MIT).
"""

from collections.abc import Iterable
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from neusee.nodes._mirror_padding import mirrored

BANDS = 31


class MSTPlusPlus(nn.Module):
    """The network MST++ from RGB pictures (n, 3, y, x) in [0, 1], of any size, to 31 bands (n, 31, y, x)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv_in = _conv(3, BANDS)
        self.body = nn.Sequential(*(Stage(BANDS) for _ in range(3)))
        self.conv_out = _conv(BANDS, BANDS)

    def forward(self, rgb: Tensor) -> Tensor:
        height, width = rgb.shape[-2:]
        first = self.conv_in(mirrored(rgb, -height % 8, -width % 8))
        result: Tensor = self.conv_out(self.body(first)) + first
        return result[..., :height, :width]


class Stage(nn.Module):
    """A stage of MST++: a U-Net with spectral attention, two downsampling steps and a residual connection."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.embedding = _conv(dim, dim)
        self.encoder_layers = nn.ModuleList(
            nn.ModuleList([Blocks(d), nn.Conv2d(d, 2 * d, 4, 2, 1, bias=False)]) for d in (dim, 2 * dim)
        )
        self.bottleneck = Blocks(4 * dim)
        self.decoder_layers = nn.ModuleList(
            nn.ModuleList([nn.ConvTranspose2d(2 * d, d, 2, 2), nn.Conv2d(2 * d, d, 1, bias=False), Blocks(d)])
            for d in (2 * dim, dim)
        )
        self.mapping = _conv(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        inner, skips = self.embedding(x), []
        for attend, shrink in _parts(self.encoder_layers):
            skips.append(attend(inner))
            inner = shrink(skips[-1])
        inner = self.bottleneck(inner)
        for (grow, fuse, attend), skip in zip(_parts(self.decoder_layers), reversed(skips), strict=True):
            inner = attend(fuse(torch.cat([grow(inner), skip], 1)))
        result: Tensor = self.mapping(inner) + x
        return result


class Blocks(nn.Module):
    """A transformer block: spectral attention and a feed-forward network, each with a residual connection."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList([nn.ModuleList([SpectralAttention(dim), Normed(dim)])])

    def forward(self, x: Tensor) -> Tensor:
        for attend, feed in _parts(self.blocks):
            x = attend(x) + x
            x = feed(x) + x
        return x


class SpectralAttention(nn.Module):
    """Self-attention between bands: 31 x 31 weights per head, at a cost that is linear in the number of pixels."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.heads = dim // BANDS
        self.to_q, self.to_k, self.to_v = (nn.Linear(dim, dim, bias=False) for _ in range(3))
        self.rescale = nn.Parameter(torch.ones(self.heads, 1, 1))
        self.proj = nn.Linear(dim, dim)
        self.pos_emb = nn.Sequential(_depthwise(dim), nn.GELU(), _depthwise(dim))

    def forward(self, x: Tensor) -> Tensor:
        shape = x.shape
        pixels = x.flatten(2).transpose(1, 2)
        value = self.to_v(pixels).transpose(1, 2)
        query, key, heads = (t.unflatten(1, (self.heads, -1)) for t in (*self._across(pixels), value))
        scores = (key @ query.transpose(-1, -2)) * self.rescale
        mixed = (scores.softmax(-1) @ heads).flatten(1, 2).transpose(1, 2)
        result: Tensor = self.proj(mixed).transpose(1, 2).reshape(shape) + self.pos_emb(value.reshape(shape))
        return result

    def _across(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return the queries and keys of the attention, with each band normalised to unit length over all pixels."""
        query, key = (F.normalize(to(pixels).transpose(1, 2), dim=-1) for to in (self.to_q, self.to_k))
        return query, key


class Normed(nn.Module):
    """A layer norm over the bands, followed by a feed-forward network."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.fn = FeedForward(dim)
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.fn(self.norm(x.movedim(1, -1)).movedim(-1, 1))
        return result


class FeedForward(nn.Module):
    """A feed-forward network with four times as many hidden channels and a depthwise 3 x 3 convolution."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        wide, thin = nn.Conv2d(dim, 4 * dim, 1, bias=False), nn.Conv2d(4 * dim, dim, 1, bias=False)
        self.net = nn.Sequential(wide, nn.GELU(), _depthwise(4 * dim), nn.GELU(), thin)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.net(x)
        return result


def _parts(layers: nn.ModuleList) -> Iterable[Iterable[nn.Module]]:
    return cast(Iterable[Iterable[nn.Module]], layers)


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)


def _depthwise(dim: int) -> nn.Conv2d:
    return nn.Conv2d(dim, dim, 3, padding=1, groups=dim, bias=False)
