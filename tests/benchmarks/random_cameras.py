"""Random cameras in front of random lasers: settings, laws of what is uncertain, and the recipe
of `neusee safety`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.workflows.safety import own_camera_limits as own
from tests.workflows.safety.own_camera_spots import spots_of

DRAWS, OWN_DRAWS = 1000, 2000
UNITS = {
    "power": "W",
    "energy": "J",
    "divergence": "rad",
    "waist": "m",
    "visibility": "m",
    "well": "e-",
}
KEYS = {"energy": "pulse_energy", "efficiency": "quantum_efficiency", "well": "full_well"}
ELSEWHERE = (355e-9, 1310e-9, 1550e-9)  # m, where no published law of damage holds

RECIPE = """\
# Camera {number} of the benchmark of random cameras.
defaults: [camera: lens_only, optics: lens_only, doe: flat]
lasers:
  one: {{wavelength: {wavelength!r} m, {beam}, distance: {distance!r} m}}
safety:
  lens: {{focal_length: {focal_length!r} m, diameter: {diameter!r} m, {lens}}}
  sensor: {{pixel_pitch: {pixel!r} m, shape: [128, 128], exposure: {exposure!r} s, {sensor}}}
  damage: {{dwell: {dwell!r} s}}
  dazzle: {{share: 6.1e-5}}
  draws: {draws}
outputs: [laser_lsr]
"""


@dataclass(frozen=True)
class Camera:
    """A camera and a laser: settings in SI units, and the laws of those that are uncertain."""

    number: int
    distance: float
    given: dict[str, float]
    laws: dict[str, tuple[str, float, float]]

    def text(self, name: str) -> str:
        """Return a setting as a recipe writes it."""
        unit = f" {UNITS[name]}" if name in UNITS else ""
        if name not in self.laws:
            return f"{KEYS.get(name, name)}: {self.given[name]!r}{unit}"
        law, first, second = self.laws[name]
        return (
            f'{KEYS.get(name, name)}: "{law}({first!r}{unit},'
            f' {second!r}{"" if law == "lognormal" else unit})"'
        )

    def recipe(self, draws: int = DRAWS) -> str:
        """Return the recipe; the brightest pixel is the share of the picture that dazzles."""
        given = self.given
        beam = [
            self.text(n)
            for n in ("power", "energy", "divergence", "waist", "visibility")
            if n in given
        ]
        beam += [f"pulse_duration: {given['duration']!r} s"] if "duration" in given else []
        beam += [f"repetition_rate: {given['rate']!r} Hz"] if "rate" in given else []
        focus = {0.0: "laser", math.inf: "infinity"}.get(given["focus"], f"{given['focus']!r} m")
        scatter = f"{{share: {given['scatter']!r}}}" if given["scatter"] else "null"
        lens = (
            f"{self.text('transmittance')}, focus: {focus}, defocus: {given['defocus']!r} waves,"
            f" scatter: {scatter}"
        )
        sensor = f"{self.text('efficiency')}, {self.text('well')}"
        return RECIPE.format(
            number=self.number,
            distance=self.distance,
            beam=", ".join(beam),
            lens=lens,
            sensor=sensor,
            draws=draws,
            **{
                name: given[name]
                for name in ("wavelength", "focal_length", "diameter", "pixel", "exposure", "dwell")
            },
        )

    def drawn(self) -> dict[str, Any]:
        """Return the settings with draws (draw, 1) in place of those that are uncertain."""
        draw = np.random.default_rng([33, self.number])
        laws = {
            "lognormal": lambda a, b: a * b ** draw.standard_normal(OWN_DRAWS),
            "normal": lambda a, b: draw.normal(a, b, OWN_DRAWS),
            "uniform": lambda a, b: draw.uniform(a, b, OWN_DRAWS),
        }
        return self.given | {
            name: laws[law](*numbers)[:, None] for name, (law, *numbers) in self.laws.items()
        }

    @property
    def half_pixel(self) -> float:
        """Return half a pixel in the unit of the reference."""
        given = self.given
        return (
            math.pi
            * given["diameter"]
            * given["pixel"]
            / (2 * given["wavelength"] * given["focal_length"])
        )

    @property
    def opens_below(self) -> bool:
        """Return True for pulses below 1 ns, which are judged from above alone."""
        return 0 < self.given.get("duration", 0) < 1e-9

    @property
    def judged(self) -> bool:
        """Return True where a published law of damage holds."""
        return 400e-9 <= self.given["wavelength"] <= 1100e-9


def rounded(value: float) -> float:
    """Return a number with three digits, as a data sheet has it."""
    return float(f"{value:.3g}")


def camera(number: int) -> Camera:
    """Return a random camera in front of a random laser whose light is about a limit at a random
    distance.
    """
    draw = np.random.default_rng([32, number])

    def between(low: float, high: float) -> float:
        return rounded(float(np.exp(draw.uniform(math.log(low), math.log(high)))))

    given = {
        "wavelength": float(draw.integers(400, 1101)) * 1e-9,
        "focal_length": between(8e-3, 0.2),
    }
    if draw.random() < 0.12:
        given["wavelength"] = float(draw.choice(ELSEWHERE))
    given |= {
        "diameter": rounded(given["focal_length"] / between(1.2, 16)),
        "pixel": between(1e-6, 10e-6),
    }
    given |= {
        "divergence": between(1e-4, 1e-2),
        "exposure": between(1e-5, 3e-2),
        "dwell": between(1e-3, 10),
    }
    given |= {"efficiency": rounded(draw.uniform(0.05, 0.75)), "well": between(2e3, 1e5)}
    given |= {
        "transmittance": rounded(draw.uniform(0.7, 0.95)),
        "scatter": float(draw.choice([0, 0, 0.003, 0.01])),
    }
    distance = between(1, 1e4)
    given["focus"] = [math.inf, math.inf, 0.0, rounded(distance * between(0.3, 3))][
        draw.integers(4)
    ]
    given["defocus"] = (
        rounded(draw.uniform(-1, 1)) if draw.random() < 0.2 and given["focus"] else 0.0
    )
    if draw.random() < 0.5:
        given["waist"] = rounded(
            2 * draw.uniform(2, 6) * given["wavelength"] / (math.pi * given["divergence"])
        )
    if draw.random() < 0.3:
        given["visibility"] = between(3e3, 3e4)
    given |= emitted(given, int(draw.integers(4)), between(1e-14, 1e-3), between(1, 1e6))
    source = "energy" if "energy" in given else "power"
    given[source] = source_at_limit(given, distance, bool(draw.random() < 0.5))
    return Camera(number, distance, given, laws_of(given, draw, source))


def emitted(given: dict[str, float], kind: int, duration: float, rate: float) -> dict[str, float]:
    """Return a continuous laser, a pulse or a train of 1 W or 1 J."""
    if kind < 2:
        return {"power": 1.0}
    pulse = {"energy": 1.0, "duration": duration, "exposure": max(given["exposure"], 2 * duration)}
    return pulse | ({"rate": min(rate, rounded(0.3 / duration))} if kind == 3 else {})


def source_at_limit(given: dict[str, float], distance: float, damages: bool) -> float:
    """Return the power or energy that reaches a limit at about a distance."""
    trial = Camera(0, distance, given, {})
    at, low = np.array([distance]), (400e-9 <= given["wavelength"] <= 1100e-9) and damages
    spots = spots_of(*own.taper_and_defocus(given, at), trial.half_pixel, low)
    if low:
        ratio = max(float(part[0]) for part in own.damage_ratios(given, at, spots, 0).values())
    else:
        ratio = float(own.saturation_ratio(given, at, spots)[0])
    return rounded(float(np.clip(1 / ratio, 1e-15, 1e6)))


def laws_of(
    given: dict[str, float], draw: np.random.Generator, source: str
) -> dict[str, tuple[str, float, float]]:
    """Return the laws of none to three settings."""
    known = {
        source: ("lognormal", given[source], rounded(draw.uniform(1.05, 1.6))),
        "divergence": ("lognormal", given["divergence"], rounded(draw.uniform(1.02, 1.15))),
        "efficiency": ("normal", given["efficiency"], rounded(0.04 * given["efficiency"])),
        "well": ("lognormal", given["well"], 1.1),
        "transmittance": ("uniform", rounded(2 * given["transmittance"] - 0.98), 0.98),
    }
    if "visibility" in given:
        known["visibility"] = ("lognormal", given["visibility"], rounded(draw.uniform(1.1, 1.3)))
    count = int(draw.choice(4, p=[0.3, 0.2, 0.25, 0.25]))
    return {name: known[name] for name in draw.permutation(list(known))[:count]}
