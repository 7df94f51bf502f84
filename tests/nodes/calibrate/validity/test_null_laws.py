"""The laws of chance behind the tests of frames, against SciPy and against NumPy's noise."""

import math

import numpy as np
import pytest
import torch
from scipy.fft import dctn
from scipy.stats import chi2, kstest, kurtosis, kurtosistest, norm

from neusee.nodes.calibrate import _frame_pairs, _noise_tests


def test_limits_are_those_of_the_normal_law():
    assert _frame_pairs.normal_limit(1e-3) == pytest.approx(norm.isf(1e-3), rel=1e-12)
    evidence = _frame_pairs.strongest_evidence([[1.0, 2.0, 3.0], [0.0, -5.0, 0.0]])
    assert evidence.strength == pytest.approx(6 / math.sqrt(3))
    assert evidence.limit == pytest.approx(norm.isf(1e-3 / 8), rel=1e-12)
    both = _frame_pairs.strongest_evidence([[1.0, 2.0, 3.0], [0.0, -5.0, 0.0]], sides=2)
    assert (both.strength, both.limit) == (5.0, pytest.approx(norm.isf(1e-3 / 16), rel=1e-12))


def test_a_chi_square_number_becomes_a_normal_one():
    for freedom in (31, 500):
        for p in (0.5, 0.1, 1e-3, 1e-6):
            assert _noise_tests._chi_square_as_normal(
                chi2.isf(p, freedom), freedom
            ) == pytest.approx(norm.isf(p), abs=0.05)


def test_the_kurtosis_becomes_a_normal_number_as_in_scipy():
    rng = np.random.default_rng(4)
    for n in (100, 4096):
        for x in (rng.standard_normal(n), rng.standard_t(4, n), rng.uniform(-1, 1, n)):
            assert _noise_tests._kurtosis_as_normal(kurtosis(x, fisher=False), n) == pytest.approx(
                kurtosistest(x).statistic, rel=1e-9
            )


def test_cosines_of_blocks_are_those_of_scipy():
    frame = np.random.default_rng(1).standard_normal((24, 40))
    blocks = frame.reshape(3, 8, 5, 8).transpose(0, 2, 1, 3)
    expected = dctn(blocks, axes=(2, 3), norm="ortho").reshape(15, 64)
    np.testing.assert_allclose(
        _noise_tests._block_cosines(torch.from_numpy(frame)).numpy(), expected, atol=1e-12
    )


def test_products_of_neighbours_without_line_means_are_standard_normal():
    """Also where the pixels have unequal variances."""
    rng, found = np.random.default_rng(2), []
    unlike = np.exp(rng.standard_normal((32, 32)))
    for i in range(300):
        x = torch.from_numpy(rng.standard_normal((1, 32, 32)) * (unlike if i % 2 else 1.0))
        x = x - x.mean(2, keepdim=True) - x.mean(1, keepdim=True) + x.mean()
        found.append(
            _frame_pairs.studentised(
                _noise_tests.neighbour_products(x, (0, 1) if i % 3 else (1, 0))
            )
        )
    assert kstest(found, "norm").pvalue > 1e-3
    assert np.std(found) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("sd", [1.0, 1.7, 9.0])
def test_the_middle_of_rounded_noise_has_its_standard_deviation(sd):
    rng = np.random.default_rng(3)
    pair = np.rint(rng.normal(50.3, sd, (2, 400, 400)))
    x = torch.from_numpy(pair[1] - pair[0])
    assert _noise_tests._core_deviation(x) == pytest.approx(math.sqrt(2 * sd**2 + 1 / 6), rel=0.012)


def test_an_error_above_two_percent_is_refused_and_a_smaller_one_widens():
    strong = _frame_pairs.strongest_evidence([[9.0]])
    assert [
        _frame_pairs.outcome("x", strong, "y", {"gain": g}, "z").verdict for g in (0.01, 0.03)
    ] == [
        "widened",
        "refused",
    ]
    assert _frame_pairs.outcome("x", strong, "y", {}, "z").verdict == "refused"
    assert _frame_pairs.outcome("x", strong, "y", {"gain": 0.5}, "z", "w").verdict == "modelled"
    assert (
        _frame_pairs.outcome(
            "x", _frame_pairs.strongest_evidence([[1.0]]), "y", {"gain": 0.5}, "z"
        ).verdict
        == "passed"
    )
    assert _noise_tests._step_evidence(4, []) == []
