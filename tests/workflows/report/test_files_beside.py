"""Files that are made beside the run are those that the report makes, and every failure is left to the report."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from neusee.nodes import node
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.diagnostics import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.report import drawing_process, files_beside
from neusee.workflows.report.drawing_process import DrawingProcess, NotDrawn
from neusee.workflows.report.files_beside import FilesBeside
from neusee.workflows.report.run_pictures import DerivedFile, Drawing, files_of
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.result_store import Store


@node()
def first_beside(*, side: int) -> torch.Tensor:
    """Return a picture.

    Shapes: (y, x). Units: none. Error: exact. Raises: nothing. Source: none.
    """
    return torch.arange(float(side * side)).reshape(side, side)


@node()
def second_beside(image: torch.Tensor) -> torch.Tensor:
    """Return a picture that is twice as bright.

    Shapes: (y, x). Units: none. Error: exact. Raises: nothing. Source: none.
    """
    return 2 * image


def recipe(side: int = 8) -> Recipe:
    here, second = Location("small.yaml", 1, 1), {"image": "first"}
    steps = {
        "first": Step("first", first_beside, {"side": side}, {}, here, {}),
        "second": Step("second", second_beside, {}, second, here, {}),
    }
    return Recipe("small", "small", 0, 0.0, ("second",), steps)


def sums(path: Path, /, **values: torch.Tensor) -> None:
    path.write_text(f"{os.getpid()} {sum(float(x.sum()) for x in values.values()):.0f}")


def breaks(path: Path, /, **values: torch.Tensor) -> None:
    path.write_text("half")
    raise ValueError("it cannot be drawn")


def files(make=sums, **more: str):
    needs = [
        ("one", {"x": "first"}),
        ("both", {"x": "first", "y": "second"}),
        *((n, {"x": s}) for n, s in more.items()),
    ]
    return [DerivedFile(name, ".txt", ("test", name), need, make) for name, need in needs]


def result_of(tmp_path, made, side=8, limit=1e12):
    store = Store(tmp_path / "cache")
    shelf = DerivedFiles(store)
    with FilesBeside(lambda _: made, shelf, limit) as beside:
        result = run(recipe(side), store, show=beside)
        beside.finish()
        early = sorted(path.name for path in shelf.folder.rglob("*.txt"))
    return files_of(made, result, shelf), early


def texts(paths: dict[str, Path]) -> dict[str, str]:
    return {name: path.read_text().split()[1] for name, path in paths.items()}


@pytest.fixture
def forks(monkeypatch):
    monkeypatch.setattr(drawing_process, "possible", lambda: sys.platform == "linux")
    if sys.platform != "linux":
        pytest.skip("pictures are drawn in a fork only on Linux")


def test_files_are_made_before_the_report_and_in_the_process_that_draws(tmp_path, forks):
    (paths, missing), early = result_of(tmp_path, files())
    assert (texts(paths), missing, len(early)) == ({"one": "2016", "both": "6048"}, {}, 2)
    makers = {path.read_text().split()[0] for path in paths.values()}
    assert len(makers) == 1
    assert str(os.getpid()) not in makers


def test_without_a_fork_the_same_files_are_made_here(tmp_path):
    (paths, missing), early = result_of(tmp_path, files())
    assert (texts(paths), missing, len(early)) == ({"one": "2016", "both": "6048"}, {}, 2)
    assert {path.read_text().split()[0] for path in paths.values()} == {str(os.getpid())}


def test_no_memory_means_no_file_before_the_report(tmp_path):
    (paths, _), early = result_of(tmp_path, files(), limit=0.0)
    assert texts(paths) == {"one": "2016", "both": "6048"}
    assert early == []


def test_a_large_result_is_held_only_for_files_that_need_nothing_else(tmp_path, monkeypatch):
    monkeypatch.setattr(files_beside, "LARGE", 100)
    (paths, _), early = result_of(tmp_path, files())
    assert texts(paths) == {"one": "2016", "both": "6048"}
    assert len(early) == 1  # the file of the first result alone


@pytest.mark.parametrize("forked", [True, False])
def test_an_error_is_met_again_by_the_report(tmp_path, request, forked):
    if forked:
        request.getfixturevalue("forks")
    (paths, missing), early = result_of(tmp_path, files(breaks))
    assert (paths, early) == ({}, [])
    assert missing == {"one": "it cannot be drawn", "both": "it cannot be drawn"}
    assert not list((tmp_path / "cache" / "files").rglob("*.txt"))


def test_a_process_that_was_killed_is_not_waited_for(tmp_path, forks):
    drawer = DrawingProcess()
    drawer.make(tmp_path / "a", sums, {"x": torch.ones(3)})
    os.kill(drawer._process.pid, signal.SIGKILL)
    with pytest.raises(NotDrawn, match="ended"):
        drawer.make(tmp_path / "b", sums, {"x": torch.ones(3)})
    drawer.close()


def test_what_is_large_or_no_data_is_not_sent(tmp_path, forks, monkeypatch):
    drawer = DrawingProcess()
    monkeypatch.setattr(drawing_process, "MOST", 10)
    with pytest.raises(NotDrawn, match="large"):
        drawer.make(tmp_path / "b", sums, {"x": torch.ones(3)})
    with pytest.raises(NotDrawn):
        drawer.make(tmp_path / "b", sums, {"x": lambda: None})
    drawer.close()
    assert not drawer._process.is_alive()


def test_the_process_that_draws_ends_with_a_run_that_is_killed(tmp_path, forks):
    code = (
        "from neusee.workflows.report.drawing_process import DrawingProcess\n"
        "import time\nprint(DrawingProcess()._process.pid, flush=True)\ntime.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        child = int(parent.stdout.readline())
        parent.kill()
    for _ in range(200):
        if not Path(f"/proc/{child}").exists() or ") Z " in Path(f"/proc/{child}/stat").read_text():
            return
        time.sleep(0.05)
    os.kill(child, signal.SIGKILL)
    pytest.fail("the process that draws outlived the run")


def test_a_drawing_is_sent_by_its_name(tmp_path, forks):
    drawer = DrawingProcess()
    drawing = Drawing("report.figures.recipe_graph:graph")
    drawer.make(tmp_path / "g.png", drawing, {"sources": {"a": []}, "states": {"a": "run"}})
    drawer.close()
    assert (tmp_path / "g.png").read_bytes().startswith(b"\x89PNG")
