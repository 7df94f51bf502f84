"""Conversion of digital numbers to electrons and to colour: colour matrix and white level."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ErrorBound, TensorStats, node
from neusee.nodes.precision import single
from neusee.nodes.restore.inverse._masked_blur import effective_psf
from neusee.nodes.scene._picture_changes import luminance
from neusee.nodes.sensor._digitization import Bits, is_clipped
from neusee.nodes.sensor._exposure import channel_weights
from neusee.nodes.sensor._saturation import Well, refuse_without_steps
from neusee.nodes.spectra._cie_tables import paints, to_srgb
from neusee.nodes.units import Efficiency, Electrons, Exposure, Gain, PixelPitch
from neusee.nodes.values import Bands, MeasuredPsf, Psf

# --- electrons and colour -------------------------------------------------------------------------

# Nodes that convert digital numbers to electrons, and electrons to colour.


Brightness = Annotated[float, Field(gt=0, le=1e18)]
#: relative error of the colours over that of the channels, for errors that are proportional to the
#: light
_GAIN = 2.0
#: brightest colour over (largest matrix element times brightest channel): 0.25 to 0.6 in shipped
#: recipes
_BRIGHTEST = 0.5


@node()
def electrons(
    raw: Tensor,
    *,
    gain: Gain,
    offset: Electrons,
    offset_subtracted: bool = True,
) -> Tensor:
    """Convert digital numbers to electrons: undo the gain of the sensor and subtract its offset.

    Shapes: raw (..., y, x) -> (..., y, x).
    Units:  raw DN; gain K, DN/e-; offset e-; result e-, negative where read noise was negative.
    Error:  the rounding of the converter, 0.29 DN rms; clipped pixels stay clipped. The quotient
            itself is float32, within 1.2e-7 of raw / gain.
    Source: NeuSee, Eq. (SensorImage), inverted.
    """
    return single(raw) / gain - (offset if offset_subtracted else 0.0)


@electrons.preflight
def _(*, offset: float, offset_subtracted: bool = True, **params: object) -> list[str]:
    if offset and not offset_subtracted:
        return [
            f"an offset of {offset:g} e- stays in the picture: set offset_subtracted: true to"
            " remove the offset"
        ]
    return []


@electrons.propagate_error
def _(raw: ErrorBound, *, gain: float, **params: Any) -> float:
    return raw.rms / gain


@electrons.expected_range
def _(
    raw: TensorStats, *_: Any, gain: float, offset: float, offset_subtracted: bool
) -> tuple[float, float]:
    low, high = (end / gain - (offset if offset_subtracted else 0.0) for end in (raw.min, raw.max))
    return low, high


@node(rtol=0.0)
def clipped(raw: Tensor, *, full_well: Well, gain: Gain, bits: Bits = 16) -> Tensor:
    """Mark clipped pixels, which reach the full well or the largest digital number of the
    converter.

    Shapes: raw (..., y, x) -> (..., y, x) bool.
    Units:  raw DN.
    Error:  a value within one DN of the full well is marked too, and so is what is not a number
            (NaN).
    Source: NeuSee, Eq. (SensorImage).
    """
    return is_clipped(raw, full_well=full_well, gain=gain, bits=bits)


@clipped.preflight
def _(*, full_well: float, gain: float, bits: int = 16, **params: object) -> list[str]:
    refuse_without_steps(full_well, gain=gain, bits=bits)
    return []


@node()
def colour(channels: Tensor, matrix: Tensor, *, brightness: Brightness = 1.0) -> Tensor:
    """Convert the channels of the sensor to linear sRGB by a colour matrix.

    ``brightness`` multiplies the picture: 1 over the share of the light that a filter passes gives
    a picture behind this filter an exposure of its own.

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
    flat = brightness * matrix.to(channels) @ channels.flatten(-2)
    return flat.reshape(*flat.shape[:-1], *channels.shape[-2:])


@colour.reference
def _(channels: Tensor, matrix: Tensor, *, brightness: float = 1.0) -> Tensor:
    return brightness * torch.stack(
        [
            sum(m * c for m, c in zip(row, channels.double().unbind(-3), strict=True))
            for row in matrix
        ],
        -3,
    )


@colour.propagate_error
def _(channels: ErrorBound, matrix: ErrorBound, *, result: TensorStats, **params: Any) -> float:
    """Return an estimate of the error (not a bound): the relative errors of channels, doubled, and
    matrix, times the brightest element.

    Errors of the light are similar in all channels, so that the matrix amplifies them as much as
    the light. The error of the matrix is one factor for the whole picture.
    """
    return (_GAIN * channels.share + matrix.share) * max(abs(result.min), abs(result.max))


colour.hooks.estimated = True


@colour.propagate_scattered
def _(
    channels: ErrorBound,
    matrix: ErrorBound,
    *,
    result: TensorStats,
    brightness: float = 1.0,
    **params: Any,
) -> float:
    """Return an error bound for noise in the channels: the matrix amplifies noise by at most its
    Frobenius norm.
    """
    if channels.stats is None or matrix.stats is None:
        return math.inf
    # Frobenius norm = rms element * sqrt(3 * channels); rms over 3 colours instead of the channels
    # gives a further sqrt(channels / 3): together the number of channels
    return (
        brightness * matrix.stats.shape[-1] * (matrix.stats.largest_rms + matrix.rms) * channels.rms
    )


@colour.expected_range
def _(
    channels: TensorStats, matrix: TensorStats, *, brightness: float = 1.0
) -> tuple[float, float]:
    """Return the range from 0 to the brightest colour that is usual for photographs in daylight,
    from the largest elements of matrix and channels.
    """
    return 0.0, brightness * _BRIGHTEST * max(channels.max, -channels.min) * max(
        matrix.max, -matrix.min
    )


# --- colour matrix --------------------------------------------------------------------------------

# The colour matrix, which converts the electrons of the channels to the colour that the scene has
# in daylight.


@node(rtol=1e-9)
def colour_matrix(
    bands: Bands,
    illuminant: Tensor,
    responses: Tensor,
    level: Tensor,
    *,
    pixel_pitch: PixelPitch,
    exposure: Exposure,
    quantum_efficiency: Efficiency,
) -> Tensor:
    """Compute the matrix from electrons to linear sRGB with the least mean square error over
    measured paints.

    Linear least mean square over the reflectances s of colour charts, C = E[s s^T]: M = T C A^T (A
    C A^T)^-1, where A s are the electrons under this illuminant and T s is the linear sRGB under
    D65. The matrix includes white balance. A sensor with a single channel sees no colour: T s is
    the luminance then, equal in red, green and blue.

    Shapes: bands, illuminant, level (band,), responses (channel, band) -> (3, channel) float64.
    Units:  linear sRGB per electron.
    Error:  metamerism: rms 0.01 to 0.05 on the charts, depending on the channels; larger for
            saturated lights. The light of the scene is assumed to be reflected once.
    Raises: ValueError where the bands of the inputs differ.
    Source: Wiener estimation as in Pratt and Mancill, Appl. Opt. 15, 73 (1976); charts of
            colour-science.
    """
    spectra = _paints(bands.centres)
    # least squares over paints: electrons A s, colour T s, with C = mean of s s^T
    spectra_products = spectra.T @ spectra / len(spectra)
    pixel = {"pixel_pitch": pixel_pitch, "exposure": exposure}
    counts = _counts(bands, illuminant, responses, level, quantum_efficiency, **pixel)
    rgb = _target(bands.centres, len(counts))
    count_products = counts @ spectra_products @ counts.T
    # a small ridge: the system is singular if two channels have the same response
    ridge = (1e-12 * count_products.diagonal().mean()).clamp_min(1e-200) * torch.eye(
        len(count_products), dtype=torch.float64
    )
    matrix: Tensor = torch.linalg.solve(count_products + ridge, counts @ spectra_products @ rgb.T).T
    return matrix


@colour_matrix.check
def _(result: Tensor, *inputs: Any, **params: float) -> list[Check]:
    bands, illuminant, responses, level = inputs
    spectra = _paints(bands.centres)
    counts = _counts(bands, illuminant, responses, level, **params)
    rms_error = (
        (spectra @ counts.T @ result.T - spectra @ _target(bands.centres, len(result[0])).T)
        .square()
        .mean()
        .sqrt()
    )
    quantity = "colour" if len(result[0]) > 1 else "luminance"
    return [
        Check(
            f"rms {quantity} error {float(rms_error):.3f} on colour charts", float(rms_error) < 0.1
        )
    ]


@colour_matrix.propagate_error
def _(
    bands: ErrorBound,
    illuminant: ErrorBound,
    responses: ErrorBound,
    level: ErrorBound,
    **params: Any,
) -> float:
    """Return an error bound of the matrix, which is inversely proportional to the input `level`.

    There is no bound if the error of the level may differ from band to band.
    """
    result: TensorStats = params["result"]
    if any(bound.rms for bound in (bands, illuminant, responses)) or level.share >= 1.0:
        return math.inf
    if level.rms and (level.stats is None or level.stats.min < level.stats.max):
        return math.inf
    return level.share / (1.0 - level.share) * result.largest_rms


@colour_matrix.expected_range
def _(*inputs: Any, **params: Any) -> tuple[float, float]:
    """Return a nominal range of the elements; only the ratio of a colour to the largest element
    matters.
    """
    return 0.0, 1.0


def _target(centres: Tensor, channels: int) -> Tensor:
    """Return the matrix (3, band) from reflectance to linear sRGB; for a sensor with one channel,
    to luminance in all three colours.
    """
    rgb = to_srgb(centres)
    return rgb if channels > 1 else luminance(rgb, 0).expand(3, -1)


def _counts(
    bands: Bands,
    illuminant: Tensor,
    responses: Tensor,
    level: Tensor,
    quantum_efficiency: float,
    **pixel: float,
) -> Tensor:
    """Return the electrons (channel, band) of each channel for reflectance 1 in each band, on the
    CPU.
    """
    band_light = level.cpu().double() * illuminant.cpu().double()
    weights = channel_weights(bands, responses.cpu(), band_light, **pixel)
    return weights * quantum_efficiency


def _paints(centres: Tensor) -> Tensor:
    """Return the reflectances of the colour charts at the wavelengths ``centres``: (paint, band)
    float64.
    """
    return torch.cat([paint.at(centres) for paint in paints()])


# --- white level ----------------------------------------------------------------------------------

# The light level of a frame of an unknown scene: how bright a white surface would be.


White = Annotated[float, Field(ge=1e-30, le=1e30)]
_WHITE_QUANTILE = 0.995  #: quantile of the unclipped pixels that counts as white
_QUANTILE_PIXELS = 2**22  #: approximate number of pixels from which the quantile is estimated


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
    """Compute the level of the light in a frame of an unknown scene, so that
    `restore.colour_matrix` knows its white.

    A white surface gives ``white`` full wells in the brightest channel. Without ``white``, a
    quantile counts as white: in the channels of the ``restored`` picture, that of 99.5 % of the
    unclipped pixels by their brightest colour, so that 0.5 % of these pixels are brighter than 1 in
    the picture; without it, that of the frame by its brightest channel. This choice sets how bright
    the picture is shown and nothing else.

    Shapes: signal, clipped and restored (channel, y, x), psf (band,) or measured, illuminant
            (band,), responses (channel, band) -> (band,) float64.
    Units:  signal and restored e-; white full wells; result W/m2 per unit of the illuminant, as
            `sensor.level`.
    Error:  a choice, not a measurement: a scene without white is shown too bright. In the frame a
            blurred scene is darker than it is, so that its restored picture would be shown too
            bright.
    Raises: ValueError where bands or channels differ.
    Source: white-patch assumption, Land and McCann, J. Opt. Soc. Am. 61, 1 (1971), with a quantile
            for the maximum.
    """
    equal_energy = torch.ones(len(bands.centres), dtype=torch.float64)
    equal_light = equal_energy * illuminant.cpu().double()
    weights = channel_weights(
        bands, responses.cpu(), equal_light, pixel_pitch=pixel_pitch, exposure=exposure
    )
    electrons_of_white = weights.sum(-1) * quantum_efficiency
    # stated by the user: white gives this many full wells in the most sensitive channel
    if white is not None:
        return equal_energy * (white * full_well / float(electrons_of_white.max()))
    # brightness from the colours of the restored picture; without one, from the channels of the
    # frame, each relative to its electrons for white
    if restored is not None:
        light_of = {
            "pixel_pitch": pixel_pitch,
            "exposure": exposure,
            "quantum_efficiency": quantum_efficiency,
        }
        matrix = colour_matrix(bands, illuminant, responses, equal_energy, **light_of)
        brightness = (matrix.to(restored.device) @ single(restored).double().flatten(-2)).amax(-2)
        return equal_energy * _bright_quantile(brightness.reshape(restored.shape[-2:]), clipped)
    psf_sum = _passed(psf, bands, illuminant, responses)
    white_counts = (electrons_of_white * psf_sum).clamp_min(1e-300).to(signal.device)
    return equal_energy * _bright_quantile(
        (single(signal).double() / white_counts[:, None, None]).amax(-3), clipped
    )


def _bright_quantile(brightness: Tensor, clipped: Tensor) -> Tensor:
    """Return the quantile of brightness (y, x) that counts as white, over the unclipped pixels, or
    over all pixels if all are clipped.
    """
    unclipped = ~clipped.any(-3)
    pixels = brightness[unclipped] if bool(unclipped.any()) else brightness.flatten()
    sample = pixels[:: max(1, len(pixels) // _QUANTILE_PIXELS)]
    return torch.quantile(sample, _WHITE_QUANTILE).clamp_min(1e-300).cpu()


def _passed(psf: Psf | MeasuredPsf, bands: Bands, illuminant: Tensor, responses: Tensor) -> Tensor:
    """Return the sum (channel,) of the PSF of each channel: the fraction of the light in its
    window; 1 for a measured PSF.
    """
    if isinstance(psf, MeasuredPsf):
        return torch.ones(len(responses), dtype=torch.float64)
    return effective_psf(psf, illuminant, responses, bands).sum((-2, -1)).double().cpu()


@white_level.check
def _(result: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    level = float(result[0])
    return [
        Check(
            f"white is {level:.3g} W/m2 per unit of the illuminant",
            math.isfinite(level) and level > 1e-200,
        )
    ]
