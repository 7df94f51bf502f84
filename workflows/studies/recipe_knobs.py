"""Recipe values that trade accuracy for run time, such as the number of bands or the precision.

They are identified by the parameters of nodes: ``count`` of a node that returns bands, ``samples``
and ``pitch`` of a pupil, the window's ``shape`` of a node that returns a PSF, and every
``precision``. The recipe gives the place of each value and the other steps that depend on it.
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
_ONE_BY_ONE = ("item", "each")  #: first parts of paths whose value differs between repetitions
_FACTORS = (0.2, 1 / 3, 0.5, 2.0)  #: factors on the number of intervals between bands
_QUICK_FACTORS = (1 / 3, 2.0)
#: factors on the number of samples, and on the side of a window
_SCALES = (0.5, 0.75, 0.9, 1.5, 2.0)
_QUICK_SCALES = (0.75, 1.5)


@dataclass(frozen=True)
class Change:
    """One value to try for a recipe parameter, as overrides of the recipe; no overrides for its
    present value.
    """

    label: str
    overrides: tuple[str, ...]


@dataclass(frozen=True)
class Knob:
    """A recipe parameter, or several that change together, with the values to measure."""

    name: str  #: path in the recipe, such as ``optics.bands``
    what: str
    changes: tuple[Change, ...]


@dataclass(frozen=True)
class Knobs:
    """The recipe parameters that can be varied, and the reasons why others cannot."""

    found: tuple[Knob, ...]
    without: tuple[str, ...]


@dataclass(frozen=True)
class _Place:
    """The recipe path of a parameter value, and the steps that read it."""

    path: str
    value: Any
    steps: tuple[Step, ...]


def knobs(recipe: Recipe, quick: bool = False) -> Knobs:
    """Return the recipe parameters that trade accuracy for run time; ``quick`` selects fewer
    values of each.
    """
    varied: list[Knob] = []
    without: list[str] = []
    for kind, knobs_or_reasons in (
        ("bands", _bands(recipe, quick)),
        ("pupil samples at the same width", _samples(recipe, quick)),
        ("window of the PSF", _windows(recipe, quick)),
        ("precision", _precisions(recipe)),
    ):
        # a text is the reason why a parameter cannot be varied
        of_kind = [
            knob if isinstance(knob, str) else replace(knob, what=kind) for knob in knobs_or_reasons
        ]
        # a parameter with one value has nothing to compare
        varied += [knob for knob in of_kind if isinstance(knob, Knob) and len(knob.changes) > 1]
        without += [f"{kind}: {knob}" for knob in of_kind if isinstance(knob, str)]
        if not of_kind:
            without.append(f"{kind}: this recipe has no such value")
    return Knobs(tuple(varied), tuple(without))


def finest(recipe: Recipe) -> Recipe:
    """Return the recipe with all steps computed in full and in their best precision, at unchanged
    sampling.
    """
    best = [
        f"{place.path}={allowed_words(place.steps[0], 'precision')[-1]}"
        for place in _places(recipe, "precision")
    ]
    return replace(changed(recipe, best) if best else recipe, exact=True)


def _bands(recipe: Recipe, quick: bool) -> Iterator[Knob | str]:
    """Yield a parameter for each number of bands in the recipe, with the numbers to try."""
    for place in _places(recipe, "count", gives=Bands):
        own_count = int(place.value)
        # `count` bands have `count - 1` intervals between them, which the factors scale
        counts = {
            1 + round((own_count - 1) * factor)
            for factor in (1.0, *(_QUICK_FACTORS if quick else _FACTORS))
        }
        yield _knob(
            place.path,
            [(count, str(count), (f"{place.path}={count}",)) for count in sorted(counts)],
            own_count,
        )


def _samples(recipe: Recipe, quick: bool) -> Iterator[Knob | str]:
    """Yield the parameter for the pupil samples, varied at constant pupil width; or a text that
    says why it cannot be varied.
    """
    samples, pitches = (_places(recipe, name, beside=other) for name, other in _BOTH)
    if len(samples) != 1 or len(pitches) != 1:
        if samples:
            yield (
                f"{' and '.join(p.path for p in (*samples, *pitches))} are not one pair of samples"
                " and pitch"
            )
        return
    own_samples, pitch = int(samples[0].value), pitches[0].value
    if pitch is None:  # the grid is as wide as the aperture
        sizes = _sizes(own_samples, quick)
        yield _knob(
            samples[0].path,
            [(count, str(count), (f"{samples[0].path}={count}",)) for count in sizes],
            own_samples,
        )
        return
    if equal_elsewhere := _others(recipe, "pitch", pitches[0]):
        yield f"{', '.join(equal_elsewhere)} would keep the old pitch, which is written elsewhere"
        return
    samples_path, other = samples[0].path, pitches[0].path
    settings = [
        # the width of the pupil stays: samples x pitch
        (
            count,
            str(count),
            (f"{samples_path}={count}", f"{other}={own_samples * pitch / count!r} m"),
        )
        for count in _sizes(own_samples, quick)
    ]
    yield _knob(samples_path, settings, own_samples)


def _sizes(own: int, quick: bool) -> list[int]:
    """Return the numbers of pupil samples that a study tries, the recipe's own among them."""
    # at least two samples
    return sorted(
        {max(2, round(own * factor)) for factor in (1.0, *(_QUICK_SCALES if quick else _SCALES))}
    )


_BOTH = (("samples", "pitch"), ("pitch", "samples"))


def _windows(recipe: Recipe, quick: bool) -> Iterator[Knob | str]:
    """Yield a parameter for each PSF window, with the shapes to try; or a text that says why it
    cannot be varied.
    """
    for place in _places(recipe, "shape", gives=Psf):
        if other_steps := _others(recipe, "shape", place):
            yield f"{place.path} is also a parameter of the step {other_steps[0]}"
            continue
        own_shape, scales = tuple(place.value), (1.0, *(_QUICK_SCALES if quick else _SCALES))
        sizes = sorted(
            {tuple(max(1, round(side * factor)) for side in own_shape) for factor in scales}
        )
        yield _knob(
            place.path,
            [
                (shape, "×".join(map(str, shape)), (f"{place.path}={list(shape)}",))
                for shape in sizes
            ],
            own_shape,
        )


def _precisions(recipe: Recipe) -> Iterator[Knob | str]:
    """Yield one parameter for the precision of all steps, because double precision in a single step
    improves no result.
    """
    if places := _places(recipe, "precision"):
        words = allowed_words(places[0].steps[0], "precision")
        path = ", ".join(precision_place.path for precision_place in places)
        yield _knob(
            path,
            [
                (word, word, tuple(f"{precision_place.path}={word}" for precision_place in places))
                for word in words
            ],
            places[0].value,
        )


def _knob(path: str, settings: Sequence[tuple[Any, str, tuple[str, ...]]], own: Any) -> Knob:
    """Return the parameter at ``path`` with its ``settings`` (value, label, overrides); the value
    ``own`` gets no overrides.
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
    """Return the recipe paths that set ``parameter``, each with the steps that read it.

    Only steps that return the type ``gives`` and also have the parameter ``beside`` are considered.
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
            other_readers = places[path].steps if path in places else ()
            places[path] = _Place(path, step.params[parameter], (*other_readers, step))
    return list(places.values())


def _written(recipe: Recipe, step: Step, parameter: str) -> str | None:
    """Return the recipe path of a step's parameter, after following references such as
    ``${optics.bands}``; None if repetitions of the step have different values.
    """
    path = f"steps.{step.name.partition('[')[0]}.with.{parameter}"
    # from reference to reference, to the path with a value
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
    """Return other steps that read the value at ``place``, or that have an equal pitch from another
    path.
    """
    if parameter == "pitch":
        return _equal_elsewhere(recipe, parameter, place)
    reading_steps = {step.name for step in place.steps}
    names: list[str] = []
    for step in recipe.steps.values():
        if step.name not in reading_steps:
            params_read = [
                param for param in step.params if _written(recipe, step, param) == place.path
            ]
            # only parameters that are written in the recipe count, not defaults
            names += [step.name for param in params_read if param in step.param_marks]
    return names


def _equal_elsewhere(recipe: Recipe, parameter: str, place: _Place) -> list[str]:
    """Return steps whose parameter equals the value at ``place`` but is written at another path."""
    with_parameter = [step for step in recipe.steps.values() if parameter in step.params]
    equal_steps = [step for step in with_parameter if step.params[parameter] == place.value]
    return [step.name for step in equal_steps if _written(recipe, step, parameter) != place.path]
