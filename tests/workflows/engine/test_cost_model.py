"""What a step is expected to cost."""

import importlib
import sys
import time

import pytest
import torch

from neusee.nodes import doe, node, optics, registered_nodes, shape_rules
from neusee.workflows.engine import cost_model
from neusee.workflows.engine.cost_model import (
    MOST_RESULTS,
    Costs,
    Law,
    Loading,
    Size,
    guess,
    libraries_of,
    shipped,
    size_of,
    sizes_of,
)
from neusee.workflows.engine.placement_inputs import MOST_PARTS, parts_of, past_costs
from neusee.workflows.engine.processor_speed import Processor, probed_seconds, processor
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.store.result_store import Store

SMALL, LARGE = Size(1e8, 1e8, 0.0, 5e7), Size(4e8, 4e8, 0.0, 2e8)


@pytest.fixture(autouse=True)
def laws_of_here(monkeypatch):
    """Tests compute on the processor of the laws, whatever the machine is."""
    here = {"processor": processor().name, "threads": processor().threads}
    laws = {**cost_model._file(), **here}
    monkeypatch.setattr(cost_model, "_file", lambda: laws)


@node()
def blur(x=None):
    return x


def step(name, what=blur):
    return Step(name, what, {}, {}, Location("t.yaml", 1, 1), {})


def row(name, seconds, size=100, device="cpu", peak=None, node=blur.path, of=None):
    of = of and list(of[:4])
    return {
        "step": name,
        "node": node,
        # the clock counts other work too, and decides on a GPU alone
        "seconds": seconds if device.startswith("cuda") else 7 * seconds,
        "processor_seconds": seconds,
        "processor": processor().name,
        "threads": processor().threads,
        "bytes": size,
        "device": device,
        "peak": peak,
        "size": of,
    }


def test_of_what_nobody_measured_there_is_a_guess_at_the_upper_end_that_says_so():
    found = Costs([], {"a": SMALL}).of(step("a"), ["cpu", "cuda"])
    assert not found.known
    assert found.peak == guess().peak(SMALL) > 4 * (SMALL.inputs + SMALL.result)
    assert found.bytes == SMALL.result
    assert found.seconds["cpu"] == guess().time(SMALL) > found.seconds["cuda"] > 0


def test_nothing_is_known_of_a_step_without_a_shape_but_it_does_not_count_as_nothing():
    found = Costs([]).of(step("a"), ["cpu"])
    assert not found.known
    assert found.peak > 1e7


def test_the_costs_follow_the_size_and_not_the_name():
    rows = [
        row("a", 1.0, peak=3e8, of=SMALL),
        row("a", 2.0, peak=5e8, of=SMALL),
        row("a", 1.5, peak=4e8, of=SMALL),
    ]
    same = Costs(rows, {"b": SMALL}).of(step("b"), ["cpu"])
    assert same.known
    assert same.seconds["cpu"] == 1.5
    assert same.peak == 4e8
    larger = Costs(rows, {"a": LARGE}).of(step("a"), ["cpu"])
    assert larger.known
    assert larger.bytes == LARGE.result
    assert larger.peak == pytest.approx(4e8 * guess().peak(LARGE) / guess().peak(SMALL))
    assert larger.seconds["cpu"] == pytest.approx(1.5 * guess().time(LARGE) / guess().time(SMALL))


def test_what_a_node_of_the_user_costs_at_a_size_far_above_all_its_runs_is_a_guess():
    tiny, eighth, large = Size(5e6, 5e6, 0.0, 2e6), Size(2.5e7, 2.5e7, 0.0, 1e7), SMALL
    quick = Costs([row("a", 1e-4, peak=1e6, of=tiny)], {"a": large}).of(step("a"), ["cpu"])
    assert not quick.known
    assert (quick.peak, quick.seconds["cpu"]) == (guess().peak(large), guess().time(large))
    near = Costs([row("a", 5.0, of=eighth)], {"a": large}).of(step("a"), ["cpu"])
    assert near.known
    tenth = Costs([row("a", 100 * guess().time(tiny), of=tiny)], {"a": large}).of(
        step("a"), ["cpu"]
    )
    assert not tenth.known
    assert tenth.seconds["cpu"] == pytest.approx(100 * guess().time(large))


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
    """Such as in a line of the journal that somebody wrote: it would make the step too large for
    ever.
    """
    right = row("a", 1.0, peak=3e8, of=SMALL)
    forged = [row("a", 1.0, peak=1e15, of=SMALL)] * 5
    for sizes in ({"a": SMALL}, {"a": LARGE}, {}):
        assert Costs([right, *forged], sizes).of(step("a"), ["cpu"]) == Costs([right], sizes).of(
            step("a"), ["cpu"]
        )
    assert Costs([], {"a": SMALL}).of(step("a"), ["cpu"], forged[0]) == Costs([], {"a": SMALL}).of(
        step("a"), ["cpu"]
    )


def test_only_the_newest_count():
    rows = [
        *(row("a", 100.0, of=SMALL) for _ in range(50)),
        *(row("a", 1.0, of=SMALL) for _ in range(5)),
    ]
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
    assert (
        Law((7.0, 1.0, 2.0, 3.0), (0.0, 0.0)).peak(Size(10.0, 100.0, 1000.0, 0.0))
        == 7 + 10 + 200 + 3000
    )


@pytest.mark.parametrize(
    ("size", "shape", "measured"),
    [
        ((7000, 9000), (8, 8), 615e6), ((7000, 9000), None, 1020e6), ((1990, 2000), (500, 500), 263e6),
        ((1990, 2000), None, 215e6), ((427, 640), (768, 768), 33e6), ((427, 640), (3000, 3000), 335e6),
    ],
)  # fmt: skip
def test_the_memory_of_a_photograph_follows_its_own_pixels(
    tmp_path, monkeypatch, size, shape, measured
):
    """Peaks measured in a process of their own; 37 MB were predicted for a scene of 8 x 8 of 63
    million pixels.
    """
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


def loading(memory=1e8, seconds=2.0):
    """The laws of a machine on which two nodes load the same library."""
    loads = Loading(("a library that no machine has",), memory, seconds)
    return {
        path: Law((1e6, 1.0, 1.0, 0.0), (0.5, 0.0), loads=loads)
        for path in (blur.path, "optics.psf")
    }


def test_a_library_costs_the_first_step_that_loads_it_and_counts_once_in_the_program(monkeypatch):
    monkeypatch.setattr("neusee.workflows.engine.cost_model.shipped", loading)
    names = {"a": blur, "b": optics.psf, "c": blur}
    costs = Costs([], dict.fromkeys(names, SMALL))
    found = costs.in_turn(((name, step(name, each), None) for name, each in names.items()), ["cpu"])
    assert [found[name].seconds["cpu"] for name in names] == [2.5, 0.5, 0.5]
    assert found["a"].peak - found["b"].peak == 1e8
    assert found["a"].work == found["b"].work, (
        "the program holds the library, so no schedule counts it again"
    )
    assert libraries_of([blur.path, "optics.psf", "sensor.crop"]) == 1e8
    monkeypatch.setitem(sys.modules, "a library that no machine has", sys)
    assert libraries_of([blur.path, "optics.psf"]) == 0.0
    assert costs.in_turn([("a", step("a"), None)], ["cpu"])["a"].seconds["cpu"] == 0.5


def test_what_a_step_took_with_its_library_is_not_charged_for_the_library_again(monkeypatch):
    monkeypatch.setattr("neusee.workflows.engine.cost_model.shipped", loading)
    found = Costs([row("a", 2.6, peak=3e8, of=SMALL)], {"a": SMALL}).in_turn(
        [("a", step("a"), None)], ["cpu"]
    )
    assert found["a"].seconds["cpu"] == 2.6
    assert found["a"].peak == 3e8


def test_the_range_of_a_step_that_ran_is_that_of_its_runs_and_of_a_law_that_of_the_law():
    rows = [
        row("a", seconds, peak=peak, of=SMALL)
        for seconds, peak in ((1.0, 3e8), (2.0, 4e8), (3.0, 6e8))
    ]
    memory, time = Costs(rows, {"a": SMALL}).of(step("a"), ["cpu"]).spread
    assert time == (0.5, 1.5)
    assert memory == (0.75, 1.5)
    law = shipped()["restore.wiener"]
    assert law.spread[1].least < 1 < law.spread[1].most < 2


def test_the_result_of_a_step_without_a_rule_is_no_larger_than_the_largest_known_result():
    """Before, it counted as 64 MB, and each further step of the same kind as four times as much."""
    at = Location("t.yaml", 1, 1)
    known = Step("known", optics.stop, {"samples": 8, "pitch": 1e-5, "diameter": 8e-5}, {}, at, {})
    flat = Step("flat", doe.flat, {}, {"stop": "known"}, at, {})
    own = [
        Step(f"own{i}", blur, {}, {"x": "flat" if i == 0 else f"own{i - 1}"}, at, {})
        for i in range(5)
    ]
    recipe = Recipe("t", "", 1, 0.0, ("own4",), {s.name: s for s in (known, flat, *own)})
    sizes = sizes_of(recipe, list(recipe.steps))
    assert not any(sizes[s.name].known for s in own)
    assert {sizes[s.name].result for s in own} == {sizes["flat"].result} == {8 * 8 * 4.0}
    alone = Recipe("t", "", 1, 0.0, ("own",), {"own": Step("own", blur, {}, {}, at, {})})
    assert sizes_of(alone, ["own"])["own"].result > 1e7


def test_a_guess_needs_the_most_that_a_shipped_node_needs_for_its_size():
    """The ratio of peak to inputs and result, of the nodes that declare no further work, bounds
    what a guess needs.
    """
    for path in shipped():
        importlib.import_module(f"neusee.nodes.{path.partition('.')[0]}")  # registers the nodes
    works = {each.path for each in registered_nodes() if each.hooks.work is not None}
    ratios = {
        path: law.peak(LARGE) / (LARGE.inputs + LARGE.result)
        for path, law in shipped().items()
        if path not in works
    }
    bound = guess().peak(LARGE) / (LARGE.inputs + LARGE.result)
    assert max(ratios.values()) < bound < 3 * max(ratios.values())


def test_costs_follow_the_journal_and_read_each_line_once(tmp_path, monkeypatch):
    store, seen = Store(tmp_path), []
    learn = Costs.learn
    monkeypatch.setattr(
        Costs, "learn", lambda self, rows: (seen.append(len(rows)), learn(self, rows))[1]
    )

    def put(n, seconds):
        about = {
            "step": "a",
            "recipe": "r",
            "origin": {"node": "toy.a"},
            "seconds": seconds,
            "processor_seconds": seconds,
            "processor": processor().name,
            "threads": processor().threads,
            "device": "cpu",
        }
        date = f"2026-11-26 00:00:{n:02d}"
        store.put(f"{n:032x}", 1.0, {**about, "bytes": 1, "peak": None, "size": None, "date": date})

    for n in range(9):
        put(n, 1.0 if n < 4 else 3.0)
        costs = past_costs(store, {})
    assert sum(seen) == 9
    assert [len(rows) for rows in costs._nodes.values()] == [9]
    assert costs._nodes == Costs(store.journal.rows())._nodes
    store.journal.compact()  # begins anew
    put(9, 5.0)
    assert past_costs(store, {})._nodes == Costs(store.journal.rows())._nodes


def test_only_the_newest_runs_of_a_step_are_kept():
    costs = Costs([row("a", float(n), of=SMALL) for n in range(1000)])
    assert {len(rows) for rows in (*costs._nodes.values(), *costs._steps.values())} <= set(
        range(MOST_RESULTS, 2 * MOST_RESULTS + 1)
    )
    newest = Costs([row("a", float(n), of=SMALL) for n in range(900, 1000)], {"a": SMALL})
    assert costs.with_sizes({"a": SMALL}).of(step("a"), ["cpu"]) == newest.of(step("a"), ["cpu"])


def other_processor(monkeypatch, probe):
    """Compute on a processor with another name, whose probe takes ``probe`` s; return the probes."""
    probes = []
    here = Processor("another processor, NEON", 1)
    monkeypatch.setattr("neusee.workflows.engine.cost_model.processor", lambda: here)
    monkeypatch.setattr(
        "neusee.workflows.engine.cost_model.probed_seconds", lambda n: probes.append(n) or probe
    )
    return probes


def test_a_law_is_scaled_by_the_probe_on_another_processor_and_has_a_wider_interval(monkeypatch):
    law_probe = cost_model._file()["probe"]
    psf = Step("psf", optics.psf, {}, {}, Location("t.yaml", 1, 1), {})
    law = shipped()["optics.psf"]
    probes = other_processor(monkeypatch, 3 * law_probe)
    there = Costs([], {"psf": SMALL}).of(psf, ["cpu"])
    assert there.seconds["cpu"] == pytest.approx(3 * law.time(SMALL))
    assert there.spread[1].least < law.spread[1].least
    assert there.spread[1].most > law.spread[1].most
    assert probes


def test_a_law_holds_as_it_is_on_its_own_processor_and_no_probe_runs(monkeypatch):
    probes = other_processor(monkeypatch, 1.0)
    monkeypatch.setitem(cost_model._file(), "processor", "another processor, NEON")
    psf = Step("psf", optics.psf, {}, {}, Location("t.yaml", 1, 1), {})
    found = Costs([], {"psf": SMALL}).of(psf, ["cpu"])
    assert found.seconds["cpu"] == shipped()["optics.psf"].time(SMALL)
    assert not probes


@pytest.mark.parametrize(
    "change",
    [
        {"processor": "another processor, NEON"},
        {"threads": 64},
        # a line of an earlier version has the time of the clock alone
        {"processor_seconds": None, "processor": None, "threads": None},
    ],
)
def test_a_time_of_another_processor_or_of_the_clock_alone_predicts_nothing(change):
    psf = Step("psf", optics.psf, {}, {}, Location("t.yaml", 1, 1), {})
    line = row("psf", 1e3, peak=2e9, node="optics.psf", of=SMALL) | change
    with_line, without = (Costs(rows, {"psf": SMALL}).of(psf, ["cpu"]) for rows in ([line], []))
    assert with_line.seconds == without.seconds
    assert not with_line.measured
    assert Costs([line], {"psf": SMALL}).of(psf, ["cpu"], line).seconds == without.seconds


def test_the_probe_takes_a_fifth_of_a_second_at_most():
    began = time.thread_time()
    assert probed_seconds(torch.get_num_threads()) > 0
    assert time.thread_time() - began < 0.2
