"""What a restoration is trained for: the right colour at every pixel and in every frequency."""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import node


@node()
def charbonnier(
    estimate: Tensor, truth: Tensor, *, epsilon: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-6
) -> Tensor:
    """Average sqrt(difference^2 + epsilon): an absolute difference that is smooth at 0.

    Shapes: estimate and truth alike -> ().
    Units:  those of the pictures; epsilon in their square.
    Error:  above the mean absolute difference by sqrt(epsilon) at most, 1e-3.
    Raises: ValueError for pictures of different shape.
    Source: NeuSee, section Two-Stage Training (L_REC), with the mean; epsilon is ours.
    """
    _alike(estimate, truth)
    return ((estimate - truth).square() + epsilon).sqrt().mean()


@node()
def fft_l1(estimate: Tensor, truth: Tensor) -> Tensor:
    """Average the absolute difference of the two spectra.

    Shapes: estimate and truth (..., y, x) -> ().
    Units:  those of the pictures: the transform is unitary, so the size of a picture does not matter.
    Error:  float32 FFT, 1e-6.
    Raises: ValueError for pictures of different shape.
    Source: NeuSee, section Two-Stage Training (L_REC), with a unitary transform and the mean.
    """
    _alike(estimate, truth)
    spectrum: Tensor = torch.fft.fft2(estimate - truth, norm="ortho")
    return spectrum.abs().mean()


def _alike(estimate: Tensor, truth: Tensor) -> None:
    if estimate.shape != truth.shape:
        raise ValueError(
            f"estimate {tuple(estimate.shape)} and truth {tuple(truth.shape)} differ: crop the truth alike"
        )
