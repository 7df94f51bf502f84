"""Training pictures of a network that needs what the Wiener filter knows: the filter is solved once for each picture.

The networks `unrolled` and `informed` need the PSF, the glare, the clipped pixels and the noise of a picture. The
recipe gives them to the step of the filter, whose result `train.picture` converts to colours. In the training the node
of this step is `restore.wiener_problem` or `restore.filter_facts`, with the same inputs, so that the answer of the
filter is the input of the network.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import restore
from neusee.nodes.scene import symmetry
from neusee.nodes.values import FilterFacts, WienerProblem
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.train_block import KEY, POSED, Training

Posed = WienerProblem | FilterFacts
Given = tuple[()] | tuple[Posed, Tensor]  #: nothing, or what the filter poses and knows, and the colour matrix
_FILTERS = ("restore.wiener", "restore.unrolled", "restore.informed")
_KNOWN: dict[str, Any] = {"unrolled": restore.wiener_problem, "informed": restore.filter_facts}
_PARAMETERS = ("balance", "doubt", "least_doubt", "read_noise")


@dataclass(frozen=True)
class PosedPictures:
    """The steps of a recipe that pose the problem of a picture, and that compute the colour matrix."""

    filter: str
    matrix: str
    kind: str = "unrolled"  #: of the network

    @classmethod
    def of(cls, recipe: Recipe, settings: Training) -> PosedPictures | None:
        """Return the steps of a training of such a network, or None for every other network.

        Raises ValueError if the picture of the training is not that of the Wiener filter.
        """
        kind = settings.network.kind
        if settings.network.architecture is not None or kind not in POSED:
            return None
        shown = recipe.steps[settings.picture]
        channels, matrix = (str(shown.wires.get(name)) for name in ("channels", "matrix"))
        if shown.node.path != "restore.colour" or recipe.steps[channels].node.path not in _FILTERS:
            given = recipe.config.settings.get(f"{KEY}.picture")
            text = (
                f"{settings.picture} is {shown.node.path}, and the network {kind} starts from the Wiener filter: use "
                f"restore: wiener and {KEY}.picture: restored"
            )
            raise ValueError(f"{given.source if given else recipe.name}   {KEY}.picture   {text}")
        return cls(channels, matrix, kind)

    @property
    def steps(self) -> tuple[str, str]:
        """Return the steps from which `read` makes the input of the network."""
        return (self.filter, self.matrix)

    def within(self, recipe: Recipe) -> Recipe:
        """Return the recipe whose filter poses the problem and solves it."""
        step = recipe.steps[self.filter]
        params = {name: value for name, value in step.params.items() if name in _PARAMETERS}
        posed = replace(step, node=_KNOWN[self.kind], params=params)
        return replace(recipe, steps={**recipe.steps, self.filter: posed})

    def read(self, values: Mapping[str, Any], dtype: torch.dtype) -> tuple[Tensor, Given]:
        """Return the picture of the filter (3, y, x), and what the network needs beside it in the given precision.

        The filter solves small pictures in float64; the steps of a training take half the time in float32.
        """
        posed, matrix = values[self.filter], values[self.matrix]
        told: Tensor = restore.colour(posed.answer * posed.scale + posed.mean, matrix)
        return told, (posed._make(part.to(dtype) for part in posed), matrix.to(dtype))


def tensors_of(given: Given) -> dict[str, Tensor]:
    """Return the tensors by name of what a network needs beside a picture."""
    if not given:
        return {}
    posed, matrix = given
    return {**{f"given.{name}": x for name, x in posed._asdict().items()}, "given.matrix": matrix}


def given_of(tensors: Mapping[str, Tensor]) -> Given:
    """Return what a network needs beside a picture, from its tensors by name."""
    if "given.matrix" not in tensors:
        return ()
    kind = FilterFacts if "given.maps" in tensors else WienerProblem
    return kind(**{name: tensors[f"given.{name}"] for name in kind._fields}), tensors["given.matrix"]


def turned(given: Given, seed: tuple[int, ...]) -> Given:
    """Turn the maps that a network sees beside a picture, as `scene.symmetry` turns the picture with the same seed."""
    known = given[0] if given else None
    if not given or not isinstance(known, FilterFacts):
        return given
    seen = {name: symmetry(getattr(known, name), seed) for name in ("answer", "deviation", "maps")}
    return known._replace(**seen), given[1]
