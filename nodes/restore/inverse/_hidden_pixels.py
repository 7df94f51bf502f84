"""The most likely picture before a blur, from a blurred picture with unknown pixels."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from neusee.nodes.precision import transformed
from neusee.nodes.restore.inverse._conjugate_gradients import (
    LOWEST,
    Preconditioner,
    descend,
    inner,
    pieces,
)
from neusee.nodes.restore.inverse._masked_blur import (
    Blurred,
    Size,
    halvings,
    mixed,
    narrowed,
    variance,
    widened,
)

# --- hidden pixels --------------------------------------------------------------------------------

# The most likely picture before a blur, from a blurred picture with unknown pixels.
#
# Linear least squares with a Gaussian prior (Kaipio and Somersalo, Statistical and Computational
# Inverse Problems, 2005, ch. 3). The unknowns include the pixels beyond the edge. Light from beyond
# the edge mixes with the light of the frame, so conjugate gradients converge too slowly from a bad
# start. The problem is therefore solved exactly on a coarse grid, and each finer grid starts from
# the solution of the coarser grid. On the coarser grids, each step also solves the lowest
# frequencies exactly.


#: largest number of steps on the finest grid; each coarser grid may take four times as many, up to
#: `MOST`
STEPS = 20
MOST = 100
#: squared distance from the solution at which the iteration ends, per known pixel, in the norm of
#: the inverse posterior covariance. The residual underestimates this distance by a factor of 10 to
#: 30, because it underestimates the slowest modes
ENOUGH = 1e-6
#: ratio of the covariances of scene and noise (in norm), at which rounding is 1e-6 of the noise
_NOISELESS = 1e10
_ONCE = "the deconvolution has no second derivative: differentiate without create_graph=True"
CAREFUL = 8.0  #: each coarser grid has a tolerance smaller by this factor: its steps are cheap


class Inverses:
    """The factors and preconditioners of a deconvolution, which do not depend on the pixels of the
    picture and can be reused for further pictures.

    The preconditioners of grids beyond `LOWEST` pixels a side are large and quickly built; they are
    not kept.
    """

    def __init__(self) -> None:
        self._factors: dict[Size, Tensor] = {}
        self._preconditioners: dict[Size, Preconditioner] = {}

    def factor(self, problem: Blurred) -> Tensor:
        """Return the Cholesky factor of the matrix of a small problem."""
        if problem.torus not in self._factors:
            self._factors[problem.torus] = _factor(problem)
        return self._factors[problem.torus]

    def preconditioner(self, problem: Blurred) -> Preconditioner:
        """Return the preconditioner of a problem."""
        if max(_size(problem)) > LOWEST:
            return Preconditioner(problem)
        if problem.torus not in self._preconditioners:
            self._preconditioners[problem.torus] = Preconditioner(problem)
        return self._preconditioners[problem.torus]


def most_likely(
    problem: Blurred,
    steps: int = STEPS,
    enough: float = ENOUGH,
    coarser: bool = True,
    inverses: Inverses | None = None,
) -> Tensor:
    """Return the half spectrum of the most likely picture before the blur, from the known pixels
    and the prior.

    Without ``coarser`` grids the steps start from a picture without contrast, which is good enough
    only for a narrow PSF. ``inverses`` may come from a problem that differs only in the picture;
    missing ones are computed and added.
    """
    inverses = inverses or Inverses()
    tensors = (problem.picture, problem.weight, problem.transfer, *problem.glare)
    with torch.no_grad():
        constant_problem = fixed(problem)
        # an empty factor: the picture is too large for a dense solution
        lower = (
            problem.picture.new_empty(0)
            if halvings(_size(problem))
            else inverses.factor(constant_problem)
        )
        enough = enough * float((problem.weight > 0).sum())
        if coarser or lower.numel():
            x = _solved(constant_problem, lower, steps, enough, inverses)
        else:
            x = descend(constant_problem, torch.zeros_like(constant_problem.transfer), MOST, enough)
    # the derivatives flow through the residual of the linear problem, whose value is 0
    followed = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    if not (followed or transformed()):
        return x
    residual = torch.fft.irfft2(problem.slope(x), s=problem.torus)
    frame = _Frame(problem.torus, problem.grey, steps, problem.bounded)
    others = (
        lower,
        *map(Tensor.detach, (problem.weight, problem.transfer, problem.power, *problem.glare)),
    )
    pixels: Tensor = _Followed.apply(torch.fft.irfft2(x, s=problem.torus), residual, frame, *others)  # type: ignore[no-untyped-call]
    spectrum: Tensor = torch.fft.rfft2(pixels)
    return spectrum


def fixed(problem: Blurred) -> Blurred:
    """Return the problem with detached tensors, without gradients and tangents."""
    detached = {
        name: getattr(problem, name).detach() for name in ("picture", "weight", "transfer", "power")
    }
    held = None if problem.held is None else problem.held.detach()
    return replace(
        problem, **detached, glare=tuple(pattern.detach() for pattern in problem.glare), held=held
    )


class _Frame(NamedTuple):
    """The parameters of a deconvolution problem that are not tensors."""

    torus: Size
    grey: float
    steps: int
    bounded: int


class _Followed(torch.autograd.Function):
    """The deconvolved picture as a function of the residual of the linear problem, which carries
    all derivatives.
    """

    @staticmethod
    def forward(answer: Tensor, residual: Tensor, frame: _Frame, *fixed: Tensor) -> Tensor:
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
    def jvp(ctx: Any, answer: Tensor | None, residual_tangent: Tensor, *_: None) -> Any:
        return _Solved.apply(residual_tangent, ctx.frame, *ctx.saved_tensors)  # type: ignore[no-untyped-call]


class _Solved(torch.autograd.Function):
    """The solution of the linear problem for a right-hand side; forward and reverse mode
    differentiation use it.
    """

    @staticmethod
    def forward(right: Tensor, frame: _Frame, *fixed: Tensor) -> Tensor:
        # in the order of `others` in `most_likely`
        lower, weight, transfer, power, *glare = fixed
        pull, nothing = torch.fft.rfft2(right), torch.zeros_like(weight)
        problem = Blurred(
            nothing,
            weight,
            transfer,
            power,
            frame.torus,
            frame.grey,
            tuple(glare),
            pull,
            frame.bounded,
        )
        # relative to the squared norm of the right-hand side in the prior covariance
        enough = 1e-10 * float(inner(pull, _spread(problem, pull), problem.torus))
        solution: Tensor = torch.fft.irfft2(
            _solved(problem, lower, frame.steps, enough, Inverses()), s=problem.torus
        )
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


def _solved(
    problem: Blurred, lower: Tensor, steps: int, enough: float, inverses: Inverses
) -> Tensor:
    """Return the solution: exact for a small problem with the Cholesky factor `lower`, iterative
    for a larger problem (empty `lower`).
    """
    return (
        _by_factor(problem, lower) if lower.numel() else _nested(problem, steps, enough, inverses)
    )


def _nested(problem: Blurred, steps: int, enough: float, inverses: Inverses) -> Tensor:
    """Return the iterative solution, which starts from the solution on a grid half as fine; the
    coarsest grid is solved exactly.
    """
    if not halvings(_size(problem)):
        return _by_factor(problem, inverses.factor(problem))
    coarser_problem = halved(problem)
    start = widened(
        _nested(coarser_problem, min(4 * steps, MOST), enough / CAREFUL, inverses),
        coarser_problem.torus,
        problem.torus,
    )
    return descend(problem, start, steps, enough, inverses.preconditioner(problem))


def _size(problem: Blurred) -> Size:
    y, x = problem.picture.shape[-2:]
    return y, x


def halved(problem: Blurred) -> Blurred:
    """Return the deconvolution problem on pixels twice as wide; the variance at the lost
    frequencies counts as noise.
    """
    weight = _pooled(problem.weight)
    picture, *glare = (
        _pooled(problem.weight * p) / weight.clamp_min(1e-30)
        for p in (problem.picture, *problem.glare)
    )
    half_size = (problem.torus[0] // 2, problem.torus[1] // 2)
    y_transfer, x_transfer = (_pooling(n, problem.transfer) for n in problem.torus)
    lost_variance = problem.power.new_zeros(len(problem.transfer))
    for rows in pieces(problem.transfer):
        averaged_power = (
            problem.power[rows]
            * y_transfer[rows, None].abs().square()
            * x_transfer[: problem.transfer.shape[-1]].abs().square()
        )
        transfer_rows = problem.transfer[:, rows]
        lost_variance = lost_variance + variance(
            (transfer_rows.real.square() + transfer_rows.imag.square()) * averaged_power,
            problem.torus,
        )
    nonnegative_rows, columns = (half_size[0] + 1) // 2, half_size[1] // 2 + 1
    y_transfer = torch.cat(
        [
            y_transfer[:nonnegative_rows],
            y_transfer[len(y_transfer) - half_size[0] + nonnegative_rows :],
        ]
    )
    transfer = narrowed(problem.transfer, half_size) * y_transfer[:, None] * x_transfer[:columns]
    # 4: the variance is the mean over a quarter of the frequencies
    power = narrowed(problem.power, half_size) / 4.0
    # variance of the blurred picture at the frequencies that are missing on the coarser grid
    lost_variance = (
        lost_variance - variance(transfer.abs().square() * power, half_size)
    ).clamp_min(0.0)[:, None, None]
    pull = None if problem.pull is None else narrowed(problem.pull, half_size)
    return replace(
        problem,
        picture=picture,
        weight=weight / (1.0 + weight * lost_variance),
        transfer=transfer,
        power=power,
        torus=half_size,
        glare=tuple(glare),
        pull=pull,
    )


def _pooled(pixels: Tensor) -> Tensor:
    """Return the sums of a picture over blocks of two by two pixels."""
    y, x = pixels.shape[-2:]
    return 4.0 * avg_pool2d(pad(pixels, (0, x % 2, 0, y % 2)) if x % 2 or y % 2 else pixels, 2)


def _pooling(size: int, like: Tensor) -> Tensor:
    """Return the transfer function of the mean of two neighbouring pixels along an axis of
    `size` pixels.
    """
    cycles_per_pixel = torch.arange(size, dtype=torch.float64, device=like.device) / size
    cycles_per_pixel = torch.where(cycles_per_pixel > 0.5, cycles_per_pixel - 1.0, cycles_per_pixel)
    # (1 + exp(2 pi i f)) / 2
    return ((1.0 + torch.exp(2j * math.pi * cycles_per_pixel)) / 2.0).to(like)


def _factor(problem: Blurred) -> Tensor:
    """Return the float64 Cholesky factor of the whitened covariance of the known pixels of a small
    picture.

    Whitened, the noise has the covariance 1. The rounding error of the covariance of the scene acts
    as additional noise of 1e-16 of its norm. For a picture with less noise, the factor is computed
    from a square root of the covariance, which is ten times slower.
    """
    precise, root_weight, colour_correlation = _fine(problem), _root(problem), _colours(problem)
    # block (i, j): covariance of the blurred pixels of channels i and j
    rows = [
        torch.cat(
            [
                colour_correlation[i, j] * _covariance(precise, a * b.conj())
                for j, b in enumerate(precise.transfer)
            ],
            1,
        )
        for i, a in enumerate(precise.transfer)
    ]
    matrix = root_weight[:, None] * torch.cat(rows) * root_weight
    patterns = _spread_patterns(problem)
    if float(matrix.detach().abs().sum(-1).max()) > _NOISELESS:
        return _factor_of_root(precise, patterns)
    for pattern in patterns:
        matrix = matrix + torch.outer(pattern, pattern)
    matrix.diagonal().add_(1.0)
    lower: Tensor = torch.linalg.cholesky(matrix)
    return lower


def _factor_of_root(fine: Blurred, patterns: list[Tensor]) -> Tensor:
    """Return the Cholesky factor of A A^T + I from QR decompositions of [A I]^T, without the
    product A A^T.

    A (known pixel, unknown) is the response of the whitened pixels to independent unknowns: those
    of the scene, channel by channel, and the strengths of the glare ``patterns``. The rounding
    error is that of A, not that of A A^T.
    """
    root_weight, colour_factor = _root(fine), torch.linalg.cholesky(_colours(fine))
    responses = [_response(fine, transfer) for transfer in fine.transfer]
    upper = torch.eye(len(root_weight), dtype=root_weight.dtype, device=root_weight.device)
    for shares in colour_factor.T:
        unknown_response = torch.cat(
            [share * response for share, response in zip(shares, responses, strict=True)]
        )
        upper = torch.linalg.qr(
            torch.cat([upper, (root_weight[:, None] * unknown_response).T]), mode="r"
        ).R
    if patterns:
        upper = torch.linalg.qr(torch.cat([upper, torch.stack(patterns)]), mode="r").R
    lower: Tensor = (upper * upper.diagonal().sign()[:, None]).T
    return lower


def _response(problem: Blurred, transfer: Tensor) -> Tensor:
    """Return the response (pixel, unknown) of the blurred pixels of a channel to each independent
    unknown of the prior.
    """
    impulse = torch.fft.irfft2(transfer * problem.power.sqrt(), s=problem.torus)
    rows, columns = (torch.arange(count, device=impulse.device) for count in _size(problem))
    grid_rows, grid_columns = (
        torch.arange(count, device=impulse.device) for count in problem.torus
    )
    row_offsets = (rows[:, None] - grid_rows) % problem.torus[0]
    column_offsets = (columns[:, None] - grid_columns) % problem.torus[1]
    response: Tensor = impulse[row_offsets[:, None, :, None], column_offsets[None, :, None, :]]
    return response.reshape(len(rows) * len(columns), -1)


def _colours(problem: Blurred) -> Tensor:
    """Return the correlation matrix (channel, channel) of the scene."""
    channels = len(problem.picture)
    colours = torch.full(
        (channels, channels), problem.grey, dtype=torch.float64, device=problem.weight.device
    )
    return colours.fill_diagonal_(1.0)


def _spread_patterns(problem: Blurred) -> list[Tensor]:
    """Return the whitened glare patterns (pixel,), each times the prior standard deviation of its
    strength.
    """
    root_weight, patterns = _root(problem), []
    for number, pattern in enumerate(problem.glare):
        whitened = root_weight * pattern.double().flatten()
        is_free = number < len(problem.glare) - problem.bounded
        # an unknown strength has a standard deviation of 1e4 in whitened units
        patterns.append(
            whitened * (1e4 / whitened.norm().clamp_min(1e-15)) if is_free else whitened
        )
    return patterns


def _by_factor(problem: Blurred, lower: Tensor) -> Tensor:
    """Return the half spectrum of the exact deconvolution of a small picture, from the Cholesky
    factor of `_factor`.
    """
    precise, root_weight = _fine(problem), _root(problem)
    # solution for `problem.pull` alone, without known pixels
    pulled_picture = (
        torch.zeros_like(precise.transfer)
        if problem.pull is None
        else _spread(precise, problem.pull.to(torch.complex128))
    )
    residual = (root_weight * (problem.picture.double() - precise.blur(pulled_picture)).flatten())[
        :, None
    ]
    weighted_answer = root_weight * torch.cholesky_solve(residual, lower)[:, 0]
    return (
        pulled_picture
        + _spread(precise, precise.gathered(weighted_answer.reshape(problem.picture.shape)))
    ).to(problem.transfer)


def _fine(problem: Blurred) -> Blurred:
    """Return the problem with transfer function and power spectrum in double precision."""
    return replace(
        problem, transfer=problem.transfer.to(torch.complex128), power=problem.power.double()
    )


def _root(problem: Blurred) -> Tensor:
    """Return the square roots of the weights of all pixels, (channel * y * x,) float64."""
    weight = problem.weight.double().flatten()
    # the gradient of sqrt is infinite at 0
    return weight.where(weight > 0, 1.0).sqrt().where(weight > 0, 0.0)


def _covariance(problem: Blurred, passed: Tensor) -> Tensor:
    """Return the prior covariance of all pairs of blurred pixels; ``passed`` is the product of the
    transfer functions of the two channels.
    """
    covariance_by_lag = torch.fft.irfft2(passed * problem.power, s=problem.torus)
    rows, columns = (
        torch.arange(n, device=covariance_by_lag.device) for n in problem.picture.shape[-2:]
    )
    row_lags, column_lags = (
        (rows[:, None] - rows) % problem.torus[0],
        (columns[:, None] - columns) % problem.torus[1],
    )
    covariance: Tensor = covariance_by_lag[
        row_lags[:, None, :, None], column_lags[None, :, None, :]
    ]
    return covariance.reshape(len(rows) * len(columns), -1)


def _spread(problem: Blurred, spectrum: Tensor) -> Tensor:
    """Return the product of the prior covariance and a half spectrum."""
    return problem.power * mixed(spectrum, 1.0 - problem.grey, problem.grey)


# --- pulled answer --------------------------------------------------------------------------------

# The answer of the filter with a second prior, which pulls it towards another picture, as far as
# the known pixels allow.
#
# The answer x0 of the filter is the most likely picture under the known pixels y and the prior. The
# second prior is normal: in the frame, x has the mean c and the precision R for each pixel. The
# most likely picture x under both priors minimises (y - B x)^T W (y - B x) + x^T P^-1 x +
# (x - c)^T R (x - c), where B is the blur, W the weights of the noise and P the covariance of the
# first prior. With the normal matrix A = B^T W B + P^-1 + R, the change is x - x0 =
# A^-1 R (c - x0).


#: number of conjugate gradient steps; they leave an error of 2e-3 to 4e-3 of a change behind
#: half-rings
PULLED_STEPS = 10
#: number of unknowns of each channel that the preconditioner solves exactly: 500 take five times as
#: long in all
_MODES = 100


def pulled(
    problem: Blurred, towards: Tensor, precision: Tensor, steps: int = PULLED_STEPS
) -> tuple[Tensor, Tensor]:
    """Return the change of the filter's answer in the frame, and the blur of this change.

    `towards` (channel, y, x) is c - x0, and `precision`, of the same shape, the diagonal of R. Both
    results are exactly 0 if all of `towards` is 0. They have first derivatives, also with respect
    to the problem itself.
    """
    y, x = problem.picture.shape[-2:]
    right_side = precision * towards
    without_picture = replace(problem, picture=torch.zeros_like(problem.picture), held=precision)
    solver = _Solver(fixed(without_picture), steps)
    with torch.no_grad():
        change = solver(torch.fft.rfft2(right_side, s=problem.torus))
    # as in `most_likely`: the residual carries the derivatives
    tensors = (problem.weight, problem.transfer, *problem.glare)
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        residual = torch.fft.irfft2(
            replace(without_picture, pull=torch.fft.rfft2(right_side, s=problem.torus)).slope(
                change
            ),
            s=problem.torus,
        )
    else:  # the other terms of the residual are constant
        residual = pad(
            right_side - precision * problem.first(change),
            (0, problem.torus[1] - x, 0, problem.torus[0] - y),
        )
    torus_change = torch.fft.irfft2(change, s=problem.torus)
    pixels: Tensor = _FollowedAnswer.apply(residual, torus_change, solver)  # type: ignore[no-untyped-call]
    return pixels[..., :y, :x], problem.blur(torch.fft.rfft2(pixels))


class _Solver:
    """The product of the inverse normal matrix A^-1 and a half spectrum, by conjugate gradients
    that start from 0.
    """

    def __init__(self, problem: Blurred, steps: int) -> None:
        self.seen, self.steps = problem, steps
        self._inverse: Preconditioner | None = None

    def __call__(self, right: Tensor) -> Tensor:
        """Return A^-1 times a half spectrum; the first call builds the preconditioner."""
        start = torch.zeros_like(right)
        if not right.any():
            return start
        if self._inverse is None:
            self._inverse = Preconditioner(self.seen, _MODES)
        return descend(replace(self.seen, pull=right), start, self.steps, 0.0, self._inverse)


class _FollowedAnswer(torch.autograd.Function):
    """The change as a function of the residual of its linear equation, which carries all
    derivatives.
    """

    @staticmethod
    def forward(ctx: Any, residual: Tensor, change: Tensor, solver: _Solver) -> Tensor:
        ctx.solver = solver
        return change.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        solution: Tensor = ctx.solver(torch.fft.rfft2(grad))
        return torch.fft.irfft2(solution, s=grad.shape[-2:]), None, None
