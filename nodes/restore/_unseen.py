"""The most likely picture behind a blur of which only some pixels are seen.

Linear least squares with a Gaussian prior (Kaipio and Somersalo, Statistical and Computational Inverse Problems, 2005,
ch. 3), with what lies beyond the edge as unknown as what lies within. Light from there mixes with all that is seen, so
conjugate gradients get nowhere from a bad start: the problem is solved exactly on a coarse grid, and each finer grid
starts from the one before.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from neusee.nodes.optics._image import smooth

Size = tuple[int, int]
Map = Callable[[Tensor], Tensor]

DENSE = 40  #: a picture of no more pixels a side is solved exactly
STEPS = 20  #: on the finest grid, and four times as many on each coarser one up to
MOST = 160


@dataclass(frozen=True)
class Blurred:
    """A picture = (blur of x) + noise; x has mean 0, and its channels correlate."""

    picture: Tensor  #: (channel, y, x)
    weight: Tensor  #: (channel, y, x), 1 / variance of the noise; 0 where nothing is known
    transfer: Tensor  #: (channel, fy, fx), half a spectrum of the torus, with the picture in its first corner
    power: Tensor  #: (fy, fx) of x; its mean over the whole spectrum is the variance of x
    torus: Size
    grey: float  #: correlation of any two channels of x, below 1
    glare: tuple[Tensor, ...] = ()  #: (channel, y, x) patterns of unknown strength that lie over the picture

    def blur(self, spectrum: Tensor) -> Tensor:
        """From half the spectrum of x to the pixels of the picture."""
        y, x = self.picture.shape[-2:]
        pixels: Tensor = torch.fft.irfft2(self.transfer * spectrum, s=self.torus)[:, :y, :x]
        return pixels

    def gathered(self, pixels: Tensor) -> Tensor:
        """The adjoint of `blur`."""
        spectrum: Tensor = self.transfer.conj() * torch.fft.rfft2(pixels, s=self.torus)
        return spectrum


def torus(picture: Size, edge: Size) -> Size:
    """A grid with `edge` of unknown pixels around the picture, that can be halved until the picture is small."""
    whole = 2 ** _halvings(picture)
    y, x = (whole * smooth(-(-(n + 2 * e) // whole)) for n, e in zip(picture, edge, strict=True))
    return y, x


def most_likely(seen: Blurred, steps: int = STEPS) -> Tensor:
    """Half the spectrum of the x that the picture and the prior make most likely."""
    if not _halvings((seen.picture.shape[-2], seen.picture.shape[-1])):
        return _exact(seen)
    coarse = halved(seen)
    start = _widened(most_likely(coarse, min(4 * steps, MOST)), coarse.torus, seen.torus)
    return _descend(seen, start, steps)


def _halvings(picture: Size) -> int:
    return max(0, math.ceil(math.log2(max(picture) / DENSE)))


def halved(seen: Blurred) -> Blurred:
    """The same picture on pixels twice as wide; what these cannot hold counts as noise."""
    y, x = seen.picture.shape[-2:]
    room = (0, x % 2, 0, y % 2)
    weight = 4.0 * avg_pool2d(pad(seen.weight, room), 2)
    share = 4.0 * pad(seen.weight, room) / weight.clamp_min(1e-30).repeat_interleave(2, -2).repeat_interleave(2, -1)
    picture, *glare = (avg_pool2d(share * pad(p, room), 2) for p in (seen.picture, *seen.glare))
    size = (seen.torus[0] // 2, seen.torus[1] // 2)
    pooled = seen.transfer * _pooling(seen.torus, seen.transfer)
    transfer = _narrowed(pooled, size)
    power = _narrowed(seen.power, size) / 4.0
    lost = variance(pooled.abs().square() * seen.power, seen.torus)
    lost = (lost - variance(transfer.abs().square() * power, size)).clamp_min(0.0)[:, None, None]
    return replace(
        seen, picture=picture, weight=weight / (1.0 + weight * lost), transfer=transfer, power=power, torus=size,
        glare=tuple(glare),
    )  # fmt: skip


def variance(power: Tensor, size: Size) -> Tensor:
    """Mean over a whole spectrum of which the last dimension holds one half."""
    return (power * _times(size, power)).sum((-2, -1)) / (size[0] * size[1])


def _times(size: Size, like: Tensor) -> Tensor:
    """How often each column of half a spectrum stands in the whole."""
    times = torch.full((size[1] // 2 + 1,), 2.0, dtype=like.real.dtype, device=like.device)
    times[0] = 1.0
    if size[1] % 2 == 0:
        times[-1] = 1.0
    return times


def _pooling(size: Size, like: Tensor) -> Tensor:
    """Transfer of the mean of a pixel and the next one, along both axes."""
    fy, fx = (
        torch.arange(n, dtype=torch.float64, device=like.device) / m for n, m in zip(like.shape[-2:], size, strict=True)
    )
    y, x = ((1.0 + torch.exp(2j * math.pi * f)) / 2.0 for f in (fy, fx))
    return (y[:, None] * x).to(like)


def _narrowed(spectrum: Tensor, size: Size) -> Tensor:
    """Half a spectrum of a grid twice as fine, cut to this size; nothing at the highest frequency if that is even."""
    up, down, right = (size[0] + 1) // 2, (size[0] - 1) // 2, (size[1] + 1) // 2
    kept = spectrum[..., :right]
    middle = kept.new_zeros(*kept.shape[:-2], size[0] - up - down, right)
    kept = torch.cat([kept[..., :up, :], middle, kept[..., spectrum.shape[-2] - down :, :]], -2)
    return pad(kept, (0, size[1] // 2 + 1 - right))


def _widened(spectrum: Tensor, size: Size, wide: Size) -> Tensor:
    """Half a spectrum on a grid twice as fine."""
    up, down, right = (size[0] + 1) // 2, (size[0] - 1) // 2, (size[1] + 1) // 2
    kept = 4.0 * spectrum[..., :right]
    middle = kept.new_zeros(*kept.shape[:-2], wide[0] - up - down, right)
    tall = torch.cat([kept[..., :up, :], middle, kept[..., size[0] - down :, :]], -2)
    return pad(tall, (0, wide[1] // 2 + 1 - right))


def _exact(seen: Blurred) -> Tensor:
    """Solve for the weights of all seen pixels at once, in float64, by Cholesky."""
    channels = len(seen.picture)
    root = seen.weight.double().flatten().sqrt()
    colours = torch.full((channels, channels), seen.grey, dtype=torch.float64, device=root.device).fill_diagonal_(1.0)
    transfer = seen.transfer.to(torch.complex128)
    rows = [torch.cat([colours[i, j] * _covariance(seen, a * b.conj()) for j, b in enumerate(transfer)], 1)
            for i, a in enumerate(transfer)]  # fmt: skip
    matrix = root[:, None] * torch.cat(rows) * root
    for pattern in seen.glare:
        shape = root * pattern.double().flatten()
        matrix = matrix + 1e8 * torch.outer(shape, shape) / shape.square().sum().clamp_min(1e-30)
    matrix = matrix + torch.eye(len(root), dtype=torch.float64, device=root.device)
    wanted = (root * seen.picture.double().flatten())[:, None]
    answer = root * torch.cholesky_solve(wanted, torch.linalg.cholesky(matrix))[:, 0]
    back = seen.gathered(answer.to(seen.picture).reshape(seen.picture.shape))
    return seen.power * _mixed(back, 1.0 - seen.grey, seen.grey)


def _covariance(seen: Blurred, passed: Tensor) -> Tensor:
    """Covariance of every two pixels of the picture, for a product of two transfers."""
    lags = torch.fft.irfft2(passed * seen.power.double(), s=seen.torus)
    y, x = (torch.arange(n, device=lags.device) for n in seen.picture.shape[-2:])
    down, right = (y[:, None] - y) % seen.torus[0], (x[:, None] - x) % seen.torus[1]
    square: Tensor = lags[down[:, None, :, None], right[None, :, None, :]]
    return square.reshape(len(y) * len(x), -1)


def _mixed(spectrum: Tensor, own: float, shared: float) -> Tensor:
    """Each channel, and the sum of all."""
    return own * spectrum + shared * spectrum.sum(0)


def _descend(seen: Blurred, x: Tensor, steps: int) -> Tensor:
    """Conjugate gradients from here, preconditioned by the inverse for a picture without edges."""
    weigh, precondition = _weighing(seen), _preconditioner(seen)
    own, shared = _inverse_colour(len(seen.picture), seen.grey)
    times = _times(seen.torus, seen.power)
    inverse = 1.0 / seen.power.clamp_min(1e-30)

    def dot(a: Tensor, b: Tensor) -> Tensor:
        total: Tensor = ((a.conj() * b).real * times).sum(dtype=torch.float64)
        return total

    def normal(x: Tensor) -> Tensor:
        return inverse * _mixed(x, own, -shared) + seen.gathered(weigh(seen.blur(x)))

    left = seen.gathered(weigh(seen.picture - seen.blur(x))) - inverse * _mixed(x, own, -shared)
    ahead = precondition(left)
    way, size = ahead, dot(left, ahead)
    first = float(size)
    for _ in range(steps):
        if not float(size) > 1e-14 * first:
            break
        change = normal(way)
        length = (size / dot(way, change)).to(seen.picture)
        x, left = x + length * way, left - length * change
        ahead = precondition(left)
        new = dot(left, ahead)
        way, size = ahead + (new / size).to(seen.picture) * way, new
    return x


def _weighing(seen: Blurred) -> Map:
    """Residuals times their weight, blind to any amount of each glare."""
    if not seen.glare:
        return lambda residual: seen.weight * residual
    flat = torch.stack(seen.glare).flatten(1)
    weighted = seen.weight.flatten() * flat
    inverse = torch.linalg.pinv((weighted.double() @ flat.double().T), hermitian=True).to(flat)

    def weigh(residual: Tensor) -> Tensor:
        strengths = inverse @ (weighted @ residual.flatten())
        told: Tensor = strengths @ weighted
        return seen.weight * residual - told.reshape(residual.shape)

    return weigh


def _preconditioner(seen: Blurred) -> Map:
    own, shared = _inverse_colour(len(seen.picture), seen.grey)
    known = (seen.weight > 0).sum((-2, -1)).clamp_min(1)
    mean = (seen.weight.sum((-2, -1)) / known)[:, None, None]
    inverse = 1.0 / seen.power.clamp_min(1e-30)
    gain = 1.0 / (own * inverse + mean * seen.transfer.abs().square())
    shared_gain = shared * inverse / (1.0 - shared * inverse * gain.sum(0))

    def precondition(x: Tensor) -> Tensor:
        own_part = gain * x
        return own_part + gain * (shared_gain * own_part.sum(0))

    return precondition


def _inverse_colour(channels: int, grey: float) -> tuple[float, float]:
    """The inverse of  (1 - grey) I + grey  over the channels, as  own I - shared."""
    return 1.0 / (1.0 - grey), grey / ((1.0 - grey) * (1.0 - grey + channels * grey))
