"""Files that own code makes for itself, in a temporary folder or in memory, are no parameters
and need none.
"""

import pytest

from neusee.workflows.keys.source_summary import summarise

HEAD = """
import contextlib, gzip, io, os, tarfile, tempfile, zipfile
from io import BytesIO, StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
import h5py
import numpy as np
import pandas as pd
import torch
from PIL import Image
from glob import glob
TEXT = "1 2"
"""
MADE = {
    "a table in memory": "return np.genfromtxt(io.StringIO(TEXT)), np.loadtxt(StringIO(TEXT)), "
    "pd.read_csv(StringIO(TEXT))",
    "an array in memory": "buffer = BytesIO()\nnp.save(buffer, x)\nbuffer.seek(0)\nreturn np.load(buffer)",
    "a picture in memory": "with Image.open(io.BytesIO(x)) as picture:\n    return picture.size",
    "weights in memory": "buffer: BytesIO = io.BytesIO(b'1')\nreturn torch.load(buffer, weights_only=True)",
    "one of two objects in memory": "b = BytesIO()\nif len(TEXT):\n    b = BytesIO(b'1')\nreturn np.load(b)",
    "a compressed file in memory": "with gzip.open(BytesIO(b'1')) as file:\n    return np.load(file)",
    "an archive in memory": "with zipfile.ZipFile(BytesIO(b'1')) as z:\n"
    "    return np.load(z.open('a.npy')), z.read('b.txt')",
    "an archive by a word": "with tarfile.open(mode='r', fileobj=BytesIO(b'1')) as t:\n"
    "    return t.extractfile('a.txt')",
    "hdf5 in memory": "with BytesIO() as b, h5py.File(b, 'w') as file:\n    pass\n"
    "with h5py.File(b, 'r') as file:\n    return file",
    "a temporary folder": "with tempfile.TemporaryDirectory() as folder:\n    path = Path(folder) / 'a.npy'\n"
    "    np.save(path, x)\n    return np.load(path), path.exists(), path.read_bytes()",
    "a folder by its own name": "with TemporaryDirectory(prefix='a') as d:\n"
    "    return open(os.path.join(d, 'b', 'x.txt')).read()",
    "a folder that stays": "folder = tempfile.mkdtemp()\npath = os.path.join(folder, 'x.txt')\nreturn np.loadtxt(path)",
    "a folder, listed": "d = TemporaryDirectory()\nfound = [np.load(f) for f in sorted(Path(d.name).glob('*.npy'))]\n"
    "return found, glob(f'{d.name}/*.csv'), os.listdir(d.name), list(Path(d.name).iterdir())",
    "a path that is lengthened": "p = Path(tempfile.mkdtemp())\np = p / 'in'\np = p.joinpath('x.csv')\n"
    "return p.read_text()",
    "texts that are added": "d = tempfile.mkdtemp()\nreturn open(d + '/x.txt').read(), open(f'{d}/y.txt').read()",
    "a folder of a stack": "with contextlib.ExitStack() as stack:\n"
    "    d = Path(stack.enter_context(TemporaryDirectory()))\n"
    "    return np.load(d / 'x.npy')",
    "a file by its name": "with tempfile.NamedTemporaryFile(suffix='.h5') as file:\n"
    "    return h5py.File(file.name, 'r')",
    "a file and its number": "number, path = tempfile.mkstemp('.txt')\nos.close(number)\nreturn open(path).read()",
    "in an inner function": "d = tempfile.mkdtemp()\ndef inner():\n    return np.load(Path(d) / 'x.npy')\n"
    "return inner()",
}  # fmt: skip
NOT_MADE = {
    "a file that is read into memory": ("return np.load(BytesIO(open('/data/x').read()))", "open("),
    "a folder that is not new": ("return np.load(Path(tempfile.gettempdir()) / 'x.npy')", "np.load("),
    "the name of a file in a folder that is not new": ("return Path(tempfile.gettempdir()) / 'x.npy'", "'x.npy'"),
    "one of two": ("b = BytesIO()\nif len(TEXT):\n    b = '/data/x'\nreturn np.load(b)", "np.load(b)"),
    "the name of a helper's file": ("return helper(TemporaryDirectory(), 'x.csv')", "'x.csv'"),
    "another name": ("with TemporaryDirectory() as d:\n    return np.load('/data/x'), d", "np.load('/data/x')"),
    "a folder of the module": ("return np.load(FOLDER)", "np.load(FOLDER)"),
    "a function of the name": ("return np.load(mkdtemp())", "np.load(mkdtemp())"),
}  # fmt: skip


def found(body):
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    code = f"{HEAD}\n\ndef value(x_of_no_path=0):\n    x = 1\n{lines}"
    return [
        item.text for item in summarise(code.encode(), own=True).constructs if item.kind == "file"
    ]


@pytest.mark.parametrize("kind", MADE)
def test_a_file_that_a_function_makes_for_itself_is_not_refused(kind):
    assert found(MADE[kind]) == []


@pytest.mark.parametrize("kind", NOT_MADE)
def test_a_file_that_it_may_not_have_made_is(kind):
    body, text = NOT_MADE[kind]
    assert any(each.startswith(text) for each in found(body))
