"""The level of a frame whose scene is not known: how bright white was."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.restore._inverse._grey_psf import effective_psf
from neusee.nodes.sensor._exposure import channel_weights
from neusee.nodes.sensor._saturation import Efficiency, Well
from neusee.nodes.units import PositiveLength, Time
from neusee.nodes.values import Bands, MeasuredPsf, Psf

White = Annotated[float, Field(gt=0, allow_inf_nan=False)]
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
    *,
    white: White | None = None,
    full_well: Well,
    quantum_efficiency: Efficiency,
    pixel_pitch: PositiveLength,
    exposure: Time,
) -> Tensor:
    """Compute the level of the light in a frame of an unknown scene, so that `restore.colour_matrix` knows its white.

    A white surface gives ``white`` full wells in the brightest channel. Without ``white``, the pixel at the 99.5 %
    quantile of the unclipped pixels counts as white. This choice sets how bright the picture is shown and nothing else.

    Shapes: signal and clipped (channel, y, x), psf (band,) or measured, illuminant (band,), responses (channel, band)
            -> (band,) float64.
    Units:  signal e-; white full wells; result W/m2 per unit of the illuminant, as `sensor.level`.
    Error:  a choice, not a measurement: a scene without white is shown too bright, and a blurred one too bright too.
    Raises: ValueError where bands or channels differ.
    Source: white-patch assumption, Land and McCann, J. Opt. Soc. Am. 61, 1 (1971), with a quantile for the maximum.
    """
    one = torch.ones(len(bands.centres), dtype=torch.float64)
    lit = one * illuminant.cpu().double()
    weights = channel_weights(bands, responses.cpu(), lit, pixel_pitch=pixel_pitch, exposure=exposure)
    counts = weights.sum(-1) * quantum_efficiency
    if white is not None:
        return one * (white * full_well / float(counts.max()))
    passed = _passed(psf, bands, illuminant, responses)
    whole = (counts * passed).clamp_min(1e-300).to(signal.device)
    known = ~clipped.any(-3)
    shown = (single(signal).double() / whole[:, None, None]).amax(-3)
    found = shown[known] if bool(known.any()) else shown.flatten()
    sample = found[:: max(1, len(found) // _SAMPLE)]
    return one * torch.quantile(sample, _BRIGHT).clamp_min(1e-300).cpu()


def _passed(psf: Psf | MeasuredPsf, bands: Bands, illuminant: Tensor, responses: Tensor) -> Tensor:
    """Return the share of the light that the PSF of each channel holds: 1 for one that was measured."""
    if isinstance(psf, MeasuredPsf):
        return torch.ones(len(responses), dtype=torch.float64)
    return effective_psf(psf, illuminant, responses, bands).sum((-2, -1)).double().cpu()


@white_level.check
def _(result: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    level = float(result[0])
    return [Check(f"white is {level:.3g} W/m2 per unit of the illuminant", math.isfinite(level) and level > 1e-200)]
