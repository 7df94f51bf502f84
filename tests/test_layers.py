"""Layers: nodes know nothing of workflows, one room for emcee, full names, and nothing heavy on import."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NODES, WORKFLOWS = sorted(ROOT.glob("nodes/**/*.py")), sorted(ROOT.glob("workflows/**/*.py"))
HEAVY = {"colour", "kornia", "OpenEXR", "scipy", "matplotlib", "skimage"}
FORBIDDEN_IN_NODES = {"yaml", "ruamel", "emcee", "typer", "rich", "jinja2", "logging", "xxhash"}


def imports(tree):
    """Every module that is imported, and whether at module level."""
    top = set(map(id, tree.body))
    for item in ast.walk(tree):
        if isinstance(item, ast.ImportFrom):
            assert item.level == 0, "import by the full name"
            yield item.module, id(item) in top
        elif isinstance(item, ast.Import):
            yield from ((a.name, id(item) in top) for a in item.names)


@functools.cache
def parsed(path):
    return list(imports(ast.parse(path.read_text())))


every_file = pytest.mark.parametrize("path", NODES + WORKFLOWS, ids=lambda p: str(p.relative_to(ROOT)))
every_node_file = pytest.mark.parametrize("path", NODES, ids=lambda p: str(p.relative_to(ROOT)))


@every_file
def test_the_house_is_imported_by_its_full_name(path):
    assert not [n for n, _ in parsed(path) if n.split(".")[0] in ("nodes", "workflows", "recipes")]


@every_node_file
def test_nodes_know_only_physics(path):
    names = [n for n, _ in parsed(path)]
    assert not [n for n in names if n.startswith(("neusee.workflows", "neusee.recipes"))]
    assert not [n for n in names if n.split(".")[0] in FORBIDDEN_IN_NODES]


@every_node_file
def test_units_below_node_below_the_families(path):
    names = {n for n, _ in parsed(path) if n.startswith("neusee.nodes")}
    allowed = {
        "units.py": set(),
        "constants.py": set(),
        "values.py": set(),
        "_node.py": {"neusee.nodes._error_bound"},
        "_error_bound.py": set(),
    }
    if path.parent == ROOT / "nodes" and path.name in allowed:
        assert names <= allowed[path.name]


@every_file
def test_heavy_imports_wait_until_they_are_needed(path):
    if path.is_relative_to(ROOT / "nodes"):
        assert not [n for n, top in parsed(path) if top and n.split(".")[0] in HEAVY]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda p: p.name)
def test_only_calibration_imports_emcee(path):
    if path.parent.name != "calibration":
        assert not [n for n, _ in parsed(path) if n.split(".")[0] == "emcee"]


LADDER = ["_marks", "_graph", "_keys", "_store", "_place", "_recipe", "_run", "cli"]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda p: p.name)
def test_no_room_of_workflows_imports_one_above_it(path):
    if path.stem not in LADDER:
        return
    above = set(LADDER[LADDER.index(path.stem) + 1 :]) - {"_keys", "_store", "_place", "_graph"}
    used = {n.split(".")[2] for n, _ in parsed(path) if n.startswith("neusee.workflows.")}
    assert not used & above


def test_importing_every_node_loads_nothing_heavy():
    families = sorted(p.parent.name for p in ROOT.glob("nodes/*/__init__.py"))
    lines = "; ".join(f"import neusee.nodes.{f}" for f in families)
    heavy = f"sorted(set(m.split('.')[0] for m in sys.modules) & {HEAVY | {'emcee', 'ruamel', 'typer'}!r})"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {lines}; print({heavy})"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT / "tests",
        env={"PYTHONPATH": str(ROOT / ".src"), "PATH": ""},
    )
    assert done.stdout.strip() == "[]"
