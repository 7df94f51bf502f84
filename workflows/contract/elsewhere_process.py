"""What runs in a process with other surroundings: it imports the modules of the calls, and sends their outcomes."""

from __future__ import annotations

import decimal
import faulthandler
import locale
import os
import pickle
import random
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np
import torch

from neusee.nodes.own_modules import import_missing
from neusee.workflows.contract.outcomes import Outcome, failed, outcome_of
from neusee.workflows.contract.surroundings import ERRORS, LOCALE, RANDOM, THREADS, WORK

_LONGEST = 600  #: s of a call after which the process ends: its parent, which waits less, has died
_SIDE = 64  #: of the matrices of unrelated work


@dataclass(frozen=True, slots=True)
class Asked:
    """The calls that a process makes, each pickled as a function without arguments, with the module of its code."""

    changes: tuple[str, ...]  #: names of surroundings
    threads: int
    files: tuple[str, ...]  #: files and folders of the user to import
    declared: dict[str, str]  #: variables of the environment that a key covers
    calls: tuple[tuple[str, bytes], ...]


def serve(pipe: int) -> None:
    """Answer what is asked through a pipe, given by its number, until its other end is closed."""
    with Connection(pipe) as connection:
        connection.send_bytes(b"ready")
        try:
            while True:
                _answer(connection, pickle.loads(connection.recv_bytes()))
        except (EOFError, BrokenPipeError):
            return


def _answer(connection: Connection, asked: Asked) -> None:
    """Send the outcome of each call, in the order that was asked for."""
    os.environ |= asked.declared
    if LOCALE.name in asked.changes:
        locale.setlocale(locale.LC_ALL, "")  # as a program does that shows numbers to its user
    if THREADS.name in asked.changes:
        torch.set_num_threads(asked.threads)
    for module, pickled in asked.calls:
        faulthandler.dump_traceback_later(_LONGEST, exit=True)
        connection.send_bytes(pickle.dumps(_called(asked, module, pickled)))
        faulthandler.cancel_dump_traceback_later()


def _called(asked: Asked, module: str, pickled: bytes) -> Outcome:
    _change(asked.changes)
    try:
        import_missing(asked.files)
        function = pickle.loads(pickled)
    except (Exception, SystemExit) as error:
        found = failed(error, module)
        return Outcome(failure=f"cannot be imported: it {found.failure}", place=found.place)
    _change(asked.changes)  # again, as the import may have changed it back
    return outcome_of(function, module)


def _change(changes: tuple[str, ...]) -> None:
    """Change what belongs to the process: states of generators, what NumPy does at an error, other work."""
    if WORK.name in changes:
        _work()
    if RANDOM.name in changes:
        torch.manual_seed(4711)
        np.random.seed(4711)
        random.seed(4711)
    if ERRORS.name in changes:
        raising = {name: what == "raise" for name, what in np.geterr().items()}
        np.seterr(**{name: "ignore" if is_raised else "raise" for name, is_raised in raising.items()})


def _work() -> None:
    """Do what other steps may have done before: numbers, and settings of libraries that code of others changes."""
    x = torch.full((_SIDE, _SIDE), 3.0)
    torch.fft.fft2(x @ x).abs().sort()
    np.linalg.svd(np.full((_SIDE, _SIDE), 7.0))
    np.set_printoptions(precision=3, suppress=True)
    torch.set_printoptions(precision=2)  # type: ignore[no-untyped-call]
    decimal.getcontext().prec = 9
