"""Threads of torch beside other work, decided before torch is imported, because OpenMP reads its settings only then.

A thread of OpenMP that waits for another spins for a thousandth of a second or more. Where the processors are busy, the
other thread is not running, so that two threads burn ten times the processor time of one and take as much longer.
"""

from __future__ import annotations

import os
import sys
from collections.abc import MutableMapping

from neusee.workflows.engine.processors import free_processors

_WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")  #: variables that say how a thread waits
_NUMBER = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")
_DRAWN = ("run",)  #: commands beside whose short steps a process draws pictures
_TIMED = ("study",)  #: commands whose stored times belong to a number of threads


def settle_threads(command: str, environ: MutableMapping[str, str] = os.environ) -> None:
    """Let waiting threads sleep, and leave the processors that are busy to other work; keep what the user has set.

    Steps beside which pictures are drawn leave one processor to these: on two processors `neusee run first_light` took
    10.0 s with two threads and 8.1 s with one. Nothing changes where torch is imported already.
    """
    if "torch" in sys.modules:
        return
    if not any(name in environ for name in _WAITING):
        environ["OMP_WAIT_POLICY"] = "PASSIVE"
    threads = free_processors()
    if command not in _TIMED and not any(name in environ for name in _NUMBER) and threads is not None:
        environ["OMP_NUM_THREADS"] = str(max(1, threads - (command in _DRAWN)))
