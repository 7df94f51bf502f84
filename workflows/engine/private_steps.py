"""Steps whose results hold for this process alone, since own code was seen to read what its key does not cover."""

from __future__ import annotations

from neusee.workflows.engine.step_job import Outcome
from neusee.workflows.keys.loaded_source import say_once
from neusee.workflows.keys.tainted_code import taint_code
from neusee.workflows.observation.own_call import WORDS, tainted_modules


class TaintedRun(Exception):
    """Signal of a run whose keys no longer hold: an own step reached what its key does not cover.

    The run begins again with private keys for this code and for all that follows from it.
    """

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome.work.step.name)
        self.outcome = outcome


def refuse_taints(outcome: Outcome) -> None:
    """Taint the code of a step that was seen to reach what its key does not cover; say so, and raise `TaintedRun`.

    A step whose code was tainted before has a private key, and its run goes on.
    """
    if not outcome.taints or outcome.work.own is None:
        return
    step = outcome.work.step
    for taint in outcome.taints:
        text = f"{step.name} ({step.node.path}): {WORDS[taint.kind]} {taint.what}, which its cache key does not cover"
        say_once(
            step.node.fn.__module__,
            f"{text}: its result, and all that follow, are not stored. {taint.fix[0].upper()}{taint.fix[1:]}",
        )
    if taint_code(tainted_modules(outcome.work.own, outcome.taints), outcome.taints):
        raise TaintedRun(outcome)
