"""Statistics: what is kept beside a result is right for every type and size, whatever the parts
it is read in.
"""

import math

import numpy as np
import pytest
import torch

from neusee.nodes import TensorStats

SIZES = [(65,), (1000, 7), (1 << 17,), (3, 1 << 17), (2, (1 << 17) + 1)]


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize(
    "dtype", [torch.float16, torch.float32, torch.float64, torch.uint8, torch.int32, torch.bool]
)
def test_agrees_with_numpy(shape, dtype):
    torch.manual_seed(0)
    x = (torch.randn(shape) * torch.randint(0, 2, shape) * 5).abs().to(dtype)
    found, known = TensorStats.of(x), x.numpy().astype(np.float64)
    assert (found.min, found.max, found.support) == (
        known.min(),
        known.max(),
        np.count_nonzero(known),
    )
    assert found.sum == pytest.approx(known.sum(), rel=2e-7)
    assert found.finite
    assert found.shape == shape


@pytest.mark.parametrize("at", [0, 1 << 17, 200_000])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_one_number_that_is_none_is_found_in_any_part(at, bad):
    x = torch.ones(200_001)
    x[at] = bad
    found = TensorStats.of(x)
    assert not found.finite
    assert found.max == bad or found.min == bad or (math.isnan(bad) and math.isnan(found.max))


def test_a_sum_beyond_its_own_type_is_finite():
    found = TensorStats.of(torch.full((1 << 18,), 3e38))
    assert found.finite
    assert found.sum == pytest.approx(3e38 * (1 << 18), rel=1e-6)
    assert TensorStats.of(torch.full((1 << 12,), 6e4, dtype=torch.float16)).sum == pytest.approx(
        6e4 * (1 << 12), rel=1e-3
    )


def test_complex_numbers_count_by_their_magnitude_and_views_as_they_look():
    assert TensorStats.of(torch.full((100,), 3 + 4j)).sum == pytest.approx(500.0)
    whole = torch.arange(10_000.0).view(100, 100)
    assert TensorStats.of(whole.T[::3]) == TensorStats.of(whole.T[::3].contiguous())
    assert TensorStats.of(torch.tensor(2.0).expand(300, 1024)).sum == pytest.approx(
        2.0 * 300 * 1024
    )
