"""A fresh thread that runs a function as its caller would: with its context, its modes of torch,
its exceptions.

The thread is fresh because the filter of the kernel stays with a thread for ever.
"""

from __future__ import annotations

import contextvars
import ctypes
import gc
import re
import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import torch

T = TypeVar("T")
#: names of the threads of this program, and of a worker of dask that computes its steps
_OWN = re.compile(
    r"(MainThread|neusee|\d+-Dask-|Dask-Offload|Nanny stop queue|Thread-\d+ \(monitor_parent\)).*"
)
_LOOK = 0.05  #: s after which a waiting caller sees an exception that another thread raises in it
_raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc


def is_alone() -> bool:
    """Return True if all threads of this process are of this program."""
    return all(_OWN.fullmatch(thread.name) for thread in threading.enumerate())


class StepThread(Generic[T]):
    """A thread that runs ``function`` after ``prepare``, and keeps what came of it."""

    def __init__(self, function: Callable[[], T], prepare: Callable[[], None]) -> None:
        self._function, self._prepare = function, prepare
        self._context = contextvars.copy_context()
        self._modes = _modes()
        self._value: T
        self._error: BaseException | None = None
        #: the error of ``prepare``; the function did not run
        self.unprepared: Exception | None = None
        self._ended = False
        # both are held: the thread waits for the first, the caller for the second
        self._begin, self._end = threading.Lock(), threading.Lock()
        self._begin.acquire()
        self._end.acquire()
        self.thread = threading.Thread(target=self._keep, name="neusee step", daemon=True)

    def run(self) -> None:
        """Run the function in the thread, and wait until it has ended.

        An exception that is raised in the waiting thread is raised in the step too. A Ctrl-C does
        not wait for the step to end, any other one does: the memory of a step that was stopped must
        be free.
        """
        try:
            try:
                self.thread.start()
            # the step waits for it: an exception in the middle of `Thread.start` would leave half a
            # thread
            finally:
                self._begin.release()
            self._join()
        except KeyboardInterrupt:
            self._stop(KeyboardInterrupt)
            raise
        except BaseException as error:
            self._stop(type(error))
            self._join()
            raise

    def value(self) -> T:
        """Return the value of the function, or raise what it raised, with its traceback."""
        if self._error is not None:
            try:
                raise self._error
            finally:
                self._error = None  # or the error, through its traceback, would hold itself
        return self._value

    def _join(self) -> None:
        """Wait for the end; an exception in the middle of `Thread.join` would leave a thread
        that only seems to end.
        """
        while not self._ended:
            self._end.acquire(timeout=_LOOK)

    def _stop(self, kind: type[BaseException]) -> None:
        """Raise an exception in the thread of the step."""
        if self.thread.ident is not None:
            _raise_in(ctypes.c_ulong(self.thread.ident), ctypes.py_object(kind))

    def _keep(self) -> None:
        """Run the function in the thread, and keep its value or its error."""
        self._begin.acquire()
        try:
            if self._is_prepared():
                self._value = self._context.run(self._in_modes)
        except BaseException as error:
            self._error = error
        finally:
            self._ended = True
            self._end.release()

    def _is_prepared(self) -> bool:
        """Prepare the thread; return False, and keep the error, if that fails."""
        collects_garbage = gc.isenabled()
        # a finalizer could make a call that is stopped before there is anybody to answer it
        gc.disable()
        try:
            self._prepare()
        except Exception as error:
            self.unprepared = error
        finally:
            if collects_garbage:
                gc.enable()
        return self.unprepared is None

    def _in_modes(self) -> T:
        """Run the function with the modes of torch that the caller has."""
        records_gradients, is_inference, thread_count, device = self._modes
        if torch.get_num_threads() != thread_count:
            torch.set_num_threads(thread_count)
        if device is not None:
            torch.cuda.set_device(device)
        with torch.inference_mode(is_inference), torch.set_grad_enabled(records_gradients):
            return self._function()


def _modes() -> tuple[bool, bool, int, Any]:
    """Return what torch keeps for each thread: gradients, inference, number of threads, current
    device.
    """
    device = torch.cuda.current_device() if torch.cuda.is_initialized() else None  # type: ignore[no-untyped-call]
    return (
        torch.is_grad_enabled(),
        torch.is_inference_mode_enabled(),
        torch.get_num_threads(),
        device,
    )
