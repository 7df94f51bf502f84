"""A result travels to another process, names the arms of outputs, and gives the numbers that the
program prints.
"""

import json
import pickle
import subprocess
import sys

import pytest
import torch

import neusee
from neusee.workflows import as_function, load
from neusee.workflows.engine.wanted_steps import wanted
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store.remote_store import RemoteStore
from neusee.workflows.store.result_store import Store

SMALL = [
    "optics.samples=90",
    "optics.pitch=89.76 um",
    "optics.window=[48, 48]",
    "scene.shape=[64, 64]",
]
SMALL += ["sensor.shape=[48, 48]", "optics.bands=5", "doe=vortex"]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("cache"), verify="sampled", budget=10**9)


@pytest.fixture(scope="module")
def result(store):
    return neusee.run(load("first_light", SMALL), store=store)


def same(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        pairs = (
            zip(value, other[name], strict=True)
            if isinstance(value, tuple)
            else [(value, other[name])]
        )
        assert all(torch.equal(a, b) for a, b in pairs), name


def test_a_result_can_be_pickled(result):
    again = pickle.loads(pickle.dumps(result))
    same(result.values, again.values)
    assert again.metrics() == result.metrics()
    assert repr(again) == repr(result)
    assert again.done == result.done
    assert (again.store.root, again.store.verify, again.store.budget) == (
        result.store.root,
        "sampled",
        10**9,
    )
    assert torch.equal(again["truth"], result["truth"])


def test_a_remote_store_is_opened_again_at_its_place(tmp_path):
    there = RemoteStore(f"file://{tmp_path / 'far'}", tmp_path / "near", verify="never")
    again = pickle.loads(pickle.dumps(there))
    assert (type(again), again.url, again.root, again.verify) == (
        RemoteStore,
        there.url,
        there.root,
        "never",
    )


READER = """
import json, pickle, sys
with open(sys.argv[1], "rb") as file:
    result = pickle.load(file)
print(json.dumps([result.metrics(), result.numpy("raw[mask]").tolist(), float(result["truth"].double().sum())]))
"""


@pytest.mark.slow
def test_a_fresh_process_reads_a_result(result, tmp_path):
    (tmp_path / "result.pickle").write_bytes(pickle.dumps(result))
    command = [sys.executable, "-c", READER, str(tmp_path / "result.pickle")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    here = [
        result.metrics(),
        result.numpy("raw[mask]").tolist(),
        float(result["truth"].double().sum()),
    ]
    assert json.loads(done.stdout) == json.loads(json.dumps(here))


@pytest.mark.parametrize(
    "ask",
    [
        lambda result: result["raw"],
        lambda result: result.value("raw"),
        lambda result: result.numpy("raw"),
        lambda result: neusee.run(result.recipe, store=result.store, outputs=["raw"]),
        lambda result: as_function(result.recipe, "raw", store=result.store),
    ],
    ids=["item", "value", "numpy", "run", "as_function"],
)
def test_an_output_without_its_arm_is_answered_with_the_arms_there_are(ask, result):
    with pytest.raises(
        ValueError, match=r"^no output raw: this recipe has raw\[mask\], raw\[plain\]$"
    ):
        ask(result)


def test_many_arms_are_counted(store):
    recipe = load("six_lasers", [*SMALL, "optics.pixel=zoh"])
    count = sum(name.startswith("spot[") for name in recipe.steps)
    with pytest.raises(
        ValueError,
        match=rf"^no output spot: this recipe has spot\[.*, spot\[.* and {count - 8} more$",
    ):
        neusee.run(recipe, store=store, outputs=["spot"])


@pytest.mark.slow
@pytest.mark.parametrize("outputs", [None, ["raw[mask]"]])
def test_metrics_are_the_numbers_that_the_program_prints(outputs, store, tmp_path):
    recipe = load("first_light", SMALL)
    document = simulate(recipe, store, tmp_path / "runs", ["neusee", "run"]).document
    found = neusee.run(recipe, store=store, outputs=outputs).metrics()
    printed = {}
    for step, field, _, number in document["metrics"]:
        printed.setdefault(f"{step}.{field}".rstrip("."), []).append(number)
    printed = {
        name: numbers[0] if len(numbers) == 1 else numbers for name, numbers in printed.items()
    }
    shown = {name.partition(".")[0] for name in found} & set(wanted(recipe))
    assert {
        "restored_quality",
        "developed_quality[mask]",
        "peak[plain]",
        "saturated[mask]",
        "lsr[mask]",
    } <= shown
    # to the tolerance: which steps are cheaper depends on all that is asked for
    for name, numbers in found.items():
        assert numbers == pytest.approx(printed[name], rel=recipe.tolerance), name
    assert {name for name in printed if name.partition(".")[0] in wanted(recipe)} <= set(found)
    cells = [cell for row in document["table"]["rows"] for cell in row["cells"] if cell]
    assert f"{found['restored_quality.psnr']:.2f}" in cells, json.dumps(cells)
