"""Nodes of a user: named in a recipe or installed by a package, they behave as those of neusee."""

import json
import os
import subprocess
import sys

import jsonschema
import pytest
from typer.testing import CliRunner

import neusee
from neusee.workflows import Store, load, run
from neusee.workflows.cli.app import app
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.handbook import json_schema
from neusee.workflows.recipe import node_families
from neusee.workflows.recipe.loading import families_of

NODE = '''\
"""Blooming: charge above the full well spills along the column."""

import torch
from torch import Tensor

from {helper} import share
from neusee.nodes import node
from neusee.nodes.units import Electrons


@node(rtol=1e-5)
def bloom(charge: Tensor, *, full_well: Electrons = 100.0) -> Tensor:
    """Spill the charge above the full well to the neighbours in the column."""
    excess = (charge - full_well).clamp(min=0) * share()
    return charge - excess + 0.5 * (torch.roll(excess, 1, -2) + torch.roll(excess, -1, -2))


@node()
def total(charge: Tensor) -> Tensor:
    """Sum the charge."""
    return charge.sum()
'''
RECIPE = """\
# Mine.
nodes: [{family}.py]
scene: {{shape: [8, 8]}}
steps:
  scene: {{node: scene.targets, with: {{kind: points, shape: "${{scene.shape}}"}}}}
  bloomed: {{node: {family}.bloom, from: scene, with: {{full_well: 0.25 e-}}}}
  total: {{node: {family}.total, from: bloomed}}
outputs: [bloomed, total]
"""
IDENTITY = (
    "from torch import Tensor\nfrom neusee.nodes import node\n\n\n@node()\ndef f(x: Tensor) ->"
    " Tensor:\n    return x\n"
)
USES = """\
outputs: [b]
steps:
  a: {{node: scene.targets, with: {{kind: siemens, shape: [4, 4]}}}}
  b: {{node: {0}, from: a}}
"""


@pytest.fixture
def mine(write):
    """Write a node, its helper and a recipe with them, and give the recipe."""

    def mine(family="bloom_a", share=0.5):
        write(f"def share():\n    return {share}\n", f"{family}_helper.py")
        write(NODE.format(helper=f"{family}_helper"), f"{family}.py")
        return write(RECIPE.format(family=family))

    return mine


pytestmark = pytest.mark.usefixtures("forget")


def problems(*arguments):
    with pytest.raises(RecipeError) as caught:
        load(*arguments)
    return [f"{p.mark} | {p.path} | {p.message}" for p in caught.value.diagnostics]


def test_a_file_beside_the_recipe_is_a_family(mine, tmp_path):
    recipe = load(mine(), (), tmp_path)
    assert recipe.steps["bloomed"].node.path == "bloom_a.bloom"
    assert f"reading this recipe ran code: {tmp_path / 'bloom_a.py'}" in recipe.notes
    result = run(recipe, store=Store(tmp_path / "cache"))
    scene = neusee.run(load(mine(), ["outputs=[scene]"], tmp_path))["scene"]
    assert (result["bloomed"] != scene).any()
    assert float(result["total"]) == pytest.approx(float(scene.sum()), rel=1e-6)


def test_paths_are_relative_to_the_recipe_and_the_final_recipe_runs_elsewhere(
    mine, tmp_path, monkeypatch
):
    mine()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    recipe = load(tmp_path / "mine.yaml")
    (tmp_path / "elsewhere" / "final.yaml").write_text(recipe.config.to_yaml())
    assert load("final.yaml").steps["bloomed"].node is recipe.steps["bloomed"].node


def in_new_process(tmp_path, *words):
    env = {**os.environ, "NEUSEE_CACHE": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "neusee", *words]
    return subprocess.run(
        command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )


def state_of(process):
    return [
        "run" if step["state"] == "run" else "cached"
        for step in json.loads(process.stdout)["steps"]
    ]


@pytest.mark.slow
def test_an_edited_helper_runs_the_step_again_and_why_names_it(mine, tmp_path):
    mine()
    states = [state_of(in_new_process(tmp_path, "run", "mine.yaml", "--json")) for _ in range(2)]
    assert states == [["run"] * 3, ["cached"] * 3]
    mine(share=0.4)
    assert state_of(in_new_process(tmp_path, "run", "mine.yaml", "--json")) == [
        "cached",
        "run",
        "run",
    ]
    why = in_new_process(tmp_path, "why", "bloomed", "mine.yaml").stdout
    assert "code of share() in bloom_a_helper.py changed" in why


def test_a_folder_is_a_family_and_an_entry_may_name_it(write, tmp_path):
    write('"""Lab."""\nfrom ._inner import tilt\n', "lab_b/__init__.py")
    code = "from torch import Tensor\nfrom neusee.nodes import node\n\n\n@node()\n"
    code += (
        'def tilt(x: Tensor, *, by: float = 1.0) -> Tensor:\n    """Tilt."""\n    return x + by\n'
    )
    write(code, "lab_b/_inner.py")
    write("nodes: [./lab_b]\n" + USES.format("lab_b.tilt"))
    assert load("mine.yaml", (), tmp_path).steps["b"].node.path == "lab_b.tilt"
    write("nodes: [optics_of_ours: ./lab_b]\n" + USES.format("optics_of_ours.tilt"), "other.yaml")
    [problem] = problems("other.yaml", (), tmp_path)
    assert problem.endswith(
        "lab_b already has the name lab_b in this process: use that name, or start a new process"
    )
    node_families._family_of.clear()
    assert load("other.yaml", (), tmp_path).steps["b"].node.path == "optics_of_ours.tilt"


FAILS = "cannot be imported: "
BAD = {
    "[blom.py]": f"blom.py {FAILS}there is no file",
    "[./none]": f"./none {FAILS}there is no file",
    "[none_such.mod]": "there is no installed module none_such.mod",
    "[lab_c]": "there is no installed module lab_c; write ./lab_c for the folder",
    "[optics: ok_c.py]": (
        "there is already a family of nodes optics, from neusee or an installed package: choose"
    ),
    "[ok_c.py, sub/ok_c.py]": f"sub/ok_c.py {FAILS}the name ok_c is that of",
    "ok_c.py": "must be a list of files and modules, not a string",
    "[3]": "must be a file, a folder or a module, such as bloom.py, or `family: module`",
    "[{a: b.py, c: d.py}]": (
        "must be a file, a folder or a module, such as bloom.py, or `family: module`"
    ),
    "[string.py]": f"string.py {FAILS}the name string is that of",
    "[bad_c.py]": f"bad_c.py {FAILS}bad_c.py:2: ZeroDivisionError: division by zero",
    "[syntax_c.py]": f"syntax_c.py {FAILS}syntax_c.py:1: SyntaxError: ",
    "[empty_c.py]": "empty_c defines no node: decorate a function with @node() of neusee.nodes",
    "[math]": "math defines no node",
    "[a-b.py]": f"a-b.py {FAILS}a-b is not the name of a module: use letters, digits and _",
    "[exits_c.py]": f"exits_c.py {FAILS}exits_c.py:2: SystemExit: 0",
    "[lacks_c.py]": (
        f"lacks_c.py {FAILS}lacks_c.py:1: ModuleNotFoundError: No module named 'none_such_at_all'"
    ),
}


@pytest.mark.parametrize(("nodes", "problem"), BAD.items())
def test_a_mistake_is_located_once_and_hides_what_follows_from_it(write, tmp_path, nodes, problem):
    write("nothing", "lab_c/readme")
    for name in ("ok_c.py", "sub/ok_c.py", "string.py", "a-b.py"):
        write(IDENTITY, name)
    write("x = 1\nx / 0\n", "bad_c.py")
    write("def (\n", "syntax_c.py")
    write("x = 1\n", "empty_c.py")
    write("import none_such_at_all\n", "lacks_c.py")
    write("import sys\nsys.exit(0)\n", "exits_c.py")
    write(f"nodes: {nodes}\noutputs: [b]\nsteps: {{b: {{node: bloomy.f}}}}\n")
    found = problems("mine.yaml", (), tmp_path)
    assert len(found) == 1
    mark, _, message = found[0].split(" | ")
    assert mark.startswith("mine.yaml:1:")
    assert message.startswith(problem)


@pytest.mark.parametrize(
    ("annotation", "problem"),
    [
        (
            "by=1.0",
            ("tilt_d.py:5: tilt gives no type for by: write a type such as `by: float`, or a unit"),
        ),
        (
            "by: 'None_such' = 1",
            "tilt_d.py:5: the annotations of tilt cannot be read: NameError: name 'None_such'",
        ),
    ],
)
def test_a_parameter_without_a_type_is_located_at_its_function(
    write, tmp_path, annotation, problem
):
    code = "from torch import Tensor\nfrom neusee.nodes import node\n\n\n@node()\n"
    write(
        f'{code}def tilt(x: Tensor, *, {annotation}) -> Tensor:\n    """Tilt."""\n    return x\n',
        "tilt_d.py",
    )
    write("nodes: [tilt_d.py]\n" + USES.format("tilt_d.tilt"))
    [found] = problems("mine.yaml", (), tmp_path)
    assert found.startswith(f"mine.yaml:5:13 | steps.b.node | {problem}")


def test_a_helper_of_another_folder_is_not_taken_for_the_one_beside(write, tmp_path):
    node = "from helper_d import k\n" + IDENTITY
    for folder, family in (("a", "one_d"), ("b", "two_d")):
        write(node, f"{folder}/{family}.py")
        write("k = 2\n", f"{folder}/helper_d.py")
    for folder, family in (("a", "one_d"), ("b", "two_d")):
        write(f"nodes: [{family}.py]\n" + USES.format(f"{family}.f"), f"{folder}/mine.yaml")
    load(tmp_path / "a" / "mine.yaml")
    [problem] = problems(tmp_path / "b" / "mine.yaml")
    assert (
        f"the name helper_d is that of {tmp_path / 'a' / 'helper_d.py'}: rename {tmp_path / 'b'}"
        in problem
    )


@pytest.mark.slow
def test_no_code_refuses_before_anything_is_run(mine, tmp_path, monkeypatch):
    recipe = mine("bloom_e")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "environ", dict(os.environ))
    for words in (["validate", str(recipe), "--no-code"], ["--no-code", "run", str(recipe)]):
        found = in_new_process(tmp_path, *words)
        assert found.returncode == 2
        assert (
            "nodes.0 = bloom_e.py   names code, which NEUSEE_NO_CODE or --no-code refuses to run"
            in found.stderr
        )
        assert found.stderr.count("\n") == 2
    assert "bloom_e" not in sys.modules


@pytest.mark.slow
def test_nodes_and_schema_list_those_of_a_recipe(mine, tmp_path, monkeypatch):
    mine("bloom_f")
    monkeypatch.chdir(tmp_path)
    out = CliRunner().invoke(app, ["nodes", "--recipe", "mine.yaml"]).output
    assert "Blooming: charge above the full well spills along the column" in out
    out = CliRunner().invoke(app, ["nodes", "bloom_f.bloom", "--recipe", "mine.yaml"]).output
    assert "full_well  charge from 0 to 1e+12 e-, such as 390 e-" in out
    schema = json_schema.schema(families_of("mine.yaml"))
    good = {
        "nodes": ["bloom_f.py"],
        "steps": {"a": {"node": "bloom_f.bloom", "with": {"full_well": "3 e-"}}},
    }
    jsonschema.validate(good, schema)
    good["steps"]["a"]["with"]["full_wel"] = 3
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(good, schema)


def test_a_group_brings_its_node_and_the_recipe_its_own(mine, write, tmp_path):
    mine("bloom_g")
    mine("bloom_h")
    write(
        "nodes: [../bloom_g.py]\nsteps: {first: {node: bloom_g.bloom, from: scene}}\n",
        "spill/g.yaml",
    )
    text = RECIPE.format(family="bloom_h").replace("nodes:", "defaults: [spill: g]\nnodes:")
    write(text)
    recipe = load("mine.yaml", (), tmp_path)
    assert recipe.steps["first"].node.path == "bloom_g.bloom"
    assert recipe.steps["bloomed"].node.path == "bloom_h.bloom"


@pytest.mark.slow
def test_a_worker_imports_the_files_of_the_recipe(mine, tmp_path):
    from neusee.workflows.engine.dask_cluster import cluster

    recipe = load(mine("bloom_i"), (), tmp_path)
    here = run(recipe, store=Store(tmp_path / "here"))
    store = Store(tmp_path / "there")
    with cluster("dask:1", store) as executor:
        there = run(recipe, store=store, executor=executor)
    assert (there["bloomed"] == here["bloomed"]).all()
    assert {done.state for done in there.done.values()} == {"run"}
