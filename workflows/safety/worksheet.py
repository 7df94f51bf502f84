"""A printable worksheet: the inputs, each formula with its numbers, the limits, and the
assumptions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from neusee.nodes.laser import (
    Beam,
    axis_density,
    beam_radius,
    eye_aperture,
    eye_limit,
    eye_mpe,
    eye_mpe_formula,
    eye_share,
    nominal_ocular_hazard_distance,
    photons_in_joule,
    sensor_density,
    share_through,
    train_limit,
    underfilled,
)
from neusee.workflows.report.run_folder import filled
from neusee.workflows.safety.exposure_limits import EyeDazzleRow, EyeFinding, saturating
from neusee.workflows.safety.safety_estimate import CERTIFICATE, Estimate, Finding
from neusee.workflows.safety.safety_text import UNITS, laser_text
from neusee.workflows.safety.what_helps import Remedy

_SYMBOL = re.compile(r"\b[A-Za-z]\w*\b")


@dataclass(frozen=True)
class Line:
    """A quantity of the worksheet, with its formula and the numbers in it, as text in SI units."""

    symbol: str
    quantity: str
    printed: str
    unit: str
    formula: str = ""
    numbers: str = ""


@dataclass
class Sheet:
    """The lines of the worksheet, and the value of each symbol for use in formulas."""

    values: dict[str, float] = field(default_factory=dict)
    parts: list[dict[str, object]] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)

    def given(self, symbol: str, quantity: str, value: float, unit: str = "") -> None:
        """Add a quantity without a formula."""
        self.values[symbol] = value
        self.lines.append(Line(symbol, quantity, put(value), unit))

    def computed(
        self, symbol: str, quantity: str, value: float, unit: str, formula: str, numbers: str = ""
    ) -> None:
        """Add a quantity with its formula; ``numbers`` is the formula with numbers in place of
        symbols, by default filled in from the values.
        """
        self.values[symbol] = value
        with_numbers = numbers or _SYMBOL.sub(lambda match: self._number(match[0]), formula)
        self.lines.append(
            Line(symbol, quantity, put(value), unit, _signs(formula), _signs(with_numbers))
        )

    def end_part(self, heading: str, text: str = "") -> None:
        """Collect the lines added since the last part under a heading."""
        if self.lines or text:
            self.parts.append({"heading": heading, "text": text, "lines": self.lines})
        self.lines = []

    def _number(self, symbol: str) -> str:
        return put(self.values[symbol]) if symbol in self.values else symbol


def put(value: float) -> str:
    """Return a number as text with six significant digits, for print and for formulas."""
    return f"{value:.6g}"


def _signs(formula: str) -> str:
    """Return a formula with × for the product and ^ for the power."""
    return formula.replace("**", "^").replace("*", "×")


def worksheet_page(estimate: Estimate) -> str:
    """Return the worksheet of an estimate as one self-contained HTML file."""
    sheet = Sheet()
    for add, heading, text in _contents(estimate):
        add(sheet, estimate)
        sheet.end_part(heading, text)
    return filled(
        "worksheet.html.j2",
        title=f"Worksheet: {estimate.recipe.name}",
        certificate=CERTIFICATE,
        lead=[estimate.recipe.title, laser_text(estimate)],
        parts=sheet.parts,
    )


def _contents(estimate: Estimate) -> list[tuple[Callable[[Sheet, Estimate], None], str, str]]:
    """Return the parts of the worksheet: the function that adds its lines, its heading and its
    text.
    """
    return [
        (_inputs, "1 Inputs", ""),
        (_light, "2 At the lens and on the sensor", ""),
        (_limits, "3 Limits of the sensor behind the plain lens", _limits_text(estimate)),
        (
            _eye,
            "4 The eye",
            f"Source: {estimate.eye.source}."
            if estimate.eye
            else "The limit of the eye is not judged.",
        ),
        (_dazzle, "5 Dazzle of the eye", _dazzle_text(estimate)),
        (lambda sheet, estimate: None, "6 Assumed", _assumed(estimate)),
    ]


# --- inputs ---------------------------------------------------------------------------------------


def _inputs(sheet: Sheet, estimate: Estimate) -> None:
    """Add the inputs: light, beam, distance, air, lens, sensor and eye."""
    beam, lens, sensor = (
        estimate.exposures.beams[0],
        estimate.safety.settings.lens,
        estimate.safety.settings.sensor,
    )
    _emission(sheet, beam)
    sheet.given("lambda", "wavelength", beam.wavelength, "m")
    sheet.given("w0", "radius of the beam at the laser, 1/e²", beam.waist, "m")
    sheet.given("theta", "full divergence, 1/e²", beam.divergence, "rad")
    sheet.given("R", "distance", estimate.safety.laser.distance, "m")
    sheet.given("T", "transmittance of the air over R", _air(estimate))
    sheet.given("D", "diameter of the lens", lens.diameter, "m")
    sheet.given("F", "focal length", lens.focal_length, "m")
    sheet.given("tau", "transmittance of the lens", lens.transmittance)
    sheet.given("p", "pixel pitch", sensor.pixel_pitch, "m")
    if sensor.quantum_efficiency is not None:
        sheet.given("eta", "quantum efficiency", sensor.quantum_efficiency)
    if sensor.full_well is not None:
        sheet.given("n", "full well", sensor.full_well, "e-")
    if sensor.exposure is not None:
        sheet.given("t", "exposure of a frame", sensor.exposure, "s")
    if estimate.eye is not None:
        sheet.given("te", "time for which an eye looks", estimate.eye.duration, "s")


def _emission(sheet: Sheet, beam: Beam) -> None:
    """Add the light of the laser: power, or energy and duration of a pulse with its rate."""
    if beam.pulse_energy is None or beam.pulse_duration is None:
        sheet.given("X", "power", beam.power or 0.0, "W")
        return
    sheet.given("X", "energy of a pulse", beam.pulse_energy, "J")
    sheet.given("tp", "duration of a pulse", beam.pulse_duration, "s")
    if beam.repetition_rate is not None:
        sheet.given("f", "repetition rate", beam.repetition_rate, "Hz")


def _air(estimate: Estimate) -> float:
    """Return the nominal transmittance of the air at the distance of the recipe."""
    clear = axis_density(estimate.exposures.beams[0], estimate.safety.laser.distance)
    return float(estimate.exposures.lens[0, estimate.at] / clear)


# --- light ----------------------------------------------------------------------------------------


def _light(sheet: Sheet, estimate: Estimate) -> None:
    """Add the beam at the lens, the light through the aperture, and the peak on the sensor."""
    beam, lens, distance = (
        estimate.exposures.beams[0],
        estimate.safety.settings.lens,
        estimate.safety.laser.distance,
    )
    emitted, air, unit = sheet.values["X"], sheet.values["T"], "J" if beam.is_pulsed else "W"
    radius = beam_radius(beam, distance)
    fill = lens.diameter**2 / (4 * radius**2)
    peak = emitted * sensor_density(
        beam, distance, lens.diameter, lens.focal_length, lens.transmittance, air
    )
    estimated_peak = emitted * float(
        estimate.exposures.sensor[estimate.options[0].name][0, estimate.at]
    )
    sheet.computed(
        "w", "radius of the beam at the lens, 1/e²", radius, "m", "sqrt(w0**2 + (theta * R / 2)**2)"
    )
    at_lens = emitted * axis_density(beam, distance, air)
    sheet.computed(
        "El", "exposure at the lens, on the axis", at_lens, f"{unit}/m²", "2 * X * T / (pi * w**2)"
    )
    through = emitted * share_through(beam, distance, lens.diameter, air)
    sheet.computed(
        "Xa", "through the aperture", through, unit, "X * T * (1 - exp(-D**2 / (2 * w**2)))"
    )
    sheet.computed("x", "filling of the aperture", fill, "", "D**2 / (4 * w**2)")
    sheet.computed(
        "u", "of the peak that a narrow beam keeps", underfilled(fill), "", "2 / x * tanh(x / 2)"
    )
    peak_formula = "Xa * tau * u * pi * D**2 / 4 / (lambda * F)**2"
    sheet.computed("Ec", "peak of a clear lens in focus", peak, f"{unit}/m²", peak_formula)
    sheet.given("q", "factor of focus and beam, computed by the estimate", estimated_peak / peak)
    sheet.computed("Es", "peak on the sensor", estimated_peak, f"{unit}/m²", "Ec * q")


# --- limits of the sensor -------------------------------------------------------------------------


def _plain(estimate: Estimate) -> list[Finding]:
    """Return the findings behind the plain lens."""
    return [finding for finding in estimate.findings if finding.option == estimate.options[0].name]


def _limits(sheet: Sheet, estimate: Estimate) -> None:
    """Add the saturation of a pixel, and each limit with the ratio of exposure to limit and the
    optical density that meets it.
    """
    # inputs that not every recipe states
    if {"eta", "n", "t"} <= set(sheet.values):
        full_irradiance = float(saturating(estimate.safety, estimate.draws)[0])
        sheet.given(
            "k",
            "photons in a joule, lambda / (h c)",
            photons_in_joule(estimate.exposures.beams[0].wavelength),
            "1/J",
        )
        formula = "n / (eta * k * t * p**2)"
        sheet.computed("S", "irradiance that fills a pixel", full_irradiance, "W/m²", formula)
    for number, finding in enumerate(_plain(estimate), 1):
        _limit(sheet, number, finding, estimate.helps)


def _limit(sheet: Sheet, number: int, finding: Finding, remedies: Sequence[Remedy]) -> None:
    """Add one limit, the ratio of exposure to limit, and the optical density that brings the laser
    down to it.
    """
    unit, name = f"{UNITS[finding.limit.quantity]}/m²", finding.limit.name
    limit, exposure = finding.at_sensor.value, finding.exposure.value
    sheet.given(f"L{number}", f"{name}: limit at the peak", limit, unit)
    sheet.given(f"E{number}", f"{name}: exposure at the peak", exposure, unit)
    sheet.computed(
        f"r{number}", f"{name}: exposure over limit", exposure / limit, "", f"E{number} / L{number}"
    )
    if exposure > limit:
        density = math.log10(exposure / limit)
        sheet.computed(
            f"OD{number}", f"{name}: density that meets it", density, "", f"log10(r{number})"
        )
    safe = next(
        (
            remedy.safe
            for remedy in remedies
            if remedy.limit == name and remedy.means == "grey filter"
        ),
        None,
    )
    if safe is not None:
        sheet.given(f"OS{number}", f"{name}: density that meets it in 95 % of the draws", safe)


def _limits_text(estimate: Estimate) -> str:
    """Return the sources of the limits."""
    sources = dict.fromkeys(
        f"{finding.limit.name}: {finding.limit.source}." for finding in _plain(estimate)
    )
    return " ".join(sources) or "No limit of the sensor is judged."


# --- the eye --------------------------------------------------------------------------------------


def _eye(sheet: Sheet, estimate: Estimate) -> None:
    """Add the exposure limit of the eye by the rule in force, and the hazard distance."""
    eye, beam = estimate.eye, estimate.exposures.beams[0]
    if eye is None:
        return
    unit = f"{UNITS[eye.quantity]}/m²"
    _eye_limit(sheet, estimate, eye, unit)
    sheet.given("Ee", "exposure of the eye at R, on the axis", eye.exposure.value, unit)
    sheet.computed("re", "exposure over limit", eye.exposure.value / eye.limit, "", "Ee / M")
    aperture = eye_aperture(
        beam.wavelength, eye.duration if beam.pulse_duration is None else beam.pulse_duration
    )
    share = eye_share(eye.limit, aperture, sheet.values["X"])
    sheet.given("a", "aperture of the eye", aperture, "m")
    sheet.computed("se", "share of X that the eye may receive", share, "", "pi * a**2 / 4 * M / X")
    hazard_distance = nominal_ocular_hazard_distance(
        beam, eye.duration, rule=estimate.safety.settings.eye.rule
    )
    if share >= 1:
        sheet.given(
            "NOHD",
            "nominal ocular hazard distance, 0 since se is not below 1",
            hazard_distance,
            "m",
        )
        return
    formula = "2 * sqrt(max(0, -a**2 / 2 / ln(1 - se) - w0**2)) / theta"
    sheet.computed("NOHD", "nominal ocular hazard distance", hazard_distance, "m", formula)


def _eye_limit(sheet: Sheet, estimate: Estimate, eye: EyeFinding, unit: str) -> None:
    """Add the limit of the eye with its formula."""
    beam, rule = estimate.exposures.beams[0], estimate.safety.settings.eye.rule
    limit = eye_limit(beam, eye.duration, rule)
    formula = eye_mpe_formula(beam.wavelength, eye.duration)
    if beam.pulse_energy is None or beam.pulse_duration is None:
        sheet.computed(
            "M",
            "limit of the eye (MPE)",
            limit,
            unit,
            "H(te) / te",
            f"{formula} / {put(eye.duration)}",
        )
        return
    pulse_formula = eye_mpe_formula(beam.wavelength, beam.pulse_duration)
    sheet.computed(
        "M1",
        "limit of one pulse",
        eye_mpe(beam.wavelength, beam.pulse_duration),
        unit,
        "H(tp)",
        pulse_formula,
    )
    if beam.repetition_rate is None or eye.duration * beam.repetition_rate <= 1:
        sheet.computed("M", "limit of the eye (MPE)", limit, unit, "M1")
        return
    train = train_limit(
        beam.wavelength, beam.pulse_duration, beam.repetition_rate, eye.duration, rule
    )
    by_mean = f"{formula} / ({put(eye.duration)} * {put(beam.repetition_rate)})"
    sheet.computed(
        "M2",
        "limit of a pulse by the mean of the train",
        train.mean,
        unit,
        "H(te) / (te * f)",
        by_mean,
    )
    smallest = "min(M1, M2)"
    if math.isfinite(train.repeated):
        smallest = "min(M1, M2, M3)"
        group_limit = train.repeated * train.together / train.factor
        sheet.given("Hg", "limit of one pulse, or of a group that counts as one", group_limit, unit)
        sheet.given("g", "pulses that count as one", train.together)
        sheet.given("N", "pulses or groups that are counted", train.groups)
        sheet.given("C5", f"factor of repeated pulses by the rule {rule}", train.factor)
        sheet.computed(
            "M3", "limit of a pulse among repeated pulses", train.repeated, unit, "Hg / g * C5"
        )
    sheet.computed("M", "limit of the eye (MPE)", limit, unit, smallest)


def _dazzle(sheet: Sheet, estimate: Estimate) -> None:
    """Add the maximum dazzle exposure at the smallest angle, where it is lowest, and the dazzle
    distance.
    """
    if not estimate.eye_dazzle.rows:
        return
    sheet.given("V", "V(lambda)", estimate.eye_dazzle.efficiency)
    sheet.given("P", "mean power", estimate.exposures.beams[0].power or 0.0, "W")
    nearest = min(row.angle for row in estimate.eye_dazzle.rows)
    rows = [row for row in estimate.eye_dazzle.rows if row.angle == nearest]
    for number, row in enumerate(rows, 1):
        _dazzle_row(sheet, number, row)


def _dazzle_row(sheet: Sheet, number: int, row: EyeDazzleRow) -> None:
    """Add the exposure that hides the target, for one ambient luminance and one angle."""
    condition_text = f"{row.background:g} cd/m², {row.angle:.3g}°"
    sheet.given(
        f"lx{number}", f"{condition_text}: illuminance that hides the target", row.illuminance, "lx"
    )
    if row.distance is None:
        return
    formula = f"lx{number} / (683 * V)"
    sheet.computed(
        f"MDE{number}", f"{condition_text}: maximum dazzle exposure", row.limit, "W/m²", formula
    )
    distance_formula = f"2 * sqrt(max(0, 2 * P / (pi * MDE{number}) - w0**2)) / theta"
    sheet.computed(
        f"NODD{number}",
        f"{condition_text}: dazzle distance",
        row.distance.value,
        "m",
        distance_formula,
    )


def _dazzle_text(estimate: Estimate) -> str:
    """Return the viewing task and the source, or why dazzle of the eye is not judged."""
    dazzle, asked = estimate.eye_dazzle, estimate.safety.settings.eye.dazzle
    if dazzle.reason:
        return f"Not judged: {dazzle.reason}."
    size = math.degrees(asked.size) * 60
    return (
        f"Target of {size:.3g} arc minutes and contrast {asked.contrast:g}, viewer of {asked.age:g}"
        f" years, margin {asked.margin:g}. Source: {dazzle.source}."
    )


def _assumed(estimate: Estimate) -> str:
    """Return the uncertain values and the assumptions as text."""
    laws = "; ".join(f"{name} {law_text}" for name, law_text in estimate.draws.laws.items())
    start = f"Uncertain: {laws}. The values above are the nominal ones. " if laws else ""
    return (
        f"{start}The beam is Gaussian and hits the middle of the lens. Limits of the eye hold for"
        " the unaided eye and a small source, in clear air; reflections, binoculars and beams that"
        f" sweep are not in them. {CERTIFICATE}"
    )
