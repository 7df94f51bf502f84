"""Damage of a sensor by a laser, and the resulting dead pixels."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.input_files import once_per_version
from neusee.nodes.laser._damage_laws import KINDS, DamageLaw, Kind, damage_at
from neusee.nodes.laser._damage_parts import (
    DamagePart,
    LightInTime,
    damage_parts,
    state_of,
    worst_state,
)
from neusee.nodes.laser._damage_table import read_damage_laws
from neusee.nodes.precision import single
from neusee.nodes.sensor._digitization import Bits, crop
from neusee.nodes.sensor._saturation import Well, refuse_without_steps
from neusee.nodes.spectra._bands import mean_wavelength
from neusee.nodes.units import DataFile, Exposure, Frequency, Gain, PixelPitch, Ratio, Time
from neusee.nodes.values import Bands, LaserLight

# --- damage spot ----------------------------------------------------------------------------------

# Damage of a sensor by a laser: every part of the light is compared with a threshold, or has a
# reason why it is not.


Thresholds = Literal["published"] | DataFile
Exponent = Annotated[float, Field(ge=0, le=1)]
_UNITS = {"irradiance": "W/cm2", "fluence": "J/cm2"}
_NO_PULSE = (
    "no pulse falls into the exposure, yet every pulse hits the sensor: give the laser a"
    " pulse_delay of 0"
)
_VERDICTS = {
    "above": "damage is expected",
    "not judged": "damage is not judged: a part of the light has no law",
    "within": (
        "damage cannot be excluded: a part of the light is within the bracket of its threshold"
    ),
    "below": (
        "no damage is expected: every part of the light is judged and below the bracket of its"
        " threshold"
    ),
}


class SpotDamage(NamedTuple):
    """The exposure by each part of a laser's light relative to its damage threshold: pulse, mean,
    accumulation, incubation, others.
    """

    #: (part,) float64, exposure of the brightest pixel over the threshold; NaN for a part without a
    #: law
    ratio: Tensor
    least: Tensor  #: (part,) float64, exposure over the upper end of the threshold's bracket
    #: (part,) float64, exposure over the lower end; infinite where no lower end is known
    most: Tensor
    #: (part,) float64, share of devices that are damaged; -1 without device data behind the law
    probability: Tensor
    #: (part,) float64, lower end of the 90 % interval of the probability; -1 without device data
    low: Tensor
    high: Tensor  #: (part,) float64, upper end; -1 without device data
    peak: Tensor  #: (part,) float64, W/m2, or J/m2 of one pulse, in the brightest pixel
    threshold: Tensor  #: (part,) float64, W/m2 or J/m2; NaN for a part without a law
    pattern: Tensor  #: (y, x) uint8, bit mask: bit k is set where the damage `KINDS[k]` occurs


@dataclass(frozen=True)
class _ExposedSensor:
    """The exposure of the sensor by a laser."""

    fluence: Tensor | None  #: (y, x) J/m2 of one pulse; None for continuous light
    irradiance: Tensor  #: (y, x) W/m2, mean over the dwell time
    time: LightInTime


@node(rtol=1e-5)
def damage(
    spot: Tensor,
    line: Bands,
    light: LaserLight | None = None,
    *,
    pixel_pitch: PixelPitch,
    exposure: Exposure,
    dwell: Time,
    pulse_duration: Time | None = None,
    repetition_rate: Frequency | None = None,
    device: str = "CMOS",
    thresholds: Thresholds = "published",
    small_spot_exponent: Exponent = 0.0,
    resilience: Ratio = 1.0,
) -> SpotDamage:
    """Compare the light that a laser brings to the sensor with thresholds of damage, one part of
    the light after other.

    The parts are one pulse, the mean over ``dwell`` (how long the laser stays on the spot), the
    accumulation of the heat of both, the incubation of many pulses, and further kinds of damage by
    one pulse. A part without a law is not judged and has a ratio of NaN. Laws of a CSV file in
    ``thresholds`` count where they hold, and elsewhere the published curve does: 0.1 J/cm2 for 10
    ns, interpolated to continuous light in W/cm2, from 400 to 1100 nm. Each threshold has a
    bracket; a probability is stated for a law with data of devices alone. A spot that is wider than
    the published one warms more at equal irradiance, by the sum of E dA / (2 pi r) over all pixels,
    and lowers the threshold; a narrower one raises it only with ``small_spot_exponent``. Gain, full
    well, quantum efficiency and the exposure time of a continuous laser do not enter. The pattern
    is that of one device, whose threshold is ``resilience`` times the stated one.

    Shapes: spot (band, y, x), line (band,) -> eight of (part,) float64, and the pattern (y, x).
    Units:  spot W/m2, mean over the exposure; result W/m2 or J/m2.
    Error:  of continuous light 1.4 % too little heat for a spot of 5 pixels and 0.6 % for one of 9;
            pixels must resolve the spot, lambda N / p above 1, else the peak at a point is higher.
            Heat outside the window and several lasers at once are left out. Thresholds are those of
            few devices: an estimate, no certificate.
    Raises: ParameterError before the run for a mistake in the file of thresholds.
    Source: the source of each law; Carslaw, Jaeger, Conduction of Heat in Solids, 2nd ed., ch. 10
            (steady heat).
    """
    choice = {
        "dwell": dwell,
        "pulse_duration": pulse_duration,
        "repetition_rate": repetition_rate,
        "device": device,
        "thresholds": thresholds,
        "small_spot_exponent": small_spot_exponent,
    }
    exposed = _exposed_sensor(spot, line, light, exposure, choice)
    diameter = heated_spot(exposed.irradiance, pixel_pitch)
    # a wider spot is heated more, so that its thresholds are lower
    parts = _parts_for_spot(exposed.time, choice, diameter)
    no_pulse = exposed.fluence is not None and light is not None and _pulses_in_exposure(light) <= 0
    pattern = torch.zeros(spot.shape[-2:], dtype=torch.uint8, device=spot.device)
    part_rows = []
    for damage_part in parts:
        is_fluence = damage_part.quantity == "fluence"
        exposure_picture = (
            exposed.fluence if is_fluence and exposed.fluence is not None else exposed.irradiance
        )
        peak = math.nan if no_pulse else float(exposure_picture.max())
        part_rows.append(_fields_of_part(damage_part, peak))
        if damage_part.threshold is not None and not no_pulse:
            over_threshold = exposure_picture >= float(damage_part.threshold.middle) * resilience
            # bit k of the pattern stands for the kind KINDS[k]
            pattern |= over_threshold.to(torch.uint8) << KINDS.index(damage_part.kind)
    # transpose: from one row per part to one tensor for each of the first eight fields
    part_columns = torch.tensor(part_rows, dtype=torch.float64).reshape(-1, 8).T.contiguous()
    return SpotDamage._make([*part_columns, pattern])


def _fields_of_part(damage_part: DamagePart, peak: float) -> tuple[float, ...]:
    """Return (ratio, least, most, probability, low, high, peak, threshold) of one part of the
    light: the first eight fields of `SpotDamage`.

    ``peak`` is the exposure of the brightest pixel in W/m2, or in J/m2 of one pulse; NaN if no
    pulse fell into the exposure.
    """
    # probability of damage and the ends of its interval; -1 means not known
    probability = (-1.0, -1.0, -1.0)
    if damage_part.threshold is None or math.isnan(peak):
        return (math.nan, math.nan, math.nan, *probability, peak, math.nan)
    low, middle, high = (
        float(end)
        for end in (
            damage_part.threshold.low,
            damage_part.threshold.middle,
            damage_part.threshold.high,
        )
    )
    if damage_part.law is not None:
        # the law holds for another spot size: pass on the ratio to the threshold of this spot
        damage_of_law = damage_at(damage_part.law, peak / middle * damage_part.law.median)
        probability = (damage_of_law.probability, damage_of_law.low, damage_of_law.high)  # type: ignore[assignment]
    return (
        peak / middle,
        peak / high,
        peak / low if low > 0 else math.inf,
        *probability,
        peak,
        middle,
    )


def _pulses_in_exposure(light: LaserLight) -> float:
    """Return the number of pulses in an exposure; 1 for a laser that is given by its strength."""
    return float(light.pulses) if float(light.pulse_fluence) > 0 else 1.0


def _exposed_sensor(
    spot: Tensor, line: Bands, light: LaserLight | None, exposure: float, choice: dict[str, Any]
) -> _ExposedSensor:
    """Return the fluence of one pulse and the mean irradiance over the dwell time in each pixel."""
    mean_irradiance = spot.detach().sum(0, dtype=torch.float64)
    time = _light_in_time(line, light, exposure, choice)
    if choice["pulse_duration"] is None:
        return _ExposedSensor(None, mean_irradiance, time)
    pulse_count = 1.0 if light is None else _pulses_in_exposure(light)
    # mean irradiance x exposure time is the fluence of all pulses in the exposure
    fluence = mean_irradiance * (exposure / pulse_count if pulse_count > 0 else math.nan)
    # fluence x pulse rate x share of a pulse in the dwell time
    return _ExposedSensor(fluence, fluence * float(time.rate * time.caught), time)


def _light_in_time(
    line: Bands, light: LaserLight | None, exposure: float, choice: dict[str, Any]
) -> LightInTime:
    """Return dwell time, pulse duration and repetition rate of the light of a laser.

    If no rate is stated, it is the number of pulses in the exposure over the exposure time.
    """
    rate = choice["repetition_rate"]
    if rate is None and light is not None and not light.pulses.is_meta and float(light.pulses) > 1:
        rate = float(light.pulses) / exposure
    if choice["pulse_duration"] is None:
        rate = None
    return LightInTime(
        wavelength=mean_wavelength(line),
        dwell=choice["dwell"],
        pulse_duration=choice["pulse_duration"],
        repetition_rate=rate,
        small_spot_exponent=choice["small_spot_exponent"],
    )


def _parts_for_spot(
    time: LightInTime, choice: dict[str, Any], diameter: float | None = None
) -> tuple[DamagePart, ...]:
    """Return the parts of the light with their thresholds; ``diameter`` is the heated diameter in
    m.
    """
    return damage_parts(
        LightInTime(
            wavelength=time.wavelength,
            dwell=time.dwell,
            pulse_duration=time.pulse_duration,
            repetition_rate=time.repetition_rate,
            spot=diameter,
            small_spot_exponent=time.small_spot_exponent,
        ),
        choice["device"],
        own_laws(choice["thresholds"]),
    )


@damage.preflight
def _(
    *,
    line: Bands | None = None,
    light: LaserLight | None = None,
    exposure: float = 1.0,
    thresholds: Thresholds = "published",
    **params: Any,
) -> list[str]:
    own_laws(thresholds)
    if line is None or line.centres.is_meta:
        return []
    parts = parts_before(line, light, exposure=exposure, thresholds=thresholds, **params)
    continuous = params.get("pulse_duration") is None
    return [
        _threshold_text(damage_part, continuous)
        for damage_part in parts
        if _has_sentence(damage_part, continuous)
    ]


def _has_sentence(damage_part: DamagePart, continuous: bool) -> bool:
    """Return True if the report has a sentence on this part: on every part of pulsed light, but
    only on the mean of continuous light, whose parts are equal.
    """
    return damage_part.part == "mean" or not continuous


def _part_name(damage_part: DamagePart, continuous: bool) -> str:
    """Return the part of the light and the kind of damage, as sentences name them."""
    return f"{'continuous light' if continuous else damage_part.part}, {damage_part.kind}"


def _threshold_text(damage_part: DamagePart, continuous: bool) -> str:
    """Return the threshold of a part of the light in one sentence, or why the part is not
    judged.
    """
    name = _part_name(damage_part, continuous)
    if damage_part.threshold is None:
        return f"{name}: not judged: {damage_part.reason}"
    low, middle, high = (
        # convert from 1/m2 to 1/cm2
        float(end) / 1e4
        for end in (
            damage_part.threshold.low,
            damage_part.threshold.middle,
            damage_part.threshold.high,
        )
    )
    unit = _UNITS[damage_part.quantity]
    if damage_part.open_below:
        return (
            f"{name}: at most {high:.3g} {unit}, not judged from below: {damage_part.reason};"
            f" {damage_part.source}"
        )
    note = f" ({damage_part.note})" if damage_part.note else ""
    return f"{name}: {middle:.3g} ({low:.3g} to {high:.3g}) {unit}{note}, {damage_part.source}"


@damage.check
def _(
    result: SpotDamage,
    spot: Tensor,
    line: Bands,
    light: LaserLight | None = None,
    *,
    exposure: float,
    **params: Any,
) -> list[Check]:
    parts = parts_before(line, light, exposure=exposure, **params)
    rows = list(zip(*(column.tolist() for column in result[:8]), strict=True))
    states = [
        state_of(row[1], row[2], damage_part.open_below)
        for damage_part, row in zip(parts, rows, strict=True)
    ]
    verdict = worst_state(states)
    checks = [Check(_VERDICTS[verdict], verdict == "below")]
    continuous = params.get("pulse_duration") is None
    for damage_part, row, state in zip(parts, rows, states, strict=True):
        if _has_sentence(damage_part, continuous):
            checks.append(Check(_sentence(damage_part, row, continuous), state == "below"))
    return checks


def _sentence(damage_part: DamagePart, row: tuple[float, ...], continuous: bool) -> str:
    """Return the sentence of a report on one part of the light: exposure, threshold, ratio with
    its bracket, and probability.

    ``row`` holds the first eight fields of `SpotDamage` for this part.
    """
    ratio, least_ratio, most_ratio, share, low, high, peak, threshold = row
    part_name = _part_name(damage_part, continuous)
    if math.isnan(ratio):
        return f"{part_name}: not judged: {damage_part.reason or _NO_PULSE}"
    unit = _UNITS[damage_part.quantity]
    if damage_part.open_below:
        ratio_text = f"at least {least_ratio:.3g} times the threshold"
        return (
            f"{part_name}: {peak / 1e4:.3g} {unit}, {ratio_text}; not judged from below:"
            f" {damage_part.reason}"
        )
    bracket = f" ({least_ratio:.3g} to {most_ratio:.3g})" if most_ratio > least_ratio else ""
    text = (
        f"{part_name}: {peak / 1e4:.3g} of {threshold / 1e4:.3g} {unit}, {ratio:.3g}{bracket} times"
        " the threshold"
    )
    if share < 0:
        return text
    return f"{text}; {share:.2g} of devices damaged (90 % interval {low:.2g} to {high:.2g})"


def parts_before(
    line: Bands, light: LaserLight | None, *, exposure: float = 1.0, **params: Any
) -> tuple[DamagePart, ...]:
    """Return the parts of the light from the parameters of the step, with the thresholds for the
    published spot size.
    """
    choice = {
        "dwell": params["dwell"],
        "pulse_duration": params.get("pulse_duration"),
        "repetition_rate": params.get("repetition_rate"),
        "device": params.get("device", "CMOS"),
        "thresholds": params.get("thresholds", "published"),
        "small_spot_exponent": params.get("small_spot_exponent", 0.0),
    }
    return _parts_for_spot(_light_in_time(line, light, exposure, choice), choice)


def heated_spot(image: Tensor, pitch: float, lost: float = 0.0) -> float | None:
    """Return the 1/e2 diameter in m of the Gaussian spot that heats as much as an image of equal
    peak; None without light.

    ``lost`` is the light outside the window, in the unit of the image; it is treated as if it fell
    on the rim of the window.
    """
    peak = float(image.max())
    if not peak > 0:
        return None
    rim_distance = min(image.shape) / 2 * pitch
    # light at the distance r warms a point by E dA / (2 pi r)
    peak_heat = float(steady_heat(image, pitch).max()) + lost * pitch**2 / (
        2 * math.pi * rim_distance
    )
    # a Gaussian spot of 1/e2 radius w has the heat E w sqrt(pi / 8) at its centre
    return 2 * peak_heat / (peak * math.sqrt(math.pi / 8))


def steady_heat(image: Tensor, pitch: float) -> Tensor:
    """Return the steady heat (y, x) of an irradiance on a half-space: the integral of E dA / (2 pi
    r), in W/m.

    Each pixel is evenly lit; the integral of 1 / r over its square is exact.
    """
    rows, columns = image.shape
    y, x = (torch.arange(n + 1, dtype=torch.float64, device=image.device) for n in (rows, columns))
    # the integral of 1 / sqrt(u^2 + v^2) over a pixel is its antiderivative u asinh(v / |u|) + v
    # asinh(u / |v|) at the four corners, with the signs 4 i j = +1, -1
    corner_offsets = itertools.product((-0.5, 0.5), repeat=2)
    signed_corners = [(y[:, None] + j, x + i, 4 * i * j) for j, i in corner_offsets]
    quarter_kernel = sum(
        sign * (u * torch.asinh(v / u.abs()) + v * torch.asinh(u / v.abs()))
        for u, v, sign in signed_corners
    )
    # the kernel is even: the distances 0 .. n - 1, n .. 1 give a circular kernel of twice the size
    row_distance, column_distance = (torch.cat([n[:-1], n[1:].flip(0)]).long() for n in (y, x))
    kernel = torch.as_tensor(quarter_kernel)[row_distance][:, column_distance]
    padded_size = (2 * rows, 2 * columns)
    # convolution of the irradiance with 1 / r, zero-padded to twice the size against wrap-around
    heat: Tensor = torch.fft.irfft2(
        torch.fft.rfft2(image, padded_size) * torch.fft.rfft2(kernel), padded_size
    )
    # rounding leaves tiny values below 0; with lengths in pixels, dA / r is in units of the pitch
    return heat[:rows, :columns].clamp_min(0) * (pitch / (2 * math.pi))


def own_laws(thresholds: Thresholds) -> tuple[DamageLaw, ...]:
    """Return the laws of damage in a user's file; raise ParameterError for a mistake in it."""
    if not isinstance(thresholds, Path):
        return ()
    try:
        return _laws_of_file(thresholds)
    except ValueError as error:
        raise ParameterError("thresholds", str(error)) from None


@once_per_version
def _laws_of_file(file: Path) -> tuple[DamageLaw, ...]:
    return read_damage_laws(file)


# --- damage pixels --------------------------------------------------------------------------------

# Dead pixels in the raw frame of a damaged sensor: points, lines, crosses and whole frames.


@node(rtol=0.0)
def damaged_pixels(
    raw: Tensor,
    damages: list[SpotDamage] | None = None,
    *,
    full_well: Well,
    gain: Gain,
    bits: Bits = 16,
    device: str = "CMOS",
) -> Tensor:
    """Draw the pixels that lasers have destroyed in a raw frame, from the patterns of the step
    `laser.damage`.

    `point` is a white pixel, `destruction` a black pixel, `line` a black row of a CMOS or a white
    column of a CCD, `cross` a black row and a black column, and `frame` a black frame. What stands
    later here covers what stands before.

    Shapes: raw (channel, y, x), each pattern (y, x) of at least that size -> (channel, y, x),
            float32 for half precision, which cannot hold the white of 16 bits.
    Units:  DN.
    Error:  a drawing of the published kinds of damage. Which neighbours a line takes with it, how
            bright a dead column is, and what changes later are left out.
    Source: Schwarz et al., Opt. Eng. 56, 034108 (2017), abstract (dead pixels, columns and rows);
            Bi et al., Opt. Express 32, 4709 (2024), abstract (point, line, cross); Photonics 12,
            790 (2025), abstract (white points, black lines in both directions, no valid frame).
            That lines of a CCD are white columns is ours.
    """
    shape = (raw.shape[-2], raw.shape[-1])
    pattern = torch.zeros(shape, dtype=torch.uint8, device=raw.device)
    for damage_of_laser in damages or ():
        pattern |= crop(damage_of_laser.pattern, shape=shape).to(raw.device)
    # the saturation value: the largest number of the converter, or the full well
    white = float(max(1, min(2**bits - 1, int(full_well * gain - 0.5))))
    damaged_frame = (
        single(raw)
        .masked_fill(_pixels_with(pattern, "point"), white)
        .masked_fill(_pixels_with(pattern, "destruction"), 0.0)
    )
    if device.casefold() == "ccd":
        damaged_frame = damaged_frame.masked_fill(
            _pixels_with(pattern, "line").any(-2, keepdim=True), white
        )
    else:
        damaged_frame = damaged_frame.masked_fill(
            _pixels_with(pattern, "line").any(-1, keepdim=True), 0.0
        )
    cross = _pixels_with(pattern, "cross")
    # `any` along an axis: one damaged pixel blackens its whole row or column
    damaged_frame = damaged_frame.masked_fill(
        cross.any(-1, keepdim=True) | cross.any(-2, keepdim=True), 0.0
    )
    return damaged_frame.masked_fill(_pixels_with(pattern, "frame").any(), 0.0)


def _pixels_with(pattern: Tensor, kind: Kind) -> Tensor:
    """Return a mask (y, x) of the pixels of a pattern with a kind of damage: bit k stands for
    `KINDS[k]`.
    """
    return (pattern & (1 << KINDS.index(kind))) > 0


@damaged_pixels.preflight
def _(*, full_well: float, gain: float, bits: int = 16, **params: object) -> list[str]:
    refuse_without_steps(full_well, gain=gain, bits=bits)
    return []


@damaged_pixels.check
def _(result: Tensor, raw: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    changed = int((result != raw).any(-3).sum())
    return [Check(f"damage changes {changed} pixels of the frame", changed == 0)]
