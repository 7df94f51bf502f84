"""Training pictures of several cameras in turn, so that one network learns to restore the pictures of all of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from neusee.nodes.scene import Photographs
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.train_block import KEY, Training
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.parallel.process_mesh import Mesh, MeshError
from neusee.workflows.training.parallel.shared_graph import Shared
from neusee.workflows.training.training_pictures import HELD_OUT, Sample, TrainingStream


class SeveralCameras:
    """The pictures of a training with the camera of its recipe and with each of ``train.cameras``.

    The picture with the number n, or its number n in the pool, is of camera n modulo their count. A held-out photograph
    is seen by every camera.
    """

    shared = None  #: no mask is trained, so that no result depends on one

    def __init__(
        self, recipe: Recipe, settings: Training, photographs: Photographs, store: Store, device: str,
        held_out: Sequence[Path],
    ) -> None:  # fmt: skip
        recipes = (recipe, *recipe.cameras)
        self.repeats, self._pool = len(recipes), settings.pool
        seen = [path for path in held_out for _ in recipes]
        parts = settings, photographs, store, device
        self._streams = [TrainingStream(each, *parts, each, held_out=seen) for each in recipes]
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


Samples = TrainingStream | SeveralCameras


def samples_of(
    recipe: Recipe, settings: Training, photographs: Photographs, store: Store, device: str, frozen: Recipe | None,
    mesh: Mesh, held_out: Sequence[Path],
) -> Samples:  # fmt: skip
    """Return the pictures of a training, of one camera or of several in turn."""
    if frozen is not None and frozen.cameras:
        return SeveralCameras(frozen, settings, photographs, store, device, held_out)
    return TrainingStream(recipe, settings, photographs, store, device, frozen, mesh, held_out)


def require_alone(recipe: Recipe, mesh: Mesh) -> None:
    """Raise an error for a training with several cameras in several processes."""
    if recipe.cameras and mesh.size > 1:
        raise MeshError(f"{KEY}.cameras: a training with several cameras runs in a single process, without torchrun")
