"""Low-rank approximation of a spectral cube: a sum of a few basis images times spectra, with an error bound."""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.spectra._principal_planes import Source, few_planes
from neusee.nodes.values import LowRankCube

Share = Annotated[float, Field(ge=0, le=1)]  #: relative to the largest element


@node(rtol=1e-6)
def compress(cube: Tensor, *, within: Share = 1e-6) -> LowRankCube:
    """Approximate a spectral cube by the fewest principal components that keep the error within a bound.

    A grey scene needs one basis image. A linear estimate from RGB needs three, or a few more if pixels are clipped.

    Shapes: cube (band, y, x) -> planes (k, y, x), basis (band, k), residual_max and residual_rms (k + 1, band)
            float64, residual_map (y, x).
    Units:  planes and residuals as the cube; the basis has no unit.
    Error:  `residual_rms[k]` is at most the largest of `within`, 2e-7 and eight round-off units of the planes, times
            the largest element. `residual_max[k]` and `residual_map` are the largest errors of a band and of a pixel,
            measured on every pixel in float64. `residual_max[r]` for 0 < r < k is as a rule at most five times too
            large. The gradient treats the basis as constant.
    Raises: ValueError where the cube is not (band, y, x), has no pixels or holds NaN.
    Source: principal components, Pearson 1901; Maloney, J. Opt. Soc. Am. A 3, 1673 (1986) for spectra.
    """
    if cube.ndim != 3:
        raise ValueError(f"cube has shape {tuple(cube.shape)}, not (band, y, x): compress one scene at a time")
    flat = cube.detach().flatten(1)
    dtype = cube.dtype if cube.dtype == torch.float64 else torch.float32
    source = Source(lambda pixels: flat[:, pixels].to(torch.float64, copy=True), len(flat), flat.shape[1], dtype)
    return as_low_rank_cube(few_planes(source, within), cube)


def as_low_rank_cube(flat: LowRankCube, cube: Tensor) -> LowRankCube:
    """Reshape the flattened basis images of a low-rank cube to the rows and columns of ``cube``.

    If ``cube`` requires a gradient, the basis images are computed anew as projections of ``cube``.
    """
    if cube.requires_grad:
        planes = torch.tensordot(flat.basis.T.to(cube), cube, 1)
    else:
        planes = flat.planes.reshape(-1, *cube.shape[-2:])
    return flat._replace(planes=planes, residual_map=flat.residual_map.reshape(cube.shape[-2:]))


@compress.reference
def _(cube: Tensor, *, within: float = 1e-6) -> LowRankCube:
    flat = cube.double().flatten(1)
    axes = torch.linalg.svd(flat, full_matrices=False)[0]
    errors = [flat - axes[:, :r] @ (axes[:, :r].T @ flat) for r in range(axes.shape[1] + 1)]
    spread = torch.stack([error.square().mean(1).sqrt() for error in errors])
    most = within * float(flat.abs().max())
    count = max(1, next((r for r, x in enumerate(spread) if float(x.max()) <= most), axes.shape[1]))
    planes = (axes[:, :count].T @ flat).reshape(-1, *cube.shape[1:])
    rest = torch.stack([error.abs().amax(1) for error in errors])
    off = errors[count].abs().amax(0).reshape(cube.shape[1:])
    return LowRankCube(planes, axes[:, :count], rest[: count + 1], spread[: count + 1], off)


@compress.check
def plane_checks(result: LowRankCube, *inputs: object, **params: object) -> list[Check]:
    """Report the number of basis images of a low-rank cube, and the error relative to the full spectral cube."""
    rms, most = (
        float(x[-1].max()) / max(float(result.residual_max[0].max()), 1e-300)
        for x in (result.residual_rms, result.residual_max)
    )
    count = f"{len(result.planes)} basis images for {len(result.basis)} bands"
    return [Check(f"{count}: error {rms:.2g} rms, {most:.2g} at most, relative to the largest element of the cube")]
