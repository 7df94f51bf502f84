"""The protocol of the paper: wavelengths by the law of the recipe, every photograph, and tables
that survive a kill.
"""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.stats import kstest

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.evaluation import evaluation_scenes
from neusee.workflows.evaluation.evaluation_points import EvaluationPoints, PointRequest
from neusee.workflows.evaluation.evaluation_result import mistold_pipeline, points_of_scenes
from neusee.workflows.evaluation.evaluation_scenes import photographs, scenes, wavelengths
from neusee.workflows.evaluation.pipelines import (
    DRAWN,
    SIX,
    EvaluationRefused,
    NamedRecipe,
    compose_pipelines,
    read_pipelines,
    read_settings,
    refuse_fixed_laser,
)
from neusee.workflows.recipe.uncertain_inputs import Inputs
from neusee.workflows.store.result_store import Store

SMALL = ["optics.samples=96", "optics.pitch=84.15 um", "optics.bands=3", "optics.window=[24, 24]"]
SMALL += ["scene.shape=[32, 32]", "sensor.shape=[24, 24]"]
HERE = Path()


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """What no scene reaches is computed once."""
    return Store(tmp_path_factory.mktemp("protocol"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three photographs, each exactly a scene."""
    folder, rng = tmp_path_factory.mktemp("photographs"), np.random.default_rng(2)
    for name in "abc":
        coarse = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
        Image.fromarray(coarse).resize((32, 32), Image.Resampling.BICUBIC).save(
            folder / f"{name}.png"
        )
    return folder


def pipeline(text, *more):
    (one,) = compose_pipelines(
        NamedRecipe("paper_protocol", [*SMALL, *more], HERE), read_pipelines(text, HERE)
    )
    return one


def drawn(store, folder, count=None, *more):
    return scenes(load("paper_protocol", [*SMALL, *more]), store, folder, count, [DRAWN])[0]


def test_the_recipe_is_the_protocol_of_the_paper():
    recipe = load("paper_protocol")
    assert recipe.evaluation.scenes == "all"
    assert (
        recipe.steps["truth"].params["shape"]
        == recipe.steps["scene"].params["shape"]
        == (2048, 2048)
    )
    assert list(SIX) == ["violet", "blue", "cyan", "green", "yellow", "red", "none"]
    assert all(400e-9 <= metres <= 700e-9 for metres in SIX.values() if metres)


def test_every_photograph_is_in_one_scene(store, folder):
    shown = drawn(store, folder)
    assert sorted(scene.name for scene in shown) == ["a.png", "b.png", "c.png"]
    assert photographs(drawn(store, folder, 7)) == [0, 1, 2, 0, 1, 2, 0]
    # of one scene, lasers and noise are what is drawn
    assert photographs(drawn(store, None, 3)) == [0, 1, 2]


def test_wavelengths_follow_the_law_and_are_the_same_for_every_pipeline(store, folder):
    """Kolmogorov and Smirnov: 500 draws of a uniform law between 400 and 700 nm."""
    shown = drawn(store, folder, 500)
    found = wavelengths(pipeline("flat+none"), shown)
    assert found == wavelengths(pipeline("half_ring+wiener"), shown)
    assert len(set(found)) == 500
    assert kstest(np.array(found) * 1e9, "uniform", (400, 300)).pvalue > 0.01
    narrow = wavelengths(
        pipeline("flat+none", "lasers.drawn.wavelength=normal(550 nm, 1 nm)"), shown
    )
    assert np.std(narrow) == pytest.approx(1e-9, rel=0.15)


def test_a_point_with_a_drawn_wavelength_is_a_run_with_that_wavelength(tmp_path, store, folder):
    scene = drawn(store, folder)[1]
    fixed = ["sensor.c1=0", "sensor.c2=1", "sensor.exposure=0.1 s", "sensor.background=0.7"]
    mask = pipeline("five_half_rings+none", *fixed)
    (metres,) = wavelengths(mask, [scene])
    found = EvaluationPoints(store, 16).point(mask, PointRequest(scene, 1e4))
    laser = (
        f"lasers={{beam: {{wavelength: {metres!r} m, fwhm: 10 nm, strength: 1e4, angle: null}}}}"
    )
    own, inputs = (
        [*fixed, laser, f"seed={scene.seed}"],
        Inputs.of(mask.recipe(DRAWN), mask.pipeline.outputs),
    )
    for name in ("dark_current", "offset", "read_noise"):
        own.append(f"sensor.{name}={scene.draw(inputs)[f'sensor.{name}']!r} e-")
    recipe = load(
        "paper_protocol", [*SMALL, *own, f"scene.file={scene.path}", "doe=five_half_rings"]
    )
    wanted = run(recipe, Store(tmp_path), mask.pipeline.outputs)
    assert found["l1"] == float(wanted["developed_quality[mask]"].l1)
    assert found["peak"] == float(wanted["peak[mask]"].irradiance)


def test_a_restorer_that_is_told_an_error_of_zero_sees_the_drawn_values(store, folder):
    """Before, the copies of its steps hid the laws, so that the camera had other values than
    beside it.
    """
    scene, bench, true = (
        drawn(store, folder)[0],
        EvaluationPoints(store, 16),
        pipeline("half_ring+wiener"),
    )
    same = mistold_pipeline(true, "nothing", {"pupil[mask].defocus": 0.0})
    assert bench.point(same, PointRequest(scene, 1e3)) == bench.point(
        true, PointRequest(scene, 1e3)
    )


def test_a_photograph_that_cannot_be_decoded_costs_its_scene_and_no_other(
    store, folder, monkeypatch
):
    usual = evaluation_scenes.crop_photograph

    def damaged(path, *rest):
        if path.name == "b.png":
            raise OSError("broken data stream")
        return usual(path, *rest)

    monkeypatch.setattr(evaluation_scenes, "crop_photograph", damaged)
    shown, said = drawn(store, folder), list[str]()
    points, kept, broken = points_of_scenes(
        EvaluationPoints(store, 16), [pipeline("flat+none")], shown, (0.0,), said.append
    )
    assert sorted(scene.name for scene in kept) == ["a.png", "c.png"]
    assert len(points["flat+none"]) == 2
    assert [path.name for path, _ in broken] == ["b.png"]
    assert "broken data stream" in broken[0][1]
    assert "not read, and left out: b.png" in said


def test_a_laser_without_a_law_is_refused():
    with pytest.raises(
        EvaluationRefused, match=r"evaluate\.lasers is drawn, but no law says which wavelength"
    ):
        refuse_fixed_laser(load("paper_protocol", [*SMALL, "laser=green"]))
    with pytest.raises(EvaluationRefused, match=r"evaluate\.scenes"):
        read_settings(NamedRecipe("paper_protocol", [*SMALL, "evaluate.scenes=some"], HERE))


# --- the whole ------------------------------------------------------------------------------------

#: imports what takes seconds once, and forks for each run: store, and pictures before the kill
_PROGRAM = """
import json, os, signal, sys
from pathlib import Path
import neusee
from neusee.workflows.evaluation import evaluation_scenes
from neusee.workflows.evaluation.evaluation_points import EvaluationPoints
from neusee.workflows.recipe.uncertain_inputs import Inputs
from neusee.workflows.store.result_store import Store

import colour, matplotlib.figure
import neusee.workflows.evaluation.run_evaluation

real = EvaluationPoints._measure

def evaluated(store, last):
    seen = []

    def measured(self, *point):
        if len(seen) == last:
            os.kill(os.getpid(), signal.SIGKILL)
        seen.append(1)
        return real(self, *point)

    EvaluationPoints._measure = measured
    return str(neusee.evaluate("paper_protocol", changes=sys.argv[3:], data=sys.argv[1], store=Store(Path(store)),
        pipelines="flat+none, five_half_rings+none, five_half_rings+wiener", strengths=[0, 100], small=16,
        equal_protection=1e-4, out=store + "_runs"))

ends = []
for number, (store, last) in enumerate(json.loads(sys.argv[2])):
    if not (child := os.fork()):
        Path(f"out{number}").write_text(evaluated(store, last))
        sys.stderr.flush()
        os._exit(0)
    ends.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print(json.dumps(ends))
"""


def protocols(place, folder, *runs):
    """Return how each run of the protocol ended: its exit code, and the folder that it wrote."""
    runs = [(str(place / name), last) for name, last in runs]
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(folder), json.dumps(runs), *SMALL],
        capture_output=True,
        text=True,
        cwd=place,
    )
    assert done.returncode == 0, done.stderr
    wrote = [place / f"out{number}" for number in range(len(runs))]
    return json.loads(done.stdout.splitlines()[-1]), [
        path.read_text() if path.is_file() else done.stderr for path in wrote
    ]


@pytest.mark.slow
def test_a_killed_protocol_goes_on_and_its_tables_have_the_same_bytes(tmp_path, folder):
    """SIGKILL before the sixth picture and before the twenty-third; nothing depends on the
    clock.
    """
    count = 3 * 2 * 6  # scenes, strengths, and pipelines, half of them at equal protection
    runs = ("killed", 5), ("killed", 17), ("killed", 1000), ("whole", 1000)
    ends, wrote = protocols(tmp_path, folder, *runs)
    assert ends == [-signal.SIGKILL, -signal.SIGKILL, 0, 0], wrote[-1]
    first, second = (tmp_path / path.split()[-1] for path in wrote[2:])
    tables = sorted(path.name for path in second.glob("*.csv"))
    assert tables == ["mistold.csv", "points.csv", "protection.csv", "suppression.csv", "table.csv"]
    assert [(first / name).read_bytes() for name in tables] == [
        (second / name).read_bytes() for name in tables
    ]
    figures = sorted((second / "figures").glob("*.png"))
    assert [path.name for path in figures] == [
        "cases.png",
        "curves.png",
        "plane.png",
        "strengths.png",
        "wavelengths.png",
    ]
    assert [(first / "figures" / path.name).read_bytes() for path in figures] == [
        path.read_bytes() for path in figures
    ]
    said = [json.loads((path / "provenance.json").read_text()) for path in (first, second)]
    assert [document["computed"] for document in said] == [count - 5 - 17, count]
    with (second / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == count
    assert len({row["wavelength (nm)"] for row in rows}) == 3
    page = (second / "report.html").read_text()
    for heading in ("Equal protection", "Gain by strength over flat+none", "Error over wavelength"):
        assert f"{heading}</h2>" in page
    assert "Gain by strength over plain lens + filter 0.0001, not restored</h2>" in page


@pytest.mark.slow
def test_the_figure_has_six_lasers_and_the_pictures_of_the_sensors(store, folder):
    from neusee.workflows.evaluation.evaluation_result import panels

    each = [
        pipeline("flat+none"),
        pipeline("five_half_rings+none"),
        pipeline("five_half_rings+wiener"),
    ]
    shown = panels(
        EvaluationPoints(store, 16), each, replace(drawn(store, folder)[0]), [100.0], SIX
    )
    assert [panel.case for panel in shown] == list(SIX)
    assert [panel.strength for panel in shown] == [*[pytest.approx(1e4)] * 6, 0.0]
    assert list(shown[0].pictures) == [
        "truth",
        "plain lens",
        "five_half_rings, sensor",
        "five_half_rings+wiener",
    ]
