"""Rules on what a node computes, checked on one example of a call."""

from __future__ import annotations

import inspect
import itertools
import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError, gradcheck

from neusee.nodes import Node, TensorStats
from neusee.nodes.values import band_names
from neusee.workflows.contract.finding import Finding
from neusee.workflows.store.serialization import each_tensor, tensors_in
from neusee.workflows.store.stored_types import fits

_SEED = 2026
_FEW = 8  #: numbers of a tensor whose values a rule for shapes may read
_SLOPES = re.compile(r"numerical:\s*(?:tensor\()?([^\s,)]+).*?analytical:\s*(?:tensor\()?([^\s,)]+)", re.DOTALL)
_STEP, _ATOL, _RTOL = 1e-5, 1e-4, 1e-3  #: of the comparison of gradients, relative to the scale of input and result


@dataclass(frozen=True)
class Call:
    """One call of a node: its inputs and its parameters in SI."""

    node: Node
    inputs: Sequence[Any]
    params: Mapping[str, Any]

    def result(self, inputs: Sequence[Any] | None = None) -> Any:
        """Return the result of the node, with the same random numbers each time."""
        rng = {"rng": torch.Generator().manual_seed(_SEED)} if self.node.random else {}
        return self.node(*(self.inputs if inputs is None else inputs), **self.params, **rng)


def check_result(call: Call) -> Iterator[Finding]:
    """Find whether the result is finite, of the annotated type, the same twice, and the inputs are left alone."""
    before = [x.clone() for x in tensors_in(list(call.inputs))]
    first, second = call.result(), call.result()
    after = tensors_in(list(call.inputs))
    same = all(torch.equal(x, y) for x, y in zip(before, after, strict=True))
    yield Finding("inputs", same, "left as they were" if same else "changed in place: let the node clone the input")
    tensors = tensors_in(first)
    finite = all(bool(x.isfinite().all()) for x in tensors if x.is_floating_point() or x.is_complex())
    yield Finding("finite", finite, "no NaN, no infinity" if finite else "the result has NaN or infinite values")
    again = all(torch.allclose(x, y, 0.0, 0.0, True) for x, y in zip(tensors, tensors_in(second), strict=True))
    yield Finding("same twice", again, "the same bits" if again else "two calls differ: draw from the argument rng")
    kind = call.node.hints.get("return", Any)
    is_kind = fits(first, kind)
    text = f"as annotated: {getattr(kind, '__name__', kind)}" if is_kind else f"a {type(first).__name__}, not {kind}"
    yield Finding("type", is_kind, text)


def check_reference(call: Call) -> Iterator[Finding]:
    """Find whether the result agrees with the slow reference within the error that the node declares."""
    node = call.node
    if node.hooks.reference is None:
        name = node.fn.__name__
        yield Finding("reference", None, f"none: attach a slow float64 form, written apart, with @{name}.reference")
        return
    if node.hooks.approximation_error is not None:
        return  # factors of a cheaper form, of which many have the same product
    rng = {"rng": torch.Generator().manual_seed(_SEED)} if node.random else {}
    found, slow = tensors_in(call.result()), tensors_in(node.hooks.reference(*call.inputs, **call.params, **rng))
    if [x.shape for x in found] != [x.shape for x in slow]:
        shapes = [_shapes(tensors) or "no tensor" for tensors in (found, slow)]
        yield Finding("reference", False, f"the result is {shapes[0]}, the reference {shapes[1]}")
        return
    error = max(map(off_by, found, slow), default=0.0)
    ok = error <= node.rtol
    yield Finding("reference", ok, f"off by {error:.2g} of the largest value; rtol = {node.rtol:.2g}")


def check_gradient(call: Call) -> Iterator[Finding]:
    """Find whether each gradient is that of finite differences in float64."""
    stated = [line for line in (inspect.getdoc(call.node.fn) or "").splitlines() if line.startswith("Gradient:")]
    if stated:
        yield Finding("gradient", None, f"not compared: {stated[0]}")
        return
    inputs = [_double(value) for value in call.inputs]
    scales = [_largest(y) for y in _floating(call.result(inputs))]
    followed = []
    for i, name in enumerate(call.node.inputs):
        for j, x in enumerate(tensors_in([inputs[i]])):
            if not x.is_floating_point() or x.numel() == 0:
                continue
            function = partial(_scaled, call, inputs, i, j, scales)
            zero = torch.zeros_like(x, requires_grad=True)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a node may read a number of a tensor without a slope
                if not any(y.requires_grad for y in function(zero)):
                    continue
            if fault := _slope_fault(function, zero):
                yield Finding("gradient", False, f"with respect to {name}: {fault}")
                return
            followed.append(name)
    if followed:
        yield Finding("gradient", True, f"as finite differences, with respect to {', '.join(dict.fromkeys(followed))}")


def _slope_fault(function: Callable[[Tensor], tuple[Tensor, ...]], zero: Tensor) -> str:
    """Return what is wrong with the slopes of a function at ``zero``; no text if they are those of differences."""
    follow = [y.requires_grad for y in function(zero)]

    def followed(x: Tensor) -> tuple[Tensor, ...]:  # gradcheck pairs results wrongly where one of them has no slope
        return tuple(y for y, has_slope in zip(function(x), follow, strict=True) if has_slope)

    results = followed(zero)
    slope = torch.autograd.grad(results, zero, [torch.ones_like(y) for y in results])[0]
    if bad := int((~slope.isfinite()).sum()):
        return f"NaN or infinite for {bad} of {slope.numel()} values: see where a root, a logarithm or a quotient is 0"
    try:
        gradcheck(followed, (zero,), eps=_STEP, atol=_ATOL, rtol=_RTOL, fast_mode=True)
    except GradcheckError as error:
        both = _SLOPES.search(str(error))
        if both is None:
            return " ".join(str(error).split())
        return f"along a drawn direction the slope is {both[2]}, but by finite differences {both[1]}"
    return ""


def check_bands(call: Call) -> Iterator[Finding]:
    """Find whether one band alone has the bits that it has in the stack, if the node declares that."""
    axes = call.node.bands
    if not axes:
        return
    one = [
        _first_band(value, axes[name]) if name in axes else value
        for name, value in zip(call.node.inputs, call.inputs, strict=True)
    ]
    whole, alone = tensors_in(_first_band(call.result(), axes["return"])), tensors_in(call.result(one))
    same = all(torch.equal(x, y) for x, y in zip(whole, alone, strict=True))
    yield Finding("bands", same, f"the first band alone has {'the same' if same else 'other'} bits")


def check_skip_bound(call: Call) -> Iterator[Finding]:
    """Find whether leaving the node out changes the result by no more than its bound."""
    hook = call.node.hooks.skip_bound
    if hook is None or not isinstance(whole := call.result(), Tensor) or not isinstance(call.inputs[0], Tensor):
        return
    stats = [TensorStats.of(value) for value in call.inputs]
    bound = float(hook(*stats, **call.params))
    without = call.inputs[0]
    if without.shape != whole.shape or math.isnan(bound):
        return
    scale = float(without.abs().max())
    if (of := call.node.hooks.skip_scale) is not None:
        scale = min(scale, float(of(stats[0], **call.params)))
    difference = (whole - without).double()
    change = float(difference.square().mean().sqrt() if call.node.random else difference.abs().max()) / (scale or 1.0)
    spread = 5 / math.sqrt(whole.numel()) if call.node.random else 1e-9  # of a root mean square over few numbers
    ok = change <= bound * (1 + spread) + 1e-12
    yield Finding("skip bound", ok, f"left out, the result changes by {change:.3g}; the bound is {bound:.3g}")


def check_shape(call: Call) -> Iterator[Finding]:
    """Find whether the rule for the shape tells the shape that comes."""
    hook = call.node.hooks.shape
    if hook is None:
        return
    known = [each_tensor(lambda x: x.to("meta") if x.numel() > _FEW else x, value) for value in call.inputs]
    told, there = (_every_tensor(value) for value in (hook(*known, **call.params), call.result()))
    same = [tuple(x.shape) for x in told] == [tuple(x.shape) for x in there]
    yield Finding("shape", same, f"told {_shapes(told)}, is {_shapes(there)}")


def _every_tensor(value: Any) -> list[Tensor]:
    """Return the tensors in ``value``, one that stands at two places twice: a shape that is told may be shared."""
    if isinstance(value, Tensor):
        return [value]
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, (tuple, list)) else ()
    return [x for each in inner for x in _every_tensor(each)]


def _scaled(
    call: Call, inputs: Sequence[Any], i: int, j: int, scales: Sequence[float], change: Tensor
) -> tuple[Tensor, ...]:
    """Return the floating tensors of the result over ``scales``, with a scaled ``change`` of tensor j in input i."""
    number = itertools.count()

    def changed(x: Tensor) -> Tensor:
        return x + _largest(x) * change if next(number) == j else x

    result = call.result([each_tensor(changed, value) if n == i else value for n, value in enumerate(inputs)])
    return tuple(y / scale for y, scale in zip(_floating(result), scales, strict=True))


def _largest(x: Tensor) -> float:
    """Return the largest absolute value of a tensor, or 1 if that is 0 or the tensor is empty."""
    return (float(x.detach().abs().max()) if x.numel() else 0.0) or 1.0


def _floating(result: Any) -> list[Tensor]:
    return [y for y in tensors_in(result) if y.is_floating_point() or y.is_complex()]


def _double(value: Any) -> Any:
    return each_tensor(lambda x: x.double() if x.is_floating_point() else x, value)


def _first_band(value: Any, axis: int) -> Any:
    """Return a value with its first band alone; of a named tuple, the fields that have bands are cut."""
    if isinstance(value, Tensor):
        return value.narrow(axis, 0, 1)
    fields = {name: getattr(value, name) for name in band_names(value)}
    cut = {name: x.narrow(axis, 0, 1) for name, x in fields.items() if x is not None}
    return value._replace(**cut) if cut else value


def off_by(found: Tensor, wanted: Tensor) -> float:
    """Return the largest difference of two tensors relative to the largest wanted value."""
    if found.numel() == 0:
        return 0.0
    wide = torch.complex128 if wanted.is_complex() else torch.float64
    scale = float(wanted.to(wide).abs().max())
    return float((found.to(wide) - wanted.to(wide)).abs().max()) / (scale or 1.0)


def _shapes(tensors: Sequence[Tensor]) -> str:
    return ", ".join(" x ".join(map(str, x.shape)) or "number" for x in tensors)
