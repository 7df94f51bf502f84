"""Fifty runs in one process leave nothing behind: no memory, files, threads, handlers, filters or figures."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

RECIPE = """\
# An axicon, cut off at half its height.
mask: {waves: 2, samples: 192}
steps:
  cone:
    node: doe.axicon
    with: {samples: "${mask.samples}", pitch: 10 um, diameter: 1.9 mm, waves: "${mask.waves}"}
  made:
    node: doe.fabricate
    from: cone
    with: {material: fused silica, max_height: 1.2 um}
outputs: [cone, made]
"""
pytestmark = pytest.mark.slow  # it draws, and counts every object
COUNTED = (
    "files",
    "handlers",
    "loggers",
    "filters",
    "at exit",
    "figures",
    "tensors",
    "modules",
    "temporary",
)
NAMES = 5000  #: bytes a run of names that Python's own look-up cache keeps for a while
LOOSE = 7e6  #: bytes that come and go; the results of fifty runs are 14 MB


WARM, RUNS = 20, 50


@pytest.fixture(scope="module")
def grown(tmp_path_factory):
    """What ``growing.py`` held before and after so many runs."""
    folder = tmp_path_factory.mktemp("growth")
    recipe, rest = folder / "mine.yaml", folder / "tmp"
    recipe.write_text(RECIPE)
    rest.mkdir()
    program = Path(__file__).with_name("growing.py")
    done = subprocess.run(
        [sys.executable, program, recipe, folder / "work", str(WARM), str(RUNS)],
        env={**os.environ, "TMPDIR": str(rest), "MPLCONFIGDIR": str(folder / "mpl")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_fifty_runs_leave_nothing_open_or_hung_in(grown):
    left = {name: grown[name] for name in COUNTED if grown[name][1] > grown[name][0]}
    assert left == {}
    before, after = grown["threads"]
    assert after <= before + 1  # the one that keeps leases alive rests when there is none


def test_fifty_runs_need_no_more_memory(grown):
    before, after = grown["bytes"]
    assert after - before < NAMES * RUNS, f"{after - before} bytes of objects more"
    before, after = grown["resident"]
    assert after - before < LOOSE, f"{after - before} bytes of memory more"
    before, after = grown["maps"]
    assert after - before < RUNS / 2
