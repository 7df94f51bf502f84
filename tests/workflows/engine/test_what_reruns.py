"""The table of truths: what must rerun, what must not, through whole runs in processes of their
own.

Every process sees a family of nodes as it stands on disk at that time. What ran is read from a file
to which each node's function adds its name, so that no report of the engine is taken on trust.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

SPEC = importlib.util.spec_from_file_location("forks", Path(__file__).parents[1] / "forks.py")
forks = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(forks)

LAYOUT = {
    "truth/__init__.py": (
        '"""Four nodes and what they lean on."""\n'
        "from neusee.nodes.truth._ends import measure, network\n"
        "from neusee.nodes.truth._heads import scene, sensor\n"
    ),
    "truth/_heads.py": (
        '"""Where light begins."""\n'
        "import torch\n\n"
        "from neusee.nodes import node\n"
        "from neusee.nodes.truth_log import ran\n"
        "from neusee.nodes.truth_more import OFFSET, scaled\n\n\n"
        "@node()\n"
        "def scene(*, level: float):\n"
        '    """Make light."""\n'
        '    ran("scene")\n'
        "    return torch.full((3,), scaled(level))\n\n\n"
        "@node()\n"
        "def sensor(x, *, gain: float):\n"
        '    ran("sensor")\n'
        "    return x * gain + OFFSET\n"
    ),
    "truth/_ends.py": (
        "from pathlib import Path\n\n"
        "import torch\n\n"
        "from neusee.nodes import node\n"
        "from neusee.nodes.truth_log import ran\n"
        "from neusee.nodes.units import DataFile\n\n\n"
        "@node()\n"
        "def network(x, *, weights: DataFile):\n"
        '    ran("network")\n'
        "    layer = torch.nn.Linear(3, 1)\n"
        "    layer.load_state_dict(torch.load(weights, weights_only=True))\n"
        "    return layer(x)\n\n\n"
        "@node()\n"
        "def measure(x, *, offset: Path):\n"
        '    ran("measure")\n'
        "    return x.sum() + float(offset.read_text())\n"
    ),
    "truth_more.py": (
        "TWO = 2.0\nOFFSET = 1.0\nUNUSED = 5.0\n\n\ndef scaled(x):\n    return x * TWO\n"
    ),
    "truth_log.py": (
        "import os\n\n__depends__ = ('unaffected:os.environ', 'unaffected:open')\n\n\n"
        "def ran(name):\n"
        '    with open(os.environ["TRUTH_LOG"], "a") as file:\n'
        '        file.write(name + "\\n")\n'
    ),
}
ALL, SENSOR, NETWORK, MEASURE = (
    "scene sensor network measure",
    "sensor network measure",
    "network measure",
    "measure",
)
NONE = ""
#: level 2, gain 10: scene 4, sensor 41, weights 1 1 1 and bias 0: 123, offset 0.5
TRUE = 123.5


class Lab:
    """Four steps in a row: scene, sensor, network, measure."""

    def __init__(self, folder: Path, server: Any) -> None:
        self.folder, self.server, self.store = folder / "nodes", server, folder / "cache"
        self.log, self.offset, self.weights = (
            folder / "ran.txt",
            folder / "offset.txt",
            folder / "weights.pt",
        )
        self.level, self.gain = 2.0, 10.0
        for name, text in LAYOUT.items():
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / name).write_text(text)
        self.offset.write_text("0.5")
        self.train(1.0)

    def train(self, weight: float, path: Path | None = None) -> None:
        """Save a network whose three weights are ``weight``."""
        state = {"weight": torch.full((1, 3), weight), "bias": torch.zeros(1)}
        torch.save(state, path or self.weights)

    def edit(self, name: str, old: str, new: str) -> None:
        text = (self.folder / name).read_text()
        assert text.count(old) == 1
        (self.folder / name).write_text(text.replace(old, new))

    def job(self) -> dict[str, Any]:
        steps = [
            ["scene", "scene", {"level": self.level}, {}],
            ["sensor", "sensor", {"gain": self.gain}, {"x": "scene"}],
            ["network", "network", {"weights": {"file": self.weights}}, {"x": "sensor"}],
            ["measure", "measure", {"offset": {"file": self.offset}}, {"x": "network"}],
        ]
        first = f"import os; os.environ['TRUTH_LOG'] = {str(self.log)!r}"
        job = {
            "folder": self.folder,
            "family": "truth",
            "store": self.store,
            "steps": steps,
            "first": first,
        }
        return {**job, "outputs": ["measure"]}

    def run(self, server: Any = None) -> tuple[float, str]:
        """The last step's value in a new process, and what it had to compute."""
        self.log.unlink(missing_ok=True)
        self.last = (server or self.server).run(**self.job())
        assert self.last.get("error") is None, self.last["error"]
        assert self.last["warnings"] == []
        ran = self.log.read_text().split() if self.log.exists() else []
        return self.last["values"]["measure"][0], " ".join(ran)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    found = forks.Forks(tmp_path_factory.mktemp("forks"))
    yield found
    found.close()


@pytest.fixture
def lab(tmp_path, server):
    found = Lab(tmp_path, server)
    assert found.run() == (TRUE, ALL)
    return found


def edit(name, old, new):
    return lambda lab: lab.edit(f"{name}.py", old, new)


def weight(value):
    return lambda lab: lab.train(value)


TRUTHS = {
    # what must rerun, from the first step that it reaches
    "body of the first node": (
        edit("truth/_heads", "scaled(level)", "scaled(level) + 1"),
        153.5,
        ALL,
    ),
    # one module, one digest
    "body of the last node": (edit("truth/_ends", "x.sum()", "2 * x.sum()"), 246.5, NETWORK),
    "body of a helper": (edit("truth_more", "x * TWO", "x * TWO + 1"), 153.5, ALL),
    "constant of a helper": (edit("truth_more", "TWO = 2.0", "TWO = 3.0"), 183.5, ALL),
    "constant of a node": (edit("truth_more", "OFFSET = 1.0", "OFFSET = 2.0"), 126.5, ALL),
    "default of a helper": (edit("truth_more", "def scaled(x):", "def scaled(x, y=0):"), TRUE, ALL),
    "parameter of the first": (lambda lab: setattr(lab, "level", 3.0), 183.5, ALL),
    "parameter of the second": (lambda lab: setattr(lab, "gain", 20.0), 243.5, SENSOR),
    "content of a file": (lambda lab: lab.offset.write_text("0.7"), pytest.approx(123.7), MEASURE),
    "weights": (weight(2.0), 246.5, NETWORK),
    "weights by the last bit": (weight(1.0 + 2**-23), pytest.approx(123.5, rel=1e-6), NETWORK),
    # what must not
    "nothing": (lambda lab: None, TRUE, NONE),
    "comment": (edit("truth/_heads", "import torch\n", "import torch  # of course\n"), TRUE, NONE),
    "comment in a helper": (
        edit("truth_more", "    return", "    # twice\n    return"),
        TRUE,
        NONE,
    ),
    "docstring of a node": (
        edit("truth/_heads", "Make light.", "Make light, much of it."),
        TRUE,
        NONE,
    ),
    "docstring of a module": (
        edit("truth/_heads", "Where light begins.", "It begins here."),
        TRUE,
        NONE,
    ),
    "docstring, a new one": (
        edit("truth_more", "    return", '    """Twice."""\n    return'),
        TRUE,
        NONE,
    ),
    "blank lines": (edit("truth_more", "\n\n\ndef", "\n\n\n\n\n\ndef"), TRUE, NONE),
    "layout": (edit("truth_more", "x * TWO", "(x *\n            TWO)"), TRUE, NONE),
    "source touched": (lambda lab: os.utime(lab.folder / "truth_more.py"), TRUE, NONE),
    "file touched": (lambda lab: os.utime(lab.offset, (1, 1)), TRUE, NONE),
    "file written again": (lambda lab: lab.offset.write_text("0.5"), TRUE, NONE),
    "weights saved again": (weight(1.0), TRUE, NONE),
}


@pytest.mark.slow
@pytest.mark.parametrize("change", TRUTHS)
def test_what_may_have_changed_runs_again_and_nothing_else(lab, change):
    make, value, ran = TRUTHS[change]
    make(lab)
    assert lab.run() == (value, ran)
    assert lab.run() == (value, NONE)


BACK_AND_FORTH = {
    "helper": (
        edit("truth_more", "x * TWO", "TWO + x * TWO"),
        edit("truth_more", "TWO + x * TWO", "x * TWO"),
    ),
    "constant": (
        edit("truth_more", "OFFSET = 1.0", "OFFSET = 9.0"),
        edit("truth_more", "OFFSET = 9.0", "OFFSET = 1.0"),
    ),
    "parameter": (lambda lab: setattr(lab, "gain", 20.0), lambda lab: setattr(lab, "gain", 10.0)),
    "file": (lambda lab: lab.offset.write_text("0.7"), lambda lab: lab.offset.write_text("0.5")),
    "weights": (weight(3.0), weight(1.0)),
}


@pytest.mark.parametrize("change", BACK_AND_FORTH)
def test_what_is_taken_back_finds_the_old_result(lab, change):
    there, back = BACK_AND_FORTH[change]
    there(lab)
    value, ran = lab.run()
    assert value != TRUE
    assert ran
    back(lab)
    assert lab.run() == (TRUE, NONE)
    there(lab)
    assert lab.run() == (value, NONE)


def test_three_networks_give_three_results(lab):
    found = []
    for value in (1.0, 2.0, 3.0, 2.0):
        lab.train(value)
        found.append(lab.run()[0])
    assert found == [123.5, 246.5, 369.5, 246.5]


@pytest.fixture(scope="module")
def others(tmp_path_factory):
    """Servers whose processes put sets and dictionaries in other orders."""
    found = [forks.Forks(tmp_path_factory.mktemp("others"), seed) for seed in ("1", "2")]
    yield found
    for server in found:
        server.close()


@pytest.mark.slow
def test_processes_agree_on_keys_and_share_results(lab, others):
    keys = lab.last["keys"]
    for server in others:
        assert lab.run(server) == (TRUE, NONE)
        assert lab.last["keys"] == keys


@pytest.mark.slow
def test_equal_tensors_of_two_processes_make_equal_keys(lab, others, tmp_path):
    """Each process saves its own weights and makes its own keys, in a folder and a store of its
    own.
    """
    found = []
    for i, (server, value) in enumerate(zip([*others, *others], (1.5, 1.5, 1.5, 2.5), strict=True)):
        folder = tmp_path / f"copy{i}"
        folder.mkdir()
        own = Lab(folder, server)
        own.weights.unlink()
        first = (
            "import torch\n"
            f"state = {{'weight': torch.full((1, 3), {value}), 'bias': torch.zeros(1)}}\n"
            f"torch.save(state, {str(own.weights)!r})\n"
        )
        job = own.job()
        found.append(server.run(**{**job, "first": first + job["first"]})["keys"])
    assert found[0] == found[1] == found[2]
    assert found[3]["sensor"] == found[0]["sensor"]
    assert found[3]["network"] != found[0]["network"]


@pytest.mark.slow
def test_a_moved_project_keeps_its_results(lab, tmp_path):
    """No path of the code or of a file is part of a key."""
    for name in ("nodes", "offset.txt", "weights.pt"):
        (tmp_path / "elsewhere").mkdir(exist_ok=True)
        shutil.move(tmp_path / name, tmp_path / "elsewhere" / name)
    lab.folder = tmp_path / "elsewhere" / "nodes"
    lab.offset, lab.weights = (
        tmp_path / "elsewhere" / "offset.txt",
        tmp_path / "elsewhere" / "weights.pt",
    )
    assert lab.run() == (TRUE, NONE)
