"""What a node is: a plain function, plus the little that an engine must know of it.

The signature is the whole contract. What stands before ``*`` is data and comes from
other steps; what stands after ``*`` is a parameter and comes from the recipe; a
parameter named ``rng`` is filled in by the engine.

    @node(rtol=0.0)
    def digitize(electrons: Tensor, *, gain: Gain, bits: Bits = 16) -> Tensor: ...

    @digitize.reference        # float64, slow, plainly right; a test compares to rtol
    @digitize.skip_bound       # true upper bound of what skipping the step changes
    @digitize.propagate_error  # how far errors of the inputs can move the result
    @digitize.preflight        # looks at the parameters before anything runs
    @digitize.check            # looks at the result: what a physicist would look at first

What is attached is found under the same name in ``digitize.hooks``.
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
    """A parameter cannot be used; raised by a node's ``preflight``, before anything runs.

    Args: the name of the parameter, and one sentence with the value and the fix.
    """

    def __init__(self, parameter: str, message: str) -> None:
        super().__init__(message)
        self.parameter = parameter


@dataclass(frozen=True, slots=True)
class Check:
    """One line that a physicist would look at: ``Check("phase step 0.31 turn < 0.5", True)``."""

    text: str
    ok: bool = True


@dataclass(slots=True)
class Hooks:
    """What a node has beside its function; `Node` has a decorator of the same name for each."""

    reference: Callable[..., Any] | None = None
    skip_bound: Callable[..., float] | None = None
    skip_scale: Callable[..., float] | None = None
    zero_bound: Callable[..., float] | None = None
    propagate_error: Callable[..., float] | None = None
    approximation_error: Callable[[Any], tuple[float, float]] | None = None
    band_invariant: Callable[[Mapping[str, Any]], bool] | None = None
    preflight: Callable[..., Sequence[str]] | None = None
    check: Callable[..., Sequence[Check]] | None = None


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
        self.preflight_inputs: tuple[str, ...] = ()
        self.random = any(p.name == "rng" for p in pars)
        self._keyword_only = [p for p in pars if p.kind is p.KEYWORD_ONLY and p.name != "rng"]
        self.bands = bands and self._declared(bands)
        self.before_run = before_run
        if before_run and (self.inputs or self.random):
            raise ValueError(f"{self.path}: before_run is for a node of parameters alone, without inputs and rng")

    def __call__(self, *inputs: Any, **params: Any) -> Any:
        """Call the function itself: no validation, no cache; gradients flow."""
        return self.fn(*inputs, **params)

    def __repr__(self) -> str:
        return f"<node {self.path}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """A node travels as its name: the other process has its own code, which it can compare."""
        return _found, (self.fn.__module__, self.fn.__name__)

    @functools.cached_property
    def path(self) -> str:
        """The name a recipe writes: ``sensor.digitize``."""
        parts = [p for p in self.fn.__module__.removeprefix("neusee.nodes.").split(".") if not p.startswith("_")]
        return ".".join([*parts, self.fn.__name__])

    def _declared(self, bands: Mapping[str, int]) -> Mapping[str, int]:
        unknown = sorted(bands.keys() - {*self.inputs, "return"})
        if unknown or "return" not in bands or len(bands) < 2:
            raise ValueError(f"{self.path}: bands={dict(bands)} must name 'return' and inputs among {self.inputs}")
        if self.random:
            raise ValueError(f"{self.path} draws at random, so that a band is not the same in another stack")
        return MappingProxyType(dict(bands))

    @functools.cached_property
    def hints(self) -> dict[str, Any]:
        """Annotations by argument name, and ``return``, with their ``Annotated`` extras."""
        return get_type_hints(self.fn, include_extras=True)

    @functools.cached_property
    def params(self) -> type[BaseModel]:
        """Model that reads this node's parameters from a recipe and rejects the rest."""
        fields = {p.name: (self.hints[p.name], ... if p.default is p.empty else p.default) for p in self._keyword_only}
        config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)
        model: type[BaseModel] = create_model(self.fn.__name__, __config__=config, **fields)  # type: ignore[call-overload]
        return model

    def reference(self, fn: Fn) -> Fn:
        """Attach the slow float64 form: same arguments, same result within ``rtol``."""
        self.hooks.reference = fn
        return fn

    def skip_bound(self, fn: Fn) -> Fn:
        """Attach the bound of skipping: ``(`TensorStats` of each input, *, parameters) -> float``.

        The value bounds ``max |with - without| / max |with|``; for a random node, the same ratio with the root mean
        square over the noise. A skipped node returns its first input.
        """
        self.hooks.skip_bound = fn
        return fn

    def skip_scale(self, fn: Fn) -> Fn:
        """Attach ``(`TensorStats` of the first input, *, parameters) -> float``: the scale of `skip_bound`.

        An example is the full well, because a later step cuts off what is above it.
        """
        self.hooks.skip_scale = fn
        return fn

    def zero_bound(self, fn: Fn) -> Fn:
        """Attach ``(`TensorStats` of each input, *, parameters) -> float``: a bound of the result's largest element.

        Where the bound is 0, the step and the steps that only feed it are left out. An absent input is given as None.
        """
        self.hooks.zero_bound = fn
        return fn

    def propagate_error(self, fn: Fn) -> Fn:
        """Attach ``(`ErrorBound` of each input, *, result: TensorStats, parameters) -> float``: the result's error.

        Both errors are upper bounds in root mean square. A list input is a list of bounds, an absent input is None.
        Without this hook the error behind the node is not known, and its inputs are held to the tolerance instead.
        """
        self.hooks.propagate_error = fn
        return fn

    def approximation_error(self, fn: Fn) -> Fn:
        """Attach ``(result) -> (rms, peak)``: bounds of a cheaper form's error, as shares of its largest element.

        The first is in root mean square, the second of the largest element alone. Both include the approximations
        that the inputs carry.
        """
        self.hooks.approximation_error = fn
        return fn

    def band_invariant(self, fn: Callable[[Mapping[str, Any]], bool]) -> Callable[[Mapping[str, Any]], bool]:
        """Attach ``(parameters) -> bool``: whether the result is the same for every band."""
        self.hooks.band_invariant = fn
        return fn

    def preflight(self, fn: Fn) -> Fn:
        """Attach ``(*, parameters) -> notes``, called before anything runs; ``fn`` may raise `ParameterError`.

        An argument with the name of an input receives the value of this input where a node with ``before_run``
        computes it; the argument is None where the value is known only during the run.
        """
        self.hooks.preflight = fn
        self.preflight_inputs = tuple(name for name in inspect.signature(fn).parameters if name in self.inputs)
        return fn

    def check(self, fn: Fn) -> Fn:
        """Attach ``(result, *inputs, **parameters) -> checks``, run once after computing."""
        self.hooks.check = fn
        return fn


def _found(module: str, name: str) -> Node:
    found: Node = getattr(importlib.import_module(module), name)
    return found


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
    """Make a node of a function. ``rtol`` is the agreed error against its reference.

    Args:
        bands: the axis of the bands of some inputs and of the result (``return``). Band i of the result depends on
            band i of those inputs and on the whole of the others, and is the same to the last bit whatever bands
            stand beside it. Of a named tuple, only the fields in `values.BAND_FIELDS` have that axis.
        accepts_channel_sums: inputs that may be `Channels` instead of an image of all bands.
        needs_band_invariant: inputs that must then be the same for every band.
        accepts_low_rank: inputs that may be a `LowRankCube` instead of a cube.
        additive_inputs: inputs that change nothing where they are zero, an optional input or a list; each with the
            inputs that belong to it.
        before_run: True for a node of few numbers without inputs, which the check of a recipe computes too, so that
            the preflight of another node can use the result.
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
