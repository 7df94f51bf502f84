"""Learn a lift from RGB to spectra: one state to go on from, a row for each iteration, weights that `lift` takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from neusee.workflows.engine.provenance import versions
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import digest, plain
from neusee.workflows.recipe.blocks.train_lift_block import LiftTraining
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.checkpoint import (
    Rows,
    export,
    packed,
    replaced,
    restore,
    unpacked,
    weights_of,
    write_json,
)
from neusee.workflows.training.lift.lift_figures import lift_curves, lifted_spectra
from neusee.workflows.training.lift.lift_iteration import LiftLearner, Pairs
from neusee.workflows.training.training_iteration import NotFinite

Tell = Callable[[str], None]
Watch = Callable[[int, Mapping[str, float]], None]  #: iterations done, what was found
_COLUMNS = ("iteration", "MRAE", "RMSE", "slope", "rate", "seconds")
_NETWORK = "mst_plus_plus"
_ABOUT = "training.json"  #: what is written last


def train_lift(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    tell: Tell,
    device: str = "cpu",
    watch: Watch | None = None,
) -> Path:
    """Learn MST++ as a recipe's ``train_lift`` says, or go on where the same was stopped; the folder.

    ``mst_plus_plus.safetensors`` is what `spectra.lift_mst_plus_plus` takes as its weights.

    Raises ValueError for a recipe that says not how, or lacks the steps; ArithmeticError where a loss is no number,
    with all that led to it beside the state.
    """
    how = recipe.lifting
    if how is None:
        raise ValueError(f"{recipe.name} says not how a lift is learnt: begin with the recipe train_lift")
    pairs = Pairs(recipe, how, store, device)
    folder = runs / f"{recipe.name}_{_name(recipe, how)}"
    folder.mkdir(parents=True, exist_ok=True)
    _Course(how, LiftLearner(how, pairs, recipe.seed, device), folder, tell, device, watch).through(recipe, command)
    return folder


def _name(recipe: Recipe, how: LiftTraining) -> str:
    """What decides a training, but for how often it is kept and shown, and on how much it is judged."""
    steps = {
        name: [
            recipe.steps[name].node.path,
            {key: plain(value) for key, value in recipe.steps[name].params.items()},
            {key: plain(wire) for key, wire in recipe.steps[name].wires.items()},
        ]
        for name in needed(recipe, [how.measured, how.picture, how.cube])
    }
    said = how.model_copy(update={"keep": 1, "show": 1, "judge": 1}).model_dump(mode="json")
    return digest("lift", recipe.seed, steps, said)[:8]


class _Course:
    """One training: where it stands, and how it goes on."""

    def __init__(
        self, how: LiftTraining, learner: LiftLearner, folder: Path, tell: Tell, device: str, watch: Watch | None
    ) -> None:
        self.how, self.learner, self.folder, self.watch = how, learner, folder, watch
        self.rows = Rows(folder / "losses.csv", _COLUMNS)
        self.state, self.iteration = folder / "state.pt", 0
        if self.state.exists():
            found = unpacked(self.state, device)
            self.iteration = found["iteration"]
            restore(learner.parts(), found)
            self.rows.cut(0, self.iteration)
            tell(f"goes on after {self.iteration} iterations")

    def through(self, recipe: Recipe, command: Sequence[str]) -> None:
        """To the end, and what comes out of it; what is finished stays as it is."""
        if self.iteration == self.how.iterations and (self.folder / _ABOUT).is_file():
            return
        while self.iteration < self.how.iterations:
            self._iterate()
            if self.iteration % self.how.show == 0 and self.iteration < self.how.iterations:
                self._show()
            if self.iteration % self.how.keep == 0 or self.iteration == self.how.iterations:
                self._keep()
        export(self.folder, _NETWORK, weights_of(self.learner.best()))
        self._show()
        self._close(recipe, command)

    def _iterate(self) -> None:
        began = time.perf_counter()
        try:
            found = self.learner.iterate(self.iteration)
        except NotFinite as error:
            raise self._dumped(error) from error
        self.rows.add(0, self.iteration, found | {"seconds": time.perf_counter() - began})
        self.iteration += 1
        if self.watch is not None:
            self.watch(self.iteration, found)

    def _dumped(self, error: NotFinite) -> ArithmeticError:
        path = self.folder / f"not_finite_{self.iteration}.pt"
        replaced(path, packed(self.learner.parts(), iteration=self.iteration))
        self.rows.keep()
        return ArithmeticError(f"iteration {self.iteration}: {error}; weights of that moment: {path}")

    def _keep(self) -> None:
        """First the rows, then the state: rows that are too many are cut off, lacking ones would be lost."""
        self.rows.keep()
        replaced(self.state, packed(self.learner.parts(), iteration=self.iteration))

    @torch.no_grad()
    def _show(self) -> None:
        picture, cube = self.learner.pairs("show", 0)
        shown = lifted_spectra(picture, cube, self.learner.estimates(picture), self.learner.pairs.bands.centres)
        (self.folder / "pictures").mkdir(exist_ok=True)
        replaced(self.folder / "pictures" / f"{self.iteration:06d}.png", shown)

    def _close(self, recipe: Recipe, command: Sequence[str]) -> None:
        replaced(self.folder / "curves.png", lift_curves(self.rows.rows))
        document: dict[str, Any] = {
            "command": list(command),
            "recipe": recipe.name,
            "train_lift": self.how.model_dump(mode="json"),
            "reflectances": len(self.learner.pairs.measured),
            "judged": self.learner.judged(),
            "seconds": sum(float(row["seconds"]) for row in self.rows.rows),
            "versions": versions(),
        }
        write_json(self.folder / _ABOUT, document)
