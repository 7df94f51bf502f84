"""Parts of a laser's light: 2000 drawn lasers, superposed heat by hand, and trains that become
continuous light.
"""

import math

import numpy as np
import pytest
from scipy.stats import lognorm

from neusee.nodes.laser import PARTS, DamageLaw, LightInTime, damage_parts, state_of, worst_state

LIGHTS = 2000
OWN = DamageLaw(
    "CMOS", "line", "fluence", 5e3, 1.5, 1.2, (1500e-9, 1600e-9), (1e-9, 1e-7), None, "own test"
)


def drawn_light(draw):
    """Return a laser from femtoseconds to continuous, 300 to 1600 nm, one pulse to MHz, with its
    spot and dwell.
    """
    wavelength = draw.uniform(300e-9, 1600e-9)
    dwell = 10 ** draw.uniform(-6, 2)
    spot = draw.choice([None, 10 ** draw.uniform(-6, -3)])
    common = {
        "wavelength": wavelength,
        "dwell": dwell,
        "spot": spot,
        "small_spot_exponent": draw.choice([0.0, 0.5]),
    }
    sort = draw.integers(0, 4)
    if sort == 0:
        return LightInTime(**common)
    duration = 10 ** draw.uniform(-14, 0)
    if sort == 1:
        return LightInTime(**common, pulse_duration=duration)
    rate = min(10 ** draw.uniform(0, 8), draw.uniform(0.01, 0.999) / duration)
    return LightInTime(**common, pulse_duration=duration, repetition_rate=rate)


def judged(light, device="CMOS", exposure=1.0, own=()):
    """Return the ratio, the state and the part of each part, for an irradiance, or a fluence, at
    the peak.
    """
    found = []
    for part in damage_parts(light, device, own):
        if part.threshold is None:
            found.append((math.nan, "not judged", part))
            continue
        rate = float(light.rate * light.caught) if light.pulse_duration is not None else 1.0
        level = exposure * rate if part.part == "mean" else exposure
        low, middle, high = (
            float(x) for x in (part.threshold.low, part.threshold.middle, part.threshold.high)
        )
        assert 0 <= low <= middle * (1 + 1e-12)
        assert middle <= high * (1 + 1e-12)
        state = state_of(level / high, level / low if low else math.inf, part.open_below)
        found.append((level / middle, state, part))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("device", ["CMOS", "CCD", "InGaAs"])
def test_no_laser_is_without_its_rows_and_none_is_safe_by_what_is_not_judged(device):
    """Pulses outside 1 to 100 ns were once judged by their mean alone, and said nothing else."""
    draw = np.random.default_rng(7)
    seen = set()
    for _ in range(LIGHTS):
        light = drawn_light(draw)
        exposure = 10 ** draw.uniform(-2, 12)
        rows = judged(light, device, exposure)
        assert tuple(part.part for _, _, part in rows[:4]) == PARTS
        verdict = worst_state(state for _, state, _ in rows)
        seen.add(verdict)
        for ratio, state, part in rows:
            assert part.threshold is not None or part.reason
            assert part.threshold is None or part.source
            if state != "below":
                assert verdict != "below", (light, part)
            if ratio >= 1:
                assert state != "below", (light, part)
        inside = 400e-9 <= light.wavelength <= 1100e-9 and device != "InGaAs"
        assert all(part.threshold is not None for _, _, part in rows) == inside
    assert seen == (
        {"not judged"} if device == "InGaAs" else {"above", "within", "below", "not judged"}
    )


@pytest.mark.slow
def test_more_energy_and_more_power_never_read_as_safer():
    draw = np.random.default_rng(8)
    order = {"below": 0, "within": 1, "not judged": 1, "above": 2}
    for _ in range(300):
        light = drawn_light(draw)
        states = [
            worst_state(s for _, s, _ in judged(light, exposure=10.0**e)) for e in range(-3, 13)
        ]
        ranks = [order[state] for state in states]
        assert ranks == sorted(ranks), (light, states)


@pytest.mark.parametrize(("rate", "pulse"), [(10.0, 1e-8), (1e5, 5e-9), (2e5, 1e-7), (1e3, 1e-6)])
def test_the_heat_of_one_pulse_and_of_the_mean_superpose(rate, pulse):
    """F (1 - duty) / F_th + E_mean / E_cw = 1 at the threshold, with figures of the curve by
    hand.
    """
    light = LightInTime(532e-9, 1.0, pulse, rate)
    own, mean, both, many = damage_parts(light, "CMOS")[:4]
    per_decade = math.log10(math.sqrt(10)) / 3
    fluence = 1e3 * 10 ** (per_decade * max(0.0, math.log10(pulse / 1e-8)))
    ends = {
        "low": (fluence / math.sqrt(40), 1e8),
        "middle": (fluence, 10**8.5),
        "high": (fluence * math.sqrt(40), 1e9),
    }
    for end, (joules, watts) in ends.items():
        assert float(getattr(own.threshold, end)) == pytest.approx(joules)
        assert float(getattr(mean.threshold, end)) == pytest.approx(watts)
        at = float(getattr(both.threshold, end))
        assert at * (1 - pulse * rate) / joules + at * rate / watts == pytest.approx(1.0)
    # a duty of at most 2 %
    assert float(many.threshold.middle) == pytest.approx(fluence * rate**-0.1, rel=0.03)
    assert float(many.threshold.low) == pytest.approx(
        float(own.threshold.low) * rate**-0.2, rel=0.2
    )
    assert float(many.threshold.high) == pytest.approx(float(own.threshold.high))


@pytest.mark.parametrize(
    ("dwell", "rate", "pulses"), [(1.0, 0.1, 1), (0.07, 100.0, 7), (0.25, 10.0, 3), (0.3, 10.0, 3)]
)
def test_every_pulse_that_begins_within_the_dwell_counts(dwell, rate, pulses):
    """0.07 s of 100 Hz are 7 pulses, although the product is 7.000000000000001."""
    light = LightInTime(532e-9, dwell, 1e-8, rate)
    assert float(light.pulses) == pulses
    assert float(LightInTime(532e-9, dwell, 1e-8).pulses) == 1


def test_of_a_train_that_is_slower_than_the_dwell_one_pulse_warms():
    light = LightInTime(532e-9, 0.01, 1e-8, 2.0)
    both = damage_parts(light, "CMOS")[2].threshold
    assert 1 / float(both.middle) == pytest.approx(1 / 1e3 + 100 / 10**8.5)


def test_the_shutter_or_the_scan_catches_a_part_of_each_pulse():
    """Half of a pulse of 20 ns within 10 ns: the fluence of the whole pulse may be twice as
    large.
    """
    parts = damage_parts(LightInTime(532e-9, 1e-8, 2e-8), "CMOS")
    assert float(parts[0].threshold.middle) == pytest.approx(2e3)
    joules = {part.kind: part.threshold for part in parts[4:]}
    assert float(joules["destruction"].middle) == pytest.approx(2e6)
    law = OWN._replace(wavelengths=(500e-9, 600e-9))
    own = damage_parts(LightInTime(532e-9, 1e-8, 2e-8), "CMOS", (law,))[0]
    assert float(own.threshold.middle) == pytest.approx(2 * 5e3)


def test_further_kinds_of_damage_have_the_spread_of_one_figure():
    further = damage_parts(LightInTime(532e-9, 1.0, 1e-8), "CMOS")[4:]
    assert len(further) == 3
    for part in further:
        assert float(part.threshold.high / part.threshold.middle) == pytest.approx(math.sqrt(40))
        assert float(part.threshold.middle / part.threshold.low) == pytest.approx(math.sqrt(40))


def test_a_train_of_a_lidar_is_beyond_by_its_mean():
    """6 J/cm2 at 200 kHz are 1.2 MW/cm2 mean, 38 times the continuous law at a wavelength that
    has one.
    """
    light = LightInTime(1064e-9, 1.0, 3e-9, 2e5)
    rows = judged(light, exposure=6e4)
    assert rows[1][0] == pytest.approx(1.2e6 / 10**4.5)
    assert rows[2][0] > rows[1][0]
    assert rows[2][0] == pytest.approx(rows[0][0] * (1 - 6e-4) + rows[1][0])


@pytest.mark.parametrize("period", [1e-7, 1e-5, 1e-3])
def test_pulses_that_touch_each_other_are_continuous_light(period):
    power = 10**8.5 * 0.8  # W/m2
    steady = judged(LightInTime(532e-9, 1.0), exposure=power)
    assert [ratio for ratio, _, _ in steady[:4]] == pytest.approx([0.8] * 4)
    last = 0.0
    for duty in (0.5, 0.9, 0.99, 0.999999):
        light = LightInTime(532e-9, 1.0, duty * period, 1 / period)
        rows = judged(light, exposure=power * duty * period)
        accumulated, incubated = rows[2][0], rows[3][0]
        assert accumulated >= rows[1][0] * (1 - 1e-9)
        last = accumulated
    assert last == pytest.approx(0.8, rel=1e-3)
    assert incubated == pytest.approx(rows[0][0], rel=1e-3)


@pytest.mark.parametrize("dwell", [1e-6, 1e-4, 0.1])
def test_a_pulse_that_outlasts_the_dwell_is_continuous_light_of_the_dwell(dwell):
    steady = judged(LightInTime(532e-9, dwell), exposure=1e8)
    pulse = judged(LightInTime(532e-9, dwell, 50.0), exposure=1e8 * 50.0)
    assert [ratio for ratio, _, _ in pulse[:3]] == pytest.approx([steady[0][0]] * 3)


def test_a_scanned_beam_is_judged_by_the_time_it_stays():
    """At 10 ns the irradiance of 0.1 J/cm2 is 10 MW/cm2, and not the tens of kW/cm2 of
    continuous light.
    """
    (first, *_) = damage_parts(LightInTime(532e-9, 1e-8), "CMOS")
    assert float(first.threshold.middle) == pytest.approx(1e3 / 1e-8)
    (first, *_) = damage_parts(LightInTime(532e-9, 1e-15), "CMOS")
    assert first.open_below


def test_own_laws_count_where_they_hold_and_the_rest_is_said():
    light = LightInTime(1550e-9, 1.0, 3e-9, 2e5)
    rows = judged(light, exposure=6e4, own=(OWN,))
    assert (rows[0][0], rows[0][2].kind, rows[0][2].law) == (pytest.approx(12.0), "line", OWN)
    assert [part.part for _, state, part in rows if state == "not judged"] == [
        "mean",
        "accumulation",
    ]
    assert (
        worst_state(state for _, state, _ in judged(light, exposure=1e-3, own=(OWN,)))
        == "not judged"
    )
    green = judged(LightInTime(532e-9, 1.0, 3e-9, 2e5), exposure=6e4, own=(OWN,))
    assert all(part.law is None for _, _, part in green)


def test_an_own_law_of_continuous_light_judges_pulses_of_its_durations():
    law = OWN._replace(
        quantity="irradiance", median=2e8, durations=(1e-3, 10.0), wavelengths=(500e-9, 600e-9)
    )
    rows = judged(LightInTime(532e-9, 1.0, 2e-3), exposure=4e5, own=(law,))
    assert rows[0][0] == pytest.approx(4e5 / (2e8 * 2e-3))


def test_an_own_fluence_judges_continuous_light_of_its_durations_by_its_energy():
    law = OWN._replace(durations=(1e-9, 1e-6), wavelengths=(500e-9, 600e-9))
    for part in damage_parts(LightInTime(532e-9, 2e-7), "CMOS", (law,))[:3]:
        assert (part.quantity, float(part.threshold.middle)) == (
            "irradiance",
            pytest.approx(5e3 / 2e-7),
        )


def test_the_bracket_of_an_own_law_holds_nine_of_ten_devices_with_what_is_unknown_of_their_median():
    bracket = damage_parts(LightInTime(1550e-9, 1.0, 3e-9), "CMOS", (OWN,))[0].threshold
    draws = np.random.default_rng(5).normal(size=(2, 400_000))
    devices = 5e3 * 1.5 ** draws[0] * 1.2 ** draws[1]
    ends = (float(bracket.low), float(bracket.middle), float(bracket.high))
    assert ends == pytest.approx(tuple(np.quantile(devices, (0.05, 0.5, 0.95))), rel=0.01)
    known = damage_parts(
        LightInTime(1550e-9, 1.0, 3e-9), "CMOS", (OWN._replace(median_factor=None),)
    )[0].threshold
    assert float(known.low) == pytest.approx(lognorm.ppf(0.05, math.log(1.5), scale=5e3))


def test_the_lowest_of_several_own_laws_judges_the_pulse_and_the_others_follow():
    higher = OWN._replace(damage="cross", median=9e3)
    parts = damage_parts(LightInTime(1550e-9, 1.0, 3e-9, 2e5), "CMOS", (higher, OWN))
    assert [(part.part, part.kind) for part in parts] == [
        ("pulse", "line"),
        ("mean", "point"),
        ("accumulation", "line"),
        ("incubation", "line"),
        ("pulse", "cross"),
    ]


def test_an_own_irradiance_falls_with_a_wider_spot_and_an_own_fluence_does_not():
    spot = {"spot": 20e-6, "durations": (1e-9, 10.0), "wavelengths": (500e-9, 600e-9)}
    steady = OWN._replace(quantity="irradiance", median=2e8, **spot)
    (wide, *_) = damage_parts(LightInTime(532e-9, 1.0, spot=400e-6), "CMOS", (steady,))
    assert float(wide.threshold.middle) == pytest.approx(2e8 / 20, rel=0.03)
    (pulse, *_) = damage_parts(
        LightInTime(532e-9, 1.0, 1e-8, spot=400e-6), "CMOS", (OWN._replace(**spot),)
    )
    assert float(pulse.threshold.middle) == pytest.approx(5e3)


@pytest.mark.parametrize(("dwell", "words"), [
    (0.9e-3, "continuous law of 1 ms and longer"),
    (1e-3, ""),
    (5e-6, "interpolated between 10 ns and continuous light"),
    (1e-8, "published for 10 ns"),
    (0.9e-9, "extrapolated to shorter pulses"),
])  # fmt: skip
def test_a_duration_without_an_experiment_is_named(dwell, words):
    note = damage_parts(LightInTime(532e-9, dwell), "CMOS")[0].note
    assert (words in note) if words else note == ""


def test_away_from_the_experiment_the_upper_end_is_that_of_silicon_alone():
    """3 um of silicon absorb 0.900 at 532 nm and 0.0824 at 905 nm: the threshold is up to 10.9
    times as high.
    """
    ends = [
        damage_parts(LightInTime(nm * 1e-9, 1.0, 1e-8), "CMOS")[0].threshold
        for nm in (532, 905, 405)
    ]
    assert float(ends[1].high / ends[0].high) == pytest.approx(0.900 / 0.0824, rel=2e-3)
    assert float(ends[1].low) == float(ends[0].low)
    assert float(ends[2].low / ends[0].low) == pytest.approx(0.900, rel=2e-3)


@pytest.mark.parametrize(
    ("nm", "named"), [(520, False), (532, False), (561, True), (405, True), (1064, True)]
)
def test_a_wavelength_without_an_experiment_is_named_as_an_extrapolation(nm, named):
    parts = damage_parts(LightInTime(nm * 1e-9, 1.0, 1e-8, 10.0), "CMOS")
    for part in parts[:3]:
        assert ("extrapolated from 532" in part.note) == named
    green = damage_parts(LightInTime(532e-9, 1.0, 1e-8, 10.0), "CMOS")
    assert float(parts[0].threshold.middle) == float(green[0].threshold.middle)
    assert float(parts[0].threshold.high) >= float(green[0].threshold.high)


def test_states_are_ordered_so_that_nothing_unknown_reads_as_safe():
    assert worst_state([]) == "not judged"
    assert worst_state(["below", "below"]) == "below"
    assert worst_state(["below", "within"]) == "within"
    assert worst_state(["below", "within", "not judged"]) == "not judged"
    assert worst_state(["below", "not judged", "above"]) == "above"
    assert state_of(math.nan, math.nan) == "not judged"
    assert state_of(0.5, math.inf, open_below=True) == "not judged"
    assert (state_of(1.0, 5.0), state_of(0.9, 1.0), state_of(0.1, 0.99)) == (
        "above",
        "within",
        "below",
    )
