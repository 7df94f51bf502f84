"""The law that a frame tells of its scene, and errors that follow the details of a frame: scenes
and blur in NumPy.
"""

import numpy as np
import pytest
import torch

from neusee.nodes.restore import wiener_spread
from neusee.nodes.restore.inverse import Blurred, fitted_law
from neusee.nodes.values import Bands, Psf

SIDE, TORUS, WIDE = 64, 100, 256
ONE = torch.ones(1, dtype=torch.float64)


def frequency(size):
    return np.hypot(np.fft.fftfreq(size)[:, None], np.fft.fftfreq(size))


def law(size, slope, strength):
    return strength * (frequency(size) ** 2 + 1 / SIDE**2) ** (-slope / 2)


def speckles(rng, side=33):
    """The PSF of a rough mask: random phases in a round pupil."""
    at = np.linspace(-2, 2, side)
    pupil = np.hypot(at[:, None], at) < 1
    light = (
        np.abs(np.fft.fftshift(np.fft.fft2(pupil * np.exp(2j * np.pi * rng.random((side, side))))))
        ** 2
    )
    return light / light.sum()


def scene(slope, strength, rng):
    """A scene of a power spectrum, on a torus far wider than the frame."""
    white = np.fft.fft2(rng.standard_normal((WIDE, WIDE)))
    return np.fft.ifft2(white * np.sqrt(law(WIDE, slope, strength))).real


def centred(kernel, size):
    wide = np.zeros((size, size))
    wide[: len(kernel), : len(kernel)] = kernel
    return np.roll(wide, (-(len(kernel) // 2),) * 2, (0, 1))


def problem_of(slope, rng, noise=1e-3, told=1e-3, glare=False):
    """A frame of a drawn scene, as the filter poses it, and the strength of the scene's law."""
    kernel, strength = speckles(rng), 1.0 / law(WIDE, slope, 1.0).mean()
    image = np.fft.ifft2(
        np.fft.fft2(scene(slope, strength, rng)) * np.fft.fft2(centred(kernel, WIDE))
    ).real
    deviation = np.full((SIDE, SIDE), noise**0.5)
    if glare:
        y, x = np.indices((SIDE, SIDE))
        deviation = np.hypot(deviation, 1e4 / (1 + (y - 40) ** 2 + (x - 20) ** 2) ** 1.5)
    picture = image[:SIDE, :SIDE] + deviation * rng.standard_normal((SIDE, SIDE))
    weight = 1 / (deviation**2 - noise + told)
    weight[10:14, 30:50] = 0  # saturated
    picture[10:14, 30:50] = 40.0
    given = [torch.from_numpy(x[None].copy()) for x in (picture, weight)]
    transfer = torch.fft.rfft2(torch.from_numpy(centred(kernel, TORUS)))[None]
    return Blurred(
        *given, transfer, torch.ones(TORUS, TORUS // 2 + 1), (TORUS, TORUS), 0.0
    ), strength


@pytest.mark.parametrize(("glare", "within"), [(False, 1.6), (True, 5.0)])
@pytest.mark.parametrize("slope", [2.5, 3.0])
def test_the_law_of_a_frame_is_that_of_its_scene_behind_a_mask(slope, glare, within):
    """In the median of five frames, beside a glare that is not known too: there within a factor
    of 5.
    """
    found = []
    for seed in range(5):
        problem, strength = problem_of(
            slope, np.random.default_rng([seed, int(10 * slope)]), glare=glare
        )
        ratio = fitted_law(problem).power.numpy() / law(TORUS, slope, strength)[:, : TORUS // 2 + 1]
        at = frequency(TORUS)[:, : TORUS // 2 + 1]
        found.append([np.log(ratio[(at > low) & (at < 2 * low)]).mean() for low in (0.05, 0.1)])
    assert np.abs(np.median(found, 0)).max() < np.log(within), np.exp(found)


def test_noise_beyond_what_the_filter_assumes_is_found_and_the_right_one_is_kept():
    factors = [
        [
            fitted_law(problem_of(3.0, np.random.default_rng(s), noise=0.1, told=0.1 / f)[0]).noise
            for s in range(4)
        ]
        for f in (1.0, 8.0)
    ]
    assert np.median(factors[0]) == 1.0
    assert 4.0 <= np.median(factors[1]) <= 16.0


def test_the_error_is_larger_where_the_frame_has_details():
    """Half of the scene is even, half has squares; the deviation follows the error of each half."""
    rng = np.random.default_rng(3)
    true = np.full((SIDE, SIDE), 1500.0)
    true[:, SIDE // 2 :] = 800 + 1400 * np.kron(rng.random((16, 8)), np.ones((4, 4)))
    y, x = np.indices((9, 9)) - 4
    kernel = np.exp(-(y**2 + x**2) / 3.0)[None]
    kernel /= kernel.sum()
    wide = np.pad(true, 4, mode="edge")
    parts = np.lib.stride_tricks.sliding_window_view(wide, (9, 9))
    seen = rng.poisson(np.einsum("yxab,ab->yx", parts, kernel[0]))[None].astype(float)
    given = [torch.from_numpy(each) for each in (seen, kernel)]
    matrix, responses = torch.eye(1, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64)
    bands, clipped = Bands(550e-9 * ONE, 1e-8 * ONE, ONE), torch.zeros(seen.shape, dtype=torch.bool)
    found = wiener_spread(
        given[0],
        Psf(given[1], ONE),
        ONE,
        responses,
        bands,
        clipped,
        matrix,
        read_noise=5.0,
        rng=torch.Generator().manual_seed(1),
    )[0].numpy()
    assert found[:, 40:].mean() > 2.5 * found[:, :24].mean()
