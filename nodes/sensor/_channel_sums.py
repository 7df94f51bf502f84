"""Weighted sums of the spectral bands of an image, computed from the bands or from stored sums."""

import torch
from torch import Tensor

from neusee.nodes._half_precision import single
from neusee.nodes.values import Channels

_OFF = 1e-9  #: largest relative error of weights that are combined from the rows


def weighted(image: Tensor | Channels, weights: Tensor) -> Tensor:
    """Multiply the spectral bands of an image by ``weights`` (..., band), and return the sum over the bands.

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
    """Return weighted sums of the spectral bands of an image, one sum for each row of the matrix ``rows``.

    Shapes: image (..., band, y, x), rows (row, band). The sums carry no approximation error. The sums of a part of the
    bands are the contribution of these bands to the whole.
    """
    exact = torch.zeros((), dtype=torch.float64)
    return Channels(weighted(image, rows), rows.detach().double(), exact, largest=exact)


def _of_rows(weights: Tensor, rows: Tensor) -> Tensor:
    """Solve ``weights = M rows`` for the matrix M by least squares in float64.

    The gradient reaches the weights.
    """
    known = rows.detach().cpu().double()
    scale = known.abs().amax(1, keepdim=True)
    inverse = torch.linalg.pinv(known / scale.where(scale > 0, 1.0)) / scale.where(scale > 0, 1.0).T
    exact = weights.cpu().double()
    if exact.shape[-1] != known.shape[1]:
        counts = f"the weights have {exact.shape[-1]} bands and the sums of the image {known.shape[1]} bands"
        raise ValueError(f"{counts}: compute weights and image from the same `bands` step")
    matrix: Tensor = exact @ inverse
    _require_combination(exact.detach(), matrix.detach() @ known)
    return matrix


def _require_combination(exact: Tensor, combined: Tensor) -> None:
    """Raise ValueError unless the weights ``combined`` equal ``exact`` within 1e-9 of the largest weight."""
    off, most = (exact - combined).abs().flatten(0, -2), exact.abs().flatten(0, -2).amax(-1)
    if not bool((off.amax(-1) <= _OFF * most).all()):
        worst = float((off.amax(-1) / most.clamp_min(1e-300)).max())
        raise ValueError(
            f"the image was summed over its bands with other weights: the weights of this step differ by "
            f"{worst:.2g} (relative error; at most 1e-9) from every combination of these weights: use the same `bands` "
            "and `responses` for both, with a level that is equal in all bands, or keep the image of all bands"
        )
