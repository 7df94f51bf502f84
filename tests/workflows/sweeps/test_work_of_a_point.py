"""What holds for all points of a sweep is done once; a further point does what differs, counted
and not timed.
"""

import sys
from collections import Counter
from pathlib import Path

import pytest

from neusee.workflows.engine import cost_model as cost_laws
from neusee.workflows.engine import step_job
from neusee.workflows.graph import recipe_graph
from neusee.workflows.keys import code_digest as known_keys
from neusee.workflows.recipe.text import composition
from neusee.workflows.recipe.text import composition as option_groups
from neusee.workflows.store.result_store import Store
from neusee.workflows.sweeps.axes import points as points_of
from neusee.workflows.sweeps.axes import read_axes, read_words
from neusee.workflows.sweeps.sweep_points import outcomes, plan_sweep

SMALL = [
    "optics.samples=64",
    "optics.pitch=126.22 um",
    "optics.bands=3",
    "optics.window=[32, 32]",
    "scene.shape=[28, 28]",
    "sensor.shape=[24, 24]",
    "outputs=[saturated]",
]
CHAIN = """# Three steps
sensor: {noise: 5 e-}
steps:
  light: {node: chained.light}
  noisy: {node: chained.noisy, from: light, with: {noise: "${sensor.noise}"}}
  mean: {node: chained.mean, from: noisy}
outputs: [mean]
nodes: [chained.py]
"""
NODES = '''"""Nodes of a test."""
import torch
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.units import Electrons


@node()
def light() -> Tensor:
    return torch.ones(8, 8)


@node()
def noisy(image: Tensor, *, noise: Electrons = 0.0) -> Tensor:
    return image + noise


@node()
def mean(image: Tensor) -> Tensor:
    return image.mean()
'''


class Ticks:
    """A clock by which every step takes 0.3 s, so that every result is kept, however busy the
    machine is.
    """

    now = 1.9e9

    def time(self):
        return self.now

    def perf_counter(self):
        self.now += 0.3
        return self.now


@pytest.fixture(autouse=True)
def every_result_is_kept(monkeypatch):
    """What is kept, and so what a later point computes again, is chosen by the time that a step
    took.
    """
    monkeypatch.setattr(step_job, "time", Ticks())


@pytest.fixture
def counted(monkeypatch):
    """Count the calls of functions, by name."""
    calls = Counter()

    def count(module, name):
        whole = getattr(module, name)

        def watched(*arguments, **how):
            calls[name] += 1
            return whole(*arguments, **how)

        monkeypatch.setattr(module, name, watched)

    count(known_keys, "key_of")
    count(cost_laws, "form_of")
    count(composition, "read")
    count(option_groups, "read")
    count(recipe_graph, "in_order")
    return calls


def swept(count, tmp_path, counted):
    """Return the calls of planning and of running a sweep of ``count`` points in an empty store."""
    arguments = [
        *read_words(SMALL, tmp_path),
        *read_axes({"sensor.read_noise": [f"{n + 5} e-" for n in range(count)]}, tmp_path),
    ]
    store = Store(tmp_path / str(count))
    recipe_graph._ordered.cache_clear()
    cost_laws._sized.clear()
    counted.clear()
    plan = plan_sweep("first_light", points_of(arguments), Path(tmp_path), store)
    planned = Counter(counted)
    counted.clear()
    assert len([each for each in outcomes(plan, store) if each.state == "run"]) == count
    return planned, Counter(counted)


@pytest.mark.slow
def test_a_further_point_repeats_nothing_that_cannot_differ(tmp_path, counted):
    swept(2, tmp_path, counted)  # what a process does once, whichever test comes first
    few, many = swept(4, tmp_path, counted), swept(8, tmp_path, counted)
    assert few[0]["read"] == many[0]["read"] > 10  # files
    assert few[0]["in_order"] == many[0]["in_order"]
    assert few[1]["in_order"] == many[1]["in_order"]
    further = {name: (many[0][name] - few[0][name]) / 4 for name in many[0]}
    assert further["key_of"] <= 11  # ten steps depend on the noise, and one reads a file
    further = {name: (many[1][name] - few[1][name]) / 4 for name in many[1]}
    assert further["key_of"] <= 9  # the two full wells are left out
    # the two steps that have the noise, and the one that reads a file
    assert further["form_of"] <= 3


@pytest.mark.slow
def test_the_calls_of_a_point_do_not_grow_with_the_points_before_it(tmp_path):
    (tmp_path / "chain.yaml").write_text(CHAIN, encoding="utf-8")
    (tmp_path / "chained.py").write_text(NODES, encoding="utf-8")
    axes = read_axes({"sensor.noise": [f"{n / 7} e-" for n in range(1, 101)]}, tmp_path)
    store = Store(tmp_path / "cache")
    plan = plan_sweep("chain.yaml", points_of(axes), tmp_path, store)
    calls, found = [0], []
    sys.setprofile(lambda frame, event, arg: calls.__setitem__(0, calls[0] + (event == "call")))
    try:
        for _ in outcomes(plan, store):
            found.append(calls[0])
            calls[0] = 0
    finally:
        sys.setprofile(None)
    # the fewest calls of a point: a thread that waits for another calls once more, and never once
    # less
    assert min(found[80:]) == pytest.approx(min(found[10:30]), rel=0.1)
