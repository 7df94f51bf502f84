"""A recipe is checked by the remembered answers of its nodes: the same mistakes, notes and values,
and never by an answer that may be wrong.
"""

import json
import os
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from pydantic import ValidationError

from neusee.nodes import input_files, node
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe import remembered_checks
from neusee.workflows.recipe.asked_nodes import THEMSELVES
from neusee.workflows.recipe.node_families import all_nodes
from neusee.workflows.recipe.remembered_checks import (
    NAME,
    Answers,
    RecordedNodes,
    RememberedNodes,
    edition_of_code,
    load_from,
    with_nodes,
)
from neusee.workflows.recipe.remembered_nodes import (
    NotRemembered,
    RememberedNode,
    looked_up_parameters,
    signature_of,
)
from tests.workflows.recipe.both_ways import load_with, outcome, signed

FIRST_LIGHT = "first_light"
#: one mistake of each kind
MISTAKES = (
    ["sensor.read_nois=20 e-"],
    ["sensor.read_noise=20 nm"],
    ["sensor.read_noise=20"],
    ["sensor.gain=-3 e-/DN"],
    ["sensor.bits=99"],
    ["sensor.bits=true"],
    ["steps.restored.node=restore.wienr"],
    ["steps.restored.node=restor.wiener"],
    ["steps.raw.with.gian=2"],
    ["steps.restored.from.psf=pfs"],
    ["steps.psf.from.pupil=height[mask]"],
    ["optics.bands=0"],
    ["illuminant.temperature=2 mK"],
    ["doe.material=glass"],
    ["seed=x"],
    ["expect.a={step: lsr[mask], at: [99], value: 1, rtol: 1}"],
)


@pytest.fixture(scope="module")
def answers():
    """The answers that one check of a recipe leaves."""
    found = signed()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_with(RecordedNodes(found), FIRST_LIGHT, (), Path.cwd())
    return found


def copy_of(answers):
    """Answers as another process reads them."""
    document = json.loads(json.dumps([answers.signatures, answers.by_question]))
    return Answers(answers.edition, *document)


# --- signatures -----------------------------------------------------------------------------------

PROBES = (
    None, True, 0, -1, 3, 10**12, 0.5, -2.5, 1e300, float("nan"), "", "x", "5", "-1 nm", "5 nm",
    "3 e-/DN", "2 e-", "1e9 km", "1 e-/s", "7 mrad", [], [1, 2], [0.1, "2 nm"], {}, {"a": 1},
)  # fmt: skip


def errors_of(model, name, value):
    """The mistakes of one parameter, or its value."""
    try:
        read = model.model_validate({name: value})
    except ValidationError as error:
        mistakes = [(d["type"], d["loc"], d["msg"]) for d in error.errors(include_url=False)]
        return [mistake for mistake in mistakes if mistake[0] != "missing"]
    except TypeError as error:  # `units.files_of` refuses a number so
        return str(error)
    return repr(getattr(read, name))


def remembered(path, node):
    """A node from its signature as JSON."""
    return RememberedNode(path, json.loads(json.dumps(signature_of(node))), refused)


def refused(*question):
    raise NotRemembered


def own():
    return [(path, node) for path, node in all_nodes() if node.fn.__module__.startswith("neusee.")]


def test_each_node_of_neusee_has_a_signature():
    assert [path for path, node in own() if signature_of(node) is None] == []
    looked_up = {(path, name) for path, node in own() for name in looked_up_parameters(node)}
    assert {name for _, name in looked_up} == {
        "material", "surfaces", "architecture", "file", "window"
    }  # fmt: skip


def test_a_parameter_is_read_from_a_signature_as_by_the_node_itself():
    differ = []
    for path, original in own():
        copy = remembered(path, original)
        assert copy.params.model_fields.keys() == original.params.model_fields.keys()
        for name in set(original.params.model_fields) - set(looked_up_parameters(original)):
            for value in PROBES:
                right, found = (errors_of(n.params, name, value) for n in (original, copy))
                if right != found:
                    differ.append((path, name, value, right, found))
    assert differ == []


def test_a_signature_has_the_inputs_and_the_traits_of_a_node():
    for path, original in own():
        copy = remembered(path, original)
        for name in ("inputs", "optional", "random", "device", "before_run", "preflight_inputs"):
            assert getattr(copy, name) == getattr(original, name), (path, name)
        for hook in ("preflight", "shape"):
            has_hook = [getattr(n.hooks, hook) is not None for n in (copy, original)]
            assert len(set(has_hook)) == 1, (path, hook)
        defaults = [
            {name: field.default for name, field in n.params.model_fields.items()}
            for n in (copy, original)
        ]
        assert repr(defaults[0]) == repr(defaults[1]), path


def test_a_remembered_node_computes_nothing():
    path, original = next(iter(own()))
    with pytest.raises(NotRemembered):
        remembered(path, original)()


# --- the same mistakes ----------------------------------------------------------------------------


def test_a_recipe_is_the_same(answers):
    words = FIRST_LIGHT, (), Path.cwd()
    assert outcome(RememberedNodes(copy_of(answers)), *words) == outcome(THEMSELVES, *words)


@pytest.mark.parametrize("changes", MISTAKES, ids=lambda changes: changes[0])
def test_the_first_mistake_in_a_recipe_is_found_without_its_nodes(answers, changes):
    words = FIRST_LIGHT, changes, Path.cwd()
    found = outcome(RememberedNodes(copy_of(answers)), *words)
    assert found == outcome(THEMSELVES, *words)
    assert "argument 1" in found[0] or "first_light" in found[0]


def test_a_new_value_asks_the_nodes_once(answers):
    later, words = copy_of(answers), (FIRST_LIGHT, ["sensor.read_noise=21 e-"], Path.cwd())
    with pytest.raises(NotRemembered):
        load_with(RememberedNodes(later), *words)
    right = outcome(RecordedNodes(later), *words)
    assert outcome(RememberedNodes(copy_of(later)), *words) == right


def test_a_mistake_that_a_node_finds_itself_asks_the_node_once(answers):
    later, words = copy_of(answers), (FIRST_LIGHT, ["sensor.full_well=1 e-"], Path.cwd())
    with pytest.raises(NotRemembered):
        load_with(RememberedNodes(later), *words)
    right = outcome(RecordedNodes(later), *words)
    assert "full_well" in right[0]
    assert outcome(RememberedNodes(copy_of(later)), *words) == right


# --- what is never remembered ---------------------------------------------------------------------


def checked(answers, *words):
    return outcome(RecordedNodes(answers), *words), outcome(RememberedNodes(answers), *words)


def test_nodes_of_a_user_are_not_remembered(write, forget, tmp_path):
    write(
        "from neusee.nodes import node\n@node()\ndef one() -> float:\n    return 1.0\n", "mine.py"
    )
    write("nodes: [mine.py]\nsteps: {one: {node: mine.one}}\noutputs: [one]\n")
    answers = signed()
    with pytest.raises(NotRemembered):
        checked(answers, "mine.yaml", (), tmp_path)
    assert answers.by_question == {}


def test_a_file_counts_by_its_content(toy, write, tmp_path):
    table = write("wavelength (nm),power (1)\n500,1\n600,2\n", "light.csv")
    text = "steps: {line: {node: spectra.line_table, with: {file: light.csv}}}\noutputs: [line]\n"
    write(text)
    answers, words = signed(), ("mine.yaml", (), tmp_path)
    found, again = checked(answers, *words)
    assert found == again
    table.write_text("wavelength (nm),power (1)\n500,1\n600,3\n")
    with pytest.raises(NotRemembered):
        load_with(RememberedNodes(answers), *words)
    table.write_text("nonsense\n")
    recorded, count = RecordedNodes(answers), len(answers.by_question)
    with pytest.raises(RecipeError):
        load_with(recorded, *words)
    # a file may be read better the next time
    assert len(answers.by_question) == count


def test_a_file_that_the_free_memory_may_refuse_is_not_remembered(write, tmp_path, monkeypatch):
    """The next process may have less memory, or a limit."""
    write("wavelength (nm),power (1)\n500,1\n600,2\n", "light.csv")
    write("steps: {line: {node: spectra.line_table, with: {file: light.csv}}}\noutputs: [line]\n")
    monkeypatch.setattr("neusee.nodes.input_files.SMALL", 0)
    answers, words = signed(), ("mine.yaml", (), tmp_path)
    spent = [1e12, 1e12, 1e12, 1e12, 1e12]

    def measure():
        return input_files.Room(spent.pop())

    input_files.measured_by(measure)
    try:
        load_with(RecordedNodes(answers), *words)
        assert len(spent) < 5
        assert input_files._measures[-1] is measure
        with pytest.raises(NotRemembered):
            load_with(RememberedNodes(answers), *words)
    finally:
        input_files.measured_by(input_files.free_memory)


def test_an_answer_with_a_warning_is_not_remembered(toy, write, tmp_path):
    @node()
    def loud(*, value: float = 1.0) -> torch.Tensor:
        """Warn."""

    @loud.preflight
    def _(*, value):
        warnings.warn("listen", stacklevel=1)
        return ["said"]

    loud.fn.__module__, toy.loud = toy.__name__, loud
    write("steps: {loud: {node: toy.loud}}\noutputs: [loud]\n")
    answers = signed()
    with pytest.warns(UserWarning, match="listen"):
        load_with(RecordedNodes(answers), "mine.yaml", (), tmp_path)
    with pytest.raises(NotRemembered):
        load_with(RememberedNodes(answers), "mine.yaml", (), tmp_path)


# --- the file -------------------------------------------------------------------------------------


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """A file of answers of a small recipe, and the words that load the recipe."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cache").mkdir()
    (tmp_path / "mine.yaml").write_text(
        "bands: {count: 3}\n"
        "steps:\n"
        "  bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm,"
        ' count: "${bands.count}"}}\n'
        "outputs: [bands]\n"
    )
    path, edition = tmp_path / "cache" / NAME, edition_of_code(time.time_ns())
    assert edition
    _, is_without_nodes = load_from(path, edition, "mine.yaml", [])
    assert not is_without_nodes
    assert path.is_file()
    return path, edition


def is_remembered(path, edition, *changes):
    recipe, is_without_nodes = load_from(path, edition, "mine.yaml", changes)
    assert with_nodes(recipe).steps["bands"].params["stop"] == pytest.approx(700e-9)
    return is_without_nodes


def test_the_file_answers_the_next_process(kept):
    assert is_remembered(*kept)
    assert not is_remembered(*kept, "bands.count=4")
    assert is_remembered(*kept, "bands.count=4")


def test_a_file_that_is_missing_or_damaged_is_written_again(kept):
    path, edition = kept
    raw = path.read_bytes()
    flipped = raw[:-9] + bytes([raw[-9] ^ 1]) + raw[-8:]
    for content in (None, b"", b"{}", raw[: len(raw) // 2], flipped, raw.replace(b"\n", b"")):
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        assert not is_remembered(path, edition)
        assert is_remembered(path, edition)


def test_a_file_of_another_edition_is_not_read(kept, monkeypatch):
    path, edition = kept
    assert not is_remembered(path, "0" * 32)
    # written for the code as it is, which is not that edition
    assert Answers.read(path, "0" * 32).by_question == {}
    assert is_remembered(path, edition)


def test_something_else_in_the_place_of_the_file_is_not_read(kept):
    path, edition = kept
    path.unlink()
    os.mkfifo(path)
    assert not is_remembered(path, edition)


def test_a_forged_file_is_not_believed_to_be_right_in_form(kept):
    """Anybody can compute the checksum; only a secret keeps others out."""
    path, edition = kept
    answers = Answers.read(path, edition)
    for forged in (1, "x", [], ["form"], ["form", 5], ["form", ["tensor"]], {"a": 1}):
        questions = dict.fromkeys(answers.by_question, forged)
        Answers(edition, answers.signatures, questions).write(path)
        assert not is_remembered(path, edition)
    Answers(edition, {"spectra": {"bands": {"inputs": 1}}}, answers.by_question).write(path)
    assert not is_remembered(path, edition)


def test_a_file_without_the_signature_of_the_secret_is_not_read(kept, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "mine")
    assert not is_remembered(*kept)
    assert is_remembered(*kept)
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "of another")
    assert not is_remembered(*kept)


def test_a_cache_that_cannot_be_written_changes_nothing(kept):
    path, edition = kept
    path.unlink()
    for entry in (path.parent / "tmp").iterdir():
        entry.unlink()
    (path.parent / "tmp").rmdir()
    (path.parent / "tmp").write_text("no folder")
    assert not is_remembered(path, edition)
    assert not path.exists()
    missing = path.parent / "missing" / NAME
    assert not is_remembered(missing, edition)
    assert not missing.parent.exists()


def test_two_that_write_at_once_leave_a_whole_file(kept):
    path, edition = kept
    answers = Answers.read(path, edition)
    contents = [
        Answers(edition, answers.signatures, {**answers.by_question, f"of {n}": ["notes"]})
        for n in range(8)
    ]
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(lambda content: content.write(path), contents * 4))
    assert len(Answers.read(path, edition).by_question) == len(answers.by_question) + 1
    assert is_remembered(path, edition)


def test_the_newest_answers_are_kept(kept, monkeypatch):
    path, edition = kept
    monkeypatch.setattr(remembered_checks, "_MOST_ANSWERS", 3)
    Answers(edition, {}, {str(n): ["notes"] for n in range(9)}).write(path)
    assert list(Answers.read(path, edition).by_question) == ["6", "7", "8"]


# --- edition --------------------------------------------------------------------------------------


def test_the_edition_is_that_of_the_code_of_the_nodes(tmp_path, monkeypatch):
    package = tmp_path / "neusee"
    for folder in ("nodes/optics", "workflows/graph", "workflows/recipe", "workflows/report"):
        (package / folder).mkdir(parents=True)
    files = [package / "nodes/optics/_psf.py", package / "workflows/recipe/steps.py"]
    other = package / "workflows/report/page.py"
    for file in (*files, other):
        file.write_text("a = 1\n")
    monkeypatch.setattr(remembered_checks.neusee.nodes, "__file__", f"{package}/nodes/__init__.py")
    later = time.time_ns() + 60_000_000_000
    first = edition_of_code(later)
    assert first
    assert edition_of_code(later) == first
    other.write_text("a = 2\n")
    assert edition_of_code(later) == first
    for file in files:
        file.write_text("a = 2\n")
        assert edition_of_code(later) != first
        file.write_text("a = 1\n")
    assert edition_of_code(later) == first
    monkeypatch.setenv("NEUSEE_NO_CODE", "1")
    assert edition_of_code(later) != first
    # a file that has just been changed may have been imported before
    assert edition_of_code(time.time_ns()) is None
