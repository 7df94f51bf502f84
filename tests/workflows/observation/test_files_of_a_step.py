"""Files that a step reads without saying so, by whatever way: each is found, with its path."""

import configparser
import ctypes
import dbm.dumb
import glob
import json
import linecache
import mmap
import os
import shelve
import shutil
import sqlite3
import tarfile
import tempfile
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import fsspec
import h5py
import numpy as np
import pytest
import scipy.io
import torch

from neusee.workflows.observation.observed_call import observed
from neusee.workflows.observation.taints import Covered


@pytest.fixture
def data(tmp_path):
    """A folder with one file of each format."""
    folder = tmp_path / "data"
    folder.mkdir()
    (folder / "gain.csv").write_text("1 2\n3 4\n")
    (folder / "gain.ini").write_text("[gain]\nred = 2\n")
    (folder / "gain.json").write_text("2")
    (folder / "gain.mtx").write_text("%%MatrixMarket matrix array real general\n1 1\n2.0\n")
    np.save(folder / "gain.npy", np.ones(3))
    with sqlite3.connect(folder / "gain.db") as base:
        base.execute("create table gain (red real)")
    base.close()
    with shelve.Shelf(dbm.dumb.open(str(folder / "gain"), "c")) as shelf:
        shelf["red"] = 2
    with h5py.File(folder / "gain.h5", "w") as file:
        file["red"] = 2
    with zipfile.ZipFile(folder / "gain.zip", "w") as file:
        file.writestr("red", "2")
    return folder


def of_a_dictionary(folder):
    names = {"red": "gain"}
    return (folder / f"{names['red']}.csv").read_text()


def of_a_formatted_text(folder):
    name = "gain"
    with open(f"{folder}/{name}.csv") as file:
        return file.read()


def of_a_join(folder):
    return np.loadtxt(os.path.join(os.fspath(folder), "gain" + ".csv"))


def of_a_relative_path(folder):
    with open(os.path.relpath(folder / "gain.csv")) as file:
        return file.read()


def of_a_link(folder):
    with tempfile.TemporaryDirectory() as other:
        link = Path(other) / "link"
        link.symlink_to(folder / "gain.csv")
        return link.read_text()


def of_an_open_folder(folder):
    inside = os.open(folder, os.O_RDONLY)
    file = os.open("gain.csv", os.O_RDONLY, dir_fd=inside)
    os.close(inside)
    os.close(file)


def of_a_configuration(folder):
    parser = configparser.ConfigParser()
    assert parser.read(folder / "gain.ini")


def of_a_table(folder):
    return np.fromregex(folder / "gain.csv", r"(\d) (\d)", [("red", int), ("green", int)])


def of_raw_numbers(folder):
    return np.fromfile(folder / "gain.csv", np.uint8)


def of_a_memory_map(folder):
    with (
        open(folder / "gain.csv", "rb") as file,
        mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ) as memory,
    ):
        return bytes(memory)


def of_an_array(folder):
    return np.load(folder / "gain.npy", mmap_mode="r").sum()


def of_a_copy(folder):
    return Path(shutil.copy(folder / "gain.csv", folder / "copy.csv")).read_text()


def of_a_name_that_was_taken_away(folder):
    (folder / "gain.csv").rename(folder / "moved.csv")
    return (folder / "moved.csv").read_text()


def of_a_thread(folder):
    thread = threading.Thread(target=(folder / "gain.csv").read_text)
    thread.start()
    thread.join()


def of_a_pool_of_the_step(folder):
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(Path.read_text, [folder / "gain.csv"] * 4))


def of_a_thread_of_a_thread(folder):
    def inner():
        of_a_thread(folder)

    thread = threading.Thread(target=inner)
    thread.start()
    thread.join()


def of_a_shelf(folder):
    with shelve.Shelf(dbm.dumb.open(str(folder / "gain"))) as shelf:
        return shelf["red"]


READERS = {
    of_a_dictionary: "gain.csv",
    of_a_formatted_text: "gain.csv",
    of_a_join: "gain.csv",
    of_a_relative_path: "gain.csv",
    of_a_link: "gain.csv",
    of_an_open_folder: "gain.csv",
    of_a_configuration: "gain.ini",
    of_a_table: "gain.csv",
    of_raw_numbers: "gain.csv",
    of_a_memory_map: "gain.csv",
    of_an_array: "gain.npy",
    of_a_copy: "gain.csv",
    of_a_name_that_was_taken_away: "gain.csv",
    of_a_thread: "gain.csv",
    of_a_pool_of_the_step: "gain.csv",
    of_a_thread_of_a_thread: "gain.csv",
    lambda folder: fsspec.open(f"file://{folder}/gain.json").open().close(): "gain.json",
    lambda folder: dbm.dumb.open(str(folder / "gain")).close(): "gain.dat",
    of_a_shelf: "gain.dir",
    lambda folder: zipfile.ZipFile(folder / "gain.zip").close(): "gain.zip",
    lambda folder: linecache.getlines(str(folder / "gain.csv")): "gain.csv",
    lambda folder: json.loads((folder / "gain.json").read_bytes()): "gain.json",
    lambda folder: tarfile.is_tarfile(folder / "gain.csv"): "gain.csv",
    lambda folder: (
        sqlite3.connect(folder / "gain.db").execute("select * from gain").connection.close()
    ): "gain.db",
}


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.__name__)
def test_a_file_that_is_read_is_found(reader, data, taints, layer):
    found = taints(lambda: reader(data))
    if layer == "python" and reader is of_an_open_folder:  # which folder it was is not known
        assert ("file", "gain.csv") in found
    else:
        assert ("file", f"data/{READERS[reader]}") in found
        assert {kind for kind, _ in found} == {"file"}


def with_libc(library):
    def read(folder):
        libc = library(None)
        libc.fopen.restype = ctypes.c_void_p
        file = libc.fopen(os.fsencode(folder / "gain.csv"), b"r")
        assert file
        libc.fclose(ctypes.c_void_p(file))

    return read


NATIVE = {
    "libc": (with_libc(ctypes.CDLL), "gain.csv"),
    "libc with the lock of the interpreter": (with_libc(ctypes.PyDLL), "gain.csv"),
    "hdf5": (lambda folder: h5py.File(folder / "gain.h5").close(), "gain.h5"),
    "matrices": (lambda folder: scipy.io.mmread(folder / "gain.mtx", spmatrix=False), "gain.mtx"),
    "map": (lambda folder: torch.from_file(str(folder / "gain.npy"), size=3), "gain.npy"),
}


@pytest.mark.parametrize("name", NATIVE)
def test_a_file_that_native_code_reads_is_found(name, data, taints, watched):
    read, file = NATIVE[name]
    assert ("file", f"data/{file}") in taints(lambda: read(data))


def test_a_file_that_is_read_within_a_covered_folder_or_is_covered_itself_is_none(
    data, taints, layer
):
    assert taints(lambda: of_a_join(data), data / "gain.csv") == []
    assert taints(lambda: [of_a_configuration(data), os.listdir(data)], data) == []


def test_a_covered_file_may_be_reached_by_its_folders_and_by_a_link(data, taints, watched):
    link = data.parent / "link"
    link.symlink_to(data)
    assert taints(lambda: (link / "gain.csv").resolve().read_text(), data / "gain.csv") == []


def test_a_folder_that_is_listed_is_found(data, taints, layer):
    for step in (
        lambda: os.listdir(data),
        lambda: list(os.scandir(data)),
        lambda: glob.glob(f"{data}/*.csv"),
    ):
        assert ("folder", "data") in taints(step)
    assert ("folder", "data") in taints(lambda: list(data.iterdir()), data / "gain.csv")


@pytest.mark.parametrize("name", ["gain.csv", "missing.csv"])
def test_a_file_whose_existence_age_or_size_decides_is_found(name, data, taints, watched):
    path = data / name
    for ask in (
        path.exists,
        path.is_file,
        path.resolve,
        lambda: os.access(path, os.R_OK),
        lambda: os.path.getmtime(data / "gain.ini"),
    ):
        assert [kind for kind, _ in taints(ask)] == ["file"]


def test_a_default_for_a_file_that_is_not_there_is_found(data, taints, layer):
    def step():
        try:
            return (data / "missing.csv").read_text()
        except FileNotFoundError:
            return ""

    assert taints(step) == [("file", "data/missing.csv")]


def test_a_text_of_several_lines_that_is_taken_for_a_name_is_none_if_there_is_no_such_file(
    data, taints, layer
):
    text = data / "x, y\n1, 2\n"
    assert taints(text.exists) == []

    def opened():
        with pytest.raises(FileNotFoundError):
            text.read_text()

    assert taints(opened) == []
    text.write_text("there")
    assert taints(text.read_text) == [("file", "data/x, y\n1, 2\n")]


def test_temporary_files_that_are_read_back_are_none(taints, layer):
    def step():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "inner" / "x.txt"
            path.parent.mkdir()
            path.write_text("1")
            path.rename(path.with_name("y.txt"))
            assert [file.read_text() for file in path.parent.iterdir()] == ["1"]
        with tempfile.NamedTemporaryFile() as file, tempfile.TemporaryFile("w+") as other:
            other.write("x")
            return Path(file.name).read_bytes()

    assert taints(step) == []


def test_a_file_that_the_step_writes_anew_may_be_read_back_and_one_that_it_appends_to_may_not(
    data, taints, layer
):
    def anew():
        (data / "gain.csv").write_text("5")
        return (data / "gain.csv").read_text()

    def appended():
        with open(data / "gain.json", "a") as file:
            file.write("5")
        return (data / "gain.json").read_text()

    assert taints(anew) == []
    assert taints(appended) == [("write", "data/gain.json"), ("file", "data/gain.json")]


def test_a_file_that_is_only_written_anew_is_none(data, taints, layer):
    def step():
        (data / "log.txt").write_text("done")

    assert taints(step) == []
    assert taints(step) == []


def test_a_taint_says_what_to_write(data):
    found = observed(lambda: of_a_join(data), Covered(frozenset(), lambda name: True))[1]
    assert [each.what for each in found if "gain.csv" in each.what] == [str(data / "gain.csv")]
    assert 'depends=["gain.csv"]' in found[0].fix
    assert "DataFile" in found[0].fix
    assert "cache: false" in found[0].fix


def test_files_of_other_threads_are_not_those_of_the_step(data, taints, layer):
    stop, reads = threading.Event(), []

    def read():
        while not stop.is_set():
            reads.append((data / "gain.csv").read_text())

    def step():
        before = len(reads)
        while len(reads) < before + 20:
            time.sleep(0.001)

    thread = threading.Thread(target=read)
    thread.start()
    try:
        assert taints(step) == []
    finally:
        stop.set()
        thread.join()
