"""Several processes learn what one learns: gradients, resumption, and an end for all where one
fails.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from neusee.workflows import Store, load
from neusee.workflows.training.process_mesh import Mesh, MeshError
from neusee.workflows.training.resumable_loop import TrainingSession
from neusee.workflows.training.run_training import train
from tests.workflows.training.noise_photographs import noise_photograph

ROOT = Path(__file__).parents[4]
SMALL = [
    "optics.samples=48", "optics.pitch=168.27 um", "optics.bands=5", "optics.window=[40, 40]", "scene.shape=[40, 40]",
    "sensor.shape=[32, 32]", "doe=pixelwise", "train.network.kind=unet", "train.network.width=4",
    "train.critics.width=4", "train.precision=float64", "steps.psf.with.precision=double",
    "steps.laser_psf.with.precision=double",
]  # fmt: skip
EVERY = [*SMALL, "tolerance=0"]  #: each band of each picture is imaged
#: a few planes are; nothing drowns the network
FEW = [*SMALL, "train.stages.1.lsr=0", "train.stages.1.bsr=0"]
SHORT = [
    *EVERY,
    "train.stages.1.iterations=3",
    "train.stages.2.iterations=1",
    "train.keep=1",
    "train.show=2",
]
JOBS = [
    ("every", 1, "step", EVERY),
    ("every", 2, "step", EVERY),
    ("broken", 2, "fail", SHORT),
]


def processes(folder, jobs):
    """Do the jobs, one after another, each in processes of its own; by what it is called and
    their number, its folder.
    """
    made = [
        {
            "folder": str(folder / f"{name} {count}"),
            "store": str(folder / "store"),
            "runs": str(folder / name),
            "processes": count,
            "do": do,
            "words": words,
        }
        for name, count, do, words in jobs
    ]
    (folder / "jobs.json").write_text(json.dumps(made))
    script = Path(__file__).parents[2] / "mesh_processes.py"
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT / ".src")}
    done = subprocess.run(
        [sys.executable, script, folder / "jobs.json"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return {
        (name, count): Path(job["folder"])
        for (name, count, *_), job in zip(jobs, made, strict=True)
    }


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    return processes(tmp_path_factory.mktemp("mesh"), JOBS)


def codes(folder):
    return json.loads((folder / "codes.json").read_text())


def stepped(folder):
    """What one iteration found, where all its processes ended well."""
    assert not any(codes(folder)), errors(folder)
    return torch.load(folder / "step.pt", weights_only=True)


def errors(folder):
    return "\n".join(path.read_text() for path in sorted(folder.glob("error_*.txt")))


def apart(found, expected):
    """By part, how far gradients are from the expected ones, as a share of their norm."""
    parts = {}
    for part in ("mask", "net", "critics"):
        names = [name for name in expected["grads"] if name.startswith(f"{part}.")]
        assert all(expected["grads"][n].dtype == torch.float64 for n in names)
        off, all_of_it = (
            torch.cat([x.flatten() for x in each]).norm()
            for each in (
                [found["grads"][n] - expected["grads"][n] for n in names],
                [expected["grads"][n] for n in names],
            )
        )
        assert all_of_it > 0
        parts[part] = float(off / all_of_it)
    return parts


def same(found, expected):
    assert max(apart(found, expected).values()) <= 1e-12
    assert found["losses"].keys() == expected["losses"].keys()
    for name, value in expected["losses"].items():
        assert found["losses"][name] == pytest.approx(value, rel=1e-12), name


@pytest.mark.slow
def test_two_processes_find_the_gradients_of_one(done):
    one, two = (stepped(done["every", count]) for count in (1, 2))
    same(two, one)


@pytest.mark.slow
def test_a_pool_is_simulated_once_by_two_processes_and_with_a_camera_that_is_not_known(tmp_path):
    """Each process has the pictures of one process, of which it draws the values in the first
    round alone.
    """
    defocus = "train.mismatch={optics.defocus: 'normal(0 waves, 0.3 waves)'}"
    words = [
        *EVERY,
        "doe=half_ring",
        "train.learn=null",
        "train.pool=4",
        "train.keep_pool=false",
        defocus,
        "train.picture=restored",
    ]
    done = processes(tmp_path, [("pool", count, "pool", words) for count in (1, 2)])
    assert not any(code for folder in done.values() for code in codes(folder)), [
        errors(f) for f in done.values()
    ]
    (one,), two = (
        [torch.load(file, weights_only=True) for file in sorted(done["pool", count].glob("pool_*"))]
        for count in (1, 2)
    )
    assert (one["drawn"], [each["drawn"] for each in two]) == (4, [2, 2])
    for rank in range(2):
        mine = [tensors for i, tensors in one["pictures"] if i == rank]
        assert [i for i, _ in two[rank]["pictures"]] == [rank] * 4
        for (_, found), expected in zip(two[rank]["pictures"], mine, strict=True):
            assert float((found["picture"] - expected["picture"]).abs().max()) <= 1e-9
            assert torch.equal(found["truth"], expected["truth"])


@pytest.mark.slow
def test_one_that_fails_ends_all(done):
    broken = done["broken", 2]
    assert codes(broken) == [1, 1], "each ends by itself, and with an error"
    assert "this one cannot go on" in (broken / "error_1.txt").read_text()
    (folder,) = (broken.parent / "broken").iterdir()
    kept = torch.load(folder / "state.pt", weights_only=True)
    assert (kept["stage"], kept["iteration"]) == (1, 1), "of what all had done"
    assert not (folder / "mask.safetensors").exists()


@pytest.mark.slow
def test_one_process_goes_on_to_the_same_weights(tmp_path):
    jobs = [("whole", 1, "train"), ("broken", 2, "fail"), ("broken", 1, "train")]
    found = processes(tmp_path, [(*job, SHORT) for job in jobs])
    assert not any(codes(found["broken", 1])), errors(found["broken", 1])
    (one,), (two,) = ((tmp_path / name).iterdir() for name in ("whole", "broken"))
    assert one.name == two.name
    for file in ("mask", "network"):
        expected, made = (load_file(folder / f"{file}.safetensors") for folder in (one, two))
        for name, x in expected.items():
            assert float((made[name] - x).norm()) <= 1e-9 * float(x.norm()), name
    rows = [
        [line.split(",")[:-1] for line in (f / "losses.csv").read_text().splitlines()]
        for f in (one, two)
    ]
    assert rows[0] == rows[1]
    assert len(rows[0]) == 1 + 4
    assert json.loads((two / "training.json").read_text())["mesh"] == "1x1"


@pytest.mark.slow
def test_four_processes_find_the_gradients_of_one(tmp_path):
    each = {"every": EVERY, "few": FEW}
    jobs = [(name, count, "step", words) for name, words in each.items() for count in (1, 4)]
    found = processes(tmp_path, jobs)
    for name in each:
        same(stepped(found[name, 4]), stepped(found[name, 1]))


@pytest.mark.slow
def test_torchrun_starts_it_and_stops_all_where_one_fails(tmp_path):
    words = [word.replace("float64", "float32") for word in SHORT]
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT / ".src"),
        "NEUSEE_CACHE": str(tmp_path / "cache"),
    }
    start = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        "2",
        "-m",
        "neusee.workflows.cli",
        "train",
        "train_small",
        *words,
        "--out",
        str(tmp_path / "runs"),
    ]
    once = subprocess.run(start, env=environment, capture_output=True, text=True, check=False)
    assert once.returncode == 0, once.stderr
    (folder,) = (tmp_path / "runs").iterdir()
    assert once.stdout.splitlines().count(str(folder)) == 1
    assert json.loads((folder / "training.json").read_text())["mesh"] == "2x1"


LEAVES = """
import sys
from pathlib import Path
import torch
import torch.distributed as dist
from neusee.workflows.training.process_mesh import joined

def threads():
    return [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]

with joined("cpu") as mesh:
    dist.all_reduce(torch.ones(3))
    assert "pt_gloo_runloop" in threads()
Path(sys.argv[1], str(mesh.rank)).write_text(" ".join(threads()))  # the mesh is held
"""


@pytest.mark.slow
@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="reads the names of threads from /proc"
)
def test_no_thread_of_a_mesh_runs_on_after_it(tmp_path):
    """Such a thread may ask for Python's lock while Python shuts down, and then ends the process
    with SIGABRT.
    """
    (tmp_path / "leaves.py").write_text(LEAVES)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT / ".src")}
    start = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*start, tmp_path / "leaves.py", tmp_path], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for rank in "01":
        assert "gloo" not in (tmp_path / rank).read_text()


def test_a_batch_that_cannot_be_shared_is_refused_where_it_stands(tmp_path):
    recipe = load("train_small", [*EVERY, "train.stages.1.batch=3"])
    with pytest.raises(
        MeshError, match=r"argument \d+   train\.stages\.1\.batch   3 pictures .* multiple of 2"
    ):
        train(recipe, TrainingSession(Store(tmp_path), tmp_path, print, mesh=Mesh(2)))


@pytest.mark.slow
def test_all_processes_hold_out_the_same_photographs(tmp_path):
    (tmp_path / "photographs").mkdir()
    for i in range(4):
        noise_photograph(40 + 20 * i, i).save(tmp_path / "photographs" / f"{i}.png")
    words = [
        *SHORT,
        "train.stages.2.iterations=2",
        "train.held_out=0.5",
        "train.validate_every=2",
        f"train.photographs={tmp_path / 'photographs'}",
    ]
    found = processes(tmp_path, [(f"{count}", count, "train", words) for count in (1, 2)])
    rows = {}
    for name, count in found:
        assert not any(codes(found[name, count])), errors(found[name, count])
        (folder,) = (tmp_path / name).iterdir()
        table = [line.split(",")[:-1] for line in (folder / "losses.csv").read_text().splitlines()]
        rows[name] = table
        about = json.loads((folder / "training.json").read_text())
        assert (about["photographs"], len(about["held_out"]), about["best"]["iterations"]) == (
            2,
            2,
            2,
        )
    assert rows["2"] == rows["1"]
    # one process has no picture to restore
    one = [*words, "train.held_out_pictures=1", "train.validate_every=1"]
    again = processes(tmp_path, [("alone", 2, "train", one)])["alone", 2]
    assert not any(codes(again)), errors(again)
    place = rows["1"][0].index("held_out_PSNR")
    assert [bool(row[place]) for row in rows["1"][1:]] == [False, True, True, False, True]
