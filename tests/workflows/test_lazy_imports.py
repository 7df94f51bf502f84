"""What a room imports late: the modules that a type checker sees are those that there are."""

import ast
import importlib
from pathlib import Path

import pytest

ROOMS = ("api", "cli", "recipe", "store")


def late(room):
    return importlib.import_module(f"neusee.workflows.{room}.lazy_imports")


def declared(module):
    """The modules of neusee that a file imports for types."""
    tree = ast.parse(Path(module.__file__).read_text())
    for item in ast.walk(tree):
        if isinstance(item, ast.ImportFrom) and item.module.startswith("neusee."):
            yield f"{item.module}.{item.names[0].name}"


@pytest.mark.parametrize("room", ROOMS)
def test_every_module_that_is_declared_is_imported_under_its_name(room):
    names = list(declared(late(room)))
    assert names
    for name in names:
        assert getattr(late(room), name.rpartition(".")[2]).__name__ == name


@pytest.mark.parametrize("room", ROOMS)
def test_no_other_name_is_there(room):
    with pytest.raises(AttributeError, match="has no attribute 'gone'"):
        late(room).gone  # noqa: B018
