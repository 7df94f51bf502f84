"""Learn an element and the restoration behind it, in stages: resumed to the last bit, one folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from neusee.nodes import doe
from neusee.nodes.network_weights import file_metadata
from neusee.nodes.scene import Photographs
from neusee.workflows.engine.provenance import versions
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.recipe.blocks.mask_design_block import MaskSettings
from neusee.workflows.recipe.blocks.train_block import GRID, KEY, Stage, Training
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
from neusee.workflows.training.mask_stage import MASK, design_in, designed
from neusee.workflows.training.parallel.process_mesh import ALONE, Mesh, MeshError
from neusee.workflows.training.tensorboard_log import TensorBoardLog
from neusee.workflows.training.training_figures import curves, strip
from neusee.workflows.training.training_iteration import Learner, NotFinite
from neusee.workflows.training.training_pictures import Sample, TrainingStream

Tell = Callable[[str], None]
Watch = Callable[[int, int, Mapping[str, float]], None]  #: stage, iterations done of it, what was found


def train(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    tell: Tell,
    stages: Sequence[int] = (1, 2),
    device: str = "cpu",
    watch: Watch | None = None,
    mesh: Mesh = ALONE,
) -> Path:
    """Learn through the stages, or go on where an earlier call of the same was stopped; the folder.

    Stage 0 designs the element without images, in place of stage 1.

    Of the processes of a mesh each calls this, with the same arguments and a folder that all of them see; the first
    alone writes, and an error in one ends them all. The mesh decides no number but by rounding.

    Raises ValueError for a recipe that says not how, a folder without photographs, a second stage before there is an
    element, a first one where that was designed, or a mesh that does not fit; ArithmeticError where a loss is no
    number, with all that led to it beside the state.
    """
    how = recipe.training
    if how is None:
        raise ValueError(f"{recipe.name} says not how it is learnt: add `train: recommended` to its defaults")
    with_pictures = [number for number in stages if number != MASK]
    if MASK in stages and mesh.size > 1:
        raise MeshError("--stage mask is designed by one process: start it without torchrun")
    _divided(recipe, how, mesh)
    photographs = _photographs(recipe, how, bool(with_pictures))
    folder = runs / f"{recipe.name}_train_{_name(recipe, how, photographs)}"
    folder.mkdir(parents=True, exist_ok=True)
    if not mesh.first:
        tell, watch = (lambda line: None), None
    if MASK in stages:
        design_in(folder, recipe, how, store, command, tell, device)
    if with_pictures:
        course = _Course(recipe, how, photographs, store, folder, tell, device, watch, mesh)
        try:
            course.through(with_pictures, command)
        finally:
            if course.board is not None:
                course.board.close()
    return folder


def _divided(recipe: Recipe, how: Training, mesh: Mesh) -> None:
    """Refuse a batch of which the processes of the data axis cannot have equal shares."""
    for number, stage in how.stages.items():
        if stage.batch % mesh.data:
            path = f"{KEY}.stages.{number}.batch"
            where = recipe.config.settings.get(path)
            raise MeshError(
                f"{where.source if where else recipe.name}   {path}   {stage.batch} pictures cannot be shared equally "
                f"among {mesh.data}: --mesh {mesh} needs a multiple of {mesh.data}"
            )


def _photographs(recipe: Recipe, how: Training, needed: bool) -> Photographs:
    if how.photographs is not None:
        return Photographs.under(how.photographs)
    file = recipe.steps[how.scene].params.get("file") if how.scene in recipe.steps else None
    if not isinstance(file, Path) and needed:
        raise ValueError("train.photographs: name a folder of photographs")
    return Photographs((file,) if isinstance(file, Path) else ())


def _name(recipe: Recipe, how: Training, photographs: Photographs) -> str:
    """What decides a training, but for how often it is kept and shown: another begins anew in a folder of its own."""
    settings = recipe.config.settings.items()
    values = {name: str(setting.value) for name, setting in settings if not name.startswith(f"{KEY}.")}
    usual = {"mask"} if how.mask == MaskSettings() else set()  # trainings from before there was a mask go on
    still = how.model_copy(update={"keep": 1, "show": 1})
    said = still.model_dump(mode="json", exclude={"tensorboard", *usual})
    said["network"] = {"kind": how.network.kind, "width": how.network.width, **how.network.options}
    return digest("training", values, said, [path.name for path in photographs.paths])[:8]


class _Course:
    """One training: where it stands, and how it goes on."""

    def __init__(
        self,
        recipe: Recipe,
        how: Training,
        photographs: Photographs,
        store: Store,
        folder: Path,
        tell: Tell,
        device: str,
        watch: Watch | None,
        mesh: Mesh,
    ) -> None:
        self.recipe, self.how, self.photographs, self.store = recipe, how, photographs, store
        self.folder, self.tell, self.device, self.watch, self.mesh = folder, tell, device, watch, mesh
        self.designed = designed(folder)
        self.learner = Learner(recipe, how, device, self.designed, mesh)
        self.rows = Rows(folder / "losses.csv")
        self.state = folder / "state.pt"
        self.stage, self.iteration = 2 if self.designed else min(how.learnt), 0
        self._go_on()
        mesh.agree(f"{folder.name} in stage {self.stage} after {self.iteration} iterations")
        self.board = TensorBoardLog(folder, self._behind) if how.tensorboard and mesh.first else None

    def _go_on(self) -> None:
        if not self.state.exists():
            return self._begin()
        found = unpacked(self.state, self.device)
        self.stage, self.iteration = found["stage"], found["iteration"]
        self._begin()
        restore(self.learner.parts(), found)
        self.rows.cut(self.stage, self.iteration, self.mesh.first)
        self.tell(f"goes on in stage {self.stage} after {self.iteration} iterations")

    def _begin(self) -> None:
        """Fresh moments for the stage; after the last there is nothing to move."""
        self.learner.begin(self.how.stages.get(self.stage, Stage(iterations=0)), self.stage == 1)

    def through(self, stages: Sequence[int], command: Sequence[str]) -> None:
        """The stages that are asked for, and what comes out of them."""
        if self.designed and 1 in stages:
            raise ValueError(f"the element in {self.folder} was designed without images: --stage 2 goes on from it")
        for number in stages:
            if number not in self.how.learnt:
                raise ValueError(f"there is no stage {number}: train.stages and train.learn leave {self.how.learnt}")
            if number > self.stage:
                first = f"its {self._length} iterations first, or --stage mask"
                raise ValueError(f"stage {number} needs stage {self.stage}: {first}")
            if number == self.stage:
                self._through()
        if self.rows.rows and self.mesh.first:
            self._close(command)

    @property
    def _behind(self) -> int:
        """Iterations of all stages that are done."""
        return self.iteration + sum(s.iterations for number, s in self.how.stages.items() if number < self.stage)

    @property
    def _length(self) -> int:
        return self.how.stages[self.stage].iterations

    def _through(self) -> None:
        """To the end of the stage, and to the beginning of the next."""
        learns = self.stage == 1
        samples = self._samples(learns)
        while self.iteration < self._length:
            self._iterate(samples)
            if self.iteration % self.how.keep == 0 and self.iteration < self._length:
                self._keep()
        if self.mesh.first:
            self._export(learns)
        self.stage, self.iteration = self.stage + 1, 0
        self._begin()
        self._keep()
        self.mesh.wait()  # for the mask that is frozen now

    def _samples(self, learns: bool) -> TrainingStream:
        parts = self.recipe, self.how, self.photographs, self.store, self.device
        return TrainingStream(*parts, None if learns else frozen(self.recipe, self.how, self.folder), self.mesh)

    def _iterate(self, samples: TrainingStream) -> None:
        began, number = time.perf_counter(), self.iteration
        rate = self.learner.set_rates(number)
        try:
            found, seen = self.learner.iterate(samples, self.stage, number)
        except NotFinite as error:
            raise self._dumped(error) from error
        found |= {"rate": rate, "seconds": time.perf_counter() - began}
        self.rows.add(self.stage, number, found)
        if self.board is not None:
            self.board.row(self._behind, found)
        self.iteration += 1
        if self.mesh.first and (self.iteration % self.how.show == 0 or self.iteration == self._length):
            self._show(seen[0])
        if self.watch is not None:
            self.watch(self.stage, self.iteration, found)

    def _dumped(self, error: NotFinite) -> ArithmeticError:
        """Keep what led to a number that is none: the weights, and which pictures."""
        path = self.folder / f"not_finite_{self.stage}_{self.iteration}.pt"
        batch = self.how.stages[self.stage].batch
        pictures = [self.iteration * batch + i for i in range(batch)]
        here = {"stage": self.stage, "iteration": self.iteration, "pictures": pictures}
        if self.mesh.first:
            replaced(path, packed(self.learner.parts(), **here))
            self.rows.keep()
        said = f"stage {self.stage}, iteration {self.iteration}, pictures {pictures[0]} to {pictures[-1]}"
        return ArithmeticError(f"{said}: {error}; weights of that moment: {path}")

    def _keep(self) -> None:
        """First the rows, then the state: rows that are too many are cut off, lacking ones would be lost."""
        if not self.mesh.first:
            return
        self.rows.keep()
        if self.board is not None:
            self.board.keep()
        replaced(self.state, packed(self.learner.parts(), stage=self.stage, iteration=self.iteration))

    def _show(self, sample: Sample) -> None:
        with torch.no_grad():
            restored = self.learner.net(sample.picture[:1])[0].float()
        shown = strip([sample.picture[0].detach(), restored, sample.truth[0]])
        if self.board is not None:
            self.board.picture(self._behind - 1, self.stage, shown)
        (self.folder / "pictures").mkdir(exist_ok=True)
        replaced(self.folder / "pictures" / f"stage{self.stage}_{self.iteration:06d}.png", shown)

    def _export(self, learns: bool) -> None:
        if learns:
            with torch.no_grad():
                export(self.folder, "mask", {"height": self.learner.height()})
        net = self.learner.average or self.learner.net
        export(self.folder, "network", weights_of(net), file_metadata(self.learner.net))

    @property
    def _mask_source(self) -> str:
        """Return where the mask comes from."""
        if self.how.learn is None:
            return "the recipe's own"
        return "designed without images" if self.designed else "learnt in stage 1"

    def _close(self, command: Sequence[str]) -> None:
        replaced(self.folder / "curves.png", curves(self.rows.rows))
        broken = {str(path): why for path, why in self.photographs.broken.items()}
        document: dict[str, Any] = {
            "command": list(command),
            "recipe": self.recipe.name,
            "mask": self._mask_source,
            "train": self.how.model_dump(mode="json"),
            "photographs": len(self.photographs.paths),
            "mesh": str(self.mesh),
            "broken": broken,
            "iterations": {str(s): sum(int(r["stage"]) == s for r in self.rows.rows) for s in self.how.stages},
            "seconds": sum(float(r["seconds"]) for r in self.rows.rows),
            "last": self.rows.rows[-1],
            "versions": versions(),
        }
        write_json(self.folder / "training.json", document)


def frozen(recipe: Recipe, how: Training, folder: Path) -> Recipe:
    """The recipe with the element that was learnt in place of the one that learns: a step like any other."""
    if how.learn is None:
        return recipe
    file = folder / "mask.safetensors"
    if not file.is_file():
        raise ValueError(f"{file} is not there: --stage 1 or mask makes it")
    step = recipe.steps[how.learn]
    grid = {name: step.params[name] for name in GRID}
    params = {**grid, "file": file, "depth": 1e-6, "scale": 0.1}
    return replace(recipe, steps={**recipe.steps, how.learn: replace(step, node=doe.pixelwise, params=params)})
