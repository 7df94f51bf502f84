"""Own nodes on a worker: their code has the digest of the caller, whatever else each of both has
imported.
"""

import os
import pickle
import random
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import pytest

from neusee.workflows import load
from neusee.workflows.engine.step_job import StepJob
from neusee.workflows.keys.cache_key import key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.user_code import own_code

ROOT = Path(__file__).parents[3]

NODE = """
    from torch import Tensor

    from neusee.nodes import node{more}
    from {lab}.helper import half


    @node()
    def {name}(x: Tensor) -> Tensor:
        return half(x) + 0 * {use}
"""
RECIPE = """nodes: [{nodes}]
seed: 1
tolerance: 0
outputs: [last]
steps:
  scene: {{node: scene.targets, with: {{kind: siemens, shape: [8, 8]}}}}
  last: {{node: {family}.{name}, from: {{x: scene}}}}
"""
#: a process that finds the code of a pickled job, after imports of its own
WORKER = """
import importlib, pickle, sys
for module in sys.argv[3:]:
    importlib.import_module(module)
from neusee.workflows.engine.dask_executor import _Here
work = pickle.load(open(sys.argv[1], "rb"))
code = _Here(sys.argv[2], 0.0).code_for(work)
print(work.step.node.path if code else "differs")
"""


@pytest.fixture
def lab(tmp_path, monkeypatch, request):
    """A package with a name that no other test has: a helper, and two modules with a node each."""
    name = f"lab_{abs(hash(request.node.nodeid)) % 10**9}"
    folder = tmp_path / name
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "helper.py").write_text("def half(x):\n    return x / 2\n")
    for node, more, use in (("one", ", optics", "len(optics.psf.inputs)"), ("two", "", "1")):
        text = textwrap.dedent(NODE.format(name=node, lab=name, more=more, use=use))
        (folder / f"{node}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield name
    for module in [module for module in sys.modules if f"{module}.".startswith(f"{name}.")]:
        del sys.modules[module]


def job_of(recipe, folder):
    """Return the job of the last step as a run sends it, in a file."""
    code, keys = Code(folder / "code.json"), {}
    for step in recipe.steps.values():
        keys[step.name], origin = key_of(step, keys, recipe.seed, code, "cpu")
    step = recipe.steps["last"]
    work = StepJob(step, keys["last"], origin, (keys["scene"],), 1, recipe.name, "cpu", "worker")
    (folder / "job").write_bytes(pickle.dumps(replace(work, own=own_code(step, code))))
    return folder / "job"


def on_a_worker(job, *modules):
    """Return the name of the node of a job in a new process, or that its code differs there."""
    path = f"{ROOT / '.src'}:{job.parent}"
    words = [sys.executable, "-c", WORKER, str(job), str(job.parent / "store"), *modules]
    done = subprocess.run(
        words, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}
    )
    return done.stdout.strip() or done.stderr


@pytest.mark.slow
def test_a_worker_lacks_modules_that_the_caller_imported(lab, tmp_path):
    import neusee.nodes.metrics  # noqa: F401  imports modules of optics that optics itself does not

    text = RECIPE.format(nodes=f"{lab}.one, {lab}.two", family="one", name="one")
    (tmp_path / "mine.yaml").write_text(text)
    job = job_of(load("mine.yaml", (), tmp_path), tmp_path)
    assert on_a_worker(job) == "one.one"


@pytest.mark.slow
def test_a_worker_that_served_other_recipes_has_modules_that_the_caller_lacks(lab, tmp_path):
    (tmp_path / "mine.yaml").write_text(
        RECIPE.format(nodes=f"other: {lab}.two", family="other", name="two")
    )
    job = job_of(load("mine.yaml", (), tmp_path), tmp_path)
    assert f"{lab}.one" not in sys.modules
    assert on_a_worker(job, f"{lab}.one", "neusee.nodes.metrics") == "other.two"


@pytest.mark.slow
def test_a_changed_helper_is_refused(lab, tmp_path):
    (tmp_path / "mine.yaml").write_text(RECIPE.format(nodes=f"{lab}.two", family="two", name="two"))
    job = job_of(load("mine.yaml", (), tmp_path), tmp_path)
    (tmp_path / lab / "helper.py").write_text("def half(x):\n    return x / 3\n")
    assert on_a_worker(job) == "differs"


def test_what_dask_draws_beside_a_step_is_no_draw_of_the_step(monkeypatch):
    sizeof = pytest.importorskip("dask.sizeof")
    monkeypatch.setattr(sizeof, "random", random)  # a worker in this process may have changed it
    from neusee.workflows.engine.dask_executor import _chance_of_its_own
    from neusee.workflows.observation.random_generators import SharedGenerators

    many = {number: number for number in range(1000)}
    before = SharedGenerators()
    sizeof.sizeof(many)
    assert before.drawn() == ["random"]  # dask asks the generator of the process
    _chance_of_its_own()
    before = SharedGenerators()
    sizeof.sizeof(many)
    assert before.drawn() == []
    # a second worker in this process takes a class from what dask holds for the module
    assert sizeof.random.Random(3).random() == random.Random(3).random()
