"""Own files beside that of a node: one that changes what the node computes joins its key, any other
one does not.

Each case writes files as a recipe names them, runs the node of ``sib_a.py``, edits the other file,
and runs again. What a call of the node gives without any cache is the truth.
"""

import importlib
import sys

import numpy as np
import pytest
import torch

from neusee.nodes import own_modules, scene
from neusee.nodes.own_modules import import_missing, own_files
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.node_families import import_own
from neusee.workflows.store.result_store import Store

MARK = Location("siblings.yaml", 1, 1)
HEAD = "import numpy as np\nimport torch\nfrom neusee.nodes import node\n"
NODE = "\n\n@node()\ndef {name}(*, k: float = 1.0):\n    return torch.tensor(float({result}))\n"
COMMON = "sib_common.py"
HIDDEN = (
    "import argparse\n\nSEEN = argparse.Namespace(part=lambda: 1.0)\n\n\ndef register(f):\n   "
    " SEEN.part = f\n"
)
BASE = "class Base:\n    s = 0.0\n"


def source(result, before="", name="value"):
    return f"{HEAD}{before}{NODE.format(result=result, name=name)}"


class Lab:
    """A folder with files of a recipe, and a store."""

    def __init__(self, folder):
        self.folder, self.store = folder, Store(folder / "cache")

    def write(self, name, text):
        (self.folder / name).write_text(text)

    def edit(self, old="2.0", new="3.0", name="sib_b.py"):
        text = (self.folder / name).read_text()
        assert old in text
        self.write(name, text.replace(old, new))

    def load(self, *names):
        """The node, from new imports as a new process has them."""
        forget()
        for name in ("sib_a.py", *names):
            import_own(name, self.folder)
        return sys.modules["sib_a"].value

    def run(self, *names):
        """What a run gives, what the node gives without a cache, and how the run got it."""
        node = self.load(*names or ("sib_b.py",))
        step = Step("value", node, {"k": 1.0}, {}, MARK, {})
        result = run(Recipe("siblings", "", 1, 0.0, ("value",), {"value": step}), self.store)
        return float(result.values["value"]), float(node(k=1.0)), result.done["value"].state


def forget():
    for name in [name for name in sys.modules if name.startswith("sib_")]:
        del sys.modules[name]
    own_modules._files.clear()
    importlib.invalidate_caches()


@pytest.fixture
def lab(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(np, "mean", np.mean)
    monkeypatch.setattr(torch.nn.functional, "relu", torch.nn.functional.relu)
    monkeypatch.setattr(torch.Tensor, "sib_thing", lambda x: x, raising=False)
    monkeypatch.setattr(scene.targets.hooks, "check", scene.targets.hooks.check)
    monkeypatch.setattr(sys, "path", [*sys.path])
    files = dict(own_modules._files)
    yield Lab(tmp_path)
    forget()
    own_modules._files.update(files)


#: what ``sib_a.py`` computes with what before it, what stands in ``sib_b.py``, and a helper of both
JOINED = {
    "subclasses of a shared class": (
        ("sum(c.s for c in Base.__subclasses__())", "from sib_common import Base"),
        "from sib_common import Base\n\n\nclass Two(Base):\n    s = 2.0\n",
        BASE,
    ),
    "subclasses of a class of torch": (
        ("max(getattr(c, 'sib', 0.0) for c in torch.nn.Bilinear.__subclasses__())", ""),
        "class Two(torch.nn.Bilinear):\n    sib = 2.0\n",
        "",
    ),
    "attribute of the module": (("globals().get('S', 1.0)", ""), "import sib_a\nsib_a.S = 2.0\n", ""),
    "attribute by setattr": (
        ("globals().get('S', 1.0)", ""),
        "import sib_a\nfor part in (sib_a,):\n    setattr(part, 'S', 2.0)\n",
        "",
    ),
    "weights of a module": (
        ("NET.weight.detach()", "NET = torch.nn.Linear(1, 1, device='meta').to_empty(device='cpu')"),
        "import sib_a\nfor part in sib_a.NET.parameters():\n    part.data.fill_(2.0)\n",
        "",
    ),
    "registry of hidden state": (
        ("SEEN.part()", "from sib_common import SEEN"),
        "from sib_common import register\nregister(lambda: 2.0)\n",
        HIDDEN,
    ),
    "registry by a decorator": (
        ("SEEN.part()", "from sib_common import SEEN"),
        "from sib_common import register\n\n\n@register\ndef part():\n    return 2.0\n",
        HIDDEN,
    ),
    "registry whose function is used": (
        ("SEEN.part()", "from sib_common import SEEN"),
        "import sib_common\nnothing = sib_common.register(lambda: 2.0)\n",
        HIDDEN,
    ),
    "function of numpy": (("np.mean([k, k])", ""), "np.mean = lambda x: 2.0\n", ""),
    "function of torch": (
        ("torch.nn.functional.relu(torch.ones(()))", ""),
        "F = torch.nn.functional\nF.relu = lambda x: 2.0\n",
        "",
    ),
    "method of tensors": (
        ("torch.ones(()).sib_thing()", ""),
        "setattr(torch.Tensor, 'sib_thing', lambda x: 2.0)\n",
        "",
    ),
    "function of numpy, by a helper": (
        ("np.mean([k, k])", ""),
        "from sib_common import patch\npatch(np, 'mean', lambda x: 2.0)\n",
        "def patch(where, name, new):\n    setattr(where, name, new)\n",
    ),
    "function of numpy, while a step computes": (
        ("np.mean([k, k])", ""),
        "def patch():\n    np.mean = lambda x: 2.0\n\n\n[patch()]\n",
        "",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", JOINED)
def test_a_file_that_changes_what_a_node_computes_is_part_of_its_key(lab, kind):
    (result, before), beside, common = JOINED[kind]
    lab.write(COMMON, common)
    lab.write("sib_a.py", source(result, before))
    lab.write("sib_b.py", source("k", beside, "other"))
    first, truth, _ = lab.run()
    assert first == truth == 2.0
    assert lab.run()[2] == "cached"
    lab.edit()
    assert lab.run() == (3.0, 3.0, "run")


def test_a_file_that_is_added_and_patches_a_library_is_part_of_the_key(lab):
    lab.write("sib_a.py", source("np.mean([k, k])"))
    lab.write("sib_b.py", source("k", "np.mean = lambda x: 2.0\n", "other"))
    lab.write("sib_c.py", source("k", name="third"))
    assert lab.run("sib_c.py") == (1.0, 1.0, "run")
    assert lab.run("sib_c.py", "sib_b.py") == (2.0, 2.0, "run")


#: what stands in a file that changes nothing beyond itself
APART = {
    "a node": "SCALE = 2.0\n",
    "a network": "from torch import nn\n\n\nclass Net(nn.Module):\n    def __init__(self):\n        super().__init__()"
    "\n        self.part = nn.Linear(1, 1)\n        nn.init.zeros_(self.part.weight)\n        "
    "self.scale = 2.0\n",
    "a memo of its own": "SEEN = {}\n\n\ndef part(x):\n    SEEN[x] = 2.0\n    return SEEN[x]\n",
    "a helper that only computes": "from sib_common import Base\n\n\ndef part():\n    return Base.s * 2.0\n",
    "warnings that are ignored": "import warnings\nwarnings.filterwarnings('ignore')\nSCALE = 2.0\n",
    "a dataclass and an enumeration": "from dataclasses import dataclass\nfrom enum import Enum\n\n\n"
    "@dataclass(frozen=True)\nclass Part:\n    s: float = 2.0\n\n\nclass Kind(Enum):\n    A = 1\n",
    "an array that is filled": "def part():\n    out = np.zeros(3)\n    out[0] = 2.0\n    out += 1\n    return out\n",
    "an autograd function": "class Part(torch.autograd.Function):\n    @staticmethod\n    def forward(ctx, x):\n"
    "        ctx.save_for_backward(x)\n        ctx.scale = 2.0\n        return x\n",
}  # fmt: skip


@pytest.mark.parametrize("kind", APART)
def test_an_edit_of_a_file_that_changes_nothing_beyond_itself_computes_nothing_again(lab, kind):
    lab.write(COMMON, BASE)
    lab.write("sib_a.py", source("k + Base.s", "from sib_common import Base"))
    lab.write("sib_b.py", source("k", APART[kind], "other"))
    assert lab.run() == (1.0, 1.0, "run")
    lab.edit()
    assert lab.run() == (1.0, 1.0, "cached")


def digest_of(lab, node):
    return Code(lab.folder / "code.json").of(node)


@pytest.mark.parametrize(
    ("beside", "joins"), [("np.mean = lambda x: 2.0\n", True), ("S = 2.0\n", False)]
)
def test_a_patched_library_counts_for_the_nodes_of_neusee_too(lab, beside, joins):
    lab.write("sib_a.py", source("k"))
    lab.write("sib_b.py", source("k", beside, "other"))
    forget()
    alone = digest_of(lab, scene.targets)
    lab.load("sib_b.py")
    first = digest_of(lab, scene.targets)
    lab.edit()
    lab.load("sib_b.py")
    assert (first != alone, digest_of(lab, scene.targets) != first) == (joins, joins)


def test_a_changed_object_of_an_own_module_does_not_count_for_the_nodes_of_neusee(lab):
    lab.write("sib_a.py", source("globals().get('S', 1.0)"))
    lab.write("sib_b.py", source("k", "import sib_a\nsib_a.S = 2.0\n", "other"))
    forget()
    alone = digest_of(lab, scene.targets)
    lab.load("sib_b.py")
    assert digest_of(lab, scene.targets) == alone


def test_a_patch_that_rests_on_a_file_without_a_key_is_refused(lab):
    lab.write("sib_a.py", source("np.mean([k, k])"))
    lab.write("factor", "2.0")
    read = (
        f"from pathlib import Path\nfactor = float(Path({str(lab.folder)!r}, 'fac' +"
        " 'tor').read_text())\n"
    )
    lab.write("sib_b.py", source("k", f"{read}np.mean = lambda x: factor\n", "other"))
    with pytest.warns(UserWarning, match="sib_b reads"):
        node = lab.load("sib_b.py")
    with pytest.raises(LookupError, match=r"sib_b.py:5: .*: a file is read that is no parameter"):
        digest_of(lab, node)


def test_another_process_imports_files_and_modules_in_the_same_order(lab, monkeypatch):
    lab.write("sib_a.py", source("k"))
    lab.write("sib_b.py", source("k", name="other"))
    monkeypatch.syspath_prepend(str(lab.folder))
    forget()
    import_own("sib_b", lab.folder)
    import_own("sib_a.py", lab.folder)
    files = own_files()
    assert files == ("sib_b", str(lab.folder / "sib_a.py"))
    forget()
    import_missing(files, "sib_a")
    assert own_files() == files
    assert {"sib_a", "sib_b"} <= sys.modules.keys()


def test_another_process_needs_no_file_of_other_nodes(lab, monkeypatch):
    """The caller may have imported files for other recipes, which are gone or fail elsewhere."""
    lab.write("sib_a.py", source("k"))
    lab.write("sib_b.py", source("k", name="other"))
    files = (str(lab.folder / "sib_gone.py"), str(lab.folder / "sib_a.py"), "sib_of_no_folder")
    forget()
    import_missing(files, "sib_a")
    assert own_files() == (str(lab.folder / "sib_a.py"),)
    with pytest.raises(ImportError, match=r"there is no file .*sib_gone"):
        import_missing(files, "sib_gone")
    with pytest.raises(ImportError, match="sib_of_no_folder"):
        import_missing(files, "sib_of_no_folder.part")
