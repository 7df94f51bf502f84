"""A step that leaves something in a module, where another step reads it: both are computed in each
run, and it is said.

Keys of own steps also have the names of files and the order of mappings, which their nodes may
read.
"""

import sys
import textwrap

import pytest
import torch

from neusee.nodes import own_modules
from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.keys import user_code as tainted_code
from neusee.workflows.keys.cache_key import is_private
from neusee.workflows.store.result_store import Store

TWO = """
import numpy as np
import torch
from functools import cached_property, lru_cache
from pathlib import Path
from torch import Tensor
from neusee.nodes import node
import {helper} as helper

{top}


@node({declared})
def first(*, by: float) -> Tensor:
    {first}
    return torch.full((2,), by)


@node()
def second(x: Tensor) -> Tensor:
    return x * {second}


@node()
def third(*, by: float) -> Tensor:
    return torch.full((2,), by) * {second}
"""
HELPER = "KEPT = [0.0]\n\n\ndef put(x):\n    KEPT[0] = x\n\n\ndef get():\n    return KEPT[0]\n"
#: what stands before the nodes, what the first leaves, and what the second reads
TOLD = {
    "a global": ("GAIN = 0.0", "global GAIN; GAIN = by", "GAIN"),
    "a global that was None": ("GAIN = None", "global GAIN; GAIN = by", "(GAIN or 0.0)"),
    "a dictionary": ("KEPT = {}", "KEPT['g'] = by", "KEPT.get('g', 0.0)"),
    "a list in a helper": ("", "helper.put(by)", "helper.get()"),
    "an attribute of a class": ("class Lens:\n    gain = 0.0", "Lens.gain = by", "Lens.gain"),
    "an attribute of a function": ("def tell():\n    pass", "tell.gain = by", "getattr(tell, 'gain', 0.0)"),
    "the running mean of a batch norm": (
        "NORM = torch.nn.BatchNorm2d(1, momentum=1.0)",
        "NORM.train()(torch.full((2, 1, 2, 2), by))",
        "float(NORM.running_mean)",
    ),
    "an attribute of torch": ("", "torch.told_gain = by", "getattr(torch, 'told_gain', 0.0)"),
    "a setting of torch": (
        "",
        "torch.set_float32_matmul_precision('high' if by > 2 else 'medium')",
        "{'highest': 1.0, 'medium': 2.0, 'high': 3.0}[torch.get_float32_matmul_precision()]",
    ),
}  # fmt: skip
HONEST = {
    "a memo of a function": ("@lru_cache\ndef memo(x):\n    return 2 * x", "memo(by)", "memo(1.0)"),
    "a constant that is made at the first call": (
        (
            "TABLE = None\n\n\ndef table():\n    global TABLE\n    if TABLE is None:\n        TABLE"
            " = np.ones(3)\n    return TABLE"
        ),
        "table()",
        "float(table()[0])",
    ),
    "a cached property": (
        (
            "class Lens:\n    @cached_property\n    def gain(self):\n        return 2.0\n\n\nLENS ="
            " Lens()"
        ),
        "LENS.gain",
        "LENS.gain",
    ),
    "a log that nobody reads": ("LOG = []", "LOG.append(by)", "1.0"),
    "a network": ("NET = torch.nn.BatchNorm2d(1).eval()", "NET(torch.ones(1, 1, 1, 1))", "1.0"),
}
FILES = {
    "name": "file.stem.split('_')[1]",
    "folder": "file.parent.name.split('_')[1]",
    "link": "file.resolve().stem.split('_')[1]",
}


@pytest.fixture
def lab(tmp_path, request, monkeypatch):
    """Write two nodes of their own module, and run them as a new process would."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    files = dict(own_modules._files)
    name = f"told_{abs(hash(request.node.nodeid)) % 10**9}"
    names = (name, f"{name}_helper")

    def forget():
        for each in names:
            sys.modules.pop(each, None)
            tainted_code._taints.pop(each, None)
            tainted_code._held_back.discard(each)
        own_modules._files.clear()
        own_modules._files.update(files)
        vars(torch).pop("told_gain", None)
        torch.set_float32_matmul_precision("highest")

    def compute(parts, by=2.0, declared=""):
        forget()
        top, first, second = parts
        code = TWO.format(top=top, first=first, second=second, helper=names[1], declared=declared)
        (tmp_path / f"{name}.py").write_text(textwrap.dedent(code))
        (tmp_path / f"{names[1]}.py").write_text(HELPER)
        (tmp_path / "told.yaml").write_text(
            f"nodes: [./{name}.py]\nseed: 1\ntolerance: 1e-3\noutputs: [one, two]\nsteps:\n  one:"
            f" {{node: {name}.first, with: {{by: {by}}}}}\n  two: {{node: {name}.third, with: {{by:"
            " 1.0}}\n"
        )
        result = run(load("told.yaml", [], tmp_path), Store(tmp_path / "cache"))
        return float(result["two"][0]), result

    yield compute
    forget()


@pytest.mark.filterwarnings("ignore:.*which its cache key does not cover")
@pytest.mark.parametrize("kind", TOLD)
def test_what_one_step_leaves_for_another_is_never_served_from_the_cache(lab, kind):
    assert lab(TOLD[kind], 2.0)[0] == 2.0
    value, result = lab(TOLD[kind], 3.0)
    assert value == 3.0
    assert all(is_private(key) for key in result.keys.values())


@pytest.mark.parametrize("kind", HONEST)
def test_what_no_argument_decides_is_stored(lab, kind):
    assert not any(map(is_private, lab(HONEST[kind])[1].keys.values()))
    assert lab(HONEST[kind])[1].done["two"].state == "cached"


def test_a_memo_that_is_declared_is_stored_and_one_that_is_not_is_named(lab):
    memo = ("SEEN = {}", "SEEN[by] = 2 * by", "float(len(SEEN) > -1)")
    with pytest.warns(
        UserWarning, match=r"one .*leaves.* told_\d+.SEEN, which .*\"unaffected:SEEN\""
    ):
        lab(memo)
    _, result = lab(memo, declared="depends=['unaffected:SEEN']")
    assert not any(map(is_private, result.keys.values()))


NAMED = """
from pathlib import Path
import torch
from torch import Tensor
from neusee.nodes import node


@node()
def value(*, {takes}) -> Tensor:
    return torch.full((2,), float({result}))
"""


@pytest.fixture
def own(tmp_path, request, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    files, name = dict(own_modules._files), f"named_{abs(hash(request.node.nodeid)) % 10**9}"

    def compute(takes, result, given):
        (tmp_path / f"{name}.py").write_text(NAMED.format(takes=takes, result=result))
        (tmp_path / "r.yaml").write_text(
            f"nodes: [./{name}.py]\nseed: 1\ntolerance: 1e-3\noutputs: [it]\nsteps:\n"
            f"  it: {{node: {name}.value, with: {{{given}}}}}\n"
        )
        done = run(load("r.yaml", [], tmp_path), Store(tmp_path / "cache"))
        return float(done["it"][0]), done.done["it"].state

    yield compute
    sys.modules.pop(name, None)
    own_modules._files.clear()
    own_modules._files.update(files)


@pytest.mark.parametrize("kind", FILES)
def test_the_name_of_a_file_counts_for_own_nodes(own, tmp_path, kind):
    for number in (2, 3):
        (tmp_path / f"run_{number}").mkdir()
        for file in (tmp_path / f"dark_{number}.txt", tmp_path / f"run_{number}" / "dark.txt"):
            file.write_text("1")
    for number in (2, 3):
        (tmp_path / "link.txt").unlink(missing_ok=True)
        (tmp_path / "link.txt").symlink_to(f"dark_{number}.txt")
        given = {
            "name": f"dark_{number}.txt",
            "folder": f"run_{number}/dark.txt",
            "link": "link.txt",
        }[kind]
        parts = ("file: Path", FILES[kind], f"file: {given}")
        assert own(*parts) == (number, "run")
        assert own(*parts) == (number, "cached")


def test_the_order_of_a_mapping_counts_for_own_nodes(own):
    parts = ("gains: dict[str, float]", "next(iter(gains.values()))")
    assert own(*parts, "gains: {a: 2.0, b: 3.0}") == (2.0, "run")
    assert own(*parts, "gains: {b: 3.0, a: 2.0}") == (3.0, "run")
    assert own(*parts, "gains: {a: 2.0, b: 3.0}") == (2.0, "cached")


def test_the_folder_of_the_recipe_does_not_count(own, tmp_path):
    """The key has the path below the folder of the recipe."""
    from neusee.workflows.keys.cache_key import written

    (tmp_path / "dark.txt").write_text("1")
    own("file: Path", "1", "file: dark.txt")
    assert written(load("r.yaml", [], tmp_path).steps["it"]) == {"file": ["dark.txt"]}
