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


def reads(name: str, about: str, lines: str, **words) -> Case:
    """Return a case whose node runs a few lines that return a number; `place` is the folder of the lab."""
    indented = "\n".join("    " + line for line in lines.strip("\n").splitlines())
    code = f'@node()\ndef value(*, place: str = ".") -> Tensor:\n{indented}\n'
    return Case(name, about, code, **words)


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
    base.executescript(f"drop table if exists gains; create table gains (gain real); insert into gains values ({turn})")
    base.close()


def _hdf(folder: Path, turn: int) -> None:
    with h5py.File(folder / "lab.h5", "w") as file:
        file["gain"] = float(turn)


CASES = [
    reads(
        "configparser",
        "an INI file of the laboratory",
        """
import configparser

lab = configparser.ConfigParser()
lab.read(place + "/lab.ini")
return picture(lab["camera"]["gain"])
""",
        files={"lab.ini": ("[camera]\ngain = 1\n", "[camera]\ngain = 2\n")},
    ),
    reads(
        "fsspec_local",
        "fsspec.open",
        """
import fsspec

with fsspec.open(f"file://{os.path.abspath(place)}/gain.txt", "r") as file:
    return picture(file.read())
""",
        files={"gain.txt": TWO},
    ),
    reads(
        "fromregex",
        "np.fromregex over a log of the instrument",
        """
found = np.fromregex(place + "/lab.log", r"gain=(\\d+)", [("gain", float)])
return picture(found["gain"][0])
""",
        files={"lab.log": ("gain=1\n", "gain=2\n")},
    ),
    reads(
        "matrix_market",
        "scipy.io.mmread",
        """
import scipy.io

return picture(scipy.io.mmread(os.path.join(place, "lab.mtx")).sum())
""",
        make=lambda folder, turn: scipy.io.mmwrite(folder / "lab.mtx", np.full((1, 1), float(turn))),
    ),
    reads(
        "colour_table",
        "colour.read_sds_from_csv_file",
        """
import colour

return picture(colour.read_sds_from_csv_file(place + "/lab.csv")["gain"].values.mean())
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
        """
import dbm.dumb
import shelve

with shelve.Shelf(dbm.dumb.open(place + "/lab", "r")) as shelf:
    return picture(shelf["gain"])
""",
        make=_shelf,
    ),
    reads(
        "process_cat",
        "another program reads the file",
        """
from subprocess import check_output as ask

return picture(ask(["cat", os.path.join(place, "gain.txt")]))
""",
        files={"gain.txt": TWO},
    ),
    reads(
        "popen_of_os",
        "os.popen",
        """
with os.popen(f"cat {place}/gain.txt") as pipe:
    return picture(pipe.read())
""",
        files={"gain.txt": TWO},
    ),
    reads(
        "dumb_database",
        "dbm",
        """
import dbm.dumb as base

with base.open(place + "/lab", "r") as lab:
    return picture(lab["gain"])
""",
        make=_dumb,
    ),
    reads(
        "zip_member",
        "a member of a zip file",
        """
import zipfile

with zipfile.ZipFile(Path(place) / "lab.zip") as lab:
    return picture(lab.read("gain.txt"))
""",
        make=_zip,
    ),
    reads(
        "tar_member",
        "a member of a tar file",
        """
import tarfile

with tarfile.open(Path(place) / "lab.tar") as lab:
    return picture(lab.extractfile("gain.txt").read())
""",
        make=_tar,
    ),
    reads(
        "gzip_text",
        "gzip.open",
        """
import gzip as squeezed

with squeezed.open(place + "/gain.gz", "rt") as file:
    return picture(file.read())
""",
        make=lambda folder, turn: (folder / "gain.gz").write_bytes(gzip.compress(str(turn).encode())),
    ),
    reads(
        "database",
        "sqlite3",
        """
import sqlite3

base = sqlite3.connect(place + "/lab.db")
((gain,),) = base.execute("select gain from gains")
base.close()
return picture(gain)
""",
        make=_database,
    ),
    reads(
        "hdf_native",
        "HDF5, whose library opens files itself",
        """
import h5py

with h5py.File(Path(place) / "lab.h5") as lab:
    return picture(lab["gain"][()])
""",
        make=_hdf,
    ),
    reads(
        "memory_map",
        "np.memmap",
        """
return picture(np.memmap(place + "/lab.bin", dtype=np.float32, mode="r")[0])
""",
        make=lambda folder, turn: np.full(1, turn, np.float32).tofile(folder / "lab.bin"),
    ),
    reads(
        "pandas_table",
        "pandas.read_csv, and another engine",
        """
import pandas

return picture(pandas.read_csv(place + "/lab.csv", engine="python")["gain"].sum())
""",
        files={"lab.csv": ("gain\n1\n", "gain\n2\n")},
    ),
    reads(
        "run_as_script",
        "runpy runs a settings file of Python",
        """
import runpy

return picture(runpy.run_path(place + "/settings.txt")["GAIN"])
""",
        files={"settings.txt": ("GAIN = 1\n", "GAIN = 2\n")},
    ),
    reads(
        "module_from_a_path",
        "importlib loads a file as a module",
        """
import importlib.util

spec = importlib.util.spec_from_file_location("lab_settings", place + "/settings.py")
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
return picture(module.GAIN)
""",
        files={"settings.py": ("GAIN = 1\n", "GAIN = 2\n")},
    ),
    reads(
        "rasters_of_pillow",
        "PIL",
        """
from PIL import Image

with Image.open(place + "/lab.pgm") as lab:
    return picture(np.asarray(lab).mean())
""",
        files={"lab.pgm": (b"P5 1 1 255\n\x01", b"P5 1 1 255\n\x02")},
    ),
]
