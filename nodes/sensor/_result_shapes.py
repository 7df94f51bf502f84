"""Shapes of the results of the sensor nodes."""

from typing import Any

from torch import Tensor

from neusee.nodes.sensor._digitization import crop, digitize, full_well
from neusee.nodes.sensor._exposure import add_photons, expose, level
from neusee.nodes.sensor._frame_file import frame
from neusee.nodes.sensor._noise import dark_current, photon_noise, read_noise
from neusee.nodes.sensor._photon_transfer import photon_transfer
from neusee.nodes.sensor._saturation import Limits, limits, saturation
from neusee.nodes.shape_rules import at_least_single, blank, double, like_first, scalars
from neusee.nodes.values import Bands, Channels

for node in (photon_noise, dark_current, read_noise, full_well, digitize, add_photons):
    node.shape(like_first)
limits.shape(scalars(Limits))


@expose.shape
def _(
    irradiance: Tensor | Channels, bands: Bands, responses: Tensor, *level: Any, **params: Any
) -> Tensor:
    image = irradiance.planes if isinstance(irradiance, Channels) else irradiance
    return blank(*image.shape[:-3], len(responses), *image.shape[-2:], dtype=at_least_single(image))


@level.shape
def _(plain_image: Any, bands: Bands, *responses: Any, **params: Any) -> Tensor:
    return double(len(bands.centres))


@saturation.shape
def _(bands: Bands, **params: Any) -> Tensor:
    return double(len(bands.centres))


@crop.shape
def _(image: Tensor, *, shape: tuple[int, int], **params: Any) -> Tensor:
    return blank(*image.shape[:-2], *shape, dtype=image.dtype)


@photon_transfer.shape
def _(*, levels: int = 24, **params: Any) -> Tensor:
    return double(levels, 3)


@photon_transfer.work
def _(result: Tensor, *, pixels: int = 16384, **params: Any) -> tuple[float, float]:
    return 16.0 * pixels, float(len(result) * pixels)


@frame.shape
def _(responses: Tensor, *, shape: tuple[int, int], **params: Any) -> Tensor:
    return blank(len(responses), *shape)
