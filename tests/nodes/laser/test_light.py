"""The light of a laser at the lens, its wavefront in the pupil, and the pulses that an exposure
catches.
"""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy import integrate

from neusee.nodes import ParameterError, doe, laser, optics, spectra
from tests.workflows.simulation import radiometry

LINE = spectra.line(wavelength=532e-9, fwhm=1e-9)
STOP = optics.stop(samples=128, pitch=62.5e-6, diameter=8e-3)
CAMERA = {"focal_length": 0.11, "exposure": 0.02}
BEAM = {"divergence": 1e-3, "distance": 100.0}


def test_light_is_that_of_the_beam_through_the_clear_aperture():
    found = laser.light(
        LINE, STOP, **CAMERA, **BEAM, power=5e-3, lens_transmittance=0.8, air_transmittance=0.5
    )
    beam = laser.beam(532e-9, power=5e-3, divergence=1e-3)
    assert float(found.power) == pytest.approx(
        laser.power_through(beam, 100.0, 8e-3, 0.5), rel=1e-9
    )
    assert float(found.irradiance) == pytest.approx(
        laser.axis_irradiance(beam, 100.0, 0.5), rel=1e-9
    )
    assert float(found.peak) == pytest.approx(
        laser.peak_on_sensor(beam, 100.0, 8e-3, 0.11, 0.8, 0.5), rel=1e-9
    )
    assert float(found.flux) == pytest.approx(
        0.8 * float(found.irradiance) * math.pi * 16e-6, rel=1e-12
    )
    assert (float(found.pulses), float(found.pulse_fluence)) == (0.0, 0.0)


def test_a_pulse_train_has_its_mean_power_in_a_whole_number_of_periods():
    train = {"pulse_energy": 5e-6, "pulse_duration": 1e-8, "repetition_rate": 1e3}
    one, mean = (
        laser.light(LINE, STOP, **CAMERA, **BEAM, **each) for each in (train, {"power": 5e-3})
    )
    assert float(one.pulses) == pytest.approx(20)
    assert float(one.peak) == pytest.approx(float(mean.peak), rel=1e-9)
    assert float(one.pulse_fluence) * 20 == pytest.approx(float(one.peak) * 0.02, rel=1e-9)


def counted(exposure, delay, duration, rate):
    """Pulses within a shutter, as the integral of a comb that is drawn on a fine clock."""
    clock = np.linspace(0, exposure, 400_001)
    phase = clock - delay
    on = (phase >= 0) & (phase < duration) if rate is None else np.mod(phase, 1 / rate) < duration
    return integrate.trapezoid(on.astype(float), clock) / duration


@pytest.mark.parametrize("exposure", [0.3e-3, 1e-3, 7.3e-3])
@pytest.mark.parametrize("delay", [0.0, 0.1e-3, 2.05e-3])
@pytest.mark.parametrize(
    ("duration", "rate"), [(0.2e-3, None), (0.2e-3, 1e3), (0.95e-3, 1e3), (0.04e-3, 3333.0)]
)
def test_pulses_in_an_exposure_are_those_of_a_comb(exposure, delay, duration, rate):
    beam = laser.beam(
        532e-9, pulse_energy=1.0, pulse_duration=duration, repetition_rate=rate, waist=1e-3
    )
    found = laser.pulses_within(beam, exposure, delay)
    edges = 4 + 2 * exposure * (rate or 0.0)  # each is off by up to a step of the clock
    off = edges * exposure / 400_000 / duration
    assert found == pytest.approx(counted(exposure, delay, duration, rate), abs=off)


def test_a_shutter_before_the_pulse_catches_nothing():
    single = {"pulse_energy": 5e-6, "pulse_duration": 1e-8, "pulse_delay": 0.03}
    dark = laser.light(LINE, STOP, **CAMERA, **BEAM, **single)
    assert (float(dark.pulses), float(dark.peak)) == (0.0, 0.0)
    assert float(dark.pulse_fluence) > 0
    params = {each: field.default for each, field in laser.light.params.model_fields.items()}
    (note,) = laser.light.hooks.preflight(line=LINE, stop=STOP, **params | CAMERA | BEAM | single)
    assert (
        note
        == "no pulse falls into the exposure of 0.02 s, for a global shutter and pulse_delay 0.03 s"
    )


def test_a_laser_with_a_strength_has_no_light_in_watts_and_a_plane_wave():
    assert not any(map(float, laser.light(LINE, STOP, **CAMERA, strength=3.0)))
    assert not any(map(float, laser.wavefront(LINE)))


def test_the_wavefront_is_that_of_the_complex_beam_parameter():
    found = laser.wavefront(LINE, waist=1e-3, m_squared=2.0, distance=3.0)
    beam = laser.beam(532e-9, power=1.0, waist=1e-3, m_squared=2.0)
    q = 3.0 + 1j * math.pi * (1e-3) ** 2 / (2.0 * 532e-9)
    assert float(found.curvature) == pytest.approx((1 / q).real, rel=1e-6)
    assert float(found.taper) == pytest.approx(-(1 / q).imag * math.pi / (2.0 * 532e-9), rel=1e-6)
    assert float(found.taper) == pytest.approx(laser.beam_radius(beam, 3.0) ** -2, rel=1e-6)


@pytest.mark.parametrize("distance", [2.0, 100.0])
def test_a_near_laser_is_as_far_out_of_focus_as_waves_of_defocus_say(distance):
    """The design's case: 7.7 waves at 2 m for 8.08 mm; D^2 / (8 R) of path at the rim."""
    wide = laser.wavefront(LINE, divergence=1.0, distance=distance)
    waves = 8e-3**2 / (8 * distance) / 550e-9
    flat = torch.zeros(128, 128)
    index = doe.material(LINE)
    near = optics.pupil(flat, index, LINE, STOP, None, wide)
    far = optics.pupil(flat, index, LINE, STOP, defocus=waves)
    torch.testing.assert_close(near.path, far.path, rtol=1e-5, atol=1e-12)
    assert float((near.amplitude - far.amplitude).abs().max()) < 1e-4
    assert waves == pytest.approx(7.27 if distance == 2.0 else 0.145, rel=0.01)


@pytest.mark.parametrize(("samples", "distance"), [(540, 2.0), (540, 5.0), (540, 20.0), (128, 8.0)])
def test_the_spot_of_a_near_laser_is_as_exact_as_stated(samples, distance):
    """The Hankel integral of a beam of 30 mrad, by SciPy, for the lens of `radiometry`."""
    size, focal, pixel = radiometry.LENS["diameter"], radiometry.LENS["focal"], radiometry.PIXEL
    stop = optics.stop(samples=samples, pitch=size / samples, diameter=size)
    wave = laser.wavefront(LINE, divergence=0.03, distance=distance)
    pupil = optics.pupil(torch.zeros(samples, samples), doe.material(LINE), LINE, stop, None, wave)
    psf = optics.psf(pupil, shape=(32, 32), focal_length=focal, pixel_pitch=pixel)
    middle = len(LINE.centres) // 2
    at = (np.arange(32) - 16) * pixel
    beam = {"power": 1.0, "divergence": 0.03, "distance": distance}
    colour, away = float(LINE.centres[middle]), np.hypot(at[:, None], at[None]).ravel()
    wanted = radiometry.irradiance(colour, beam | {"wavelength": colour}, away, 1.0).reshape(32, 32)
    axis = float(laser.axis_irradiance(laser.beam(532e-9, power=1.0, divergence=0.03), distance))
    light = 0.9 * axis * float(pupil.aperture.sum()) * float(stop.pitch) ** 2 / pixel**2
    off = np.abs(psf.intensity[middle].double().numpy() * light - wanted).max() / wanted.max()
    waves = size**2 / (8 * distance) / 550e-9
    assert off < 1.5 * waves / samples


@pytest.mark.parametrize("distance", [2.0, 60.0])
def test_a_laser_that_is_out_of_focus_is_told_with_the_defocus_that_focuses_it(distance):
    params = {each: field.default for each, field in laser.light.params.model_fields.items()}
    params |= {**CAMERA, "power": 1.0, "divergence": 0.1, "distance": distance}
    notes = laser.light.hooks.preflight(line=LINE, stop=STOP, **params)
    if distance == 60.0:
        assert notes == []
        return
    (note,) = notes
    assert note.startswith(
        "a laser at 2 m is 7.27 waves out of focus for a lens focused at infinity"
    )
    assert "(its spot is exact to 0.085 of its peak)" in note  # of 128 samples
    assert note.endswith(': optics.defocus="-7.27 waves" focuses it')
    wave = laser.wavefront(LINE, divergence=0.1, distance=2.0)
    focused = optics.pupil(
        torch.zeros(128, 128), doe.material(LINE), LINE, STOP, None, wave, defocus=-7.27
    )
    assert float(focused.path.abs().max()) < 0.01 * 550e-9


def test_a_narrow_beam_fills_the_middle_of_the_pupil_alone():
    narrow = laser.wavefront(LINE, waist=1e-3, distance=0.1)
    pupil = optics.pupil(torch.zeros(128, 128), doe.material(LINE), LINE, STOP, None, narrow)
    passed = (
        float(pupil.amplitude.square().sum())
        * 62.5e-6**2
        * float(laser.axis_density(laser.beam(532e-9, power=1.0, waist=1e-3), 0.1))
    )
    assert passed == pytest.approx(1.0, rel=1e-3)


def test_distance_and_power_have_gradients_to_the_peak_of_the_pupil():
    distance = torch.tensor(1.7, dtype=torch.float64, requires_grad=True)
    small = optics.stop(samples=8, pitch=1e-3, diameter=8e-3)

    def field(d):
        wave = laser.wavefront(LINE, waist=2e-3, distance=d)
        pupil = optics.pupil(
            torch.zeros(8, 8).double(), doe.material(LINE), LINE, small, None, wave
        )
        return pupil.amplitude, pupil.path * 1e6

    assert torch.autograd.gradcheck(field, (distance,))


@pytest.mark.parametrize(
    ("changed", "name"),
    [({"power": None}, "waist"), ({"distance": None}, "power"), ({"strength": 1.0}, "strength"),
     ({"haze": "kim"}, "haze"), ({"divergence": 1e-9}, "divergence")],
)  # fmt: skip
def test_preflight_names_a_parameter_that_is_given(changed, name):
    params = {each: field.default for each, field in laser.light.params.model_fields.items()}
    params |= {**CAMERA, **BEAM, "power": 1.0, "waist": 1e-3} | changed
    with pytest.raises(ParameterError) as error:
        laser.light.hooks.preflight(line=LINE, stop=STOP, **params)
    assert error.value.parameter == name


def test_the_clear_area_of_a_clipped_disc_is_that_of_its_samples():
    for diameter in (7e-3, 8e-3, 9e-3, 10e-3, 12e-3):
        stop = optics.stop(samples=1000, pitch=8e-6, diameter=diameter, aperture="clipped")
        samples = float(
            optics.pupil(torch.zeros(1000, 1000), doe.material(LINE), LINE, stop).aperture.sum()
        )
        found = laser.light(LINE, stop, **CAMERA, **BEAM, power=1.0)
        assert float(found.flux / found.irradiance) == pytest.approx(samples * 8e-6**2, rel=2e-4)


@pytest.mark.parametrize("width", [2e-3, 8e-3, 0.2])
@pytest.mark.parametrize("diameter", [7e-3, 9e-3, 10e-3, 20e-3])
def test_the_light_through_a_clipped_disc_is_that_of_its_opening(diameter, width):
    """Power and peak by quadrature over the disc that the square grid of 8 mm cuts; a disc of 8
    mm has too little.
    """
    stop = optics.stop(samples=1000, pitch=8e-6, diameter=diameter, aperture="clipped")
    beam = {"waist": width, "divergence": 1e-3, "distance": 1e-9}
    found = laser.light(LINE, stop, **CAMERA, **beam, power=1.0, lens_transmittance=0.7)
    radius, half = diameter / 2, 4e-3

    def opened(law):
        """Return four times the integral of a law of r squared over a quadrant of the opening,
        row by row.
        """

        def row(y):
            end = min(half, math.sqrt(max(radius**2 - y**2, 0.0)))
            return integrate.quad(lambda x: law(x * x + y * y), 0, end, epsabs=0, epsrel=1e-10)[0]

        corner, top = math.sqrt(max(radius**2 - half**2, 0.0)), min(radius, half)
        parts = [0.0, min(corner, top), top]
        return 4 * sum(
            integrate.quad(row, *ends, epsabs=0, epsrel=1e-9)[0]
            for ends in itertools.pairwise(parts)
        )

    axis = 2 / (math.pi * width**2)
    power, field = (
        axis * opened(lambda square, k=k: math.exp(-k * square / width**2)) for k in (2, 1)
    )
    assert float(found.power) == pytest.approx(power, rel=1e-6)
    peak = 0.7 * field**2 / axis / (532e-9 * 0.11) ** 2
    assert float(found.peak) == pytest.approx(peak, rel=1e-6)
