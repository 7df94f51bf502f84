import importlib.util
import sys
from pathlib import Path

import pytest


@pytest.fixture
def toy(monkeypatch):
    """The family ``toy`` of nodes, as if it were one of the package."""
    name = "neusee.nodes.toy"
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name("toy_nodes.py"))
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def write(tmp_path):
    """Write a file of YAML below a folder of its own and give its path."""

    def write(text, name="mine.yaml"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def read(toy, write, tmp_path):
    """Load a recipe of toy nodes from its text and arguments."""
    from neusee.workflows.recipe.loading import load

    return lambda text, *arguments: load(write(text), arguments, tmp_path)


@pytest.fixture
def mistakes(read):
    """What a recipe of toy nodes is refused with: one line each, with single spaces between the
    columns.
    """
    from neusee.workflows.graph.errors import RecipeError

    def mistakes(text, *arguments):
        with pytest.raises(RecipeError) as caught:
            read(text, *arguments)
        return [
            " | ".join(filter(None, (str(p.mark), p.path, p.message)))
            for p in caught.value.diagnostics
        ]

    return mistakes


@pytest.fixture
def one_thread():
    """What is computed is over before a second thread is awake."""
    from neusee.workflows.engine.local_executor import one_thread

    with one_thread():
        yield


@pytest.fixture(autouse=True)
def one_worker(monkeypatch):
    """A test computes in its own process unless it asks for several workers, whatever the load
    of the machine.
    """
    from neusee.workflows.engine import worker_processes

    monkeypatch.setattr(worker_processes, "free_processors", lambda: 1)


@pytest.fixture(autouse=True)
def no_fault_in_any_figure(monkeypatch):
    """Every figure that the program draws in a test has panels with content, and texts that can
    be read.
    """
    from neusee.workflows.report import files_beside as drawing_process
    from neusee.workflows.report.figures import style
    from tests.figure_faults import watched

    save, found = style.png_of, []

    def saved(figure):
        watched(figure, found)
        return save(figure)

    monkeypatch.setattr(style, "png_of", saved)
    # pictures of another process are not seen here
    monkeypatch.setattr(drawing_process, "possible", lambda: False)
    yield
    assert found == []


@pytest.fixture(autouse=True)
def no_fault_in_any_crate(monkeypatch):
    """Every crate that the program writes in a test keeps the rules of RO-Crate."""
    from neusee.workflows.report import run_crate
    from tests.workflows.crate_rules import faults

    write, found = run_crate._write, []

    def written(folder, crate):
        write(folder, crate)
        found.extend(faults(folder))

    monkeypatch.setattr(run_crate, "_write", written)
    yield
    assert found == []
