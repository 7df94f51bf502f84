"""What every node owes: documented shapes, units, errors and source; typed parameters; a small
size.
"""

import ast
import importlib
import inspect
import pkgutil
from pathlib import Path

import pytest

import neusee.nodes
from neusee.nodes import Node

ROOT = Path(__file__).parents[2]
MODULES = [
    importlib.import_module(m.name)
    for m in pkgutil.walk_packages(neusee.nodes.__path__, "neusee.nodes.")
]
NODES = sorted(
    {
        n
        for m in MODULES
        for n in vars(m).values()
        if isinstance(n, Node) and n.__module__ == m.__name__
    },
    key=lambda n: n.path,
)
FILES = sorted([*ROOT.glob("nodes/**/*.py"), *ROOT.glob("workflows/**/*.py")])


def test_the_walk_finds_the_families():
    assert {n.path.split(".")[0] for n in NODES} >= {
        "sensor",
        "optics",
        "metrics",
        "losses",
        "restore",
    }
    assert len({n.path for n in NODES}) == len(NODES)


def test_docstring_begins_with_one_sentence_of_physics():
    for node in NODES:
        first = inspect.getdoc(node.fn).split("\n\n")[0]
        assert first.endswith("."), f"{node.path}: the first paragraph is a sentence"
        assert first[0].isupper(), node.path
        assert len(first) <= 240, f"{node.path}: one sentence, not a story"


@pytest.mark.parametrize("word", ["Shapes:", "Units:", "Error:", "Source:"])
def test_docstring_names(word):
    for node in NODES:
        lines = [
            line for line in (inspect.getdoc(node.fn) or "").splitlines() if line.startswith(word)
        ]
        assert len(lines) == 1, f"{node.path}: one line that begins with {word}"
        assert len(lines[0].removeprefix(word).strip()) >= 2, node.path


def test_a_node_that_raises_says_so():
    for node in NODES:
        raises = any(
            isinstance(item, ast.Raise) for item in ast.walk(ast.parse(inspect.getsource(node.fn)))
        )
        assert not raises or "Raises:" in node.__doc__, node.path


def test_every_argument_is_annotated_and_the_model_of_parameters_builds():
    for node in NODES:
        for name in inspect.signature(node.fn).parameters:
            assert name in node.hints, f"{node.path}: {name} has no annotation"
        assert "return" in node.hints, node.path
        assert set(node.params.model_fields) == {p.name for p in node._keyword_only}, node.path


def test_the_family_exports_its_node():
    for node in NODES:
        family = importlib.import_module(f"neusee.nodes.{node.path.split('.')[0]}")
        assert getattr(family, node.fn.__name__) is node
        assert node.fn.__name__ in family.__all__, node.path


def test_hooks_take_what_the_node_takes():
    for node in NODES:
        own = set(inspect.signature(node.fn).parameters)
        for hook in (
            node.hooks.reference,
            node.hooks.skip_bound,
            node.hooks.preflight,
            node.hooks.shape,
            node.hooks.check,
        ):
            taken = {} if hook is None else inspect.signature(hook).parameters
            for p in taken.values():
                known = (
                    p.name in own
                    or p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
                    or p.name == "result"
                )
                assert known or p.kind is not p.KEYWORD_ONLY, (
                    f"{node.path}: a hook asks for {p.name}"
                )


def test_rules_for_shapes_are_used_by_nothing_that_computes_a_result():
    """No cache key covers a file of rules, so only the family imports the file, to attach the
    rules to its nodes.
    """
    for path in ROOT.glob("nodes/**/*.py"):
        imported = {
            name
            for item in ast.walk(ast.parse(path.read_text()))
            if isinstance(item, ast.ImportFrom)
            for name in (item.module, *(f"{item.module}.{alias.name}" for alias in item.names))
        }
        assert path.name == "_result_shapes.py" or "neusee.nodes.shape_rules" not in imported, path
        assert path.name == "__init__.py" or not [
            n for n in imported if n.endswith("._result_shapes")
        ], path


#: hooks that are called with the parameters of their node by name
WITH_PARAMETERS = (
    "skip_bound", "skip_draw", "skip_scale", "zero_bound", "propagate_error", "propagate_draw", "propagate_scattered",
    "rounding_error", "preflight", "check", "shape", "expected_range", "work",
)  # fmt: skip


@pytest.mark.parametrize("node", NODES, ids=lambda node: node.path)
def test_a_hook_takes_every_parameter_of_its_node(node):
    """A hook that does not would fail when it is called, and its shape, plan or bound would be
    lost without a word.
    """
    for hook in WITH_PARAMETERS:
        function = getattr(node.hooks, hook)
        if function is None:
            continue
        parameters = inspect.signature(function).parameters.values()
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            taken = {parameter.name for parameter in parameters}
            assert set(node.params.model_fields) <= taken, hook
