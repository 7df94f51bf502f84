"""The camera of a training as it is, which differs for each picture from what the restorer is told of it.

The true values are drawn about those of the recipe. The steps before the frame compute with the truth; the restorer
reads copies of the steps that tell it optics and lasers, and the copies keep the values of the recipe.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, Step, dependents, needed
from neusee.workflows.graph.told_copies import FRAME, TOLD, knowers, known, with_copies
from neusee.workflows.recipe.blocks.train_block import KEY, Training
from neusee.workflows.recipe.distributions.mismatch_laws import ANGLE, Difference
from neusee.workflows.recipe.distributions.scalar import draw_laws
from neusee.workflows.recipe.distributions.uncertain_inputs import Index, Inputs, put_at

_FAR = 4.5  #: standard deviations up to which the drawn values must be valid
_AXES = ("y", "x")
_STREAM = (5, 4)  #: of the draws of a picture


@dataclass(frozen=True)
class CameraMismatch:
    """The differences between camera and recipe of a training, and the parameters that have them; empty for none."""

    differences: Mapping[str, Difference]  #: by path; y and x of a direction are two
    moved: Mapping[str, tuple[tuple[Index, str], ...]]  #: by ``step.parameter``, indices and paths
    probes: Mapping[str, Any]  #: values of these parameters that differ from those of the recipe

    @classmethod
    def of(cls, recipe: Recipe, settings: Training) -> CameraMismatch:
        """Find the parameters of the camera that a recipe's ``train.mismatch`` changes.

        Raises: `RecipeError` for a value that no step before the frame reads, or that has draws which are not valid.
        """
        given = recipe.uncertain.mismatch if recipe.uncertain else {}
        if not given:
            return cls({}, {}, {})
        if FRAME not in recipe.steps:
            raise _mistake(given, next(iter(given)), f"the recipe has no step {FRAME}, which is the frame of a camera")
        directions = {path: one for path, one in given.items() if path.rpartition(".")[2] == ANGLE}
        inputs = _inputs(recipe, {path: one for path, one in given.items() if path not in directions})
        moved = dict(inputs.readers) if inputs else {}
        probes = inputs.theta(_probes(inputs)) if inputs else {}
        differences = {path: one for path, one in given.items() if path not in directions}
        for path, one in directions.items():
            for reader in _towards(recipe, given, path):
                moved[reader] = tuple(((i,), f"{path} {axis}") for i, axis in enumerate(_AXES))
                probes[reader] = _value(recipe, reader)
            differences |= {f"{path} {axis}": one for axis in _AXES}
        if learnt := [name for name in moved if name.rpartition(".")[0] == settings.learn]:
            path = moved[learnt[0]][0][1]
            raise _mistake(given, path, f"{settings.learn} is trained, so that its parameters have no effect")
        return cls(differences, moved, probes)

    def camera(self, recipe: Recipe, outputs: Sequence[str], psf: str) -> tuple[Recipe, str]:
        """Return the recipe with copies of what the makers of the ``outputs`` are told, and the copy of the PSF step.

        Until they are drawn, the true values are the probes, so that no step counts as one without effect.
        """
        moved = {name for name in self.moved if _has(recipe, name)}
        if not moved:
            return recipe, psf
        camera = set(needed(recipe, [FRAME]))
        readers = knowers(recipe, [name for name in needed(recipe, outputs) if name not in camera])
        told = needed(recipe, [*known(recipe, readers), psf])
        copied = dependents(recipe, {name.rpartition(".")[0] for name in moved}) & set(told)
        changed = with_copies(recipe, readers, copied, lambda step: step)
        steps = dict(changed.steps)
        for name in moved:
            step, _, param = name.rpartition(".")
            steps[step] = _with(steps[step], param, self.probes[name])
        return replace(changed, steps=steps), (TOLD if psf in copied else "") + psf

    def drawn(self, seed: Sequence[int]) -> dict[str, float]:
        """Draw the differences of one picture, in SI, by path."""
        if not self.differences:
            return {}
        laws = {path: one.law for path, one in self.differences.items()}
        return {path: column[0] for path, column in draw_laws(laws, 1, [*seed, *_STREAM]).items()}

    def truth(self, theta: Mapping[str, Any], drawn: Mapping[str, float]) -> dict[str, Any]:
        """Return the true values of those parameters of ``theta``, by ``step.parameter``, that differ from belief."""
        found = {}
        for reader, inputs in self.moved.items():
            if reader in theta:
                found[reader] = theta[reader]
                for index, path in inputs:
                    new = self.differences[path].of(_at(theta[reader], index), drawn[path])
                    found[reader] = put_at(found[reader], index, new)
        return found


def _inputs(recipe: Recipe, given: Mapping[str, Difference]) -> Inputs | None:
    """Return the values of the camera that differ, with the parameters before the frame that read them."""
    if not given:
        return None
    assert recipe.uncertain is not None
    laws = {path: one.truth for path, one in given.items()}
    within = replace(recipe, uncertain=replace(recipe.uncertain, laws=laws, joint=None))
    for path in given:
        one = replace(recipe.uncertain, laws={path: laws[path]}, joint=None)
        try:
            Inputs.of(replace(recipe, uncertain=one), [FRAME], negligible=None)
        except ValueError as error:
            text = "no step before the frame reads it" if str(error).startswith("no output") else str(error)
            raise _mistake(given, path, text) from error
    inputs = Inputs.of(within, [FRAME], negligible=None)
    ends = [[one.of(one.own, float(one.law.at(np.array(z)))) for one in given.values()] for z in (-_FAR, _FAR)]
    inputs.checked(np.array(ends))
    return inputs


def _probes(inputs: Inputs) -> dict[str, float]:
    """Return a value of each law that differs from that of the recipe."""
    assert inputs.recipe.uncertain is not None
    own = {path: one.own for path, one in inputs.recipe.uncertain.mismatch.items()}
    return {name: inputs.uncertain.laws[name].other_than(own[name]) for name in inputs.names}


def _towards(recipe: Recipe, given: Mapping[str, Difference], path: str) -> list[str]:
    """Return the parameters before the frame that turn the light of the laser whose direction has the path."""
    laser = path.removeprefix("lasers.").removesuffix(f".{ANGLE}")
    source, order = f"direction[{laser}]", needed(recipe, [FRAME])
    found = [
        f"{name}.{ANGLE}" for name in order
        if recipe.steps[name].wires.get("direction") == source and ANGLE in recipe.steps[name].params
    ]  # fmt: skip
    if not found:
        raise _mistake(given, path, "no step before the frame reads this direction")
    return found


def _mistake(given: Mapping[str, Difference], path: str, message: str) -> RecipeError:
    path = path.rpartition(" ")[0] or path
    return RecipeError([Diagnostic(given[path].mark, f"{KEY}.mismatch.{path}", message)])


def _has(recipe: Recipe, reader: str) -> bool:
    step, _, param = reader.rpartition(".")
    return step in recipe.steps and param in recipe.steps[step].params


def _value(recipe: Recipe, reader: str) -> Any:
    step, _, param = reader.rpartition(".")
    return recipe.steps[step].params[param]


def _with(step: Step, param: str, value: Any) -> Step:
    return replace(step, params={**step.params, param: value})


def _at(value: Any, index: Index) -> Any:
    for key in index:
        value = value[key]
    return value
