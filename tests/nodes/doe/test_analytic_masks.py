"""The masks against their formulas, written out once more in polar or scalar form."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from neusee.nodes import ParameterError, doe, optics

STOP = optics.stop(samples=48, pitch=10e-6, diameter=480e-6)
WAVE = doe.wave_height("fused silica", 550e-9)


def plane(samples=48):
    line = (torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2) / (samples / 2)
    v, u = torch.meshgrid(line, line, indexing="ij")
    return v, u, v**2 + u**2 <= 1


def turns(height, material="fused silica", wavelength=550e-9):
    return height.double() / doe.wave_height(material, wavelength)


FORMULAS = {
    "vortex": ({"charge": 3}, lambda r, t: 3 * t / (2 * math.pi)),
    "axicon": ({"waves": 7.5}, lambda r, t: 7.5 * r),
    "spiral_axicon": ({"waves": 5.0, "charge": -2}, lambda r, t: 5 * r - 2 * t / (2 * math.pi)),
    "cubic": ({"waves": 6.0}, lambda r, t: 6 * r**3 * (torch.cos(t) ** 3 + torch.sin(t) ** 3)),
    "half_rings": ({"waves": (4.0,)}, lambda r, t: 4 * r * torch.sign(torch.cos(t))),
    "zernike": ({"coefficients": {4: 110e-9}}, lambda r, t: 0.2 * math.sqrt(3) * (2 * r**2 - 1)),
}


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize(("material", "wavelength"), [("fused silica", 550e-9), ("PMMA", 450e-9)])
def test_mask_delays_its_wavelength_by_its_formula(name, material, wavelength):
    params, formula = FORMULAS[name]
    if name == "zernike":
        params = {"coefficients": {4: 0.2 * wavelength}}
    height = getattr(doe, name)(STOP, **params, material=material, wavelength=wavelength)
    v, u, open_ = plane()
    wanted = formula(torch.hypot(v, u), torch.atan2(v, u))[open_]
    assert_close(
        turns(height, material, wavelength)[open_], wanted - wanted.min(), rtol=0, atol=1e-5
    )
    assert height.dtype == torch.float32
    assert float(height.min()) == 0
    assert not height[~open_].any()


def test_five_half_rings_have_equal_areas_and_alternate():
    slopes = (2.0, 3.0, 4.0, 5.0, 6.0)
    samples = 400
    height = doe.half_rings(optics.stop(samples=samples, pitch=1e-6, diameter=400e-6), waves=slopes)
    v, u, open_ = plane(samples)
    radius = torch.hypot(v, u)
    slope = (turns(height) - turns(height)[open_].mean()) / radius * torch.sign(u)
    for place, wanted in enumerate((2, -3, 4, -5, 6)):
        ring = (radius > math.sqrt(place / 5)) & (radius <= math.sqrt((place + 1) / 5)) & open_
        assert_close(slope[ring], torch.full_like(slope[ring], wanted), rtol=0, atol=2e-3)
        assert float(ring.sum() / open_.sum()) == pytest.approx(0.2, rel=0.01)


@pytest.mark.parametrize("samples", [40, 41])
@pytest.mark.parametrize("orientation", [0.0, 0.7, math.pi / 2])
def test_half_rings_are_odd_about_the_axis(samples, orientation):
    stop = optics.stop(samples=samples, pitch=1e-6, diameter=samples * 1e-6)
    height = doe.half_rings(stop, waves=(3.0, 5.0), orientation=orientation)
    open_ = height.new_zeros(samples, samples, dtype=torch.bool) | plane(samples)[2]
    total = (height + height.flip(0, 1))[open_]
    assert_close(total, torch.full_like(total, float(total.mean())), rtol=1e-5, atol=0)


def test_half_ring_has_a_real_amplitude_spread():
    phase = 2 * math.pi * turns(doe.half_rings(STOP, waves=(6.0,)))
    v, u, open_ = plane()
    field = torch.polar(open_.double(), phase - phase[open_].mean())
    y, x = (
        torch.linspace(-20, 20, 21, dtype=torch.float64),
        torch.linspace(-20, 20, 21, dtype=torch.float64),
    )
    kernel = [torch.exp(-2j * math.pi * a[:, None] * b) for a, b in ((y, v[:, 0]), (x, u[0]))]
    amplitude = kernel[0] @ field @ kernel[1].T
    assert float(amplitude.imag.abs().max()) < 1e-4 * float(amplitude.abs().max())


def test_orientation_turns_the_element():
    across = doe.half_rings(STOP, waves=(3.0,))
    along = doe.half_rings(STOP, waves=(3.0,), orientation=math.pi / 2)
    assert_close(along, across.T, rtol=1e-6, atol=1e-12)


def test_every_reading_of_the_aperture_comes_from_one_place():
    def axicon(samples=64, pitch=5e-6, diameter=480e-6, **aperture):
        return doe.axicon(
            optics.stop(samples=samples, pitch=pitch, diameter=diameter, **aperture), waves=8.0
        )

    with pytest.raises(
        ParameterError, match="give samples: 96, leave the pitch out, or choose aperture: stretched"
    ):
        axicon()
    assert_close(axicon(aperture="inscribed"), axicon(diameter=320e-6))
    assert_close(axicon(aperture="stretched"), axicon(pitch=7.5e-6))
    assert_close(axicon(pitch=None), axicon(pitch=7.5e-6))
    assert_close(
        axicon(aperture="stretched", diameter=160e-6), axicon(pitch=2.5e-6, diameter=160e-6)
    )
    whole = axicon(samples=96)[16:-16, 16:-16]
    assert_close(axicon(aperture="clipped"), whole, rtol=1e-4, atol=float(whole.max()) * 1e-2)
    small = axicon(diameter=160e-6)
    assert int((small > 0).sum()) == pytest.approx(math.pi * 16**2, rel=0.02)


def test_preflight_says_what_the_grid_does_to_the_aperture():
    paper = {"samples": 2160, "pitch": 3.74e-6, "diameter": 11e-3}
    (note,) = optics.stop.hooks.preflight(**paper, aperture="inscribed")
    grid = "pupil grid 2160 x 3.74 um = 8.078 mm"
    assert note == f"aperture 11 mm > {grid}: inscribed, a disc of 8.078 mm; see reading.aperture"
    (note,) = optics.stop.hooks.preflight(**paper, aperture="stretched")
    assert (
        note == f"aperture 11 mm, {grid}: the pitch becomes 5.093 um, so that 2160 samples span the"
        " aperture"
    )
    with pytest.raises(
        ParameterError, match=r"11 mm is wider than the pupil grid of 2160 x 3\.74 um"
    ) as caught:
        optics.stop.hooks.preflight(**paper)
    assert caught.value.parameter == "diameter"
    assert "samples: 2942" in str(caught.value)
    assert (
        optics.stop.hooks.preflight(**{**paper, "diameter": 8.0784e-3}, aperture="stretched") == []
    )
    assert optics.stop.hooks.preflight(**{**paper, "pitch": None}) == []
    assert (
        optics.stop.hooks.preflight(
            samples=2160, pitch=3.74e-6, diameter=8e-3, aperture="inscribed"
        )
        == []
    )
    with pytest.raises(ParameterError, match="no pupil sample") as caught:
        optics.stop.hooks.preflight(samples=4, pitch=1e-3, diameter=1e-3, aperture="inscribed")
    assert caught.value.parameter == "diameter"


@settings(max_examples=40, deadline=None)
@given(
    samples=st.integers(1, 33),
    slopes=st.lists(st.floats(-1e4, 1e4), min_size=1, max_size=6),
    scale=st.floats(1e-8, 10),
    alternate=st.booleans(),
)
def test_any_half_rings_are_finite_and_counted_up_from_zero(samples, slopes, scale, alternate):
    stop = optics.stop(samples=samples, pitch=scale, diameter=scale * samples)
    height = doe.half_rings(stop, waves=tuple(slopes), alternate=alternate)
    assert height.shape == (samples, samples)
    assert bool(torch.isfinite(height).all())
    assert float(height.min()) == 0


def test_check_reports_the_depth():
    height = doe.axicon(STOP, waves=10.0)
    (line,) = doe.axicon.hooks.check(height, STOP, waves=10.0)
    assert line.ok
    assert f"{float(height.max()) * 1e6:.4g} um" in line.text
    (line,) = doe.axicon.hooks.check(height - 1e-6, STOP, waves=10.0)
    assert not line.ok


def test_recipe_parameters_are_read_with_their_units():
    read = doe.half_rings.params(waves=[12, 18], orientation="90 deg")
    assert read.waves == (12.0, 18.0)
    assert read.orientation == pytest.approx(math.pi / 2)
    assert doe.zernike.params(coefficients={"4": "55 nm"}).coefficients == {4: pytest.approx(55e-9)}
    assert optics.stop.params(samples=8, pitch="3.74 um", diameter="8 mm").pitch == pytest.approx(
        3.74e-6
    )
    with pytest.raises(ValueError, match="at least 1 item"):
        doe.half_rings.params(waves=[])
