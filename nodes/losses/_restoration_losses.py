"""Loss functions of restored pictures, of estimated spectra, and of a GAN critic's gradient."""

from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.metrics._picture_quality import require_same_shape
from neusee.nodes.precision import single

# --- restoration losses ---------------------------------------------------------------------------

# Loss functions of a restored picture: its difference from the true picture, by pixel and by
# spatial frequency.


Reduction = Literal["mean", "sum"]
_LEAST = 1e-30  #: added power, because the root has no finite gradient at 0
#: added mean square of a difference, and the slope of the encoding outside [0, 1]
_NEAR, _BEYOND = 1e-6, 0.1


@node()
def charbonnier(
    estimate: Tensor,
    truth: Tensor,
    *,
    epsilon: Annotated[float, Field(ge=1e-12, le=1e3)] = 1e-6,
    reduction: Reduction = "mean",
) -> Tensor:
    """Average sqrt(difference^2 + epsilon), an absolute difference of pictures that is smooth at 0.

    ``reduction`` sum adds up the pixels instead, which is the only reduction that the paper names.

    Kornia's `charbonnier_loss` has a fixed epsilon of 1, and is a square for all differences of
    pictures in [0, 1].

    Shapes: estimate and truth alike -> ().
    Units:  those of the pictures; epsilon in their square.
    Error:  above the mean absolute difference by at most sqrt(epsilon), 1e-3.
    Raises: ValueError for pictures of different shapes.
    Source: NeuSee, section Two-Stage Training (L_REC), with the mean; epsilon is ours.
    """
    require_same_shape(estimate, truth)
    return _reduced(((single(estimate) - single(truth)).square() + epsilon).sqrt(), reduction)


@node()
def fft_l1(estimate: Tensor, truth: Tensor, *, reduction: Reduction = "mean") -> Tensor:
    """Average the absolute difference between the spatial Fourier spectra of the estimated and the
    true picture.

    ``reduction`` sum adds up the frequencies of a transform that is not normalised, as the paper
    prints. For n pixels, the sum is n^(3/2) times the mean, so that the weight of the loss depends
    on the size of the picture.

    The transform is in float64: in single precision a coefficient near 0 has neither a reliable
    size nor a reliable direction, and the gradient is that direction.

    Shapes: estimate and truth (..., y, x) -> ().
    Units:  those of the pictures: for the mean the transform is unitary, so the size of a picture
            does not matter.
    Error:  round-off of the type of the loss, 1e-7 in float32; a coefficient below 1e-15 has no
            gradient.
    Raises: ValueError for pictures of different shapes.
    Source: NeuSee, section Two-Stage Training (L_REC), with a unitary transform and the mean.
    """
    require_same_shape(estimate, truth)
    norm = "ortho" if reduction == "mean" else "backward"
    spectrum: Tensor = torch.fft.fft2(estimate.double() - truth.double(), norm=norm)
    loss = _reduced((spectrum.real.square() + spectrum.imag.square() + _LEAST).sqrt(), reduction)
    return loss.to(single(estimate).dtype)


@node()
def log_error(estimate: Tensor, truth: Tensor) -> Tensor:
    """Average over pictures the logarithm of the mean squared difference of the encoded pictures.

    It is -ln(10) / 10 of the PSNR of `metrics.quality`. A decibel counts alike in every picture,
    whereas in a mean of errors a few pictures that cannot be restored rule. Outside of [0, 1] a
    tenth of the linear value counts, so that the loss has a slope where a display shows black or
    white.

    Shapes: estimate and truth (..., 3, y, x), linear sRGB -> ().
    Units:  none; 0 for pictures that differ by 1 everywhere.
    Error:  1e-6 is added to each mean, so that pictures above 50 dB hardly count; 1e-6 in float32.
    Raises: ValueError for pictures of different shapes.
    Source: ours; sRGB as IEC 61966-2-1.
    """
    require_same_shape(estimate, truth)
    mean_square = (_encoded(single(estimate)) - _encoded(single(truth))).square().mean((-3, -2, -1))
    return (mean_square + _NEAR).log().mean()


def _encoded(picture: Tensor) -> Tensor:
    """Return a linear picture in sRGB encoding; outside [0, 1] it continues with a small slope."""
    from kornia.color import linear_rgb_to_rgb

    displayable = picture.clamp(0, 1)
    encoded: Tensor = linear_rgb_to_rgb(displayable)
    return encoded + _BEYOND * (picture - displayable)


def _reduced(errors: Tensor, reduction: Reduction) -> Tensor:
    return errors.mean() if reduction == "mean" else errors.sum()


# --- spectral loss --------------------------------------------------------------------------------

# The loss function of spectra estimated from RGB: the error of each band relative to the true
# value.


@node()
def mrae(
    estimate: Tensor, truth: Tensor, *, floor: Annotated[float, Field(ge=1e-12, le=1)] = 0.02
) -> Tensor:
    """Average the absolute error of spectra, divided by the true value or by `floor`, whichever is
    larger.

    Without a floor a black of 1e-4 has ten thousand times the gradient of white, and training fits
    the noise of the black. With a floor no gradient exceeds 1 / floor, and for a truth below the
    floor the divisor is constant.

    Shapes: estimate and truth alike -> ().
    Units:  none; floor in the unit of the spectra.
    Error:  equal to the published measure where the truth is above the floor, smaller elsewhere.
    Raises: ValueError for spectra of different shapes.
    Source: mean relative absolute error as in NTIRE 2022 and Cai et al., MST++, CVPRW 2022; the
            floor is ours.
    """
    require_same_shape(estimate, truth, "lift the picture that was rendered from the truth")
    truth = single(truth)
    result: Tensor = ((single(estimate) - truth).abs() / truth.abs().clamp_min(floor)).mean()
    return result


@mrae.reference
def _(estimate: Tensor, truth: Tensor, *, floor: float = 0.02) -> Tensor:
    truth = truth.double()
    relative_error = (estimate.double() - truth).abs() / torch.maximum(
        truth.abs(), torch.tensor(floor, dtype=torch.float64)
    )
    return relative_error.sum() / relative_error.numel()


# --- gradient penalty -----------------------------------------------------------------------------

# The gradient penalty, a loss function that keeps the norm of a critic's gradient near 1.


@node()
def gradient_penalty(slopes: Tensor) -> Tensor:
    """Average (n - 1)^2 over samples, where n is the norm of the gradient of a GAN critic at a
    sample.

    ``slopes`` are the gradients of the critic with respect to its inputs, made with
    ``create_graph=True``.

    Shapes: slopes (sample, ...) -> ().
    Units:  none.
    Error:  float32, 1e-5. A gradient of exactly 0 adds 1 and passes nothing back: the norm of 0 has
            no direction.
    Source: Gulrajani et al., Improved Training of Wasserstein GANs, NeurIPS 2017 (WGAN-GP).
    """
    flat_slopes = single(slopes).flatten(1)
    largest_slope = flat_slopes.detach().abs().amax(1, keepdim=True)
    is_zero = largest_slope == 0
    # scaled, since squares of gradients below 1e-19 underflow; sqrt has no finite gradient at 0
    scale = largest_slope.where(~is_zero, 1.0)
    scaled_squares = (flat_slopes / scale).square().sum(1, keepdim=True)
    norm = scaled_squares.where(~is_zero, 1.0).sqrt().where(~is_zero, 0.0) * scale
    return (norm - 1).square().mean()
