"""Names of devices: what cannot compute a recipe is refused before any step runs."""

from __future__ import annotations

import re

import pytest
import torch

from neusee.nodes import node
from neusee.workflows.engine.local_executor import check_devices
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.store.result_store import Store

RAN = []


@node()
def one() -> torch.Tensor:
    """Return one."""
    RAN.append(1)
    return torch.ones(1)


REFUSED = [
    (
        "cpu,cpu",
        "cpu,cpu: names a device twice (cpu): name each device once; cpu:0,cpu:1 are two lanes",
    ),
    ("cpu,cpu:0", "names a device twice (cpu and cpu:0 are one device)"),
    ("meta", "meta: a tensor there has a shape and no values: write cpu or cuda"),
    ("gpu", "gpu: Expected one of cpu, cuda"),
    ("", "Device string must not be empty"),
]


@pytest.mark.parametrize(("device", "said"), REFUSED)
def test_a_device_that_cannot_compute_is_refused_before_any_step(tmp_path, device, said):
    recipe = Recipe(
        "r", "", 1, 0.0, ("one",), {"one": Step("one", one, {}, {}, Location("a.yaml", 1, 1), {})}
    )
    RAN.clear()
    with pytest.raises(ValueError, match=re.escape(said)):
        run(recipe, Store(tmp_path), device=device)
    assert RAN == []


@pytest.mark.parametrize("device", ["cpu", "cpu:0,cpu:1", "cpu:1,cpu"])
def test_lanes_of_one_cpu_are_accepted(device):
    check_devices(device)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_one_gpu_of_two_names_is_one_device():
    with pytest.raises(ValueError, match="cuda and cuda:0 are one device"):
        check_devices("cuda,cuda:0")
