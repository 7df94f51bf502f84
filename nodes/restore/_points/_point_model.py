"""The frames of point sources as a function of the PSF at the nodes of a grid, and of each point's place and signal."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._points._point_frames import Seen

_REACH = 12  #: pixels on each side of a pixel that its interpolated value uses
_BETA = 8.0  #: of the Kaiser window


class State(NamedTuple):
    """What is fitted: also a change of it, and a slope with respect to it."""

    kernels: Tensor  #: (node, channel, y, x)
    signal: Tensor  #: (point, channel), e-
    offset: Tensor  #: (point, 2), pixels from the middle of the window
    background: Tensor  #: (frame, channel), e-

    def plus(self, other: State, times: float | Tensor = 1.0) -> State:
        """Return the sum of this and a multiple of another."""
        return State(*(a + times * b for a, b in zip(self, other, strict=True)))

    def dot(self, other: State) -> Tensor:
        """Return the sum of the products of all entries."""
        return torch.stack([(a * b).sum() for a, b in zip(self, other, strict=True)]).sum()

    def times(self, other: State) -> State:
        """Return the products of all entries."""
        return State(*(a * b for a, b in zip(self, other, strict=True)))


def node_weights(places: Tensor, shape: tuple[int, int], zones: tuple[int, int]) -> Tensor:
    """Return the bilinear weight of each node at places (point, 2): (point, rows * columns), with a sum of 1."""
    down, right = (hats(places[:, k], shape[k], zones[k]) for k in (0, 1))
    return (down[:, :, None] * right[:, None]).flatten(1)


def hats(at: Tensor, size: int, count: int) -> Tensor:
    """Return the linear weights (place, node) of ``count`` nodes in the middles of equal parts of ``size`` pixels."""
    along = ((at.double() + 0.5) * count / size - 0.5).clamp(0, count - 1)
    return (1.0 - (along[:, None] - torch.arange(count, dtype=torch.float64)).abs()).clamp_min(0.0)


def shifting(offset: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return matrices (point, size, size) that shift samples by ``offset`` (point,), and their slopes.

    The interpolation is a sinc with a Kaiser window: its error is below 1e-4 for up to 0.4 periods in a pixel. The
    slope of the samples is continued beyond their ends.
    """
    apart = torch.arange(size)[:, None] - torch.arange(size + 2 * _REACH) + _REACH
    at = apart.double() - offset[:, None, None]
    inside = (1.0 - (at / (_REACH + 1.0)).square()).clamp_min(0.0)
    root = inside.sqrt()
    taper = torch.special.i0(_BETA * root) / torch.special.i0(torch.tensor(_BETA, dtype=torch.float64))
    bent = torch.special.i1(_BETA * root) / torch.special.i0(torch.tensor(_BETA, dtype=torch.float64))
    wave, x = torch.sinc(at), math.pi * at
    small = at.abs() < 1e-4
    rise = torch.where(small, -math.pi * x / 3.0, (torch.cos(x) - wave) / torch.where(small, 1.0, at))
    fall = -_BETA * at / (_REACH + 1.0) ** 2 * bent / root.clamp_min(1e-6)
    outside = inside <= 0
    value = (wave * taper).masked_fill(outside, 0.0)
    slope = -(rise * taper + wave * fall).masked_fill(outside, 0.0)
    return _folded(value), _folded(slope)


def _folded(matrix: Tensor) -> Tensor:
    """Return matrices whose columns beyond the ends act on the samples within, mirrored at the ends and turned over."""
    inner = matrix[..., _REACH:-_REACH].clone()
    reach = min(_REACH, inner.shape[-1] - 1)
    left, right = matrix[..., _REACH - reach : _REACH], matrix[..., -_REACH : matrix.shape[-1] - _REACH + reach]
    inner[..., 0] += 2.0 * left.sum(-1)
    inner[..., 1 : reach + 1] -= left.flip(-1)
    inner[..., -1] += 2.0 * right.sum(-1)
    inner[..., -1 - reach : -1] -= right.flip(-1)
    return inner


def moved(kernels: Tensor, offset: Tensor) -> Tensor:
    """Return kernels (kernel, channel, y, x), shifted by ``offset`` (kernel, 2)."""
    down, _ = shifting(offset[:, 0], kernels.shape[-2])
    right, _ = shifting(offset[:, 1], kernels.shape[-1])
    return _applied(down, kernels, right)


class Linear(NamedTuple):
    """The frames near a state: the model, and its derivative as a matrix that is never formed."""

    seen: Seen
    share: Tensor  #: (point, node)
    signal: Tensor  #: (point, channel)
    down: Tensor  #: (point, y, y)
    right: Tensor  #: (point, x, x)
    patterns: Tensor  #: (3, point, channel, y, x): each point of signal 1, and its slopes with y and x times the signal

    def change(self, by: State) -> Tensor:
        """Return the change (channel, pixel) of the frames for a small change of the state."""
        kernels = torch.tensordot(self.share, by.kernels, 1)
        stamps = self.signal[..., None, None] * _applied(self.down, kernels, self.right)
        stamps = stamps + by.signal[..., None, None] * self.patterns[0]
        stamps = stamps + (by.offset.T[:, :, None, None, None] * self.patterns[1:]).sum(0)
        return self._scattered(stamps) + by.background.T[:, self.seen.frame]

    def slope(self, pixels: Tensor) -> State:
        """Return the transpose of `change`, applied to pixels (channel, pixel)."""
        stamps = self.stamps_of(pixels)
        signal = (stamps * self.patterns[0]).sum((-2, -1))
        offset = (stamps * self.patterns[1:]).sum((-3, -2, -1)).T
        back = self.down.mT[:, None] @ (self.signal[..., None, None] * stamps) @ self.right[:, None]
        kernels = torch.tensordot(self.share, back, ([0], [0]))
        background = pixels.new_zeros(len(self.seen.background), len(pixels)).index_add(0, self.seen.frame, pixels.T)
        return State(kernels, signal, offset, background)

    def stamps_of(self, pixels: Tensor) -> Tensor:
        """Return pixels (channel, pixel) as windows (point, channel, y, x); 0 beyond the frame."""
        held = torch.cat([pixels, pixels.new_zeros(len(pixels), 1)], 1)[:, self.seen.pixels].transpose(0, 1)
        return held.reshape(*held.shape[:2], *self.patterns.shape[-2:])

    def _scattered(self, stamps: Tensor) -> Tensor:
        flat = stamps.transpose(0, 1).flatten(1)
        count = self.seen.light.shape[-1]
        whole = flat.new_zeros(len(flat), count + 1).index_add(1, self.seen.pixels.flatten(), flat)
        return whole[:, :count]

    def model(self, background: Tensor) -> Tensor:
        """Return the expected frames (channel, pixel)."""
        return self._scattered(self.signal[..., None, None] * self.patterns[0]) + background.T[:, self.seen.frame]


def linear(seen: Seen, state: State, share: Tensor) -> Linear:
    """Return the frames near a state."""
    y, x = state.kernels.shape[-2:]
    (down, steep), (right, steep_x) = shifting(state.offset[:, 0], y), shifting(state.offset[:, 1], x)
    kernels, size = torch.tensordot(share, state.kernels, 1), state.signal[..., None, None]
    there = _applied(down, kernels, right)
    slopes = size * _applied(steep, kernels, right), size * _applied(down, kernels, steep_x)
    return Linear(seen, share, state.signal, down, right, torch.stack([there, *slopes]))


def _applied(down: Tensor, kernels: Tensor, right: Tensor) -> Tensor:
    """Return kernels (point, channel, y, x), multiplied from both sides by the matrices of each point."""
    there: Tensor = down[:, None] @ kernels @ right.mT[:, None]
    return there
