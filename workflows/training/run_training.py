"""The training of a mask and of the network that restores the pictures behind the mask, in two stages."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from neusee.nodes import doe
from neusee.nodes.network_weights import file_metadata
from neusee.nodes.scene import Photographs
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.blocks.mask_design_block import MaskSettings
from neusee.workflows.recipe.blocks.train_block import KEY, Network, Stage, Training
from neusee.workflows.recipe.own_families import KEY as OWN_NODES
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.loop.checkpoint import export
from neusee.workflows.training.loop.resumable_loop import Losses, Progress, ResumableLoop, Watch
from neusee.workflows.training.mask_design.design_run import MASK, design_in, designed
from neusee.workflows.training.parallel.process_mesh import ALONE, Mesh, MeshError
from neusee.workflows.training.tensorboard_log import open_board
from neusee.workflows.training.training_figures import curves, png, strip
from neusee.workflows.training.training_iteration import Learner
from neusee.workflows.training.training_pictures import TrainingStream

_COLUMNS = ("stage", "iteration", "LSR", "BSR", "L1", "reconstruction", "adversarial", "critics", "penalty", "slope",
            "rate", "seconds")  # fmt: skip


def train(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    progress: Progress,
    stages: Sequence[int] = (1, 2),
    device: str = "cpu",
    watch: Watch | None = None,
    mesh: Mesh = ALONE,
) -> Path:
    """Train mask and restoration network in stages, or continue a stopped training, and return the result folder.

    Stage 0 designs the mask without images and replaces stage 1.

    Every process of a mesh calls this function with the same arguments and a folder that all processes see; only the
    first process writes, and an error in one process ends all processes. The mesh changes results by rounding only.

    Raises ValueError for a recipe without the block ``train``, a folder without photographs, stage 2 without a mask,
    stage 1 after the mask was designed, or a mesh that does not fit; ArithmeticError for a loss that is NaN or
    infinite, after the weights and picture numbers that led to the loss are written to a file.
    """
    settings = recipe.training
    if settings is None:
        raise ValueError(f"{recipe.name} has no block `train`: add `train: recommended` to its defaults")
    with_pictures = [number for number in stages if number != MASK]
    if MASK in stages and mesh.size > 1:
        raise MeshError("--stage mask runs in a single process: start the training without torchrun")
    _require_equal_shares(recipe, settings, mesh)
    photographs = _photographs(recipe, settings, bool(with_pictures))
    folder = runs / f"{recipe.name}_train_{_key(recipe, settings, photographs, Code(store.code_memo))}"
    folder.mkdir(parents=True, exist_ok=True)
    if not mesh.first:
        progress, watch = (lambda line: None), None
    if MASK in stages:
        design_in(folder, recipe, settings, store, command, progress, device)
    if with_pictures:
        loop = _TrainingLoop(recipe, settings, photographs, store, folder, progress, device, watch, mesh)
        with loop.board or nullcontext():
            loop.run_stages(with_pictures, command)
    return folder


def _require_equal_shares(recipe: Recipe, settings: Training, mesh: Mesh) -> None:
    for number, stage in settings.stages.items():
        if stage.batch % mesh.data:
            path = f"{KEY}.stages.{number}.batch"
            setting = recipe.config.settings.get(path)
            raise MeshError(
                f"{setting.source if setting else recipe.name}   {path}   {stage.batch} pictures cannot be divided "
                f"equally among {mesh.data} processes: --mesh {mesh} needs a multiple of {mesh.data}"
            )


def _photographs(recipe: Recipe, settings: Training, needed: bool) -> Photographs:
    if settings.photographs is not None:
        return Photographs.under(settings.photographs)
    file = recipe.steps[settings.scene].params.get("file") if settings.scene in recipe.steps else None
    if not isinstance(file, Path) and needed:
        raise ValueError("train.photographs is missing: write the path of a folder of photographs")
    return Photographs((file,) if isinstance(file, Path) else ())


def _key(recipe: Recipe, settings: Training, photographs: Photographs, code: Code) -> str:
    """Return a digest of all settings that can change a trained network or mask, as a part of the folder name."""
    items = recipe.config.settings.items()
    left_out = (f"{KEY}.", OWN_NODES)
    values = {name: str(setting.value) for name, setting in items if not name.startswith(left_out)}
    defaults = {"mask": MaskSettings(), "clip": 10.0, "reduction": "mean"}
    usual = {name for name, x in defaults.items() if getattr(settings, name) == x}  # so that older trainings continue
    block = settings.model_copy(update={"keep": 1, "show": 1}).model_dump(mode="json", exclude={"tensorboard", *usual})
    block["network"] = _identity(settings.network, code)
    return digest("training", values, block, [path.name for path in photographs.paths])[:8]


def _identity(network: Network, code: Code) -> dict[str, Any]:
    """Return what identifies the network of a training; a class of the user counts with its code."""
    if network.architecture is None:
        return {"kind": network.kind, "width": network.width, **network.options}
    made = code.digest(network.architecture.network.__module__)
    return {"class": str(network.architecture), "code": made, **network.model_dump(include={"parameters", "multiple"})}


class _TrainingLoop(ResumableLoop[Learner]):
    def __init__(
        self, recipe: Recipe, settings: Training, photographs: Photographs, store: Store, folder: Path,
        progress: Progress, device: str, watch: Watch | None, mesh: Mesh,
    ) -> None:  # fmt: skip
        self.designed = designed(folder)
        learner = Learner(recipe, settings, device, self.designed, mesh)
        super().__init__(folder, settings, learner, _COLUMNS, progress, device, watch, mesh.first)
        self.recipe, self.settings, self.photographs, self.store = recipe, settings, photographs, store
        self.mesh, self.stage = mesh, 2 if self.designed else min(settings.learnt)
        self.resume()
        mesh.agree(f"{folder.name} in stage {self.stage} after {self.iteration} iterations")
        self.board = open_board(folder, self._iterations_of_all_stages) if settings.tensorboard and mesh.first else None

    def begin_stage(self) -> None:
        """Prepare new optimisers for the present stage of the training."""
        self.learner.begin(self.settings.stages.get(self.stage, Stage(iterations=0)), self.stage == 1)

    def run_stages(self, stages: Sequence[int], command: Sequence[str]) -> None:
        """Run the given stages of the training (1: mask and network, 2: network alone), and write the results."""
        if self.designed and 1 in stages:
            raise ValueError(f"the mask in {self.folder} was designed without images: continue with --stage 2")
        for number in stages:
            if number not in self.settings.learnt:
                stages_left = self.settings.learnt
                raise ValueError(f"there is no stage {number}: train.stages and train.learn define only {stages_left}")
            if number > self.stage:
                first = f"run the {self._length} iterations of stage {self.stage} first, or --stage mask"
                raise ValueError(f"stage {number} cannot begin before the end of stage {self.stage}: {first}")
            if number == self.stage:
                self._run_stage()
        if self.rows.rows and self.writes:
            self._close(command)

    @property
    def _iterations_of_all_stages(self) -> int:
        return self.iteration + sum(s.iterations for number, s in self.settings.stages.items() if number < self.stage)

    @property
    def _length(self) -> int:
        return self.settings.stages[self.stage].iterations

    def _run_stage(self) -> None:
        """Train to the end of the present stage, and write the checkpoint with which the next stage begins."""
        fixed = None if self.stage == 1 else frozen(self.recipe, self.settings, self.folder)
        parts = self.recipe, self.settings, self.photographs, self.store, self.device
        self.samples = TrainingStream(*parts, fixed, self.mesh)
        self.run(self._length, self.settings.stages[self.stage].batch)
        if self.writes:
            self._export()
        self.stage, self.iteration = self.stage + 1, 0
        self.begin_stage()
        self.keep()
        self.mesh.wait()  # until the first process has written the mask

    def iterate(self) -> Losses:
        """Train on one batch of pictures; return the losses, and the learning rate relative to its initial value."""
        rate = self.learner.set_rates(self.iteration)
        losses, self.seen = self.learner.iterate(self.samples, self.stage, self.iteration)
        return losses | {"rate": rate}

    def note(self, losses: Losses) -> None:
        """Write the losses of the last training iteration to TensorBoard, and pass them to the callback ``watch``."""
        if self.board:
            for name, value in losses.items():
                self.board.add_scalar(name, value, self._iterations_of_all_stages - 1)
        super().note(losses)

    def keep(self) -> None:
        """Write TensorBoard events, loss table and checkpoint of a training to disk."""
        if self.board:
            self.board.flush()
        super().keep()

    def show(self) -> None:
        """Write a PNG file with a picture of the last batch, its restoration and the true picture side by side."""
        sample = self.seen[0]
        self.learner.net.eval()
        with torch.no_grad():
            restored = self.learner.net(sample.picture[:1])[0].float()
        self.learner.net.train()
        shown = strip([sample.picture[0].detach(), restored, sample.truth[0]])
        if self.board:
            self.board.add_image(f"stage {self.stage}", shown, self._iterations_of_all_stages - 1, dataformats="HWC")
        self.write_picture(f"stage{self.stage}_{self.iteration:06d}", png(shown))

    def _export(self) -> None:
        if self.stage == 1:
            with torch.no_grad():
                export(self.folder, "mask", {"height": self.learner.height()})
        net: Any = self.learner.average.module if self.learner.average else self.learner.net
        export(self.folder, "network", net.stored.state_dict(), file_metadata(self.learner.net))

    @property
    def _mask_source(self) -> str:
        if self.settings.learn is None:
            return "the recipe's own"
        return "designed without images" if self.designed else "learnt in stage 1"

    def _close(self, command: Sequence[str]) -> None:
        rows = self.rows.rows
        self.close(
            curves(rows),
            self.recipe.name,
            command,
            mask=self._mask_source,
            train=self.settings.model_dump(mode="json"),
            photographs=len(self.photographs.paths),
            mesh=str(self.mesh),
            broken={str(path): reason for path, reason in self.photographs.broken.items()},
            iterations={str(stage): sum(int(r["stage"]) == stage for r in rows) for stage in self.settings.stages},
            last=rows[-1],
        )


def frozen(recipe: Recipe, settings: Training, folder: Path) -> Recipe:
    """Return the recipe with the trained mask from the file ``mask.safetensors`` as a fixed mask."""
    if settings.learn is None:
        return recipe
    file = folder / "mask.safetensors"
    if not file.is_file():
        raise ValueError(f"{file} does not exist: run --stage 1 or --stage mask first to write this file")
    step = recipe.steps[settings.learn]
    params, wires = {"file": file, "depth": 1e-6, "scale": 0.1}, {"stop": step.wires["stop"]}
    learnt = replace(step, node=doe.pixelwise, params=params, wires=wires)
    return replace(recipe, steps={**recipe.steps, settings.learn: learnt})
