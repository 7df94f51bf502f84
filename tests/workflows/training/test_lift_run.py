"""Learning a lift: from measured reflectances to weights that the node takes, and a kill that
costs nothing.
"""

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from neusee.nodes.spectra import bands, lift_mst_plus_plus, render
from neusee.workflows import RecipeError, Store, load
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.training import lift_training
from neusee.workflows.training.lift_training import LiftLearner, Pairs, train_lift
from neusee.workflows.training.resumable_loop import TrainingSession

ROOT = Path(__file__).parents[3]
TINY = [
    "patch.shape=[8, 8]",
    "patch.leaves=8",
    "train_lift.iterations=4",
    "train_lift.batch=1",
    "train_lift.keep=2",
    "train_lift.warmup=2",
    "train_lift.validation_batches=2",
    "train_lift.ema_decay=0.5",
]

pytestmark = pytest.mark.usefixtures("one_thread")


def trained(recipe, folder, watch=None):
    return train_lift(
        recipe,
        TrainingSession(
            Store(folder / "store"),
            folder / "runs",
            lambda line: None,
            command=["neusee"],
            watch=watch,
        ),
    )


def losses(folder):
    with (folder / "losses.csv").open(newline="") as file:
        return [{**row, "seconds": ""} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return trained(load("train_lift", TINY), tmp_path_factory.mktemp("whole"))


def test_the_weights_are_those_that_the_lift_takes(whole):
    weights = whole / "mst_plus_plus.safetensors"
    assert sum(tensor.numel() for tensor in load_file(weights).values()) == 1_619_625
    assert lift_mst_plus_plus.hooks.preflight(weights=weights) == []
    scene = bands(start=400e-9, stop=700e-9, count=31)
    rgb = torch.rand(3, 12, 12, generator=torch.Generator().manual_seed(2))
    cube = lift_mst_plus_plus(rgb, scene, weights=weights, rng=torch.Generator())
    assert float((render(cube, scene) - rgb).square().mean().sqrt()) < 0.1
    document = json.loads((whole / "training.json").read_text())
    assert document["reflectances"] == 216
    assert set(document["judged"]) == {"mst_plus_plus", "linear"}
    assert document["judged"]["linear"]["colour"] < 0.01
    assert [row["iteration"] for row in losses(whole)] == list("0123")
    assert (whole / "curves.png").stat().st_size > 5_000
    assert [path.name for path in (whole / "pictures").iterdir()] == ["000004.png"]


def same(again, whole):
    assert again.name == whole.name
    assert (again / "mst_plus_plus.safetensors").read_bytes() == (
        whole / "mst_plus_plus.safetensors"
    ).read_bytes()
    assert losses(again) == losses(whole)


@pytest.mark.slow
def test_a_training_that_is_stopped_goes_on_to_the_same_weights(tmp_path, whole):
    def watch(stage, done, found):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(load("train_lift", TINY), tmp_path, watch)
    (folder,) = (tmp_path / "runs").iterdir()
    assert not (folder / "mst_plus_plus.safetensors").exists()
    same(trained(load("train_lift", TINY), tmp_path), whole)


@pytest.mark.slow
def test_a_killed_training_goes_on_to_the_same_weights(tmp_path, whole):
    code = f"""
import os, signal
from pathlib import Path
from neusee.workflows import Store, load
from neusee.workflows.training.lift_training import train_lift
from neusee.workflows.training.resumable_loop import TrainingSession
def watch(stage, done, found):
    if done == 3:
        os.kill(os.getpid(), signal.SIGKILL)
here = Path({str(tmp_path)!r})
train_lift(load("train_lift", {TINY!r}), TrainingSession(Store(here / "store"), here / "runs", print, watch=watch))
"""
    env = {**os.environ, "PYTHONPATH": str(ROOT / ".src"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    same(trained(load("train_lift", TINY), tmp_path), whole)


def test_a_finished_training_is_not_repeated(whole):
    before = {
        path: path.stat().st_mtime_ns for path in whole.rglob("*.*") if path.name != "losses.csv"
    }
    trained(load("train_lift", [*TINY, "train_lift.keep=1"]), whole.parents[1])
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert len(losses(whole)) == 4


def test_a_pair_is_that_of_its_number_and_renders_as_the_steps_do(tmp_path):
    recipe = load("train_lift", [*TINY, "patch.read=0", "patch.shot=0"])
    pairs = Pairs(recipe, recipe.lifting, Store(tmp_path), "cpu")
    picture, cube = pairs(5)
    pairs(6)
    again = pairs(5)
    assert torch.equal(picture, again[0])
    assert torch.equal(cube, again[1])
    assert not torch.equal(cube, pairs(6)[1])
    assert torch.equal(render(cube, pairs.bands), picture)
    assert 0 <= float(cube.min()) <= float(cube.max()) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("start", ["linear", "random"])
def test_a_few_iterations_lower_the_error(tmp_path, start):
    recipe = load(
        "train_lift",
        [*TINY, f"train_lift.start={start}", "train_lift.iterations=12", "train_lift.rate=2e-3"],
    )
    pairs = Pairs(recipe, recipe.lifting, Store(tmp_path), "cpu")
    learner = LiftLearner(recipe.lifting, pairs, recipe.seed, "cpu")
    kept = pairs.batch([0, 1])
    pairs.batch = lambda numbers: kept
    errors = [learner.iterate(number)["MRAE"] for number in range(12)]
    assert errors[-1] < 0.9 * errors[0]
    if start == "linear":
        assert errors[0] < 0.3


@pytest.mark.parametrize("clip", [10.0, 0.5, None])
def test_the_gradient_of_all_weights_has_at_most_the_norm_clip(tmp_path, clip):
    words = [
        "train_lift.start=random",
        *([] if clip == 10.0 else [f"train_lift.clip={clip or 'null'}"]),
    ]
    recipe = load("train_lift", [*TINY, *words])
    assert recipe.lifting.clip == clip
    learner = LiftLearner(
        recipe.lifting, Pairs(recipe, recipe.lifting, Store(tmp_path), "cpu"), recipe.seed, "cpu"
    )
    with torch.no_grad():
        for weight in learner.net.parameters():
            weight.mul_(2)  # so that the gradient is long
    norm = learner.iterate(0)["slope"]
    assert norm > 10
    kept = float(torch.cat([p.grad.flatten() for p in learner.net.parameters()]).double().norm())
    assert kept == pytest.approx(clip or norm, rel=1e-4)


@pytest.mark.parametrize("value", ["0", "-1", "none"])
def test_a_limit_of_the_gradient_that_is_not_positive_is_refused(value):
    with pytest.raises(RecipeError, match=r"train_lift\.clip"):
        load("train_lift", [f"train_lift.clip={value}"])


def test_every_setting_and_file_of_a_lift_is_in_the_name_of_its_folder_and_a_display_setting_is_not(
    tmp_path,
):
    """Reflectances in a file, which another content under the old name makes another training."""
    table = tmp_path / "paints.csv"
    table.write_text("nm,one,two\n380,0.1,0.2\n780,0.3,0.4\n")

    def key(*words):
        recipe = load("train_lift", [*TINY, f"measured.files={table}", *words])
        return lift_training.lift_inputs(
            recipe, recipe.lifting, Code(Store(tmp_path / "store").code_memo)
        ).key

    first = key()
    assert key("train_lift.show=7", "train_lift.keep=3", "train_lift.validation_batches=2") == first
    assert len({first, key("train_lift.clip=0.5"), key("train_lift.clip=null"), key("seed=9")}) == 4
    about = table.stat()
    table.write_text("nm,one,two\n380,0.1,0.2\n780,0.3,0.5\n")
    os.utime(table, ns=(about.st_atime_ns, about.st_mtime_ns))
    assert key() != first


def test_what_is_not_a_number_stops_and_is_kept(tmp_path, monkeypatch):
    from neusee.nodes import losses as nodes

    monkeypatch.setattr(nodes, "mrae", lambda a, b, floor: (a - b).mean() * float("nan"))
    with pytest.raises(
        ArithmeticError, match=r"iteration 0, picture 0: these numbers are NaN or infinite: MRAE"
    ):
        trained(load("train_lift", TINY), tmp_path)
    (folder,) = (tmp_path / "runs").iterdir()
    assert {"net", "optimiser"} <= torch.load(folder / "not_finite_0.pt", weights_only=True)[
        "parts"
    ].keys()
    assert not (folder / "mst_plus_plus.safetensors").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("train_lift.iterations=0", "train_lift.iterations"),
        ("+train_lift.fish=1", "unknown; "),
        ("train_lift.start=foo", "linear"),
        ("measured.files=nowhere.csv", "no such file"),
        ("~train_lift.iterations", "needs iterations"),
    ],
)
def test_a_mistake_is_located(change, said):
    with pytest.raises(RecipeError, match=said):
        load("train_lift", [change])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("train_lift.cube=cub", "did you mean cube"),
        ("train_lift.measured=bands", "bands has no input `bands`"),
        ("steps.bands.with.count=16", "31 bands from 400 to 700 nm"),
    ],
)
def test_steps_that_cannot_be_learnt_from_are_refused(tmp_path, change, said):
    with pytest.raises(ValueError, match=said):
        trained(load("train_lift", [*TINY, change]), tmp_path)


def test_the_rate_rises_and_falls_as_a_cosine():
    how = load("train_lift", ["train_lift.iterations=1000", "train_lift.warmup=10"]).lifting
    assert how.rate_at(0) == pytest.approx(4e-5)
    assert how.rate_at(500) == pytest.approx(2e-4, rel=0.01)
    assert how.rate_at(999) == pytest.approx(1e-6, rel=0.01)


@pytest.mark.slow
def test_the_command_learns_a_lift_and_knows_no_stages(tmp_path, capsys, monkeypatch):
    from neusee.workflows.cli.app import main

    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "store"))
    with pytest.raises(SystemExit) as error:
        main(["train", "train_lift", *TINY, "--stage", "1"])
    assert error.value.code == 2
    assert "learns a lift, which has no stages" in capsys.readouterr().err
    with pytest.raises(SystemExit) as done:
        main(
            [
                "train",
                "train_lift",
                *TINY,
                "train_lift.iterations=1",
                "--out",
                str(tmp_path / "runs"),
            ]
        )
    assert done.value.code == 0
    out = capsys.readouterr().out
    assert "lift=mst_plus_plus lift.weights=" in out
    assert Path(out.splitlines()[-1], "mst_plus_plus.safetensors").is_file()
