"""What a command writes when it computes, it writes when everything is in the cache: the same
bytes.

Each command runs twice in a process of its own, because what a process has imported of neusee may
change how it writes, and with two hash seeds, because the order of a set may too. What may differ
is listed here, each with its reason, and nothing else.
"""

import csv
import json
import os
import re
import shlex
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from ruamel.yaml import YAML

from neusee.workflows.cli.commands_and_exit_codes import COMMANDS as ALL_COMMANDS
from neusee.workflows.studies.run_study import KINDS
from tests.guide_commands import write_reader_files
from tests.workflows.forked_commands import Commands

SMALL = (
    "'optics.samples=64' 'optics.pitch=120 um' 'optics.window=[32,32]' optics.bands=3"
    " 'scene.shape=[28,28]' 'sensor.shape=[24,24]'"
)
LIFT = (
    "'patch.shape=[8,8]' patch.leaves=8 train_lift.iterations=2 train_lift.batch=1"
    " train_lift.keep=1 train_lift.warmup=1 train_lift.validation_batches=1"
    " train_lift.ema_decay=0.5"
)
CAMERA = (
    "optics.samples=48 'optics.pitch=168.27 um' optics.bands=5 'optics.window=[40,40]'"
    " 'scene.shape=[40,40]' 'sensor.shape=[32,32]' train.network.width=4"
)
PROTECTION = (
    "optics.samples=128 'optics.pitch=63.11 um' optics.bands=3 'optics.window=[64,64]'"
    " 'scene.shape=[64,64]' 'sensor.shape=[48,48]' --bands 2 --draws 2"
)
SAFETY = (
    "safety.draws=100 optics.samples=128 'optics.window=[64,64]' 'wide.window=[49,49]'"
    " safety.dazzle.share=1e-3"
)
RECIPE = """
# A target through a small sensor.
sensor: {gain: 0.5 e-/DN, capacity: 200 e-}
seed: 3
tolerance: 0
outputs: [raw, saturated]
steps:
  scene: {node: scene.targets, with: {kind: siemens, shape: [64, 64]}}
  full: {node: sensor.full_well, from: {electrons: scene}, with: {capacity: "${sensor.capacity}"}}
  raw: {node: sensor.digitize, from: {electrons: full}, with: {gain: "${sensor.gain}"}}
  saturated: {node: sensor.crop, from: {image: raw}, with: {shape: [8, 8]}}
"""

#: commands that write a folder or a file, by their first words and what a case is about
COMMANDS = {
    "run": f"run first_light {SMALL} ~expect",
    "run, own steps": "run mine.yaml",
    "report": "report --out {out}",
    "compare": "compare runs/left runs/right",
    "safety": f"safety safety_pointer {SAFETY}",
    "restore": f"restore raw.npy --camera half_ring {SMALL}",
    "sweep": "sweep mine.yaml 'sensor.gain=0.5 e-/DN,0.6 e-/DN'",
    "sweep, a camera": (
        f"sweep first_light {SMALL} ~expect 'sensor.read_noise=5 e-,10 e-'"
        " outputs=[restored_quality]"
    ),
    "train, a lift": f"train train_lift {LIFT}",
    "train, a mask": f"train train_small --stage mask {CAMERA} train.mask.iterations=2",
    "train": (
        f"train train_small doe=half_ring {CAMERA} train.critics.width=4 train.pool=2 "
        "train.stages.1.iterations=1 train.stages.2.iterations=1"
    ),
    "calibrate": "calibrate calibrate 'flats.shape=[32,32]' --draws 100 --walkers 16",
    "calibrate, a folder": "calibrate my/lab --sensor lab --draws 100 --walkers 16",
    "sheet": "sheet my/frames.yaml --relative",
    "evaluate": (
        f"evaluate first_light {SMALL} ~expect --scenes 1 --strengths 0,30 "
        "--pipelines 'flat+none, half_ring+none'"
    ),
    "evaluate, equal protection": (
        f"evaluate first_light {SMALL} ~expect --scenes 1 --strengths 100 --by filter "
        "--pipelines 'flat+none, five_half_rings+none' --equal-protection 1e-3"
    ),
    "init": "init {out}",
    "new": "new node mine --in {out}",
    "handbook": "handbook --no-pictures --no-open --quiet --out {out}/book",
    "study accuracy": (
        f"study accuracy first_light {SMALL} ~expect laser=none outputs=[raw] --quick --seeds 1"
    ),
    "study stability": "study stability mine.yaml",
    "study leave-out": "study leave-out mine.yaml",
    "study calibration": (
        "study calibration calibrate 'flats.shape=[32,32]' 'sensor.gain=0.37 DN/e-'"
        " --simulations 20"
    ),
    "study uncertainty": (
        f"study uncertainty first_light {SMALL} ~expect 'sensor.read_noise=normal(10.5 e-, 0.5 e-)'"
        " --error 0.5 --most 64 outputs=[restored_quality]"
    ),
    "study protection": f"study protection axicon doe.waves=5 {PROTECTION}",
}
#: cases of half a minute that write as another one: the other studies share their page and their
#: documents, and frames of a folder are calibrated as those of a recipe
LONG = {"study calibration", "calibrate"}
#: commands that print, or that write into the cache alone
WRITE_NOTHING = {
    "validate",
    "plan",
    "why",
    "config",
    "recipes",
    "nodes",
    "check",
    "schema",
    "cache",
}

#: files that differ, and why; their numbers are those of provenance.json
DIFFERENT_FILES = {
    "report.html": "the page of provenance.json, with its dates and seconds",
    "ro-crate-metadata.json": "dates, and the sizes and digests of the other files",
    "timing.csv": "what was computed, when and for how long",
    "timeline.png": "when the steps ran",
    "graph.png": "its colours say which steps were computed",
}
#: fields of a document that differ, and why
DIFFERENT_FIELDS = {
    "started": "date of the command",
    "date": "date of the command",
    "seconds": "time of the command or of a step",
    "seconds a point": "time of a point that was computed",
    "seconds a draw": "time of a draw that was computed",
    "seconds_a_run": "time of a run of a study that was computed",
    "computed": "how many points were computed",
    "timing": "time, memory and bytes of the steps",
    "counts": "how many steps were computed",
    "state": "whether a step was computed",
    "why": "why a step was computed, or when it was",
    "began": "when a step was computed",
    "lane": "who computed a step",
    "predicted": "time that was predicted for a step that was computed",
    "predicted_peak": "memory that was predicted for a step that was computed",
    "peak": "memory that a step took",
    "kept": "whether this run stored a result",
}
#: rows of the facts of a run, and columns of a table, of the same kinds
DIFFERENT_ROWS = {"engine": "time", "peak memory": "memory", "answer": "the run that is repeated"}
MEASURED = {"seconds": "time of a point", "cached": "whether a point was computed"}
#: pictures of a run that show when its steps ran; a run that computes nothing has none
OF_WHAT_RAN = {"timeline"}
DATE = re.compile(r"(^|(?<=/))\d{4}-\d\d-\d\d_")
TIME = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d")


@pytest.fixture(scope="module")
def commands():
    """Two servers of commands, whose processes order their sets differently."""
    servers = [Commands(seed) for seed in ("1", "2")]
    yield servers
    for each in servers:
        each.close()


@pytest.fixture(scope="module")
def project(tmp_path_factory, commands):
    """A folder of a user: a recipe, a frame, frames of a laboratory, and two runs."""
    folder = tmp_path_factory.mktemp("project")
    write_reader_files(folder)
    (folder / "mine.yaml").write_text(RECIPE)
    np.save(
        folder / "raw.npy",
        np.random.default_rng(0).integers(1100, 3000, (24, 24, 3)).astype(np.uint16),
    )
    for name, words in (("left", ""), ("right", "'sensor.gain=0.6 e-/DN'")):
        line = f"run mine.yaml {words} --quiet --out runs/made"
        command(line, folder, folder / "cache", commands[0])
        (latest,) = (folder / "runs" / "made").glob("latest")
        latest.resolve().rename(folder / "runs" / name)
    return folder


def command(words, project, cache, start):
    environment = {**os.environ, "NEUSEE_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    done = start(*shlex.split(words), cwd=project, env=environment)
    assert done.returncode in (0, 3), done.stderr  # 3: a check of so short a calibration fails
    return done


def written(words, kept, project, cache, start):
    """The contents of the files that a command writes, by name without the date; they end in the
    folder ``kept``.
    """
    out = kept.parent / "out"  # always the same, because documents state the command
    out.mkdir()
    if words.startswith("report"):
        command(f"run mine.yaml --out {out}", project, cache, start)
    before = {path: path.stat().st_mtime_ns for path in project.rglob("*") if path.is_file()}
    line = words.format(out=out) if "{out}" in words else f"{words} --out {out}"
    command(line, project, cache, start)
    files = {DATE.sub("", path.relative_to(out).as_posix()): path for path in below(out)}
    beside = {path for path in below(project) if before.get(path) != path.stat().st_mtime_ns}
    files |= {
        f"beside {path.relative_to(project)}": path for path in beside if "runs" not in path.parts
    }
    if words.startswith("compare"):  # its page is all that it writes
        pages = {
            name: TIME.sub(b"", path.read_bytes())
            for name, path in files.items()
            if path.name == "report.html"
        }
        out.rename(kept)
        return pages
    found = {
        name: content(path) for name, path in files.items() if path.name not in DIFFERENT_FILES
    }
    for path in beside:
        path.unlink()
    out.rename(kept)
    return found


def below(folder):
    """The files below a folder, without those that are reached through a link."""
    return [
        Path(at) / name
        for at, _, names in os.walk(folder)
        for name in names
        if not (Path(at) / name).is_symlink()
    ]


def content(path):
    """The bytes of a file; of a table or a document, what may not differ."""
    if path.suffix == ".csv":
        with path.open(newline="", encoding="utf-8") as file:
            head, *rows = csv.reader(file)
        kept = [at for at, name in enumerate(head) if name not in MEASURED]
        return [[row[at] for at in kept] for row in (head, *rows)]
    if path.suffix == ".json":
        return said(json.loads(path.read_bytes(), parse_constant=str))  # NaN is not NaN
    if path.name == "sweep.yaml":  # its first line, a comment, counts the points that were computed
        return said(YAML(typ="safe").load(path.read_text(encoding="utf-8")))
    return path.read_bytes()


def said(item, name=""):
    """A document without what may differ."""
    if isinstance(item, dict):
        found = {
            key: said(value, key) for key, value in item.items() if key not in DIFFERENT_FIELDS
        }
        if {"made_in", "kept"} <= item.keys():
            found["made_in"] = MadeIn(item["kept"], item["made_in"])
        return found
    if isinstance(item, list) and name == "facts":
        return [row for row in item if row[0] not in DIFFERENT_ROWS]
    if isinstance(item, list) and name == "figures":
        return [
            said(each)
            for each in item
            if not isinstance(each, dict) or each.get("name") not in OF_WHAT_RAN
        ]
    return [said(each) for each in item] if isinstance(item, list) else item


class MadeIn(NamedTuple):
    """How long a step took when its result was made, and whether this computation of it was
    stored.
    """

    kept: bool
    seconds: float


def differences(one, other, place=""):
    """The places at which two contents differ.

    On one processor a cheap step may be computed twice in a command: a result that is not stored at
    first is made again later, and stored. The first run states the time of the first, a run from
    the cache that of the second.
    """
    if isinstance(one, MadeIn) and isinstance(other, MadeIn):
        if not one.kept:
            return []
        one, other = one.seconds, other.seconds
    if isinstance(one, dict) and isinstance(other, dict):
        every = sorted({*one, *other})
        return [
            each
            for key in every
            for each in differences(one.get(key), other.get(key), f"{place}/{key}")
        ]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = enumerate(zip(one, other, strict=True))
        return [
            each
            for at, (left, right) in pairs
            for each in differences(left, right, f"{place}/{at}")
        ]
    return [] if one == other else [f"{place}: {str(one)[:80]} | {str(other)[:80]}"]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.long if name in LONG else pytest.mark.slow)
        for name in COMMANDS
    ],
)
def test_a_command_writes_the_same_from_the_cache(name, tmp_path, project, commands):
    cache = tmp_path / "cache"
    first = written(COMMANDS[name], tmp_path / "first", project, cache, commands[0])
    again = written(COMMANDS[name], tmp_path / "again", project, cache, commands[1])
    assert first
    assert differences(first, again) == []


@pytest.mark.slow
def test_a_page_is_written_again_as_it_was(tmp_path, project, commands):
    command(f"run mine.yaml --out {tmp_path}", project, tmp_path / "cache", commands[0])
    (page,) = (path for path in below(tmp_path) if path.name == "report.html")
    before = page.read_bytes()
    page.unlink()
    command(f"report --out {tmp_path}", project, tmp_path / "cache", commands[1])
    assert page.read_bytes() == before


def test_every_command_that_writes_is_a_case():
    words = {tuple(shlex.split(line)[:2]) for line in COMMANDS.values()}
    assert {first for first, _ in words} == set(ALL_COMMANDS) - WRITE_NOTHING
    assert {kind for first, kind in words if first == "study"} == set(KINDS)
    assert set(ALL_COMMANDS) > WRITE_NOTHING


@pytest.mark.parametrize("kept", [True, False])
def test_the_time_of_a_step_may_differ_only_where_its_first_result_was_not_stored(kept):
    first = {"step": "a", "kept": kept, "made_in": 1.0}
    again = {"step": "a", "kept": True, "made_in": 2.0}
    assert bool(differences(said(first), said(again))) == kept
    assert differences(said(first), said({**again, "made_in": 1.0})) == []
