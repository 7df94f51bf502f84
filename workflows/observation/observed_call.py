"""Call of a step of the user that is observed: its value, and what it reached that its key does not know."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TypeVar

from neusee.workflows.observation import audit_events, kernel_layer, python_watch
from neusee.workflows.observation.asked_chance import WatchedChance
from neusee.workflows.observation.covered_paths import decides
from neusee.workflows.observation.judgement import Judgement
from neusee.workflows.observation.legacy_numpy import WatchedLegacyGenerators
from neusee.workflows.observation.notification_client import NoServer, NotificationClient
from neusee.workflows.observation.python_watch import Watch
from neusee.workflows.observation.recorded_call import Record
from neusee.workflows.observation.shared_generators import SharedGenerators
from neusee.workflows.observation.step_thread import StepThread
from neusee.workflows.observation.taints import Covered, Taint
from neusee.workflows.observation.watched_imports import WatchedImports
from neusee.workflows.observation.watched_threads import WatchedThreads

T = TypeVar("T")
_turn = [threading.Lock()]  #: one observed call at a time: hooks and generators belong to the process
_LOOK = 0.05  #: s after which a caller that waits for its turn sees an exception that another thread raises in it


def observed(
    function: Callable[[], T], covered: Covered, state: Callable[[], Callable[[], list[Taint]]] | None = None
) -> tuple[T, tuple[Taint, ...]]:
    """Return the value of a function, and what the function reached that is not covered.

    ``state`` notes what modules hold, before the call, and returns what tells the changes after it.

    The function runs in a thread of its own, as its caller would run it, and its exceptions pass unchanged. If the
    process that watches it dies meanwhile, calls of the function fail, so the function is called again: what it uses
    up, such as a generator, it makes itself. An observed call within an observed call is a part of it, without taints.
    """
    if python_watch.watch_here() is not None:
        return function(), ()
    with one_at_a_time():
        told = state() if state is not None else list[Taint]
        step, taints = _observed(function, covered)
        taints += tuple(told())
    return step.value(), taints


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """Wait until no other thread of this process observes a call."""
    turn = _turn[0]
    while not turn.acquire(timeout=_LOOK):
        pass
    try:
        yield
    finally:
        turn.release()


@contextmanager
def watched_in_fork() -> Iterator[Callable[[], None]]:
    """Give what a fork of this process calls first, so that the kernel watches it as it would watch this process.

    Only one fork is observed at a time, and this process waits for it: see `one_at_a_time`.
    """
    answering, succeeded = kernel_layer.begun_for_fork(), False

    def begin() -> None:
        if answering is not None:
            with suppress(OSError, ValueError):  # then the call says that it is not watched
                answering.observe_here()

    try:
        yield begin
        succeeded = True
    finally:
        if answering is not None:
            try:
                answering.observe_here()
            except (OSError, ValueError):
                succeeded = False
            if not succeeded:
                kernel_layer.give_up()


def observed_import(load: Callable[[], T], covered: Covered) -> tuple[T, tuple[Taint, ...]]:
    """Return what a function imports, and what the bodies of the modules of the user reached meanwhile.

    A module that is loaded already is not executed again, so it reaches nothing: observe its first import.
    """
    return observed(load, covered)


def _observed(function: Callable[[], T], covered: Covered) -> tuple[StepThread[T], tuple[Taint, ...]]:
    """Return the step that has ended, and its taints; without the kernel's layer where it fails."""
    unwatched = ""
    if not kernel_layer.missing():
        try:
            client = kernel_layer.client()
            step, watch = _run(function, client)
            return step, _judged(watch, covered, client.records())
        except NoServer as error:
            unwatched = str(error)
    step, watch = _run(function, None)
    unseen = [Record("unseen", f"the kernel did not watch: {unwatched}")] if unwatched else []
    return step, _judged(watch, covered, [*watch.records, *unseen])


def _run(function: Callable[[], T], client: NotificationClient | None) -> tuple[StepThread[T], Watch]:
    """Run a function in its thread until it has ended; raise `NoServer` if its thread could not be watched."""
    watch = Watch(kernel=client is not None)
    step = StepThread(function, lambda: kernel_layer.stop_here(client) if client else None)
    watch.add(step.thread)
    audit_events.listen()
    with WatchedChance(), WatchedLegacyGenerators(), WatchedImports(), WatchedThreads(), SharedGenerators() as shared:
        python_watch.begin(watch)
        try:
            step.run()
        finally:
            python_watch.end()
        watch.draws.update(shared.drawn(), watch.kept.changed())
    if step.unprepared is not None:
        raise step.unprepared
    return step, watch


def _judged(watch: Watch, covered: Covered, records: list[Record]) -> tuple[Taint, ...]:
    chance = watch.chance()
    if not (records or watch.bodies or watch.settings or chance):
        return ()
    quiet = {path for path, is_quiet in watch.quiet.items() if is_quiet}
    judgement = Judgement(covered, watch.bodies, quiet, watch.temporary)
    # where Python knows which source of chance was asked, what the kernel says of it is the same once more
    judgement.judge(record for record in records if record.does != "entropy" or not chance)
    judgement.judge(Record("input", path) for path in sorted(watch.settings) if decides(path))
    judgement.judge_modules()
    for source in sorted(chance):
        judgement.add("random", source)
    return judgement.taints()


def _in_child() -> None:
    """Let the fork of a process observe calls of its own, unless it is a part of the observed call."""
    _turn[0] = threading.Lock()
    if python_watch.watch_here() is None:
        python_watch.end()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
