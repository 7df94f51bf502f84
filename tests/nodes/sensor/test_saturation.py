"""Where the sensor ends: the anchors of the paper's Table 1."""

import pytest
import torch
from pydantic import ValidationError

from neusee.nodes.sensor import limits, saturation
from neusee.nodes.values import Bands

SENSOR = {"full_well": 25500.0, "quantum_efficiency": 0.56, "pixel_pitch": 2.9e-6, "exposure": 0.1}
CENTRES = torch.tensor([400e-9, 550e-9, 700e-9], dtype=torch.float64)
BANDS = Bands(CENTRES, torch.full_like(CENTRES, 1e-8), torch.ones_like(CENTRES))


def test_saturation_irradiance():
    papers = torch.tensor([2.692e-2, 1.958e-2, 1.538e-2], dtype=torch.float64)
    found = saturation(BANDS, **SENSOR)
    torch.testing.assert_close(found, papers, rtol=1.6e-3, atol=0.0)
    # The paper's h = 6.63e-34 and c = 3e8 against CODATA: 0.13 %, and then to the last digit
    # printed.
    rounded = found * (6.63e-34 * 3e8) / (6.62607015e-34 * 299792458)
    torch.testing.assert_close(rounded, papers, rtol=4e-4, atol=0.0)


def test_limits_of_table_1():
    found = limits(full_well=25500.0, quantum_efficiency=0.56, read_noise=10.5)
    assert round(float(found.photons)) == 45536
    assert round(float(found.snr), 1) == 159.7
    assert round(float(found.dynamic_range), 1) == 67.7
    assert limits.hooks.check(found)[0].text == "45536 photons, SNR 159.7, 67.7 dB"


def test_a_sensor_without_read_noise_has_a_finite_range():
    found = limits(full_well=100.0, quantum_efficiency=1.0, read_noise=0.0)
    assert float(found.dynamic_range) == pytest.approx(40.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("exposure", "0 s"),
        ("full_well", "0 e-"),
        ("quantum_efficiency", 0.0),
        ("quantum_efficiency", 1.1),
    ],
)
def test_what_would_divide_by_zero_is_refused(name, value):
    given = {
        "full_well": "25500 e-",
        "quantum_efficiency": 0.56,
        "pixel_pitch": "2.9 um",
        "exposure": "0.1 s",
    }
    assert saturation.params(**given).exposure == 0.1
    with pytest.raises(ValidationError, match=name):
        saturation.params(**{**given, name: value})


def test_check():
    (line,) = saturation.hooks.check(saturation(BANDS, **SENSOR), BANDS, **SENSOR)
    assert line.ok
    assert "W/m2" in line.text
