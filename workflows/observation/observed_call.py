"""Observed calls, imports and hooks of code of the user, and the dependencies that their keys do
not cover (taints).
"""

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

# Observed call of a step of the user: its value, and its dependencies that the key does not cover.


T = TypeVar("T")
#: lock for one observed call at a time, since hooks and generators belong to the process
_turn = [threading.Lock()]
#: interval (s) at which a waiting caller checks for an exception that another thread raised in it
_LOOK = 0.05


def observed(
    function: Callable[[], T],
    covered: Covered,
    state: Callable[[], Callable[[], list[Taint]]] | None = None,
) -> tuple[T, tuple[Taint, ...]]:
    """Return the value of a function, and its dependencies that are not covered (taints).

    ``state`` is called before the call and returns a function that lists the changes after it.

    The function runs in a new thread, under the same conditions as its caller, and its exceptions
    pass unchanged. If the watching server dies meanwhile, system calls of the function fail, so the
    function is called again: it must itself create whatever it uses up, such as a generator. An
    observed call within an observed call is a part of it, without taints.
    """
    # an observed call inside another one is part of the outer call
    if python_watch.watch_here() is not None:
        return function(), ()
    with one_at_a_time():
        # returns, after the call, the changes that it left in modules
        left_taints = state() if state is not None else list[Taint]
        step, taints = _observed(function, covered)
        taints += tuple(left_taints())
    return step.value(), taints


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """Wait until no other thread of this process observes a call."""
    turn = _turn[0]
    # wakes regularly, so that Ctrl-C takes effect
    while not turn.acquire(timeout=_LOOK):
        pass
    try:
        yield
    finally:
        turn.release()


@contextmanager
def watched_in_fork() -> Iterator[Callable[[], None]]:
    """Yield a function that a forked process calls first, so that the kernel watches it as it would
    watch this process.

    Only one fork is observed at a time, and this process waits for it: see `one_at_a_time`.
    """
    server, succeeded = kernel_layer.begun_for_fork(), False

    def begin() -> None:
        if server is not None:
            # in that case the call reports that it is not watched
            with suppress(OSError, ValueError):
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
    """Return the result of an import function, and the taints of the module bodies that run
    meanwhile.

    A module that is already loaded is not executed again and has no taints: observe its first
    import.
    """
    return observed(load, covered)


def _observed(
    function: Callable[[], T], covered: Covered
) -> tuple[StepThread[T], tuple[Taint, ...]]:
    """Return the finished step and its taints. If observation through the kernel fails, the step
    runs again without it.
    """
    reason_unwatched = ""
    if not kernel_layer.missing():
        try:
            client = kernel_layer.client()
            step, watch = _run(function, client)
            return step, _judged(watch, covered, client.records())
        except NoServer as error:
            reason_unwatched = str(error)
    # without the kernel, perhaps for a second time
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
    # the kernel's filter is installed in the thread of the step
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
        # draws that show only in a comparison of states
        watch.draws.update(shared_generators.drawn(), watch.kept.changed())
    if step.unprepared is not None:
        raise step.unprepared
    return step, watch


def _judged(watch: Watch, covered: Covered, records: list[Record]) -> tuple[Taint, ...]:
    """Return the taints of an observed call, from the records of the kernel and of Python."""
    chance_sources = watch.chance()
    if not any((records, watch.bodies, watch.settings, chance_sources)):
        return ()
    quiet_paths = {path for path, is_quiet in watch.quiet.items() if is_quiet}
    judgement = Judgement(covered, watch.bodies, quiet_paths, watch.temporary)
    # if Python has named the source of random numbers, the record of the kernel would repeat it
    judgement.judge(record for record in records if record.does != "entropy" or not chance_sources)
    judgement.judge(Record("input", path) for path in sorted(watch.settings) if decides(path))
    judgement.judge_modules()
    for source in sorted(chance_sources):
        judgement.add("random", source)
    return judgement.taints()


def _in_child() -> None:
    """Prepare a forked process for observed calls of its own, unless it is part of the observed
    call.
    """
    _turn[0] = threading.Lock()
    if python_watch.watch_here() is None:
        python_watch.end()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)


# --- own call -------------------------------------------------------------------------------------

# Observed call of code of the user: its taints, without those that its author states to affect no
# result.

#: verb of a message for each kind of taint; the name follows
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
    """Return the value of a function of the user's code, and its dependencies that the key does not
    cover.
    """
    covered = Covered(frozenset(map(Path, own.files)), own.followed.__contains__)
    value, taints = observed(function, covered, lambda: watch_state(own))
    return value, [taint for taint in taints if not own.free & _words_of(taint)]


def tainted_modules(own: OwnCode, taints: Iterable[Taint]) -> frozenset[str]:
    """Return the modules of the user that a taint may affect: all of them if a library or a setting
    was changed.
    """
    if any(is_of_library(reached, own) for reached in taints):
        return own.modules.union(own_modules())
    return own.modules


def undeclared(own: OwnCode, asked: Asked) -> list[Taint]:
    """Return a taint for each environment variable that code of the user read and that its key does
    not cover.
    """
    taints = [taint("variable", name) for name in asked.of_own_code]
    return [variable for variable in taints if not own.free & _words_of(variable)]


def say_lost(module: str, left: Iterable[Taint]) -> None:
    """Warn of changes that code of the user made in a separate process, where no other step finds
    them.
    """
    for change in left:
        text = (
            f"{module} changes {change.what}, and no other step finds the change, since its steps"
            " compute in processes"
        )
        say_once(module, f"{text} of their own: {change.fix.partition(', or')[0]}")


def say_hidden(module: str, asked: Asked, free: Collection[str] = ()) -> None:
    """Warn which environment variables are set but hidden from the libraries that code of the user
    calls.
    """
    names = [name for name in asked.of_libraries if name not in free]
    if names:
        text = (
            f"libraries that {module} uses do not find {', '.join(names)} of the environment, which"
            " no cache key has"
        )
        say_once(module, f'{text}; if it decides a result, declare it, depends=["env:{names[0]}"]')


def _words_of(reached: Taint) -> set[str]:
    """Return the words with which an author can state that a taint affects no result."""
    return {reached.kind, reached.what, Path(reached.what).name, reached.what.rpartition(".")[2]}


# --- own import -----------------------------------------------------------------------------------

# Observed import of modules of the user: what they read at import stays in them, and no later call
# shows it.


#: the declaration of an environment variable in source
_VARIABLE = re.compile(rb"[\"']env:(\w+)[\"']")


def import_observed(name: str) -> ModuleType:
    """Import a module of the user, and taint all modules that this loads if the import depends on
    something no key covers.

    A dependency that ``__depends__`` declares is no taint. A module that is already loaded is not
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
    # only modules of the user
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
    """Return True if one of the modules declares a taint as a dependency."""
    return any(declares(module, reached) for module in modules)


@contextmanager
def _hidden(name: str) -> Iterator[Asked]:
    """Hide environment variables from the libraries that a module imports, unless other libraries
    run threads in this process.
    """
    if not is_alone():
        yield Asked()
        return
    with hidden_while_importing(_declared_variables(name)) as asked_variables:
        yield asked_variables


def _declared_variables(name: str) -> frozenset[str]:
    """Return the environment variables that a module, or one beside or below it, declares; the
    module is not imported for this.
    """
    spec = importlib.util.find_spec(name)
    if spec is None or not spec.has_location or spec.origin is None:
        return frozenset()
    folder = Path(spec.origin).parent
    # in a package, files at any depth
    sources = folder.rglob("*.py") if spec.submodule_search_locations else folder.glob("*.py")
    names = set[str]()
    for source in sources:
        if source.is_file():
            names.update(variable.decode() for variable in _VARIABLE.findall(bytes_of(source)))
    return frozenset(names)


def declares(module: str, taint: Taint) -> bool:
    """Return True if the ``__depends__`` of a module declares a taint as a dependency."""
    loaded_module = sys.modules[module]
    entries = [
        entry for entry in getattr(loaded_module, "__depends__", ()) if isinstance(entry, str)
    ]
    free_names = {entry.removeprefix(FREE) for entry in entries if entry.startswith(FREE)}
    # declared by kind, by path or by file name
    if free_names & {taint.kind, taint.what, Path(taint.what).name}:
        return True
    return any(
        path == Path(taint.what) or path in Path(taint.what).parents
        for path in _beside(loaded_module, entries)
    )


def _beside(module: ModuleType, entries: list[str]) -> Iterator[Path]:
    """Yield the paths, beside a module, that its entries name."""
    file = getattr(module, "__file__", None)
    if file is not None:
        yield from (Path(file).resolve().parent / entry for entry in entries)


# --- own hook -------------------------------------------------------------------------------------

# Observed hook of a node of the user. It runs before the step, and what it reads may stay in a
# cache of its module.


def call_hook(node: Node, hook: Callable[[], T], params: Mapping[str, Any]) -> T:
    """Return the result of a hook of a node of the user; taint modules of the user if the hook
    depends on more than the parameters.
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
        # any module of the user may read what the hook left
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
