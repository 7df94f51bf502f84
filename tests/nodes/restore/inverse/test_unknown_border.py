"""A border wider than the reach of the PSF: opposite ends of a picture need not agree, against
dense NumPy algebra.
"""

import numpy as np
import pytest
import torch

from neusee.nodes.restore import wiener, wiener_spread
from neusee.nodes.restore.inverse import (
    Settings,
    about_mean,
    expected_variance,
    fall,
    posed,
    visible,
)
from neusee.nodes.values import Bands, Psf

ONE = torch.ones(1, dtype=torch.float64)
BANDS = Bands(550e-9 * ONE, 1e-8 * ONE, ONE)
SIDE, REACH, READ = 16, 10, 10.0


def ring():
    """A PSF without a peak, as wide as the picture."""
    at = np.arange(2 * REACH + 1) - REACH
    distance = np.hypot(at[:, None], at)
    kernel = np.where((distance > 5) & (distance < REACH + 0.3), 1.0, 0.0)
    return kernel / kernel.sum()


def valid(whole, kernel):
    """A convolution of a wide picture, of which the border is cropped."""
    out = np.zeros((SIDE, SIDE))
    middle = (len(whole) - SIDE) // 2
    for dy in range(-REACH, REACH + 1):
        for dx in range(-REACH, REACH + 1):
            rows = slice(middle - dy, middle - dy + SIDE)
            out += kernel[dy + REACH, dx + REACH] * whole[rows, middle - dx : middle - dx + SIDE]
    return out


def law(period, wide):
    """Covariance of two pixels by their distance (y, x), on a torus so wide that it is none."""
    fy, fx = np.fft.fftfreq(wide)[:, None], np.fft.fftfreq(wide)
    power = (fy**2 + fx**2 + 1 / period**2) ** -1.5
    return np.fft.ifft2(power / power.mean()).real


def restored(electrons, kernel, **how):
    psf = Psf(torch.tensor(kernel)[None], ONE)
    channels, clipped = (
        torch.ones(1, 1, dtype=torch.float64),
        torch.zeros(1, SIDE, SIDE, dtype=torch.bool),
    )
    picture = torch.tensor(electrons)[None]
    return wiener(picture, psf, ONE, channels, BANDS, clipped, read_noise=READ, **how)[0].numpy()


def model(scaled):
    """Prior of a scene that does not repeat, camera and noise as matrices, in the units of a
    posed filter.
    """
    covariance, side = law(2 * SIDE, 64 * SIDE), SIDE + 2 * REACH
    at = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), -1).reshape(-1, 2)
    apart = at[:, None] - at
    camera = np.zeros((SIDE * SIDE, side * side))
    for row, (y, x) in enumerate(np.ndindex(SIDE, SIDE)):
        window = np.zeros((side, side))
        window[y : y + 2 * REACH + 1, x : x + 2 * REACH + 1] = ring()[::-1, ::-1] / float(
            scaled.share
        )
        camera[row] = window.ravel()
    return (
        covariance[apart[..., 0], apart[..., 1]],
        camera,
        np.diag(1 / scaled.problem.weight[0].numpy().ravel()),
    )


def inner(values):
    """The pixels of the frame, from those of the whole scene."""
    return values.reshape(SIDE + 2 * REACH, -1)[REACH:-REACH, REACH:-REACH]


def dense(scaled):
    """The mean of the posterior of a scene that does not repeat, for the mean, scale and weights
    of a posed filter.
    """
    prior, camera, noise = model(scaled)
    seen = scaled.problem.picture[0].numpy().ravel()
    found = prior @ camera.T @ np.linalg.solve(camera @ prior @ camera.T + noise, seen)
    return inner(found) * float(scaled.scale) / float(scaled.share) + float(scaled.mean)


def dense_variance(scaled):
    """The mean variance of the pixels of the frame in that posterior."""
    prior, camera, noise = model(scaled)
    left = prior - prior @ camera.T @ np.linalg.solve(
        camera @ prior @ camera.T + noise, camera @ prior
    )
    return inner(np.diag(left)).mean() * (float(scaled.scale) / float(scaled.share)) ** 2


def frame(seed):
    """The picture of a drawn scene that does not repeat, with noise, in e-."""
    rng = np.random.default_rng(seed)
    wide = 16 * SIDE
    fy, fx = np.fft.fftfreq(wide)[:, None], np.fft.fftfreq(wide)
    root = (fy**2 + fx**2 + 1 / (4 * SIDE) ** 2) ** -0.75
    scene = np.fft.ifft2(np.fft.fft2(rng.standard_normal((wide, wide))) * root).real
    scene = 8000 + 1500 * (scene - scene.mean()) / scene.std()
    picture = valid(scene, ring())
    return picture + rng.standard_normal(picture.shape) * np.sqrt(picture + READ**2)


def problem_of(electrons, border):
    kernel = torch.tensor(ring())[None]
    known = torch.ones(1, SIDE, SIDE, dtype=torch.float64)
    settings = Settings(1.0, READ, border=border)
    return posed(torch.tensor(electrons)[None], known, kernel, visible([], [], known), settings)


@pytest.mark.parametrize("seed", range(3))
def test_a_wider_border_comes_nearer_to_a_scene_that_does_not_repeat(seed):
    electrons = frame(seed)
    gaps = []
    for border in (1.01, 2.0, 4.0):
        exact = dense(problem_of(electrons, border))
        found = restored(electrons, ring(), border=border)
        gaps.append(np.sqrt(np.mean((found - exact) ** 2)) / exact.std())
    assert gaps[1] < 0.5 * gaps[0]
    assert gaps[2] < 0.5 * gaps[1]


@pytest.mark.parametrize("seed", range(4))
def test_a_scene_whose_ends_differ_is_restored_better(seed):
    rng, wide = np.random.default_rng(seed), 4 * SIDE
    towards, at = rng.uniform(0, 2 * np.pi), np.arange(wide) - wide / 2
    ramp = 8000 + 3000 * (np.cos(towards) * at[:, None] + np.sin(towards) * at) / SIDE
    picture = valid(ramp, ring())
    noisy = picture + rng.standard_normal(picture.shape) * np.sqrt(picture + READ**2)
    inside = slice((wide - SIDE) // 2, (wide + SIDE) // 2)
    errors = [
        np.std(restored(noisy, ring(), border=border) - ramp[inside, inside])
        for border in (1.0, 2.0)
    ]
    assert errors[1] < 0.75 * errors[0]


@pytest.mark.parametrize(
    ("picture", "torus"), [((5, 4), (12, 15)), ((6, 6), (6, 6)), ((1, 7), (3, 20))]
)
def test_the_variance_about_the_mean_is_that_of_the_covariance(picture, torus):
    rng = np.random.default_rng(1)
    kernel = rng.uniform(0, 1, torus)
    power = fall(torus)
    transfer = torch.fft.rfft2(torch.tensor(kernel))[None]
    found = float(expected_variance(transfer, about_mean(power, picture, torus), torus))
    whole = (
        np.abs(np.fft.fft2(kernel)) ** 2
        * np.fft.fft2(torch.fft.irfft2(power, s=torus).numpy()).real
    )
    covariance = np.fft.ifft2(whole).real
    at = np.stack(np.meshgrid(*map(np.arange, picture), indexing="ij"), -1).reshape(-1, 2)
    apart = at[:, None] - at
    dense_covariance = covariance[apart[..., 0] % torus[0], apart[..., 1] % torus[1]]
    blurred_mean = dense_covariance.mean()
    assert found == pytest.approx(covariance[0, 0] - blurred_mean, rel=1e-9)


def test_the_reach_alone_is_the_filter_without_the_parameter():
    electrons = frame(7)
    assert np.array_equal(restored(electrons, ring(), border=1.0), restored(electrons, ring()))


def test_the_deviation_of_drawn_scenes_is_that_of_the_wider_border():
    electrons = frame(8)
    psf, one = Psf(torch.tensor(ring())[None], ONE), torch.ones(1, 1, dtype=torch.float64)
    clipped = torch.zeros(1, SIDE, SIDE, dtype=torch.bool)
    found = [
        wiener_spread(
            torch.tensor(electrons)[None],
            psf,
            ONE,
            one,
            BANDS,
            clipped,
            one,
            law="filter",
            draws=64,
            border=border,
            read_noise=READ,
            rng=torch.Generator().manual_seed(3),
        )
        .square()
        .mean()
        for border in (1.0, 2.0)
    ]
    assert float(found[1]) == pytest.approx(dense_variance(problem_of(electrons, 2.0)), rel=0.15)
    assert float(found[0]) < 0.8 * float(found[1])
