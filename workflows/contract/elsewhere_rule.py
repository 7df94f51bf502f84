"""Rule on surroundings: the same call in other processes, of which everything around the call is changed."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neusee.nodes.own_modules import own_files
from neusee.workflows.contract.elsewhere_client import Elsewhere, NotStartedError
from neusee.workflows.contract.elsewhere_process import Asked
from neusee.workflows.contract.finding import Finding
from neusee.workflows.contract.outcomes import Difference, Outcome, difference, outcome_of
from neusee.workflows.contract.surroundings import FRESH, HASH, THREADS, VARIABLES, WORK, Others, Surrounding

RULE = "elsewhere"
_MORE_SEEDS = 3  #: hash seeds that are tried where two gave the same order: a set of two words has only two orders
_UNSTEADY = "two processes in the same surroundings differ, so draw from the argument rng and read no clock:"

Changes = frozenset[Surrounding]
Found = dict[str, Outcome]  #: by the name of the call


@dataclass(frozen=True, slots=True)
class Tried:
    """One call that is tried elsewhere: of a node, or of a network."""

    name: str
    module: str  #: of its code
    place: str  #: file and line of its code
    rtol: float
    function: Callable[[], Any]  #: which another process imports
    declared: Mapping[str, str]  #: variables of the environment that its key covers


class Trial:
    """The calls, their outcomes here, and the processes in which they are made again."""

    def __init__(self, tried: Sequence[Tried], others: Others) -> None:
        self.others = others
        self.findings = dict[str, Finding]()  #: by the name of the call
        self._pickled = dict[str, bytes]()
        for each in tried:
            try:
                self._pickled[each.name] = pickle.dumps(each.function)
            except Exception as error:
                text = f"not tried: its example cannot be sent to another process: {type(error).__name__}: {error}"
                self.findings[each.name] = Finding(RULE, None, text)
        self._tried = {each.name: each for each in tried if each.name in self._pickled}
        self._here: Found = {}
        self._processes = dict[Changes, Elsewhere]()  # by what only a new process can have

    def compare(self, first: Elsewhere) -> None:
        """Find what differs in the process ``first``, in which all is changed, and then what decides it."""
        with ExitStack() as self._stack:
            self._compare(first)

    def _compare(self, first: Elsewhere) -> None:
        away = self._outcomes(first, frozenset(self.others.changed()))
        self._leave_out_ends([name for name, outcome in away.items() if outcome.is_end])
        self._here = {name: outcome_of(each.function, each.module) for name, each in self._tried.items()}
        open_names = list[str]()
        for name, here in self._here.items():
            if here.failure:
                self.findings[name] = Finding(RULE, None, "not tried: the example fails here")
            elif self._difference(name, away[name], here):
                open_names.append(name)
            else:
                self._say_same(name)
        self._settle_rounding(open_names, away)
        self._settle_others([name for name in open_names if name not in self.findings])

    def ends(self, name: str) -> bool:
        """Return True if a call ends its process also in the same surroundings, so that it is not made here."""
        return name not in self._here and name in self._pickled

    # --- processes ----------------------------------------------------------------------------------------------------

    def _outcomes(self, process: Elsewhere, changes: Changes, others: Others | None = None) -> Found:
        """Return the outcome of each call in a process, in the other order where other work is changed."""
        names = [*self._tried]
        if WORK in changes:
            names.reverse()
        declared = {name: value for each in self._tried.values() for name, value in each.declared.items()}
        settings = (others or self.others).settings(changes, Path(process.folder.name), declared)
        calls = tuple((self._tried[name].module, self._pickled[name]) for name in names)
        return dict(zip(names, process.outcomes(Asked(settings, own_files(), calls)), strict=True))

    def _each(self, *sets: Iterable[Surrounding]) -> list[Found]:
        """Return the outcomes for each set of changes; the processes that they need start at the same time."""
        changes = [frozenset(each) for each in sets]
        for each in changes:
            if each & FRESH not in self._processes:
                self._processes[each & FRESH] = self._stack.enter_context(closing(Elsewhere(self.others, each)))
        return [self._outcomes(self._processes[each & FRESH], each) for each in changes]

    # --- what decides -------------------------------------------------------------------------------------------------

    def _leave_out_ends(self, names: list[str]) -> None:
        """Find whether calls that ended their process end it in the same surroundings; these are not made here."""
        if not names:
            return
        [same] = self._each(())
        for name in names:
            if same[name].is_end:
                self._fail(name, f"the call {same[name].failure}; the rules on values were not tried")
                del self._tried[name]

    def _settle_rounding(self, names: list[str], away: Found) -> None:
        """Say which results differ by rounding alone, and with the number of threads alone."""
        sizes = dict[str, float]()
        for name in names:
            found = self._difference(name, away[name], self._here[name])
            if found and found.is_rounding:
                sizes[name] = found.size
        if not sizes:
            return
        [others] = self._each(set(self.others.changed()) - {THREADS})
        for name, size in sizes.items():
            if not self._difference(name, others[name], self._here[name]):
                self._say_same(name, size)

    def _settle_others(self, names: list[str]) -> None:
        """Say for each result which surroundings it depends on, one by one."""
        if not names:
            return
        changed = self.others.changed()
        same, *singles = self._each((), *([each] for each in changed))
        unsteady = {name: one for name in names if (one := self._difference(name, same[name], self._here[name]))}
        again = self._each(())[0] if unsteady else same
        for name in names:
            if found := self._difference(name, again[name], same[name]):
                self._fail(name, f"{_UNSTEADY} {found.text}; other surroundings were not compared", found.place)
                continue
            for surrounding, outcomes in zip(changed, singles, strict=True):
                found = self._difference(name, outcomes[name], same[name])
                if found and not (surrounding is THREADS and found.is_rounding):
                    variables = self._deciding(name, same) if surrounding is VARIABLES else []
                    self._fail_in(name, surrounding, found, variables)
        self._settle_hidden([name for name in names if name not in self.findings], same, unsteady)

    def _deciding(self, name: str, same: Found) -> list[str]:
        """Return the variables of the environment without any of which a result differs, by halving."""
        process = self._processes[frozenset()]
        todo, deciding = [self.others.variables], list[str]()
        while todo:
            few = todo.pop()
            found = self._outcomes(process, frozenset({VARIABLES}), replace(self.others, variables=few))
            if not few or not self._difference(name, found[name], same[name]):
                continue
            if len(few) == 1:
                deciding += few
            else:
                todo += [few[: len(few) // 2], few[len(few) // 2 :]]
        return sorted(deciding)

    def _settle_hidden(self, names: list[str], same: Found, unsteady: Mapping[str, Difference]) -> None:
        """Say what decides where no surrounding that was changed alone does."""
        if not names:
            return
        for seed in range(_MORE_SEEDS):
            others = replace(self.others, hash_seed=self.others.hash_seed + 1 + seed)
            with closing(Elsewhere(others, frozenset({HASH}))) as process:
                found = self._outcomes(process, frozenset({HASH}))
            for name in names:
                one = self._difference(name, found[name], same[name])
                if one and name not in self.findings:
                    self._fail_in(name, HASH, one)
        for name in names:
            if name in self.findings:
                continue
            if name in unsteady:
                found_text = f"in a process that has done nothing else, {unsteady[name].text}: {WORK.fix}"
                self._fail(name, found_text, unsteady[name].place)
            else:
                self._fail(name, f"with all of these changed together, but none alone: {self.others.said()}")

    # --- words --------------------------------------------------------------------------------------------------------

    def _difference(self, name: str, found: Outcome, wanted: Outcome) -> Difference | None:
        return difference(found, wanted, self._tried[name].rtol)

    def _say_same(self, name: str, rounding: float = 0.0) -> None:
        count = len(self.others.changed()) - (rounding > 0)
        text = f"the same bits in {count} changed surroundings: {self.others.said(without_threads=rounding > 0)}"
        if rounding:
            text += f"; equal to rounding with {self.others.in_threads()} ({rounding:.1g} of the largest value)"
        self.findings[name] = Finding(RULE, True, f"{text}; the clock was not changed")

    def _fail_in(self, name: str, surrounding: Surrounding, found: Difference, variables: Sequence[str] = ()) -> None:
        differs = self.others.differs(surrounding, variables)
        fix = surrounding.fix.replace("NAME", variables[0]) if variables else surrounding.fix
        self._fail(name, f"{differs} {found.text}: {fix}", found.place)

    def _fail(self, name: str, text: str, place: str = "") -> None:
        """Add a sentence on a call; several surroundings make several sentences."""
        before = f"{self.findings[name].text}; " if name in self.findings else ""
        self.findings[name] = Finding(RULE, False, f"{before}{place or self._tried[name].place}: {text}")


def check_elsewhere(tried: Sequence[Tried], process: Callable[[], Elsewhere]) -> tuple[dict[str, Finding], set[str]]:
    """Return what was found on each call, by name, and the names of those that may not be called here.

    ``process`` returns a process in which all surroundings are changed.
    """
    if not tried:
        return {}, set()
    try:
        first = process()
        trial = Trial(tried, first.others)
        trial.compare(first)
    except NotStartedError as error:
        return {each.name: Finding(RULE, None, f"not tried: {error}") for each in tried}, set()
    return trial.findings, {each.name for each in tried if trial.ends(each.name)}
