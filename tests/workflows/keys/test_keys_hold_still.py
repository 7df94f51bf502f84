"""Keys stay equal while nothing changes: whatever else a process imports, computes, draws or
trains.
"""

import abc
import importlib
import io
import json
import os
import subprocess
import sys
import threading

import pytest
import torch

import neusee.nodes
from neusee.nodes import metrics, restore
from neusee.nodes.precision import exact_convolutions
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.loaded_state import settings
from neusee.workflows.recipe.node_families import all_nodes


@pytest.fixture(scope="module")
def memo(tmp_path_factory):
    return tmp_path_factory.mktemp("still") / "code.json"


@pytest.fixture(scope="module")
def before(memo):
    return digests(memo)


def digests(memo):
    """The digest of each node of the program, and the settings that count."""
    code = Code(memo)
    found = {node.path: code.of(node) for _, node in all_nodes()}
    code.save()
    return found, settings()


def compare_pictures():
    picture = torch.rand(1, 3, 48, 48, generator=torch.Generator().manual_seed(1))
    metrics.quality(picture, picture * 0.5)


def compare_in_threads():
    threads = [threading.Thread(target=compare_pictures) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def draw():
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().plot([1, 2])
    figure.savefig(io.BytesIO())


def train_one_step():
    net = torch.nn.Conv2d(3, 3, 3)
    optimiser = torch.optim.Adam(net.parameters())
    with exact_convolutions(torch.zeros(1)):
        loss = net(torch.ones(1, 3, 8, 8)).square().mean()
    loss.backward()
    optimiser.step()
    torch.func.grad(lambda x: (x**2).sum())(torch.ones(3))


def fail():
    """A node that raises leaves nothing behind."""
    with pytest.raises(Exception):  # noqa: B017, PT011
        restore.wiener(None, None)


def import_libraries():
    for name in (
        "scipy.signal",
        "scipy.sparse.csgraph",
        "PIL.Image",
        "xxhash",
        "decimal",
        "locale",
    ):
        importlib.import_module(name)


def register_abstract_classes():
    class Abstract(abc.ABC):  # noqa: B024
        pass

    Abstract.register(int)


@pytest.mark.parametrize(
    "act",
    [compare_in_threads, draw, train_one_step, fail, import_libraries, register_abstract_classes],
    ids=lambda act: act.__name__,
)
def test_no_digest_of_a_node_changes(memo, before, act):
    act()
    assert digests(memo) == before


DISPATCH = """import functools
import torch
from collections.abc import Sized
from neusee.nodes import node


@functools.singledispatch
def scale(x):
    return 2.0 * x


@scale.register(Sized)
def _(x):
    return 0.0


@node()
def value(*, k: float = 1.0):
    return torch.tensor(scale(k))
"""


def test_a_function_that_a_type_chooses_holds_a_cache_that_does_not_count(tmp_path, monkeypatch):
    monkeypatch.setattr(neusee.nodes, "__path__", [*neusee.nodes.__path__, str(tmp_path)])
    (tmp_path / "still_trial.py").write_text(DISPATCH)
    node = importlib.import_module("neusee.nodes.still_trial").value
    try:
        first = Code(tmp_path / "code.json").of(node)
        register_abstract_classes()
        assert float(node(k=1.0)) == 2.0
        assert Code(tmp_path / "code.json").of(node) == first
    finally:
        del sys.modules["neusee.nodes.still_trial"], neusee.nodes.still_trial


SCRIPT = """
import importlib, json, sys
for name in sys.argv[3:]:
    importlib.import_module(name)
from pathlib import Path
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.node_families import all_nodes
code = Code(Path(sys.argv[1]))
print(json.dumps({node.path: code.of(node) for _, node in [*all_nodes()][:: int(sys.argv[2])]}))
"""


def keys_of_a_process(memo, folder, hash_seed, *modules, flags=(), each=1):
    command = [sys.executable, *flags, "-c", SCRIPT, str(memo), str(each), *modules]
    path = os.pathsep.join(filter(None, (os.path.abspath(entry) for entry in sys.path if entry)))
    env = {**os.environ, "PYTHONHASHSEED": hash_seed, "PYTHONPATH": path}
    found = subprocess.run(command, env=env, cwd=folder, capture_output=True, text=True, check=True)
    return json.loads(found.stdout)


@pytest.mark.slow
def test_processes_agree_whatever_they_import_first_and_wherever_they_start(before, tmp_path):
    others = ("neusee.nodes.restore", "matplotlib.pyplot", "kornia", "neusee.workflows.cli.app")
    assert keys_of_a_process(tmp_path / "a.json", "/", "2", *others) == before[0]


@pytest.mark.slow
def test_python_without_assert_statements_has_keys_of_its_own(before, tmp_path):
    """A node may compute another result where ``__debug__`` is False."""
    other = keys_of_a_process(tmp_path / "o.json", tmp_path, "1", flags=["-O"], each=8)
    assert len(other) > 10
    assert {*other.values()}.isdisjoint(before[0].values())
