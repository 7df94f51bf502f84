"""Uncertain inputs of a recipe: random draws of their values, and the step parameters that use these values."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from neusee.nodes.units import read_any
from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.recipe.distributions.allowed_range import RARE, within_allowed
from neusee.workflows.recipe.distributions.nominal_values import Uncertain
from neusee.workflows.recipe.distributions.shapes import FloatArray, Normal, Shape

SCRAMBLES = 8  #: number of independently scrambled Sobol sequences, whose scatter gives the error
_PROBE = 0.3  #: standard deviations by which a value of a joint distribution is changed to find its readers
_NORMAL = Normal()
_CORRELATED = 0.1  #: smallest correlation of two values that count as correlated
_EDGE = 1e-12  #: smallest distance of the probability of a point from 0 and 1

Index = tuple[int | str, ...]  #: path of a number in a parameter; empty for the parameter itself


class NothingDrawn(ValueError):
    """Error for a recipe of which no output depends on an uncertain value."""


@dataclass(frozen=True)
class InputDraws:
    """Random draws of all uncertain inputs of a recipe."""

    z: FloatArray  #: (draw, input) independent standard normal numbers
    values: FloatArray  #: (draw, input) in SI


@dataclass(frozen=True)
class Inputs:
    """The uncertain inputs of a recipe that affect its outputs, in the order of `names`."""

    recipe: Recipe
    uncertain: Uncertain
    names: tuple[str, ...]  #: paths of the recipe that affect an output
    idle: tuple[str, ...]  #: paths that affect no output
    readers: Mapping[str, tuple[tuple[Index, str], ...]]  #: indices and inputs by ``step.parameter``
    notes: Mapping[str, str] = field(default_factory=dict)  #: by name, what was cut off because it is not allowed

    @classmethod
    def of(cls, recipe: Recipe, outputs: Sequence[str] | None = None, negligible: float | None = RARE) -> Inputs:
        """Return the uncertain inputs of a recipe that affect ``outputs``, by default the recipe's own outputs.

        A part of a distribution outside the allowed values is cut off, with a note, if its probability is at most
        ``negligible``; None leaves all distributions as they are.
        Raises: `NothingDrawn` for a recipe without uncertain values, and if no output depends on an uncertain value.
        `RecipeError` for a distribution of which more is outside. ValueError for a value that cannot be sampled.
        """
        outputs = recipe.outputs if outputs is None else outputs
        uncertain = recipe.uncertain
        if uncertain is None or not uncertain.names:
            raise NothingDrawn(
                "no value is uncertain: write a distribution in place of a value, such as "
                'sensor.read_noise="normal(10.5 e-, 0.5 e-)", or posterior: PATH'
            )
        uncertain, notes = (uncertain, {}) if negligible is None else within_allowed(uncertain, negligible)
        readers = _all_readers(recipe, uncertain, outputs)
        used = {name for inputs in readers.values() for _, name in inputs}
        if not used:
            raise NothingDrawn(f"no output depends on {', '.join(uncertain.names)}")
        idle = tuple(name for name in uncertain.names if name not in used)
        drawn = only_values(uncertain, used)
        return cls(recipe, drawn, drawn.names, idle, readers, notes)

    @property
    def labels(self) -> list[str]:
        """Return the label of each uncertain input; the label shows whether the input is correlated with others."""
        return [_label(self.uncertain, name) for name in self.names]

    @property
    def shapes(self) -> list[Shape]:
        """Return the distribution of each column of normal numbers; values of a joint distribution are normal."""
        return [self.uncertain.laws[name].shape if name in self.uncertain.laws else _NORMAL for name in self.names]

    @property
    def has_table(self) -> bool:
        """Return True if some inputs are drawn as whole rows of a table of samples."""
        return self.most is not None

    @property
    def most(self) -> int | None:
        """Return the largest possible number of independent draws of the inputs, or None if there is no limit."""
        joint = self.uncertain.joint
        return None if joint is None or joint.draws is None else len(joint.draws)

    def theta(self, values: Mapping[str, float]) -> dict[str, Any]:
        """Return the parameters that use uncertain inputs, by ``step.parameter``, for given values of the inputs."""
        parameters = {}
        for reader, inputs in self.readers.items():
            step, _, param = reader.rpartition(".")
            parameters[reader] = self.recipe.steps[step].params[param]
            for index, name in inputs:
                parameters[reader] = put_at(parameters[reader], index, values[name])
        return parameters

    def at(self, z: FloatArray) -> FloatArray:
        """Transform standard normal numbers ``z`` to values of uncertain inputs; both have the shape (draw, input)."""
        columns = [law.at(z[:, i]) for i, law in enumerate(self.uncertain.laws.values())]
        joint = self.uncertain.joint
        return np.stack([*columns, *(joint.at(z[:, len(columns) :]).T if joint else ())], 1)

    def independent(self, count: int, seed: int) -> InputDraws:
        """Return independent random draws of the uncertain inputs; a larger ``count`` begins with the same draws."""
        z = np.random.default_rng([seed, 1]).standard_normal((count, len(self.names)))
        values, joint = self.at(z), self.uncertain.joint
        if joint is None or joint.draws is None:
            return InputDraws(z, values)
        rows = np.random.default_rng([seed, 2]).permutation(len(joint.draws))[:count]
        first = len(self.uncertain.laws)
        z = np.concatenate([z[: len(rows), :first], joint.numbers()[rows]], 1)
        return InputDraws(z, np.concatenate([values[: len(rows), :first], joint.draws[rows]], 1))

    def sobol(self, count: int, seed: int) -> InputDraws:
        """Return input draws from `SCRAMBLES` scrambled Sobol sequences; draw i belongs to sequence i % SCRAMBLES."""
        from scipy.special import ndtri
        from scipy.stats import qmc

        each = -(-count // SCRAMBLES)
        streams = [np.random.default_rng([seed, 3, n]) for n in range(SCRAMBLES)]
        sequences = [qmc.Sobol(len(self.names), seed=rng).random_base2((each - 1).bit_length()) for rng in streams]
        u = np.stack([s[:each] for s in sequences], 1).reshape(-1, len(self.names))[:count]
        z = np.asarray(ndtri(u.clip(_EDGE, 1 - _EDGE)), np.float64)
        return InputDraws(z, self.at(z))

    def checked(self, values: FloatArray) -> None:
        """Check the smallest and the largest draw of each uncertain input; raise `RecipeError` for an invalid value."""
        for name, column in zip(self.names, values.T, strict=True):
            for value in (float(column.min()), float(column.max())):
                try:
                    self.uncertain.at({name: value})
                except RecipeError as error:
                    drawn = [replace(d, message=f"the value is sampled, but {d.message}") for d in error.diagnostics]
                    raise RecipeError(drawn) from None

    def problem(self, row: FloatArray) -> Diagnostic | None:
        """Return why the recipe does not allow the values of a draw together, or None."""
        try:
            self.uncertain.at(dict(zip(self.names, map(float, row), strict=True)))
        except RecipeError as error:
            return error.diagnostics[0]
        return None


def only_values(uncertain: Uncertain, names: Collection[str]) -> Uncertain:
    """Return those uncertain values of a recipe whose paths are in ``names``."""
    laws = {name: law for name, law in uncertain.laws.items() if name in names}
    joint = uncertain.joint
    kept = [name for name in joint.names if name in names] if joint else []
    return replace(uncertain, laws=laws, joint=joint.only(kept) if joint and kept else None)


def _all_readers(
    recipe: Recipe, uncertain: Uncertain, outputs: Sequence[str]
) -> dict[str, tuple[tuple[Index, str], ...]]:
    """Return the indices and the names of the uncertain values in each ``step.parameter`` that uses some."""
    readers: dict[str, tuple[tuple[Index, str], ...]] = {}
    for name in uncertain.names:
        for reader, index in _readers(recipe, uncertain, name, outputs):
            readers[reader] = (*readers.get(reader, ()), (index, name))
    return readers


def _readers(recipe: Recipe, uncertain: Uncertain, name: str, outputs: Sequence[str]) -> Iterator[tuple[str, Index]]:
    """Yield each ``step.parameter`` that uses the recipe value ``name``, and the value's index in the parameter."""
    probe = _probe(uncertain, name)
    changed: Recipe = uncertain.at({name: probe})
    if changed.steps.keys() != recipe.steps.keys() or changed.outputs != recipe.outputs:
        raise ValueError(f"the value {name} changes the list of steps and therefore cannot be sampled")
    for step in needed(recipe, outputs):
        before, after = recipe.steps[step], changed.steps[step]
        for param, value in after.params.items():
            for index, new in _changed(before.params[param], value):
                _refuse_changed(new, probe, f"{step}.{param}", name)
                yield f"{step}.{param}", index


def _probe(uncertain: Uncertain, name: str) -> float:
    """Return a value of an uncertain input that differs from the value in the recipe."""
    if name in uncertain.laws:
        value = uncertain.composed.root.below(name.split("."))
        assert value is not None
        return uncertain.laws[name].other_than(read_any(value.data)[0])
    assert uncertain.joint is not None
    i = uncertain.joint.names.index(name)
    return float(uncertain.joint.mean[i] + _PROBE * uncertain.joint.sd[i])


def _refuse_changed(new: Any, probe: float, reader: str, name: str) -> None:
    """Raise ValueError if a parameter has another number than the value of the recipe that it reads."""
    if isinstance(new, int):
        raise ValueError(f"{name} is a whole number and cannot be sampled: compare its values by `neusee sweep`")
    if not isinstance(new, float) or abs(new - probe) > 1e-9 * abs(probe):
        raise ValueError(f"{reader} does not use {name} unchanged, so {name} cannot be sampled")


def _changed(before: Any, after: Any) -> Iterator[tuple[Index, Any]]:
    """Yield the index of each element in which two values of a parameter differ, and the new element."""
    if isinstance(after, list | tuple) and isinstance(before, list | tuple) and len(after) == len(before):
        for i, (a, b) in enumerate(zip(before, after, strict=True)):
            yield from (((i, *rest), new) for rest, new in _changed(a, b))
    elif isinstance(after, Mapping) and isinstance(before, Mapping) and after.keys() == before.keys():
        for key, b in after.items():
            yield from (((key, *rest), new) for rest, new in _changed(before[key], b))
    elif before != after:
        yield (), after


def put_at(value: Any, index: Index, new: float) -> Any:
    """Return a parameter with another number at an index; the index is empty for the parameter itself."""
    if not index:
        return new
    if isinstance(value, Mapping):
        return {**value, index[0]: put_at(value[index[0]], index[1:], new)}
    return type(value)(put_at(v, index[1:], new) if i == index[0] else v for i, v in enumerate(value))


def _label(uncertain: Uncertain, name: str) -> str:
    joint = uncertain.joint
    if joint is None or name not in joint.names:
        return name
    i = joint.names.index(name)
    whole: FloatArray = joint.factor @ joint.factor.T
    correlated = np.abs(whole[i]) > _CORRELATED
    if correlated[:i].any():
        return f"rest of {name}"
    return f"{name} and correlated values" if correlated[i + 1 :].any() else name
