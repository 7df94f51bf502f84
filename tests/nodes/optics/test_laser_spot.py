"""The spot of a laser: scaled by what saturates, whatever the line and the element."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.optics import laser_irradiance
from neusee.nodes.sensor import saturation
from neusee.nodes.values import Bands, Psf

SENSOR = {"full_well": 25500.0, "quantum_efficiency": 0.56, "pixel_pitch": 2.9e-6, "exposure": 0.1}
LINE = Bands(
    torch.tensor([525e-9, 532e-9, 539e-9], dtype=torch.float64),
    torch.full((3,), 7e-9, dtype=torch.float64),
    torch.tensor([0.2, 0.6, 0.2], dtype=torch.float64),
)
CLEAR = 0.1178 * (550e-9 / LINE.centres) ** 2


def clear_psf():
    kernel = torch.zeros(3, 5, 5)
    kernel[:, 2, 2], kernel[:, 2, 3] = CLEAR.float(), 0.3 * CLEAR.float()
    return Psf(kernel, CLEAR)


@settings(max_examples=30, deadline=None)
@given(st.floats(1e-6, 1e9))
def test_the_clear_peak_is_strength_times_saturation(strength):
    found = laser_irradiance(clear_psf(), LINE, strength=strength, **SENSOR).double()
    wells = (found / saturation(LINE, **SENSOR)[:, None, None]).sum(0)
    assert float(wells.max()) == pytest.approx(strength, rel=1e-6)


def test_each_wavelength_sends_its_share_of_the_energy():
    energy = laser_irradiance(clear_psf(), LINE, strength=10.0, **SENSOR).double() / clear_psf().intensity
    torch.testing.assert_close(energy[:, 2, 2] / energy[:, 2, 2].sum(), LINE.weights, rtol=1e-6, atol=0.0)


def test_an_element_that_suppresses_by_a_thousand_does_so_here():
    weak = Psf(clear_psf().intensity / 1000, CLEAR)
    found = laser_irradiance(weak, LINE, strength=1e6, **SENSOR).double()
    assert float((found / saturation(LINE, **SENSOR)[:, None, None]).sum(0).max()) == pytest.approx(1e3, rel=1e-6)
    assert (
        laser_irradiance.hooks.check(found, weak, LINE, strength=1e6, **SENSOR)[0].text
        == "peak of the spot 1e+03 I_sat, strength 1e+06 I_sat"
    )


def test_no_laser_is_no_light():
    assert not laser_irradiance(clear_psf(), LINE, strength=0.0, **SENSOR).any()


def test_gradient():
    kernel = clear_psf().intensity.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda k: laser_irradiance(Psf(k, CLEAR), LINE, strength=3.0, **SENSOR), (kernel,))


def test_psf_and_line_must_agree():
    with pytest.raises(ValueError, match="PSF of 3 bands and line of 1"):
        laser_irradiance(clear_psf(), Bands(*(x[:1] for x in LINE)), strength=1.0, **SENSOR)
