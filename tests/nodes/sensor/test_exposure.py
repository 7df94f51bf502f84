"""Light to photons: units, conservation, the level of the scene, light that adds."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes import ErrorBound, ParameterError, TensorStats
from neusee.nodes.sensor import add_photons, expose, level, saturation
from neusee.nodes.spectra import rows
from neusee.nodes.values import Bands, Channels

SHUTTER = {"pixel_pitch": 2.9e-6, "exposure": 0.1}
SENSOR = {"full_well": 25500.0, "quantum_efficiency": 0.56, **SHUTTER}
CENTRES = torch.linspace(400e-9, 700e-9, 5, dtype=torch.float64)
BANDS = Bands(CENTRES, torch.full_like(CENTRES, 1e-8), torch.ones_like(CENTRES))
RESPONSES = torch.rand(3, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def scene(*shape, dtype=torch.float32):
    return torch.rand(5, *shape, dtype=dtype, generator=torch.Generator().manual_seed(1))


def test_saturating_light_of_one_wavelength_frees_a_full_well():
    one = torch.zeros(5, 2, 2, dtype=torch.float64)
    one[3] = saturation(BANDS, **SENSOR)[3]
    photons = expose(one, BANDS, torch.ones(1, 5), **SHUTTER)
    torch.testing.assert_close(
        photons * 0.56, torch.full_like(photons, 25500.0), rtol=1e-6, atol=0.0
    )


def test_agrees_with_its_reference():
    found = expose(scene(4, 3), BANDS, RESPONSES, torch.rand(5), **SHUTTER)
    assert found.dtype == torch.float32
    exact = expose.hooks.reference(scene(4, 3), BANDS, RESPONSES, torch.rand(5), **SHUTTER)
    assert found.shape == exact.shape == (3, 4, 3)
    again = expose(scene(4, 3), BANDS, RESPONSES, **SHUTTER)
    torch.testing.assert_close(
        again.double(),
        expose.hooks.reference(scene(4, 3), BANDS, RESPONSES, **SHUTTER),
        rtol=1e-6,
        atol=0,
    )


@settings(max_examples=30, deadline=None)
@given(st.floats(1e-6, 1e3), st.sampled_from([0.0, 1e-30, 1.0, 1e15]))
def test_doubling_the_exposure_doubles_the_photons(exposure, scale):
    light = scene(1, 1) * scale
    one = expose(light, BANDS, RESPONSES, pixel_pitch=2.9e-6, exposure=exposure)
    two = expose(light, BANDS, RESPONSES, pixel_pitch=2.9e-6, exposure=2 * exposure)
    assert torch.isfinite(two).all()
    torch.testing.assert_close(two, 2 * one, rtol=1e-5, atol=0.0)


def test_a_batch_passes():
    assert expose(scene(2, 2).expand(7, 5, 2, 2), BANDS, RESPONSES, **SHUTTER).shape == (7, 3, 2, 2)


def test_gradient():
    light = scene(2, 2, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: expose(x * 1e-3, BANDS, RESPONSES, **SHUTTER), (light,)
    )


@pytest.mark.parametrize("strength", [0.0, 0.7, 3.0])
def test_level_fills_the_brightest_channel_to_the_strength(strength):
    factor = level(scene(6, 6), BANDS, RESPONSES, strength=strength, **SENSOR)
    electrons = 0.56 * expose(scene(6, 6), BANDS, RESPONSES, factor, **SHUTTER)
    assert float(electrons.max()) == pytest.approx(strength * 25500, rel=1e-5)
    assert len(set(factor.tolist())) == 1


@pytest.mark.parametrize("share", [0.01, 0.3, 0.9])
def test_a_level_is_off_by_as_much_as_stated_where_the_brightest_pixel_is(share):
    """The level divides by the brightest pixel: of an image too bright by a share it is off by
    more than that share.
    """
    bright = scene(6, 6, dtype=torch.float64)
    found, low, high = (
        level(bright * k, BANDS, RESPONSES, strength=0.7, **SENSOR)
        for k in (1, 1 + share, 1 - share)
    )
    off = max(float((found - true).abs().max()) for true in (low, high))
    image = ErrorBound(0.1, TensorStats.of(bright), share)
    told = level.hooks.propagate_error(
        image, None, None, result=TensorStats.of(found), strength=0.7, **SENSOR
    )
    assert told == pytest.approx(off, rel=1e-9)


def test_nothing_is_known_of_a_level_where_the_brightest_pixel_may_be_dark():
    image, found = ErrorBound(0.1, TensorStats.of(scene(2, 2)), 1.0), TensorStats.of(torch.ones(5))
    assert (
        level.hooks.propagate_error(image, None, None, result=found, strength=0.7, **SENSOR)
        == math.inf
    )


def test_a_scene_in_lux_has_the_level_of_its_white_and_no_other():
    white = torch.tensor(3e-4, dtype=torch.float64)
    factor = level(scene(6, 6), BANDS, RESPONSES, white, **SENSOR)
    assert factor.tolist() == [3e-4] * 5
    broken = scene(6, 6).index_fill(0, torch.tensor(2), math.nan)
    with pytest.raises(ValueError, match="plain_image holds values that are not finite"):
        level(broken, BANDS, RESPONSES, white, **SENSOR)
    zero = torch.zeros((), dtype=torch.float64)
    with pytest.raises(ParameterError, match="the brightness of the scene is not known"):
        level(scene(6, 6), BANDS, RESPONSES, zero, **SENSOR)
    bound = level.hooks.propagate_error(
        ErrorBound(0.1), result=TensorStats.of(factor), strength=None
    )
    assert bound == 0.0


def test_level_per_band_lets_each_band_reach_the_strength():
    factor = level(scene(6, 6), BANDS, RESPONSES, strength=0.7, rule="per_band", **SENSOR)
    peaks = (scene(6, 6) * factor[:, None, None]).amax((-2, -1))
    torch.testing.assert_close(
        peaks.double(), 0.7 * saturation(BANDS, **SENSOR), rtol=1e-6, atol=0.0
    )
    assert "each band alone" in level.hooks.preflight(strength=0.7, rule="per_band")[0]
    assert "saturates" in level.hooks.preflight(strength=2.0, rule="channel_sum")[0]


@pytest.mark.parametrize("rule", ["channel_sum", "per_band"])
@pytest.mark.parametrize("value", [0.0, 1e-40])
def test_a_dark_scene_has_a_finite_level(rule, value):
    factor = level(
        torch.full((5, 2, 2), value), BANDS, RESPONSES, strength=0.7, rule=rule, **SENSOR
    )
    assert torch.isfinite(factor).all()
    assert (value > 0) == bool(factor.any())


def test_light_adds():
    one, two, three = (torch.full((3, 2, 2), float(n)) for n in (1, 2, 3))
    assert add_photons(one) is one
    torch.testing.assert_close(add_photons(one, [two, two], [three]), torch.full((3, 2, 2), 8.0))
    with pytest.raises(ValueError, match="cannot be added"):
        add_photons(one, [torch.ones(3, 1, 1)])


def test_bands_must_agree():
    with pytest.raises(ValueError, match="same `bands` step"):
        expose(scene(2, 2)[:4], BANDS, RESPONSES, **SHUTTER)
    with pytest.raises(ValueError, match="differ in the number of bands"):
        expose(scene(2, 2), BANDS, RESPONSES[:, :4], **SHUTTER)
    with pytest.raises(ValueError, match="level"):
        expose(scene(2, 2), BANDS, RESPONSES, torch.ones(3), **SHUTTER)


def test_checks():
    assert expose.hooks.check(torch.ones(3, 2, 2))[0].ok
    assert not expose.hooks.check(torch.tensor([-1.0, 1.0]))[0].ok
    assert (
        "1 from the scene"
        in add_photons.hooks.check(torch.full((3, 1, 1), 4.0), torch.ones(3, 1, 1), [])[0].text
    )


def channels(light, weights):
    """Sums over the bands of an image, as `optics.image_channels` gives them."""
    return Channels(torch.tensordot(weights.to(light), light, 1), weights, torch.zeros(()))


def test_channels_give_the_photons_and_the_level_of_all_bands():
    light = scene(6, 7, dtype=torch.float64)
    summed = channels(light, rows(BANDS, RESPONSES))
    factors = [level(x, BANDS, RESPONSES, strength=0.7, **SENSOR) for x in (light, summed)]
    torch.testing.assert_close(*factors, rtol=1e-12, atol=0)
    for factor in (None, factors[0]):
        found = [expose(x, BANDS, RESPONSES, factor, **SHUTTER) for x in (summed, light)]
        torch.testing.assert_close(*found, rtol=1e-12, atol=0)
        torch.testing.assert_close(
            expose.hooks.reference(summed, BANDS, RESPONSES, factor, **SHUTTER),
            found[1],
            rtol=1e-12,
            atol=0,
        )


def test_channels_in_single_precision_and_of_rows_that_say_the_same_twice():
    light = scene(6, 7)
    twice = torch.cat([rows(BANDS, RESPONSES)] * 2)
    found = expose(channels(light, twice), BANDS, RESPONSES, **SHUTTER)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, expose(light, BANDS, RESPONSES, **SHUTTER), rtol=1e-5, atol=0)


def test_channels_of_other_weights_are_refused():
    summed = channels(scene(2, 2), rows(BANDS, RESPONSES))
    with pytest.raises(ValueError, match="from every combination of these weights"):
        expose(summed, BANDS, RESPONSES, torch.linspace(1, 2, 5), **SHUTTER)
    with pytest.raises(ValueError, match="from every combination of these weights"):
        expose(summed, BANDS, RESPONSES + 1e-6 * torch.eye(3, 5), **SHUTTER)
    with pytest.raises(ValueError, match="per_band needs the peak of each band"):
        level(summed, BANDS, RESPONSES, strength=0.7, rule="per_band", **SENSOR)
    fewer = Bands(*(v[:4] for v in BANDS))
    with pytest.raises(ValueError, match="same `bands` step"):
        expose(summed, fewer, RESPONSES[:, :4], **SHUTTER)


def test_darkness_of_a_level_of_zero_reaches_channels():
    summed = channels(scene(2, 2), rows(BANDS, RESPONSES))
    assert not bool(expose(summed, BANDS, RESPONSES, torch.zeros(5), **SHUTTER).any())


def test_gradients_through_channels():
    weights = rows(BANDS, RESPONSES)
    planes, factor = (
        (weights @ scene(3, 3, dtype=torch.float64).flatten(1)).reshape(4, 3, 3),
        torch.ones((), dtype=torch.float64),
    )
    summed = channels(scene(3, 3, dtype=torch.float64), weights)

    def photons(planes, factor):
        return expose(
            summed._replace(planes=planes * 1e-3), BANDS, RESPONSES, factor.expand(5), **SHUTTER
        )

    assert torch.autograd.gradcheck(photons, (planes.requires_grad_(), factor.requires_grad_()))


def test_nodes_say_which_inputs_may_be_channels():
    assert (
        expose.accepts_channel_sums,
        expose.needs_band_invariant,
        level.accepts_channel_sums,
    ) == (
        ("irradiance",),
        ("level",),
        ("plain_image",),
    )
    assert level.hooks.band_invariant({"rule": "channel_sum"})
    assert level.hooks.band_invariant({})
    assert not level.hooks.band_invariant({"rule": "per_band"})
