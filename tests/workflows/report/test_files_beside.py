"""Files that are made beside the run are those that the report makes, and every failure is left
to the report.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neusee.nodes import node
from neusee.workflows.engine.machine_resources import MemoryLimit
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step, StepRecord
from neusee.workflows.report import files_beside
from neusee.workflows.report.contents import Bound
from neusee.workflows.report.files_beside import DrawingProcess, FilesBeside, GraphAhead, NotDrawn
from neusee.workflows.report.run_pictures import DerivedFile, Drawing, files_of, graphs, states_of
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.result_store import Store

HERE = os.getpid()
GATE: list[str] = []  #: path of the file that pictures of the other process wait for


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
    monkeypatch.setattr(files_beside, "possible", lambda: sys.platform == "linux")
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
    monkeypatch.setattr(files_beside, "LARGE_RESULT", 100)
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
    monkeypatch.setattr(files_beside, "MOST_PIPE_BYTES", 10)
    with pytest.raises(NotDrawn, match="large"):
        drawer.make(tmp_path / "b", sums, {"x": torch.ones(3)})
    with pytest.raises(NotDrawn):
        drawer.make(tmp_path / "b", sums, {"x": lambda: None})
    drawer.close()
    assert not drawer._process.is_alive()


@pytest.mark.slow
def test_the_process_that_draws_ends_with_a_run_that_is_killed(tmp_path, forks):
    code = (
        "from neusee.workflows.report.files_beside import DrawingProcess\n"
        "import time\nprint(DrawingProcess()._process.pid, flush=True)\ntime.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True
    ) as parent:
        child = int(parent.stdout.readline())
        parent.kill()
    for _ in range(6000):
        if _has_ended(child):
            return
        time.sleep(0.05)
    os.kill(child, signal.SIGKILL)
    pytest.fail("the process that draws outlived the run")


def _has_ended(pid: int) -> bool:
    try:
        return ") Z " in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return True


def test_a_drawing_is_sent_by_its_name(tmp_path, forks):
    drawer = DrawingProcess()
    drawing = Drawing("report.figures.graph_and_timeline:graph")
    drawer.make(tmp_path / "g.png", drawing, {"sources": {"a": []}, "states": {"a": "run"}})
    drawer.close()
    assert (tmp_path / "g.png").read_bytes().startswith(b"\x89PNG")


def test_two_threads_take_turns_with_the_process_that_draws(tmp_path, forks):
    drawer = DrawingProcess()
    with ThreadPoolExecutor(4) as threads:
        made = [
            threads.submit(drawer.make, tmp_path / str(n), sums, {"x": torch.full((9,), n)})
            for n in range(40)
        ]
        for each in made:
            each.result(60)
    drawer.close()
    assert [(tmp_path / str(n)).read_text().split()[1] for n in range(40)] == [
        str(9 * n) for n in range(40)
    ]


@pytest.mark.slow
def test_a_thread_that_waits_is_the_next(tmp_path, forks):
    drawer, order, entered = DrawingProcess(), [], []
    drawer._next = NotedDoor(drawer._next, lambda: entered.append(len(order)))

    def pictures():
        for n in range(30):
            drawer.make(tmp_path / f"picture{n}", short, {"x": torch.ones(3)})
            order.append("picture")

    with ThreadPoolExecutor(1) as threads:
        drawing = threads.submit(pictures)
        waited = []
        while not drawing.done() and len(waited) < 8:
            drawer.make(tmp_path / "file", sums, {"x": torch.ones(3)})
            waited.append(len(order) - entered[-1])
            time.sleep(0.03)
        drawing.result(60)
    drawer.close()
    assert max(waited) <= 2  # the picture that is drawn, and one that was asked for before


class NotedDoor:
    """A lock that notes when the main thread has it."""

    def __init__(self, lock, note):
        self.lock, self.note = lock, note

    def __enter__(self):
        self.lock.acquire()
        if threading.current_thread() is threading.main_thread():
            self.note()

    def __exit__(self, *error):
        self.lock.release()


def short(path: Path, /, **values: torch.Tensor) -> None:
    time.sleep(0.1)
    sums(path, **values)


def slow(path: Path, /, **values: torch.Tensor) -> None:
    """Draw a picture, in the other process not before one was drawn in this process, if a `GATE`
    is named.
    """
    _pass_the_gate()
    sums(path, **values)


def _pass_the_gate() -> None:
    """Open the gate in this process, and wait for it in the process that draws."""
    if GATE and os.getpid() == HERE:
        Path(GATE[0]).touch()
    ends = time.monotonic() + 300
    while GATE and not Path(GATE[0]).exists():
        assert time.monotonic() < ends, "nothing is drawn in the other process"
        time.sleep(0.005)


@pytest.fixture
def gate(tmp_path, monkeypatch):
    """Hold back the pictures of the other process until the file is there."""
    monkeypatch.setattr(sys.modules[__name__], "GATE", [str(tmp_path / "gate")])
    return tmp_path / "gate"


def test_a_data_file_does_not_wait_for_pictures(tmp_path, forks, monkeypatch, gate):
    monkeypatch.setattr(files_beside, "Drawing", type(slow))  # functions count as pictures here
    copies = replace(files(Sums())[1], copied=True)
    shelf = DerivedFiles(Store(tmp_path / "cache"))
    with FilesBeside(lambda _: [*files(slow), copies], shelf, 1e12) as beside:
        run(recipe(), shelf.store, show=beside)
        copied = [begun for begun, job in beside._begun if job.here]
        copied[0].result(60)
        assert [begun.done() for begun, job in beside._begun if not job.here] == [False, False]
        gate.touch()


class Sums:
    """A function that is no picture."""

    def __call__(self, path: Path, /, **values: torch.Tensor) -> None:
        sums(path, **values)


def test_the_last_pictures_are_drawn_here_while_the_other_process_is_busy(
    tmp_path, forks, monkeypatch
):
    monkeypatch.setattr(files_beside, "Drawing", type(slow))
    makers = {}
    for imported in (True, False):
        monkeypatch.setattr(
            sys.modules[__name__], "GATE", [str(tmp_path / "gate")] if imported else []
        )
        monkeypatch.setattr(files_beside, "_draws_at_once", lambda imported=imported: imported)
        (paths, missing), early = result_of(tmp_path / str(imported), files(slow))
        assert (texts(paths), missing, len(early)) == ({"one": "2016", "both": "6048"}, {}, 2)
        makers[imported] = {
            name: path.read_text().split()[0] == str(os.getpid()) for name, path in paths.items()
        }
    assert makers == {True: {"one": False, "both": True}, False: {"one": False, "both": False}}


def test_the_report_makes_the_files_of_a_process_that_was_killed_during_the_run(tmp_path, forks):
    shelf = DerivedFiles(Store(tmp_path / "cache"))
    with FilesBeside(lambda _: files(), shelf, 1e12) as beside:

        def show(*shown):
            beside(*shown)
            os.kill(beside._drawer._process.pid, signal.SIGKILL)

        result = run(recipe(), shelf.store, show=show)
        beside.finish()
    paths, missing = files_of(files(), result, shelf)
    assert (texts(paths), missing) == ({"one": "2016", "both": "6048"}, {})


def exceeds(path: Path, /, **values: torch.Tensor) -> None:
    _pass_the_gate()
    if os.getpid() == HERE:
        raise MemoryLimit
    sums(path, **values)


@pytest.mark.parametrize("error", [MemoryLimit, ValueError])
def test_too_little_memory_ends_the_report_and_other_errors_are_met_again(
    tmp_path, forks, monkeypatch, gate, error
):
    monkeypatch.setattr(files_beside, "Drawing", type(slow))
    monkeypatch.setattr(files_beside, "_draws_at_once", lambda: True)
    shelf = DerivedFiles(Store(tmp_path / "cache"))
    with FilesBeside(
        lambda _: files(exceeds if error is MemoryLimit else breaks), shelf, 1e12
    ) as beside:
        run(recipe(), shelf.store, show=beside)
        beside.add(
            "late", "0" * 32, exceeds if error is MemoryLimit else breaks, {"x": torch.ones(3)}
        )
        with pytest.raises(MemoryLimit) if error is MemoryLimit else nullcontext():
            beside.finish()


def test_a_picture_that_is_not_stored_is_drawn_in_any_case(tmp_path, forks):
    shelf, ones = DerivedFiles(Store(tmp_path / "cache")), {"x": torch.ones(3)}
    with FilesBeside(lambda _: files(), shelf, 1e12) as beside:
        beside.draw(tmp_path / "before", sums, ones)()  # no process draws yet
        run(recipe(), shelf.store, show=beside)
        beside.finish()
        wait = beside.draw(tmp_path / "there", sums, ones)
        wait()
        os.kill(beside._drawer._process.pid, signal.SIGKILL)
        beside.draw(tmp_path / "killed", sums, ones)()
        with pytest.raises(ValueError, match="it cannot be drawn"):
            beside.draw(tmp_path / "wrong", breaks, ones)()
    here = {name: (tmp_path / name).read_text().split() for name in ("before", "there", "killed")}
    assert {total for _, total in here.values()} == {"3"}
    assert [pid == str(os.getpid()) for pid, _ in here.values()] == [True, False, True]


def test_what_a_picture_shows_is_not_held_after_it_is_drawn(tmp_path, forks):
    shelf = DerivedFiles(Store(tmp_path / "cache"))
    with FilesBeside(lambda _: files(), shelf, 1e12) as beside:
        run(recipe(), shelf.store, show=beside)
        for begun, job in beside._begun:
            begun.result(60)
            assert job.arguments == {}


def test_a_function_of_a_step_is_sent_by_its_name(tmp_path, forks):
    step = recipe().steps["second"]
    drawer = DrawingProcess()
    drawer.make(tmp_path / "f", applied, {"step": Bound(step), "x": torch.ones(4)})
    drawer.close()
    assert (tmp_path / "f").read_text() == "8"


def applied(path: Path, /, *, step: Bound, x: torch.Tensor) -> None:
    path.write_text(f"{float(step(x).sum()):.0f}")


@pytest.mark.parametrize("wrong", [False, True])
def test_the_graph_is_begun_when_it_can_be_foreseen(tmp_path, forks, wrong):
    drawn, done = [], {}
    shelf = DerivedFiles(Store(tmp_path / "cache"))
    with FilesBeside(lambda _: files(), shelf, 1e12) as beside:
        graph = GraphAhead(beside, shelf.store, done)

        def watch(event):
            if event.done is not None:
                done[event.step] = event.done

        def show(*shown):
            beside(*shown)
            if wrong:  # as if another process had stored the result meanwhile
                done["second"] = StepRecord("second", "cached", "", 0.0, "")
            graph(*shown)
            drawn.append([job.key for _, job in beside._begun if job.name == "graph"])

        result = run(recipe(), shelf.store, watch=watch, show=show)
        beside.finish()
        needed = [key for key, _ in graphs(result.recipe, states_of(result.done))]
        assert len(drawn[0]) == 2  # with the first result, before the second step ran
        assert (drawn[0] == needed) is not wrong
        assert drawn[0][1] == needed[1]
        assert all(shelf.find(key, ".png") for key in drawn[0])
