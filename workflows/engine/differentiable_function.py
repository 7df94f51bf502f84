"""A recipe as a differentiable function of some of its parameters or steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch._C._functorch import peek_interpreter_stack

from neusee.nodes import TensorStats
from neusee.workflows.engine.node_call import call, place
from neusee.workflows.engine.runner import run
from neusee.workflows.engine.step_job import gathered
from neusee.workflows.graph.errors import RunError, nearest
from neusee.workflows.graph.recipe_graph import Recipe, Step, in_order, needed, unknown_step
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import settle
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.tolerance.skip_decision import ErrorBudget

Theta = Mapping[str, Any]

#: words in torch's errors for a function that does not support a transform
_MARKS = {
    "vmap": ("vmap", "Batching rule", "batching rule"),
    "jvp": ("jvp", "forward mode", "forward AD", "second derivative"),
    "vjp": ("setup_context", "functorch", "second derivative"),
}
_OTHERWISE = {
    "vmap": (
        ", or take dataclasses.replace(recipe, exact=True), where no step is left out for its"
        " values"
    ),
    "jvp": ", or torch.func.vjp",
    "vjp": ", which differentiates more nodes",
}
_PAGE = "recipes/guide/torch_func.md lists the nodes"


def as_function(
    recipe: Recipe,
    *free: str,
    outputs: Iterable[str] | None = None,
    store: Store | None = None,
    device: str = "cpu",
    redraw: Collection[str] = (),
    caller: Callable[..., Any] = call,
) -> _Function:
    """Return the recipe as a differentiable function ``theta -> {output: value}``.

    Every value equals the value of `run` bit for bit. `torch.func.vjp` and `jvp` follow all outputs
    of the packaged recipes, networks excepted. `torch.func.vmap` needs ``randomness="same"`` and
    passes PSFs and what is measured of them (`lsr`, `bsr`, `outside`, `peak`); with
    ``dataclasses.replace(recipe, exact=True)`` it passes the raw and the developed picture too, but
    no restoration. A node that does not pass raises RunError with its place and the transform;
    ``recipes/guide/torch_func.md`` lists every node.

    Noise is the same at every call, because its stream depends on the seed and the step.

    Args:
        free: parameters such as ``"spot.strength"``, or steps such as ``"height"``, whose result
            the caller provides. Steps that do not depend on ``free`` are computed once, here, or
            read from the store.
        redraw: random steps that are computed at every call, which may have another seed
        caller: replaces `call` for all steps that are computed at a call
    """
    names = recipe.outputs if outputs is None else tuple(outputs)
    replaced_steps, tuned_params = _read(recipe, free)
    recipe = with_substitutions(recipe, names, replaced_steps | tuned_params.keys())
    # a step whose result the caller provides needs no inputs
    sources = {
        name: () if name in replaced_steps else step.sources for name, step in recipe.steps.items()
    }
    order = in_order(sources, names)
    if unused_names := sorted((replaced_steps | tuned_params.keys()) - set(order)):
        raise ValueError(f"no output depends on {', '.join(unused_names)}")
    # steps computed at every call; all others are computed once, here
    live_steps = _from_roots(order, sources, {*replaced_steps, *tuned_params, *redraw})
    # steps that the live steps read, and the outputs
    steps_read_live = set(names).union(*(sources[step] for step in live_steps))
    fixed_results = run(recipe, store, sorted(steps_read_live - live_steps.keys()), device=device)
    bounds_of_skipped = {
        name: record.bound or 0.0
        for name, record in fixed_results.done.items()
        if record.state == "left out"
    }
    return _Function(
        recipe,
        free,
        names,
        replaced_steps,
        tuned_params,
        list(live_steps),
        fixed_results.values,
        bounds_of_skipped,
        device,
        caller,
    )


def _from_roots(
    order: Iterable[str], sources: Mapping[str, Iterable[str]], roots: Collection[str]
) -> dict[str, None]:
    """Return the steps ``roots`` and those that depend on them, in running order."""
    # as an ordered set
    dependent_steps = dict[str, None]()
    for name in order:
        if name in roots or not dependent_steps.keys().isdisjoint(sources[name]):
            dependent_steps[name] = None
    return dependent_steps


def _read(recipe: Recipe, free: tuple[str, ...]) -> tuple[set[str], dict[str, dict[str, str]]]:
    """Split the names ``free`` into names of steps, and full names of parameters grouped by
    step.
    """
    replaced: set[str] = set()
    tuned: dict[str, dict[str, str]] = {}
    for name in free:
        step, _, param = name.rpartition(".")
        if name in recipe.steps:
            replaced.add(name)
        elif step not in recipe.steps:
            raise ValueError(unknown_step(step or name, recipe.steps))
        elif param not in recipe.steps[step].params:
            raise ValueError(
                f"{step} has no parameter {param!r}; {nearest(param, recipe.steps[step].params)}"
            )
        else:
            tuned.setdefault(step, {})[param] = name
    return replaced, tuned


@dataclass(eq=False, repr=False)
class _Function:
    """A differentiable function: the steps that depend on the free values, and the fixed inputs
    of these steps.
    """

    recipe: Recipe
    free: tuple[str, ...]
    wanted: tuple[str, ...]
    given: set[str]
    tuned: dict[str, dict[str, str]]
    live: list[str]
    fixed: dict[str, Any]
    left_out: Mapping[str, float]
    device: str
    caller: Callable[..., Any]

    def __post_init__(self) -> None:
        self._facts: dict[str, TensorStats | None] = {}
        self._spent = _spent(self.recipe, self.fixed, self.left_out)
        computed_steps = [name for name in self.live if name not in self.given]
        # by step, the last live step that reads its result
        self._last: dict[str, str] = {}
        for name in computed_steps:
            self._last.update(dict.fromkeys(self.recipe.steps[name].sources, name))

    def __call__(self, theta: Theta, seed: int | None = None) -> dict[str, Any]:
        """Return the outputs for the free values ``theta``; the seed of the noise is ``seed`` or
        the recipe's seed.
        """
        seed = self.recipe.seed if seed is None else seed
        if set(theta) != set(self.free):
            raise ValueError(
                f"theta must hold exactly {', '.join(self.free)}, not"
                f" {', '.join(theta) or 'nothing'}"
            )
        values, ledger = dict(self.fixed), self._spent.copy()
        for name in self.live:
            if name in self.given:
                values[name] = settle(theta[name])
            else:
                step = self.recipe.steps[name]
                values[name] = self._evaluate(step, values, theta, ledger, seed)
                self._free(name, values)
        return {name: values[name] for name in self.wanted}

    def _free(self, name: str, values: dict[str, Any]) -> None:
        """Delete the values that no step after ``name`` reads."""
        for source in set(self.recipe.steps[name].sources):
            if self._last[source] == name and source not in self.wanted:
                del values[source]

    def _evaluate(
        self, step: Step, values: dict[str, Any], theta: Theta, ledger: ErrorBudget, seed: int
    ) -> Any:
        """Return the result of one live step, from the values so far and the parameters in
        ``theta``. An error of torch names the step.
        """
        params = {
            **step.params,
            **{
                param: theta[full_name]
                for param, full_name in self.tuned.get(step.name, {}).items()
            },
        }
        inputs = [gathered(step.wires.get(name), values.__getitem__) for name in step.node.inputs]
        try:
            return self._result(step, inputs, params, values, ledger, seed)
        except (RuntimeError, NotImplementedError, ValueError) as error:
            raise _named_transform_error(error, step, inputs, self.recipe.exact) from error

    def _result(
        self,
        step: Step,
        inputs: list[Any],
        params: dict[str, Any],
        values: dict[str, Any],
        ledger: ErrorBudget,
        seed: int,
    ) -> Any:
        """Return the result of a step, or of a cheaper step if the tolerance of the recipe allows
        it.
        """
        if step.node.hooks.skip_bound is not None:
            with torch.no_grad():
                verdict = ledger.verdict(step, params, lambda name: self._facts_of(name, values))
            if verdict.left_out:
                # the step is left out: its input replaces its result
                return values[verdict.instead]
        else:
            ledger.pass_on(step)
        return self.caller(step, inputs, params, seed, place(step, self.device))

    def _facts_of(self, name: str, values: dict[str, Any]) -> Any:
        """Return the statistics of a value; those of fixed values are computed once."""
        if name not in self.fixed:
            value = values[name]
            return (
                _Ends(value)
                if isinstance(value, Tensor) and value.dtype == torch.float32
                else TensorStats.of(value)
            )
        if name not in self._facts:
            self._facts[name] = TensorStats.of(self.fixed[name])
        return self._facts[name]


def _named_transform_error(
    error: Exception, step: Step, inputs: list[Any], exact: bool
) -> Exception:
    """Return an error that names the step and the `torch.func` transform that it does not support,
    or ``error`` itself.
    """
    # the active `torch.func` transform, if any
    interpreter = peek_interpreter_stack()
    if interpreter is None:
        return error
    cause = error.cause if isinstance(error, RunError) else error
    error_text = " ".join(str(cause).split())
    transform = {"Vmap": "vmap", "Jvp": "jvp", "Grad": "vjp"}.get(interpreter.key().name, "")
    if not transform or not any(mark in error_text for mark in _MARKS[transform]):
        return error
    advice = (
        "call the function for one tensor after another"
        if transform == "vmap"
        else "use torch.autograd"
    )
    # do not advise an exact recipe if the recipe is already exact
    alternative = "" if exact and transform == "vmap" else _OTHERWISE[transform]
    text = (
        f"torch.func.{transform} does not pass {step.node.path} ({error_text[:120]} ...):"
        f" {advice}{alternative}; {_PAGE}"
    )
    return RunError(step, inputs, NotImplementedError(text))


class _Ends:
    """Statistics of an image; minimum and maximum are computed at once, all other statistics at
    their first use.
    """

    def __init__(self, value: Tensor) -> None:
        self._value = value.detach()
        self.shape, self.dtype = tuple(value.shape), "float32"
        self.min, self.max = (
            map(float, torch.aminmax(self._value)) if value.numel() else (math.nan, math.nan)
        )
        self.finite = not value.numel() or (math.isfinite(self.min) and math.isfinite(self.max))

    @cached_property
    def _whole(self) -> TensorStats | None:
        return TensorStats.of(self._value)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._whole, name)


def _spent(recipe: Recipe, fixed: Mapping[str, Any], left_out: Mapping[str, float]) -> ErrorBudget:
    """Return an error budget with the error bounds of all steps that do not depend on the free
    values.
    """
    ledger = ErrorBudget(recipe)
    for name in needed(recipe, fixed):
        ledger.pass_on(recipe.steps[name])
        if name in left_out:
            ledger.leave_out(recipe.steps[name], left_out[name])
    return ledger
