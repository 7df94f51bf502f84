"""What runs in a process with other surroundings: its forks import the modules of the calls, and send the outcomes."""

from __future__ import annotations

import decimal
import faulthandler
import locale
import multiprocessing
import os
import pickle
import random
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np
import torch

from neusee.nodes.own_modules import import_missing
from neusee.workflows.contract.outcomes import Outcome, failed, outcome_of
from neusee.workflows.contract.surroundings import Settings

_LONGEST = 600  #: s of a call after which its process ends: the one that asked, which waits less, has died
_SIDE = 64  #: of the matrices of unrelated work
_errors: list[object] = [None]  #: what NumPy does at an error, as this process has set it last


@dataclass(frozen=True, slots=True)
class Asked:
    """The calls that a process makes, each pickled as a function without arguments, with the module of its code."""

    settings: Settings
    files: tuple[str, ...]  #: files and folders of the user to import
    calls: tuple[tuple[str, bytes], ...]


def serve(pipe: int) -> None:
    """Answer what is asked through a pipe, given by its number, until its other end is closed.

    Each answer comes from a fork, which has imported no code of the user before, and ends with its exit code.
    """
    fork = multiprocessing.get_context("fork")
    with Connection(pipe) as connection:
        connection.send_bytes(b"ready")
        try:
            while True:
                asked: Asked = pickle.loads(connection.recv_bytes())
                process = fork.Process(target=_answer, args=(connection, asked))
                process.start()
                process.join()
                connection.send_bytes(pickle.dumps(process.exitcode))
        except (EOFError, OSError):
            return


def _answer(connection: Connection, asked: Asked) -> None:
    """Send the outcome of each call, in the order that was asked for."""
    _settle(asked.settings)
    for module, pickled in asked.calls:
        faulthandler.dump_traceback_later(_LONGEST, exit=True)
        connection.send_bytes(pickle.dumps(_called(asked, module, pickled)))
        faulthandler.cancel_dump_traceback_later()


def _called(asked: Asked, module: str, pickled: bytes) -> Outcome:
    _disturb(asked.settings)
    try:
        import_missing(asked.files, module)
        function = pickle.loads(pickled)
    except (Exception, SystemExit) as error:
        found = failed(error, module)
        return Outcome(failure=f"cannot be imported: it {found.failure}", place=found.place)
    _disturb(asked.settings)  # again, as the import may have changed it back
    return outcome_of(function, module)


def _settle(settings: Settings) -> None:
    """Change what is set once: the folder, variables, the zone, the locale, the threads of torch."""
    for name, value in settings.variables.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    time.tzset()
    if settings.folder:
        os.chdir(settings.folder)
    if settings.has_locale:
        locale.setlocale(locale.LC_ALL, "")
    if settings.threads:
        torch.set_num_threads(settings.threads)


def _disturb(settings: Settings) -> None:
    """Change what other code changes between two calls: other work, states of generators, errors of NumPy."""
    if settings.has_other_work:
        _work()
    if settings.has_other_states:
        torch.manual_seed(4711)
        np.random.seed(4711)
        random.seed(4711)
    if settings.has_other_errors and np.geterr() != _errors[0]:  # so that a second time does not change it back
        np.seterr(**{name: "ignore" if what == "raise" else "raise" for name, what in np.geterr().items()})
        _errors[0] = np.geterr()


def _work() -> None:
    """Do what other steps may have done before: numbers, and settings of libraries that code of others changes."""
    x = torch.full((_SIDE, _SIDE), 3.0)
    torch.fft.fft2(x @ x).abs().sort()
    np.linalg.svd(np.full((_SIDE, _SIDE), 7.0))
    np.set_printoptions(precision=3, suppress=True)
    torch.set_printoptions(precision=2)  # type: ignore[no-untyped-call]
    decimal.getcontext().prec = 9
