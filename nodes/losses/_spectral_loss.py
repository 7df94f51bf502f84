"""What a spectral lift is trained for: every band right in proportion to what it is."""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import node
from neusee.nodes._half_precision import single


@node()
def mrae(
    estimate: Tensor, truth: Tensor, *, floor: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.02
) -> Tensor:
    """Average the absolute difference over the truth, which counts as `floor` at least.

    Without a floor a black at 1e-4 pulls ten thousand times as hard as white, and its noise is all that is learnt; with
    it the slope is never above 1 / floor, and below it the difference counts as it is.

    Shapes: estimate and truth alike -> ().
    Units:  none; floor in those of the spectra.
    Error:  equal to the published measure where the truth is above the floor, else less.
    Raises: ValueError for spectra of different shape.
    Source: mean relative absolute error as in NTIRE 2022 and Cai et al., MST++, CVPRW 2022; the floor is ours.
    """
    if estimate.shape != truth.shape:
        raise ValueError(
            f"estimate {tuple(estimate.shape)} and truth {tuple(truth.shape)} differ: lift the same picture"
        )
    wanted = single(truth)
    result: Tensor = ((single(estimate) - wanted).abs() / wanted.abs().clamp_min(floor)).mean()
    return result


@mrae.reference
def _(estimate: Tensor, truth: Tensor, *, floor: float = 0.02) -> Tensor:
    wanted = truth.double()
    share = (estimate.double() - wanted).abs() / torch.maximum(wanted.abs(), torch.tensor(floor, dtype=torch.float64))
    return share.sum() / share.numel()
