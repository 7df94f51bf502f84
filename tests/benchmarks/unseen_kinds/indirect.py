"""Parameters that are read rightly, but lead to something else: links, parts, journals, and own
source as data.
"""

import os
import sqlite3
import subprocess
import sysconfig
from pathlib import Path

import h5py
import numpy as np
import tifffile

from unseen_kinds.case import Case


def through(name: str, about: str, header: str, lines: str, **words) -> Case:
    """Return a case whose node runs lines on its parameter `header` and returns a number."""
    indented = "\n".join("    " + line for line in lines.strip("\n").splitlines())
    steps = f"a: {{node: own.value, with: {{header: {header}}}}}"
    return Case(
        name,
        about,
        f"@node()\ndef value(*, header: DataFile) -> Tensor:\n{indented}\n",
        steps,
        **words,
    )


def _linked(folder: Path, turn: int) -> None:
    with h5py.File(folder / "data.h5", "w") as file:
        file["gain"] = float(turn)
    if turn == 1:
        with h5py.File(folder / "lab.h5", "w") as file:
            file["gain"] = h5py.ExternalLink("data.h5", "gain")


def _virtual(folder: Path, turn: int) -> None:
    with h5py.File(folder / "data.h5", "w") as file:
        file["gain"] = np.full(3, float(turn))
    if turn == 1:
        layout = h5py.VirtualLayout((3,), float)
        layout[:] = h5py.VirtualSource("data.h5", "gain", (3,))
        with h5py.File(folder / "lab.h5", "w") as file:
            file.create_virtual_dataset("gain", layout)


def _external(folder: Path, turn: int) -> None:
    np.full(3, float(turn)).tofile(folder / "raw.bin")
    if turn == 1:
        with h5py.File(folder / "lab.h5", "w") as file:
            file.create_dataset("gain", (3,), float, external=[(str(folder / "raw.bin"), 0, 24)])


def _journal(folder: Path, turn: int) -> None:
    base = sqlite3.connect(folder / "live.db")
    base.execute("pragma journal_mode = wal")
    base.execute("pragma wal_autocheckpoint = 0")
    if turn == 1:
        base.executescript(
            "create table gains (gain real); insert into gains values (1); pragma"
            " wal_checkpoint(truncate)"
        )
    else:
        base.execute("update gains set gain = 2")
        base.commit()
    for end in ("", "-wal"):
        if (folder / f"live.db{end}").exists():
            (folder / f"lab.db{end}").write_bytes((folder / f"live.db{end}").read_bytes())
    base.close()


def _series(folder: Path, turn: int) -> None:
    paths = [folder / "lab_0.tif", folder / "lab_1.tif"]
    if turn == 1:
        tifffile.imwrite(paths[0], np.full((4, 4), 1, np.uint8))
    tifffile.imwrite(paths[1], np.full((4, 4), turn, np.uint8))


def _link(folder: Path, turn: int) -> None:
    (folder / "one").write_text("1")
    (folder / "three").write_text("1")
    (folder / "lab.txt").unlink(missing_ok=True)
    os.symlink("one" if turn == 1 else "three", folder / "lab.txt")


def _compiled(folder: Path, turn: int) -> None:
    (folder / "lab.c").write_text(f"int gain(void) {{ return {turn}; }}")
    (folder / "lab.so").unlink(missing_ok=True)
    subprocess.run(["cc", "-shared", "-fPIC", "lab.c", "-o", "lab.so"], cwd=folder, check=True)


_MODULE = """
#include <Python.h>
static PyObject *gain(PyObject *self, PyObject *none) { return PyLong_FromLong(TURN); }
static PyMethodDef methods[] = {{"gain", gain, METH_NOARGS, ""}, {0}};
static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "labc", "", -1, methods};
PyMODINIT_FUNC PyInit_labc(void) { return PyModule_Create(&module); }
"""


def _extension(folder: Path, turn: int) -> None:
    (folder / "labc.c").write_text(_MODULE.replace("TURN", str(turn)))
    (folder / "labc.so").unlink(missing_ok=True)
    include = "-I" + sysconfig.get_path("include")
    subprocess.run(
        ["cc", "-shared", "-fPIC", include, "labc.c", "-o", "labc.so"], cwd=folder, check=True
    )


CASES = [
    through(
        "external_link_of_hdf",
        "a link of HDF5 to another file",
        "lab.h5",
        """
import h5py

with h5py.File(header) as lab:
    return picture(lab["gain"][()])
""",
        make=_linked,
    ),
    through(
        "virtual_dataset_of_hdf",
        "a virtual dataset over another file",
        "lab.h5",
        """
import h5py

with h5py.File(header) as lab:
    return picture(lab["gain"][0])
""",
        make=_virtual,
    ),
    through(
        "external_storage_of_hdf",
        "a dataset whose numbers are in a raw file",
        "lab.h5",
        """
import h5py

with h5py.File(header) as lab:
    return picture(lab["gain"][0])
""",
        make=_external,
    ),
    through(
        "journal_of_database",
        "a database whose newest rows are in its journal",
        "lab.db",
        """
import sqlite3

base = sqlite3.connect(str(header))
((gain,),) = base.execute("select gain from gains")
base.close()
return picture(gain)
""",
        make=_journal,
    ),
    through(
        "series_of_tiff",
        "a pattern from the name of the parameter",
        "lab_0.tif",
        """
import tifffile

return picture(tifffile.imread(str(header)[:-5] + "*.tif").sum())
""",
        make=_series,
    ),
    through(
        "name_of_target",
        "the name to which the parameter leads",
        "lab.txt",
        "return picture(len(Path(header).resolve().name))",
        make=_link,
    ),
    through(
        "folder_above",
        "the name of the folder of the recipe",
        "lab.txt",
        "return picture(Path(header).absolute().parent.stat().st_nlink)",
        files={"lab.txt": "1", "new/x": (None, "1")},
    ),
    through(
        "attached_database",
        "a database that attaches another one",
        "lab.sql",
        """
import sqlite3

base = sqlite3.connect(":memory:")
base.executescript(Path(header).read_text())
return picture(base.execute("select count(*) from other.sqlite_master").fetchone()[0])
""",
        files={"lab.sql": "attach database 'other.db' as other;"},
        make=lambda folder, turn: (
            turn == 2
            and sqlite3.connect(folder / "other.db").execute("create table gains (gain real)")
        ),
    ),
    through(
        "yaml_with_include",
        "a YAML file with an include",
        "lab.yaml",
        """
import yaml

class Loader(yaml.SafeLoader):
    pass

Loader.add_constructor("!include", lambda loader, item: (Path(header).parent / item.value).read_text())
return picture(yaml.load(Path(header).read_text(), Loader)["gain"])
""",
        files={"lab.yaml": "gain: !include gain", "gain": ("1", "2")},
    ),
    Case(
        "own_comments",
        "a node whose comments are data, which a library reads",
        """
        import inspect

        def table():
            return 0  # the gain: PAIR

        @node()
        def value() -> Tensor:
            import pydoc

            return picture(len(getattr(inspect, "getsource" + "lines")(table)[0]))
        """,
        make=lambda folder, turn: (folder / "own.py").write_text(
            (folder / "own.py")
            .read_text()
            .replace("PAIR", "1")
            .replace("return 0  #", "# more\n    return 0  #" if turn == 2 else "return 0  #")
        ),
    ),
    Case(
        "declared_folder_grows",
        "a file that is added to a folder below a declared one",
        """
        @node(depends=["set"])
        def value() -> Tensor:
            return picture(sum(1 for _ in os.walk("set")))
        """,
        files={"set/keep": "", "set/new/x": (None, "")},
    ),
    Case(
        "declared_link",
        "a declared file is a link that leads elsewhere",
        """
        @node(depends=["lab.txt"])
        def value() -> Tensor:
            return picture(len(os.readlink("lab.txt")))
        """,
        make=_link,
    ),
    Case(
        "compiled_extension",
        "a library in C that is compiled anew",
        """
        import ctypes

        @node()
        def value(*, name: str) -> Tensor:
            return picture(ctypes.cdll.LoadLibrary(os.path.abspath(name)).gain())
        """,
        "a: {node: own.value, with: {name: lab.so}}",
        make=_compiled,
    ),
    Case(
        "compiled_module",
        "a module of C beside the node",
        """
        @node()
        def value() -> Tensor:
            import labc

            return picture(labc.gain())
        """,
        make=_extension,
    ),
    Case(
        "thread_at_import",
        "a thread that the module starts reads a file when it likes",
        """
        import threading
        import time

        BOX = []

        def watch():
            time.sleep(0.3)
            BOX.append(open("gain").read())

        WATCHER = threading.Thread(target=watch, daemon=True)
        WATCHER.start()

        @node()
        def value() -> Tensor:
            WATCHER.join()
            return picture(BOX[0])
        """,
        files={"gain": ("1", "2")},
    ),
    Case(
        "open_file_of_module",
        "a file that the module opens and the node reads",
        """
        FILE = open("gain")

        @node()
        def value() -> Tensor:
            FILE.seek(0)
            return picture(FILE.read())
        """,
        files={"gain": ("1", "2")},
    ),
    Case(
        "read_by_numba_style_cache",
        "a memo on the disk of an earlier run",
        """
        import functools
        import pickle

        def on_disk(function):
            @functools.wraps(function)
            def wrapped(x):
                path = Path(".memo") / str(x)
                if not path.exists():
                    path.parent.mkdir(exist_ok=True)
                    path.write_bytes(pickle.dumps(function(x)))
                return float(np.load(path, allow_pickle=True))

            return wrapped

        @on_disk
        def slow(x):
            return x * 2

        @node()
        def value(*, x: int = 1) -> Tensor:
            return picture(slow(x))
        """,
        files={".memo/1": (b"\x80\x04K\x05.", b"\x80\x04K\x06.")},
    ),
    Case(
        "asyncio_in_node",
        "a file that a thread of asyncio reads",
        """
        import asyncio

        @node()
        def value(*, name: str) -> Tensor:
            return picture(asyncio.run(asyncio.to_thread(Path(name).read_text)))
        """,
        "a: {node: own.value, with: {name: gain}}",
        files={"gain": ("1", "2")},
    ),
    Case(
        "url_of_file",
        "urllib opens a file",
        """
        from urllib.request import urlopen

        @node()
        def value(*, name: str) -> Tensor:
            return picture(urlopen("file://" + os.path.abspath(name)).read())
        """,
        "a: {node: own.value, with: {name: gain}}",
        files={"gain": ("1", "2")},
    ),
    Case(
        "fork_reads",
        "a child process by os.fork reads the file",
        """
        @node()
        def value(*, name: str) -> Tensor:
            end, start = os.pipe()
            if os.fork() == 0:
                os.write(start, Path(name).read_bytes())
                os._exit(0)
            os.wait()
            return picture(os.read(end, 10))
        """,
        "a: {node: own.value, with: {name: gain}}",
        files={"gain": ("1", "2")},
    ),
    Case(
        "preflight_reads",
        "the check before the run reads the file and leaves its number",
        """
        LIMIT = {}

        @node()
        def value(*, name: str) -> Tensor:
            return picture(LIMIT[name])

        @value.preflight
        def _(*, name: str) -> list[str]:
            LIMIT[name] = float(np.loadtxt(name))
            return []
        """,
        "a: {node: own.value, with: {name: gain}}",
        files={"gain": ("1", "2")},
    ),
    Case(
        "metaclass_and_import",
        "a metaclass reads the table when the class is made",
        """
        class Table(type):
            def __new__(kind, name, bases, space):
                space["gain"] = float(np.loadtxt(name.lower()))
                return super().__new__(kind, name, bases, space)

        class Gain(metaclass=Table):
            pass

        @node()
        def value() -> Tensor:
            return picture(Gain.gain)
        """,
        files={"gain": ("1", "2")},
    ),
    Case(
        "lazy_module_getattr",
        "a module with __getattr__ reads the table when it is asked",
        """
        import tables

        @node()
        def value() -> Tensor:
            return picture(tables.gain)
        """,
        files={
            "tables.py": (
                "import numpy\n\n\ndef __getattr__(name):\n    return float(numpy.loadtxt(name))\n"
            ),
            "gain": ("1", "2"),
        },
    ),
]
