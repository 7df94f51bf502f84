"""Test targets: exact areas, symmetry, determinism."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes import ParameterError
from neusee.nodes.scene import targets

KINDS = ["flat", "edge", "slanted_edge", "siemens", "points"]


@settings(max_examples=60, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    y=st.integers(1, 90),
    x=st.integers(1, 90),
    ends=st.tuples(*[st.floats(0, 1)] * 2),
)
def test_any_shape_stays_between_low_and_high(kind, y, x, ends):
    low, high = sorted(ends)
    result = targets(kind=kind, shape=(y, x), low=low, high=high)
    assert result.shape == (3, y, x)
    assert result.dtype == torch.float32
    assert float(result.min()) >= low - 1e-6
    assert float(result.max()) <= high + 1e-6
    assert torch.equal(result, targets(kind=kind, shape=(y, x), low=low, high=high))


def test_edge_halves_the_pixel_on_the_axis():
    row = targets(kind="edge", shape=(3, 8))[0, 1]
    assert row.tolist() == [0, 0, 0, 0, 0.5, 1, 1, 1]


def test_slanted_edge_is_the_area_beyond_the_line():
    fine, tilt = 64, math.radians(5)
    result = targets(kind="slanted_edge", shape=(9, 9))[0].double()
    offsets = (torch.arange(9 * fine, dtype=torch.float64) + 0.5) / fine - 4.5
    beyond = (offsets[None, :] * math.cos(tilt) + offsets[:, None] * math.sin(tilt) > 0).double()
    counted = beyond.reshape(9, fine, 9, fine).mean((1, 3))
    torch.testing.assert_close(result, counted, atol=2e-3, rtol=0)
    torch.testing.assert_close(
        result + result.flip(0, 1), torch.ones(9, 9, dtype=torch.float64), atol=1e-6, rtol=0
    )


def test_star_has_36_cycles_and_mean_grey():
    star = targets(kind="siemens", shape=(257, 257))[0].double()
    angle = torch.linspace(0, 2 * math.pi, 3601, dtype=torch.float64)[:-1]
    y, x = (
        (128 + 100 * torch.sin(angle)).round().long(),
        (128 + 100 * torch.cos(angle)).round().long(),
    )
    spectrum = torch.fft.rfft(star[y, x] - 0.5).abs()
    assert int(spectrum.argmax()) == 36
    assert abs(float(star[128, 128]) - 0.5) < 1e-6
    assert abs(float(star.mean()) - 0.5) < 5e-3


def test_points_are_single_pixels_with_one_on_the_axis():
    result = targets(kind="points", shape=(200, 130), high=0.5)[0]
    assert float(result[100, 65]) == 0.5
    assert int((result > 0).sum()) == 3 * 3  # rows 36, 100, 164; columns 1, 65, 129


def test_flat_is_flat():
    assert torch.equal(targets(kind="flat", shape=(2, 3), high=0.25), torch.full((3, 2, 3), 0.25))


def test_refuses_low_above_high():
    with pytest.raises(ParameterError, match=r"0\.9.*0\.1"):
        targets.hooks.preflight(kind="edge", shape=(2, 2), low=0.9, high=0.1)
