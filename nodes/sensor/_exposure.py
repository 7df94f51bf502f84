"""Irradiance to photons in each channel: weighted sums of bands, level, laser light."""

import math
from collections.abc import Mapping
from itertools import chain
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ErrorBound, ParameterError, TensorStats, node
from neusee.nodes.precision import refuse_not_finite, single
from neusee.nodes.sensor._saturation import Well, photons_per_joule, photons_that_fill, saturation
from neusee.nodes.units import Efficiency, Exposure, PixelPitch
from neusee.nodes.values import Bands, Channels

# --- channel sums ---------------------------------------------------------------------------------

# Weighted sums of the spectral bands of an image, computed from the bands or from stored sums.


_LARGEST_WEIGHT_ERROR = 1e-9  #: largest relative error of weights that are combined from the rows


def weighted_bands(image: Tensor | Channels, weights: Tensor) -> Tensor:
    """Multiply the spectral bands of an image by ``weights`` (..., band), and return the sum over
    the bands.

    Raises ValueError if weights and image have different numbers of bands, or if no combination of
    the channel sums gives the weights.
    """
    if isinstance(image, Channels):
        # the planes of the image are already sums over its bands
        plane_weights = _combination_of_rows(weights, image.rows).to(image.planes)
        channels: Tensor = torch.tensordot(plane_weights, image.planes, 1)
        return channels
    image = single(image)
    flat_channels = weights.to(image) @ image.flatten(-2)
    return flat_channels.reshape(*flat_channels.shape[:-1], *image.shape[-2:])


def _combination_of_rows(weights: Tensor, rows: Tensor) -> Tensor:
    """Return the matrix M with ``weights = M rows``, by least squares in float64.

    ``rows`` (row, band) are the weights by which the planes of an image were summed over its bands.
    The gradient reaches the weights. Raises ValueError if no M gives the weights.
    """
    image_rows = rows.detach().cpu().double()
    # rows are scaled, because the inverse of rows of very different size would lose precision
    row_maxima = image_rows.abs().amax(1, keepdim=True)
    inverse_rows = (
        torch.linalg.pinv(image_rows / row_maxima.where(row_maxima > 0, 1.0))
        / row_maxima.where(row_maxima > 0, 1.0).T
    )
    exact_weights = weights.cpu().double()
    if exact_weights.shape[-1] != image_rows.shape[1]:
        counts = (
            f"the weights have {exact_weights.shape[-1]} bands and the sums of the image"
            f" {image_rows.shape[1]} bands"
        )
        raise ValueError(f"{counts}: compute weights and image from the same `bands` step")
    matrix: Tensor = exact_weights @ inverse_rows
    _require_combination(exact_weights.detach(), matrix.detach() @ image_rows)
    return matrix


def _require_combination(exact: Tensor, combined: Tensor) -> None:
    """Raise ValueError unless the weights ``combined`` equal ``exact`` within 1e-9 of the
    largest weight.
    """
    errors, largest = (
        (exact - combined).abs().flatten(0, -2),
        exact.abs().flatten(0, -2).amax(-1),
    )
    if not bool((errors.amax(-1) <= _LARGEST_WEIGHT_ERROR * largest).all()):
        worst = float((errors.amax(-1) / largest.clamp_min(1e-300)).max())
        raise ValueError(
            "the image was summed over its bands with other weights: the weights of this step"
            f" differ by {worst:.2g} (relative error; at most 1e-9) from every combination of these"
            " weights: use the same `bands` and `responses` for both, with a level that is equal"
            " in all bands, or keep the image of all bands"
        )


# --- exposure -------------------------------------------------------------------------------------

# Conversion of irradiance to photons in each colour channel, scaling of the scene, and addition of
# laser light.


#: multiple of the exposure that saturates a pixel
Strength = Annotated[float, Field(ge=0, le=1e18)]


@node(accepts_channel_sums=("irradiance",), needs_band_invariant=("level",))
def expose(
    irradiance: Tensor | Channels,
    bands: Bands,
    responses: Tensor,
    level: Tensor | None = None,
    *,
    pixel_pitch: PixelPitch,
    exposure: Exposure,
) -> Tensor:
    """Compute the photons in each colour channel of each pixel from the irradiance in each band.

    Photons are the sum over the bands of r I level lambda t dx^2 / (h c), with response r and
    irradiance I. If the image has already been summed over its bands (`Channels`), the photons are
    weighted sums of its planes.

    Shapes: irradiance (..., band, y, x), responses (channel, band), level (band,) -> (..., channel,
            y, x).
    Units:  irradiance W/m2 in the whole band, or any unit if `level` is given; result photons.
    Error:  one wavelength represents its band: error below (width / wavelength)^2 / 12, 5e-5 at 10
            nm.
    Raises: ValueError if the bands of the inputs differ, or if no combination of the rows gives the
            weights.
    Source: NeuSee, Eq. (photon_count); the channel sum as EMVA Standard 1288, release 4.0, for each
            wavelength.
    """
    weights = channel_weights(bands, responses, level, pixel_pitch=pixel_pitch, exposure=exposure)
    if isinstance(irradiance, Tensor) and (
        irradiance.ndim < 3 or irradiance.shape[-3] != weights.shape[1]
    ):
        raise ValueError(
            f"irradiance has shape {tuple(irradiance.shape)}, not (band, y, x) with"
            f" {weights.shape[1]} bands: compute irradiance, bands and responses from the same"
            " `bands` step"
        )
    return weighted_bands(irradiance, weights)


@expose.reference
def _(
    irradiance: Tensor | Channels,
    bands: Bands,
    responses: Tensor,
    level: Tensor | None = None,
    **sizes: float,
) -> Tensor:
    weights = channel_weights(bands, responses, level, **sizes)
    if isinstance(irradiance, Channels):
        return weighted_bands(irradiance._replace(planes=irradiance.planes.double()), weights)
    # in float64, one channel after another
    channels = [
        (row[:, None, None] * irradiance.double()).sum(-3) for row in weights.to(irradiance.device)
    ]
    return torch.stack(channels, -3)


@expose.check
def _(result: Tensor, *inputs: object, **params: object) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [Check(f"the brightest pixel receives {high:.4g} photons", low >= -1e-3 * high)]


@expose.propagate_error
def _(
    irradiance: ErrorBound, *others: ErrorBound | None, result: TensorStats, **params: Any
) -> float:
    """Return an error bound of the photons from the relative errors of the irradiance and of the
    factor `level`, including the product of both errors.

    It holds for each channel, because the relative error of `Channels` holds for each of its rows.
    For an image in bands the error is unknown: a channel may see only the darker bands.
    """
    if irradiance.rms and irradiance.peak is None:
        return math.inf
    # the others are bands, responses and level
    level = others[2] if len(others) > 2 else None
    light_share, factor_share = irradiance.share, level.share if level else 0.0
    return (light_share + factor_share + light_share * factor_share) * max(
        abs(result.min), abs(result.max)
    )


def channel_weights(
    bands: Bands, responses: Tensor, level: Tensor | None, *, pixel_pitch: float, exposure: float
) -> Tensor:
    """Return the photons per unit of irradiance in each band for each colour channel: (channel,
    band) float64.
    """
    band_counts = {len(bands.centres), responses.shape[-1]} | (
        set() if level is None else {len(level)}
    )
    if len(band_counts) > 1:
        raise ValueError(
            f"bands {len(bands.centres)}, responses {tuple(responses.shape)}, level"
            f" {None if level is None else tuple(level.shape)} differ in the number of bands: use"
            " one step `bands`"
        )
    # photons per pixel in one exposure at 1 W/m2
    photons = photons_per_joule(bands.centres) * (exposure * pixel_pitch**2)
    weights = responses.double() * photons.to(responses.device)
    return weights if level is None else weights * level.to(weights)


@node(accepts_channel_sums=("plain_image",))
def level(
    plain_image: Tensor | Channels,
    bands: Bands,
    responses: Tensor,
    white: Tensor | None = None,
    *,
    strength: Strength | None = None,
    full_well: Well,
    quantum_efficiency: Efficiency,
    pixel_pitch: PixelPitch,
    exposure: Exposure,
    rule: Literal["channel_sum", "per_band"] = "channel_sum",
) -> Tensor:
    """Compute the factor that scales an image to irradiance, so that the brightest pixel has
    ``strength`` full wells.

    The image is that of the plain lens, without mask.

    `channel_sum`: the brightest pixel of the brightest channel holds strength x full well, summed
    over bands. `per_band`: each band alone peaks at strength x I_sat, as the paper prints; the sum
    of 31 bands overexposes. Without a strength the factor is ``white``, the irradiance of a white
    surface in lux or cd/m2.

    Shapes: plain_image (..., band, y, x), responses (channel, band), white () -> (band,) float64.
    Units:  result W/m2 per unit of the image.
    Error:  exact; a scene without light has level 0.
    Raises: ParameterError before the run where strength and white are both given, or neither;
            ValueError for `per_band` if the image has been summed over its bands, and for an image
            that is not finite.
    Source: NeuSee, Eq. (peak_irrad_coded).
    """
    if strength is None:
        if white is None or not bool(white > 0):
            raise ParameterError("strength", _UNKNOWN_BRIGHTNESS)
        planes = plain_image.planes if isinstance(plain_image, Channels) else plain_image
        refuse_not_finite(
            "no level can scale this image", plain_image=planes.amin() + planes.amax()
        )
        return white.double().expand(len(bands.centres)).clone()
    if rule == "per_band":
        if isinstance(plain_image, Channels):
            raise ValueError(
                "rule per_band needs the peak of each band, but this image is summed over its"
                " bands: use rule channel_sum, or keep the image of all bands"
            )
        # the peak of each band, over all pictures of a batch
        peaks = plain_image.amax((-2, -1)).reshape(-1, len(bands.centres)).amax(0).double()
        sensor = {"full_well": full_well, "quantum_efficiency": quantum_efficiency}
        full_pixel = saturation(bands, **sensor, pixel_pitch=pixel_pitch, exposure=exposure)
    else:
        photons: Tensor = expose(
            plain_image, bands, responses, pixel_pitch=pixel_pitch, exposure=exposure
        )
        peaks = photons.amax().double().expand(len(bands.centres))
        full_pixel = torch.tensor(
            photons_that_fill(full_well, quantum_efficiency), dtype=torch.float64
        )
    refuse_not_finite("no level can scale this image", plain_image=peaks)
    has_light = peaks > 0
    # without light the factor is 0, and nothing is divided by 0
    return torch.where(
        has_light, strength * full_pixel.to(peaks) / peaks.where(has_light, 1.0), 0.0
    )


_UNKNOWN_BRIGHTNESS = (
    "the brightness of the scene is not known: give sensor.background, scene.illuminance or"
    " scene.luminance"
)


@level.band_invariant
def _(params: Mapping[str, Any]) -> bool:
    return bool(params.get("rule", "channel_sum") == "channel_sum")


@level.propagate_error
def _(plain_image: ErrorBound, *others: object, result: TensorStats, **params: Any) -> float:
    """Return an error bound of the scale factor `level` from the error of the brightest pixel of
    the image.

    The brightest pixels of single bands may have a larger error.
    """
    if params["strength"] is None:
        return 0.0
    if params.get("rule", "channel_sum") == "per_band":
        return math.inf
    share = plain_image.largest
    return result.max * share / (1.0 - share) if share < 1.0 else math.inf


@level.preflight
def _(
    *,
    white: Tensor | None = None,
    strength: float | None = None,
    rule: str = "channel_sum",
    **params: object,
) -> list[str]:
    has_brightness = white is not None and (white.is_meta or float(white) > 0)
    if strength is None:
        if not has_brightness:
            raise ParameterError("strength", _UNKNOWN_BRIGHTNESS)
        if rule == "per_band":
            raise ParameterError(
                "rule", "lux and cd/m2 are sums over the bands: use rule channel_sum"
            )
        return []
    if has_brightness:
        text = (
            "the brightness of the scene is stated twice, here and in lux or cd/m2: write"
            " sensor.background=null"
        )
        raise ParameterError(
            "strength", f"{text}, or leave scene.illuminance and scene.luminance out"
        )
    notes = (
        [f"background of {strength:g} full wells saturates the plain lens without any laser"]
        if strength > 1
        else []
    )
    return notes + (["rule per_band: each band alone fills the well"] if rule == "per_band" else [])


@node(rtol=1e-6, additive_inputs=[("lasers",), ("ghosts",)])
def add_photons(
    photons: Tensor, lasers: list[Tensor] | None = None, ghosts: list[Tensor] | None = None
) -> Tensor:
    """Add the photons of the scene, of every laser and of every ghost image, which are mutually
    incoherent.

    Shapes: photons (..., channel, y, x), each laser and ghost the same -> (..., channel, y, x).
    Units:  photons.
    Error:  float32: 6e-8 of the sum. Half precision ends at 65504, so photons in half precision are
            added in float32.
    Raises: ValueError if a shape differs.
    Source: NeuSee, Eq. (photon_count).
    """
    sum_of_photons = single(photons)
    for laser_light in chain(lasers or (), ghosts or ()):
        if laser_light.shape[-3:] != photons.shape[-3:]:
            raise ValueError(
                f"laser light of shape {tuple(laser_light.shape)} cannot be added to a scene of"
                f" {tuple(photons.shape)}: give laser and scene the same `shape`"
            )
        sum_of_photons = sum_of_photons + laser_light
    return sum_of_photons


@add_photons.propagate_error
def _(photons: ErrorBound, *added: list[ErrorBound] | None, **params: Any) -> float:
    return math.fsum(error.rms for error in (photons, *chain.from_iterable(filter(None, added))))


@add_photons.check
def _(result: Tensor, photons: Tensor, *others: object, **params: object) -> list[Check]:
    scene, high = float(photons.max()), float(result.max())
    return [
        Check(
            f"the brightest pixel receives {high:.4g} photons, and {scene:.4g} from the scene"
            " alone",
            high >= 0,
        )
    ]


@expose.zero_bound
def _(
    irradiance: TensorStats,
    bands: TensorStats,
    responses: TensorStats,
    level: TensorStats | None = None,
    *,
    pixel_pitch: float,
    exposure: float,
) -> float:
    """Return an upper bound of the photons in a pixel, from the largest irradiance and the largest
    response.

    The bound is exact for a single band.
    """
    brightest = max(irradiance.max, -irradiance.min)
    if brightest == 0:
        return 0.0
    photons = (
        float(photons_per_joule(torch.tensor(bands.max, dtype=torch.float64)))
        * exposure
        * pixel_pitch**2
    )
    return (
        photons * bands.shape[0] * responses.max * brightest * (1.0 if level is None else level.max)
    )
