"""Watts, lux and exposure to electrons and digital numbers, against integrals by SciPy that
share no line with them.
"""

import numpy as np
import pytest
import torch

import neusee
from neusee.workflows import Store, load
from tests.workflows.simulation import radiometry

# percent
QE = {350: 20, 400: 45, 450: 60, 525: 69, 600: 62, 700: 45, 850: 19, 950: 7, 1050: 1.2, 1100: 0.2}
LASERS = {
    "pointer": "wavelength: 532 nm, power: 5 mW, divergence: 1 mrad, distance: 100 m",
    "violet": "wavelength: 405 nm, power: 1 mW, divergence: 2 mrad, distance: 30 m",
    "blue": "wavelength: 460 nm, power: 1 W, waist: 2 mm, m_squared: 20, distance: 500 m",
    "cyan": "wavelength: 488 nm, power: 50 mW, waist: 1 mm, distance: 5 m",
    "safety": (
        "wavelength: 520 nm, power: 1 mW, divergence: 1 mrad, waist: 1.5 mm, convention: 1/e,"
        " distance: 60 m"
    ),
    "near": "wavelength: 589 nm, power: 1 mW, divergence: 30 mrad, distance: 20 m",
    "red": (
        "wavelength: 638 nm, power: 200 mW, divergence: 0.5 mrad, distance: 2 km, visibility: 5 km,"
        " haze: kim"
    ),
    "fog": (
        "wavelength: 660 nm, power: 3 W, divergence: 0.5 mrad, distance: 1 km, visibility: 2 km,"
        " haze: kruse"
    ),
    "train": (
        "wavelength: 780 nm, power: 10 mW, pulse_duration: 10 ns, repetition_rate: 1234 Hz,"
        " divergence: 2 mrad, distance: 80 m"
    ),
    "pulse": (
        "wavelength: 808 nm, pulse_energy: 20 uJ, pulse_duration: 100 ns, pulse_delay: 1 ms,"
        " divergence: 5 mrad, distance: 150 m, air_transmittance: 0.7"
    ),
    "lidar": (
        "wavelength: 905 nm, pulse_energy: 500 nJ, pulse_duration: 5 ns, repetition_rate: 100 kHz, "
        "pulse_delay: 3 us, divergence: 3 mrad, distance: 50 m"
    ),
    "laboratory": "wavelength: 1064 nm, power: 1 mW, waist: 1.5 mm, distance: 1 m",
}
REST = "fwhm: 1 nm, angle: [9 urad, -6 urad]"
SCALE = {"km": 1e3, "m": 1, "mm": 1e-3, "nm": 1e-9, "W": 1, "mW": 1e-3, "uJ": 1e-6, "nJ": 1e-9, "mrad": 1e-3,
         "ns": 1e-9, "us": 1e-6, "ms": 1e-3, "Hz": 1, "kHz": 1e3}  # fmt: skip
QUIET = [
    "camera=mono", "scene=wall", "flare=clean", "doe=flat", "restore=wiener", "sensor=mine", "sensor.background=null",
    "expect={}", "sensor.sampling=point",
    "scene.shape=[32,32]", "sensor.shape=[32,32]", "optics.window=[32,32]", "optics.bands=4",
]  # fmt: skip
SENSOR = """\
# A mono camera with an absolute QE; the efficiency below does not count beside it.
defaults: [small]
sensor: {camera: mono.csv, quantum_efficiency: 0.5, read_noise: 0 e-, dark_current: 20 e-/s, c2: 0, offset: 0 e-}
"""
WALL = """\
# A white wall.
scene: {shape: [32, 32]}
steps: {scene: {node: scene.targets, with: {kind: edge, low: 1, high: 1, shape: "${scene.shape}"}}}
"""


def numbers(text):
    """A laser of the table in SI units."""
    pairs = (each.split(": ") for each in text.split(", "))
    found = {}
    for name, value in pairs:
        number, _, unit = value.partition(" ")
        found[name] = (
            float(number) * SCALE[unit]
            if unit
            else value
            if name in ("convention", "haze")
            else float(value)
        )
    return found | {"fwhm": 1e-9}


def efficiency(wavelength):
    return np.interp(np.asarray(wavelength) * 1e9, list(QE), [value / 100 for value in QE.values()])


@pytest.fixture(scope="module")
def compute(tmp_path_factory):
    """Outputs of the recipe `pointer` with the mono camera and the twelve lasers, from one
    store.
    """
    folder = tmp_path_factory.mktemp("watts")
    (folder / "laser").mkdir()
    (folder / "sensor").mkdir()
    lines = (f"  {name}: {{{text}, {REST}}}\n" for name, text in LASERS.items())
    (folder / "laser" / "twelve.yaml").write_text("# Twelve lasers.\nlasers:\n" + "".join(lines))
    (folder / "scene").mkdir()
    (folder / "scene" / "wall.yaml").write_text(WALL)
    (folder / "sensor" / "mine.yaml").write_text(SENSOR)
    rows = "".join(f"{nm},{percent}\n" for nm, percent in QE.items())
    (folder / "sensor" / "mono.csv").write_text("wavelength (nm),QE (%)\n" + rows)
    store = Store(folder / "store")

    def compute(outputs, *words):
        recipe = load(
            "pointer",
            ["laser=twelve", *QUIET, *words, f"outputs=[{outputs}]", "tolerance=0"],
            folder,
        )
        return neusee.run(recipe, store=store)

    return compute


def radii():
    """Distances of the pixels from the middle of the spot: angle x focal length, in m."""
    at = (np.arange(32) - 16) * radiometry.PIXEL
    return np.hypot(*np.meshgrid(at - 0.11 * 9e-6, at + 0.11 * 6e-6, indexing="ij")).ravel()


def expected(name, exposure, **changed):
    laser = numbers(LASERS[name]) | changed
    return radiometry.electrons(laser, radii(), exposure, efficiency).reshape(32, 32)


def sampled(name, exposure):
    """The electrons of `expected` by a sum over the samples of the pupil: their rim is a
    staircase, not a circle.
    """
    laser, at = numbers(LASERS[name]), (np.arange(32) - 16) * radiometry.PIXEL
    y, x = at - 0.11 * 9e-6, at + 0.11 * 6e-6

    def light(nm):
        return radiometry.sampled_irradiance(nm, laser, y, x, exposure)

    return radiometry.line_electrons(laser, exposure, efficiency, light, nodes=5)


@pytest.mark.slow
def test_unclipped_electrons_of_twelve_lasers_agree_to_1e_4(compute):
    result = compute(", ".join(f'"laser_photons[plain,{name}]"' for name in LASERS))
    for name in LASERS:
        found = result[f"laser_photons[plain,{name}]"][0].double().numpy() * 0.5
        wanted = expected(name, 5e-3)
        assert found.max() == pytest.approx(wanted.max(), rel=1e-4), name
        assert np.abs(found - wanted).max() < 1e-4 * wanted.max(), name
        # the bound of `optics.psf`
        assert np.abs(found - sampled(name, 5e-3)).max() < 3e-6 * wanted.max(), name


@pytest.mark.slow
def test_pixels_that_average_over_their_area_agree_with_a_quadrature(compute):
    name, half = "pointer", 4
    only = f"lasers={{pointer: {{{LASERS[name]}, {REST}}}}}"
    found = compute('"laser_photons[plain,pointer]"', only, "sensor.sampling=integrated")
    middle = slice(16 - half, 16 + half)
    node, weight = np.polynomial.legendre.leggauss(6)
    at = (np.arange(-half, half)[:, None] + node / 2).ravel() * radiometry.PIXEL
    away = np.hypot(*np.meshgrid(at - 0.11 * 9e-6, at + 0.11 * 6e-6, indexing="ij")).ravel()
    fine = radiometry.electrons(numbers(LASERS[name]), away, 5e-3, efficiency).reshape(
        2 * half, 6, 2 * half, 6
    )
    wanted = np.einsum("aibj,i,j->ab", fine, weight / 2, weight / 2)
    electrons = found["laser_photons[plain,pointer]"][0, middle, middle].double().numpy() * 0.5
    assert electrons.max() == pytest.approx(wanted.max(), rel=1e-4)
    assert np.abs(electrons - wanted).max() < 1e-4 * wanted.max()


@pytest.mark.slow
@pytest.mark.parametrize("seconds", ["1 us", "1 ms", "1 s"])
def test_electrons_of_a_continuous_laser_of_the_scene_and_of_the_dark_rise_with_the_exposure(
    compute, seconds
):
    outputs = (
        '"laser_photons[plain,pointer]", "scene_photons[plain]", "spot[plain,pointer]",'
        ' "dark[plain]", "light"'
    )
    only = f"lasers={{pointer: {{{LASERS['pointer']}, {REST}}}}}"
    one, long = (compute(outputs, only, f"sensor.exposure={time}") for time in ("100 ms", seconds))
    ratio = {"1 us": 1e-5, "1 ms": 1e-2, "1 s": 10.0}[seconds]
    for name in ("laser_photons[plain,pointer]", "scene_photons[plain]"):
        torch.testing.assert_close(long[name], one[name] * ratio, rtol=1e-5, atol=0.0)
    torch.testing.assert_close(
        long["spot[plain,pointer]"], one["spot[plain,pointer]"], rtol=0.0, atol=0.0
    )
    assert float(long["light[pointer]"].peak) == float(one["light[pointer]"].peak)


@pytest.fixture(scope="module")
def pointer():
    """The electrons of the pointer, by the integral over a round pupil and by the sum over the
    samples of the pupil.
    """
    return expected("pointer", 5e-3), sampled("pointer", 5e-3)


@pytest.mark.parametrize("share", [1.0, 1e-2, 1e-4, 1e-6, 1e-8])
def test_clipped_numbers_agree_at_five_attenuations(compute, pointer, share):
    """The rim of 540 samples is a staircase: with it the numbers are right to 3e-7 of the peak, and
    to 1.4e-5 without.

    The shape of the rim changes the rings by up to 1.4e-5 of the peak, and the area of its samples,
    which is 9.2e-6 less than that of the disc, the peak by 7e-6.
    """
    only = f"lasers={{pointer: {{{LASERS['pointer']}, air_transmittance: {share}, {REST}}}}}"
    dark = ("scene.illuminance=0.001 lx", "sensor.dark_current=0 e-/s")
    raw = compute('"raw[plain]"', only, *dark)["raw[plain]"][0].numpy()
    for whole, near in zip(pointer, (1.5e-5, 3e-7), strict=True):
        charge = share * whole
        assert (charge > 25500).any() == (share > 1e-7)
        wanted = np.minimum(np.round(np.minimum(charge, 25500) / 0.37), 2**16 - 1)
        assert np.abs(raw - wanted).max() <= 1 + near * charge.max() / 0.37
        assert ((raw == 65535) == (wanted == 65535)).mean() > 0.99


def test_a_white_wall_in_lux_gives_the_electrons_of_the_direct_integral(compute):
    import colour

    result = compute(
        '"scene_photons[plain]", cube, "psf[plain]"',
        "lasers={}",
        "optics.bands=31",
        "illuminant=a",
    )
    light, eye = (
        colour.SDS_ILLUMINANTS["A"],
        colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"],
    )

    def spectrum(x):
        return np.interp(x * 1e9, light.wavelengths, light.values)

    def luminous(x):
        return np.interp(x * 1e9, eye.wavelengths, eye.values[:, 1])

    # the lift from RGB gives a white that is not quite 1, and the window of 32 pixels holds 97 % of
    # the light
    kept = result["cube"][:, 16, 16] * result["psf[plain]"].intensity.sum((-2, -1))

    def reflected(x):
        return efficiency(x) * np.interp(x * 1e9, np.arange(400, 701, 10), kept.numpy())

    wanted = radiometry.white_electrons(2000, spectrum, luminous, reflected, (395e-9, 705e-9), 5e-3)
    found = float(result["scene_photons[plain]"][0, 16, 16]) * 0.5
    assert found == pytest.approx(wanted, rel=3e-4)
