"""What no element can do better: the floor of the LSR and the most contrast, against closed forms and any PSF."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.metrics import limits, lsr, mtf
from neusee.nodes.values import Psf


def psf(intensity, clear_peak):
    return Psf(intensity, torch.tensor([clear_peak], dtype=torch.float64))


def test_light_that_is_spread_evenly_reaches_the_floor():
    even = psf(torch.full((1, 32, 16), 1 / 512), 0.12)
    assert float(lsr(even)) == pytest.approx(float(limits(even).floor), rel=1e-6)


@given(st.integers(0, 2**31), st.floats(0.02, 0.19), st.floats(0.1, 1.0))
@settings(max_examples=30, deadline=None)
def test_no_psf_has_more_contrast_or_less_peak_than_is_possible(seed, clear_peak, kept):
    intensity = torch.rand((1, 48, 48), generator=torch.Generator().manual_seed(seed)) ** 8
    drawn = psf(intensity * kept / intensity.sum(), clear_peak)
    bounds = limits(drawn)
    assert float(mtf(drawn).rms) <= 1.05 * float(bounds.passed)  # one half of the frequencies stands for all
    assert float(bounds.rms) <= float(bounds.bound) * (1 + 1e-6)
    assert float(mtf(drawn).median) <= 1.05 * float(bounds.median)
    assert float(lsr(drawn)) >= float(bounds.floor) * (1 - 1e-6)
