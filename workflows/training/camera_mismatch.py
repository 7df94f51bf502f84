"""The actual camera of a training, which differs for each picture from the camera that the restorer
assumes.

The true values are drawn around those of the recipe. The steps up to the frame use the true values;
the restorer reads copies of the optics and laser steps, which keep the values of the recipe.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from neusee.workflows.graph.errors import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import (
    FRAME,
    TOLD,
    Recipe,
    Step,
    dependents,
    knowers,
    known,
    needed,
    with_copies,
)
from neusee.workflows.recipe.blocks.train_block import KEY, Training
from neusee.workflows.recipe.distributions.law_text import ANGLE, Difference
from neusee.workflows.recipe.distributions.shapes import draw_laws
from neusee.workflows.recipe.uncertain_inputs import Index, Inputs, put_at

_FARTHEST_DRAW = 4.5  #: drawn values must be valid up to this many standard deviations
_AXES = ("y", "x")
_STREAM = (5, 4)  #: stream of random numbers for the draws of a picture


@dataclass(frozen=True)
class CameraMismatch:
    """The differences between actual camera and recipe, with the affected parameters; empty for
    none.
    """

    differences: Mapping[str, Difference]  #: by path; y and x of a direction are separate
    moved: Mapping[str, tuple[tuple[Index, str], ...]]  #: (index, path) pairs by ``step.parameter``
    #: test values of these parameters that differ from those of the recipe
    probes: Mapping[str, Any]

    @classmethod
    def of(cls, recipe: Recipe, settings: Training) -> CameraMismatch:
        """Find the camera parameters that ``train.mismatch`` of a recipe changes.

        Raises: `RecipeError` for a value that no step before the frame reads, or that has draws
                which are not valid.
        """
        mismatch = recipe.uncertain.mismatch if recipe.uncertain else {}
        if not mismatch:
            return cls({}, {}, {})
        _refuse_no_frame(recipe, mismatch)
        directions = [path for path in mismatch if path.rpartition(".")[2] == ANGLE]
        differences = {
            path: difference for path, difference in mismatch.items() if path not in directions
        }
        moved, probes = _moved_and_probes(_inputs(recipe, differences))
        # the recipe has no law for a direction: each of its two angles gets one
        for path in directions:
            axis_paths = _by_axis(path)
            readers = _towards(recipe, mismatch, path)
            moved |= dict.fromkeys(readers, axis_paths)
            probes |= {reader: _value(recipe, reader) for reader in readers}
            differences |= dict.fromkeys((name for _, name in axis_paths), mismatch[path])
        _refuse_learnt(moved, mismatch, settings.learn)
        return cls(differences, moved, probes)

    def camera(self, recipe: Recipe, outputs: Sequence[str], psf: str) -> tuple[Recipe, str]:
        """Return the recipe with copies of the steps whose results the restorer of the ``outputs``
        assumes, and the name of the assumed PSF step.

        Until they are drawn, the true values are the probes, so that no step is taken for one
        without effect.
        """
        changed_names = {name for name in self.moved if _has_parameter(recipe, name)}
        if not changed_names:
            return recipe, psf
        camera_steps = set(needed(recipe, [FRAME]))
        # steps after the frame that read something of the camera
        restorer_steps = knowers(
            recipe, [name for name in needed(recipe, outputs) if name not in camera_steps]
        )
        believed_steps = needed(recipe, [*known(recipe, restorer_steps), psf])
        steps_to_copy = dependents(
            recipe, {name.rpartition(".")[0] for name in changed_names}
        ) & set(believed_steps)
        copied_recipe = with_copies(recipe, restorer_steps, steps_to_copy, lambda step: step)
        steps = dict(copied_recipe.steps)
        for name in changed_names:
            step, _, param = name.rpartition(".")
            steps[step] = _with(steps[step], param, self.probes[name])
        # the copies have the prefix TOLD
        return replace(copied_recipe, steps=steps), (TOLD if psf in steps_to_copy else "") + psf

    def drawn(self, seed: Sequence[int]) -> dict[str, float]:
        """Draw the differences for one picture, in SI units, by path."""
        if not self.differences:
            return {}
        laws = {path: difference.law for path, difference in self.differences.items()}
        # one draw of each law
        return {path: column[0] for path, column in draw_laws(laws, 1, [*seed, *_STREAM]).items()}

    def truth(self, theta: Mapping[str, Any], drawn: Mapping[str, float]) -> dict[str, Any]:
        """Return the true values of the parameters in ``theta``, by ``step.parameter``, that differ
        from the assumed ones.
        """
        values = {}
        for reader, inputs in self.moved.items():
            if reader in theta:
                values[reader] = theta[reader]
                for index, path in inputs:
                    true_value = self.differences[path].of(
                        _element(theta[reader], index), drawn[path]
                    )
                    values[reader] = put_at(values[reader], index, true_value)
        return values


def _by_axis(path: str) -> tuple[tuple[Index, str], ...]:
    """Return (index, path) for y and for x of a direction."""
    return tuple(((i,), f"{path} {axis}") for i, axis in enumerate(_AXES))


def _refuse_no_frame(recipe: Recipe, mismatch: Mapping[str, Difference]) -> None:
    """Raise `RecipeError` at the first difference if the recipe has no camera frame."""
    if FRAME not in recipe.steps:
        raise _mistake(
            mismatch,
            next(iter(mismatch)),
            f"the recipe has no step {FRAME}, which is the frame of a camera",
        )


def _moved_and_probes(
    inputs: Inputs | None,
) -> tuple[dict[str, tuple[tuple[Index, str], ...]], dict[str, Any]]:
    """Return the parameters that read uncertain values, and test values that differ from the
    recipe's.
    """
    if inputs is None:
        return {}, {}
    return dict(inputs.readers), inputs.theta(_probes(inputs))


def _refuse_learnt(
    moved: Mapping[str, tuple[tuple[Index, str], ...]],
    mismatch: Mapping[str, Difference],
    learn: str | None,
) -> None:
    """Raise `RecipeError` for a difference in a parameter of the trained step."""
    for name, inputs in moved.items():
        if name.rpartition(".")[0] == learn:
            path = inputs[0][1]
            raise _mistake(
                mismatch, path, f"{learn} is trained, so that its parameters have no effect"
            )


def _inputs(recipe: Recipe, mismatch: Mapping[str, Difference]) -> Inputs | None:
    """Return the differing camera values, with the parameters up to the frame that read them."""
    if not mismatch:
        return None
    assert recipe.uncertain is not None
    laws = {path: difference.truth for path, difference in mismatch.items()}
    all_laws = replace(recipe, uncertain=replace(recipe.uncertain, laws=laws, joint=None))
    for path in mismatch:
        # check each law alone first, so that an error names its path
        one_law = replace(recipe.uncertain, laws={path: laws[path]}, joint=None)
        try:
            Inputs.of(replace(recipe, uncertain=one_law), [FRAME], negligible=None)
        except ValueError as error:
            text = (
                "no step before the frame reads it"
                if str(error).startswith("no output")
                else str(error)
            )
            raise _mistake(mismatch, path, text) from error
    inputs = Inputs.of(all_laws, [FRAME], negligible=None)
    # rows: all values at the lower end, all at the upper end
    extreme_values = [
        [
            difference.of(difference.own, float(difference.law.at(np.array(z))))
            for difference in mismatch.values()
        ]
        for z in (-_FARTHEST_DRAW, _FARTHEST_DRAW)
    ]
    inputs.checked(np.array(extreme_values))
    return inputs


def _probes(inputs: Inputs) -> dict[str, float]:
    """Return for each uncertain input a test value other than its value in the recipe."""
    assert inputs.recipe.uncertain is not None
    recipe_values = {
        path: difference.own for path, difference in inputs.recipe.uncertain.mismatch.items()
    }
    return {
        name: inputs.uncertain.laws[name].other_than(recipe_values[name]) for name in inputs.names
    }


def _towards(recipe: Recipe, mismatch: Mapping[str, Difference], path: str) -> list[str]:
    """Return the parameters up to the frame that set the direction of the laser in ``path``."""
    laser = path.removeprefix("lasers.").removesuffix(f".{ANGLE}")
    direction_input, steps_before_frame = f"direction[{laser}]", needed(recipe, [FRAME])
    turned_steps = [
        name
        for name in steps_before_frame
        if recipe.steps[name].wires.get("direction") == direction_input
    ]
    readers = [f"{name}.{ANGLE}" for name in turned_steps if ANGLE in recipe.steps[name].params]
    if not readers:
        raise _mistake(mismatch, path, "no step before the frame reads this direction")
    return readers


def _mistake(mismatch: Mapping[str, Difference], path: str, message: str) -> RecipeError:
    """Return the error for one difference in the block.

    For a path with an axis, such as ``lasers.red.angle y``, only the part before the space is in
    the recipe.
    """
    path = path.rpartition(" ")[0] or path
    return RecipeError([Diagnostic(mismatch[path].mark, f"{KEY}.mismatch.{path}", message)])


def _has_parameter(recipe: Recipe, reader: str) -> bool:
    step, _, param = reader.rpartition(".")
    return step in recipe.steps and param in recipe.steps[step].params


def _value(recipe: Recipe, reader: str) -> Any:
    step, _, param = reader.rpartition(".")
    return recipe.steps[step].params[param]


def _with(step: Step, param: str, value: Any) -> Step:
    return replace(step, params={**step.params, param: value})


def _element(value: Any, index: Index) -> Any:
    for key in index:
        value = value[key]
    return value
