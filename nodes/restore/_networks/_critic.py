"""Critics: how far a picture is from the true ones, to be learnt beside what restores it.

Plain convolutions that are run as they stand: their slopes are differentiated again, and what is compiled, or has a
derivative of its own, may give a wrong second one without a word.
"""

from functools import partial
from itertools import pairwise

import torch
from torch import Tensor, nn

from neusee.nodes._half_precision import single
from neusee.nodes.restore._networks._restorer import LEAK, LEAKY, start_network

SMALLEST = 16  #: pixels a side, that four halvings leave one


class Critic(nn.Module):
    """Four halvings and a mean: (n, 3, y, x) -> (n,). No norm, for a picture is judged by itself."""

    gain = LEAKY

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        sizes = [3, width, 2 * width, 4 * width, 8 * width]
        pairs = [(nn.Conv2d(a, b, 4, 2, 1), nn.LeakyReLU(LEAK)) for a, b in pairwise(sizes)]
        self.layers = nn.Sequential(*(part for pair in pairs for part in pair), nn.Conv2d(sizes[-1], 1, 3, padding=1))

    def forward(self, picture: Tensor) -> Tensor:
        if min(picture.shape[-2:]) < SMALLEST:
            raise ValueError(f"a picture {tuple(picture.shape)} is too small to judge: give {SMALLEST} pixels a side")
        scores: Tensor = self.layers(picture)
        return scores.mean((1, 2, 3))


def critics(rng: torch.Generator, width: int = 64) -> tuple[Critic, Critic]:
    """D0 of the coarse estimate and D1 of the fine one: orthogonal weights that keep the power, zero biases."""
    first, second = (start_network(partial(Critic, width), rng) for _ in range(2))
    return first, second


def skip_critic_draws(rng: torch.Generator, count: int = 1) -> None:
    """Draw what `critic_slopes` draws for ``count`` pictures, where another process looks at them."""
    torch.rand(count, 1, 1, 1, generator=rng, device=rng.device)


def critic_slopes(critic: nn.Module, truth: Tensor, estimate: Tensor, rng: torch.Generator) -> Tensor:
    """How the critic rises somewhere between each true picture and its estimate, in single precision at least.

    To be differentiated again, as by `losses.gradient_penalty`; nothing reaches the pictures.
    """
    truth, estimate = single(truth.detach()), single(estimate.detach())
    share = torch.rand(len(truth), 1, 1, 1, generator=rng, device=rng.device).to(truth)
    between = torch.lerp(estimate, truth, share).requires_grad_()
    with torch.enable_grad(), torch.autocast(truth.device.type, enabled=False):
        (found,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
    return found
