"""Limits of a sensor: saturation, range between dark signal and full well, dynamic range."""

import math
from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.constants import PLANCK, SPEED_OF_LIGHT
from neusee.nodes.units import Efficiency, Electrons, Exposure, PixelPitch
from neusee.nodes.values import Bands

# --- saturation -----------------------------------------------------------------------------------

# Saturation irradiance of a sensor, and the photons that fill a pixel.


Well = Annotated[Electrons, Field(ge=1)]  #: electrons that fill a pixel


def photons_per_joule(centres: Tensor) -> Tensor:
    """Return the number of photons in one joule of light of each wavelength: wavelength / (h c)."""
    return centres.double() / (PLANCK * SPEED_OF_LIGHT)


def photons_that_fill(full_well: float, quantum_efficiency: float) -> float:
    """Return the number of photons that fill the well of a pixel: full well / quantum
    efficiency.
    """
    return full_well / quantum_efficiency


def line_saturation(
    line: Bands,
    responses: Tensor,
    *,
    electrons: float,
    quantum_efficiency: float,
    pixel_pitch: float,
    exposure: float,
) -> float:
    """Return the irradiance of a laser line that fills a pixel of the channel that saturates first.

    In a channel with the response r, one joule of light gives (sum over bands of r weight lambda /
    (h c)) x quantum efficiency electrons. The result is infinite for a line that no channel sees.

    Shapes: line (band,), responses (channel, band) -> ().
    Units:  electrons of a full pixel e-; pixel_pitch m; exposure s; result W/m2 of the whole line.
    Error:  exact for a fill factor of 1.
    Source: EMVA Standard 1288, release 4.0, of the channel whose quantum efficiency is the largest
            at the line.
    """
    band_shares = line.weights.double() / line.weights.double().sum()
    electrons_per_joule = (
        responses.double() * (band_shares * photons_per_joule(line.centres))
    ).sum(-1) * quantum_efficiency
    largest_response = float(electrons_per_joule.amax())
    return (
        electrons / (largest_response * exposure * pixel_pitch**2)
        if largest_response > 0
        else math.inf
    )


@node(rtol=1e-12)
def saturation(
    bands: Bands,
    *,
    full_well: Well,
    quantum_efficiency: Efficiency,
    pixel_pitch: PixelPitch,
    exposure: Exposure,
) -> Tensor:
    """Compute the saturation irradiance at each wavelength, which fills a pixel within one
    exposure.

    Shapes: bands (band,) -> (band,) float64.
    Units:  result W/m2.
    Error:  exact for a fill factor of 1 and an efficiency that does not depend on wavelength. The
            paper's rounded constants give 0.13 % more.
    Source: NeuSee, Eq. (ThresSat).
    """
    joules_that_fill = photons_that_fill(full_well, quantum_efficiency) / photons_per_joule(
        bands.centres
    )
    return joules_that_fill / (exposure * pixel_pitch**2)


@saturation.check
def _(result: Tensor, bands: Bands, **params: object) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [
        Check(
            f"saturation irradiance from {low:.3e} to {high:.3e} W/m2",
            math.isfinite(low + high) and low > 0,
        )
    ]


# --- room for light -------------------------------------------------------------------------------

# Refusal of sensors that cannot record light: the dark signal fills the well, or the full well is
# below one step of the converter.


def refuse_without_room(
    full_well: float,
    *,
    well: str = "full_well",
    offset: float = 0.0,
    read_noise: float = 0.0,
    dark: float = 0.0,
) -> None:
    """Raise ParameterError for a sensor whose pixels have no room for light.

    The sum of the offset and the electrons of the dark current must be below the full well, and so
    must the read noise. The error names the parameter ``well`` (the node's name of the full well)
    or read_noise.

    Shapes: scalars.
    Units:  electrons.
    Source: EMVA Standard 1288, release 4.0: the saturation capacity counts from the dark value.
    """
    if offset + dark >= full_well:
        # a list times False is empty: only parts above 0 are named
        parts = [f"the offset of {offset:.6g} e-"] * (offset > 0) + [
            f"the dark current of {dark:.6g} e-"
        ] * (dark > 0)
        text = (
            f"{' and '.join(parts)} fill{'s' * (len(parts) == 1)} a full well of {full_well:.6g} e-"
            " without light"
        )
        raise ParameterError(well, f"{text}: no exposure could be recorded")
    if read_noise >= full_well:
        text = (
            f"a read noise of {read_noise:.6g} e- is not below the full well of {full_well:.6g} e-"
        )
        raise ParameterError("read_noise", f"{text}: no exposure could be told from the dark")


def refuse_without_steps(full_well: float, *, gain: float, bits: int) -> None:
    """Raise ParameterError for a converter that has no step for light: a full well below half a
    digital number.

    Shapes: scalars.
    Units:  full_well e-; gain DN/e-.
    Source: EMVA Standard 1288, release 4.0: the linear model y = K e- + offset, rounded.
    """
    if full_well * gain < 0.5:
        text = (
            f"a gain of {gain:.4g} DN/e- turns a full well of {full_well:.6g} e- into"
            f" {full_well * gain:.3g} DN"
        )
        raise ParameterError("gain", f"{text}: every picture would be 0 DN")
    refuse_below_one_electron(gain=gain, bits=bits)


def refuse_below_one_electron(*, gain: float, bits: int) -> None:
    """Raise ParameterError for a converter of ``bits`` that ends below one electron, so that one
    electron clips it.
    """
    largest = ((1 << bits) - 1) / gain
    if largest < 1:
        text = (
            f"with a gain of {gain:.4g} DN/e- the largest digital number of {bits} bits is"
            f" {largest:.3g} e-"
        )
        raise ParameterError("gain", f"{text}: a single electron would clip a pixel")


# --- sensor limits --------------------------------------------------------------------------------

# Largest signal-to-noise ratio and dynamic range of a sensor.


class Limits(NamedTuple):
    """Limits of a sensor: photons that fill a pixel, largest signal-to-noise ratio, and dynamic
    range.
    """

    photons: Tensor  #: () float64, photons that fill a pixel
    snr: Tensor  #: () float64, signal-to-noise ratio at saturation
    dynamic_range: Tensor  #: () float64, dB


@node(rtol=1e-12)
def limits(*, full_well: Well, quantum_efficiency: Efficiency, read_noise: Electrons) -> Limits:
    """Compute the photons that fill a pixel, the signal-to-noise ratio at saturation, and the
    dynamic range.

    Shapes: -> three scalars, float64.
    Units:  photons; signal-to-noise ratio 1; dynamic range in dB, 20 log10(well / read noise).
    Error:  shot noise alone at the top and read noise alone at the bottom; a read noise under 1 e-
            counts as 1 e-.
    Source: EMVA Standard 1288, release 4.0 (SNR_max = sqrt(saturation capacity)).
    """
    range_decibels = 20.0 * math.log10(full_well / max(read_noise, 1.0))
    limit_values = (
        photons_that_fill(full_well, quantum_efficiency),
        math.sqrt(full_well),
        range_decibels,
    )
    return Limits(*(torch.tensor(v, dtype=torch.float64) for v in limit_values))


@limits.preflight
def _(*, full_well: float, read_noise: float, **params: object) -> list[str]:
    refuse_without_room(full_well, read_noise=read_noise)
    return []


@limits.check
def _(result: Limits, **params: object) -> list[Check]:
    text = (
        f"{float(result.photons):.0f} photons, SNR {float(result.snr):.1f},"
        f" {float(result.dynamic_range):.1f} dB"
    )
    return [Check(text, float(result.dynamic_range) > 0)]
