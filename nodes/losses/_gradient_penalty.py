"""The gradient penalty, a loss that keeps the norm of a critic's gradient near 1."""

from torch import Tensor

from neusee.nodes import node
from neusee.nodes._half_precision import single


@node()
def gradient_penalty(slopes: Tensor) -> Tensor:
    """Average (n - 1)^2 over samples, where n is the norm of the gradient of a GAN critic at a sample.

    ``slopes`` are the gradients of the critic with respect to its inputs, made with ``create_graph=True``.

    Shapes: slopes (sample, ...) -> ().
    Units:  none.
    Error:  float32, 1e-5. A gradient of exactly 0 adds 1 and passes nothing back: the norm of 0 has no direction.
    Source: Gulrajani et al., Improved Training of Wasserstein GANs, NeurIPS 2017 (WGAN-GP).
    """
    flat = single(slopes).flatten(1)
    top = flat.detach().abs().amax(1, keepdim=True)
    still = top == 0
    scale = top.where(~still, 1.0)  # squares of gradients below 1e-19 underflow, and sqrt has no gradient at 0
    squares = (flat / scale).square().sum(1, keepdim=True)
    norm = squares.where(~still, 1.0).sqrt().where(~still, 0.0) * scale
    return (norm - 1).square().mean()
