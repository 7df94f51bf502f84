"""What a result depends on beside parameters: each kind is computed again, or refused by name; none
is stale.

Each case writes a small package, runs its node, changes one thing, and runs it again. What a call
of the node gives without any cache is the truth.
"""

import importlib
import json
import os
import shutil
import sys
import time
import types
import zipfile

import pytest
import torch

import neusee.nodes
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location, RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.store.result_store import Store

MARK = Location("kinds.yaml", 1, 1)
HEAD = "import torch\nfrom neusee.nodes import node\n"
NODE = "@node({depends})\ndef value(*, k: float = 1.0):\n    return torch.tensor(float({result}))\n"


def source(result, before="", depends="", after=""):
    """The text of a module with a node."""
    return f"{HEAD}{before}\n\n{NODE.format(result=result, depends=depends)}{after}"


class Lab:
    """A package with a node, packages beside it, and a store that all cases share."""

    def __init__(self, folder, store):
        self.folder, self.store = folder, store

    def write(self, name, text):
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def edit(self, name, old, new):
        text = (self.folder / name).read_text()
        assert old in text
        self.write(name, text.replace(old, new))

    def node(self, again=True):
        """The node, from a new import as a new process has it, or as it is loaded."""
        if again:
            forget()
        return importlib.import_module("neusee.nodes.kinds").value

    def run(self, again=True):
        """What a run gives and what the node gives without a cache."""
        node = self.node(again)
        step = Step("value", node, {"k": 1.0}, {}, MARK, {})
        result = run(Recipe("kinds", "", 1, 0.0, ("value",), {"value": step}), Store(self.store))
        return float(result.values["value"]), float(node(k=1.0)), result.done["value"].state


def forget():
    for name in [n for n in sys.modules if n.startswith(("neusee.nodes.kinds", "kinds_"))]:
        del sys.modules[name]
    vars(neusee.nodes).pop("kinds", None)
    importlib.invalidate_caches()


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return tmp_path_factory.mktemp("kinds") / "cache"


@pytest.fixture
def lab(tmp_path, store, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(neusee.nodes, "__path__", [*neusee.nodes.__path__, str(tmp_path)])
    monkeypatch.syspath_prepend(str(tmp_path / "lib"))
    monkeypatch.setenv("KIND", "2")
    (tmp_path / "lib").mkdir()
    yield Lab(tmp_path, store)
    torch.set_default_dtype(torch.float32)
    torch.set_float32_matmul_precision("highest")
    forget()


ONE, TWO = "kinds/__init__.py", "kinds/_two.py"
FROM = "from neusee.nodes.kinds._two import part\n"
HELPER = "from kinds_helper import part\n"
JSON = "import json\nfrom pathlib import Path\n"
TABLE = "kinds/table.json"
DECLARED = "depends=['table.json']"
REGISTRY = """PARTS = {}


def register(name):
    def note(part):
        PARTS[name] = part
        return part
    return note
"""
FILL = (
    "from neusee.nodes.kinds._two import register\n\n\n@register('a')\ndef a(x):\n    return 2.0"
    " * x\n"
)
PARTS = "from neusee.nodes.kinds import _fill\nfrom neusee.nodes.kinds._two import PARTS as part\n"
PATH = "from pathlib import Path\npart = Path(__file__).parent / "
READ = 'TABLE = json.loads((Path(__file__).parent / "table.json").read_text())\n'

#: files, and the edit of one of them
EDITS = {
    "body": ({ONE: source("2.0 * k")}, (ONE, "2.0 *", "3.0 *")),
    "constant": ({ONE: source("TWO * k", "TWO = 2.0")}, (ONE, "TWO = 2.0", "TWO = 3.0")),
    "closure": (
        {ONE: source("part(k)", "def make(s):\n    return lambda x: s * x\n\n\npart = make(2.0)")},
        (ONE, "make(2.0)", "make(3.0)"),
    ),
    "partial": (
        {ONE: source("part(k)", "from functools import partial\nfrom operator import mul\npart = partial(mul, 2.0)")},
        (ONE, "(mul, 2.0)", "(mul, 3.0)"),
    ),
    "default of a helper": (
        {ONE: source("part(k)", FROM), TWO: "S = 2.0\n\n\ndef part(x, s=S):\n    return s * x\n"},
        (TWO, "S = 2.0", "S = 3.0"),
    ),
    "method": (
        {ONE: source("part().of(k)", FROM), TWO: "class part:\n    def of(self, x):\n        return 2.0 * x\n"},
        (TWO, "2.0 *", "3.0 *"),
    ),
    "field of a dataclass": (
        {
            ONE: source("k * part().s", FROM),
            TWO: "from dataclasses import dataclass\n\n\n@dataclass\nclass part:\n    s: float = 2.0\n",
        },
        (TWO, "= 2.0", "= 3.0"),
    ),
    "base class in another file": (
        {
            ONE: source("part().of(k)", FROM),
            TWO: "from neusee.nodes.kinds._base import Base\n\n\nclass part(Base):\n    pass\n",
            "kinds/_base.py": "class Base:\n    def of(self, x):\n        return 2.0 * x\n",
        },
        ("kinds/_base.py", "2.0", "3.0"),
    ),
    "decorator": (
        {
            ONE: f"{HEAD}{FROM}\n\n@node()\n@part(2.0)\ndef value(*, k: float = 1.0):\n    return torch.tensor(k)\n",
            TWO: "from functools import wraps\n\n\ndef part(s):\n    def outer(f):\n        @wraps(f)\n"
            "        def inner(**given):\n            return s * f(**given)\n        return "
            "inner\n    return outer\n",
        },
        (TWO, "return s * f", "return 5 * s * f"),
    ),
    "table in another file": (
        {ONE: source("part['a']", FROM), TWO: "part = {'a': 2.0, 'b': 1.0}\n"},
        (TWO, "2.0", "3.0"),
    ),
    "registry that a sibling fills": (
        {
            ONE: source("part['a'](k)", PARTS),
            TWO: REGISTRY,
            "kinds/_fill.py": FILL,
        },
        ("kinds/_fill.py", "2.0", "3.0"),
    ),
    "helper module of the user": (
        {ONE: source("part(k)", HELPER), "lib/kinds_helper.py": "def part(x):\n    return 2.0 * x\n"},
        ("lib/kinds_helper.py", "2.0", "3.0"),
    ),
    "helper package, two levels": (
        {
            ONE: source("part(k)", HELPER),
            "lib/kinds_helper/__init__.py": "from ._deep import part\n",
            "lib/kinds_helper/_deep.py": "def part(x):\n    return 2.0 * x\n",
        },
        ("lib/kinds_helper/_deep.py", "2.0", "3.0"),
    ),
    "helper by its attribute": (
        {
            ONE: source("kinds_helper.deep.part(k)", "import kinds_helper.deep"),
            "lib/kinds_helper/__init__.py": "",
            "lib/kinds_helper/deep.py": "def part(x):\n    return 2.0 * x\n",
        },
        ("lib/kinds_helper/deep.py", "2.0", "3.0"),
    ),
    "import inside a function": (
        {
            ONE: source("part()(k)", "def part():\n    from kinds_helper import part\n    return part\n"),
            "lib/kinds_helper.py": "def part(x):\n    return 2.0 * x\n",
        },
        ("lib/kinds_helper.py", "2.0", "3.0"),
    ),
    "import by a literal name": (
        {
            ONE: source(
                "part(k)", "import importlib\npart = importlib.import_module('neusee.nodes.kinds._two').part"
            ),
            TWO: "def part(x):\n    return 2.0 * x\n",
        },
        (TWO, "2.0", "3.0"),
    ),
    "declared module": (
        {
            ONE: source(
                "part(k)",
                "import importlib\npart = importlib.import_module('kinds_' + 'helper').part",
                "depends=['kinds_helper']",
            ),
            "lib/kinds_helper.py": "def part(x):\n    return 2.0 * x\n",
        },
        ("lib/kinds_helper.py", "2.0", "3.0"),
    ),
    "declared file, read at import": (
        {ONE: source("TABLE", JSON + READ, "depends=['table.json']"), TABLE: "2.0"},
        (TABLE, "2.0", "3.0"),
    ),
    "declared file, read in the body": (
        {ONE: source("part()", JSON + READ.replace("TABLE =", "part = lambda:"), DECLARED), TABLE: "2.0"},
        (TABLE, "2.0", "3.0"),
    ),
    "declared folder of templates": (
        {
            ONE: source("part.read_text()", f"{PATH}'parts' / 'a.tmpl'", "depends=['parts']"),
            "kinds/parts/a.tmpl": "2.0",
        },
        ("kinds/parts/a.tmpl", "2.0", "3.0"),
    ),
    "declared C++ source": (
        {
            ONE: source("float(part.read_text()[3:])", f"{PATH}'a.cpp'", "depends=['a.cpp']"),
            "kinds/a.cpp": "// 2.0",
        },
        ("kinds/a.cpp", "2.0", "3.0"),
    ),
    "declared by a helper module": (
        {
            ONE: source("part", FROM),
            TWO: f"{JSON}__depends__ = ('table.json',)\n{READ}part = TABLE\n",
            TABLE: "2.0",
        },
        (TABLE, "2.0", "3.0"),
    ),
    "docstring that is read": (
        {ONE: source("float(part.__doc__)", "def part():\n    '''2.0'''\n")},
        (ONE, "'''2.0'''", "'''3.0'''"),
    ),
    "class attribute": (
        {ONE: source("part.s * k", FROM), TWO: "class part:\n    s = 2.0\n"},
        (TWO, "2.0", "3.0"),
    ),
    "enumeration": (
        {ONE: source("part.a.value", FROM), TWO: "from enum import Enum\n\n\nclass part(Enum):\n    a = 2.0\n"},
        (TWO, "2.0", "3.0"),
    ),
    "star import": (
        {ONE: source("part * k", "from neusee.nodes.kinds._two import *"), TWO: "part = 2.0\n"},
        (TWO, "2.0", "3.0"),
    ),
    "single dispatch, registered elsewhere": (
        {
            ONE: source("part(k)", "from neusee.nodes.kinds import _fill\nfrom neusee.nodes.kinds._two import part\n"),
            TWO: "from functools import singledispatch\n\n\n@singledispatch\ndef part(x):\n    return x\n",
            "kinds/_fill.py": "from neusee.nodes.kinds._two import part\n\n\n@part.register\ndef _(x: float):\n"
            "    return 2.0 * x\n",
        },
        ("kinds/_fill.py", "2.0", "3.0"),
    ),
    "match on an enumeration of another file": (
        {
            ONE: source(
                "pick(Kind.A)",
                "from neusee.nodes.kinds._two import Kind\n\n\ndef pick(kind):\n    match "
                "kind:\n        case Kind.B:\n"
                "            return 3.0\n        case _:\n            return 2.0\n",
            ),
            TWO: "from enum import Enum\n\n\nclass Kind(Enum):\n    A = 1\n    B = 2\n",
        },
        (TWO, "B = 2", "B = 1"),
    ),
    "attribute that a metaclass of another file sets": (
        {
            ONE: source("part.s", FROM),
            TWO: "from neusee.nodes.kinds._meta import Base\n\n\nclass part(Base):\n    pass\n",
            "kinds/_meta.py": "class Meta(type):\n    @property\n    def s(cls):\n        return 2.0\n\n\n"
            "class Base(metaclass=Meta):\n    pass\n",
        },
        ("kinds/_meta.py", "2.0", "3.0"),
    ),
    "module with its own getattr": (
        {
            ONE: source("part", FROM),
            TWO: "def __getattr__(name):\n    if name != 'part':\n        raise AttributeError(name)\n"
            "    return 2.0\n",
        },
        (TWO, "2.0", "3.0"),
    ),
    "lambda in a list": (
        {ONE: source("part[0](k)", FROM), TWO: "part = [lambda x: 2.0 * x]\n"},
        (TWO, "2.0", "3.0"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", EDITS)
def test_an_edit_of_a_dependency_is_computed_again(lab, kind):
    files, change = EDITS[kind]
    for name, text in files.items():
        lab.write(name, text)
    first, truth, _ = lab.run()
    assert first == truth
    assert lab.run()[2] == "cached"
    lab.edit(*change)
    second, truth, state = lab.run()
    assert (second, state) == (truth, "run")
    assert truth != first


#: files, and the text that the refusal has after the place
REFUSED = {
    "JSON at import": (
        {ONE: source("TABLE", JSON + READ), TABLE: "2.0"},
        r"__init__\.py:5: .*table.json.*: a file .*depends="),
    "file in the body": ({ONE: source("open('/tmp/x.txt').read()")}, r"__init__\.py:7: .*/tmp/x.txt.*: a file"),
    "file of a helper": (
        {ONE: source("part", HELPER), "lib/kinds_helper.py": "def part():\n    return open('x.txt').read()\n"},
        r"kinds_helper\.py:2: .*depends=\[\"x.txt\"\]",
    ),
    "name of a file that a helper reads": (
        {ONE: source("part('a.csv')", FROM), TWO: "def part(path):\n    return open(path).read()\n"},
        r"__init__\.py:8: 'a.csv'",
    ),
    "resource of a package": (
        {ONE: source("files('x')", "from importlib.resources import files")},
        r"importlib.resources.files: a file",
    ),
    "environment": (
        {ONE: source("os.environ['KIND']", "import os")},
        r'os.environ: an environment variable .*depends=\["env:KIND"\]',
    ),
    "environment by another name": ({ONE: source("e('KIND')", "from os import getenv as e")}, "os.getenv: an env"),
    "import by a name": (
        {ONE: source("f('kinds_' + 'x').y", "from importlib import import_module as f")},
        "importlib.import_module: a module is imported by a name",
    ),
    "__import__": ({ONE: source("__import__('a' + 'b')")}, "__import__: a module"),
    "exec": ({ONE: source("eval('k * ' + '2')")}, "eval: code that no import names"),
    "subprocess": ({ONE: source("subprocess.run(['x'])", "import subprocess")}, "subprocess.run: code"),
    "clock": ({ONE: source("time.time()", "import time")}, "time.time: a clock"),
    "threads": ({ONE: source("torch.get_num_threads()")}, "torch.get_num_threads: "),
    "device": ({ONE: source("torch.cuda.is_available()")}, "torch.cuda.is_available: "),
    "library of C by numpy": (
        {ONE: source("np.ctypeslib.load_library('x', '.')", "import numpy as np")},
        "numpy.ctypeslib.load_library: code that no import names",
    ),
    "functions of Python by ctypes": ({ONE: source("ctypes.pythonapi", "import ctypes")}, "ctypes.pythonapi: code"),
    "locale": ({ONE: source("locale.atof('2,5')", "import locale")}, "locale.atof: a setting of the process"),
    "timer": ({ONE: source("time.perf_counter()", "import time")}, "time.perf_counter: a clock"),
    "context of decimal numbers": (
        {ONE: source("float(Decimal(1) / 3)", "from decimal import Decimal")},
        "decimal.Decimal: a setting of the process",
    ),
    "setting of numpy": ({ONE: source("len(np.geterr()['over'])", "import numpy as np")}, "numpy.geterr: a setting"),
    "existence of a file": (
        {ONE: source("2.0 if Path('/tmp/flag').exists() else 3.0", "from pathlib import Path")},
        r"Path\('/tmp/flag'\)\.exists\(\): a file is read",
    ),
    "size of a file": (
        {ONE: source("os.path.getsize('/tmp/flag')", "import os")},
        r"os.path.getsize\('/tmp/flag'\): a file is read",
    ),
    "variables in a path": (
        {ONE: source("len(os.path.expandvars('$HOME'))", "import os")},
        "os.path.expandvars: an environment variable",
    ),
    "generator of the module": (
        {ONE: source("next(part)", "part = (float(i) for i in range(9))")},
        r"__init__\.py: part is or holds a generator, .*depends=\[\"unaffected:part\"\]",
    ),
    "counter of a helper": (
        {ONE: source("next(part)", FROM), TWO: "import itertools\n\npart = itertools.count(2.0)\n"},
        r"\.py: part is or holds a count, ",
    ),
    "random numbers of the module": (
        {ONE: source("part.random()", "import numpy as np\npart = np.random.default_rng(1)")},
        r"__init__\.py: part is or holds a Generator, ",
    ),
    "memory of several processes": (
        {ONE: source("part[0]", "import mmap\npart = mmap.mmap(-1, 16)")},
        r"__init__\.py: part is or holds a mmap, ",
    ),
    "random numbers of a class": (
        {ONE: source("part.rng.seed()", FROM), TWO: "import torch\n\n\nclass part:\n    rng = torch.Generator()\n"},
        r"_two\.py: part is or holds a Generator, ",
    ),
    "numbers without a seed": ({ONE: source("random.random()", "import random")}, "random.random: random"),
    "declared file that is missing": ({ONE: source("k", depends="depends=['no.csv']")}, "depends='no.csv' is no file"),
    "declared text that is no list": ({ONE: source("k", "__depends__ = 3")},
        "__depends__ must be a tuple of texts"),
}  # fmt: skip


@pytest.mark.parametrize("inside", ["at the top", "in a function", "as a package"])
def test_a_helper_in_an_archive_is_refused_by_name(lab, inside, monkeypatch):
    name = "kinds_packed/__init__.py" if inside == "as a package" else "kinds_packed.py"
    with zipfile.ZipFile(lab.folder / "lib" / "a.zip", "w") as file:
        file.writestr(name, "def part(x):\n    return 2.0 * x\n")
    monkeypatch.syspath_prepend(str(lab.folder / "lib" / "a.zip"))
    line = "from kinds_packed import part"
    before = (
        f"def part(x):\n    {line} as f\n    return f(x)\n" if inside == "in a function" else line
    )
    lab.write(ONE, source("part(k)", before))
    with pytest.raises(
        RunError, match=r"kinds_packed has no source file.*save the module as a file"
    ):
        lab.run()


def test_a_name_of_a_changing_object_that_the_node_does_not_reach_is_fine(lab):
    lab.write(ONE, source("part(k)", FROM))
    lab.write(
        TWO, "import itertools\n\nCOUNT = itertools.count()\n\n\ndef part(x):\n    return 2.0 * x\n"
    )
    assert lab.run()[:2] == (2.0, 2.0)
    lab.edit(TWO, "def part(x):", "def part(x, count=COUNT):")
    with pytest.raises(RunError, match=r"(part|COUNT) is or holds a count"):
        lab.run()
    lab.edit(
        TWO,
        "import itertools",
        "import itertools\n__depends__ = ('unaffected:COUNT', 'unaffected:part')",
    )
    assert lab.run()[:2] == (2.0, 2.0)


@pytest.mark.parametrize("kind", REFUSED)
def test_what_cannot_be_followed_is_refused_with_place_and_fix(lab, kind):
    files, said = REFUSED[kind]
    for name, text in files.items():
        lab.write(name, text)
    with pytest.raises(RunError, match=said):
        lab.run()


def three_times(x):
    return 3.0 * x


def three(self):
    return 3.0


def patched_constant(lab, monkeypatch):
    monkeypatch.setattr(sys.modules["neusee.nodes.kinds._two"], "S", 3.0)


def patched_function(lab, monkeypatch):
    monkeypatch.setattr(sys.modules["neusee.nodes.kinds"], "part", three_times)


def patched_default(lab, monkeypatch):
    sys.modules["neusee.nodes.kinds._two"].part.__defaults__ = (3.0,)


def patched_table(lab, monkeypatch):
    sys.modules["neusee.nodes.kinds._two"].TABLE["a"] = 3.0


def patched_method(lab, monkeypatch):
    monkeypatch.setattr(sys.modules["neusee.nodes.kinds._two"].Part, "of", three)


def patched_tensor(lab, monkeypatch):
    sys.modules["neusee.nodes.kinds._two"].TENSOR.fill_(3.0)


def three_of_a_number(name):
    if isinstance(name, str):
        raise AttributeError(name)
    return 3.0


def late_registration(lab, monkeypatch):
    sys.modules["neusee.nodes.kinds._two"].scale.register(float, three_times)


def late_getattr(lab, monkeypatch):
    vars(sys.modules["neusee.nodes.kinds._two"])["__getattr__"] = three_of_a_number


def private_name(lab, monkeypatch):
    vars(sys.modules["neusee.nodes.kinds._two"])["__OWN"] = 3.0


def metaclass_attribute(lab, monkeypatch):
    monkeypatch.setattr(type(sys.modules["neusee.nodes.kinds._two"].Part), "s", 3.0)


def default_dtype(lab, monkeypatch):
    torch.set_default_dtype(torch.float64)


LATE = """import functools
import sys

__OWN = 1.0


class Meta(type):
    s = 1.0


class Part(metaclass=Meta):
    pass


@functools.singledispatch
def scale(x):
    return x


def part(x):
    late = sys.intern and globals().get("__getattr__")
    return scale(x) * __OWN * Part.s * (late(0) if late else 1.0)
"""
LOADED = "import torch\nS = 1.0\nTABLE = {'a': 1.0}\nTENSOR = torch.ones(())\n\n\nclass Part:\n    def of(self):\n        return 1.0\n\n\ndef part(x, f=1.0):\n    return x * f * S * TABLE['a'] * TENSOR * Part().of() + 0.5 * (torch.get_default_dtype() == torch.float64)\n"
PATCHES = (
    patched_constant,
    patched_function,
    patched_default,
    patched_table,
    patched_method,
    patched_tensor,
    default_dtype,
)


@pytest.mark.parametrize("patch", PATCHES, ids=lambda patch: patch.__name__)
def test_what_changes_in_a_loaded_module_is_computed_again(lab, patch, monkeypatch):
    lab.write(ONE, source("part(k)", FROM))
    lab.write(TWO, LOADED)
    first, truth, _ = lab.run()
    assert first == truth
    patch(lab, monkeypatch)
    second, truth, _ = lab.run(again=False)
    assert second == truth
    assert truth != first
    torch.set_default_dtype(torch.float32)
    monkeypatch.undo()


@pytest.mark.parametrize(
    "patch",
    [late_registration, late_getattr, private_name, metaclass_attribute],
    ids=lambda patch: patch.__name__,
)
def test_what_is_added_to_a_loaded_module_is_computed_again(lab, patch, monkeypatch):
    lab.write(ONE, source("part(k)", FROM))
    lab.write(TWO, LATE)
    first, truth, _ = lab.run()
    assert first == truth == 1.0
    patch(lab, monkeypatch)
    assert lab.run(again=False)[:2] == (3.0, 3.0)


def test_an_object_that_changes_is_noticed_under_each_of_its_names(lab):
    lab.write(ONE, source("next(part[0])", FROM))
    lab.write(TWO, "import itertools\n\na = [itertools.count(2.0)]\npart = a\n")
    with pytest.raises(RunError, match=r"part is or holds a count"):
        lab.run()


@pytest.mark.parametrize("setting", ["autocast", "denormal"])
def test_a_setting_of_torch_that_changes_digits_counts(lab, setting):
    result = (
        "(x @ x).double().sum()"
        if setting == "autocast"
        else "torch.tensor([1e-310], dtype=torch.float64) * 1e300"
    )
    lab.write(ONE, source(result, "x = torch.linspace(0.0, 1.0, 4096).reshape(64, 64)"))
    first, truth, _ = lab.run()
    assert first == truth
    try:
        with torch.autocast("cpu", enabled=setting == "autocast"):
            torch.set_flush_denormal(setting == "denormal")
            assert lab.run(again=False)[0] != first
    finally:
        torch.set_flush_denormal(False)
    assert lab.run(again=False)[2] == "cached"


def entries(store):
    return {key for key, _ in Store(store).entries()}


def in_a_new_process(lab, monkeypatch):
    """The value of a run that has the files as they are now."""
    second, truth, _ = lab.run()
    assert second == truth
    return second


def test_an_edit_between_import_and_first_run_is_not_stored_without_byte_code(lab, monkeypatch):
    lab.write(ONE, source("part(k)", FROM))
    lab.write(TWO, "def part(x):\n    return 1.5 * x\n")
    lab.node()
    lab.edit(TWO, "1.5", "2.5")
    before = entries(lab.store) if lab.store.exists() else set()
    with pytest.warns(UserWarning, match=r"_two.py was edited after its import: restart Python"):
        assert lab.run(again=False)[:2] == (1.5, 1.5)
    assert entries(lab.store) == before
    assert in_a_new_process(lab, monkeypatch) == 2.5


def test_an_edit_after_the_clock_was_set_back_is_noticed(lab, monkeypatch):
    """The import was at a time that has not come yet, as the clock is set now."""
    lab.write(ONE, source("part(k)", FROM))
    lab.write(TWO, "def part(x):\n    return 1.5 * x\n")
    now = time.time_ns
    with monkeypatch.context() as ahead:
        ahead.setattr(time, "time_ns", lambda: now() + 3600 * 10**9)
        lab.node()
    lab.edit(TWO, "1.5", "2.5")
    before = entries(lab.store) if lab.store.exists() else set()
    with pytest.warns(UserWarning, match=r"_two.py was edited after its import: restart Python"):
        assert lab.run(again=False)[:2] == (1.5, 1.5)
    assert entries(lab.store) == before


def test_equal_size_and_time_after_an_edit_are_noticed(lab, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    lab.write(ONE, source("part(k)", FROM))
    lab.write(TWO, "def part(x):\n    return 1.5 * x\n")
    path = lab.folder / TWO
    lab.node()
    stat = path.stat()
    lab.edit(TWO, "1.5", "2.5")
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    before = entries(lab.store) if lab.store.exists() else set()
    with pytest.warns(UserWarning, match=r"the loaded code of part\(\) is not that of .*_two.py"):
        assert lab.run()[0] == 1.5
    assert entries(lab.store) == before
    shutil.rmtree(path.parent / "__pycache__")
    assert in_a_new_process(lab, monkeypatch) == 2.5


def test_a_declared_variable_counts_by_its_value(lab, monkeypatch):
    lab.write(ONE, source("os.environ['KIND']", "import os", "depends=['env:KIND']"))
    assert lab.run()[:2] == (2.0, 2.0)
    monkeypatch.setenv("KIND", "3")
    assert lab.run()[:2] == (3.0, 3.0)


def test_a_link_counts_by_what_it_leads_to(lab):
    lab.write(ONE, source("TABLE", JSON + READ, "depends=['table.json']"))
    for name, text in (("a.json", "2.0"), ("b.json", "3.0")):
        lab.write(name, text)
        os.utime(lab.folder / name, (10**9, 10**9))
    link = lab.folder / TABLE
    link.symlink_to(lab.folder / "a.json")
    assert lab.run()[:2] == (2.0, 2.0)
    link.unlink()
    link.symlink_to(lab.folder / "b.json")
    assert lab.run()[:2] == (3.0, 3.0)


def test_a_file_that_is_replaced_while_it_is_read_and_put_back_is_no_result(lab):
    lab.write(
        ONE,
        f"{HEAD}import os\nfrom pathlib import Path\n\n\n@node(depends=['unaffected:os'])\ndef"
        " value(*, k: float, file: Path):\n    own = file.with_suffix('.own')\n    os.rename(file,"
        " own)\n    file.write_text('9.0')\n    read = float(file.read_text())\n    os.rename(own,"
        " file)\n    return torch.tensor(read)\n",
    )
    lab.write("input.txt", "2.0")
    step = Step("value", lab.node(), {"k": 1.0, "file": lab.folder / "input.txt"}, {}, MARK, {})
    with pytest.raises(RunError, match="changed while it was read"):
        run(Recipe("kinds", "", 1, 0.0, ("value",), {"value": step}), Store(lab.store))


def test_two_nodes_of_one_factory_have_two_digests(lab):
    lab.write(
        ONE,
        f"{HEAD}\n\ndef make(s):\n    @node()\n    def value(*, k: float = 1.0):\n        return"
        " torch.tensor(s * k)\n    return value\n\n\nvalue = make(2.0)\nother = make(3.0)\n",
    )
    module = importlib.import_module("neusee.nodes.kinds")
    code = Code(lab.store / "code.json")
    assert code.of(module.value) != code.of(module.other)


def test_any_flipped_bit_of_the_memo_gives_the_same_digest(lab, tmp_path):
    lab.write(ONE, source("part(k)", FROM))
    lab.write(TWO, "def part(x):\n    return 2.0 * x\n")
    memo, node = tmp_path / "memo" / "code.json", lab.node()
    code = Code(memo)
    right = code.of(node)
    code.save()
    whole = memo.read_bytes()
    for place in range(0, len(whole), max(1, len(whole) // 60)):
        memo.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        found = Code(memo)
        assert found._summaries == {}
        del found
    memo.write_bytes(whole.replace(b"kinds._two", b"kinds._tow"))
    again = Code(memo)
    assert again.of(node) == right
    again.save()
    assert memo.read_bytes() == whole
    assert json.loads(memo.read_bytes().split(b"\n", 2)[2])


def test_a_package_counts_by_its_version(lab, monkeypatch):
    from neusee.workflows.keys import module_origin

    lab.write(ONE, source("k", "import safetensors"))
    code = Code(lab.store / "code.json").of(lab.node())
    monkeypatch.setattr(module_origin, "_fixed", {})
    real = module_origin.version_of
    monkeypatch.setattr(
        module_origin, "version_of", lambda top: real(top) + ("9" if top == "safetensors" else "")
    )
    assert Code(lab.store / "code.json").of(lab.node()) != code


def test_a_module_without_a_file_is_refused(lab):
    lab.write(ONE, source("part(k)", HELPER))
    sys.modules["kinds_helper"] = types.ModuleType("kinds_helper")
    sys.modules["kinds_helper"].part = float
    with pytest.raises(
        RunError, match=r"kinds_helper has no source file.*save the module as a file"
    ):
        lab.run(again=False)
