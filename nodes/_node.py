"""Nodes: functions that compute one step of a recipe, with error bounds, checks and other hooks."""

from __future__ import annotations

import functools
import importlib
import inspect
import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_type_hints

from pydantic import BaseModel, create_model

from neusee.nodes.own_modules import import_missing, own_files
from neusee.nodes.parameters import ParameterModel, as_paths, is_file

if TYPE_CHECKING:
    from torch import Tensor


# --- error bound ----------------------------------------------------------------------------------

# Statistics and error bounds of tensors, which an engine uses instead of the tensors.


#: up to this number of elements, a Python loop is faster than five calls of torch
_FEW_ELEMENTS = 64
_PART_ELEMENTS = 1 << 17  #: elements processed at once
_ROW_ELEMENTS = 1 << 10  #: elements of a row, which is summed in the precision of the tensor
#: bound of the relative round-off of a sum; float32 rows of 1024 elements stay far below it
_SUM_ROUND_OFF = 1e-4


@dataclass(frozen=True, slots=True)
class TensorStats:
    """Statistics of a tensor, such as range and sum; they are stored so that the tensor need not be
    loaded.
    """

    shape: tuple[int, ...]
    dtype: str
    min: float
    max: float
    sum: float
    support: int  #: number of nonzero elements
    finite: bool

    @classmethod
    def of(cls, value: Any) -> TensorStats | None:
        """Return the statistics of a tensor, or of the first element of a tuple or list; None for
        other values.
        """
        # imported here, so that a command without computation need not import torch
        from torch import Tensor

        if isinstance(value, tuple | list) and value:
            return cls.of(value[0])
        if not isinstance(value, Tensor):
            return None
        tensor = value.detach()
        shape, dtype = tuple(tensor.shape), str(tensor.dtype).removeprefix("torch.")
        if tensor.numel() == 0:
            return cls(shape, dtype, math.nan, math.nan, 0.0, 0, True)
        tensor = tensor.abs() if tensor.is_complex() else tensor
        few_elements = tensor.reshape(-1).tolist() if tensor.numel() <= _FEW_ELEMENTS else []
        # a Python sum is accurate enough; overflows and values that are not finite are handled
        # below
        if few_elements and math.isfinite(total := float(sum(few_elements))):
            return cls(
                shape,
                dtype,
                float(min(few_elements)),
                float(max(few_elements)),
                total,
                sum(v != 0 for v in few_elements),
                True,
            )
        lowest, highest, total, support = _measure(tensor.reshape(-1))
        finite = all(map(math.isfinite, (lowest, highest, total)))
        return cls(shape, dtype, lowest, highest, total, support, finite)

    @property
    def largest_rms(self) -> float:
        """Return the largest possible root mean square of a tensor with this number of elements,
        minimum, maximum and sum.

        The sum of squares is largest if all elements but one are at an end of the range. If the sum
        is not finite, all elements may be at the end of larger magnitude.
        """
        lowest, highest, count = self.min, self.max, math.prod(self.shape)
        largest_absolute = max(abs(lowest), abs(highest))
        if count == 0 or highest <= lowest or not math.isfinite(self.sum):
            return largest_absolute
        # for a given sum, the sum of squares is largest with all elements but one at an end of the
        # range
        count_at_top = min(max((self.sum - count * lowest) / (highest - lowest), 0.0), count)
        middle_value = lowest + (count_at_top - math.floor(count_at_top)) * (highest - lowest)
        count_at_bottom = max(count - math.floor(count_at_top) - 1, 0)
        square_sum = (
            math.floor(count_at_top) * highest**2 + middle_value**2 + count_at_bottom * lowest**2
        )
        return min(largest_absolute, math.sqrt(square_sum / count) * (1 + _SUM_ROUND_OFF))


def _measure(flat: Tensor) -> tuple[float, float, float, int]:
    """Return minimum, maximum, sum and number of nonzero elements of a flat tensor, computed in
    parts that fit into the CPU cache.
    """
    import torch

    # booleans and half precision are converted to float32
    is_small = flat.dtype == torch.bool or (flat.is_floating_point() and flat.element_size() < 4)
    part_statistics = [
        _measure_piece(piece, is_small) for piece in torch.split(flat, _PART_ELEMENTS)
    ]
    minima, maxima, sums, counts = (
        torch.stack(values) for values in zip(*part_statistics, strict=True)
    )
    lowest, highest, total = (float(x) for x in (minima.min(), maxima.max(), sums.sum()))
    # if the sum of a row overflowed, sum in float64
    if math.isinf(total) and math.isfinite(lowest) and math.isfinite(highest):
        total = float(
            sum(piece.sum(dtype=torch.float64) for piece in torch.split(flat, _PART_ELEMENTS))
        )
    return lowest, highest, total, int(counts.sum())


def _measure_piece(piece: Tensor, small: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return minimum, maximum, sum and number of nonzero elements of a piece; with ``small`` it is
    converted to float32.
    """
    import torch

    piece = piece.float() if small else piece
    rows = piece.view(-1, _ROW_ELEMENTS) if piece.numel() % _ROW_ELEMENTS == 0 else piece[None]
    low, high = torch.aminmax(piece)
    return low, high, rows.sum(1).sum(dtype=torch.float64), torch.count_nonzero(piece)


@dataclass(frozen=True, slots=True)
class ErrorBound:
    """A bound, or an estimate, of the error of a node's input, with the statistics of this
    input.
    """

    rms: float  #: bound of the root mean square error over the elements, in the unit of the input
    stats: TensorStats | None = None
    #: bound of the relative error of the largest element; None if unknown
    peak: float | None = None
    #: True if the error includes an estimate; else it is a proved upper bound
    estimated: bool = False
    #: part of `rms` that varies from element to element like noise; the other part is as smooth as
    #: the light itself
    scattered: float = 0.0

    @property
    def top(self) -> float:
        """Return the largest absolute value of the input, or 0 if its statistics are unknown."""
        return max(abs(self.stats.min), abs(self.stats.max)) if self.stats else 0.0

    @property
    def share(self) -> float:
        """Return the bound of the rms error of the input, relative to its largest absolute
        value.
        """
        if self.rms == 0.0:
            return 0.0
        return self.rms / self.top if self.top > 0 else math.inf

    @property
    def largest(self) -> float:
        """Return the bound of the relative error of the largest element of the input; inf if
        unknown.
        """
        if self.rms == 0.0:
            return 0.0
        return math.inf if self.peak is None else self.peak


# --- hooks ----------------------------------------------------------------------------------------

# Hooks: the functions that are attached to a node, such as bounds of its error and checks of its
# result.


@dataclass(frozen=True, slots=True)
class Check:
    """The outcome of one check of a node's result, such as ``Check("phase step 0.31 turn < 0.5",
    True)``.
    """

    text: str
    ok: bool = True


@dataclass(slots=True)
class Hooks:
    """The functions attached to a node (hooks), such as ``check``, attached by
    ``@digitize.check``.
    """

    #: slow reference in float64: same arguments, same result within ``rtol``
    reference: Callable[..., Any] | None = None
    #: (`TensorStats` of each input, *, parameters): bound of ``max |with - without| / max |with|``
    #: if the step is left out and its first input is used instead; for a random node, in root mean
    #: square over the noise
    skip_bound: Callable[..., float] | None = None
    #: (`TensorStats` of the first input, *, parameters): the factor by which the root mean square
    #: error of a single draw of the noise exceeds `skip_bound` in only one of 10 000 draws
    skip_draw: Callable[..., float] | None = None
    #: True if `skip_bound` is an estimate and not a bound; a recipe with ``estimates: false`` does
    #: not use it to omit a step
    skip_estimated: bool = False
    #: (`TensorStats` of the first input, *, parameters): the scale of `skip_bound`, such as the
    #: full well, if a later step clips larger values
    skip_scale: Callable[..., float] | None = None
    #: (`TensorStats` of each input, None for an absent input, *, parameters): bound of the largest
    #: element of the result; if it is 0, the step and the steps that only it uses are omitted
    zero_bound: Callable[..., float] | None = None
    #: (`ErrorBound` of each input, *, result: TensorStats, parameters): the error that errors of
    #: the inputs cause in the result; both errors are upper bounds in root mean square; a list
    #: input has a list, an absent input None; an `ErrorBound` in place of a number also tells the
    #: error of the largest element; without this hook the inputs must satisfy the tolerance
    #: themselves, because the error of the result is not known
    propagate_error: Callable[..., float | ErrorBound] | None = None
    #: (the same arguments): the error that only one of 10 000 draws of the noise exceeds, whereas
    #: `propagate_error` is over all draws; a run reports it and does not compare it with the
    #: tolerance
    propagate_draw: Callable[..., float] | None = None
    #: (the same arguments): the error of the result from noise-like errors of the inputs
    #: (`ErrorBound.scattered`, passed here as ``rms``); without this hook `propagate_error` is used
    #: for these errors too
    propagate_scattered: Callable[..., float] | None = None
    #: (rms error of the result as `propagate_error` gives it, *, result: TensorStats, parameters):
    #: the rms error including rounding to whole numbers; an estimate, which a run reports and does
    #: not compare with the tolerance
    rounding_error: Callable[..., float] | None = None
    #: True if `propagate_error` or `approximation_error` is an estimate and not a bound; a recipe
    #: with ``estimates: false`` does not use it
    estimated: bool = False
    #: (result): the error of a cheaper form relative to its largest element, as root mean square
    #: and for the largest element; both include the errors by cheaper forms of the inputs, but not
    #: those by omitted steps
    approximation_error: Callable[[Any], tuple[float, float]] | None = None
    #: (parameters): True if the result is the same for every band
    band_invariant: Callable[[Mapping[str, Any]], bool] | None = None
    #: (parameters): names of the parameters that change nothing beside the others, such as the law
    #: of a draw where a value is given; with ``rng`` if the node then draws nothing. The cache key
    #: leaves them out
    unused: Callable[[Mapping[str, Any]], Collection[str]] | None = None
    #: (*, parameters): notes for the user before the run; may raise `ParameterError`; an argument
    #: with the name of an input receives the input as far as it is known before the run (see
    #: ``shape``), else None
    preflight: Callable[..., Sequence[str]] | None = None
    #: (result, *inputs, **parameters): checks of a computed result
    check: Callable[..., Sequence[Check]] | None = None
    #: (each input as far as known before the run, else None, **parameters): the result as far as
    #: known before the run: tensors on the device ``meta``, which have shape and type but no
    #: values; a tensor of few numbers may have values. If the rule fails, such as for an unknown
    #: input, the result is unknown
    shape: Callable[..., Any] | None = None
    #: (`TensorStats` of each input, *, parameters): expected smallest and largest element of the
    #: result, for planning, not a bound; reading an unknown input raises LookupError
    expected_range: Callable[..., tuple[float, float]] | None = None
    #: (): the arguments, by name, of a small call with which `neusee check` tests the node
    example: Callable[[], Mapping[str, Any]] | None = None
    #: (result, *inputs, **parameters), all as for ``shape``: bytes of memory during the run in
    #: addition to inputs and result, and number of operations, both up to a constant factor, which
    #: is measured
    work: Callable[..., tuple[float, float]] | None = None


# --- node -----------------------------------------------------------------------------------------

# A node is a function that computes one step of a recipe, with typed parameters and attached
# functions (hooks).
#
# The signature defines the node. Arguments before ``*`` are data from other steps. Arguments after
# ``*`` are parameters from the recipe; for a parameter ``rng`` the engine passes a random
# generator.
#
#     @node(rtol=0.0)
#     def digitize(electrons: Tensor, *, gain: Gain, bits: Bits = 16) -> Tensor: ...
#
#     @digitize.reference        # slow and simple form in float64; a test compares to rtol
#     @digitize.skip_bound       # upper bound of the change if the step is skipped
#     @digitize.propagate_error  # upper bound of the error that errors of the inputs cause
#     @digitize.rounding_error   # the same with what rounding to whole numbers adds, an estimate
#     @digitize.unused           # parameters that change nothing beside the others
#     @digitize.preflight        # checks the parameters before anything runs
#     @digitize.check            # checks that the result is plausible
#     @digitize.shape            # shape and type of the result, before anything runs
#     @digitize.expected_range   # least and largest element of the result, guessed before a run
#     @digitize.work             # memory and number of operations beside what the shapes say
#     @digitize.example          # arguments of one small call, for `neusee check`
#
# ``digitize.hooks`` has each attached function under the name of its decorator; `nodes/_node.py`
# lists all hooks.


Device = Literal["any", "cpu", "gpu"]
Fn = TypeVar("Fn", bound=Callable[..., Any])
#: every node defined in this process, by module and name; a redefinition replaces the older node
_registered: dict[tuple[str, str], Node] = {}


class ParameterError(ValueError):
    """Raised by the ``preflight`` of a node for an invalid parameter, before any step runs.

    Its arguments are the name of the parameter, and one sentence with the value and the fix. The
    name ``direction.angle`` means the parameter ``angle`` of the step that computes the input
    ``direction``.
    """

    def __init__(self, parameter: str, message: str) -> None:
        super().__init__(message)
        self.parameter = parameter


def _attaches(hook: str) -> Callable[[Any, Fn], Fn]:
    """Return the decorator that attaches a function to a node as the hook with this name."""

    def attach(to: Node, fn: Fn) -> Fn:
        setattr(to.hooks, hook, fn)
        return fn

    attach.__doc__ = f"Attach the function to the node as its ``{hook}``, which `Hooks` describes."
    return attach


@dataclass(frozen=True, slots=True)
class NodeTraits:
    """The properties of a node that an engine needs in addition to its function; `node` explains
    each field.
    """

    device: Device = "any"  #: where the node may run
    rtol: float = 1e-5  #: largest relative error of the node against its reference
    #: axis of the bands in inputs and in "return", for a node that processes each band
    #: independently
    bands: Mapping[str, int] | None = None
    accepts_channel_sums: Sequence[str] = ()  #: inputs that may be weighted sums over the bands
    #: inputs that must be the same in every band if another input is a weighted sum over the bands
    needs_band_invariant: Sequence[str] = ()
    accepts_low_rank: Sequence[str] = ()  #: inputs that may be low-rank cubes
    #: groups of inputs whose first input is light that is only added: if one of its entries is 0,
    #: this entry is omitted in all inputs of the group
    additive_inputs: Sequence[tuple[str, ...]] = ()
    #: True for a node without inputs whose result is computed before planning
    before_run: bool = False
    #: what the function reads in addition to its arguments, such as "table.csv" or "env:X"
    depends: Sequence[str] = ()


class Node:
    """A function that computes one step of a recipe, with typed parameters and hooks such as
    checks.

    Two cheaper forms may replace a node where a recipe's tolerance allows it: ``channel_sum_form``
    gives `Channels` instead of all bands, and ``low_rank_form`` gives a `LowRankCube` instead of a
    cube.
    """

    def __init__(self, fn: Callable[..., Any], traits: NodeTraits | None = None) -> None:
        """Create a node from its function and its traits."""
        traits = traits or NodeTraits()
        functools.update_wrapper(self, fn)
        self.fn, self.device, self.rtol = fn, traits.device, traits.rtol
        self.accepts_channel_sums = tuple(traits.accepts_channel_sums)
        self.needs_band_invariant = tuple(traits.needs_band_invariant)
        self.accepts_low_rank = tuple(traits.accepts_low_rank)
        self.additive_inputs = tuple(traits.additive_inputs)
        self.channel_sum_form: Node | None = None
        self.low_rank_form: Node | None = None
        self.hooks = Hooks()
        self._read_signature()
        self.bands = traits.bands and self._checked_bands(traits.bands)
        self.before_run = traits.before_run
        self._require_texts(traits.depends)
        self.depends = tuple(traits.depends)
        #: declared environment variables with their values at import, when a module may read them
        self.environment = {name: os.environ.get(name) for name in _environment_names(self.depends)}
        self._refuse_inputs_before_run()
        _registered[fn.__module__, fn.__name__] = self

    def _read_signature(self) -> None:
        """Determine inputs, optional inputs, use of random numbers and parameters from the
        signature.
        """
        arguments = inspect.signature(self.fn).parameters.values()
        input_arguments = [
            argument for argument in arguments if argument.kind is argument.POSITIONAL_OR_KEYWORD
        ]
        self.inputs = tuple(argument.name for argument in input_arguments)
        self.optional = frozenset(
            argument.name for argument in input_arguments if argument.default is not argument.empty
        )
        self.random = any(argument.name == "rng" for argument in arguments)
        self._keyword_only = [
            argument
            for argument in arguments
            if argument.kind is argument.KEYWORD_ONLY and argument.name != "rng"
        ]

    def _require_texts(self, depends: Sequence[str]) -> None:
        """Raise ValueError unless declared dependencies are a list of texts that are not empty."""
        if isinstance(depends, str) or not all(
            isinstance(entry, str) and entry for entry in depends
        ):
            raise ValueError(
                f'{self.path}: depends={depends!r} must be a list of texts, such as ["table.csv",'
                ' "env:X"]'
            )

    def _refuse_inputs_before_run(self) -> None:
        """Raise ValueError for a node with ``before_run`` that has inputs or needs random
        numbers.
        """
        if self.before_run and (self.inputs or self.random):
            raise ValueError(
                f"{self.path}: before_run needs a node without inputs and without rng: omit"
                " before_run"
            )

    def __call__(self, *inputs: Any, **params: Any) -> Any:
        """Call the function of the node directly: gradients are kept, parameters are not validated,
        and no cache is used.

        For a file parameter, a text is taken as a path, as in a recipe.
        """
        texts = [name for name, value in params.items() if isinstance(value, str | list)]
        if texts:
            files = {name: self.hints[name] for name in texts if is_file(self.hints.get(name))}
            params |= {name: as_paths(hint, params[name]) for name, hint in files.items()}
        return self.fn(*inputs, **params)

    def __repr__(self) -> str:
        return f"<node {self.path}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a node by module and name; the process that unpickles it imports the code.

        The pickle also names the user's files that this process has imported, since results of
        their nodes may be inputs, and the name of the node in the recipe, since a recipe may choose
        its family.
        """
        return _imported, (self.fn.__module__, self.fn.__name__, own_files(), self.path)

    @functools.cached_property
    def path(self) -> str:
        """Return the name of the node in a recipe, such as ``sensor.digitize``."""
        module = self.fn.__module__.removeprefix("neusee.nodes.")
        public_names = [name for name in module.split(".") if not name.startswith("_")]
        if module != self.fn.__module__:
            # a room of a family, such as ``restore.networks``, is no part of the name
            public_names = public_names[:1]
        return ".".join([*public_names, self.fn.__name__])

    def _checked_bands(self, bands: Mapping[str, int]) -> Mapping[str, int]:
        """Return the axes of the bands as a read-only mapping; raise ValueError unless they name
        "return" and at least one input.
        """
        unknown_names = sorted(bands.keys() - {*self.inputs, "return"})
        if unknown_names or "return" not in bands or len(bands) < 2:
            raise ValueError(
                f"{self.path}: bands={dict(bands)} must name 'return' and at least one of"
                f" {self.inputs}"
            )
        if self.random:
            raise ValueError(
                f"{self.path} draws random numbers, so each band would depend on the other bands:"
                " omit bands="
            )
        return MappingProxyType(dict(bands))

    @functools.cached_property
    def hints(self) -> dict[str, Any]:
        """Return the type annotations of the arguments and of the result, with ``Annotated``
        metadata.
        """
        return get_type_hints(self.fn, include_extras=True)

    @functools.cached_property
    def params(self) -> type[BaseModel]:
        """Return the pydantic model that validates the parameters and rejects unknown ones."""
        fields = {
            argument.name: (
                self.hints[argument.name],
                ... if argument.default is argument.empty else argument.default,
            )
            for argument in self._keyword_only
        }
        model: type[BaseModel] = create_model(
            self.fn.__name__, __base__=ParameterModel, __module__=self.fn.__module__, **fields
        )  # type: ignore[call-overload]
        return model

    reference, preflight, check = _attaches("reference"), _attaches("preflight"), _attaches("check")
    skip_bound, skip_scale, zero_bound = (
        _attaches("skip_bound"),
        _attaches("skip_scale"),
        _attaches("zero_bound"),
    )
    propagate_error, approximation_error = (
        _attaches("propagate_error"),
        _attaches("approximation_error"),
    )
    propagate_scattered, rounding_error = (
        _attaches("propagate_scattered"),
        _attaches("rounding_error"),
    )
    propagate_draw, skip_draw = _attaches("propagate_draw"), _attaches("skip_draw")
    band_invariant, unused = _attaches("band_invariant"), _attaches("unused")
    expected_range = _attaches("expected_range")
    shape, work, example = _attaches("shape"), _attaches("work"), _attaches("example")

    def unused_parameters(self, params: Mapping[str, Any]) -> frozenset[str]:
        """Return the names of the parameters that change nothing beside the others."""
        return frozenset(self.hooks.unused(params) if self.hooks.unused else ())

    @property
    def preflight_inputs(self) -> tuple[str, ...]:
        """Return the names of the inputs that the hook ``preflight`` takes as arguments."""
        hook = self.hooks.preflight
        return tuple(name for name in _arguments(hook) if name in self.inputs) if hook else ()


@functools.lru_cache(1000)
def _arguments(hook: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of the arguments of a hook."""
    return tuple(inspect.signature(hook).parameters)


def registered_nodes() -> tuple[Node, ...]:
    """Return all nodes defined or imported in this process; of redefined nodes, only the newest."""
    return tuple(_registered.values())


def _environment_names(depends: Sequence[str]) -> list[str]:
    """Return the names of the environment variables among declared dependencies."""
    return [entry.removeprefix("env:") for entry in depends if entry.startswith("env:")]


def _imported(module: str, name: str, files: tuple[str, ...] = (), path: str = "") -> Node:
    """Import a module and return one of its nodes, with the name ``path`` that a recipe has given
    it.
    """
    import_missing(files, module)
    imported: Node = getattr(importlib.import_module(module), name)
    if path:
        imported.path = path
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
    """Return the decorator that turns a function into a node; ``rtol`` is the allowed error
    relative to the reference.

    Args:
        bands: the axis of the bands of some inputs and of the result (``return``). Band i of the
            result depends only on band i of these inputs and on the whole of every other input, and
            is the same to the last bit for any other bands in the stack. In a named tuple, only the
            fields in `values.BAND_FIELDS` have this axis.
        accepts_channel_sums: inputs that may be `Channels` instead of an image of all bands.
        needs_band_invariant: inputs that must be the same for every band if an image is given as
            `Channels`.
        accepts_low_rank: inputs that may be a `LowRankCube` instead of a cube.
        additive_inputs: groups of inputs; the first input of a group is optional or a list, and
            changes nothing where its values are zero. The other inputs of the group are used only
            with the first input.
        before_run: True for a node without inputs and with a result of few numbers, which is also
            computed when a recipe is checked, so that the preflight of another node can use the
            result.
        depends: what the code reads and no import shows: files beside the module, ``env:NAME``,
            names of modules. The page ``recipes/guide/code_changes.md`` lists the constructs that
            need an entry.
    """
    traits = NodeTraits(
        device=device,
        rtol=rtol,
        bands=bands,
        accepts_channel_sums=accepts_channel_sums,
        needs_band_invariant=needs_band_invariant,
        accepts_low_rank=accepts_low_rank,
        additive_inputs=additive_inputs,
        before_run=before_run,
        depends=depends,
    )
    return lambda fn: Node(fn, traits)


__all__ = [
    "Check",
    "ErrorBound",
    "Hooks",
    "Node",
    "ParameterError",
    "TensorStats",
    "node",
    "registered_nodes",
]
