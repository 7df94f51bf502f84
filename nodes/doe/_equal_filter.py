"""The grey filter that protects the sensor as well as a mask does: the rival that anyone can buy."""

import math
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, ErrorBound, TensorStats, node
from neusee.nodes._half_precision import single
from neusee.nodes.values import Bands


@node(rtol=1e-6)
def equal_filter(light: Tensor, lsr: Tensor, bands: Bands, lines: list[Bands] | None = None) -> Tensor:
    """Weaken light by the grey filter behind which every laser is at least as weak as behind a mask.

    The transmittance of the filter is the laser suppression ratio of the mask at the wavelength of the laser, and of
    several lasers the largest of these; without a laser, the largest ratio of all bands. It is at most 1. The filter
    scales the irradiance and the photons of a clear lens, and needs no point-spread function of its own.

    Shapes: light (any), lsr (band,), bands (band,), each line (line band,) -> as light.
    Units:  result as light, irradiance or photons; lsr none.
    Error:  float32: 6e-8 of the light. The ratio is that of the band nearest to the mean wavelength of the laser.
    Raises: ValueError where ratios and bands differ in number.
    Source: by definition of the laser suppression ratio: NeuSee, section Sensor Image.
    """
    light = single(light)
    return light * transmittance(lsr, bands, lines).to(light)


@equal_filter.propagate_error
def _(light: ErrorBound, *others: ErrorBound | None, result: TensorStats, **params: Any) -> float:
    """Return an error bound from the relative error of the light and the error of the ratio.

    The filter takes the ratio of one band, which may have all of the error of the ratios. The two errors multiply too.
    """
    ratio = others[0] if others else None
    if light.stats is None or (ratio is not None and ratio.rms and ratio.stats is None):
        return math.inf
    largest = max(abs(result.min), abs(result.max))
    passed = largest / light.top if light.top > 0 else 1.0
    off = ratio.rms * math.sqrt(math.prod(ratio.stats.shape)) if ratio and ratio.stats else 0.0
    return light.rms * (passed + off) + off * light.top


@equal_filter.check
def _(result: Tensor, light: Tensor, lsr: Tensor, bands: Bands, lines: Any = None, **params: Any) -> list[Check]:
    share = float(transmittance(lsr, bands, lines))
    return [Check(f"a grey filter that passes {share:.3g} of the light", share > 0)]


def transmittance(lsr: Tensor, bands: Bands, lines: list[Bands] | None) -> Tensor:
    """Return the share of the light () that the filter passes."""
    if len(lsr) != len(bands.centres):
        raise ValueError(f"{len(lsr)} ratios and {len(bands.centres)} bands: compute the ratios from the same `bands`")
    found = lsr
    if lines:
        middles = torch.stack([(line.centres * line.weights).sum() / line.weights.sum() for line in lines])
        found = lsr[(middles[:, None] - bands.centres).abs().argmin(-1).to(lsr.device)]
    return found.amax().clamp(max=1.0)
