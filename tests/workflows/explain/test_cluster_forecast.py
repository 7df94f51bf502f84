"""What a recipe would take on machines that are not here."""

from __future__ import annotations

from dataclasses import replace

import pytest

from neusee.nodes import node
from neusee.workflows.engine.cost_model import Estimate
from neusee.workflows.explain.cluster_forecast import cluster_lines, simulated
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.placement.machine_file import read_machines

YAML = """\
# A host and two cards.
devices:
  host: {kind: cpu, memory: 2 TB}
  card: {kind: cuda, count: 2, memory: 1 GB, speed: 10}
links: {cpu-cuda: {bandwidth: 1 GB/s}, cuda-cuda: {bandwidth: 10 GB/s}}
"""


@node()
def make():
    return None


@node()
def change(x):
    return x


@pytest.fixture
def machines(tmp_path):
    (tmp_path / "m.yaml").write_text(YAML)
    return read_machines(tmp_path / "m.yaml")


def recipe(devices=("", "", "", "")):
    """``a`` feeds ``b`` and ``c``, which ``d`` reads."""
    wires = {"a": (), "b": ("a",), "c": ("a",), "d": ("b", "c")}
    steps = {
        name: Step(
            name,
            change if reads else make,
            {},
            {"x": reads} if reads else {},
            Location("r.yaml", 1, 1),
            {},
            device,
        )
        for (name, reads), device in zip(wires.items(), devices, strict=True)
    }
    return Recipe("r", "", 1, 0.0, ("d",), steps)


def costs(**changed):
    known = {name: Estimate({"cpu": 10.0}, 100e6, 0.0, True) for name in "abcd"}
    return known | changed


def test_every_figure_that_was_asked_for_is_told(machines):
    lines = cluster_lines(recipe(), costs(c=Estimate({"cpu": 10.0}, 100e6, 0.0, False)), machines)
    assert lines == [
        "4 steps on 3 devices: A host and two cards.",
        "",
        (
            "makespan     3.01 s; where they were measured, one after another, 40 s: 13.3 times as"
            " long"
        ),
        "transferred  200 MB in 2 copies",
        "",
        "device  busy  steps  memory    of",
        "cpu       0%      0     0 B  2 TB",
        "cuda:0   66%      2  200 MB  1 GB",
        "cuda:1   66%      2  300 MB  1 GB",
        "the devices are busy 44% of the time on average",
        "",
        "critical path  device  at      takes",
        "a              cuda:0  0 s     1 s",
        "b              cuda:0  1 s     1 s",
        "d              cuda:1  2.01 s  1 s",
        "3 steps on it, 3 s of 3.01 s; the rest is waiting for data or memory",
        "",
        "guesses, never measured: c",
    ]


def test_a_hint_is_followed(machines):
    on = {
        s.task: s.device
        for s in simulated(recipe(("cpu", "gpu", "cuda:1", "mps")), costs(), machines).slots
    }
    assert on["a"] == "cpu"
    assert on["b"] != "cpu"
    assert on["c"] == "cuda:1"


def test_speed_goes_by_the_family_of_the_node(machines):
    fast = replace(
        machines,
        speeds={**machines.speeds, "cuda:1": {"default": 1.0, change.path.split(".")[0]: 100.0}},
    )
    ends = {
        s.task: (s.device, round(s.end - s.start, 9))
        for s in simulated(recipe(), costs(), fast).slots
    }
    assert ends["d"] == ("cuda:1", 0.1)


def test_a_step_is_cut_where_it_can_be_and_refused_where_it_cannot(machines):
    large = costs(b=Estimate({"cpu": 10.0}, 100e6, 3e9, True))
    cards = replace(machines, cluster=replace(machines.cluster, devices=machines.devices[1:]))
    lines = cluster_lines(recipe(), large, cards)
    assert lines[1:] == [
        "refused: b does not fit: its inputs, result and results kept there need 3,200,000,000 B"
        " (3.2 GB) on cuda:1, which has 1,000,000,000 B (1 GB)"
    ]
    banded = recipe()
    steps = {**banded.steps, "b": replace(banded.steps["b"], node=_banded(change))}
    lines = cluster_lines(replace(banded, steps=steps), large, cards)
    assert "in parts     b (4)" in lines


def _banded(what):
    from copy import copy

    made = copy(what)
    made.bands = {"x": -3, "return": -3}
    return made


def test_a_long_critical_path_loses_its_middle(machines):
    steps = {
        f"s{i}": Step(
            f"s{i}",
            change if i else make,
            {},
            {"x": f"s{i - 1}"} if i else {},
            Location("r.yaml", 1, 1),
            {},
        )
        for i in range(10_000)
    }
    long = Recipe("r", "", 1, 0.0, ("s9999",), steps)
    lines = cluster_lines(
        long, {name: Estimate({"cpu": 0.01}, 0.0, 0.0, False) for name in steps}, machines
    )
    assert any("… 9976 more …" in line for line in lines)
    assert len(lines) < 50
    assert lines[-1].endswith("s23 and 9976 more")


def test_nothing_to_run_is_no_mistake(machines):
    assert (
        cluster_lines(recipe(), {}, machines)[2]
        == "makespan     0 s; where they were measured, one after another, 0 s"
    )
