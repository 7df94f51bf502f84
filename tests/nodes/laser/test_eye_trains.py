"""Limits of the eye for trains of pulses, against a second writing of the published rules and
hand-worked numbers.
"""

import math

import numpy as np
import pytest

from neusee.nodes import ParameterError
from neusee.nodes.laser import (
    TRAIN_RULES,
    beam,
    eye_limit,
    eye_limit_source,
    eye_mpe,
    eye_mpe_formula,
    eye_mpe_train,
    nominal_ocular_hazard_distance,
    train_limit,
)

#: C5 of the edition of 2014 below 5 mrad: nm, pulse s, rate Hz, exposure s -> pulses as one, groups
#: within 10 s, C5. Worked by hand: T_i 5 us below 1050 nm, 13 us from there; 1 up to 600; 5
#: N^(-1/4) above; 0.4 from 24 414 groups on.
GROUPS = [
    (905, 1e-8, 50.0, 10.0, 1.0, 500.0, 1.0),
    (905, 1e-8, 60.0, 10.0, 1.0, 600.0, 1.0),
    (905, 1e-8, 100.0, 10.0, 1.0, 1000.0, 0.88914),
    (905, 1e-8, 100.0, 100.0, 1.0, 1000.0, 0.88914),  # 10 s count, not 100 s
    (905, 1e-8, 2000.0, 10.0, 1.0, 20000.0, 0.42045),
    (905, 1e-8, 1e5, 10.0, 1.0, 1e6, 0.4),  # the period of 10 us is longer than T_i
    (905, 1e-8, 3e5, 10.0, 1.5, 2e6, 0.4),
    (1049, 1e-8, 1e6, 1.0, 5.0, 2e5, 0.4),
    (1064, 1e-8, 1e5, 10.0, 1.3, 10 / 13e-6, 0.4),
    (1064, 1e-8, 1e6, 0.25, 13.0, 0.25 / 13e-6, 1.0),  # up to 0.25 s
    (532, 1e-8, 1e4, 0.25, 1.0, 2500.0, 1.0),
    (532, 1e-8, 1e4, 0.26, 1.0, 2600.0, 0.70021),
    (532, 6e-6, 1e4, 10.0, 1.0, 1e5, 1.0),  # longer than T_i
    (1064, 6e-6, 1e4, 10.0, 1.0, 1e5, 0.4),  # shorter than T_i here
]


@pytest.mark.parametrize(("nm", "pulse", "rate", "seconds", "together", "count", "factor"), GROUPS)
def test_the_groups_and_the_factor_of_2014_are_those_worked_by_hand(
    nm, pulse, rate, seconds, together, count, factor
):
    train = train_limit(nm * 1e-9, pulse, rate, seconds, "IEC 60825-1:2014")
    assert train.together == pytest.approx(together, rel=1e-9)
    assert train.groups == pytest.approx(count, rel=1e-9)
    assert train.factor == pytest.approx(factor, rel=1e-4)


#: nm, pulse s, rate Hz, exposure s, rule -> J/m2 of a pulse by the rule for repeated pulses, worked
#: by hand
REPEATED = [
    # 0.1626 mJ/m2; T_i of 13 us would give 58 % more
    (905, 1e-8, 1e5, 10.0, "N^(-1/4)", 5.1404e-3 * 1e6**-0.25),
    (905, 1e-8, 3e5, 10.0, "N^(-1/4)", 5.1404e-3 / 1.5 * 2e6**-0.25),
    (905, 1e-8, 1e5, 100.0, "N^(-1/4)", 5.1404e-3 * 1e7**-0.25),  # the whole exposure counts
    (905, 1e-8, 2000.0, 10.0, "IEC 60825-1:2014", 5.1404e-3 * 0.42045),
    (1064, 1e-8, 1e6, 10.0, "IEC 60825-1:2014", 2e-2 / 13 * 0.4),
    (1064, 1e-8, 1e6, 10.0, "N^(-1/4)", 2e-2 / 13 * (10 / 13e-6) ** -0.25),
    (532, 1e-4, 100.0, 10.0, "IEC 60825-1:2014", 18 * 1e-4**0.75),
    (532, 1e-4, 100.0, 10.0, "N^(-1/4)", 18 * 1e-4**0.75 * 1000**-0.25),
]


@pytest.mark.parametrize(("nm", "pulse", "rate", "seconds", "rule", "expected"), REPEATED)
def test_the_limit_of_repeated_pulses_is_that_worked_by_hand(
    nm, pulse, rate, seconds, rule, expected
):
    assert train_limit(nm * 1e-9, pulse, rate, seconds, rule).repeated == pytest.approx(
        expected, rel=2e-4
    )


# --- the published tables, written a second time --------------------------------------------------


def factors(nm):
    """C4 and C7 of Table 9."""
    c4 = np.interp(nm, [400, 700, 1050, 1400], [0, 0, 0.7, 0.7])
    c7 = (
        0.0
        if nm < 1150
        else 0.018 * (nm - 1150)
        if nm < 1200
        else math.log10(8 + 10 ** ((nm - 1250) / 25))
    )
    return 10 ** (c4 if nm < 1050 else math.log10(5)), 10**c7


def one_pulse(nm, seconds):
    """Table A.1 in W/m2 for 400 to 1400 nm and 10 ps to 100 s, as irradiances, and the skin of
    Table A.5.
    """
    c4, c7 = factors(nm)
    flat, power, until = (2e-3, 18.0, 5e-6) if nm < 1050 else (2e-2, 90.0, 13e-6)
    weight = c4 if nm < 1050 else c7
    steps = [
        (until, flat / seconds),
        (10.0, power * seconds**-0.25),
        (math.inf, 10 * c4 * c7 / weight),
    ]
    retina = weight * next(value for end, value in steps if seconds <= end)
    if nm < 500 and seconds > 10:
        retina = min(retina, 10 ** max(0.0, (nm - 450) / 50) * max(1.0, 100 / seconds))
    if nm < 700:
        return retina
    skin = [(1e-9, 2e11), (1e-7, 200 / seconds), (10.0, 1.1e4 * seconds**-0.75), (math.inf, 2000.0)]
    return min(retina, c4 * next(value for end, value in skin if seconds <= end))


def drawn(count, seed):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        nm = rng.uniform(400, 1399)
        pulse = 10 ** rng.uniform(-10, -3)
        rate = 10 ** rng.uniform(0.5, math.log10(0.5 / pulse))
        yield nm, pulse, min(rate, 1e9), 10 ** rng.uniform(math.log10(max(2 * pulse, 1e-2)), 2)


def test_one_exposure_agrees_with_the_second_writing():
    for nm, pulse, _, seconds in drawn(500, 11):
        for t in (pulse, seconds):
            assert eye_mpe(nm * 1e-9, t) / t == pytest.approx(one_pulse(nm, t), rel=2e-3), (nm, t)


def test_trains_agree_with_the_second_writing_of_both_rules():
    for nm, pulse, rate, seconds in drawn(500, 12):
        period, group = 1 / rate, 5e-6 if nm < 1050 else 13e-6
        joined = period < group
        alone = one_pulse(nm, pulse) * pulse
        several = one_pulse(nm, group) * group * period / group if joined else alone
        per_group = group if joined else period
        new, old = max(1.0, min(seconds, 10) / per_group), max(1.0, seconds / per_group)
        c5 = (
            1.0
            if pulse > group or seconds <= 0.25 or new <= 600
            else min(1.0, max(0.4, 5 / new**0.25))
        )
        mean = one_pulse(nm, seconds) * min(seconds, period)
        if seconds * rate < 2 or seconds < 3 * group:
            continue
        expected = {
            "IEC 60825-1:2014": min(alone, mean, several * c5),
            "N^(-1/4)": min(alone, mean, several / old**0.25),
        }
        for rule, limit in expected.items():
            found = eye_mpe_train(nm * 1e-9, pulse, rate, seconds, rule)
            assert found == pytest.approx(limit, rel=3e-3), (nm, pulse, rate, seconds, rule)


@pytest.mark.parametrize("rule", TRAIN_RULES)
def test_no_rule_lets_more_pass_than_one_pulse_or_the_mean(rule):
    for nm, pulse, rate, seconds in drawn(200, 13):
        if seconds * rate < 1.5:
            continue
        limit = eye_mpe_train(nm * 1e-9, pulse, rate, seconds, rule)
        assert limit <= eye_mpe(nm * 1e-9, pulse) * (1 + 1e-12)
        assert limit * rate * seconds <= eye_mpe(nm * 1e-9, seconds) * (1 + 1e-12)


def test_the_older_factor_is_never_less_strict():
    for nm, pulse, rate, seconds in drawn(300, 14):
        if seconds * rate < 1.5:
            continue
        limits = [
            eye_mpe_train(nm * 1e-9, pulse, rate, seconds, rule)
            for rule in ("N^(-1/4)", "IEC 60825-1:2014")
        ]
        assert limits[0] <= limits[1] * (1 + 1e-12)


def test_from_1400_nm_no_rule_for_repeated_pulses_is_applied():
    train = train_limit(1550e-9, 5e-9, 1e5, 10)
    assert (train.repeated, train.factor) == (math.inf, 1.0)
    assert train.limit == train.mean == pytest.approx(1e4 / 1e6, rel=1e-12)
    assert train.strictest == "mean"


def test_a_pulse_longer_than_the_period_or_the_exposure_is_refused():
    for rate, seconds in ((1e4, 10.0), (10.0, 1e-4)):
        with pytest.raises(ParameterError, match="too long") as raised:
            train_limit(905e-9, 1e-3, rate, seconds)
        assert raised.value.parameter == "pulse_duration"


# --- the rule that is printed is the one that is computed -----------------------------------------

TRAIN = beam(905e-9, pulse_energy=1e-6, pulse_duration=5e-9, repetition_rate=2e3, divergence=2e-3)


@pytest.mark.parametrize("rule", TRAIN_RULES)
def test_the_source_names_the_rule_and_the_factor_that_were_computed(rule):
    text, limit = eye_limit_source(TRAIN, 10, rule), eye_limit(TRAIN, 10, rule)
    train = train_limit(905e-9, 5e-9, 2e3, 10, rule)
    assert limit == train.limit
    assert f"{train.factor:.3g}" in text
    assert ("2014 decides" in text or "edition of 2014" in text) == (rule == "IEC 60825-1:2014")
    assert ("edition of 2007" in text) == (rule == "N^(-1/4)")
    assert f"{train.strictest} decides" in text


def test_the_two_rules_give_the_numbers_that_their_names_promise():
    single = 2e-3 * 10 ** (0.002 * 205)
    assert eye_limit(TRAIN, 10) == pytest.approx(single * 5 * 2e4**-0.25, rel=1e-12)
    assert eye_limit(TRAIN, 10, "N^(-1/4)") == pytest.approx(single * 2e4**-0.25, rel=1e-12)
    near, far = (nominal_ocular_hazard_distance(TRAIN, 10, rule=rule) for rule in TRAIN_RULES)
    assert near < far


def test_beams_without_a_train_name_no_rule_of_trains():
    steady = beam(532e-9, power=1e-3, divergence=1e-3)
    single = beam(1064e-9, pulse_energy=0.1, pulse_duration=1e-8, divergence=1e-3)
    for laser, words in ((steady, "continuous light for 0.25 s"), (single, "one pulse")):
        for rule in TRAIN_RULES:
            text = eye_limit_source(laser, 0.25, rule)
            assert text.endswith(words)
            assert "N^(-1/4)" not in text
            assert "C5" not in text
    assert "C5" not in eye_limit_source(TRAIN._replace(wavelength=1550e-9), 10)


# --- worked examples that others printed ----------------------------------------------------------


@pytest.mark.parametrize(
    ("watts", "metres"),
    [(1.0, 225.0), (5.0, 500.0)],  # handbooks of laser shows and laserpointersafety.com, 1 mrad
)
def test_published_hazard_distances_of_show_lasers_are_met(watts, metres):
    show = beam(532e-9, power=watts, divergence=1e-3, waist=0.5e-3, convention="1/e")
    assert nominal_ocular_hazard_distance(show) == pytest.approx(metres, rel=0.01)


def test_the_reference_case_of_a_public_calculator_is_met():
    """3 W, 5 mm and 1 mrad at 1/e2, 0.25 s: 547.8 m at 25.46 W/m2."""
    show = beam(520e-9, power=3.0, waist=2.5e-3, divergence=1e-3)
    assert eye_limit(show, 0.25) == pytest.approx(25.46, rel=2e-4)
    assert nominal_ocular_hazard_distance(show) == pytest.approx(547.8, rel=2e-3)


def test_the_formula_that_is_printed_gives_the_limit():
    """The worksheet shows it; Python reads it as it stands."""
    rng = np.random.default_rng(15)
    for _ in range(1000):
        nm, seconds = 10 ** rng.uniform(math.log10(400), 4), 10 ** rng.uniform(-11, 4)
        text = eye_mpe_formula(nm * 1e-9, seconds)
        assert eval(text, {"__builtins__": {}}) == pytest.approx(
            eye_mpe(nm * 1e-9, seconds), rel=1e-5
        ), text
