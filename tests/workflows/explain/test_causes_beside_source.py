"""What `neusee why` says of a change that is not in the source: settings, versions, files,
variables, loaded values.
"""

import importlib
import sys

import pytest
import torch

import neusee.nodes
from neusee.workflows.engine.runner import run
from neusee.workflows.explain import change_causes as code_changes
from neusee.workflows.explain.why_rerun import why_lines
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys import code_digest, module_origin
from neusee.workflows.keys import loaded_state as process_settings
from neusee.workflows.store.result_store import Store

NODE = """import os
from pathlib import Path

import safetensors
import torch
from neusee.nodes import node
from neusee.nodes.beside._part import TABLE

def make(factor):
    @node(depends=["table.csv", "env:BESIDE"])
    def value(*, k: float = 1.0):
        table = (Path(__file__).parent / "table.csv").read_text()
        return torch.tensor(float(table) * float(os.environ["BESIDE"]) * TABLE["a"] * factor * k)
    return value

value = make(1.0)
"""


class Lab:
    def __init__(self, folder):
        self.folder, self.store = folder / "beside", Store(folder / "cache")
        self.folder.mkdir()
        for name, text in {
            "__init__.py": NODE,
            "_part.py": "TABLE = {'a': 2.0}\n",
            "table.csv": "3.0",
        }.items():
            (self.folder / name).write_text(text)

    def recipe(self, again=True):
        if again:
            forget()
        node = importlib.import_module("neusee.nodes.beside").value
        return Recipe(
            "beside",
            "",
            1,
            0.0,
            ("s",),
            {"s": Step("s", node, {"k": 1.0}, {}, Location("b", 1, 1), {})},
        )

    def causes(self, again=True):
        """What differs from the stored result."""
        head, *found, _ = why_lines(self.recipe(again), self.store, "s")
        assert "not stored" in head
        return [line.strip().removeprefix("s: ") for line in found]

    def edit(self, name, old, new):
        text = (self.folder / name).read_text()
        assert old in text
        (self.folder / name).write_text(text.replace(old, new))


def forget():
    for name in [n for n in sys.modules if n.startswith("neusee.nodes.beside")]:
        del sys.modules[name]
    vars(neusee.nodes).pop("beside", None)
    importlib.invalidate_caches()


@pytest.fixture
def lab(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(neusee.nodes, "__path__", [*neusee.nodes.__path__, str(tmp_path)])
    monkeypatch.setenv("BESIDE", "2")
    found = Lab(tmp_path)
    run(found.recipe(), found.store)
    assert "stored since" in why_lines(found.recipe(), found.store, "s")[0]
    yield found
    torch.set_default_dtype(torch.float32)
    forget()


def test_a_setting(lab):
    torch.set_default_dtype(torch.float64)
    assert lab.causes() == [
        "default dtype torch.float32 -> torch.float64, a setting of this process"
    ]


def test_autocast(lab):
    with torch.autocast("cpu"):
        assert lab.causes() == ["autocast off -> cpu torch.bfloat16, a setting of this process"]


def test_every_setting_has_a_usual_value(monkeypatch):
    assert process_settings.settings() == {}
    monkeypatch.setattr(process_settings, "USUAL", dict.fromkeys(process_settings.USUAL, ""))
    found = process_settings.settings() | process_settings.own_settings(reads_time=True)
    assert found.keys() == process_settings.USUAL.keys()


def test_the_version_of_python(lab, monkeypatch):
    monkeypatch.setattr(code_digest, "_PYTHON", "Python 3.99")
    assert lab.causes() == ["Python {}.{} -> Python 3.99".format(*sys.version_info)]


def test_the_version_of_a_package(lab, monkeypatch):
    real = module_origin.version_of
    monkeypatch.setattr(module_origin, "_fixed", {})
    monkeypatch.setattr(
        module_origin, "version_of", lambda top: real(top) + ("9" if top == "safetensors" else "")
    )
    now = real("safetensors")
    assert lab.causes() == [f"{now} -> {now}9, an installed package"]


def test_a_declared_file(lab):
    (lab.folder / "table.csv").write_text("4.0")
    assert lab.causes() == ["declared file table.csv changed"]


def test_a_variable_of_the_environment(lab, monkeypatch):
    monkeypatch.setenv("BESIDE", "3")
    assert lab.causes() == ["environment variable BESIDE changed"]


def test_declarations_that_come_and_go(lab):
    (lab.folder / "more.csv").write_text("1.0")
    lab.edit("__init__.py", '"table.csv").read_text()', '"more.csv").read_text()')
    lab.edit(
        "__init__.py",
        'depends=["table.csv", "env:BESIDE"]',
        'depends=["more.csv", "unaffected:os"]',
    )
    found = lab.causes()
    assert "file more.csv is declared now" in found
    assert "file table.csv is declared no more" in found
    assert "environment variable BESIDE is declared no more" in found
    assert "code of make() in neusee/nodes/beside/__init__.py changed (line 9)" in found


def test_a_package_that_is_used_no_longer(lab):
    lab.edit("__init__.py", "import safetensors\n", "import xxhash\n")
    assert {"package xxhash is used now", "package safetensors is no longer used"} <= {
        *lab.causes()
    }


def test_a_value_that_was_changed_in_memory(lab):
    recipe = lab.recipe()
    sys.modules["neusee.nodes.beside._part"].TABLE["a"] = 5.0
    found = [line.strip() for line in why_lines(recipe, lab.store, "s")]
    what = "a constant, a table, a default or a function"
    assert (
        "s: a value that neusee/nodes/beside/_part.py holds was changed while the program ran:"
        f" {what}" in found
    )


def test_a_value_of_the_function_around_a_node(lab):
    lab.edit("__init__.py", "def value(", "def inner(")
    lab.edit("__init__.py", "return value\n", "return inner\n")
    lab.store = Store(lab.folder.parent / "other")
    run(lab.recipe(), lab.store)
    lab.edit("__init__.py", "make(1.0)", "make(2.0)")
    assert lab.causes() == [
        "constant value in neusee/nodes/beside/__init__.py changed (line 16)",
        "a value that the function of the node holds from the function around it changed",
    ]


def test_code_that_was_edited_after_its_import(lab):
    recipe = lab.recipe()
    lab.edit("_part.py", "2.0", "2.5")
    with pytest.warns(UserWarning, match=r"_part.py was edited after its import"):
        found = why_lines(recipe, lab.store, "s")
    assert (
        found[1].strip()
        == "s: the loaded code of beside.value is not that of its file any more: restart Python"
    )


def test_a_package_with_other_files_under_its_version_is_told():
    old, new = ({"version": "thing 1.0", "content": digest} for digest in ("1" * 32, "2" * 32))
    told = code_changes._beside("package thing", old, new)
    assert told == ["package thing has other files, under the same version: thing 1.0"]
