"""Two outcomes are the same if all their bits are, in the same order; a difference says where
and how large.
"""

from typing import NamedTuple

import numpy as np
import pytest
import torch

from neusee.workflows.contract.node_rules import difference, outcome_of


class Pair(NamedTuple):
    left: torch.Tensor
    right: float


def outcome(value):
    return outcome_of(lambda: value, __name__)


NAN = float("nan")
SAME = [
    torch.tensor([1.0, NAN]),
    {"a": 1, "b": [2.0, None]},
    Pair(torch.ones(2), NAN),
    {"x", "y"},
    np.ones(3),
    "text",
]


@pytest.mark.parametrize("value", SAME)
def test_what_has_the_same_bits_does_not_differ(value):
    assert difference(outcome(value), outcome(value), 0.0) is None


DIFFERENT = {
    "size": (
        torch.tensor([1.0, 2.0]),
        torch.tensor([1.0, 4.0]),
        "the result differs by 0.5 of its largest value",
    ),
    "part": (
        Pair(torch.ones(2), 1.0),
        Pair(torch.ones(2), 2.0),
        "the result.right is 1.0 and not 2.0",
    ),
    "order": (
        {"a": 1, "b": 2},
        {"b": 2, "a": 1},
        "the result has other parts, or in another order",
    ),
    "shape": (torch.ones(2), torch.ones(3), "the result is 2 float32 and not 3 float32"),
    "type": (torch.ones(2), torch.ones(2).double(), "the result is 2 float32 and not 2 float64"),
    "NaN": (
        torch.tensor([1.0, NAN]),
        torch.tensor([NAN, 1.0]),
        "the result has NaN or infinite values at other places",
    ),
    "number": (1, 1.0, "the result is 1 and not 1.0"),
}


@pytest.mark.parametrize("kind", DIFFERENT)
def test_a_difference_is_said_with_its_part(kind):
    found, wanted, text = DIFFERENT[kind]
    one = difference(outcome(found), outcome(wanted), 0.0)
    assert one is not None
    assert one.text == text
    assert not one.is_rounding


def test_rounding_is_within_the_error_of_the_node_or_a_few_steps_of_the_type():
    one, other = outcome(torch.tensor([1.0])), outcome(torch.tensor([1.0 + 1e-6]))
    assert difference(other, one, 0.0).is_rounding
    far = outcome(torch.tensor([1.0 + 1e-4]))
    assert not difference(far, one, 1e-5).is_rounding
    assert difference(far, one, 1e-3).is_rounding
    counts = [outcome(torch.tensor([1000, number])) for number in (1, 2)]
    assert not difference(*counts, 0.0).is_rounding


def test_an_error_is_said_with_the_line_that_raised_it():
    def fails():
        raise ValueError("no\n  gain")

    failed = outcome_of(fails, __name__)
    assert failed.failure == "raises ValueError: no gain"
    assert failed.place == f"test_outcomes.py:{fails.__code__.co_firstlineno + 1}"
    assert difference(failed, outcome(1), 0.0).text == "it raises ValueError: no gain"
    assert difference(outcome(1), failed, 0.0).text == "it gives a result"
