"""The knobs of a recipe: its values that trade accuracy for run time, found by the parameters of its nodes.

A node that makes bands has a ``count``, a pupil has ``samples`` and a ``pitch``, a node that gives a PSF has the
``shape`` of its window, and a ``precision`` is a choice of words. The recipe shows where each value is written and
which other steps depend on the value.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args, get_origin

from neusee.nodes.values import Bands, Psf
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.recipe.changed_recipe import changed

_REFERENCE = re.compile(r"\$\{([\w.-]+)\}")
_ONE_BY_ONE = ("item", "each")  #: first names of paths whose value differs from item to item
_FACTORS = (0.2, 1 / 3, 0.5, 2.0)  #: of the spaces between bands
_FEWER = (1 / 3, 2.0)
_SCALES = (0.5, 0.75, 0.9, 1.5, 2.0)  #: of samples, and of the side of a window
_FEWER_SCALES = (0.75, 1.5)


@dataclass(frozen=True)
class Change:
    """One setting of a recipe value; without overrides, the recipe's own setting."""

    label: str
    overrides: tuple[str, ...]


@dataclass(frozen=True)
class Knob:
    """A recipe value that trades accuracy for run time, or several values together, and the settings to measure."""

    name: str  #: path in the recipe, such as ``optics.bands``
    what: str
    changes: tuple[Change, ...]


@dataclass(frozen=True)
class Knobs:
    """The values of a recipe that can be varied, and the reasons why other values cannot."""

    found: tuple[Knob, ...]
    without: tuple[str, ...]


@dataclass(frozen=True)
class _Place:
    """A path in the recipe at which a parameter value is written, and the steps that read the value."""

    path: str
    value: Any
    steps: tuple[Step, ...]


def knobs(recipe: Recipe, quick: bool = False) -> Knobs:
    """Return the values of ``recipe`` that trade accuracy for run time, with their settings; fewer if ``quick``."""
    found: list[Knob] = []
    without: list[str] = []
    for what, turned in (
        ("bands", _bands(recipe, quick)),
        ("pupil samples at the same width", _samples(recipe, quick)),
        ("window of the PSF", _windows(recipe, quick)),
        ("precision", _precisions(recipe)),
    ):
        mine = [knob if isinstance(knob, str) else replace(knob, what=what) for knob in turned]
        found += [knob for knob in mine if isinstance(knob, Knob) and len(knob.changes) > 1]
        without += [f"{what}: {knob}" for knob in mine if isinstance(knob, str)]
        if not mine:
            without.append(f"{what}: this recipe has none")
    return Knobs(tuple(found), tuple(without))


def finest(recipe: Recipe) -> Recipe:
    """Return the recipe at its own sampling, with nothing left out and every step in its best precision."""
    best = [f"{place.path}={allowed_words(place.steps[0], 'precision')[-1]}" for place in _places(recipe, "precision")]
    return replace(changed(recipe, best) if best else recipe, exact=True)


def _bands(recipe: Recipe, quick: bool) -> Iterator[Knob | str]:
    for place in _places(recipe, "count", gives=Bands):
        own = int(place.value)
        counts = {1 + round((own - 1) * f) for f in (1.0, *(_FEWER if quick else _FACTORS))}
        yield _knob(place.path, [(n, str(n), (f"{place.path}={n}",)) for n in sorted(counts)], own)


def _samples(recipe: Recipe, quick: bool) -> Iterator[Knob | str]:
    samples, pitches = (_places(recipe, name, beside=other) for name, other in _BOTH)
    if len(samples) != 1 or len(pitches) != 1:
        if samples:
            yield f"{' and '.join(p.path for p in (*samples, *pitches))} do not go together"
        return
    own, pitch = int(samples[0].value), float(pitches[0].value)
    if others := _others(recipe, "pitch", pitches[0]):
        yield f"{', '.join(others)} would keep another pitch"
        return
    at, other = samples[0].path, pitches[0].path
    sizes = sorted({max(2, round(own * f)) for f in (1.0, *(_FEWER_SCALES if quick else _SCALES))})
    yield _knob(at, [(n, str(n), (f"{at}={n}", f"{other}={own * pitch / n!r} m")) for n in sizes], own)


_BOTH = (("samples", "pitch"), ("pitch", "samples"))


def _windows(recipe: Recipe, quick: bool) -> Iterator[Knob | str]:
    for place in _places(recipe, "shape", gives=Psf):
        if others := _others(recipe, "shape", place):
            yield f"{place.path} is the shape of {others[0]} too"
            continue
        own, scales = tuple(place.value), (1.0, *(_FEWER_SCALES if quick else _SCALES))
        sizes = sorted({tuple(max(1, round(n * f)) for n in own) for f in scales})
        yield _knob(place.path, [(s, "×".join(map(str, s)), (f"{place.path}={list(s)}",)) for s in sizes], own)


def _precisions(recipe: Recipe) -> Iterator[Knob | str]:
    """Yield one knob for the precisions of all steps, because double precision in one step alone gains nothing."""
    if places := _places(recipe, "precision"):
        words = allowed_words(places[0].steps[0], "precision")
        path = ", ".join(p.path for p in places)
        yield _knob(path, [(w, w, tuple(f"{p.path}={w}" for p in places)) for w in words], places[0].value)


def _knob(path: str, settings: Sequence[tuple[Any, str, tuple[str, ...]]], own: Any) -> Knob:
    """Return a knob for the value at ``path``; each setting has a value, a label and overrides."""
    return Knob(path, "", tuple(Change(label, () if value == own else how) for value, label, how in settings))


def allowed_words(step: Step, parameter: str) -> tuple[str, ...]:
    """Return the words that a parameter accepts, in the order of the node: the coarsest word first."""
    hint = step.node.hints[parameter]
    return tuple(map(str, get_args(hint))) if get_origin(hint) is Literal else (str(step.params[parameter]),)


def _places(recipe: Recipe, parameter: str, gives: type | None = None, beside: str = "") -> list[_Place]:
    """Return each path at which ``parameter`` is written, for steps that return ``gives`` and also have ``beside``."""
    found: dict[str, _Place] = {}
    for name in needed(recipe, recipe.outputs):
        step = recipe.steps[name]
        if parameter not in step.params or (beside and beside not in step.params):
            continue
        if gives is not None and step.node.hints.get("return") is not gives:
            continue
        path = _written(recipe, step, parameter)
        if path is not None:
            before = found[path].steps if path in found else ()
            found[path] = _Place(path, step.params[parameter], (*before, step))
    return list(found.values())


def _written(recipe: Recipe, step: Step, parameter: str) -> str | None:
    """Return the path at which the value of a step's parameter is written, or None if the value varies by item."""
    path = f"steps.{step.name.partition('[')[0]}.with.{parameter}"
    while True:
        setting = recipe.config.settings.get(path)
        match = _REFERENCE.fullmatch(setting.value) if setting and isinstance(setting.value, str) else None
        if match is None:
            return path
        path = match[1]
        if path.partition(".")[0] in _ONE_BY_ONE:
            return None


def _others(recipe: Recipe, parameter: str, place: _Place) -> list[str]:
    """Return the other steps that read the value at ``place``, or for a pitch, steps with an equal pitch elsewhere."""
    mine = {step.name for step in place.steps}
    if parameter == "pitch":
        apart = (s for s in recipe.steps.values() if parameter in s.params and s.params[parameter] == place.value)
        return [s.name for s in apart if _written(recipe, s, parameter) != place.path]
    others = (s for s in recipe.steps.values() if s.name not in mine)
    return [s.name for s in others for p in s.params if _written(recipe, s, p) == place.path and p in s.param_marks]
