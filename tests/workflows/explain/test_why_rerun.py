"""Why a step ran: each kind of change in the words of the recipe, and the way it came."""

import importlib
import json
import shutil
import sys

import pytest

import neusee.nodes
from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.runner import run
from neusee.workflows.explain import change_causes, stored_origin, why_rerun
from neusee.workflows.explain.change_causes import Comparison, Pair, edits
from neusee.workflows.explain.stored_origin import why_key_lines
from neusee.workflows.explain.why_rerun import explained, why_lines
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

MODULES = {
    "trial/__init__.py": (
        "from neusee.nodes.trial._light import add, bright, flat, gather, noise, photograph\n"
    ),
    "trial/_light.py": (
        '''
from pathlib import Path

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.trial._helper import FALL, half
from neusee.nodes.units import Count, DataFile, Electrons, Length, Real, Shape, Wavelength

Place = tuple[Length, Length]


@node()
def flat(*, shape: Shape = (2, 2), value: Real = 8.0, wavelength: Wavelength = 550e-9) -> Tensor:
    """Light that is the same everywhere."""
    return torch.full(shape, value)


@flat.check
def _(light, **params):
    return [Check("even")]


@node()
def bright(*, shape: Shape = (2, 2), sources: dict[int, Real] | None = None) -> Tensor:
    return torch.ones(shape)


@node()
def photograph(*, file: DataFile) -> Tensor:
    return torch.zeros(2, 2)


@node()
def add(light: Tensor, more: Tensor | None = None, *, amount: Real = 0.0, at: Place = (0.0, 0.0)) -> Tensor:
    return half(light + amount) * FALL if more is None else light + more


@node()
def gather(lights: list[Tensor]) -> Tensor:
    return sum(lights)


@node()
def noise(light: Tensor, *, sigma: Electrons, rng: torch.Generator) -> Tensor:
    return light + sigma * torch.randn(light.shape, generator=rng)


@noise.skip_bound
def _(light, *, sigma: float) -> float:
    return sigma / light.max
'''
    ),
    "trial/_helper.py": "FALL = 2.0\n\n\ndef half(x):\n    return x / 2\n",
}

RECIPE = """\
seed: 1
tolerance: 1e-3
scene: {value: 8, shape: [2, 2], wavelength: 550 nm, file: a.bin}
sensor:
  read_noise: 10.5 e-
  gain: 3
  at: [1 mm, 2 mm]
lasers:
  red: {amount: 1}
  green: {amount: 2}
steps:
  light: {node: trial.flat, with: {shape: "${scene.shape}", value: "${scene.value}", wavelength: "${scene.wavelength}"}}
  photo: {node: trial.photograph, with: {file: "${scene.file}"}}
  spot: {node: trial.add, each: lasers, from: light, with: {amount: "${item.amount}"}}
  all: {node: trial.gather, from: {lights: spot}}
  read: {node: trial.noise, from: all, with: {sigma: "${sensor.read_noise}"}}
  raw: {node: trial.add, from: read, with: {amount: "${sensor.gain}", at: "${sensor.at}"}}
  restored: {node: trial.add, from: {light: raw, more: photo}, with: {amount: 1.5}}
outputs: [restored]
"""


class Trial:
    """A package of nodes and a recipe that a test may edit; every call sees them as a new
    process would.
    """

    def __init__(self, folder):
        self.folder, self.cache = folder, folder / "cache"
        for name, text in {**MODULES}.items():
            self.write(f"nodes/{name}", text)
        self.write("mine.yaml", RECIPE)
        self.write("a.bin", "a")

    def write(self, name, text):
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def edit(self, name, old, new):
        text = (self.folder / name).read_text()
        assert text.count(old) == 1
        self.write(name, text.replace(old, new))

    def load(self, *arguments):
        forget()
        return load("mine.yaml", arguments, self.folder, first=2)

    @property
    def store(self):
        return Store(self.cache)

    def run(self, *arguments, watch=None):
        recipe = self.load(*arguments)
        store = self.store
        return run(recipe, store, watch=watch and explained(recipe, store, watch))

    def told(self, *arguments):
        """Why each step ran, as a run says it."""
        found = {}
        self.run(*arguments, watch=lambda e: found.update({e.step: e.done}))
        return {name: done.why for name, done in found.items() if done.state == "run"}

    def why(self, step, *arguments):
        return why_lines(self.load(*arguments), self.store, step)

    def causes(self, step, *arguments):
        """The causes alone."""
        head, *causes, beside = self.why(step, *arguments)
        assert head.startswith(f"{step} (trial.")
        assert beside.startswith("  compared with")
        return [
            line.strip() for line in causes if "depending on the values of the inputs" not in line
        ]


def forget():
    for name in [n for n in sys.modules if n.startswith("neusee.nodes.trial")]:
        del sys.modules[name]
        vars(neusee.nodes).pop(name.rpartition(".")[2], None)
    importlib.invalidate_caches()


@pytest.fixture
def trial(tmp_path, monkeypatch):
    # edits within one second would be missed by Python itself
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(neusee.nodes, "__path__", [*neusee.nodes.__path__, str(tmp_path / "nodes")])
    yield Trial(tmp_path)
    forget()


CHANGES = {
    "a value": (
        ["sensor.read_noise=20 e-"],
        "restored <- raw <- read: sensor.read_noise 10.5 -> 20 e- (argument 2)",
    ),
    "a plain number": (["sensor.gain=4"], "restored <- raw: sensor.gain 3 -> 4 (argument 2)"),
    "a quantity in the unit it is written in": (
        ["scene.wavelength=0.6 um"],
        (
            "restored <- raw <- read <- all <- spot[red] <- light: scene.wavelength 0.55 -> 0.6 um"
            " (argument 2)"
        ),
    ),
    "a list": (
        ["sensor.at=[1 mm, 3 mm]"],
        "restored <- raw: sensor.at [1 mm, 2 mm] -> [1 mm, 3 mm] (argument 2)",
    ),
    "a part of a list": (
        ["sensor.at.1=3 mm"],
        "restored <- raw: sensor.at [1 mm, 2 mm] -> [1 mm, 3 mm] (mine.yaml:7:7, argument 2)",
    ),
    "an item": (
        ["lasers.green.amount=5"],
        "restored <- raw <- read <- all <- spot[green]: lasers.green.amount 2 -> 5 (argument 2)",
    ),
    "a value of the step itself": (
        ["steps.restored.with.amount=2"],
        "restored: steps.restored.with.amount 1.5 -> 2 (argument 2)",
    ),
    "a default": (
        ["~steps.restored.with.amount"],
        "restored: amount 1.5 -> 0 (default of trial.add)",
    ),
    "the seed": (["seed=2"], "restored <- raw <- read: seed 1 -> 2 (argument 2)"),
    "another item": (
        ["+lasers.blue={amount: 3}"],
        "restored <- raw <- read <- all: reads spot[blue] now",
    ),
    "an item less": (
        ["~lasers.green"],
        "restored <- raw <- read <- all: reads spot[green] no more",
    ),
    "an input less": (["~steps.restored.from.more"], "restored: reads photo no more"),
    "another source": (
        ["steps.restored.from.more=light"],
        "restored: reads light, not photo (argument 2)",
    ),
    "a step taken out": (
        ["steps.restored.from.light=read"],
        "restored: reads read, not raw (argument 2)",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_told_from_its_root(trial, change):
    trial.run()
    arguments, said = CHANGES[change]
    assert said in trial.causes("restored", *arguments)
    assert trial.why("restored", *arguments)[0].startswith(
        "restored (trial.add): not stored, so it would run"
    )


def test_a_change_in_the_recipe_s_file_says_its_line(trial):
    trial.run()
    trial.edit("mine.yaml", "10.5 e-", "20 e-")
    said = "restored <- raw <- read: sensor.read_noise 10.5 -> 20 e- (mine.yaml:5:15)"
    assert trial.causes("restored") == [said]


def test_another_node_at_a_step(trial):
    trial.run()
    trial.edit(
        "mine.yaml",
        'photo: {node: trial.photograph, with: {file: "${scene.file}"}}',
        "photo: {node: trial.bright}",
    )
    trial.edit("mine.yaml", ", file: a.bin", "")
    assert trial.causes("restored") == [
        "restored <- photo: trial.photograph -> trial.bright (mine.yaml:13:17)"
    ]


def test_many_items_are_told_in_one(trial):
    trial.run()
    more = "+lasers.{0}={{amount: 3}}"
    assert trial.causes("all", *[more.format(name) for name in "abcdef"]) == [
        "all: reads spot[a], spot[b], spot[c], spot[d] and 2 more now"
    ]


def test_a_source_that_is_null(trial):
    trial.run()
    trial.edit(
        "mine.yaml", 'photo: {node: trial.photograph, with: {file: "${scene.file}"}}', "photo: null"
    )
    trial.edit("mine.yaml", ", file: a.bin", "")
    assert trial.causes("restored") == [
        "restored: reads photo no more: it is null (mine.yaml:13:10)"
    ]


def test_a_mapping_says_the_entries_that_differ(trial):
    trial.edit(
        "mine.yaml",
        'trial.photograph, with: {file: "${scene.file}"}',
        "trial.bright, with: {sources: {1: 2, 3: 4}}",
    )
    trial.edit("mine.yaml", ", file: a.bin", "")
    trial.run()
    trial.edit("mine.yaml", "3: 4", "3: 5")
    (said,) = trial.causes("photo")
    assert "sources {3: 4} -> {3: 5} (mine.yaml:13:" in said


def test_values_that_differ_in_the_last_digit_alone_are_told_apart(trial):
    trial.run("sensor.gain=0.1")
    (said,) = trial.causes("raw", "sensor.gain=0.10000000000000002")
    assert said == "raw: sensor.gain 0.1 -> 0.10000000000000002 (argument 2)"


def test_nought_has_a_unit_too(trial):
    trial.run()
    (said,) = trial.causes("raw", "sensor.at=[0 um, 2 mm]")
    assert said == "raw: sensor.at [1000 um, 2 mm] -> [0 um, 2 mm] (argument 2)"


def test_a_file_of_another_content(trial):
    trial.run()
    trial.write("a.bin", "b")
    assert trial.causes("restored") == [
        "restored <- photo: file a.bin: other content (scene.file, mine.yaml:3:60)"
    ]
    trial.write("a.bin", "a")
    shutil.copy(trial.folder / "a.bin", trial.folder / "a.png")
    assert trial.causes("photo", "scene.file=a.png") == [
        "photo: file a.png: .png, not .bin (scene.file, argument 2)"
    ]


def test_two_changes_are_both_told_the_nearest_first(trial):
    trial.run()
    assert trial.causes("restored", "scene.value=9", "sensor.gain=4") == [
        "restored <- raw: sensor.gain 3 -> 4 (argument 3)",
        "restored <- raw <- read <- all <- spot[red] <- light: scene.value 8 -> 9 (argument 2)",
    ]


CODE = {
    "a node's own function": (
        ("_light.py", "return light + sigma * torch", "return light + 2 * sigma * torch"),
        (
            "restored <- raw <- read: code of noise() in neusee/nodes/trial/_light.py changed"
            " (line 46)"
        ),
    ),
    "a helper": (
        ("_helper.py", "x / 2", "x / 4"),
        "restored <- raw: code of half() in neusee/nodes/trial/_helper.py changed (line 4)",
    ),
    "a constant": (
        ("_helper.py", "FALL = 2.0", "FALL = 3.0"),
        "restored <- raw: constant FALL in neusee/nodes/trial/_helper.py changed (line 1)",
    ),
    "a bound": (
        ("_light.py", "return sigma / light.max", "return 2 * sigma / light.max"),
        "code of noise.skip_bound() in neusee/nodes/trial/_light.py changed (line 51)",
    ),
    "a check": (
        ("_light.py", 'Check("even")', 'Check("flat")'),
        "code of flat.check() in neusee/nodes/trial/_light.py changed (line 21)",
    ),
    "a new function": (
        ("_helper.py", "FALL = 2.0\n", "FALL = 2.0\n\n\ndef third(x):\n    return x / 3\n"),
        "function third() was added to neusee/nodes/trial/_helper.py",
    ),
    "a new class": (
        ("_helper.py", "FALL = 2.0\n", "FALL = 2.0\n\n\nclass Third:\n    x = 3\n"),
        "class Third was added to neusee/nodes/trial/_helper.py",
    ),
    "a statement": (
        ("_helper.py", "FALL = 2.0\n", "FALL = 2.0\nassert FALL\n"),
        "the other statements was added to neusee/nodes/trial/_helper.py",
    ),
    "an import": (
        ("_helper.py", "FALL = 2.0\n", "from neusee.nodes.values import Psf as Psf\nFALL = 2.0\n"),
        "neusee/nodes/values.py is imported now",
    ),
}


@pytest.mark.parametrize("change", CODE)
def test_which_definition_changed_is_told(trial, change):
    trial.run()
    (name, old, new), said = CODE[change]
    trial.edit(f"nodes/trial/{name}", old, new)
    assert any(line.endswith(said.rpartition(": ")[2]) for line in trial.causes("restored"))


def test_a_function_that_is_gone(trial):
    trial.edit("nodes/trial/_helper.py", "FALL = 2.0\n", "FALL = 2.0\nNEVER = 1\n")
    trial.run()
    trial.edit("nodes/trial/_helper.py", "NEVER = 1\n", "")
    assert trial.causes("photo") == [
        "photo: constant NEVER was removed from neusee/nodes/trial/_helper.py"
    ]


@pytest.mark.parametrize("damage", [None, "", "{", "[]", '{"a": 1}', '{"a": {"b": [1]}}', "\x00"])
def test_without_the_definitions_it_is_the_code_that_changed(trial, damage):
    trial.run()
    for path in (trial.cache / "code").iterdir():
        path.unlink() if damage is None else path.write_text(damage)
    trial.edit("nodes/trial/_helper.py", "x / 2", "x / 4")
    trial.edit("nodes/trial/_light.py", "return torch.ones(shape)", "return 2 * torch.ones(shape)")
    assert trial.causes("restored") == [
        "restored: the code of trial.add changed",
        "restored <- photo: the code of trial.photograph changed",
        "restored <- raw <- read: the code of trial.noise changed",
        "restored <- raw <- read <- all: the code of trial.gather changed",
        "restored <- raw <- read <- all <- spot[red] <- light: the code of trial.flat changed",
    ]


def test_the_definitions_are_written_once_and_a_comment_adds_none(trial):
    trial.run()
    names = {path.name: path.stat().st_mtime_ns for path in (trial.cache / "code").iterdir()}
    assert len(names) == 1
    trial.edit("nodes/trial/_helper.py", "FALL = 2.0", "FALL = 2.0  # of course")
    trial.run("scene.value=9")
    assert {
        path.name: path.stat().st_mtime_ns for path in (trial.cache / "code").iterdir()
    } == names
    found = json.loads(next((trial.cache / "code").iterdir()).read_text())
    assert set(found["neusee.nodes.trial._helper"]) == {"constant FALL", "half()"}


def test_a_store_that_cannot_be_written_does_not_need_them(trial):
    trial.run()
    shutil.rmtree(trial.cache / "code")
    (trial.cache / "code").write_text("a file where a folder should be")
    assert trial.run().done["restored"].state == "cached"
    assert edits(trial.cache, "0" * 32, "1" * 32) == []


def test_a_step_that_is_left_out_says_its_bound(trial):
    trial.run()
    (line,) = trial.why("read", "sensor.read_noise=0.001 e-")
    assert line.startswith("read (trial.noise): left out and replaced by all: changes at most ")
    assert line.endswith("tolerance 0.001")


def test_a_step_that_is_left_out_now_or_no_longer(trial):
    trial.run()
    (said,) = trial.causes("raw", "sensor.read_noise=0.001 e-")
    assert said.startswith("raw: read is left out now: changes at most")
    shutil.rmtree(trial.cache)
    trial.run("sensor.read_noise=0.001 e-")
    (said,) = trial.causes("raw")
    assert said.startswith("raw: read is no longer left out: changes at most")
    both = trial.causes("raw", "scene.value=9")
    assert both[0] == "raw: read is no longer left out: its inputs decide"
    assert "scene.value 8 -> 9" in both[1]


def test_what_only_a_run_can_tell_is_said(trial):
    lines = trial.why("raw")
    assert lines[1] == "  left out or not, depending on the values of the inputs: read"
    assert lines[2] == "  no earlier result to compare with: no result of this step"


def test_a_stored_result_says_since_when_and_beside_what(trial):
    trial.run()
    head, rest = trial.why("restored")
    assert head.startswith("restored (trial.add): stored since 20")
    assert rest == "  no earlier result to compare with: the first result of this step"


def test_the_nearest_earlier_result_is_the_one_with_the_fewest_causes(trial):
    trial.run()
    trial.run("scene.value=9", "sensor.gain=4")
    trial.run("scene.value=7", "sensor.gain=5")
    assert trial.causes("restored", "scene.value=9") == [
        "restored <- raw: sensor.gain 4 -> 3 (mine.yaml:6:9)"
    ]
    assert trial.why("restored", "scene.value=9")[-1].startswith(
        "  compared with the nearest of 3 earlier results, "
    )


def test_every_item_of_a_step_is_told(trial):
    trial.run()
    lines = trial.why("spot", "lasers.green.amount=5")
    assert [line.split()[0] for line in lines if line[0] != " "] == ["spot[red]", "spot[green]"]
    with pytest.raises(ValueError, match=r"no step 'spott'.*did you mean spot\?"):
        trial.why("spott")


def test_twins_are_said_to_be_one_computation(trial):
    trial.run()
    lines = trial.why("spot", "lasers.green.amount=1")
    assert "  same key as spot[red]" in lines


def test_a_run_tells_every_step_s_own_cause(trial):
    assert set(trial.told().values()) == {""}
    told = trial.told("sensor.read_noise=20 e-", "sensor.gain=4")
    assert told == {
        "read": "sensor.read_noise 10.5 -> 20 e- (argument 2)",
        "raw": "sensor.gain 3 -> 4 (argument 3)",
        "restored": "after raw",
    }
    assert trial.told("lasers.green.amount=5")["all"] == "after lights"


def test_a_cached_run_looks_nothing_up(trial, monkeypatch):
    trial.run()
    monkeypatch.setattr(why_rerun, "keys_in", lambda rows: pytest.fail("looked at earlier results"))
    assert trial.told() == {}


def test_a_value_that_was_not_kept_is_said_to_have_been_made(trial):
    key = trial.run().keys["raw"]
    about = {
        name: value
        for name, value in trial.store.about(key).items()
        if name not in ("payload", "tensors", "layout")
    }
    for path in (trial.cache / key[:2]).glob(f"{key}.*"):
        path.unlink()
    (trial.cache / "brief.jsonl").unlink(missing_ok=True)
    assert trial.store.put_receipt(key, about)
    head, *rest = trial.why("raw")
    assert head.startswith("raw (trial.add): ran 20")
    assert f"but its value was not kept, key {key[:8]}" in head
    assert rest == ["  no earlier result to compare with: the first result of this step"]
    recipe, told, store = trial.load(), {}, trial.store
    run(
        recipe,
        store,
        ["raw"],
        explained(recipe, store, lambda event: told.update({event.step: event.done})),
    )
    assert told["raw"].why == "computed before, but its value is not stored"


@pytest.mark.parametrize("damage", [None, "", "{", "\x00"])
def test_without_a_journal_the_same_is_said(trial, damage):
    trial.run()
    path = trial.cache / "journal.jsonl"
    path.unlink() if damage is None else path.write_text(damage)
    assert trial.causes("raw", "sensor.gain=4") == ["raw: sensor.gain 3 -> 4 (argument 2)"]


def test_results_that_were_removed_are_passed_over(trial):
    first = trial.run().keys["raw"]
    second = trial.run("sensor.gain=5").keys["raw"]
    for path in trial.cache.glob(f"{second[:2]}/{second}.*"):
        path.unlink()
    # where a result is that was computed faster than written
    if (brief := trial.cache / "brief.jsonl").exists():
        brief.write_text(
            "\n".join(line for line in brief.read_text().split("\n") if second not in line[:60])
        )
    *_, beside = trial.why("raw", "sensor.gain=4")
    assert beside.startswith(f"  compared with the nearest of 2 earlier results, {first[:8]} of ")


def test_a_run_compares_few_results(trial, monkeypatch):
    for gain in range(12):
        trial.run(f"sensor.gain={gain}", f"sensor.read_noise={gain + 20} e-")
    seen = []
    own = change_causes.Comparison.own
    monkeypatch.setattr(
        change_causes.Comparison,
        "own",
        lambda self, label, *a: seen.append(label) or own(self, label, *a),
    )
    assert (
        trial.told("sensor.gain=50", "sensor.read_noise=50 e-")["raw"]
        == "sensor.gain 11 -> 50 (argument 2)"
    )
    assert seen.count("raw") == why_rerun._COMPARED_RESULTS


def test_what_went_into_a_key(trial):
    first = trial.run()
    key = first.keys["read"]
    lines = why_key_lines(trial.store, key[:10])
    assert lines[0].startswith("read of mine: stored since 20")
    assert lines[0].endswith(f"key {key}")
    assert lines[1].startswith("  node    trial.noise, code ")
    assert lines[2] == "  with    sigma = 10.5"
    assert lines[3] == f"  from    all, {first.keys['all'][:8]}"
    assert lines[4] == "  noise   seed 1, of read, on cpu"
    assert lines[-1] == "  no earlier result to compare with: the first result of this step"


def test_a_key_that_is_none_or_many_is_refused(trial):
    trial.run()
    with pytest.raises(LookupError, match="no results have a key that begins with 'x'"):
        why_key_lines(trial.store, "x")
    with pytest.raises(LookupError, match=r"\d+ results have .*there are [0-9a-f]{12}, "):
        why_key_lines(trial.store, "")


# --- long chains ----------------------------------------------------------------------------------


class DerivedFiles:
    """A store of origins alone, as deep as a test needs it."""

    def __init__(self, root, abouts):
        self.root, self.code_memo, self.abouts = root, root / "code.json", abouts

    def about(self, key):
        return self.abouts.get(key)


def chain(length, first, node):
    """A chain of steps, of which the first has another parameter."""
    mark = Location("long.yaml", 1, 1)
    steps = {"s0": Step("s0", node, {"amount": first}, {}, mark, {})}
    for n in range(1, length):
        steps[f"s{n}"] = Step(f"s{n}", node, {"amount": 1.0}, {"photons": f"s{n - 1}"}, mark, {})
    return Recipe("long", "", 1, 0.0, (f"s{length - 1}",), steps)


def test_a_chain_of_ten_thousand_steps_is_walked_without_recursion(tmp_path, toy):
    length, shelf = 10_000, DerivedFiles(tmp_path, {})
    recipe = chain(length, 2.0, toy.add)
    before = resolve(chain(length, 1.0, toy.add), list(recipe.steps), shelf)
    shelf.abouts = {
        key: {"step": before.makers[key], "origin": before.origins[key]}
        for key in before.keys.values()
    }
    after = resolve(recipe, list(recipe.steps), shelf)
    last = f"s{length - 1}"
    roots = Comparison(shelf, recipe, after).roots(Pair(last, after.keys[last], before.keys[last]))
    assert list(roots.found) == ["amount 1 -> 2 (default of toy.add)"]
    names = roots.chain("amount 1 -> 2 (default of toy.add)")
    assert (len(names), names[0], names[-1]) == (length, last, "s0")
    assert stored_origin._chain(names) == f"{last} <- s9998 <- s9997 <- s9996 <- (9995 more) <- s0"


def test_results_that_are_gone_are_said_to_be(tmp_path, toy):
    shelf = DerivedFiles(tmp_path, {})
    recipe = chain(5, 2.0, toy.add)
    before = resolve(chain(5, 1.0, toy.add), list(recipe.steps), shelf)
    key = before.keys["s4"]
    shelf.abouts = {key: {"step": "s4", "origin": before.origins[key]}}
    after = resolve(recipe, list(recipe.steps), shelf)
    roots = Comparison(shelf, recipe, after).roots(Pair("s4", after.keys["s4"], key))
    found = {text: roots.chain(text) for text in roots.found}
    assert found == {"the earlier origin of s3 is no longer known": ["s4", "s3"]}


def test_code_of_a_module_that_was_edited_after_its_import_is_not_remembered(trial, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    trial.load()
    (trial.folder / "nodes/trial/_helper.py").write_text(
        MODULES["trial/_helper.py"].replace("2", "25")
    )
    code = Code(trial.cache / "code.json")
    with pytest.warns(UserWarning, match="edited after its import"):
        code.digest("neusee.nodes.trial._light")
    code.save()
    assert not list((trial.cache / "code").glob("*.json"))


PACKAGED = {
    "sensor.read_noise=20 e-": (
        "well[mask] <- read[mask]: sensor.read_noise 10.5 -> 20 e- (argument 2)"
    ),
    "optics.bands=25": "scene_photons[mask] <- bands: optics.bands 31 -> 25 (argument 2)",
    "doe=axicon": (
        "pupil[mask] <- fabricated <- height: doe.half_rings -> doe.axicon (doe/axicon.yaml:5:11)"
    ),
    "sensor.shape=[320, 320]": "raw[mask]: sensor.shape [640, 640] -> [320, 320] (argument 2)",
    "seed=8": "digital[mask]: seed 7 -> 8 (argument 2)",
}


@pytest.mark.parametrize("change", PACKAGED)
def test_a_packaged_recipe_s_changes_are_told_in_its_own_words(tmp_path, change):
    shelf, recipe, other = (
        DerivedFiles(tmp_path, {}),
        load("first_light"),
        load("first_light", [change], first=2),
    )
    said = PACKAGED[change]
    step = said.replace(":", " ").split()[0]
    before = resolve(recipe, needed(recipe, [step]), shelf)
    shelf.abouts = {
        key: {"step": before.makers[key], "origin": origin}
        for key, origin in before.origins.items()
    }
    after = resolve(other, needed(other, [step]), shelf)
    roots = Comparison(shelf, other, after).roots(Pair(step, after.keys[step], before.keys[step]))
    assert [f"{stored_origin._chain(roots.chain(text))}: {text}" for text in roots.found] == [said]
