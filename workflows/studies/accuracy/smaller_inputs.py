"""Smaller inputs of a step, so that its slow reference can be afforded: the middle of each picture, and fewer bands."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from neusee.nodes import Node
from neusee.nodes.values import BAND_FIELDS
from neusee.workflows.store.serialization import each_tensor

Cut = tuple[int, int]  #: the longest side, and the most bands; 0 for all


def cut(node: Node, inputs: list[Any], size: Cut) -> list[Any]:
    """``inputs`` with no picture wider than ``size`` and no more bands, where the node says which axis these are."""
    side, bands = size
    found = []
    for name, value in zip(node.inputs, inputs, strict=True):
        axis = (node.bands or {}).get(name)
        fewer = value if axis is None or not bands else _fewer(value, axis, bands)
        found.append(each_tensor(lambda x: _middle(x, side), fewer) if side else fewer)
    return found


def said(node: Node, size: Cut) -> str:
    """The cut in words; empty of none."""
    side, bands = size
    fewer = bands and (node.bands or {}).keys() - {"return"}
    parts = [f"the middle {side} × {side}"] * bool(side) + [f"{bands} bands"] * bool(fewer)
    return " and ".join(parts)


def _middle(x: Tensor, side: int) -> Tensor:
    for axis in (-2, -1) if x.ndim >= 2 and min(x.shape[-2:]) > side else ():
        x = x.narrow(axis, x.shape[axis] // 2 - side // 2, side)
    return x


def _fewer(value: Any, axis: int, bands: int) -> Any:
    """Bands spread over all that there are."""
    if isinstance(value, Tensor):
        count = value.shape[axis]
        if count <= bands:
            return value
        places = value.new_tensor([round((i + 0.5) * count / bands - 0.5) for i in range(bands)]).long()
        return value.index_select(axis, places)
    fields = BAND_FIELDS.get(type(value), ())
    return value._replace(**{name: _fewer(getattr(value, name), axis, bands) for name in fields}) if fields else value
