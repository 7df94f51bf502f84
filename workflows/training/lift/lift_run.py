"""The complete training of a network that estimates spectra from RGB, with its figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.code_digest import Code, outline
from neusee.workflows.recipe.blocks.train_block import LiftTraining
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    ORANGE,
    PointLabel,
    canvas,
    drawn,
    encoded,
    picture,
    place_labels,
)
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.lift import lift_iteration
from neusee.workflows.training.lift.lift_iteration import LiftLearner, Pairs
from neusee.workflows.training.loop import resumable_loop
from neusee.workflows.training.loop.recorded_inputs import (
    CameraInputs,
    RecordedInputs,
    folder_of,
    prepare_folder,
)
from neusee.workflows.training.loop.resumable_loop import (
    DOCUMENT,
    Losses,
    Progress,
    ResumableLoop,
    Watch,
    export,
)
from neusee.workflows.training.training_page import running_median

# --- lift figures ---------------------------------------------------------------------------------

# Figures of the training of a network that estimates spectra from RGB: error curves, estimated and
# true spectra.


_SHOWN = ("MRAE", "RMSE", "rate")
_LOOKS = {"mst_plus_plus": {"color": BLUE}, "linear": {"color": ORANGE, "linestyle": "--"}}


@drawn
def lift_curves(rows: Sequence[Mapping[str, str]]) -> Any:
    """Draw each training error and its running median over the iterations of the training."""
    figure, axes = canvas(11.0, 3.0, 1, len(_SHOWN))
    for ax, name in zip(axes.flat, _SHOWN, strict=True):
        values = [float(row[name]) for row in rows]
        ax.plot(values, color=BLUE, alpha=0.25, linewidth=0.7)
        ax.plot(running_median(values), color=BLUE, linewidth=1.5)
        ax.set_yscale("log", nonpositive="mask")
        ax.set_title(name)
    figure.supxlabel("iteration")
    return figure


@drawn
def lifted_spectra(
    shown: Tensor, truth: Tensor, estimates: Mapping[str, Tensor], centres: Tensor
) -> Any:
    """Draw a picture, and the true spectra (black) and the estimated spectra of five pixels of
    the picture.
    """
    figure, axes = canvas(13.0, 2.6, 1, 6)
    y, x = shown.shape[-2:]
    # five pixels at the heights 1/10, 3/10 ... 9/10, at widths in another order
    pixels = [(y * (2 * i + 1) // 10, x * (2 * ((3 * i) % 5) + 1) // 10) for i in range(5)]
    picture(axes[0, 0], encoded(shown), "picture")
    axes[0, 0].plot(
        # a picture has its columns along x
        [c for _, c in pixels],
        [r for r, _ in pixels],
        "o",
        color=BLACK,
        markerfacecolor="white",
        markersize=5,
    )
    wavelengths_nm = (centres * 1e9).cpu().numpy()
    for number, (ax, (row, column)) in enumerate(zip(axes[0, 1:], pixels, strict=True), 1):
        ax.plot(
            wavelengths_nm,
            truth[:, row, column].cpu().numpy(),
            color=BLACK,
            linewidth=1.5,
            label="truth",
        )
        for name, cube in estimates.items():
            ax.plot(
                wavelengths_nm,
                cube[:, row, column].cpu().numpy(),
                linewidth=1.2,
                label=name,
                **_LOOKS[name],
            )
        ax.set_title(f"pixel {number}")
        ax.set_ylim(bottom=0)
    axes[0, 1].set_ylabel("reflectance")
    figure.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    figure.supxlabel("wavelength (nm)")
    place_labels(
        figure,
        {axes[0, 0]: [PointLabel(c, r, str(i), BLACK) for i, (r, c) in enumerate(pixels, 1)]},
    )
    return figure


# --- lift run -------------------------------------------------------------------------------------

# The complete training of a network that estimates spectra from RGB, up to the file of its weights.


_COLUMNS = ("iteration", "MRAE", "RMSE", "slope", "rate", "seconds")
#: files of the program that decide the pairs and the steps of the optimiser
_PROGRAM = {
    "neusee/workflows/training/lift/lift_iteration.py": lift_iteration.__file__,
    "neusee/workflows/training/loop/resumable_loop.py": resumable_loop.__file__,
}


def train_lift(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    progress: Progress,
    device: str = "cpu",
    watch: Watch | None = None,
) -> Path:
    """Train the network MST++ to estimate spectra from RGB, or continue a stopped training; return
    the result folder.

    ``mst_plus_plus.safetensors`` holds the weights for `spectra.lift_mst_plus_plus`.

    Raises ValueError for a recipe without the block or the steps that the block names;
    ArithmeticError for a loss that is NaN or infinite, after the weights and picture numbers that
    led to the loss are written to a file.
    """
    settings = recipe.lifting
    if settings is None:
        raise ValueError(
            f"{recipe.name} has no block `train_lift`: start from the recipe train_lift"
        )
    pairs = Pairs(recipe, settings, store, device)
    code = Code(store.code_memo)
    inputs = lift_inputs(recipe, settings, code)
    code.save()
    folder = folder_of(runs, recipe.name, inputs)
    prepare_folder(folder, inputs, recipe, store, progress)
    learner = LiftLearner(settings, pairs, recipe.seed, device)
    _LiftLoop(settings, learner, inputs, folder, progress, device, watch).run_to_end(
        recipe, command
    )
    return folder


def lift_inputs(recipe: Recipe, settings: LiftTraining, code: Code) -> RecordedInputs:
    """Return everything that can change the trained weights."""
    camera = CameraInputs.of(recipe, [settings.measured, settings.picture, settings.cube], code)
    lift_settings = settings.model_dump(mode="json", exclude={"keep", "show", "validation_batches"})
    node_digests = {
        f"neusee.nodes.{name}": code.digest(f"neusee.nodes.{name}")
        for name in ("losses", "spectra")
    }
    program_files = {name: Path(file).read_bytes() for name, file in _PROGRAM.items()}
    return RecordedInputs(
        kind="lift",
        recipe=recipe.name,
        settings={
            **camera.settings,
            **{f"train_lift.{name}": value for name, value in lift_settings.items()},
        },
        steps=camera.steps,
        laws=camera.laws,
        code={
            **node_digests,
            **{name: outline(source).digest for name, source in program_files.items()},
        },
    )


class _LiftLoop(ResumableLoop[LiftLearner]):
    def __init__(
        self,
        settings: LiftTraining,
        learner: LiftLearner,
        inputs: RecordedInputs,
        folder: Path,
        progress: Progress,
        device: str,
        watch: Watch | None,
    ) -> None:
        super().__init__(
            folder, settings, learner, _COLUMNS, progress, device, watch, inputs=inputs.digest
        )
        self.settings = settings
        self.resume()

    def run_to_end(self, recipe: Recipe, command: Sequence[str]) -> None:
        """Train the network to the last iteration, and write the results; do nothing if the
        training is finished.
        """
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
            f"{self.iteration:06d}",
            lifted_spectra(picture, cube, self.learner.estimates(picture), centres),
        )
