"""Another file of the same recipe, or a helper of it, changes what a node computes."""

from unseen_kinds.case import OTHER, Case

BOTH = "own.py, other.py"


def sibling(name: str, about: str, code: str, first: str, second: str, **files) -> Case:
    """Return a case whose file `other.py` changes from one text to another."""
    return Case(
        name, about, code, nodes=BOTH, files={"other.py": (first + OTHER, second + OTHER), **files}
    )


CASES = [
    sibling(
        "subclass",
        "counts the subclasses of its base",
        """
        class Base:
            gain = 0

        @node()
        def value() -> Tensor:
            return picture(sum(kind.gain for kind in Base.__subclasses__()))
        """,
        """
import own

class Mine(own.Base):
    gain = 1
""",
        """
import own

class Mine(own.Base):
    gain = 2
""",
    ),
    sibling(
        "attribute",
        "an attribute that the other file sets",
        """
        GAIN = 0.0

        @node()
        def value() -> Tensor:
            return picture(GAIN)
        """,
        """
import own

own.GAIN = 1.0
""",
        """
import own

own.GAIN = 2.0
""",
    ),
    sibling(
        "registry",
        "a registry that the other file fills",
        """
        GAINS = {}

        def register(function):
            GAINS[function.__name__] = function
            return function

        @node()
        def value() -> Tensor:
            return picture(GAINS["gain"]())
        """,
        """
from own import register

@register
def gain():
    return 1
""",
        """
from own import register

@register
def gain():
    return 2
""",
    ),
    sibling(
        "patched_library",
        "the other file replaces a function of NumPy",
        """
        @node()
        def value() -> Tensor:
            return picture(np.trapezoid([1.0, 1.0]))
        """,
        """
import numpy

numpy.trapezoid = lambda values: 1.0
""",
        """
import numpy

numpy.trapezoid = lambda values: 2.0
""",
    ),
    sibling(
        "weights",
        "the other file sets the weights of a network",
        """
        NET = torch.nn.Linear(2, 2, bias=False)
        NET.weight.data.fill_(0.0)

        @node()
        def value() -> Tensor:
            return NET(torch.ones(2, 2)).detach()
        """,
        """
import own

own.NET.weight.data.fill_(1.0)
""",
        """
import own

own.NET.weight.data.fill_(2.0)
""",
    ),
    sibling(
        "single_dispatch",
        "the other file registers a method for a type",
        """
        import functools

        @functools.singledispatch
        def gain(kind):
            return 0

        @node()
        def value() -> Tensor:
            return picture(gain(1.0))
        """,
        """
import own

@own.gain.register
def _(kind: float):
    return 1
""",
        """
import own

@own.gain.register
def _(kind: float):
    return 2
""",
    ),
    sibling(
        "codec",
        "the other file registers an error handler of codecs",
        """
        @node()
        def value() -> Tensor:
            return picture(b"\\xff".decode("ascii", "lab"))
        """,
        """
import codecs

codecs.register_error('lab', lambda error: ('1', error.end))
""",
        """
import codecs

codecs.register_error('lab', lambda error: ('2', error.end))
""",
    ),
    sibling(
        "dialect",
        "the other file registers a dialect of csv",
        """
        import csv

        @node()
        def value() -> Tensor:
            return picture(len(next(csv.reader(["1;2,3,4"], dialect="lab"))))
        """,
        """
import csv

csv.register_dialect('lab', delimiter=';')
""",
        """
import csv

csv.register_dialect('lab', delimiter=',')
""",
    ),
    sibling(
        "method_of_tensor",
        "the other file adds a method to torch.Tensor",
        """
        @node()
        def value() -> Tensor:
            return torch.ones(2, 2).amplified()
        """,
        """
import torch

torch.Tensor.amplified = lambda self: self * 1
""",
        """
import torch

torch.Tensor.amplified = lambda self: self * 2
""",
    ),
    sibling(
        "hook_of_json",
        "the other file changes the default encoder of json",
        """
        import json

        @node()
        def value() -> Tensor:
            return picture(json.dumps(object()))
        """,
        """
import json

json.JSONEncoder.default = lambda self, thing: 1
""",
        """
import json

json.JSONEncoder.default = lambda self, thing: 2
""",
    ),
    sibling(
        "variable_of_process",
        "the other file sets a variable that a library reads",
        """
        import string

        @node()
        def value() -> Tensor:
            import tempfile

            return picture(len(tempfile.gettempprefix()) + len(os.path.expanduser("~")))
        """,
        """
import os

os.environ['HOME'] = '/a'
""",
        """
import os

os.environ['HOME'] = '/ab'
""",
    ),
    sibling(
        "mock",
        "the other file starts a patch of unittest.mock",
        """
        import math

        @node()
        def value() -> Tensor:
            return picture(math.hypot(3, 4))
        """,
        """
from unittest import mock

mock.patch('math.hypot', lambda a, b: 1).start()
""",
        """
from unittest import mock

mock.patch('math.hypot', lambda a, b: 2).start()
""",
    ),
    sibling(
        "helper_of_other",
        "a helper of the other file patches a library; the other file stays",
        """
        @node()
        def value() -> Tensor:
            return picture(np.trapezoid([1.0, 1.0]))
        """,
        "import patches\n",
        "import patches\n",
        **{
            "patches.py": (
                """
import numpy

numpy.trapezoid = lambda values: 1.0
""",
                """
import numpy

numpy.trapezoid = lambda values: 2.0
""",
            )
        },
    ),
    Case(
        "contextvar",
        "the other file sets a context variable of a helper before the node is imported",
        """
        from shared import GAIN

        NOW = GAIN.get()

        @node()
        def value() -> Tensor:
            return picture(NOW)
        """,
        nodes="other.py, own.py",
        files={
            "shared.py": "import contextvars\n\nGAIN = contextvars.ContextVar('gain', default=0)\n",
            "other.py": (
                "from shared import GAIN\n\nGAIN.set(1)\n" + OTHER,
                "from shared import GAIN\n\nGAIN.set(2)\n" + OTHER,
            ),
        },
    ),
    sibling(
        "entry_in_builtins",
        "the other file puts a constant into builtins",
        """
        @node()
        def value() -> Tensor:
            return picture(LAB_GAIN)
        """,
        """
import builtins

builtins.LAB_GAIN = 1
""",
        """
import builtins

builtins.LAB_GAIN = 2
""",
    ),
    sibling(
        "import_hook",
        "the other file puts a module into sys.modules",
        """
        @node()
        def value() -> Tensor:
            import lab_gain

            return picture(lab_gain.GAIN)
        """,
        """
import sys
import types

sys.modules['lab_gain'] = types.SimpleNamespace(GAIN=1)
""",
        """
import sys
import types

sys.modules['lab_gain'] = types.SimpleNamespace(GAIN=2)
""",
    ),
]
