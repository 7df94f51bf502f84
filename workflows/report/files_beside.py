"""Pictures and data files of a run, made in parallel while later steps compute."""

from __future__ import annotations

import gc
import itertools
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self

import torch

from neusee.workflows.engine.machine_resources import MemoryLimit, process_memory
from neusee.workflows.engine.wanted_steps import wanted
from neusee.workflows.engine.worker_processes import deaf_fork, ignore_interrupts
from neusee.workflows.graph.recipe_graph import Recipe, StepRecord, needed
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.report.contents import Missing
from neusee.workflows.report.figures import style
from neusee.workflows.report.run_pictures import (
    GRAPH_DRAWING,
    DerivedFile,
    Drawing,
    arguments_of,
    graphs,
    key_of_file,
    states_of,
    steps_of,
)
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import pack, tensors_in, unpack

# --- drawing process ------------------------------------------------------------------------------

# A second process, forked from that of the run, which draws pictures and encodes images while the
# steps of the run compute.
#
# matplotlib holds the lock of the interpreter, so that a thread that draws would stop the steps.
# The process is a fork of the run at its start, with one thread, so that it imports nothing again;
# it reads its jobs from a pipe, and ends when the run does. Where a fork is not safe, or for
# another reason no process answers, the run draws its pictures itself.


MOST_PIPE_BYTES = 1 << 27  #: bytes; largest size of the arguments of a picture in the pipe
_PATIENCE = 120.0  #: s for one picture, after which the process counts as lost
_WORDS = (str, int, float, Path, type(None))


class NotDrawn(RuntimeError):
    """Error for a picture that the process did not draw; the run then draws the picture itself."""


def possible() -> bool:
    """Return True if this process may fork, and has a second processor for the fork."""
    return sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1


class DrawingProcess:
    """A forked process that writes one picture at a time; `close` ends the process."""

    def __init__(self) -> None:
        """Fork the process that draws; raise `OSError` if memory or permission is lacking."""
        # a second thread waits until the file of the first is written
        self._turn = threading.Lock()
        # it is then the next, before the first thread asks again
        self._next = threading.Lock()
        context = multiprocessing.get_context("fork")
        self._pipe, far_end = context.Pipe()
        # Python 3.12 warns of each fork in a process with several threads
        with warnings.catch_warnings(), deaf_fork():
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process = context.Process(
                target=_serve, args=(far_end, self._pipe), name="neusee draws", daemon=True
            )
            self._process.start()
        far_end.close()

    def make(self, path: Path, make: Callable[..., None], arguments: Mapping[str, Any]) -> None:
        """Let the process call ``make(path, **arguments)``; raise `NotDrawn` if the call failed
        or was not made.
        """
        with self._next:
            self._turn.acquire()
        try:
            self._ask(_sent(path, make, arguments))
        finally:
            self._turn.release()

    def _ask(self, job: bytes) -> None:
        """Send a job and wait until it is done."""
        try:
            self._pipe.send_bytes(job)
            if not self._pipe.poll(_PATIENCE):
                self.close()
                raise NotDrawn(f"no answer within {_PATIENCE:.0f} s")
            failed = self._pipe.recv_bytes().decode()
        except (OSError, EOFError) as error:
            self.close()
            raise NotDrawn(f"the process that draws has ended: {error}") from error
        if failed:
            raise NotDrawn(failed)

    def close(self) -> None:
        """End the process, at once if it does not end when its pipe closes."""
        self._pipe.close()
        self._process.join(0.5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _sent(path: Path, make: Callable[..., None], arguments: Mapping[str, Any]) -> bytes:
    """Return a job as bytes; raise `NotDrawn` for arguments that are too large or cannot be
    pickled.
    """
    if sum(tensor.nbytes for tensor in tensors_in(list(arguments.values()))) > MOST_PIPE_BYTES:
        raise NotDrawn("the arguments are large")
    try:
        packed = {name: _packed(value) for name, value in arguments.items()}
        return pickle.dumps((path, make, packed), protocol=5)
    except (TypeError, pickle.PicklingError, AttributeError) as error:
        raise NotDrawn(str(error)) from error


def _packed(value: Any) -> tuple[Any, list[Any], Any]:
    """Return (layout, arrays, None) for a value with tensors, or (empty layout, no arrays, value)
    for a value without tensors.

    A function that applies the node of a step is such a value; the process that draws has all
    modules of the run.
    """
    if not isinstance(value, _WORDS):
        try:
            layout, tensors = pack(value)
            return layout, [tensor.cpu().numpy() for tensor in tensors], None
        except TypeError:
            if tensors_in(value):
                raise
    # no arrays: the value goes as it is
    return pack(None)[0], [], value


def _serve(pipe: Connection, other_end: Connection) -> None:
    """Make the files that are requested through the pipe, until its other end closes."""
    other_end.close()  # else the pipe stays open when the run is killed
    # open files of the run would stay open as long as this process
    _close_all_but(pipe.fileno())
    gc.freeze()  # a search for garbage among the objects of the run would copy their memory
    ignore_interrupts()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(1)  # a forked process does not have the threads of the run
    with suppress(Exception):  # the first picture meets the error again
        style.warm()
    with suppress(EOFError, OSError), torch.no_grad():
        while True:
            job = pipe.recv_bytes()
            pipe.send_bytes(_made(job).encode())


def _close_all_but(mine: int) -> None:
    """Close every file but those of the terminal and ``mine``: a lock of the store ends when its
    last copy closes.
    """
    for name in os.listdir("/proc/self/fd"):
        if int(name) > 2 and int(name) != mine:
            with suppress(OSError):
                os.close(int(name))


def _made(job: bytes) -> str:
    """Write the file of a job; return an empty text, or why this failed."""
    try:
        path, make, packed = pickle.loads(job)
        values = {
            name: unpack(layout, [torch.from_numpy(array) for array in arrays])
            if plain_value is None
            else plain_value
            for name, (layout, arrays, plain_value) in packed.items()
        }
        make(path, **values)
    except Exception as error:  # the run meets the error again when it draws the picture itself
        return f"{type(error).__name__}: {error}"
    return ""


# --- files beside ---------------------------------------------------------------------------------

# Pictures and data files of a run, made while later steps compute.
#
# A file is made as soon as the last of its results is there. One thread writes data files, and
# another leaves pictures to the process that draws, so that neither waits for the other. Such a
# file is found by its key when the report is written, and the report makes what is missing; there
# an error occurs again. So this module changes only the time that the report takes.


#: bytes; a larger result is held only for files that need no further result
LARGE_RESULT = 1 << 26
_SMALL_RESULT = 1 << 22  #: bytes of a result that is held in any case
ROOM = 1 << 27  #: bytes of smaller results that are held for files


class FilesBeside:
    """Files that are made in parallel with a run; call the object with each result of the run.

    ``files`` returns the files of a recipe. ``limit`` is the memory in bytes that the process may
    use: at most an eighth of it is held for files, no more than `ROOM` beside one large result, and
    nothing once half of it is in use. With 0 no file is made beside the run.
    """

    def __init__(
        self, files: Callable[[Recipe], Iterable[DerivedFile]], shelf: DerivedFiles, limit: float
    ) -> None:
        self._files, self._shelf = files, shelf
        self._large, self._room = min(LARGE_RESULT, limit / 32), min(ROOM, limit / 16)
        self._limit = limit
        self._recipe: Recipe | None = None
        self._code = Code(shelf.store.code_memo)
        # files to make, and the steps that they show
        self._open: list[tuple[DerivedFile, frozenset[str]]] = []
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
        """Hold the result of a step as long as files need it, and begin the files that need no
        other result.
        """
        if self._limit <= 0:
            return
        # the first result, or a run that begins again with a smaller tolerance
        if recipe is not self._recipe:
            self._begin(recipe)
        names = [name for name in self._shown() if keys.get(name) == keys[step]]
        size = _bytes_of(value)
        if not names or self._is_too_large(size):
            return  # the report makes the files of this result
        self._held.update(dict.fromkeys(names, value))
        self._submit_complete(recipe, keys)
        is_full = size > self._large or _bytes_of(list(self._held.values())) > self._room
        # a large result is not held for files that need others too
        self._let_go(names if is_full else ())

    def _submit_complete(self, recipe: Recipe, keys: Mapping[str, Key]) -> None:
        """Begin the files whose results are all held."""
        # job[1]: the steps that the file shows
        for file, steps in [job for job in self._open if job[1] <= self._held.keys()]:
            self._open.remove((file, steps))
            self._submit(file, recipe, {name: keys[name] for name in steps})

    def _shown(self) -> set[str]:
        """Return the steps that are shown by files which are still to be made."""
        return set(itertools.chain.from_iterable(steps for _, steps in self._open))

    def _is_too_large(self, size: int) -> bool:
        """Return True if a result of ``size`` bytes is too large to be held now."""
        if size > self._large and (self._busy or size > self._limit / 16):
            return True
        return size > _SMALL_RESULT and process_memory() > self._limit / 2

    def add(
        self, name: str, key: str, make: Callable[..., None], arguments: Mapping[str, Any]
    ) -> None:
        """Begin a picture that shows no result of a step."""
        if self._drawer is not None:
            self._start(_Job(name, key, ".png", make, arguments), self._draws)

    def draw(
        self, path: Path, make: Callable[..., None], arguments: Mapping[str, Any]
    ) -> Callable[[], None]:
        """Begin a picture that is not stored; return a function that waits for the picture.

        That function draws the picture itself if the process that draws is missing, is busy with
        another, or failed.
        """
        drawer = self._drawer
        future = None if drawer is None else self._draws.submit(drawer.make, path, make, arguments)

        def wait() -> None:
            if (
                future is None
                or (_draws_at_once() and future.cancel())
                or future.exception() is not None
            ):
                make(path, **arguments)

        return wait

    def finish(self) -> None:
        """Wait for the files that were begun, and release all results.

        The last pictures are drawn here while the process that draws is busy with others.
        """
        # from the last, which would be waited for longest
        for future, job in reversed(self._begun):
            if isinstance(job.make, Drawing) and _draws_at_once() and future.cancel():
                try:
                    self._make(job, None)
                except MemoryLimit:
                    raise
                except Exception:  # the report meets the error again
                    continue
        for future, _ in self._begun:
            with suppress(Exception, CancelledError):
                future.result()
        self._begun, self._open, self._held = [], [], {}

    def _begin(self, recipe: Recipe) -> None:
        """Find the files of a recipe and the steps that they show, and start the process that
        draws.
        """
        self._recipe, self._held, self._open = recipe, {}, []
        # the keys are not known yet; only the steps are needed here
        empty_keys = dict.fromkeys(needed(recipe, wanted(recipe)), "")
        for file in self._files(recipe):
            with suppress(Missing):
                sources = arguments_of(
                    file.needs, recipe, empty_keys, self._code, self._shelf.store
                )
                steps = steps_of(sources)
                if steps and not file.only_tables:
                    self._open.append((file, steps))
        if self._open and self._drawer is None and possible():
            with suppress(OSError):  # no memory or no permission for a fork
                self._drawer = DrawingProcess()

    def _let_go(self, names: Iterable[str]) -> None:
        """Release the results that no file needs any more, and those of the steps ``names``."""
        needed_later = self._shown() - set(names)
        self._held = {name: value for name, value in self._held.items() if name in needed_later}

    def _submit(self, file: DerivedFile, recipe: Recipe, keys: Mapping[str, Key]) -> None:
        """Begin a file whose results are all held; leave to the report a picture that cannot be
        drawn here.
        """
        sources = arguments_of(file.needs, recipe, keys, self._code, self._shelf.store)
        arguments = {name: source.make(self._held) for name, source in sources.items()}
        is_large = _bytes_of(list(arguments.values())) > MOST_PIPE_BYTES
        is_drawing = isinstance(file.make, Drawing)
        # a large picture would take the pipe too long: the report draws it
        if is_drawing and (is_large or self._drawer is None):
            return
        job = _Job(
            file.name,
            key_of_file(file, sources),
            file.suffix,
            file.make,
            arguments,
            is_large or file.copied,
        )
        threads = self._draws if is_drawing else self._writes
        future = self._start(job, threads)
        if is_large:
            self._busy.add(file.name)
            future.add_done_callback(lambda _: self._busy.discard(file.name))

    def _start(self, job: _Job, threads: ThreadPoolExecutor) -> Future[None]:
        """Begin a job in a thread, and keep it for `finish`."""
        drawer = None if job.here else self._drawer
        future = threads.submit(self._make, job, drawer)
        self._begun.append((future, job))
        return future

    def _make(self, job: _Job, drawer: DrawingProcess | None) -> None:
        """Write a file here, or let a process write it."""
        # so that this object does not hold them until the end
        arguments, job.arguments = job.arguments, {}
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
    """Return True if this process has imported the modules for drawing; their import takes longer
    than a picture.
    """
    return "matplotlib.figure" in sys.modules


def _bytes_of(value: Any) -> int:
    """Return the bytes of all tensors in a value."""
    return sum(tensor.nbytes for tensor in tensors_in(value))


# --- graph ahead ----------------------------------------------------------------------------------

# The picture of the graph of a run, begun as soon as the state of each step at the end can be
# foreseen.
#
# Where a state is another one in the end, the report draws the graph again, under another key.


class GraphAhead:
    """Callable that receives each result of a run, and begins the picture of the graph when the
    keys of all steps are known.

    ``beside`` draws the graph. ``done`` has the records of the finished steps; the run fills it.
    """

    def __init__(self, beside: FilesBeside, store: Store, done: Mapping[str, StepRecord]) -> None:
        self._beside, self._store, self._done = beside, store, done
        self._recipe: Recipe | None = None
        self._order: Sequence[str] = ()

    def __call__(self, recipe: Recipe, keys: Mapping[str, Key], step: str, value: Any) -> None:
        """Take note of a result; begin the graph, once for each recipe."""
        # the first result, or a run that begins again with a smaller tolerance
        if recipe is not self._recipe:
            self._recipe, self._order = recipe, needed(recipe, wanted(recipe))
        if self._order and len(keys) >= len(self._order):
            for key, arguments in graphs(recipe, self._foreseen(keys)):
                self._beside.add("graph", key, GRAPH_DRAWING, arguments)
            self._order = ()

    def _foreseen(self, keys: Mapping[str, Key]) -> dict[str, str]:
        """Return the state of each step at the end: what is not stored runs, and equal results
        are computed once.
        """
        ended_states = states_of(
            {name: self._done[name] for name in self._order if name in self._done}
        )
        earlier_keys, states = set[Key](), dict[str, str]()
        for name in self._order:
            stored = keys[name] in earlier_keys or self._store.has(keys[name])
            states[name] = ended_states.get(name) or ("cached" if stored else "run")
            # a step with the key of an earlier one takes its result
            earlier_keys.add(keys[name])
        return states
