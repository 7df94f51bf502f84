"""Held-out photographs: the same split whatever the names, a validation that agrees with NumPy,
and the best state.
"""

import csv
import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file
from scipy import stats

from neusee.nodes.scene import Photographs, crop_photograph
from neusee.nodes.scene import _photograph as _photograph_folder
from neusee.workflows import RecipeError, Store, load
from neusee.workflows.training.held_out import COLUMNS, Validation, interval, split
from neusee.workflows.training.process_mesh import ALONE
from neusee.workflows.training.resumable_loop import TrainingSession
from neusee.workflows.training.run_training import train
from neusee.workflows.training.training_pictures import PictureSource, Shared, TrainingStream

TINY = [
    "optics.samples=48", "optics.pitch=168.27 um", "optics.bands=3", "optics.window=[32, 32]", "scene.shape=[32, 32]",
    "sensor.shape=[24, 24]", "doe=flat", "train.learn=null", "train.network.kind=unet", "train.network.width=4",
    "train.critics.width=4", "train.stages.2.iterations=6", "train.stages.2.adversarial=0", "train.keep=4",
    "train.validate_every=2", "train.held_out=0.4", "train.average=0.5", "train.rates.weights=3e-3",
]  # fmt: skip

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("photographs")
    rng = np.random.default_rng(5)
    for i in range(5):
        coarse = Image.fromarray(rng.integers(0, 256, (5, 5, 3), dtype=np.uint8))
        coarse.resize((40, 36), Image.Resampling.BICUBIC).save(root / f"{i}.png")
    return root


def tiny(folder, *words):
    return load("train_small", [*TINY, f"train.photographs={folder}", *words])


def parts_of(folder, *words):
    recipe = tiny(folder, *words)
    return split(recipe, recipe.training, Photographs.under(folder))


def content(paths):
    return sorted(path.read_bytes() for path in paths)


def trained(recipe, folder, watch=None, lines=None):
    said = (lines if lines is not None else []).append
    return train(
        recipe, TrainingSession(Store(folder / "store"), folder / "runs", said, watch=watch), (2,)
    )


def rows_of(folder):
    with (folder / "losses.csv").open(newline="") as file:
        return list(csv.DictReader(file))


# --- the split ------------------------------------------------------------------------------------


def test_the_split_follows_the_content_and_not_the_names(tmp_path, folder):
    found = parts_of(folder)
    assert (len(found.held_out), len(found.trained.paths)) == (2, 3)
    assert not set(found.held_out) & set(found.trained.paths)
    for i, path in enumerate(sorted(folder.iterdir(), reverse=True)):
        shutil.copy(path, tmp_path / f"renamed_{i}.png")
    shutil.copy(found.held_out[0], tmp_path / "a_copy.png")
    renamed = parts_of(tmp_path)
    assert set(content(renamed.held_out)) == set(content(found.held_out))
    assert len(renamed.held_out) == 3, "a copy of a held-out photograph is held out"
    assert len(renamed.judged) == 2, "and counts once"


def test_few_photographs_are_refused_where_they_stand_unless_none_is_held_out(tmp_path, folder):
    for name in ("one.png", "same.png"):
        shutil.copy(folder / "0.png", tmp_path / name)
        said = rf"train\.photographs   the folder {tmp_path} holds .*write train\.held_out=null"
        with pytest.raises(ValueError, match=rf"argument \d+   {said}"):
            trained(tiny(tmp_path), tmp_path)
    assert parts_of(tmp_path, "train.held_out=null").held_out == ()


def test_a_photograph_that_cannot_be_decoded_is_held_out_and_not_restored(folder, monkeypatch):
    bad = parts_of(folder).held_out[0]
    usual = crop_photograph

    def damaged(path, *rest):
        if path == bad:
            raise OSError("broken data stream")
        return usual(path, *rest)

    monkeypatch.setattr(_photograph_folder, "crop_photograph", damaged)
    found = parts_of(folder)
    assert bad in found.held_out
    assert len(found.judged) == 1
    assert "broken data stream" in found.trained.broken[bad]
    assert "2 are held out, of which 1 are restored" in str(found)


def test_patience_without_held_out_photographs_is_a_mistake(folder):
    with pytest.raises(RecipeError, match="patience: without held-out pictures no improvement"):
        tiny(folder, "train.held_out=null", "train.patience=3")


def test_the_photograph_of_the_recipe_alone_holds_nothing_out():
    recipe = load("train_small", TINY)
    assert (
        split(
            recipe, recipe.training, Photographs((recipe.steps["scene"].params["file"],))
        ).held_out
        == ()
    )


@pytest.mark.slow
def test_no_crop_of_a_held_out_photograph_is_trained_on(tmp_path, folder):
    """Photographs of one colour each, so that the colour of any crop says from which photograph
    it is.
    """
    for i in range(5):
        Image.new("RGB", (40, 36), (40 * i + 20, 0, 0)).save(tmp_path / f"{i}.png")
    recipe = tiny(tmp_path)
    parts = split(recipe, recipe.training, Photographs.under(tmp_path))
    red = {
        path: float(Photographs((path,)).crop((8, 8), 1, 1)[0, 0, 0])
        for path in sorted(tmp_path.glob("*.png"))
    }
    stream = TrainingStream(
        recipe,
        recipe.training,
        PictureSource(parts.trained, Store(tmp_path), mesh=ALONE, held_out=parts.judged),
        recipe,
    )
    for stage, allowed in ((1, parts.trained.paths), (2, parts.trained.paths), (3, parts.judged)):
        count = 24 if stage != 3 else len(parts.judged)
        seen = {float(stream._drawn(stage, n)[0]["scene"][0, 0, 0]) for n in range(count)}
        assert seen == {red[path] for path in allowed}


# --- the validation -------------------------------------------------------------------------------


def test_the_interval_is_that_of_student():
    values = [21.0, 24.5, 19.2, 30.1]
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.9)
    assert interval(values) == pytest.approx((np.mean(values), low, high), rel=1e-12)


def test_a_validation_agrees_with_numpy_and_repeats(tmp_path, folder):
    recipe = tiny(folder)
    parts = split(recipe, recipe.training, Photographs.under(folder))
    stream = TrainingStream(
        recipe,
        recipe.training,
        PictureSource(parts.trained, Store(tmp_path), mesh=ALONE, held_out=parts.judged),
        recipe,
    )
    net = torch.nn.Identity()
    net.train()
    judge = Validation(parts, ALONE, "cpu")
    found = judge(net, stream, Shared.of({}), False)
    assert net.training
    assert (
        judge(net, stream, Shared.of({}), True) == judge(net, stream, Shared.of({}), True) == found
    )
    each = []
    for number in range(2):
        sample = stream({}, 3, number)
        a, b = (np.clip(x[0].double().numpy(), 0, 1) for x in (sample.picture, sample.truth))
        a, b = (np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055) for x in (a, b))
        each.append((-10 * np.log10(((a - b) ** 2).mean()), np.abs(a - b).mean()))
    psnr, l1 = np.mean(each, axis=0)
    assert found["input_PSNR"] == found["held_out_PSNR"] == pytest.approx(psnr, abs=1e-4)
    assert found["input_L1"] == pytest.approx(l1, rel=1e-4)
    assert found["gain_PSNR"] == found["gain_PSNR_low"] == 0.0
    assert found["held_out_PSNR_low"] < psnr < found["held_out_PSNR_high"]


@pytest.mark.slow
def test_the_best_state_is_kept_and_a_stopped_training_finds_the_same(tmp_path, folder):
    recipe = tiny(folder)
    lines = []
    whole = trained(recipe, tmp_path / "whole", lines=lines)
    assert lines[0] == "trains on 3 photographs; 2 are held out"
    rows = rows_of(whole)
    assert [bool(row["held_out_PSNR"]) for row in rows] == [False, True] * 3
    about = json.loads((whole / "training.json").read_text())
    scores = {
        int(row["iteration"]) + 1: float(row["held_out_PSNR"])
        for row in rows
        if row["held_out_PSNR"]
    }
    assert about["best"]["iterations"] == max(scores, key=scores.get)
    assert len(about["held_out"]) == 2

    def stopped(stage, done, found):
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(recipe, tmp_path / "again", stopped)
    again = trained(recipe, tmp_path / "again")
    for name in ("best.safetensors", "network.safetensors"):
        assert (again / name).read_bytes() == (whole / name).read_bytes(), name
    same = [[{**row, "seconds": ""} for row in rows_of(one)] for one in (whole, again)]
    assert same[0] == same[1]


@pytest.mark.slow
def test_a_training_that_gets_worse_stops_early_and_keeps_its_best(tmp_path, folder, monkeypatch):
    scores = iter([20.0, 19.0, 20.0, 25.0])

    def worse(self, *_):
        return dict.fromkeys(COLUMNS, next(scores))

    monkeypatch.setattr(Validation, "__call__", worse)
    recipe = tiny(folder, "train.validate_every=1", "train.patience=2", "train.average=0")
    found = trained(recipe, tmp_path)
    assert [row["held_out_PSNR"] for row in rows_of(found)] == ["20", "19", "20"]
    about = json.loads((found / "training.json").read_text())
    assert (about["best"]["iterations"], about["stopped_early"]) == (1, True)
    best, last = (load_file(found / f"{name}.safetensors") for name in ("best", "network"))
    assert any(not torch.equal(best[name], x) for name, x in last.items())
    assert trained(recipe, tmp_path) == found, "a training that stopped early is finished"
