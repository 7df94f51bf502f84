"""The complete training of a network that estimates spectra from RGB, with its figures:
training data, one iteration, and the run up to the file of weights.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from neusee.nodes import losses
from neusee.nodes.spectra import (
    lift_matrix,
    lift_pictures,
    need_mst_plus_plus_bands,
    render,
    start_mst_plus_plus,
)
from neusee.nodes.values import Bands
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import stream_seed
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
from neusee.workflows.training import resumable_loop
from neusee.workflows.training.recorded_inputs import (
    CameraInputs,
    RecordedInputs,
    folder_of,
    prepare_folder,
)
from neusee.workflows.training.resumable_loop import (
    DOCUMENT,
    Losses,
    ResumableLoop,
    TrainingSession,
    averaged,
    export,
    require_finite,
)
from neusee.workflows.training.training_page import running_median
from neusee.workflows.training.training_pictures import require_steps


class Pairs:
    """Numbered training pairs of an RGB picture (3, y, x) and the true spectra of its pixels (31,
    y, x).
    """

    def __init__(self, recipe: Recipe, settings: LiftTraining, store: Store, device: str) -> None:
        require_steps(recipe, "train_lift", (settings.measured, settings.picture, settings.cube))
        bands = recipe.steps[settings.measured].wires.get("bands")
        if not isinstance(bands, str):
            name = settings.measured
            raise ValueError(
                f"train_lift.measured: {name} has no input `bands`: name a spectra.reflectances"
                " step"
            )
        self._names, self._seed = (settings.picture, settings.cube), recipe.seed
        random_steps = {
            name for name in needed(recipe, self._names) if recipe.steps[name].node.random
        }
        if not random_steps:
            raise ValueError(
                f"train_lift: step {settings.picture} gives no random pictures: use a"
                " spectra.leaves step"
            )
        results = run(recipe, store, [bands, settings.measured], device=device)
        self.bands: Bands = results[bands]
        self.measured: Tensor = results[settings.measured]
        need_mst_plus_plus_bands(self.bands)
        self._draw = as_function(
            recipe, outputs=self._names, store=store, device=device, redraw=random_steps
        )

    def __call__(self, *number: object) -> tuple[Tensor, Tensor]:
        """Return the training picture with the given number, and the true spectra of its pixels.

        The same number always gives the same picture.
        """
        values = self._draw({}, seed=stream_seed(self._seed, " ".join(map(str, ("lift", *number)))))
        picture, cube = (values[name] for name in self._names)
        return picture.float(), cube.float()

    def batch(self, numbers: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return a batch of training pictures and of their true spectra, each as one tensor."""
        pictures, cubes = zip(*map(self, numbers), strict=True)
        return torch.stack(pictures), torch.stack(cubes)


class LiftLearner:
    """The network that estimates spectra from RGB, with its optimiser and the moving average of its
    weights.
    """

    def __init__(self, settings: LiftTraining, pairs: Pairs, seed: int, device: str) -> None:
        self.settings, self.pairs = settings, pairs
        rng = torch.Generator(device).manual_seed(stream_seed(seed, "train lift network"))
        self.linear = lift_matrix(pairs.measured.cpu(), pairs.bands.centres.cpu()).to(
            device, torch.float32
        )
        self.net = start_mst_plus_plus(rng, self.linear if settings.start == "linear" else None)
        self.optimiser = torch.optim.Adam(
            self.net.parameters(), lr=settings.rate, betas=settings.betas
        )
        self.average = averaged(self.net, settings.ema_decay)
        self.best: nn.Module = self.average.module if self.average else self.net

    def parts(self) -> dict[str, Any]:
        """Return the objects whose state a checkpoint must contain, by name."""
        members = {"net": self.net, "optimiser": self.optimiser, "average": self.average}
        return {name: member for name, member in members.items() if member}

    def iterate(self, iteration: int) -> Losses:
        """Train the network on one batch of pictures, and return the losses.

        Raises `NotFinite` if a loss or the gradient is NaN or infinite.
        """
        batch, rate = self.settings.batch, self.settings.rate_at(iteration)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad(set_to_none=True)
        # each iteration has new pictures, numbered consecutively
        picture, cube = self.pairs.batch(range(iteration * batch, (iteration + 1) * batch))
        estimate = lift_pictures(self.net, picture)
        loss = losses.mrae(estimate, cube, floor=self.settings.floor)
        loss.backward()
        norm_limit = math.inf if self.settings.clip is None else self.settings.clip
        gradient_norm = float(nn.utils.clip_grad_norm_(self.net.parameters(), norm_limit))
        numbers = {
            "MRAE": float(loss.detach()),
            "RMSE": _rmse(estimate.detach(), cube),
            "slope": gradient_norm,
            "rate": rate,
        }
        require_finite(numbers)
        self.optimiser.step()
        if self.average:
            self.average.update_parameters(self.net)
        return numbers

    @torch.no_grad()
    def validate(self) -> dict[str, Losses]:
        """Return the mean errors of the network and of a linear estimate on pictures outside the
        training.
        """
        means, picture_count = dict[str, Losses](), self.settings.validation_batches
        for number in range(picture_count):
            picture, cube = self.pairs("judge", number)
            for name, estimate in self.estimates(picture).items():
                errors = {
                    "MRAE": float(losses.mrae(estimate, cube, floor=self.settings.floor)),
                    "RMSE": _rmse(estimate, cube),
                    "colour": _rmse(render(estimate, self.pairs.bands), picture),
                }
                means[name] = {
                    key: means.get(name, {}).get(key, 0.0) + x / picture_count
                    for key, x in errors.items()
                }
        return means

    def estimates(self, picture: Tensor) -> dict[str, Tensor]:
        """Return the spectra of an RGB picture, estimated by the network and by a linear
        reconstruction.
        """
        linear = torch.einsum("bc,cyx->byx", self.linear, picture)
        return {
            "mst_plus_plus": lift_pictures(self.best, picture[None])[0].clamp_min(0),
            "linear": linear.clamp_min(0),
        }


def _rmse(estimate: Tensor, truth: Tensor) -> float:
    return float((estimate - truth).square().mean().sqrt())


# --- lift figures ---------------------------------------------------------------------------------

# Figures of the training of a network that estimates spectra from RGB: error curves, and estimated
# and true spectra.


_SHOWN = ("MRAE", "RMSE", "rate")
_LINE_LOOKS = {"mst_plus_plus": {"color": BLUE}, "linear": {"color": ORANGE, "linestyle": "--"}}


@drawn
def lift_curves(rows: Sequence[Mapping[str, str]]) -> Any:
    """Draw each training error and its running median against the iterations."""
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
    """Draw a picture, and the true (black) and estimated spectra of five of its pixels."""
    figure, axes = canvas(13.0, 2.6, 1, 6)
    y, x = shown.shape[-2:]
    # five pixels at the heights 1/10, 3/10 ... 9/10, and at the same fractions of the width in
    # another order
    pixels = [(y * (2 * i + 1) // 10, x * (2 * ((3 * i) % 5) + 1) // 10) for i in range(5)]
    picture(axes[0, 0], encoded(shown), "picture")
    axes[0, 0].plot(
        # x is the column
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
                **_LINE_LOOKS[name],
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
#: program files that determine the pairs and the optimiser steps
_PROGRAM_FILES = {
    "neusee/workflows/training/lift_training.py": __file__,
    "neusee/workflows/training/resumable_loop.py": resumable_loop.__file__,
}


def train_lift(recipe: Recipe, session: TrainingSession) -> Path:
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
    pairs = Pairs(recipe, settings, session.store, session.device)
    code = Code(session.store.code_memo)
    inputs = lift_inputs(recipe, settings, code)
    code.save()
    folder = folder_of(session.runs, recipe.name, inputs)
    prepare_folder(folder, inputs, recipe, session.store, session.progress)
    learner = LiftLearner(settings, pairs, recipe.seed, session.device)
    _LiftLoop(settings, learner, inputs, folder, session).run_to_end(recipe)
    return folder


def lift_inputs(recipe: Recipe, settings: LiftTraining, code: Code) -> RecordedInputs:
    """Return everything that can change the trained weights."""
    camera = CameraInputs.of(recipe, [settings.measured, settings.picture, settings.cube], code)
    lift_settings = settings.model_dump(mode="json", exclude={"keep", "show", "validation_batches"})
    node_digests = {
        f"neusee.nodes.{name}": code.digest(f"neusee.nodes.{name}")
        for name in ("losses", "spectra")
    }
    program_files = {name: Path(file).read_bytes() for name, file in _PROGRAM_FILES.items()}
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
        session: TrainingSession,
    ) -> None:
        super().__init__(folder, settings, learner, _COLUMNS, session, inputs.digest)
        self.settings = settings
        self.resume()

    def run_to_end(self, recipe: Recipe) -> None:
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
