"""A network of the user as a restorer: its sizes, its parameters, its first call, and the cost
that this call shows.
"""

import sys
import threading

import pytest
import torch
from torch import nn

from neusee.nodes import ParameterError, restore
from neusee.nodes.own_modules import Architecture, network_classes
from neusee.nodes.restore import own_network, try_network
from neusee.workflows.contract.node_contract import whole_networks


class Net(nn.Module):
    """A network with each kind of layer that counts."""

    multiple = 4

    def __init__(self, width: int, groups: int = 1, *, bias: bool = True) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, width, 3, 2, 1, groups=1, bias=bias)
        self.middle = nn.Conv2d(width, width, 3, 1, 1, groups=groups)
        self.mix = nn.Linear(width, width)
        self.last = nn.ConvTranspose2d(width, 3, 2, 2)

    def forward(self, picture):
        x = torch.relu(self.middle(self.first(picture)))
        x = self.mix(x.movedim(1, -1))
        return picture + self.last((x @ torch.eye(x.shape[-1])).movedim(-1, 1))


NET = Architecture("mine.Net", Net)


def test_sides_are_padded_to_the_multiple_of_the_class_or_of_the_recipe():
    seen = []

    class Seeing(nn.Module):
        multiple = 8

        def forward(self, picture):
            seen.append(tuple(picture.shape))
            return picture * 2

    picture = torch.rand(1, 3, 21, 30)
    for multiple, wanted in ((None, (24, 32)), (1, (21, 30)), (5, (25, 30))):
        net = own_network(Architecture("mine.Seeing", Seeing), None, multiple)
        assert torch.equal(net(picture), 2 * picture)
        assert seen.pop() == (1, 3, *wanted)
        coarse, fine = net.pyramid(picture)
        assert torch.equal(fine, 2 * picture)
        assert coarse.shape == (1, 3, 11, 15)


def test_initial_weights_depend_on_the_seed_alone():
    one, same, other = (own_network(NET, {"width": 4}, None, seed) for seed in (1, 1, 2))
    torch.manual_seed(9)
    before = torch.random.get_rng_state()
    own_network(NET, {"width": 4}, None)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), same.parameters(), strict=True))
    assert not torch.equal(one.inner.first.weight, other.inner.first.weight)


def test_threads_that_build_at_once_get_the_weights_of_their_own_seeds():
    wanted = [own_network(NET, {"width": 4}, None, seed).inner.mix.weight for seed in range(8)]
    found = [None] * 8

    def build(seed):
        found[seed] = own_network(NET, {"width": 4}, None, seed).inner.mix.weight

    threads = [threading.Thread(target=build, args=(seed,)) for seed in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(torch.equal(a, b) for a, b in zip(wanted, found, strict=True))


def test_the_options_of_a_class_are_its_arguments_with_the_defaults():
    net = own_network(NET, {"width": 4}, None)
    assert net.options == {"class": "Net", "parameters": {"width": 4, "groups": 1, "bias": True}}
    with pytest.raises(
        ParameterError, match=r"mine.Net needs the argument width: write parameters: {width: VALUE}"
    ):
        own_network(NET, None, None)
    with pytest.raises(
        ParameterError,
        match=r"mine.Net\(width=4, groups=3\): in_channels must be divisible by groups",
    ):
        own_network(NET, {"width": 4, "groups": 3}, None)


def test_the_operations_are_two_for_each_product_of_a_layer_and_one_for_each_other_number():
    trial = try_network(own_network(NET, {"width": 8, "groups": 2}, None))
    half, whole = 18 * 22, 36 * 44
    # two convolutions, two matrices, one transposed convolution
    products = half * 8 * (3 * 9 + 4 * 9 + 8 + 8 + 3 * 4)
    assert 2 * products <= trial.operations * whole <= 2 * products + 2 * 3 * whole + 2 * 8 * half
    # bytes: five results of 8 channels, the last layer and the sum
    kept = 4 * (5 * 8 * half + 2 * 3 * whole)
    assert kept <= trial.memory * whole <= 1.1 * kept


def test_the_predicted_work_grows_with_the_pixels_up_to_a_tile():
    work = restore.network.hooks.work
    small, large = (torch.empty(3, n, n, device="meta") for n in (64, 128))
    how = {"architecture": NET, "parameters": {"width": 4}}
    one, four = (work(x, x, **how) for x in (small, large))
    assert four == (4 * one[0], 4 * one[1])
    assert work(large, large, **how, tile=64) == (one[0], four[1])
    assert work(large, large, **how, reduce=2) == one


def test_a_network_may_draw_in_training_and_compute_in_float64():
    class Dropping(Net):
        def __init__(self):
            super().__init__(4)
            self.drop = nn.Dropout(0.5)

        def forward(self, picture):
            return super().forward(self.drop(picture))

    net = own_network(Architecture("mine.Dropping", Dropping), None, None)
    with pytest.raises(
        ParameterError,
        match=r"fails for a picture 1 x 3 x 36 x 44: test_own_network.py:3\d: expected",
    ):
        try_network(net, torch.float64)  # torch.eye is float32
    try_network(net)


def test_layers_of_a_file_that_builds_others_are_not_the_networks_of_a_family():
    found = network_classes(sys.modules[__name__])
    assert set(found) == {"Net"}
    assert (
        set(whole_networks(sys.modules["neusee.nodes.restore.networks._convolutional_networks"]))
        == set()
    )
