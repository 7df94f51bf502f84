"""Readers of files that few people would list."""

import dbm.dumb
import gzip
import shelve
import sqlite3
import tarfile
import zipfile
from pathlib import Path

import h5py
import numpy as np
import scipy.io

from unseen_kinds.case import Case

TWO = ("1\n", "2\n")
TABLE = ("400, 1\n410, 1\n420, 1\n", "400, 2\n410, 2\n420, 2\n")


def reads(name: str, about: str, table: str, lines: str, **words) -> Case:
    """Return a case whose node runs a few lines that return a number; `table` is the name of a
    file, as a text.
    """
    indented = "\n".join("    " + line for line in lines.strip("\n").splitlines())
    steps = f"a: {{node: own.value, with: {{table: {table}}}}}"
    return Case(
        name, about, f"@node()\ndef value(*, table: str) -> Tensor:\n{indented}\n", steps, **words
    )


def _shelf(folder: Path, turn: int) -> None:
    with shelve.Shelf(dbm.dumb.open(str(folder / "lab"), "n")) as shelf:
        shelf["gain"] = turn


def _dumb(folder: Path, turn: int) -> None:
    with dbm.dumb.open(str(folder / "lab"), "n") as base:
        base["gain"] = str(turn)


def _zip(folder: Path, turn: int) -> None:
    with zipfile.ZipFile(folder / "lab.zip", "w") as file:
        file.writestr("gain.txt", str(turn))


def _tar(folder: Path, turn: int) -> None:
    (folder / "gain.txt").write_text(str(turn))
    with tarfile.open(folder / "lab.tar", "w") as file:
        file.add(folder / "gain.txt", "gain.txt")
    (folder / "gain.txt").unlink()


def _database(folder: Path, turn: int) -> None:
    base = sqlite3.connect(folder / "lab.db")
    base.executescript(
        "drop table if exists gains; create table gains (gain real); insert into gains values"
        f" ({turn})"
    )
    base.close()


def _hdf(folder: Path, turn: int) -> None:
    with h5py.File(folder / "lab.h5", "w") as file:
        file["gain"] = float(turn)


CASES = [
    reads(
        "configparser",
        "an INI file of the laboratory",
        "lab.ini",
        """
import configparser

lab = configparser.ConfigParser()
lab.read(table)
return picture(lab["camera"]["gain"])
""",
        files={"lab.ini": ("[camera]\ngain = 1\n", "[camera]\ngain = 2\n")},
    ),
    reads(
        "fsspec_local",
        "fsspec.open",
        "gain.txt",
        """
import fsspec

with fsspec.open(f"file://{os.path.abspath(table)}", "r") as file:
    return picture(file.read())
""",
        files={"gain.txt": TWO},
    ),
    reads(
        "fromregex",
        "np.fromregex over a log of the instrument",
        "lab.log",
        """
found = np.fromregex(table, r"gain=(\\d+)", [("gain", float)])
return picture(found["gain"][0])
""",
        files={"lab.log": ("gain=1\n", "gain=2\n")},
    ),
    reads(
        "matrix_market",
        "scipy.io.mmread",
        "lab.mtx",
        """
import scipy.io

return picture(scipy.io.mmread(table).sum())
""",
        make=lambda folder, turn: scipy.io.mmwrite(
            folder / "lab.mtx", np.full((1, 1), float(turn))
        ),
    ),
    reads(
        "colour_table",
        "colour.read_sds_from_csv_file",
        "lab.csv",
        """
import colour

return picture(colour.read_sds_from_csv_file(table)["gain"].values.mean())
""",
        files={
            "lab.csv": (
                "wavelength,gain\n400,1\n410,1\n420,1\n430,1\n440,1\n450,1\n",
                "wavelength,gain\n400,2\n410,2\n420,2\n430,2\n440,2\n450,2\n",
            )
        },
    ),
    reads(
        "shelve_of_lab",
        "shelve",
        "lab",
        """
import dbm.dumb
import shelve

with shelve.Shelf(dbm.dumb.open(table, "r")) as shelf:
    return picture(shelf["gain"])
""",
        make=_shelf,
    ),
    reads(
        "process_cat",
        "another program reads the file",
        "gain.txt",
        """
from subprocess import check_output as ask

return picture(ask(["cat", table]))
""",
        files={"gain.txt": TWO},
    ),
    reads(
        "popen_of_os",
        "os.popen",
        "gain.txt",
        """
with os.popen(f"cat {table}") as pipe:
    return picture(pipe.read())
""",
        files={"gain.txt": TWO},
    ),
    reads(
        "dumb_database",
        "dbm",
        "lab",
        """
import dbm.dumb as base

with base.open(table, "r") as lab:
    return picture(lab["gain"])
""",
        make=_dumb,
    ),
    reads(
        "zip_member",
        "a member of a zip file",
        "lab.zip",
        """
import zipfile

with zipfile.ZipFile(table) as lab:
    return picture(lab.read("gain.txt"))
""",
        make=_zip,
    ),
    reads(
        "tar_member",
        "a member of a tar file",
        "lab.tar",
        """
import tarfile

with tarfile.open(table) as lab:
    return picture(lab.extractfile("gain.txt").read())
""",
        make=_tar,
    ),
    reads(
        "gzip_text",
        "gzip.open",
        "gain.gz",
        """
import gzip as squeezed

with squeezed.open(table, "rt") as file:
    return picture(file.read())
""",
        make=lambda folder, turn: (folder / "gain.gz").write_bytes(
            gzip.compress(str(turn).encode())
        ),
    ),
    reads(
        "database",
        "sqlite3",
        "lab.db",
        """
import sqlite3

base = sqlite3.connect(table)
((gain,),) = base.execute("select gain from gains")
base.close()
return picture(gain)
""",
        make=_database,
    ),
    reads(
        "hdf_native",
        "HDF5, whose library opens files itself",
        "lab.h5",
        """
import h5py

with h5py.File(table) as lab:
    return picture(lab["gain"][()])
""",
        make=_hdf,
    ),
    reads(
        "memory_map",
        "np.memmap",
        "lab.bin",
        """
return picture(np.memmap(table, dtype=np.float32, mode="r")[0])
""",
        make=lambda folder, turn: np.full(1, turn, np.float32).tofile(folder / "lab.bin"),
    ),
    reads(
        "pandas_table",
        "pandas.read_csv, and another engine",
        "lab.csv",
        """
import pandas

return picture(pandas.read_csv(table, engine="python")["gain"].sum())
""",
        files={"lab.csv": ("gain\n1\n", "gain\n2\n")},
    ),
    reads(
        "run_as_script",
        "runpy runs a settings file of Python",
        "settings.txt",
        """
import runpy

return picture(runpy.run_path(table)["GAIN"])
""",
        files={"settings.txt": ("GAIN = 1\n", "GAIN = 2\n")},
    ),
    reads(
        "module_from_a_path",
        "importlib loads a file as a module",
        "settings.py",
        """
import importlib.util

spec = importlib.util.spec_from_file_location("lab_settings", table)
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
return picture(module.GAIN)
""",
        files={"settings.py": ("GAIN = 1\n", "GAIN = 2\n")},
    ),
    reads(
        "rasters_of_pillow",
        "PIL",
        "lab.pgm",
        """
from PIL import Image

with Image.open(table) as lab:
    return picture(np.asarray(lab).mean())
""",
        files={"lab.pgm": (b"P5 1 1 255\n\x01", b"P5 1 1 255\n\x02")},
    ),
]
