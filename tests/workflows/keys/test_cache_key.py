"""What changes a key, what does not, and what making one costs."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import neusee.nodes
from neusee.nodes import node
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys import code_digest
from neusee.workflows.keys.cache_key import digest, file_digest, key_of, plain, stream_seed
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.store.result_store import Store

MARK = Location("trial.yaml", 1, 1)
LAYOUT = {
    "trial/__init__.py": (
        "from neusee.nodes.trial._head import head\nfrom neusee.nodes.trial._tail import tail\n"
    ),
    "trial/_head.py": (
        '"""Head."""\nimport torch\nfrom neusee.nodes import node\nfrom'
        " neusee.nodes.trial_constants import ONE\nfrom ._helper import half\n\n\n@node()\ndef"
        ' head(*, start: float):\n    """Begin."""\n    return torch.full((3,), half(2 * start) +'
        " ONE)\n"
    ),
    "trial/_helper.py": (
        "from .. import trial_more\n\n\ndef half(x):\n    return x / trial_more.TWO\n"
    ),
    "trial/_tail.py": (
        "from pathlib import Path\nfrom neusee.nodes import node\n\n\n@node()\ndef tail(x, *,"
        " factor: float, file: Path):\n    return x * factor + float(file.read_text())\n"
    ),
    "trial_constants.py": "ONE = 1.0\nOTHER = 7.0\n",
    "trial_more.py": "TWO = 2.0\n",
}


class Trial:
    """A package of two nodes, a helper and two modules of constants, that a test may edit."""

    def __init__(self, folder: Path, store: Path) -> None:
        self.folder, self.store = folder, store
        self.params = {"factor": 10.0, "file": folder / "offset.txt"}
        for name, text in {**LAYOUT, "offset.txt": "0.5"}.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)

    def edit(self, name: str, old: str, new: str) -> None:
        text = (self.folder / name).read_text()
        assert old in text
        (self.folder / name).write_text(text.replace(old, new))

    def run(self) -> tuple[float, str, str]:
        """First number of the result, and what became of the two steps, as a new process would
        see it.
        """
        forget()
        module = importlib.import_module("neusee.nodes.trial")
        head = Step("head", module.head, {"start": 2.0}, {}, MARK, {})
        tail = Step("tail", module.tail, self.params, {"x": "head"}, MARK, {})
        recipe = Recipe("trial", "", 1, 0.0, ("tail",), {"head": head, "tail": tail})
        result = run(recipe, Store(self.store))
        return float(result.values["tail"][0]), result.done["head"].state, result.done["tail"].state


def forget():
    for name in [n for n in sys.modules if n.startswith("neusee.nodes.trial")]:
        del sys.modules[name]
        vars(neusee.nodes).pop(name.rpartition(".")[2], None)
    importlib.invalidate_caches()


@pytest.fixture
def trial(tmp_path, monkeypatch):
    (tmp_path / "nodes").mkdir()
    # edits within one second would be missed by Python itself
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(neusee.nodes, "__path__", [*neusee.nodes.__path__, str(tmp_path / "nodes")])
    yield Trial(tmp_path / "nodes", tmp_path / "cache")
    forget()


FRESH, TAIL, NONE = ("run", "run"), ("cached", "run"), ("not needed", "cached")
EDITS = {
    "nothing": (None, NONE, 30.5),
    "body of the node": (("trial/_tail.py", "x * factor", "2 * x * factor"), TAIL, 60.5),
    "body of the node before": (
        ("trial/_head.py", "half(2 * start)", "half(4 * start)"),
        FRESH,
        50.5,
    ),
    "helper": (("trial/_helper.py", "x / ", "2 * x / "), FRESH, 50.5),
    "constant": (("trial_constants.py", "ONE = 1.0", "ONE = 2.0"), FRESH, 40.5),
    "constant of a helper": (("trial_more.py", "TWO = 2.0", "TWO = 1.0"), FRESH, 50.5),
    "comment": (("trial/_head.py", "import torch", "import torch  # of course"), NONE, 30.5),
    "comment in a helper": (
        ("trial/_helper.py", "    return", "    # half\n    return"),
        NONE,
        30.5,
    ),
    "docstring": (("trial/_head.py", "Begin.", "Begin, at last."), NONE, 30.5),
    "docstring of the module": (
        ("trial/_head.py", '"""Head."""', '"""The head of it all."""'),
        NONE,
        30.5,
    ),
    "blank lines": (("trial/_head.py", "\n\n\n", "\n\n\n\n\n"), NONE, 30.5),
    "quotes and brackets": (
        ("trial/_helper.py", "x / trial_more.TWO", "(x / (trial_more.TWO))"),
        NONE,
        30.5,
    ),
}


@pytest.mark.parametrize("edit", EDITS)
def test_an_edit_reruns_what_it_may_change_and_nothing_else(trial, edit):
    assert trial.run() == (30.5, *FRESH)
    change, states, value = EDITS[edit]
    if change:
        trial.edit(*change)
    assert trial.run() == (value, *states)


def test_a_reverted_edit_finds_the_old_result(trial):
    trial.run()
    trial.edit("trial_constants.py", "ONE = 1.0", "ONE = 2.0")
    assert trial.run() == (40.5, *FRESH)
    trial.edit("trial_constants.py", "ONE = 2.0", "ONE = 1.0")
    assert trial.run() == (30.5, *NONE)


def test_a_parameter_reruns_what_it_feeds(trial):
    trial.run()
    trial.params["factor"] = 20.0
    assert trial.run() == (60.5, *TAIL)
    trial.params["factor"] = 10.0
    assert trial.run() == (30.5, *NONE)


def test_a_file_counts_by_what_it_holds(trial):
    trial.run()
    file = trial.params["file"]
    os.utime(file, (1, 1))
    assert trial.run() == (30.5, *NONE)
    copy = trial.params["file"] = file.with_name("copy.txt")
    copy.write_text("0.5")
    assert trial.run() == (30.5, *NONE)
    copy.write_text("0.7")  # same size, within the same tick
    assert trial.run() == (pytest.approx(30.7), *TAIL)


def test_an_edit_after_the_import_cannot_poison_the_store(trial, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    forget()
    module = importlib.import_module("neusee.nodes.trial")
    code = Code(trial.store / "code.json").digest
    path = trial.folder / "trial/_helper.py"
    path.write_text(path.read_text().replace("x / ", "20 * x / "))
    with pytest.warns(UserWarning, match="edited after its import"):
        stale = code("neusee.nodes.trial._head")
    forget()
    assert module is not importlib.import_module("neusee.nodes.trial")
    assert Code(trial.store / "code.json").digest("neusee.nodes.trial._head") != stale


def test_a_loaded_module_keeps_the_digest_of_the_code_that_runs(trial):
    trial.run()
    before = Code(trial.store / "code.json").digest("neusee.nodes.trial._head")
    trial.edit("trial/_helper.py", "x / ", "2 * x / ")
    assert Code(trial.store / "code.json").digest("neusee.nodes.trial._head") == before
    importlib.reload(sys.modules["neusee.nodes.trial._helper"])
    assert Code(trial.store / "code.json").digest("neusee.nodes.trial._head") != before


def test_an_edit_of_the_rule_for_a_shape_computes_nothing_again(trial):
    """The rule hangs on a node of the family, and the second node imports the family, which
    imports the rule.
    """
    rule = "@head.shape\ndef _(*, start):\n    return torch.empty((3,), device='meta')\n"
    head = "import torch\nfrom neusee.nodes.trial._head import head\n\n\n"
    (trial.folder / "trial/_result_shapes.py").write_text(head + rule)
    trial.edit(
        "trial/__init__.py",
        "from neusee.nodes.trial._head",
        "from . import _result_shapes\nfrom ._head",
    )
    trial.edit(
        "trial/_tail.py", "from pathlib", "from neusee.nodes.trial import head\nfrom pathlib"
    )
    first = trial.run()
    assert first[1:] == ("run", "run")
    trial.edit("trial/_result_shapes.py", "(3,)", "(4,)")
    assert trial.run() == (first[0], "not needed", "cached")


def test_no_rule_for_a_shape_is_in_the_digest_of_a_shipped_node(tmp_path):
    from neusee.workflows.recipe.node_families import all_nodes

    code = Code(tmp_path / "code.json")
    for _, each in all_nodes():
        code.digest(each.fn.__module__)
    code.save()
    covered = {
        name for path in (tmp_path / "code").glob("*.json") for name in json.loads(path.read_text())
    }
    assert "neusee.nodes.optics._psf" in covered
    assert [name for name in covered if name.endswith(("_result_shapes", "shape_rules"))] == []


def test_only_what_is_imported_counts(trial):
    trial.run()
    head, tail = (
        Code(trial.store / "code.json").digest(f"neusee.nodes.trial.{n}")
        for n in ("_head", "_tail")
    )
    trial.edit("trial/_tail.py", "x * factor", "x * factor * 1")
    forget()
    again = Code(trial.store / "code.json")
    assert again.digest("neusee.nodes.trial._head") == head
    assert again.digest("neusee.nodes.trial._tail") != tail


def test_a_cached_run_parses_nothing(trial, monkeypatch):
    trial.run()
    monkeypatch.setattr(code_digest, "summarise", lambda source: pytest.fail("parsed again"))
    assert trial.run() == (30.5, *NONE)


OLD_MEMO = '{"3.11:0": ["0", [[0, "neusee.nodes", "node"]], ["node"]]}'


@pytest.mark.parametrize("text", ["", "{", "[]", '{"a": 1}', '{"a": [1]}', "\x00\xff", OLD_MEMO])
def test_a_damaged_memo_is_made_again(trial, text):
    trial.run()
    (trial.store / "code.json").write_text(text)
    assert trial.run() == (30.5, *NONE)
    assert len(json.loads((trial.store / "code.json").read_text().split("\n", 2)[2])) > 3


CHAINS = {
    "from neusee import nodes": "nodes.trial_more.TWO",
    "import neusee": "neusee.nodes.trial_more.TWO",
    "import neusee.nodes": "neusee.nodes.trial_more.TWO",
    "import neusee.nodes as n": "n.trial_more.TWO",
    "import neusee.nodes.units": "neusee.nodes.trial_more.TWO",
    "from neusee import nodes as all_of_it": "all_of_it.trial_more.TWO",
    "from ... import nodes": "nodes.trial_more.TWO",
    "from neusee.nodes import trial": "trial._deep.trial_more.TWO",
    "import neusee.nodes.trial as t": "t._deep.trial_more.TWO",
    "import neusee.nodes.trial": "neusee.nodes.trial._deep.trial_more.TWO",
}


@pytest.mark.parametrize("line", CHAINS)
def test_what_an_attribute_chain_reads_counts(trial, line):
    (trial.folder / "trial/_deep.py").write_text("from neusee.nodes import trial_more\n")
    (trial.folder / "trial/_helper.py").write_text(
        f"{line}\ndef half(x):\n    return x / {CHAINS[line]}\n"
    )
    before = Code(trial.store / "code.json").digest("neusee.nodes.trial._helper")
    trial.edit("trial_more.py", "TWO = 2.0", "TWO = 1.0")
    forget()
    assert Code(trial.store / "code.json").digest("neusee.nodes.trial._helper") != before


def test_a_chain_reruns_what_it_feeds(trial):
    text = (
        "import neusee.nodes as n\nimport neusee.nodes.trial_more\n\n\ndef half(x):\n    return x /"
        " n.trial_more.TWO\n"
    )
    (trial.folder / "trial/_helper.py").write_text(text)
    assert trial.run() == (30.5, *FRESH)
    trial.edit("trial_more.py", "TWO = 2.0", "TWO = 1.0")
    assert trial.run() == (50.5, *FRESH)
    trial.edit("trial_more.py", "TWO = 1.0", "TWO = 1.0  # of course")
    assert trial.run() == (50.5, *NONE)


WHOLE = {
    "from neusee import nodes": 'getattr(nodes, "trial_more").TWO',
    "from neusee import nodes as all_of_it": "(lambda n: n.trial_more.TWO)(all_of_it)",
    "import neusee": 'getattr(neusee.nodes, "trial_more").TWO',
    "import neusee as whole": 'whole.__dict__["nodes"].trial_more.TWO',
    "import neusee.nodes as n": 'vars(n)["trial_more"].TWO',
    "from ... import nodes as n": 'vars(n)["trial_more"].TWO',
}


@pytest.mark.parametrize("line", WHOLE)
def test_a_package_that_is_used_whole_is_refused_with_its_line(trial, line):
    (trial.folder / "trial/_helper.py").write_text(
        f"{line}\n\n\ndef half(x):\n    return x / {WHOLE[line]}\n"
    )
    with pytest.raises(
        LookupError, match=r"_helper.py:5: the package of all nodes is used.*from its own module"
    ):
        Code(trial.store / "code.json").digest("neusee.nodes.trial._head")


def test_an_import_that_is_not_used_and_a_name_of_the_package_are_fine(trial):
    text = (
        "from neusee import nodes\nimport neusee\n\n\ndef half(x):\n    return x / 2 + 0 *"
        " len(nodes.Check.__name__)\n"
    )
    (trial.folder / "trial/_helper.py").write_text(text)
    assert trial.run() == (30.5, *FRESH)


SCRIPT = """
import sys
import neusee.nodes
neusee.nodes.__path__ = [*neusee.nodes.__path__, sys.argv[1]]
from pathlib import Path
from neusee.nodes.trial import head, tail
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys.cache_key import key_of
from neusee.workflows.graph.errors import Location
mark, code, keys = Location("trial.yaml", 1, 1), Code(Path(sys.argv[2])), {}
params = {"factor": 10.0, "file": Path(sys.argv[1]) / "offset.txt"}
for step in (Step("head", head, {"start": 2.0}, {}, mark, {}), Step("tail", tail, params, {"x": "head"}, mark, {})):
    keys[step.name] = key_of(step, keys, 1, code)[0]
print(*keys.values())
"""


@pytest.mark.slow
def test_two_processes_make_the_same_keys(trial, tmp_path):
    def keys(hash_seed: str) -> str:
        command = [
            sys.executable,
            "-B",
            "-c",
            SCRIPT,
            str(trial.folder),
            str(tmp_path / f"memo{hash_seed}"),
        ]
        env = {**os.environ, "PYTHONHASHSEED": hash_seed}
        return subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout

    assert keys("1") == keys("2")


@node()
def leaf(*, k: float = 1.0):
    return torch.tensor(k)


@node()
def noisy(x, *, rng: torch.Generator):
    return x + torch.rand((), generator=rng)


@node()
def pair(a, b=None, c=None):
    return a


def key(n, params=None, wires=None, keys=None, seed=1, name="s", device="cpu"):
    step = Step(name, n, params or {}, wires or {}, MARK, {})
    return key_of(step, keys or {}, seed, Code(Path("/nonexistent/code.json")), device)[0]


def test_a_name_or_a_seed_counts_for_noise_alone():
    x = {"wires": {"x": "x"}, "keys": {"x": "0" * 32}}
    assert (
        key(leaf, seed=1) == key(leaf, seed=2) == key(leaf, name="t") == key(leaf, device="cuda:0")
    )
    noise = {
        key(noisy, **x),
        key(noisy, **x, seed=2),
        key(noisy, **x, name="t"),
        key(noisy, **x, device="cuda:0"),
    }
    assert len(noise) == 4
    assert key(noisy, **x, device="cuda:0") == key(noisy, **x, device="cuda:1")


def test_which_input_a_result_goes_to_counts():
    keys = {"p": "1" * 32, "q": "2" * 32}
    wires = [{"a": "p", "b": "q"}, {"a": "q", "b": "p"}, {"a": "p", "c": "q"}, {"a": "p"}]
    wires += [{"a": ("p", "q")}, {"a": ("q", "p")}, {"a": ("p",)}, {"a": ()}]
    assert len({key(pair, wires=w, keys=keys) for w in wires}) == len(wires)
    assert key(pair, wires={"a": "p"}, keys=keys) == key(
        pair, wires={"a": "p", "b": None}, keys=keys
    )


def test_parameters_count_to_the_last_bit():
    values = [
        1.0,
        1.0 + 2**-52,
        1,
        True,
        "1.0",
        None,
        float("nan"),
        float("inf"),
        0.0,
        -0.0,
        5e-324,
        (1.0,),
        [[1.0]],
    ]
    values += [{1: 1.0}, {"1": 1.0}, {1: 2.0}, 1j, 0.1 + 0.2, 0.3]
    assert len({digest(plain(v)) for v in values}) == len(values)
    assert digest(plain({3: 1.0, 11: 2.0})) == digest(plain({11: 2.0, 3: 1.0}))
    assert digest(plain((1, 2))) == digest(plain([1, 2]))
    with pytest.raises(TypeError, match="tensor"):
        plain(torch.ones(2))


def test_a_node_without_a_source_file_is_refused():
    space = {"__name__": "nowhere"}
    exec("def f(*, k: float = 1.0):\n    return k", space)
    with pytest.raises(LookupError, match="nowhere has no source file"):
        key(node()(space["f"]))


def test_a_file_is_read_once_when_its_stamp_can_be_trusted(tmp_path, monkeypatch):
    file = tmp_path / "a.bin"
    file.write_bytes(b"x" * 100)
    young = file_digest(file)
    file.write_bytes(b"y" * 100)
    assert file_digest(file) != young
    monkeypatch.setattr("neusee.workflows.keys.cache_key._SETTLED", 0)
    old = file_digest(file)
    monkeypatch.setattr("builtins.open", lambda *a: pytest.fail("read again"))
    assert file_digest(file) == old


_TICK = 2_000_000_000  #: ns, the coarsest stamp in use: that of files on FAT


@pytest.fixture
def on_fat(tmp_path, monkeypatch):
    """A file of which stamps are rounded down to ticks, and a clock that stands where it is set."""
    file, clock = tmp_path / "a.bin", SimpleNamespace(now=10**9 * _TICK)

    def write(text):
        file.write_text(text)
        clock.stamp = clock.now // _TICK * _TICK

    def stat(path):
        true = os.stat(path)
        return SimpleNamespace(
            st_dev=1,
            st_ino=10**15,
            st_size=true.st_size,
            st_mtime_ns=clock.stamp,
            st_ctime_ns=clock.stamp,
        )

    monkeypatch.setattr("neusee.workflows.keys.cache_key._files", {})
    monkeypatch.setattr("neusee.workflows.keys.cache_key.os", SimpleNamespace(stat=stat))
    monkeypatch.setattr(
        "neusee.workflows.keys.cache_key.time", SimpleNamespace(time_ns=lambda: clock.now)
    )
    return file, clock, write


@pytest.mark.parametrize("later", [0, _TICK // 2, _TICK - 1])
def test_a_file_that_is_written_twice_within_one_tick_of_its_stamp_is_read_twice(on_fat, later):
    file, clock, write = on_fat
    write("one")
    clock.now += later
    before = file_digest(file)
    write("two")
    assert file_digest(file) != before


def test_a_file_that_was_left_alone_for_ten_seconds_is_read_once(on_fat, monkeypatch):
    file, clock, write = on_fat
    write("one")
    clock.now += 5 * _TICK
    before = file_digest(file)
    monkeypatch.setattr("builtins.open", lambda *a: pytest.fail("read again"))
    assert file_digest(file) == before


def test_streams_depend_on_seed_and_name():
    assert len({stream_seed(1, "a"), stream_seed(2, "a"), stream_seed(1, "b")}) == 3
    assert 0 <= stream_seed(1, "a") < 2**63
