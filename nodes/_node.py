"""Nodes: functions that compute one step of a recipe, with typed parameters and attached functions (hooks).

The signature defines the node. Arguments before ``*`` are data from other steps.
Arguments after ``*`` are parameters from the recipe, and the engine gives the random
generator for a parameter named ``rng``.

    @node(rtol=0.0)
    def digitize(electrons: Tensor, *, gain: Gain, bits: Bits = 16) -> Tensor: ...

    @digitize.reference        # slow and simple form in float64; a test compares to rtol
    @digitize.skip_bound       # upper bound of the change if the step is skipped
    @digitize.propagate_error  # upper bound of the error that errors of the inputs cause
    @digitize.rounding_error   # the same with what rounding to whole numbers adds, an estimate
    @digitize.preflight        # checks the parameters before anything runs
    @digitize.check            # checks that the result is plausible
    @digitize.shape            # shape and type of the result, before anything runs
    @digitize.expected_range   # least and largest element of the result, a guess before anything runs
    @digitize.work             # memory and number of operations beside what the shapes say
    @digitize.example          # the arguments of one small call, on which `neusee check` tries the node

``digitize.hooks`` has each attached function under the name of its decorator.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, TypeVar, get_type_hints

from pydantic import BaseModel, ConfigDict, create_model

from neusee.nodes._error_bound import ErrorBound, TensorStats
from neusee.nodes.own_modules import import_missing, own_files

Device = Literal["any", "cpu", "gpu"]
Fn = TypeVar("Fn", bound=Callable[..., Any])
_registered: dict[tuple[str, str], Node] = {}  #: every node of this process, the newest of each module and name


class ParameterError(ValueError):
    """The error that the ``preflight`` of a node raises for a wrong parameter, before any step runs.

    Args: the name of the parameter, and one sentence with the value and the fix. The name ``direction.angle`` means the
    parameter ``angle`` of the step that computes the input ``direction``.
    """

    def __init__(self, parameter: str, message: str) -> None:
        super().__init__(message)
        self.parameter = parameter


@dataclass(frozen=True, slots=True)
class Check:
    """One finding about the result of a node, such as ``Check("phase step 0.31 turn < 0.5", True)``."""

    text: str
    ok: bool = True


@dataclass(slots=True)
class Hooks:
    """The functions attached to a node (hooks), such as ``check``, which ``@digitize.check`` attaches."""

    #: slow float64 form: same arguments, same result within ``rtol``
    reference: Callable[..., Any] | None = None
    #: (`TensorStats` of each input, *, parameters): bound of ``max |with - without| / max |with|`` if the step is left
    #: out and its first input is used instead; for a random node, in root mean square over the noise
    skip_bound: Callable[..., float] | None = None
    #: (`TensorStats` of the first input, *, parameters): the scale of `skip_bound`, such as the full well, because a
    #: later step cuts off larger values
    skip_scale: Callable[..., float] | None = None
    #: (`TensorStats` of each input, None for an absent input, *, parameters): bound of the result's largest element;
    #: where the bound is 0, the step and the steps that only feed this step are left out
    zero_bound: Callable[..., float] | None = None
    #: (`ErrorBound` of each input, *, result: TensorStats, parameters): the error of the result; both errors are
    #: upper bounds in root mean square; a list input has a list, an absent input None; without this hook the inputs
    #: must satisfy the tolerance themselves, because the error of the result is not known
    propagate_error: Callable[..., float] | None = None
    #: (rms error of the result as `propagate_error` gives it, *, result: TensorStats, parameters): the rms error with
    #: what rounding to whole numbers adds; an estimate, which a run states and does not hold to the tolerance
    rounding_error: Callable[..., float] | None = None
    #: True if `propagate_error` or `approximation_error` gives an estimate and no bound, which a recipe with
    #: ``estimates: false`` does not use
    estimated: bool = False
    #: (result): the error of a cheaper form relative to its largest element, in root mean square and for the largest
    #: element alone; both include the approximations of the inputs
    approximation_error: Callable[[Any], tuple[float, float]] | None = None
    #: (parameters): True if the result is the same for every band
    band_invariant: Callable[[Mapping[str, Any]], bool] | None = None
    #: (*, parameters): notes for the user, before anything runs; may raise `ParameterError`; an argument with the name
    #: of an input receives what is known of that input before the run, as ``shape`` gives it, else None
    preflight: Callable[..., Sequence[str]] | None = None
    #: (result, *inputs, **parameters): findings, once after computing
    check: Callable[..., Sequence[Check]] | None = None
    #: (what is known of each input, None where nothing is, **parameters): what is known of the result before the run:
    #: tensors on the device ``meta``, which have a shape and a type but no values; a tensor of few numbers may have
    #: values. A rule that fails, such as one that needs an unknown input, leaves the result unknown
    shape: Callable[..., Any] | None = None
    #: (`TensorStats` of each input, *, parameters): least and largest element of the result as a plan expects them
    #: before the run, no bound; an input of which nothing is known raises LookupError where it is read
    expected_range: Callable[..., tuple[float, float]] | None = None
    #: (): the arguments of one small call by name, on which `neusee check` tries the node
    example: Callable[[], Mapping[str, Any]] | None = None
    #: (result, *inputs, **parameters), all as for ``shape``: bytes of memory during the run beside inputs and result,
    #: and number of operations, both up to a constant factor, which is measured
    work: Callable[..., tuple[float, float]] | None = None


def _attaches(hook: str) -> Callable[[Any, Fn], Fn]:
    """Return the decorator that attaches a function to a node as the hook with the given name."""

    def attach(to: Node, fn: Fn) -> Fn:
        setattr(to.hooks, hook, fn)
        return fn

    attach.__doc__ = f"Attach the function to the node as its ``{hook}``, which `Hooks` describes."
    return attach


class Node:
    """A function that computes one step of a recipe, with typed parameters and hooks such as checks.

    Two cheaper forms may replace a node where a recipe's tolerance allows it: ``channel_sum_form`` gives
    `Channels` instead of all bands, and ``low_rank_form`` gives a `LowRankCube` instead of a cube.
    """

    def __init__(
        self,
        fn: Callable[..., Any],
        device: Device = "any",
        rtol: float = 1e-5,
        bands: Mapping[str, int] | None = None,
        accepts_channel_sums: Sequence[str] = (),
        needs_band_invariant: Sequence[str] = (),
        accepts_low_rank: Sequence[str] = (),
        additive_inputs: Sequence[tuple[str, ...]] = (),
        before_run: bool = False,
        depends: Sequence[str] = (),
    ) -> None:
        functools.update_wrapper(self, fn)
        self.fn, self.device, self.rtol = fn, device, rtol
        self.accepts_channel_sums = tuple(accepts_channel_sums)
        self.needs_band_invariant = tuple(needs_band_invariant)
        self.accepts_low_rank = tuple(accepts_low_rank)
        self.additive_inputs = tuple(additive_inputs)
        self.channel_sum_form: Node | None = None
        self.low_rank_form: Node | None = None
        self.hooks = Hooks()
        pars = inspect.signature(fn).parameters.values()
        data = [p for p in pars if p.kind is p.POSITIONAL_OR_KEYWORD]
        self.inputs = tuple(p.name for p in data)
        self.optional = frozenset(p.name for p in data if p.default is not p.empty)
        self.random = any(p.name == "rng" for p in pars)
        self._keyword_only = [p for p in pars if p.kind is p.KEYWORD_ONLY and p.name != "rng"]
        self.bands = bands and self._declared(bands)
        self.before_run = before_run
        if isinstance(depends, str) or not all(isinstance(entry, str) and entry for entry in depends):
            raise ValueError(
                f'{self.path}: depends={depends!r} must be a list of texts, such as ["table.csv", "env:X"]'
            )
        self.depends = tuple(depends)
        #: the declared variables of the environment at the import, which a module may read only then
        self.environment = {name: os.environ.get(name) for name in _variables(depends)}
        if before_run and (self.inputs or self.random):
            raise ValueError(f"{self.path}: before_run needs a node without inputs and without rng: omit before_run")
        _registered[fn.__module__, fn.__name__] = self

    def __call__(self, *inputs: Any, **params: Any) -> Any:
        """Call the function of the node directly, with gradients, without parameter validation and without cache."""
        return self.fn(*inputs, **params)

    def __repr__(self) -> str:
        return f"<node {self.path}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a node as module and name, so that the process that unpickles the node imports the code.

        Files of the user that this process has imported are named too: a result of their nodes may be an input.
        """
        return _imported, (self.fn.__module__, self.fn.__name__, own_files())

    @functools.cached_property
    def path(self) -> str:
        """Return the name of the node in a recipe, such as ``sensor.digitize``."""
        parts = [p for p in self.fn.__module__.removeprefix("neusee.nodes.").split(".") if not p.startswith("_")]
        return ".".join([*parts, self.fn.__name__])

    def _declared(self, bands: Mapping[str, int]) -> Mapping[str, int]:
        unknown = sorted(bands.keys() - {*self.inputs, "return"})
        if unknown or "return" not in bands or len(bands) < 2:
            raise ValueError(f"{self.path}: bands={dict(bands)} must name 'return' and at least one of {self.inputs}")
        if self.random:
            raise ValueError(
                f"{self.path} draws random numbers, so each band would depend on the other bands: omit bands="
            )
        return MappingProxyType(dict(bands))

    @functools.cached_property
    def hints(self) -> dict[str, Any]:
        """Return the type annotation of each argument and of the result of the node, with ``Annotated`` metadata."""
        return get_type_hints(self.fn, include_extras=True)

    @functools.cached_property
    def params(self) -> type[BaseModel]:
        """Return the pydantic model that validates the parameters of the node and rejects unknown parameters."""
        fields = {p.name: (self.hints[p.name], ... if p.default is p.empty else p.default) for p in self._keyword_only}
        config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)
        model: type[BaseModel] = create_model(self.fn.__name__, __config__=config, **fields)  # type: ignore[call-overload]
        return model

    reference, preflight, check = _attaches("reference"), _attaches("preflight"), _attaches("check")
    skip_bound, skip_scale, zero_bound = _attaches("skip_bound"), _attaches("skip_scale"), _attaches("zero_bound")
    propagate_error, approximation_error = _attaches("propagate_error"), _attaches("approximation_error")
    rounding_error, band_invariant = _attaches("rounding_error"), _attaches("band_invariant")
    expected_range = _attaches("expected_range")
    shape, work, example = _attaches("shape"), _attaches("work"), _attaches("example")

    @property
    def preflight_inputs(self) -> tuple[str, ...]:
        """Return the names of those inputs of the node that the hook ``preflight`` receives before the run."""
        hook = self.hooks.preflight
        return tuple(name for name in _arguments(hook) if name in self.inputs) if hook else ()


@functools.lru_cache(1000)
def _arguments(hook: Callable[..., Any]) -> tuple[str, ...]:
    return tuple(inspect.signature(hook).parameters)


def registered_nodes() -> tuple[Node, ...]:
    """Return every node that this process has defined or imported, the newest of each module and name."""
    return tuple(_registered.values())


def _variables(depends: Sequence[str]) -> list[str]:
    return [entry.removeprefix("env:") for entry in depends if entry.startswith("env:")]


def _imported(module: str, name: str, files: tuple[str, ...] = ()) -> Node:
    import_missing(files)
    imported: Node = getattr(importlib.import_module(module), name)
    return imported


def node(
    device: Device = "any",
    rtol: float = 1e-5,
    bands: Mapping[str, int] | None = None,
    *,
    accepts_channel_sums: Sequence[str] = (),
    needs_band_invariant: Sequence[str] = (),
    accepts_low_rank: Sequence[str] = (),
    additive_inputs: Sequence[tuple[str, ...]] = (),
    before_run: bool = False,
    depends: Sequence[str] = (),
) -> Callable[[Callable[..., Any]], Node]:
    """Return the decorator that turns a function into a node; ``rtol`` is the allowed error relative to the reference.

    Args:
        bands: the axis of the bands of some inputs and of the result (``return``). Band i of the result depends only
            on band i of these inputs and on the whole of every other input, and is the same to the last bit for any
            other bands in the stack. In a named tuple, only the fields in `values.BAND_FIELDS` have this axis.
        accepts_channel_sums: inputs that may be `Channels` instead of an image of all bands.
        needs_band_invariant: inputs that must be the same for every band if an image is given as `Channels`.
        accepts_low_rank: inputs that may be a `LowRankCube` instead of a cube.
        additive_inputs: groups of inputs; the first input of a group is optional or a list, and changes nothing where
            its values are zero. The other inputs of the group are used only with the first input.
        before_run: True for a node without inputs and with a result of few numbers, which is also computed when a
            recipe is checked, so that the preflight of another node can use the result.
        depends: what the code reads and no import shows: files beside the module, ``env:NAME``, names of modules. The
            page ``recipes/guide/code_changes.md`` lists the constructs that need an entry.
    """
    return lambda fn: Node(
        fn,
        device,
        rtol,
        bands,
        accepts_channel_sums,
        needs_band_invariant,
        accepts_low_rank,
        additive_inputs,
        before_run,
        depends,
    )


__all__ = ["Check", "ErrorBound", "Hooks", "Node", "ParameterError", "TensorStats", "node", "registered_nodes"]
