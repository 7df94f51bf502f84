"""Rules on what a node says of itself and what it computes, and the outcome of a call."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import math
import re
import textwrap
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError, gradcheck

from neusee.nodes import Node, TensorStats
from neusee.nodes.values import band_names
from neusee.workflows.store.serialization import each_tensor, fits, tensors_in

# --- finding --------------------------------------------------------------------------------------

# What one rule found about one node.


@dataclass(frozen=True, slots=True)
class Finding:
    """The outcome of a rule, such as ``Finding("reference", False, "off by 3e-3, more than rtol
    = 1e-5")``.
    """

    rule: str
    ok: bool | None  #: None if the node leaves out what would be good to have
    text: str

    @classmethod
    def of(cls, rule: str, ok: bool, kept_text: str, broken_text: str) -> Finding:
        """Return the outcome of a rule, with the text for a rule that is kept or that is broken."""
        text = kept_text if ok else broken_text
        return cls(rule, ok, text)


# --- document rules -------------------------------------------------------------------------------

# Rules on what a node says of itself: docstring, annotations, arguments of its hooks.


_LINES = ("Shapes:", "Units:", "Error:", "Source:")
_LONGEST = 240  #: characters of the first paragraph
_HOOKS = ("reference", "skip_bound", "skip_scale", "zero_bound", "preflight", "shape", "check")


def check_docstring(node: Node) -> Iterator[Finding]:
    """Find whether the docstring begins with one sentence and has the lines of a node."""
    text = inspect.getdoc(node.fn) or ""
    first, lines = text.split("\n\n")[0], text.splitlines()
    faults = []
    if not first.endswith(".") or not first[:1].isupper() or len(first) > _LONGEST:
        faults.append("the first paragraph must be one sentence")
    faults += [f"one line must begin with {word}" for word in _LINES if not _has_line(lines, word)]
    if "Raises:" not in text and _raises(node):
        faults.append("the function raises an error, so one line must begin with Raises:")
    yield Finding(
        "docstring",
        not faults,
        "; ".join(faults) or "one sentence, shapes, units, error and source",
    )


def _has_line(lines: Sequence[str], word: str) -> bool:
    """Return True if one line alone begins with a word, and says something."""
    begun = [line for line in lines if line.startswith(word)]
    return len(begun) == 1 and len(begun[0].removeprefix(word).strip()) >= 2


def check_signature(node: Node) -> Iterator[Finding]:
    """Find whether every argument and the result are annotated, and the parameters can be
    validated.
    """
    try:
        names = inspect.signature(node.fn).parameters
        bare = [name for name in names if name not in node.hints and name != "rng"]
        bare += [] if "return" in node.hints else ["the result"]
        fields = [] if bare else list(node.params.model_fields)
    except Exception as error:
        yield Finding(
            "signature", False, f"an annotation cannot be read: {type(error).__name__}: {error}"
        )
        return
    count = f"{len(fields)} parameter{'s' * (len(fields) != 1)}"
    text = f"without an annotation: {', '.join(bare)}" if bare else f"{count}, all annotated"
    yield Finding("signature", not bare, text)


def check_hooks(node: Node) -> Iterator[Finding]:
    """Find whether each hook takes arguments that the node has."""
    own = {*inspect.signature(node.fn).parameters, "result"}
    faults = []
    for name in _HOOKS:
        hook = getattr(node.hooks, name)
        for p in inspect.signature(hook).parameters.values() if hook else ():
            if p.kind is p.KEYWORD_ONLY and p.name not in own:
                faults.append(f"{name} asks for {p.name}, which {node.fn.__name__} does not have")
    attached = [name for name in _HOOKS if getattr(node.hooks, name)]
    yield Finding("hooks", not faults, "; ".join(faults) or (", ".join(attached) or "none"))


def _raises(node: Node) -> bool:
    try:
        source = textwrap.dedent(inspect.getsource(node.fn))
    except OSError:
        return False
    return any(isinstance(item, ast.Raise) for item in ast.walk(ast.parse(source)))


# --- value rules ----------------------------------------------------------------------------------

# Rules on what a node computes, checked on one example of a call.


_SEED = 2026
_FEW = 8  #: numbers of a tensor whose values a rule for shapes may read
_SLOPES = re.compile(
    r"numerical:\s*(?:tensor\()?([^\s,)]+).*?analytical:\s*(?:tensor\()?([^\s,)]+)", re.DOTALL
)
#: of the comparison of gradients, relative to the scale of input and result
_STEP, _ATOL, _RTOL = 1e-5, 1e-4, 1e-3


@dataclass(frozen=True)
class Call:
    """One call of a node: its inputs and its parameters in SI."""

    node: Node
    inputs: Sequence[Any]
    params: Mapping[str, Any]

    def result(self, inputs: Sequence[Any] | None = None) -> Any:
        """Return the result of the node, with the same random numbers each time."""
        rng = {"rng": torch.Generator().manual_seed(_SEED)} if self.node.random else {}
        values = self.inputs if inputs is None else inputs
        return self.node(*values, **self.params, **rng)


def check_result(call: Call) -> Iterator[Finding]:
    """Find whether the result is finite, of the annotated type, the same twice, and the inputs
    are left alone.
    """
    before = [x.clone() for x in tensors_in(list(call.inputs))]
    first, second = call.result(), call.result()
    after = tensors_in(list(call.inputs))
    same = all(torch.equal(x, y) for x, y in zip(before, after, strict=True))
    yield Finding.of(
        "inputs", same, "left as they were", "changed in place: let the node clone the input"
    )
    finite = all(bool(x.isfinite().all()) for x in _floating(first))
    yield Finding.of(
        "finite", finite, "no NaN, no infinity", "the result has NaN or infinite values"
    )
    again = all(
        torch.allclose(x, y, 0.0, 0.0, True)
        for x, y in zip(tensors_in(first), tensors_in(second), strict=True)
    )
    yield Finding.of(
        "same twice", again, "the same bits", "two calls differ: draw from the argument rng"
    )
    kind = call.node.hints.get("return", Any)
    is_kind = fits(first, kind)
    text = (
        f"as annotated: {getattr(kind, '__name__', kind)}"
        if is_kind
        else f"a {type(first).__name__}, not {kind}"
    )
    yield Finding("type", is_kind, text)


def check_reference(call: Call) -> Iterator[Finding]:
    """Find whether the result agrees with the slow reference within the error that the node
    declares.
    """
    node = call.node
    if node.hooks.reference is None:
        name = node.fn.__name__
        yield Finding(
            "reference",
            None,
            f"none: attach a slow float64 form, written apart, with @{name}.reference",
        )
        return
    if node.hooks.approximation_error is not None:
        return  # factors of a cheaper form, of which many have the same product
    rng = {"rng": torch.Generator().manual_seed(_SEED)} if node.random else {}
    results = tensors_in(call.result())
    slow = tensors_in(node.hooks.reference(*call.inputs, **call.params, **rng))
    if [x.shape for x in results] != [x.shape for x in slow]:
        shapes = [_shapes(tensors) or "no tensor" for tensors in (results, slow)]
        yield Finding("reference", False, f"the result is {shapes[0]}, the reference {shapes[1]}")
        return
    error = max(map(off_by, results, slow), default=0.0)
    ok = error <= node.rtol
    yield Finding(
        "reference", ok, f"off by {error:.2g} of the largest value; rtol = {node.rtol:.2g}"
    )


def check_gradient(call: Call) -> Iterator[Finding]:
    """Find whether each gradient is that of finite differences in float64."""
    lines = (inspect.getdoc(call.node.fn) or "").splitlines()
    stated = [line for line in lines if line.startswith("Gradient:")]
    if stated:
        yield Finding("gradient", None, f"not compared: {stated[0]}")
        return
    followed = []
    for name, function, zero in _followed(call):
        if fault := _slope_fault(function, zero):
            yield Finding("gradient", False, f"with respect to {name}: {fault}")
            return
        followed.append(name)
    if followed:
        yield Finding(
            "gradient",
            True,
            f"as finite differences, with respect to {', '.join(dict.fromkeys(followed))}",
        )


def _followed(
    call: Call,
) -> Iterator[tuple[str, Callable[[Tensor], tuple[Tensor, ...]], Tensor]]:
    """Yield the name of the input of each tensor on which the result depends with a slope, the
    result as a function of a change of the tensor, and no change.
    """
    inputs = [_double(value) for value in call.inputs]
    scales = [_largest(y) for y in _floating(call.result(inputs))]
    for i, name in enumerate(call.node.inputs):
        for j, x in enumerate(tensors_in([inputs[i]])):
            if not x.is_floating_point() or x.numel() == 0:
                continue
            function = partial(_scaled, call, inputs, i, j, scales)
            zero = torch.zeros_like(x, requires_grad=True)
            with warnings.catch_warnings():
                # a node may read a number of a tensor without a slope
                warnings.simplefilter("ignore")
                follows = any(y.requires_grad for y in function(zero))
            if follows:
                yield name, function, zero


def _slope_fault(function: Callable[[Tensor], tuple[Tensor, ...]], zero: Tensor) -> str:
    """Return what is wrong with the slopes of a function at ``zero``; no text if they are those
    of differences.
    """
    follow = [y.requires_grad for y in function(zero)]

    # gradcheck pairs results wrongly where one of them has no slope
    def followed(x: Tensor) -> tuple[Tensor, ...]:
        return tuple(y for y, has_slope in zip(function(x), follow, strict=True) if has_slope)

    results = followed(zero)
    slope = torch.autograd.grad(results, zero, [torch.ones_like(y) for y in results])[0]
    if bad := int((~slope.isfinite()).sum()):
        return (
            f"NaN or infinite for {bad} of {slope.numel()} values: see where a root, a logarithm or"
            " a quotient is 0"
        )
    try:
        gradcheck(followed, (zero,), eps=_STEP, atol=_ATOL, rtol=_RTOL, fast_mode=True)
    except GradcheckError as error:
        both = _SLOPES.search(str(error))
        if both is None:
            return " ".join(str(error).split())
        return (
            f"along a drawn direction the slope is {both[2]}, but by finite differences {both[1]}"
        )
    return ""


def check_bands(call: Call) -> Iterator[Finding]:
    """Find whether one band alone has the bits that it has in the stack, if the node declares
    that.
    """
    axes = call.node.bands
    if not axes:
        return
    first_bands = [
        _first_band(value, axes[name]) if name in axes else value
        for name, value in zip(call.node.inputs, call.inputs, strict=True)
    ]
    of_stack = tensors_in(_first_band(call.result(), axes["return"]))
    alone = tensors_in(call.result(first_bands))
    same = all(torch.equal(x, y) for x, y in zip(of_stack, alone, strict=True))
    yield Finding("bands", same, f"the first band alone has {'the same' if same else 'other'} bits")


def check_skip_bound(call: Call) -> Iterator[Finding]:
    """Find whether leaving the node out changes the result by no more than its bound."""
    hook = call.node.hooks.skip_bound
    if hook is None:
        return
    result = call.result()
    if not isinstance(result, Tensor) or not isinstance(call.inputs[0], Tensor):
        return
    without = call.inputs[0]
    stats = [TensorStats.of(value) for value in call.inputs]
    bound = float(hook(*stats, **call.params))
    if without.shape != result.shape or math.isnan(bound):
        return
    scale = float(without.abs().max())
    if (of := call.node.hooks.skip_scale) is not None:
        scale = min(scale, float(of(stats[0], **call.params)))
    change = _size(result - without, call.node.random) / (scale or 1.0)
    # of a root mean square over few numbers
    spread = 5 / math.sqrt(result.numel()) if call.node.random else 1e-9
    ok = change <= bound * (1 + spread) + 1e-12
    yield Finding(
        "skip bound", ok, f"left out, the result changes by {change:.3g}; the bound is {bound:.3g}"
    )


def _size(change: Tensor, is_random: bool) -> float:
    """Return the largest element of a change, or the root mean square of a random one."""
    double = change.double()
    size = double.square().mean().sqrt() if is_random else double.abs().max()
    return float(size)


def check_shape(call: Call) -> Iterator[Finding]:
    """Find whether the rule for the shape tells the shape that comes."""
    hook = call.node.hooks.shape
    if hook is None:
        return
    inputs = [
        each_tensor(lambda x: x.to("meta") if x.numel() > _FEW else x, value)
        for value in call.inputs
    ]
    stated = _every_tensor(hook(*inputs, **call.params))
    actual = _every_tensor(call.result())
    same = [tuple(x.shape) for x in stated] == [tuple(x.shape) for x in actual]
    yield Finding("shape", same, f"told {_shapes(stated)}, is {_shapes(actual)}")


def _every_tensor(value: Any) -> list[Tensor]:
    """Return the tensors in ``value``, one that stands at two places twice: a shape that is told
    may be shared.
    """
    if isinstance(value, Tensor):
        return [value]
    elements: Iterable[Any] = ()
    if isinstance(value, dict):
        elements = value.values()
    elif isinstance(value, tuple | list):
        elements = value
    tensors = []
    for element in elements:
        tensors += _every_tensor(element)
    return tensors


def _scaled(
    call: Call, inputs: Sequence[Any], i: int, j: int, scales: Sequence[float], change: Tensor
) -> tuple[Tensor, ...]:
    """Return the floating tensors of the result over ``scales``, with a scaled ``change`` of
    tensor j in input i.
    """
    number = itertools.count()

    def changed(x: Tensor) -> Tensor:
        return x + _largest(x) * change if next(number) == j else x

    result = call.result(
        [each_tensor(changed, value) if n == i else value for n, value in enumerate(inputs)]
    )
    return tuple(y / scale for y, scale in zip(_floating(result), scales, strict=True))


def _largest(x: Tensor) -> float:
    """Return the largest absolute value of a tensor, or 1 if that is 0 or the tensor is empty."""
    return (float(x.detach().abs().max()) if x.numel() else 0.0) or 1.0


def _floating(result: Any) -> list[Tensor]:
    return [y for y in tensors_in(result) if y.is_floating_point() or y.is_complex()]


def _double(value: Any) -> Any:
    return each_tensor(lambda x: x.double() if x.is_floating_point() else x, value)


def _first_band(value: Any, axis: int) -> Any:
    """Return a value with its first band alone; of a named tuple, the fields that have bands are
    cut.
    """
    if isinstance(value, Tensor):
        return value.narrow(axis, 0, 1)
    fields = {name: getattr(value, name) for name in band_names(value)}
    cut = {name: x.narrow(axis, 0, 1) for name, x in fields.items() if x is not None}
    return value._replace(**cut) if cut else value


def off_by(actual: Tensor, expected: Tensor) -> float:
    """Return the largest difference of two tensors relative to the largest wanted value."""
    if actual.numel() == 0:
        return 0.0
    wide = torch.complex128 if expected.is_complex() else torch.float64
    scale = float(expected.to(wide).abs().max())
    return float((actual.to(wide) - expected.to(wide)).abs().max()) / (scale or 1.0)


def _shapes(tensors: Sequence[Tensor]) -> str:
    return ", ".join(" x ".join(map(str, x.shape)) or "number" for x in tensors)


# --- outcomes -------------------------------------------------------------------------------------

# What a call gave, in a form that another process can compare: its parts, an error, or an end
# without either.


_PLAIN = (bool, int, float, complex, str, bytes, type(None))
_EPS = 16  #: smallest steps of a type of numbers that a sum in another order is off by


@dataclass(frozen=True, slots=True)
class Outcome:
    """The parts of a result, each with its place in the result, or why there is none."""

    parts: tuple[tuple[str, Any], ...] = ()
    failure: str = ""  #: such as "raises ValueError: ..."
    place: str = ""  #: file and line of the failure in the code of the user
    is_end: bool = False  #: True if the call ended its process, or had no end

    def names(self) -> list[str]:
        """Return the places of the parts in the result."""
        return [name for name, _ in self.parts]


@dataclass(frozen=True, slots=True)
class Difference:
    """How one outcome differs from another one."""

    text: str
    place: str = ""
    size: float = float("inf")  #: relative to the largest value; infinite if no numbers say it
    is_rounding: bool = False  #: True if a sum in another order explains it


def outcome_of(function: Callable[[], Any], module: str) -> Outcome:
    """Return the outcome of a call of code of a module."""
    try:
        return Outcome(tuple(_parts("", function())))
    except (Exception, SystemExit) as error:
        return failed(error, module)


def failed(error: BaseException, module: str) -> Outcome:
    """Return the outcome of a call of code of a module that raised an error."""
    text = " ".join(str(error).split())
    return Outcome(
        failure=f"raises {type(error).__name__}: {text}".rstrip(": "), place=_place(error, module)
    )


def difference(actual: Outcome, expected: Outcome, rtol: float) -> Difference | None:
    """Return how an outcome differs; None if all bits are the same. NaN is the same as NaN."""
    if actual.failure or expected.failure:
        return _of_failures(actual, expected)
    if actual.names() != expected.names():
        return Difference("the result has other parts, or in another order")
    pairs = zip(actual.parts, expected.parts, strict=True)
    deviations = [_of_part(name, own, other, rtol) for (name, own), (_, other) in pairs]
    differing = [deviation for deviation in deviations if deviation]
    return max(differing, key=lambda deviation: deviation.size, default=None)


def _of_failures(actual: Outcome, expected: Outcome) -> Difference | None:
    """Return how an outcome differs, where one of both is a failure."""
    if actual.failure == expected.failure:
        return None
    text = f"it {actual.failure}" if actual.failure else "it gives a result"
    return Difference(text, actual.place)


def _of_part(name: str, actual: Any, expected: Any, rtol: float) -> Difference | None:
    """Return how one part of a result differs; None if it does not."""
    subject = f"the result{name}"
    if not isinstance(actual, Tensor) or not isinstance(expected, Tensor):
        if _same_value(actual, expected):
            return None
        return Difference(f"{subject} is {_short(actual)} and not {_short(expected)}")
    if actual.shape != expected.shape or actual.dtype != expected.dtype:
        return Difference(f"{subject} is {_kind(actual)} and not {_kind(expected)}")
    if torch.allclose(actual, expected, 0.0, 0.0, True):
        return None
    size = off_by(actual, expected)
    if not size < float("inf"):
        return Difference(f"{subject} has NaN or infinite values at other places")
    return Difference(
        f"{subject} differs by {size:.2g} of its largest value",
        "",
        size,
        size <= max(rtol, _EPS * _last_digit(expected)),
    )


def _same_value(actual: Any, expected: Any) -> bool:
    """Return True for equal values of one type, and for two NaN."""
    if type(actual) is not type(expected):
        return False
    return bool(actual == expected or (actual != actual and expected != expected))


def _last_digit(x: Tensor) -> float:
    """Return the step of the numbers of a tensor beside 1; 0 for whole numbers."""
    return torch.finfo(x.dtype).eps if x.is_floating_point() or x.is_complex() else 0.0


def _parts(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield every tensor and every plain value in a result, with its place; of anything else the
    type alone.
    """
    if isinstance(value, Tensor):
        yield name, value.detach().cpu()
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biufc":
        yield name, torch.from_numpy(np.ascontiguousarray(value).copy())
    elif isinstance(value, _PLAIN):
        yield name, value
    elif isinstance(value, set | frozenset):
        yield name, str(sorted(map(repr, value)))
    elif (items := _items(value)) is not None:
        for place, item in items:
            yield from _parts(name + place, item)
    else:
        yield name, f"{type(value).__module__}.{type(value).__qualname__}"


def _items(value: Any) -> list[tuple[str, Any]] | None:
    """Return what a value holds, each with its place in it; None for a value that holds nothing
    that is known.
    """
    if isinstance(value, dict):
        return [(f"[{key!r}]", item) for key, item in value.items()]
    if isinstance(value, tuple | list):
        fields = getattr(value, "_fields", None)
        return [
            (f".{fields[number]}" if fields else f"[{number}]", item)
            for number, item in enumerate(value)
        ]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [
            (f".{field.name}", getattr(value, field.name)) for field in dataclasses.fields(value)
        ]
    return None


def _place(error: BaseException, module: str) -> str:
    """Return file and line of the last code of a module that ran, or nothing if none did."""
    lines = [
        f"{Path(frame.f_code.co_filename).name}:{line}"
        for frame, line in traceback.walk_tb(error.__traceback__)
        if frame.f_globals.get("__name__") == module
    ]
    return lines[-1] if lines else ""


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _kind(x: Tensor) -> str:
    return f"{' x '.join(map(str, x.shape)) or 'number'} {str(x.dtype).removeprefix('torch.')}"
