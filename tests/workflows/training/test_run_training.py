"""Learning: two stages from a clean start, the same pictures whoever asks, and a killed training
that goes on.
"""

import csv
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

import neusee
from neusee.nodes import optics
from neusee.nodes.doe import PARAMETRISATIONS
from neusee.nodes.scene import Photographs
from neusee.workflows import RecipeError, Store, as_function, load
from neusee.workflows.cli import app
from neusee.workflows.recipe.blocks.train_block import MaskSettings, Rates
from neusee.workflows.training import design_run
from neusee.workflows.training.resumable_loop import TrainingSession
from neusee.workflows.training.run_training import frozen, train
from neusee.workflows.training.training_pictures import PictureSource, Shared, TrainingStream
from tests.workflows.crate_rules import faults

ROOT = Path(__file__).parents[3]
TINY = [
    "optics.samples=64", "optics.pitch=126.2 um", "optics.bands=5", "optics.window=[48, 48]", "scene.shape=[48, 48]",
    "sensor.shape=[32, 32]", "doe.grid=32", "train.network.kind=unet", "train.network.width=4", "train.critics.width=4",
    "train.stages.1.iterations=4", "train.stages.2.iterations=3", "train.keep=2",
]  # fmt: skip

STILL = [word for word in TINY if not word.startswith("doe.")]

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def photographs(tmp_path):
    folder = tmp_path / "photographs" / "deep"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(5)
    for i, size in enumerate([(60, 70), (20, 24), (50, 50)]):
        coarse = Image.fromarray(rng.integers(0, 256, (5, 5, 3), dtype=np.uint8))
        coarse.resize(size[::-1], Image.Resampling.BICUBIC).save(folder / f"{i}.png")
    (folder / "broken.jpg").write_bytes(b"no picture")
    return folder.parent


@pytest.fixture
def tiny(photographs):
    return load("train_small", [*TINY, f"train.photographs={photographs}"])


def trained(recipe, folder, stages=(1, 2), watch=None):
    return train(
        recipe,
        TrainingSession(
            Store(folder / "store"),
            folder / "runs",
            lambda line: None,
            command=["neusee", "train"],
            watch=watch,
        ),
        stages,
    )


def pupil(recipe):
    return optics.stop(**recipe.steps["stop"].params)


def relief_of(recipe):
    start = PARAMETRISATIONS["doe.unet"]
    return start(pupil(recipe), recipe.steps["height"].params, torch.Generator().manual_seed(3))


def losses(folder):
    with (folder / "losses.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_both_stages_at_64_pixels_and_31_bands(tmp_path, photographs):
    small = ["train.stages.1.iterations=3", "train.stages.2.iterations=3", "train.stages.1.batch=2"]
    recipe = load("train_small", [*small, f"train.photographs={photographs}"])
    folder = trained(recipe, tmp_path, [1])
    before = (folder / "mask.safetensors").read_bytes()
    assert trained(recipe, tmp_path, [2]) == folder
    assert (folder / "mask.safetensors").read_bytes() == before
    rows = losses(folder)
    assert [(row["stage"], row["iteration"]) for row in rows] == [
        (s, i) for s in "12" for i in "012"
    ]
    assert all(np.isfinite(float(x)) for row in rows for x in row.values() if x)
    lsr = [float(row["LSR"]) for row in rows if row["LSR"]]
    assert lsr[-1] < lsr[0]
    height = load_file(folder / "mask.safetensors")["height"]
    assert height.shape == (128, 128)
    files = [
        f"doe.file={folder / 'mask.safetensors'}",
        f"restore.weights={folder / 'network.safetensors'}",
    ]
    own = [
        "doe=pixelwise",
        "restore=fft_mamba",
        "restore.width=16",
        *files,
        "outputs=[restored, lsr]",
    ]
    made = neusee.run(load("train_small", own), store=Store(tmp_path / "store"))
    assert made["restored"].shape == (3, 64, 64)
    assert (folder / "curves.png").stat().st_size > 10_000
    assert sorted(path.name for path in (folder / "pictures").iterdir()) == [
        "stage1_000003.png",
        "stage2_000003.png",
    ]


@pytest.mark.slow
def test_a_killed_training_goes_on_to_the_same_weights(tmp_path, tiny, photographs):
    whole = trained(tiny, tmp_path / "whole")
    code = f"""
import os, signal
from pathlib import Path
from neusee.workflows import Store, load
from neusee.workflows.training.resumable_loop import TrainingSession
from neusee.workflows.training.run_training import train
def watch(stage, done, found):
    if (stage, done) == (2, 1):
        os.kill(os.getpid(), signal.SIGKILL)
here = Path({str(tmp_path / "killed")!r})
recipe = load("train_small", {[*TINY, f"train.photographs={photographs}"]!r})
train(recipe, TrainingSession(Store(here / "store"), here / "runs", print, watch=watch))
"""
    env = {**os.environ, "PYTHONPATH": str(ROOT / ".src"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert list((tmp_path / "killed" / "runs").rglob("ro-crate-metadata.json")) == []
    again = trained(tiny, tmp_path / "killed")
    assert list(faults(again)) == []
    assert again.name == whole.name
    for name in ("mask.safetensors", "network.safetensors"):
        assert (again / name).read_bytes() == (whole / name).read_bytes(), name
    same = [[{**row, "seconds": ""} for row in losses(folder)] for folder in (whole, again)]
    assert same[0] == same[1]


def test_a_picture_is_the_same_in_whatever_order(tmp_path, tiny):
    sources = Photographs.under(tiny.training.photographs)
    samples = TrainingStream(tiny, tiny.training, PictureSource(sources, Store(tmp_path)))
    height = relief_of(tiny)(pupil(tiny))
    shared = Shared.of(samples.shared({"height": height})).values
    first = [samples(shared, 1, number) for number in (0, 1, 2)]
    again = [samples(shared, 1, number) for number in (2, 0, 1)]
    assert all(
        torch.equal(first[n].picture, x.picture) for n, x in zip((2, 0, 1), again, strict=True)
    )
    assert not torch.equal(first[0].picture, first[1].picture)
    assert not torch.equal(first[0].truth, samples(shared, 2, 0).truth)
    assert all(400e-9 <= x.drawn["lasers.drawn.wavelength"] <= 700e-9 for x in first)


def test_the_gradient_through_the_cut_is_the_whole_one(tmp_path):
    recipe = load("train_small", [*TINY, "laser=green", "sensor.read_noise=10 e-", "tolerance=0"])
    how = recipe.training
    samples = TrainingStream(
        recipe,
        how,
        PictureSource(Photographs((recipe.steps["scene"].params["file"],)), Store(tmp_path)),
    )
    relief = relief_of(recipe)
    shared = Shared.of(samples.shared({"height": relief(pupil(recipe))}))
    for number in (0, 1):
        sample = samples(shared.values, 1, number)
        (sample.picture - sample.truth).square().mean().backward()
    shared.back()
    cut = [p.grad.clone() for p in relief.parameters()]
    relief.zero_grad()
    loss = torch.zeros(())
    names = [*samples._readers, "scene", "height"]
    noise = [
        name
        for name, step in recipe.steps.items()
        if step.node.random and name.endswith(("[mask]", "[green]"))
    ]
    f = as_function(
        recipe, *names, outputs=[how.picture, how.truth], store=Store(tmp_path), redraw=noise
    )
    for number in (0, 1):
        seen = samples(shared.values, 1, number)
        theta = {
            **samples._readers,
            "height": relief(pupil(recipe)),
            "scene": _scene(samples, number),
        }
        theta |= samples._inputs.theta(
            {k: v for k, v in seen.drawn.items() if k in samples._inputs.names}
        )
        if seen.drawn.get("laser") == "none":
            theta |= dict.fromkeys(samples._lasers, 0.0)
        found = f(theta, seed=seen.drawn["noise"])
        loss = loss + (found[how.picture] - found[how.truth]).square().mean()
    loss.backward()
    for a, b in zip(cut, (p.grad for p in relief.parameters()), strict=True):
        assert float((a - b).norm()) <= 2e-4 * float(b.norm()) + 1e-9


def _scene(samples, number):
    return samples.photographs.crop(samples.shape, samples.seed, (1, number))


def samples_of(recipe, folder, still=False):
    sources = Photographs.under(recipe.training.photographs)
    return TrainingStream(
        recipe, recipe.training, PictureSource(sources, Store(folder)), recipe if still else None
    )


def test_patches_are_the_same_places_of_a_picture_and_its_truth(tmp_path, photographs):
    recipe = load("train_small", [*STILL, "doe=flat", f"train.photographs={photographs}"])
    whole = samples_of(recipe, tmp_path, still=True)({}, 2, 0)
    how = recipe.training.model_copy(update={"patch": (12, 9), "patches": 2})
    cut = samples_of(replace(recipe, training=how), tmp_path, still=True)({}, 2, 0)
    assert cut.picture.shape == cut.truth.shape == (2, 3, 12, 9)
    places = [(y, x) for y in range(21) for x in range(24)]
    for part, true in zip(cut.picture, cut.truth, strict=True):
        same = [
            (y, x)
            for y, x in places
            if torch.equal(whole.picture[0, :, y : y + 12, x : x + 9], part)
        ]
        assert len(same) == 1
        ((y, x),) = same
        assert torch.equal(whole.truth[0, :, y : y + 12, x : x + 9], true)
    too_large = replace(recipe, training=how.model_copy(update={"patch": (40, 9)}))
    with pytest.raises(
        ValueError,
        match=r"train\.patch: \[40, 9\] is larger than the picture \[32, 32\]: set a smaller patch",
    ):
        samples_of(too_large, tmp_path, still=True)({}, 2, 0)


def test_a_pool_comes_again_where_the_element_is_still(tmp_path, photographs):
    recipe = load(
        "train_small", [*STILL, "doe=flat", "train.pool=2", f"train.photographs={photographs}"]
    )
    samples = samples_of(recipe, tmp_path, still=True)
    first, second, third = (samples({}, 2, number) for number in range(3))
    assert third is first
    assert not torch.equal(first.picture, second.picture)
    again = samples_of(recipe, tmp_path, still=True)({}, 2, 2)  # as after a kill
    assert torch.equal(again.picture, first.picture)


@pytest.mark.slow
def test_a_network_is_learnt_behind_the_recipes_own_restorer(tmp_path, photographs):
    """It sees what the Wiener filter made, and in stage 1 the element is learnt through the
    filter.
    """
    words = [
        *STILL,
        "doe=half_ring",
        "doe.waves=[2]",
        "laser=none",
        "restore=wiener",
        "train.stages.1.iterations=1",
        f"train.photographs={photographs}",
    ]
    coded, filtered = (
        samples_of(load("train_small", [*words, *more]), tmp_path, still=True)({}, 2, 0)
        for more in ([], ["train.picture=restored"])
    )
    assert torch.equal(coded.truth, filtered.truth)
    far = [float((sample.picture - sample.truth).abs().mean()) for sample in (coded, filtered)]
    assert far[1] < 0.7 * far[0]
    alone = [
        "train.stages.1.batch=1",
        "train.stages.1.lsr=0",
        "train.stages.1.bsr=0",
        "train.stages.1.adversarial=0",
    ]
    recipe = load("train_small", [*words, *alone, "train.picture=restored"])
    folder = trained(recipe, tmp_path, [1])
    start = neusee.run(recipe, store=Store(tmp_path / "store"), outputs=["height"])["height"]
    learnt = load_file(folder / "mask.safetensors")["height"]
    moved = learnt - start - (learnt - start).mean()
    assert float(moved.abs().max()) > 1e-10  # a step of 2e-4 in a logit; rounding: 1e-13


@pytest.mark.slow
def test_a_network_is_learnt_behind_an_element_that_stays(tmp_path, photographs):
    words = [*STILL, "doe=half_ring", "train.learn=null", f"train.photographs={photographs}"]
    recipe = load("train_small", words)
    folder = trained(recipe, tmp_path, recipe.training.learnt)
    assert not (folder / "mask.safetensors").exists()
    assert [row["stage"] for row in losses(folder)] == ["2"] * 3
    with pytest.raises(ValueError, match="there is no stage 1"):
        trained(recipe, tmp_path, [1])


@pytest.mark.slow
def test_it_runs_as_printed_too(tmp_path, photographs):
    strength = 'lasers.drawn.strength="uniform(0, 2e6)"'
    recipe = load(
        "train_small", ["train=as_printed", *TINY, strength, f"train.photographs={photographs}"]
    )
    rows = losses(trained(recipe, tmp_path))
    assert len(rows) == 7
    assert all(np.isfinite(float(x)) for row in rows for x in row.values() if x)
    assert [bool(row["reconstruction"]) for row in rows] == [False] * 4 + [True] * 3


BOARD = pytest.mark.skipif(
    not importlib.util.find_spec("tensorboard"), reason='pip install -e ".[tensorboard]"'
)


@pytest.mark.slow
@BOARD
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of TensorBoard's own
def test_tensorboard_shows_each_iteration_once_and_the_pictures(tmp_path, photographs):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    changes = [*TINY, "train.tensorboard=true", "train.show=2", f"train.photographs={photographs}"]

    def stopped(stage, done, found):
        if (stage, done) == (1, 3):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(load("train_small", changes), tmp_path, watch=stopped)
    folder = trained(load("train_small", changes), tmp_path)
    assert (
        folder.name
        == trained(load("train_small", [*changes, "train.tensorboard=false"]), tmp_path).name
    )
    events = EventAccumulator(str(folder / "tensorboard")).Reload()
    assert {"LSR", "BSR", "L1", "critics", "rate"} <= set(events.Tags()["scalars"])
    shown = events.Scalars("L1")
    assert [event.step for event in shown] == list(range(7))
    assert [event.value for event in shown] == pytest.approx(
        [float(row["L1"]) for row in losses(folder)], rel=1e-5
    )
    assert [event.step for event in events.Scalars("LSR")] == list(range(4))
    assert [event.step for event in events.Images("stage 1")] == [1, 3]
    assert [event.step for event in events.Images("stage 2")] == [5, 6]


def test_tensorboard_that_is_not_installed_is_said_before_anything_is_learnt(
    tmp_path, photographs, monkeypatch
):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    recipe = load(
        "train_small", [*TINY, "train.tensorboard=true", f"train.photographs={photographs}"]
    )
    with pytest.raises(
        ValueError,
        match=(
            r'train.tensorboard: TensorBoard is not installed.*pip install -e "\.\[tensorboard\]"'
        ),
    ):
        trained(recipe, tmp_path)


def test_what_is_not_a_number_stops_and_is_kept(tmp_path, tiny, monkeypatch):
    from neusee.nodes import losses

    monkeypatch.setattr(losses, "charbonnier", lambda a, b: (a - b).mean() * float("nan"))
    with pytest.raises(
        ArithmeticError,
        match=(
            "stage 1, iteration 0, pictures 0 to 1: these numbers are NaN or infinite:"
            " reconstruction"
        ),
    ):
        trained(tiny, tmp_path)
    (folder,) = (tmp_path / "runs").iterdir()
    kept = torch.load(folder / "not_finite_1_0.pt", weights_only=True)
    assert {"mask", "net", "critics"} <= kept["parts"].keys()
    assert kept["pictures"] == [0, 1]
    assert not (folder / "network.safetensors").exists()


def test_the_second_stage_needs_the_first(tmp_path, tiny):
    with pytest.raises(ValueError, match="stage 2 cannot begin before the end of stage 1"):
        trained(tiny, tmp_path, [2])


@pytest.mark.slow
def test_a_training_that_goes_on_has_no_crate_until_it_ends(tmp_path, tiny):
    folder = trained(tiny, tmp_path, [1])
    assert list(faults(folder)) == []
    seen = []
    trained(
        tiny,
        tmp_path,
        [2],
        lambda *state: seen.append((folder / "ro-crate-metadata.json").exists()),
    )
    assert (set(seen), list(faults(folder))) == ({False}, [])


@pytest.mark.slow
def test_a_state_that_is_none_is_not_gone_on_from(tmp_path, photographs):
    tiny = load(
        "train_small", [*TINY, "train.stages.1.iterations=1", f"train.photographs={photographs}"]
    )
    folder = trained(tiny, tmp_path, [1])
    (folder / "state.pt").write_bytes(b"half")
    with pytest.raises(ValueError, match=r"state\.pt cannot be read"):
        trained(tiny, tmp_path)


def test_photographs_are_found_and_broken_ones_said(photographs, tmp_path):
    found = Photographs.under(photographs)
    assert [path.name for path in found.paths] == ["0.png", "1.png", "2.png"]
    assert [path.name for path in found.broken] == ["broken.jpg"]
    found.paths[1].unlink()
    pictures = [found.crop((30, 30), 1, i) for i in range(20)]
    assert {p.shape for p in pictures} == {(3, 30, 30)}
    assert [path.name for path in found.broken] == ["broken.jpg", "1.png"]
    assert len({float(p.sum()) for p in pictures}) > 10
    (tmp_path / "none").mkdir()
    with pytest.raises(ValueError, match="holds no readable photograph"):
        Photographs.under(tmp_path / "none")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("train.stages.1.iterations=-1", "train.stages.1.iterations"),
        ("+train.fish=1", "unknown; "),
        ("train.photographs=nowhere", "is not a folder"),
        ("train.network.kind=foo", "fft_mamba"),
        ("train.network.shuffle=9", "train.network.shuffle"),
    ],
)
def test_a_mistake_is_located(change, said):
    with pytest.raises(RecipeError, match=said) as caught:
        load("train_small", [change])
    assert all("argument 1" in str(problem.mark) for problem in caught.value.diagnostics)


def test_options_of_one_network_are_refused_of_another():
    with pytest.raises(
        RecipeError,
        match="shuffle: these options belong to the network fft_mamba, not to unet",
    ):
        load("train_small", ["train.network.kind=unet", "train.network.shuffle=4"])


@pytest.mark.slow
def test_a_network_with_options_is_learnt_and_restores_only_with_them(tmp_path, photographs):
    own = [*TINY, "train.network.kind=fft_mamba", "train.network.shuffle=4"]
    recipe = load(
        "train_small",
        [
            *own,
            "train.stages.1.batch=1",
            "train.stages.1.iterations=1",
            f"train.photographs={photographs}",
        ],
    )
    folder = trained(recipe, tmp_path, [1])
    run = [
        "restore=fft_mamba",
        "restore.width=4",
        f"restore.weights={folder / 'network.safetensors'}",
    ]
    with pytest.raises(RecipeError, match=r"this network \(width 4\) has"):
        load("first_light", run)
    load("first_light", [*run, "restore.shuffle=4"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("doe", "said"), [("flat", "which has no trainable parameters"), ("axicon", "")]
)
def test_only_what_learns_can_be_learnt(tmp_path, photographs, doe, said):
    short = ["train.stages.1.iterations=1", "train.stages.2.iterations=1"]
    recipe = load("train_small", [f"doe={doe}", *STILL, *short, f"train.photographs={photographs}"])
    if said:
        with pytest.raises(ValueError, match=said):
            trained(recipe, tmp_path)
    else:
        assert trained(recipe, tmp_path).is_dir()


def test_a_recipe_without_a_word_on_learning_is_refused(tmp_path):
    with pytest.raises(ValueError, match=re.escape("add `train: recommended`")):
        trained(load("first_light"), tmp_path)


def test_rates_fall_as_the_paper_prints_them():
    printed = Rates(factor=0.3, least=0)
    shares = [printed.share(i) for i in (0, 1999, 2000, 3000, 5000)]
    assert shares == pytest.approx([1, 1, 0.5, 0.15, 0.0135])
    assert 2e-4 * printed.share(10_000) == pytest.approx(6.6e-9, rel=0.01)


# --- the element without images -------------------------------------------------------------------

MASK = [
    "train.mask.iterations=4",
    "+train.mask.grid=32",
    "+train.mask.bands=3",
    "train.mask.max_height=3 um",
]


@pytest.fixture
def command(tmp_path, monkeypatch, capfd):
    """Call the command line in a folder of its own; the exit code, stdout and stderr."""
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "store"))
    monkeypatch.chdir(tmp_path)
    # they take longer than what is tested
    monkeypatch.setattr(design_run, "design_pictures", lambda *_: {})

    def call(*words):
        with pytest.raises(SystemExit) as end:
            app.main(["train", *words])
        return (end.value.code or 0, *capfd.readouterr())

    return call


@pytest.mark.slow
def test_a_mask_is_designed_and_stage_2_learns_behind_it(command, tmp_path, photographs):
    words = [
        "train_small",
        *TINY,
        *MASK,
        f"train.photographs={photographs}",
        "train.mask.feature=300 um",
        "mask.levels=16",
        "mask.max_height=3 um",
    ]
    code, out, err = command(*words, "--stage", "mask")
    assert (code, err) == (0, "")
    assert "levels 16, greatest height 3 um, least feature 300 um" in out
    folder = Path(out.splitlines()[-1])
    height = load_file(folder / "mask.safetensors")["height"]
    assert height.shape == (64, 64)
    assert "least feature" in (folder / "report.html").read_text()
    made = json.loads((folder / "mask.json").read_text())
    assert made["fabrication"] == {
        "levels": 16,
        "max_height": 3e-6,
        "wrap_at": None,
        "feature": 3e-4,
    }
    assert not (folder / "mask.state").exists()
    before = (folder / "mask.safetensors").stat().st_mtime_ns
    assert list(faults(folder)) == []
    assert "the mask is already designed" in command(*words, "--stage", "mask")[1]
    for stage in ("1", "both"):
        code, _, err = command(*words, "--stage", stage)
        assert code != 0
        assert "was designed without images: continue with --stage 2" in err
    code, out, err = command(*words, "--stage", "2", "--quiet")
    assert (code, Path(out.strip()), err) == (0, folder, "")
    assert (folder / "mask.safetensors").stat().st_mtime_ns == before
    assert list(faults(folder)) == []
    assert [(row["stage"], row["iteration"]) for row in losses(folder)] == [("2", i) for i in "012"]
    assert json.loads((folder / "training.json").read_text())["mask"] == "designed without images"
    assert torch.equal(_element_of(words, folder), height)


def _element_of(words, folder):
    """The relief that stage 2 sees."""
    recipe = load(words[0], words[1:])
    return neusee.run(
        frozen(recipe, recipe.training, folder), store=Store(folder / "own"), outputs=["height"]
    )["height"]


@pytest.mark.slow
def test_a_mask_is_designed_where_nothing_else_could_learn(command, tmp_path, photographs):
    changes = [c for c in TINY if not c.startswith("doe.")]
    words = [
        "train_small",
        "doe=flat",
        *changes,
        "train.mask.kind=five_half_rings",
        "train.mask.iterations=1",
        "+train.mask.population=5",
        "+train.mask.polish=5",
        "+train.mask.bands=2",
        f"train.photographs={photographs}",
    ]
    assert "which has no trainable parameters" in command(*words)[2]
    code, out, err = command(*words, "--stage", "mask")
    assert (code, err) == (0, "")
    assert "too steep for the samples of the pupil" in out
    code, out, err = command(*words, "--stage", "2", "--quiet")
    assert (code, err) == (0, "")
    assert (Path(out.strip()) / "network.safetensors").is_file()


@pytest.mark.slow
def test_a_mask_is_not_designed_over_one_that_learns(tmp_path, photographs):
    tiny = load(
        "train_small", [*TINY, "train.stages.1.iterations=1", f"train.photographs={photographs}"]
    )
    folder = trained(tiny, tmp_path, [1])
    before = (folder / "mask.safetensors").read_bytes()
    with pytest.raises(ValueError, match="training stage 1 has begun"):
        trained(tiny, tmp_path, [0])
    assert (folder / "mask.safetensors").read_bytes() == before


def test_the_recommended_mask_is_that_of_trainings_that_say_nothing_of_it():
    """Else a training that was begun without a word on masks would begin anew."""
    assert load("train_small").training.mask == MaskSettings()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("train.mask.kind=cubic", "train.mask.kind: .*five_half_rings"),
        ("+train.mask.fish=1", "train.mask.fish: unknown; "),
        ("+train.mask.weights.lsrr=1", "train.mask.weights.lsrr: unknown; .*lsr"),
        ("train.mask.max_height=3", "train.mask.max_height: .*needs a unit"),
        ("+train.mask.slopes=[9, 3]", "train.mask: .*write the smaller slope first"),
        ("+train.mask.start=no.npy", "train.mask.start: .*no such file"),
    ],
)
def test_a_mistake_of_the_mask_is_located(change, said):
    with pytest.raises(RecipeError) as caught:
        load("train_small", [change])
    (problem,) = caught.value.diagnostics
    assert re.search(said, f"{problem.path}: {problem.message}")
    if "slopes" not in change:
        assert "argument 1" in str(problem.mark)
