"""Critics: their size, what they look at, and a second derivative that is one."""

from itertools import pairwise

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from neusee.nodes.losses import gradient_penalty
from neusee.nodes.restore import critic_slopes, critics, parameter_groups
from neusee.nodes.restore.networks import Critic


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def drawn(*shape, seed=7):
    return torch.rand(*shape, generator=seeded(seed), dtype=torch.float64)


def test_has_as_many_parameters_as_its_parts():
    sizes = [3, 64, 128, 256, 512]
    parts = sum(16 * a * b + b for a, b in pairwise(sizes)) + 9 * 512 + 1
    with torch.device("meta"):
        assert sum(p.numel() for p in Critic().parameters()) == parts == 2_761_153


def test_two_scales_start_differently_and_orthogonal():
    coarse, fine = critics(seeded(), 4)
    assert not torch.equal(coarse.layers[0].weight, fine.layers[0].weight)
    for layer in (m for c in (coarse, fine) for m in c.modules() if isinstance(m, nn.Conv2d)):
        rows = layer.weight.detach().flatten(1)
        assert_close(rows @ rows.T, 2 / 1.04 * torch.eye(len(rows)), rtol=0, atol=1e-5)
        assert not layer.bias.any()


def test_holds_nothing_that_sees_the_batch_or_breaks_a_second_derivative():
    kinds = {type(m) for m in Critic(2).modules()}
    assert kinds == {Critic, nn.Sequential, nn.Conv2d, nn.LeakyReLU}


@pytest.mark.parametrize("size", [(16, 16), (17, 40), (64, 33)])
def test_one_score_a_picture_of_any_size(size):
    critic, pictures = critics(seeded(), 4)[0].double(), drawn(3, 3, *size)
    scores = critic(pictures)
    assert scores.shape == (3,)
    assert_close(scores[1:2], critic(pictures[1:2]))
    assert len(set(scores.tolist())) == 3


def test_what_is_too_small_is_refused():
    with pytest.raises(ValueError, match="give 16 pixels a side"):
        Critic(2)(torch.rand(1, 3, 15, 64))


def test_slopes_are_those_of_each_picture_on_the_line_between():
    critic = critics(seeded(), 4)[0].double()
    truth, estimate = drawn(4, 3, 16, 16), drawn(4, 3, 16, 16, seed=8)
    found = critic_slopes(critic, truth, estimate, seeded(1))
    share = torch.rand(4, 1, 1, 1, generator=seeded(1)).double()
    assert share.unique().numel() == 4
    between = share * truth + (1 - share) * estimate
    step = 1e-6 * torch.randn(between.shape, generator=seeded(2), dtype=torch.float64)
    with torch.no_grad():
        moved = (critic(between + step) - critic(between - step)) / 2
    assert_close((found * step).sum((1, 2, 3)).detach(), moved, rtol=1e-6, atol=0)
    assert found.shape == truth.shape


@pytest.mark.parametrize("seed", [0, 1])
def test_the_penalty_has_a_true_slope_for_every_parameter(seed):
    critic = critics(seeded(seed), 3)[1].double()
    truth, estimate = drawn(2, 3, 18, 16), drawn(2, 3, 18, 16, seed=8)

    def penalty():
        return gradient_penalty(critic_slopes(critic, truth, estimate, seeded(seed)))

    weights = [p for name, p in critic.named_parameters() if name.endswith("weight")]
    found = torch.autograd.grad(penalty(), weights)
    for weight, slope in zip(weights, found, strict=True):
        step = 1e-6 * torch.randn(weight.shape, generator=seeded(4), dtype=torch.float64)
        kept = weight.detach().clone()
        values = []
        for sign in (1, -1):
            weight.data = kept + sign * step
            values.append(float(penalty().detach()))
        weight.data = kept
        assert float((slope * step).sum()) == pytest.approx((values[0] - values[1]) / 2, rel=1e-5)
        assert bool(slope.any())


def test_nothing_reaches_the_pictures_and_they_are_single_under_autocast():
    critic = critics(seeded(), 4)[0]
    truth = torch.rand(2, 3, 16, 16, generator=seeded())
    estimate = torch.rand(2, 3, 16, 16, generator=seeded(1)).requires_grad_()
    with torch.autocast("cpu", torch.bfloat16), torch.no_grad():
        found = critic_slopes(critic, truth, estimate, seeded(2))
    exact = critic_slopes(critic, truth, estimate, seeded(2))
    assert torch.equal(found, exact)
    gradient_penalty(exact).backward()
    assert estimate.grad is None
    assert critic.layers[0].weight.grad.any()


@pytest.mark.parametrize("size", [0.0, 1.0, 1e6])
def test_finite_for_any_light(size):
    critic = critics(seeded(), 4)[0]
    picture = size * torch.rand(2, 3, 16, 16, generator=seeded())
    (
        critic(picture).mean()
        + gradient_penalty(critic_slopes(critic, picture, picture.sqrt(), seeded()))
    ).backward()
    assert all(bool(p.grad.isfinite().all()) for p in critic.parameters())


def test_learns_with_the_rates_of_the_generator():
    critic = Critic(2)
    weights, biases = parameter_groups(critic)
    assert (len(weights["params"]), len(biases["params"])) == (5, 5)
