"""Pictures and data files of a run, made while later steps compute.

A file is made as soon as the last of its results is there. One thread writes data files, and another leaves pictures
to the process that draws, so that neither waits for the other. What is made so is found by its key when the report is
written, and the report makes what is missing; an error is met there again. So nothing of the report depends on this
module but its time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from neusee.workflows.engine.memory_use import process_memory
from neusee.workflows.engine.memory_watch import MemoryLimit
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.report import drawing_process
from neusee.workflows.report.contents import wanted
from neusee.workflows.report.drawing_process import DrawingProcess
from neusee.workflows.report.requirements import Missing
from neusee.workflows.report.run_pictures import DerivedFile, Drawing, arguments_of, key_of_file
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.serialization import tensors_in

LARGE = 1 << 26  #: bytes; a larger result is held only for files that need nothing else any more
_SMALL = 1 << 22  #: bytes of a result that is held in any case
ROOM = 1 << 27  #: bytes of smaller results that are held for files


class FilesBeside:
    """Files that are made beside a run; call the object with each result of the run.

    Args: files: the files of a recipe. limit: bytes of memory that the process may use; of these, an eighth at most is
    held for files, no more than `ROOM` beside one large result, and nothing once half of the limit is in use. With 0
    no file is made beside the run.
    """

    def __init__(self, files: Callable[[Recipe], Iterable[DerivedFile]], shelf: DerivedFiles, limit: float) -> None:
        self._files, self._shelf = files, shelf
        self._large, self._room = min(LARGE, limit / 32), min(ROOM, limit / 16)
        self._limit = limit
        self._recipe: Recipe | None = None
        self._code = Code(shelf.store.code_memo)
        self._open: list[tuple[DerivedFile, frozenset[str]]] = []  # files to make, and the steps that they show
        self._held: dict[str, Any] = {}
        self._busy: set[str] = set()  # files of large results that are being written
        self._writes = ThreadPoolExecutor(1, "neusee files")
        self._draws = ThreadPoolExecutor(1, "neusee pictures")
        self._drawer: DrawingProcess | None = None
        self._begun: list[tuple[Future[None], _Job]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for threads in (self._writes, self._draws):
            threads.shutdown(wait=True, cancel_futures=True)
        if self._drawer is not None:
            self._drawer.close()

    def __call__(self, recipe: Recipe, keys: Mapping[str, Key], step: str, value: Any) -> None:
        """Hold the result of a step as long as files need it, and begin the files that need no other result."""
        if self._limit <= 0:
            return
        if recipe is not self._recipe:  # the first result, or a run that begins again with a smaller tolerance
            self._begin(recipe)
        shown = {name for _, steps in self._open for name in steps}
        names = [name for name in shown if keys.get(name) == keys[step]]
        size = _bytes_of(value)
        if not names or (size > self._large and (self._busy or size > self._limit / 16)):
            return  # the report makes the files of this result
        if size > _SMALL and process_memory() > self._limit / 2:
            return
        self._held.update(dict.fromkeys(names, value))
        for file, steps in [job for job in self._open if job[1] <= self._held.keys()]:
            self._open.remove((file, steps))
            self._submit(file, recipe, {name: keys[name] for name in steps})
        self._let_go(names if size > self._large or _bytes_of(list(self._held.values())) > self._room else ())

    def add(self, name: str, key: str, make: Callable[..., None], arguments: Mapping[str, Any]) -> None:
        """Begin a picture that shows no result of a step."""
        if self._drawer is not None:
            self._start(_Job(name, key, ".png", make, arguments), self._draws)

    def draw(self, path: Path, make: Callable[..., None], arguments: Mapping[str, Any]) -> Callable[[], None]:
        """Begin a picture that is not stored; return a function that waits for the picture.

        That function draws the picture itself if the process that draws is missing, is busy with another, or failed.
        """
        drawer = self._drawer
        begun = None if drawer is None else self._draws.submit(drawer.make, path, make, arguments)

        def wait() -> None:
            if begun is None or (_draws_at_once() and begun.cancel()) or begun.exception() is not None:
                make(path, **arguments)

        return wait

    def finish(self) -> None:
        """Wait for the files that were begun, and hold no result any more.

        The last pictures are drawn here while the process that draws is busy with others.
        """
        for begun, job in reversed(self._begun):
            if isinstance(job.make, Drawing) and _draws_at_once() and begun.cancel():
                try:
                    self._make(job, None)
                except MemoryLimit:
                    raise
                except Exception:  # the report meets the error again
                    continue
        for begun, _ in self._begun:
            with suppress(Exception, CancelledError):
                begun.result()
        self._begun, self._open, self._held = [], [], {}

    def _begin(self, recipe: Recipe) -> None:
        self._recipe, self._held, self._open = recipe, {}, []
        known = dict.fromkeys(needed(recipe, wanted(recipe)), "")
        for file in self._files(recipe):
            with suppress(Missing):
                found = arguments_of(file.needs, recipe, known, self._code, self._shelf.store)
                steps = frozenset(step for each in found.values() for step in each.steps)
                if steps and not file.only_tables:
                    self._open.append((file, steps))
        if self._open and self._drawer is None and drawing_process.possible():
            with suppress(OSError):  # no memory or no permission for a fork
                self._drawer = DrawingProcess()

    def _let_go(self, names: Iterable[str]) -> None:
        """Hold no result longer that no file needs, and none of the steps ``names``."""
        still = {name for _, steps in self._open for name in steps} - set(names)
        self._held = {name: value for name, value in self._held.items() if name in still}

    def _submit(self, file: DerivedFile, recipe: Recipe, keys: Mapping[str, Key]) -> None:
        found = arguments_of(file.needs, recipe, keys, self._code, self._shelf.store)
        arguments = {name: each.make(self._held) for name, each in found.items()}
        large = _bytes_of(list(arguments.values())) > drawing_process.MOST
        drawing = isinstance(file.make, Drawing)
        if drawing and (large or self._drawer is None):
            return
        job = _Job(file.name, key_of_file(file, found), file.suffix, file.make, arguments, large or file.copied)
        begun = self._start(job, self._draws if drawing else self._writes)
        if large:
            self._busy.add(file.name)
            begun.add_done_callback(lambda _: self._busy.discard(file.name))

    def _start(self, job: _Job, threads: ThreadPoolExecutor) -> Future[None]:
        begun = threads.submit(self._make, job, None if job.here else self._drawer)
        self._begun.append((begun, job))
        return begun

    def _make(self, job: _Job, drawer: DrawingProcess | None) -> None:
        """Write a file here, or let a process write it."""
        arguments, job.arguments = job.arguments, {}  # so that this object does not hold them until the end
        if self._shelf.find(job.key, job.suffix) is not None:
            return

        def write(path: Path) -> None:
            if drawer is None:
                job.make(path, **arguments)
            else:
                drawer.make(path, job.make, arguments)

        self._shelf.keep(job.key, job.suffix, job.name, write)


@dataclass(slots=True)
class _Job:
    """A file to be made; ``here`` is True for one that this process writes itself."""

    name: str
    key: str
    suffix: str
    make: Callable[..., None]
    arguments: Mapping[str, Any]
    here: bool = False


def _draws_at_once() -> bool:
    """Return True if this process has imported what drawing needs; the import takes longer than a picture."""
    return "matplotlib.figure" in sys.modules


def _bytes_of(value: Any) -> int:
    return sum(x.nbytes for x in tensors_in(value))
