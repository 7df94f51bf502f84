"""Values of a run in plain form: figures of merit as numbers, and NumPy arrays instead of
tensors.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.graph.recipe_graph import Recipe

_MOST_ELEMENTS = 4096  #: greatest number of elements of a result whose numbers become rows


def metrics_of(recipe: Recipe, among: Container[str]) -> list[str]:
    """Return the steps in ``among`` whose nodes are metrics, in the order of the recipe."""
    return [
        name
        for name, step in recipe.steps.items()
        if name in among and step.node.path.startswith("metrics.")
    ]


def numbers_of(step: str, result: Any) -> list[list[Any]]:
    """Return a row (step, field, index, value) for each number in a result of at most 4096
    elements.
    """
    rows: list[list[Any]] = []
    for field, tensor in tensor_fields(result):
        if tensor.numel() <= _MOST_ELEMENTS and not tensor.is_complex():
            numbers = tensor.detach().double().flatten().tolist()
            # a single number has no index
            rows += [
                [step, field, i if len(numbers) > 1 else "", number]
                for i, number in enumerate(numbers)
            ]
    return rows


def tensor_fields(result: Any) -> list[tuple[str, Tensor]]:
    """Return the tensors of a result by field; a tensor alone has the empty name."""
    if isinstance(result, Tensor):
        return [("", result)]
    if hasattr(result, "_asdict"):
        return [(k, v) for k, v in result._asdict().items() if isinstance(v, Tensor)]
    return []


def figures_of_merit(values: Mapping[str, Any]) -> dict[str, float | list[float]]:
    """Return the numbers in the results of metrics by name, such as ``restored_quality.psnr``; a
    figure with several numbers is a list.
    """
    lists: dict[str, list[float]] = {}
    for name, value in values.items():
        for step, field, _, number in numbers_of(name, value):
            lists.setdefault(f"{step}.{field}".rstrip("."), []).append(number)
    return {name: numbers[0] if len(numbers) == 1 else numbers for name, numbers in lists.items()}


def arrays_of(value: Any) -> Any:
    """Replace every tensor in a nested value by a NumPy array; bfloat16 becomes float32."""
    if isinstance(value, Tensor):
        on_cpu = value.detach().cpu()
        # NumPy has no bfloat16
        return (on_cpu.float() if on_cpu.dtype == torch.bfloat16 else on_cpu).numpy()
    if isinstance(value, tuple):
        items = [arrays_of(item) for item in value]
        return value._make(items) if hasattr(value, "_make") else tuple(items)
    if isinstance(value, list):
        return [arrays_of(item) for item in value]
    return (
        {name: arrays_of(item) for name, item in value.items()}
        if isinstance(value, dict)
        else value
    )
