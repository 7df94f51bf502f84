"""The spot of a laser: scaled by what saturates, whatever the line and the element."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.optics import laser_irradiance
from neusee.nodes.sensor import saturation
from neusee.nodes.values import Bands, LaserLight, Psf

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
    energy = (
        laser_irradiance(clear_psf(), LINE, strength=10.0, **SENSOR).double()
        / clear_psf().intensity
    )
    torch.testing.assert_close(
        energy[:, 2, 2] / energy[:, 2, 2].sum(), LINE.weights, rtol=1e-6, atol=0.0
    )


def test_an_element_that_suppresses_by_a_thousand_does_so_here():
    weak = Psf(clear_psf().intensity / 1000, CLEAR)
    found = laser_irradiance(weak, LINE, strength=1e6, **SENSOR).double()
    assert float((found / saturation(LINE, **SENSOR)[:, None, None]).sum(0).max()) == pytest.approx(
        1e3, rel=1e-6
    )
    assert (
        laser_irradiance.hooks.check(found, weak, LINE, strength=1e6, **SENSOR)[0].text
        == "peak of the spot 20.22 W/m2, strength 1e+06 at the nominal exposure of 0.1 s"
    )


def photons_of(found, seen, at=(2, 2)):
    """Photons of each channel in one pixel, from the photoelectric sum: lambda / (h c) x
    irradiance x time x area.
    """
    joules = found[:, at[0], at[1]] * 0.1 * 2.9e-6**2
    return (seen * joules * LINE.centres / (6.62607015e-34 * 299792458.0)).sum(-1)


@pytest.mark.parametrize("strength", [1.0, 40.0])
@pytest.mark.parametrize("row", [0, 1, 2])
def test_a_strength_of_the_first_channel_fills_one_pixel_of_it_in_every_colour(strength, row):
    seen = torch.tensor(
        [[0.2, 0.25, 0.3], [0.02, 0.03, 0.05], [0.1, 0.0, 0.0]], dtype=torch.float64
    ).roll(row, 0)
    found = laser_irradiance(
        clear_psf(), LINE, seen, strength=strength, meaning="first_channel", **SENSOR
    ).double()
    assert float(photons_of(found, seen).max()) * 0.56 == pytest.approx(strength * 25500, rel=1e-6)
    assert int(photons_of(found, seen).argmax()) == row


def test_a_channel_that_sees_nothing_has_no_strength():
    blind = torch.zeros(3, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"no channel of the camera sees 532 nm"):
        laser_irradiance(clear_psf(), LINE, blind, strength=1.0, meaning="first_channel", **SENSOR)
    with pytest.raises(ValueError, match="give `responses` for the bands of the line"):
        laser_irradiance(clear_psf(), LINE, strength=1.0, meaning="first_channel", **SENSOR)
    with pytest.raises(ValueError, match="give strength, or the input light"):
        laser_irradiance(clear_psf(), LINE, **SENSOR)


WATTS = LaserLight(*torch.tensor([3.0, 2e-6, 0.5, 1e-6, 2.4, 0.0, 0.0], dtype=torch.float64))


def test_light_in_watts_lands_whole_on_the_sensor_and_states_its_strength():
    seen = torch.full((1, 3), 0.5, dtype=torch.float64)
    found = laser_irradiance(
        clear_psf(), LINE, seen, WATTS, meaning="first_channel", **SENSOR
    ).double()
    share = (clear_psf().intensity.double().sum((-2, -1)) * LINE.weights).sum()
    assert float(found.sum()) * 2.9e-6**2 == pytest.approx(2e-6 * float(share), rel=1e-6)
    hook = laser_irradiance.hooks.check
    (told,) = hook(found, clear_psf(), LINE, seen, WATTS, meaning="first_channel", **SENSOR)
    strength = float(told.text.partition("a strength of ")[2].split()[0])
    again = laser_irradiance(
        clear_psf(), LINE, seen, strength=strength, meaning="first_channel", **SENSOR
    ).double()
    # of the peak of the tapered pupil
    torch.testing.assert_close(again, found * (2.4 / 3.0), rtol=1e-3, atol=0.0)


def test_no_laser_is_no_light():
    assert not laser_irradiance(clear_psf(), LINE, strength=0.0, **SENSOR).any()


def test_gradient():
    kernel = clear_psf().intensity.double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda k: laser_irradiance(Psf(k, CLEAR), LINE, strength=3.0, **SENSOR), (kernel,)
    )


def test_psf_and_line_must_agree():
    with pytest.raises(ValueError, match="PSF of 3 bands and line of 1"):
        laser_irradiance(clear_psf(), Bands(*(x[:1] for x in LINE)), strength=1.0, **SENSOR)
