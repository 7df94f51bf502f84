"""With --json and --quiet stdout holds the result alone, whatever own code prints and the terminal can show."""

import json
import os
import pty
import re
import subprocess
import sys

import pytest

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
RECIPE = "# Prints µ.\nnodes: [own_prints.py]\nsteps:\n  a: {node: own_prints.printed}\noutputs: [a]\n"


@pytest.fixture
def called(tmp_path):
    """Run the program on a recipe with a node that prints."""
    (tmp_path / "own_prints.py").write_text(OWN, encoding="utf-8")
    (tmp_path / "r.yaml").write_text(RECIPE, encoding="utf-8")

    def call(*words, **variables):
        env = {**os.environ, "NEUSEE_CACHE": str(tmp_path / "cache"), **variables}
        command = [sys.executable, "-m", "neusee", *words, "--out", str(tmp_path / "out")]
        return subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, check=True)

    return call


@pytest.mark.parametrize(
    "variables",
    [{}, {"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}],
    ids=["usual", "ascii", "C"],
)
def test_json_is_all_that_stdout_has(called, variables):
    done = called("run", "r.yaml", "--json", **variables)
    document = json.loads(done.stdout)
    assert document["title"] == "Prints µ."
    assert b"printed by Python" in done.stderr
    assert b"printed by C" in done.stderr
    assert json.loads(called("run", "r.yaml", "--json", **variables).stdout)["counts"] == "1 cached"


def test_quiet_prints_one_path(called, tmp_path):
    lines = called("run", "r.yaml", "--quiet").stdout.decode().splitlines()
    assert len(lines) == 1
    assert (tmp_path / lines[0]).is_file()


def test_code_that_changes_nothing_prints_beside_the_result_too(called, tmp_path):
    (tmp_path / "r.yaml").write_text(RECIPE.replace("printed}", "plain}"), encoding="utf-8")
    own = tmp_path / "own_prints.py"
    own.write_text(OWN.replace("import ctypes\n", "").replace("ctypes.CDLL(None)", "object"), encoding="utf-8")
    done = called("run", "r.yaml", "--json")
    json.loads(done.stdout)
    assert b"printed beside" in done.stderr


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


@pytest.mark.parametrize("imports", ["", "import decimal"], ids=["changes nothing", "may change something"])
def test_beside_the_table_of_a_terminal_a_step_has_its_process_and_its_words(imports, tmp_path):
    (tmp_path / "own_prints.py").write_text(imports + ON_TERMINAL, encoding="utf-8")
    (tmp_path / "r.yaml").write_text(RECIPE, encoding="utf-8")
    mine, theirs = pty.openpty()
    env = {**os.environ, "NEUSEE_CACHE": str(tmp_path / "cache"), "TERM": "xterm"}
    command = [sys.executable, "-m", "neusee", "run", "r.yaml", "--out", str(tmp_path / "out")]
    with subprocess.Popen(command, env=env, cwd=tmp_path, stdin=theirs, stdout=theirs, stderr=theirs) as program:
        os.close(theirs)
        shown = b"".join(iter(lambda: _read(mine), b""))
    os.close(mine)
    assert program.returncode == 0, shown
    number = int(re.search(rb"process (\d+)", shown).group(1))
    assert (number != program.pid) == bool(imports)


def _read(terminal):
    try:
        return os.read(terminal, 4096)
    except OSError:  # the other end is closed
        return b""
