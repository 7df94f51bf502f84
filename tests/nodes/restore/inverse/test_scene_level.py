"""Mean and contrast of a scene behind glare: right on average over scenes, exposures and errors
that NumPy draws.
"""

import numpy as np
import pytest
import torch

from neusee.nodes.restore.inverse import (
    BLOTCH_PIXELS,
    Told,
    drawn_blotches,
    level_and_variance,
)

WHITE = np.array([0.9, 1.0, 0.5])
FULL = 25_000.0


def column(values):
    return torch.from_numpy(np.asarray(values, float))[..., None, None]


def told(value, errors):
    return Told(column(value), column(errors))


def worlds(count, seed):
    """Means and variances of scenes, and what pictures tell of them: glare of two colours is
    wrong by any amount.
    """
    rng = np.random.default_rng(seed)
    for _ in range(count):
        level = 0.15 * FULL * np.exp(np.log(3.0) * rng.standard_normal())
        mean = WHITE * level * (1.0 + 0.3 * rng.standard_normal(3)).clip(0.05)
        contrast = 0.8 * level * np.exp(0.5 * rng.standard_normal())
        variance = (WHITE * contrast) ** 2 * (1.0 + 0.4 * rng.standard_normal(3)).clip(0.05)
        errors = 10 ** rng.uniform(0, 5) * np.abs(rng.standard_normal((2, 3)))
        wrong = 10 ** rng.uniform(0, 9) * np.array([[0.5, 1.0, 0.1]])
        yield (
            (mean, mean + rng.standard_normal(2) @ errors, errors),
            (variance, variance + rng.standard_normal(1) @ wrong, wrong),
        )


def test_the_deviation_of_the_mean_is_that_of_its_errors():
    squares = []
    for (mean, seen, errors), (_, varied, wrong) in worlds(300, 1):
        level, _ = level_and_variance(told(seen, errors), told(varied, wrong), column(WHITE), FULL)
        squares.append(
            ((level.value[:, 0, 0].numpy() - mean) / level.deviation[:, 0, 0].numpy()) ** 2
        )
    assert 0.6 < np.mean(np.minimum(squares, 25.0)) < 1.4


def test_the_mean_is_better_than_what_the_picture_tells_and_than_the_prior():
    found, direct, prior = [], [], []
    for (mean, seen, errors), (_, varied, wrong) in worlds(300, 2):
        level, _ = level_and_variance(told(seen, errors), told(varied, wrong), column(WHITE), FULL)
        for values, x in (
            (found, level.value[:, 0, 0].numpy()),
            (direct, seen),
            (prior, 0.15 * FULL * WHITE),
        ):
            values.append(np.abs(x - mean).mean())
    assert np.mean(found) < 0.7 * np.mean(prior)
    assert np.mean(found) < 0.5 * np.mean(direct)


def test_the_variance_is_right_on_average_by_a_factor():
    ratios = []
    for (_, seen, errors), (variance, varied, wrong) in worlds(300, 3):
        _, squares = level_and_variance(
            told(seen, errors), told(varied, wrong), column(WHITE), FULL
        )
        ratios.append(np.log(squares.value[:, 0, 0].numpy() / variance).mean())
    assert abs(np.mean(ratios)) < 0.6  # the mean of a wide law is above its median
    assert np.std(ratios) < 1.2


def test_what_is_told_exactly_is_kept():
    mean, variance = np.array([3000.0, 100.0, 9000.0]), np.array([4e6, 5e6, 1.5e6])
    nothing = np.zeros((1, 3))
    level, squares = level_and_variance(
        told(mean, nothing), told(variance, nothing), column(WHITE), FULL
    )
    np.testing.assert_allclose(level.value[:, 0, 0], mean, rtol=0.01)
    np.testing.assert_allclose(squares.value[:, 0, 0], variance, rtol=0.1)
    assert float(level.deviation.max()) < 5.0


@pytest.mark.parametrize("size", [(1, 5), (40, 70), (128, 128)])
def test_blotches_have_the_deviation_that_is_given_and_are_wide(size):
    deviation = torch.linspace(1.0, 3.0, size[0] * size[1], dtype=torch.float64).reshape(1, *size)
    draws = torch.stack(
        [drawn_blotches(deviation, torch.Generator().manual_seed(seed))[0] for seed in range(600)]
    )
    torch.testing.assert_close(draws.square().mean(0).sqrt(), deviation[0], rtol=0.15, atol=0.0)
    far = 3 * BLOTCH_PIXELS
    row = draws[:, 0] / deviation[0, 0]
    assert float((row[:, 0] * row[:, 2]).mean()) > 0.8
    if size[1] > far:
        assert abs(float((row[:, 0] * row[:, far]).mean())) < 0.15
