"""Suppression, peak and saturation: closed forms and both ends of the range."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neusee.nodes.metrics import lsr, peak_irradiance, saturated
from neusee.nodes.optics import laser_irradiance
from neusee.nodes.sensor import digitize, expose, full_well, level, saturation
from neusee.nodes.spectra import rows
from neusee.nodes.units import read_quantity
from neusee.nodes.values import Bands, Channels, Psf

SENSOR = {"full_well": 25500.0, "quantum_efficiency": 0.56, "pixel_pitch": 2.9e-6, "exposure": 0.1}


def bands(*centres):
    c = torch.tensor(centres, dtype=torch.float64)
    return Bands(c, torch.full_like(c, 1e-8), torch.ones_like(c) / len(c))


def test_lsr_is_the_peak_over_the_clear_peak():
    kernel = torch.rand(2, 5, 5)
    found = lsr(Psf(kernel, torch.tensor([2.0, 4.0], dtype=torch.float64)))
    assert found.dtype == torch.float64
    torch.testing.assert_close(
        found, kernel.amax((1, 2)).double() / torch.tensor([2.0, 4.0], dtype=torch.float64)
    )


def test_lsr_check_names_the_floor():
    psf = Psf(torch.full((1, 10, 10), 0.01), torch.tensor([0.1], dtype=torch.float64))
    lines = lsr.hooks.check(lsr(psf), psf)
    assert lines[0].ok
    assert (
        lines[1].text
        == "light spread evenly over the field would give a laser suppression ratio of 0.1"
    )
    assert not lsr.hooks.check(torch.tensor([1.2]), psf)[0].ok


@pytest.mark.parametrize("rounding", ["nearest", "truncation", "dithered_floor"])
@pytest.mark.parametrize(
    ("gain", "unit", "bits"),
    [(0.37, "e-/DN", 16), (0.37, "DN/e-", 16), (7.0, "e-/DN", 12), (1e4, "e-/DN", 1)],
)
def test_a_full_pixel_counts_whether_well_or_converter_ends_first(gain, unit, bits, rounding):
    sensor = {"gain": read_quantity(f"{gain} {unit}", "DN/e-"), "bits": bits}
    electrons = torch.tensor([1e9, 25500.0, 100.0, 0.0]).reshape(1, 2, 2).expand(3, 2, 2)
    rng = torch.Generator().manual_seed(0)
    raw = digitize(full_well(electrons, capacity=25500.0), rounding=rounding, rng=rng, **sensor)
    found = saturated(raw, full_well=25500.0, **sensor)
    assert (float(found.pixels), float(found.share)) == (2.0, 0.5)
    assert saturated.hooks.check(found)[0].text == "2 saturated pixels, 50.00% of all pixels"


def test_a_pixel_with_one_full_channel_counts_once():
    raw = torch.zeros(3, 2, 2)
    raw[0, 0, 0] = raw[1, 0, 0] = raw[2, 1, 1] = 65535.0
    assert float(saturated(raw, full_well=25500.0, gain=1 / 0.37).pixels) == 2.0


@given(st.floats(0.0, 1e9))
def test_the_peak_of_a_laser_alone_is_its_strength(strength):
    line = bands(530e-9, 534e-9)
    kernel = torch.zeros(2, 3, 3)
    kernel[:, 1, 1] = 0.12
    psf = Psf(kernel, torch.full((2,), 0.12, dtype=torch.float64))
    dark = torch.zeros(1, 3, 3)
    laser = laser_irradiance(psf, line, strength=strength, **SENSOR)
    found = peak_irradiance(dark, bands(550e-9), torch.ones(1), [laser], [line], **SENSOR)
    assert float(found.irradiance) == pytest.approx(strength, rel=1e-5)
    assert bool(found.above) == (float(found.irradiance) > 1e6)
    assert float(found.laser) == pytest.approx(float(laser.sum(0).max()), rel=1e-6)


def test_the_multiple_of_the_paper_is_a_reading_and_no_verdict_and_can_be_left_out():
    """A multiple of saturation is no damage: the same light exceeds it after a longer exposure."""
    light, one = torch.full((1, 2, 2), 1e5), torch.ones(1)
    short, long = (
        peak_irradiance(light, bands(550e-9), one, **{**SENSOR, "exposure": t}) for t in (1e-3, 1.0)
    )
    assert (float(short.above), float(long.above)) == (0.0, 1.0)
    (check,) = peak_irradiance.hooks.check(long, exposure=1.0)
    assert check.ok
    assert check.text.endswith(
        "above the 1e+06 that the paper names (C10), which is no threshold of damage"
    )
    none = peak_irradiance(light, bands(550e-9), one, **{**SENSOR, "exposure": 1.0}, multiple=None)
    assert math.isnan(float(none.above))
    (check,) = peak_irradiance.hooks.check(none, exposure=1.0, multiple=None)
    assert check.ok
    assert "damage" not in check.text


def test_scene_and_lasers_add():
    scene, visible = torch.rand(2, 4, 4), bands(500e-9, 600e-9)
    factor = level(scene, visible, torch.ones(1, 2), strength=0.7, **SENSOR)
    found = peak_irradiance(scene, visible, factor, **SENSOR)
    assert float(found.irradiance) == pytest.approx(0.7, rel=1e-5)
    electrons = 0.56 * expose(
        scene, visible, torch.ones(1, 2), factor, pixel_pitch=2.9e-6, exposure=0.1
    )
    assert float(electrons.max()) == pytest.approx(0.7 * 25500, rel=1e-5)
    even = saturation(visible, **SENSOR)[:, None, None].expand(2, 4, 4).float()
    both = peak_irradiance(scene, visible, factor, [even, even], [visible, visible], **SENSOR)
    assert float(both.irradiance) == pytest.approx(4.7, rel=1e-5)
    (check,) = peak_irradiance.hooks.check(both, exposure=0.1)
    lasers = f"{2e-4 * float(even.sum(0).max()):.3g} W/cm2 of lasers"
    assert check.text == f"brightest pixel 4.7 times the saturation irradiance of 0.1 s, {lasers}"


@pytest.mark.parametrize("exposure", [1e-3, 1e-2, 0.1, 3.0])
def test_the_peak_is_counted_in_saturation_of_its_own_exposure(exposure):
    """The same light is as many multiples of I_sat as the exposure is long: h c / (lambda QE)
    well / (t p^2).
    """
    light, line = torch.full((1, 2, 2), 3.0), bands(532e-9)
    one_well = 25500 / 0.56 * 6.62607015e-34 * 299792458 / 532e-9 / (exposure * 2.9e-6**2)
    found = peak_irradiance(
        torch.zeros(1, 2, 2),
        line,
        torch.ones(1),
        [light],
        [line],
        **{**SENSOR, "exposure": exposure},
    )
    assert float(found.irradiance) == pytest.approx(3.0 / one_well, rel=1e-6)
    assert float(found.laser) == pytest.approx(3.0, rel=1e-6)


def test_every_spot_needs_its_line():
    with pytest.raises(ValueError, match="1 spots and 0 laser lines"):
        peak_irradiance(
            torch.ones(1, 2, 2), bands(5e-7), torch.ones(1), [torch.ones(1, 2, 2)], [], **SENSOR
        )


def test_a_level_of_zero_is_dark():
    assert (
        float(
            peak_irradiance(torch.ones(1, 2, 2), bands(5e-7), torch.zeros(1), **SENSOR).irradiance
        )
        == 0.0
    )


def channels(light, weights):
    """Sums over the bands of an image, as `optics.image_channels` gives them."""
    return Channels(torch.tensordot(weights.to(light), light, 1), weights, torch.zeros(()))


def test_the_peak_of_channels_is_that_of_all_bands():
    visible, seen = (
        bands(450e-9, 520e-9, 600e-9),
        torch.tensor([[0.1, 0.9, 0.2]], dtype=torch.float64),
    )
    scene = torch.rand(3, 6, 7, dtype=torch.float64)
    summed = channels(scene, rows(visible, seen))
    factor = level(scene, visible, seen, strength=0.7, **SENSOR)
    laser = torch.rand(3, 6, 7, dtype=torch.float64)
    found = [
        peak_irradiance(x, visible, factor, [laser], [visible], **SENSOR) for x in (scene, summed)
    ]
    torch.testing.assert_close(*found, rtol=1e-12, atol=0)
    with pytest.raises(ValueError, match="from every combination of these weights"):
        peak_irradiance(channels(scene, rows(visible, seen)[:1]), visible, factor, **SENSOR)
    assert (peak_irradiance.accepts_channel_sums, peak_irradiance.needs_band_invariant) == (
        ("image",),
        ("level",),
    )
