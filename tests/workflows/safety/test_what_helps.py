"""What helps: each answer put back into closed forms written here, over cameras and lasers drawn
at random.
"""

import math

import numpy as np
import pytest

from neusee.nodes.laser import DamageLaw, counted_pixels, pixel_share, spot_in_pixels
from neusee.workflows.recipe.blocks.safety_block import Laser, Safety, SafetySettings
from neusee.workflows.safety.exposures import SettingDraws
from neusee.workflows.safety.what_helps import MET, crossing, remedies

PLANCK_LIGHT = 6.62607015e-34 * 299792458.0


def law(quantity="irradiance", threshold=3e8, factor=None, median_factor=None):
    """A law that holds for every laser and every spot."""
    return DamageLaw(
        device="CMOS",
        damage="point",
        quantity=quantity,
        median=threshold,
        factor=factor,
        median_factor=median_factor,
        wavelengths=(300e-9, 1700e-9),
        durations=(1e-13, 100.0),
        spot=None,
        source="test",
    )


def case(laser, lens, sensor, dazzle=None, laws=(), **more):
    # the closed forms have neither defocus nor a veil
    lens = {"focus": "laser", "scatter": None, **lens}
    settings = {"lens": lens, "sensor": sensor, "dazzle": dazzle, "draws": 100, **more}
    return Safety(
        Laser.model_validate(laser),
        SafetySettings.model_validate(settings),
        "laser",
        {},
        tuple(laws),
    )


def draws(count=0, **values):
    return SettingDraws(count, {name.replace("__", "."): x for name, x in values.items()}, {}, 7)


def answers(safety, drawn=None):
    return {(each.problem, each.means): each for each in remedies(safety, drawn or draws(), ())}


def peak(laser, lens, diameter):
    """Peak irradiance of a continuous laser in air, behind a clear lens in focus."""
    w = math.hypot(laser["waist_m"], laser["divergence_rad"] / 2 * laser["distance_m"])
    x = diameter**2 / (4 * w * w)
    through = laser["watts"] * -math.expm1(-(diameter**2) / (2 * w * w))
    area = math.pi * diameter**2 / 4 / (laser["wavelength_m"] * lens["focal_m"]) ** 2
    return through * lens["tau"] * area * (math.tanh(x / 2) * 2 / x if x > 1e-6 else 1.0)


def random_case(rng, **more):
    """A camera and a continuous laser, as numbers and as settings."""
    laser = {
        "watts": 10 ** rng.uniform(-3, 1), "wavelength_m": rng.uniform(450e-9, 900e-9),
        "divergence_rad": 10 ** rng.uniform(-3.3, -2.5), "distance_m": 10 ** rng.uniform(0.5, 2.5),
    }  # fmt: skip
    laser["waist_m"] = (
        2 * laser["wavelength_m"] / math.pi / laser["divergence_rad"] * rng.uniform(1.0, 20.0)
    )
    focal = 10 ** rng.uniform(-2, -0.8)
    lens = {
        "focal_m": focal,
        "diameter_m": focal / 10 ** rng.uniform(0.15, 1.1),
        "tau": rng.uniform(0.5, 1.0),
    }
    sensor = {
        "pitch_m": rng.uniform(1.5e-6, 10e-6), "well": rng.uniform(4e3, 4e4), "qe": rng.uniform(0.1, 0.9),
        "exposure_s": 10 ** rng.uniform(-4, -1.5),
    }  # fmt: skip
    settings = case(
        {"wavelength": f"{laser['wavelength_m']} m", "power": f"{laser['watts']} W", "waist": f"{laser['waist_m']} m",
         "divergence": f"{laser['divergence_rad']} rad", "distance": f"{laser['distance_m']} m"},
        {"focal_length": f"{focal} m", "diameter": f"{lens['diameter_m']} m", "transmittance": lens["tau"]},
        {"pixel_pitch": f"{sensor['pitch_m']} m", "shape": [1000, 1000], "quantum_efficiency": sensor["qe"],
         "full_well": f"{sensor['well']} e-", "exposure": f"{sensor['exposure_s']} s"},
        **more,
    )  # fmt: skip
    return laser, lens, sensor, settings


@pytest.mark.slow
def test_each_answer_put_back_gives_the_limit_over_random_cameras():
    rng = np.random.default_rng(21)
    solved = 0
    for _ in range(25):
        share = 10 ** rng.uniform(-3, -1)
        safety = random_case(rng, laws=[law()], dazzle={"share": share, "background": "1000 e-"})[3]
        for each in remedies(safety, draws(), ()):
            if each.value is None or each.reason == MET:
                continue
            assert each.put_back == pytest.approx(1.0, rel=0.01), each
            solved += 1
        if solved > 20:
            return
    pytest.fail(f"only {solved} are solved")


@pytest.mark.slow
def test_the_density_and_the_stop_against_damage_are_those_of_the_closed_form():
    rng = np.random.default_rng(22)
    stops = 0
    for _ in range(25):
        laser, lens, _, safety = random_case(rng, laws=[law(threshold=3e8)])
        found = answers(safety)
        ratio = peak(laser, lens, lens["diameter_m"]) / 3e8
        grey, stop = found["damage", "grey filter"], found["damage", "stop"]
        if ratio <= 1:
            assert {each.reason for each in found.values()} == {MET}
            continue
        assert grey.value.value == pytest.approx(math.log10(ratio), abs=2e-3)
        assert found["damage", "notch filter"].value.value == pytest.approx(
            math.log10(ratio), abs=2e-3
        )
        assert found["damage", "exposure"].value is None
        assert "does not change damage" in found["damage", "exposure"].reason
        slowest = min(0.5 * lens["diameter_m"], lens["focal_m"] / 64)
        if peak(laser, lens, slowest) > 3e8:
            assert stop.value is None
            assert "f/64" in stop.reason
            continue
        stops += 1
        assert peak(laser, lens, stop.value.value) == pytest.approx(3e8, rel=0.01)
        assert stop.value.value < lens["diameter_m"]
    assert stops > 4


@pytest.mark.slow
def test_the_exposure_and_the_density_against_saturation_leave_the_counted_pixels():
    """Filled pixels counted one by one behind the density that is said: within what the closed
    form states.
    """
    rng = np.random.default_rng(23)
    counted = 0
    for _ in range(20):
        laser, lens, sensor, safety = random_case(rng, dazzle={"share": 0.01})
        found = answers(safety)
        grey, shorter = found["saturation", "grey filter"], found["saturation", "exposure"]
        if grey.reason == MET:
            continue
        spread = spot_in_pixels(
            laser["wavelength_m"], lens["focal_m"], lens["diameter_m"], sensor["pitch_m"]
        )
        fills = sensor["well"] / sensor["qe"] * PLANCK_LIGHT / laser["wavelength_m"]
        fills /= sensor["exposure_s"] * sensor["pitch_m"] ** 2
        strength = (
            peak(laser, lens, lens["diameter_m"])
            * 10**-grey.value.value
            / fills
            * pixel_share(spread)
        )
        width = math.hypot(laser["waist_m"], laser["divergence_rad"] / 2 * laser["distance_m"])
        fill = (lens["diameter_m"] / 2 / width) ** 2
        # the wings of a Gaussian beam are fainter beside its peak
        strength *= (fill / math.expm1(fill)) ** 2
        assert shorter.value.value == pytest.approx(
            sensor["exposure_s"] * 10**-grey.value.value, rel=0.01
        )
        counted += 1
        assert counted_pixels(strength, spread) == pytest.approx(1e4, rel=0.02)
        if counted > 2:
            return
    pytest.fail(f"only {counted} are counted")


# --- contrast -------------------------------------------------------------------------------------

LASER = {"wavelength": "532 nm", "power": "1 W", "divergence": "1 mrad", "distance": "25 m"}
LENS = {"focal_length": "50 mm", "diameter": "12 mm", "transmittance": 0.9}
SENSOR = {
    "pixel_pitch": "3.45 um",
    "shape": [1536, 2048],
    "quantum_efficiency": 0.65,
    "full_well": "10500 e-",
    "exposure": "10 ms",
}
VEIL = {
    "share": 0.1,
    "background": "3000 e-",
    "contrast": 0.2,
    "rule": "contrast",
    "threshold": 0.1,
}


def test_no_grey_filter_no_stop_and_no_exposure_helps_contrast():
    """The laser over the scene stays behind a grey filter, and the wings of the spot grow over
    it behind a stop.
    """
    found = answers(case(LASER, LENS, SENSOR, VEIL))
    for means, word in (
        ("grey filter", "as much as the laser"),
        ("stop", "f/64"),
        ("exposure", "alike"),
    ):
        assert found["contrast", means].value is None
        assert word in found["contrast", means].reason
    assert found["saturation", "grey filter"].value is not None


def test_a_notch_helps_contrast_by_as_much_as_it_takes_from_the_laser_alone():
    found = answers(case(LASER, LENS, SENSOR, VEIL))
    notch, full = found["contrast", "notch filter"], found["saturation", "grey filter"]
    left = notch.cost.scene
    part = 3000 * left * (0.2 / 0.1 - 1) / 10500  # veil that is allowed, of the full well
    assert notch.value.value == pytest.approx(full.value.value - math.log10(part), abs=2e-3)
    assert 0.9 < left < 1
    assert notch.band[0] == pytest.approx(532e-9)
    corner = math.atan(math.hypot(1536, 2048) * 3.45e-6 / 2 / 50e-3)
    assert notch.band[1] == pytest.approx(
        532e-9 / math.sqrt(1 - (math.sin(corner) / 1.8) ** 2), rel=1e-9
    )


def test_a_longer_exposure_helps_contrast_that_noise_limits():
    faint = LASER | {"power": "0.02 uW"}
    dim = {
        "share": 1e-3,
        "background": "20 e-",
        "contrast": 0.2,
        "feature": 10,
        "read_noise": "6 e-",
    }
    found = answers(case(faint, LENS, SENSOR, dim))
    longer = found["contrast", "exposure"]
    assert longer.value is not None
    assert longer.value.value > 10e-3
    assert longer.put_back == pytest.approx(1.0, rel=1e-6)
    # a white fills the well, and a longer exposure does not add to it
    assert longer.cost.white == 10500
    assert longer.cost.snr_after > longer.cost.snr_before
    assert found["contrast", "grey filter"].value is None


def test_no_exposure_is_said_that_fills_the_well_with_the_scene_alone():
    bright = VEIL | {
        "rule": "snr",
        "background": "3000 e-",
        "contrast": 0.02,
        "feature": 1.9,
        "threshold": 1.0,
    }
    longer = answers(case(LASER | {"power": "1 uW"}, LENS, SENSOR, bright)).get(
        ("contrast", "exposure")
    )
    assert longer is not None
    assert longer.value is None or longer.value.value < 10e-3 * 10500 / 3000


def test_a_grey_filter_does_not_lower_the_veil_over_the_scene_in_the_verdict():
    """The limit of the veil at the lens behind a filter is that of the plain lens: both are
    dimmed.
    """
    from neusee.workflows.safety.dazzled_area import area_of
    from neusee.workflows.safety.exposure_limits import limit_ratio, limits_behind
    from neusee.workflows.safety.exposures import Option, compute_exposures

    safety = case(LASER, LENS, SENSOR, VEIL)
    ratios = []
    for option in (Option("plain lens"), Option("grey filter", passing=0.01)):
        exposures = compute_exposures(safety, draws(), (option,), np.array([25.0]))
        limits = limits_behind(safety, draws(), option, area_of(safety, option, ()), exposures)
        veil = next(limit for limit in limits if limit.name.startswith("veiled"))
        ratios.append(float(limit_ratio(safety, option.name, veil, exposures)[0, 0]))
    assert ratios[0] == pytest.approx(ratios[1], rel=1e-9)


# --- draws, pulses, costs -------------------------------------------------------------------------


def test_the_safe_density_is_that_of_the_weakest_twentieth_of_the_devices():
    """OD = log10(E / E_5%): the quantile of a lognormal law, and the interval of the draws
    beside it.
    """
    safety = case(LASER, LENS, SENSOR, laws=[law(threshold=3e8, factor=2.0, median_factor=1.5)])
    grey = answers(safety, draws(count=4000))["damage", "grey filter"]
    middle = grey.value.value
    spread = math.hypot(math.log10(2.0), math.log10(1.5))
    assert grey.safe == pytest.approx(middle + 1.6449 * spread, abs=0.04)
    assert grey.value.low == pytest.approx(middle - 1.6449 * spread, abs=0.04)
    assert grey.covered == pytest.approx(0.95, abs=0.005)
    assert grey.cost.scene == pytest.approx(10**-grey.safe, rel=1e-9)
    stop = answers(safety, draws(count=4000))["damage", "stop"]
    assert stop.covered >= 0.95
    assert stop.safe < stop.value.value


@pytest.mark.slow
def test_an_uncertain_power_widens_every_answer():
    rng = np.random.default_rng(4)
    powers = np.exp(rng.normal(0, 0.5, 1000))
    found = answers(
        case(LASER, LENS, SENSOR, VEIL, laws=[law()]), draws(count=1000, laser__power=powers)
    )
    for key in (
        ("damage", "grey filter"),
        ("saturation", "grey filter"),
        ("contrast", "notch filter"),
    ):
        each = found[key]
        assert each.value.high - each.value.low == pytest.approx(
            2 * 1.6449 * 0.5 / math.log(10), rel=0.08
        )
        assert each.safe >= each.value.high - 0.02
        assert each.covered >= 0.95


def test_a_limit_that_is_met_needs_nothing():
    found = answers(case(LASER | {"power": "1 nW"}, LENS, SENSOR, {"share": 0.1}, laws=[law()]))
    assert {each.reason for each in found.values()} == {MET}
    assert found["damage", "stop"].value.value == pytest.approx(12e-3)
    assert found["damage", "grey filter"].value.value == 0.0


def numbers(focal=50e-3):
    """Return `LASER` and a lens as numbers of `peak`."""
    laser = {"watts": 1.0, "wavelength_m": 532e-9, "divergence_rad": 1e-3, "distance_m": 25.0}
    return laser | {"waist_m": 2 * 532e-9 / math.pi / 1e-3}, {"focal_m": focal, "tau": 0.9}


def test_a_limit_is_met_at_the_nominal_values_and_in_nineteen_of_twenty_draws():
    here = peak(*numbers(), 12e-3)
    lower = draws(count=100, laser__power=np.full(100, 0.5))
    spread = draws(count=100, laser__power=np.concatenate([np.full(90, 1.0), np.full(10, 3.0)]))
    nearly = draws(count=100, laser__power=np.concatenate([np.full(96, 1.0), np.full(4, 3.0)]))
    for drawn, threshold, met in (
        (lower, 0.8, False),
        (spread, 1.2, False),
        (nearly, 1.2, True),
        (lower, 1.2, True),
    ):
        safety = case(LASER, LENS, SENSOR, laws=[law(threshold=threshold * here)])
        assert (answers(safety, drawn)["damage", "grey filter"].reason == MET) == met, threshold


def test_a_slow_lens_is_stopped_down_to_half_its_diameter():
    """The lens of f/50 passes a quarter of the peak at 0.71 of its diameter, which is f/71."""
    slow = LENS | {"diameter": "1 mm"}
    for share, solved in ((0.25, True), (0.05, False)):
        limit = share * peak(*numbers(), 1e-3)
        stop = answers(case(LASER, slow, SENSOR, laws=[law(threshold=limit)]))["damage", "stop"]
        assert (stop.value is not None) == solved
        if solved:
            assert stop.value.value == pytest.approx(1e-3 * share**0.25, rel=1e-3)


def test_a_fast_lens_is_stopped_down_to_f_64():
    for f_number, solved in ((60, True), (70, False)):
        limit = peak(*numbers(), 50e-3 / f_number)
        stop = answers(case(LASER, LENS, SENSOR, laws=[law(threshold=limit)]))["damage", "stop"]
        assert (stop.value is not None) == solved


def test_few_draws_have_a_safe_value_too():
    found = answers(
        case(LASER, LENS, SENSOR, laws=[law()]),
        draws(count=10, laser__power=np.linspace(0.8, 1.2, 10)),
    )
    grey = found["damage", "grey filter"]
    assert grey.safe == pytest.approx(math.log10(1.2 * peak(*numbers(), 12e-3) / 3e8), abs=2e-3)
    assert grey.covered == 1.0


def test_no_exposure_helps_against_a_single_pulse_that_falls_into_the_frame():
    pulse = {
        "wavelength": "532 nm",
        "pulse_energy": "1 mJ",
        "pulse_duration": "10 ns",
        "divergence": "1 mrad",
        "distance": "25 m",
    }
    found = answers(case(pulse, LENS, SENSOR, {"share": 0.01}, laws=[law("fluence", 1e3)]))
    assert found["saturation", "exposure"].value is None
    assert found["damage", "exposure"].value is None
    assert found["damage", "grey filter"].value.value > 0


def test_the_cost_is_the_light_of_the_scene_over_its_noise():
    dazzle = {
        "share": 0.1,
        "background": "900 e-",
        "contrast": 0.3,
        "feature": 10,
        "read_noise": "5 e-",
    }
    found = answers(case(LASER, LENS, SENSOR, dazzle, laws=[law()]))
    for means, factor in (("grey filter", 1.0), ("stop", 2.0), ("exposure", 1.0)):
        each = found.get(("saturation" if means == "exposure" else "damage", means))
        if means == "grey filter":
            share = 10**-each.value.value
        elif means == "stop":
            share = (each.value.value / 12e-3) ** factor
        else:
            share = each.value.value / 10e-3
        assert each.cost.scene == pytest.approx(share, rel=1e-9)
        background = 900 * share
        assert each.cost.background == pytest.approx(background, rel=1e-9)
        assert each.cost.white == pytest.approx(10500 * share, rel=1e-9)
        assert each.cost.snr_before == pytest.approx(0.3 * 900 * 10 / math.sqrt(925), rel=1e-9)
        assert each.cost.snr_after == pytest.approx(
            0.3 * background * 10 / math.sqrt(background + 25), rel=1e-9
        )
    stop = found["damage", "stop"].cost
    assert stop.cutoff_before == pytest.approx(3.45e-6 * 12e-3 / (550e-9 * 50e-3), rel=1e-9)
    assert stop.cutoff_after == pytest.approx(stop.cutoff_before * math.sqrt(stop.scene), rel=1e-9)


def test_a_safe_notch_band_holds_every_drawn_wavelength():
    waves = np.linspace(525e-9, 540e-9, 200)
    found = answers(
        case(LASER, LENS, SENSOR, laws=[law()]), draws(count=200, laser__wavelength=waves)
    )
    low, high = found["damage", "notch filter"].band
    assert low == pytest.approx(525e-9)
    assert high > 540e-9


@pytest.mark.parametrize(
    ("ratio", "problem", "expected"),
    [
        ([10.0, 1.0, 0.1], "damage", 0.1),
        ([100.0, 10.0, 1.0], "damage", 0.01),
        ([10.0, 5.0, 0.1], "damage", 0.1 ** (1 + math.log(5) / math.log(50))),
        ([10.0, 0.1, 10.0], "damage", math.nan),  # a stronger one is above the limit again
        ([10.0, 0.1, 10.0], "contrast", 10**-0.5),
        ([0.5, 0.1, 0.01], "damage", 1.0),
        ([10.0, 5.0, 2.0], "damage", math.nan),
        ([math.inf, 0.5, 0.1], "contrast", 0.1),
    ],
)
def test_the_crossing_is_where_the_ratio_passes_one(ratio, problem, expected):
    found = crossing(np.array([1.0, 0.1, 0.01]), np.array(ratio)[:, None], problem)[0]
    assert found == pytest.approx(expected, rel=2e-2, nan_ok=True)


def test_no_filter_is_said_to_be_safe_below_a_limit_of_which_nothing_is_known(monkeypatch):
    from neusee.workflows.safety import what_helps as module

    def opened(*asked):
        for limit in behind(*asked):
            object.__setattr__(limit, "open_below", True)
            yield limit

    behind = module.limits_behind
    monkeypatch.setattr(module, "limits_behind", opened)
    found = answers(case(LASER, LENS, SENSOR, laws=[law()]))
    assert all(each.value is None and each.safe is None for each in found.values())
    assert all(each.reason.startswith("not judged") for each in found.values())
