"""Fabrication: wrapping keeps the phase, steps are even and cost what theory says."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from torch.testing import assert_close

from neusee.nodes import ParameterError, TensorStats, doe

WAVE = doe.wave_height("fused silica", 550e-9)
PLAIN = {"material": "fused silica", "wrap_at": None, "levels": None, "max_height": None}
heights = arrays.arrays("float32", (3, 4), elements=st.floats(0, 0.0001220703125, width=32)).map(
    torch.from_numpy
)


@settings(max_examples=60, deadline=None)
@given(height=heights)
def test_wrapping_leaves_the_phase_at_its_wavelength(height):
    made = doe.fabricate(height, wrap_at=550e-9)
    assert float(made.min()) >= 0
    assert float(made.max()) <= WAVE * (1 + 1e-6)
    off = ((height.double() - made.double()) / WAVE).sub(
        ((height.double() - made.double()) / WAVE).round()
    )
    assert float(off.abs().max()) < 1e-4


@settings(max_examples=60, deadline=None)
@given(height=heights, levels=st.integers(2, 256), wrapped=st.booleans())
def test_steps_are_even_few_and_near(height, levels, wrapped):
    top = WAVE if wrapped else 40e-6
    params = {"wrap_at": 550e-9} if wrapped else {"max_height": top}
    made = doe.fabricate(height, levels=levels, **params)
    step = top / (levels if wrapped else levels - 1)
    place = made.double() / step
    assert_close(place, place.round(), rtol=0, atol=1e-3)
    assert float(place.round().min()) >= 0
    assert float(place.round().max()) <= levels - 1
    smooth = doe.fabricate(height, **params).double()
    gap = (smooth - made.double()).abs()
    gap = torch.minimum(gap, (WAVE - gap).abs()) if wrapped else gap
    assert float(gap.max()) <= step / 2 * (1 + 1e-3) + 1e-11


@settings(max_examples=60, deadline=None)
@given(height=heights, levels=st.integers(2, 64), wrapped=st.booleans())
def test_quantising_twice_is_quantising_once(height, levels, wrapped):
    params = {"wrap_at": 550e-9} if wrapped else {"max_height": 40e-6}
    once = doe.fabricate(height, levels=levels, **params)
    assert_close(doe.fabricate(once, levels=levels, **params), once, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize(
    "params",
    [
        {},
        {"wrap_at": 550e-9},
        {"wrap_at": 450e-9, "levels": 4},
        {"max_height": 2e-6},
        {"max_height": 2e-6, "levels": 7},
    ],
)
def test_agrees_with_the_reference(params):
    height = 10e-6 * torch.rand(40, 40, generator=torch.Generator().manual_seed(5))
    params = PLAIN | params
    assert_close(
        doe.fabricate(height, **params).double(),
        doe.fabricate.hooks.reference(height, **params),
        rtol=0,
        atol=2e-12,
    )


def test_nothing_asked_is_nothing_done():
    height = torch.rand(5, 5) * 1e-5
    assert doe.fabricate(height) is height


@pytest.mark.parametrize("levels", [2, 4, 8, 16])
def test_steps_cost_the_efficiency_of_a_multi_level_grating(levels):
    """First order of a blazed grating in L steps: sinc(1/L) squared."""
    ramp = torch.arange(4096, dtype=torch.float64) / 4096 * 16 * WAVE
    made = doe.fabricate(ramp[None, :], wrap_at=550e-9, levels=levels)[0]
    field = torch.polar(torch.ones_like(made), 2 * math.pi * made / WAVE)
    order = torch.fft.fft(field)[16].abs().square() / 4096**2
    assert float(order) == pytest.approx(
        (math.sin(math.pi / levels) / (math.pi / levels)) ** 2, rel=2e-3
    )


def test_gradient_passes_straight_through_steps_and_wraps_but_not_through_the_cut():
    height = torch.tensor([[0.3e-6, 1.9e-6, 5.0e-6]], dtype=torch.float64, requires_grad=True)
    for params, wanted in (
        ({"wrap_at": 550e-9, "levels": 4}, [1.0, 1.0, 1.0]),
        ({"wrap_at": 550e-9}, [1.0, 1.0, 1.0]),
        ({"max_height": 2e-6, "levels": 4}, [1.0, 1.0, 0.0]),
    ):
        (gradient,) = torch.autograd.grad(doe.fabricate(height, **params).sum(), height)
        assert gradient[0].tolist() == wanted


def test_preflight_refuses_what_cannot_be_made():
    with pytest.raises(ParameterError, match=r"at least 1\.196 um") as caught:
        doe.fabricate.hooks.preflight(**PLAIN | {"wrap_at": 550e-9, "max_height": 1e-6})
    assert caught.value.parameter == "max_height"
    with pytest.raises(ParameterError, match="set wrap_at or max_height"):
        doe.fabricate.hooks.preflight(**PLAIN | {"levels": 8})
    (note,) = doe.fabricate.hooks.preflight(**PLAIN | {"max_height": 1e-6})
    assert "cut flat" in note
    assert doe.fabricate.hooks.preflight(**PLAIN | {"wrap_at": 550e-9, "max_height": 2e-6}) == []


def test_check_says_what_was_cut():
    height = torch.tensor([[0.0, 1e-6], [3e-6, 4e-6]])
    params = PLAIN | {"max_height": 2e-6}
    checks = doe.fabricate.hooks.check(doe.fabricate(height, **params), height, **params)
    assert "50.00%" in checks[-1].text
    assert not checks[-1].ok


def test_negligible_only_where_nothing_changes():
    facts = TensorStats.of(torch.tensor([[0.0, 1e-6]]))
    assert doe.fabricate.hooks.skip_bound(facts, **PLAIN | {"wrap_at": 550e-9}) == 0
    assert doe.fabricate.hooks.skip_bound(facts, **PLAIN | {"max_height": 2e-6}) == 0
    assert (
        doe.fabricate.hooks.skip_bound(facts, **PLAIN | {"max_height": float(torch.tensor(1e-6))})
        == 0
    )
    assert doe.fabricate.hooks.skip_bound(facts, **PLAIN | {"wrap_at": 400e-9}) > 1


def test_small_in_height_is_not_small_in_phase():
    facts = TensorStats.of(torch.tensor([[0.0, 0.9e-6]]))
    step = 0.5e-6 / 255 / doe.wave_height("fused silica", 400e-9)  # half a step, waves
    bound = doe.fabricate.hooks.skip_bound(facts, **PLAIN | {"max_height": 1e-6, "levels": 256})
    assert bound == pytest.approx(2 * math.pi * step, rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("wavelength", [540e-9, 549e-9, 551e-9, 552e-9])
def test_the_bound_tells_a_relief_of_just_one_wave_as_it_is_made(wavelength, dtype):
    wave = torch.tensor(doe.wave_height("fused silica", wavelength), dtype=dtype)
    for top in (
        wave,
        wave.nextafter(torch.zeros_like(wave)),
        wave.nextafter(torch.ones_like(wave)),
    ):
        height = torch.stack([torch.zeros_like(top), 0.5 * top, top])[None]
        changed = not torch.equal(doe.fabricate(height, **PLAIN | {"wrap_at": wavelength}), height)
        assert (
            doe.fabricate.hooks.skip_bound(
                TensorStats.of(height), **PLAIN | {"wrap_at": wavelength}
            )
            > 0
        ) == changed


@pytest.mark.parametrize(
    "params", [{"wrap_at": 550e-9, "levels": 4}, {"max_height": 2e-6, "levels": 4}]
)
def test_made_where_the_relief_is(params):
    assert doe.fabricate(torch.zeros(4, 4, device="meta"), **params).device.type == "meta"
