"""Values of a recipe that trade accuracy for run time, such as the number of bands and the
precision.

The values are found by the parameters of nodes: ``count`` of a node that returns bands, ``samples``
and ``pitch`` of a pupil, the window's ``shape`` of a node that returns a PSF, and every
``precision``. The recipe shows where each value is written and which other steps depend on the
value.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args, get_origin

from neusee.nodes.values import Bands, Psf
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.recipe.loading import changed

_REFERENCE = re.compile(r"\$\{([\w.-]+)\??\}")
_ONE_BY_ONE = ("item", "each")  #: first names of paths whose value differs from item to item
_FACTORS = (0.2, 1 / 3, 0.5, 2.0)  #: factors on the number of intervals between bands
_FEWER = (1 / 3, 2.0)
#: factors on the number of samples, and on the side of a window
_SCALES = (0.5, 0.75, 0.9, 1.5, 2.0)
_FEWER_SCALES = (0.75, 1.5)


@dataclass(frozen=True)
class Change:
    """One value to try for a recipe parameter, as overrides of the recipe (none for the recipe's
    own value).
    """

    label: str
    overrides: tuple[str, ...]


@dataclass(frozen=True)
class Knob:
    """A recipe parameter, or several parameters that change together, with the values to
    measure.
    """

    name: str  #: path in the recipe, such as ``optics.bands``
    what: str
    changes: tuple[Change, ...]


@dataclass(frozen=True)
class Knobs:
    """The parameters of a recipe that can be varied, and the reasons why other parameters cannot
    be varied.
    """

    found: tuple[Knob, ...]
    without: tuple[str, ...]


@dataclass(frozen=True)
class _Place:
    """The path in a recipe at which a parameter value is written, and the steps that read the
    value.
    """

    path: str
    value: Any
    steps: tuple[Step, ...]


def knobs(recipe: Recipe, quick: bool = False) -> Knobs:
    """Return the recipe parameters that trade accuracy for run time; ``quick`` selects fewer
    values of each.
    """
    varied: list[Knob] = []
    without: list[str] = []
    for kind, turned in (
        ("bands", _bands(recipe, quick)),
        ("pupil samples at the same width", _samples(recipe, quick)),
        ("window of the PSF", _windows(recipe, quick)),
        ("precision", _precisions(recipe)),
    ):
        mine = [knob if isinstance(knob, str) else replace(knob, what=kind) for knob in turned]
        varied += [knob for knob in mine if isinstance(knob, Knob) and len(knob.changes) > 1]
        without += [f"{kind}: {knob}" for knob in mine if isinstance(knob, str)]
        if not mine:
            without.append(f"{kind}: this recipe has no such value")
    return Knobs(tuple(varied), tuple(without))


def finest(recipe: Recipe) -> Recipe:
    """Return the recipe with all steps computed in full and in their best precision, at the same
    sampling.
    """
    best = [
        f"{place.path}={allowed_words(place.steps[0], 'precision')[-1]}"
        for place in _places(recipe, "precision")
    ]
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
            yield (
                f"{' and '.join(p.path for p in (*samples, *pitches))} are not one pair of samples"
                " and pitch"
            )
        return
    own, pitch = int(samples[0].value), pitches[0].value
    if pitch is None:  # the grid is as wide as the aperture
        sizes = _sizes(own, quick)
        yield _knob(samples[0].path, [(n, str(n), (f"{samples[0].path}={n}",)) for n in sizes], own)
        return
    if others := _others(recipe, "pitch", pitches[0]):
        yield f"{', '.join(others)} would keep the old pitch, which is written elsewhere"
        return
    path, other = samples[0].path, pitches[0].path
    settings = [
        (n, str(n), (f"{path}={n}", f"{other}={own * pitch / n!r} m")) for n in _sizes(own, quick)
    ]
    yield _knob(path, settings, own)


def _sizes(own: int, quick: bool) -> list[int]:
    """Return the numbers of pupil samples that a study tries, the recipe's own among them."""
    return sorted({max(2, round(own * f)) for f in (1.0, *(_FEWER_SCALES if quick else _SCALES))})


_BOTH = (("samples", "pitch"), ("pitch", "samples"))


def _windows(recipe: Recipe, quick: bool) -> Iterator[Knob | str]:
    for place in _places(recipe, "shape", gives=Psf):
        if others := _others(recipe, "shape", place):
            yield f"{place.path} is also a parameter of the step {others[0]}"
            continue
        own, scales = tuple(place.value), (1.0, *(_FEWER_SCALES if quick else _SCALES))
        sizes = sorted({tuple(max(1, round(n * f)) for n in own) for f in scales})
        yield _knob(
            place.path,
            [(s, "×".join(map(str, s)), (f"{place.path}={list(s)}",)) for s in sizes],
            own,
        )


def _precisions(recipe: Recipe) -> Iterator[Knob | str]:
    """Yield one parameter for the precisions of all steps, because double precision in one step
    improves no result.
    """
    if places := _places(recipe, "precision"):
        words = allowed_words(places[0].steps[0], "precision")
        path = ", ".join(p.path for p in places)
        yield _knob(
            path, [(w, w, tuple(f"{p.path}={w}" for p in places)) for w in words], places[0].value
        )


def _knob(path: str, settings: Sequence[tuple[Any, str, tuple[str, ...]]], own: Any) -> Knob:
    """Return the varied parameter at ``path`` with its ``settings`` (value, label, overrides);
    ``own`` is unchanged.
    """
    return Knob(
        path,
        "",
        tuple(
            Change(label, () if value == own else overrides) for value, label, overrides in settings
        ),
    )


def allowed_words(step: Step, parameter: str) -> tuple[str, ...]:
    """Return the words that a parameter accepts, the coarsest first, such as the names of
    precisions.
    """
    hint = step.node.hints[parameter]
    return (
        tuple(map(str, get_args(hint)))
        if get_origin(hint) is Literal
        else (str(step.params[parameter]),)
    )


def _places(
    recipe: Recipe, parameter: str, gives: type | None = None, beside: str = ""
) -> list[_Place]:
    """Return the recipe paths that set ``parameter``, for steps that return ``gives`` and also
    have ``beside``.
    """
    places: dict[str, _Place] = {}
    for name in needed(recipe, recipe.outputs):
        step = recipe.steps[name]
        if parameter not in step.params or (beside and beside not in step.params):
            continue
        if gives is not None and step.node.hints.get("return") is not gives:
            continue
        path = _written(recipe, step, parameter)
        if path is not None:
            before = places[path].steps if path in places else ()
            places[path] = _Place(path, step.params[parameter], (*before, step))
    return list(places.values())


def _written(recipe: Recipe, step: Step, parameter: str) -> str | None:
    """Return the recipe path that sets a step's parameter, or None if repetitions of the step
    have different values.
    """
    path = f"steps.{step.name.partition('[')[0]}.with.{parameter}"
    while True:
        setting = recipe.config.settings.get(path)
        match = (
            _REFERENCE.fullmatch(setting.value)
            if setting and isinstance(setting.value, str)
            else None
        )
        if match is None:
            return path
        path = match[1]
        if path.partition(".")[0] in _ONE_BY_ONE:
            return None


def _others(recipe: Recipe, parameter: str, place: _Place) -> list[str]:
    """Return the names of other steps that read the value at ``place``, or that have an equal
    pitch at another path.
    """
    if parameter == "pitch":
        return _equal_elsewhere(recipe, parameter, place)
    mine = {step.name for step in place.steps}
    names: list[str] = []
    for step in recipe.steps.values():
        if step.name not in mine:
            read = [p for p in step.params if _written(recipe, step, p) == place.path]
            names += [step.name for p in read if p in step.param_marks]
    return names


def _equal_elsewhere(recipe: Recipe, parameter: str, place: _Place) -> list[str]:
    """Return the names of steps whose parameter has the value of ``place`` from another path."""
    having = [step for step in recipe.steps.values() if parameter in step.params]
    equal = [step for step in having if step.params[parameter] == place.value]
    return [step.name for step in equal if _written(recipe, step, parameter) != place.path]
