"""Own shots fitted to a law of damage: SciPy's likelihood, coverage of the median, and data that
show no threshold.
"""

import math

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import log_ndtr

from neusee.nodes.laser import Shots, fit_shots, read_damage_laws

LEVELS = (200.0, 300.0, 500.0, 800.0, 1200.0, 2000.0)
HEADER = (
    "device,damage,wavelength from (nm),wavelength to (nm),duration from (ns),duration to"
    " (ns),level (J/cm2),shots,damaged,spot (um),source\n"
)
PLACE = "CMOS,point,900,910,1,100"


def shots_of(damaged, count=10, levels=LEVELS):
    return [Shots(level, count, hits) for level, hits in zip(levels, damaged, strict=True)]


def rows(damaged, place=PLACE):
    return "".join(
        f"{place},{level / 1e4},10,{hits},20,bench\n"
        for level, hits in zip(LEVELS, damaged, strict=True)
    )


@pytest.mark.parametrize("damaged", [(0, 1, 4, 6, 9, 10), (1, 0, 2, 5, 8, 9), (3, 4, 5, 5, 6, 8)])
def test_the_fit_has_the_largest_likelihood(damaged):
    """The optimum of SciPy, and the curvature of the logarithm of the likelihood by differences."""
    logs, hits = np.log(LEVELS), np.array(damaged, float)

    def misfit(parameters):
        away = (logs - parameters[0]) / math.exp(parameters[1])
        return -float((hits * log_ndtr(away) + (10 - hits) * log_ndtr(-away)).sum())

    best = minimize(
        misfit,
        [6.3, -0.5],
        method="Nelder-Mead",
        options={"xatol": 1e-10, "fatol": 1e-12, "maxiter": 4000},
    )
    found = fit_shots(shots_of(damaged))
    assert math.log(found.median) == pytest.approx(best.x[0], abs=1e-5)
    assert math.log(found.factor) == pytest.approx(math.exp(best.x[1]), rel=1e-4)
    step = 1e-3
    hessian = np.empty((2, 2))
    for i in range(2):
        for j in range(2):
            corners = [
                (a, b, best.x + step * (a * np.eye(2)[i] + b * np.eye(2)[j]))
                for a in (1, -1)
                for b in (1, -1)
            ]
            hessian[i, j] = sum(a * b * misfit(x) for a, b, x in corners) / (4 * step**2)
    deviation = math.sqrt(np.linalg.inv(hessian)[0, 0])
    # observed against expected information
    assert math.log(found.median_factor) == pytest.approx(deviation, rel=0.15)


def test_the_interval_holds_the_true_median_in_nine_of_ten_tests():
    draw, held, fitted = np.random.default_rng(3), 0, 0
    for _ in range(2000):
        hits = draw.binomial(
            20, [float(np.exp(log_ndtr(math.log(x / 600) / math.log(1.7)))) for x in LEVELS]
        )
        found = fit_shots(shots_of(hits, 20))
        if found.factor is None:
            continue
        fitted += 1
        held += abs(math.log(found.median / 600)) < 1.645 * math.log(found.median_factor)
    assert fitted > 1900
    assert held / fitted == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize("median", [150.0, 600.0, 3000.0])
def test_a_median_beyond_the_levels_is_as_uncertain_as_it_scatters_from_test_to_test(median):
    """Extrapolated from levels of which none is near, the median takes the error of the slope
    with it.
    """
    draw = np.random.default_rng(4)
    shares = [float(np.exp(log_ndtr(math.log(x / median) / math.log(2.0)))) for x in LEVELS]
    fits = [fit_shots(shots_of(draw.binomial(200, shares), 200)) for _ in range(300)]
    scatter = np.std([math.log(fit.median) for fit in fits])
    stated = np.median([math.log(fit.median_factor) for fit in fits])
    assert stated == pytest.approx(scatter, rel=0.12)


@pytest.mark.parametrize(("damaged", "low", "high"), [
    ((0, 0, 0, 10, 10, 10), 500.0, 800.0),
    ((0, 0, 5, 10, 10, 10), 300.0, 800.0),
])  # fmt: skip
def test_levels_without_overlap_leave_a_bracket_and_no_spread(damaged, low, high):
    found = fit_shots(shots_of(damaged))
    assert (found.low, found.high) == (low, high)
    assert found.median == pytest.approx(math.sqrt(low * high))
    assert found.factor is found.median_factor is None


@pytest.mark.parametrize(("damaged", "message"), [
    ((0, 0, 0, 0, 0, 0), "no shot was damaged.*add higher levels"),
    ((10, 10, 10, 10, 10, 10), "every shot was damaged.*add lower levels"),
    ((10, 9, 6, 4, 1, 0), "damage gets rarer with the level"),
    ((5, 10, 10, 10, 10, 10), "no level is without damage"),
    ((0, 0, 0, 0, 0, 5), "no level damaged with every shot"),
])  # fmt: skip
def test_shots_that_show_no_threshold_are_refused(damaged, message):
    with pytest.raises(ValueError, match=message):
        fit_shots(shots_of(damaged))


def test_one_level_is_no_threshold():
    with pytest.raises(ValueError, match="the shots have one level"):
        fit_shots([Shots(100.0, 10, 3), Shots(100.0, 10, 5)])


def test_a_table_of_shots_is_one_law_a_test(tmp_path):
    file = tmp_path / "shots.csv"
    other = PLACE.replace("point", "line")
    file.write_text(HEADER + rows((0, 1, 4, 6, 9, 10)) + rows((0, 0, 0, 10, 10, 10), other))
    point, line = read_damage_laws(file)
    expected = fit_shots(shots_of((0, 1, 4, 6, 9, 10)))
    assert (point.damage, point.quantity, point.spot) == ("point", "fluence", pytest.approx(20e-6))
    assert (point.median, point.factor) == (
        pytest.approx(expected.median),
        pytest.approx(expected.factor),
    )
    assert point.has_spread
    assert (line.damage, line.low, line.high) == (
        "line",
        pytest.approx(500.0),
        pytest.approx(800.0),
    )
    assert not line.has_spread


@pytest.mark.parametrize(("old", "new", "message"), [
    (",10,4,", ",10,11,", r"shots.csv:4, column 9, damaged: 11 damaged of 10 shots"),
    (",10,4,", ",0,0,", r"shots.csv:4, column 9, damaged: 0 damaged of 0 shots"),
    (",10,4,", ",10,4.5,", r"shots.csv:4, column 9, damaged: '4.5' is no whole number"),
    (",10,4,", ",ten,4,", r"shots.csv:4, column 8, shots: 'ten' is no whole number"),
    (",10,4,", ",10,-1,", r"shots.csv:4, column 9, damaged"),
    ("shots,damaged", "shots,hits", "no quantity 'hits'"),
    ("shots,", "factor,", "no column shots"),
    ("level (J/cm2)", "level", "has no unit"),
    ("0.05,", "-0.05,", "column 7, .* is not a finite number above 0"),
    ("spot (um)", "median factor", "the column median factor beside shots"),
])  # fmt: skip
def test_a_mistake_in_a_table_of_shots_is_told_with_its_place(tmp_path, old, new, message):
    text = HEADER + rows((0, 1, 4, 6, 9, 10))
    assert old in text
    (tmp_path / "shots.csv").write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_damage_laws(tmp_path / "shots.csv")


def test_shots_without_a_threshold_are_told_with_the_place_of_their_first_row(tmp_path):
    (tmp_path / "shots.csv").write_text(HEADER + rows((0,) * 6))
    with pytest.raises(
        ValueError, match=r"shots.csv:2, column 7, level \(J/cm2\): no shot was damaged"
    ):
        read_damage_laws(tmp_path / "shots.csv")
