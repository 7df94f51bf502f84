"""Nodes of a user that read what their key does not cover: refused before the run, or used and
never stored.

Each kind stands with the code of its node; `{place}` is a folder with files that no key covers.
Honest nodes, which are stored, stand beside them.
"""

import shutil
import sys
import textwrap
from contextlib import closing

import numpy as np
import pytest

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import RunError
from neusee.workflows.keys import user_code as tainted_code
from neusee.workflows.keys.cache_key import is_private
from neusee.workflows.store.result_store import Store

#: imports, helpers and the expression of the value, by kind; `place` is an argument of the node
UNSEEN = {
    "a path that is formatted": ("", "", "float(open(f'{place}/one.txt').read())"),
    "a path that is joined": (
        "import os",
        "",
        "float(open(os.path.join(place, 'one' + '.txt')).read())",
    ),
    "a path in a dictionary": ("", "", "float(open({'a': place + '/one.txt'}['a']).read())"),
    "a path by a helper": (
        "",
        "def path(x): return x + '/one' + '.txt'",
        "float(open(path(place)).read())",
    ),
    "a sidecar": (
        "from pathlib import Path",
        "",
        "float(Path(place, 'one.hdr').with_suffix('.txt').read_text())",
    ),
    "os.open": ("import os", "", "float(os.read(os.open(f'{place}/one.txt', os.O_RDONLY), 9))"),
    "configparser": (
        "import configparser",
        (
            "def read(x):\n    c = configparser.ConfigParser()\n    c.read(x)\n    return"
            " float(c['a']['b'])"
        ),
        "read(f'{place}/one.ini')",
    ),
    "np.fromregex": (
        "import numpy as np",
        "",
        "float(np.fromregex(f'{place}/one.txt', r'(\\d+)', [('n', 'f8')])['n'][0])",
    ),
    "np.genfromtxt": ("import numpy as np", "", "float(np.genfromtxt(f'{place}/one.txt'))"),
    "np.memmap": (
        "import numpy as np",
        "",
        "float(np.memmap(f'{place}/one.bin', dtype='f8', mode='r')[0])",
    ),
    "scipy.io.mmread": (
        "from scipy.io import mmread",
        "",
        "float(mmread(f'{place}/one.mtx').toarray()[0, 0])",
    ),
    "torch.from_file": (
        "import torch",
        "",
        "float(torch.from_file(f'{place}/one.bin', size=1, dtype=torch.float64)[0])",
    ),
    "sqlite3": (
        "import sqlite3",
        "",
        "float(sqlite3.connect(f'{place}/one.db').execute('select x from t').fetchone()[0])",
    ),
    "shelve": ("import shelve", "", "float(shelve.open(f'{place}/shelf', 'r')['x'])"),
    "zipfile": ("import zipfile", "", "float(zipfile.ZipFile(f'{place}/one.zip').read('one.txt'))"),
    "fileinput": (
        "import fileinput",
        "",
        "float(next(iter(fileinput.input([f'{place}/one.txt']))))",
    ),
    "linecache": ("import linecache", "", "float(linecache.getline(f'{place}/one.txt', 1))"),
    "mmap": (
        "import mmap",
        (
            "def read(x):\n    f = open(x, 'rb')\n    return float(mmap.mmap(f.fileno(), 0,"
            " prot=mmap.PROT_READ)[:])"
        ),
        "read(f'{place}/one.txt')",
    ),
    "a native reader": (
        "import ctypes",
        (
            "def read(x):\n"
            "    libc = ctypes.PyDLL(None)\n"
            "    libc.fopen.restype = ctypes.c_void_p\n"
            "    libc.fgetc.argtypes = [ctypes.c_void_p]\n"
            "    return float(libc.fgetc(libc.fopen(x.encode(), b'r')))"
        ),
        "read(f'{place}/one.txt')",
    ),
    "a thread": (
        "from concurrent.futures import ThreadPoolExecutor",
        "def read(x): return float(open(x).read())",
        "ThreadPoolExecutor(1).submit(read, f'{place}/one.txt').result()",
    ),
    "whether a file exists": ("import os", "", "float(os.path.exists(f'{place}/one.txt'))"),
    "the size of a file": ("import os", "", "float(os.stat(f'{place}/one.txt').st_size)"),
    "a listed folder": ("import os", "", "float(len(os.listdir(place)))"),
    "glob": ("import glob", "", "float(len(glob.glob(f'{place}/*.txt')))"),
    "a process": (
        "import subprocess",
        "",
        "float(subprocess.check_output(['cat', f'{place}/one.txt']))",
    ),
    "os.popen": ("import os", "", "float(os.popen(f'cat {place}/one.txt').read())"),
    "a memo": (
        "import functools",
        "@functools.cache\ndef read(x): return float(open(x).read())",
        "read(f'{place}/one.txt')",
    ),
    "torch.poisson": ("import torch", "", "float(torch.poisson(torch.ones(1)))"),
    "torch.randn": ("import torch", "", "float(torch.randn(1))"),
    "default_rng": ("import numpy as np", "", "float(np.random.default_rng().normal())"),
    "np.random": ("from numpy import random as draw", "", "float(draw.normal())"),
    "rvs of scipy": ("from scipy import stats", "", "float(stats.norm.rvs())"),
    "random": ("import random as draw", "", "draw.random()"),
    "os.urandom": ("import os", "", "float(os.urandom(1)[0])"),
    "secrets": ("import secrets", "", "float(secrets.randbelow(9))"),
    "a module that is computed": (
        "import importlib",
        "",
        "float(importlib.import_module('one_' + 'hidden').VALUE)",
    ),
}
HONEST = {
    "arithmetic": ("", "", "3.0"),
    "a lazy import": (
        "",
        "def f():\n    from scipy.special import gamma\n    return float(gamma(4))",
        "f()",
    ),
    "a seeded generator": ("import numpy as np", "", "float(np.random.default_rng(3).normal())"),
    "a generator of torch": (
        "import torch",
        "",
        "float(torch.randn(1, generator=torch.Generator().manual_seed(3)))",
    ),
    "a temporary file": (
        "import tempfile",
        (
            "def f():\n"
            "    with tempfile.NamedTemporaryFile('w+') as file:\n"
            "        file.write('4')\n"
            "        file.seek(0)\n"
            "        return float(file.read())"
        ),
        "f()",
    ),
    "an FFT": ("import torch", "", "float(torch.fft.fft(torch.ones(64)).abs().max())"),
    "a linear system": (
        "import numpy as np",
        "",
        "float(np.linalg.solve(np.eye(3), np.ones(3))[0])",
    ),
    "threads that compute": (
        "from concurrent.futures import ThreadPoolExecutor",
        "def f(): return sum(ThreadPoolExecutor(2).map(abs, [1, -2]))",
        "float(f())",
    ),
    "a warning": (
        "import warnings",
        "def f():\n    warnings.warn('a word', stacklevel=1)\n    return 2.0",
        "f()",
    ),
    "an error that is caught": (
        "",
        (
            "def f():\n    try:\n        return 1 / 0\n    except ZeroDivisionError:\n       "
            " return 5.0"
        ),
        "f()",
    ),
}
NODE = """
from torch import Tensor
{imports}
import torch

from neusee.nodes import node

{helpers}


@node()
def value(*, place: str) -> Tensor:
    return torch.full((1,), {value}, dtype=torch.float64)
"""
_count = iter(range(10**6))


@pytest.fixture
def place(tmp_path):
    """A folder with a file of each format."""
    import shelve
    import sqlite3
    import zipfile

    (tmp_path / "one.txt").write_text("7")
    (tmp_path / "one.ini").write_text("[a]\nb = 7\n")
    (tmp_path / "one.mtx").write_text(
        "%%MatrixMarket matrix coordinate real general\n1 1 1\n1 1 7.0\n"
    )
    (tmp_path / "one_hidden.py").write_text("VALUE = 7\n")
    np.array([7.0]).tofile(tmp_path / "one.bin")
    with closing(sqlite3.connect(tmp_path / "one.db")) as base, base:
        base.execute("create table t (x real)")
        base.execute("insert into t values (7)")
    with shelve.open(str(tmp_path / "shelf")) as shelf:
        shelf["x"] = 7
    with zipfile.ZipFile(tmp_path / "one.zip", "w") as packed:
        packed.writestr("one.txt", "7")
    yield tmp_path
    shutil.rmtree(tmp_path, ignore_errors=True)


def run_node(place, parts, lab):
    """The key of a run of a node of its own module, or None where the node is refused."""
    imports, helpers, value = parts
    name = f"unseen_{next(_count)}"
    lab.mkdir(exist_ok=True)
    (lab / f"{name}.py").write_text(
        NODE.format(imports=imports, helpers=textwrap.dedent(helpers), value=value)
    )
    (lab / "own.yaml").write_text(
        f"nodes: [./{name}.py]\nseed: 1\ntolerance: 1e-3\noutputs: [it]\nsteps:\n"
        f"  it: {{node: {name}.value, with: {{place: {place}}}}}\n"
    )
    sys.path.append(str(place))
    try:
        result = run(load("own.yaml", [], lab), Store(lab / "cache"))
    except RunError as error:
        if "a cache key cannot see it" in str(error):
            return None
        raise
    finally:
        sys.path.remove(str(place))
        sys.modules.pop(name, None)
        sys.modules.pop("one_hidden", None)
        tainted_code._taints.pop(name, None)
    assert result["it"].isfinite().all()
    return result.keys["it"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", UNSEEN)
def test_what_a_key_does_not_cover_is_refused_or_not_stored(kind, place, tmp_path_factory):
    key = run_node(place, UNSEEN[kind], tmp_path_factory.mktemp("lab"))
    assert key is None or is_private(key)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", HONEST)
def test_an_honest_node_is_stored(kind, place, tmp_path_factory):
    lab = tmp_path_factory.mktemp("lab")
    key = run_node(place, HONEST[kind], lab)
    assert key is not None
    assert not is_private(key)
