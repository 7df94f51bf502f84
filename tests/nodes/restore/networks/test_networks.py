"""Every network that restores: any size, any light, near the picture at the start, and only with
its own weights.
"""

import math
from functools import partial

import pytest
import torch
from safetensors.torch import save_file
from torch import nn
from torch.testing import assert_close

from neusee.nodes import ParameterError, restore
from neusee.nodes.resampling import resize
from neusee.nodes.restore import FFTMamba, NAFNet, UNet, parameter_groups, start_network
from neusee.nodes.restore.networks import NAFBlock

SMALL = {"width": 4, "blocks": 2, "states": 3}
MAKE = {
    "fft_mamba": partial(FFTMamba, **SMALL),
    "unet": partial(UNet, 4),
    "nafnet": partial(NAFNet, 4),
}
PARAMS = {
    "fft_mamba": SMALL,
    "unet": {"width": 4},
    "nafnet": {"width": 4},
}
every_network = pytest.mark.parametrize("name", MAKE)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def drawn(*shape, seed=3):
    return torch.rand(*shape, generator=seeded(seed))


def fresh(name, seed=0):
    return start_network(MAKE[name], seeded(seed))


@pytest.fixture
def saved(tmp_path):
    """A network whose weights are anything but those of the start, and the file of them."""

    def saved(name, seed=0):
        net = fresh(name, seed)
        with torch.no_grad():
            for i, p in enumerate(net.parameters()):
                p.add_(0.05 * torch.randn(p.shape, generator=seeded(i)))
        save_file(net.state_dict(), tmp_path / f"{name}{seed}.safetensors")
        return net, tmp_path / f"{name}{seed}.safetensors"

    return saved


@every_network
@pytest.mark.parametrize("shape", [(2, 3, 16, 12), (1, 3, 17, 13), (1, 3, 1, 2)])
def test_any_size_gives_the_same_size_and_half_of_it(name, shape):
    coarse, fine = fresh(name).pyramid(drawn(*shape))
    assert fine.shape == shape
    assert coarse.shape == (*shape[:2], math.ceil(shape[2] / 2), math.ceil(shape[3] / 2))
    assert bool(fine.isfinite().all())


@every_network
def test_pictures_of_a_batch_do_not_see_each_other(name):
    net, pictures = fresh(name), drawn(3, 3, 16, 16)
    with torch.no_grad():
        assert_close(net(pictures)[1:2], net(pictures[1:2]), rtol=0, atol=1e-6)


@every_network
def test_a_size_that_does_not_fit_is_mirrored_at_the_far_rims(name):
    net, picture = fresh(name), drawn(1, 3, 15, 14)
    rows, columns = [*range(15), 13], [*range(14), 12, 11]
    with torch.no_grad():
        assert torch.equal(net(picture), net(picture[..., rows, :][..., columns])[..., :15, :14])


@every_network
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_starts_near_the_picture_and_not_at_it(name, seed):
    net, picture = fresh(name, seed), drawn(1, 3, 16, 16)
    with torch.no_grad():
        change = float((net(picture) - picture).square().mean().sqrt())
    assert 1e-4 < change < 0.3


@every_network
def test_the_start_is_drawn_from_the_given_stream_alone(name):
    before = torch.get_rng_state()
    one, same, other = (fresh(name, seed).state_dict() for seed in (0, 0, 1))
    assert all(torch.equal(one[key], same[key]) for key in one)
    assert any(not torch.equal(one[key], other[key]) for key in one)
    assert torch.equal(torch.get_rng_state(), before)


@every_network
def test_the_start_leaves_no_parameter_as_memory_was(name):
    """Memory that nobody has written is not a number here."""
    torch.use_deterministic_algorithms(True)
    try:
        assert all(bool(p.isfinite().all()) for p in fresh(name).parameters())
        assert bool(torch.empty(4).isnan().all())
    finally:
        torch.use_deterministic_algorithms(False)


@every_network
def test_layers_start_orthogonal_with_zero_biases(name):
    net = fresh(name)
    for part in net.modules():
        if isinstance(part, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            flat = part.weight.detach().flatten(1) * (10 if part is net.last else 1)
            product = flat @ flat.T if flat.shape[0] <= flat.shape[1] else flat.T @ flat
            assert_close(
                product,
                (2 / 1.04 if name == "unet" else 1) * torch.eye(len(product)),
                rtol=0,
                atol=1e-5,
            )
            assert part.bias is None or not part.bias.any()


@every_network
@pytest.mark.parametrize("light", ["none", "one", "million", "half"])
def test_any_light_has_finite_results_and_slopes(name, light):
    picture = {
        "none": torch.zeros(1, 3, 16, 8),
        "one": torch.ones(1, 3, 16, 8),
        "million": 1e6 * drawn(1, 3, 16, 8),
        "half": (drawn(1, 3, 16, 8) * 2 - 1) * 65504 * (drawn(1, 3, 16, 8, seed=4) * 2 - 1).pow(21),
    }[light].requires_grad_()
    net = fresh(name)
    coarse, fine = net.pyramid(picture)
    (coarse.mean() + (fine - 0.3).abs().mean()).backward()
    assert bool(fine.isfinite().all())
    assert bool(picture.grad.isfinite().all())
    assert all(bool(p.grad.isfinite().all()) for p in net.parameters())


@every_network
def test_slopes_reach_every_parameter(name):
    net, picture = fresh(name), drawn(2, 3, 16, 16)
    coarse, fine = net.pyramid(picture)
    ((fine - picture).square().mean() + coarse.square().mean()).backward()
    assert not [key for key, p in net.named_parameters() if p.grad is None or not p.grad.any()]


@every_network
def test_a_step_of_learning_lowers_the_loss(name):
    net, picture = fresh(name), drawn(1, 3, 16, 16)
    truth = 0.5 * picture + 0.2
    optimiser = torch.optim.Adam(parameter_groups(net, 2e-3, 4e-3))
    losses = []
    for _ in range(8):
        loss = (net(picture) - truth).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.8 * losses[0]


@every_network
def test_bfloat16_is_near_single_precision_and_learns(name):
    net, picture = fresh(name), drawn(1, 3, 16, 16)
    exact = net(picture).detach()
    with torch.autocast("cpu", torch.bfloat16):
        result = net(picture)
        loss = (result - 0.3).square().mean()
    loss.backward()
    off = float((result.detach() - exact).square().mean().sqrt())
    assert 0 < off < 0.05 * float((exact - picture).square().mean().sqrt())
    assert all(p.dtype == p.grad.dtype == torch.float32 for p in net.parameters())
    assert all(bool(p.grad.isfinite().all()) for p in net.parameters())
    with torch.autocast("cpu", torch.bfloat16), torch.no_grad():
        assert bool(net(1e6 * picture).isfinite().all())


@every_network
def test_groups_hold_every_parameter_once_and_biases_of_layers_learn_faster(name):
    net = fresh(name)
    weights, biases = parameter_groups(net)
    assert (weights["lr"], biases["lr"]) == (2e-4, 4e-4)
    assert sorted(map(id, weights["params"] + biases["params"])) == sorted(
        map(id, net.parameters())
    )
    names = {id(p): key for key, p in net.named_parameters()}
    kinds = {key: type(part) for key, part in net.named_modules()}
    wanted = {
        key
        for key in names.values()
        if key.endswith(".bias") and kinds[key[:-5]] in (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)
    }
    assert {names[id(p)] for p in biases["params"]} == wanted
    assert wanted


def test_one_scale_is_the_other_made_small():
    for name in ("unet", "nafnet"):
        coarse, fine = fresh(name).pyramid(drawn(1, 3, 32, 16))
        assert torch.equal(coarse, resize(fine, 16, 8))


@pytest.mark.parametrize("name", ["unet", "nafnet"])
def test_detail_passes_beside_what_is_small(name):
    """With nothing coming up from below, the change is still of the picture, pixel by pixel."""
    net, picture = fresh(name).requires_grad_(False), drawn(1, 3, 32, 32)
    for p in net.grow.parameters():
        p.zero_()
    other = picture.clone()
    other[..., 16, 16] += 0.1
    moved = (net.change(other) - net.change(picture)).abs().amax((0, 1))
    assert float(moved[16, 16]) > 1e-4
    row, column = divmod(int(moved.argmax()), 32)
    assert max(abs(row - 16), abs(column - 16)) <= 2


def test_a_block_of_nafnet_multiplies_channels_and_weighs_them_by_their_mean():
    block, x = (
        start_network(lambda: NAFBlock(3), seeded()).requires_grad_(False).double(),
        drawn(2, 3, 5, 4).double(),
    )

    def normed(x):
        return (x - x.mean(1, keepdim=True)) / (x.var(1, keepdim=True, correction=0) + 1e-5).sqrt()

    def mixed(layer, x):
        return torch.einsum("oi,nixy->noxy", layer.weight[..., 0, 0], x)

    wide = torch.nn.functional.pad(mixed(block.widen, normed(x)), (1, 1, 1, 1))
    rows, columns = torch.arange(5), torch.arange(4)
    wide = sum(
        block.mix.weight[:, 0, i, j, None, None] * wide[..., rows + i, :][..., columns + j]
        for i in range(3)
        for j in range(3)
    )
    y = wide[:, :3] * wide[:, 3:]
    y = x + 0.1 * mixed(block.narrow, y * mixed(block.attend, y.mean((2, 3), keepdim=True)))
    fed = mixed(block.feed, normed(y))
    assert_close(block(x), y + 0.1 * mixed(block.fed, fed[:, :3] * fed[:, 3:]), rtol=0, atol=1e-7)


def test_sizes_of_the_baselines():
    with torch.device("meta"):
        assert sum(p.numel() for p in UNet().parameters()) == 1_925_667
        assert sum(p.numel() for p in NAFNet().parameters()) == 1_991_923


@every_network
def test_the_node_gives_what_the_network_gives(name, saved):
    net, path = saved(name)
    picture = 3 * drawn(3, 19, 13) - 1  # beside a lamp, and out of gamut
    node = getattr(restore, name)
    assert node.hooks.preflight(**PARAMS[name], weights=path) == []
    with torch.no_grad():
        wanted = net(picture[None])[0]
    found = node(picture, **PARAMS[name], weights=path)
    assert torch.equal(found, node(picture, **PARAMS[name], weights=path))
    # weights lie elsewhere, by which some processors round
    assert_close(found, wanted, rtol=2e-6, atol=2e-6)
    assert not found.requires_grad
    assert node.hooks.check(found, picture, **PARAMS[name], weights=path)[0].ok
    _, other = saved(name, 1)
    assert float((found - node(picture, **PARAMS[name], weights=other)).abs().max()) > 1e-2


@every_network
def test_the_node_computes_in_single_precision_whatever_comes(name, saved):
    _, path = saved(name)
    node = partial(getattr(restore, name), **PARAMS[name], weights=path)
    picture = drawn(3, 16, 16).half()
    found = node(picture)
    assert found.dtype == torch.float32
    assert torch.equal(found, node(picture.float()))
    assert torch.equal(found, node(picture.double()))
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(found, node(picture))


@every_network
def test_weights_stored_in_half_precision_compute_in_single(name, saved, tmp_path):
    net, _ = saved(name)
    save_file(
        {key: v.bfloat16() for key, v in net.state_dict().items()}, tmp_path / "half.safetensors"
    )
    with torch.no_grad():
        wanted = net.bfloat16().float()(drawn(3, 16, 16)[None])[0]
    assert torch.equal(
        getattr(restore, name)(
            drawn(3, 16, 16), **PARAMS[name], weights=tmp_path / "half.safetensors"
        ),
        wanted,
    )


@every_network
def test_slopes_reach_the_picture_through_the_node(name, saved):
    _, path = saved(name)
    picture = drawn(3, 16, 16).requires_grad_()
    getattr(restore, name)(picture, **PARAMS[name], weights=path).square().sum().backward()
    assert bool(picture.grad.isfinite().all())
    assert float(picture.grad.abs().min(0).values.min()) > 0


@every_network
def test_without_weights_it_is_refused_with_what_to_give(name):
    node = getattr(restore, name)
    with pytest.raises(ParameterError, match=r"give the \.safetensors file") as caught:
        node.hooks.preflight(**PARAMS[name])
    assert caught.value.parameter == "weights"
    with pytest.raises(ParameterError, match=r"give the \.safetensors file"):
        node(drawn(3, 8, 8), **PARAMS[name])


@every_network
def test_weights_of_another_network_are_refused_by_their_name(name, saved, tmp_path):
    net, path = saved(name)
    node = getattr(restore, name)
    with pytest.raises(ParameterError, match=r"\(width 8\) has") as caught:
        node.hooks.preflight(**PARAMS[name] | {"width": 8}, weights=path)
    assert caught.value.parameter == "weights"
    state = dict(net.state_dict())
    save_file({k: v for k, v in state.items() if k != "last.bias"}, tmp_path / "less.safetensors")
    save_file(state | {"more": torch.ones(1)}, tmp_path / "more.safetensors")
    save_file(state | {"last.bias": torch.ones(7)}, tmp_path / "other.safetensors")
    (tmp_path / "text.safetensors").write_text("no")
    for file, words in (
        ("less", r"less.safetensors: last.bias is None, .* has \("),
        ("more", r"more.safetensors: more is \(1,\), .* has None"),
        ("other", r"other.safetensors: last.bias is \(7,\), .* has \("),
        ("text", "text.safetensors is not a safetensors file"),
    ):
        with pytest.raises(ParameterError, match=words):
            node.hooks.preflight(**PARAMS[name], weights=tmp_path / f"{file}.safetensors")


@pytest.mark.parametrize("wrong", [torch.rand(1, 8, 8), torch.rand(2, 3, 8, 8), torch.rand(8, 8)])
def test_what_is_no_colour_picture_is_refused(wrong, saved):
    with pytest.raises(ValueError, match=r"give \(3, y, x\)"):
        restore.unet(wrong, width=4, weights=saved("unet")[1])


def test_a_picture_that_is_not_finite_is_refused(saved):
    broken = drawn(3, 8, 8)
    broken[1, 2, 3] = math.nan
    with pytest.raises(ValueError, match="picture holds values that are not finite"):
        restore.nafnet(broken, width=4, weights=saved("nafnet")[1])


@pytest.mark.slow
@every_network
def test_the_full_size_works_on_an_odd_picture(name):
    full = {
        "fft_mamba": FFTMamba,
        "unet": UNet,
        "nafnet": NAFNet,
    }
    net = start_network(full[name], seeded())
    picture = drawn(1, 3, 37, 53)
    coarse, fine = net.pyramid(picture)
    ((fine - picture).square().mean() + coarse.square().mean()).backward()
    assert fine.shape == (1, 3, 37, 53)
    assert coarse.shape == (1, 3, 19, 27)
    assert float((fine - picture).detach().square().mean().sqrt()) < 0.3
    assert not [
        key for key, p in net.named_parameters() if not p.grad.any() or not p.grad.isfinite().all()
    ]
