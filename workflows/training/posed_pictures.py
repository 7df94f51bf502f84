"""Training pictures of an unrolled filter: the problem of the filter is posed and solved once for each picture.

The network `unrolled` needs the PSF, the glare, the clipped pixels and the noise of a picture. The recipe gives them to
the step of the filter, whose result `train.picture` converts to colours. In the training the node of this step is
`restore.wiener_problem`, with the same inputs, so that the answer of the filter is the input of the network.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import restore
from neusee.nodes.values import WienerProblem
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.train_block import KEY, Training

Given = tuple[()] | tuple[WienerProblem, Tensor]  #: nothing, or the problem of the filter and the colour matrix
_FILTERS = ("restore.wiener", "restore.unrolled")
_PARAMETERS = ("balance", "doubt", "least_doubt", "read_noise")


@dataclass(frozen=True)
class PosedPictures:
    """The steps of a recipe that pose the problem of a picture, and that compute the colour matrix."""

    filter: str
    matrix: str

    @classmethod
    def of(cls, recipe: Recipe, settings: Training) -> PosedPictures | None:
        """Return the steps of a training of the network unrolled, or None for every other network.

        Raises ValueError if the picture of the training is not that of the Wiener filter.
        """
        if settings.network.architecture is not None or settings.network.kind != "unrolled":
            return None
        shown = recipe.steps[settings.picture]
        channels, matrix = (str(shown.wires.get(name)) for name in ("channels", "matrix"))
        if shown.node.path != "restore.colour" or recipe.steps[channels].node.path not in _FILTERS:
            given = recipe.config.settings.get(f"{KEY}.picture")
            text = (
                f"{settings.picture} is {shown.node.path}, and the network unrolled starts from the Wiener filter: use "
                f"restore: wiener and {KEY}.picture: restored"
            )
            raise ValueError(f"{given.source if given else recipe.name}   {KEY}.picture   {text}")
        return cls(channels, matrix)

    @property
    def steps(self) -> tuple[str, str]:
        """Return the steps from which `read` makes the input of the network."""
        return (self.filter, self.matrix)

    def within(self, recipe: Recipe) -> Recipe:
        """Return the recipe whose filter poses the problem and solves it."""
        step = recipe.steps[self.filter]
        params = {name: value for name, value in step.params.items() if name in _PARAMETERS}
        posed = replace(step, node=restore.wiener_problem, params=params)
        return replace(recipe, steps={**recipe.steps, self.filter: posed})

    def read(self, values: Mapping[str, Any], dtype: torch.dtype) -> tuple[Tensor, tuple[WienerProblem, Tensor]]:
        """Return the picture of the filter (3, y, x), and what the network needs beside it in the given precision.

        The filter solves small pictures in float64; the steps of a training take half the time in float32.
        """
        problem, matrix = values[self.filter], values[self.matrix]
        told: Tensor = restore.colour(problem.answer * problem.scale + problem.mean, matrix)
        return told, (WienerProblem._make(part.to(dtype) for part in problem), matrix.to(dtype))


def tensors_of(given: Given) -> dict[str, Tensor]:
    """Return the tensors by name of what a network needs beside a picture."""
    if not given:
        return {}
    problem, matrix = given
    return {**{f"given.{name}": x for name, x in problem._asdict().items()}, "given.matrix": matrix}


def given_of(tensors: Mapping[str, Tensor]) -> Given:
    """Return what a network needs beside a picture, from its tensors by name."""
    if "given.matrix" not in tensors:
        return ()
    return WienerProblem(**{name: tensors[f"given.{name}"] for name in WienerProblem._fields}), tensors["given.matrix"]
