"""What a step is expected to cost."""

import pytest
import torch

from neusee.nodes import node, optics, shape_rules
from neusee.workflows.engine.cost_laws import GUESS, Law, Size, shipped, size_of
from neusee.workflows.engine.cost_model import Costs
from neusee.workflows.engine.placement_inputs import MOST_PARTS, parts_of
from neusee.workflows.graph.diagnostics import Location
from neusee.workflows.graph.recipe_graph import Step

SMALL, LARGE = Size(1e8, 1e8, 0.0, 5e7), Size(4e8, 4e8, 0.0, 2e8)


@node()
def blur(x=None):
    return x


def step(name, what=blur):
    return Step(name, what, {}, {}, Location("t.yaml", 1, 1), {})


def row(name, seconds, size=100, device="cpu", peak=None, node=blur.path, of=None):
    of = of and list(of[:4])
    return {"step": name, "node": node, "seconds": seconds, "bytes": size, "device": device, "peak": peak, "size": of}


def test_of_what_nobody_measured_there_is_a_guess_at_the_upper_end_that_says_so():
    found = Costs([], {"a": SMALL}).of(step("a"), ["cpu", "cuda"])
    assert not found.known
    assert found.peak == GUESS.peak(SMALL) > 4 * (SMALL.inputs + SMALL.result)
    assert found.bytes == SMALL.result
    assert found.seconds["cpu"] == GUESS.time(SMALL) > found.seconds["cuda"] > 0


def test_nothing_is_known_of_a_step_without_a_shape_but_it_does_not_count_as_nothing():
    found = Costs([]).of(step("a"), ["cpu"])
    assert not found.known
    assert found.peak > 1e7


def test_the_costs_follow_the_size_and_not_the_name():
    rows = [row("a", 1.0, peak=3e8, of=SMALL), row("a", 2.0, peak=5e8, of=SMALL), row("a", 1.5, peak=4e8, of=SMALL)]
    same = Costs(rows, {"b": SMALL}).of(step("b"), ["cpu"])
    assert same.known
    assert same.seconds["cpu"] == 1.5
    assert same.peak == 4e8
    larger = Costs(rows, {"a": LARGE}).of(step("a"), ["cpu"])
    assert larger.known
    assert larger.bytes == LARGE.result
    assert larger.peak == pytest.approx(4e8 * GUESS.peak(LARGE) / GUESS.peak(SMALL))
    assert larger.seconds["cpu"] == pytest.approx(1.5 * GUESS.time(LARGE) / GUESS.time(SMALL))


def test_a_shipped_law_is_scaled_by_the_runs_of_this_machine():
    law = shipped()["optics.psf"]
    psf = step("psf", optics.psf)
    alone = Costs([], {"psf": LARGE}).of(psf, ["cpu"])
    assert alone.known
    assert alone.spread == law.spread
    assert alone.seconds["cpu"] == pytest.approx(law.time(LARGE))
    slow = row("psf", 3 * law.time(SMALL), peak=1.2 * law.peak(SMALL), node="optics.psf", of=SMALL)
    here = Costs([slow], {"psf": LARGE}).of(psf, ["cpu"])
    assert here.seconds["cpu"] == pytest.approx(3 * law.time(LARGE))
    assert here.peak == pytest.approx(1.2 * law.peak(LARGE))


def test_a_damaged_size_in_the_journal_is_passed_over():
    rows = [{**row("a", 1.0, of=SMALL), "size": size} for size in ("lots", [1, 2], [1, 2, 3, None])]
    assert not Costs(rows, {"a": SMALL}).of(step("a"), ["cpu"]).known


def test_a_peak_that_this_machine_cannot_have_is_passed_over():
    """Such as in a line of the journal that somebody wrote: it would make the step too large for ever."""
    right = row("a", 1.0, peak=3e8, of=SMALL)
    forged = [row("a", 1.0, peak=1e15, of=SMALL)] * 5
    for sizes in ({"a": SMALL}, {"a": LARGE}, {}):
        assert Costs([right, *forged], sizes).of(step("a"), ["cpu"]) == Costs([right], sizes).of(step("a"), ["cpu"])
    assert Costs([], {"a": SMALL}).of(step("a"), ["cpu"], forged[0]) == Costs([], {"a": SMALL}).of(step("a"), ["cpu"])


def test_only_the_newest_count():
    rows = [*(row("a", 100.0, of=SMALL) for _ in range(50)), *(row("a", 1.0, of=SMALL) for _ in range(5))]
    assert Costs(rows, {"a": SMALL}).of(step("a"), ["cpu"]).seconds["cpu"] == 1.0


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
    assert there.seconds["cpu"] == pytest.approx(0.5 * (4.0 + 0.3 * 4.0), rel=0.6)


def test_a_law_gives_at_least_the_bytes_of_the_result():
    assert Law((0.0, 0.0, 0.5, 0.0), (0.0, 0.0)).peak(SMALL) == SMALL.result
    assert Law((7.0, 1.0, 2.0, 3.0), (0.0, 0.0)).peak(Size(10.0, 100.0, 1000.0, 0.0)) == 7 + 10 + 200 + 3000


@pytest.mark.parametrize(
    ("size", "shape", "measured"),
    [
        ((7000, 9000), (8, 8), 615e6), ((7000, 9000), None, 1020e6), ((1990, 2000), (500, 500), 263e6),
        ((1990, 2000), None, 215e6), ((427, 640), (768, 768), 33e6), ((427, 640), (3000, 3000), 335e6),
    ],
)  # fmt: skip
def test_the_memory_of_a_photograph_follows_its_own_pixels(tmp_path, monkeypatch, size, shape, measured):
    """Peaks measured in a process of their own; 37 MB were predicted for a scene of 8 x 8 of 63 million pixels."""
    from neusee.nodes.scene import _result_shapes, photograph

    monkeypatch.setattr(_result_shapes, "read_header", lambda file: ("", 1, size))
    (tmp_path / "a.png").write_bytes(b"")
    params = {"file": tmp_path / "a.png", "shape": shape}
    found = size_of(photograph, [], params, photograph.hooks.shape(**params))
    peak = shipped()["scene.photograph"].peak(found)
    assert 0.9 * measured < peak < 2.2 * measured


def test_the_size_of_a_step_is_that_of_its_tensors():
    found = size_of(blur, [torch.zeros(10, 10)], {}, shape_rules.double(10, 10))
    assert found[:4] == (400.0, 800.0, 0.0, 300.0)


def test_a_step_is_cut_into_no_more_parts_than_it_has_bands():
    few, many = SMALL._replace(bands=5), SMALL._replace(bands=1000)
    psf = step("psf", optics.psf)
    assert parts_of(psf, Costs([], {"psf": few}).of(psf, ["cpu"])) == 5
    assert parts_of(psf, Costs([], {"psf": many}).of(psf, ["cpu"])) == MOST_PARTS
    assert parts_of(psf, Costs([], {"psf": SMALL}).of(psf, ["cpu"])) == MOST_PARTS
    assert parts_of(step("a"), Costs([], {"a": few}).of(step("a"), ["cpu"])) == 1
