"""Damage by the light on a sensor: heat by a direct sum, verdicts that no camera setting moves,
dead pixels.
"""

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm

from neusee.nodes import Check, ParameterError
from neusee.nodes.laser import (
    KINDS,
    PUBLISHED_DAMAGE,
    SpotDamage,
    airy_diameter,
    damage,
    damaged_pixels,
    steady_heat,
)
from neusee.nodes.values import Bands, LaserLight

PITCH, SHAPE = 2.9e-6, (64, 80)
SENSOR = {"pixel_pitch": PITCH, "exposure": 0.1, "dwell": 0.1}
CMOS = next(
    law for law in PUBLISHED_DAMAGE if law.device == "CMOS" and law.quantity == "irradiance"
)
HEADER = (
    "device,damage,wavelength from (nm),wavelength to (nm),duration from (ns),duration to (ns),"
    "threshold (J/cm2),factor,median factor,spot (um),source\n"
)
STEADY = "CMOS,point,500,1100,0.001,10,40,1.6,1.2,30,own test\n"
INFRARED = (
    "CMOS,point,1500,1600,1,100,0.5,1.6,1.2,20,own test\nCMOS,line,1500,1600,1,100,1.5,,,20,own"
    " test\n"
)


def line(nm=532.0):
    return Bands(*(torch.tensor([x], dtype=torch.float64) for x in (nm * 1e-9, 1e-9, 1.0)))


def radii(shape=SHAPE):
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in shape)
    return torch.hypot(y[:, None], x) * PITCH


def gaussian(peak, diameter, shape=SHAPE):
    return (peak * torch.exp(-8 * (radii(shape) / diameter) ** 2))[None]


def train(pulses):
    return LaserLight(*(torch.tensor(x, dtype=torch.float64) for x in (0, 0, 0, 0, 0, pulses, 1)))


def test_the_heat_is_the_direct_sum_over_all_pixels():
    image = torch.rand(6, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = np.zeros((6, 8))
    inside = (np.arange(400) + 0.5) / 400 - 0.5  # the mean of 1 / r over a pixel by many points
    near = {
        (y, x): (1 / np.hypot(inside[:, None] + y, inside + x)).mean()
        for y in range(6)
        for x in range(8)
    }
    for y in range(6):
        for x in range(8):
            for j in range(6):
                for i in range(8):
                    expected[y, x] += (
                        float(image[j, i]) * PITCH / (2 * np.pi) * near[abs(y - j), abs(x - i)]
                    )
    np.testing.assert_allclose(steady_heat(image, PITCH).numpy(), expected, rtol=5e-4)


@pytest.mark.parametrize("diameter", [28e-6, 40e-6, 60e-6])
def test_a_wider_gaussian_spot_is_at_the_threshold_where_it_heats_as_the_published_one(diameter):
    found = damage(gaussian(1e8, diameter, (160, 160)), line(), **SENSOR)
    assert found.ratio[:4].tolist() == pytest.approx(
        [1e8 / CMOS.median * diameter / CMOS.spot] * 4, rel=0.02
    )
    assert float(found.threshold[0]) == pytest.approx(CMOS.median * CMOS.spot / diameter, rel=0.02)
    assert float(found.peak[0]) == pytest.approx(1e8)


@pytest.mark.parametrize("diameter", [9e-6, 15e-6, 25e-6])
def test_a_narrower_spot_is_judged_as_the_published_one_unless_a_bonus_is_asked_for(diameter):
    spot = gaussian(1e8, diameter)
    found = damage(spot, line(), **SENSOR)
    assert float(found.ratio[0]) == pytest.approx(1e8 / CMOS.median)
    # 10 of 10 to 100 kW/cm2
    assert (float(found.least[0]), float(found.most[0])) == pytest.approx((0.1, 1.0))
    bonus = damage(spot, line(), **SENSOR, small_spot_exponent=1.0)
    assert float(bonus.ratio[0]) == pytest.approx(
        1e8 / CMOS.median * diameter / CMOS.spot, rel=0.02
    )


def test_an_airy_spot_is_judged_by_its_equivalent_diameter():
    number = 40.0
    reach = math.pi * radii((400, 400)) / (532e-9 * number)
    airy = torch.where(reach > 0, (2 * torch.special.bessel_j1(reach) / reach).square(), 1.0)
    found = damage(1e8 * airy[None], line(), **SENSOR)
    expected = 1e8 / CMOS.median * airy_diameter(532e-9, number) / CMOS.spot
    assert float(found.ratio[0]) == pytest.approx(expected, rel=0.03)


def test_a_probability_is_stated_for_data_of_devices_alone(tmp_path):
    (tmp_path / "own.csv").write_text(
        HEADER.replace("J/cm2", "kW/cm2").replace("(ns)", "(s)") + STEADY
    )
    spot = gaussian(2e8, 15e-6)
    found = damage(spot, line(), **SENSOR, thresholds=tmp_path / "own.csv")
    away = math.log(0.5) / math.log(1.6)
    moved = 1.6449 * math.log(1.2) / math.log(1.6)
    for column, shift in ((found.probability, 0.0), (found.low, -moved), (found.high, moved)):
        assert float(column[0]) == pytest.approx(norm.cdf(away + shift), rel=1e-3)
    published = damage(spot, line(), **SENSOR)
    assert published.probability.tolist() == published.high.tolist() == [-1.0] * 4


def test_the_verdict_is_the_same_for_every_exposure_of_a_continuous_laser():
    every = [
        damage(gaussian(2e8, 20e-6), line(), **{**SENSOR, "exposure": t}) for t in (1e-6, 1e-3, 1.0)
    ]
    for other in every[1:]:
        for one, same in zip(every[0], other, strict=True):
            assert torch.equal(one, same)


@pytest.mark.parametrize("exposure", [1e-6, 1e-3, 1.0])
@pytest.mark.parametrize("pulses", [1.0, 0.5, 20.0])
def test_the_fluence_of_a_pulse_is_the_same_for_every_exposure(exposure, pulses):
    """The spot is the mean over the exposure, of which the shutter catches some pulses, or a
    part of one.
    """
    fluence = 900.0
    mean = gaussian(fluence * pulses / exposure, 12e-6)
    choice = {**SENSOR, "exposure": exposure, "pulse_duration": 10e-9}
    found = damage(mean, line(), train(pulses), **choice)
    # pulse, mean, accumulation, incubation, and three further kinds of one pulse
    assert len(found.ratio) == 4 + 3
    assert float(found.ratio[0]) == pytest.approx(0.9)
    assert found.ratio[4:].tolist() == pytest.approx([9e-4, 900 / 2419, 900 / 20054])
    rate = pulses / exposure if pulses > 1 else 1 / SENSOR["dwell"]
    rate = max(rate, 1 / SENSOR["dwell"])
    assert float(found.ratio[1]) == pytest.approx(fluence * rate / 10**8.5)
    # duty at most 1 %
    assert float(found.ratio[2]) == pytest.approx(0.9 + fluence * rate / 10**8.5, rel=0.011)
    assert found.probability.tolist() == [-1.0] * 7
    if pulses == 1:
        torch.testing.assert_close(damage(mean, line(), **choice).ratio, found.ratio)


def test_a_pulse_that_the_shutter_misses_is_not_judged_and_never_safe():
    spot = gaussian(0.0, 12e-6)
    choice = {**SENSOR, "pulse_duration": 10e-9}
    found = damage(spot, line(), train(0.0), **choice)
    assert found.ratio.isnan().all()
    checks = damage.hooks.check(found, spot, line(), train(0.0), **choice)
    assert not any(check.ok for check in checks)
    assert checks[0].text == "damage is not judged: a part of the light has no law"
    assert "every pulse hits the sensor: give the laser a pulse_delay of 0" in checks[1].text


def test_the_megawatts_of_a_long_pulse_are_not_hidden_by_its_mean():
    """1 mJ in 1 us at 10 Hz: the mean was 0.34 of the threshold, and the pulse 3.4e4 times its
    own.
    """
    fluence = 7.3e7  # J/m2
    choice = {
        **SENSOR,
        "dwell": 1.0,
        "exposure": 0.1,
        "pulse_duration": 1e-6,
        "repetition_rate": 10.0,
    }
    spot = gaussian(fluence / 0.1, 5e-6)
    found = damage(spot, line(), train(1.0), **choice)
    assert float(found.ratio[0]) == pytest.approx(7.3e3 / 0.2154, rel=1e-3)
    assert float(found.least[0]) > 1e3
    checks = damage.hooks.check(found, spot, line(), train(1.0), **choice)
    assert checks[0].text == "damage is expected"


def test_at_1550_nm_own_thresholds_are_judged_and_the_mean_is_said_to_be_open(tmp_path):
    own = tmp_path / "own.csv"
    own.write_text(HEADER + INFRARED)
    choice = {**SENSOR, "pulse_duration": 5e-9, "thresholds": own}
    spot = gaussian(1e4 / 0.1, 15e-6)
    found = damage(spot, line(1550), **choice)
    assert found.ratio[[0, 4]].tolist() == pytest.approx([2.0, 2 / 3])
    assert float(found.probability[0]) == pytest.approx(norm.cdf(math.log(2) / math.log(1.6)))
    assert float(found.probability[4]) == -1.0
    assert found.ratio[1:3].isnan().all()
    notes = damage.hooks.preflight(line=line(1550), **choice)
    assert notes[0].startswith("pulse, point: 0.5 (0.")
    assert (
        notes[1]
        == "mean, point: not judged: no law of damage at 1550 nm: published laws are used from 400"
        " to 1100 nm"
    )
    dim = gaussian(1.0, 15e-6)
    checks = damage.hooks.check(damage(dim, line(1550), **choice), dim, line(1550), **choice)
    assert checks[0] == Check("damage is not judged: a part of the light has no law", False)


@pytest.mark.parametrize(("nm", "change", "message"), [
    (1550, {}, "no law of damage at 1550 nm"),
    (399, {"pulse_duration": 5e-9}, "no law of damage at 399 nm"),
    (532, {"device": "InGaAs"}, "no law of damage for the device InGaAs: there are published laws for CCD, CMOS"),
])  # fmt: skip
def test_a_laser_without_a_law_is_not_judged_and_refuses_nothing(nm, change, message):
    """Once one laser at 1550 nm refused the whole recipe."""
    notes = damage.hooks.preflight(line=line(nm), light=train(50.0), **SENSOR | change)
    assert all(f"not judged: {message}" in note for note in notes)
    spot = gaussian(1.0, 12e-6)
    found = damage(spot, line(nm), train(50.0), **SENSOR | change)
    assert found.ratio.isnan().all()
    assert int(found.pattern.max()) == 0
    checks = damage.hooks.check(found, spot, line(nm), train(50.0), **SENSOR | change)
    assert not any(check.ok for check in checks)


@pytest.mark.parametrize(("nm", "change"), [
    (905, {"pulse_duration": 5e-9}),
    (532, {"pulse_duration": 1e-3}),
    (532, {"dwell": 1e-6}),
    (650, {}),
])  # fmt: skip
def test_lasers_that_were_refused_before_are_judged(nm, change):
    found = damage(gaussian(1.0, 12e-6), line(nm), **SENSOR | change)
    assert len(found.ratio) >= 4
    assert found.ratio.isfinite().all()
    assert (found.least <= found.ratio).all()
    assert (found.ratio <= found.most).all()


def test_a_mistake_in_the_file_of_thresholds_is_told_before_the_run(tmp_path):
    own = tmp_path / "own.csv"
    own.write_text(HEADER + INFRARED.replace("0.5", "half"))
    with pytest.raises(
        ParameterError, match=r"own.csv:2, column 7, threshold \(J/cm2\): 'half'"
    ) as raised:
        damage.hooks.preflight(dwell=0.1, thresholds=own)
    assert raised.value.parameter == "thresholds"


def test_each_part_has_a_sentence_with_its_numbers_and_the_verdict_comes_first():
    spot = gaussian(2e3 / 0.1, 12e-6)
    choice = {**SENSOR, "pulse_duration": 10e-9}
    checks = damage.hooks.check(damage(spot, line(), **choice), spot, line(), **choice)
    assert (
        checks[0].text
        == "damage cannot be excluded: a part of the light is within the bracket of its threshold"
    )
    assert checks[1].text == "pulse, point: 0.2 of 0.1 J/cm2, 2 (0.316 to 12.6) times the threshold"
    assert [check.ok for check in checks] == [False, False, True, False, False, True, False, True]
    dim = gaussian(1.0, CMOS.spot)
    first, *_ = damage.hooks.check(damage(dim, line(), **SENSOR), dim, line(), **SENSOR)
    assert first.ok
    assert first.text.startswith(
        "no damage is expected: every part of the light is judged and below"
    )


def test_pulses_below_a_nanosecond_are_judged_from_above_alone():
    choice = {**SENSOR, "pulse_duration": 1e-13}
    for fluence, state in ((1e3, "not judged"), (1e4, "expected")):
        spot = gaussian(fluence / 0.1, 12e-6)
        found = damage(spot, line(), **choice)
        assert float(found.least[0]) == pytest.approx(fluence / 1e3 / math.sqrt(40))
        assert math.isinf(float(found.most[0]))
        checks = damage.hooks.check(found, spot, line(), **choice)
        assert state in checks[0].text


def pattern(**places):
    found = torch.zeros(7, 9, dtype=torch.uint8)
    for kind, (y, x) in places.items():
        found[y, x] += 1 << KINDS.index(kind)
    empty = torch.zeros(0, dtype=torch.float64)
    return SpotDamage(*[empty] * 8, pattern=found)


def test_the_pattern_has_the_pixels_beyond_the_threshold_of_the_device():
    spot = gaussian(3e3 / 0.1, 20e-6)
    choice = {**SENSOR, "pulse_duration": 10e-9}
    for resilience in (0.5, 1.0, 2.0):
        found = damage(spot, line(), **choice, resilience=resilience).pattern
        for kind, threshold in (
            ("point", 999.0),
            ("cross", 2419.0),
            ("frame", 20054.0),
            ("destruction", 1e6),
        ):
            marked = (found >> KINDS.index(kind)) % 2 == 1
            assert torch.equal(marked, spot[0] * 0.1 >= threshold * resilience), kind


@pytest.mark.parametrize(("places", "device", "white", "black"), [
    ({}, "CMOS", [], []),
    ({"point": (2, 3)}, "CMOS", np.s_[2:3, 3:4], []),
    ({"destruction": (2, 3)}, "CMOS", [], np.s_[2:3, 3:4]),
    ({"line": (2, 3)}, "CMOS", [], np.s_[2:3, :]),
    ({"line": (2, 3)}, "CCD", np.s_[:, 3:4], []),
    ({"frame": (2, 3), "point": (4, 4)}, "CMOS", [], np.s_[:, :]),
])  # fmt: skip
def test_each_kind_of_damage_has_its_pattern_in_the_frame(places, device, white, black):
    raw = torch.full((3, 5, 7), 100.0)
    expected = np.full((5, 7), 100.0)
    for where, value in ((white, 999.0), (black, 0.0)):  # the sensor is the middle of the scene
        if where:
            inside = tuple(slice(s.start and s.start - 1, s.stop and s.stop - 1) for s in where)
            expected[inside] = value
    found = damaged_pixels(raw, [pattern(**places)], full_well=1000.0, gain=1.0, device=device)
    for channel in found:
        np.testing.assert_array_equal(channel.numpy(), expected)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_frame_in_half_precision_holds_the_white_of_sixteen_bits(dtype):
    raw = torch.full((1, 5, 7), 100.0, dtype=dtype)
    found = damaged_pixels(raw, [pattern(point=(2, 3))], full_well=1e6, gain=1.0)
    assert found.dtype == torch.float32
    assert float(found.max()) == 2**16 - 1


def test_a_cross_is_a_row_and_a_column_and_lasers_add_up():
    raw = torch.full((1, 5, 7), 100.0)
    found = damaged_pixels(
        raw, [pattern(cross=(2, 3)), pattern(point=(4, 5))], full_well=1e6, gain=1.0, bits=8
    )[0]
    expected = torch.full((5, 7), 100.0)
    expected[3, 4] = 255.0
    expected[1, :], expected[:, 2] = 0.0, 0.0
    assert torch.equal(found, expected)
    assert torch.equal(damaged_pixels(raw, full_well=1e6, gain=1.0), raw)
    assert not damaged_pixels.hooks.check(found[None], raw)[0].ok
