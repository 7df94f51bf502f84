"""A run whose results are all in the cache is given again as it was, and only while each of
these results is there.
"""

import json
import os
import shutil
from pathlib import Path

import pytest
import torch

from neusee.nodes import node
from neusee.workflows.answers import repeated_command
from neusee.workflows.answers import witnesses as stored_results
from neusee.workflows.answers.stored_answer import (
    FOLDER_MARK,
    SECONDS_MARK,
    RunResults,
    read_answer,
)
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Expectation, Recipe, Step
from neusee.workflows.report import run_folder as run_html
from neusee.workflows.report.run_crate import CRATE
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store import metadata
from neusee.workflows.store.result_store import Store

MARK = Location("<script>.yaml", 3, 1)
#: results for which a run asks, one missing and one small
FURTHER, SMALL = "ab" + "0" * 30, "cd" + "0" * 30


@node()
def filled(*, value: float) -> torch.Tensor:
    """Fill a line with a number. Units: DN."""
    return torch.full((2000,), value, dtype=torch.float64)


@node()
def brightest(x: torch.Tensor) -> torch.Tensor:
    """Return the largest number. Units: DN."""
    return x.max()


def recipe(promised: float = 3.0) -> Recipe:
    steps = {
        "line": Step("line", filled, {"value": 3.0}, {}, MARK, {}),
        "top": Step("top", brightest, {}, {"x": "line"}, MARK, {}),
    }
    expect = (Expectation("the top", "top", (), promised, 0.01, MARK),)
    return Recipe("small", "A small recipe.", 5, 1e-3, ("line", "top"), steps, expect)


class Runs:
    """A recipe that is run, with the command that keeps its answer."""

    def __init__(self, place):
        self.place, self.words = place, ["run", "small.yaml"]
        self.computed, self.promised, self.as_json, self.asks = 0, 3.0, False, (SMALL,)

    @property
    def store(self):
        return Store(self.place.root / "cache")

    def __call__(self):
        """Return what the command prints: its stored answer, or that of a run, which is kept if
        it can be.
        """
        command = self.command()
        text = command.answer()
        if text is not None:
            return text
        self.computed += 1
        store, small = self.store, recipe(self.promised)
        for key in self.asks:
            store.has(key)
        done = simulate(small, store, Path("runs"), ["neusee", *self.words])
        folder = str(done.folder)
        text = "{}/report.html in {} s"
        if not done.document["missed"]:
            results = RunResults(done.folder, Path("runs"), done.document, done.taken, store)
            command.keep(text.format(FOLDER_MARK, SECONDS_MARK), self.as_json, small, results)
        return text.format(folder, f"{done.document['seconds']:.2f}")

    def again(self):
        """Return True if the recipe was run when it was asked for."""
        before = self.computed
        self()
        return self.computed > before

    def file(self, pattern):
        """Return the only file of the cache with such a path."""
        (found,) = (self.place.root / "cache").glob(pattern)
        return found

    @property
    def answer(self):
        return read_answer(self.place.disk, self.command().name)

    def command(self):
        return repeated_command.Command(self.words, self.place.terminal, self.place.disk)

    def taken(self, name):
        """Return the file of the cache that stands in the folder of the run under a name."""
        return self.place.root / "cache" / self.answer.stored.taken[name]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A cache with all results and pictures of the run, of its first time and of later times."""
    root = tmp_path_factory.mktemp("computed")
    store = Store(root / "cache")
    store.put_small(SMALL, torch.ones(1), {"step": "small", "seconds": 1e-4, "date": "2026-01-01"})
    for _ in range(2):
        simulate(recipe(), store, root / "runs", ["neusee", "run", "small.yaml"])
    return store.root


@pytest.fixture
def runs(place, cache):
    """A run whose results are in the cache, and whose answer is stored."""
    shutil.copytree(cache, place.root / "cache", dirs_exist_ok=True, symlinks=True)
    found = Runs(place)
    assert found.again(), "the results are in the cache"
    assert not found.again(), "the answer is in the cache"
    return found


def newest(runs):
    return (runs.place.work / "runs" / "latest").resolve()


def test_the_folder_of_a_run_is_the_same_but_for_time_and_memory(runs):
    first = newest(runs)
    text = runs()
    second = newest(runs)
    assert second != first
    assert text.startswith(f"runs/{second.name}/report.html in 0.")
    names = sorted(
        path.relative_to(first).as_posix() for path in first.rglob("*") if path.is_file()
    )
    assert names == sorted(
        path.relative_to(second).as_posix() for path in second.rglob("*") if path.is_file()
    )
    assert {"report.html", "recipe.yaml", "data/outputs.safetensors", "figures/graph.png"} <= set(
        names
    )
    for name in set(names) - {CRATE, "report.html", "provenance.json"}:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
    old, new = (json.loads((folder / "provenance.json").read_text()) for folder in (first, second))
    assert {name for name in old if old[name] != new[name]} <= {
        "started",
        "seconds",
        "facts",
        "timing",
    }
    assert list(old) == list(new)
    facts = dict(new["facts"])
    assert facts["engine"] == f"{new['seconds']:.3f} s"
    assert facts["answer"].startswith("that of the run of 20")
    assert new["timing"] | {"peak": 0} == old["timing"] | {"peak": 0}
    page = (second / "report.html").read_bytes()
    assert run_html.rebuild(second).read_bytes() == page
    assert facts["answer"].encode() in page
    crate = {each["@id"]: each for each in json.loads((second / CRATE).read_text())["@graph"]}
    assert second.name.startswith(crate["./"]["name"])
    assert crate["report.html"]["contentSize"] == str(len(page))


def test_the_document_of_a_run_is_printed_with_its_own_time(runs):
    runs.as_json, runs.words = True, ["run", "small.yaml", "--json"]
    assert runs.again()
    printed = json.loads(runs())
    kept = json.loads((newest(runs) / "provenance.json").read_text())
    assert printed == {"report": f"runs/{newest(runs).name}/report.html", **kept}


# --- what a run rests on --------------------------------------------------------------------------


def spoil(path):
    """Change one bit in the middle of a file, and give the file its old time and size."""
    about, raw = path.stat(), bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.chmod(0o644)
    path.write_bytes(raw)
    os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))


def exchange(path):
    """Put a link to a file of another content in the place of a file."""
    (other := path.with_name("other")).write_bytes(path.read_bytes()[:-1] + b"x")
    path.unlink()
    path.symlink_to(other)


def pipe(path):
    path.unlink()
    os.mkfifo(path)


def evict(runs):
    path = runs.file("??/*.safetensors")
    key, disk = path.stem, runs.place.disk
    metadata.write(disk, key, metadata.receipt(metadata.read(disk, key)), over=True)
    path.unlink()


def compute_anew(runs):
    """Put another value under the key of a result, as whole as the first."""
    path = runs.file("??/*.safetensors")
    about = metadata.read(runs.place.disk, path.stem)
    path.unlink()
    path.with_suffix(".json").unlink()
    kept = {
        name: about[name]
        for name in ("step", "seconds", "date", "device", "origin", "facts", "checks")
    }
    assert runs.store.put(path.stem, torch.full((2000,), 4.0, dtype=torch.float64), kept)


CHANGES = {
    "a value is gone": lambda r: r.file("??/*.safetensors").unlink(),
    "a value is damaged": lambda r: spoil(r.file("??/*.safetensors")),
    "a value is cut short": lambda r: os.truncate(r.file("??/*.safetensors"), 100),
    "a value is a link to another": lambda r: exchange(r.file("??/*.safetensors")),
    "a pipe in place of a value": lambda r: pipe(r.file("??/*.safetensors")),
    "a value is removed for its size": evict,
    "a value is another": compute_anew,
    "metadata are gone": lambda r: r.file("??/*.safetensors").with_suffix(".json").unlink(),
    "metadata are damaged": lambda r: spoil(r.file("??/*.safetensors").with_suffix(".json")),
    "a folder in place of metadata": lambda r: (
        (path := r.file("??/*.safetensors").with_suffix(".json")).unlink(),
        path.mkdir(),
    ),
    "small results are gone": lambda r: (r.place.root / "cache" / "brief.jsonl").unlink(),
    "small results are damaged": lambda r: spoil(r.place.root / "cache" / "brief.jsonl"),
    "a picture is gone": lambda r: r.taken("figures/graph.png").unlink(),
    "a picture is damaged": lambda r: spoil(r.taken("figures/graph.png")),
    "a picture is a link to another": lambda r: exchange(r.taken("figures/graph.png")),
    "an export is damaged": lambda r: spoil(r.taken("data/outputs.safetensors")),
    "a pipe in place of an export": lambda r: pipe(r.taken("data/outputs.safetensors")),
}


def test_a_result_or_file_of_the_cache_that_is_not_as_it_was_ends_the_answer(runs, tmp_path):
    cache, kept = runs.place.root / "cache", tmp_path / "kept"
    cache.rename(kept)
    given = []
    for name, change in {"nothing": lambda r: None, **CHANGES}.items():
        shutil.copytree(kept, cache, symlinks=True)
        change(runs)
        if runs.command().answer() is not None:
            given.append(name)
        shutil.rmtree(cache)
    assert given == ["nothing"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["a value is damaged", "a picture is damaged", "small results are gone"]
)
def test_after_damage_the_run_goes_its_ordinary_way_and_is_kept_again(runs, name):
    first = newest(runs)
    CHANGES[name](runs)
    assert runs.again()
    assert runs.again() is (name == "a value is damaged"), (
        "a step was computed, and a run that computes is not kept"
    )
    assert not runs.again()
    for name in ("data/outputs.safetensors", "metrics.csv"):
        assert (newest(runs) / name).read_bytes() == (first / name).read_bytes()


def test_a_result_that_was_missing_and_is_there_now_ends_the_answer(runs):
    runs.words.append("more=1")
    runs.asks = (SMALL, FURTHER)
    assert runs.again()
    assert not runs.again()
    runs.store.put(FURTHER, torch.ones(3), {"step": "exact", "seconds": 1.0, "date": "2026-01-01"})
    assert runs.again()
    assert not runs.again()


def test_a_result_of_which_only_the_use_is_noted_keeps_the_answer(runs):
    path = runs.file("??/*.safetensors").with_suffix(".json")
    os.utime(path, (10**9, 10**9))
    assert not runs.again()
    assert path.stat().st_mtime > 10**9 + 1, "the use of the value is noted, as a run notes it"


@pytest.mark.slow
def test_a_run_that_computes_warns_or_misses_is_not_kept(place):
    runs = Runs(place)
    assert runs.again()
    assert not list((place.root / "cache" / "answers").rglob("*run*"))
    assert runs.again(), "the first run has computed its steps"
    runs.words, runs.promised = ["run", "missed"], 4.0
    assert runs.again()
    assert runs.again(), "a number was missed"


def test_a_page_that_is_not_made_of_its_document_is_not_kept(runs, monkeypatch):
    runs.words = ["run", "another"]
    monkeypatch.setattr(
        run_html, "page", lambda doc, pictures, real=run_html.page: real(doc, pictures) + "<!-- -->"
    )
    assert runs.again()
    assert runs.again()


@pytest.mark.slow
def test_with_a_secret_only_what_is_signed_is_given_again(runs, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "ours")
    assert runs.again(), "nothing was signed"
    assert runs.again(), "the signed results are in the cache"
    assert not runs.again()
    spoil(runs.taken("figures/graph.png"))
    assert runs.again()
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "theirs")
    assert runs.command().answer() is None


def test_what_a_run_asked_for_is_all_of_its_results(runs):
    answer = runs.answer
    document = json.loads((newest(runs) / "provenance.json").read_text())
    assert {step["key"] for step in document["steps"]} <= set(answer.stored.results)
    assert runs.file("??/*.safetensors").stem in answer.stored.loaded
    assert set(answer.stored.taken) == {"figures/graph.png", "data/outputs.safetensors"}
    assert stored_results.still_there(runs.place.disk, answer.stored)
