"""Objects of installed packages in an own module: whatever their methods do, the key is made, and is the same again."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
KEY = """
import sys
from pathlib import Path
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.node_families import import_own
value = import_own("mine.py", Path.cwd()).value
print(Code(Path("code.json")).of(value))
"""
NODE = "from neusee.nodes import node\n{before}\n\n\n@node()\ndef value():\n    return {result}\n"
#: a class of which every method raises, but for those by which it is made
HOSTILE = """
class Hostile(list):
    def __getattribute__(self, name):
        raise RuntimeError("no attributes")

    def refuse(self, *given):
        raise RuntimeError("no")

    __eq__ = __bool__ = __len__ = __iter__ = __repr__ = __str__ = __reduce_ex__ = __deepcopy__ = refuse
    __contains__ = __getitem__ = __call__ = refuse

    def __hash__(self):
        raise RuntimeError("no hash")


class Number(float):
    def __repr__(self):
        raise RuntimeError("no text")


class Answering:
    def __getattr__(self, name):
        return Answering()

    def __call__(self, *given):
        return Answering()


class Unplaced:
    pass


Unplaced.__module__ = 3
"""
OBJECTS = ("Hostile", "Hostile()", "Number(2)", "Answering()", "Unplaced()", "[Number(2), {1: Hostile()}]")
QUANTITIES = {
    "a constant": "from astropy.constants import c as held",
    "a unit": "from astropy.units import nm as held",
    "a quantity": "from astropy import units as u\nheld = 3.0 * u.m",
    "quantities that do not stand in one piece": "import numpy as np\nfrom astropy import units as u\n"
    "held = (np.arange(6.0).reshape(2, 3) * u.nm).T",
    "quantities by name": "from astropy import units as u\nheld = {'a': [[1, 2] * u.nm][0][::-1]}",
    "a model": "from astropy.modeling.models import Gaussian1D\nheld = Gaussian1D(2.0, 0.0, 1.0)",
    "a table": "from astropy.table import Table\nheld = Table({'a': [1.0, 2.0]})",
    "places": "from astropy import units as u\nfrom astropy.coordinates import SkyCoord\n"
    "held = SkyCoord(1 * u.deg, 2 * u.deg)",
}  # fmt: skip


def told(folder):
    """The key of the node in a folder, made in a new process, or the last line of its error."""
    path = os.pathsep.join([str(folder), str(ROOT / ".src")])
    env = {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    env.pop("PYTHONHASHSEED", None)
    done = subprocess.run([sys.executable, "-c", KEY], env=env, cwd=folder, capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else done.stderr.strip().splitlines()[-1]


def write(folder, before, result="str(held)"):
    (folder / "mine.py").write_text(NODE.format(before=before, result=result))


def is_key(text):
    return re.fullmatch(r"[0-9a-f]{32}", text) is not None


@pytest.fixture
def package(tmp_path):
    """A folder with an installed package of hostile classes."""
    (tmp_path / "hostile-1.0.dist-info").mkdir()
    (tmp_path / "hostile-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: hostile\nVersion: 1.0\n")
    (tmp_path / "hostile-1.0.dist-info" / "RECORD").write_text("hostile/__init__.py,,\n")
    (tmp_path / "hostile").mkdir()
    (tmp_path / "hostile" / "__init__.py").write_text(HOSTILE)
    return tmp_path


def test_objects_whose_methods_all_fail_count_by_their_class(package):
    imports = "from hostile import Answering, Hostile, Number, Unplaced\n"
    held = "".join(f"held_{n} = {text}\n" for n, text in enumerate(OBJECTS))
    lines = f"{imports}{held}\n\ndef held():\n    return [{', '.join(f'held_{n}' for n in range(len(OBJECTS)))}]\n"
    write(package, lines, "len(held())")
    first = told(package)
    assert is_key(first), first
    assert told(package) == first


@pytest.mark.parametrize("kind", QUANTITIES)
def test_a_key_of_quantities_and_units_is_the_same_in_each_process(kind, tmp_path):
    pytest.importorskip("astropy")
    write(tmp_path, QUANTITIES[kind])
    first = told(tmp_path)
    assert is_key(first), first
    assert told(tmp_path) == first


def test_an_array_of_objects_counts_by_what_it_holds(tmp_path):
    def key(line, fill="2.0"):
        (tmp_path / "held_table.py").write_text(f"import numpy as np\n\n\ndef part(x):\n    return x\n\n\n{line}\n")
        write(tmp_path, f"import numpy as np\nfrom held_table import T\nT[0] = {fill}", "str(T)")
        return told(tmp_path)

    functions = key("T = np.array([1, part, None], dtype=object)")
    assert is_key(functions)
    assert key("T = np.array([1, part, None], dtype=object)") == functions
    assert key("T = np.array([1, part, None], dtype=object)", "3.0") != functions
    masked = key("T = np.ma.array([1.0, 2.0, 3.0])")
    assert is_key(masked)
    assert key("T = np.ma.array([1.0, 2.0, 3.0])", "np.ma.masked") != masked


def test_own_objects_whose_parts_cannot_be_read_are_refused_with_place_and_fix(tmp_path):
    before = "class Part(dict):\n    def items(self):\n        raise OSError('not now')\n\n\nheld = {}"
    write(tmp_path, before.format("[Part()]"))
    found = told(tmp_path)
    assert "mine.py: held is or holds a Part, which could not be read (OSError: not now), and a cache key" in found
    assert 'depends=["unaffected:held"]' in found
    write(tmp_path, "held = []\nfor _ in range(100_000):\n    held = [held]", "len(held)")
    assert "mine.py: held is or holds a list, which is nested too deeply" in told(tmp_path)
