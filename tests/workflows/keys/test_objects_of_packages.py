"""Objects of installed packages in an own module: whatever their methods do, the key is made,
and is the same again.
"""

import re

import pytest

from tests.workflows.keys.forked_keys import told

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
OBJECTS = (
    "Hostile",
    "Hostile()",
    "Number(2)",
    "Answering()",
    "Unplaced()",
    "[Number(2), {1: Hostile()}]",
)
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


def write(folder, before, result="str(held)"):
    folder.mkdir(exist_ok=True)
    (folder / "mine.py").write_text(NODE.format(before=before, result=result))


def is_key(text):
    return re.fullmatch(r"[0-9a-f]{32}", text) is not None


@pytest.fixture
def package(tmp_path):
    """A folder with an installed package of hostile classes."""
    (tmp_path / "hostile-1.0.dist-info").mkdir()
    (tmp_path / "hostile-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: hostile\nVersion: 1.0\n"
    )
    (tmp_path / "hostile-1.0.dist-info" / "RECORD").write_text("hostile/__init__.py,,\n")
    (tmp_path / "hostile").mkdir()
    (tmp_path / "hostile" / "__init__.py").write_text(HOSTILE)
    return tmp_path


@pytest.mark.slow
def test_objects_whose_methods_all_fail_count_by_their_class(package):
    imports = "from hostile import Answering, Hostile, Number, Unplaced\n"
    held = "".join(f"held_{n} = {text}\n" for n, text in enumerate(OBJECTS))
    lines = (
        f"{imports}{held}\n\ndef held():\n    return"
        f" [{', '.join(f'held_{n}' for n in range(len(OBJECTS)))}]\n"
    )
    write(package, lines, "len(held())")
    [first] = told(package)
    assert is_key(first), first
    assert told(package, seed="2") == [first]


@pytest.mark.slow
def test_a_key_of_quantities_and_units_is_the_same_in_each_process(tmp_path):
    pytest.importorskip("astropy")
    folders = [tmp_path / str(number) for number in range(len(QUANTITIES))]
    for folder, before in zip(folders, QUANTITIES.values(), strict=True):
        write(folder, before)
    first, again = told(*folders), told(*folders, seed="2")
    found = dict(zip(QUANTITIES, zip(first, again, strict=True), strict=True))
    assert {kind: keys for kind, keys in found.items() if not is_key(keys[0])} == {}
    assert {kind: keys for kind, keys in found.items() if keys[0] != keys[1]} == {}


@pytest.mark.slow
def test_an_array_of_objects_counts_by_what_it_holds(tmp_path):
    folders = []

    def held(line, fill="2.0"):
        folders.append(tmp_path / str(len(folders)))
        write(folders[-1], f"import numpy as np\nfrom held_table import T\nT[0] = {fill}", "str(T)")
        (folders[-1] / "held_table.py").write_text(
            f"import numpy as np\n\n\ndef part(x):\n    return x\n\n\n{line}\n"
        )

    held("T = np.array([1, part, None], dtype=object)")
    held("T = np.array([1, part, None], dtype=object)")
    held("T = np.array([1, part, None], dtype=object)", "3.0")
    held("T = np.ma.array([1.0, 2.0, 3.0])")
    held("T = np.ma.array([1.0, 2.0, 3.0])", "np.ma.masked")
    functions, same, other, masked, hidden = told(*folders)
    assert is_key(functions), functions
    assert same == functions
    assert other != functions
    assert is_key(masked), masked
    assert hidden != masked


@pytest.mark.slow
def test_own_objects_whose_parts_cannot_be_read_are_refused_with_place_and_fix(tmp_path):
    before = (
        "class Part(dict):\n    def items(self):\n        raise OSError('not now')\n\n\nheld = {}"
    )
    parts, deep = tmp_path / "parts", tmp_path / "deep"
    write(parts, before.format("[Part()]"))
    write(deep, "held = []\nfor _ in range(100_000):\n    held = [held]", "len(held)")
    found, nested = told(parts, deep)
    assert (
        "mine.py: held is or holds a Part, which could not be read (OSError: not now), and a"
        " cache key" in found
    )
    assert 'depends=["unaffected:held"]' in found
    assert "mine.py: held is or holds a list, which is nested too deeply" in nested
