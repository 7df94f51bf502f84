"""What a call gave, in a form that another process can compare: its parts, an error, or an end without either."""

from __future__ import annotations

import dataclasses
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neusee.workflows.contract.value_rules import off_by

_PLAIN = (bool, int, float, complex, str, bytes, type(None))
_EPS = 16  #: smallest steps of a type of numbers that a sum in another order is off by


@dataclass(frozen=True, slots=True)
class Outcome:
    """The parts of a result, each with its place in the result, or why there is none."""

    parts: tuple[tuple[str, Any], ...] = ()
    failure: str = ""  #: such as "raises ValueError: ..."
    place: str = ""  #: file and line of the failure in the code of the user
    is_end: bool = False  #: True if the call ended its process, or had no end


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
    return Outcome(failure=f"raises {type(error).__name__}: {text}".rstrip(": "), place=_place(error, module))


def difference(found: Outcome, wanted: Outcome, rtol: float) -> Difference | None:
    """Return how an outcome differs; None if all bits are the same. NaN is the same as NaN."""
    if found.failure or wanted.failure:
        same = found.failure == wanted.failure
        text = f"it {found.failure}" if found.failure else "it gives a result"
        return None if same else Difference(text, found.place)
    names = [[name for name, _ in outcome.parts] for outcome in (found, wanted)]
    if names[0] != names[1]:
        return Difference("the result has other parts, or in another order")
    each = [_of_part(*part, there[1], rtol) for part, there in zip(found.parts, wanted.parts, strict=True)]
    return max((one for one in each if one), key=lambda one: one.size, default=None)


def _of_part(name: str, found: Any, wanted: Any, rtol: float) -> Difference | None:
    """Return how one part of a result differs; None if it does not."""
    what = f"the result{name}"
    if not isinstance(found, Tensor) or not isinstance(wanted, Tensor):
        same = type(found) is type(wanted) and (found == wanted or (found != found and wanted != wanted))
        return None if same else Difference(f"{what} is {_short(found)} and not {_short(wanted)}")
    if found.shape != wanted.shape or found.dtype != wanted.dtype:
        return Difference(f"{what} is {_kind(found)} and not {_kind(wanted)}")
    if torch.allclose(found, wanted, 0.0, 0.0, True):
        return None
    size = off_by(found, wanted)
    if not size < float("inf"):
        return Difference(f"{what} has NaN or infinite values at other places")
    eps = torch.finfo(wanted.dtype).eps if wanted.is_floating_point() or wanted.is_complex() else 0.0
    return Difference(f"{what} differs by {size:.2g} of its largest value", "", size, size <= max(rtol, _EPS * eps))


def _parts(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield every tensor and every plain value in a result, with its place; of anything else the type alone."""
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
    """Return what a value holds, each with its place in it; None for a value that holds nothing that is known."""
    if isinstance(value, dict):
        return [(f"[{key!r}]", item) for key, item in value.items()]
    if isinstance(value, tuple | list):
        fields = getattr(value, "_fields", None)
        return [(f".{fields[number]}" if fields else f"[{number}]", item) for number, item in enumerate(value)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [(f".{field.name}", getattr(value, field.name)) for field in dataclasses.fields(value)]
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
