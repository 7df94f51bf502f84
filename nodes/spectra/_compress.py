"""A cube of many bands as few planes and their spectra, with a bound of what is left away."""

from collections.abc import Iterator
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.values import Mixture

Share = Annotated[float, Field(ge=0, allow_inf_nan=False)]  #: of the brightest element

_PIECE = 1 << 14  #: pixels looked at together: 31 bands of them in float64 are 4 MB and stay in the cache


@node(rtol=1e-6)
def compress(cube: Tensor, *, within: Share = 1e-6) -> Mixture:
    """Write a cube as the fewest planes, principal components of its spectra, that come within a bound of it.

    Shapes: cube (band, y, x) -> planes (k, y, x), basis (band, k), rest (k + 1, band) float64.
    Units:  planes those of the cube; basis none; rest those of the cube.
    Error:  `rest[k]`, measured on every pixel, is at most `within` times the largest element, and never asked to be
            below the rounding of the cube's own precision.
    Raises: ValueError where the cube is not (band, y, x) or not finite.
    Source: principal components, Pearson 1901; Maloney, J. Opt. Soc. Am. A 3, 1673 (1986) for spectra.
    """
    if cube.ndim != 3:
        raise ValueError(f"cube {tuple(cube.shape)} must be (band, y, x): compress one scene at a time")
    flat = cube.detach().flatten(1)
    gram = _gram(flat)
    if not bool(torch.isfinite(gram).all()):
        raise ValueError("the cube holds NaN or infinite light: mend the scene, or keep the image of all bands")
    power, axes = torch.linalg.eigh(gram)
    power, axes = power.flip(0).clamp_min(0), axes.flip(1)
    basis = _enough(flat, power, axes, within)
    planes = torch.tensordot(basis.T.to(cube), cube, 1)
    return Mixture(planes, basis, _rest(flat, planes.detach().flatten(1), basis))


def _pieces(flat: Tensor) -> Iterator[Tensor]:
    """The cube in float64, some pixels at a time."""
    for start in range(0, flat.shape[1], _PIECE):
        yield flat[:, start : start + _PIECE].double()


def _gram(flat: Tensor) -> Tensor:
    gram = flat.new_zeros(len(flat), len(flat), dtype=torch.float64)
    for piece in _pieces(flat):
        gram.addmm_(piece, piece.T)
    return gram


def _enough(flat: Tensor, power: Tensor, axes: Tensor, within: float) -> Tensor:
    """The first axes that come near enough."""
    most = flat.abs().amax(1).double() if flat.numel() else flat.new_zeros(len(flat), dtype=torch.float64)
    target = max(within, 4 * torch.finfo(flat.dtype).eps) * float(most.max())
    for k in range(len(axes) + 1):
        if float((power[k:].sum() / max(flat.numel(), 1)).sqrt()) > target:
            continue
        left = flat.new_zeros(len(flat), dtype=torch.float64)
        outside = axes[:, k:] @ axes[:, k:].T
        for piece in _pieces(flat):
            left = torch.maximum(left, (outside @ piece).abs().amax(1))
        if float(left.max()) <= target:
            return axes[:, :k]
    return axes


def _rest(flat: Tensor, planes: Tensor, basis: Tensor) -> Tensor:
    """What is left after the first r planes: measured for none and for all, between them the sum of what follows."""
    most = planes.abs().amax(1).double() if planes.numel() else planes.new_zeros(len(planes), dtype=torch.float64)
    last = basis.new_zeros(len(basis))
    for start in range(0, flat.shape[1], _PIECE):
        made = basis @ planes[:, start : start + _PIECE].double()
        last = torch.maximum(last, (flat[:, start : start + _PIECE] - made).abs().amax(1))
    each = (basis.abs() * most).T
    rest = last + torch.cat([each.flip(0).cumsum(0).flip(0), torch.zeros_like(last)[None]])
    rest[0] = flat.abs().amax(1).double() if flat.numel() else 0.0
    return rest


@compress.reference
def _(cube: Tensor, *, within: float = 1e-6) -> Mixture:
    left, _, _ = torch.linalg.svd(cube.double().flatten(1), full_matrices=False)
    planes = (left.T @ cube.double().flatten(1)).reshape(-1, *cube.shape[1:])
    rest = [
        (cube.double() - torch.tensordot(left[:, :r], planes[:r], 1)).abs().amax((1, 2)) for r in range(len(planes) + 1)
    ]
    target = within * float(cube.abs().max())
    count = next((r for r, x in enumerate(rest) if float(x.max()) <= target), len(planes))
    return Mixture(planes[:count], left[:, :count], torch.stack(rest[: count + 1]))


@compress.deviates
def _(result: Mixture) -> float:
    most = float(result.rest[0].max())
    return float(result.rest[-1].max()) / most if most > 0 else 0.0


@compress.check
def _(result: Mixture, *inputs: Tensor, **params: float) -> list[Check]:
    most = max(float(result.rest[0].max()), 1e-300)
    left = float(result.rest[-1].max()) / most
    return [Check(f"{len(result.planes)} planes for {len(result.basis)} bands, within {left:.2g} of the brightest")]
