"""The complete training of a network that estimates spectra from RGB, up to the file of its weights."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import digest, plain
from neusee.workflows.recipe.blocks.train_lift_block import LiftTraining
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.lift.lift_figures import lift_curves, lifted_spectra
from neusee.workflows.training.lift.lift_iteration import LiftLearner, Pairs
from neusee.workflows.training.loop.checkpoint import export
from neusee.workflows.training.loop.resumable_loop import DOCUMENT, Losses, Progress, ResumableLoop, Watch

_COLUMNS = ("iteration", "MRAE", "RMSE", "slope", "rate", "seconds")
#: old names of settings in the folder key, so that trainings of version 0.1 continue
_OLD_NAMES = {"min_rate": "least", "warmup": "warm", "ema_decay": "average", "validation_batches": "judge"}


def train_lift(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    progress: Progress,
    device: str = "cpu",
    watch: Watch | None = None,
) -> Path:
    """Train the network MST++ to estimate spectra from RGB, or continue a stopped training; return the result folder.

    ``mst_plus_plus.safetensors`` holds the weights for `spectra.lift_mst_plus_plus`.

    Raises ValueError for a recipe without the block or the steps that the block names; ArithmeticError for a loss that
    is NaN or infinite, after the weights and picture numbers that led to the loss are written to a file.
    """
    settings = recipe.lifting
    if settings is None:
        raise ValueError(f"{recipe.name} has no block `train_lift`: start from the recipe train_lift")
    pairs = Pairs(recipe, settings, store, device)
    folder = runs / f"{recipe.name}_{_key(recipe, settings)}"
    folder.mkdir(parents=True, exist_ok=True)
    learner = LiftLearner(settings, pairs, recipe.seed, device)
    _LiftLoop(settings, learner, folder, progress, device, watch).run_to_end(recipe, command)
    return folder


def _key(recipe: Recipe, settings: LiftTraining) -> str:
    """Return a digest of all settings that can change the trained weights, as a part of the folder name."""
    steps = {
        name: [
            recipe.steps[name].node.path,
            {key: plain(value) for key, value in recipe.steps[name].params.items()},
            {key: plain(wire) for key, wire in recipe.steps[name].wires.items()},
        ]
        for name in needed(recipe, [settings.measured, settings.picture, settings.cube])
    }
    usual = {"clip"} if settings.clip == 10.0 else set()  # so that older trainings continue
    fixed = settings.model_copy(update={"keep": 1, "show": 1, "validation_batches": 1})
    block = fixed.model_dump(mode="json", exclude=usual)
    return digest("lift", recipe.seed, steps, {_OLD_NAMES.get(name, name): value for name, value in block.items()})[:8]


class _LiftLoop(ResumableLoop[LiftLearner]):
    def __init__(
        self, settings: LiftTraining, learner: LiftLearner, folder: Path, progress: Progress, device: str,
        watch: Watch | None,
    ) -> None:  # fmt: skip
        super().__init__(folder, settings, learner, _COLUMNS, progress, device, watch)
        self.settings = settings
        self.resume()

    def run_to_end(self, recipe: Recipe, command: Sequence[str]) -> None:
        """Train the network to the last iteration, and write the results; do nothing if the training is finished."""
        if self.iteration == self.settings.iterations and (self.folder / DOCUMENT).is_file():
            return
        if self.iteration < self.settings.iterations:
            self.run(self.settings.iterations, self.settings.batch)
            self.keep()
        export(self.folder, "mst_plus_plus", self.learner.best.state_dict())
        self.close(
            lift_curves(self.rows.rows),
            recipe.name,
            command,
            train_lift=self.settings.model_dump(mode="json"),
            reflectances=len(self.learner.pairs.measured),
            judged=self.learner.validate(),
        )

    def iterate(self) -> Losses:
        return self.learner.iterate(self.iteration)

    @torch.no_grad()
    def show(self) -> None:
        """Write a figure of one picture with the true and the estimated spectra of its pixels."""
        picture, cube = self.learner.pairs("show", 0)
        centres = self.learner.pairs.bands.centres
        self.write_picture(
            f"{self.iteration:06d}", lifted_spectra(picture, cube, self.learner.estimates(picture), centres)
        )
