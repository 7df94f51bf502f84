"""Richardson-Lucy deconvolution: against matrices in NumPy, its likelihood, and a lamp beside a
dark scene.
"""

import numpy as np
import pytest
import torch

from neusee.nodes import restore
from neusee.nodes.restore.inverse import edge, torus
from neusee.nodes.values import Bands, Psf

ONE = torch.ones(1, dtype=torch.float64)
BANDS = Bands(550e-9 * ONE, 10e-9 * ONE, ONE)
GREY = (torch.ones(1), torch.ones(1, 1), BANDS)  # one channel, one band


def kernel(side=5, seed=0):
    rng = np.random.default_rng(seed)
    values = rng.random((side, side)) * np.exp(-0.3 * np.hypot(*np.mgrid[:side, :side] - side // 2))
    return values / values.sum() * 0.98


def psf_of(values):
    return Psf(torch.from_numpy(values)[None], 0.1 * ONE)


def blur_matrix(values, picture, wide):
    """Rows: pixels of the picture; columns: pixels of the periodic grid around it."""
    rows = []
    middle = values.shape[0] // 2
    for y in range(picture[0]):
        for x in range(picture[1]):
            row = np.zeros(wide)
            for (i, j), value in np.ndenumerate(values):
                row[(y - (i - middle)) % wide[0], (x - (j - middle)) % wide[1]] += value
            rows.append(row.ravel())
    return np.array(rows)


def by_matrix(counts, known, design, iterations, variance, patterns=()):
    """The multiplicative update of Richardson and Lucy from its definition, with all pixels of
    the grid unknown.
    """
    mean = (counts * known).sum() / known.sum()
    scene, strengths = (
        np.full(design.shape[1], mean / design.sum(1).max()),
        np.full(len(patterns), mean),
    )
    columns = np.array(patterns).reshape(len(patterns), known.size).T
    for _ in range(iterations):
        expected = design @ scene + columns @ strengths + variance
        ratio = known * np.maximum(counts + variance, 0) / expected
        scene = (
            scene * (design.T @ ratio) / np.maximum(design.T @ known, 1e-3 * design.sum(1).max())
        )
        strengths = strengths * (columns.T @ ratio) / (columns.T @ known)
    return scene


@pytest.mark.parametrize("pattern", ["", "glare", "ghosts"])
def test_equals_the_update_by_matrices(pattern):
    size, values, rng = (9, 8), kernel(), np.random.default_rng(2)
    counts = rng.poisson(rng.random(size) * 900).astype(float)
    known = rng.random(size) > 0.15
    glare = np.exp(-0.1 * np.hypot(*np.mgrid[:9, :8] - 3)) if pattern else None
    scaled = [] if glare is None else [(glare / (glare * known).max()).ravel()]
    wide = torus(size, edge(torch.from_numpy(values)[None], size))
    matrix = blur_matrix(values, size, wide)
    expected = by_matrix(counts.ravel(), known.ravel().astype(float), matrix, 12, 100.0, scaled)
    found = restore.richardson_lucy(
        torch.from_numpy(counts)[None],
        psf_of(values),
        *GREY,
        torch.from_numpy(~known)[None],
        **({pattern: [torch.from_numpy(glare)[None]]} if pattern else {}),
        iterations=12,
        read_noise=10.0,
    )
    np.testing.assert_allclose(found[0].numpy(), expected.reshape(wide)[:9, :8], rtol=1e-9)


def test_each_step_raises_the_likelihood():
    size, values, rng = (20, 20), kernel(), np.random.default_rng(3)
    wide = torus(size, edge(torch.from_numpy(values)[None], size))
    matrix = blur_matrix(values, size, wide)
    counts = rng.poisson(500 * rng.random(size)).astype(float)
    hidden, scores = torch.zeros(1, *size, dtype=torch.bool), []
    scene = np.full(wide[0] * wide[1], counts.mean() / matrix.sum(1).max())
    share = np.maximum(matrix.sum(0), 1e-3 * matrix.sum(1).max())
    for _ in range(6):
        expected = matrix @ scene
        scores.append((counts.ravel() * np.log(expected) - expected).sum())
        scene = scene * (matrix.T @ (counts.ravel() / expected)) / share
    assert np.all(np.diff(scores) > 0)
    found = restore.richardson_lucy(
        torch.from_numpy(counts)[None], psf_of(values), *GREY, hidden, iterations=6, read_noise=0.0
    )
    np.testing.assert_allclose(found[0].numpy(), scene.reshape(wide)[:20, :20], rtol=1e-9)


def night(side=64):
    """A road of at most 7 % of white, and a lamp 300 times as bright as white, behind a blur
    with a wide skirt.
    """
    rng = np.random.default_rng(4)
    scene = np.kron(5 + 60 * rng.random((side // 8, side // 8)), np.ones((8, 8)))
    scene[20:22, 30:32] = 3e5
    v, u = np.mgrid[:63, :63] - 31
    skirt = np.exp(-np.hypot(v, u) / 16) * (1 + 0.8 * np.cos(1.3 * u))
    values = 0.93 * skirt / skirt.sum()
    values[31, 31] += 0.05
    whole = np.fft.ifft2(np.fft.fft2(scene, (128, 128)) * np.fft.fft2(values, (128, 128))).real
    blurred = np.maximum(whole[31 : 31 + side, 31 : 31 + side], 0)
    seen = np.minimum(rng.poisson(blurred) + 10 * rng.normal(size=blurred.shape), 25500.0)
    return scene, values, torch.from_numpy(seen)[None]


def error(found, scene):
    """The root mean square error in the encoding of a display, whose white is 1000 e-."""
    shown = (np.clip(x / 1000, 0, 1) ** (1 / 2.2) for x in (found, scene))
    return float(np.sqrt(np.mean(np.subtract(*shown) ** 2)))


def test_a_lamp_beside_a_dark_scene_is_restored_better_than_by_wiener():
    scene, values, seen = night()
    inputs = (seen, psf_of(values), *GREY, seen >= 25500.0)
    found = restore.richardson_lucy(*inputs, read_noise=10.0)
    assert float(found.min()) >= 0
    before, wiener = (
        error(seen[0].numpy(), scene),
        error(restore.wiener(*inputs, read_noise=10.0)[0].numpy(), scene),
    )
    now = error(found[0].numpy(), scene)
    assert now < 0.8 * before
    assert now < 0.8 * wiener


@pytest.mark.parametrize("value", [0.0, -5.0])
def test_a_picture_without_light_is_dark(value):
    picture = torch.full((1, 16, 16), value)
    hidden = torch.zeros(1, 16, 16, dtype=torch.bool)
    found = restore.richardson_lucy(
        picture, psf_of(kernel()), *GREY, hidden, [torch.ones(1, 16, 16)], read_noise=0.0
    )
    assert torch.equal(found, torch.zeros_like(picture))


def test_a_picture_that_is_clipped_everywhere_is_finite_and_bad_inputs_are_refused():
    picture = torch.full((1, 16, 16), 25500.0)
    inputs = (psf_of(kernel()), *GREY)
    found = restore.richardson_lucy(
        picture, *inputs, torch.ones(1, 16, 16, dtype=torch.bool), read_noise=10.0
    )
    assert bool(found.isfinite().all())
    with pytest.raises(ValueError, match="must have the same channels and pixels"):
        restore.richardson_lucy(
            picture, *inputs, torch.zeros(1, 8, 8, dtype=torch.bool), read_noise=10.0
        )
    broken = picture.clone()
    broken[0, 3, 3] = float("nan")
    with pytest.raises(ValueError, match="electrons holds values that are not finite"):
        restore.richardson_lucy(
            broken, *inputs, torch.zeros(1, 16, 16, dtype=torch.bool), read_noise=10.0
        )


def test_single_precision_keeps_the_stated_error():
    _, values, seen = night()
    inputs = (psf_of(values), *GREY, seen >= 25500.0)
    exact = restore.richardson_lucy(seen, *inputs, read_noise=10.0)
    rounded = restore.richardson_lucy(seen.float(), *inputs, read_noise=10.0).double()
    assert float((rounded - exact).abs().max() / exact.max()) < 1e-4


def test_no_scale_of_picture_and_psf_overflows():
    values, rng = kernel(), np.random.default_rng(4)
    counts = torch.from_numpy(rng.random((1, 24, 24)) * 900).float()
    clipped = torch.zeros(1, 24, 24, dtype=torch.bool)
    found = [
        restore.richardson_lucy(
            counts * by, psf_of(values.astype(np.float32) * by), *GREY, clipped, read_noise=0.0
        )
        for by in (1.0, 1e18)
    ]
    assert found[1].isfinite().all()
    assert torch.allclose(found[1], found[0], rtol=1e-3, atol=1e-3 * float(found[0].max()))
