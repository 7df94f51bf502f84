"""Ctrl-C at any moment ends any command with exit code 130 and one sentence, and keeps what is
finished.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.workflows.forked_commands import Commands

LONGEST = 600.0  #: s after which a command counts as hanging

#: presses Ctrl-C once, for the whole group of processes as a terminal does, at an event of Python's
#: audit
PRESSING = """
import os, signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets what runs in the background ignore it
event_name, word = sys.argv[1:3]
del sys.argv[1:3]
pressed = []

def press(event, arguments):
    if event == event_name and not pressed and word in str(arguments[:1]):
        pressed.append(word)
        os.killpg(os.getpgrp(), signal.SIGINT)

sys.addaudithook(press)
try:
    from neusee.__main__ import main
    main()
finally:
    print("pressed" if pressed else "never pressed", file=sys.stderr)
"""

#: runs the program as a terminal does
LISTENING = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from neusee.__main__ import main
main()
"""

NODES = '''"""Nodes of a test."""
import os
import signal
import time

import torch
from torch import Tensor

from neusee.nodes import node


@node()
def light() -> Tensor:
    """Return light, after a while that is worth keeping."""
    time.sleep(0.3)
    return torch.ones(64, 64)


@node(depends=["unaffected:file", "unaffected:pressed"])
def pressed(image: Tensor, *, number: float = 0.0) -> Tensor:
    """Press Ctrl-C as a terminal does, once in a folder."""
    try:
        os.close(os.open("pressed", os.O_CREAT | os.O_EXCL))
        os.killpg(os.getpgrp(), signal.SIGINT)
        time.sleep(30)
    except FileExistsError:
        pass
    return image + number
'''

RECIPE = """# A step that is interrupted.
nodes: [pressing.py]
numbers: {one: 1.0}
steps:
  light: {node: pressing.light}
  pressed: {node: pressing.pressed, from: light, with: {number: "${numbers.one}"}}
outputs: [light, pressed]
"""


def environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "NEUSEE_CACHE": str(folder / "cache"), "COLUMNS": "200"}


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command of Python in a folder, in a group of processes of its own."""
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
        timeout=LONGEST,
        start_new_session=True,
    )


@pytest.fixture(scope="module")
def forked():
    """The same in a fork of a process that has torch at hand."""
    forks = Commands()

    def forked(folder: Path, option: str, code: str, *words: str):
        assert option == "-c"
        return forks(*words, cwd=folder, env=environment(folder), code=code, session=True)

    yield forked
    forks.close()


def stopped(done: subprocess.CompletedProcess[str]) -> None:
    """Check that a command ended as after Ctrl-C: with its exit code, one sentence and no
    traceback.
    """
    said = [
        line
        for line in done.stderr.splitlines()
        if line.strip() and line not in ("pressed", "never pressed")
    ]
    assert "never pressed" not in done.stderr
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    assert len([line for line in said if "stopped" in line]) == 1, done.stderr


QUICK = {
    "validate, at an import": (["validate", "laser_free"], "import", "pydantic"),
    "validate, while a recipe is read": (["validate", "laser_free"], "open", "laser_free.yaml"),
}
#: a run and an estimate that end soon; a module that `lazy_imports` imports raises no event of its own,
#: and its file is opened
PLAIN = """# A target, digitized.
outputs: [raw]
tolerance: 0
steps:
  scene: {node: scene.targets, with: {kind: siemens, shape: [8, 8]}}
  raw: {node: sensor.digitize, from: {electrons: scene}, with: {gain: 0.5 e-/DN}}
"""
PULSE = """# A pulse, 20 m away.
defaults: [camera: lens_only, optics: lens_only, doe: flat]
lasers:
  long: {wavelength: 532 nm, pulse_energy: 1 mJ, pulse_duration: 1 us, repetition_rate: 10 Hz, divergence: 1 mrad,
         distance: 20 m}
safety:
  lens: {focal_length: 50 mm, diameter: 12 mm, transmittance: 0.9, focus: laser}
  sensor: {pixel_pitch: 3.45 um, shape: [1536, 2048], quantum_efficiency: 0.65, full_well: 10500 e-, exposure: 10 ms}
  damage: none
outputs: [laser_lsr]
"""
SLOW = {
    "run, while the report is written": (["run", "plain.yaml"], "open", "provenance.json"),
    "sweep": (
        ["sweep", "laser_free", "optics.bands=3,4", "outputs=[lsr]"],
        "import",
        "neusee.workflows.sweeps",
    ),
    "train": (["train", "train_small"], "open", "run_training."),
    "study": (
        ["study", "stability", "laser_free"],
        "import",
        "neusee.workflows.studies.extreme_cases",
    ),
    "safety": (["safety", "safety_pointer"], "open", "run_safety."),
    "safety, while it writes": (["safety", "pulse.yaml"], "open", "provenance.json"),
    "calibrate": (["calibrate", "calibrate"], "open", "run_calibration."),
    "restore": (
        ["restore", "frame.png", "--camera", "first_light"],
        "import",
        "neusee.workflows.recipe.loading",
    ),
    "handbook": (["handbook"], "import", "neusee.workflows.handbook"),
    "evaluate": (["evaluate", "first_light"], "open", "run_evaluation."),
    "nodes": (["nodes"], "import", "neusee.nodes.optics"),
    "cache": (["cache", "list"], "import", "neusee.workflows.store.result_store"),
}


@pytest.mark.parametrize("moment", QUICK)
def test_ctrl_c_before_the_work_is_one_sentence(moment, tmp_path):
    words, event, word = QUICK[moment]
    stopped(command(tmp_path, "-c", PRESSING, event, word, *words))


@pytest.mark.slow
@pytest.mark.parametrize("moment", SLOW)
def test_ctrl_c_ends_every_command_with_one_sentence(moment, tmp_path, forked):
    words, event, word = SLOW[moment]
    (tmp_path / "frame.png").write_bytes(b"no picture")
    (tmp_path / "plain.yaml").write_text(PLAIN)
    (tmp_path / "pulse.yaml").write_text(PULSE)
    stopped(forked(tmp_path, "-c", PRESSING, event, word, *words))


@pytest.mark.slow
def test_ctrl_c_at_the_import_of_torch_is_one_sentence(tmp_path):
    stopped(command(tmp_path, "-c", PRESSING, "import", "torch", "run", "laser_free"))


@pytest.fixture
def here(tmp_path):
    """A folder with a recipe whose second step presses Ctrl-C."""
    (tmp_path / "pressing.py").write_text(NODES)
    (tmp_path / "pressing.yaml").write_text(RECIPE)
    return tmp_path


@pytest.mark.slow
def test_ctrl_c_in_a_step_keeps_the_finished_steps(here, forked):
    stopped(forked(here, "-c", LISTENING, "run", "pressing.yaml"))
    again = forked(here, "-c", LISTENING, "run", "pressing.yaml")
    assert again.returncode == 0, again.stderr
    rows = {
        line.split()[0]: line
        for line in again.stdout.splitlines()
        if line.startswith("  ") and line.split()
    }
    assert "cached" in rows["light"]
    assert "run" in rows["pressed"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["sweep", "pressing.yaml", "numbers.one=1.5,2.5,3.5", "--workers", "2"],
        ["study", "uncertainty", "pressing.yaml", "numbers.one=normal(1, 0.1)", "--workers", "2"],
    ],
)
def test_ctrl_c_reaches_no_worker_of_a_command(here, words, forked):
    done = forked(here, "-c", LISTENING, *words)
    stopped(done)


@pytest.mark.slow
def test_a_program_that_ignores_the_signal_goes_on(here, forked):
    """A script that runs the program in the background lets the shell decide."""
    ignoring = (
        "import runpy, signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "runpy.run_module('neusee', run_name='__main__')"
    )
    (here / "pressing.py").write_text(NODES.replace("time.sleep(30)", "pass"))
    done = forked(here, "-c", ignoring, "run", "pressing.yaml", "--quiet")
    assert done.returncode == 0, done.stderr


HANGING = '''"""Nodes of a test."""
import os
import time
from pathlib import Path

import torch
from torch import Tensor

from neusee.nodes import node


@node()
def hangs(x: Tensor) -> Tensor:
    """Hang, and say in which process."""
    Path(__file__).with_suffix(".new").write_text(str(os.getpid()))
    Path(__file__).with_suffix(".new").replace(Path(__file__).with_suffix(".pid"))
    time.sleep(1e6)
    return x


@hangs.example
def _():
    return {"x": torch.ones(3)}
'''


@pytest.mark.slow
def test_ctrl_c_ends_a_check_whose_node_hangs_and_its_processes(tmp_path):
    (tmp_path / "hanging.py").write_text(HANGING)
    words = [sys.executable, "-c", LISTENING, "check", "hanging.py"]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        words, cwd=tmp_path, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    ) as checking:
        called = tmp_path / "hanging.pid"
        until = time.monotonic() + LONGEST
        while not called.exists() and checking.poll() is None and time.monotonic() < until:
            time.sleep(0.05)
        elsewhere = int(called.read_text())
        # a node that would end or stop the check is called in another process first
        assert elsewhere != checking.pid
        os.killpg(checking.pid, signal.SIGINT)
        out, err = checking.communicate(timeout=LONGEST)
    stopped(subprocess.CompletedProcess(words, checking.returncode, out, err))
    while Path(f"/proc/{elsewhere}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not Path(f"/proc/{elsewhere}").exists()
