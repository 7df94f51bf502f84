"""Results of the laser nodes before a run: values of those with few numbers, shapes of the
others.
"""

from typing import Any

import torch
from torch import Tensor

from neusee.nodes.laser._bright_pixels import PARTS, RINGS, BrightPixels, bright_pixels
from neusee.nodes.laser._damage_spot import SpotDamage, damage, damaged_pixels, parts_before
from neusee.nodes.laser._dazzle import DECADES, Dazzle, DazzleCurve, dazzle, dazzle_curve
from neusee.nodes.laser._light import light, wavefront
from neusee.nodes.shape_rules import (
    at_least_single,
    blank,
    double,
    known,
    scalars,
    transform_operations,
)
from neusee.nodes.values import Bands, LaserLight, Psf, Stop, Wavefront

dazzle.shape(scalars(Dazzle))


@wavefront.shape
def _(line: Bands, **params: Any) -> Wavefront:
    result: Wavefront = wavefront(line, **params) if known(line.centres) else scalars(Wavefront)()
    return result


@light.shape
def _(line: Bands, stop: Stop, **params: Any) -> LaserLight:
    result: LaserLight = (
        light(line, stop, **params) if known(line.centres) else scalars(LaserLight)()
    )
    return result


@damage.shape
def _(spot: Tensor, line: Bands, light: LaserLight | None = None, **params: Any) -> SpotDamage:
    column = double(len(parts_before(line, light, **params)))
    return SpotDamage._make([*[column] * 8, blank(*spot.shape[-2:], dtype=torch.uint8)])


@damage.work
def _(result: SpotDamage, spot: Tensor, *inputs: Any, **params: Any) -> tuple[float, float]:
    # memory and operations: FFTs of twice the size for the heat, and the sum of the bands
    pixels = float(spot[0].numel())
    return 8.0 * 26 * pixels, float(spot.numel()) + 12 * transform_operations(
        2 * spot.shape[-2], 2 * spot.shape[-1]
    )


@damaged_pixels.shape
def _(raw: Tensor, *inputs: Any, **params: Any) -> Tensor:
    return blank(*raw.shape, dtype=at_least_single(raw))


@dazzle_curve.shape
def _(
    psf: Psf, bands: Bands, *, strengths: tuple[float, ...] = DECADES, **params: Any
) -> DazzleCurve:
    column = double(len(strengths))
    return DazzleCurve(column, column, column, column)


@dazzle_curve.work
def _(result: DazzleCurve, psf: Psf, *inputs: Any, **params: Any) -> tuple[float, float]:
    pixels = float(psf.intensity[0].numel())
    return 40.0 * pixels, 2.0 * psf.intensity.numel() + 20 * pixels


@bright_pixels.shape
def _(psf: Psf, bands: Bands, **params: Any) -> BrightPixels:
    column = double(RINGS * PARTS)
    return BrightPixels(column, column, column, column, double(3))


@bright_pixels.work
def _(
    result: BrightPixels,
    psf: Psf,
    *inputs: Any,
    pixel_pitch: float,
    sample_pitch: float | None = None,
    **params: Any,
) -> tuple[float, float]:
    samples = float(psf.intensity[0].numel())
    pixels = samples * min(1.0, (sample_pitch or pixel_pitch) / pixel_pitch) ** 2
    return 8.0 * samples + 48 * pixels, 2.0 * psf.intensity.numel() + 30 * samples
