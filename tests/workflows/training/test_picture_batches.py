"""Pictures that go through the network together: the losses and gradients of pictures that go
one by one.
"""

import pytest
import torch

from neusee.nodes import losses
from neusee.nodes.restore import Informed, NAFNet, start_network
from neusee.nodes.values import FilterFacts
from neusee.workflows.training.training_iteration import (
    Learner,
    Scales,
    joined,
    pictures_by_number,
    together,
)
from neusee.workflows.training.training_pictures import Sample

MAPS = 32


def sample(seed, size=(12, 16), informed=True):
    rng = torch.Generator().manual_seed(seed)

    def drawn(*shape):
        return torch.rand(shape, generator=rng, dtype=torch.float64)

    picture, truth = drawn(1, 3, *size), drawn(1, 3, *size)
    facts = FilterFacts(
        drawn(3, *size) - 0.5,
        drawn(3, *size) + 0.1,
        drawn(MAPS, *size),
        1 + drawn(3, 1, 1),
        drawn(3, 1, 1),
    )
    given = (facts, torch.eye(3, dtype=torch.float64) + 0.1 * drawn(3, 3)) if informed else ()
    return Sample(picture, truth, torch.zeros(0), {"noise": seed}, given)


def gradients(net, groups, count):
    net.zero_grad()
    for numbers, one in groups:
        loss = losses.log_error(net(one.picture, *one.given), one.truth) * len(numbers) / count
        loss.backward()
    return [p.grad.clone() for p in net.parameters() if p.grad is not None]


@pytest.mark.parametrize("informed", [True, False])
def test_gradients_are_those_of_pictures_one_by_one(informed):
    pictures = [sample(i, (12, 16) if i != 2 else (8, 8), informed) for i in range(5)]
    make = (lambda: Informed(4)) if informed else (lambda: NAFNet(4, (1,), 1))
    net = start_network(make, torch.Generator().manual_seed(1)).double()
    for part in net.parameters():
        torch.nn.init.normal_(part, std=0.1, generator=torch.Generator().manual_seed(part.numel()))
    numbered = list(enumerate(pictures))
    groups = list(together(numbered, True))
    assert sorted(n for numbers, _ in groups for n in numbers) == [0, 1, 2, 3, 4]
    assert [numbers for numbers, _ in groups] == [[0, 1, 3, 4], [2]], (
        "pictures of one size go together"
    )
    for one, many in zip(
        gradients(net, together(numbered, False), 5), gradients(net, groups, 5), strict=True
    ):
        torch.testing.assert_close(many, one, rtol=1e-10, atol=1e-12)


def test_a_picture_that_goes_alone_is_the_picture_itself():
    one = sample(3)
    assert joined([one]) is one
    assert [(n, s) for n, s in together([(7, one)], False)] == [([7], one)]


def test_results_are_taken_apart_by_number_with_all_patches():
    truth = Scales(torch.arange(6.0).view(6, 1, 1, 1), torch.arange(6.0).view(6, 1, 1, 1) + 10)
    found = pictures_by_number([4, 9, 1], truth, truth)
    assert list(found) == [4, 9, 1]
    assert found[9][0].coarse.flatten().tolist() == [2, 3]
    assert found[1][1].fine.flatten().tolist() == [14, 15]


def test_on_a_processor_each_picture_goes_alone():
    learner = Learner.__new__(Learner)
    learner.device = "cpu"
    assert not learner._batch_goes_whole
