"""What no element can do better: the floor of the LSR and the most contrast, against closed forms and any PSF."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.metrics import lsr, mtf
from neusee.nodes.metrics._bounds import _share, least_lsr, most_contrast, most_unsuppressed
from neusee.nodes.values import Psf


def psf(intensity, clear_peak):
    return Psf(intensity, torch.tensor([clear_peak], dtype=torch.float64))


def test_light_that_is_spread_evenly_reaches_the_floor():
    even = psf(torch.full((1, 32, 16), 1 / 512), 0.12)
    assert float(lsr(even)) == pytest.approx(float(least_lsr(even)), rel=1e-6)


@given(st.integers(0, 2**31), st.floats(0.02, 0.19), st.floats(0.1, 1.0))
@settings(max_examples=30, deadline=None)
def test_no_psf_has_more_contrast_than_its_peak_allows(seed, clear_peak, kept):
    intensity = torch.rand((1, 48, 48), generator=torch.Generator().manual_seed(seed)) ** 8
    found = psf(intensity * kept / intensity.sum(), clear_peak)
    assert float(mtf(found).rms) <= 1.05 * float(most_contrast(found))  # the pixels' grid of frequencies is coarse


def test_the_share_of_frequencies_is_that_of_a_disc_cut_by_the_square():
    f = (torch.arange(1000, dtype=torch.float64) + 0.5) / 1000 - 0.5
    for p0 in (0.05, 0.12, 0.19, 0.25, 0.35, 0.5):
        counted = (torch.hypot(f[:, None], f) <= math.sqrt(4 * p0 / math.pi)).double().mean()
        assert float(_share(torch.tensor([p0], dtype=torch.float64))) == pytest.approx(float(counted), abs=1e-3)


def test_a_lens_whose_cut_off_is_sampled_has_at_most_half_the_contrast_in_root_mean_square():
    """mean |OTF|^2 over the band <= mean OTF = p0 / 4 p0."""
    clear = torch.zeros((1, 16, 16))
    clear[0, 8, 8], clear[0, 0, 0] = 0.12, 0.88 * 0.1
    found = psf(clear, 0.12)
    assert float(most_unsuppressed(found)) == pytest.approx(0.5, rel=1e-12)
    kept = 0.12 + 0.088
    assert float(most_contrast(found)) == pytest.approx(0.5 / math.sqrt(kept), rel=1e-6)
