"""Files of strangers that would take gigabytes, or would never end: each is refused in one sentence
and little memory.

All are read by one child process, whose readers may use 100 MB more than it holds.
"""

import json
import subprocess
import sys
from functools import partial

import pytest

from tests import file_bombs as bombs

LEFT = 100 * bombs.MB  #: bytes that readers may use
#: bytes by which the process may grow: what a reader was allowed, and libraries
MOST = 130 * bombs.MB
MEMORY = "more than the"  #: in each sentence about memory
OTHER = "is not a regular file but"

SCENE, FRAMES, SENSOR = "scene.{}(file=path)", "calibrate.frames(files=(path,))", "read_frame(path)"
CUBE = "scene.hyperspectral.hooks.preflight(file=path, start=4e-7, stop=7e-7)"
HEIGHT = "map_header(path)"
#: name of the bomb: its maker, the name of its file, what reads it, and what the sentence says
BOMBS = {
    "exr of a huge window": (bombs.exr, "a.exr", SCENE.format("exr"), MEMORY),
    "exr of many channels": (
        partial(bombs.exr, channels=["R", "G", "B", *(f"c{i:04}" for i in range(2000))], size=(600, 600)),
        "a.exr", SCENE.format("exr"), MEMORY,
    ),
    "exr of several parts": (
        partial(bombs.exr, size=(5000, 5000), parts=3), "a.exr", "picture_size(path, 'p1')", MEMORY
    ),
    "exr of deep samples": (partial(bombs.exr, size=(4, 4), deep=True), "a.exr", SCENE.format("exr"), "deep samples"),
    "exr as a frame": (partial(bombs.exr, channels="Y"), "a.exr", SENSOR, MEMORY),
    "exr of dark frames": (partial(bombs.exr, channels="Y"), "a.exr", FRAMES, MEMORY),
    "tiff of many pages": (partial(bombs.tiff, pages=500), "a.tif", FRAMES, "500 pages of 4000 x 3000 pixels"),
    "tiff of a huge tile": (
        partial(bombs.tiff, pages=1, shape=(16, 16), tile=60000), "a.tif", FRAMES, MEMORY
    ),
    "tiff as a frame": (partial(bombs.tiff, pages=1, shape=(6000, 8000)), "a.tif", SENSOR, MEMORY),
    "png of 60000 x 60000": (partial(bombs.png, side=60000), "a.png", "read_header(path)", "limit of 64 million"),
    "png within the limit": (partial(bombs.png, side=7900), "a.png", SCENE.format("photograph"), MEMORY),
    "png of 16 bits": (partial(bombs.png, side=7900, colour=2, depth=16), "a.png", SENSOR, MEMORY),
    "png of a height map": (partial(bombs.png, side=9400), "a.png", HEIGHT, MEMORY),
    "jpeg": (partial(bombs.jpeg, side=7900), "a.jpg", SCENE.format("photograph"), MEMORY),
    "fits of a hole": (partial(bombs.fits, side=20000), "a.fits", FRAMES, MEMORY),
    "npy of a huge shape": (partial(bombs.npy, shape=(100_000, 100_000, 31)), "a.npy", CUBE, "its header states"),
    "npy of a hole": (partial(bombs.npy, shape=(5000, 5000, 31), hole=True), "a.npy", CUBE, MEMORY),
    "npy of a height map": (partial(bombs.npy, shape=(20000, 20000), hole=True), "a.npy", HEIGHT, MEMORY),
    "npy of frames": (partial(bombs.npy, shape=(9, 4000, 6000), dtype="<u2", hole=True), "a.npy", FRAMES, MEMORY),
    "npy of samples": (partial(bombs.npy, shape=(300_000_000,), hole=True), "a.npy", "read_columns(path)", MEMORY),
    "npz of reflectances": (
        partial(bombs.npz, names=("wavelengths", "reflectances")), "a.npz", "reflectances(path)", MEMORY
    ),
    "npz of samples": (partial(bombs.npz, names=("gain",)), "a.npz", "read_columns(path)", MEMORY),
    "npz that lies": (
        lambda path: bombs.zipped(path, {"gain.npy": (bombs.npy_head((10**12,)), 1)}),
        "a.npz", "read_columns(path)", "its array gain.npy states",
    ),
    "mat of zeros": (partial(bombs.mat, name="height"), "a.mat", HEIGHT, MEMORY),
    "mat that lies": (partial(bombs.mat, name="height", lies=True), "a.mat", HEIGHT, MEMORY),
    "mat of reflectances": (partial(bombs.mat, name="sur_a"), "a.mat", "reflectances(path)", MEMORY),
    "safetensors that lie": (partial(bombs.safetensors, count=10**10), "a.safetensors", HEIGHT, "its header states"),
    "safetensors of a long header": (
        partial(bombs.safetensors, count=1, header=1 << 40), "a.safetensors", "weights(path)", "of header"
    ),
    "pt of weights": (bombs.checkpoint, "a.pth", "lift_weights(path)", MEMORY),
    "pt of a training": (bombs.checkpoint, "state.pt", "StateFile(path).read()", MEMORY),
    "exported network": (
        lambda path: bombs.zipped(path, {"models/model.json": (b"{", 120)}), "a.pt2", "exported_network(path)", MEMORY
    ),
    "hdf5 of draws": (bombs.chain, "draws.h5", "draws(path)", MEMORY),
    "hdf5 of draws that are kept": (bombs.chain, "draws.h5", "said(chain(path, 0) is None)", "True"),
    "csv of a long line": (bombs.long_line, "a.csv", "list(csv_rows(path))", "more than 1000000 characters"),
    "csv of a hole": (bombs.hole, "a.csv", "reflectances(path)", MEMORY),
    "csv of samples": (bombs.hole, "a.csv", "read_columns(path)", MEMORY),
    "recipe of aliases": (bombs.aliases, "a.yaml", "load(path)", "aliases expand this value"),
    "recipe of a hole": (bombs.hole, "a.yaml", "load(path)", "more than the limit of 4000000"),
    "posterior of aliases": (bombs.aliases, "a.yaml", "read_posterior(path)", "unknown key a0"),
    "posterior of a hole": (bombs.hole, "posterior.json", "read_posterior(path)", "more than the limit of 4000000"),
    "descriptor of a hole": (bombs.hole, "a.txt", "descriptor_release((path,))", "more than the limit of 67.1 MB"),
    "record of a run": (bombs.hole, "provenance.json", "record(path)", "more than the limit of 67108864"),
    # --- what is no file
    "pipe as a photograph": (bombs.pipe, "a.png", SCENE.format("photograph"), OTHER),
    "pipe as an exr": (bombs.pipe, "a.exr", SCENE.format("exr"), OTHER),
    "pipe as a frame": (bombs.pipe, "a.tif", SENSOR, OTHER),
    "pipe as dark frames": (bombs.pipe, "a.tif", "frame_header(path)", OTHER),
    "pipe as a fits": (bombs.pipe, "a.fits", "frame_header(path)", OTHER),
    "pipe as a cube": (bombs.pipe, "a.npy", CUBE, OTHER),
    "pipe as a table": (bombs.pipe, "a.csv", "list(csv_rows(path))", OTHER),
    "pipe as weights": (bombs.pipe, "a.safetensors", "weights(path)", OTHER),
    "pipe as a recipe": (bombs.pipe, "a.yaml", "load(path)", OTHER),
    "pipe as a posterior": (bombs.pipe, "posterior.json", "read_posterior(path)", OTHER),
    "pipe as a record": (bombs.pipe, "provenance.json", "record(path)", OTHER),
    "device as a table": (bombs.device, "a.csv", "list(csv_rows(path))", OTHER),
    "device as samples": (bombs.device, "a.csv", "read_columns(path)", OTHER),
    "device as a photograph": (bombs.device, "a.png", SCENE.format("photograph"), OTHER),
    "socket as a table": (bombs.unix_socket, "a.csv", "list(csv_rows(path))", OTHER),
    "parameter that is a pipe": (bombs.pipe, "a.png", "existing(path)", OTHER.removesuffix(" but")),
    "link to itself": (bombs.loop, "a.csv", "read_columns(path)", "there is no file"),
    "folder of loops": (bombs.folder_of_loops, "photos", "said([len(x) for x in list_photographs(path)])", "[1, 1]"),
    "pipe in place of a record of code": (bombs.pipe, "code", "said(code_record(path))", "{}"),
    "pipe in place of the memo of code": (bombs.pipe, "memo", "said(read_memo(path))", "{}"),
    "pipe in place of a lease": (bombs.pipe, "lease", "said(look(str(path))[0] == '')", "True"),
}  # fmt: skip

READ = """
import json, resource, signal, sys, time
from pathlib import Path

import h5py

from neusee.nodes import calibrate, scene
from neusee.nodes.file_headers import hdf5_needs
from neusee.nodes.calibrate import descriptor_release, frame_header
from neusee.nodes.doe._height_map_files import map_header
from neusee.nodes.input_files import csv_rows
from neusee.nodes.network_weights import fits
from neusee.nodes.restore.networks import exported_network
from neusee.nodes.scene._exr import picture_size
from neusee.nodes.scene._photograph import read_header
from neusee.nodes.scene import list_photographs
from neusee.nodes.sensor._frame_file import read_frame
from neusee.nodes.spectra._plausible_spectra import _spectra_of_file as reflectances
from neusee.nodes.spectra._lift import _checkpoint_tensors as lift_weights
from neusee.nodes.units import existing_file as existing
from neusee.workflows import load
from neusee.workflows.calibration.emcee_sampler import _read as chain
from neusee.workflows.comparison.run_record import _json as record
from neusee.workflows.engine.machine_resources import process_memory
from neusee.workflows.engine.machine_resources import limited
from neusee.workflows.keys.module_digest import read_memo, read_parts
from neusee.workflows.recipe.distributions.joint_distribution import read_posterior
from neusee.workflows.recipe.distributions.joint_distribution import read_columns
from neusee.workflows.store.lease import _state_of_lease as look
from neusee.workflows.training.resumable_loop import StateFile
import PIL.Image, astropy.io.fits, kornia_rs, scipy.io, torch, torch.export


class Said(Exception):
    pass


def said(value):
    raise Said(str(value))


def weights(path):
    fits(torch.nn.Linear(1, 1), path, "this network", {})


def code_record(path):
    root = path.parent / "store"
    (root / "code").mkdir(parents=True)
    path.rename(root / "code" / "abc.json")
    return read_parts(root, "abc")


def draws(path):
    with h5py.File(path) as opened:
        hdf5_needs(path, [opened["ensemble0"]])


def late(*_):
    raise TimeoutError("it waits")


def highest():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))


signal.signal(signal.SIGALRM, late)
for name, (file, code) in json.load(sys.stdin).items():
    path = Path(file)
    Path("/proc/self/clear_refs").write_text("5")
    before = process_memory()
    signal.alarm(60)
    began, text = time.process_time(), "nothing"
    with limited(before + LEFT):
        try:
            eval(code)
        except BaseException as error:
            text = str(error)
    signal.alarm(0)
    print(json.dumps([name, text, highest() - before, time.process_time() - began]), flush=True)
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What the child says of each bomb: the text of the error, the bytes by which it grew, and
    the seconds.
    """
    folder, jobs = tmp_path_factory.mktemp("bombs"), {}
    for number, (name, (make, file, code, _)) in enumerate(BOMBS.items()):
        path = folder / str(number) / file
        path.parent.mkdir()
        make(path)
        jobs[name] = (str(path), code)
    done = subprocess.run(
        [sys.executable, "-c", READ.replace("LEFT", str(LEFT))],
        input=json.dumps(jobs),
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=1200,
    )
    found = {
        name: (text, *numbers) for name, text, *numbers in map(json.loads, done.stdout.splitlines())
    }
    assert set(found) == set(BOMBS), done.stderr[-2000:]
    return found | {"paths": {name: path for name, (path, _) in jobs.items()}}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_in_one_sentence_and_in_little_memory(answers, name):
    text, grown, _ = answers[name]
    sentence = BOMBS[name][3]
    assert sentence in text
    assert "\n" not in text.strip()
    if sentence in (MEMORY, OTHER):
        assert answers["paths"][name] in text, "the sentence names the file"
    if sentence == MEMORY:
        assert "would need" in text
        assert "--memory" in text
    assert grown < MOST
