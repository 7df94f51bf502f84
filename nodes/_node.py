"""What a node is: a plain function, plus the little that an engine must know of it.

The signature is the whole contract. What stands before ``*`` is data and comes from
other steps; what stands after ``*`` is a parameter and comes from the recipe; a
parameter named ``rng`` is filled in by the engine.

    @node(rtol=0.0)
    def digitize(electrons: Tensor, *, gain: Gain, bits: Bits = 16) -> Tensor: ...

    @digitize.reference        # float64, slow, plainly right; a test compares to rtol
    @digitize.negligible       # true upper bound of what skipping the step changes
    @digitize.carries          # how far errors of the inputs can move the result
    @digitize.preflight        # looks at the parameters before anything runs
    @digitize.check            # looks at the result: what a physicist would look at first
"""

from __future__ import annotations

import functools
import importlib
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, TypeVar, get_type_hints

import torch
from pydantic import BaseModel, ConfigDict, create_model
from torch import Tensor

_FEW = 64  #: elements that are looked at one by one, for to call torch five times takes longer
_PART, _ROW = 1 << 17, 1 << 10  #: elements that are looked at together, and summed in their own precision

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


@dataclass(frozen=True, slots=True)
class Facts:
    """What is cheap to know of a tensor, kept beside it so that a verdict never loads it."""

    shape: tuple[int, ...]
    dtype: str
    min: float
    max: float
    sum: float
    support: int  #: elements that are not zero
    finite: bool

    @classmethod
    def of(cls, value: Any) -> Facts | None:
        """Facts of a tensor, or of the first tensor of a named tuple; None of anything else."""
        if isinstance(value, tuple | list) and value:
            return cls.of(value[0])
        if not isinstance(value, Tensor):
            return None
        x = value.detach()
        shape, dtype = tuple(x.shape), str(x.dtype).removeprefix("torch.")
        if x.numel() == 0:
            return cls(shape, dtype, math.nan, math.nan, 0.0, 0, True)
        x = x.abs() if x.is_complex() else x
        few = x.reshape(-1).tolist() if x.numel() <= _FEW else []
        if few and math.isfinite(total := float(sum(few))):
            return cls(shape, dtype, float(min(few)), float(max(few)), total, sum(v != 0 for v in few), True)
        low, high, total, support = _measured(x.reshape(-1))
        finite = all(map(math.isfinite, (low, high, total)))
        return cls(shape, dtype, low, high, total, support, finite)


def _measured(flat: Tensor) -> tuple[float, float, float, int]:
    """Least, greatest, sum and number of what is not zero, by parts that stay in cache: memory is read once."""
    small = flat.dtype == torch.bool or (flat.is_floating_point() and flat.element_size() < 4)
    found = []
    for part in torch.split(flat, _PART):
        part = part.float() if small else part
        rows = part.view(-1, _ROW) if part.numel() % _ROW == 0 else part[None]
        found.append((*torch.aminmax(part), rows.sum(1).sum(dtype=torch.float64), torch.count_nonzero(part)))
    lows, highs, sums, counts = (torch.stack(each) for each in zip(*found, strict=True))
    low, high, total = (float(x) for x in (lows.min(), highs.max(), sums.sum()))
    if math.isinf(total) and math.isfinite(low) and math.isfinite(high):  # a row went beyond its own type
        total = float(sum(part.sum(dtype=torch.float64) for part in torch.split(flat, _PART)))
    return low, high, total, int(counts.sum())


@dataclass(frozen=True, slots=True)
class Deviation:
    """How far an input may be from what it ought to be, and what is known of it."""

    bound: float  #: of the root mean square of the difference, over the elements and the noise
    facts: Facts | None = None
    top: float | None = None  #: of how far its largest element is off, as a share of it; None where nobody tells

    @property
    def share(self) -> float:
        """The bound as a share of the input's largest element."""
        if self.bound == 0.0:
            return 0.0
        top = max(abs(self.facts.min), abs(self.facts.max)) if self.facts else 0.0
        return self.bound / top if top > 0 else math.inf

    @property
    def largest(self) -> float:
        """The bound on the largest element, as a share of it."""
        return 0.0 if self.bound == 0.0 else math.inf if self.top is None else self.top


class Node:
    """A function with its typed parameters, its reference, its bound and its checks.

    Cheaper forms, for `neusee.workflows` to choose from where a recipe's tolerance allows it: ``collapsed``, the node
    that gives `Channels` instead of all bands, and ``mixed``, the one that gives a `Mixture` instead of a cube.
    """

    def __init__(
        self,
        fn: Callable[..., Any],
        device: Device = "any",
        rtol: float = 1e-5,
        bands: Mapping[str, int] | None = None,
        channels: Sequence[str] = (),
        even: Sequence[str] = (),
        mixtures: Sequence[str] = (),
        adds: Sequence[tuple[str, ...]] = (),
    ) -> None:
        functools.update_wrapper(self, fn)
        self.fn, self.device, self.rtol = fn, device, rtol
        self.channels, self.even, self.mixtures = tuple(channels), tuple(even), tuple(mixtures)
        self.adds = tuple(adds)
        self.collapsed: Node | None = None
        self.mixed: Node | None = None
        self.sums: Callable[[Mapping[str, Any]], bool] | None = None
        self.spread: Callable[..., float] | None = None
        self.deviation: Callable[[Any], tuple[float, float]] | None = None
        self.nothing: Callable[..., float] | None = None
        self.scale: Callable[..., float] | None = None
        self.ref: Callable[..., Any] | None = None
        self.bound: Callable[..., float] | None = None
        self.before: Callable[..., Sequence[str]] | None = None
        self.after: Callable[..., Sequence[Check]] | None = None
        pars = inspect.signature(fn).parameters.values()
        data = [p for p in pars if p.kind is p.POSITIONAL_OR_KEYWORD]
        self.inputs = tuple(p.name for p in data)
        self.optional = frozenset(p.name for p in data if p.default is not p.empty)
        self.random = any(p.name == "rng" for p in pars)
        self._keyword_only = [p for p in pars if p.kind is p.KEYWORD_ONLY and p.name != "rng"]
        self.bands = bands and self._declared(bands)

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
        self.ref = fn
        return fn

    def negligible(self, fn: Fn) -> Fn:
        """Attach the bound: ``(facts of each input, *, parameters) -> float``.

        It bounds ``max |with - without| / max |with|``; of a random node, the same with
        root mean square over the noise. Skipping hands on the first input.
        """
        self.bound = fn
        return fn

    def weighed(self, fn: Fn) -> Fn:
        """Attach ``(facts of the first input, *, parameters) -> float``: what `negligible` is a share of.

        Such as the full well, where what is above it is cut off later.
        """
        self.scale = fn
        return fn

    def absent(self, fn: Fn) -> Fn:
        """Attach ``(facts of each input, *, parameters) -> float``: a true bound of the result's largest element.

        Where that is 0, the step and what only feeds it are left out. An input that is absent is given as None.
        """
        self.nothing = fn
        return fn

    def carries(self, fn: Fn) -> Fn:
        """Attach ``(a `Deviation` of each input, *, result: Facts, parameters) -> float``: how far off the result is.

        At most, both in root mean square. A list input is a list of them, one that is absent None. Without it, nothing
        is known behind the node, and its inputs are held to the tolerance instead.
        """
        self.spread = fn
        return fn

    def deviates(self, fn: Fn) -> Fn:
        """Attach ``(result) -> (share, share)``: how far a cheaper form may be from the full one, over its largest.

        In root mean square, and of the largest element alone. What its inputs lack is part of it.
        """
        self.deviation = fn
        return fn

    def even_where(self, fn: Callable[[Mapping[str, Any]], bool]) -> Callable[[Mapping[str, Any]], bool]:
        """Attach ``(parameters) -> bool``: whether the result is the same for every band."""
        self.sums = fn
        return fn

    def preflight(self, fn: Fn) -> Fn:
        """Attach ``(*, parameters) -> notes``; it may raise `ParameterError`."""
        self.before = fn
        return fn

    def check(self, fn: Fn) -> Fn:
        """Attach ``(result, *inputs, **parameters) -> checks``, run once after computing."""
        self.after = fn
        return fn


def _found(module: str, name: str) -> Node:
    found: Node = getattr(importlib.import_module(module), name)
    return found


def node(
    device: Device = "any",
    rtol: float = 1e-5,
    bands: Mapping[str, int] | None = None,
    *,
    channels: Sequence[str] = (),
    even: Sequence[str] = (),
    mixtures: Sequence[str] = (),
    adds: Sequence[tuple[str, ...]] = (),
) -> Callable[[Callable[..., Any]], Node]:
    """Make a node of a function. ``rtol`` is the agreed error against its reference.

    ``bands`` gives the axis of the bands of some inputs and of the result (``return``): band i of the result depends
    on band i of those inputs and on the whole of the others, and is the same to the last bit whatever bands stand
    beside it. Of a named tuple, only the fields in `values.BAND_FIELDS` have that axis.

    ``channels`` names the inputs that may be `Channels` instead of an image of all bands; those in ``even`` must then
    be the same for every band. ``mixtures`` names those that may be a `Mixture` instead of a cube. ``adds`` names those
    without which nothing changes where they are nothing, an optional input or a list; with each, what goes with it.
    """
    return lambda fn: Node(fn, device, rtol, bands, channels, even, mixtures, adds)
