"""The loss of spectra estimated from RGB: the error of every band, relative to the true value."""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import node
from neusee.nodes._half_precision import single
from neusee.nodes.metrics._picture_quality import require_same_shape


@node()
def mrae(estimate: Tensor, truth: Tensor, *, floor: Annotated[float, Field(ge=1e-12, le=1)] = 0.02) -> Tensor:
    """Average the absolute error of spectra, divided by the true value or by `floor`, whichever is larger.

    Without a floor a black of 1e-4 has ten thousand times the gradient of white, and training fits the noise of the
    black. With a floor no gradient exceeds 1 / floor, and for a truth below the floor the divisor is constant.

    Shapes: estimate and truth alike -> ().
    Units:  none; floor in the unit of the spectra.
    Error:  equal to the published measure where the truth is above the floor, smaller elsewhere.
    Raises: ValueError for spectra of different shapes.
    Source: mean relative absolute error as in NTIRE 2022 and Cai et al., MST++, CVPRW 2022; the floor is ours.
    """
    require_same_shape(estimate, truth, "lift the picture that was rendered from the truth")
    truth = single(truth)
    result: Tensor = ((single(estimate) - truth).abs() / truth.abs().clamp_min(floor)).mean()
    return result


@mrae.reference
def _(estimate: Tensor, truth: Tensor, *, floor: float = 0.02) -> Tensor:
    truth = truth.double()
    share = (estimate.double() - truth).abs() / torch.maximum(truth.abs(), torch.tensor(floor, dtype=torch.float64))
    return share.sum() / share.numel()
