"""Deconvolution with a PSF that was measured at several places of the frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, node
from neusee.nodes.precision import single
from neusee.nodes.restore._point_frames import hats
from neusee.nodes.restore.inverse._glare import Glare, with_light_around, with_smooth
from neusee.nodes.restore.inverse._hidden_pixels import most_likely
from neusee.nodes.restore.inverse._masked_blur import edge
from neusee.nodes.restore.inverse._posterior_spread import Draws, frame_deviation
from neusee.nodes.restore.inverse._wiener import (
    PRECISE,
    Doubt,
    LaserLight,
    LeastDoubt,
    Scaled,
    Settings,
    known_and_light,
    posed,
)
from neusee.nodes.units import Electrons
from neusee.nodes.values import Bands, MeasuredPsf, Psf

Balance = Annotated[float, Field(ge=1e-6, le=1e6)]


@node(rtol=1e-5, additive_inputs=[("glare", "nearby")])
def wiener_by_field(
    electrons: Tensor,
    measured: MeasuredPsf,
    clipped: Tensor,
    glare: list[Tensor] | None = None,
    nearby: list[Tensor] | None = None,
    *,
    balance: Balance = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    scatter: bool = False,
    read_noise: Electrons,
) -> Tensor:
    """Deconvolve a picture with a PSF that was measured by field: `restore.wiener` around each
    node, blended.

    The picture around each node of the grid is deconvolved with the PSF of the node, up to where
    its bilinear weight is 0 and by the radius that holds 99.9 % of the PSF beyond. The results are
    added with these weights, whose sum is 1. The patterns of ``glare`` are removed, with
    ``nearby``, ``doubt``, ``least_doubt`` and ``scatter`` as in `restore.wiener`, but that channels
    share no level. They come from a model of the lens, because a PSF that white points gave does
    not tell the pattern of one wavelength. Strengths, a doubt that is found and the light that is
    scattered are those around each node.

    Shapes: electrons and clipped (channel, y, x), measured.kernels (row, column, channel, any,
            any), each glare (channel, y, x), each nearby (pattern, channel, y, x) -> (channel, y,
            x).
    Units:  e-, glare and nearby any; the result as behind a perfect lens that loses the same light;
            doubt none.
    Error:  that of `restore.wiener`, of the PSF (`restore.spread_by_field` includes it), and of
            taking the PSF as constant over each part: the blend of two restored pictures is not the
            restoration with the blended PSF. Variance and mean of the prior are those of each part.
            Without `glare` lasers are taken for scene.
    Raises: ValueError where channels or pixels differ.
    Source: overlap-add with a PSF that varies in space, Nagy and O'Leary, SIAM J. Sci. Comput. 19,
            1063 (1998), applied to the restored pictures.
    """
    _refuse_other(electrons, measured)
    total = torch.zeros_like(single(electrons))
    light = _glare(electrons, measured, clipped, LaserLight(glare, nearby), doubt, scatter)
    settings = Settings(balance, read_noise, doubt, least_doubt, scatter)
    for zone in _parts(electrons, measured):
        scaled = _problem(electrons, clipped, zone, light, settings)
        restored = scaled.pixels(most_likely(scaled.problem, coarser=True)) + scaled.mean
        total[:, zone.rows, zone.columns] += (zone.weight.to(restored) * restored).to(total)
    return total


@node()
def spread_by_field(
    electrons: Tensor,
    measured: MeasuredPsf,
    clipped: Tensor,
    matrix: Tensor,
    glare: list[Tensor] | None = None,
    nearby: list[Tensor] | None = None,
    *,
    balance: Balance = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    scatter: bool = False,
    draws: Draws = 8,
    read_noise: Electrons,
    rng: Generator,
) -> Tensor:
    """Compute the standard deviation of each pixel of `restore.wiener_by_field`, the error of the
    PSF included.

    As `restore.wiener_spread` with the law `frame`, around each node. Each drawn scene is blurred
    with a PSF drawn from the measurement, and restored with the mean PSF: noise, the lost detail
    and the error of the PSF enter together. ``glare`` and ``nearby`` count as in
    `restore.wiener_spread`.

    Shapes: as `restore.wiener_by_field`, matrix (colour, channel) -> (colour, y, x).
    Units:  those of `restore.colour`.
    Error:  as `restore.wiener_spread`. Between nodes the deviations are added with the weights of
            the blend, as if the errors of both were the same: too wide where they are not. The
            change of the PSF within a part, and a scene with lamps far brighter than its mean, are
            not included. Too narrow for a PSF that two faint frames of points tell: 90 % intervals
            held 72 % of one scene.
    Raises: ValueError where channels or pixels differ.
    Source: as `restore.wiener_spread`.
    """
    _refuse_other(electrons, measured)
    total = torch.zeros(
        len(matrix), *electrons.shape[-2:], dtype=single(electrons).dtype, device=electrons.device
    )
    with torch.no_grad():
        light = _glare(electrons, measured, clipped, LaserLight(glare, nearby), doubt, scatter)
    settings = Settings(balance, read_noise, doubt, least_doubt, scatter)
    for zone in _parts(electrons, measured):
        with torch.no_grad():
            scaled = _problem(electrons, clipped, zone, light, settings)
        deviation = frame_deviation(scaled, matrix, draws, rng, zone.draws)
        total[:, zone.rows, zone.columns] += zone.weight.to(total) * deviation.to(total)
    return total


@wiener_by_field.check
def _(
    result: Tensor, electrons: Tensor, measured: MeasuredPsf, *inputs: Any, **params: Any
) -> list[Check]:
    rows, columns = measured.kernels.shape[:2]
    return [Check(f"{rows} x {columns} PSFs over the frame", math.isfinite(float(result.sum())))]


@spread_by_field.check
def _(result: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    lowest, highest = float(result.min()), float(result.max())
    return [
        Check(
            f"deviation from {lowest:.2g} to {highest:.2g}", math.isfinite(highest) and lowest >= 0
        )
    ]


class _Part(NamedTuple):
    """The part of a frame around one node: its pixels, the PSFs there, and the blending weight of
    its restored picture.
    """

    rows: slice
    columns: slice
    weight: Tensor  #: (y, x) of these pixels
    kernels: Tensor  #: (channel, y, x)
    draws: Tensor  #: (draw, channel, y, x)


def _parts(electrons: Tensor, measured: MeasuredPsf) -> Iterator[_Part]:
    """Yield the part of a frame around each node of the measured PSF, row by row.

    A part consists of the pixels where the node's weight is not 0, and a border as wide as the
    radius of its PSF.
    """
    size = (electrons.shape[-2], electrons.shape[-1])
    row_weights, column_weights = (
        hats(torch.arange(n), n, count)
        for n, count in zip(size, measured.kernels.shape[:2], strict=True)
    )
    for i in range(row_weights.shape[1]):
        for j in range(column_weights.shape[1]):
            kernels = measured.kernels[i, j]
            psf_radii = edge(kernels, size)
            rows, columns = (
                _around(row_weights[:, i], psf_radii[0]),
                _around(column_weights[:, j], psf_radii[1]),
            )
            weight = row_weights[rows, i, None] * column_weights[columns, j]
            yield _Part(rows, columns, weight, kernels, measured.draws[:, i, j])


def _glare(
    electrons: Tensor,
    measured: MeasuredPsf,
    clipped: Tensor,
    lights: LaserLight,
    doubt: float | None,
    scatter: bool,
) -> Glare:
    """Return the glare of the whole frame, with the surrounding light if ``doubt`` is not 0, and
    the smoothed patterns if ``scatter`` is set.
    """
    kernel = _channelwise(measured.kernels[0, 0])
    # kernel[0] is a PSF with one band per channel, kernel[2] are the responses
    light = known_and_light(kernel[0], kernel[2], single(electrons), clipped, lights)[2]
    light = light if doubt == 0 else with_light_around(light)
    return with_smooth(light) if scatter else light


def _problem(
    electrons: Tensor, clipped: Tensor, zone: _Part, light: Glare, settings: Settings
) -> Scaled:
    """Return the deconvolution problem of a part of a frame, scaled."""
    channels_and_part = (slice(None), zone.rows, zone.columns)
    picture = single(electrons)[channels_and_part]
    picture = picture.double() if max(picture.shape[-2:]) <= PRECISE else picture
    unclipped, kernels = (~clipped[channels_and_part]).to(picture), zone.kernels.to(picture)

    def cut(pictures: list[Tensor]) -> list[Tensor]:
        return [x[..., zone.rows, zone.columns].to(picture) for x in pictures]

    nearby = [None if x is None else cut([x])[0] for x in light.nearby]
    light_around, spread_patterns = (
        light.around and cut(light.around),
        light.smooth and [cut(patterns) for patterns in light.smooth],
    )
    glare_in_part = Glare(cut(light.patterns), nearby, light_around, light.peaks, spread_patterns)
    return posed(picture, unclipped, kernels, glare_in_part, settings)


def _around(weight: Tensor, reach: int) -> slice:
    """Return the slice of an axis where a weight is not 0, extended by ``reach`` pixels on both
    sides.
    """
    inside = weight.nonzero()[:, 0]
    return slice(max(int(inside[0]) - reach, 0), min(int(inside[-1]) + reach + 1, len(weight)))


def _channelwise(kernels: Tensor) -> tuple[Psf, Tensor, Tensor, Bands]:
    """Return PSF, illuminant, responses and bands of a camera in which each channel sees one band,
    and each band has its own PSF.
    """
    ones = torch.ones(len(kernels), dtype=torch.float64)
    return (
        Psf(kernels, ones),
        ones,
        torch.eye(len(kernels), dtype=torch.float64),
        Bands(ones, ones, ones),
    )


def _refuse_other(electrons: Tensor, measured: MeasuredPsf) -> None:
    """Raise ValueError unless the picture and the measured PSF have the same number of channels."""
    if (channels := measured.kernels.shape[2]) != electrons.shape[-3]:
        raise ValueError(
            f"the measured PSF has {channels} channels and the picture {electrons.shape[-3]}: use"
            " frames of one camera"
        )
