"""Training pictures behind several fixed masks in turn, so that one network learns to restore behind all of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from neusee.nodes import doe
from neusee.nodes.scene import Photographs
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.train_block import FLAT, KEY, Training
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.parallel.process_mesh import Mesh, MeshError
from neusee.workflows.training.parallel.shared_graph import Shared
from neusee.workflows.training.training_pictures import HELD_OUT, Sample, TrainingStream

_HEIGHT = "height"  #: the step that an option of the group `doe` sets


class MixedMasks:
    """The pictures of a training behind the mask of its recipe and behind each of ``train.masks``.

    The picture with the number n, or its number n in the pool, stands behind mask n modulo their count. A held-out
    photograph is seen behind every mask.
    """

    shared = None  #: no mask is trained, so that no result depends on one

    def __init__(
        self, recipe: Recipe, settings: Training, photographs: Photographs, store: Store, device: str,
        held_out: Sequence[Path],
    ) -> None:  # fmt: skip
        recipes = behind_each(recipe, settings)
        self.repeats, self._pool = len(recipes), settings.pool
        seen = [path for path in held_out for _ in recipes]
        parts = settings, photographs, store, device
        self._streams = [TrainingStream(recipe, *parts, each, held_out=seen) for each in recipes]
        self.psf = self._streams[0].psf

    @property
    def pool_counts(self) -> dict[str, int]:
        """Return how many pictures of the pool came from the store, and how many were simulated."""
        counts = [stream.pool_counts for stream in self._streams]
        return {name: sum(each[name] for each in counts) for name in counts[0]}

    def begin(self, height: Any) -> Shared:
        """Return no results: none depends on a mask that is trained."""
        return Shared.of({})

    def counted(self, name: str, here: int) -> tuple[int, int]:
        """Return the total number of spectral bands of a result, and how many processes compute each: one."""
        return here, 1

    def batch(self, shared: Shared, stage: int, first: int, count: int) -> Iterator[tuple[int, Sample]]:
        """Yield index and picture of each of the ``count`` pictures of a batch, from the picture number ``first``."""
        for i in range(count):
            number = first + i
            within = number % self._pool if self._pool and stage != HELD_OUT else number
            stream = self._streams[within % self.repeats]
            yield i, stream.turned(stream(shared.seen, stage, number), stage, number)


Samples = TrainingStream | MixedMasks


def samples_of(
    recipe: Recipe, settings: Training, photographs: Photographs, store: Store, device: str, frozen: Recipe | None,
    mesh: Mesh, held_out: Sequence[Path],
) -> Samples:  # fmt: skip
    """Return the pictures of a training, behind one mask or behind several in turn."""
    if settings.masks and frozen is not None:
        return MixedMasks(frozen, settings, photographs, store, device, held_out)
    return TrainingStream(recipe, settings, photographs, store, device, frozen, mesh, held_out)


def require_masks(recipe: Recipe, settings: Training, mesh: Mesh) -> None:
    """Raise an error for several masks in a recipe without a mask, or in a training of several processes."""
    if settings.masks and mesh.size > 1:
        raise MeshError(f"{KEY}.masks: a training behind several masks runs in a single process, without torchrun")
    if settings.masks and (_HEIGHT not in recipe.steps or "stop" not in recipe.steps[_HEIGHT].wires):
        raise ValueError(f"{KEY}.masks: {recipe.name} has no mask: add an option of the group doe to its defaults")


def behind_each(recipe: Recipe, settings: Training) -> list[Recipe]:
    """Return the recipe with its own mask, and with each mask of ``train.masks`` in place of it."""
    step = recipe.steps[_HEIGHT]
    wires = {"stop": step.wires["stop"]}
    found = [recipe]
    for mask in settings.masks:
        node, params = (doe.flat, dict[str, Any]()) if mask == FLAT else (doe.pixelwise, _height_map(Path(mask)))
        other = replace(step, node=node, params=params, wires=wires)
        found.append(replace(recipe, steps={**recipe.steps, _HEIGHT: other}))
    return found


def _height_map(file: Path) -> Mapping[str, Any]:
    return {"file": file, "scale": 0.1, "between": "nearest"}  # a map may be wrapped, and has edges
