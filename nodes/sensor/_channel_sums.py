"""Weighted sums over the bands of an image, for images stored as all bands or as channel sums."""

import torch
from torch import Tensor

from neusee.nodes._half_precision import single
from neusee.nodes.values import Channels

_OFF = 1e-9  #: largest relative error of weights that are combined from the rows


def weighted(image: Tensor | Channels, weights: Tensor) -> Tensor:
    """Return the weighted sum of the bands of an image, with ``weights`` (..., band).

    Raises ValueError if weights and image have different numbers of bands, or if no combination of the channel sums
    gives the weights.
    """
    if isinstance(image, Channels):
        mixed = _of_rows(weights, image.rows).to(image.planes)
        summed: Tensor = torch.tensordot(mixed, image.planes, 1)
        return summed
    image = single(image)
    flat = weights.to(image) @ image.flatten(-2)
    return flat.reshape(*flat.shape[:-1], *image.shape[-2:])


def channel_sums(image: Tensor, rows: Tensor) -> Channels:
    """Return the weighted sums of the bands of an image as `Channels`, one sum for each row of weights.

    Shapes: image (..., band, y, x), rows (row, band). The sums carry no approximation error. The sums of a part of the
    bands are the contribution of these bands to the whole.
    """
    exact = torch.zeros((), dtype=torch.float64)
    light = single(image).sum(-1).sum(-1, dtype=torch.float64)
    return Channels(weighted(image, rows), rows.detach().double(), light, exact, largest=exact)


def _of_rows(weights: Tensor, rows: Tensor) -> Tensor:
    """Return the matrix M that satisfies ``weights = M rows``, by least squares in float64.

    The gradient reaches the weights.
    """
    known = rows.detach().cpu().double()
    scale = known.abs().amax(1, keepdim=True)
    inverse = torch.linalg.pinv(known / scale.where(scale > 0, 1.0)) / scale.where(scale > 0, 1.0).T
    exact = weights.cpu().double()
    if exact.shape[-1] != known.shape[1]:
        counts = f"the weights have {exact.shape[-1]} bands and the sums of the image {known.shape[1]} bands"
        raise ValueError(f"{counts}: use the same `bands` step for both")
    matrix: Tensor = exact @ inverse
    _require_combination(exact.detach(), matrix.detach() @ known)
    return matrix


def _require_combination(exact: Tensor, combined: Tensor) -> None:
    """Raise ValueError unless ``combined`` equals the ``exact`` weights within 1e-9 of the largest weight."""
    off, most = (exact - combined).abs().flatten(0, -2), exact.abs().flatten(0, -2).amax(-1)
    if not bool((off.amax(-1) <= _OFF * most).all()):
        worst = float((off.amax(-1) / most.clamp_min(1e-300)).max())
        raise ValueError(
            f"the image was summed over its bands with other weights: {worst:.2g} of the weights of this step lies "
            "outside the span of the image's rows, and 1e-9 is allowed: compute the rows from the same `bands` and "
            "`responses`, with a level that is equal in all bands, or keep the image of all bands"
        )
