"""The filter's answer pulled towards another picture, as far as the seen pixels leave room.

The filter's answer x0 is the most likely picture under the seen pixels y and the prior. A second prior says that the
pixels of x in the frame are those of a picture c, with a precision R for each: the most likely picture x under both
minimises  |y - B x|^2 W + x' P^-1 x + (x - c)' R (x - c),  where B is the blur, W the weights of the noise and P the
first prior. With the normal matrix A = B' W B + P^-1 + R the change is  x - x0 = A^-1 R (c - x0).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.restore._inverse._conjugate_gradients import Preconditioner, descend
from neusee.nodes.restore._inverse._hidden_pixels import fixed
from neusee.nodes.restore._inverse._masked_blur import Blurred

STEPS = 10  #: of conjugate gradients, which leave 2e-3 to 4e-3 of a change behind half-rings
_MODES = 100  #: of each channel, which the preconditioner has exactly: 500 take five times as long in all


def pulled(seen: Blurred, towards: Tensor, precision: Tensor, steps: int = STEPS) -> tuple[Tensor, Tensor]:
    """Return the change of the filter's answer in the frame, and the blur of this change.

    `towards` (channel, y, x) is c - x0, and `precision` of the same shape the diagonal of R. Both results are exactly 0
    where all of `towards` is. They have derivatives of first order, also with respect to the problem itself.
    """
    y, x = seen.picture.shape[-2:]
    right = precision * towards
    still = replace(seen, picture=torch.zeros_like(seen.picture), held=precision)
    solver = _Solver(fixed(still), steps)
    with torch.no_grad():
        change = solver(torch.fft.rfft2(right, s=seen.torus))
    tensors = (seen.weight, seen.transfer, *seen.glare)
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        rest = torch.fft.irfft2(replace(still, pull=torch.fft.rfft2(right, s=seen.torus)).slope(change), s=seen.torus)
    else:  # what else is in the residual is constant
        rest = pad(right - precision * seen.first(change), (0, seen.torus[1] - x, 0, seen.torus[0] - y))
    whole = torch.fft.irfft2(change, s=seen.torus)
    pixels: Tensor = _Followed.apply(rest, whole, solver)  # type: ignore[no-untyped-call]
    return pixels[..., :y, :x], seen.blur(torch.fft.rfft2(pixels))


class _Solver:
    """The product of the inverse normal matrix A^-1 and half a spectrum, by conjugate gradients from 0."""

    def __init__(self, seen: Blurred, steps: int) -> None:
        self.seen, self.steps = seen, steps
        self._inverse: Preconditioner | None = None

    def __call__(self, right: Tensor) -> Tensor:
        start = torch.zeros_like(right)
        if not right.any():
            return start
        if self._inverse is None:
            self._inverse = Preconditioner(self.seen, _MODES)
        return descend(replace(self.seen, pull=right), start, self.steps, 0.0, self._inverse)


class _Followed(torch.autograd.Function):
    """The change as a function of the residual of its linear equation, which carries all derivatives."""

    @staticmethod
    def forward(ctx: Any, rest: Tensor, change: Tensor, solver: _Solver) -> Tensor:
        ctx.solver = solver
        return change.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        solution: Tensor = ctx.solver(torch.fft.rfft2(grad))
        return torch.fft.irfft2(solution, s=grad.shape[-2:]), None, None
