"""The protocol of the paper: points are runs, intervals those of closed forms, what was stopped
goes on.
"""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

import neusee
from neusee.nodes.metrics import quality
from neusee.nodes.resampling import resize
from neusee.workflows import load
from neusee.workflows.cli.app import app
from neusee.workflows.engine.runner import run
from neusee.workflows.evaluation import evaluation_points
from neusee.workflows.evaluation.confidence_intervals import gain, mean, metric_table
from neusee.workflows.evaluation.evaluation_points import EvaluationPoints, PointRequest
from neusee.workflows.evaluation.evaluation_scenes import refuse_directions, scenes
from neusee.workflows.evaluation.pipelines import (
    CASES,
    EvaluationRefused,
    NamedRecipe,
    compose_pipelines,
    read_pipelines,
)
from neusee.workflows.recipe.uncertain_inputs import Inputs
from neusee.workflows.store.result_store import Store

SMALL = ["optics.samples=96", "optics.pitch=84.15 um", "optics.bands=5", "optics.window=[24, 24]"]
SMALL += ["scene.shape=[32, 32]", "sensor.shape=[24, 24]"]
HERE = Path()
BARE = "flat+none, five_half_rings+none"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """What no scene reaches is computed once."""
    return Store(tmp_path_factory.mktemp("evaluate"))


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Four photographs of which one is exactly a scene, and a broken file."""
    folder = tmp_path_factory.mktemp("photographs")
    rng = np.random.default_rng(2)
    for name, size in (("a.png", (40, 50)), ("b.jpg", (64, 40)), ("c.png", (20, 24))):
        coarse = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
        Image.fromarray(coarse).resize(size[::-1], Image.Resampling.BICUBIC).save(folder / name)
    (folder / "broken.jpg").write_bytes(b"\xff\xd8 nothing")
    return folder


def pipelines(text, *more):
    return compose_pipelines(
        NamedRecipe("first_light", [*SMALL, *more], HERE), read_pipelines(text, HERE)
    )


def by_hand(tmp_path, scene, pipeline, strength, more=()):
    """The recipe with the scene in a file and the laser as anyone would write them."""
    line = pipeline.pipeline
    laser = "lasers={}"
    if scene.case != "none" and strength:
        metres = CASES[scene.case]
        laser = (
            f"lasers={{beam: {{wavelength: {metres * 1e9:g} nm, fwhm: 10 nm, strength: {strength},"
            " angle: null}}"
        )
    words = [f"doe={line.mask}", laser, f"seed={scene.seed}", f"scene.file={scene.path}"]
    words += [f"restore={line.restorer}"] if line.restorer != "none" else []
    recipe = load("first_light", [*SMALL, *words, *more])
    return run(recipe, Store(tmp_path / "by_hand"), line.outputs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "strength"), [("five_half_rings+none", 1e4), ("flat+wiener", 1e5), ("flat+none", 0.0)]
)
def test_a_point_is_a_run_with_its_values_to_the_last_bit(tmp_path, store, name, strength):
    rng = np.random.default_rng(1)
    for i in range(2):
        Image.fromarray(rng.integers(0, 256, (32, 32, 3), dtype=np.uint8)).save(
            tmp_path / f"{i}.png"
        )
    (pipeline,) = pipelines(name)
    shown, _ = scenes(load("first_light", SMALL), store, tmp_path, 2, list(CASES))
    scene = shown[1]
    found = EvaluationPoints(store, 16).point(pipeline, PointRequest(scene, strength))
    wanted = by_hand(tmp_path, scene, pipeline, strength)
    step = pipeline.pipeline
    assert {k: found[k] for k in ("l1", "psnr", "ssim")} == {
        k: float(x) for k, x in wanted[step.quality]._asdict().items()
    }
    assert found["saturated"] == float(wanted["saturated[mask]"].pixels)
    assert found["peak"] == float(wanted["peak[mask]"].irradiance)
    assert found["bsr"] == wanted["bsr[mask]"].tolist()
    small = quality(*(resize(wanted[k].clamp(0, 1), 16, 16) for k in (step.picture, "truth")))
    assert found["l1 small"] == float(small.l1)


@pytest.mark.slow
def test_what_a_recipe_has_laws_for_is_drawn_for_each_scene(tmp_path, store):
    """The paper's sampling: a run with the drawn values, the same for all masks and strengths of
    a scene.
    """
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (32, 32, 3), dtype=np.uint8)).save(
        tmp_path / "0.png"
    )
    laws = {
        "sensor.c1": "uniform(0, 0.25)",
        "sensor.background": "uniform(0.3, 0.7)",
        "sensor.offset": "uniform(350 e-, 400 e-)",
    }
    each = pipelines(BARE, *(f"{name}={law}" for name, law in laws.items()))
    shown, _ = scenes(load("first_light", SMALL), store, tmp_path, 2, list(CASES))
    bench, seen = EvaluationPoints(store, 16), list[dict[str, float]]()
    for scene in shown:
        for pipeline in each:
            recipe = pipeline.recipe(scene.case)
            seen.append(scene.draw(Inputs.of(recipe, pipeline.pipeline.outputs)))
            units = {
                name: f"{value!r} e-" if name == "sensor.offset" else repr(value)
                for name, value in seen[-1].items()
            }
            wanted = by_hand(
                tmp_path, scene, pipeline, 1e4, [f"{name}={text}" for name, text in units.items()]
            )
            found = bench.point(pipeline, PointRequest(scene, 1e4))
            assert found["l1"] == float(wanted[pipeline.pipeline.quality].l1)
            assert found["peak"] == float(wanted["peak[mask]"].irradiance)
    assert seen[0] == seen[1] != seen[2] == seen[3]
    assert seen[0].keys() == laws.keys()
    assert 0 < seen[0]["sensor.c1"] < 0.25
    (plain, _), (still, _) = each, pipelines(BARE)
    dark = PointRequest(replace(shown[0], case="none"), 0.0)
    assert bench.key(plain, dark) != bench.key(still, dark)


def test_what_several_points_share_is_computed_once(store, monkeypatch):
    each = pipelines(BARE)
    shown, _ = scenes(load("first_light", SMALL), store, None, 1, list(CASES))
    called = []
    real = evaluation_points.call

    def counted(step, *rest):
        called.append(step.name)
        return real(step, *rest)

    bench = EvaluationPoints(store, 24)
    monkeypatch.setattr(evaluation_points, "call", counted)
    for strength in (1e2, 1e3):
        for pipeline in each:
            bench.values(pipeline, PointRequest(shown[0], strength))
    assert called.count("image[plain].channels") == called.count("level") == 1
    # one a mask
    assert called.count("laser_psf[mask,beam]") == called.count("image[mask].channels") == 2
    assert called.count("spot[mask,beam]") == called.count("raw[mask]") == 4


@pytest.mark.slow
def test_a_key_hangs_on_all_that_decides_a_point(store, photographs):
    keys = set()
    for more, small, number, case, strength in (
        ([], 16, 0, "violet", 1e3),
        ([], 12, 0, "violet", 1e3),
        ([], 16, 1, "violet", 1e3),
        ([], 16, 0, "blue", 1e3),
        ([], 16, 0, "violet", 1e4),
        ([], 16, 0, "none", 1e4),
        (["sensor.bits=12"], 16, 0, "violet", 1e3),
        (["tolerance=1e-4"], 16, 0, "violet", 1e3),
        (["seed=8"], 16, 0, "violet", 1e3),
    ):
        (pipeline,) = pipelines("flat+none", *more)
        shown, _ = scenes(load("first_light", [*SMALL, *more]), store, photographs, 2, list(CASES))
        scene = replace(shown[number], case=case)
        keys.add(EvaluationPoints(store, small).key(pipeline, PointRequest(scene, strength)))
    assert len(keys) == 9


def test_the_same_point_of_another_order_is_the_same(store, tmp_path):
    each = pipelines("five_half_rings+none")
    shown, _ = scenes(load("first_light", SMALL), store, None, 3, list(CASES))
    wanted = [PointRequest(scene, 1e4) for scene in shown]
    one, other = (
        EvaluationPoints(Store(tmp_path / "one"), 24),
        EvaluationPoints(Store(tmp_path / "other"), 24),
    )
    ahead = [one.point(each[0], w) for w in wanted]
    back = [other.point(each[0], w) for w in reversed(wanted)]
    assert ahead == back[::-1]


# --- statistics -----------------------------------------------------------------------------------


def test_an_interval_is_that_of_students_table():
    """Ten values of deviation s: mean ± 2.262 s / sqrt(10)."""
    x = np.arange(10.0)
    found = mean(x)
    assert found.mean == 4.5
    assert found.half == pytest.approx(2.262157 * x.std(ddof=1) / math.sqrt(10), rel=1e-6)
    assert math.isnan(mean([1.0]).half)
    assert not mean([1.0]).excludes_zero


def test_intervals_cover_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(1)
    held = [abs(f.mean) <= f.half for f in (mean(rng.standard_normal(8)) for _ in range(2000))]
    assert np.mean(held) == pytest.approx(0.95, abs=0.015)


def test_pairs_see_what_scatter_between_scenes_hides():
    rng = np.random.default_rng(1)
    reference = 1 + rng.random(30)
    values = 0.95 * reference + 1e-3 * rng.standard_normal(30)
    assert mean(reference - values).excludes_zero
    share = gain(values, reference, np.arange(30), 7)
    assert share.mean == pytest.approx(0.05, abs=1e-3)
    assert share.half < 2e-3
    assert share == gain(values, reference, np.arange(30), 7)


def test_the_interval_of_a_gain_is_that_of_the_delta_method():
    rng = np.random.default_rng(3)
    reference, values = 1 + 0.2 * rng.random(200), 0.9 + 0.2 * rng.random(200)
    ratio = values.mean() / reference.mean()
    spread = (values - ratio * reference).std(ddof=1) / reference.mean() / math.sqrt(200)
    assert gain(values, reference, np.arange(200), 1).half == pytest.approx(1.96 * spread, rel=0.05)


def test_a_scene_without_a_laser_counts_at_no_strength_but_none():
    point = dict.fromkeys(
        ("l1", "psnr", "ssim", "l1 small", "psnr small", "ssim small", "saturated", "peak", "above")
    )
    found = metric_table(
        [{0.0: {**point, "l1": 1.0}, 10.0: {**point, "l1": 3.0}}, {0.0: {**point, "l1": 5.0}}],
        (0.0, 10.0),
    )
    assert found.scenes("l1").tolist() == [2.0, 5.0]
    assert found.at("l1", 1).mean == 3.0


# --- what cannot be -------------------------------------------------------------------------------


def test_every_mistake_is_said_before_anything_runs(tmp_path):
    with pytest.raises(EvaluationRefused) as error:
        read_pipelines("flat, flat+none, flat+none, pixelwise@gone.npy+wiener", tmp_path)
    said = str(error.value).splitlines()
    assert len(said) == 3
    assert "write MASK+RESTORER" in said[0]
    assert f"no such file: {tmp_path / 'gone.npy'}" in said[1]
    assert said[2] == "flat+none is listed twice: remove one"
    (tmp_path / "net.safetensors").write_bytes(b"nothing")
    words = (
        "falt+none, flat+wener, flat+nafnet@net.safetensors, flat+unet, flat@net.safetensors+none"
    )
    asked = read_pipelines(words, tmp_path)
    with pytest.raises(EvaluationRefused) as error:
        compose_pipelines(NamedRecipe("first_light", SMALL, tmp_path), asked)
    said = str(error.value)
    for part in (
        "falt+none: argument 7 doe=falt no option falt",
        "flat+wener: argument 8 restore=wener no option wener",
        "is not a safetensors file",
        "flat+unet:",
        "needs trained weights",
        "flat takes no file: remove @ and the file name",
    ):
        assert part in said, said
    assert said.count("falt+none:") == 1


def test_weights_of_another_network_are_refused(tmp_path):
    from safetensors.torch import save_file

    save_file({"first.weight": torch.zeros(3)}, tmp_path / "net.safetensors")
    with pytest.raises(
        EvaluationRefused, match=r"flat\+nafnet@net.safetensors: .*this network \(width 16\) has"
    ):
        compose_pipelines(
            NamedRecipe("first_light", SMALL, tmp_path),
            read_pipelines("flat+nafnet@net.safetensors", tmp_path),
        )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--data", "nowhere"], "--data nowhere: this folder does not exist"),
        (["--data", "empty"], "--data empty: the folder contains no readable PNG or JPEG file"),
        (["--strengths", "0,lots"], "--strengths: lots is no number"),
        (
            ["--strengths", "-1"],
            "--strengths: write finite multiples of saturation that are not negative",
        ),
        (["--reference", "flat+wiener"], "--reference flat+wiener is not evaluated: write one of"),
        (["--pipelines", "flat"], "flat: write MASK+RESTORER"),
    ],
)
def test_an_argument_that_cannot_be_ends_with_one_line(tmp_path, monkeypatch, options, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "store"))
    done = CliRunner().invoke(
        app, ["evaluate", "first_light", *SMALL, "--pipelines", "flat+none", *options]
    )
    assert done.exit_code == 2
    assert said in done.stderr
    assert not (tmp_path / "runs").exists()


# --- the whole ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_evaluation_writes_its_folder_and_goes_on_where_it_was_stopped(
    tmp_path, store, photographs, monkeypatch
):
    how = {
        "pipelines": read_pipelines(BARE, HERE),
        "changes": SMALL,
        "out": tmp_path,
        "data": photographs,
        "scenes": 6,
        "strengths": (0, 1e4),
        "small": 16,
        "store": store,
    }
    real, seen = EvaluationPoints._numbers, []

    def stops(self, pipeline, values):
        seen.append(pipeline.name)
        if len(seen) == 9:
            raise KeyboardInterrupt
        return real(self, pipeline, values)

    monkeypatch.setattr(EvaluationPoints, "_numbers", stops)
    with pytest.raises(KeyboardInterrupt):
        neusee.evaluate("first_light", **how)
    lines = []
    folder = neusee.evaluate("first_light", progress=lines.append, **how)
    doc = json.loads((folder / "provenance.json").read_text())
    count = 2 * (5 * 2 + 1)  # of the scene without a laser there is one strength
    assert doc["computed"] == count - 8
    with (folder / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == count
    assert [row["laser"] for row in rows[: count // 2] if row["strength"] == "0"] == list(CASES)
    assert any("not read: broken.jpg" in line for line in lines)
    page = (folder / "report.html").read_text()
    assert page.count("<img") == 4
    assert "broken.jpg" in page
    assert "<th>PSNR (dB)</th>" in page
    # a number may stand above its interval, so that the wide table fits
    assert " ±\N{NO-BREAK SPACE}" in page
    assert "\N{NO-BREAK SPACE}±" not in page
    with (folder / "table.csv").open() as file:
        first, second = csv.DictReader(file)
    own = np.array([float(r["l1"]) for r in rows if r["pipeline"] == "five_half_rings+none"])
    each = [*own[:10].reshape(5, 2).mean(1), own[10]]
    assert float(second["l1 mean"]) == pytest.approx(np.mean(each), rel=1e-12)
    assert float(first["l1 gain mean"]) == 0.0
    with (folder / "suppression.csv").open() as file:
        curves = list(csv.DictReader(file))
    assert len(curves) == 2 * 5
    assert all(
        float(r["lsr"]) == pytest.approx(1.0, rel=1e-4) for r in curves if r["mask"] == "flat"
    )


def test_a_scene_keeps_its_picture_no_longer_than_it_is_used(store):
    shown, _ = scenes(load("first_light", SMALL), store, None, 1, list(CASES))
    alone = replace(shown[0])
    assert alone.picture.shape == (3, 32, 32)
    assert "picture" not in vars(shown[0])


def test_a_drawn_direction_beyond_the_reach_of_the_pupil_is_refused_before_work(store):
    """Before, the evaluation of `first_light` as shipped ended in its second scene."""
    shown, _ = scenes(load("first_light"), store, None, 3, list(CASES))
    first, *_ = compose_pipelines(
        NamedRecipe("first_light", [], HERE), read_pipelines("flat+none", HERE)
    )
    with pytest.raises(
        EvaluationRefused,
        match=r"scene 2 \(blue\): .*carries only 1.61 mm.*\n.*smaller sensor.shape",
    ):
        refuse_directions(first, shown)
    room = ["sensor.shape=[512,512]", "scene.shape=[576,576]"]
    fitting, *_ = compose_pipelines(
        NamedRecipe("first_light", room, HERE), read_pipelines("flat+none", HERE)
    )
    refuse_directions(fitting, scenes(load("first_light", room), store, None, 3, list(CASES))[0])
