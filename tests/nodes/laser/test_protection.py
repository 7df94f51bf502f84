"""What filters and stops do: closed forms, a tilted notch by its layer, white light by another
sum, counted pixels.
"""

import math

import numpy as np
import pytest

from neusee.nodes import ParameterError
from neusee.nodes.laser import (
    counted_pixels,
    diffraction_cutoff,
    feature_snr,
    field_angle,
    notch_band,
    notch_wavelength,
    optical_density,
    passing,
    photons_in_joule,
    stopped_share,
    veil_limit,
    white_share,
)


def test_a_density_is_a_decimal_logarithm_and_never_below_zero():
    assert optical_density(1000.0) == pytest.approx(3.0, rel=1e-12)
    assert optical_density(2.0) == pytest.approx(0.30103, rel=1e-5)
    assert optical_density(0.5) == optical_density(1.0) == 0.0
    assert passing(2.5) == pytest.approx(0.0031623, rel=1e-4)
    assert passing(optical_density(77.0)) == pytest.approx(1 / 77, rel=1e-12)


@pytest.mark.parametrize("index", [1.0, 1.5, 1.8, 2.3])
@pytest.mark.parametrize("degrees", [0, 5, 15, 30, 45])
def test_a_tilted_notch_blocks_where_its_layers_have_the_phase_of_normal_incidence(index, degrees):
    """The phase of a layer is index x thickness x cos(angle inside) / wavelength, by Snell's
    law.
    """
    inside = math.asin(math.sin(math.radians(degrees)) / index)
    expected = 532e-9 * math.cos(inside)
    assert notch_wavelength(532e-9, math.radians(degrees), index) == pytest.approx(
        expected, rel=1e-12
    )


def test_a_shift_worked_by_hand():
    """20 degrees and an index of 2: 1 - sin2 / 4 = 0.970756, its root 0.985270."""
    assert notch_wavelength(1.0, math.radians(20), 2.0) == pytest.approx(0.985270, rel=1e-6)
    assert notch_band(532e-9, 532e-9, math.radians(20), 2.0)[1] == pytest.approx(
        539.953e-9, rel=1e-6
    )


def test_the_band_covers_the_laser_from_every_angle_of_the_field():
    rng = np.random.default_rng(3)
    for _ in range(200):
        low, index, angle = (
            rng.uniform(400e-9, 1100e-9),
            rng.uniform(1.2, 2.5),
            rng.uniform(0.0, 0.7),
        )
        high = low * rng.uniform(1.0, 1.02)
        band = notch_band(low, high, angle, index)
        for theta in np.linspace(0, angle, 7):
            shifted = [notch_wavelength(end, theta, index) for end in band]
            assert shifted[0] <= low * (1 + 1e-12)
            assert shifted[1] >= high * (1 - 1e-12)
        assert band[0] == low  # and not wider than needed
        assert notch_wavelength(band[1], angle, index) == pytest.approx(high, rel=1e-12)


def test_a_filter_that_no_glass_can_make_is_refused():
    for index, angle in ((0.9, 0.1), (1.8, math.pi / 2), (1.8, -math.pi / 2)):
        with pytest.raises(ParameterError):
            notch_wavelength(532e-9, angle, index)


def test_a_joule_of_one_micrometre_has_5e18_photons():
    """1 um / (6.62607015e-34 J s x 299792458 m/s); a photon of 1.239842 um has 1 eV =
    1.602176634e-19 J.
    """
    assert photons_in_joule(1e-6) == pytest.approx(5.0341166e18, rel=1e-7)
    assert photons_in_joule(1.239841984e-6) == pytest.approx(1 / 1.602176634e-19, rel=1e-9)


def test_the_share_of_white_light_is_a_share_of_the_photons_of_daylight():
    colour = pytest.importorskip("colour")
    table = colour.SDS_ILLUMINANTS["D65"]
    nm = np.arange(400, 700.01, 0.1)
    photons = np.interp(nm, table.wavelengths, table.values) * nm
    for low, high in ((532, 540), (450, 470), (390, 420), (690, 720)):
        inside = (nm >= low * 0.99) & (nm <= high * 1.01)
        assert white_share(low * 1e-9, high * 1e-9) == pytest.approx(
            photons[inside].sum() / photons.sum(), rel=0.02
        )
    assert white_share(400e-9, 700e-9) == pytest.approx(1.0, rel=1e-9)
    assert white_share(905e-9, 915e-9) == 0.0
    assert white_share(532e-9, 532e-9, edge=0.0) == 0.0


def test_the_field_reaches_to_the_corner_of_the_sensor():
    assert field_angle((3, 4), 1e-3, 2.5e-3) == pytest.approx(math.pi / 4, rel=1e-12)


def test_a_stop_passes_the_square_of_its_diameter_and_never_more_than_the_lens():
    assert stopped_share(12e-3, 3e-3) == pytest.approx(1 / 16, rel=1e-12)
    assert stopped_share(12e-3, 20e-3) == 1.0


def test_diffraction_cuts_off_at_the_wavelength_times_the_f_number():
    # 550 nm x 8 = 4.4 um
    assert diffraction_cutoff(0.05, 0.05 / 8, 4.4e-6) == pytest.approx(1.0, rel=1e-12)
    assert diffraction_cutoff(0.05, 0.05 / 16, 4.4e-6) == pytest.approx(0.5, rel=1e-12)


def test_the_feature_is_at_its_threshold_under_the_veil_that_veil_limit_names():
    import torch

    told = {"contrast": 0.3, "feature": 8.0, "read_noise": 7.0}
    veil = float(
        veil_limit(torch.tensor(400.0, dtype=torch.float64), threshold=5.0, rule="snr", **told)
    )
    assert feature_snr(400.0, veil, **told) == pytest.approx(5.0, rel=1e-12)
    assert feature_snr(400.0, 0.0, contrast=0.3, feature=8.0) == pytest.approx(
        0.3 * 20 * 8, rel=1e-12
    )
    assert feature_snr(0.0, 0.0, contrast=0.3, feature=8.0) == 0.0


# --- the saturated area behind a filter and a stop, counted pixel by pixel ------------------------


def slope(counts, factors):
    return math.log(counts[0] / counts[1]) / math.log(factors[0] / factors[1])


@pytest.mark.parametrize("spread", [0.7, 1.3, 2.6])
def test_the_saturated_area_falls_as_the_two_thirds_power_of_a_filter(spread):
    strength = 3e6
    counts = [counted_pixels(strength * t, spread) for t in (1.0, 1e-2)]
    assert slope(counts, (1.0, 1e-2)) == pytest.approx(2 / 3, abs=0.02)


@pytest.mark.parametrize("spread", [0.5, 1.0])
def test_the_saturated_area_falls_as_the_two_thirds_power_of_the_diameter(spread):
    """At a fixed exposure the peak falls as D^4, and the spot widens as 1 / D."""
    strength, factors = 1e7, (1.0, 0.25)
    counts = []
    for part in factors:
        point = strength * part**4 / pixel_peak(spread) * pixel_peak(spread / part)
        counts.append(counted_pixels(point, spread / part))
    assert slope(counts, factors) == pytest.approx(2 / 3, abs=0.05)


def pixel_peak(spread):
    """Mean of the Airy spot over the middle pixel, by a plain grid."""
    from scipy.special import j1

    at = (np.arange(200) + 0.5) / 200 - 0.5
    v = np.pi / spread * np.hypot(at[:, None], at)
    return float(((2 * j1(v) / v) ** 2).mean())
