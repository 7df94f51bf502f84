"""The training of a mask and of the restoration network behind it, in two stages, with its inputs
and files.
"""

from __future__ import annotations

import copy
import importlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from neusee.nodes import ParameterError, doe
from neusee.nodes.file_headers import safetensors_need
from neusee.nodes.network_weights import file_metadata
from neusee.nodes.own_modules import Architecture
from neusee.nodes.restore import Restorer, export_network, require_exportable
from neusee.nodes.restore import network as network_node
from neusee.nodes.scene import Photographs
from neusee.workflows.engine.processor_speed import thread_seconds
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import Stamp, device_kind, file_digest, file_stamps
from neusee.workflows.keys.code_digest import Code, outline
from neusee.workflows.recipe.blocks.train_block import KEY, Network, Stage, Training
from neusee.workflows.store.result_store import Store
from neusee.workflows.training import held_out
from neusee.workflows.training.camera_mismatch import CameraMismatch
from neusee.workflows.training.design_run import MASK, design_in, design_inputs, designed
from neusee.workflows.training.held_out import Best, Split, Validation
from neusee.workflows.training.process_mesh import Mesh, MeshError
from neusee.workflows.training.recorded_inputs import (
    CAMERA,
    CameraInputs,
    RecordedFile,
    RecordedInputs,
    folder_of,
    prepare_folder,
)
from neusee.workflows.training.resumable_loop import (
    Losses,
    ResumableLoop,
    TrainingSession,
    export,
)
from neusee.workflows.training.training_forecast import IterationTimes
from neusee.workflows.training.training_iteration import Learner, WarmStart
from neusee.workflows.training.training_page import curves, png, strip, write_page
from neusee.workflows.training.training_pictures import PictureSource, require_alone, samples_of

# --- run training ---------------------------------------------------------------------------------

# The training of a mask and of the network that restores the pictures behind it, in two stages.


MASK_FILE = "mask.safetensors"  #: file with the trained or designed mask in a result folder
_COLUMNS = (
    "stage",
    "iteration",
    "LSR",
    "BSR",
    "L1",
    "reconstruction",
    "decibels",
    "adversarial",
    "critics",
    "penalty",
    "slope",
    "rate",
    *held_out.COLUMNS,
    "seconds",
)


def train(recipe: Recipe, session: TrainingSession, stages: Sequence[int] = (1, 2)) -> Path:
    """Train mask and restoration network in stages, or continue a stopped training, and return the
    result folder.

    Stage 0 designs the mask without images and replaces stage 1.

    Every process of `torchrun` calls this function with the same arguments and a folder that all
    processes see; only the first process writes, and an error in one process ends all processes.
    Their number changes results by rounding only.

    Raises ValueError for a recipe without the block ``train``, a folder without photographs, stage
    2 without a mask, stage 1 after the mask was designed, or processes that cannot share it;
    ArithmeticError for a loss that is NaN or infinite, after the weights and picture numbers that
    led to the loss are written to a file.
    """
    settings = recipe.training
    if settings is None:
        raise ValueError(
            f"{recipe.name} has no block `train`: add `train: recommended` to its defaults"
        )
    with_pictures = [number for number in stages if number != MASK]
    _require_fitting_mesh(recipe, settings, stages, session.mesh)
    CameraMismatch.of(recipe, settings)  # raises its mistakes before any work
    if not session.writes:
        session = replace(session, progress=lambda line: None, watch=None)
    begun = BegunTraining.of(recipe, settings, session.store, session.runs, bool(with_pictures))
    folder = begun.folder
    if session.writes:
        prepare_folder(folder, begun.inputs, recipe, session.store, session.progress)
    if MASK in stages:
        design_in(folder, recipe, settings, session)
    if with_pictures:
        loop = _TrainingLoop(recipe, settings, begun, session)
        with loop.board or nullcontext():
            loop.run_stages(with_pictures)
    return folder


@dataclass(frozen=True)
class BegunTraining:
    """The state of a training before its first iteration: photographs, initial weights, inputs and
    folder.
    """

    parts: Split
    start: WarmStart | None
    inputs: RecordedInputs
    folder: Path

    @classmethod
    def of(
        cls, recipe: Recipe, settings: Training, store: Store, runs: Path, pictures: bool = True
    ) -> BegunTraining:
        """Return the inputs of a training, and the result folder with equal inputs, or a
        new one.
        """
        photograph_split = held_out.split(
            recipe, settings, training_photographs(recipe, settings, pictures)
        )
        warm_start = WarmStart.of(recipe, settings)
        code = Code(store.code_memo)
        inputs = inputs_of(recipe, settings, photograph_split, warm_start, code)
        code.save()
        return cls(
            photograph_split, warm_start, inputs, folder_of(runs, f"{recipe.name}_train", inputs)
        )


def _require_fitting_mesh(
    recipe: Recipe, settings: Training, stages: Sequence[int], mesh: Mesh
) -> None:
    """Raise `MeshError` for a training that several processes cannot share."""
    if MASK in stages and mesh.size > 1:
        raise MeshError(
            "--stage mask runs in a single process: start the training without torchrun"
        )
    _require_equal_shares(recipe, settings, mesh)
    require_alone(recipe, mesh)


def _require_equal_shares(recipe: Recipe, settings: Training, mesh: Mesh) -> None:
    """Raise `MeshError` for a batch that cannot be divided equally among the processes."""
    for number, stage in settings.stages.items():
        if stage.batch % mesh.size:
            path = f"{KEY}.stages.{number}.batch"
            setting = recipe.config.settings.get(path)
            raise MeshError(
                f"{setting.source if setting else recipe.name}   {path}   {stage.batch} pictures"
                f" cannot be divided equally among {mesh.size} processes: write a multiple of"
                f" {mesh.size}"
            )


def training_photographs(recipe: Recipe, settings: Training, needed: bool) -> Photographs:
    """Return the photographs of a training: those of its folder, or the single file of the scene
    step.

    Raises ValueError if there is neither and pictures are ``needed``.
    """
    if settings.photographs is not None:
        return Photographs.under(settings.photographs)
    scene_file = (
        recipe.steps[settings.scene].params.get("file") if settings.scene in recipe.steps else None
    )
    if not isinstance(scene_file, Path) and needed:
        raise ValueError("train.photographs is missing: write the path of a folder of photographs")
    return Photographs((scene_file,) if isinstance(scene_file, Path) else ())


class _TrainingLoop(ResumableLoop[Learner]):
    def __init__(
        self,
        recipe: Recipe,
        settings: Training,
        begun: BegunTraining,
        session: TrainingSession,
    ) -> None:
        folder, photograph_split, warm_start = begun.folder, begun.parts, begun.start
        mesh, progress = session.mesh, session.progress
        self.designed = designed(folder)
        learner = Learner(recipe, settings, session.device, self.designed, mesh, warm_start)
        require_exports(learner.net, settings)
        super().__init__(folder, settings, learner, _COLUMNS, session, begun.inputs.digest)
        self.recipe, self.settings, self.mesh = recipe, settings, mesh
        self.split = photograph_split
        self.source = PictureSource(
            photograph_split.trained, session.store, session.device, mesh, photograph_split.judged
        )
        self.validation, self.best = Validation(photograph_split, mesh, session.device), Best()
        self.stage = 2 if self.designed else min(settings.learnt)
        self.start = warm_start
        self.read_again = UnchangedFiles.of(
            [*photograph_split.trained.paths, *photograph_split.judged]
        )
        self.mask_content = ""  #: digest of the mask used in stage 2
        #: None on a GPU, and where several processes share a batch
        self.times = (
            IterationTimes(recipe, settings, session.store)
            if device_kind(session.device) == "cpu" and mesh.size == 1
            else None
        )
        progress(str(photograph_split))
        if settings.augment.pooled != "none":
            progress(
                "pooled pictures are turned with their true pictures, as behind a mask and a sensor"
                " that turn"
            )
        if warm_start is not None and not self.state.path.exists():
            progress(f"begins with the weights of {warm_start.file}")
        self.resume()
        # check that all processes have read the same checkpoint
        mesh.agree(f"{folder.name} in stage {self.stage} after {self.iteration} iterations")
        self.board = (
            open_board(folder, self._iterations_of_all_stages)
            if settings.tensorboard and mesh.first
            else None
        )

    def begin_stage(self) -> None:
        """Create new optimisers for the present stage of the training."""
        self.learner.begin(
            self.settings.stages.get(self.stage, Stage(iterations=0)), self.stage == 1
        )

    def run_stages(self, stages: Sequence[int]) -> None:
        """Run the given stages (1: mask and network, 2: network only), and write the results."""
        if self.designed and 1 in stages:
            raise ValueError(
                f"the mask in {self.folder} was designed without images: continue with --stage 2"
            )
        for number in stages:
            if number not in self.settings.learnt:
                stages_left = self.settings.learnt
                raise ValueError(
                    f"there is no stage {number}: train.stages and train.learn define only"
                    f" {stages_left}"
                )
            if number > self.stage:
                advice = (
                    f"run the {self._length} iterations of stage {self.stage} first, or --stage"
                    " mask"
                )
                raise ValueError(
                    f"stage {number} cannot begin before the end of stage {self.stage}: {advice}"
                )
            if number == self.stage:
                self._run_stage()
        if self.rows.rows and self.writes:
            self._close()

    @property
    def _iterations_of_all_stages(self) -> int:
        """Return the number of iterations so far, including those of earlier stages."""
        return self.iteration + sum(
            s.iterations for number, s in self.settings.stages.items() if number < self.stage
        )

    @property
    def _length(self) -> int:
        """Return the number of iterations of the present stage."""
        return self.settings.stages[self.stage].iterations

    def _run_stage(self) -> None:
        """Train to the end of the present stage, and write the checkpoint from which the next stage
        starts.
        """
        fixed_recipe = None if self.stage == 1 else frozen(self.recipe, self.settings, self.folder)
        if fixed_recipe is not None:
            self._require_same_mask()
        self.samples = samples_of(self.recipe, self.settings, self.source, fixed_recipe)
        self.best = Best.of(self.rows.rows, self.stage)
        self.run(self._length, self.settings.stages[self.stage].batch)
        if counts := self.samples.pool_counts:
            read_count, simulated_count = counts["from_store"], counts["simulated"]
            self.progress(
                f"pictures of the pool: {read_count} came from the cache, {simulated_count}"
                " were simulated"
            )
        if self.writes:
            self._export()
        # the checkpoint written below is the first of the next stage
        self.stage, self.iteration = self.stage + 1, 0
        self.begin_stage()
        if self.stage == 2 and self.writes:
            self._require_same_mask()
        self.keep()
        self.mesh.wait()  # until the first process has written the mask

    def _require_same_mask(self) -> None:
        """Record the digest of the mask used in stage 2; raise ValueError if it differs from that
        of the checkpoint.
        """
        if self.settings.learn is None:
            return
        file = self.folder / MASK_FILE
        content = file_digest(file)
        if self.mask_content not in ("", content):
            text = "has another content than the mask behind which stage 2 began"
            raise ValueError(
                f"{file} {text}: put that mask back, or remove {self.folder} to start again"
            )
        self.mask_content = content

    def facts(self) -> dict[str, Any]:
        """Return further entries for the checkpoint: the digest of the mask used in stage 2."""
        return {"mask": self.mask_content}

    def recall(self, facts: Mapping[str, Any]) -> None:
        """Restore the entries of `facts` from a checkpoint."""
        self.mask_content = str(facts.get("mask", ""))

    def iterate(self) -> Losses:
        """Train on one batch; return the losses and the learning rate relative to its initial
        value.
        """
        rate = self.learner.set_rates(self.iteration)
        began = thread_seconds()
        losses, self.seen = self.learner.iterate(self.samples, self.stage, self.iteration)
        if self.times is not None:
            self.times.add(self.stage, self.iteration, thread_seconds() - began)
        return losses | {"rate": rate}

    def validate(self, iterations: int) -> Losses:
        """Restore the held-out pictures at intervals and at the end of a stage, and write the
        network if it is the best so far.

        No state of stage 1 counts as the best, because the PSNR does not measure laser suppression:
        a flat mask has the best pictures.
        """
        if not self._has_validation(iterations):
            return {}
        network: Any = self.learner.average.module if self.learner.average else self.learner.net
        losses = self.validation(
            network, self.samples, self.learner.shared(self.samples), self.stage == 2
        )
        self.best = self.best.after(held_out.score_of(losses), iterations)
        is_best = self.stage == 2 and self.best.iterations == iterations
        if is_best and self.writes:
            export(
                self.folder, "best", network.stored.state_dict(), file_metadata(self.learner.net)
            )
        self.progress(
            f"stage {self.stage}, iteration {iterations}:"
            f" {held_out.validation_line(losses, is_best)}"
        )
        return losses

    def _has_validation(self, iterations: int) -> bool:
        """Return True if the held-out pictures are restored after so many iterations."""
        is_at_interval = iterations % self.settings.validate_every == 0
        return bool(self.split.judged) and (is_at_interval or iterations == self._length)

    @property
    def validates_next(self) -> bool:
        """Return True if the next iteration ends with a validation."""
        return self._has_validation(self.iteration + 1)

    @property
    def stops_early(self) -> bool:
        """Return True in stage 2 after ``train.patience`` validations without improvement."""
        patience = self.settings.patience
        return self.stage == 2 and patience is not None and self.best.since >= patience

    def note(self, losses: Losses) -> None:
        """Write the losses of the last iteration to TensorBoard, and pass them to the callback
        ``watch``.
        """
        if self.board:
            for name, value in losses.items():
                self.board.add_scalar(name, value, self._iterations_of_all_stages - 1)
        super().note(losses)

    def keep(self) -> None:
        """Write TensorBoard events, loss table and checkpoint of a training to disk.

        Raises ValueError if a photograph has changed, so that a checkpoint always belongs to the
        recorded photographs.
        """
        self.read_again.require()
        if self.board:
            self.board.flush()
        super().keep()
        if self.times is not None:
            self.times.keep()

    def show(self) -> None:
        """Write a PNG file with a picture of the last batch, its restoration and the true picture,
        side by side.
        """
        sample = self.seen[0]
        self.learner.net.eval()
        with torch.no_grad():
            restored = self.learner.net(sample.picture[:1], *sample.given)[0].float()
        self.learner.net.train()
        picture_strip = strip([sample.picture[0].detach(), restored, sample.truth[0]])
        if self.board:
            self.board.add_image(
                f"stage {self.stage}",
                picture_strip,
                self._iterations_of_all_stages - 1,
                dataformats="HWC",
            )
        self.write_picture(f"stage{self.stage}_{self.iteration:06d}", png(picture_strip))

    def _export(self) -> None:
        """Write the network, and after stage 1 the mask.

        The averaged weights are written if there is an average.
        """
        if self.stage == 1:
            with torch.no_grad():
                height, stop = self.learner.height(), self.learner.stop
                size_facts = doe.size_metadata(float(stop.pitch)) if stop is not None else {}
                export(self.folder, "mask", {"height": height}, size_facts)
        network: Any = self.learner.average.module if self.learner.average else self.learner.net
        export(self.folder, "network", network.stored.state_dict(), file_metadata(self.learner.net))

    @property
    def _mask_source(self) -> str:
        """Return the origin of the mask as text."""
        if self.settings.learn is None:
            return "the recipe's own"
        return "designed without images" if self.designed else "learnt in stage 1"

    def _close(self) -> None:
        """Write the exports, the page and the document of the training."""
        rows, loss_curves = self.rows.rows, curves(self.rows.rows)
        facts: dict[str, Any] = {
            "mask": self._mask_source,
            "train": self.settings.model_dump(mode="json"),
            "photographs": len(self.split.trained.paths),
            **held_out.facts(self.split, rows, self.settings.patience),
            "mesh": str(self.mesh),
            **({"start": self.start.facts} if self.start else {}),
            "broken": {str(path): reason for path, reason in self.split.trained.broken.items()},
            "iterations": {
                str(stage): sum(int(r["stage"]) == stage for r in rows)
                for stage in self.settings.stages
            },
            "last": rows[-1],
        }
        write_exports(self.folder, self.learner.net, self.settings)
        write_page(self.folder, self.recipe.name, rows, loss_curves, facts)
        self.close(loss_curves, self.recipe.name, **facts)


def frozen(recipe: Recipe, settings: Training, folder: Path) -> Recipe:
    """Return the recipe with the trained mask from ``mask.safetensors`` as a fixed mask."""
    if settings.learn is None:
        return recipe
    file = folder / MASK_FILE
    if not file.is_file():
        raise ValueError(
            f"{file} does not exist: run --stage 1 or --stage mask first to write this file"
        )
    step = recipe.steps[settings.learn]
    # depth and scale have no effect on a file with heights in m
    params, wires = {"file": file, "depth": 1e-6, "scale": 0.1}, {"stop": step.wires["stop"]}
    learnt = replace(step, node=doe.pixelwise, params=params, wires=wires)
    return replace(recipe, steps={**recipe.steps, settings.learn: learnt})


# --- inputs ---------------------------------------------------------------------------------------

# Photographs, files, code and settings; their digest is part of the folder's name.

#: settings that do not change the weights
_WITHOUT_EFFECT = {"tensorboard", "keep_pool", "export", "keep", "show"}
#: settings that are recorded by the content of what they refer to
_BY_CONTENT = {"photographs", "start", "cameras", "mismatch", "network", "mask"}
_OF_VALIDATION = {"held_out", "held_out_pictures", "validate_every", "patience"}
#: node families that an iteration calls directly
_COMPUTE = ("losses", "metrics", "restore", "doe", "scene", "resampling")
_LOOPS = (
    "training_iteration",
    "training_pictures",
    "camera_mismatch",
    "held_out",
    "resumable_loop",
)  #: program files that determine the pictures and the optimiser steps


def inputs_of(
    recipe: Recipe, settings: Training, parts: Split, start: WarmStart | None, code: Code
) -> RecordedInputs:
    """Return everything that can change a trained network or mask.

    Raises ValueError with place and fix for user code with dependencies that cannot be tracked.
    """
    camera = _cameras(recipe, settings, code)
    design = design_inputs(recipe, settings.design, code) if settings.learn is not None else None
    files = dict(design.files) if design else {}
    if start is not None:
        files[f"{KEY}.start"] = RecordedFile(start.file.name, start.digest)
    return RecordedInputs(
        kind="training",
        recipe=recipe.name,
        settings={
            **camera.settings,
            **_settings(settings, parts),
            **(design.settings if design else {}),
        },
        steps={**camera.steps, **(design.steps if design else {})},
        laws={**camera.laws, **(design.laws if design else {})},
        code={**_code(settings.network, code), **(design.code if design else {})},
        files=files,
        photographs=recorded(parts.trained.paths),
        held_out=recorded(parts.held_out),
    )


def recorded(paths: Sequence[Path]) -> tuple[RecordedFile, ...]:
    """Return names and digests of files; each file is read only once per process."""
    return tuple(map(RecordedFile.of, paths))


def _cameras(recipe: Recipe, settings: Training, code: Code) -> CameraInputs:
    """Return the inputs that come from the camera of a training and from its further cameras."""
    joined = _camera(recipe, settings, code)
    for number, camera in enumerate(recipe.cameras, 2):
        joined = joined.joined(_camera(camera, settings, code).named(f"{CAMERA}{number}: "))
    return joined


def _camera(recipe: Recipe, settings: Training, code: Code) -> CameraInputs:
    """Return the inputs that come from one camera.

    The scene step is excluded, because the training makes the scenes itself; its shape is included.
    """
    read_steps = (settings.picture, settings.truth, settings.psf, settings.light, settings.learn)
    outputs = [name for name in read_steps if name is not None and name in recipe.steps]
    camera = CameraInputs.of(recipe, outputs, code, computed=(settings.scene,))
    scene = recipe.steps.get(settings.scene)
    scene_shape = list(scene.params.get("shape") or ()) if scene else []
    return CameraInputs(
        {**camera.settings, f"{settings.scene}.shape": scene_shape}, camera.steps, camera.laws
    )


def _settings(settings: Training, parts: Split) -> dict[str, Any]:
    """Return the settings of the block by path, except those of files and of the mask design."""
    excluded = _WITHOUT_EFFECT | _BY_CONTENT | (set() if parts.held_out else _OF_VALIDATION)
    train_settings = settings.model_dump(mode="json", exclude=excluded)
    train_settings["network"] = network_settings(settings.network)
    return dict(_flat(train_settings, KEY))


def network_settings(network: Network) -> dict[str, Any]:
    """Return the settings of a network; for a user's class its name and arguments."""
    if network.architecture is None:
        return {"kind": network.kind, "width": network.width, **network.options}
    return {
        "class": str(network.architecture),
        **network.model_dump(include={"parameters", "multiple"}),
    }


def _flat(block: Mapping[str, Any], path: str) -> list[tuple[str, Any]]:
    """Return the leaf values of a nested mapping, each with its path.

    An empty mapping counts as a leaf.
    """
    flat_settings: list[tuple[str, Any]] = []
    for name, value in block.items():
        inner_path = f"{path}.{name}"
        flat_settings += (
            _flat(value, inner_path) if isinstance(value, dict) and value else [(inner_path, value)]
        )
    return flat_settings


def _code(network: Network, code: Code) -> dict[str, str]:
    """Return digests of the code that is in no step of the recipe: losses, networks, and the
    training loop.
    """
    digests = {f"neusee.nodes.{name}": code.digest(f"neusee.nodes.{name}") for name in _COMPUTE}
    folder = Path(__file__).parent
    for name in _LOOPS:
        digests[f"neusee/workflows/training/{name}.py"] = outline(
            (folder / f"{name}.py").read_bytes()
        ).digest
    if network.architecture is not None:
        digests[f"the network {network.architecture}"] = code_of_class(network.architecture, code)
    return digests


def code_of_class(architecture: Architecture, code: Code) -> str:
    """Return the digest of the code of a network class and its imports; raise ValueError for
    dependencies that cannot be tracked.
    """
    network = architecture.network
    try:
        return code.of(network_node, ((network.__module__, network.__qualname__),))
    except LookupError as error:
        raise ValueError(f"{KEY}.network.architecture {architecture}: {error.args[0]}") from error


# --- unchanged files ------------------------------------------------------------------------------

# Files that must not change during a training: its photographs, which are read repeatedly.


@dataclass
class UnchangedFiles:
    """Files with the digests recorded before the first iteration of their training."""

    contents: Mapping[Path, str]
    _stamps: dict[Path, Stamp] = field(default_factory=dict)

    @classmethod
    def of(cls, paths: Iterable[Path]) -> UnchangedFiles:
        """Record the digests of files."""
        return cls({path: file_digest(path) for path in paths})

    def require(self) -> None:
        """Raise ValueError if a file is missing or its content has changed; a new time stamp alone
        is accepted.
        """
        for path, content in self.contents.items():
            try:
                stamp = file_stamps(path)[0]
                # same size and time as at the last check: no need to read the file again
                if self._stamps.get(path) == stamp:
                    continue
                is_same = file_digest(path) == content
            except OSError as error:
                raise ValueError(
                    self._said(path, f"cannot be read any more ({error.strerror})")
                ) from error
            if not is_same:
                raise ValueError(self._said(path, "has another content now"))
            self._stamps[path] = stamp

    @staticmethod
    def _said(path: Path, change: str) -> str:
        """Return the error message: which photograph has changed, and how to continue."""
        return (
            f"the photograph {path} {change}, after this training began with it; the checkpoint"
            " before is kept: put the file back and give the command again to go on, or give the"
            " command as it is to begin anew"
        )


# --- tensorboard log ------------------------------------------------------------------------------

# The TensorBoard log of a training, with its losses and pictures by iteration.


def open_board(folder: Path, first: int) -> Any:
    """Return a TensorBoard writer for a training; older events from iteration ``first`` on are
    hidden.

    Raises ValueError if TensorBoard is not installed.
    """
    try:
        module = importlib.import_module("torch.utils.tensorboard")
    except ImportError as error:
        text = (
            f'TensorBoard is not installed ({error}): pip install -e ".[tensorboard]", or leave'
            " tensorboard false"
        )
        raise ValueError(f"train.tensorboard: {text}") from error
    return module.SummaryWriter(str(folder / "tensorboard"), purge_step=first)


# --- exported files -------------------------------------------------------------------------------

# The trained network as a file for other programs, in addition to its weights.


def require_exports(net: Restorer, settings: Training) -> None:
    """Raise ValueError if the network cannot be exported in the formats of ``train.export``; called
    before the training.
    """
    for kind in settings.export:
        try:
            require_exportable(net, f".{kind}")
        except ParameterError as error:
            raise ValueError(f"{KEY}.export: {error}") from error


def write_exports(folder: Path, net: Restorer, settings: Training) -> None:
    """Export the best network of a training, or the last one if there is no best, in the formats of
    ``train.export``.
    """
    if not settings.export:
        return
    from safetensors.torch import load_file

    name = "best" if (folder / "best.safetensors").is_file() else "network"
    file = folder / f"{name}.safetensors"
    safetensors_need(file, 2.0)
    network = copy.deepcopy(net).cpu().float()
    network.stored.load_state_dict(load_file(file))
    for kind in settings.export:
        export_network(network, folder / f"{name}.{kind}")
