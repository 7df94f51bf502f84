"""Stray light in a PSF: energy accounted for, no help from a mask, wavelengths, bounds and
mistakes.
"""

import math

import pytest
import torch
from scipy.integrate import quad
from scipy.signal import fftconvolve
from torch.testing import assert_close

from neusee.nodes import ParameterError, TensorStats, doe, flare, optics
from neusee.nodes.flare import lobe, on_pixels
from neusee.nodes.values import Psf, Pupil

LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6, "diameter": 8e-3}
ONE = {"front": {"b0": 0.442, "l": 0.01, "s": -1.5}}
THREE = {
    "front": {"b0": 0.5, "l": 0.02, "s": -1.5},
    "middle": {"b0": 2000.0, "l": 4e-4, "s": -2.2, "radius": 2e-3},
    "dusty": {"b0": 0.02, "l": 0.2, "s": -1.0, "radius": 3.1e-3},
}
WAVES = torch.tensor([450e-9, 550e-9, 650e-9], dtype=torch.float64)


def pupil(height=None, samples=128, amplitude=1.0, wavelengths=WAVES):
    at = torch.arange(samples) - (samples - 1) / 2
    clear = (torch.hypot(at[:, None], at[None]) <= samples / 2).float()
    zero = torch.zeros(samples, samples)
    pitch = torch.tensor(LENS["diameter"] / samples, dtype=torch.float64)
    index = torch.full_like(wavelengths, 0.46)
    return Pupil(
        clear,
        amplitude * clear,
        zero if height is None else height,
        zero,
        index,
        wavelengths,
        pitch,
    )


def core_of(source, shape=(96, 96), direction=None):
    lens = {k: LENS[k] for k in ("focal_length", "pixel_pitch")}
    return optics.psf(source, direction, shape=shape, **lens)


def veiled(source=None, surfaces=ONE, shape=(96, 96), direction=None, **params):
    source = pupil() if source is None else source
    core = core_of(source, shape, direction)
    return core, flare.stray_light(core, source, direction, surfaces=surfaces, **LENS | params)


def scattered(surface, low, high):
    """Integrate a BSDF from one direction cosine to another, over the logarithm, by SciPy."""
    b0, l, s = (surface[name] for name in ("b0", "l", "s"))  # noqa: E741
    return quad(
        lambda v: b0 * (1 + (math.exp(v) / l) ** 2) ** (s / 2) * math.exp(2 * v),
        math.log(low),
        math.log(high),
        epsrel=1e-10,
        limit=300,
    )[0]


def account(surfaces, side):
    """Return core, scatter inside and scatter outside a square window about the source, by SciPy
    alone.
    """
    left, inside, outside = 1.0, 0.0, 0.0
    for surface in surfaces.values():
        scale = (
            LENS["diameter"]
            / 2
            / LENS["focal_length"]
            * LENS["pixel_pitch"]
            / surface.get("radius", 4e-3)
        )

        def sector(phi, surface=surface, scale=scale):
            edge = scale * side / 2 / math.cos(phi)
            return scattered(surface, 1e-9, edge), scattered(surface, edge, 1.0)

        parts = [
            8 * quad(lambda phi, i=i: sector(phi)[i], 0, math.pi / 4, epsrel=1e-9)[0]
            for i in (0, 1)
        ]
        inside, outside = inside + left * parts[0], outside + left * parts[1]
        left *= 1 - sum(parts)
    return left, inside, outside


def test_core_inside_and_outside_are_all_of_the_light():
    """An odd window, so that the source is in its middle; the sum is 1 although no part is
    computed from the others.
    """
    source = pupil()
    core, found = veiled(source, THREE, shape=(95, 95))
    truth = account(THREE, 95)
    assert sum(truth) == pytest.approx(1, abs=1e-9)
    whole = found.intensity.double().sum((1, 2)) - truth[0] * core.intensity.double().sum((1, 2))
    assert_close(whole, torch.full_like(whole, truth[1]), rtol=0, atol=1e-6)
    assert_close(truth[0] + whole + truth[2], torch.ones_like(whole), rtol=0, atol=1e-6)
    shares = flare.stray_shares(found, core, source, surfaces=THREE, **LENS)
    for part, expected in zip(shares, truth, strict=True):
        assert_close(part, torch.full_like(part, expected), rtol=0, atol=1e-6)


def test_light_that_dirt_absorbs_is_not_scattered():
    source = pupil(amplitude=0.5)
    core, found = veiled(source, THREE)
    _, clear = veiled(pupil(), THREE)
    assert_close(found.intensity, 0.25 * clear.intensity, rtol=1e-5, atol=1e-12)
    assert_close(found.clear_peak, clear.clear_peak)
    shares = flare.stray_shares(found, core, source, surfaces=THREE, **LENS)
    assert_close(sum(shares), torch.full((3,), 0.25, dtype=torch.float64))


def test_the_share_of_a_very_faint_pupil_keeps_its_digits():
    """Amplitudes of 1e-40: their squares are zero in single precision."""
    source = pupil()
    core, found = veiled(source, THREE)
    faint = source._replace(amplitude=source.amplitude * 1e-40, aperture=source.aperture * 1e-40)
    again = flare.stray_light(core, faint, surfaces=THREE, **LENS)
    assert_close(again.intensity, found.intensity, rtol=1e-5, atol=0)


@pytest.mark.parametrize("field", ["height", "path"])
def test_heights_and_paths_have_no_effect_and_a_hole_in_the_amplitude_is_seen(field):
    source = pupil()
    core, found = veiled(source, THREE)
    broken = source._replace(**{field: torch.full((128, 128), torch.nan)})
    assert_close(
        flare.stray_light(core, broken, surfaces=THREE, **LENS).intensity,
        found.intensity,
        rtol=0,
        atol=0,
    )
    dark = source._replace(amplitude=torch.full((128, 128), torch.nan))
    assert flare.stray_light(core, dark, surfaces=THREE, **LENS).intensity.isnan().all()


def test_a_pupil_without_end_is_refused():
    source = pupil()
    core, found = veiled(source, ONE)
    source.aperture[3, 4] = torch.inf
    for node, psfs in ((flare.stray_light, (core,)), (flare.stray_shares, (found, core))):
        with pytest.raises(
            ValueError, match="aperture holds values that are not finite: no share of its light"
        ):
            node(*psfs, source, surfaces=ONE, **LENS)


def test_a_mask_does_not_reduce_the_veil():
    """Blurring the scatter by the mask's own PSF, as the light does, changes the veil by less
    than 2 % far away.
    """
    one = WAVES[1:2]
    at = torch.linspace(-1, 1, 128)
    axicon = 8 * 550e-9 / 0.46 * torch.hypot(at[:, None], at[None])
    _, plain = veiled(pupil(wavelengths=one), shape=(257, 257))
    core, masked = veiled(pupil(axicon, wavelengths=one), shape=(257, 257))
    suppression = float(masked.intensity.max() / plain.clear_peak)
    assert suppression < 0.1
    scale = 2.9e-6 / 0.11
    kernel = on_pixels(
        lobe(*(torch.tensor(x, dtype=torch.float64) for x in (0.442, 0.01, -1.5, scale))),
        (256, 256),
        (513, 513),
    )
    blurred = fftconvolve(core.intensity[0].double().numpy(), kernel.numpy(), mode="valid")
    blurred /= float(core.intensity.sum())
    veil = (masked.intensity - 0.995 * core.intensity)[0].double().numpy()
    far = (slice(0, 20), slice(None))
    assert abs(blurred[far] / veil[far] - 1).max() < 0.02
    lens_veil = (
        (plain.intensity - 0.995 * core_of(pupil(wavelengths=one), (257, 257)).intensity)[0]
        .double()
        .numpy()
    )
    assert veil[far].mean() / lens_veil[far].mean() == pytest.approx(1, rel=1e-3)


def test_the_veil_has_its_centre_at_the_source():
    source, direction = pupil(), torch.tensor([2e-4, -5e-4], dtype=torch.float64)
    narrow = {"front": {"b0": 3e4, "l": 2e-4, "s": -2.5}}
    core, found = veiled(source, narrow, direction=direction)
    veil = (found.intensity.double() - core.intensity.double() * account(narrow, 96)[0])[0]
    y, x = divmod(int(veil.argmax()), 96)
    assert (y, x) == (round(48 + 0.11 * 2e-4 / 2.9e-6), round(48 - 0.11 * 5e-4 / 2.9e-6))


def test_scatter_of_a_polished_surface_falls_with_the_square_of_the_wavelength():
    source = pupil()
    # all of its scatter lies well within the hemisphere
    steep = {"front": {"b0": 900.0, "l": 1e-3, "s": -4.0}}
    core, found = veiled(source, steep, scaling="roughness")
    total = (
        1
        - flare.stray_shares(found, core, source, surfaces=steep, **LENS, scaling="roughness").core
    )
    same = 1 - flare.stray_shares(*veiled(source, steep)[::-1], source, surfaces=steep, **LENS).core
    assert_close(same, same[1].expand(3))
    assert_close(total[1], same[1])
    assert_close(total / total[1], (WAVES[1] / WAVES) ** 2, rtol=1e-5, atol=0)


def test_gradients_by_every_number_of_a_surface():
    source = pupil(samples=16, wavelengths=WAVES[1:2])
    core = Psf(core_of(source, (5, 6)).intensity.double(), torch.tensor([0.1], dtype=torch.float64))

    def image(b0, l, s, radius):  # noqa: E741
        surfaces = {"front": ONE["front"], "rear": {"b0": b0, "l": l, "s": s, "radius": radius}}
        return flare.stray_light(core, source, surfaces=surfaces, **LENS)

    values = [
        torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (40.0, 4e-3, -2.0, 2e-3)
    ]
    torch.autograd.gradcheck(image, values, eps=1e-8, atol=1e-5)
    assert image(*values).intensity.requires_grad


def test_no_scatter_is_no_change_and_is_left_out():
    none = {"front": {**ONE["front"], "b0": 0.0}}
    core, found = veiled(surfaces=none)
    assert_close(found.intensity, core.intensity, rtol=0, atol=0)
    assert (
        flare.stray_light.hooks.skip_bound(TensorStats.of(core), None, surfaces=none, **LENS) == 0
    )


def bound_of(core, surfaces, strength, **params):
    return flare.stray_light.hooks.skip_bound(
        TensorStats.of(core), None, surfaces=surfaces, strength=strength, **LENS, **params
    )


@pytest.mark.parametrize("strength", [1.0, 1e2, 1e4])
@pytest.mark.parametrize("b0", [1e-4, 1e-2, 0.442])
def test_the_bound_covers_what_a_picture_lacks(b0, strength):
    """A scene of full wells, and a lamp of `strength` wells whose own picture is cut off at one
    well.
    """
    surfaces = {"front": {**ONE["front"], "b0": b0}}
    source = pupil(wavelengths=WAVES[1:2])
    core, found = veiled(source, surfaces)
    bound = bound_of(core, surfaces, strength)
    one, other = (
        strength * x.intensity[0].double() / float(core.intensity.max()) for x in (core, found)
    )
    assert float((one.clamp_max(1) - other.clamp_max(1)).abs().max()) <= bound
    scene = torch.ones(96, 96, dtype=torch.float64)
    pictures = [fftconvolve(scene, x.intensity[0].double(), mode="same") for x in (core, found)]
    assert abs(pictures[0] - pictures[1]).max() / pictures[1].max() <= bound


def test_a_tolerance_keeps_what_a_bright_source_needs():
    core = core_of(pupil())
    faint = {"front": {**ONE["front"], "b0": 1e-3}}
    assert bound_of(core, faint, 1.0) < 1e-3
    assert bound_of(core, ONE, 1.0) > 1e-3
    assert bound_of(core, faint, 1e9) > 1e-3
    assert math.isinf(bound_of(core, faint, None))
    assert math.isinf(bound_of(core, faint, 1.0, scaling="roughness"))


def test_the_check_tells_the_shares():
    core, found = veiled(pupil(), THREE)
    (check,) = flare.stray_light.hooks.check(found, core, pupil(), surfaces=THREE, **LENS)
    left, inside, outside = account(THREE, 96)
    assert check.ok
    assert check.text.startswith(
        f"light not scattered {left:.2%}, stray light inside the window {inside:.1%}"[:-1]
    )
    assert f"{outside:.1%}"[:-1] in check.text


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        ({"b0": 1e4, "l": 0.01, "s": -1.5}, "surface front scatters 113 of the light"),
        (
            {"b0": 0.1, "l": 0.01, "s": -1.5, "radius": 1e-6},
            "lies on the sensor; choose a larger radius",
        ),
    ],
)
def test_impossible_surfaces_are_refused_before_work(surface, message):
    common = {"angle": (0.0, 0.0), "wavelength": 550e-9, "scaling": "none", "strength": None}
    with pytest.raises(ParameterError, match=message) as error:
        flare.stray_light.hooks.preflight(surfaces={"front": surface}, **LENS, **common)
    assert error.value.parameter == "surfaces"


def test_other_bands_are_refused():
    core = core_of(pupil())
    with pytest.raises(ValueError, match="give the pupil from which the PSF was computed"):
        flare.stray_light(core, pupil(wavelengths=WAVES[:2]), surfaces=ONE, **LENS)


def test_a_height_map_changes_the_core_alone():
    """The node takes any mask of the family: here the flat plate of `doe`."""
    stop = optics.stop(samples=128, pitch=LENS["diameter"] / 128, diameter=LENS["diameter"])
    _, found = veiled(pupil(doe.flat(stop)))
    _, plain = veiled(pupil())
    assert_close(found.intensity, plain.intensity)
