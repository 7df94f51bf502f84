"""The image of a scene, summed over its bands before it is formed: few planes in, few out."""

from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.optics._image import Border, image
from neusee.nodes.values import Channels, Mixture, Psf

Share = Annotated[float, Field(ge=0, allow_inf_nan=False)]  #: of the brightest pixel


@node(rtol=1e-5)
def image_channels(
    radiance: Mixture, psf: Psf, rows: Tensor, *, border: Border = "zero", within: Share = 0.0
) -> Channels:
    """Sum the bands of the image by each row of weights, convolving planes and summed kernels in place of bands.

    Shapes: radiance k planes (y, x), psf.intensity (band, any, any), rows (row, band) -> planes (row, y, x).
    Units:  those of the radiance times those of the rows.
    Error:  `bound`, in parts of the brightest pixel of each row.
    Raises: ValueError where scene, PSF and rows have different bands.
    Source: linearity of incoherent imaging, Goodman, Introduction to Fourier Optics, 4th ed., ch. 7.
    """
    cube = torch.tensordot(radiance.basis.to(radiance.planes), radiance.planes, 1)
    bands = image(cube, psf, border=border)
    planes = torch.tensordot(rows.to(bands), bands, 1)
    most = planes.detach().abs().amax((-2, -1)).double()
    passed = psf.intensity.detach().abs().sum((-2, -1), dtype=torch.float64)
    off = rows.double().abs() @ (radiance.rest[-1] * passed)
    bound = torch.where(off > 0, off / most, 0.0).amax() + 1e-6
    return Channels(planes, rows.double(), bands.sum(-1).sum(-1, dtype=torch.float64), bound)


@image_channels.reference
def _(radiance: Mixture, psf: Psf, rows: Tensor, *, border: Border = "zero", within: float = 0.0) -> Channels:
    assert image.ref is not None
    cube = torch.tensordot(radiance.basis.double(), radiance.planes.double(), 1)
    bands = image.ref(cube, psf, border=border)
    zero = torch.zeros((), dtype=torch.float64)
    return Channels(torch.tensordot(rows.double(), bands, 1), rows.double(), bands.sum((-2, -1)), zero)


@image_channels.check
def _(result: Channels, *inputs: Any, **params: Any) -> list[Check]:
    return [Check(f"{len(result.planes)} rows of {len(result.flux)} bands, within {float(result.bound):.2g}")]


@image_channels.deviates
def _(result: Channels) -> tuple[float, float]:
    return float(result.bound), float(result.bound)


image.collapsed = image_channels
