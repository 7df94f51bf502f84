"""What the program imports late: the names that a type checker sees are those that there are."""

import ast
from pathlib import Path

import pytest

from neusee.workflows.cli import lazy_imports as lazy


def declared():
    """The modules below neusee that the file imports for types."""
    tree = ast.parse(Path(lazy.__file__).read_text())
    for item in ast.walk(tree):
        if isinstance(item, ast.ImportFrom) and item.module.startswith("neusee."):
            yield f"{item.module}.{item.names[0].name}"


def test_every_module_that_is_declared_is_imported_under_its_name():
    names = list(declared())
    assert names
    for name in names:
        assert getattr(lazy, name.rpartition(".")[2]).__name__ == name


def test_no_other_name_is_there():
    with pytest.raises(AttributeError, match="has no attribute 'gone'"):
        lazy.gone  # noqa: B018
