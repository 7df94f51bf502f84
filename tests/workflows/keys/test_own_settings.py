"""Settings of a process that own code may read: they count for own nodes, where they are not the
usual ones.
"""

import json
import locale
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from neusee.nodes import own_modules, scene
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.loaded_state import own_settings
from neusee.workflows.recipe.node_families import import_own

ROOT = Path(__file__).parents[3]
HEAD = "import torch\nfrom neusee.nodes import node\n"
NODE = HEAD + "{before}\n\n@node()\ndef {name}(*, k: float = 1.0):\n    return {result}\n"


@pytest.fixture(autouse=True)
def plain_start(monkeypatch):
    """As if nothing had changed Python when it started."""
    for name in ("sitecustomize", "usercustomize"):
        monkeypatch.delitem(sys.modules, name, raising=False)


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The digest of an own node as it is now, with lines before it."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "path", [*sys.path])
    files = dict(own_modules._files)

    def digest(before="", node=None):
        sys.modules.pop("sets_own", None)
        (tmp_path / "sets_own.py").write_text(
            NODE.format(before=before, name="value", result="torch.tensor(k)")
        )
        mine = import_own("sets_own.py", tmp_path).value
        return Code(tmp_path / "code.json").of(node or mine)

    yield digest
    sys.modules.pop("sets_own", None)
    own_modules._files.clear()
    own_modules._files.update(files)


@pytest.fixture
def zone(monkeypatch):
    """Set the time zone of this process."""

    def put(name):
        monkeypatch.setenv("TZ", name)
        time.tzset()

    yield put
    monkeypatch.undo()
    time.tzset()


def test_floating_point_errors_that_end_a_calculation_count(own):
    usual = own()
    with np.errstate(all="ignore"):
        assert own() == usual  # a warning decides nothing
    with np.errstate(divide="raise"):
        assert own_settings(False) == {"floating-point errors": "divide raise"}
        assert own() != usual


def test_how_numbers_are_printed_counts(own):
    usual = own()
    with np.printoptions(precision=3):
        assert own_settings(False) == {"printed numbers": "precision=3"}
        assert own() != usual
    with np.printoptions(legacy="1.13"):
        assert "legacy" not in str(own_settings(False))


@pytest.mark.parametrize("name", ["sitecustomize", "usercustomize"])
def test_code_that_runs_when_python_starts_counts_by_its_text(name, own, tmp_path, monkeypatch):
    usual, file = own(), tmp_path / f"{name}.py"
    monkeypatch.setitem(sys.modules, name, SimpleNamespace(__file__=str(file)))
    assert own_settings(False) == {}
    file.write_text("import numpy")
    first = own()
    assert own_settings(False).keys() == {"code at the start of Python"}
    assert first != usual
    file.write_text("import numpy\nnumpy.pi = 3")
    assert own() != first


def test_the_encoding_of_texts_counts(own, monkeypatch):
    usual = own()
    assert "encoding of texts" not in own_settings(False)
    monkeypatch.setattr(locale, "getpreferredencoding", lambda do_setlocale=True: "ANSI_X3.4-1968")
    assert own_settings(False) == {"encoding of texts": "ascii"}
    assert own() != usual


def test_the_time_zone_counts_where_code_may_read_it(own, zone):
    zone("UTC")
    usual, plain = own("import datetime\n"), own()
    zone("Asia/Tokyo")
    assert own_settings(True)["time zone"].startswith("JST/")
    assert own("import datetime\n") != usual
    assert own() == plain
    zone("Etc/UTC")
    assert own("import datetime\n") == usual


def test_no_setting_of_own_code_counts_for_the_nodes_of_neusee(own, zone):
    zone("UTC")
    usual = own("import datetime\n", scene.targets)
    zone("Asia/Tokyo")
    with np.errstate(divide="raise"), np.printoptions(precision=3):
        assert own("import datetime\n", scene.targets) == usual


RECIPE = """\
# Mine.
nodes: [cluster_a.py, cluster_b.py]
steps:
  v: {node: cluster_a.value}
  s: {node: scene.targets, with: {kind: siemens, shape: [4, 4]}}
outputs: [v, s]
"""


@pytest.mark.slow
def test_a_worker_has_the_keys_of_the_caller_where_a_file_patches_a_library(tmp_path):
    before = "import numpy as np\nimport datetime\n"
    patch = "import numpy as np\nnp.mean = lambda x: 2.0\n"
    value = "torch.tensor(float(np.mean([k])))"
    (tmp_path / "cluster_a.py").write_text(NODE.format(before=before, name="value", result=value))
    (tmp_path / "cluster_b.py").write_text(
        NODE.format(before=patch, name="other", result="torch.tensor(k)")
    )
    (tmp_path / "r.yaml").write_text(RECIPE)
    env = {
        **os.environ,
        "PYTHONPATH": str(ROOT / ".src"),
        "NEUSEE_CACHE": str(tmp_path / "cache"),
        "TZ": "Asia/Tokyo",
    }
    states = []
    for more in (["--executor", "dask:1"], []):
        command = [sys.executable, "-m", "neusee", "run", "r.yaml", "--json", *more]
        done = subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        states.append([step["state"] for step in json.loads(done.stdout)["steps"]])
    assert states == [["run", "run"], ["cached", "cached"]]
