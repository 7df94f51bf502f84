"""Width of the mean of two nested models, against the algebra of least squares."""

import numpy as np
import pytest

from neusee.workflows.calibration.frame_validity import width_of_mean


@pytest.mark.parametrize("terms", [1, 2, 3])
def test_the_width_is_that_of_the_mean_of_two_least_squares(terms):
    x = np.linspace(0.05, 1, 14)
    scatter = 0.02 + 0.1 * x
    powers = x[:, None] ** np.arange(terms + 1) / scatter[:, None]
    # of the first value
    fewer, more = (np.linalg.pinv(powers[:, :count])[0] / scatter for count in (terms, terms + 1))
    width = np.linalg.norm((fewer + more) / 2 * scatter)
    assert width_of_mean(
        np.linalg.norm(fewer * scatter), np.linalg.norm(more * scatter)
    ) == pytest.approx(width)
    assert width < 0.99 * np.linalg.norm(more * scatter)


def test_a_posterior_that_narrows_with_a_term_counts_as_no_wider():
    assert width_of_mean(2.0, 1.5) == 2.0
    assert width_of_mean(2.0, 2.0) == 2.0
