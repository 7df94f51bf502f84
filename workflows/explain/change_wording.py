"""Texts that describe changed parameters, with path, unit and location in the recipe."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

from neusee.nodes.units import read_quantity
from neusee.workflows.graph.final_values import Setting, flow
from neusee.workflows.graph.recipe_graph import Recipe, Step

_QUANTITY = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\D.*)")
_ABSENT = object()


class Wording:
    """Texts that describe changed parameters in the units of a recipe, or without a recipe in SI units."""

    def __init__(self, recipe: Recipe | None = None) -> None:
        self._recipe = recipe

    def params(self, label: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
        """Return one text clause for each parameter that differs between two results of the step ``label``."""
        step = self._recipe.steps.get(label) if self._recipe else None
        names = [n for n in dict.fromkeys([*old, *new]) if old.get(n) != new.get(n)]
        return [self._param(step, n, old.get(n, _ABSENT), new.get(n, _ABSENT)) for n in names]

    def source(self, *path: str) -> str:
        """Return the location of a value in the recipe, such as `` (recipe.yaml:3:7)``, or an empty string."""
        setting = self._recipe.config.settings.get(".".join(path)) if self._recipe else None
        return f" ({setting.source})" if setting else ""

    def _param(self, step: Step | None, name: str, old: Any, new: Any) -> str:
        if new is _ABSENT:
            return f"{name} is no longer a parameter"
        setting, source = self._setting(step, name)
        path = ".".join(map(str, setting.path)) if setting else name
        where = f" ({source})" if source else ""
        if isinstance(new, Mapping) and "file" in new:
            inside = f" ({path}{f', {source}' if source else ''})" if setting else where
            return f"file {_file(step, name)}: {_other_file(old, new)}{inside}"
        written = setting.value if setting and not (isinstance(setting.value, str) and "${" in setting.value) else None
        if old is _ABSENT:
            return f"{path} is new: {_as_written(written, new)}{where}"
        before, after = _both(written, old, new)
        return f"{path} {before} -> {after}{where}"

    def _setting(self, step: Step | None, name: str) -> tuple[Setting | None, str]:
        """Return the recipe setting that gives a parameter its value, or None, and the location of the value."""
        if step is None:
            return None, ""
        if name not in step.param_marks:
            return None, f"default of {step.node.path}"
        mark = str(step.param_marks[name])
        found = self._marked.get(mark, [])
        here = ("steps", step.name.partition("[")[0], "with", name)
        named = [s for s in found if s.path == here] or [s for s in found if s.path[-1:] == (name,)]
        setting = (named or found)[0] if named or len(found) == 1 else None
        return setting, setting.source if setting else mark

    @cached_property
    def _marked(self) -> Mapping[str, list[Setting]]:
        """Return the settings that the user wrote, by location in the recipe files."""
        settings = defaultdict(list)
        for setting in self._recipe.config.settings.values() if self._recipe else ():
            if not setting.default:
                settings[setting.source.partition(", ")[0]].append(setting)
        return settings


def _file(step: Step | None, name: str) -> str:
    value = step.params.get(name) if step else None
    return value.name if isinstance(value, Path) else name


def _other_file(old: Any, new: Mapping[str, Any]) -> str:
    if not isinstance(old, Mapping) or "file" not in old:
        return "is given now"
    return "other content" if old["file"] != new["file"] else f"{new['suffix']}, not {old['suffix']}"


def _both(written: Any, old: Any, new: Any) -> tuple[str, str]:
    """Return the old and the new value of a parameter as text, both in the unit of the new value."""
    after = _as_written(written, new)
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        parts = written if isinstance(written, list) and len(written) == len(old) else [None] * len(old)
        return f"[{', '.join(map(_in_unit_of, parts, new, old))}]", after
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        return _items(old, new)
    unit = _unit(written, new)
    before = spoken(unit[0](old)) if unit and _is_number(old) else spoken(old)
    if before in (spoken(new), after.partition(" ")[0]):  # the values differ by less than the shown digits
        return repr(old), repr(new)
    return before, after


def _in_unit_of(written: Any, new: Any, old: Any) -> str:
    unit = _unit(written, new)
    return f"{spoken(unit[0](old))} {unit[1]}" if unit and _is_number(old) else spoken(old)


def _is_number(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool)


def _items(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, str]:
    """Return two texts: the entries that only the old mapping has, and the entries that only the new mapping has."""
    pairs = [[(str(key), value) for key, value in m.get("items", ())] for m in (old, new)]
    only = [[f"{k}: {spoken(v)}" for k, v in pairs[i] if (k, v) not in pairs[1 - i]] for i in (0, 1)]
    return f"{{{', '.join(only[0])}}}", f"{{{', '.join(only[1])}}}"


def _as_written(written: Any, new: Any) -> str:
    """Return a parameter value as text: as the user wrote the value if that text has a unit, else in short form."""
    if _unit(written, new) or (isinstance(written, list) and isinstance(new, list)):
        return flow(written)
    return spoken(new)


def _unit(written: Any, new: Any) -> tuple[Callable[[float], float], str] | None:
    """Return a function from SI units to the unit that the user wrote, and this unit; None if there is no unit."""
    match = _QUANTITY.fullmatch(written.strip()) if isinstance(written, str) else None
    if match is None or not _is_number(new):
        return None
    if match[2].strip() == "e-/DN":
        return (lambda si: 1.0 / si if si else math.inf), match[2]
    if new and float(match[1]):
        return _times(float(match[1]) / new), match[2]
    for si in ("m", "s", "rad", "K", "e-", "waves", "DN/e-"):
        with suppress(ValueError):
            return _times(1.0 / read_quantity(f"1 {match[2]}", si)), match[2]
    return None


def _times(factor: float) -> Callable[[float], float]:
    return lambda si: si * factor


def spoken(value: Any) -> str:
    """Return a short text for the value of a parameter."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        items = ", ".join(f"{spoken(k)}: {spoken(v)}" for k, v in value.get("items", ()))
        return f"a {value['suffix']} file".replace("  ", " ") if "file" in value else f"{{{items}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(spoken, value))}]"
    return "none" if value is None else flow(value)
