"""With --json and --quiet stdout holds the result alone, whatever own code prints and the
terminal can show.
"""

import json
import os
import pty
import re
import subprocess
import sys
import threading

import pytest

from tests.workflows.forked_commands import NEUSEE, OTHERS, PROGRAM, Commands

OWN = '''
import ctypes
import torch
from torch import Tensor
from neusee.nodes import node


@node(depends=["unaffected:run"])
def printed(*, by: float = 2.0) -> Tensor:
    """Print in Python and in C."""
    print("printed by Python, 3 µm", flush=True)
    ctypes.CDLL(None).puts(b"printed by C")
    ctypes.CDLL(None).fflush(None)
    return torch.full((2, 3, 4), by)


@node()
def plain(*, by: float = 2.0) -> Tensor:
    """Print without any import that may change something."""
    print("printed beside")
    return torch.full((2, 3, 4), by)
'''
RECIPE = (
    "# Prints µ.\nnodes: [own_prints.py]\nsteps:\n  a: {node: own_prints.printed}\noutputs: [a]\n"
)


@pytest.fixture(scope="module")
def forks():
    found = Commands(imports=(*OTHERS, *PROGRAM))
    yield found
    found.close()


@pytest.fixture
def called(tmp_path, forks):
    """Run the program on a recipe with a node that prints; with variables that Python reads at
    its start in a new process.
    """
    (tmp_path / "own_prints.py").write_text(OWN, encoding="utf-8")
    (tmp_path / "r.yaml").write_text(RECIPE, encoding="utf-8")

    def call(*words, **variables):
        env = {**os.environ, "NEUSEE_CACHE": str(tmp_path / "cache"), **variables}
        words = [*words, "--out", str(tmp_path / "out")]
        if not variables:
            done = forks(*words, env=env, cwd=tmp_path)
            assert done.returncode == 0, done.stderr
            return done.stdout, done.stderr
        command = [sys.executable, "-m", "neusee", *words]
        done = subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, check=True)
        return done.stdout.decode(), done.stderr.decode("utf-8", "replace")

    return call


LOCALES = {
    "usual": {},
    "ascii": {"PYTHONIOENCODING": "ascii"},
    "C": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LOCALES)
def test_json_is_all_that_stdout_has(called, name):
    out, err = called("run", "r.yaml", "--json", **LOCALES[name])
    assert json.loads(out)["title"] == "Prints µ."
    assert "printed by Python" in err
    assert "printed by C" in err
    if name == "usual":
        assert json.loads(called("run", "r.yaml", "--json")[0])["counts"] == "1 cached"


def test_quiet_prints_one_path(called, tmp_path):
    lines = called("run", "r.yaml", "--quiet")[0].splitlines()
    assert len(lines) == 1
    assert (tmp_path / lines[0]).is_file()


def test_code_that_changes_nothing_prints_beside_the_result_too(called, tmp_path):
    (tmp_path / "r.yaml").write_text(RECIPE.replace("printed}", "plain}"), encoding="utf-8")
    own = tmp_path / "own_prints.py"
    own.write_text(
        OWN.replace("import ctypes\n", "").replace("ctypes.CDLL(None)", "object"), encoding="utf-8"
    )
    out, err = called("run", "r.yaml", "--json")
    json.loads(out)
    assert "printed beside" in err


ON_TERMINAL = """
import os
import torch
from torch import Tensor
from neusee.nodes import node


@node(depends=["unaffected:state"])
def printed(*, by: float = 2.0) -> Tensor:
    print("process", os.getpid())
    return torch.full((2, 3, 4), by)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "imports", ["", "import decimal"], ids=["changes nothing", "may change something"]
)
def test_beside_the_table_of_a_terminal_a_step_has_its_process_and_its_words(
    imports, tmp_path, forks
):
    (tmp_path / "own_prints.py").write_text(imports + ON_TERMINAL, encoding="utf-8")
    (tmp_path / "r.yaml").write_text(RECIPE, encoding="utf-8")
    mine, theirs = pty.openpty()
    shown = []
    reading = threading.Thread(
        target=lambda: shown.extend(iter(lambda: _read(mine), b"")), daemon=True
    )
    reading.start()
    program = forks(
        *("run", "r.yaml", "--out", str(tmp_path / "out")),
        cwd=tmp_path,
        env={**os.environ, "NEUSEE_CACHE": str(tmp_path / "cache"), "TERM": "xterm"},
        code=f"import os\nprint('program', os.getpid())\n{NEUSEE}",
        terminal=os.ttyname(theirs),
    )
    os.close(theirs)
    reading.join()
    os.close(mine)
    shown = b"".join(shown)
    assert program.returncode == 0, shown
    numbers = dict(re.findall(rb"(program|process) (\d+)", shown))
    assert (numbers[b"process"] != numbers[b"program"]) == bool(imports)


def _read(terminal):
    try:
        return os.read(terminal, 4096)
    except OSError:  # the other end is closed
        return b""
