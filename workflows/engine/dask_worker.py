"""The side of a worker of `dask.distributed`: it computes chains of steps, and returns outcomes without values.

The worker reads values by key from the store, or takes values of earlier tasks from memory, and writes the last result
of the chain to the store.
"""

from __future__ import annotations

import random
import sys
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, get_args, get_origin

import torch

from neusee.nodes.own_modules import own_modules
from neusee.workflows.engine.memory_use import there_is
from neusee.workflows.engine.step_job import InputMissing, Outcome, StepJob, carry_out
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import Key, code_of, is_private
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.loaded_source import imported
from neusee.workflows.keys.seal import Unsigned, check_signature, secrets
from neusee.workflows.keys.tainted_code import taint_code, taints_of
from neusee.workflows.keys.user_code import own_code
from neusee.workflows.observation.own_call import tainted_modules
from neusee.workflows.recipe.node_families import all_nodes
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.store.serialization import tensors_in

_PLANNED = 0.6  #: fraction of the memory of a worker that a schedule may use


class _Here:
    """State of one worker between tasks: the store, digests of code, and the most recently used values."""

    def __init__(self, where: str, room: float) -> None:
        self.store = open_store(where)
        self._codes: dict[frozenset[str] | None, Code] = {None: Code(self.store.code_memo)}
        self._own = own_modules()
        self.values: OrderedDict[Key, Any] = OrderedDict()
        self.room, self.held = room, 0

    def look_again(self) -> None:
        """Compute digests of code anew if a job has brought modules of a user, which may change what others compute."""
        if self._own != own_modules():
            self._codes, self._own = {None: Code(self.store.code_memo)}, own_modules()

    def code_for(self, work: StepJob) -> Code | None:
        """Return the digests of code by which a step has the digest of the caller, or None where its code differs.

        What a package of the user holds depends on which of its modules were imported. The caller's count: this worker
        imports those that it lacks, and leaves out those that steps of other recipes imported here.
        """
        for loaded in (None, work.own.followed if work.own else frozenset[str]()):
            for module in sorted(loaded or ()):
                imported(module)
            code = self._codes.get(loaded) or self._codes.setdefault(loaded, Code(self.store.code_memo, loaded))
            if code_of(work.step, code) == work.origin["code"]:
                return code
        return None

    def fetch(self, key: Key, kinds: Mapping[Key, Any]) -> Any:
        """Return the value of a key; ``kinds`` are the annotated types of the inputs of a step, by their keys."""
        if key not in self.values:
            try:
                self.keep(key, self.store.get(key, kinds.get(key, Any)))
            except KeyError:
                raise InputMissing(key) from None
        self.values.move_to_end(key)
        return self.values[key]

    def keep(self, key: Key, value: Any) -> None:
        self.held += _size(value) - _size(self.values.get(key))
        self.values[key] = value
        self.values.move_to_end(key)
        while self.held > self.room and len(self.values) > 1:
            self.held -= _size(self.values.popitem(last=False)[1])


_here: dict[str, _Here] = {}


def _chance_of_its_own() -> None:
    """Give dask a generator of its own: its threads draw beside a step, which would be taken for draws of the step."""
    for name, module in list(sys.modules.items()):
        if name.startswith(("distributed.", "dask.")) and getattr(module, "random", None) is random:
            module.random = random.Random()  # type: ignore[attr-defined]


def lane_here(dask_worker: Any) -> tuple[str, float]:
    """Return the device of a worker, and the memory (bytes) that a schedule may use on this device."""
    if torch.cuda.is_available():
        return "cuda:0", _PLANNED * there_is("cuda:0")
    allowed = getattr(dask_worker.memory_manager, "memory_limit", None)
    return "cpu", _PLANNED * min(there_is("cpu"), allowed or float("inf"))


def work_here(chain: tuple[StepJob, ...], where: str, threads: int, room: float, signed: str = "") -> list[Outcome]:
    """Compute a chain of jobs on a worker; return outcomes without values, and cache up to ``room`` bytes of values.

    ``signed`` is a signature by the secret of the caller, which this worker needs too.
    """
    if not _same_secret(signed):
        text = "NEUSEE_CACHE_SECRET of a worker is not that of this process: set the same secret there"
        return [Outcome(chain[0], error=RunError(chain[0].step, [], OSError(text)))]
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)
    _chance_of_its_own()
    here = _here.get(where) or _here.setdefault(where, _Here(where, room))
    here.look_again()
    outcomes: list[Outcome] = []
    refetch = chain[0].refetch_seconds
    for work in chain:
        outcome = _one_here(replace(work, refetch_seconds=refetch), here)
        outcomes.append(outcome)
        if outcome.held or outcome.error or outcome.lost:
            break
        refetch = 0.0 if outcome.kept else outcome.seconds + refetch
    return [_light(outcome) for outcome in outcomes]


def _same_secret(signed: str) -> bool:
    try:
        check_signature(signed, "worker", "", b"")
    except Unsigned:
        return False
    return bool(secrets()) == bool(signed)


def _one_here(work: StepJob, here: _Here) -> Outcome:
    if is_private(work.key):
        text = "the loaded code is not that of its file, so no other process can use the result: restart Python"
        return Outcome(work, error=RunError(work.step, [], OSError(text)))
    code = here.code_for(work)
    if code is None:
        text = (
            f"the code of {work.step.node.path} differs on a worker: install the same version and packages there, and "
            "set the same time zone and settings of NumPy and torch"
        )
        return Outcome(work, error=RunError(work.step, [], OSError(text)))
    work = replace(work, own=own_code(work.step, code))
    if work.own and (known := taints_of(work.own.modules)):  # of an earlier job, whose memo may still hold it
        return Outcome(work, taints=known)
    outcome = carry_out(work, partial(here.fetch, kinds=kinds_of(work)), here.store)
    if work.own and outcome.taints:
        taint_code(tainted_modules(work.own, outcome.taints), outcome.taints)
        outcome.value = None
    if outcome.value is not None:
        here.keep(work.key, outcome.value)
    return outcome


def kinds_of(work: StepJob) -> dict[Key, Any]:
    """Return the annotated type of each input of a job, by the key of the input.

    Where a type is not annotated, the value may be a named tuple of any node, so all families of nodes are imported.
    """
    node, kinds = work.step.node, dict[Key, Any]()
    for name, read in zip(node.inputs, work.reads, strict=True):
        kind = node.hints.get(name, Any)
        if isinstance(read, tuple):
            lists = [each for each in (kind, *get_args(kind)) if get_origin(each) is list]
            kind = get_args(lists[0])[0] if lists else Any
        if kind is Any:
            list(all_nodes())
        kinds |= dict.fromkeys(read if isinstance(read, tuple) else [read] if read else [], kind)
    return kinds


def _light(outcome: Outcome) -> Outcome:
    """Return an outcome that pickle can send: without the value, and with any error as a `RunError`."""
    outcome.value = None
    if outcome.error is not None and not isinstance(outcome.error, RunError):
        outcome.error = RunError(outcome.work.step, [], outcome.error)
    return outcome


def _size(value: Any) -> int:
    return 0 if value is None else sum(t.nbytes for t in tensors_in(value))
