"""Nodes: plain functions, with the little that an engine must know of each function.

The signature is the whole contract. Arguments before ``*`` are data from other steps.
Arguments after ``*`` are parameters from the recipe, and the engine gives the random
generator for a parameter named ``rng``.

    @node(rtol=0.0)
    def digitize(electrons: Tensor, *, gain: Gain, bits: Bits = 16) -> Tensor: ...

    @digitize.reference        # float64, slow, plainly right; a test compares to rtol
    @digitize.skip_bound       # true upper bound of what skipping the step changes
    @digitize.propagate_error  # how far errors of the inputs can move the result
    @digitize.preflight        # looks at the parameters before anything runs
    @digitize.check            # looks at the result as a physicist would

``digitize.hooks`` has each attached function under the name of its decorator.
"""

from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, TypeVar, get_type_hints

from pydantic import BaseModel, ConfigDict, create_model

from neusee.nodes._error_bound import ErrorBound, TensorStats

Device = Literal["any", "cpu", "gpu"]
Fn = TypeVar("Fn", bound=Callable[..., Any])


class ParameterError(ValueError):
    """The refusal of a parameter by a node's ``preflight``, before anything runs.

    Args: the name of the parameter, and one sentence with the value and the fix.
    """

    def __init__(self, parameter: str, message: str) -> None:
        super().__init__(message)
        self.parameter = parameter


@dataclass(frozen=True, slots=True)
class Check:
    """One finding about a result, for a physicist to read: ``Check("phase step 0.31 turn < 0.5", True)``."""

    text: str
    ok: bool = True


@dataclass(slots=True)
class Hooks:
    """The functions attached to a node, by the decorators of the same names: ``@digitize.check`` attaches ``check``."""

    #: slow float64 form: same arguments, same result within ``rtol``
    reference: Callable[..., Any] | None = None
    #: (`TensorStats` of each input, *, parameters): bound of ``max |with - without| / max |with|`` if the step is left
    #: out, which then returns its first input; for a random node, in root mean square over the noise
    skip_bound: Callable[..., float] | None = None
    #: (`TensorStats` of the first input, *, parameters): the scale of `skip_bound`, such as the full well, because a
    #: later step cuts off larger values
    skip_scale: Callable[..., float] | None = None
    #: (`TensorStats` of each input, None for an absent input, *, parameters): bound of the result's largest element;
    #: where the bound is 0, the step and the steps that only feed this step are left out
    zero_bound: Callable[..., float] | None = None
    #: (`ErrorBound` of each input, *, result: TensorStats, parameters): the result's error; both errors are upper
    #: bounds in root mean square, of a list input a list, of an absent input None; without this hook the inputs of the
    #: node are held to the tolerance, because the error of the result is not known
    propagate_error: Callable[..., float] | None = None
    #: (result): the error of a cheaper form as shares of its largest element, in root mean square and of the largest
    #: element alone, both with the approximations that the inputs carry
    approximation_error: Callable[[Any], tuple[float, float]] | None = None
    #: (parameters): True if the result is the same for every band
    band_invariant: Callable[[Mapping[str, Any]], bool] | None = None
    #: (*, parameters): notes for the user, before anything runs; may raise `ParameterError`; an argument with the name
    #: of an input receives the value of that input where a node with ``before_run`` computes it, else None
    preflight: Callable[..., Sequence[str]] | None = None
    #: (result, *inputs, **parameters): findings, once after computing
    check: Callable[..., Sequence[Check]] | None = None


def _attaches(hook: str) -> Callable[[Any, Fn], Fn]:
    """Return the decorator that attaches a function to a node as this hook."""

    def attach(to: Node, fn: Fn) -> Fn:
        setattr(to.hooks, hook, fn)
        return fn

    return attach


class Node:
    """A function with its typed parameters and its hooks: the reference, the bounds and the checks.

    Two cheaper forms may stand in for a node where a recipe's tolerance allows it: ``channel_sum_form`` gives
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
        if before_run and (self.inputs or self.random):
            raise ValueError(f"{self.path}: before_run is for a node of parameters alone, without inputs and rng")

    def __call__(self, *inputs: Any, **params: Any) -> Any:
        """Call the function itself, without validation and without cache; gradients flow."""
        return self.fn(*inputs, **params)

    def __repr__(self) -> str:
        return f"<node {self.path}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a node as its name: the process that reads the pickle imports its own code of the node."""
        return _imported, (self.fn.__module__, self.fn.__name__)

    @functools.cached_property
    def path(self) -> str:
        """Return the name of the node in a recipe, such as ``sensor.digitize``."""
        parts = [p for p in self.fn.__module__.removeprefix("neusee.nodes.").split(".") if not p.startswith("_")]
        return ".".join([*parts, self.fn.__name__])

    def _declared(self, bands: Mapping[str, int]) -> Mapping[str, int]:
        unknown = sorted(bands.keys() - {*self.inputs, "return"})
        if unknown or "return" not in bands or len(bands) < 2:
            raise ValueError(f"{self.path}: bands={dict(bands)} must name 'return' and inputs among {self.inputs}")
        if self.random:
            raise ValueError(
                f"{self.path} draws random numbers, so a band would change with its neighbours: omit bands="
            )
        return MappingProxyType(dict(bands))

    @functools.cached_property
    def hints(self) -> dict[str, Any]:
        """Return the annotations by argument name and of ``return``, with their ``Annotated`` extras."""
        return get_type_hints(self.fn, include_extras=True)

    @functools.cached_property
    def params(self) -> type[BaseModel]:
        """Return the pydantic model that reads this node's parameters from a recipe and rejects unknown ones."""
        fields = {p.name: (self.hints[p.name], ... if p.default is p.empty else p.default) for p in self._keyword_only}
        config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)
        model: type[BaseModel] = create_model(self.fn.__name__, __config__=config, **fields)  # type: ignore[call-overload]
        return model

    reference, preflight, check = _attaches("reference"), _attaches("preflight"), _attaches("check")
    skip_bound, skip_scale, zero_bound = _attaches("skip_bound"), _attaches("skip_scale"), _attaches("zero_bound")
    propagate_error, approximation_error = _attaches("propagate_error"), _attaches("approximation_error")
    band_invariant = _attaches("band_invariant")

    @property
    def preflight_inputs(self) -> tuple[str, ...]:
        """The inputs whose values the preflight receives if a node with ``before_run`` computes the value."""
        hook = self.hooks.preflight
        return tuple(name for name in inspect.signature(hook).parameters if name in self.inputs) if hook else ()


def _imported(module: str, name: str) -> Node:
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
) -> Callable[[Callable[..., Any]], Node]:
    """Return the decorator that makes a node of a function; ``rtol`` is the agreed error against its reference.

    Args:
        bands: the axis of the bands of some inputs and of the result (``return``). Band i of the result depends only
            on band i of these inputs and on the whole of every other input, and is the same to the last bit for any
            other bands in the stack. In a named tuple, only the fields in `values.BAND_FIELDS` have this axis.
        accepts_channel_sums: inputs that may be `Channels` instead of an image of all bands.
        needs_band_invariant: inputs that must be the same for every band if an image is given as `Channels`.
        accepts_low_rank: inputs that may be a `LowRankCube` instead of a cube.
        additive_inputs: groups of inputs; the first input of a group is optional or a list, and changes nothing where
            its values are zero. The other inputs of the group belong to the first one.
        before_run: True for a node without inputs and with a result of few numbers, which is also computed when a
            recipe is checked, so that the preflight of another node can use the result.
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
    )


__all__ = ["Check", "Device", "ErrorBound", "Hooks", "Node", "ParameterError", "TensorStats", "node"]
