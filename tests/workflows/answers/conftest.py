import importlib.util
from pathlib import Path

import pytest

from neusee.workflows.answers import witnesses as opened_files
from neusee.workflows.engine.provenance import versions


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A command with a recipe and files of its own, whose answer is already stored."""
    spec = importlib.util.spec_from_file_location(
        "answered", Path(__file__).with_name("answered.py")
    )
    answered = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(answered)
    versions()  # kept for the whole process, and not those of the packages that are made up here
    found = answered.Place(tmp_path, monkeypatch)
    assert found.again()
    assert not found.again()
    yield found
    opened_files._listeners.clear()
