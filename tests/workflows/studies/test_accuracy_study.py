"""The study of accuracy: its knobs are the recipe's own, its errors closed forms, and it goes on
where it stopped.
"""

import csv
import importlib.util
import json
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from neusee.workflows import load
from neusee.workflows.recipe.loading import changed
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.accuracy_page import (
    EXACT,
    AccuracyResult,
    Dot,
    Line,
    count_missed,
    lead,
    promises,
    sections,
    steps,
    work_precision_diagram,
)
from neusee.workflows.studies.accuracy_study import trials
from neusee.workflows.studies.recipe_knobs import finest, knobs
from neusee.workflows.studies.run_study import count_failures, study_recipe
from neusee.workflows.studies.work_precision import (
    TIMES,
    PointCache,
    ToleranceChoice,
    Trial,
    WorkPrecisionPoint,
    cheapest,
    cut_inputs,
    median_ratio,
    pareto_front,
    steps_that_matter,
    try_step,
)

RECIPE = """\
# A camera whose errors are known
optics: {bands: 9, samples: 8, pitch: 1 mm, window: [6, 8]}
sensor: {sigma: 0.1}
steps:
  bands: {node: measured.bands, with: {count: "${optics.bands}"}}
  pupil: {node: measured.pupil, with: {samples: "${optics.samples}", pitch: "${optics.pitch}"}}
  psf: {node: measured.spread, from: {pupil: pupil, bands: bands}, with: {shape: "${optics.window}"}}
  cube: {node: measured.weighed, from: psf}
  image: {node: measured.together, from: cube}
  lit: {node: measured.glow, from: image, with: {amount: 5e-3}}
  raw: {node: measured.noise, from: lit, with: {sigma: "${sensor.sigma}"}}
seed: 3
tolerance: 1e-3
outputs: [raw, cube]
"""


@pytest.fixture
def nodes(monkeypatch):
    """The family ``measured``, as if it were one of the package."""
    name = "neusee.nodes.measured"
    spec = importlib.util.spec_from_file_location(
        name, Path(__file__).parents[1] / "accuracy_nodes.py"
    )
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def recipe(nodes, write, tmp_path):
    return load(write(RECIPE), folder=tmp_path)


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def quadrature(count):
    """What `together` gives of so many bands."""
    return (1 / 3 - 1 / (12 * count**2)) / 3


# --- knobs ----------------------------------------------------------------------------------------


def test_knobs_are_found_by_what_they_are_to_their_nodes(recipe):
    found = {knob.what: knob for knob in knobs(recipe).found}
    assert {what: knob.name for what, knob in found.items()} == {
        "bands": "optics.bands",
        "pupil samples at the same width": "optics.samples",
        "window of the PSF": "optics.window",
        "precision": "steps.psf.with.precision",
    }
    assert [c.label for c in found["bands"].changes] == ["3", "4", "5", "9", "17"]
    assert next(c for c in found["bands"].changes if c.label == "9").overrides == ()
    assert [c.label for c in found["precision"].changes] == ["single", "double"]


def test_a_pupil_keeps_its_width(recipe):
    samples = next(k for k in knobs(recipe).found if k.name == "optics.samples")
    for change in samples.changes:
        params = changed(recipe, change.overrides).steps["pupil"].params
        assert params["samples"] == int(change.label)
        assert params["samples"] * params["pitch"] == pytest.approx(8e-3, rel=1e-12)


def test_a_value_that_something_else_reads_is_no_knob(nodes, write, tmp_path):
    text = RECIPE.replace("amount: 5e-3", 'amount: "${optics.window.0}"')
    shared = load(write(text), folder=tmp_path)
    # its first number alone is another value
    assert "optics.window" in {k.name for k in knobs(shared).found}
    both = RECIPE.replace(
        "outputs:",
        '  again: {node: scene.targets, with: {kind: edge, shape: "${optics.window}"}}\noutputs:',
    )
    found = knobs(
        load(
            write(both.replace("  again", "  again", 1).replace("seed: 3\ntolerance: 1e-3\n", "")),
            folder=tmp_path,
        )
    )
    assert "optics.window" not in {k.name for k in found.found}
    assert "window of the PSF: optics.window is also a parameter of the step again" in found.without


def test_a_recipe_without_a_knob_says_so(nodes, write, tmp_path):
    text = RECIPE[: RECIPE.index("  pupil:")] + "outputs: [bands]\n"
    text = text.replace(", samples: 8, pitch: 1 mm, window: [6, 8]", "").replace(
        "sensor: {sigma: 0.1}\n", ""
    )
    found = knobs(load(write(text), folder=tmp_path))
    assert [k.name for k in found.found] == ["optics.bands"]
    assert "precision: this recipe has no such value" in found.without


def test_the_reference_is_the_same_sampling_in_double_with_everything_kept(recipe):
    best = finest(recipe)
    assert best.exact
    assert best.steps["psf"].params["precision"] == "double"
    assert best.steps["bands"].params == recipe.steps["bands"].params
    assert (best.name, best.seed, best.outputs) == (recipe.name, recipe.seed, recipe.outputs)


# --- points ---------------------------------------------------------------------------------------


def test_errors_are_the_closed_forms(recipe, store):
    cache = PointCache(finest(recipe), store, seeds=1)
    coarse = cache.point(Trial("bands", "3", changed(recipe, ["optics.bands=3"])))
    assert coarse.found.errors["raw"][0] == pytest.approx(
        1 - quadrature(3) / quadrature(9), rel=1e-4
    )
    assert "cube" not in coarse.found.errors  # of another shape
    single = cache.point(Trial("own", "", recipe))
    assert 1e-9 < single.error < 1e-7  # a third in float32
    assert cache.point(Trial("best", "", finest(recipe))).error == 0


def test_a_tolerance_leaves_out_what_it_may_and_the_error_shows_it(recipe, store):
    cache = PointCache(finest(recipe), store, seeds=2)
    loose = cache.point(Trial("tolerance", "1e-1", replace(recipe, tolerance=1e-1)))
    assert "lit" not in loose.found.steps
    for error in loose.found.errors["raw"]:
        assert error == pytest.approx(5e-3 / (1 + 5e-3), rel=1e-4)
    assert loose.most <= loose.found.bound <= 2 * 5e-3


def test_seeds_draw_other_noise_and_only_that_runs_again(nodes, recipe, store):
    cache = PointCache(finest(recipe), store, seeds=3)
    cache.truth(0)
    nodes.CALLS.clear()
    point = cache.point(Trial("own", "", recipe))
    assert len(point.by_seed) == 3
    truths = [cache.truth(seed)["raw"][0, 0].item() for seed in range(3)]
    assert len(set(truths)) == 3
    assert nodes.CALLS.count("bands 9") == 1  # not again for the other seeds
    assert cache.point(Trial("own", "", recipe)) == point


def test_a_quick_point_is_timed_again_each_time_once(nodes, recipe, store):
    cache = PointCache(finest(recipe), store, seeds=1)
    point = cache.point(Trial("own", "", recipe))
    nodes.CALLS.clear()
    third = cache.time_again(cache.time_again(point, 2), 3)
    assert nodes.CALLS.count("bands 9") == 2
    assert len(set(third.found.seconds)) == 3
    assert third.seconds == sorted(third.found.seconds)[1]
    assert cache.time_again(cache.time_again(point, 2), 3) == third
    assert nodes.CALLS.count("bands 9") == 2
    slow = WorkPrecisionPoint(point.trial, replace(point.found, seconds=[9.0]))
    assert cache.time_again(slow, 2) == slow


def test_what_cannot_run_is_a_point_that_says_why(recipe, store):
    cache = PointCache(finest(recipe), store, seeds=1)
    point = cache.point(
        Trial("samples", "4", changed(recipe, ["optics.samples=4", "optics.pitch=2 mm"]))
    )
    assert point.found.refused == "pupil: 4 samples are too few"
    assert not point.sound


def test_a_point_is_another_with_another_tolerance_recipe_seed_or_number_of_seeds(recipe, store):
    cache = PointCache(finest(recipe), store, seeds=2)
    keys = {
        cache.key(recipe),
        cache.key(replace(recipe, tolerance=1e-2)),
        cache.key(replace(recipe, exact=True)),
        cache.key(replace(recipe, seed=4)),
        cache.key(changed(recipe, ["optics.bands=8"])),
        PointCache(finest(recipe), store, seeds=3).key(recipe),
        PointCache(recipe, store, seeds=2).key(recipe),
    }
    assert len(keys) == 7
    assert cache.key(recipe) == PointCache(finest(recipe), store, seeds=2).key(recipe)


# --- the Pareto front -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Spot:
    seconds: float
    most: float


def test_the_pareto_line_has_what_no_other_point_beats():
    points = [
        Spot(1, 1e-1),
        Spot(2, 1e-3),
        Spot(2, 1e-2),
        Spot(3, 5e-3),
        Spot(4, 1e-3),
        Spot(5, 1e-6),
    ]
    assert pareto_front(points) == [Spot(1, 1e-1), Spot(2, 1e-3), Spot(5, 1e-6)]
    assert cheapest(points, 1e-2) == Spot(2, 1e-3)
    assert cheapest(points, 1e-7) is None


def test_a_choice_is_weighed_against_the_cheapest_that_holds():
    made = [
        ToleranceChoice(1e-2, Spot(4, 1e-3), Spot(2, 1e-2)),
        ToleranceChoice(1e-3, Spot(3, 2e-3), Spot(3, 1e-3)),
        ToleranceChoice(1e-9, Spot(1, 1), None),
    ]
    assert [c.held for c in made] == [True, False, False]
    assert [c.ratio for c in made] == [2.0, 1.0, None]
    assert median_ratio(made) == 1.5


# --- steps ----------------------------------------------------------------------------------------


def test_steps_that_matter_are_the_slowest_items(recipe):
    seconds = {"cube": 6.0, "image": 3.98, "psf": 0.02, "elsewhere": 5.0}
    assert steps_that_matter(recipe, seconds) == [
        ("cube", pytest.approx(0.4)),
        ("image", pytest.approx(3.98 / 15)),
    ]


def test_a_step_is_tried_in_its_forms_against_its_reference(nodes, recipe, store):
    found = try_step(recipe, "cube", 0.5, store, patience=10.0)
    errors = {(form.line, form.label): form.error for form in found.variants}
    assert 0 < errors["as used", ""] < 1e-7
    assert errors["precision", "double"] == 0
    assert ("window of the PSF", "0.5") not in errors  # its result has another shape
    assert all(form.seconds >= 0.01 for form in found.variants)
    assert found.found.cut_inputs == ""
    nodes.CALLS.clear()
    assert try_step(recipe, "cube", 0.5, store, patience=10.0) == found
    assert nodes.CALLS == []


def test_a_step_without_a_reference_says_so(recipe, store):
    assert try_step(recipe, "image", 0.5, store, 1.0).found.refused == "the node has no reference"


def test_a_part_of_the_inputs_is_their_middle_and_bands_from_all_over(nodes):
    cube = (
        torch.arange(9.0)[:, None, None] * 100 + torch.arange(6.0)[:, None] * 10 + torch.arange(8.0)
    )
    psf = nodes.Psf(cube, torch.arange(9.0))
    (part,) = cut_inputs(nodes.weighed, [psf], (4, 3))
    assert part.intensity.shape == (3, 4, 4)
    assert part.clear_peak.tolist() == [1.0, 4.0, 7.0]
    assert part.intensity[0, 2, 2] == 100 + 30 + 4  # the sample at N // 2 stays there
    assert cut_inputs(nodes.weighed, [psf], (0, 0))[0].intensity.shape == (9, 6, 8)


# --- the whole ------------------------------------------------------------------------------------


def rows_of(folder):
    with (folder / "table.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_a_study_that_was_stopped_goes_on_and_writes_its_folder(nodes, recipe, store, tmp_path):
    nodes.STOP_AT.add(17)
    lines = []
    with pytest.raises(KeyboardInterrupt):
        study_recipe(
            "accuracy", recipe, store, tmp_path / "runs", [], lines.append, seeds=1, quick=True
        )
    assert not list(tmp_path.glob("runs/*"))
    assert "bands 4" in nodes.CALLS
    nodes.CALLS.clear()
    lines.clear()
    command = ["neusee", "study"]
    folder = study_recipe(
        "accuracy", recipe, store, tmp_path / "runs", command, lines.append, seeds=1, quick=True
    )
    assert "bands 17" in nodes.CALLS
    assert nodes.CALLS.count("bands 4") == TIMES - 1  # known from before, and only timed again
    points = len(list(trials(recipe, knobs(recipe, True), True)))
    words = [line.partition(" ")[0] for line in lines]
    assert words[: points + 3] == [
        str(points),
        *(f"{i + 1}/{points}" for i in range(points)),
        "timed",
        "timed",
    ]
    assert "step cube: 2 variants" in lines
    _look_at(folder)


def _look_at(folder):
    names = {
        "figures",
        "provenance.json",
        "recipe.yaml",
        "report.html",
        "ro-crate-metadata.json",
        "table.csv",
    }
    assert {p.name for p in folder.iterdir()} == names
    assert {p.stem for p in (folder / "figures").iterdir()} == {
        "work_precision",
        "promises",
        "steps",
    }
    assert json.loads((folder / "provenance.json").read_text())["command"] == "neusee study"
    assert count_failures(folder) == 0
    rows = rows_of(folder)
    asked = [r for r in rows if r["line"] == "tolerance" and r["output"] == "raw"]
    assert [r["setting"] for r in asked] == ["1e-1", "1e-2", "1e-3", "1e-4"]
    assert all(float(r["error"]) <= float(r["setting"]) for r in asked)
    assert {r["setting"] for r in rows if r["line"] == "bands (optics.bands)"} == {"4", "9", "17"}
    page = (folder / "report.html").read_text()
    assert "4 of 4 tolerances were held" in page
    assert "pupil samples at the same width" in page


@pytest.mark.slow
def test_what_the_budget_leaves_is_said_and_measured_the_next_time(nodes, recipe, store, tmp_path):
    folder = study_recipe(
        "accuracy", recipe, store, tmp_path / "runs", [], print, seeds=1, quick=True, budget=0.0
    )
    left = [r for r in rows_of(folder) if r["refused"].startswith("not measured within the budget")]
    assert {r["setting"] for r in left} == {"4", "17", "6", "12", "4×6", "9×12", "double"}
    assert "not measured within the budget" in (folder / "report.html").read_text()
    again = study_recipe(
        "accuracy", recipe, store, tmp_path / "runs", [], print, seeds=1, quick=True
    )
    assert not [r for r in rows_of(again) if r["refused"].startswith("left")]


def test_a_tolerance_finer_than_the_arithmetic_is_told_from_one_that_was_missed(recipe, store):
    cache = PointCache(finest(recipe), store, seeds=1)
    points = [
        cache.point(t)
        for t in trials(recipe, knobs(recipe, True), True)
        if t.line in ("tolerance", "everything kept")
    ]
    fine = cache.point(Trial("tolerance", "1e-9", replace(recipe, tolerance=1e-9), value=1e-9))
    assert fine.most > 1e-9  # a third in float32
    said = lead(recipe, [*points, fine])
    assert (
        "4 of 5 tolerances were held. 1 cannot be tested: rounding gives the full computation"
        in said
    )
    off = WorkPrecisionPoint(
        replace(fine.trial, value=1e-9), replace(fine.found, errors={"raw": [1e-3]})
    )
    assert "cannot be tested" not in lead(recipe, [*points, off])
    assert (count_missed([*points, fine]), count_missed([*points, off])) == (0, 1)


def test_a_table_of_many_outputs_is_cut_to_the_width_of_the_page(recipe, store):
    point = PointCache(finest(recipe), store, seeds=1).point(Trial("samples", "10", recipe))
    names = [f"output[{i}]" for i in range(15)]
    many = WorkPrecisionPoint(
        point.trial, replace(point.found, errors={name: [1e-3] for name in names})
    )
    result = AccuracyResult(load("laser_free"), (many,), (), (), 1)
    parts = [
        s for s in sections(result, {"promises": b"PNG"}) if s.heading.startswith("Every output")
    ]
    assert [s.heading for s in parts] == [
        "Every output",
        "Every output, part 2 of 3",
        "Every output, part 3 of 3",
    ]
    assert [bool(s.picture) for s in parts] == [True, False, False]
    assert [name for s in parts for name in s.columns[2:]] == names
    assert max(len(s.columns) for s in parts) <= 8
    assert {len(row) for s in parts for row in s.rows} == {8, 5}


def test_many_outputs_can_be_told_apart():
    outputs = {f"output {i}": [1e-3, 1e-4] for i in range(20)}
    # the legend is checked wherever a figure is drawn
    promises([1e-2, 1e-3], outputs, [None, None])


def test_a_study_without_seeds_is_refused(recipe, store, tmp_path):
    with pytest.raises(ValueError, match="seeds=0"):
        study_recipe("accuracy", recipe, store, tmp_path, [], print, seeds=0)


def test_a_diagram_is_drawn_of_errors_that_are_zero(tmp_path):
    dots = [Dot(1.0, 0.0, "exact"), Dot(0.1, 1e-3, "1e-3", 5e-4, 2e-3, own=True)]
    picture = work_precision_diagram(
        [Line("tolerance", dots)], [(0.1, 1e-3), (1.0, EXACT / 2)], 1e-3, "title"
    )
    assert picture.startswith(b"\x89PNG")


@pytest.mark.slow
def test_first_light_in_small(tmp_path):
    small = [
        "optics.samples=64",
        "optics.pitch=126.2 um",
        "optics.bands=4",
        "optics.window=[24, 24]",
    ]
    small += ["scene.shape=[32, 32]", "sensor.shape=[24, 24]", "laser=none", "outputs=[raw, lsr]"]
    recipe = load("first_light", small)
    store = Store(tmp_path / "store")
    folder = study_recipe(
        "accuracy", recipe, store, tmp_path / "runs", [], print, seeds=1, quick=True
    )
    asked = [r for r in rows_of(folder) if r["line"] == "tolerance"]
    assert asked
    assert all(float(r["error"]) <= float(r["setting"]) for r in asked)


@pytest.mark.parametrize("error", [3e-17, 2e-7, 0.0])
def test_errors_that_differ_in_their_last_digit_alone_are_drawn_without_a_warning(error):
    dots = [
        Dot(0.1, error, "a"),
        Dot(0.1, math.nextafter(error, 1.0), "b", error, math.nextafter(error, 1.0)),
    ]
    assert steps([("image", [Line("precision", dots)], 0.1)])
