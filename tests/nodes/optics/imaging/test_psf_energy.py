"""Sums and peaks of PSFs inside and outside of windows: against each window looked at alone, in
float64.
"""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.optics._convolution_plan import central_window, psf_light, psf_light_by_window


def outside(stack, window):
    """Sum and largest of |samples| outside the window, by band."""
    size = stack.double().abs()
    rest = size.clone()
    central_window(rest, window).zero_()
    return rest.sum((1, 2)), rest.amax((1, 2))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 70),
    st.integers(1, 70),
    st.integers(1, 4),
    st.booleans(),
    st.integers(0, 1 << 30),
)
def test_each_window_is_as_it_were_measured_alone(y, x, count, negative, seed):
    generator = torch.Generator().manual_seed(seed)
    stack = torch.randn(count, y, x, generator=generator) ** 5
    stack = stack if negative else stack.abs()
    signed = bool((stack < 0).any())
    found, whole = psf_light_by_window(stack, signed), psf_light(stack)
    assert found.signed == whole.signed == signed
    assert found.windows[0] == (y, x)
    for j, window in enumerate(found.windows):
        beyond, above = outside(stack, window)
        torch.testing.assert_close(found.beyond[j], beyond, rtol=1e-5, atol=0)
        assert bool((found.beyond[j] >= beyond).all())  # a bound
        assert torch.equal(found.above[j], above)
    exact = stack.double().abs()
    for measured in (found, whole):
        torch.testing.assert_close(measured.total, exact.sum((1, 2)), rtol=1e-5, atol=0)
        assert bool((measured.total >= exact.sum((1, 2))).all())
        assert torch.equal(measured.peak, exact.amax((1, 2)))
    assert whole.windows == found.windows[:1]
    assert not whole.beyond.any()
    assert not whole.above.any()


def test_of_a_large_stack_the_sum_in_single_precision_is_no_less_than_the_true_one():
    """Many small samples beside a few large ones lose the most."""
    tails = torch.rand(2, 2048, 700, generator=torch.Generator().manual_seed(2)) ** 12
    tails[:, 1024, 350] = 1e6
    exact = tails.double().sum((1, 2))
    for found in (psf_light(tails), psf_light_by_window(tails, signed=False)):
        assert bool((found.total >= exact).all())
        torch.testing.assert_close(found.total, exact, rtol=1e-5, atol=0)


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_what_is_not_a_number_is_seen_and_not_summed_away(wrong):
    stack = torch.ones(2, 16, 16)
    stack[1, 3, 4] = wrong
    found = psf_light_by_window(stack, signed=False)
    assert (
        torch.isfinite(found.total).tolist()
        == torch.isfinite(psf_light(stack).total).tolist()
        == [True, False]
    )
    assert torch.isfinite(found.beyond[-1]).tolist() == [True, False]
