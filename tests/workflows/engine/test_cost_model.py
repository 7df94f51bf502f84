"""What a step is expected to cost."""

import pytest

from neusee.nodes import node
from neusee.workflows.engine.cost_model import GUESS, Costs
from neusee.workflows.graph.diagnostics import Location
from neusee.workflows.graph.recipe_graph import Step


@node()
def blur(x=None):
    return x


def step(name):
    return Step(name, blur, {}, {}, Location("t.yaml", 1, 1), {})


def row(name, seconds, size=100, device="cpu", peak=None, node=blur.path):
    return {"step": name, "node": node, "seconds": seconds, "bytes": size, "device": device, "peak": peak}


def test_of_what_nobody_measured_there_is_a_guess_that_says_so():
    found = Costs([]).of(step("a"), ["cpu", "cuda"])
    assert not found.known
    assert found.seconds["cpu"] == GUESS > found.seconds["cuda"]


def test_the_same_step_counts_before_the_same_node():
    costs = Costs([row("b", 9.0), row("a", 1.0), row("a", 3.0), row("a", 2.0)])
    assert costs.of(step("a"), ["cpu"]).seconds["cpu"] == 2.0
    assert costs.of(step("a"), ["cpu"]).known
    other = costs.of(step("c"), ["cpu"])
    assert not other.known
    assert 1.0 <= other.seconds["cpu"] <= 9.0


def test_only_the_newest_count():
    costs = Costs([*(row("a", 100.0) for _ in range(50)), *(row("a", 1.0) for _ in range(5))])
    assert costs.of(step("a"), ["cpu"]).seconds["cpu"] == 1.0


def test_a_step_of_the_same_name_with_another_node_does_not_count():
    assert not Costs([row("a", 5.0, node="toy.other")]).of(step("a"), ["cpu"]).known


def test_this_very_result_counts_before_all_else():
    found = Costs([row("a", 1.0, 100)]).of(step("a"), ["cpu"], row("a", 4.0, 700))
    assert found.bytes == 700


def test_memory_beside_the_result_is_the_peak_less_the_result():
    assert Costs([row("a", 1.0, 100, peak=350)]).of(step("a"), ["cpu"]).work == 250
    assert Costs([row("a", 1.0, 100, peak=50)]).of(step("a"), ["cpu"]).work == 0


def test_another_kind_of_device_is_priced_by_the_steps_that_ran_on_both():
    both = [row("b", 8.0), row("b", 2.0, device="cuda:1"), row("a", 4.0)]
    assert Costs(both).of(step("a"), ["cpu", "cuda"]).seconds["cuda"] == pytest.approx(1.0)
    there = Costs([*both, row("a", 0.3, device="cuda:0")]).of(step("a"), ["cpu", "cuda"])
    assert there.seconds["cuda"] == 0.3
    assert there.seconds["cpu"] == 4.0
