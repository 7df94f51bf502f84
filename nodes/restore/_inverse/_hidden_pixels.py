"""The most likely picture before a blur, given only some pixels of the blurred picture.

Linear least squares with a Gaussian prior (Kaipio and Somersalo, Statistical and Computational Inverse Problems, 2005,
ch. 3), in which pixels beyond the edge are as unknown as pixels within. Light from beyond the edge mixes with the seen
light, so conjugate gradients converge too slowly from a bad start. The problem is therefore solved exactly on a coarse
grid, each finer grid starts from the solution of the coarser grid, and on the coarser grids each step also solves the
lowest frequencies exactly.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from neusee.nodes.restore._inverse._conjugate_gradients import LOWEST, Preconditioner, descend, inner, pieces
from neusee.nodes.restore._inverse._fft_grid import halvings
from neusee.nodes.restore._inverse._masked_blur import Blurred, Size, mixed, narrowed, variance, widened
from neusee.nodes.torch_func import transformed

STEPS = 20  #: the most steps on the finest grid; each coarser grid may take four times as many, up to MOST
MOST = 100
ENOUGH = 1e-6  #: squared distance for each seen pixel, in units of the posterior, at which the iteration ends. The
#: residual underestimates this distance by a factor of 10 to 30, because it underestimates the slowest modes
_NOISELESS = 1e10  #: norm of the covariance of the scene over that of the noise, whose rounding is 1e-6 of the noise
_ONCE = "the deconvolution has no second derivative: differentiate without create_graph=True"
CAREFUL = 8.0  #: factor by which the tolerance falls with each coarser grid, whose steps are cheap


class Inverses:
    """What solves the grids of a deconvolution and depends on no pixel of the picture: for several pictures of it.

    The preconditioners of grids beyond `LOWEST` pixels a side are large and cheap to make, and are not kept.
    """

    def __init__(self) -> None:
        self._factors: dict[Size, Tensor] = {}
        self._preconditioners: dict[Size, Preconditioner] = {}

    def factor(self, seen: Blurred) -> Tensor:
        """Return the Cholesky factor of the matrix of a small problem."""
        if seen.torus not in self._factors:
            self._factors[seen.torus] = _factor(seen)
        return self._factors[seen.torus]

    def preconditioner(self, seen: Blurred) -> Preconditioner:
        """Return the preconditioner of a problem."""
        if max(_size(seen)) > LOWEST:
            return Preconditioner(seen)
        if seen.torus not in self._preconditioners:
            self._preconditioners[seen.torus] = Preconditioner(seen)
        return self._preconditioners[seen.torus]


def most_likely(
    seen: Blurred, steps: int = STEPS, enough: float = ENOUGH, coarser: bool = True, inverses: Inverses | None = None
) -> Tensor:
    """Return half the spectrum of the most likely picture before the blur, given the seen pixels and the prior.

    Without ``coarser`` grids the steps start from a picture without contrast, which suits a narrow PSF alone.
    ``inverses`` are those of a problem that differs in the picture alone; missing ones are made and added.
    """
    inverses = inverses or Inverses()
    tensors = (seen.picture, seen.weight, seen.transfer, *seen.glare)
    with torch.no_grad():
        alone = fixed(seen)
        lower = seen.picture.new_empty(0) if halvings(_size(seen)) else inverses.factor(alone)
        enough = enough * float((seen.weight > 0).sum())
        if coarser or lower.numel():
            x = _solved(alone, lower, steps, enough, inverses)
        else:
            x = descend(alone, torch.zeros_like(alone.transfer), MOST, enough)
    followed = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    if not (followed or transformed()):
        return x
    rest = torch.fft.irfft2(seen.slope(x), s=seen.torus)
    frame = _Frame(seen.torus, seen.grey, steps, seen.bounded)
    others = (lower, *map(Tensor.detach, (seen.weight, seen.transfer, seen.power, *seen.glare)))
    pixels: Tensor = _Followed.apply(torch.fft.irfft2(x, s=seen.torus), rest, frame, *others)  # type: ignore[no-untyped-call]
    spectrum: Tensor = torch.fft.rfft2(pixels)
    return spectrum


def fixed(seen: Blurred) -> Blurred:
    """Return the problem without gradients and tangents."""
    parts = {name: getattr(seen, name).detach() for name in ("picture", "weight", "transfer", "power")}
    held = None if seen.held is None else seen.held.detach()
    return replace(seen, **parts, glare=tuple(pattern.detach() for pattern in seen.glare), held=held)


class _Frame(NamedTuple):
    """The numbers of a deconvolution problem that are no tensors."""

    torus: Size
    grey: float
    steps: int
    bounded: int


class _Followed(torch.autograd.Function):
    """The deconvolved picture as a function of the residual of the linear problem, which carries all derivatives."""

    @staticmethod
    def forward(answer: Tensor, rest: Tensor, frame: _Frame, *fixed: Tensor) -> Tensor:
        return answer.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, _, ctx.frame, *fixed = inputs
        ctx.save_for_backward(*fixed)
        ctx.save_for_forward(*fixed)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        fixed = ctx.saved_tensors
        return None, _Solved.apply(grad, ctx.frame, *fixed), None, *(None for _ in fixed)  # type: ignore[no-untyped-call]

    @staticmethod
    def jvp(ctx: Any, answer: Tensor | None, rest: Tensor, *_: None) -> Any:
        return _Solved.apply(rest, ctx.frame, *ctx.saved_tensors)  # type: ignore[no-untyped-call]


class _Solved(torch.autograd.Function):
    """The solution of the linear problem for a given right side, with which forward and reverse mode differentiate."""

    @staticmethod
    def forward(right: Tensor, frame: _Frame, *fixed: Tensor) -> Tensor:
        lower, weight, transfer, power, *glare = fixed
        pull, nothing = torch.fft.rfft2(right), torch.zeros_like(weight)
        seen = Blurred(nothing, weight, transfer, power, frame.torus, frame.grey, tuple(glare), pull, frame.bounded)
        enough = 1e-10 * float(inner(pull, _spread(seen, pull), seen.torus))
        solution: Tensor = torch.fft.irfft2(_solved(seen, lower, frame.steps, enough, Inverses()), s=seen.torus)
        return solution

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        raise RuntimeError(_ONCE)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Any:
        raise RuntimeError(_ONCE)


def _solved(seen: Blurred, lower: Tensor, steps: int, enough: float, inverses: Inverses) -> Tensor:
    """Solve a small problem exactly with the Cholesky factor `lower` of its matrix, and a larger problem by steps."""
    return _by_factor(seen, lower) if lower.numel() else _nested(seen, steps, enough, inverses)


def _nested(seen: Blurred, steps: int, enough: float, inverses: Inverses) -> Tensor:
    if not halvings(_size(seen)):
        return _by_factor(seen, inverses.factor(seen))
    coarse = halved(seen)
    start = widened(_nested(coarse, min(4 * steps, MOST), enough / CAREFUL, inverses), coarse.torus, seen.torus)
    return descend(seen, start, steps, enough, inverses.preconditioner(seen))


def _size(seen: Blurred) -> Size:
    y, x = seen.picture.shape[-2:]
    return y, x


def halved(seen: Blurred) -> Blurred:
    """Return the deconvolution problem on pixels twice as wide, where lost variance of the picture counts as noise."""
    weight = _pooled(seen.weight)
    picture, *glare = (_pooled(seen.weight * p) / weight.clamp_min(1e-30) for p in (seen.picture, *seen.glare))
    size = (seen.torus[0] // 2, seen.torus[1] // 2)
    y_mean, x_mean = (_pooling(n, seen.transfer) for n in seen.torus)
    lost = seen.power.new_zeros(len(seen.transfer))
    for rows in pieces(seen.transfer):
        passed = seen.power[rows] * y_mean[rows, None].abs().square() * x_mean[: seen.transfer.shape[-1]].abs().square()
        through = seen.transfer[:, rows]
        lost = lost + variance((through.real.square() + through.imag.square()) * passed, seen.torus)
    up, right = (size[0] + 1) // 2, size[1] // 2 + 1
    y_mean = torch.cat([y_mean[:up], y_mean[len(y_mean) - size[0] + up :]])
    transfer = narrowed(seen.transfer, size) * y_mean[:, None] * x_mean[:right]
    power = narrowed(seen.power, size) / 4.0
    lost = (lost - variance(transfer.abs().square() * power, size)).clamp_min(0.0)[:, None, None]
    pull = None if seen.pull is None else narrowed(seen.pull, size)
    return replace(
        seen, picture=picture, weight=weight / (1.0 + weight * lost), transfer=transfer, power=power, torus=size,
        glare=tuple(glare), pull=pull,
    )  # fmt: skip


def _pooled(pixels: Tensor) -> Tensor:
    """Return the sums of a picture over blocks of two by two pixels."""
    y, x = pixels.shape[-2:]
    return 4.0 * avg_pool2d(pad(pixels, (0, x % 2, 0, y % 2)) if x % 2 or y % 2 else pixels, 2)


def _pooling(size: int, like: Tensor) -> Tensor:
    """Return the transfer function of the mean of two neighbouring pixels along an axis of `size` pixels."""
    turns = torch.arange(size, dtype=torch.float64, device=like.device) / size
    turns = torch.where(turns > 0.5, turns - 1.0, turns)
    return ((1.0 + torch.exp(2j * math.pi * turns)) / 2.0).to(like)


def _factor(seen: Blurred) -> Tensor:
    """Return the Cholesky factor, in float64, of the whitened covariance of the seen pixels of a small picture.

    The noise has the covariance 1. Rounding of the covariance of the scene acts as further noise of 1e-16 of its norm,
    so that a picture with less noise than that has the factor of a square root of the covariance: ten times slower.
    """
    fine, root, colours = _fine(seen), _root(seen), _colours(seen)
    rows = [torch.cat([colours[i, j] * _covariance(fine, a * b.conj()) for j, b in enumerate(fine.transfer)], 1)
            for i, a in enumerate(fine.transfer)]  # fmt: skip
    matrix = root[:, None] * torch.cat(rows) * root
    patterns = _spread_patterns(seen)
    if float(matrix.detach().abs().sum(-1).max()) > _NOISELESS:
        return _factor_of_root(fine, patterns)
    for pattern in patterns:
        matrix = matrix + torch.outer(pattern, pattern)
    matrix.diagonal().add_(1.0)
    lower: Tensor = torch.linalg.cholesky(matrix)
    return lower


def _factor_of_root(fine: Blurred, patterns: list[Tensor]) -> Tensor:
    """Return the Cholesky factor of A A^T + 1 by QR decompositions of [A 1]^T, without the product A A^T.

    A (seen pixel, unknown) is the response of the whitened pixels to independent unknowns: those of the scene, channel
    by channel, and the strengths of the glare ``patterns``. The factor has the rounding of A, not that of its square.
    """
    root, mixing = _root(fine), torch.linalg.cholesky(_colours(fine))
    responses = [_response(fine, transfer) for transfer in fine.transfer]
    upper = torch.eye(len(root), dtype=root.dtype, device=root.device)
    for shares in mixing.T:
        columns = torch.cat([share * response for share, response in zip(shares, responses, strict=True)])
        upper = torch.linalg.qr(torch.cat([upper, (root[:, None] * columns).T]), mode="r").R
    if patterns:
        upper = torch.linalg.qr(torch.cat([upper, torch.stack(patterns)]), mode="r").R
    lower: Tensor = (upper * upper.diagonal().sign()[:, None]).T
    return lower


def _response(seen: Blurred, transfer: Tensor) -> Tensor:
    """Return the blurred pixels of a channel for a unit of each independent unknown of the prior, (pixel, unknown)."""
    impulse = torch.fft.irfft2(transfer * seen.power.sqrt(), s=seen.torus)
    y, x = (torch.arange(count, device=impulse.device) for count in _size(seen))
    v, u = (torch.arange(count, device=impulse.device) for count in seen.torus)
    down = (y[:, None] - v) % seen.torus[0]
    right = (x[:, None] - u) % seen.torus[1]
    square: Tensor = impulse[down[:, None, :, None], right[None, :, None, :]]
    return square.reshape(len(y) * len(x), -1)


def _colours(seen: Blurred) -> Tensor:
    """Return the correlations of the channels of the scene."""
    channels = len(seen.picture)
    colours = torch.full((channels, channels), seen.grey, dtype=torch.float64, device=seen.weight.device)
    return colours.fill_diagonal_(1.0)


def _spread_patterns(seen: Blurred) -> list[Tensor]:
    """Return the whitened glare patterns (pixel,), times the standard deviation of their strengths."""
    root, patterns = _root(seen), []
    for number, pattern in enumerate(seen.glare):
        shape = root * pattern.double().flatten()
        free = number < len(seen.glare) - seen.bounded
        patterns.append(shape * (1e4 / shape.norm().clamp_min(1e-15)) if free else shape)
    return patterns


def _by_factor(seen: Blurred, lower: Tensor) -> Tensor:
    """Return the exact deconvolution of a small picture, given the factor of its matrix that `_factor` returns."""
    fine, root = _fine(seen), _root(seen)
    before = torch.zeros_like(fine.transfer) if seen.pull is None else _spread(fine, seen.pull.to(torch.complex128))
    residual = (root * (seen.picture.double() - fine.blur(before)).flatten())[:, None]
    answer = root * torch.cholesky_solve(residual, lower)[:, 0]
    return (before + _spread(fine, fine.gathered(answer.reshape(seen.picture.shape)))).to(seen.transfer)


def _fine(seen: Blurred) -> Blurred:
    return replace(seen, transfer=seen.transfer.to(torch.complex128), power=seen.power.double())


def _root(seen: Blurred) -> Tensor:
    weight = seen.weight.double().flatten()
    return weight.where(weight > 0, 1.0).sqrt().where(weight > 0, 0.0)  # the gradient of sqrt is infinite at 0


def _covariance(seen: Blurred, passed: Tensor) -> Tensor:
    """Return the prior covariance of all pairs of picture pixels, given the product of two transfer functions."""
    lags = torch.fft.irfft2(passed * seen.power, s=seen.torus)
    y, x = (torch.arange(n, device=lags.device) for n in seen.picture.shape[-2:])
    down, right = (y[:, None] - y) % seen.torus[0], (x[:, None] - x) % seen.torus[1]
    square: Tensor = lags[down[:, None, :, None], right[None, :, None, :]]
    return square.reshape(len(y) * len(x), -1)


def _spread(seen: Blurred, spectrum: Tensor) -> Tensor:
    """Return the prior covariance of the picture, multiplied by half a spectrum."""
    return seen.power * mixed(spectrum, 1.0 - seen.grey, seen.grey)
