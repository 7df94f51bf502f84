"""The PSF averaged over pixels: against its transfer function, in all shapes, and what is
refused.
"""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes import ParameterError, optics
from neusee.nodes.optics import _pixel_average, cut_off, psf, round_lens
from neusee.nodes.values import Pupil
from tests.nodes.optics import own_pixel_average as own
from tests.nodes.optics.random_pixel_cameras import compared, drawn, energy

FOCAL = 0.05


def pupil_of(aperture, wavelengths=(532e-9,), height=None, number=4.0, dtype=torch.float64):
    """A pupil as wide as its grid, at f/``number``."""
    clear = torch.from_numpy(aperture).to(dtype)
    relief = torch.zeros_like(clear) if height is None else torch.from_numpy(height).to(dtype)
    bands = torch.tensor(wavelengths, dtype=torch.float64)
    pitch = torch.tensor(FOCAL / number / aperture.shape[0], dtype=torch.float64)
    return Pupil(clear, clear, relief, 0 * clear, own.SILICA + 0 * bands, bands, pitch)


def turns(pupil, pixel, band=0):
    return float(pupil.pitch) * pixel / (float(pupil.wavelengths[band]) * FOCAL)


def field_of(pupil, band=0):
    phase = own.SILICA * pupil.height.double().numpy() / float(pupil.wavelengths[band])
    return pupil.amplitude.double().numpy() * np.exp(2j * np.pi * phase)


def rough(shape, seed=3):
    return 3e-7 * np.random.default_rng(seed).random(shape)


CAMERAS = [  # samples, f-number, pixel, shape, spot in pixels
    ((64, 64), 4.0, 3.45e-6, (9, 12), (0.0, 0.0)),
    ((64, 48), 1.4, 3.45e-6, (6, 5), (0.3, -0.7)),
    ((33, 40), 8.0, 3.45e-6, (1, 1), (0.0, 0.25)),
    ((96, 96), 1.2, 20e-6, (2, 1), (0.0, 0.0)),
    ((50, 50), 32.0, 1e-6, (40, 31), (2.5, 1.0)),
]


@pytest.mark.parametrize(("samples", "number", "pixel", "shape", "spot"), CAMERAS)
def test_a_pixel_has_the_mean_of_its_square(samples, number, pixel, shape, spot):
    pupil = pupil_of(own.disc(*samples), height=rough(samples), number=number)
    light, alpha = float((pupil.aperture**2).sum()), turns(pupil, pixel)
    expected = own.averaged(field_of(pupil), light, alpha, shape, spot)
    peak = own.averaged(pupil.aperture.numpy() + 0j, light, alpha, (1, 1))[0, 0]
    camera = dict(focal_length=FOCAL, pixel_pitch=pixel, shape=shape, sensor="integrated")
    angle = tuple(at * pixel / FOCAL for at in spot)
    double = psf(pupil, **camera, angle=angle, precision="double")
    assert np.abs(double.intensity[0].numpy() - expected).max() < 1e-11 * peak
    single = psf(pupil, **camera, angle=angle)
    assert np.abs(single.intensity[0].numpy() - expected).max() < 1e-6 * peak
    assert float(double.clear_peak) == pytest.approx(peak, rel=1e-10)


def test_square_pupil_samples_wear_their_envelope_within_each_pixel():
    pupil = pupil_of(own.disc(24), height=rough((24, 24)), number=2.0)
    light, alpha, shape, spot = (
        float((pupil.aperture**2).sum()),
        turns(pupil, 6e-6),
        (9, 8),
        (0.4, 0.0),
    )
    expected = own.by_points(field_of(pupil), light, alpha, shape, spot)
    camera = dict(
        focal_length=FOCAL, pixel_pitch=6e-6, shape=shape, sensor="integrated", pixel="zoh"
    )
    found = psf(pupil, **camera, angle=(0.4 * 6e-6 / FOCAL, 0.0), precision="double")
    assert np.abs(found.intensity[0].numpy() - expected).max() < 1e-11 * float(found.clear_peak)
    centre = own.by_points(pupil.aperture.numpy() + 0j, light, alpha, (1, 1))[0, 0]
    assert float(found.clear_peak) == pytest.approx(centre, rel=1e-10)


def test_wings_are_right_to_1e_minus_10_of_the_peak_in_double():
    """At f/4 over 201 pixels the wings of a clear lens fall to 1e-7 of the peak."""
    pupil = pupil_of(own.disc(400), number=4.0)
    light, alpha = float((pupil.aperture**2).sum()), turns(pupil, 3.45e-6)
    expected = own.averaged(pupil.aperture.numpy() + 0j, light, alpha, (3, 201))
    camera = dict(focal_length=FOCAL, pixel_pitch=3.45e-6, shape=(3, 201), sensor="integrated")
    found = psf(pupil, **camera, precision="double").intensity[0].numpy()
    assert expected[0].min() < 1e-6 * expected.max()
    assert np.abs(found - expected).max() < 1e-11 * expected.max()


def test_strips_change_nothing(monkeypatch):
    pupil = pupil_of(own.disc(64), (450e-9, 640e-9), rough((64, 64)))
    camera = dict(
        focal_length=FOCAL,
        pixel_pitch=3.45e-6,
        shape=(21, 16),
        sensor="integrated",
        precision="double",
    )
    angle = (1e-4, -3e-5)
    at_once = psf(pupil, **camera, angle=angle).intensity
    monkeypatch.setattr(_pixel_average, "FINE_SAMPLES", 1)
    assert (
        len(
            _pixel_average.pixel_strips(
                *_pixel_average.fine_axes((64, 64), (21, 16), 0.03, torch.float64)
            )
        )
        == 21
    )
    row_by_row = psf(pupil, **camera, angle=angle).intensity
    torch.testing.assert_close(row_by_row, at_once, rtol=0, atol=1e-12 * float(at_once.max()))


@settings(max_examples=30, deadline=None)
@given(pixels=st.integers(1, 70), bandwidth=st.sampled_from([0.0, 1e-3, 0.2, 0.499, 0.5, 1.62, 3.99, 4.63, 47.0]),
       errors=st.sampled_from([(5e-10, 1e-8), (5e-15, 1e-12)]))  # fmt: skip
def test_the_filter_averages_every_fringe_of_the_band(pixels, bandwidth, errors):
    """The mean of exp(2 pi i nu x) over a pixel about k is sinc(nu) exp(2 pi i nu k)."""
    error, most = errors
    grid = _pixel_average.fine_axis(pixels, bandwidth, error)
    assert grid.per_pixel > 2 * bandwidth
    assert grid.per_pixel >= 1
    even = _pixel_average.fine_axis(1, 0.0, error)
    at = (torch.arange(grid.samples, dtype=torch.float64) - (grid.samples - 1) / 2) / grid.per_pixel
    middle = torch.arange(pixels, dtype=torch.float64) - (pixels - 1) / 2
    for fringe in torch.linspace(0, bandwidth, 7, dtype=torch.float64):
        for wave in (torch.cos, torch.sin):
            light = wave(2 * math.pi * fringe * at)[:, None].expand(-1, even.samples).contiguous()
            found = _pixel_average.averaged(light, grid, even)[:, 0]
            expected = wave(2 * math.pi * fringe * middle) * torch.sinc(fringe)
            assert float((found - expected).abs().max()) < most


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")
@pytest.mark.parametrize("pixel", ["point", "zoh"])
def test_gradients_are_those_of_the_definition(pixel):
    pupil = pupil_of(own.disc(10), height=rough((10, 10)), number=4.0)
    camera = dict(
        focal_length=FOCAL, pixel_pitch=3.45e-6, shape=(3, 4), sensor="integrated", pixel=pixel
    )
    factors = [
        x.clone().requires_grad_() for x in (pupil.amplitude, pupil.height * 1e6, pupil.path * 1e6)
    ]

    def light(amplitude, height, path):
        changed = pupil._replace(amplitude=0.9 * amplitude, height=height * 1e-6, path=path * 1e-6)
        return psf(changed, **camera, angle=(2e-5, 1e-5), precision="double").intensity

    assert torch.autograd.gradcheck(light, factors, atol=1e-7)
    _, slope = torch.func.jvp(
        light, tuple(x.detach() for x in factors), tuple(torch.ones_like(x) for x in factors)
    )
    weight = torch.rand_like(slope)
    grads = torch.autograd.grad((light(*factors) * weight).sum(), factors)
    assert float((slope * weight).sum()) == pytest.approx(
        sum(float(g.sum()) for g in grads), rel=1e-8
    )


def test_what_the_samples_cannot_carry_is_refused_with_the_samples_to_write():
    pupil, camera = (
        pupil_of(own.disc(100), number=4.0),
        dict(focal_length=FOCAL, pixel_pitch=3.45e-6, shape=(256, 200)),
    )
    pupil = pupil._replace(diameter=torch.tensor(FOCAL / 4, dtype=torch.float64))
    known = {
        "angle": (0.0, 0.0),
        "pixel": "point",
        "sensor": "integrated",
        "pupil": pupil,
        "direction": None,
    }
    with pytest.raises(ParameterError) as refused:
        psf.hooks.preflight(**camera, **known)
    text = str(refused.value)
    samples = int(text.split("optics.samples=")[1].split()[0])
    pitch = float(text.split('optics.pitch="')[1].split(" um")[0]) * 1e-6
    assert samples * pitch == pytest.approx(FOCAL / 4, rel=1e-9)
    assert samples % 2 == 0
    finer = pupil._replace(
        height=torch.zeros(samples, samples), pitch=torch.tensor(pitch, dtype=torch.float64)
    )
    assert psf.hooks.preflight(**camera, **{**known, "pupil": finer}) == []
    coarser = torch.tensor(pitch * samples / (samples - 2), dtype=torch.float64)
    fewer = pupil._replace(height=torch.zeros(samples - 2, samples - 2), pitch=coarser)
    with pytest.raises(ParameterError):
        psf.hooks.preflight(**camera, **{**known, "pupil": fewer})


def test_points_further_apart_than_wavelength_times_f_number_are_refused():
    """The sum of points is the light up to that pitch; beyond it, 2.3 times at f/4, 16.9 times
    at f/1.4.
    """
    bands = (640e-9, 532e-9)
    for number, refused in ((8.0, False), (6.4, True), (4.0, True), (1.4, True)):
        pupil = pupil_of(own.disc(160), bands, number=number)
        named = pupil._replace(diameter=torch.tensor(FOCAL / number, dtype=torch.float64))
        camera = dict(focal_length=FOCAL, pixel_pitch=3.45e-6, shape=(9, 9))
        known = {"angle": (0.0, 0.0), "pixel": "point", "direction": None, **camera}
        psf.hooks.preflight(pupil=named, sensor="integrated", **known)
        psf.hooks.preflight(pupil=named, sensor="point_as_printed", **known)
        if not refused:
            assert float(psf(pupil, **camera).intensity.sum(dtype=torch.float64)) < 2
            psf.hooks.preflight(pupil=named, sensor="point", **known)
            continue
        with pytest.raises(ParameterError, match="sensor\\.sampling=integrated") as found:
            psf.hooks.preflight(pupil=named, sensor="point", **known)
        assert found.value.parameter == "sensor"
        with pytest.raises(ValueError, match="sensor\\.sampling=integrated"):
            psf(pupil, **camera)


def test_a_narrow_stop_on_a_wide_grid_is_not_taken_for_a_fast_lens():
    """f/16 on a grid of f/4: points 3.45 um apart are fine enough, whether the diameter is named
    or not.
    """
    wide = own.disc(120)
    v = (np.arange(120) - 59.5) / 60
    narrow = wide * (v[:, None] ** 2 + v**2 <= 1 / 16)
    pupil = pupil_of(narrow, number=4.0)
    camera = dict(focal_length=FOCAL, pixel_pitch=3.45e-6, shape=(60, 60))
    assert 0.9 < float(psf(pupil, **camera).intensity.sum(dtype=torch.float64)) < 1


def test_light_that_the_pupil_does_not_pass_is_an_error():
    """Also behind a grey filter, where the window holds less than all light but more than the
    pupil passes.
    """
    pupil = pupil_of(own.disc(160), number=1.4)
    camera = dict(focal_length=FOCAL, pixel_pitch=3.45e-6, shape=(9, 9), sensor="point_as_printed")
    for grey in (1.0, 0.1):
        with pytest.raises(ValueError, match="pupil passes only"):
            psf(pupil._replace(amplitude=grey * pupil.amplitude), **camera)
    whole = psf(
        pupil._replace(amplitude=0.1 * pupil.amplitude),
        **{**camera, "sensor": "integrated"},
        precision="double",
    )
    assert 0.0095 < float(whole.intensity.sum()) <= 0.01


def test_a_very_fast_lens_is_said_to_be_beyond_scalar_theory():
    known = {"angle": (0.0, 0.0), "pixel": "point", "direction": None, "sensor": "integrated"}
    camera = dict(focal_length=FOCAL, pixel_pitch=3.45e-6, shape=(9, 9))
    for number, told in ((1.2, True), (1.0, True), (1.21, False)):
        diameter = torch.tensor(FOCAL / number, dtype=torch.float64)
        pupil = pupil_of(own.disc(160), number=number)._replace(diameter=diameter)
        notes = psf.hooks.preflight(pupil=pupil, **camera, **known)
        assert any("scalar theory" in note for note in notes) is told


def test_a_grid_of_a_spot_that_misses_peaks_is_told_by_how_much():
    """Points 1.2 times half of wavelength x f-number apart: four of them about an Airy pattern."""
    number, pitch = 4.0, 1.2 * 532e-9 * 4.0 / 2
    pupil = pupil_of(own.disc(160), number=number)._replace(
        diameter=torch.tensor(FOCAL / number, dtype=torch.float64)
    )
    known = {"angle": (0.0, 0.0), "pixel": "point", "direction": None, "sensor": "point"}
    camera = dict(focal_length=FOCAL, shape=(8, 8))
    told = psf.hooks.preflight(pupil=pupil, pixel_pitch=pitch, **camera, **known)
    between = psf(
        pupil, pixel_pitch=pitch, **camera, angle=(0.5 * pitch / FOCAL, 0.5 * pitch / FOCAL)
    )
    lost = 1 - float(between.intensity.max() / between.clear_peak)
    assert told == [note for note in told if f"up to {lost:.0%} too low" in note] != []
    assert psf.hooks.preflight(pupil=pupil, pixel_pitch=pitch / 1.21, **camera, **known) == []


def test_the_pupil_names_its_clear_diameter():
    for aperture, diameter, expected in (
        ("inscribed", 3e-3, 3e-3),
        ("inscribed", 9e-3, 5e-3),
        ("clipped", 6e-3, 5e-3),
    ):
        stop = optics.stop(samples=50, pitch=1e-4, diameter=diameter, aperture=aperture)
        bands = optics_bands()
        pupil = optics.pupil(torch.zeros(50, 50), 0.46 + 0 * bands.centres, bands, stop)
        assert float(pupil.diameter) == pytest.approx(expected)
        before = optics.pupil.hooks.shape(torch.empty(50, 50, device="meta"), None, bands, stop)
        assert float(before.diameter) == pytest.approx(expected)


def optics_bands():
    from neusee.nodes.spectra import bands

    return bands(start=500e-9, stop=600e-9, count=2)


@pytest.mark.parametrize(("number", "pixel"), [(13.6, 2.9e-6), (4.0, 3.45e-6), (1.4, 6e-6)])
def test_the_lens_band_of_a_psf_does_not_depend_on_its_sampling(number, pixel):
    pupil = pupil_of(own.disc(256), number=number)
    camera = dict(
        focal_length=FOCAL, pixel_pitch=pixel, shape=(5, 5), sensor="integrated", precision="double"
    )
    found = psf(pupil, **camera)
    area = float(pupil.aperture.sum()) * float(pupil.pitch) ** 2
    expected = math.sqrt(4 * area / math.pi) * pixel / (532e-9 * FOCAL)
    assert float(cut_off(found)) == pytest.approx(expected, rel=1e-9)
    assert found.averaged.tolist() == [1.0]
    lens = round_lens(found.cut_off, found.averaged)
    assert float(found.clear_peak) == pytest.approx(
        float(lens.peak) * math.pi / 4 * expected**2, rel=3e-3
    )


def test_random_cameras_hold_no_more_light_than_the_pupil_passes():
    """Four of those that tests/benchmarks/bench_pixel_energy.py draws."""
    cameras = [camera for camera in map(drawn, range(12)) if camera is not None]
    for camera in itertools.islice(cameras, 4):
        assert energy(camera) <= 1 + 1e-6
        assert compared(camera) < 1e-6


@pytest.mark.slow
def test_thirty_random_cameras_hold_no_more_light_than_the_pupil_passes():
    cameras = [camera for camera in map(drawn, range(1000, 1090)) if camera is not None]
    assert len(cameras) >= 30
    for camera in cameras[:30]:
        assert energy(camera) <= 1 + 1e-6, camera
        assert compared(camera) < 1e-6, camera
