"""What differs between two runs is said; a folder that is no run, or is damaged, is refused with
its place.
"""

import csv
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import save_file

from neusee.workflows.comparison.comparison_report import (
    compare,
    document,
    lines,
    summary,
    write_comparison,
)
from neusee.workflows.comparison.differences import NumberDifference, data_files, figures
from neusee.workflows.comparison.run_record import NotComparable, read_record
from neusee.workflows.recipe.loading import load
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store.result_store import Store

RECIPE = """
seed: 3
tolerance: 0
outputs: [full, restored_quality]
steps:
  scene: {node: scene.targets, with: {kind: siemens, shape: [16, 16]}}
  full: {node: restore.electrons, from: {raw: scene}, with: {gain: 4 DN/e-, offset: 0 e-}}
  restored_quality: {node: metrics.quality, from: {estimate: full, truth: scene}}
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder with two runs of a small recipe that differ in one value, and the names of both."""
    root = tmp_path_factory.mktemp("runs")
    (root / "mine.yaml").write_text(RECIPE)
    names = []
    for change in ([], ["steps.full.with.gain=8 DN/e-"]):
        recipe = load(root / "mine.yaml", change, root)
        names.append(
            simulate(
                recipe, Store(root / "cache"), root / "runs", ["neusee", "run", *change]
            ).folder.name
        )
    return root / "runs", *names


@pytest.fixture
def two(runs, tmp_path):
    """Copies of the two runs that a test may change, and a function that compares them."""
    for side, name in zip(("left", "right"), runs[1:], strict=True):
        shutil.copytree(runs[0] / name, tmp_path / side)
    return tmp_path


def compared(root, left="left", right="right"):
    return compare(read_record(left, root), read_record(right, root))


def edited(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_a_changed_value_is_named_with_both_sources_and_its_numbers(two):
    found = compared(two)
    (value,) = found.recipe
    assert (value.name, value.left, value.right) == ("steps.full.with.gain", "4 DN/e-", "8 DN/e-")
    assert (value.left_source, value.right_source) == ("mine.yaml:7:68", "argument 1")
    sides = [
        json.loads((two / side / "provenance.json").read_text())["metrics"]
        for side in ("left", "right")
    ]
    wanted = [(a[3], b[3]) for a, b in zip(*sides, strict=True)]
    assert [(n.left, n.right) for n in found.numbers] == wanted
    assert 0 < found.largest < 1
    assert found.code == []
    assert found.steps[0].startswith(
        "2 of 3 common steps have another cache key: full, restored_quality"
    )
    assert [each.name for each in found.environment] == ["command"]
    text = "\n".join(lines(found))
    assert "steps.full.with.gain: 4 DN/e- (mine.yaml:7:68) -> 8 DN/e- (argument 1)" in text
    assert "1 value of the recipe differs." in text


def test_a_run_is_the_same_as_itself(two):
    found = compared(two, "left", "left")
    assert (found.largest, found.recipe, found.code, found.environment, found.steps) == (
        0,
        [],
        [],
        [],
        [],
    )
    assert {each.state for each in (*found.figures, *found.data)} == {"same"}
    said = "\n".join(lines(found))
    assert f"All {len(found.numbers)} numbers are the same." in said
    assert "differs" not in said


def test_the_folder_of_a_comparison_holds_page_table_pictures_and_document(two):
    Image.fromarray(np.zeros((40, 40, 3), np.uint8)).save(two / "left" / "figures" / "drawn.png")
    Image.fromarray(np.full((40, 40, 3), 7, np.uint8)).save(two / "right" / "figures" / "drawn.png")
    found = compared(two)
    folder = write_comparison(found, two / "out", ["neusee", "compare", "left", "right"])
    assert folder.parent == two / "out" / "comparisons"
    page = (folder / "report.html").read_text()
    assert not [
        word
        for word in ("steps.full.with.gain", "restored_quality", "argument 1")
        if word not in page
    ]
    assert "data:image/png;base64," in page
    rows = list(csv.DictReader((folder / "numbers.csv").read_text().splitlines()))
    assert [float(row["left"]) for row in rows] == [n.left for n in found.numbers]
    about = json.loads((folder / "provenance.json").read_text())
    assert {name: about[name] for name in document(found)} == json.loads(
        json.dumps(document(found))
    )
    assert (folder / "figures" / "drawn.png").is_file()


def test_numbers_that_one_run_lacks_are_counted_apart(two):
    edited(two / "right/provenance.json", lambda content: content["metrics"].clear())
    first = compared(two)
    alone = len(first.numbers)
    assert alone > 1
    said = ["The runs have no number in common.", f"Only the left run has {alone} further numbers."]
    assert summary(first)[:2] == said
    edited(
        two / "left/provenance.json", lambda content: content["metrics"].append(["new", "", 0, 1.0])
    )
    kept = json.loads((two / "left/provenance.json").read_text())["metrics"]
    edited(two / "right/provenance.json", lambda content: content["metrics"].extend(kept[:-1]))
    said = summary(compared(two))
    assert said[:2] == [
        f"All {len(kept) - 1} numbers are the same.",
        "Only the left run has 1 further number.",
    ]


@pytest.mark.parametrize(
    ("left", "right", "difference", "relative"),
    [
        (2.0, 1.0, -1.0, 0.5),
        (-1.0, 1.0, 2.0, 2.0),
        (0.0, 1e-3, 1e-3, 1.0),
        (math.inf, math.inf, 0.0, 0.0),
        (math.nan, math.nan, 0.0, 0.0),
        (1.0, None, None, math.inf),
        (math.inf, 1.0, -math.inf, math.inf),
    ],
)
def test_numbers_are_subtracted(left, right, difference, relative):
    found = NumberDifference("a", "", 0, left, right)
    assert (found.difference, found.relative) == (difference, relative)


def test_a_number_that_is_none_of_one_run_differs_by_more_than_any_limit(two):
    edited(two / "right" / "provenance.json", lambda doc: doc["metrics"].pop())
    found = compared(two)
    assert found.largest == math.inf
    assert "–" in "\n".join(lines(found))
    assert math.isnan(NumberDifference("a", "", 0, 1.0, math.nan).difference)
    assert NumberDifference("a", "", 0, 1.0, math.nan).relative == math.inf


def test_the_changed_definition_is_named(two):
    code = {
        "nodes": {"sensor.full_well": "a", "scene.targets": "b"},
        "parts": {
            "lab.helper": {"spill()": "1", "constant LIMIT": "1"},
            "state of lab.helper": {"values": "1"},
            "state of lab.other": {"values": "1"},
            "package torch": {"version": "torch 1"},
            "settings": {"TF32": "False"},
        },
    }
    (two / "left" / "code.json").write_text(json.dumps(code))
    code["nodes"] = {"sensor.full_well": "c", "doe.flat": "d"}
    code["parts"] |= {
        "lab.helper": {"spill()": "2", "round()": "1"},
        "state of lab.helper": {"values": "2"},
    }
    code["parts"] |= {
        "state of lab.other": {"values": "2"},
        "lab.more": {},
        "package numpy": {"version": "numpy 2"},
    }
    code["parts"] |= {"settings": {"TF32": "True"}}
    (two / "right" / "code.json").write_text(json.dumps(code))
    found = compared(two)
    assert found.code == [
        "the code of sensor.full_well differs",
        "only the left run uses the node scene.targets",
        "only the right run uses the node doe.flat",
        "lab.helper: constant LIMIT is only in the left run",
        "lab.helper: round() is only in the right run",
        "lab.helper: spill() differs",
        "a value that lab.other holds differs: a constant, a table or a default",
    ]
    edited(two / "left" / "code.json", lambda content: content.update(nodes=code["nodes"]))
    assert "only the right run uses lab.more" in compared(two).code
    assert {"TF32"} <= {each.name for each in found.environment}


def test_a_folder_without_digests_of_code_says_so(two):
    (two / "left" / "code.json").unlink()
    found = compared(two)
    assert found.code is None
    assert "The left or the right folder records no digests of code." in lines(found)
    write_comparison(found, two / "out", [])


def test_other_versions_devices_and_outputs_are_said(two):
    def change(doc):
        doc |= {
            "version": "0.0.9",
            "device": "cuda",
            "table": {"columns": ["SSIM"], "rows": [{"name": "x", "cells": ["1"]}]},
        }
        doc["steps"] = [row for row in doc["steps"] if row["step"] != "full"]

    edited(two / "right" / "provenance.json", change)
    (two / "right" / "data" / "more.exr").write_bytes(b"")
    found = compared(two)
    told = {each.name: (each.left, each.right) for each in found.environment}
    assert told["device"] == ("cpu", "cuda")
    assert told["neusee"][1] == "0.0.9"
    assert "only the left run has the step full" in found.steps
    assert found.missing == ["only the right run has data/more.exr"]
    assert [cell for cell in found.table[1][-1] if cell] == ["x", "right", "1"]


def picture(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values.astype(np.uint8)).save(path)


@pytest.mark.parametrize("shape", [(40, 40, 3), (30, 120, 3)], ids=["square", "wide"])
def test_the_difference_of_a_figure_is_that_of_its_pixels(shape, tmp_path):
    one = np.random.default_rng(0).integers(0, 200, shape)
    other = one.copy()
    other[3, 4] += (1, 9, 50)
    picture(tmp_path / "a/figures/x.png", one)
    picture(tmp_path / "b/figures/x.png", other)
    for side in "ab":
        picture(tmp_path / side / "figures/same.png", one)
        picture(tmp_path / side / "figures/timeline.png", one * (side == "a"))
    same, found = figures(tmp_path / "a", tmp_path / "b")
    assert (same.state, same.drawing) == ("same", None)
    assert (found.state, found.largest) == ("differs", 50)
    assert found.rms == pytest.approx(math.sqrt(50**2 / (shape[0] * shape[1])))
    assert found.drawing.startswith(b"\x89PNG")


def test_figures_of_two_sizes_stand_side_by_side_without_a_difference(tmp_path):
    picture(tmp_path / "a/figures/x.png", np.ones((20, 30, 3)))
    picture(tmp_path / "b/figures/x.png", np.ones((20, 40, 3)))
    (found,) = figures(tmp_path / "a", tmp_path / "b")
    assert (found.state, found.largest) == ("drawn in two sizes, 30 x 20 and 40 x 20 pixels", None)
    assert found.drawing.startswith(b"\x89PNG")


def exr(path, channels):
    import OpenEXR

    path.parent.mkdir(parents=True, exist_ok=True)
    OpenEXR.File(
        {"type": OpenEXR.scanlineimage}, {k: v.astype(np.float32) for k, v in channels.items()}
    ).write(str(path))


def test_the_difference_of_data_is_in_the_unit_of_the_file(tmp_path):
    ramp = np.linspace(0, 100, 64).reshape(8, 8)
    for side, more in (("a", 0.0), ("b", 0.5)):
        exr(
            tmp_path / side / "data/colour.exr",
            {"R": ramp, "G": ramp + more * (ramp > 50), "B": ramp},
        )
        exr(tmp_path / side / "data/many.exr", {f"S0.{n}": ramp + more for n in range(6)})
        exr(tmp_path / side / "data/other.exr", {"Y" if side == "a" else "Z": ramp})
        exr(
            tmp_path / side / "data/holes.exr",
            {"Y": np.where(ramp > 99, np.nan, ramp) if side == "a" else ramp},
        )
        tensors = {"same": ramp, "wide": ramp + more, "one": np.array([more]), side: ramp}
        save_file(
            tensors | {"shape": ramp[: 4 + int(2 * more)]},
            tmp_path / side / "data/outputs.safetensors",
        )
        (tmp_path / side / "data/note.txt").write_text(side)
    found = {each.name: each for each in data_files(tmp_path / "a", tmp_path / "b")}
    assert found["colour.exr"].largest == pytest.approx(0.5, rel=1e-4)
    assert found["colour.exr"].scale == pytest.approx(100.5)
    assert found["colour.exr"].drawing.startswith(b"\x89PNG")
    assert found["many.exr"].rms == pytest.approx(0.5, rel=1e-4)
    assert found["many.exr"].drawing is None
    assert (
        found["other.exr"].state
        == "differs in channels or size: 1 channels of 8 x 8 and 1 channels of 8 x 8"
    )
    assert found["holes.exr"].state == "differs, with NaN or infinity in one run alone at 1 places"
    assert found["note.txt"].state == "differs"
    assert found["outputs.safetensors: same"].state == "same"
    assert found["outputs.safetensors: wide"].largest == pytest.approx(0.5)
    assert found["outputs.safetensors: a"].state == "only the left run has it"
    assert found["outputs.safetensors: shape"].state == "differs in shape: (4, 8) and (5, 8)"
    assert "outputs.safetensors: one" not in found


def damaged(name, text):
    return lambda folder: (folder / name).write_bytes(text)


REFUSED = [
    (
        damaged("provenance.json", b'{\n "recipe": ,'),
        r"left/provenance.json:2:12: Expecting value: the file is damaged",
    ),
    (damaged("provenance.json", b"\xff\xfe"), r"left/provenance.json: byte 0 is not UTF-8"),
    (
        damaged("provenance.json", b"[]"),
        r"left/provenance.json: the top: input should be a valid dictionary",
    ),
    (
        damaged("provenance.json", b"{}"),
        r"left/provenance.json: recipe: field required: the file is damaged, or of anoth",
    ),
    (
        damaged("code.json", b'{"nodes": 3, "parts": {}}'),
        r"left/code.json: nodes: input should be a valid dictionary",
    ),
    (damaged("recipe.yaml", b"a: [1"), r"left/recipe.yaml:\d+:\d+"),
    (lambda folder: (folder / "recipe.yaml").unlink(), r"left/recipe.yaml .*cannot be read"),
    (
        lambda folder: (folder / "provenance.json").unlink(),
        r"no run at left: give the name of a folder in",
    ),
    (
        damaged("sweep.yaml", b""),
        r"left is the folder of a sweep: compare reads folders of `neusee run`",
    ),
    (damaged("training.json", b""), r"left is the folder of a training"),
    (
        damaged("provenance.json", b'{"study": "stability"}'),
        r"left is the folder of `stability`: compare reads",
    ),
    (
        damaged("data/outputs.safetensors", b"torn"),
        r"left/data/outputs.safetensors: .*the file is damaged",
    ),
]


@pytest.mark.parametrize(("harm", "said"), REFUSED, ids=[said[5:40] for _, said in REFUSED])
def test_a_folder_that_cannot_be_compared_is_refused_with_its_place(harm, said, two):
    harm(two / "left")
    with pytest.raises(NotComparable, match=said):
        compared(two)


def test_a_torn_picture_is_refused(two):
    for side, text in (("left", b"torn"), ("right", b"x")):
        (two / side / "figures" / "drawn.png").write_bytes(text)
        exr(two / side / "data" / "z.exr", {"Y": np.ones((2, 2)) * len(side)})
    with pytest.raises(NotComparable, match=r"left/figures/drawn.png: .*the file is damaged"):
        compared(two)
    (two / "left" / "data" / "z.exr").write_bytes(b"torn")
    for side in ("left", "right"):
        (two / side / "figures" / "drawn.png").unlink()
    with pytest.raises(NotComparable, match=r"left/data/z.exr: .*the file is damaged"):
        compared(two)


def test_the_newest_run_is_latest(runs):
    assert read_record("latest", runs[0]).name == runs[2]
    assert read_record(str(Path(runs[0]) / runs[1]), Path("elsewhere")).name == runs[1]
