"""Runs on a cache that somebody else changed: the same values come out, and the run after it
finds them again.
"""

import random
import signal
import warnings

import pytest
import torch

from neusee.nodes import node
from neusee.nodes.values import Psf
from neusee.workflows.engine.dask_executor import kinds_of, work_here
from neusee.workflows.engine.runner import run
from neusee.workflows.engine.step_job import StepJob
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.sealed_files import seal_record, signature, unseal_record
from neusee.workflows.store.result_store import Store

CALLS: list[str] = []
PEAK = 0.25


@node()
def light(*, count: int = 20_000) -> torch.Tensor:
    CALLS.append("light")
    return torch.arange(float(count))


@node()
def spread(x: torch.Tensor) -> Psf:
    CALLS.append("spread")
    return Psf(x.reshape(2, 100, 100) * PEAK, torch.ones(2, dtype=torch.float64))


@node()
def picture(psf: Psf, more: list[torch.Tensor] | None = None) -> torch.Tensor:
    CALLS.append("picture")
    return psf.intensity.sum(0) * psf.clear_peak[0]


@pytest.fixture(autouse=True)
def _ends():
    """A run that computes a value again and again fails, instead of never ending."""

    def late(*args):
        raise TimeoutError("the run does not end")

    CALLS.clear()
    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(100)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def recipe():
    mark = Location("r.yaml", 1, 1)
    wires = {"light": {}, "spread": {"x": "light"}, "picture": {"psf": "spread", "more": None}}
    nodes = {"light": (light, {"count": 20_000}), "spread": (spread, {}), "picture": (picture, {})}
    steps = {name: Step(name, *nodes[name], wires[name], mark, {}) for name in nodes}
    return Recipe("forged", "", 1, 0.0, tuple(steps), steps)


TRUTH = torch.arange(20_000.0).reshape(2, 100, 100).mul(PEAK).sum(0).double()

#: what is forged in the metadata of each entry, with a checksum that is right
FORGERIES = {
    "type": lambda about: {"layout": {"class": "os:system", "items": [{"value": "true"}]}},
    "function": lambda about: {
        "layout": {
            "class": "neusee.nodes._node:_imported",
            "items": [{"value": "os"}, {"value": "system"}],
        }
    },
    "other kind of value": lambda about: {"layout": {"value": "text"}},
    "other type": lambda about: {
        "layout": {"class": "neusee.nodes.values:Dirt", "items": [{"tensor": 0}] * 2},
    },
    "kind of layout": lambda about: {"layout": {"quantised": {"bits": 4}}},
    "no facts": lambda about: dict.fromkeys(
        ("checks", "seconds", "bytes", "date", "device", "peak")
    ),
    "strange facts": lambda about: {
        "facts": {"shape": [1], "x": 7},
        "error": [1.0, 2.0],
        "versions": {},
    },
    "other origin": lambda about: {"origin": {"node": None}},
    "huge peak": lambda about: {"peak": 1e30},
    "text": lambda about: {"seconds": "long", "bytes": "many"},
    "receipt": lambda about: {"kept": False, "bytes": None, "seconds": None},
    "huge tensor": lambda about: {"tensors": [["F64", [1 << 40], False, ""]], "payload": None},
    "no payload": lambda about: {"payload": None},
}


def result(root):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = run(recipe(), Store(root))
    assert torch.equal(found.value("picture").double(), TRUTH)
    assert type(found.value("spread")) is Psf
    return found


@pytest.mark.parametrize("how", FORGERIES)
def test_a_run_on_forged_entries_computes_them_and_the_next_one_finds_them(tmp_path, how):
    result(tmp_path)
    for path in tmp_path.glob("??/*.json"):
        about = unseal_record("result", path.read_bytes())
        path.write_bytes(seal_record("result", about | FORGERIES[how](about)))
    result(tmp_path)
    result(tmp_path)
    CALLS.clear()
    result(tmp_path)
    assert CALLS == []


def test_a_run_on_a_forged_journal_plans_as_if_it_were_not_there(tmp_path):
    result(tmp_path)
    rows = Store(tmp_path).journal.rows()
    assert rows
    rng = random.Random(0)
    with (tmp_path / "journal.jsonl").open("ab") as file:
        for row in rows:
            for _ in range(20):
                bad = {
                    rng.choice(["peak", "bytes", "seconds"]): rng.choice(
                        [1e30, "x", -5, None, [], float("nan")]
                    )
                }
                file.write(b"\n" + seal_record("journal", {**row, **bad}))
    for path in tmp_path.glob("??/*.json"):
        path.unlink()
    result(tmp_path)


def test_a_secret_that_is_set_later_is_no_failure(tmp_path, monkeypatch):
    result(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "ours")
    CALLS.clear()
    result(tmp_path)
    assert len(CALLS) == 3
    CALLS.clear()
    result(tmp_path)
    assert CALLS == []
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "new, ours")
    result(tmp_path)
    assert CALLS == []


# --- on a worker ----------------------------------------------------------------------------------


def test_a_worker_knows_the_type_of_each_input():
    work = StepJob(recipe().steps["picture"], "k", {}, ("p", ("a", "b")), 1, "r", "cpu", "l")
    assert kinds_of(work) == {"p": Psf, "a": torch.Tensor, "b": torch.Tensor}


@pytest.mark.parametrize(
    ("caller", "worker", "same"), [("", "one", False), ("one", "", False), ("one", "two", False)]
)
def test_a_worker_with_another_secret_says_so(tmp_path, monkeypatch, caller, worker, same):
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", caller)
    signed = signature("worker", "", b"")
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", worker)
    work = StepJob(recipe().steps["light"], "k", {"code": ""}, (), 1, "r", "cpu", "l")
    (outcome,) = work_here((work,), str(tmp_path), torch.get_num_threads(), 1e9, signed)
    assert "set the same secret there" in str(outcome.error)
