"""The PSF of highest likelihood for frames of point sources, and draws of its error.

Places, signals, backgrounds and PSFs are fitted together by Gauss-Newton steps (Bjoerck, Numerical Methods for Least
Squares Problems, 1996, ch. 9), so that the error of the centring is part of the error of the PSF.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from neusee.nodes.restore._points._point_frames import Seen
from neusee.nodes.restore._points._point_model import Linear, State, linear, moved, node_weights

_SEARCH = 6  #: pixels by which a point may lie beside the first guess
_STEPS = 30  #: Gauss-Newton steps, at most
_ENOUGH = 1e-4  #: pixels by which no point moves any more at the end
_MOST = 0.4  #: pixels by which a point may move in one step
_HALVED = 8  #: times that a step is halved, at most
_SURE = 4.0  #: standard deviations below saturation from which a pixel counts
_CALM = 1e-9  #: share of the largest curvature that is added to each, in a step alone
_ITERATIONS = 300  #: of conjugate gradients
_RESIDUAL = 1e-8  #: squared residual over the first, at which they end
_SHARED = 1.02  #: inflation of a variance from which points tell several PSFs
_CORE = 2  #: pixels around the middle of a PSF, in which points are counted
_ALONE = 1e-9  #: least eigenvalue of the products of weights, below which nodes are not told apart
_LOCAL = 5  #: pixels a side over which chi-square is averaged


class Fit(NamedTuple):
    """The fitted PSFs and draws of them, in the form of `MeasuredPsf`."""

    kernels: Tensor  #: (node, channel, y, x)
    draws: Tensor  #: (draw, node, channel, y, x)
    state: State
    chi: Tensor  #: (channel,)
    support: Tensor  #: (node,)
    inflation: Tensor  #: (node,)


def fitted(seen: Seen, shape: tuple[int, int], zones: tuple[int, int], window: tuple[int, int], count: int,
           rng: Generator) -> Fit:  # fmt: skip
    """Return the PSFs at the nodes and draws of them; raise ValueError where no pixel tells of a part of a PSF."""
    share = node_weights(seen.middle, shape, zones)
    state, weight = _start(seen, share, window)
    hold = _hold(linear(seen, state, share), state.kernels, weight)
    _refuse_unseen(linear(seen, state, share), weight)
    for _ in range(_STEPS):
        near = linear(seen, state, share)
        residual = seen.light - near.model(state.background)
        step = _solved(near, hold, weight, _slope(near, state, weight, residual))
        before = state.offset
        state = _ahead(seen, state, share, weight, step._replace(offset=step.offset.clamp(-_MOST, _MOST)))
        weight = _weight(seen, linear(seen, state, share).model(state.background))
        if float((state.offset - before).abs().max()) < _ENOUGH:
            break
    near = linear(seen, state, share)
    residual = seen.light - near.model(state.background)
    _refuse_unseen(near, weight)
    kernels = gauged(state.kernels)
    local = _misfit(near, weight, residual)
    draws = []
    for _ in range(count):
        noise = _normal(weight, rng) * weight.sqrt()
        slope = near.slope(noise)
        slope = slope._replace(background=slope.background + _normal(seen.doubt, rng) / seen.doubt.sqrt())
        other = gauged(state.plus(_solved(near, hold, weight, slope)).kernels)
        draws.append((kernels + local * (other - kernels)).float())
    return Fit(kernels, torch.stack(draws), state, _chi(weight, residual, near), *_support(near, weight))


def gauged(kernels: Tensor) -> Tensor:
    """Return kernels of sum 1 whose centres are in the middle of the window.

    The centre is the mean place, weighted by the square of the sum of the channels; noise in the wings hardly moves it.
    """
    offset = kernels.new_zeros(len(kernels), 2)
    found = kernels
    for _ in range(6):
        offset = offset - centre(found)
        found = moved(kernels, offset)
    return found / found.sum((-2, -1), keepdim=True)


def centre(kernels: Tensor) -> Tensor:
    """Return the centre (node, 2) of kernels (node, channel, y, x), from the middle pixel."""
    power = kernels.mean(1).square()
    y, x = (torch.arange(n, dtype=power.dtype) - n // 2 for n in power.shape[-2:])
    whole = power.sum((-2, -1))
    return torch.stack([(power.sum(-1) * y).sum(-1) / whole, (power.sum(-2) * x).sum(-1) / whole], -1)


# --- start ------------------------------------------------------------------------------------------------------------


def _start(seen: Seen, share: Tensor, window: tuple[int, int]) -> tuple[State, Tensor]:
    """Return a first guess: one PSF for all nodes, from the points that are not saturated."""
    points, channels, nodes = len(seen.owner), len(seen.light), share.shape[1]
    kernels = seen.light.new_zeros(nodes, channels, *window)
    state = State(kernels, seen.light.new_zeros(points, channels), seen.light.new_zeros(points, 2), seen.background)
    near = linear(seen, state, share)
    stamps = near.stamps_of(seen.light - seen.background.T[:, seen.frame])
    weight = _weight(seen, seen.light)
    weights = near.stamps_of(weight)
    good = (near.stamps_of(seen.clipped.double()) == 0).all(1).flatten(1).all(1)
    valid = (weights[good] > 0).double()
    guess = (stamps[good] * valid).sum(0) / (valid * stamps[good].sum((-2, -1), keepdim=True)).sum(0).clamp_min(1e-9)
    guess = guess.clamp_min(0.0)
    guess = guess / guess.sum((-2, -1), keepdim=True).clamp_min(1e-9)
    for _ in range(2):
        offset, signal = _registered(stamps, weights, guess)
    return State(guess.expand_as(kernels).contiguous(), signal, offset, seen.background), weight


def _registered(stamps: Tensor, weights: Tensor, guess: Tensor) -> tuple[Tensor, Tensor]:
    """Return the whole-pixel offset of each point at which the guess explains most, and the signal of each channel."""
    channels, wide = len(guess), (_SEARCH,) * 4
    found = conv2d(pad(weights * stamps, wide), guess[:, None], groups=channels)
    there = conv2d(pad(weights, wide), guess.square()[:, None], groups=channels).clamp_min(1e-30)
    best = (found.clamp_min(0.0).square() / there).sum(1).flatten(1).argmax(1)
    signal = (found / there).flatten(2).gather(2, best[:, None, None].expand(-1, channels, 1))[..., 0]
    side = 2 * _SEARCH + 1
    offset = torch.stack([best // side, best % side], 1).double() - _SEARCH
    return offset, signal.clamp_min(1e-3)


# --- steps ------------------------------------------------------------------------------------------------------------


def _weight(seen: Seen, expected: Tensor) -> Tensor:
    """Return 1 / variance of each pixel; 0 where it is clipped, or may be clipped by chance."""
    ground = seen.background.T[:, seen.frame]
    variance = seen.floor.T[:, seen.frame] + (expected - ground).clamp_min(0.0)
    censored = seen.clipped | (expected > seen.level - _SURE * variance.sqrt())
    return torch.where(censored, 0.0, 1.0 / variance)


def _slope(near: Linear, state: State, weight: Tensor, residual: Tensor) -> State:
    slope = near.slope(weight * residual)
    known = (near.seen.background - state.background) / near.seen.doubt
    return slope._replace(background=slope.background + known)


def _ahead(seen: Seen, state: State, share: Tensor, weight: Tensor, step: State) -> State:
    """Return the state after a step, halved until the frames fit better; the state itself if none does."""
    worst = _square(seen, state, linear(seen, state, share), weight)
    for _ in range(_HALVED):
        ahead = state.plus(step)
        if float(_square(seen, ahead, linear(seen, ahead, share), weight)) < float(worst):
            return ahead
        step = State(*(0.5 * part for part in step))
    return state


def _square(seen: Seen, state: State, near: Linear, weight: Tensor) -> Tensor:
    """Return chi-square of the frames and of what is known of their backgrounds."""
    known = (seen.background - state.background).square() / seen.doubt
    return (weight * (seen.light - near.model(state.background)).square()).sum() + known.sum()


def _curvature(near: Linear, weight: Tensor) -> State:
    """Return the diagonal of the matrix of the step, roughly: that of the PSFs as if no point were shifted."""
    stamps = near.stamps_of(weight)
    kernels = torch.tensordot(near.share.square(), near.signal.square()[..., None, None] * stamps, ([0], [0]))
    signal = (stamps * near.patterns[0].square()).sum((-2, -1))
    offset = (stamps * near.patterns[1:].square()).sum((-3, -2, -1)).T
    count = weight.new_zeros(len(near.seen.background), len(weight)).index_add(0, near.seen.frame, weight.T)
    found = State(kernels, signal, offset, count + 1.0 / near.seen.doubt)
    return State(*(x + 1e-3 * x.amax() * (x <= 0) + _CALM * x.amax() for x in found))


def _solved(near: Linear, hold: Hold, weight: Tensor, right: State) -> State:
    """Return the step for a slope, by conjugate gradients that the curvature of each entry speeds up.

    A shift of all points is a shift of the PSFs, and a factor of a PSF is one of the signals: ``hold`` decides.
    """
    diagonal = _curvature(near, weight)
    inverse = State(*(1.0 / x for x in diagonal))
    calm = State(*(_CALM * x.amax() * torch.ones_like(x) for x in diagonal))
    x = State(*(torch.zeros_like(part) for part in right))
    rest = _free(right, hold)
    way = _free(rest.times(inverse), hold)
    size = rest.dot(way)
    first = size
    for _ in range(_ITERATIONS):
        if float(size) <= _RESIDUAL * float(first):
            break
        image = near.slope(weight * near.change(way)).plus(way.times(calm))
        image = image._replace(background=image.background + way.background / near.seen.doubt)
        image = _free(image, hold)
        step = size / way.dot(image)
        x, rest = x.plus(way, step), rest.plus(image, -step)
        turned = _free(rest.times(inverse), hold)
        size, before = rest.dot(turned), size
        way = turned.plus(way, size / before)
    return x


class Hold(NamedTuple):
    """What stays where it is, because a shift of all points is a shift of the PSFs."""

    points: Tensor  #: (point, point), projects on the moves of the points that are left to the PSFs
    ways: Tensor | None  #: (way, node, channel, y, x), changes of the PSFs that are left to the points


def _hold(near: Linear, kernels: Tensor, weight: Tensor) -> Hold:
    """Return what stays where it is at the nodes.

    Where each point tells one PSF, the points stay, so that a PSF need not be known between pixels. Where points tell
    several, the PSFs stay in the middle: those that lie beside one another would add to a wider one.
    """
    if float(_support(near, weight)[1].max()) > _SHARED:
        return Hold(torch.zeros_like(near.share @ near.share.T), _ways(kernels))
    return Hold(near.share @ torch.linalg.pinv(near.share), None)


def _free(change: State, hold: Hold) -> State:
    """Return a change without the part that does not change the frames, which would have no end."""
    kernels = change.kernels - change.kernels.mean((-2, -1), keepdim=True)
    for way in () if hold.ways is None else hold.ways:
        kernels = kernels - (way * kernels).sum((-3, -2, -1), keepdim=True) * way
    return change._replace(kernels=kernels, offset=change.offset - hold.points @ change.offset)


def _ways(kernels: Tensor) -> Tensor:
    """Return two changes (2, node, channel, y, x) of each PSF, of unit length, that move it down and to the right."""
    found = list[Tensor]()
    for way in torch.gradient(kernels, dim=(-2, -1)):
        way = way - way.mean((-2, -1), keepdim=True)
        for other in found:
            way = way - (way * other).sum((-3, -2, -1), keepdim=True) * other
        found.append(way / way.square().sum((-3, -2, -1), keepdim=True).sqrt().clamp_min(1e-30))
    return torch.stack(found)


def _refuse_unseen(near: Linear, weight: Tensor) -> None:
    """Raise ValueError where a pixel of a PSF is saturated or beyond the frame in all frames."""
    seen = torch.tensordot(near.share.square(), (near.stamps_of(weight) > 0).double(), ([0], [0]))
    if missing := int((seen <= 0).any(1).sum()):
        raise ValueError(
            f"{missing} pixels of the PSF are saturated, or beyond the edge, in every frame: add frames of a shorter "
            "exposure, move points from the edge, or choose a smaller window or fewer zones"
        )


# --- error ------------------------------------------------------------------------------------------------------------


def _misfit(near: Linear, weight: Tensor, residual: Tensor) -> Tensor:
    """Return the root of chi-square around each pixel of the window (y, x), at least 1."""
    square, known = (near.stamps_of(x).sum((0, 1)) for x in (weight * residual.square(), (weight > 0).double()))
    mean = [avg_pool2d(x[None, None], _LOCAL, 1, _LOCAL // 2, count_include_pad=False)[0, 0] for x in (square, known)]
    free = 1.0 - _unknowns(near) / float((weight > 0).sum())
    return (mean[0] / (free * mean[1]).clamp_min(1e-9)).clamp_min(1.0).sqrt()


def _chi(weight: Tensor, residual: Tensor, near: Linear) -> Tensor:
    free = 1.0 - _unknowns(near) / float((weight > 0).sum())
    return (weight * residual.square()).sum(1) / ((weight > 0).sum(1) * free).clamp_min(1.0)


def _support(near: Linear, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return how many points at each node would tell its PSF as well, and the inflation of its variance.

    The worst of the pixels in the middle. With A the bilinear weights of the points that show a pixel, the number is
    1 over the diagonal of the inverse of A^T A, and the inflation the product of this diagonal and that of A^T A
    (Kutner et al., Applied Linear Statistical Models, 5th ed., 2005, sec. 10.5): 1 for points in the middles of zones.
    """
    shown = near.stamps_of(weight) > 0
    y, x = (n // 2 for n in shown.shape[-2:])
    core = shown[..., y - _CORE : y + _CORE + 1, x - _CORE : x + _CORE + 1].flatten(1).double()
    patterns = torch.unique(core, dim=1).T
    normal = near.share.T @ (patterns[:, :, None] * near.share)
    sizes, ways = torch.linalg.eigh(normal)
    inverse = (ways.square() / sizes.clamp_min(_ALONE)[:, None]).sum(-1)
    return (1.0 / inverse).amin(0), (inverse * normal.diagonal(dim1=-2, dim2=-1)).amax(0)


def _unknowns(near: Linear) -> float:
    """Return the number of fitted values, at most nine tenths of the pixels."""
    points, channels = near.signal.shape
    window = near.patterns.shape[-2] * near.patterns.shape[-1]
    whole = near.share.shape[1] * channels * window + points * (channels + 2)
    return min(float(whole), 0.9 * near.seen.light.numel())


def _normal(like: Tensor, rng: Generator) -> Tensor:
    drawn = torch.randn(like.shape, generator=rng, device=rng.device, dtype=like.dtype)
    return drawn.to(like)
