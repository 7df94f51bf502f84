"""Illuminants, what they make of a scene, and the channels that see it."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes import ParameterError
from neusee.nodes.spectra import (
    Table,
    bands,
    illuminant,
    illuminate,
    light,
    line,
    observer,
    responses,
    to_srgb,
)
from neusee.nodes.values import Bands

NM = 1e-9
SCENE = bands(start=400 * NM, stop=700 * NM, count=31)
FINE = bands(start=400 * NM, stop=700 * NM, count=301)
KINDS = illuminant.hints["kind"].__args__[0].__args__


def white(samples, power):
    xyz = (observer().at(samples.centres) * power).sum(1)
    return (xyz / xyz[1]).tolist()


def test_white_of_d65_on_31_bands():
    at_centres = light("D65").at(SCENE.centres)[0]
    assert white(SCENE, at_centres) == pytest.approx([0.9494, 1, 1.0871], abs=1e-4)
    xyz = (responses(SCENE) * illuminant(SCENE, kind="D65")).sum(1)
    assert (xyz / xyz[1]).tolist() == pytest.approx([0.9494, 1, 1.0871], abs=3e-4)


def test_daylight_of_6504_kelvin_is_d65():
    torch.testing.assert_close(illuminant(SCENE), illuminant(SCENE, kind="D65"), rtol=2e-3, atol=0)


def test_illuminant_a_is_planck_at_2848_kelvin_with_its_old_constant():
    """CIE 15: A follows Planck's law at 2848 K with c2 = 1.435e-2 m K, that is 2856 K today."""
    planck = FINE.centres**-5 / (torch.exp(1.435e-2 / (2848 * FINE.centres)) - 1)
    torch.testing.assert_close(
        illuminant(FINE, kind="A"), planck / planck.mean(), rtol=1e-3, atol=0
    )


def test_equal_energy_is_flat():
    torch.testing.assert_close(illuminant(SCENE, kind="E"), torch.ones(31, dtype=torch.float64))


@pytest.mark.parametrize("kind", KINDS)
def test_every_light_has_mean_one_and_no_darkness(kind):
    result = illuminant(SCENE, kind=kind)
    assert result.dtype == torch.float64
    assert float(result.mean()) == pytest.approx(1, rel=1e-12)
    assert float(result.min()) >= 0
    assert illuminant.hooks.check(result, SCENE, kind=kind)[0].text.startswith(kind)


@pytest.mark.parametrize(("first", "last"), [(380, 480), (680, 780)])
def test_bands_up_to_the_ends_of_a_table_have_light_and_bands_beyond_have_none(first, last):
    """CIE 15:2018 tabulates light-emitting diodes from 380 to 780 nm."""

    def within(first, last):
        centres = torch.tensor([first + 5, last - 5], dtype=torch.float64) * NM
        widths = torch.full_like(centres, 10 * NM)
        return illuminant(Bands(centres, widths, torch.ones_like(centres)), kind="LED-B1")

    assert bool((within(first, last) >= 0).all())
    with pytest.raises(ValueError, match="tabulated from 380 to 780 nm"):
        within(first - 1 * (first == 380), last + 1 * (last == 780))


def test_lines_of_a_lamp_keep_their_energy_in_wide_bands():
    fine = (
        illuminant(bands(start=405.5 * NM, stop=694.5 * NM, count=290), kind="FL11")
        .reshape(29, 10)
        .mean(1)
    )
    wide = illuminant(bands(start=410 * NM, stop=690 * NM, count=29), kind="FL11")
    torch.testing.assert_close(fine / fine.mean(), wide / wide.mean(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kelvin", [3999.0, 25001.0])
def test_daylight_is_refused_outside_its_definition(kelvin):
    with pytest.raises(ParameterError, match="4000 K to 25000 K"):
        illuminant.hooks.preflight(kind="daylight", temperature=kelvin)
    assert illuminant.hooks.preflight(kind="A", temperature=kelvin) == []


@pytest.mark.parametrize("kelvin", [4000.0, 25000.0])
def test_warm_light_is_red_and_cold_light_blue(kelvin):
    result = illuminant(SCENE, temperature=kelvin)
    assert (float(result[5]) > float(result[25])) == (kelvin > 6000)


def test_bands_beyond_the_table_are_refused():
    with pytest.raises(ValueError, match="380 to 780"):
        illuminant(bands(start=380 * NM, stop=780 * NM, count=41), kind="LED-B1")


def test_a_band_in_the_dark_of_an_led_is_refused():
    dark = Bands(*(torch.tensor([v], dtype=torch.float64) for v in (385 * NM, 1 * NM, 1.0)))
    with pytest.raises(ValueError, match="no light"):
        illuminant(dark, kind="LED-B2")


@settings(max_examples=30, deadline=None)
@given(
    count=st.integers(1, 8),
    y=st.integers(1, 5),
    x=st.integers(1, 5),
    scale=st.sampled_from([0.0, 1e-38, 1.0, 1e30]),
)
def test_illuminate_once_and_twice(count, y, x, scale):
    reflectance = torch.rand(count, y, x, generator=torch.Generator().manual_seed(x)) * scale
    power = torch.linspace(0.5, 1.5, count, dtype=torch.float64)
    for times, factor in (("once", power), ("twice", power**2)):
        result = illuminate(reflectance, power, times=times)
        assert result.dtype == torch.float32
        torch.testing.assert_close(
            result.double(), factor[:, None, None] * reflectance.double(), rtol=1e-6, atol=1e-44
        )
        torch.testing.assert_close(
            result.double(),
            illuminate.hooks.reference(reflectance, power, times=times),
            rtol=1e-6,
            atol=1e-44,
        )
    assert "squared" in illuminate.hooks.preflight(times="twice")[0]


def test_illuminate_learns_and_refuses_other_bands():
    reflectance = torch.rand(3, 2, 2, dtype=torch.float64, requires_grad=True)
    power = torch.rand(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(illuminate.fn, (reflectance, power))
    with pytest.raises(ValueError, match=r"\(3, 2, 2\).*\(4,\)"):
        illuminate(reflectance, torch.ones(4))


def test_cie_responses_are_the_matching_functions_over_their_largest():
    import colour

    cmfs = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    expected = np.array([cmfs[nm] for nm in range(400, 701)]).T / cmfs.values.max()
    thin = Bands(FINE.centres, torch.zeros_like(FINE.centres), FINE.weights)
    np.testing.assert_allclose(responses(thin).numpy(), expected, atol=1e-9)
    assert float(cmfs.values.max()) == pytest.approx(1.7830, abs=1e-4)
    wide = np.array(
        [
            expected[:, i - 5 : i + 6] @ np.array([0.5, *[1] * 9, 0.5]) / 10
            for i in range(10, 291, 10)
        ]
    ).T
    np.testing.assert_allclose(responses(SCENE).numpy()[:, 1:-1], wide, atol=1e-9)


@pytest.mark.parametrize("camera", ["CIE 1931", "Nikon 5100", "Sigma SDMerill"])
def test_channels_are_not_negative_and_the_largest_peaks_at_one(camera):
    fine = bands(start=350 * NM, stop=850 * NM, count=5001)
    result = responses(fine, camera=camera)
    assert result.dtype == torch.float64
    assert float(result.min()) == 0
    assert float(result.max()) == pytest.approx(1, abs=0.01)
    assert float(result.max()) <= 1
    assert responses.hooks.check(responses(SCENE, camera=camera), SCENE, camera=camera)[0].ok


@pytest.mark.parametrize("camera", ["Nikon 5100", "Sigma SDMerill"])
@pytest.mark.parametrize("at", [443.0, 532.0, 633.3])
def test_a_laser_between_samples_sees_the_mean_of_the_lines_between_them(camera, at):
    sub = line(wavelength=at * NM)
    result = responses(sub, camera=camera)
    for b in range(5):
        low, high = (
            float(sub.centres[b] - sub.widths[b] / 2),
            float(sub.centres[b] + sub.widths[b] / 2),
        )
        steps = bands(start=low, stop=high, count=20001)
        points = responses(
            Bands(steps.centres, torch.zeros_like(steps.centres), steps.weights), camera=camera
        )
        torch.testing.assert_close(
            result[:, b], torch.trapezoid(points, dx=1 / 20000), rtol=1e-6, atol=1e-9
        )


@settings(max_examples=50, deadline=None)
@given(edges=st.lists(st.floats(300, 900), min_size=3, max_size=8, unique=True))
def test_means_over_bands_add_up_to_the_whole_integral(edges):
    edges = torch.tensor(sorted(edges), dtype=torch.float64)
    if float(edges.diff().min()) < 1e-3:
        return
    table = Table(
        torch.tensor([400.0, 450.0, 520.0, 700.0], dtype=torch.float64) * NM,
        torch.rand(2, 4, dtype=torch.float64),
    )
    parts = Bands((edges[1:] + edges[:-1]) / 2 * NM, edges.diff() * NM, edges[1:] * 0 + 1)
    whole = Bands(
        (edges[:1] + edges[-1:]) / 2 * NM, (edges[-1:] - edges[:1]) * NM, edges[:1] * 0 + 1
    )
    total = (table.over(parts) * parts.widths).sum(1)
    torch.testing.assert_close(
        total, (table.over(whole) * whole.widths)[:, 0], rtol=1e-9, atol=1e-18
    )


def test_white_reflectance_is_white_on_any_bands():
    for samples in (SCENE, FINE, bands(start=450 * NM, stop=650 * NM, count=5)):
        matrix = to_srgb(samples.centres)
        torch.testing.assert_close(
            matrix.sum(1), torch.ones(3, dtype=torch.float64), rtol=1e-12, atol=0
        )
