"""The filter's answer pulled towards a picture: the posterior mean under a second prior, by
dense algebra in NumPy.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from neusee.nodes.restore.inverse import Blurred, pulled

GREY = 0.6
SIZE, TORUS = (5, 4), (8, 6)
STEPS = 240  #: more than there are unknowns, so that conjugate gradients end


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def problem(glare=True):
    """A deconvolution of two channels with clipped pixels, a free pattern and a bounded pattern."""
    weight = 1.0 + 30.0 * random(2, *SIZE, seed=5)
    weight[:, 2:4, 1:3] = 0.0
    kernel = torch.zeros(2, *TORUS, dtype=torch.float64)
    kernel[:, :2, :3] = random(2, 2, 3, seed=6) / 3.0
    fy, fx = np.fft.fftfreq(TORUS[0]), np.fft.rfftfreq(TORUS[1])
    power = torch.as_tensor((fy[:, None] ** 2 + fx**2 + 0.01) ** -1.2)
    patterns = tuple(random(2, *SIZE, seed=k) for k in (7, 8)) if glare else ()
    picture = random(2, *SIZE, seed=9)
    return Blurred(
        picture,
        weight,
        torch.fft.rfft2(kernel),
        power,
        TORUS,
        GREY,
        patterns,
        bounded=len(patterns) // 2,
    )


TOWARDS, PRECISION = random(2, *SIZE, seed=10) - 0.5, 0.5 + 20.0 * random(2, *SIZE, seed=12)


def dense(seen):
    """Return the prior covariance of the torus, and the matrix of the blur onto the frame, as
    NumPy matrices.
    """
    kernel, law = (np.fft.irfft2(x.detach().numpy(), s=TORUS) for x in (seen.transfer, seen.power))
    places = [(y, x) for y in range(TORUS[0]) for x in range(TORUS[1])]
    rolled = np.array(
        [[law[(a - c) % TORUS[0], (b - d) % TORUS[1]] for c, d in places] for a, b in places]
    )
    one = [
        np.array(
            [
                [k[(a - c) % TORUS[0], (b - d) % TORUS[1]] for c, d in places]
                for a in range(SIZE[0])
                for b in range(SIZE[1])
            ]
        )
        for k in kernel
    ]
    zero = np.zeros_like(one[0])
    return np.kron((1 - GREY) * np.eye(2) + GREY, rolled), np.block(
        [[one[0], zero], [zero, one[1]]]
    )


def reference(seen, towards, precision):
    """The posterior mean given frame and pseudo-observations c of the pixels, minus that given
    the frame alone.
    """
    prior, blur = dense(seen)
    weight = seen.weight.detach().numpy().ravel()
    known = weight > 0
    noise = np.diag(1 / weight[known])
    for pattern, spread in zip(seen.glare, (1e8, 1.0), strict=False):
        flat = pattern.numpy().ravel()[known]
        noise = noise + spread * np.outer(flat, flat)
    inside = np.zeros((2, *TORUS), dtype=bool)
    inside[:, : SIZE[0], : SIZE[1]] = True
    pixels = np.eye(inside.size)[inside.ravel()]

    def mean(rows, covariance, observed):
        return prior @ rows.T @ np.linalg.solve(rows @ prior @ rows.T + covariance, observed)

    frame = seen.picture.numpy().ravel()[known]
    alone = mean(blur[known], noise, frame)
    said = pixels @ alone + towards.detach().numpy().ravel()
    loose, none = (
        np.diag(1 / precision.detach().numpy().ravel()),
        np.zeros((len(noise), len(pixels))),
    )
    both = np.block([[noise, none], [none.T, loose]])
    change = mean(np.vstack([blur[known], pixels]), both, np.concatenate([frame, said])) - alone
    return (pixels @ change).reshape(2, *SIZE), (blur @ change).reshape(2, *SIZE)


@pytest.mark.parametrize("glare", [False, True])
def test_the_change_is_the_posterior_mean_under_both_priors_less_that_under_one(glare):
    seen = problem(glare)
    found = pulled(seen, TOWARDS, PRECISION, STEPS)
    for one, expected in zip(found, reference(seen, TOWARDS, PRECISION), strict=True):
        assert np.abs(one.numpy() - expected).max() < 5e-6 * np.abs(expected).max()


def test_a_certain_picture_is_taken_a_worthless_one_is_not_and_none_changes_no_bit():
    seen = problem()
    assert torch.allclose(
        pulled(seen, TOWARDS, torch.full_like(TOWARDS, 1e9), STEPS)[0],
        TOWARDS,
        rtol=0,
        atol=1e-5,
    )
    assert float(pulled(seen, TOWARDS, torch.full_like(TOWARDS, 1e-9), STEPS)[0].abs().max()) < 1e-7
    assert not any(
        float(part.abs().max()) for part in pulled(seen, torch.zeros_like(TOWARDS), PRECISION)
    )


def test_a_frame_without_a_seen_pixel_leaves_the_two_priors():
    seen = replace(problem(glare=False), weight=torch.zeros(2, *SIZE, dtype=torch.float64))
    found = pulled(seen, TOWARDS, PRECISION, STEPS)[0]
    expected = reference(seen, TOWARDS, PRECISION)[0]
    assert np.abs(found.numpy() - expected).max() < 5e-6 * np.abs(expected).max()
    assert np.abs(expected).max() > 0.1


def test_in_float32_the_change_is_that_of_float64():
    seen = problem()
    parts = {name: getattr(seen, name).float() for name in ("picture", "weight", "power")}
    glare = tuple(pattern.float() for pattern in seen.glare)
    single = replace(seen, **parts, transfer=seen.transfer.to(torch.complex64), glare=glare)
    found = pulled(single, TOWARDS.float(), PRECISION.float())[0]
    assert found.dtype == torch.float32
    assert torch.allclose(found.double(), pulled(seen, TOWARDS, PRECISION)[0], rtol=0, atol=2e-5)


def moved(seen, logarithm, bright, through, towards, precision):
    """The change for another problem: unknown pixels stay unknown, so that weights are moved by
    their logarithm.
    """
    weight, glare = seen.weight * logarithm.exp(), tuple(p * bright for p in seen.glare)
    other = replace(seen, weight=weight, glare=glare, transfer=seen.transfer * through)
    return pulled(other, towards, precision, STEPS)


def start():
    return (
        torch.zeros(2, *SIZE, dtype=torch.float64),
        random(1, seed=13),
        1.0 + 0.1 * random(2, 1, 1, seed=14),
        TOWARDS.clone(),
        PRECISION.clone(),
    )


@pytest.mark.parametrize(
    "followed", [slice(0, 3), slice(3, 5)], ids=["the problem", "what a network says"]
)
def test_derivatives_agree_with_differences(followed):
    seen, given = problem(), list(start())
    ways = [
        random(*x.shape, seed=20 + k) - 0.5 if k in range(5)[followed] else 0 * x
        for k, x in enumerate(given)
    ]
    weights = [random(2, *SIZE, seed=k) - 0.5 for k in (30, 31)]

    def value(*x):
        return sum((w * part).sum() for w, part in zip(weights, moved(seen, *x), strict=True))

    for x in given[followed]:
        x.requires_grad_()
    slopes = torch.autograd.grad(value(*given), given[followed])
    expected = sum(
        float((slope * way).sum()) for slope, way in zip(slopes, ways[followed], strict=True)
    )
    with torch.no_grad():
        ends = [
            float(value(*(x + h * way for x, way in zip(given, ways, strict=True))))
            for h in (1e-3, -1e-3)
        ]
    assert (ends[0] - ends[1]) / 2e-3 == pytest.approx(expected, rel=1e-4)
    assert abs(expected) > 1e-3


@pytest.mark.slow
def test_all_derivatives_pass_gradcheck():
    """To the error of an iteration that ends by its residual, which differences see and slopes
    do not.
    """
    given = tuple(x.requires_grad_() for x in start())
    assert torch.autograd.gradcheck(
        partial(moved, problem()), given, fast_mode=True, rtol=5e-3, atol=1e-5
    )


def test_there_is_no_second_derivative():
    towards = TOWARDS.clone().requires_grad_()
    (slope,) = torch.autograd.grad(
        pulled(problem(), towards, PRECISION)[0].square().sum(),
        towards,
        create_graph=True,
    )
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()
