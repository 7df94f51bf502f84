"""What a command writes when it computes, it writes when everything is in the cache: the same bytes.

Each command runs twice in a process of its own, because what a process has imported may change how it writes.
"""

import csv
import os
import shlex
import subprocess
import sys

import pytest

SMALL = (
    "'optics.samples=64' 'optics.pitch=120 um' 'optics.window=[32,32]' optics.bands=3 'scene.shape=[28,28]' "
    "'sensor.shape=[24,24]' ~expect"
)
COMMANDS = {
    "run": f"run first_light {SMALL}",
    "evaluate": f"evaluate first_light {SMALL} --scenes 1 --strengths 0,30 --pipelines 'flat+none, half_ring+none'",
    "sweep": f"sweep first_light {SMALL} 'sensor.read_noise=5 e-,10 e-' outputs=[restored_quality]",
    "study": f"study uncertainty first_light {SMALL} 'sensor.read_noise=normal(10.5 e-, 0.5 e-)' --error 0.5 --most 64 "
    "outputs=[restored_quality]",
}
#: files that say when and how long the command ran, which steps it computed, or the sizes of such files
OF_THE_COMMAND = {
    "provenance.json", "report.html", "ro-crate-metadata.json", "timing.csv", "timeline.png", "graph.png", "sweep.yaml",
}  # fmt: skip
MEASURED = {"seconds", "cached"}  #: columns of a table


def written(words, folder, cache):
    """The contents of the files of a command's folder, by name."""
    environment = {**os.environ, "NEUSEE_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "neusee", *shlex.split(words), "--out", str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (latest,) = folder.rglob("latest")
    files = [path for path in latest.resolve().rglob("*") if path.is_file() and path.name not in OF_THE_COMMAND]
    return {path.relative_to(latest.resolve()).as_posix(): content(path) for path in files}


def content(path):
    """The bytes of a file; of a table, the columns that are not measured."""
    if path.suffix != ".csv":
        return path.read_bytes()
    with path.open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    kept = [at for at, name in enumerate(head) if name not in MEASURED]
    return [[row[at] for at in kept] for row in (head, *rows)]


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_writes_the_same_from_the_cache(name, tmp_path):
    first = written(COMMANDS[name], tmp_path / "first", tmp_path / "cache")
    again = written(COMMANDS[name], tmp_path / "again", tmp_path / "cache")
    assert first.keys() == again.keys()
    assert first
    assert not [file for file in first if first[file] != again[file]]
