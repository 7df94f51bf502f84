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

``digitize.hooks`` has each attached function under the name of its decorator; `nodes/_hooks.py` lists all hooks.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, TypeVar, get_type_hints

from pydantic import BaseModel, create_model

from neusee.nodes._error_bound import ErrorBound, TensorStats
from neusee.nodes._hooks import Check, Hooks
from neusee.nodes.file_parameters import as_paths, is_file
from neusee.nodes.own_modules import import_missing, own_files
from neusee.nodes.parameter_model import ParameterModel

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
        """Call the function of the node directly, with gradients, without parameter validation and without cache.

        A text for a parameter that is a file is a path, as in a recipe.
        """
        texts = [name for name, value in params.items() if isinstance(value, str | list)]
        if texts:
            files = {name: self.hints[name] for name in texts if is_file(self.hints.get(name))}
            params |= {name: as_paths(hint, params[name]) for name, hint in files.items()}
        return self.fn(*inputs, **params)

    def __repr__(self) -> str:
        return f"<node {self.path}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a node as module and name, so that the process that unpickles the node imports the code.

        Files of the user that this process has imported are named too: a result of their nodes may be an input. So is
        the name in a recipe, whose family a recipe may choose.
        """
        return _imported, (self.fn.__module__, self.fn.__name__, own_files(), self.path)

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
        model: type[BaseModel] = create_model(
            self.fn.__name__, __base__=ParameterModel, __module__=self.fn.__module__, **fields
        )  # type: ignore[call-overload]
        return model

    reference, preflight, check = _attaches("reference"), _attaches("preflight"), _attaches("check")
    skip_bound, skip_scale, zero_bound = _attaches("skip_bound"), _attaches("skip_scale"), _attaches("zero_bound")
    propagate_error, approximation_error = _attaches("propagate_error"), _attaches("approximation_error")
    propagate_scattered, rounding_error = _attaches("propagate_scattered"), _attaches("rounding_error")
    propagate_draw, skip_draw = _attaches("propagate_draw"), _attaches("skip_draw")
    band_invariant = _attaches("band_invariant")
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


def _imported(module: str, name: str, files: tuple[str, ...] = (), path: str = "") -> Node:
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
