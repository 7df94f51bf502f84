"""EMVA 1288 least squares: the published figures of a real data set, known truths, and
measurements without hope.
"""

import math
import os
from pathlib import Path

import pytest
import torch

from neusee.nodes.calibrate import expose, least_squares, levels, reduce, table
from neusee.nodes.values import Levels

DATA = Path(
    os.environ.get("NEUSEE_EMVA1288", Path(__file__).parents[3] / "../shared/data/emva1288")
)
COLUMNS = {
    "exposure": "exposure_ns",
    "exposure_unit": "ns",
    "pixels": "npix",
    "mean": "mean_DN",
    "variance": "temporal_var_DN2",
    "drift": "mean_diff",
}
SENSOR = {"dark_exposure": 0.1, "offset": 390.0, "full_well": 25500.0, "gain": 0.37}
SENSOR |= {"quantum_efficiency": 0.56, "dark_current": 5.0, "read_noise": 10.5}
LIGHT = [0.0, 300.0, 1000.0, 3000.0, 10000.0, 30000.0, 40000.0]


def measured(name):
    file = DATA / f"EMVA1288_ReferenceSet_{name}_12Bit_moments.csv"
    if not file.is_file():
        pytest.skip(f"no {file.name} in {DATA}: set NEUSEE_EMVA1288")
    return least_squares(table(file=file, **COLUMNS))


def synthetic(gain=2.0, efficiency=0.5, dark=100.0, noise=4.0, light=LIGHT, exposure=1.0):
    """Levels that lie on the model to the last bit."""
    photons = torch.tensor(light, dtype=torch.float64)
    one, none = torch.ones_like(photons), torch.zeros(0, dtype=torch.float64)
    electrons = efficiency * photons
    variance = gain**2 * (noise**2 + electrons) + 1 / 12
    mean = dark + gain * electrons
    return Levels(
        photons, exposure * one, 2e5 * one, mean, variance, 1e5 * one, none.long(), none, none
    )


def simulated(light, exposures, seed, **how):
    rng = torch.Generator().manual_seed(seed)
    parts = []
    for photons, exposure in zip(light, exposures, strict=True):
        frames = expose(
            photons=photons, exposure=exposure, shape=(128, 128), rng=rng, **{**SENSOR, **how}
        )
        parts.append(reduce(frames, photons=photons, exposure=exposure))
    return levels(parts)


def test_the_published_figures_of_a_real_camera():
    found = measured("001_CCD")
    assert 1 / float(found.gain) == pytest.approx(3.56164, rel=1e-5)
    assert float(found.efficiency) == pytest.approx(0.451356, rel=1e-5)
    assert float(found.temporal_dark_noise) == pytest.approx(10.8980, rel=1e-3)


def test_a_simulated_set_lies_as_near_its_truth_as_is_known_of_this_method():
    found = measured("003_Simulation")  # 0.1 DN/e-, 0.5, 30 e-; a camera that is not quite linear
    assert float(found.gain) == pytest.approx(0.09786, rel=1e-4)
    assert float(found.efficiency) == pytest.approx(0.5037, rel=1e-4)
    assert float(found.temporal_dark_noise) == pytest.approx(30.65, rel=1e-3)


@pytest.mark.parametrize("gain", [0.01, 0.37, 40.0])
@pytest.mark.parametrize("efficiency", [0.05, 1.0])
def test_exact_levels_give_the_exact_camera(gain, efficiency):
    found = least_squares(synthetic(gain, efficiency))
    assert float(found.gain) == pytest.approx(gain, rel=1e-10)
    assert float(found.efficiency) == pytest.approx(efficiency, rel=1e-10)
    assert float(found.temporal_dark_noise) == pytest.approx(4.0, rel=1e-9)
    assert float(found.dark_signal) == 100.0
    assert float(found.saturation) == pytest.approx(40000 * efficiency, rel=1e-10)
    assert math.isnan(float(found.dark_current))
    assert float(found.fitted) == 4  # of 300 to 10000 photons, below 0.7 of 40000


def test_the_share_decides_what_is_fitted():
    assert [float(least_squares(synthetic(), share=s).fitted) for s in (0.2, 0.8, 1.0)] == [3, 5, 6]


def test_each_level_is_taken_less_the_dark_of_its_exposure():
    short, long = synthetic(dark=100.0, noise=4.0), synthetic(dark=140.0, noise=6.0, exposure=3.0)
    both = Levels(*(torch.cat(pair) for pair in zip(short, long, strict=True)))
    found = least_squares(both)
    assert float(found.gain) == pytest.approx(2.0, rel=1e-10)
    assert float(found.efficiency) == pytest.approx(0.5, rel=1e-10)
    assert float(found.dark_signal) == 100.0
    assert float(found.temporal_dark_noise) == pytest.approx(4.0, rel=1e-9)
    # 40 DN in 2 s at 2 DN/e-
    assert float(found.dark_current) == pytest.approx(40 / 2 / 2.0, rel=1e-10)


def test_simulated_frames_give_their_sensor_within_the_stated_errors():
    """Over many cameras, each figure scatters around the truth by what is stated as its error."""
    pulls = []
    for seed in range(40):
        found = least_squares(simulated(LIGHT, [0.1] * len(LIGHT), seed, dark_current=0.0))
        truth = {"gain": 0.37, "efficiency": 0.56, "temporal_dark_noise": 10.5}
        pulls.append(
            [
                float((found._asdict()[k] - v) / found._asdict()[f"{k}_error"])
                for k, v in truth.items()
            ]
        )
    pulls = torch.tensor(pulls, dtype=torch.float64)
    assert float(pulls.mean(0).abs().max()) < 4 / math.sqrt(40)
    assert float((pulls.std(0) - 1).abs().max()) < 4 / math.sqrt(2 * 40)


def test_dark_current_is_found():
    found = least_squares(simulated([0.0, 0.0, *LIGHT[1:]], [0.1, 10.0, *[0.1] * 6], 4))
    assert float(found.dark_current) == pytest.approx(
        50.0, abs=4 * 25 / math.sqrt(2 * 128**2) / 9.9
    )


def test_a_dark_that_rounding_swallows_has_an_endless_error():
    calm = synthetic(gain=0.01, noise=0.0)
    found = least_squares(calm._replace(variance=calm.variance - 1e-3))
    assert float(found.temporal_dark_noise) == 0.0
    assert float(found.temporal_dark_noise_error) == math.inf


@pytest.mark.parametrize(
    ("light", "message"),
    [
        ([10.0, 100.0, 1000.0], "without dark frames"),
        ([0.0, 0.0], "0 lit level"),
        ([0.0, 100.0], "1 lit level"),
        ([0.0, 100.0, 100.0, 1000.0], "below 70% of saturation"),
        ([0.0, 900.0, 1000.0], "below 70% of saturation"),
    ],
)
def test_measurements_without_hope_are_refused(light, message):
    with pytest.raises(ValueError, match=message):
        least_squares(synthetic(light=light))


def test_a_camera_without_response_is_refused():
    blind = synthetic()
    with pytest.raises(ValueError, match="light must raise mean and variance"):
        least_squares(
            blind._replace(
                mean=torch.full_like(blind.mean, 100.0), variance=torch.ones_like(blind.mean)
            )
        )
    quieter = blind._replace(
        variance=torch.tensor([9.0, 3.0, 3.0, 3.0, 3.0, 3.0, 4.0], dtype=torch.float64)
    )
    with pytest.raises(ValueError, match="slopes -"):
        least_squares(quieter)
    with pytest.raises(ValueError, match="below 100% of saturation"):
        least_squares(blind._replace(variance=torch.ones_like(blind.mean)), share=1.0)


def test_the_check_doubts_an_efficiency_above_one():
    good, odd = (least_squares(synthetic(efficiency=q)) for q in (0.5, 1.5))
    assert least_squares.hooks.check(good, synthetic())[0].ok
    assert not least_squares.hooks.check(odd, synthetic())[0].ok
