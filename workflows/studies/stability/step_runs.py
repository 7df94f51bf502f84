"""The runs of one step of the stability study: as a recipe uses the step, and in float64 as the reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys.cache_key import stream_seed
from neusee.workflows.store.serialization import each_tensor, tensors_in

SINGLE, DOUBLE = 2.0**-24, 2.0**-53  #: largest relative rounding
HALVES = {torch.float16: 2.0**-11, torch.bfloat16: 2.0**-8}  #: largest relative rounding


class Refused(Exception):
    """Error of a step that rejects its inputs with `ValueError`."""


class _CountedInSingle(TorchFunctionMode):
    """A PyTorch function mode that samples float64 Poisson counts with the mean rounded to single precision."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.poisson and args[0].dtype == torch.float64:
            return func(args[0].float(), *args[1:], **(kwargs or {})).double()
        return func(*args, **(kwargs or {}))


def is_picture(x: Tensor) -> bool:
    return (x.is_floating_point() and x.ndim >= 2 and x.dtype != torch.float64) or x.dtype in HALVES


def pictures_in(values: Sequence[Any]) -> list[Tensor]:
    return [x for x in tensors_in(list(values)) if is_picture(x)]


def run(step: Step, fn: Any, inputs: Sequence[Any], seed: int, **params: Any) -> Any:
    rng = {"rng": torch.Generator().manual_seed(stream_seed(seed, step.name))} if step.node.random else {}
    return fn(*inputs, **{**step.params, **params}, **rng)


def as_used(step: Step, inputs: Sequence[Any], seed: int) -> Any:
    """Compute a step with its own parameters and return its result; raise `Refused` for a `ValueError`."""
    try:
        return run(step, step.node.fn, inputs, seed)
    except ValueError as error:
        raise Refused(str(error)) from error


def in_double(step: Step, inputs: Sequence[Any], seed: int) -> Any:
    wide = each_tensor(lambda x: x.double() if x.is_floating_point() else x, list(inputs))
    precise = {"precision": "double"} if "precision" in step.params else {}
    with _CountedInSingle():
        return run(step, step.node.fn, wide, seed, **precise)


def rounded(inputs: Sequence[Any], draw: int, unit: float) -> list[Any]:
    """Return a step's inputs in float64, each element moved at random by up to four roundings of ``unit``."""
    rng = torch.Generator().manual_seed(draw)

    def move(x: Tensor) -> Tensor:
        off = 2 * torch.rand(x.shape, generator=rng, dtype=torch.float64) - 1
        return x.double() * (1 + 4 * unit * off)

    moved: list[Any] = each_tensor(lambda x: move(x) if is_picture(x) else x, list(inputs))
    return moved
