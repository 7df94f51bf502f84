"""Forms of code that change something beyond their module, and forms that only look so."""

import pytest

from neusee.workflows.keys.source_summary import summarise

#: code, and a name that it changes in another module
OUTWARD = {
    "an attribute": ("import numpy as np\nnp.mean = 1", "numpy.mean"),
    "an attribute that is deleted": ("import numpy as np\ndel np.mean", "numpy.mean"),
    "an item": ("import lib\nlib.TABLE['a'] = 1", "lib.TABLE"),
    "an item of a name": ("from lib import TABLE\nTABLE['a'] = 1", "lib.TABLE"),
    "another name of a module": ("import numpy as np\nother = np\nother.mean = 1", "numpy.mean"),
    "a loop over modules": (
        "import numpy as np\nimport torch\nfor m in (np, torch):\n    m.mean = 1",
        "torch.mean",
    ),
    "in a function": ("import torch\ndef f():\n    part = torch.nn\n    part.x = 1", "torch.nn.x"),
    "an import in a function": ("def f():\n    import numpy\n    numpy.mean = 1", "numpy.mean"),
    "setattr": ("import torch\nsetattr(torch.Tensor, 'x', 1)", "torch.Tensor"),
    "vars": ("import numpy as np\nvars(np)['mean'] = 1", "numpy"),
    "getattr": ("import torch\ngetattr(torch, 'nn').x = 1", "torch"),
    "a method of a list": ("import lib\nlib.PARTS.append(1)", "lib.PARTS.append"),
    "a variable of the environment": (
        "import os\nos.environ.setdefault('A', 'b')",
        "os.environ.setdefault",
    ),
    "a function for its effect": ("import lib\nlib.patch_all()", "lib.patch_all"),
    "a method whose result is used": ("import lib\nold = lib.NET.train(False)", "lib.NET.train"),
    "a method that ends with _": (
        "import lib\nx = lib.NET.weight.fill_(2)",
        "lib.NET.weight.fill_",
    ),
    "an initialiser": (
        "import torch\nimport lib\ntorch.nn.init.ones_(lib.NET.weight)",
        "lib.NET.weight",
    ),
    "a setting": ("import numpy as np\nnp.set_printoptions(precision=3)", "numpy.set_printoptions"),
    "a decorator": ("from lib import register\n@register('a')\ndef f():\n    pass", "lib.register"),
    "a base class": ("from lib import Base\nclass A(Base):\n    pass", "lib.Base"),
    "a relative import": ("from . import lib\nlib.S = 1", ".lib.S"),
    "a shared object of a library": (
        "import lib\nlib.get_registry()['a'] = 1",
        "lib.get_registry()",
    ),
    "warnings that are errors": (
        "import warnings\nwarnings.simplefilter('error')",
        "warnings.simplefilter",
    ),
    "a hook of a node": (
        "from neusee.nodes.optics import psf\n@psf.check\ndef _(x):\n    pass",
        "neusee.nodes.optics.psf.check",
    ),
}
QUIET = {
    "a new array": "import numpy as np\nx = np.zeros(3)\nx[0] = 1\nx.flags.writeable = False",
    "an attribute of the object itself": (
        "class A:\n    def f(self):\n        self.x = 1\n        self.y[0] = 2"
    ),
    "a local list": "def f():\n    found = []\n    found.append(1)\n    return found",
    "a log": "import logging\nlogging.getLogger('x').info('y')",
    "a table of its own": "TABLE = {}\nTABLE['a'] = 1",
    "a regular expression": "import re\nWORD = re.compile('x')",
    "evaluation mode": "def f(net):\n    net.eval()\n    return net",
    "a sum into an array": "import torch\ndef f(x, y):\n    torch.add(x, y, out=x)\n    return x",
    "a name that an argument hides": "import numpy as np\ndef f(np):\n    np.x = 1",
    "a node of neusee": "from neusee.nodes import node\n@node(rtol=1e-5)\ndef f(x):\n    return x",
    "a class of torch": "from torch import nn\nclass A(nn.Module):\n    pass",
}


def reach(code):
    return summarise(code.encode(), own=True).reach


@pytest.mark.parametrize("kind", OUTWARD)
def test_what_a_module_changes_elsewhere_is_named(kind):
    code, name = OUTWARD[kind]
    assert name in reach(code).outward


@pytest.mark.parametrize("kind", QUIET)
def test_what_stays_in_a_module_is_not(kind):
    assert reach(QUIET[kind]).outward == []


@pytest.mark.parametrize(
    ("code", "inward"),
    [
        ("PARTS = []\ndef f(x):\n    PARTS.append(x)", True),
        ("N = 0\ndef f():\n    global N\n    N += 1", True),
        ("class A:\n    n = 0\n    def f(self):\n        type(self).n += 1", True),
        ("class A:\n    @classmethod\n    def f(cls, x):\n        cls.parts[x] = 1", True),
        ("PARTS = []\nPARTS.append(1)", False),
        ("def f(x):\n    x.append(1)", False),
    ],
)
def test_a_function_that_changes_its_own_module(code, inward):
    assert reach(code).inward is inward


def test_an_import_that_nothing_names_is_there_for_its_effect():
    assert reach("import lib\nimport os\nfrom other import x\nprint(x)").unused == ["lib"]


def test_code_that_looks_for_classes_is_named():
    assert reach("def f(x):\n    return x.__subclasses__()").seeks
