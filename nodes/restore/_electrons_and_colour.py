"""Nodes that convert digital numbers to electrons, and electrons to colour."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import ErrorBound, TensorStats, node
from neusee.nodes._half_precision import single
from neusee.nodes.metrics._saturated_pixels import clipped as at_the_end
from neusee.nodes.sensor._digitization import Bits
from neusee.nodes.sensor._room_for_light import refuse_without_steps
from neusee.nodes.sensor._saturation import Well
from neusee.nodes.units import Electrons, Gain
from neusee.nodes.values import Shading

Brightness = Annotated[float, Field(gt=0, le=1e18)]
_GAIN = 2.0  #: relative error of the colours over that of the channels, for errors that are like the light
_BRIGHTEST = 0.5  #: brightest colour over largest weight and brightest channel: 0.25 to 0.6 in shipped recipes


@node()
def electrons(
    raw: Tensor, shading: Shading | None = None, *, gain: Gain, offset: Electrons, offset_subtracted: bool = True
) -> Tensor:
    """Convert digital numbers to electrons: undo the gain of the sensor and subtract its offset.

    With ``shading``, of `restore.shading`, the electrons are divided by its transmission.

    Shapes: raw (..., y, x), shading (y, x) -> (..., y, x).
    Units:  raw DN; gain K, DN/e-; offset e-; result e-, negative where read noise was negative.
    Error:  the rounding of the converter, 0.29 DN rms; clipped pixels stay clipped. The quotient itself is float32,
            within 1.2e-7 of raw / gain.
    Source: NeuSee, Eq. (SensorImage), inverted.
    """
    found = single(raw) / gain - (offset if offset_subtracted else 0.0)
    return found if shading is None else found / shading.transmission.to(found)


@electrons.preflight
def _(*, offset: float, offset_subtracted: bool = True, **params: object) -> list[str]:
    if offset and not offset_subtracted:
        return [f"an offset of {offset:g} e- stays in the picture: set offset_subtracted: true to remove the offset"]
    return []


@electrons.propagate_error
def _(raw: ErrorBound, shading: ErrorBound | None = None, *, gain: float, **params: Any) -> float:
    if shading is None:
        return raw.rms / gain
    least = shading.stats.min if shading.stats and not shading.rms else 0.0
    return raw.rms / gain / least if least > 0 else math.inf


@electrons.expected_range
def _(raw: TensorStats, *_: Any, gain: float, offset: float, offset_subtracted: bool) -> tuple[float, float]:
    low, high = (end / gain - (offset if offset_subtracted else 0.0) for end in (raw.min, raw.max))
    return low, high


@node(rtol=0.0)
def clipped(raw: Tensor, *, full_well: Well, gain: Gain, bits: Bits = 16) -> Tensor:
    """Mark clipped pixels, which reach the full well or the largest digital number of the converter.

    Shapes: raw (..., y, x) -> (..., y, x) bool.
    Units:  raw DN.
    Error:  a value within one DN of the full well is marked too, and so is what is not a number (NaN).
    Source: NeuSee, Eq. (SensorImage).
    """
    return at_the_end(raw, full_well=full_well, gain=gain, bits=bits)


@clipped.preflight
def _(*, full_well: float, gain: float, bits: int = 16, **params: object) -> list[str]:
    refuse_without_steps(full_well, gain=gain, bits=bits)
    return []


@node()
def colour(channels: Tensor, matrix: Tensor, *, brightness: Brightness = 1.0) -> Tensor:
    """Convert the channels of the sensor to linear sRGB by a colour matrix.

    ``brightness`` multiplies the picture: 1 over the share of the light that a filter passes gives a picture behind
    this filter an exposure of its own.

    Shapes: channels (..., channel, y, x), matrix (3, channel) -> (..., 3, y, x).
    Units:  channels e-; result linear sRGB, white 1; colours out of gamut below 0.
    Error:  the error of the matrix: no matrix is right for all spectra.
    Raises: ValueError where channels and matrix differ in the number of channels.
    Source: Reinhard et al., High Dynamic Range Imaging, 2nd ed. (colour spaces as 3 x 3 matrices).
    """
    if channels.ndim < 3 or channels.shape[-3] != matrix.shape[-1]:
        raise ValueError(
            f"channels {tuple(channels.shape)} do not fit the matrix {tuple(matrix.shape)}: "
            "compute both from the same `responses` step"
        )
    channels = single(channels)
    flat = brightness * matrix.to(channels) @ channels.flatten(-2)
    return flat.reshape(*flat.shape[:-1], *channels.shape[-2:])


@colour.reference
def _(channels: Tensor, matrix: Tensor, *, brightness: float = 1.0) -> Tensor:
    return brightness * torch.stack(
        [sum(m * c for m, c in zip(row, channels.double().unbind(-3), strict=True)) for row in matrix], -3
    )


@colour.propagate_error
def _(channels: ErrorBound, matrix: ErrorBound, *, result: TensorStats, **params: Any) -> float:
    """Return an estimate of the error, not a bound: twice that of the channels, relative to the brightest element.

    Errors of the light are alike in all channels, so that the matrix enlarges them as it does the light. The error of
    the matrix is one factor for the whole picture.
    """
    return (_GAIN * channels.share + matrix.share) * max(abs(result.min), abs(result.max))


colour.hooks.estimated = True


@colour.propagate_scattered
def _(
    channels: ErrorBound, matrix: ErrorBound, *, result: TensorStats, brightness: float = 1.0, **params: Any
) -> float:
    """Return a bound of the error by noise in the channels, which the matrix enlarges by its Frobenius norm at most."""
    if channels.stats is None or matrix.stats is None:
        return math.inf
    # Frobenius norm over root mean square, times the root of channels over colours
    return brightness * matrix.stats.shape[-1] * (matrix.stats.largest_rms + matrix.rms) * channels.rms


@colour.expected_range
def _(channels: TensorStats, matrix: TensorStats, *, brightness: float = 1.0) -> tuple[float, float]:
    """Return the brightest colour relative to matrix and channels, as in photographs in daylight."""
    return 0.0, brightness * _BRIGHTEST * max(channels.max, -channels.min) * max(matrix.max, -matrix.min)
