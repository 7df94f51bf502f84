"""Rules on the description of a node and on its results, and the outcome of a call."""

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

# The finding of one rule on one node.


@dataclass(frozen=True, slots=True)
class Finding:
    """The outcome of a rule, such as ``Finding("reference", False, "off by 3e-3, more than rtol
    = 1e-5")``.
    """

    rule: str
    ok: bool | None  #: None if an optional part is missing, or the rule was not tried
    text: str

    @classmethod
    def of(cls, rule: str, ok: bool, kept_text: str, broken_text: str) -> Finding:
        """Return the outcome of a rule, with the text for a rule that is kept or that is broken."""
        text = kept_text if ok else broken_text
        return cls(rule, ok, text)


# --- document rules -------------------------------------------------------------------------------

# Rules on the description of a node: docstring, annotations, arguments of its hooks.


_LINES = ("Shapes:", "Units:", "Error:", "Source:")
_MOST_CHARACTERS = 240  #: characters of the first paragraph
_HOOKS = ("reference", "skip_bound", "skip_scale", "zero_bound", "preflight", "shape", "check")


def check_docstring(node: Node) -> Iterator[Finding]:
    """Find whether the docstring begins with one sentence and has the lines of a node."""
    text = inspect.getdoc(node.fn) or ""
    first_paragraph, lines = text.split("\n\n")[0], text.splitlines()
    faults = []
    if (
        not first_paragraph.endswith(".")
        or not first_paragraph[:1].isupper()
        or len(first_paragraph) > _MOST_CHARACTERS
    ):
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
    """Return True if exactly one line begins with ``word``, and a text follows."""
    lines_with_word = [line for line in lines if line.startswith(word)]
    return len(lines_with_word) == 1 and len(lines_with_word[0].removeprefix(word).strip()) >= 2


def check_signature(node: Node) -> Iterator[Finding]:
    """Find whether every argument and the result are annotated, and the parameters can be
    validated.
    """
    try:
        argument_names = inspect.signature(node.fn).parameters
        without_annotation = [
            name for name in argument_names if name not in node.hints and name != "rng"
        ]
        without_annotation += [] if "return" in node.hints else ["the result"]
        # the model of the parameters fails where one cannot be validated
        fields = [] if without_annotation else list(node.params.model_fields)
    except Exception as error:
        yield Finding(
            "signature", False, f"an annotation cannot be read: {type(error).__name__}: {error}"
        )
        return
    count = f"{len(fields)} parameter{'s' * (len(fields) != 1)}"
    text = (
        f"without an annotation: {', '.join(without_annotation)}"
        if without_annotation
        else f"{count}, all annotated"
    )
    yield Finding("signature", not without_annotation, text)


def check_hooks(node: Node) -> Iterator[Finding]:
    """Find whether each hook takes arguments that the node has."""
    own_names = {*inspect.signature(node.fn).parameters, "result"}
    faults = []
    for name in _HOOKS:
        hook = getattr(node.hooks, name)
        for parameter in inspect.signature(hook).parameters.values() if hook else ():
            if parameter.kind is parameter.KEYWORD_ONLY and parameter.name not in own_names:
                faults.append(
                    f"{name} asks for {parameter.name}, which {node.fn.__name__} does not have"
                )
    attached = [name for name in _HOOKS if getattr(node.hooks, name)]
    yield Finding("hooks", not faults, "; ".join(faults) or (", ".join(attached) or "none"))


def _raises(node: Node) -> bool:
    """Return True if the code of a node has a ``raise`` statement."""
    try:
        source = textwrap.dedent(inspect.getsource(node.fn))
    except OSError:
        return False
    return any(isinstance(item, ast.Raise) for item in ast.walk(ast.parse(source)))


# --- value rules ----------------------------------------------------------------------------------

# Rules on the results of a node, checked on one example of a call.


_SEED = 2026
_MOST_NUMBERS = 8  #: numbers of a tensor whose values a rule for shapes may read
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
    """Find whether the result is finite, of the annotated type and the same twice, and whether the
    inputs are unchanged.
    """
    inputs_before = [x.clone() for x in tensors_in(list(call.inputs))]
    result, second_result = call.result(), call.result()
    inputs_after = tensors_in(list(call.inputs))
    is_unchanged = all(torch.equal(x, y) for x, y in zip(inputs_before, inputs_after, strict=True))
    yield Finding.of(
        "inputs",
        is_unchanged,
        "left as they were",
        "changed in place: let the node clone the input",
    )
    is_finite = all(bool(x.isfinite().all()) for x in _floating(result))
    yield Finding.of(
        "finite", is_finite, "no NaN, no infinity", "the result has NaN or infinite values"
    )
    is_repeated = all(
        # tolerances 0, and NaN equal to NaN
        torch.allclose(x, y, 0.0, 0.0, True)
        for x, y in zip(tensors_in(result), tensors_in(second_result), strict=True)
    )
    yield Finding.of(
        "same twice", is_repeated, "the same bits", "two calls differ: draw from the argument rng"
    )
    annotated_type = call.node.hints.get("return", Any)
    is_kind = fits(result, annotated_type)
    text = (
        f"as annotated: {getattr(annotated_type, '__name__', annotated_type)}"
        if is_kind
        else f"a {type(result).__name__}, not {annotated_type}"
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
        return  # a cheaper form returns factors, and many sets of factors have the same product
    rng = {"rng": torch.Generator().manual_seed(_SEED)} if node.random else {}
    results = tensors_in(call.result())
    reference_results = tensors_in(node.hooks.reference(*call.inputs, **call.params, **rng))
    if [x.shape for x in results] != [x.shape for x in reference_results]:
        shapes = [_shapes(tensors) or "no tensor" for tensors in (results, reference_results)]
        yield Finding("reference", False, f"the result is {shapes[0]}, the reference {shapes[1]}")
        return
    error = max(map(off_by, results, reference_results), default=0.0)
    is_within = error <= node.rtol
    yield Finding(
        "reference", is_within, f"off by {error:.2g} of the largest value; rtol = {node.rtol:.2g}"
    )


def check_gradient(call: Call) -> Iterator[Finding]:
    """Find whether each gradient agrees with finite differences in float64."""
    lines = (inspect.getdoc(call.node.fn) or "").splitlines()
    gradient_lines = [line for line in lines if line.startswith("Gradient:")]
    if gradient_lines:
        yield Finding("gradient", None, f"not compared: {gradient_lines[0]}")
        return
    # inputs with a gradient
    names_followed = []
    for name, function, zero in _followed(call):
        if fault := _slope_fault(function, zero):
            yield Finding("gradient", False, f"with respect to {name}: {fault}")
            return
        names_followed.append(name)
    if names_followed:
        yield Finding(
            "gradient",
            True,
            f"as finite differences, with respect to {', '.join(dict.fromkeys(names_followed))}",
        )


def _followed(
    call: Call,
) -> Iterator[tuple[str, Callable[[Tensor], tuple[Tensor, ...]], Tensor]]:
    """Yield, for each input tensor with a gradient, the name of the input, the result as a function
    of a change of the tensor, and a change of zero.
    """
    inputs = [_double(value) for value in call.inputs]
    # each result is compared relative to its largest value
    largest_values = [_largest(y) for y in _floating(call.result(inputs))]
    for i, name in enumerate(call.node.inputs):
        for j, x in enumerate(tensors_in([inputs[i]])):
            if not x.is_floating_point() or x.numel() == 0:
                continue
            result_of_change = partial(_scaled, call, inputs, i, j, largest_values)
            zero = torch.zeros_like(x, requires_grad=True)
            with warnings.catch_warnings():
                # a node may read a number from a tensor, which has no gradient
                warnings.simplefilter("ignore")
                has_slope = any(y.requires_grad for y in result_of_change(zero))
            if has_slope:
                yield name, result_of_change, zero


def _slope_fault(function: Callable[[Tensor], tuple[Tensor, ...]], zero: Tensor) -> str:
    """Return what is wrong with the gradient of a function at ``zero``; empty if it agrees with
    finite differences.
    """
    slopes = [y.requires_grad for y in function(zero)]

    # gradcheck pairs results wrongly if one of them has no gradient
    def followed(x: Tensor) -> tuple[Tensor, ...]:
        return tuple(y for y, has_slope in zip(function(x), slopes, strict=True) if has_slope)

    results = followed(zero)
    # the gradient of the sum of all results
    slope = torch.autograd.grad(results, zero, [torch.ones_like(y) for y in results])[0]
    if bad_values := int((~slope.isfinite()).sum()):
        return (
            f"NaN or infinite for {bad_values} of {slope.numel()} values: see where a root,"
            " a logarithm or a quotient is 0"
        )
    try:
        # fast mode: along one random direction in place of each element
        gradcheck(followed, (zero,), eps=_STEP, atol=_ATOL, rtol=_RTOL, fast_mode=True)
    except GradcheckError as error:
        slope_texts = _SLOPES.search(str(error))
        if slope_texts is None:
            return " ".join(str(error).split())
        return (
            f"along a drawn direction the slope is {slope_texts[2]},"
            f" but by finite differences {slope_texts[1]}"
        )
    return ""


def check_bands(call: Call) -> Iterator[Finding]:
    """Find whether a band that is computed alone has the same bits as in the stack of bands, if the
    node declares that.
    """
    axes = call.node.bands
    if not axes:
        return
    first_bands = [
        _first_band(value, axes[name]) if name in axes else value
        for name, value in zip(call.node.inputs, call.inputs, strict=True)
    ]
    band_of_stack = tensors_in(_first_band(call.result(), axes["return"]))
    band_alone = tensors_in(call.result(first_bands))
    is_same = all(torch.equal(x, y) for x, y in zip(band_of_stack, band_alone, strict=True))
    yield Finding(
        "bands", is_same, f"the first band alone has {'the same' if is_same else 'other'} bits"
    )


def check_skip_bound(call: Call) -> Iterator[Finding]:
    """Find whether leaving the node out changes the result by no more than its bound."""
    hook = call.node.hooks.skip_bound
    if hook is None:
        return
    result = call.result()
    if not isinstance(result, Tensor) or not isinstance(call.inputs[0], Tensor):
        return
    replacement = call.inputs[0]
    input_stats = [TensorStats.of(value) for value in call.inputs]
    bound = float(hook(*input_stats, **call.params))
    # a result of another shape cannot be compared
    if replacement.shape != result.shape or math.isnan(bound):
        return
    scale = float(replacement.abs().max())
    if (skip_scale := call.node.hooks.skip_scale) is not None:
        scale = min(scale, float(skip_scale(input_stats[0], **call.params)))
    change = _size(result - replacement, call.node.random) / (scale or 1.0)
    # five standard deviations of a root mean square over few numbers
    margin = 5 / math.sqrt(result.numel()) if call.node.random else 1e-9
    is_within = change <= bound * (1 + margin) + 1e-12
    yield Finding(
        "skip bound",
        is_within,
        f"left out, the result changes by {change:.3g}; the bound is {bound:.3g}",
    )


def _size(change: Tensor, is_random: bool) -> float:
    """Return the largest absolute element of a change, or its root mean square if it is random."""
    double = change.double()
    size = double.square().mean().sqrt() if is_random else double.abs().max()
    return float(size)


def check_shape(call: Call) -> Iterator[Finding]:
    """Find whether the node's rule for shapes predicts the shape of the result."""
    hook = call.node.hooks.shape
    if hook is None:
        return
    inputs = [
        each_tensor(lambda x: x.to("meta") if x.numel() > _MOST_NUMBERS else x, value)
        for value in call.inputs
    ]
    stated_tensors = _every_tensor(hook(*inputs, **call.params))
    actual_tensors = _every_tensor(call.result())
    is_same = [tuple(x.shape) for x in stated_tensors] == [tuple(x.shape) for x in actual_tensors]
    yield Finding("shape", is_same, f"told {_shapes(stated_tensors)}, is {_shapes(actual_tensors)}")


def _every_tensor(value: Any) -> list[Tensor]:
    """Return the tensors in ``value``; a tensor at two places is returned twice, because predicted
    tensors may be shared.
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
    tensor_numbers = itertools.count()

    def changed(x: Tensor) -> Tensor:
        # the tensors of an input are numbered in the order in which they are met
        return x + _largest(x) * change if next(tensor_numbers) == j else x

    result = call.result(
        [
            each_tensor(changed, value) if input_index == i else value
            for input_index, value in enumerate(inputs)
        ]
    )
    return tuple(y / scale for y, scale in zip(_floating(result), scales, strict=True))


def _largest(x: Tensor) -> float:
    """Return the largest absolute value of a tensor, or 1 if that is 0 or the tensor is empty."""
    return (float(x.detach().abs().max()) if x.numel() else 0.0) or 1.0


def _floating(result: Any) -> list[Tensor]:
    """Return the tensors of a result that have floating-point or complex numbers."""
    return [y for y in tensors_in(result) if y.is_floating_point() or y.is_complex()]


def _double(value: Any) -> Any:
    """Return a value with its floating-point tensors in float64."""
    return each_tensor(lambda x: x.double() if x.is_floating_point() else x, value)


def _first_band(value: Any, axis: int) -> Any:
    """Return a value with its first band alone; in a named tuple, the fields with bands are cut."""
    if isinstance(value, Tensor):
        return value.narrow(axis, 0, 1)
    fields = {name: getattr(value, name) for name in band_names(value)}
    first_bands = {name: x.narrow(axis, 0, 1) for name, x in fields.items() if x is not None}
    return value._replace(**first_bands) if first_bands else value


def off_by(actual: Tensor, expected: Tensor) -> float:
    """Return the largest difference of two tensors relative to the largest expected value."""
    if actual.numel() == 0:
        return 0.0
    double_type = torch.complex128 if expected.is_complex() else torch.float64
    scale = float(expected.to(double_type).abs().max())
    return float((actual.to(double_type) - expected.to(double_type)).abs().max()) / (scale or 1.0)


def _shapes(tensors: Sequence[Tensor]) -> str:
    """Return the shapes of tensors as text, such as ``3 x 32 x 32``."""
    return ", ".join(" x ".join(map(str, x.shape)) or "number" for x in tensors)


# --- outcomes -------------------------------------------------------------------------------------

# Outcome of a call in a form that another process can compare: the parts of the result, an error,
# or an end without either.


_PLAIN = (bool, int, float, complex, str, bytes, type(None))
_EPS = 16  #: error of a sum in another order, in units of the machine epsilon


@dataclass(frozen=True, slots=True)
class Outcome:
    """The parts of a result, each with its place in the result, or the reason why there is no
    result.
    """

    parts: tuple[tuple[str, Any], ...] = ()
    failure: str = ""  #: such as "raises ValueError: ..."
    place: str = ""  #: file and line of the failure in the code of the user
    is_end: bool = False  #: True if the call ended its process, or did not return

    def names(self) -> list[str]:
        """Return the places of the parts in the result."""
        return [name for name, _ in self.parts]


@dataclass(frozen=True, slots=True)
class Difference:
    """How one outcome differs from another one."""

    text: str
    place: str = ""
    size: float = float("inf")  #: relative to the largest value; infinite if not a size of numbers
    is_rounding: bool = False  #: True if a sum in another order explains it


def outcome_of(function: Callable[[], Any], module: str) -> Outcome:
    """Call a function of a module and return the outcome."""
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
    deviations = [
        _of_part(name, actual_part, expected_part, rtol)
        for (name, actual_part), (_, expected_part) in pairs
    ]
    differing = [deviation for deviation in deviations if deviation]
    return max(differing, key=lambda deviation: deviation.size, default=None)


def _of_failures(actual: Outcome, expected: Outcome) -> Difference | None:
    """Return how an outcome differs from another one, if one of the two is a failure."""
    if actual.failure == expected.failure:
        return None
    text = f"it {actual.failure}" if actual.failure else "it gives a result"
    return Difference(text, actual.place)


def _of_part(name: str, actual: Any, expected: Any, rtol: float) -> Difference | None:
    """Return how one part of a result differs; None if it does not."""
    subject = f"the result{name}"
    # numbers, texts and other values without a norm
    if not isinstance(actual, Tensor) or not isinstance(expected, Tensor):
        if _same_value(actual, expected):
            return None
        return Difference(f"{subject} is {_short(actual)} and not {_short(expected)}")
    if actual.shape != expected.shape or actual.dtype != expected.dtype:
        return Difference(f"{subject} is {_kind(actual)} and not {_kind(expected)}")
    # tolerances 0, and NaN equal to NaN
    if torch.allclose(actual, expected, 0.0, 0.0, True):
        return None
    size = off_by(actual, expected)
    if not size < float("inf"):
        return Difference(f"{subject} has NaN or infinite values at other places")
    return Difference(
        f"{subject} differs by {size:.2g} of its largest value",
        "",
        size,
        # True: rounding explains it
        size <= max(rtol, _EPS * _last_digit(expected)),
    )


def _same_value(actual: Any, expected: Any) -> bool:
    """Return True for equal values of one type, and for two NaN."""
    if type(actual) is not type(expected):
        return False
    # NaN is not equal to itself
    return bool(actual == expected or (actual != actual and expected != expected))


def _last_digit(x: Tensor) -> float:
    """Return the machine epsilon of the type of a tensor; 0 for whole numbers."""
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
    """Return the elements of a value with their places in it, or None for a value of an unknown
    kind.
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
    """Return a value as a text of at most 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _kind(x: Tensor) -> str:
    """Return the shape and type of a tensor as text."""
    return f"{' x '.join(map(str, x.shape)) or 'number'} {str(x.dtype).removeprefix('torch.')}"
