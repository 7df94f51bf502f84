"""The study of omissions: each alone, put back, and what was stated of it; a bound that lies is
found.
"""

import csv
import json
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neusee.nodes import node
from neusee.workflows.engine import worker_processes
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies import leave_out_study as scene_costs
from neusee.workflows.studies import left_out_steps as omission_rows
from neusee.workflows.studies.left_out_steps import OmissionComparison, least_error
from neusee.workflows.studies.run_study import study_recipe

MARK = Location("recipe.yaml", 1, 1)
SMALL = (
    "scene.shape=[64, 64]",
    "sensor.shape=[48, 48]",
    "optics.samples=40",
    "optics.diameter=4 mm",
    "optics.pitch=100 um",
    "optics.window=[32, 32]",
    "optics.bands=3",
)
OUTPUTS = ("raw[plain]", "raw[mask]", "lsr[mask]")


@node()
def light(*, top: float = 100.0) -> Tensor:
    return torch.linspace(0.0, top, 1001)


@node()
def glow(x: Tensor, *, amount: float = 0.0, stated: float = 1.0) -> Tensor:
    return x + amount


@glow.skip_bound
def _(x, *, amount, stated):
    return stated * abs(amount) / (x.max + amount)


@node()
def hiss(x: Tensor, *, sigma: float, stated: float = 1.0, rng: torch.Generator) -> Tensor:
    return x + sigma * torch.randn(x.shape, generator=rng)


@hiss.skip_bound
def _(x, *, sigma, stated):
    return stated * sigma / math.hypot(x.max, sigma)


@node()
def lamp(*, power: float = 1.0) -> Tensor:
    return torch.full((1001,), power).index_fill(0, torch.tensor([3]), 0.0)


@lamp.zero_bound
def _(*, power):
    return 2 * power


@node(additive_inputs=[("lamps",)])
def both(x: Tensor, lamps: list[Tensor]) -> Tensor:
    return x + sum(lamps)


def step(name, node, params=None, **wires):
    read = {i: wires.get(i) for i in node.inputs}
    values = {k: v.default for k, v in node.params.model_fields.items()} | (params or {})
    return Step(name, node, values, read, MARK, {})


def recipe(*steps, outputs="out", tolerance=1e-2):
    return Recipe("toy", "", 7, tolerance, tuple(outputs.split()), {s.name: s for s in steps})


def camera(amount=0.5, sigma=0.1, power=0.3, stated=1.0, honest=1.0, **more):
    return recipe(
        step("l", light),
        step("g", glow, {"amount": amount, "stated": stated}, x="l"),
        step("h", hiss, {"sigma": sigma, "stated": honest}, x="g"),
        step("a", lamp, {"power": power}),
        step("b", both, x="h", lamps=("a",)),
        step("out", glow, x="b"),
        **more,
    )


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


@pytest.fixture
def study(store, tmp_path):
    """Make a study and give its folder's account, and what it told on the way."""

    def study(recipe, **options):
        told = []
        folder = study_recipe(
            "leave-out", recipe, store, tmp_path / "runs", ["neusee"], told.append, **options
        )
        return json.loads((folder / "provenance.json").read_text()), told, folder

    return study


def rows_of(doc):
    return {row["name"]: row for row in doc["rows"]}


def test_each_omission_is_measured_alone(study):
    doc, told, _ = study(camera(), contents=False)
    rows = rows_of(doc)
    assert doc["failed"] == 0
    assert (
        rows["g"]["largest"]
        == pytest.approx(0.5 / 100.5, rel=1e-5)
        == pytest.approx(rows["g"]["bound"], rel=1e-5)
    )
    assert rows["h"]["rms"] == pytest.approx(0.1 / 100.5, rel=0.1)
    assert rows["a"]["bound"] == pytest.approx(2 * rows["a"]["largest"], rel=0.01)
    assert rows["g"]["outputs"]["out"] == pytest.approx(0.5 / 100.8, rel=1e-2)
    assert rows["out"]["bound"] == rows["out"]["largest"] == rows["out"]["outputs"]["out"] == 0
    assert len([line for line in told if "stated at most" in line]) == len(rows) == 4


@pytest.mark.parametrize("lie", [{"stated": 0.5}, {"honest": 0.5}])
def test_a_bound_that_does_not_hold_is_found(study, lie):
    doc, told, folder = study(camera(**lie), contents=False)
    wrong = "g" if "stated" in lie else "h"
    assert [row["name"] for row in doc["rows"] if not row["holds"]] == [wrong]
    assert doc["failed"] == 1
    assert any(line.startswith(wrong) and "does not hold" in line for line in told)
    assert "1 stated errors are too small" in (folder / "report.html").read_text()


def test_a_tolerance_that_is_missed_is_found(study):
    """Two steps that each state too little: together they change more than the tolerance."""
    doc, _, _ = study(camera(amount=5.0, stated=0.01), contents=False)
    (out,) = doc["outputs"]
    assert out["rms"] > 1e-2
    assert not out["holds"]


def test_what_is_chosen_is_put_back_alone(study):
    doc, _, _ = study(camera(amount=0.05, sigma=30.0), contents=False)
    rows = rows_of(doc)
    assert {name for name, row in rows.items() if row["taken"]} == {"g", "out"}
    assert rows["g"]["back"] == pytest.approx(doc["outputs"][0]["rms"], rel=1e-2)
    assert rows["h"]["back"] is None
    assert rows["out"]["back"] == 0


def test_neighbours_that_are_both_left_out_are_put_back_one_by_one(study):
    chain = recipe(
        step("l", light),
        step("g", glow, {"amount": 0.04}, x="l"),
        step("h", glow, {"amount": 0.05}, x="g"),
        step("out", glow, {"amount": 100.0}, x="h"),
    )
    rows = rows_of(study(chain, contents=False)[0])
    top = 200.0  # of the output with both left out
    assert rows["g"]["back"] == pytest.approx(0.04 / top, rel=5e-4)
    assert rows["h"]["back"] == pytest.approx(0.05 / top, rel=5e-4)


def test_with_everything_kept_nothing_is_chosen(study):
    doc, _, _ = study(replace(camera(), exact=True), contents=False)
    assert not any(row["taken"] for row in doc["rows"])
    assert doc["outputs"][0]["rms"] == 0


def test_a_second_study_measures_nothing_again(study, monkeypatch):
    first, _, _ = study(camera(), contents=False)
    monkeypatch.setattr(OmissionComparison, "_row", lambda *a: pytest.fail("measured again"))
    second, _, folder = study(camera(), contents=False)
    assert second["rows"] == first["rows"]
    with (folder / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["name"] for row in table if row["what"] == "omission"] == [
        row["name"] for row in first["rows"]
    ]


def test_a_study_that_was_stopped_goes_on(study, store, monkeypatch):
    real, done = OmissionComparison._row, []

    def stops(self, omission, alone):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(omission.name)
        return real(self, omission, alone)

    monkeypatch.setattr(OmissionComparison, "_row", stops)
    with pytest.raises(KeyboardInterrupt):
        study(camera(), contents=False)
    again = []
    monkeypatch.setattr(
        OmissionComparison,
        "_row",
        lambda self, o, alone: again.append(o.name) or real(self, o, alone),
    )
    study(camera(), contents=False)
    assert set(again).isdisjoint(done)
    assert len(done) + len(again) == 4


def test_one_draw_of_noise_does_not_break_a_true_bound():
    """Rare events: a handful of electrons in a million pixels scatter their mean square by more
    than itself.
    """
    for seed in range(40):
        rng = torch.Generator().manual_seed(seed)
        dark = torch.poisson(torch.full((100, 100), 3e-4), generator=rng)
        scene = torch.full((100, 100), 1000.0)
        assert least_error(scene, scene + dark) <= math.sqrt(3e-4) / 1000
    loud = scene + torch.randn(scene.shape, generator=rng)
    assert least_error(scene, loud) > 0.9 / 1000


def test_a_single_pixel_tells_nothing_of_its_noise():
    assert least_error(torch.tensor([100.0]), torch.tensor([103.0])) == 0


@pytest.fixture(scope="module")
def windshield(tmp_path_factory):
    """The account and the folder of one study of a camera, with its contents."""
    here = tmp_path_factory.mktemp("windshield")
    recipe = replace(load("dirty_windshield", SMALL), outputs=OUTPUTS)
    with pytest.MonkeyPatch.context() as patch:
        # one process, as in every test: seconds of several together exceed those that pass
        patch.setattr(worker_processes, "free_processors", lambda: 1)
        folder = study_recipe("leave-out", recipe, Store(here / "store"), here / "runs", ["neusee"])
    return json.loads((folder / "provenance.json").read_text()), folder


@pytest.mark.slow
def test_the_camera_holds_what_it_states(windshield):
    doc, folder = windshield
    rows = rows_of(doc)
    assert [
        row
        for row in (*doc["outputs"], *doc["rows"])
        if not row.get("holds", row["rms"] <= row["bound"])
    ] == []
    assert {"dark[plain]", "read[mask]", "well[plain]", "laser_photons[mask,green]"} <= rows.keys()
    assert rows["dark[mask]"]["taken"]
    assert not rows["read[mask]"]["taken"]
    assert all(
        0 <= row["largest"] <= row["bound"] for row in rows.values() if row["kind"] == "not added"
    )
    page = (folder / "report.html").read_text()
    assert "Each omission" in page
    assert "http" not in page.replace("http://www.w3.org", "")


@pytest.mark.slow
def test_what_is_nothing_is_left_away_and_changes_nothing(study):
    clean = [f"dirt.{kind}=0" for kind in ("dust", "scratches", "smudges")]
    overrides = (
        *SMALL,
        *clean,
        "dirt.grease=0 waves",
        "dirt.dents=0 waves",
        "lasers.green.strength=0",
    )
    recipe = replace(load("dirty_windshield", overrides), outputs=("raw[mask]",))
    doc, _, _ = study(recipe, contents=False)
    rows = rows_of(doc)
    nothing = {"dirt", "laser_photons[mask,green]", "ghost_photons[mask,green]"}
    assert nothing <= {name for name, row in rows.items() if row["taken"]}
    assert all(rows[name][part] == 0 for name in nothing for part in ("bound", "largest", "back"))
    assert doc["failed"] == 0


def test_scenes_of_a_recipe(tmp_path):
    scenes = scene_costs.scenes(load("dirty_windshield", SMALL))
    assert all(isinstance(made, Recipe) for made in scenes.values()), scenes
    assert not any("laser" in name for name in scenes["no laser"].steps)
    assert not any("ghost" in name or name == "dirt" for name in scenes["clean window"].steps)
    assert scenes["one wavelength"].steps["bands"].params["count"] == 1
    assert scenes["grey scene"].steps["scene"].node.path == "scene.targets"
    assert scenes["everything in full"].exact
    assert not scenes["no laser"].exact


@pytest.mark.slow
def test_a_scene_with_less_in_it_costs_less(windshield):
    doc, folder = windshield
    cost = {c["scene"]: c for c in doc["costs"]}
    assert not any(c["refused"] for c in doc["costs"])
    assert cost["no laser"]["steps"] < cost["as the recipe chooses"]["steps"]
    assert cost["one wavelength, no laser, clean window"]["steps"] < cost["no laser"]["steps"]
    assert all(0 < c["computing"] <= c["seconds"] for c in doc["costs"])
    assert (folder / "figures" / "content.png").stat().st_size > 10_000
    assert (folder / "costs.csv").is_file()


def test_facts_are_read_without_the_payload(store, monkeypatch):
    comparison = OmissionComparison(camera(), store)
    monkeypatch.setattr(omission_rows.Result, "value", lambda *a: pytest.fail("a value was read"))
    assert comparison.facts("l").max == 100
    assert run(comparison.full, store).keys["l"] == comparison.truth.keys["l"]
