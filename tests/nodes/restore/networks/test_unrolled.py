"""The unrolled filter: untrained it is the filter, and each step is the posterior mean under a prior with a mean."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from neusee.nodes import ParameterError
from neusee.nodes.restore import Unrolled, start_network, unrolled, wiener, wiener_problem
from neusee.nodes.restore._inverse._masked_blur import Blurred
from neusee.nodes.restore._inverse._prior_mean import Untold
from neusee.nodes.values import Bands, Psf

ONE = torch.ones(1, dtype=torch.float64)
BANDS = Bands(550e-9 * ONE, 1e-8 * ONE, ONE)
GREY = 0.6
SIZE, TORUS = (9, 8), (14, 12)


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def frame(size=24):
    """Electrons of three channels behind a lopsided blur, a clipped corner, and a pattern of glare within."""
    psf = Psf(random(1, 9, 9, seed=1) / 40.5, ONE)
    glare = random(3, size, size, seed=2) ** 8
    clipped = torch.zeros(3, size, size, dtype=torch.bool)
    clipped[:, :3, :4] = True
    electrons = (4000 * random(3, size, size, seed=3) + 5000 * glare).float()
    return (electrons, psf, ONE, torch.ones(3, 1, dtype=torch.float64), BANDS, clipped, [glare.float()])


def network(change=0.0, width=2, steps=2):
    net = start_network(partial(Unrolled, width, steps), torch.Generator().manual_seed(4))
    with torch.no_grad():
        for prior in net.priors:
            prior.last.weight.add_(change * torch.randn(prior.last.weight.shape, generator=torch.Generator()))
    return net


def written(net, folder):
    save_file(net.state_dict(), folder / "weights.safetensors")
    return {"weights": folder / "weights.safetensors", "width": 2, "steps": len(net.priors), "read_noise": 10.0}


def small(glare=True):
    """A deconvolution of two channels with clipped pixels, a free pattern and a bounded pattern."""
    weight = 1.0 + 30.0 * random(2, *SIZE, seed=5)
    weight[:, 2:4, 3:5] = 0.0
    kernel = torch.zeros(2, *TORUS, dtype=torch.float64)
    kernel[:, :3, :4] = random(2, 3, 4, seed=6) / 6.0
    fy, fx = np.fft.fftfreq(TORUS[0]), np.fft.rfftfreq(TORUS[1])
    power = torch.as_tensor((fy[:, None] ** 2 + fx**2 + 0.01) ** -1.2)
    patterns = tuple(random(2, *SIZE, seed=k) for k in (7, 8)) if glare else ()
    picture = random(2, *SIZE, seed=9)
    return Blurred(picture, weight, torch.fft.rfft2(kernel), power, TORUS, GREY, patterns, bounded=len(patterns) // 2)


def posterior_mean(seen, mean):
    """The posterior mean of a Gaussian scene of prior mean ``mean`` in the frame and 0 beyond, as dense algebra."""
    kernel = torch.fft.irfft2(seen.transfer, s=TORUS).numpy()
    law = np.fft.irfft2(seen.power.numpy(), s=TORUS)
    places = [(y, x) for y in range(TORUS[0]) for x in range(TORUS[1])]
    rolled = np.array([[law[(a - c) % TORUS[0], (b - d) % TORUS[1]] for c, d in places] for a, b in places])
    prior = np.kron((1 - GREY) * np.eye(2) + GREY, rolled)
    one = [np.array([[k[(a - c) % TORUS[0], (b - d) % TORUS[1]] for c, d in places]
                     for a in range(SIZE[0]) for b in range(SIZE[1])]) for k in kernel]  # fmt: skip
    blur = np.block([[one[0], np.zeros_like(one[0])], [np.zeros_like(one[0]), one[1]]])
    weight = seen.weight.numpy().ravel()
    known = weight > 0
    noise = np.diag(1 / weight[known])
    for pattern, spread in zip(seen.glare, (1e8, 1.0), strict=False):
        flat = pattern.numpy().ravel()[known]
        noise = noise + spread * np.outer(flat, flat)
    wide = np.zeros((2, *TORUS))
    wide[:, : SIZE[0], : SIZE[1]] = mean
    blur = blur[known]
    rest = seen.picture.numpy().ravel()[known] - blur @ wide.ravel()
    gain = prior @ blur.T @ np.linalg.inv(blur @ prior @ blur.T + noise)
    return (wide.ravel() + gain @ rest).reshape(2, *TORUS)[:, : SIZE[0], : SIZE[1]]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_untrained_restorer_is_the_filter_bit_for_bit(tmp_path, dtype):
    electrons, *others = frame()
    given = (electrons.to(dtype), *others)
    expected = wiener(*given, read_noise=10.0)
    assert expected.dtype == dtype
    assert torch.equal(unrolled(*given, read_noise=10.0), expected)
    assert torch.equal(unrolled(*given, **written(network(), tmp_path)), expected)


@pytest.mark.parametrize("glare", [False, True])
def test_a_step_is_the_posterior_mean_under_a_prior_of_this_mean(glare):
    seen, mean = small(glare), random(2, *SIZE, seed=10) - 0.5
    added, blurred = Untold(seen, steps=200)(mean)
    expected = posterior_mean(seen, mean.numpy()) - posterior_mean(seen, np.zeros((2, *SIZE)))
    assert np.abs(added.numpy() - expected).max() < 1e-5 * np.abs(expected).max()
    assert float(blurred.abs().max()) > 0


def test_the_gradient_with_respect_to_the_mean_is_the_adjoint():
    """The step is linear in the mean, so that differences of any length are its derivative."""
    untold, way = Untold(small(), steps=200), random(2, *SIZE, seed=11) - 0.5
    mean = random(2, *SIZE, seed=10).requires_grad_()
    weights = [random(2, *SIZE, seed=k) - 0.5 for k in (14, 15)]
    sum((w * part).sum() for w, part in zip(weights, untold(mean), strict=True)).backward()
    rise = sum(float((w * part).sum()) for w, part in zip(weights, untold(way), strict=True))
    assert float((mean.grad * way).sum()) == pytest.approx(rise, rel=1e-4)


def test_a_problem_with_gradients_has_the_same_step_and_the_derivative_of_all_parts():
    seen, mean = small(glare=False), random(2, *SIZE, seed=10) - 0.5
    followed = replace(seen, weight=seen.weight.clone().requires_grad_())
    added, _ = Untold(followed)(mean)
    assert torch.allclose(added, Untold(seen, steps=200)(mean)[0], rtol=0, atol=1e-5)
    (slope,) = torch.autograd.grad(added.sum(), followed.weight)
    way, step = random(2, *SIZE, seed=16) * (seen.weight > 0), 0.05
    up, down = (posterior_mean(replace(seen, weight=seen.weight + s * way), mean.numpy())
                - posterior_mean(replace(seen, weight=seen.weight + s * way), np.zeros((2, *SIZE)))
                for s in (step, -step))  # fmt: skip
    assert float((slope * way).sum()) == pytest.approx((up - down).sum() / (2 * step), rel=1e-3)


def test_the_problem_has_the_answer_of_the_filter_and_the_network_changes_it_alike(tmp_path):
    """The way of the training, from the posed problem, gives the pixels of the node."""
    given, net = frame(), network(0.05)
    expected = unrolled(*given, **written(net, tmp_path)).double()
    told = wiener(*given, read_noise=10.0).double()
    problem = wiener_problem(*given, read_noise=10.0)
    assert torch.allclose(problem.answer * problem.scale + problem.mean, told, rtol=1e-6)
    with torch.no_grad():
        coarse, fine = net(told[None], problem, torch.eye(3)), net.pyramid(told[None], problem, torch.eye(3))
    assert float((fine[1][0] - told).abs().max()) > 10.0
    assert torch.allclose(fine[1][0], expected, rtol=1e-5, atol=0.05)
    assert torch.equal(coarse, fine[1])
    assert fine[0].shape == (1, 3, 12, 12)


def test_gradients_reach_every_layer_of_every_step():
    problem, net = wiener_problem(*frame(), read_noise=10.0), network(0.05)
    picture = torch.zeros(1, 3, 24, 24)
    net(picture, problem, torch.eye(3)).square().mean().backward()
    assert all(float(p.grad.abs().max()) > 0 for name, p in net.named_parameters() if "attend" not in name)


@pytest.mark.slow
def test_gradients_of_the_node_agree_with_differences(tmp_path):
    electrons, *others = frame(16)
    how = written(network(0.05), tmp_path)
    picture, way = electrons.double().requires_grad_(), random(3, 16, 16, seed=12) - 0.5
    call = lambda e: (unrolled(e, *others, **how) * random(3, 16, 16, seed=13)).sum()  # noqa: E731
    (slope,) = torch.autograd.grad(call(picture), picture)
    with torch.no_grad():
        step = 20.0
        rise = float(call(picture + step * way) - call(picture - step * way)) / (2 * step)
    assert rise == pytest.approx(float((slope * way).sum()), rel=0.02)


def test_other_weights_and_other_sensors_are_refused(tmp_path):
    how = written(network(), tmp_path)
    with pytest.raises(
        ParameterError, match=re.escape("priors.0.down.0.0.attend.bias is (2,), this network (width 3)")
    ):
        unrolled.hooks.preflight(**{**how, "width": 3})
    assert "is the Wiener filter" in unrolled.hooks.preflight(read_noise=10.0)[0]
    electrons, psf, light, _, bands, clipped, _ = frame()
    with pytest.raises(ValueError, match="have 1 channels, and the network needs 3"):
        unrolled(electrons[:1], psf, light, ONE[None], bands, clipped[:1], read_noise=10.0)
