"""An evaluation at equal protection: every peak is the wanted one, rows say how, and what cannot
be is refused.
"""

import csv
import html
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import neusee
from neusee.nodes import metrics
from neusee.workflows import load
from neusee.workflows.cli.app import app
from neusee.workflows.engine.runner import run
from neusee.workflows.evaluation.pipelines import (
    NONE,
    EvaluationRefused,
    NamedRecipe,
    compose_pipelines,
    protect,
    read_pipelines,
)
from neusee.workflows.protection.equal_rivals import EqualProtection
from neusee.workflows.store.result_store import Store

SMALL = ["optics.samples=96", "optics.pitch=84.15 um", "optics.bands=3", "optics.window=[24, 24]"]
SMALL += ["scene.shape=[32, 32]", "sensor.shape=[24, 24]"]
HERE = Path()
PAIR = "flat+wiener, five_half_rings+none"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """What no pipeline changes is computed once."""
    return Store(tmp_path_factory.mktemp("equal"))


def protected(store, level, way="filter", text=PAIR, said=print):
    each = compose_pipelines(NamedRecipe("first_light", SMALL, HERE), read_pipelines(text, HERE))
    return protect(
        NamedRecipe("first_light", SMALL, HERE), each, EqualProtection(level, way), store, said
    )


def values(pipeline, store, *names):
    return run(pipeline.recipe(NONE), store, names).values


@pytest.mark.slow
def test_every_pipeline_gets_the_filter_that_brings_its_peak_to_the_level(store):
    plain, mask = protected(store, 5e-4)
    assert plain.name == "plain lens + filter 0.0005, wiener"
    assert plain.pipeline.shade.transmittance == pytest.approx(5e-4, rel=1e-5)
    bare = run(
        load("first_light", [*SMALL, "doe=five_half_rings", "lasers={}"]), store, ["psf[mask]"]
    ).values
    grey = 5e-4 / float(metrics.lsr(bare["psf[mask]"]).max())
    assert mask.name == f"five half-rings + filter {grey:.2g}, not restored"
    for pipeline, share in ((plain, 5e-4), (mask, grey)):
        found = values(pipeline, store, "lsr[mask]", "lsr[plain]", "bsr[mask]")
        assert float(found["lsr[mask]"].max()) == pytest.approx(5e-4, rel=1e-5)
        assert float(found["lsr[plain]"].max()) == pytest.approx(1.0, rel=1e-5)
        assert float(found["bsr[mask]"].max()) <= share
    dim = values(mask, store, "psf[mask]")["psf[mask]"].intensity
    assert np.allclose(
        dim.numpy(), grey * bare["psf[mask]"].intensity.numpy(), rtol=2e-5, atol=1e-12
    )


@pytest.mark.slow
def test_no_picture_is_scored_at_the_dark_exposure_of_its_filter(store):
    """Behind a grey filter of 1 % the developed picture has the light of the scene, and its
    noise has grown.
    """
    (plain,) = protected(store, 0.01, "filter", "flat+none")
    assert plain.pipeline.shade.brightness == pytest.approx(100, rel=1e-4)
    found = values(
        plain,
        store,
        "developed[mask]",
        "developed[plain]",
        "truth",
        "signal[mask]",
        "signal[plain]",
    )
    light = {name: float(x.double().mean()) for name, x in found.items()}
    assert light["signal[mask]"] == pytest.approx(0.01 * light["signal[plain]"], rel=0.1)
    assert light["developed[mask]"] == pytest.approx(light["developed[plain]"], rel=0.1)
    scatter = {
        name: float((found[name] - found["truth"]).double().std()) for name in list(found)[:2]
    }
    assert scatter["developed[mask]"] > 2 * scatter["developed[plain]"]
    (stopped,) = protected(store, 0.1, "stop", "flat+none")
    shade = stopped.pipeline.shade
    assert shade.brightness == pytest.approx(1 / (shade.transmittance * shade.diameter**2))
    dim = values(stopped, store, "developed[mask]", "developed[plain]")
    bright = {name: float(x.double().mean()) for name, x in dim.items()}
    assert bright["developed[mask]"] == pytest.approx(bright["developed[plain]"], rel=0.1)


@pytest.mark.slow
def test_a_stop_reaches_the_level_with_more_light_than_a_filter_and_the_best_has_the_least_error(
    store,
):
    picture = ("psf[mask]", "illuminant", "responses", "bands", "signal[plain]", "lsr[mask]")
    errors = {}
    for way in ("filter", "stop", "best"):
        (plain,) = protected(store, 0.02, way, "flat+none")
        found = values(plain, store, *picture)
        assert float(found["lsr[mask]"].max()) == pytest.approx(0.02, rel=1e-5)
        light = float(found["signal[plain]"].double().mean())
        dim = metrics.filtered_picture(
            *(found[n] for n in picture[:4]), electrons=light, read_noise=10.5
        )
        errors[way] = float(dim.error.mean())
        if way == "stop":
            assert plain.pipeline.shade.diameter == pytest.approx(0.02**0.25, rel=0.05)
            assert plain.pipeline.shade.transmittance > 0.8
            assert float(dim.light.mean()) > 4 * 0.02
    assert errors["best"] <= min(errors["filter"], errors["stop"]) * 1.001


def test_a_mask_that_protects_more_than_is_asked_and_one_with_a_filter_are_refused_together(store):
    with pytest.raises(EvaluationRefused) as error:
        protected(store, 0.1, text="flat+none, five_half_rings+none, grey_filter+none")
    said = str(error.value).splitlines()
    assert len(said) == 2
    assert said[0].startswith("--equal-protection 0.1: five_half_rings lowers the peak to 0.00")
    assert said[0].endswith("already: ask for at most that, or leave this mask out")
    assert said[1].startswith(
        "--equal-protection 0.1: grey_filter has a filter or a stop of its own: leave it out"
    )


@pytest.mark.slow
def test_a_stop_below_the_samples_of_the_pupil_is_refused(store):
    with pytest.raises(
        EvaluationRefused,
        match="flat needs a smaller stop than the samples of the pupil carry: ask for",
    ):
        protected(store, 1e-6, "stop", "flat+none")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--equal-protection", "2"], "--equal-protection 2: write the peak of a laser as a share"),
        (["--equal-protection", "0"], "--equal-protection 0: write the peak of a laser as a share"),
        (
            ["--equal-protection", "nan"],
            "--equal-protection nan: write the peak of a laser as a share",
        ),
        (
            ["--equal-protection", "0.1", "--by", "mirror"],
            "--by mirror: write one of best, filter, stop",
        ),
    ],
)
def test_a_wrong_option_is_refused_by_the_command(words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["evaluate", "first_light", *SMALL, *words])
    assert done.exit_code == 2
    assert said in " ".join(done.stderr.split())
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_the_table_the_page_and_the_document_compare_at_equal_protection(store, tmp_path):
    how = {
        "scenes": 1,
        "strengths": [1e4],
        "small": 16,
        "store": store,
        "reference": "five_half_rings+none",
    }
    folder = neusee.evaluate(
        "first_light",
        pipelines=PAIR,
        changes=SMALL,
        out=tmp_path,
        equal_protection=5e-4,
        by="filter",
        **how,
    )
    document = json.loads((folder / "provenance.json").read_text())
    equal = document["equal protection"]
    assert (equal["peak"], equal["by"]) == (5e-4, "filter")
    with (folder / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["pipeline"] for row in rows] == list(equal["pipelines"])
    assert document["reference"] == rows[1]["pipeline"]
    assert rows[0]["pipeline"] == "plain lens + filter 0.0005, wiener"
    with (folder / "protection.csv").open() as file:
        assert [float(row["peak"]) for row in csv.DictReader(file)] == pytest.approx(
            [5e-4, 5e-4], rel=1e-5
        )
    # where a browser may break a line
    page = (folder / "report.html").read_text().replace("<wbr>", "")
    assert "Equal protection" in page
    assert "The same numbers again" in page
    with (folder / "points.csv").open() as file:
        commands = [row["command"] for row in csv.DictReader(file)]
    assert all(command.startswith("neusee run first_light ") for command in commands)
    assert all(html.escape(command) in page for command in commands), (
        "a scene and a strength alone: all are shown"
    )
    assert "a grey filter" in page
    words = equal["pipelines"][rows[1]["pipeline"]]["words"]
    again = run(
        load("first_light", [*SMALL, "doe=five_half_rings", "lasers={}", *words]),
        store,
        ["lsr[mask]"],
    )
    assert float(again.values["lsr[mask]"].max()) == pytest.approx(5e-4, rel=1e-5)
