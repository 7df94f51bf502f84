"""The filter that knows the glare roughly: against a dense solve in NumPy, and against what it
was not told.
"""

import numpy as np
import pytest
import torch

from neusee.nodes.restore import wiener
from neusee.nodes.values import Bands, Psf

ONE = torch.ones(1, dtype=torch.float64)
BANDS = Bands(550e-9 * ONE, 1e-8 * ONE, ONE)
SIZE, TORUS, CHANNELS, READ = (10, 9), (14, 14), 2, 10.5


def dense(electrons, kernel, known, glare, nearby, doubt, balance):
    """The posterior mean in NumPy from the definitions: every pixel of the torus an unknown, all
    covariances dense.
    """
    strengths, weights, own, modes = fitted(electrons, known, glare, nearby, doubt), known, 0, []
    for last in (False, False, True):
        light = np.tensordot(strengths, glare, 1)
        own = doubt**2 * sum((s * around(g)) ** 2 for s, g in zip(strengths, glare, strict=True))
        modes = [
            s * (n - g) / len(near) ** 0.5
            for s, g, near in zip(strengths, glare, nearby, strict=True)
            for n in near
        ]
        every = own + sum(m**2 for m in modes)
        if not last:
            noise = shot(electrons, mean_of(electrons - light, weights))
            weights = known * noise / (noise + every)
            strengths = fitted(electrons, weights, glare, nearby, doubt)
    picture = electrons - light
    mean = mean_of(picture, weights)
    covariance = np.diag((balance * shot(electrons, mean) + own).ravel()) + sum(
        np.outer(m, m) for m in modes
    )
    blur, power = one_blur(kernel), spectrum()
    transfer = (
        np.abs(
            np.fft.fft2(
                np.pad(kernel, [(0, n - k) for n, k in zip(TORUS, kernel.shape, strict=True)])
            )
        )
        ** 2
    )
    seen = mean_of((picture - mean) ** 2, weights) - mean - READ**2 - mean_of(every, weights)
    seen = np.maximum(seen, 0.01 * mean_of((picture - mean) ** 2, weights))
    scale = np.sqrt(seen / (transfer * power).mean()).ravel()
    lags = np.fft.ifft2(power).real
    at = np.indices(TORUS).reshape(2, -1).T
    apart = (at[:, None] - at) % np.array(TORUS)
    alike = np.where(np.eye(CHANNELS), 1.0, 0.95)
    prior = np.kron(alike * np.outer(scale, scale), lags[apart[..., 0], apart[..., 1]])
    seen_pixels = known.ravel() > 0
    design = np.kron(np.eye(CHANNELS), blur)[seen_pixels]
    data = (picture - mean).ravel()[seen_pixels]
    inverse = np.linalg.inv(
        design @ prior @ design.T + covariance[np.ix_(seen_pixels, seen_pixels)]
    )
    free = np.array([g.ravel()[seen_pixels] for g in glare]).T
    data = data - free @ np.linalg.solve(free.T @ inverse @ free, free.T @ inverse @ data)
    found = (prior @ design.T @ inverse @ data).reshape(CHANNELS, *TORUS)[:, : SIZE[0], : SIZE[1]]
    return found + mean / kernel.sum()


def around(glare):
    """The light around each pixel, pixel by pixel: sums over squares, over their size and their
    radius.
    """
    total = np.zeros(glare.shape)
    for y, x in np.ndindex(*glare.shape[1:]):
        for r in (1, 4, 16, 64):
            square = glare[:, max(0, y - r) : y + r + 1, max(0, x - r) : x + r + 1]
            total[:, y, x] += square.sum((1, 2)) / (2 * r + 1) ** 2 / r
    return total


def mean_of(picture, weights):
    return (picture * weights).sum((1, 2), keepdims=True) / weights.sum((1, 2), keepdims=True)


def fitted(electrons, weights, glare, nearby, doubt):
    """Weighted least squares of the glare and a constant in each channel."""
    ones = [
        np.broadcast_to(np.arange(CHANNELS)[:, None, None] == c, electrons.shape)
        for c in range(CHANNELS)
    ]
    design = np.stack([*glare, *ones]).reshape(len(glare) + CHANNELS, -1).T
    root = np.sqrt(weights).ravel()
    return np.linalg.lstsq(design * root[:, None], electrons.ravel() * root, rcond=None)[0][
        : len(glare)
    ]


def shot(electrons, mean):
    """Noise variance: the mean of the nine nearest pixels on each axis in turn, at least the
    mean of the picture.
    """
    around = electrons
    for axis in (1, 2):
        count = around.shape[axis]
        spans = [range(max(0, i - 4), min(count, i + 5)) for i in range(count)]
        around = np.stack([np.take(around, list(span), axis).mean(axis) for span in spans], axis)
    return np.maximum(around, mean) + READ**2


def spectrum():
    fy, fx = (np.fft.fftfreq(n) for n in TORUS)
    power = (fy[:, None] ** 2 + fx**2 + 1 / (TORUS[0] * TORUS[1])) ** -1.5
    return power / power.mean()


def one_blur(kernel):
    """The matrix from the pixels of the torus to those of the picture, written out pixel by
    pixel.
    """
    matrix, half = np.zeros((SIZE[0] * SIZE[1], TORUS[0] * TORUS[1])), len(kernel) // 2
    for row, (y, x) in enumerate(np.ndindex(*SIZE)):
        for (j, i), share in np.ndenumerate(kernel):
            matrix[row, ((y - j + half) % TORUS[0]) * TORUS[1] + (x - i + half) % TORUS[1]] += share
    return matrix


def drawn(seed=0):
    """A scene, a kernel of 5 x 5, two glare patterns, and other patterns of the first of them."""
    rng = np.random.default_rng(seed)
    kernel = rng.random((5, 5)) + 0.2
    y, x = np.indices(SIZE)
    bump = [np.exp(-((y - a) ** 2 + (x - b) ** 2) / 6.0) for a, b in ((4, 4), (7, 2))]
    glare = [np.stack([b, 0.6 * b + 0.02]) for b in bump]
    near = [
        np.stack([np.roll(glare[0], n, axis) for n in (-1, 1) for axis in (1, 2)]),
        np.zeros((0, 2, *SIZE)),
    ]
    electrons = 3000 * rng.random((CHANNELS, *SIZE)) + 9000 * glare[0] + 2000 * glare[1]
    return electrons, kernel / kernel.sum(), electrons < 9000, glare, near


def filtered(electrons, kernel, known, glare, nearby=None, ghosts=None, **how):
    given = [torch.from_numpy(np.ascontiguousarray(x)) for x in (electrons, kernel[None], ~known)]
    channels = torch.ones(CHANNELS, 1, dtype=torch.float64)
    others = None if nearby is None else [torch.from_numpy(n) for n in nearby]
    light = [ONE, channels, BANDS, given[2], [torch.from_numpy(g) for g in glare], others, ghosts]
    return wiener(given[0], Psf(given[1], ONE), *light, read_noise=READ, **how)


@pytest.mark.parametrize(("doubt", "count"), [(0.0, 0), (0.3, 0), (0.0, 4), (0.3, 4)])
@pytest.mark.parametrize("balance", [1.0, 5.0])
def test_equals_a_dense_solve_in_numpy(doubt, count, balance):
    electrons, kernel, known, glare, near = drawn()
    near = [n[:count] for n in near]
    if count:
        near[1] = glare[1][None]  # of the second laser, a pattern that says nothing
    found = filtered(
        electrons, kernel, known, glare, near if count else None, doubt=doubt, balance=balance
    )
    expected = dense(electrons, kernel, known.astype(float), glare, near, doubt, balance)
    np.testing.assert_allclose(
        found.numpy(), expected, rtol=0, atol=0.1
    )  # of thousands; a free strength has 1e8 of variance


def test_what_is_not_known_changes_the_answer():
    """Otherwise the comparison above would compare nothing."""
    electrons, kernel, known, glare, near = drawn()
    plain = filtered(electrons, kernel, known, glare)
    for how in ({"doubt": 0.3}, {"nearby": [near[0], glare[1][None]]}):
        assert float((filtered(electrons, kernel, known, glare, **how) - plain).abs().max()) > 10


def test_ghosts_are_glare_of_their_own_strength():
    electrons, kernel, known, glare, _ = drawn()
    both = filtered(electrons, kernel, known, glare)
    apart = filtered(electrons, kernel, known, glare[:1], ghosts=[torch.from_numpy(glare[1])])
    assert torch.equal(both, apart)
    assert float((filtered(electrons, kernel, known, glare[:1]) - both).abs().max()) > 10


def test_nearby_patterns_must_fit_the_glare():
    electrons, kernel, known, glare, near = drawn()
    for wrong in (near[:1], [near[0][:, :, :-1], near[0]]):
        with pytest.raises(ValueError, match="give one nearby"):
            filtered(electrons, kernel, known, glare, wrong)


@pytest.mark.parametrize("size", [12, 44])
def test_gradients_reach_picture_glare_and_nearby(size):
    """By central differences along one direction: through the exact answer, and through the
    steps.
    """
    rng = torch.Generator().manual_seed(3)
    picture, pattern, *others = torch.rand(
        4, CHANNELS, size, size, generator=rng, dtype=torch.float64
    )
    leaves = [
        3000 * picture + 5000 * pattern**4,
        pattern**4,
        torch.stack([(pattern * o) ** 4 for o in others]),
    ]
    ways = [1e-3 * torch.randn(x.shape, generator=rng, dtype=torch.float64) * x for x in leaves]
    kernel = torch.rand(1, 5, 5, generator=rng, dtype=torch.float64)
    probe = torch.randn(CHANNELS, size, size, generator=rng, dtype=torch.float64)
    clipped = leaves[0] > 6000

    def value(at):
        given = [x + at * way for x, way in zip(leaves, ways, strict=True)]
        channels = torch.ones(CHANNELS, 1, dtype=torch.float64)
        psf = Psf(kernel / kernel.sum(), ONE)
        found = wiener(
            given[0],
            psf,
            ONE,
            channels,
            BANDS,
            clipped,
            [given[1]],
            [given[2]],
            doubt=0.2,
            read_noise=READ,
        )
        return (found * probe).sum()

    at = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(value(at), at)
    step = 1e-2 if size == 12 else 0.3
    with torch.no_grad():
        expected = (value(step) - value(-step)) / (2 * step)
    assert float(slope) == pytest.approx(float(expected), rel=1e-4 if size == 12 else 2e-2)
