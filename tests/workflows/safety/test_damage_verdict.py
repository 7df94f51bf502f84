"""The verdict of damage: where a laser is beside its thresholds, which part is named, and what
never reads as safe.
"""

import math
from itertools import pairwise
from types import SimpleNamespace

import pytest

from neusee.workflows import load
from neusee.workflows.safety.exposures import Spread
from neusee.workflows.safety.safety_estimate import (
    DamageRow,
    DamageVerdict,
    estimate,
    state_of_finding,
)

pytestmark = pytest.mark.usefixtures("without_remedies")
QUICK = [
    "safety.draws=100",
    "safety.protection.mask=null",
    "safety.protection.spots={}",
    "optics.samples=256",
]


def finding(ratio, low=None, high=None, open_below=False):
    """Return what a limit of damage says of one part of the light, with nothing but its ratios."""
    spread = Spread(ratio, ratio if low is None else low, ratio if high is None else high)
    return SimpleNamespace(ratio=ratio, ratios=spread, limit=SimpleNamespace(open_below=open_below))


def row(part, state, ratio=None):
    return DamageRow(
        part, "point", state, "" if ratio else "no law", finding(ratio) if ratio else None
    )


def named(state, *rows):
    """Return the part that a verdict names."""
    return DamageVerdict("lens", state, tuple(row(*each) for each in rows)).nearest.part


@pytest.mark.parametrize(("low", "high", "open_below", "state"), [
    (0.2, 0.9, False, "below"),
    (0.2, 1.0, False, "within"),
    (0.99, 1.1, False, "within"),
    (1.0, 30.0, False, "above"),
    (0.2, 0.9, True, "not judged"),
    (1.0, 30.0, True, "above"),
])  # fmt: skip
def test_the_ends_of_the_ratio_decide_and_not_its_middle(low, high, open_below, state):
    """Above needs every draw beyond the threshold, below needs none; from above alone nothing
    reads as safe.
    """
    assert state_of_finding(finding(math.sqrt(low * high), low, high, open_below)) == state


def test_the_verdict_names_the_largest_ratio_of_its_own_state():
    """A pulse that is above stands before a mean with a larger ratio, whose bracket is wider."""
    assert named(
        "above", ("pulse", "above", 3.0), ("mean", "within", 5.0), ("accumulation", "above", 7.0)
    ) == ("accumulation")
    assert named("within", ("pulse", "within", 0.3), ("mean", "below", 0.5)) == "pulse"


def test_a_simpler_part_is_named_in_place_of_one_that_is_alike():
    assert (
        named(
            "above",
            ("pulse", "above", 3.0),
            ("mean", "above", 1.0),
            ("accumulation", "above", 3.02),
        )
        == "pulse"
    )
    assert named(
        "above", ("pulse", "above", 3.0), ("mean", "above", 1.0), ("accumulation", "above", 3.2)
    ) == ("accumulation")


def test_an_assumption_is_named_where_nothing_else_has_the_state_of_the_verdict():
    """Incubation is not measured: it excuses no safety, and convicts only where no measured part
    does.
    """
    rows = [
        ("pulse", "within", 2.0),
        ("accumulation", "within", 2.1),
        ("incubation", "within", 9.0),
    ]
    assert named("within", *rows) == "accumulation"
    assert named("within", ("pulse", "below", 0.1), ("incubation", "within", 0.8)) == "incubation"
    assert named("below", ("pulse", "below", 0.1), ("incubation", "below", 0.4)) == "incubation"


def test_a_verdict_that_is_not_judged_names_what_is_judged():
    assert named(
        "not judged",
        ("pulse", "within", 0.4),
        ("mean", "not judged"),
        ("incubation", "within", 2.0),
    ) == ("pulse")
    beyond = DamageVerdict(
        "lens", "not judged", (row("pulse", "not judged", 0.4), row("mean", "within", 0.2))
    )
    assert (beyond.nearest.part, [each.part for each in beyond.unjudged]) == ("mean", ["pulse"])
    upper_ends_alone = DamageVerdict("lens", "not judged", (row("pulse", "not judged", 0.4),))
    assert upper_ends_alone.nearest.part == "pulse"
    assert DamageVerdict("lens", "not judged", (row("pulse", "not judged"),)).nearest is None


@pytest.fixture(scope="module")
def continuous(without_remedies):
    return estimate(
        load("safety_pointer", [*QUICK, "safety.dazzle=null", "lasers.pointer.power=50 W"])
    )


@pytest.fixture(scope="module")
def pulsed(without_remedies):
    return estimate(load("safety_car_lidar", QUICK))


def test_continuous_light_has_the_rows_of_its_pulse_its_mean_and_its_heat_alike(continuous):
    for verdict in continuous.damage:
        assert [each.part for each in verdict.rows] == ["pulse", "mean", "accumulation"]
        assert all(one == other for one, other in pairwise([each.finding for each in verdict.rows]))


def test_each_protection_has_the_findings_of_its_own_limits_of_damage(pulsed):
    assert len(pulsed.damage) == len(pulsed.options) > 1
    for verdict in pulsed.damage:
        for each in verdict.rows:
            assert each.finding.option == verdict.option
            assert each.finding.limit.effect == "damage"
            assert each.finding.limit.part == each.part
            assert each.reason == "" or each.state == "not judged"


def test_the_verdict_is_the_worst_of_its_rows(pulsed):
    order = ("above", "not judged", "within", "below")
    for verdict in pulsed.damage:
        assert verdict.state == order[min(order.index(each.state) for each in verdict.rows)]


@pytest.mark.parametrize(("energy", "state"), [("10 J", "above"), ("1e-3 nJ", "not judged")])
def test_a_part_has_a_reason_only_where_it_is_not_judged(energy, state):
    """Pulses of picoseconds have an upper end of their threshold: far beyond it, damage is sure
    and needs no excuse.
    """
    alone = ["safety.protection={}", "lasers.lidar.pulse_duration=10 ps"]
    (verdict,) = estimate(
        load(
            "safety_car_lidar",
            [
                "safety.draws=100",
                "safety.dazzle=null",
                *alone,
                f"lasers.lidar.pulse_energy={energy}",
            ],
        )
    ).damage
    pulse = verdict.rows[0]
    assert (pulse.part, pulse.state, verdict.state) == ("pulse", state, state)
    assert bool(pulse.reason) == (state == "not judged")
