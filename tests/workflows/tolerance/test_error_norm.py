"""The norm of every tolerance: root mean square over the largest element of the reference."""

import math
from typing import NamedTuple

import pytest
import torch

from neusee.workflows.tolerance.error_norm import error_of, largest_error


class Pair(NamedTuple):
    one: torch.Tensor
    two: torch.Tensor


def test_a_known_difference():
    reference = torch.tensor([0.0, 4.0, -8.0, 2.0])
    value = reference + torch.tensor([0.0, 0.0, 0.0, 1.6])
    assert error_of(value, reference) == pytest.approx(0.8 / 8)
    assert largest_error(value, reference) == pytest.approx(1.6 / 8)


def test_60_db_is_a_thousandth():
    reference = torch.linspace(0, 1, 10001, dtype=torch.float64)
    noise = (
        torch.randn(10001, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 1e-3
    )
    psnr = -10 * math.log10(float(noise.square().mean()))
    assert -20 * math.log10(error_of(reference + noise, reference)) == pytest.approx(psnr)


def test_of_several_the_worst_counts():
    a, b = torch.ones(3), torch.ones(2)
    assert error_of(Pair(a, b * 1.5), Pair(a, b)) == pytest.approx(0.5)
    assert error_of({"x": [a, a * 3]}, {"x": [a, a]}) == pytest.approx(2.0)


def test_nothing_is_compared_with_its_own_size():
    assert error_of(torch.full((4,), 0.25), torch.zeros(4)) == 0.25
    assert error_of(torch.zeros(4), torch.zeros(4)) == 0.0
    assert error_of(torch.zeros(0), torch.zeros(0)) == 0.0


@pytest.mark.parametrize("odd", [math.nan, math.inf])
def test_what_is_not_finite_must_be_so_in_both(odd):
    reference = torch.tensor([1.0, odd])
    assert error_of(reference.clone(), reference) == 0.0
    assert error_of(torch.tensor([1.0, 1.0]), reference) == math.inf
    assert error_of(reference, torch.tensor([1.0, 1.0])) == math.inf


def test_large_tensors_are_compared_in_parts_and_in_double_precision():
    reference = torch.ones((1 << 22) + 3)
    value = reference.clone()
    value[-1] += 1.0
    assert error_of(value, reference) == pytest.approx(1 / math.sqrt(len(reference)))
    assert error_of(value.double(), reference) == pytest.approx(1 / math.sqrt(len(reference)))


@pytest.mark.parametrize(
    "value", [torch.ones(3), (torch.ones(2),), None], ids=["shape", "kind", "nothing"]
)
def test_what_cannot_be_compared_is_refused(value):
    with pytest.raises(ValueError, match="cannot compare"):
        error_of(value, torch.ones(2))
