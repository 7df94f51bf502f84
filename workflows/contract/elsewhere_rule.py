"""Rule on surroundings: a call must give the same result in processes with other surroundings."""

from __future__ import annotations

import decimal
import faulthandler
import inspect
import locale
import multiprocessing
import os
import pickle
import random
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from neusee.nodes.own_modules import Architecture, import_missing, own_files
from neusee.nodes.restore import own_network
from neusee.workflows.contract.node_rules import (
    Call,
    Difference,
    Finding,
    Outcome,
    difference,
    failed,
    outcome_of,
)
from neusee.workflows.contract.surroundings import (
    HASH,
    OF_NEW_PROCESSES,
    THREADS,
    VARIABLES,
    WORK,
    Elsewhere,
    NotStartedError,
    OtherSurroundings,
    Settings,
    Surrounding,
)
from neusee.workflows.keys.code_digest import Code

# --- elsewhere process ----------------------------------------------------------------------------

# Code that runs in a process with other surroundings: its forked processes import the modules of
# the calls, and send the outcomes.


#: s of a call, after which the forked process ends: the process that asked waits for less, so that
#: it must have ended
_LONGEST_TRIAL = 600
_SIDE = 64  #: of the matrices of unrelated work
_errors: list[object] = [None]  #: NumPy's reaction to errors, as this process has set it last


@dataclass(frozen=True, slots=True)
class Asked:
    """Request to a process: the calls to make, each pickled as a function without arguments, with
    the module of its code.
    """

    settings: Settings
    files: tuple[str, ...]  #: files and folders of the user to import
    calls: tuple[tuple[str, bytes], ...]


def serve(pipe: int) -> None:
    """Answer the requests that come through the pipe with the file descriptor ``pipe``, until its
    other end is closed.

    Each answer comes from a new forked process, which has imported no code of the user before. The
    answer ends with the exit code of this process.
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
                # the exit code in place of an outcome: the forked process has ended
                connection.send_bytes(pickle.dumps(process.exitcode))
        except (EOFError, OSError):
            return


def _answer(connection: Connection, asked: Asked) -> None:
    """Send the outcome of each call, in the order of the request."""
    _settle(asked.settings)
    for module, pickled in asked.calls:
        faulthandler.dump_traceback_later(_LONGEST_TRIAL, exit=True)
        connection.send_bytes(pickle.dumps(_called(asked, module, pickled)))
        faulthandler.cancel_dump_traceback_later()


def _called(asked: Asked, module: str, pickled: bytes) -> Outcome:
    """Return the outcome of one call, made after changes of the state that other code may change
    between two calls.
    """
    _disturb(asked.settings)
    try:
        import_missing(asked.files, module)
        function = pickle.loads(pickled)
    except (Exception, SystemExit) as error:
        import_outcome = failed(error, module)
        return Outcome(
            failure=f"cannot be imported: it {import_outcome.failure}", place=import_outcome.place
        )
    _disturb(asked.settings)  # again, as the import may have changed it back
    return outcome_of(function, module)


def _settle(settings: Settings) -> None:
    """Change the surroundings that are set once: working folder, environment variables, time zone,
    locale, and number of threads of torch.
    """
    for name, value in settings.variables.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    # TZ may be among the variables
    time.tzset()
    if settings.folder:
        os.chdir(settings.folder)
    if settings.has_locale:
        locale.setlocale(locale.LC_ALL, "")
    if settings.threads:
        torch.set_num_threads(settings.threads)


def _disturb(settings: Settings) -> None:
    """Change the state that other code may change between two calls: earlier work, random
    generators, NumPy's reaction to errors.
    """
    if settings.has_other_work:
        _work()
    if settings.has_other_states:
        torch.manual_seed(4711)
        np.random.seed(4711)
        random.seed(4711)
    # only once, so that a second call does not change it back
    if settings.has_other_errors and np.geterr() != _errors[0]:
        np.seterr(
            **{
                name: "ignore" if reaction == "raise" else "raise"
                for name, reaction in np.geterr().items()
            }
        )
        _errors[0] = np.geterr()


def _work() -> None:
    """Do work as other steps may have done before: computations, and changes of the settings of
    libraries.
    """
    matrix = torch.full((_SIDE, _SIDE), 3.0)
    torch.fft.fft2(matrix @ matrix).abs().sort()
    np.linalg.svd(np.full((_SIDE, _SIDE), 7.0))
    np.set_printoptions(precision=3, suppress=True)
    torch.set_printoptions(precision=2)  # type: ignore[no-untyped-call]
    decimal.getcontext().prec = 9


# --- elsewhere rule -------------------------------------------------------------------------------

# Rule on surroundings: the same call in other processes, with everything around the call changed.


RULE = "elsewhere"
#: further hash seeds that are tried, because a set of two words has only two orders
_MORE_SEEDS = 3
_UNSTEADY = (
    "two processes in the same surroundings differ, so draw from the argument rng and read no"
    " clock:"
)

Changes = frozenset[Surrounding]
Outcomes = dict[str, Outcome]  #: by the name of the call


@dataclass(frozen=True, slots=True)
class Tried:
    """Call of a node or of a network that is made again in other processes."""

    name: str
    module: str  #: of its code
    place: str  #: file and line of its code
    rtol: float
    function: Callable[[], Any]  #: which another process imports
    declared: Mapping[str, str]  #: variables of the environment that its key covers


class Trial:
    """The calls, their outcomes here, and the processes in which they are made again."""

    def __init__(self, tried: Sequence[Tried], others: OtherSurroundings) -> None:
        self.others = others
        self.findings = dict[str, Finding]()  #: by the name of the call
        self._pickled = dict[str, bytes]()
        for call in tried:
            try:
                self._pickled[call.name] = pickle.dumps(call.function)
            except Exception as error:
                text = (
                    "not tried: its example cannot be sent to another process:"
                    f" {type(error).__name__}: {error}"
                )
                self.findings[call.name] = Finding(RULE, None, text)
        self._tried = {call.name: call for call in tried if call.name in self._pickled}
        self._outcomes_here: Outcomes = {}
        self._processes = dict[Changes, Elsewhere]()  # by the changes that need a new process

    def compare(self, first: Elsewhere) -> None:
        """Find the results that differ in the process ``first``, in which all surroundings are
        changed, and then the surroundings that cause this.
        """
        with ExitStack() as self._stack:
            self._compare(first)

    def _compare(self, first: Elsewhere) -> None:
        """Find the results that differ, and then the causes; see `compare`."""
        outcomes_away = self._outcomes(first, frozenset(self.others.changed()))
        # before the calls here, since a call that ends its process would end this one
        self._leave_out_ends([name for name, outcome in outcomes_away.items() if outcome.is_end])
        self._outcomes_here = {
            name: outcome_of(call.function, call.module) for name, call in self._tried.items()
        }
        differing_names = list[str]()
        for name, outcome_here in self._outcomes_here.items():
            if outcome_here.failure:
                self.findings[name] = Finding(RULE, None, "not tried: the example fails here")
            elif self._difference(name, outcomes_away[name], outcome_here):
                differing_names.append(name)
            else:
                self._say_same(name)
        self._settle_rounding(differing_names, outcomes_away)
        self._settle_others([name for name in differing_names if name not in self.findings])

    def ends(self, name: str) -> bool:
        """Return True if the call of a node ended a child process whose environment was unchanged;
        such a call is not made in this process.
        """
        return name not in self._outcomes_here and name in self._pickled

    # --- processes --------------------------------------------------------------------------------

    def _outcomes(
        self, process: Elsewhere, changes: Changes, others: OtherSurroundings | None = None
    ) -> Outcomes:
        """Return the outcome of each call in a process; the calls are made in reverse order if the
        order of work is changed.
        """
        names = [*self._tried]
        if WORK in changes:
            names.reverse()
        declared: dict[str, str] = {}
        for call in self._tried.values():
            declared |= call.declared
        settings = (others or self.others).settings(changes, Path(process.folder.name), declared)
        calls = tuple((self._tried[name].module, self._pickled[name]) for name in names)
        # by name, whatever the order of the calls
        return dict(zip(names, process.outcomes(Asked(settings, own_files(), calls)), strict=True))

    def _outcomes_of_each(self, sets: Sequence[Iterable[Surrounding]]) -> list[Outcomes]:
        """Return the outcomes for each set of changes; the processes that they need start at the
        same time.
        """
        change_sets = [frozenset(change_set) for change_set in sets]
        for change_set in change_sets:
            # sets of changes with the same changes that need a new process share this process
            if change_set & OF_NEW_PROCESSES not in self._processes:
                self._processes[change_set & OF_NEW_PROCESSES] = self._stack.enter_context(
                    closing(Elsewhere(self.others, change_set))
                )
        return [
            self._outcomes(self._processes[change_set & OF_NEW_PROCESSES], change_set)
            for change_set in change_sets
        ]

    # --- what decides -----------------------------------------------------------------------------

    def _leave_out_ends(self, names: list[str]) -> None:
        """Find whether calls that ended their process end it in the same surroundings; these are
        not made here.
        """
        if not names:
            return
        # without a change
        [outcomes_in_same] = self._outcomes_of_each([()])
        for name in names:
            if outcomes_in_same[name].is_end:
                self._fail(
                    name,
                    f"the call {outcomes_in_same[name].failure}; the rules on values were not"
                    " tried",
                )
                del self._tried[name]

    def _settle_rounding(self, names: list[str], away: Outcomes) -> None:
        """Record the results that differ by rounding alone, and only with another number of
        threads.
        """
        rounding_errors = dict[str, float]()
        for name in names:
            deviation = self._difference(name, away[name], self._outcomes_here[name])
            if deviation and deviation.is_rounding:
                rounding_errors[name] = deviation.size
        if not rounding_errors:
            return
        # all changes but the number of threads, which may change rounding
        [outcomes_of_others] = self._outcomes_of_each([set(self.others.changed()) - {THREADS}])
        for name, size in rounding_errors.items():
            if not self._difference(name, outcomes_of_others[name], self._outcomes_here[name]):
                self._say_same(name, size)

    def _settle_others(self, names: list[str]) -> None:
        """Record on which surroundings each result depends, with one of them changed at a time."""
        if not names:
            return
        changed = self.others.changed()
        outcomes_in_same, *outcomes_by_surrounding = self._outcomes_of_each(
            [(), *([surrounding] for surrounding in changed)]
        )
        differing_from_here = self._differences(names, outcomes_in_same, self._outcomes_here)
        # the same surroundings a second time: what differs now depends on chance or a clock
        second_outcomes = (
            self._outcomes_of_each([()])[0] if differing_from_here else outcomes_in_same
        )
        for name in names:
            if deviation := self._difference(name, second_outcomes[name], outcomes_in_same[name]):
                self._fail(
                    name,
                    f"{_UNSTEADY} {deviation.text}; other surroundings were not compared",
                    deviation.place,
                )
            else:
                for surrounding, outcomes in zip(changed, outcomes_by_surrounding, strict=True):
                    self._settle_one(name, surrounding, outcomes, outcomes_in_same)
        self._settle_hidden(
            [name for name in names if name not in self.findings],
            outcomes_in_same,
            differing_from_here,
        )

    def _settle_one(
        self, name: str, surrounding: Surrounding, outcomes: Outcomes, same: Outcomes
    ) -> None:
        """Record if a result depends on one surrounding; for the number of threads, by more than
        rounding.
        """
        deviation = self._difference(name, outcomes[name], same[name])
        if deviation and not (surrounding is THREADS and deviation.is_rounding):
            variables = self._deciding(name, same) if surrounding is VARIABLES else []
            self._fail_in(name, surrounding, deviation, variables)

    def _differences(
        self, names: Iterable[str], actual: Outcomes, expected: Outcomes
    ) -> dict[str, Difference]:
        """Return the differences of the outcomes that differ, by name."""
        pairs = ((name, self._difference(name, actual[name], expected[name])) for name in names)
        return {name: deviation for name, deviation in pairs if deviation}

    def _deciding(self, name: str, same: Outcomes) -> list[str]:
        """Return the environment variables each of which changes a result if it is left out, found
        by bisection.
        """
        process = self._processes[frozenset()]
        sets_left, deciding = [self.others.variables], list[str]()
        while sets_left:
            left_out = sets_left.pop()
            outcomes = self._outcomes(
                process, frozenset({VARIABLES}), replace(self.others, variables=left_out)
            )
            # none of these variables decides
            if not left_out or not self._difference(name, outcomes[name], same[name]):
                continue
            if len(left_out) == 1:
                deciding += left_out
            else:
                # two halves
                sets_left += [left_out[: len(left_out) // 2], left_out[len(left_out) // 2 :]]
        return sorted(deciding)

    def _settle_hidden(
        self, names: list[str], same: Outcomes, unsteady: Mapping[str, Difference]
    ) -> None:
        """Record the cause of differences that no single change of the surroundings explains."""
        if not names:
            return
        # two seeds may give the same order of a small set
        for seed in range(_MORE_SEEDS):
            other_seed = replace(self.others, hash_seed=self.others.hash_seed + 1 + seed)
            with closing(Elsewhere(other_seed, frozenset({HASH}))) as process:
                outcomes = self._outcomes(process, frozenset({HASH}))
            for name in names:
                deviation = self._difference(name, outcomes[name], same[name])
                if deviation and name not in self.findings:
                    self._fail_in(name, HASH, deviation)
        for name in names:
            if name in self.findings:
                continue
            # the call here, after other calls, differs from the call in a new process
            if name in unsteady:
                text = f"in a process that has done nothing else, {unsteady[name].text}: {WORK.fix}"
                self._fail(name, text, unsteady[name].place)
            else:
                self._fail(
                    name,
                    "with all of these changed together, but none alone:"
                    f" {self.others.described()}",
                )

    # --- words ------------------------------------------------------------------------------------

    def _difference(self, name: str, outcome: Outcome, expected: Outcome) -> Difference | None:
        """Return how an outcome of a call differs from the expected one, or None if it is equal."""
        return difference(outcome, expected, self._tried[name].rtol)

    def _say_same(self, name: str, rounding: float = 0.0) -> None:
        """Record that a call gives the same in other surroundings; ``rounding`` is its relative
        error with another number of threads.
        """
        count = len(self.others.changed()) - (rounding > 0)
        text = (
            f"the same bits in {count} changed surroundings:"
            f" {self.others.described(without_threads=rounding > 0)}"
        )
        if rounding:
            text += (
                f"; equal to rounding with {self.others.in_threads()} ({rounding:.1g} of the"
                " largest value)"
            )
        self.findings[name] = Finding(RULE, True, f"{text}; the clock was not changed")

    def _fail_in(
        self,
        name: str,
        surrounding: Surrounding,
        deviation: Difference,
        variables: Sequence[str] = (),
    ) -> None:
        """Record that a call depends on a surrounding, and on these environment variables."""
        differs = self.others.differs(surrounding, variables)
        fix = surrounding.fix.replace("NAME", variables[0]) if variables else surrounding.fix
        self._fail(name, f"{differs} {deviation.text}: {fix}", deviation.place)

    def _fail(self, name: str, text: str, place: str = "") -> None:
        """Add a sentence on a call; several surroundings make several sentences."""
        earlier_text = f"{self.findings[name].text}; " if name in self.findings else ""
        self.findings[name] = Finding(
            RULE, False, f"{earlier_text}{place or self._tried[name].place}: {text}"
        )


def check_elsewhere(
    tried: Sequence[Tried], process: Callable[[], Elsewhere]
) -> tuple[dict[str, Finding], set[str]]:
    """Return the finding on each call, by name, and the names of the calls that must not be made
    here.

    ``process`` returns a process in which all surroundings are changed.
    """
    if not tried:
        return {}, set()
    try:
        changed_process = process()
        trial = Trial(tried, changed_process.others)
        trial.compare(changed_process)
    except NotStartedError as error:
        return {call.name: Finding(RULE, None, f"not tried: {error}") for call in tried}, set()
    return trial.findings, {call.name for call in tried if trial.ends(call.name)}


# --- tried calls ----------------------------------------------------------------------------------

# Calls of nodes and networks as another process makes them: pickled, with full paths, and with the
# environment variables that keys cover.


_TRIED_SIDE = 32  #: pixels of a picture
_VARIABLE = "env:"  #: begins the declaration of a variable of the environment


def node_call(name: str, call: Call) -> Tried:
    """Return the call of a node's example; files of its parameters are named by their full
    paths.
    """
    call_with_full_paths = Call(
        call.node, call.inputs, {key: _with_full_paths(value) for key, value in call.params.items()}
    )
    return _tried(
        name, call.node.fn, call.node.rtol, call_with_full_paths.result, call.node.depends
    )


def network_call(name: str, network: type[nn.Module]) -> Tried:
    """Return the call of a network, built with its defaults, on a small picture."""
    rtol = 1e-5  # as a node by default
    return _tried(name, network, rtol, partial(_on_a_picture, Architecture(name, network)), ())


def _tried(
    name: str, code: Any, rtol: float, function: Callable[[], Any], depends: tuple[str, ...]
) -> Tried:
    """Return a call to try elsewhere, with the variables of the environment that its code
    declares.
    """
    module = code.__module__
    variables = [*depends, *_declarations(module)]
    names = {entry.removeprefix(_VARIABLE) for entry in variables if entry.startswith(_VARIABLE)}
    declared = {
        variable: os.environ[variable] for variable in sorted(names) if variable in os.environ
    }
    return Tried(name, module, _place(code), rtol, function, declared)


def _declarations(module: str) -> Iterator[str]:
    """Yield the dependences that a module, and the modules that it imports, declare."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            looks = Code(Path(folder) / "code.json").looks(module)
        except LookupError:
            return  # the rule on the key says so
    for look in looks.values():
        yield from look.summary.depends if look.summary else ()


def _with_full_paths(value: Any) -> Any:
    """Return a parameter with full paths, since another process has another working folder."""
    if isinstance(value, Path):
        return value.absolute()
    return type(value)(map(_with_full_paths, value)) if type(value) in (tuple, list) else value


def _on_a_picture(architecture: Architecture) -> torch.Tensor:
    """Return the result of a network with its first weights on a pseudo-random picture."""
    net = own_network(architecture, None, None).eval()
    picture = torch.rand(
        1,
        3,
        # odd sides, as a picture may have
        _TRIED_SIDE + 1,
        _TRIED_SIDE + 3,
        generator=torch.Generator().manual_seed(3),
    )
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        result: torch.Tensor = net(picture)
    return result


def _place(code: Any) -> str:
    """Return file and line of a function or class, or its module."""
    try:
        first_line = inspect.getsourcelines(inspect.unwrap(code))[1]
        return f"{Path(inspect.getfile(inspect.unwrap(code))).name}:{first_line}"
    except (OSError, TypeError):
        return str(code.__module__)
