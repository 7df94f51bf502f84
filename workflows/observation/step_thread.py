"""A new thread that runs a function under the conditions of its caller: context variables, modes of
torch, exceptions.

The thread is new because the filter of the kernel stays with a thread until the thread ends.
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
#: names of the threads of this program, and of a dask worker that computes its steps
_OWN = re.compile(
    r"(MainThread|neusee|\d+-Dask-|Dask-Offload|Nanny stop queue|Thread-\d+ \(monitor_parent\)).*"
)
#: interval (s) at which a waiting caller checks for an exception that another thread raised in it
_LOOK = 0.05
_raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc


def is_alone() -> bool:
    """Return True if all threads of this process belong to this program."""
    return all(_OWN.fullmatch(thread.name) for thread in threading.enumerate())


class StepThread(Generic[T]):
    """A thread that runs ``prepare`` and then ``function``, and keeps the value or the error."""

    def __init__(self, function: Callable[[], T], prepare: Callable[[], None]) -> None:
        self._function, self._prepare = function, prepare
        self._context = contextvars.copy_context()
        self._modes = _modes()
        self._value: T
        self._error: BaseException | None = None
        #: the error of ``prepare``; if there is one, the function did not run
        self.unprepared: Exception | None = None
        self._ended = False
        # both locks are held: the thread waits for the first, the caller for the second
        self._begin, self._end = threading.Lock(), threading.Lock()
        self._begin.acquire()
        self._end.acquire()
        self.thread = threading.Thread(target=self._keep, name="neusee step", daemon=True)

    def run(self) -> None:
        """Run the function in the thread, and wait until it has ended.

        An exception that is raised in the waiting thread is raised in the step too. After a Ctrl-C
        the caller does not wait for the step to end; after any other exception it does, so that the
        step's memory is free.
        """
        try:
            try:
                self.thread.start()
            # the thread waits for this lock: an exception inside `Thread.start` could leave it half
            # started
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
        """Return the value of the function, or raise its error with the traceback."""
        if self._error is not None:
            try:
                raise self._error
            finally:
                # otherwise the error would refer to itself through its traceback
                self._error = None
        return self._value

    def _join(self) -> None:
        """Wait until the thread ends, without `Thread.join`: an exception inside `join` could mark
        a thread as ended while it still runs.
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
        """Run ``prepare``; if it fails, keep the error and return False."""
        collects_garbage = gc.isenabled()
        # a finalizer could make a system call that is stopped before a server can answer it
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
        """Run the function in the torch modes of the caller."""
        records_gradients, is_inference, thread_count, device = self._modes
        if torch.get_num_threads() != thread_count:
            torch.set_num_threads(thread_count)
        if device is not None:
            torch.cuda.set_device(device)
        with torch.inference_mode(is_inference), torch.set_grad_enabled(records_gradients):
            return self._function()


def _modes() -> tuple[bool, bool, int, Any]:
    """Return the settings that torch keeps for each thread: gradients, inference mode, number of
    threads, current device.
    """
    device = torch.cuda.current_device() if torch.cuda.is_initialized() else None  # type: ignore[no-untyped-call]
    return (
        torch.is_grad_enabled(),
        torch.is_inference_mode_enabled(),
        torch.get_num_threads(),
        device,
    )
