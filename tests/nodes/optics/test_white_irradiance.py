"""A white surface in lux or cd/m2 on the sensor, against the photometric definitions."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate

from neusee.nodes import ParameterError, optics, spectra

STOP = optics.stop(samples=100, pitch=1e-4, diameter=1e-2)
LENS = {"focal_length": 0.05}  # f/5
BANDS = spectra.bands(start=400e-9, stop=700e-9, count=31)


def watts(bands=BANDS, **light):
    return float(optics.white_irradiance(bands, STOP, **LENS, **light))


def test_lux_are_the_luminance_of_a_lambertian_white_through_the_f_number():
    """In the image, luminance L gives pi L / (4 N^2) lux; the lumens of equal energy are 683
    lm/W times y-bar.
    """
    import colour

    eye = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    per_watt = 683 * integrate.trapezoid(eye.values[:, 1], eye.wavelengths)  # of 1 W in each nm
    lux_on_sensor = math.pi * (1000 / math.pi) / (4 * 5.0**2)
    assert watts(illuminance=1000.0, kind="E") == pytest.approx(
        lux_on_sensor / per_watt * 10, rel=1e-9
    )


def test_luminance_is_illuminance_over_pi_and_the_lens_passes_its_share():
    assert watts(luminance=50.0) == pytest.approx(watts(illuminance=50.0 * math.pi), rel=1e-12)
    assert watts(luminance=50.0, lens_transmittance=0.25) == pytest.approx(
        0.25 * watts(luminance=50.0), rel=1e-12
    )


def test_the_light_of_all_bands_does_not_depend_on_their_number():
    few = spectra.bands(start=405e-9, stop=695e-9, count=10)
    some = spectra.bands(start=400e-9 - 5e-9 + 0.5e-9, stop=700e-9 + 5e-9 - 0.5e-9, count=310)
    whole = watts(illuminance=1.0) * 31
    assert watts(some, illuminance=1.0) * 310 == pytest.approx(whole, rel=1e-9)
    assert watts(few, illuminance=1.0) * 10 == pytest.approx(whole, rel=0.05)


def test_infrared_bands_of_a_lamp_have_its_infrared_light():
    """Planck at 2856 K: the power of 765-775 nm per lumen of the visible, from the law itself."""
    infrared = spectra.bands(start=769e-9, stop=771e-9, count=3)
    import colour

    eye = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]

    def planck(nm):
        return nm**-5 / np.expm1(1.435e7 / (nm * 2848.0))  # CIE's illuminant A

    lumens = 683 * integrate.trapezoid(planck(eye.wavelengths) * eye.values[:, 1], eye.wavelengths)
    wanted = (100 / math.pi) * planck(770.0) / lumens * math.pi / 4 * (0.01 / 0.05) ** 2
    assert watts(infrared, illuminance=100.0, kind="A") == pytest.approx(wanted, rel=1e-3)


def test_without_a_brightness_it_is_0_and_needs_no_table():
    assert watts() == 0.0
    assert float(optics.white_irradiance.hooks.shape(BANDS, STOP, **LENS)) == 0.0


def test_what_has_no_meaning_is_refused_by_name(tmp_path):
    narrow = spectra.filters(centres=(450e-9, 550e-9), widths=(10e-9, 30e-9))
    red = tmp_path / "red.csv"
    red.write_text("wavelength (nm),power (W/nm)\n600,1\n900,1\n")
    check = optics.white_irradiance.hooks.preflight
    for params, name in (
        ({"bands": narrow, "illuminance": 1.0}, "illuminance"),
        ({"illuminance": 1.0, "luminance": 1.0}, "luminance"),
        ({"illuminance": 1.0, "kind": red}, "kind"),
    ):
        with pytest.raises(ParameterError) as error:
            check(**LENS, **params)
        assert error.value.parameter == name


def test_gradient():
    lux = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x: optics.white_irradiance(BANDS, STOP, **LENS, illuminance=x) * 1e3, (lux,)
    )
