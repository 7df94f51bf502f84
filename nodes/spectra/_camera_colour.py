"""Conversion of reflectance spectra to sRGB, and simulated camera noise for a picture."""

from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.precision import single
from neusee.nodes.spectra._cie_tables import to_srgb
from neusee.nodes.values import Bands

GrainDeviation = Annotated[float, Field(ge=0, le=1)]


@node(rtol=1e-5)
def render(reflectance: Tensor, bands: Bands) -> Tensor:
    """Convert reflectance spectra, lit by the illuminant D65, to linear sRGB with the CIE 1931
    observer.

    Shapes: reflectance (..., band, y, x) -> (..., 3, y, x).
    Units:  reflectance to linear sRGB; white is (1, 1, 1) on exactly these bands (on 31 bands,
            `sd_to_XYZ` of colour-science tints white by 2e-4), and a colour outside sRGB has a
            negative value.
    Error:  float32: 1e-6 of the brightest value; 31 bands shift saturated colours by some 1e-3 from
            5 nm sampling.
    Raises: ValueError where reflectance and bands differ in the number of bands.
    Source: CIE 15:2004; IEC 61966-2-1.
    """
    if reflectance.ndim < 3 or reflectance.shape[-3] != len(bands.centres):
        raise ValueError(
            f"reflectance has shape {tuple(reflectance.shape)}, not (band, y, x) with"
            f" {len(bands.centres)} bands: compute reflectance and bands from the same `bands` step"
        )
    light = single(reflectance)
    return torch.einsum("cb,...byx->...cyx", to_srgb(bands.centres).to(light), light)


@render.reference
def _(reflectance: Tensor, bands: Bands) -> Tensor:
    matrix = to_srgb(bands.centres).to(reflectance.device)
    rendered = matrix @ reflectance.double().flatten(-2)
    return rendered.reshape(*rendered.shape[:-1], *reflectance.shape[-2:])


@render.check
def _(result: Tensor, *inputs: Any) -> list[Check]:
    return [
        Check(f"linear sRGB values from {float(result.min()):.3g} to {float(result.max()):.3g}")
    ]


@node(rtol=1e-5)
def grain(
    picture: Tensor,
    *,
    read: GrainDeviation = 1e-3,
    shot: GrainDeviation = 2e-3,
    rng: torch.Generator,
) -> Tensor:
    """Add camera noise to a picture: Gaussian noise with a variance that rises linearly with the
    light.

    Shapes: picture (..., y, x) -> the same.
    Units:  the units of the picture; standard deviation `read` in the dark, sqrt(read^2 + shot^2)
            at 1.
    Error:  the channels are independent, whereas a colour matrix would correlate them; quantisation
            and blooming are left out.
    Source: EMVA Standard 1288, release 4.0 Linear, section 2 (variance linear in the mean).
    """
    picture = single(picture)
    normal = torch.randn(picture.shape, generator=rng, device=rng.device, dtype=torch.float32).to(
        picture
    )
    return picture + normal * (read**2 + shot**2 * picture.clamp_min(0)).sqrt()


@grain.check
def _(result: Tensor, picture: Tensor, **params: Any) -> list[Check]:
    return [Check(f"the rms of the added camera noise is {float((result - picture).std()):.3g}")]
