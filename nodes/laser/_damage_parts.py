"""The parts of a laser's light that can each damage a sensor, each with its threshold, or the
reason why it has none.

The parts are the single pulse, the mean over the dwell time, the accumulation of the heat of both,
and the incubation of many pulses. Continuous light is one pulse as long as the dwell time, so that
its parts are equal.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from neusee.nodes.laser._damage_laws import (
    ABSORPTION_SOURCE,
    CONTINUOUS_FROM,
    NORMAL_QUANTILE,
    PUBLISHED_DAMAGE,
    PULSE_END,
    SHORTEST,
    SILICON_RANGE,
    SPREAD,
    Bracket,
    CurveEnds,
    DamageLaw,
    Kind,
    Number,
    Quantity,
    absorption_bracket,
    double,
    first_damage,
    matching_laws,
    spot_factor,
)

Part = Literal["pulse", "mean", "accumulation", "incubation"]
State = Literal["above", "within", "below", "not judged"]

PARTS: tuple[Part, ...] = ("pulse", "mean", "accumulation", "incubation")
MEASURED = 532e-9  #: m, wavelength of the published experiments
#: exponents S of the incubation law F_N = F_1 N^(S - 1): least, middle, largest; an assumption
INCUBATION = (0.8, 0.9, 1.0)
_MILLISECOND = 1e-3  #: s, shortest dwell of the published continuous law
_OWN_LAW = "own law"
_SUPERPOSED = (
    "heat of one pulse above the mean, and of the mean, superposed: our derivation for linear heat"
    " conduction"
)
_INCUBATED = (
    "incubation F_N = F_1 N^(S - 1) with S from 0.8 to 1: an assumption, not measured on sensors"
)


@dataclass(frozen=True)
class LightInTime:
    """Quantities that determine the damage threshold of a laser's light at a place on the sensor;
    tensors broadcast.
    """

    wavelength: float  #: m
    dwell: Number  #: s, time for which the light stays on the place
    pulse_duration: Number | None = None  #: s; None for continuous light
    repetition_rate: Number | None = None  #: Hz; None for a single pulse
    #: m, 1/e2 diameter of the Gaussian spot that heats as much as the light
    spot: Number | None = None
    small_spot_exponent: Number = 0.0

    @property
    def duration(self) -> Tensor:
        """Return the time in s for which one pulse, or continuous light, warms the place: at most
        the dwell time.
        """
        dwell = double(self.dwell)
        return (
            dwell
            if self.pulse_duration is None
            else torch.minimum(double(self.pulse_duration), dwell)
        )

    @property
    def caught(self) -> Tensor:
        """Return the share of a pulse within the dwell time."""
        return (
            double(1.0)
            if self.pulse_duration is None
            else self.duration / double(self.pulse_duration)
        )

    @property
    def rate(self) -> Tensor:
        """Return the pulse rate in Hz during the dwell time, with at least one pulse in it."""
        one_in_dwell = 1 / double(self.dwell)
        return (
            one_in_dwell
            if self.repetition_rate is None
            else torch.maximum(double(self.repetition_rate), one_in_dwell)
        )

    @property
    def pulses(self) -> Tensor:
        """Return the number of pulses in the dwell time, at least 1."""
        if self.repetition_rate is None:
            return double(1.0)
        return torch.ceil(
            # slightly less, so that rounding does not count a pulse at the very end of the dwell
            # time
            double(self.dwell) * double(self.repetition_rate) * (1 - 1e-12)
        ).clamp_min(1.0)


@dataclass(frozen=True)
class DamagePart:
    """One part of a laser's light with its damage threshold, or the reason why it has none."""

    part: Part
    kind: Kind  #: of damage
    #: quantity of the exposure: fluence of one pulse, or mean irradiance over the dwell time
    quantity: Quantity
    threshold: Bracket | None  #: J/m2 of one pulse, or W/m2; None if the part is not judged
    source: str = ""
    note: str = ""  #: what is extrapolated or assumed
    reason: str = ""  #: why the part has no threshold, or no lower end of it
    law: DamageLaw | None = None  #: a law with a spread of devices, which gives a probability

    @property
    def open_below(self) -> bool:
        """Return True if the threshold has no known lower end."""
        return self.threshold is not None and bool((self.threshold.low <= 0).any())


def state_of(smallest: float, largest: float, open_below: bool = False) -> State:
    """Return whether an exposure is above, within or below the bracket of a threshold; ``smallest``
    is its ratio to the upper end, ``largest`` to the lower end.
    """
    if math.isnan(smallest) or math.isnan(largest):
        return "not judged"
    # above even the upper end of the threshold; the largest ratio is to its lower end
    if smallest >= 1:
        return "above"
    if open_below:
        return "not judged"
    return "within" if largest >= 1 else "below"


def worst_state(states: Iterable[State]) -> State:
    """Return the state of a laser from those of its parts; `below` only if every part is judged and
    below its bracket.
    """
    worst_first: tuple[State, ...] = ("above", "not judged", "within", "below")
    states = tuple(states)
    return next((state for state in worst_first if state in states), "not judged")


def damage_parts(
    light: LightInTime,
    device: str,
    own: Sequence[DamageLaw] = (),
    published: Sequence[DamageLaw] = PUBLISHED_DAMAGE,
) -> tuple[DamagePart, ...]:
    """Return the parts of a laser's light with their thresholds: pulse, mean, accumulation,
    incubation, and then others.

    Where a law of the user (``own``) holds, it is used; elsewhere the published curve of the first
    damage is, from 400 to 1100 nm. The first four parts are always present; they are followed by
    further laws of the user, or further published kinds of damage by one pulse.

    Shapes: thresholds broadcast over the values of ``light``.
    Units:  J/m2 of one pulse, or W/m2.
    Error:  see `first_damage` and `absorption_bracket`.
    Source: of each part; the superposition of heat is our derivation.
    """
    curve = _curve_of(light, device, published)
    # laws of the user take precedence over the published curve
    pulses = [*_own_parts(light, device, own, "pulse")] or [_first_part(light, curve, "pulse")]
    means = [*_own_parts(light, device, own, "mean")] or [_first_part(light, curve, "mean")]
    pulse, mean = _lowest(pulses), _lowest(means)
    many_pulse_parts = [_accumulation(light, pulse, mean), _incubation(light, pulse)]
    other_laws = [judged for judged in pulses if judged is not pulse]
    other_laws += [judged for judged in means if judged is not mean]
    has_own_law = any(judged.note.startswith(_OWN_LAW) for judged in pulses)
    further_kinds = () if has_own_law else _further_kinds(light, device, curve, published)
    return (pulse, mean, *many_pulse_parts, *other_laws, *further_kinds)


def _lowest(parts: Sequence[DamagePart]) -> DamagePart:
    """Return the part with the lowest middle of its threshold; a part without a threshold counts as
    infinite.
    """
    return min(
        parts,
        key=lambda judged: (
            math.inf if judged.threshold is None else float(judged.threshold.middle.min())
        ),
    )


# --- the published curve --------------------------------------------------------------------------


def _curve_of(light: LightInTime, device: str, published: Sequence[DamageLaw]) -> CurveEnds | str:
    """Return the two thresholds of the published curve of a device, or the reason why it does not
    hold.
    """
    pulse_law = _first_law(device, "fluence", published)
    continuous_law = _first_law(device, "irradiance", published)
    if pulse_law is None or continuous_law is None:
        classes = ", ".join(sorted({law.device for law in published}))
        return f"no law of damage for the device {device}: there are published laws for {classes}"
    if not SILICON_RANGE[0] <= light.wavelength <= SILICON_RANGE[1]:
        return (
            f"no law of damage at {light.wavelength * 1e9:.5g} nm: published laws are used from 400"
            " to 1100 nm"
        )
    return CurveEnds(pulse_law, continuous_law)


def _first_law(device: str, quantity: Quantity, published: Sequence[DamageLaw]) -> DamageLaw | None:
    """Return the published law of the first damage (kind `point`) of a device for a quantity, or
    None.
    """
    for law in published:
        is_first_damage = law.damage == "point" and law.quantity == quantity
        if is_first_damage and law.device.casefold() == device.casefold():
            return law
    return None


def _first_part(light: LightInTime, curve: CurveEnds | str, share_of_light: Part) -> DamagePart:
    """Return the part of one pulse, or of the mean, with its threshold from the published curve of
    the first damage.

    ``share_of_light`` is "pulse" or "mean"; ``curve`` is the published curve, or the reason why
    none holds.
    """
    as_pulse = share_of_light == "pulse" and light.pulse_duration is not None
    quantity: Quantity = "fluence" if as_pulse else "irradiance"
    if isinstance(curve, str):
        return DamagePart(share_of_light, "point", quantity, None, reason=curve)
    duration = light.duration if as_pulse else double(light.dwell)
    bracket = first_damage(curve, duration, light.spot, light.small_spot_exponent)
    # convert to the fluence of a whole pulse, of which a share is in the dwell time, or to
    # irradiance
    bracket = bracket.times(1 / light.caught) if as_pulse else bracket.times(1 / duration)
    wavelength_factors, wavelength_note = _wavelength_factors(light, curve.pulse)
    return DamagePart(
        part=share_of_light,
        kind="point",
        quantity=quantity,
        threshold=bracket.times(wavelength_factors),
        source=_curve_source(curve, duration),
        note="; ".join(text for text in (_duration_note(duration), wavelength_note) if text),
        reason=_short_pulse_reason(duration),
    )


def _short_pulse_reason(duration: Tensor) -> str:
    """Return the reason why a pulse shorter than those of all published thresholds has no lower end
    of its threshold; empty for longer pulses.
    """
    if not bool((duration < SHORTEST).any()):
        return ""
    return (
        f"no threshold was found for pulses below {SHORTEST * 1e9:g} ns, which are reported to"
        " damage at less fluence than pulses of nanoseconds"
    )


def _curve_source(curve: CurveEnds, duration: Tensor) -> str:
    """Return the sources of the published thresholds that determine the curve at a duration."""
    if bool((duration >= CONTINUOUS_FROM).all()):
        return curve.continuous.source
    # both sources; the second without the publication, which is the same
    return f"{curve.pulse.source}; {curve.continuous.source.rpartition('; ')[2]}"


def _duration_note(duration: Tensor) -> str:
    """Return a note on the interpolation or extrapolation over the duration of the light."""
    if bool((duration < SHORTEST).any()):
        return "upper end of the threshold of 10 ns, extrapolated to shorter pulses"
    if bool(((duration > PULSE_END) & (duration < CONTINUOUS_FROM)).any()):
        return (
            f"interpolated between 10 ns and continuous light, spread {SPREAD:.2g} times to each"
            " side"
        )
    if bool((duration <= PULSE_END).any()):
        return f"published for 10 ns, spread {SPREAD:.2g} times to each side"
    if bool((duration < _MILLISECOND).any()):
        return (
            "continuous law of 1 ms and longer, extrapolated to shorter light, which needs no less"
            " irradiance"
        )
    return ""


def _wavelength_factors(light: LightInTime, law: DamageLaw) -> tuple[tuple[float, float], str]:
    """Return the least and the largest factor on a published threshold for the wavelength, with a
    note.
    """
    if law.wavelengths[0] <= light.wavelength <= law.wavelengths[1]:
        return (1.0, 1.0), ""
    factors = absorption_bracket(light.wavelength, MEASURED)
    return (
        factors,
        (
            f"extrapolated from 532 to {light.wavelength * 1e9:.4g} nm: between absorption as at"
            f" 532 nm and 3 um of silicon alone, a factor of {factors[0]:.3g} to {factors[1]:.3g}"
            f" ({ABSORPTION_SOURCE})"
        ),
    )


def _further_kinds(
    light: LightInTime, device: str, curve: CurveEnds | str, published: Sequence[DamageLaw]
) -> Iterator[DamagePart]:
    """Yield parts for further kinds of damage (line, cross, destruction, frame) with published
    thresholds for pulses of this duration.
    """
    if isinstance(curve, str) or light.pulse_duration is None:
        return
    duration = float(double(light.duration).flatten()[0])
    wavelength_factors, wavelength_note = _wavelength_factors(light, curve.pulse)
    for law in matching_laws(published, device, MEASURED, duration, "fluence"):
        if law.damage != "point":
            threshold = double(law.median) / light.caught
            bracket = Bracket(threshold / SPREAD, threshold, threshold * SPREAD).times(
                wavelength_factors
            )
            note = f"one figure, spread {SPREAD:.2g} times to each side"
            yield DamagePart(
                "pulse",
                law.damage,
                "fluence",
                bracket,
                law.source,
                "; ".join(filter(None, (note, wavelength_note))),
            )


# --- laws of the user -----------------------------------------------------------------------------


def _own_parts(
    light: LightInTime, device: str, own: Sequence[DamageLaw], share_of_light: Part
) -> Iterator[DamagePart]:
    """Yield the part of one pulse, or of the mean, once for each law of the user that holds for
    it.
    """
    as_pulse = share_of_light == "pulse" and light.pulse_duration is not None
    judged_quantity: Quantity = "fluence" if as_pulse else "irradiance"
    duration = light.duration if as_pulse else double(light.dwell)
    # if durations are a tensor, the first one selects the laws
    first_duration = float(duration.flatten()[0])
    quantities: tuple[Quantity, ...] = ("fluence", "irradiance")
    for quantity in quantities:
        for law in matching_laws(own, device, light.wavelength, first_duration, quantity):
            threshold_factor = _to_quantity(law, as_pulse, duration) * _own_spot(
                law, light, duration
            )
            threshold_factor = threshold_factor / light.caught if as_pulse else threshold_factor
            note = _OWN_LAW
            if law.spot is not None:
                note = f"{_OWN_LAW}, for a spot of {law.spot * 1e6:.3g} um"
            law_with_spread = law if law.has_spread else None
            yield DamagePart(
                part=share_of_light,
                kind=law.damage,
                quantity=judged_quantity,
                threshold=_own_bracket(law).times(threshold_factor),
                source=law.source,
                note=note,
                law=law_with_spread,
            )


def _to_quantity(law: DamageLaw, as_pulse: bool, duration: Tensor) -> Tensor:
    """Return the factor that converts the quantity of a law to the fluence of one pulse, or to the
    mean irradiance over the dwell time.
    """
    if as_pulse:
        # fluence = irradiance x duration
        return duration if law.quantity == "irradiance" else double(1.0)
    return 1 / duration if law.quantity == "fluence" else double(1.0)


def _own_spot(law: DamageLaw, light: LightInTime, duration: Tensor) -> Tensor:
    """Return the factor of the spot size on a threshold irradiance; 1 for a fluence, and where a
    spot is not known.
    """
    if law.quantity == "fluence" or law.spot is None or light.spot is None:
        return double(1.0)
    return spot_factor(law.spot, light.spot, duration, light.small_spot_exponent)


def _own_bracket(law: DamageLaw) -> Bracket:
    """Return the bracket of a law: the stated one, else the central 90 % from both spreads
    combined, else the median alone.
    """
    median = double(law.median)
    if law.low is not None and law.high is not None:
        return Bracket(double(law.low), median, double(law.high))
    log_deviations = [
        math.log(factor) for factor in (law.factor, law.median_factor) if factor is not None
    ]
    # the two spreads are independent: their logarithms add in quadrature
    bracket_factor = (
        math.exp(NORMAL_QUANTILE * math.hypot(*log_deviations)) if log_deviations else 1.0
    )
    return Bracket(median / bracket_factor, median, median * bracket_factor)


# --- many pulses ----------------------------------------------------------------------------------


def _accumulation(light: LightInTime, pulse: DamagePart, mean: DamagePart) -> DamagePart:
    """Return the part for the accumulated heat of the mean and of one pulse above it; for
    continuous light it equals the mean.

    The light of a pulse train is split into its mean and a remainder of mean 0, so that a pulse
    adds the heat of (1 - duty) times its fluence to that of the mean. With a duty cycle near 1 the
    sum is that of continuous light.
    """
    if light.pulse_duration is None:
        return DamagePart(
            "accumulation",
            mean.kind,
            mean.quantity,
            mean.threshold,
            mean.source,
            mean.note,
            mean.reason,
        )
    if pulse.threshold is None or mean.threshold is None:
        unjudged = pulse if pulse.threshold is None else mean
        return DamagePart("accumulation", pulse.kind, "fluence", None, reason=unjudged.reason)
    duty_cycle = (light.duration * light.rate).clamp_max(1.0)
    # mean irradiance over the fluence of a whole pulse, in 1/s
    mean_per_fluence = light.rate * light.caught

    def summed(of_pulse: Tensor, of_mean: Tensor) -> Tensor:
        # damage where (1 - duty) F / F_pulse + mean / mean threshold = 1
        return 1 / (
            torch.where(duty_cycle < 1, (1 - duty_cycle) / of_pulse, 0.0)
            + mean_per_fluence / of_mean
        )

    mean_threshold = mean.threshold
    return DamagePart(
        part="accumulation",
        kind=pulse.kind,
        quantity="fluence",
        threshold=Bracket(
            low=summed(pulse.threshold.low, mean_threshold.low),
            middle=summed(pulse.threshold.middle, mean_threshold.middle),
            high=summed(pulse.threshold.high, mean_threshold.high),
        ),
        source=_SUPERPOSED,
        note="; ".join(dict.fromkeys(filter(None, (pulse.note, mean.note)))),
        reason=pulse.reason or mean.reason,
    )


def _incubation(light: LightInTime, pulse: DamagePart) -> DamagePart:
    """Return the part for incubation, in which each of many pulses weakens the sensor; for a single
    pulse it equals the pulse.

    Only the light above the mean counts as pulses: with a duty cycle near 1 the light is continuous
    and there is no incubation.
    """
    if pulse.threshold is None:
        return DamagePart("incubation", pulse.kind, pulse.quantity, None, reason=pulse.reason)
    pulse_count = light.pulses
    duty_cycle = (light.duration * light.rate).clamp_max(1.0)
    # F_N = F_1 N^(S - 1), applied to the share 1 - duty of the light; the share duty is steady
    # light
    low_factor, middle_factor, high_factor = (
        1 / ((1 - duty_cycle) * pulse_count ** (1 - exponent) + duty_cycle)
        for exponent in INCUBATION
    )
    bracket = Bracket(
        pulse.threshold.low * low_factor,
        pulse.threshold.middle * middle_factor,
        pulse.threshold.high * high_factor,
    )
    has_train = bool((pulse_count > 1).any())
    note = f"{_INCUBATED}; {float(pulse_count.max()):.3g} pulses" if has_train else pulse.note
    return DamagePart(
        "incubation", pulse.kind, pulse.quantity, bracket, pulse.source, note, pulse.reason
    )
