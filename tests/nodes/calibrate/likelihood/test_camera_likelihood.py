"""A real camera weighed: against the law written out once more, its extremes, and what was
believed beforehand.
"""

import math

import pytest
import torch
from scipy.optimize import brentq
from scipy.stats import norm

from neusee.nodes.calibrate import CAMERA_NAMES, CameraCoordinates, camera, camera_prior
from neusee.nodes.units import read_quantity
from neusee.nodes.values import Levels

SENSOR = {"gain": 0.5, "quantum_efficiency": 0.4, "dark_signal": 50.0, "temporal_dark_noise": 8.0}
SENSOR |= {
    "dark_current": 30.0,
    "dark_exposure": 0.5,
    "scatter": 0.004,
    "lamp": 0.012,
    "drift": 0.05,
}
BENT = {"bend": -0.03, "twist": 0.02}
PHOTONS = [0.0, 0.0, 300.0, 1500.0, 4000.0, 7000.0, 10000.0, 13000.0]
EXPOSURE = [0.02, 0.4, 0.02, 0.02, 0.1, 0.1, 0.2, 0.2]


def around(seed=3, photons=PHOTONS, exposure=EXPOSURE):
    """Levels that are near the law of `SENSOR`, and no better."""
    rng = torch.Generator().manual_seed(seed)
    light, time = (
        torch.tensor(photons, dtype=torch.float64),
        torch.tensor(exposure, dtype=torch.float64),
    )
    electrons = 0.4 * light * (1 + 0.012 * torch.randn(len(light), generator=rng)) + 60 * (
        time - time.min()
    )
    mean = 50 + 0.5 * electrons + 0.05 * torch.randn(len(light), generator=rng)
    variance = (0.25 * (64 + electrons) + 1 / 12) * (
        1 + 0.006 * torch.randn(len(light), generator=rng)
    )
    none, one = torch.zeros(0, dtype=torch.float64), torch.ones_like(light)
    return Levels(light, time, 8e4 * one, mean, variance, 4e4 * one, none.long(), none, none)


def exact():
    found = around()
    electrons = 0.4 * found.photons + 60 * (found.exposure - 0.02)
    return found._replace(mean=50 + 0.5 * electrons, variance=0.25 * (64 + electrons) + 1 / 12)


def plainly(levels, seen, *, bend, twist):
    """The same, level by level: the response inverted by search and its slope by a difference."""
    top = max(float(levels.mean[i] - levels.mean[0]) for i in seen)

    def response(e):
        """y = K e (1 + bend y/top + twist (y/top)**2), from y = K e on."""
        return brentq(
            lambda y: y - 0.5 * e * (1 + bend * y / top + twist * (y / top) ** 2),
            -200,
            4000,
            xtol=1e-13,
        )

    total = 0.0
    for i in seen:
        y, v, p, t = (
            float(x[i])
            for x in (levels.mean - 50, levels.variance, levels.photons, levels.exposure)
        )
        e = brentq(lambda e, y=y: response(e) - y, -100, 7000, xtol=1e-12)
        slope = (response(e + 0.5) - response(e - 0.5)) / 1.0
        law = slope**2 * (8.0**2 + e) + 1 / 12
        total += norm.logpdf(
            math.log(v), math.log(law) - 1 / 4e4, math.hypot(math.sqrt(2 / 4e4), 0.004)
        )
        width = math.sqrt((0.012 * 0.4 * p * slope) ** 2 + v / 8e4 + 0.05**2)
        total += norm.logpdf((e - 0.4 * p - 60 * (t - 0.02)) * slope, 0.0, width)
    return total + len(seen) * math.log(2 * math.pi)  # constants are left out


@pytest.mark.parametrize("bent", [{"bend": 0.0, "twist": 0.0}, BENT, {"bend": 0.1, "twist": -0.05}])
def test_the_law_is_that_which_is_written_out(bent):
    levels = around()
    assert float(camera(levels, **SENSOR, **bent, share=1.0).log) == pytest.approx(
        plainly(levels, range(8), **bent), rel=1e-7
    )
    assert float(camera(levels, **SENSOR, **bent).log) == pytest.approx(
        plainly(levels, range(6), **bent), rel=1e-7
    )


def test_levels_on_the_law_leave_no_deviance_and_each_parameter_matters():
    at = camera(exact(), **SENSOR, share=1.0)
    assert float(at.deviance.sum()) < 1e-3
    assert at.degrees_of_freedom.tolist() == [2.0] * 8
    for name in (
        "gain",
        "quantum_efficiency",
        "dark_signal",
        "temporal_dark_noise",
        "dark_current",
    ):
        assert float(camera(exact(), **{**SENSOR, name: 1.2 * SENSOR[name]}).deviance.sum()) > 5
    for name in ("bend", "twist"):
        assert float(camera(exact(), **SENSOR, **{name: 0.1}).deviance.sum()) > 5


def test_many_cameras_are_weighed_at_once_as_one_by_one():
    rows = {
        name: torch.tensor([x, 1.01 * x, 0.98 * x], dtype=torch.float64) for name, x in BENT.items()
    }
    rows["gain"] = torch.tensor([0.5, 0.51, 0.49], dtype=torch.float64)
    given = {**SENSOR, **BENT}
    together = camera(around(), **{**given, **rows})
    assert together.scaled.shape == (3, 4 * 6)
    assert together.deviance.shape == (3, 8)
    for i in range(3):
        one = camera(around(), **{**given, **{name: float(x[i]) for name, x in rows.items()}})
        for a, b in zip(together, one, strict=True):
            assert torch.equal(a[i] if a.ndim > b.ndim or a.ndim == 2 else a, b)
    quick = camera(around(), **{**given, **rows}, told=False)
    assert torch.equal(quick.log, together.log)
    assert len(quick.degrees_of_freedom) == 0


def test_the_unit_of_the_gain_is_as_written():
    written = camera(around(), **{**SENSOR, "gain": read_quantity("2.0 e-/DN", "DN/e-")})
    assert float(written.log) == float(camera(around(), **SENSOR).log)


@pytest.mark.parametrize("name", [*CAMERA_NAMES])
def test_slopes_are_smooth(name):
    """Central differences of ever smaller steps agree, also at no bend, and with those of
    automatic gradients.
    """
    for base in ({**SENSOR, "bend": 0.0, "twist": 0.0}, {**SENSOR, **BENT}):
        size = abs(base[name]) or 0.1

        def log(x, base=base):
            return camera(around(), **{**base, name: x}, told=False).log

        found = []
        for step in (1e-3, 3e-4, 1e-4):
            ends = log(
                torch.tensor(
                    [base[name] + step * size, base[name] - step * size], dtype=torch.float64
                )
            )
            found.append(float(ends[0] - ends[1]) / (2 * step * size))
        x = torch.tensor(base[name], dtype=torch.float64, requires_grad=True)
        log(x).backward()
        assert found == pytest.approx([float(x.grad)] * 3, rel=2e-3, abs=1e-3 / size)


def test_what_levels_tell_is_the_information_of_the_law():
    """Over many measurements, slopes of the logarithm scatter as J^T J says."""
    names, step = ("gain", "quantum_efficiency", "temporal_dark_noise", "scatter", "lamp"), 1e-4
    moved = []
    for i in range(len(names)):
        for sign in (1, -1):
            moved.append([SENSOR[n] * (1 + sign * step * (i == j)) for j, n in enumerate(names)])
    given = {
        n: torch.tensor(x, dtype=torch.float64)
        for n, x in zip(names, zip(*moved, strict=True), strict=True)
    }
    light, time = [0.0] * 8 + [400.0 * i for i in range(1, 33)], [0.02] * 40
    told, slopes = [], []
    for seed in range(200):
        found = camera(exact_law(seed, light, time), **{**SENSOR, **given}, share=1.0)
        told.append((found.scaled[::2] - found.scaled[1::2]) / (2 * step))
        slopes.append((found.log[::2] - found.log[1::2]) / (2 * step))
    information = torch.stack([j @ j.T for j in told]).mean(0)
    scatter = torch.stack(slopes).T.cov()
    assert (scatter.diagonal() / information.diagonal()).tolist() == pytest.approx(
        [1.0] * 5, abs=0.35
    )


def exact_law(seed, photons, exposure):
    """Levels drawn from the very law of `SENSOR`."""
    rng = torch.Generator().manual_seed(seed)

    def normal():
        return torch.randn(len(photons), generator=rng, dtype=torch.float64)

    found = around(0, photons, exposure)
    electrons = 0.4 * found.photons * (1 + 0.012 * normal()) + 60 * (found.exposure - 0.02)
    variance = 0.25 * (64 + electrons) + 1 / 12
    mean = 50 + 0.5 * electrons + normal() * (0.05**2 + variance / 8e4).sqrt()
    return found._replace(
        mean=mean, variance=variance * (normal() * math.hypot(math.sqrt(2 / 4e4), 0.004)).exp()
    )


def test_levels_that_pile_up_are_left_out_and_coarse_ones_are_not():
    levels = around()
    cell = {
        "cell_level": torch.tensor([3]),
        "cell_value": torch.tensor([4095.0]),
        "cell_count": torch.tensor([9.0]),
    }
    piled = levels._replace(**cell)
    assert camera(piled, **SENSOR).degrees_of_freedom.tolist() == [2, 2, 2, 0, 2, 2, 0, 0]
    coarse = piled._replace(variance=torch.where(torch.arange(8) == 3, 0.5, levels.variance))
    assert camera(coarse, **SENSOR).degrees_of_freedom.tolist() == [2, 2, 2, 2, 2, 2, 0, 0]
    dark = levels._replace(
        **{**cell, "cell_level": torch.tensor([0]), "cell_value": torch.tensor([0.0])}
    )
    found = camera(dark, **SENSOR)
    assert found.degrees_of_freedom.tolist() == [0, 2, 2, 2, 2, 2, 0, 0]
    said = [check.text for check in camera.hooks.check(found, dark) if not check.ok]
    assert said == [
        "the dark frames of 0.02 s pile up at an end: dark signal and dark noise are those of 0.4 s"
    ]


def test_negative_signals_are_weighed_and_what_cannot_be_is_not():
    dim = around(photons=[0.0, 0.01, *PHOTONS[2:]], exposure=[0.02] * 8)
    below = dim._replace(mean=torch.where(torch.arange(8) == 1, dim.mean[0] - 0.2, dim.mean))
    found = camera(below, **SENSOR)
    assert math.isfinite(float(found.log))
    assert float(found.deviance[1]) < 40
    assert float(camera(around(), **SENSOR, bend=-1.5).log) == -math.inf  # a response that falls
    assert float(camera(around(), **SENSOR, twist=1.5).log) == -math.inf
    # less than no electrons
    assert float(camera(around(), **{**SENSOR, "dark_signal": 500.0}).log) == -math.inf


def test_no_scatter_of_any_kind_is_still_a_number():
    calm = {**SENSOR, "scatter": 0.0, "lamp": 0.0, "drift": 0.0}
    assert math.isfinite(float(camera(around(), **calm).log))


@pytest.mark.parametrize(
    ("photons", "message"),
    [
        ([10.0, 100.0, 1000.0], "no dark level"),
        ([0.0, 0.0], "there are no lit levels"),
        ([0.0, 100.0], r"0 lit level\(s\) below 70% of saturation"),
        ([0.0, 500.0, 500.0, 1000.0], "below 70% of saturation"),
    ],
)
def test_measurements_without_hope_are_refused(photons, message):
    with pytest.raises(ValueError, match=message):
        camera(around(photons=photons, exposure=[0.02] * len(photons)), **SENSOR)


def test_a_level_without_scatter_and_light_that_does_nothing_are_refused():
    levels = around()
    with pytest.raises(ValueError, match=r"level 3, of 3\d\d\.?\d* DN, has no variance"):
        camera(
            levels._replace(variance=torch.where(torch.arange(8) == 3, 0.0, levels.variance)),
            **SENSOR,
        )
    with pytest.raises(ValueError, match="above the dark level, which must be positive"):
        camera(levels._replace(mean=50.0 - levels.photons / 1e3), **SENSOR)


def test_the_check_says_what_was_used():
    found = camera(around(), **SENSOR)
    assert camera.hooks.check(found, around())[0].text.endswith(
        "for 12 means and variances, from 6 of 8 levels"
    )
    assert camera.hooks.check(found, around())[0].ok
    assert camera.hooks.check(camera(around(), **SENSOR, told=False), around()) == []


def test_the_check_doubts_levels_that_rounding_decides():
    quiet = around()._replace(variance=torch.where(torch.arange(8) == 1, 0.2, around().variance))
    assert [c.ok for c in camera.hooks.check(camera(quiet, **SENSOR), quiet)] == [True, False]


PRIOR = {"gain": (0.5, 2.0), "dark_signal": (50.0, 10.0), "lamp": (0.01, 3.0), "twist": (0.0, 0.05)}


def coordinates():
    return CameraCoordinates.of(camera_prior(**PRIOR), {**SENSOR, **BENT})


def test_coordinates_go_there_and_back():
    at = coordinates()
    assert at.names == ("gain", "dark_signal", "lamp", "twist")
    assert at.labels == ("ln gain", "dark signal", "ln lamp", "twist")
    assert at.held["quantum_efficiency"] == 0.4
    assert at.held["bend"] == -0.03
    drawn = at.draw(1000, torch.Generator().manual_seed(1))
    again = at.parameters(at.place(drawn))
    for name, x in drawn.items():
        torch.testing.assert_close(again[name], x, rtol=1e-12, atol=1e-12)
    z = at.whitened(drawn)
    assert float(z.mean(0).abs().max()) < 4 / math.sqrt(1000)
    assert float((z.std(0) - 1).abs().max()) < 4 / math.sqrt(2000)
    torch.testing.assert_close(at.from_whitened(z)["lamp"], drawn["lamp"])
    torch.testing.assert_close(at.log_prior(drawn), -0.5 * z.square().sum(-1))


def test_one_standard_deviation_is_the_factor_or_the_deviation():
    found = coordinates().from_whitened(torch.ones(4, dtype=torch.float64))
    assert {name: float(x) for name, x in found.items()} == pytest.approx(
        {"gain": 1.0, "dark_signal": 60.0, "lamp": 0.03, "twist": 0.05}
    )


def test_priors_that_are_none_are_refused():
    with pytest.raises(
        ValueError, match="no parameter is free: give a prior of at least one of gain, quantum"
    ):
        camera_prior()
    with pytest.raises(ValueError, match=r"temporal_dark_noise: \[0, 2\] is not a prior"):
        camera_prior(temporal_dark_noise=(0.0, 2.0))
    assert (
        camera_prior.hooks.check(camera_prior(**PRIOR))[0].text
        == "4 free: gain, dark_signal, lamp, twist"
    )
