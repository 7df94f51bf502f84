"""Observed calls, imports and hooks of own code, and what they reached beyond their key."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import os
import re
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from neusee.nodes import Node
from neusee.nodes.own_modules import own_modules
from neusee.workflows.keys.cache_key import files_in
from neusee.workflows.keys.module_digest import say_once
from neusee.workflows.keys.module_origin import origin_of
from neusee.workflows.keys.sealed_files import bytes_of
from neusee.workflows.keys.user_code import FREE, OwnCode, taint_code
from neusee.workflows.observation import kernel_layer, python_watch
from neusee.workflows.observation import python_watch as audit_events
from neusee.workflows.observation.covered_paths import decides
from neusee.workflows.observation.environment_variables import Asked, hidden_while_importing
from neusee.workflows.observation.kernel_layer import NoServer, NotificationClient
from neusee.workflows.observation.left_state import is_of_library, watch_state
from neusee.workflows.observation.python_watch import Watch, WatchedImports, WatchedThreads
from neusee.workflows.observation.random_generators import (
    SharedGenerators,
    WatchedChance,
    WatchedLegacyGenerators,
)
from neusee.workflows.observation.step_thread import StepThread, is_alone
from neusee.workflows.observation.system_calls import Record
from neusee.workflows.observation.taints import Covered, Judgement, Taint, taint

# --- observed call --------------------------------------------------------------------------------

# Call of a step of the user that is observed: its value, and what it reached that its key does not
# know.


T = TypeVar("T")
#: one observed call at a time: hooks and generators belong to the process
_turn = [threading.Lock()]
#: s after which a caller that waits for its turn sees an exception that another thread raises in it
_LOOK = 0.05


def observed(
    function: Callable[[], T],
    covered: Covered,
    state: Callable[[], Callable[[], list[Taint]]] | None = None,
) -> tuple[T, tuple[Taint, ...]]:
    """Return the value of a function, and what the function reached that is not covered.

    ``state`` notes what modules hold, before the call, and returns what tells the changes after it.

    The function runs in a thread of its own, as its caller would run it, and its exceptions pass
    unchanged. If the process that watches it dies meanwhile, calls of the function fail, so the
    function is called again: what it uses up, such as a generator, it makes itself. An observed
    call within an observed call is a part of it, without taints.
    """
    # an observed call within another one is a part of that
    if python_watch.watch_here() is not None:
        return function(), ()
    with one_at_a_time():
        # tells after the call what it left in modules
        left_taints = state() if state is not None else list[Taint]
        step, taints = _observed(function, covered)
        taints += tuple(left_taints())
    return step.value(), taints


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """Wait until no other thread of this process observes a call."""
    turn = _turn[0]
    # wakes now and then, so that Ctrl-C is seen
    while not turn.acquire(timeout=_LOOK):
        pass
    try:
        yield
    finally:
        turn.release()


@contextmanager
def watched_in_fork() -> Iterator[Callable[[], None]]:
    """Give what a fork of this process calls first, so that the kernel watches it as it would watch
    this process.

    Only one fork is observed at a time, and this process waits for it: see `one_at_a_time`.
    """
    server, succeeded = kernel_layer.begun_for_fork(), False

    def begin() -> None:
        if server is not None:
            with suppress(OSError, ValueError):  # then the call says that it is not watched
                # this process again, when the fork has ended
                server.observe_here()

    try:
        yield begin
        succeeded = True
    finally:
        if server is not None:
            try:
                server.observe_here()
            except (OSError, ValueError):
                succeeded = False
            if not succeeded:
                kernel_layer.give_up()


def observed_import(load: Callable[[], T], covered: Covered) -> tuple[T, tuple[Taint, ...]]:
    """Return what a function imports, and what the bodies of the modules of the user reached
    meanwhile.

    A module that is loaded already is not executed again, so it reaches nothing: observe its first
    import.
    """
    return observed(load, covered)


def _observed(
    function: Callable[[], T], covered: Covered
) -> tuple[StepThread[T], tuple[Taint, ...]]:
    """Return the step that has ended, and its taints; without the kernel's layer where it fails."""
    reason_unwatched = ""
    if not kernel_layer.missing():
        try:
            client = kernel_layer.client()
            step, watch = _run(function, client)
            return step, _judged(watch, covered, client.records())
        except NoServer as error:
            reason_unwatched = str(error)
    # a second time, without the kernel
    step, watch = _run(function, None)
    unseen = (
        [Record("unseen", f"the kernel did not watch: {reason_unwatched}")]
        if reason_unwatched
        else []
    )
    return step, _judged(watch, covered, [*watch.records, *unseen])


def _run(
    function: Callable[[], T], client: NotificationClient | None
) -> tuple[StepThread[T], Watch]:
    """Run a function in its thread until it has ended; raise `NoServer` if its thread could not
    be watched.
    """
    watch = Watch(kernel=client is not None)
    # the filter of the kernel begins in the thread of the step
    step = StepThread(function, lambda: kernel_layer.stop_here(client) if client else None)
    watch.add(step.thread)
    audit_events.listen()
    with (
        WatchedChance(),
        WatchedLegacyGenerators(),
        WatchedImports(),
        WatchedThreads(),
        SharedGenerators() as shared_generators,
    ):
        python_watch.begin(watch)
        try:
            step.run()
        finally:
            python_watch.end()
        # draws that only a comparison of states shows
        watch.draws.update(shared_generators.drawn(), watch.kept.changed())
    if step.unprepared is not None:
        raise step.unprepared
    return step, watch


def _judged(watch: Watch, covered: Covered, records: list[Record]) -> tuple[Taint, ...]:
    """Return the taints of an observed call, from what the kernel and Python saw."""
    chance_sources = watch.chance()
    if not any((records, watch.bodies, watch.settings, chance_sources)):
        return ()
    quiet_paths = {path for path, is_quiet in watch.quiet.items() if is_quiet}
    judgement = Judgement(covered, watch.bodies, quiet_paths, watch.temporary)
    # where Python knows which source of chance was asked, what the kernel says of it is the same
    # once more
    judgement.judge(record for record in records if record.does != "entropy" or not chance_sources)
    judgement.judge(Record("input", path) for path in sorted(watch.settings) if decides(path))
    judgement.judge_modules()
    for source in sorted(chance_sources):
        judgement.add("random", source)
    return judgement.taints()


def _in_child() -> None:
    """Let the fork of a process observe calls of its own, unless it is a part of the observed
    call.
    """
    _turn[0] = threading.Lock()
    if python_watch.watch_here() is None:
        python_watch.end()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)


# --- own call -------------------------------------------------------------------------------------

# Observed call of own code: what it reached beyond its key, less what its author states to decide
# no result.

#: what a taint does, in words before what it reached
WORDS = {
    "file": "reads",
    "folder": "lists",
    "write": "makes, removes or adds to",
    "attribute": "reads extended attributes of",
    "process": "starts",
    "network": "asks",
    "random": "draws from",
    "import": "imports",
    "memory": "leaves, where other steps may read it,",
    "variable": "reads the environment variable",
    "unknown": "could not be watched:",
}


def call_observed(function: Callable[[], T], own: OwnCode) -> tuple[T, list[Taint]]:
    """Return the value of a function of own code, and what it reached that its key does not
    cover.
    """
    covered = Covered(frozenset(map(Path, own.files)), own.followed.__contains__)
    value, taints = observed(function, covered, lambda: watch_state(own))
    return value, [taint for taint in taints if not own.free & _words_of(taint)]


def tainted_modules(own: OwnCode, taints: Iterable[Taint]) -> frozenset[str]:
    """Return the modules of the user that may have what a step reached: all, if a library or a
    setting has it.
    """
    if any(is_of_library(reached, own) for reached in taints):
        return own.modules.union(own_modules())
    return own.modules


def undeclared(own: OwnCode, asked: Asked) -> list[Taint]:
    """Return a taint for each variable of the environment that own code read and its key does
    not have.
    """
    taints = [taint("variable", name) for name in asked.of_own_code]
    return [variable for variable in taints if not own.free & _words_of(variable)]


def say_lost(module: str, left: Iterable[Taint]) -> None:
    """Say what own code changed in a process of its own, where no other step finds it."""
    for change in left:
        text = (
            f"{module} changes {change.what}, and no other step finds the change, since its steps"
            " compute in processes"
        )
        say_once(module, f"{text} of their own: {change.fix.partition(', or')[0]}")


def say_hidden(module: str, asked: Asked, free: Collection[str] = ()) -> None:
    """Say which variables of the environment are set, and are not found by libraries that own
    code calls.
    """
    names = [name for name in asked.of_libraries if name not in free]
    if names:
        text = (
            f"libraries that {module} uses do not find {', '.join(names)} of the environment, which"
            " no cache key has"
        )
        say_once(module, f'{text}; if it decides a result, declare it, depends=["env:{names[0]}"]')


def _words_of(reached: Taint) -> set[str]:
    """Return the words by which an author states that something decides no result."""
    return {reached.kind, reached.what, Path(reached.what).name, reached.what.rpartition(".")[2]}


# --- own import -----------------------------------------------------------------------------------

# Observed import of own modules: what they read while they are imported stays in them, and no later
# call shows it.


#: as a module declares a variable of the environment
_VARIABLE = re.compile(rb"[\"']env:(\w+)[\"']")


def import_observed(name: str) -> ModuleType:
    """Import a module of a user; taint it, and those that it imports, by what they reach meanwhile.

    What a module declares in ``__depends__`` is no taint. A module that is loaded already is not
    observed again.
    """
    if name in sys.modules:
        return sys.modules[name]
    modules_before = set(sys.modules)
    load = functools.partial(importlib.import_module, name)
    with _hidden(name) as asked_variables:
        module, reaches = observed_import(load, Covered(frozenset(), lambda _: True))
    say_hidden(name, asked_variables)
    reaches += tuple(taint("variable", variable) for variable in asked_variables.of_own_code)
    # modules of users alone
    new_modules = [
        module_name
        for module_name in sys.modules
        if module_name not in modules_before
        and origin_of(module_name, frozenset()).kind == "source"
    ]
    taints = tuple(reach for reach in reaches if not _is_declared(reach, new_modules))
    if taints:
        taint_code(new_modules, taints)
        for reach in taints:
            reached = (
                f"{WORDS[reach.kind]} {reach.what} when it is imported, which no cache key covers"
            )
            say_once(
                name,
                f"{name} {reached}: the results of its nodes are not stored; to have them stored,"
                f" {reach.fix}",
            )
    return module


def _is_declared(reached: Taint, modules: Iterable[str]) -> bool:
    """Return True if one of the modules declares what was reached."""
    return any(declares(module, reached) for module in modules)


@contextmanager
def _hidden(name: str) -> Iterator[Asked]:
    """Hide variables of the environment from the libraries that a module imports, but not beside
    foreign threads.
    """
    if not is_alone():
        yield Asked()
        return
    with hidden_while_importing(_declared_variables(name)) as asked_variables:
        yield asked_variables


def _declared_variables(name: str) -> frozenset[str]:
    """Return the variables that a module, or one beside or below it, declares; it is not
    imported yet.
    """
    spec = importlib.util.find_spec(name)
    if spec is None or not spec.has_location or spec.origin is None:
        return frozenset()
    folder = Path(spec.origin).parent
    # of a package: at any depth
    sources = folder.rglob("*.py") if spec.submodule_search_locations else folder.glob("*.py")
    names = set[str]()
    for source in sources:
        if source.is_file():
            names.update(variable.decode() for variable in _VARIABLE.findall(bytes_of(source)))
    return frozenset(names)


def declares(module: str, taint: Taint) -> bool:
    """Return True if the ``__depends__`` of a module has what was reached."""
    loaded_module = sys.modules[module]
    entries = [
        entry for entry in getattr(loaded_module, "__depends__", ()) if isinstance(entry, str)
    ]
    free_names = {entry.removeprefix(FREE) for entry in entries if entry.startswith(FREE)}
    # a kind, a path or the name of a file
    if free_names & {taint.kind, taint.what, Path(taint.what).name}:
        return True
    return any(
        path == Path(taint.what) or path in Path(taint.what).parents
        for path in _beside(loaded_module, entries)
    )


def _beside(module: ModuleType, entries: list[str]) -> Iterator[Path]:
    """Yield the files and folders that a module declares beside itself."""
    file = getattr(module, "__file__", None)
    if file is not None:
        yield from (Path(file).resolve().parent / entry for entry in entries)


# --- own hook -------------------------------------------------------------------------------------

# Observed hook of an own node that runs before its step: what the hook reads may stay in a memo of
# its module.


def call_hook(node: Node, hook: Callable[[], T], params: Mapping[str, Any]) -> T:
    """Return what a hook of an own node returns; taint own modules by what it reaches beyond the
    parameters.
    """
    module_name = node.fn.__module__
    files = frozenset(Path(os.path.realpath(file)) for file in files_in(params))
    value, taints = observed(hook, Covered(files, lambda _: True))
    free_names = {entry.removeprefix(FREE) for entry in node.depends}
    undeclared_taints = [
        reached
        for reached in taints
        if not (
            free_names & {reached.kind, reached.what, Path(reached.what).name}
            or declares(module_name, reached)
        )
    ]
    if undeclared_taints:
        # any own module may read what the hook left
        taint_code({module_name, *own_modules()}, tuple(undeclared_taints))
        for reached in undeclared_taints:
            text = (
                f"a hook of {node.path} {WORDS[reached.kind]} {reached.what},"
                " which no cache key covers"
            )
            say_once(
                module_name,
                f"{text}: the results of own nodes are not stored; to have them stored,"
                f" {reached.fix}",
            )
    return value
