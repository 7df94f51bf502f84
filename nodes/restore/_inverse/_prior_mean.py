"""The most likely picture under a prior whose mean is a given picture, as a change of the filter's answer.

The most likely picture is linear in the seen picture y: it is F y for a prior of mean 0. For a prior of mean c it is
c + F (y - B c), where B is the blur, thus F y + (c - F B c). The change c - F B c is what the frame does not tell of c.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.restore._inverse._conjugate_gradients import Preconditioner, descend
from neusee.nodes.restore._inverse._hidden_pixels import most_likely
from neusee.nodes.restore._inverse._masked_blur import Blurred, weighing
from neusee.nodes.torch_func import transformed

STEPS = 12  #: of conjugate gradients. They start from c, and leave 4e-4 of the change behind a half-ring; 6 leave 5e-3
_BACK = 20  #: steps for a gradient, which start from nothing


class Untold:
    """The part of a picture that the seen pixels of a deconvolution do not tell: c - F B c for a picture c."""

    def __init__(self, seen: Blurred, steps: int = STEPS) -> None:
        self.seen, self.steps = seen, steps
        tensors = (seen.picture, seen.weight, seen.transfer, *seen.glare)
        self._followed = transformed() or (torch.is_grad_enabled() and any(t.requires_grad for t in tensors))
        self._inverse: Preconditioner | None = None

    def __call__(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Return c - F B c in the frame, and its blur, for a picture c (channel, y, x) that is 0 beyond the frame.

        The gradient with respect to c is always there; where the problem itself has gradients, those too.
        """
        if not self._followed:
            changed: tuple[Tensor, Tensor] = _Change.apply(mean, self)  # type: ignore[no-untyped-call]
            return changed
        spectrum = torch.fft.rfft2(mean, s=self.seen.torus)
        rest = spectrum - most_likely(replace(self.seen, picture=self.seen.blur(spectrum)))
        return self.seen.first(rest), self.seen.blur(rest)

    def solved(self, seen: Blurred, start: Tensor, steps: int) -> Tensor:
        """Return the most likely picture of a problem with the weights and the blur of this one, as half a spectrum."""
        if self._inverse is None:
            self._inverse = Preconditioner(self.seen)
        return descend(seen, start, steps, 0.0, self._inverse)


class _Change(torch.autograd.Function):
    """c - F B c for a problem without gradients of its own, with the adjoint by the same iteration."""

    @staticmethod
    def forward(ctx: Any, mean: Tensor, untold: Untold) -> tuple[Tensor, Tensor]:
        ctx.untold, seen = untold, untold.seen
        if not mean.any():
            return torch.zeros_like(mean), torch.zeros_like(mean)
        spectrum = torch.fft.rfft2(mean, s=seen.torus)
        told = replace(seen, picture=seen.blur(spectrum), pull=None)
        rest = spectrum - untold.solved(told, spectrum.clone(), untold.steps)
        return seen.first(rest), seen.blur(rest)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor, of_blurred: Tensor) -> tuple[Tensor, None]:
        """Return (1 - N A^-1) g, where N = B' W B, A = N + P^-1 is the normal matrix, and g the gradient."""
        seen: Blurred = ctx.untold.seen
        right = torch.fft.rfft2(grad, s=seen.torus) + seen.gathered(of_blurred)
        pulled = replace(seen, picture=torch.zeros_like(seen.picture), pull=right)
        solution = ctx.untold.solved(pulled, torch.zeros_like(right), max(_BACK, ctx.untold.steps))
        return seen.first(right - seen.gathered(weighing(seen)(seen.blur(solution)))), None
