"""Reading weighted sums of an image that has been summed over its bands already."""

import torch
from torch import Tensor

from neusee.nodes._half_precision import single
from neusee.nodes.values import Channels

_OFF = 1e-9  #: part of the weights that may lie outside the rows


def weighted(image: Tensor | Channels, weights: Tensor) -> Tensor:
    """Sum the bands of ``image`` by ``weights`` (..., band): (..., y, x); raises ValueError where they do not fit."""
    if isinstance(image, Channels):
        mixed = _of_rows(weights, image.rows).to(image.planes)
        summed: Tensor = torch.tensordot(mixed, image.planes, 1)
        return summed
    image = single(image)
    flat = weights.to(image) @ image.flatten(-2)
    return flat.reshape(*flat.shape[:-1], *image.shape[-2:])


def channel_sums(image: Tensor, rows: Tensor) -> Channels:
    """Sum an image (..., band, y, x) by each of ``rows`` (row, band), exactly; of some of its bands, their share."""
    exact = torch.zeros((), dtype=torch.float64)
    light = single(image).sum(-1).sum(-1, dtype=torch.float64)
    return Channels(weighted(image, rows), rows.detach().double(), light, exact, largest=exact)


def _of_rows(weights: Tensor, rows: Tensor) -> Tensor:
    """M with weights = M rows, by least squares in float64; the gradient reaches the weights."""
    known = rows.detach().cpu().double()
    scale = known.abs().amax(1, keepdim=True)
    inverse = torch.linalg.pinv(known / scale.where(scale > 0, 1.0)) / scale.where(scale > 0, 1.0).T
    wanted = weights.cpu().double()
    if wanted.shape[-1] != known.shape[1]:
        raise ValueError(
            f"weights of {wanted.shape[-1]} bands, but channels of {known.shape[1]}: give both the same `bands` step"
        )
    found: Tensor = wanted @ inverse
    _inside(wanted.detach(), found.detach() @ known)
    return found


def _inside(wanted: Tensor, made: Tensor) -> None:
    """Refuse weights that the rows cannot make, each row by its own largest."""
    off, most = (wanted - made).abs().flatten(0, -2), wanted.abs().flatten(0, -2).amax(-1)
    if not bool((off.amax(-1) <= _OFF * most).all()):
        worst = float((off.amax(-1) / most.clamp_min(1e-300)).max())
        raise ValueError(
            f"the image was summed over its bands by other weights: {worst:.2g} of what is asked for lies outside its "
            "rows, and 1e-9 is allowed: make the rows of the same `bands` and `responses`, with a level that is the "
            "same in all bands, or keep the image of all bands"
        )
