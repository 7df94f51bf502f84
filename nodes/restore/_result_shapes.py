"""Shapes of the results of the restoring nodes, and the work of the deconvolution and of the networks."""

from typing import Any

import torch
from torch import Tensor

from neusee.nodes.restore._colour_matrix import colour_matrix
from neusee.nodes.restore._electrons_and_colour import clipped, colour, electrons
from neusee.nodes.restore._inverse._fft_grid import halvings
from neusee.nodes.restore._inverse._richardson_lucy import richardson_lucy
from neusee.nodes.restore._inverse._wiener import wiener
from neusee.nodes.restore._networks._fft_mamba import fft_mamba
from neusee.nodes.restore._networks._nafnet import nafnet
from neusee.nodes.restore._networks._unet import unet
from neusee.nodes.shape_rules import at_least_single, blank, double, like_first, transform_operations
from neusee.nodes.values import Psf

_SYSTEM = 35.0  #: bytes for each element of a dense system: the matrix, its factors and copies
_SOLVED = 400.0  #: operations of a dense solution that take as long as one operation of a transform

for node in (electrons, wiener, richardson_lucy, fft_mamba, nafnet, unet):
    node.shape(like_first)


@clipped.shape
def _(raw: Tensor, **params: Any) -> Tensor:
    return blank(*raw.shape, dtype=torch.bool)


@colour.shape
def _(channels: Tensor, matrix: Tensor) -> Tensor:
    return blank(*channels.shape[:-3], 3, *channels.shape[-2:], dtype=at_least_single(channels))


@colour_matrix.shape
def _(*inputs: Any, **params: Any) -> Tensor:
    return double(3, 3)


@wiener.work
def _(result: Tensor, electrons: Tensor, psf: Psf, *others: Any, **params: Any) -> tuple[float, float]:
    y, x = _torus(electrons, psf)
    coarse = max(electrons.shape[-2:]) / 2 ** halvings((electrons.shape[-2], electrons.shape[-1]))
    unknowns = len(electrons) * coarse**2  # of the coarsest grid, which is solved as a dense system
    operations = len(electrons) * transform_operations(y, x) + unknowns**3 / _SOLVED
    return max(31.0 * len(electrons) * y * x, _SYSTEM * unknowns**2), operations


@richardson_lucy.work
def _(
    result: Tensor, electrons: Tensor, psf: Psf, *others: Any, iterations: int = 40, **params: Any
) -> tuple[float, float]:
    y, x = _torus(electrons, psf)
    return 4.0 * len(electrons) * y * x, 4.0 * (iterations + 1) * len(electrons) * transform_operations(y, x)


def _torus(picture: Tensor, psf: Psf) -> tuple[int, int]:
    """Return the size of the transforms that deconvolve a picture, whose border they extend by the PSF."""
    y, x = (n + min(k, 2 * n) for n, k in zip(picture.shape[-2:], psf.intensity.shape[-2:], strict=True))
    return y, x


def _layers(result: Tensor, *inputs: Any, width: int = 32, **params: Any) -> tuple[float, float]:
    pixels = float(result[0].numel())
    return 4.0 * width * pixels, width**2 * pixels


for node in (fft_mamba, nafnet, unet):
    node.work(_layers)
