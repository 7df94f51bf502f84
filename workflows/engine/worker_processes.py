"""Worker processes that share independent work, such as the points of a sweep or the draws of a
study.

Each worker is a fork of this process with one torch thread. So it has the recipe, the
modules and all large values in memory, and only the numbers of the pieces of work and their results
go through a pipe. A worker computes with the same code on one thread: its results are those of this
process on one thread, bit for bit. Work that a worker did not finish, because it failed, was killed
or had too little memory, is left to this process, which then raises the error as if there were no
workers. Workers end with this process, also after ``kill -9``.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import sys
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from itertools import chain
from multiprocessing.connection import Connection, wait
from typing import Generic, TypeVar

import torch

from neusee.workflows.engine.machine_resources import free_processors
from neusee.workflows.observation.step_thread import is_alone
from neusee.workflows.store.lease import retire

T = TypeVar("T")
_PARENT_DIES = 1  #: PR_SET_PDEATHSIG of Linux


@contextmanager
def deaf_fork() -> Iterator[None]:
    """Hold back Ctrl-C while the ``with`` block forks, so that the forked process receives it only
    after `ignore_interrupts`.
    """
    signals_before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, signals_before)


def ignore_interrupts() -> None:
    """Ignore Ctrl-C in a forked process: the parent decides what an interrupt ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def workers_for(pieces: int, asked: int = 0) -> int:
    """Return the number of workers that share ``pieces`` pieces of work: ``asked``, or by default
    one for each free processor.

    1 means that this process works alone. It does so if a fork is not possible, or by default
    beside threads of other libraries, such as those of a notebook: a lock that they hold stays
    locked in a fork.
    """
    if sys.platform != "linux":
        return 1
    return max(1, min(pieces, asked or (free_processors() or 1 if is_alone() else 1)))


def end_with(parent: int) -> bool:
    """Let this forked process end when its ``parent`` ends, also after ``kill -9``; return False if
    the parent has already ended.
    """
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PARENT_DIES, signal.SIGKILL)
    return os.getppid() == parent


def shared(
    work: Callable[[int], T], order: Sequence[int], workers: int, apart: bool = False
) -> Generator[tuple[int, tuple[T] | None], None, None]:
    """Yield each number in ``order`` with its ``work(number)`` as the only item of a tuple, in the
    order of the ends.

    None in place of the tuple means that the caller must do this piece itself. With one worker that
    is every piece.

    Args:
        apart: each worker takes a run of ``order`` of its own, and helps the others when its own is
            done. This keeps neighbours, which share results, with one worker. By default all
            workers take the next piece.
    """
    if workers < 2:
        yield from ((number, None) for number in order)
        return
    team = _Team(work, order, workers, apart)
    try:
        yield from team.results()
    finally:
        team.close()


def shared_in_order(work: Callable[[int], T], count: int, workers: int) -> Iterator[T]:
    """Yield ``work(number)`` for each number below ``count``, in order; this process does the
    pieces that no worker finished.
    """
    results, next_number = dict[int, tuple[T] | None](), 0
    with closing(shared(work, range(count), workers)) as ended:
        for number, value in ended:
            results[number] = value
            # a result waits until all earlier ones have arrived
            while next_number in results:
                result = results.pop(next_number)
                yield result[0] if result else work(next_number)
                next_number += 1


class _Team(Generic[T]):
    """The workers that share one list of pieces of work."""

    def __init__(
        self, work: Callable[[int], T], order: Sequence[int], workers: int, apart: bool
    ) -> None:
        self._work = work
        run_count, piece_count = workers if apart else 1, len(order)
        # pieces that no worker has taken: one common list, or for each worker an equal run of
        # neighbours
        self._left = [
            deque(order[i * piece_count // run_count : (i + 1) * piece_count // run_count])
            for i in range(run_count)
        ]
        self._lost = deque[int]()  # pieces for the caller
        # for each pipe, the worker's index and its present piece
        self._now: dict[Connection, tuple[int, int]] = {}
        self._processes = list[multiprocessing.process.BaseProcess]()
        self._pipes = list[Connection]()
        for index in range(workers):
            self._begin(index)

    def results(self) -> Iterator[tuple[int, tuple[T] | None]]:
        while self._now or self._lost or any(self._left):
            while self._lost:
                yield self._lost.popleft(), None
            # the workers that have sent an answer
            for pipe in wait(list(self._now)) if self._now else ():
                assert isinstance(pipe, Connection)
                yield self._result(pipe)
            if not self._now:  # no worker is left
                self._lost += chain.from_iterable(self._left)
                self._left = []

    def _result(self, pipe: Connection) -> tuple[int, tuple[T] | None]:
        """Return the piece of work that a worker finished and its result, and send the worker the
        next piece.
        """
        index, number = self._now.pop(pipe)
        answer = self._answer(pipe)
        # the worker has died: its piece is left to the caller
        if answer is None:
            return number, None
        self._hand(index, pipe)
        return number, answer[0]

    def close(self) -> None:
        """End all workers, at once if they still work."""
        for pipe in self._pipes:
            pipe.close()
        for process in self._processes:
            # idle workers end by themselves when their pipe closes
            process.join(0.0 if self._now else 0.5)
            if process.is_alive():
                process.kill()
                process.join()

    def _begin(self, index: int) -> None:
        """Start a worker and send it its first piece; if the fork fails, there is one worker
        less.
        """
        context = multiprocessing.get_context("fork")
        own_end, worker_end = context.Pipe()
        # includes the pipe ends of this process, which the worker closes
        arguments = (worker_end, [*self._pipes, own_end], self._work, os.getpid())
        process = context.Process(
            target=_serve, args=arguments, name=f"neusee worker {index}", daemon=True
        )
        try:
            # Python 3.12 warns of every fork beside a thread
            with warnings.catch_warnings(), deaf_fork():
                warnings.simplefilter("ignore", DeprecationWarning)
                process.start()
        except OSError:  # no memory or no permission: the other workers or this process do the work
            own_end.close()
            return
        finally:
            worker_end.close()
        self._processes.append(process)
        self._pipes.append(own_end)
        self._hand(index, own_end)

    def _hand(self, index: int, pipe: Connection) -> None:
        """Send a worker the next piece of its own run, or the last piece of the longest other
        run.
        """
        # all workers share one run unless they are apart
        own_run = self._left[min(index, len(self._left) - 1)]
        run = own_run or max(self._left, key=len)
        if run:
            # from the run of another worker take the last piece, which is farthest from its present
            # one
            piece = run.popleft() if run is own_run else run.pop()
            try:
                pipe.send(piece)
            except OSError:
                self._lost.append(piece)
            else:
                self._now[pipe] = index, piece

    def _answer(self, pipe: Connection) -> tuple[tuple[T] | None] | None:
        """Return the answer of a worker in a tuple: the result, or None for a piece that failed.
        Return None itself if the worker has died.
        """
        try:
            value, given_warnings = pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError, pickle.UnpicklingError):
            return None
        for text, category in given_warnings:
            warnings.warn(text, category, stacklevel=2)
        # in a tuple, to distinguish a failed piece from a dead worker
        return (value,)


def _serve(
    pipe: Connection, others: Sequence[Connection], work: Callable[[int], T], parent: int
) -> None:
    """Do the pieces of work whose numbers come through the pipe, until its other end closes."""
    for other_pipe in others:
        other_pipe.close()  # otherwise the pipes of a killed process would stay open
    ignore_interrupts()
    if not end_with(parent):
        return
    torch.set_num_threads(1)  # a forked process does not have the threads of its parent
    with suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(_done(work, pipe.recv()))
    retire()


def _done(work: Callable[[int], T], number: int) -> bytes:
    """Return the pickled result of a piece of work with its warnings, or None in place of the
    result if it failed.
    """
    with warnings.catch_warnings(record=True) as given_warnings:
        warnings.simplefilter("default")
        try:
            value: tuple[T] | None = (work(number),)
        except BaseException:  # the parent repeats this piece, and raises the error there
            value = None
    messages = [(str(warning.message), warning.category) for warning in given_warnings]
    try:
        return pickle.dumps((value, messages if value else []), protocol=5)
    except Exception:  # a result that cannot be sent
        return pickle.dumps((None, []), protocol=5)
