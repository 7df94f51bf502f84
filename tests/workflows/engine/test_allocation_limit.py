"""An own node that allocates at once what nothing foretold: the process stays within 1.3 of its
limit.
"""

import os
import re
import resource
import sys
from contextlib import suppress

import pytest

from neusee.workflows.engine.machine_resources import (
    MemoryLimit,
    limited,
    process_memory,
    refusing_allocations,
)
from tests.workflows.program_forks import Programs

GB = 10**9
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the limit is one of Linux")

#: how an own node takes 12 GB: in one call of torch or NumPy, in pieces, in threads, or through a
#: list of Python
TAKES = {
    "torch": "torch.ones(3_000_000_000).sum()",
    "numpy": "float(numpy.ones(1_500_000_000).sum())",
    "pieces": "sum(float(each[0]) for each in [torch.ones(2_500_000) for _ in range(1200)])",
    "threads": (
        "sum(ThreadPoolExecutor(4).map(lambda _: float(numpy.ones(375_000_000).sum()), range(4)))"
    ),
    "python": "len([0] * 1_500_000_000)",
}
NODE = """
from concurrent.futures import ThreadPoolExecutor

import numpy
import torch
from torch import Tensor

from neusee.nodes import node


@node()
def take(x: Tensor) -> Tensor:
    return x + {take}


@take.shape
def _(x):
    return x
"""
RECIPE = """nodes: [hoard_{name}.py]
seed: 1
tolerance: 0
outputs: [taken]
steps:
  scene: {{node: scene.targets, with: {{kind: siemens, shape: [8, 8]}}}}
  taken: {{node: hoard_{name}.take, from: {{x: scene}}}}
"""


@pytest.fixture(scope="module")
def programs():
    server = Programs()
    yield server
    server.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", TAKES)
def test_an_own_node_stays_within_1_3_of_the_limit(name, programs, tmp_path):
    (tmp_path / f"hoard_{name}.py").write_text(NODE.format(take=TAKES[name]))
    (tmp_path / "lab.yaml").write_text(RECIPE.format(name=name))
    command = ["run", "lab.yaml", "--memory", "1.5 GB"]
    own = {"NEUSEE_CACHE": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1"}
    done = programs.run(command, tmp_path, {**os.environ, **own})
    assert done.returncode == 1, done.stdout + done.stderr
    assert re.search(
        r"taken \(hoard_\w+\.take\): MemoryLimit: .*the limit is 1\.5 GB", done.stderr
    ), done.stderr
    assert "Traceback" not in done.stderr
    assert 0.05 * GB < done.peak < 1.3 * 1.5 * GB


def test_the_limit_of_the_system_is_as_before_after_the_node():
    before, inside = resource.getrlimit(resource.RLIMIT_DATA), list[int]()
    with limited(process_memory() + GB), suppress(ValueError), refusing_allocations(True):
        inside.append(resource.getrlimit(resource.RLIMIT_DATA)[0])
        raise ValueError
    assert process_memory() < inside[0] < 1 << 50
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


def test_an_error_of_an_allocation_is_told_as_one_of_the_limit():
    with (
        limited(2 * process_memory()),
        pytest.raises(MemoryLimit, match="give more memory"),
        refusing_allocations(True),
    ):
        bytearray(1 << 45)


def test_without_an_own_node_or_a_limit_nothing_is_refused():
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with limited(2 * process_memory()), refusing_allocations(False):
        assert resource.getrlimit(resource.RLIMIT_DATA) == before
    with refusing_allocations(True):
        assert resource.getrlimit(resource.RLIMIT_DATA) == before
