"""Shapes of the results of the spectral nodes."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.shape_rules import at_least_single, blank, double, known, like_first
from neusee.nodes.spectra._channel_responses import channel_count, responses, rows, seen_range
from neusee.nodes.spectra._illuminant import illuminant, illuminate
from neusee.nodes.spectra._lift import (
    lift_lmmse,
    lift_lmmse_mixture,
    lift_mallett,
    lift_mallett_mixture,
    lift_mst_plus_plus,
)
from neusee.nodes.spectra._low_rank_cube import compress
from neusee.nodes.spectra._plausible_spectra import metamers
from neusee.nodes.spectra._synthetic_pictures import _SAMPLES_PER_PIXEL, grain, leaves, render
from neusee.nodes.values import Bands, LowRankCube

_MOST_LINE_BANDS = 20  #: fewer bands than this count as those of a laser line


@illuminant.shape
def _(bands: Bands, **params: Any) -> Tensor:
    return double(len(bands.centres))


@responses.shape
def _(bands: Bands, *, camera: str | Path = "CIE 1931", **params: Any) -> Tensor:
    """Return the shape of the responses; for a laser line that no channel may see, return the
    responses themselves, which are needed before the run.
    """
    if known(bands.centres) and _may_be_unseen(bands, camera):
        channels: Tensor = responses(bands, camera=camera, **params)
        return channels
    return double(channel_count(camera), len(bands.centres))


def _may_be_unseen(bands: Bands, camera: str | Path) -> bool:
    """Return True for the few bands of a laser line outside the sensitive range of the camera."""
    shortest_nm, longest_nm = seen_range(camera)
    return (
        len(bands.centres) < _MOST_LINE_BANDS
        and not shortest_nm <= float(bands.centres.mean()) * 1e9 <= longest_nm
    )


@rows.shape
def _(bands: Bands, responses: Tensor, *, well: bool = True) -> Tensor:
    return double(len(responses) + well, responses.shape[1])


@illuminate.shape
def _(reflectance: Tensor | LowRankCube, illuminant: Tensor, **params: Any) -> Any:
    return reflectance if isinstance(reflectance, LowRankCube) else like_first(reflectance)


def _cube(rgb: Tensor, bands: Bands, **params: Any) -> Tensor:
    return blank(len(bands.centres), *rgb.shape[-2:], dtype=at_least_single(rgb))


def _mixture(rgb: Tensor, bands: Bands, **params: Any) -> LowRankCube:
    """Return the shape of the low-rank form of a linear lift, which has as many planes as the
    picture has colours.
    """
    return _low_rank(min(len(rgb), len(bands.centres)), len(bands.centres), rgb)


def _low_rank(planes: int, bands: int, like: Tensor) -> LowRankCube:
    """Return the low-rank form of a cube without values, in the size of the picture ``like``."""
    dtype = torch.float64 if like.dtype == torch.float64 else torch.float32
    planes_of_cube, residual_map = (
        blank(*shape, *like.shape[-2:], dtype=dtype) for shape in ((planes,), ())
    )
    residual_max, residual_rms = (double(planes + 1, bands) for _ in range(2))
    return LowRankCube(
        planes_of_cube, double(bands, planes), residual_max, residual_rms, residual_map
    )


for node in (lift_lmmse, lift_mallett, lift_mst_plus_plus):
    node.shape(_cube)
lift_lmmse_mixture.shape(_mixture)
lift_mallett_mixture.shape(_mixture)


@compress.shape
def _(cube: Tensor, **params: Any) -> LowRankCube:
    """Return the shape for the largest possible number of planes; the true number depends on the
    values.
    """
    return _low_rank(len(cube), len(cube), cube)


@compress.work
def _(result: LowRankCube, cube: Tensor, **params: Any) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    return 8.0 * cube[0].numel(), float(cube.numel() * len(cube))


@metamers.shape
def _(reflectances: Tensor, bands: Bands, *, count: int = 48, **params: Any) -> Tensor:
    return double(count, len(bands.centres))


@leaves.shape
def _(spectra: Tensor, bands: Bands, *, shape: tuple[int, int], **params: Any) -> Tensor:
    return blank(len(bands.centres), *shape)


@leaves.work
def _(result: Tensor, *inputs: Any, **params: Any) -> tuple[float, float]:
    """Return memory and operations of a picture that is drawn on a finer grid, in all bands at
    once.
    """
    sample_count = float(_SAMPLES_PER_PIXEL**2 * result.numel())
    return 4.0 * sample_count, sample_count


@render.shape
def _(reflectance: Tensor, bands: Bands) -> Tensor:
    return blank(
        *reflectance.shape[:-3], 3, *reflectance.shape[-2:], dtype=at_least_single(reflectance)
    )


grain.shape(like_first)
