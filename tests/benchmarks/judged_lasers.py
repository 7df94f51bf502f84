"""A table of 36 lasers of every kind of pulse, for reading by hand: `python
tests/benchmarks/judged_lasers.py`.

Each laser shines from 20 m into a lens of 50 mm and 12 mm (f/4.2, transmittance 0.9) with a
divergence of 1 mrad. Beside what `neusee safety` says, the table has the peak on the sensor and the
thresholds by the formulas of a pocket calculator, which share no line with neusee. The exit status
is 1 where both differ by more than 3 %, and where a verdict is safe beside a part that is above its
threshold or not judged.
"""

from __future__ import annotations

import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from neusee.workflows import load
from neusee.workflows.safety.run_safety import document
from neusee.workflows.safety.safety_estimate import estimate

DISTANCE, DIVERGENCE, FOCAL, DIAMETER, PASSING = 20.0, 1e-3, 50e-3, 12e-3, 0.9


@dataclass(frozen=True)
class Case:
    """A laser as a data sheet states it."""

    nm: int
    power: float = 0.0  #: W, of a continuous laser
    energy: float = 0.0  #: J, of a pulse
    duration: float = 0.0  #: s
    rate: float = 0.0  #: Hz, of a train
    dwell: float = 1.0  #: s

    @property
    def text(self) -> str:
        """Return the laser as the first column of the table."""
        if self.power:
            return f"{self.nm} nm, {self.power:g} W, continuous, {self.dwell:g} s"
        train = f" at {self.rate:g} Hz" if self.rate else " once"
        return f"{self.nm} nm, {self.energy:g} J in {self.duration:g} s{train}, {self.dwell:g} s"


CASES = (
    Case(532, power=5e-3), Case(532, power=1.0), Case(532, power=50e-3, dwell=1e-3),
    Case(532, power=5.0, dwell=20e-6), Case(532, power=100.0, dwell=1e-6), Case(532, power=5e3, dwell=1e-8),
    Case(405, power=0.1), Case(650, power=5e-3), Case(808, power=1.0), Case(905, power=0.01),
    Case(1064, power=10.0), Case(1550, power=10.0), Case(355, power=0.1),
    Case(532, energy=1e-8, duration=1e-8), Case(532, energy=1e-5, duration=1e-8),
    Case(532, energy=1e-3, duration=1e-6), Case(532, energy=1e-9, duration=1e-13),
    Case(532, energy=1e-6, duration=1e-13), Case(532, energy=1e-8, duration=3e-11),
    Case(1064, energy=1e-6, duration=8e-9), Case(1064, energy=1e-3, duration=8e-9),
    Case(1064, energy=1.0, duration=1e-3), Case(650, energy=1e-6, duration=1e-7),
    Case(355, energy=1e-3, duration=5e-9), Case(1550, energy=1e-3, duration=5e-9),
    Case(532, energy=1e-3, duration=1e-6, rate=10.0), Case(532, energy=1e-8, duration=1e-8, rate=1e4),
    Case(532, energy=1e-9, duration=1e-8, rate=1e6), Case(905, energy=4e-7, duration=5e-9, rate=1e5),
    Case(1550, energy=5e-6, duration=3e-9, rate=2e5), Case(808, energy=1e-8, duration=1e-13, rate=8e7),
    Case(532, energy=1e-8, duration=9.9e-6, rate=1e5), Case(532, energy=1e-4, duration=1e-3, rate=100.0),
    Case(1064, energy=1e-5, duration=1e-10, rate=1e3),
    Case(532, energy=1e-7, duration=1e-8, rate=1e6, dwell=2e-5),
    Case(532, energy=1e-2, duration=0.2, rate=2.0, dwell=0.1),
)  # fmt: skip

RECIPE = """\
# A laser of the table.
defaults: [camera: lens_only, optics: lens_only, doe: flat]
lasers:
  one: {{wavelength: {nm} nm, {light}, divergence: 1 mrad, distance: 20 m}}
safety:
  lens: {{focal_length: 50 mm, diameter: 12 mm, transmittance: 0.9, focus: laser}}
  sensor: {{pixel_pitch: 3.45 um, shape: [1536, 2048]}}
  damage: {{dwell: {dwell} s}}
  draws: 100
outputs: [laser_lsr]
"""


def by_hand(case: Case) -> dict[str, tuple[float, float]]:
    """Return exposure and threshold of each part, in J/cm2 or W/cm2, by the formulas of a pocket
    calculator.
    """
    if not 400 <= case.nm <= 1100:
        return {}
    wavelength = case.nm * 1e-9
    waist = 2 * wavelength / (math.pi * DIVERGENCE)
    radius = math.hypot(waist, DIVERGENCE * DISTANCE / 2)
    x = DIAMETER**2 / (4 * radius**2)
    through = 1 - math.exp(-2 * x)
    peak = PASSING * through * (math.pi * DIAMETER**2 / 4) / (wavelength * FOCAL) ** 2
    peak *= 2 / x * math.tanh(x / 2) * 1e-4  # of 1 W or 1 J, in 1/cm2
    if case.power:
        return {"mean": (case.power * peak, fluence_by_hand(case.dwell) / case.dwell)}
    seconds = min(case.duration, case.dwell)
    share = seconds / case.duration
    fluence, rate = case.energy * peak, max(case.rate, 1 / case.dwell)
    of_pulse, steady = fluence_by_hand(seconds) / share, fluence_by_hand(case.dwell) / case.dwell
    duty = min(1.0, seconds * rate)
    ratio = fluence * (1 - duty) / of_pulse + fluence * share * rate / steady
    return {
        "pulse": (fluence, of_pulse),
        "mean": (fluence * share * rate, steady),
        "accumulation": (fluence, fluence / ratio),
    }


def fluence_by_hand(seconds: float) -> float:
    """Return the threshold of the first damage in J/cm2: 0.1 to 10 ns, 0.316 at 10 us, then 31.6
    kW/cm2.
    """
    if seconds >= 10e-6:
        return 10**4.5 * seconds
    return 0.1 * 10 ** (
        math.log10(10**4.5 * 10e-6 / 0.1) / 3 * max(0.0, math.log10(seconds / 10e-9))
    )


def judged(case: Case, folder: Path) -> dict[str, object]:
    """Return the verdict of `neusee safety` behind the plain lens."""
    train = f", repetition_rate: {case.rate!r} Hz" if case.rate else ""
    light = f"pulse_energy: {case.energy!r} J, pulse_duration: {case.duration!r} s{train}"
    if case.power:
        light = f"power: {case.power!r} W"
    (folder / "table.yaml").write_text(
        RECIPE.format(nm=case.nm, light=light, dwell=repr(case.dwell))
    )
    found: dict[str, object] = document(estimate(load("table.yaml", [], folder)))["damage"][0]
    return found


def main() -> int:
    """Print the table; return 1 for a row that the formulas by hand contradict."""
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for case in CASES:
            verdict = judged(case, Path(folder))
            rows: list[dict[str, object]] = verdict["rows"]  # type: ignore[assignment]
            print(f"{case.text}: {str(verdict['verdict']).upper()}\n    {verdict['sentence']}")
            hand = by_hand(case)
            for row in rows:
                wrong += _printed(row, hand, case)
            states = {str(row["state"]) for row in rows}
            wrong += verdict["verdict"] == "below" and states != {"below"}
            wrong += not {"pulse", "mean", "accumulation"} <= {str(row["part"]) for row in rows}
    print(f"{len(CASES)} lasers, {wrong} contradictions")
    return int(wrong > 0)


def _printed(row: dict[str, object], hand: dict[str, tuple[float, float]], case: Case) -> bool:
    """Print one part of the light with the ratio by hand; return True if both differ by more
    than 3 %.
    """
    ratio: dict[str, float] | None = row["ratio"]  # type: ignore[assignment]
    if ratio is None:
        print(f"    {row['part']:13} {row['damage']:12} not judged: {row['reason']}")
        return bool(hand) and row["damage"] == "point"
    text = f"{ratio['value']:10.3g} ({ratio['low']:.2g} to {ratio['high']:.2g}), {row['state']}"
    name = "mean" if case.power else str(row["part"])
    expected = hand.get(name) if row["damage"] == "point" else None
    if expected is None:
        print(f"    {row['part']:13} {row['damage']:12} {text}")
        return False
    value = expected[0] / expected[1]
    open_below = row["state"] == "not judged" or 0 < case.duration < 1e-9
    known = ratio["value"] if not open_below else math.nan
    by_hand_text = f"by hand {expected[0]:.3g} / {expected[1]:.3g} = {value:.3g}"
    print(f"    {row['part']:13} {row['damage']:12} {text}; {by_hand_text}")
    return not (math.isnan(known) or math.isclose(known, value, rel_tol=0.03))


if __name__ == "__main__":
    sys.exit(main())
