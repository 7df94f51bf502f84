"""What no element can do better: the floor of the LSR and the most contrast, against closed
forms and any PSF.
"""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.metrics import (
    least_lsr,
    limits,
    lsr,
    most_contrast,
    most_unsuppressed,
    mtf,
    passed_frequency_shares,
)
from neusee.nodes.values import Psf


def psf(intensity, clear_peak):
    return Psf(intensity, torch.tensor([clear_peak], dtype=torch.float64))


def test_light_that_is_spread_evenly_reaches_the_floor():
    even = psf(torch.full((1, 32, 16), 1 / 512), 0.12)
    assert float(lsr(even)) == pytest.approx(float(limits(even).floor), rel=1e-6)
    assert float(lsr(even)) == pytest.approx(float(least_lsr(even)), rel=1e-6)


@given(st.integers(0, 2**31), st.floats(0.02, 0.19), st.floats(0.1, 1.0))
@settings(max_examples=30, deadline=None)
def test_no_psf_has_more_contrast_or_less_peak_than_is_possible(seed, clear_peak, kept):
    intensity = torch.rand((1, 48, 48), generator=torch.Generator().manual_seed(seed)) ** 8
    drawn = psf(intensity * kept / intensity.sum(), clear_peak)
    bounds = limits(drawn)
    # one half of the frequencies stands for all
    assert float(mtf(drawn).rms) <= 1.05 * float(bounds.passed)
    assert float(bounds.rms) <= float(bounds.bound) * (1 + 1e-6)
    assert float(mtf(drawn).median) <= 1.05 * float(bounds.median)
    assert float(lsr(drawn)) >= float(bounds.floor) * (1 - 1e-6)


def test_what_leaves_the_field_lowers_the_floor_of_this_light_alone():
    half = psf(torch.full((1, 32, 16), 0.5 / 512), 0.12)
    assert float(limits(half).floor) == pytest.approx(0.5 * float(least_lsr(half)), rel=1e-6)


def test_the_share_of_frequencies_is_that_of_a_disc_cut_by_the_square():
    blank = torch.zeros((1, 800, 800))
    for p0 in (0.05, 0.12, 0.19, 0.25, 0.35, 0.5):
        r = math.sqrt(4 * p0 / math.pi)
        over = max(r - 0.5, 0.0)
        caps = 4 * (r * r * math.acos(min(0.5 / r, 1.0)) - 0.5 * math.sqrt(over * (r + 0.5)))
        whole = 4 * p0 - caps if r < math.sqrt(0.5) else 1.0
        assert float(passed_frequency_shares(psf(blank, p0))) == pytest.approx(whole, abs=2e-3)


def test_a_lens_whose_cut_off_is_sampled_has_at_most_half_the_contrast_in_root_mean_square():
    """mean |OTF|^2 over the band <= mean OTF = p0 / 4 p0."""
    clear = torch.zeros((1, 256, 256))
    clear[0, 8, 8], clear[0, 0, 0] = 0.12, 0.88 * 0.1
    found = psf(clear, 0.12)
    assert float(most_unsuppressed(found)) == pytest.approx(0.5, rel=2e-3)
    assert float(limits(found).passed) == pytest.approx(0.5 / math.sqrt(0.12 + 0.088), rel=2e-3)


@pytest.mark.parametrize("scale", [0.0, -1.0, 1e-40])
def test_without_light_all_are_zero_and_pull_nowhere(scale):
    dark = (scale * torch.ones((1, 8, 8), dtype=torch.float64)).requires_grad_()
    found = limits(psf(dark, 0.12))
    assert all(float(x.detach()) == 0 for x in found)
    assert float(torch.autograd.grad(sum(x.sum() for x in found), dark)[0].abs().max()) == 0


def test_the_bound_of_contrast_goes_as_the_root_of_the_suppression_and_ends_at_one():
    drawn = psf(torch.rand((1, 32, 32), generator=torch.Generator().manual_seed(3)) ** 6, 0.12)
    kept = Psf(drawn.intensity / drawn.intensity.sum(), drawn.clear_peak)
    found = most_contrast(float(most_unsuppressed(kept)), lsr(kept))
    assert float(found) == pytest.approx(float(limits(kept).passed), rel=1e-6)
    assert float(most_contrast(10.0, torch.ones(1))) == 1.0
