"""Nodes that convert digital numbers to electrons, and electrons to colour."""

import torch
from torch import Tensor

from neusee.nodes import node
from neusee.nodes._half_precision import single
from neusee.nodes.metrics._saturated_pixels import clipped as at_the_end
from neusee.nodes.sensor._digitization import Bits
from neusee.nodes.sensor._saturation import Well
from neusee.nodes.units import Electrons, Gain
from neusee.nodes.values import Shading


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


@node(rtol=0.0)
def clipped(raw: Tensor, *, full_well: Well, gain: Gain, bits: Bits = 16) -> Tensor:
    """Mark clipped pixels, which reach the full well or the largest digital number of the converter.

    Shapes: raw (..., y, x) -> (..., y, x) bool.
    Units:  raw DN.
    Error:  a value within one DN of the full well is marked too, and so is what is not a number (NaN).
    Source: NeuSee, Eq. (SensorImage).
    """
    return at_the_end(raw, full_well=full_well, gain=gain, bits=bits)


@node()
def colour(channels: Tensor, matrix: Tensor) -> Tensor:
    """Convert the channels of the sensor to linear sRGB by a colour matrix.

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
    flat = matrix.to(channels) @ channels.flatten(-2)
    return flat.reshape(*flat.shape[:-1], *channels.shape[-2:])


@colour.reference
def _(channels: Tensor, matrix: Tensor) -> Tensor:
    return torch.stack(
        [sum(m * c for m, c in zip(row, channels.double().unbind(-3), strict=True)) for row in matrix], -3
    )
