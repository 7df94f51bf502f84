"""Critic networks, which are trained to score the distance of a restored picture from true
pictures.

Critics are plain convolutions that are run uncompiled: their gradients are differentiated again,
and a compiled or hand-written derivative may return a wrong second derivative without an error.
"""

from functools import partial
from itertools import pairwise

import torch
from torch import Tensor, nn

from neusee.nodes.precision import single
from neusee.nodes.restore._networks._restorer import LEAK, LEAKY, start_network

SMALLEST = 16  #: pixels a side, from which four halvings leave one


class Critic(nn.Module):
    """A network that averages scores over all positions of a picture, halved four times: (n, 3, y,
    x) -> (n,).

    The network has no norm, so each picture is scored alone.
    """

    gain = LEAKY

    def __init__(self, width: int = 64) -> None:
        """Build a critic of ``width`` channels at half the size, doubled with each halving up to
        eight times.
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
    """Advance ``rng`` as `critic_slopes` does for ``count`` pictures, whose gradients another
    process computes.
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
