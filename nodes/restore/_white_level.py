"""The level of a frame whose scene is not known: how bright white was."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.restore._colour_matrix import colour_matrix
from neusee.nodes.restore._inverse._grey_psf import effective_psf
from neusee.nodes.sensor._exposure import channel_weights
from neusee.nodes.sensor._saturation import Efficiency, Well
from neusee.nodes.units import Exposure, PixelPitch
from neusee.nodes.values import Bands, MeasuredPsf, Psf

White = Annotated[float, Field(ge=1e-30, le=1e30)]
_BRIGHT = 0.995  #: quantile of the unclipped pixels that counts as white
_SAMPLE = 2**22  #: pixels whose quantile is taken, at most


@node(rtol=1e-5)
def white_level(
    signal: Tensor,
    clipped: Tensor,
    psf: Psf | MeasuredPsf,
    bands: Bands,
    illuminant: Tensor,
    responses: Tensor,
    restored: Tensor | None = None,
    *,
    white: White | None = None,
    full_well: Well,
    quantum_efficiency: Efficiency,
    pixel_pitch: PixelPitch,
    exposure: Exposure,
) -> Tensor:
    """Compute the level of the light in a frame of an unknown scene, so that `restore.colour_matrix` knows its white.

    A white surface gives ``white`` full wells in the brightest channel. Without ``white``, a quantile counts as white:
    in the channels of the ``restored`` picture, that of 99.5 % of the unclipped pixels by their brightest colour, so
    that 0.5 % of these pixels are brighter than 1 in the picture; without it, that of the frame by its brightest
    channel. This choice sets how bright the picture is shown and nothing else.

    Shapes: signal, clipped and restored (channel, y, x), psf (band,) or measured, illuminant (band,), responses
            (channel, band) -> (band,) float64.
    Units:  signal and restored e-; white full wells; result W/m2 per unit of the illuminant, as `sensor.level`.
    Error:  a choice, not a measurement: a scene without white is shown too bright. In the frame a blurred scene is
            darker than it is, so that its restored picture would be shown too bright.
    Raises: ValueError where bands or channels differ.
    Source: white-patch assumption, Land and McCann, J. Opt. Soc. Am. 61, 1 (1971), with a quantile for the maximum.
    """
    one = torch.ones(len(bands.centres), dtype=torch.float64)
    lit = one * illuminant.cpu().double()
    weights = channel_weights(bands, responses.cpu(), lit, pixel_pitch=pixel_pitch, exposure=exposure)
    counts = weights.sum(-1) * quantum_efficiency
    if white is not None:
        return one * (white * full_well / float(counts.max()))
    if restored is not None:
        light_of = {"pixel_pitch": pixel_pitch, "exposure": exposure, "quantum_efficiency": quantum_efficiency}
        matrix = colour_matrix(bands, illuminant, responses, one, **light_of)
        brightness = (matrix.to(restored.device) @ single(restored).double().flatten(-2)).amax(-2)
        return one * _bright_quantile(brightness.reshape(restored.shape[-2:]), clipped)
    passed = _passed(psf, bands, illuminant, responses)
    whole = (counts * passed).clamp_min(1e-300).to(signal.device)
    return one * _bright_quantile((single(signal).double() / whole[:, None, None]).amax(-3), clipped)


def _bright_quantile(brightness: Tensor, clipped: Tensor) -> Tensor:
    """Return the quantile of the unclipped pixels (y, x) that counts as white, or of all if all are clipped."""
    unclipped = ~clipped.any(-3)
    pixels = brightness[unclipped] if bool(unclipped.any()) else brightness.flatten()
    sample = pixels[:: max(1, len(pixels) // _SAMPLE)]
    return torch.quantile(sample, _BRIGHT).clamp_min(1e-300).cpu()


def _passed(psf: Psf | MeasuredPsf, bands: Bands, illuminant: Tensor, responses: Tensor) -> Tensor:
    """Return the share of the light that the PSF of each channel holds: 1 for one that was measured."""
    if isinstance(psf, MeasuredPsf):
        return torch.ones(len(responses), dtype=torch.float64)
    return effective_psf(psf, illuminant, responses, bands).sum((-2, -1)).double().cpu()


@white_level.check
def _(result: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    level = float(result[0])
    return [Check(f"white is {level:.3g} W/m2 per unit of the illuminant", math.isfinite(level) and level > 1e-200)]
