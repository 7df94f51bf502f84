"""Uncertain inputs of a recipe: the parameters that read the uncertain values, and draws of these values."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.workflows.graph.diagnostics import RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.recipe.distributions.nominal_values import Uncertain

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Places = NDArray[np.float64]

SCRAMBLES = 8  #: independent scramblings of Sobol's points, whose differences give the error
_PROBE = 0.3  #: standard deviations from the median at which a value is traced to the parameters
_TIED = 0.1  #: correlation from which two values count as correlated
_EDGE = 1e-12  #: probability next to 0 and 1 that no point may reach

Index = tuple[int | str, ...]


@dataclass(frozen=True)
class Points:
    """Draws of all inputs."""

    z: Places  #: (draw, input) independent standard normal numbers
    values: Places  #: (draw, input) in SI


@dataclass(frozen=True)
class Inputs:
    """The inputs that are drawn, in the order of `names`."""

    recipe: Recipe
    uncertain: Uncertain
    names: tuple[str, ...]  #: paths of the recipe that affect an output
    idle: tuple[str, ...]  #: paths that affect no output
    readers: Mapping[str, tuple[tuple[Index, str], ...]]  #: by ``step.parameter``: index in the parameter, and input

    @classmethod
    def of(cls, recipe: Recipe, outputs: Sequence[str] | None = None) -> Inputs:
        """Return the uncertain values that affect the outputs (the recipe's own, if None).

        Raises ValueError for a recipe without uncertain values, or where no output depends on one.
        """
        outputs = recipe.outputs if outputs is None else outputs
        uncertain = recipe.uncertain
        if uncertain is None or not uncertain.names:
            raise ValueError(
                "no value is uncertain: write a distribution in place of a value, such as "
                'sensor.read_noise="normal(10.5 e-, 0.5 e-)", or posterior: PATH'
            )
        found: dict[str, list[tuple[Index, str]]] = {}
        for name in uncertain.names:
            for reader, index in _readers(recipe, uncertain, name, outputs):
                found.setdefault(reader, []).append((index, name))
        reached = {name for places in found.values() for _, name in places}
        if not reached:
            raise ValueError(f"no output depends on {', '.join(uncertain.names)}")
        idle = tuple(name for name in uncertain.names if name not in reached)
        known = _only(uncertain, reached)
        return cls(recipe, known, known.names, idle, {name: tuple(places) for name, places in found.items()})

    @property
    def labels(self) -> list[str]:
        """Return the label of each standard normal number."""
        return [_label(self.uncertain, name) for name in self.names]

    @property
    def most(self) -> int | None:
        """Return the number of independent draws, or None where the number is unlimited."""
        joint = self.uncertain.joint
        return None if joint is None or joint.draws is None else len(joint.draws)

    def theta(self, values: Mapping[str, float]) -> dict[str, Any]:
        """Return the parameters that read the inputs, by ``step.parameter``."""
        found = {}
        for reader, places in self.readers.items():
            step, _, param = reader.rpartition(".")
            value = self.recipe.steps[step].params[param]
            for index, name in places:
                value = _put(value, index, values[name])
            found[reader] = value
        return found

    def at(self, z: Places) -> Places:
        """Return (draw, input) values at standard normal numbers."""
        columns = [law.at(z[:, i]) for i, law in enumerate(self.uncertain.laws.values())]
        joint = self.uncertain.joint
        return np.stack([*columns, *(joint.at(z[:, len(columns) :]).T if joint else ())], 1)

    def independent(self, count: int, seed: int) -> Points:
        """Return independent draws; a larger count begins with the same draws."""
        z = np.random.default_rng([seed, 1]).standard_normal((count, len(self.names)))
        values, joint = self.at(z), self.uncertain.joint
        if joint is None or joint.draws is None:
            return Points(z, values)
        rows = np.random.default_rng([seed, 2]).permutation(len(joint.draws))[:count]
        first = len(self.uncertain.laws)
        z = np.concatenate([z[: len(rows), :first], joint.numbers()[rows]], 1)
        return Points(z, np.concatenate([values[: len(rows), :first], joint.draws[rows]], 1))

    def sobol(self, count: int, seed: int) -> Points:
        """Return points of `SCRAMBLES` scrambled Sobol sequences in turn: point i belongs to sequence i % SCRAMBLES."""
        from scipy.special import ndtri
        from scipy.stats import qmc

        each = -(-count // SCRAMBLES)
        streams = [np.random.default_rng([seed, 3, n]) for n in range(SCRAMBLES)]
        sequences = [qmc.Sobol(len(self.names), seed=rng).random_base2((each - 1).bit_length()) for rng in streams]
        u = np.stack([s[:each] for s in sequences], 1).reshape(-1, len(self.names))[:count]
        z = np.asarray(ndtri(u.clip(_EDGE, 1 - _EDGE)), np.float64)
        return Points(z, self.at(z))

    def checked(self, values: Places) -> None:
        """Check the least and the greatest value of each input before a run; raise `RecipeError`."""
        for name, column in zip(self.names, values.T, strict=True):
            for value in (float(column.min()), float(column.max())):
                try:
                    self.uncertain.at({name: value})
                except RecipeError as error:
                    said = [replace(p, message=f"is drawn, but {p.message}") for p in error.diagnostics]
                    raise RecipeError(said) from None


def _only(uncertain: Uncertain, names: Collection[str]) -> Uncertain:
    """Return the uncertain values with only ``names`` drawn."""
    laws = {name: law for name, law in uncertain.laws.items() if name in names}
    joint = uncertain.joint
    kept = [name for name in joint.names if name in names] if joint else []
    return replace(uncertain, laws=laws, joint=joint.only(kept) if joint and kept else None)


def _readers(recipe: Recipe, uncertain: Uncertain, name: str, outputs: Sequence[str]) -> Iterator[tuple[str, Index]]:
    """Yield the parameters of needed steps that read the value of ``name``, with the index in the parameter."""
    if name in uncertain.laws:
        probe = float(uncertain.laws[name].at(np.array(_PROBE)))
    else:
        assert uncertain.joint is not None
        at = uncertain.joint.names.index(name)
        probe = float(uncertain.joint.mean[at] + _PROBE * uncertain.joint.sd[at])
    changed: Recipe = uncertain.at({name: probe})
    if changed.steps.keys() != recipe.steps.keys() or changed.outputs != recipe.outputs:
        raise ValueError(f"{name} changes the list of steps and therefore cannot be drawn")
    for step in needed(recipe, outputs):
        before, after = recipe.steps[step], changed.steps[step]
        for param, value in after.params.items():
            for index, new in _changed(before.params[param], value):
                if not isinstance(new, float) or abs(new - probe) > 1e-9 * abs(probe):
                    raise ValueError(f"{step}.{param} does not read {name} unchanged, so {name} cannot be drawn")
                yield f"{step}.{param}", index


def _changed(before: Any, after: Any) -> Iterator[tuple[Index, Any]]:
    """Yield the index of each difference between two parameters, and the second value there."""
    if isinstance(after, list | tuple) and isinstance(before, list | tuple) and len(after) == len(before):
        for i, (a, b) in enumerate(zip(before, after, strict=True)):
            yield from (((i, *rest), new) for rest, new in _changed(a, b))
    elif isinstance(after, Mapping) and isinstance(before, Mapping) and after.keys() == before.keys():
        for key, b in after.items():
            yield from (((key, *rest), new) for rest, new in _changed(before[key], b))
    elif before != after:
        yield (), after


def _put(value: Any, index: Index, new: float) -> Any:
    if not index:
        return new
    if isinstance(value, Mapping):
        return {**value, index[0]: _put(value[index[0]], index[1:], new)}
    return type(value)(_put(v, index[1:], new) if i == index[0] else v for i, v in enumerate(value))


def _label(uncertain: Uncertain, name: str) -> str:
    joint = uncertain.joint
    if joint is None or name not in joint.names:
        return name
    i = joint.names.index(name)
    whole: Places = joint.factor @ joint.factor.T
    if _tied(whole[i, :i]):
        return f"rest of {name}"
    return f"{name} and what goes with it" if _tied(whole[i, i + 1 :]) else name


def _tied(correlations: Sequence[float] | Places) -> bool:
    return bool((np.abs(correlations) > _TIED).any())
