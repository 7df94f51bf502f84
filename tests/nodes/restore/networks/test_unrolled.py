"""The unrolled filter: untrained it is the filter, and node and training compute the same
picture.
"""

import re
from functools import partial

import pytest
import torch
from safetensors.torch import save_file

from neusee.nodes import ParameterError
from neusee.nodes.restore import Unrolled, start_network, unrolled, wiener, wiener_problem
from neusee.nodes.restore.networks import _wiener_networks
from neusee.nodes.values import Bands, Psf

ONE = torch.ones(1, dtype=torch.float64)
BANDS = Bands(550e-9 * ONE, 1e-8 * ONE, ONE)


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def frame(*size):
    """Electrons of three channels behind a lopsided blur, a clipped corner, and a pattern of
    glare within.
    """
    size = size or (24, 24)
    psf = Psf(random(1, 9, 9, seed=1) / 40.5, ONE)
    glare = random(3, *size, seed=2) ** 8
    clipped = torch.zeros(3, *size, dtype=torch.bool)
    clipped[:, :3, :4] = True
    electrons = (4000 * random(3, *size, seed=3) + 5000 * glare).float()
    return (
        electrons,
        psf,
        ONE,
        torch.ones(3, 1, dtype=torch.float64),
        BANDS,
        clipped,
        [glare.float()],
    )


def network(change=0.0, width=2, steps=2):
    net = start_network(partial(Unrolled, width, steps), torch.Generator().manual_seed(4))
    with torch.no_grad():
        for prior in net.priors:
            prior.last.weight.add_(
                change * torch.randn(prior.last.weight.shape, generator=torch.Generator())
            )
    return net


def written(net, folder):
    save_file(net.state_dict(), folder / "weights.safetensors")
    return {
        "weights": folder / "weights.safetensors",
        "width": 2,
        "steps": len(net.priors),
        "read_noise": 10.0,
    }


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_untrained_restorer_is_the_filter_bit_for_bit(tmp_path, dtype):
    electrons, *others = frame()
    given = (electrons.to(dtype), *others)
    expected = wiener(*given, read_noise=10.0)
    assert expected.dtype == dtype
    assert torch.equal(unrolled(*given, read_noise=10.0), expected)
    assert torch.equal(unrolled(*given, **written(network(), tmp_path)), expected)


def test_the_problem_has_the_answer_of_the_filter_and_the_network_changes_it_alike(tmp_path):
    """The way of the training, from the posed problem, gives the pixels of the node."""
    given, net = frame(), network(0.2)
    expected = unrolled(*given, **written(net, tmp_path)).double()
    told = wiener(*given, read_noise=10.0).double()
    problem = wiener_problem(*given, read_noise=10.0)
    assert torch.allclose(problem.answer * problem.scale + problem.mean, told, rtol=1e-6)
    with torch.no_grad():
        fine, pyramid = (
            net(told[None], problem, torch.eye(3)),
            net.pyramid(told[None], problem, torch.eye(3)),
        )
    assert float((fine[0] - told).abs().max()) > 10.0
    assert torch.allclose(fine[0], expected, rtol=1e-5, atol=0.05)
    assert torch.equal(fine, pyramid[1])
    assert pyramid[0].shape == (1, 3, 12, 12)


def test_other_colours_than_those_of_the_sensor_get_the_same_change():
    problem, net, matrix = (
        wiener_problem(*frame(), read_noise=10.0),
        network(0.2),
        random(3, 3, seed=5).float(),
    )
    nothing = torch.zeros(1, 3, 24, 24, dtype=torch.float64)
    with torch.no_grad():
        own, turned = net(nothing, problem, torch.eye(3))[0], net(nothing, problem, matrix)[0]
    expected = (matrix.double() @ own.flatten(1)).reshape(3, 24, 24)
    assert torch.allclose(turned, expected, rtol=0, atol=1e-4 * float(expected.abs().max()))


@pytest.mark.parametrize("size", [(9, 14), (21, 40)])
def test_sides_that_no_level_divides_and_one_step(tmp_path, size):
    given = frame(*size)
    found = unrolled(*given, **written(network(0.2, steps=1), tmp_path))
    assert found.shape == (3, *size)
    assert 1.0 < float((found - wiener(*given, read_noise=10.0)).abs().max()) < 1e5


def test_a_frame_that_is_clipped_altogether_stays_finite(tmp_path):
    electrons, psf, light, responses, bands, clipped, glare = frame()
    found = unrolled(
        electrons,
        psf,
        light,
        responses,
        bands,
        torch.ones_like(clipped),
        glare,
        **written(network(0.2), tmp_path),
    )
    assert bool(torch.isfinite(found).all())


def test_gradients_reach_every_layer_of_every_step():
    problem, net = wiener_problem(*frame(), read_noise=10.0), network(0.2)
    picture = torch.zeros(1, 3, 24, 24)
    net(picture, problem, torch.eye(3)).square().mean().backward()
    assert all(
        float(p.grad.abs().max()) > 0 for name, p in net.named_parameters() if "attend" not in name
    )


def test_from_the_start_the_last_layers_have_gradients():
    net = network()
    (
        net(torch.zeros(1, 3, 24, 24), wiener_problem(*frame(), read_noise=10.0), torch.eye(3))
        - 100.0
    ).square().mean().backward()
    assert all(float(prior.last.weight.grad[:3].abs().max()) > 0 for prior in net.priors)


@pytest.mark.slow
def test_gradients_of_the_node_agree_with_differences(tmp_path, monkeypatch):
    """With conjugate gradients that end: after ten steps, sums that nearly cancel are a third
    off.
    """
    monkeypatch.setattr(_wiener_networks, "PULLED_STEPS", 100)
    electrons, *others = frame(16, 16)
    how = written(network(0.2), tmp_path)
    picture, way = electrons.double().requires_grad_(), random(3, 16, 16, seed=12) - 0.5
    call = lambda e: (unrolled(e, *others, **how) * random(3, 16, 16, seed=13)).sum()  # noqa: E731
    (slope,) = torch.autograd.grad(call(picture), picture)
    with torch.no_grad():
        step = 3.0
        rise = float(call(picture + step * way) - call(picture - step * way)) / (2 * step)
    assert rise == pytest.approx(float((slope * way).sum()), rel=0.02)


def test_other_weights_and_other_sensors_are_refused(tmp_path):
    how = written(network(), tmp_path)
    with pytest.raises(
        ParameterError,
        match=re.escape("priors.0.down.0.0.attend.bias is (2,), this network (width 3)"),
    ):
        unrolled.hooks.preflight(**{**how, "width": 3})
    assert "is the Wiener filter" in unrolled.hooks.preflight(read_noise=10.0)[0]
    electrons, psf, light, _, bands, clipped, _ = frame()
    with pytest.raises(ValueError, match="have 1 channels, and the network needs 3"):
        unrolled(electrons[:1], psf, light, ONE[None], bands, clipped[:1], read_noise=10.0)
