"""Whether a node passes under a transform of `torch.func`: its result must be that of
torch.autograd, or of a loop.
"""

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

TRANSFORMS = ("vjp", "jvp", "vmap")
COUNT = 3  #: tensors that are stacked for `vmap`


class Differs(AssertionError):
    """A transform that runs and gives something else."""


def put(value, place, x):
    """``value`` with the tensor at ``place``, a path of indices and names, replaced."""
    if not place:
        return x
    first, *rest = place
    if hasattr(value, "_replace"):
        return value._replace(**{first: put(getattr(value, first), rest, x)})
    if isinstance(value, dict):
        key = int(first) if first.isdecimal() else first
        return {**value, key: put(value[key], rest, x)}
    return type(value)(
        put(item, rest, x) if i == int(first) else item for i, item in enumerate(value)
    )


def at(value, place):
    """The tensor at ``place``."""
    for part in place:
        if part.isdecimal() and not hasattr(value, "_replace"):
            value = value[int(part)]
        else:
            value = value[part] if isinstance(value, dict) else getattr(value, part)
    return value


def function_of(node, case):
    """The node as a function of one tensor that gives its floating tensors, and that tensor."""
    place = case.of.split(".")
    whole = list(case.inputs) if place[0].isdecimal() else case.params

    def function(x):
        changed = put(whole, place, x)
        inputs, params = (
            (changed, case.params) if whole is not case.params else (case.inputs, changed)
        )
        drawn = {"rng": torch.Generator().manual_seed(0)} if node.random else {}
        found = [y for y in tree_leaves(node(*inputs, **params, **drawn)) if isinstance(y, Tensor)]
        return tuple(y for y in found if y.is_floating_point() or y.is_complex())

    return function, at(whole, place)


def followed(function, x):
    """Which of the results autograd follows, of those that are no NaN here; none if the node has
    no derivative.
    """
    return [
        y.requires_grad and bool(y.isfinite().all()) for y in function(x.clone().requires_grad_())
    ]


def _close(found, expected):
    if found.shape != expected.shape:
        raise Differs(f"{tuple(found.shape)} instead of {tuple(expected.shape)}")
    scale = float(expected.detach().abs().max()) if expected.numel() else 0.0
    single = torch.float32 in (found.dtype, expected.dtype)
    if not torch.allclose(
        found,
        expected.to(found),
        rtol=2e-4 if single else 1e-9,
        atol=(1e-5 if single else 1e-10) * scale,
    ):
        raise Differs(f"off by {float((found - expected).abs().max()):.3g} of {scale:.3g}")


def _direction(y, seed):
    return torch.randn(y.shape, dtype=y.dtype, generator=torch.Generator().manual_seed(seed))


def _kept(function, x):
    """The function with those results alone that autograd follows."""
    which = [i for i, has in enumerate(followed(function, x)) if has]
    return lambda x: tuple(function(x)[i] for i in which)


def vjp(function, x):
    """Compare `torch.func.vjp` with `torch.autograd.grad`."""
    function = _kept(function, x)
    found, back = torch.func.vjp(function, x)
    pull = tuple(_direction(y, i) for i, y in enumerate(found))
    leaf = x.clone().requires_grad_()
    (expected,) = torch.autograd.grad(function(leaf), leaf, pull)
    for y, z in zip(found, function(x), strict=True):
        _close(y, z)
    _close(back(pull)[0], expected)


def jvp(function, x, to=1e-8):
    """Compare `torch.func.jvp` with what autograd pulls back: both have the same product with a
    vector, within ``to``.

    Single precision is compared to 1e-3.
    """
    function = _kept(function, x)
    push = _direction(x, 7) * x.abs().mean()
    found, tangents = torch.func.jvp(function, (x,), (push,))
    leaf = x.clone().requires_grad_()
    for i, (y, z, tangent) in enumerate(zip(found, function(leaf), tangents, strict=True)):
        _close(y, z)
        weight = _direction(z.detach(), i) + 0.5
        (pulled,) = torch.autograd.grad(z, leaf, weight, retain_graph=True)
        size = float((tangent * weight).abs().sum()) + 1e-300
        off = abs(float((tangent * weight).sum()) - float((pulled * push).sum()))
        if not off <= (1e-3 if z.dtype == torch.float32 or x.dtype == torch.float32 else to) * size:
            raise Differs(f"off by {off:.3g} of {size:.3g}")


def vmap(function, x):
    """Compare `torch.func.vmap` with a loop."""
    stack = torch.stack([x * (1 + 0.01 * i) for i in range(COUNT)])
    found = torch.func.vmap(function, randomness="same")(stack)
    each = [function(one) for one in stack]
    for y, expected in zip(found, zip(*each, strict=True), strict=True):
        _close(y, torch.stack(expected))
