"""Dazzled pixels of a picture: those that a laser saturates, and those where its light veils a stated feature."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes import Check, node
from neusee.nodes._half_precision import refuse_not_finite
from neusee.nodes.laser._dazzle_area import Rule, veil_limit
from neusee.nodes.sensor._digitization import crop
from neusee.nodes.sensor._room_for_light import refuse_without_room
from neusee.nodes.sensor._saturation import Efficiency, Well
from neusee.nodes.torch_func import transformed
from neusee.nodes.units import Count, Electrons, Ratio, Shape


class Dazzle(NamedTuple):
    """The pixels that a laser takes from a picture; pixels that are lost without it are not counted."""

    saturated: Tensor  #: () float64, pixels with a channel that the laser fills
    veiled: Tensor  #: () float64, other pixels at which the laser's light hides the feature in every channel
    share: Tensor  #: () float64, both, relative to all pixels
    visible: Tensor  #: () float64, share of all pixels at which the feature is visible without the laser


@node(rtol=1e-6)
def dazzle(
    photons: Tensor,
    lasers: list[Tensor] | None = None,
    ghosts: list[Tensor] | None = None,
    *,
    shape: Shape,
    full_well: Well,
    quantum_efficiency: Efficiency,
    read_noise: Electrons,
    offset: Electrons = 0.0,
    feature: Count = 10,
    contrast: Ratio = 0.2,
    rule: Rule = "snr",
    threshold: Ratio = 5.0,
) -> Dazzle:
    """Count the pixels that lasers saturate, and those where their light hides a feature of a stated size and contrast.

    The feature covers ``feature`` x ``feature`` pixels and differs by the Weber contrast C from the scene, whose
    mean over these pixels is its background n. The mean of the laser's light over them is the veil v. Rule `snr`: the
    feature is visible where C n sqrt(A) / sqrt(n + v + sigma^2) is at least ``threshold`` (5 is Rose's criterion); rule
    `contrast`: where C n / (n + v) is. One channel that shows it is enough.

    Shapes: photons of the scene (channel, y, x), each laser and ghost the same -> four scalars, float64.
    Units:  photons, electrons and pixels.
    Error:  mean numbers without noise; 1e-6 of a threshold, so that a pixel there may fall on either side. Patterns of
            the sensor under the veil (PRNU) and the search of a viewer are left out.
    Raises: ValueError for light that is not finite.
    Source: Rose, J. Opt. Soc. Am. 38, 196 (1948), for the threshold 5; Weber contrast by definition.
    """
    scene = crop(photons.detach(), shape=shape).double() * quantum_efficiency
    veil = torch.zeros_like(scene)
    for light in (*(lasers or ()), *(ghosts or ())):
        veil += crop(light.detach(), shape=shape).double() * quantum_efficiency
    if not transformed():
        refuse_not_finite("its dazzled pixels cannot be counted", photons=scene.sum(), laser=veil.sum())
    room = full_well - offset
    lost, filled = (scene >= room).any(-3), (scene + veil >= room).any(-3)
    background, mean = _over_feature(scene, feature), _over_feature(veil, feature)
    most = veil_limit(
        background, contrast=contrast, feature=feature, threshold=threshold, rule=rule, read_noise=read_noise
    )
    visible = (most >= 0).any(-3) & ~lost
    saturated = filled & ~lost
    veiled = visible & ~filled & ~(mean <= most).any(-3)
    pixels = visible.numel()
    counts = [x.sum().double() for x in (saturated, veiled, visible)]
    return Dazzle(counts[0], counts[1], (counts[0] + counts[1]) / pixels, counts[2] / pixels)


def _over_feature(image: Tensor, size: int) -> Tensor:
    """Return the mean of an image (channel, y, x) over a square of ``size`` pixels around each pixel."""
    rows, columns = image.shape[-2:]
    mean, half = image[None], size // 2
    for window, padding in (((size, 1), (half, 0)), ((1, size), (0, half))):
        mean = avg_pool2d(mean, window, stride=1, padding=padding, count_include_pad=False)
    return mean[0, ..., :rows, :columns]


@dazzle.preflight
def _(*, full_well: float, offset: float = 0.0, read_noise: float, **params: object) -> list[str]:
    refuse_without_room(full_well, offset=offset, read_noise=read_noise)
    return []


@dazzle.check
def _(result: Dazzle, *inputs: Any, **params: Any) -> list[Check]:
    text = f"the laser saturates {int(result.saturated)} pixels and veils {int(result.veiled)} more"
    return [Check(f"{text}, {float(result.share):.2%} of the picture together", bool(torch.isfinite(result.share)))]
