"""A device that fails in the middle of a command: no wrong result, nothing finished is lost, one
clear sentence.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.workflows.forked_commands import OTHERS, PROGRAM, Commands

SOURCE = Path(__file__).with_name("failing_device.cpp")
RECIPE = """
# A cube of a file, larger than what is stored beside the records.
outputs: [raw, small]
seed: 3
tolerance: 0
steps:
  bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count: 4}}
  scene: {node: scene.hyperspectral, from: bands, with: {file: cube.npy, start: 400 nm, stop: 700 nm}}
  raw: {node: sensor.digitize, from: {electrons: scene}, with: {gain: 0.5 e-/DN}}
  small: {node: sensor.crop, from: {image: raw}, with: {shape: [8, 8]}}
"""
#: by name: the calls that fail, how many succeed first, and the error
ON_CACHE = {
    "reads of results": ("read", 0, errno.EIO),
    "reads of a stale handle": ("read", 6, errno.ESTALE),
    "writes": ("write", 0, errno.EIO),
    "writes to a full disk": ("write", 3, errno.ENOSPC),
    "writes to the end": ("fsync", 0, errno.EIO),
    "the last step of a write": ("rename", 0, errno.EIO),
    "leases": ("link", 0, errno.EIO),
}
#: the default tests have one of each kind
SLOW = set(ON_CACHE) - {"reads of results", "writes"}


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    if sys.platform != "linux" or shutil.which("g++") is None:
        pytest.skip("only Linux puts a library before that of C, and g++ compiles it")
    file = tmp_path_factory.mktemp("device") / "device.so"
    subprocess.run(["g++", "-shared", "-fPIC", "-O1", SOURCE, "-o", file, "-ldl"], check=True)
    return file


@pytest.fixture(scope="module")
def neusee(library):
    """Calls the program in a process of its own, with the library before that of C; without
    variables of it no device fails.
    """
    forks = Commands(imports=(*OTHERS, *PROGRAM), variables={"LD_PRELOAD": str(library)})

    def neusee(folder, *words, **variables):
        environment = os.environ | {"NEUSEE_CACHE": str(folder / "cache"), **variables}
        done = forks(*words, cwd=folder, env=environment)
        assert "Traceback" not in done.stderr, done.stderr
        return done

    yield neusee
    forks.close()


def outputs(done):
    """The bytes of the outputs of a run, as its folder has them."""
    assert done.returncode == 0, done.stdout + done.stderr
    return (Path(done.args[-1]) / "latest" / "data" / "outputs.safetensors").read_bytes()


@pytest.fixture(scope="module")
def first(neusee, tmp_path_factory):
    """A folder with a recipe and a cache that has its results, and the bytes of its outputs."""
    folder = tmp_path_factory.mktemp("first")
    (folder / "mine.yaml").write_text(RECIPE)
    np.save(
        folder / "cube.npy",
        np.random.default_rng(1).uniform(10, 200, (96, 96, 4)).astype(np.float32),
    )
    right = outputs(neusee(folder, "run", "mine.yaml", "--json", "--out", str(folder / "runs")))
    shutil.rmtree(folder / "cache" / "answers", ignore_errors=True)  # or no later run would be one
    return folder, right


@pytest.fixture
def run(neusee, first, tmp_path):
    """Run the recipe with a cache that has its results and a device that fails; the process that
    has ended.
    """
    shutil.copytree(first[0], tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("runs"))

    def run(folder=None, calls="", after=0, error=errno.EIO, name=""):
        device = {"FOLDER": folder, "CALLS": calls, "AFTER": after, "ERROR": error, "NAME": name}
        variables = (
            {f"DEVICE_{name}": str(value) for name, value in device.items()} if folder else {}
        )
        return neusee(
            tmp_path, "run", "mine.yaml", "--json", "--out", str(tmp_path / "runs"), **variables
        )

    return run


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in ON_CACHE],
)
def test_a_cache_whose_device_fails_in_the_middle_costs_one_warning(name, run, first, tmp_path):
    calls, after, error = ON_CACHE[name]
    if calls != "read":
        shutil.rmtree(tmp_path / "cache")
    done = run(tmp_path / "cache", calls, after, error)
    assert outputs(done) == first[1]
    lines = [line for line in done.stderr.splitlines() if line]
    assert len(lines) <= 1
    assert all(
        line.startswith("warning: the cache ") and os.strerror(error) in line for line in lines
    )
    assert lines or name == "leases"
    again = run()
    assert outputs(again) == first[1]  # nothing wrong was left behind
    assert again.stderr == ""


def test_a_map_of_a_device_that_fails_is_not_looked_into(run, first, tmp_path):
    """A look into a map without pages ends the process by SIGBUS: the read before it fails as an
    error instead.
    """
    # so that the results are loaded, to be written again
    shutil.rmtree(tmp_path / "cache" / "files")
    done = run(tmp_path / "cache", "read,mmap", name=".safetensors")
    assert outputs(done) == first[1]
    assert done.stderr.startswith("warning: the cache ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("calls", "after"), [("read", 0), pytest.param("read", 3, marks=pytest.mark.slow)]
)
def test_an_input_file_whose_device_fails_is_named(run, tmp_path, calls, after):
    done = run(tmp_path / "cube.npy", calls, after)
    assert done.returncode in (1, 2), done.stdout
    assert [
        line
        for line in done.stderr.splitlines()
        if "cube.npy" in line and "Input/output error" in line
    ]
    assert not list((tmp_path / "runs").glob("[!.l]*"))


@pytest.mark.slow
def test_results_whose_device_fails_end_with_a_sentence_and_lose_nothing(run, first, tmp_path):
    shutil.rmtree(tmp_path / "cache")
    done = run(tmp_path / "runs", "write", 3, errno.ENOSPC)
    assert done.returncode == 1
    assert "No space left on device" in done.stderr
    assert f"are kept in the cache {tmp_path / 'cache'}" in done.stderr
    assert not list((tmp_path / "runs").glob("[!.]*"))
    again = run()
    assert outputs(again) == first[1]
    assert "run" not in {
        step["state"]
        for step in json.loads(again.stdout)["steps"]
        if step["step"] in ("raw", "small")
    }
