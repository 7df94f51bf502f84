"""Synthetic spectral pictures of overlapping ellipses, and the conversion of a spectral picture to
sRGB with noise.
"""

from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional as F

from neusee.nodes import Check, node
from neusee.nodes.precision import single
from neusee.nodes.spectra._cie_tables import daylight, light, to_srgb
from neusee.nodes.units import Fraction, Shape
from neusee.nodes.values import Bands

#: samples per pixel along each axis, so that a pixel on an edge mixes spectra
_SAMPLES_PER_PIXEL = 2
#: spacing in pixels of the random numbers from which texture and shade are interpolated
_TEXTURE_PIXELS = 8
_WARMEST_DAYLIGHT, _COOLEST_DAYLIGHT, _DAYLIGHT_COUNT = (
    4000.0,
    15000.0,
    24,
)  #: K, K, and the number of distinct daylights


@node(rtol=1e-5)
def leaves(
    spectra: Tensor,
    bands: Bands,
    *,
    shape: Shape,
    smallest: Annotated[float, Field(ge=0.5, le=1e6)] = 2.0,
    darkest: Annotated[float, Field(gt=0, le=1)] = 0.1,
    texture: Fraction = 0.3,
    shade: Fraction = 0.5,
    daylights: Fraction = 0.2,
    rng: torch.Generator,
) -> Tensor:
    """Draw a "dead leaves" picture: overlapping ellipses (leaves) of random size, each with one
    spectrum.

    The picture has statistics similar to those of photographs. Radii range from `smallest` to half
    the picture, with a density that falls with the inverse cube of the radius. The brightness of a
    leaf is log-uniform from `darkest` to 1. Up to a share `texture` of another spectrum is mixed
    in, and up to a share `shade` of the light is removed; both shares vary smoothly. A share
    `daylights` of the pictures is lit by another daylight but keeps the white balance of D65.

    Shapes: spectra (leaf, band), the first leaf behind all others -> (band, y, x) float32.
    Units:  `smallest` pixels; reflectance under D65, in [0, 1]: another daylight is scaled to
            exceed D65 in no band.
    Error:  edges from four samples per pixel; daylights at 24 temperatures from 4000 to 15 000 K.
    Raises: ValueError where spectra and bands differ in the number of bands.
    Source: Lee, Mumford and Huang, Int. J. Comput. Vis. 41, 35 (2001).
    """
    if spectra.ndim != 2 or spectra.shape[1] != len(bands.centres):
        raise ValueError(
            f"spectra have shape {tuple(spectra.shape)}, not (leaf, band) with {len(bands.centres)}"
            " bands: compute spectra and bands from the same `bands` step"
        )
    sample_shape = (_SAMPLES_PER_PIXEL * shape[0], _SAMPLES_PER_PIXEL * shape[1])
    topmost = _topmost(len(spectra), sample_shape, _SAMPLES_PER_PIXEL * smallest, rng)
    second_leaf = torch.randint(len(spectra), (len(spectra),), generator=rng, device=rng.device)
    # log-uniform from ``darkest`` to 1
    leaf_brightness = darkest ** _uniform(rng, len(spectra))
    texture_share, shading = (
        texture * _smooth_field(sample_shape, rng),
        1.0 - shade * _smooth_field(sample_shape, rng),
    )
    leaf_spectra = (spectra.double() * _daylight_ratio(bands, daylights, rng)).float().T
    cube = (
        leaf_spectra[:, topmost] * (1.0 - texture_share)
        + leaf_spectra[:, second_leaf[topmost]] * texture_share
    )
    cube = cube * (leaf_brightness[topmost] * shading)
    return F.avg_pool2d(cube[None], _SAMPLES_PER_PIXEL)[0].clamp(0.0, 1.0)


@leaves.check
def _(result: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [
        Check(f"reflectance of the picture from {low:.3g} to {high:.3g}", 0 <= low <= high <= 1)
    ]


def _topmost(count: int, size: tuple[int, int], smallest: float, rng: torch.Generator) -> Tensor:
    """Return the index of the topmost of ``count`` random overlapping ellipses at each sample (y,
    x).
    """
    largest = max(min(size) / 2, smallest)
    uniform = _uniform(rng, count)
    # the number of leaves falls as 1 / radius^3, between the smallest and the largest
    radius = (smallest**-2 * (1 - uniform) + largest**-2 * uniform) ** -0.5
    long_radius, angle = radius * (1 + _uniform(rng, count)), torch.pi * _uniform(rng, count)
    y_from_centre, x_from_centre = (
        torch.arange(n, device=rng.device) - (n * _uniform(rng, count))[:, None] for n in size
    )
    cosine, sine = angle.cos()[:, None, None], angle.sin()[:, None, None]
    long_axis, short_axis = (
        cosine * x_from_centre[:, None] + sine * y_from_centre[:, :, None],
        cosine * y_from_centre[:, :, None] - sine * x_from_centre[:, None],
    )
    inside = (long_axis / long_radius[:, None, None]) ** 2 + (
        short_axis / radius[:, None, None]
    ) ** 2 < 1
    number = torch.arange(count, device=rng.device)[:, None, None]
    return (inside * number).amax(0)


def _smooth_field(size: tuple[int, int], rng: torch.Generator) -> Tensor:
    """Return a random field (y, x) from 0 to 1 that varies slowly over the picture."""
    grid_shape = (
        max(2, size[0] // (_SAMPLES_PER_PIXEL * _TEXTURE_PIXELS)),
        max(2, size[1] // (_SAMPLES_PER_PIXEL * _TEXTURE_PIXELS)),
    )
    grid = torch.rand(1, 1, *grid_shape, generator=rng, device=rng.device)
    return F.interpolate(grid, size, mode="bilinear", align_corners=True)[0, 0]


def _daylight_ratio(bands: Bands, share: float, rng: torch.Generator) -> Tensor:
    """Return the ratio of a random daylight spectrum to D65 in each band, scaled to a maximum of
    1.
    """
    chance, light_fraction = torch.rand(2, generator=rng, device=rng.device).tolist()
    centres = bands.centres
    if chance >= share:
        return torch.ones_like(centres)
    # uniform in 1 / temperature, which is perceptually more even
    per_kelvin = 1 / _WARMEST_DAYLIGHT + (1 / _COOLEST_DAYLIGHT - 1 / _WARMEST_DAYLIGHT) * int(
        light_fraction * _DAYLIGHT_COUNT
    ) / (_DAYLIGHT_COUNT - 1)
    ratio = daylight(1 / per_kelvin).at(centres)[0] / light("D65").at(centres)[0]
    return (ratio / ratio.max()).to(centres)


def _uniform(rng: torch.Generator, count: int) -> Tensor:
    """Return ``count`` random numbers from 0 to 1, uniform."""
    return torch.rand(count, generator=rng, device=rng.device)


# --- rendering and noise --------------------------------------------------------------------------

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
