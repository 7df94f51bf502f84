"""The design of a mask without training images: the mask spreads laser light and keeps the contrast
of the scene.

The height map is optimised through the graph of the recipe with loss terms that depend on the mask
alone. Then the figures of merit of the mask are computed on every band and at the full sampling of
the recipe.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import losses, metrics
from neusee.nodes.doe import PARAMETRISATIONS, Polynomials, half_rings, size_metadata
from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.graph.diagnostics import RecipeError
from neusee.workflows.graph.final_values import flow
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.code_digest import Code, outline
from neusee.workflows.recipe.blocks.train_block import (
    DesignError,
    MaskTraining,
    Training,
    Weights,
    need_steps,
    state_file,
)
from neusee.workflows.recipe.loading import changed
from neusee.workflows.report.run_crate import write_crate
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.report.study_folder import StudyReport
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.loop.recorded_inputs import (
    CameraInputs,
    RecordedFile,
    RecordedInputs,
)
from neusee.workflows.training.loop.resumable_loop import Progress, StateFile
from neusee.workflows.training.mask_design.design_page import (
    against_stops,
    line,
    pictures,
    sections,
)
from neusee.workflows.training.mask_design.design_terms import Fabrication, Terms, stopped
from neusee.workflows.training.mask_design.mask_optimisers import LearntMask, descend, evolve

__all__ = ["DesignError", "MaskTraining", "Weights", "design", "mask_figures"]

#: files of the program that decide the loss and the steps of the optimisers
_OPTIMISES = (
    "design_terms",
    "mask_optimisers",
    "design_page",
)
MASK = 0  #: the number of the stage that designs the mask, before stage 1
_LEARNT_WITH = {
    callable_object.__module__
    for callable_object in (
        half_rings,
        Polynomials,
        PARAMETRISATIONS["doe.pixelwise"],
        losses.contrast,
        losses.suppression_loss,
        losses.filtered_error,
    )
}


def design(
    recipe: Recipe,
    settings: MaskTraining,
    store: Store | None,
    out: Path,
    progress: Progress,
    *,
    device: str = "cpu",
) -> Path:
    """Design a mask, write the folder ``out/<date>_<recipe>_mask_<key>/``, and return the path of
    this folder.

    ``mask.safetensors`` holds the height map for `doe.pixelwise`, ``history.csv`` the loss terms at
    each iteration, ``mask.json`` the figures of merit, ``provenance.json`` the settings. The state
    of an unfinished design lies beside the folder; the same call continues from this state.

    Raises: `DesignError` if the recipe lacks a step, or the loss is NaN or infinite.
    """
    need_steps(recipe.steps, settings)
    code = Code((store or Store()).code_memo)
    key = design_inputs(recipe, settings, code).digest
    state = StateFile(state_file(out, recipe.name, key))
    mask = DesignedMask.of(recipe, settings, store, state, progress, device)
    with new_run(out, f"{recipe.name}_mask", key) as folder:
        mask.write(folder)
    state.path.unlink(missing_ok=True)
    return folder.path


def designed(folder: Path) -> bool:
    """Return True if the folder of a training contains a complete mask that was designed without
    images.
    """
    return (folder / "mask.json").is_file()


def design_in(
    folder: Path,
    recipe: Recipe,
    training: Training,
    store: Store,
    command: Sequence[str],
    progress: Progress,
    device: str,
) -> None:
    """Design a mask in the folder of a training, or continue a stopped design.

    Raises `DesignError` as `design` does; ValueError if stage 1 has begun to train a mask, or no
    mask is to be trained.
    """
    if training.learn is None:
        raise ValueError(
            "train.learn is missing: write the name of the step whose mask is designed"
        )
    if designed(folder):
        progress("the mask is already designed")
        return
    if (folder / "state.pt").exists():
        raise ValueError(
            f"training stage 1 has begun in {folder}: remove this folder, or change a value of"
            " train.mask"
        )
    state = StateFile(folder / "mask.state")
    files = RunFolder(folder, {"began": timestamp()})
    DesignedMask.of(recipe, training.design, store, state, progress, device).write(files, command)
    state.path.unlink(missing_ok=True)
    write_crate(folder, folder.name, files.said)


@dataclass(frozen=True)
class DesignedMask:
    """A designed mask, with its height map on the pupil grid of the recipe, and its figures of
    merit.
    """

    terms: Terms
    learnt: LearntMask
    height: Tensor
    figures: Mapping[str, Any]

    @classmethod
    def of(
        cls,
        recipe: Recipe,
        settings: MaskTraining,
        store: Store | None,
        state: StateFile,
        progress: Progress,
        device: str,
    ) -> DesignedMask:
        """Optimise a mask, or continue from the checkpoint ``state``, and compute the figures of
        merit of the mask.
        """
        design_terms = Terms(_at(recipe, settings), settings, store, device)
        progress(f"fabrication: {Fabrication.of(recipe, settings)}")
        optimise = evolve if design_terms.settings.kind == "five_half_rings" else descend
        learnt = optimise(design_terms, state, progress)
        full_terms = _full(design_terms, learnt, recipe, settings, store, device)
        with torch.no_grad():
            # on the pupil grid of the recipe itself, not on that of the design
            height = learnt.height(full_terms.stop).detach().to("cpu", torch.float32).contiguous()
            figures = mask_figures(full_terms, height.to(full_terms.device))
        progress(summary_line(figures))
        if learnt.diameter is not None:
            progress(f"learnt stop: {learnt.diameter:.3g} of the diameter of the lens")
        if figures["protected"]:
            progress(line(figures["protected"]))
        return cls(full_terms, learnt, height, figures)

    def write(self, folder: RunFolder, command: Sequence[str] = ()) -> None:
        """Write the files of a designed mask; the last file, ``mask.json``, marks a complete
        design.
        """
        learnt, recipe, settings = self.learnt, self.terms.recipe, self.terms.settings
        provenance = {
            "stage": "mask",
            "recipe": recipe.name,
            **({"command": shlex.join(command)} if command else {}),
            "date": timestamp(),
            "settings": settings.model_dump(mode="json"),
            "versions": versions(),
        }
        folder.said |= provenance
        self._report(tuple(provenance)).write(
            folder, provenance | {"config": recipe.config.to_yaml()}
        )
        document = {
            "recipe": recipe.name,
            "kind": settings.kind,
            "loss": learnt.loss,
            **self.figures,
            **({} if learnt.diameter is None else {"stop": learnt.diameter}),
            "fabrication": self.terms.fabrication.values,
            "numbers": learnt.numbers,
        }
        folder.write("mask.json", json.dumps(document, indent=1))

    def _report(self, shown: Sequence[str]) -> StudyReport:
        """Return page, pictures, tables and files of a designed mask.

        `shown` are the keys of the provenance that the page shows.
        """
        from safetensors.torch import save

        terms, history = self.terms, self.learnt.history
        with torch.no_grad():
            drawings = pictures(terms, self.height.to(terms.device), self.learnt)
        header = list(dict.fromkeys(chain.from_iterable(history)))
        tables = {
            "history.csv": (header, [[row.get(name, "") for name in header] for row in history])
        }
        title, lead = (
            f"{terms.recipe.name}: a mask designed without images",
            summary_line(self.figures),
        )
        page_sections = sections(self.figures, terms.fabrication, drawings)
        size_facts = size_metadata(float(terms.stop.pitch))
        files = {"mask.safetensors": save({"height": self.height}, size_facts)}
        return StudyReport(
            title, f"{terms.settings.kind}: {lead}.", page_sections, drawings, tables, files, shown
        )


def _full(
    learning: Terms,
    learnt: LearntMask,
    recipe: Recipe,
    settings: MaskTraining,
    store: Store | None,
    device: str,
) -> Terms:
    """Return the terms of the recipe itself, with the stop that was learnt."""
    if learnt.diameter is not None and learning.shade is not None:
        recipe = stopped(recipe, learning.shade.step, learnt.diameter)
    return (
        Terms(recipe, settings, store, device)
        if settings.at or learnt.diameter is not None
        else learning
    )


def _at(recipe: Recipe, settings: MaskTraining) -> Recipe:
    """Return the recipe with the parameters that apply only during a mask optimisation, such as
    coarser sampling.
    """
    if not settings.at:
        return recipe
    try:
        return changed(recipe, [f"{name}={flow(value)}" for name, value in settings.at.items()])
    except RecipeError as error:
        raise DesignError(
            f"at: {error.diagnostics[0].path}: {error.diagnostics[0].message}"
        ) from error


def design_inputs(recipe: Recipe, settings: MaskTraining, code: Code) -> RecordedInputs:
    """Return everything that can change a designed mask: steps with their files and code,
    settings and own code.
    """
    colour_steps = (settings.illuminant, settings.responses) if settings.weights.coloured else ()
    read_steps = (settings.psf, settings.plain, settings.height, *colour_steps)
    outputs = [name for name in read_steps if name in recipe.steps]
    camera = CameraInputs.of(recipe, outputs, code)
    if settings.at:
        # values under `at` give the design a second recipe
        camera = camera.joined(
            CameraInputs.of(_at(recipe, settings), outputs, code).named("in the design: ")
        )
    design_settings = settings.model_dump(mode="json", exclude={"save_every", "start", "at"})
    node_digests = {module: code.digest(module) for module in sorted(_LEARNT_WITH)}
    folder = Path(__file__).parent
    program_files = {
        f"neusee/workflows/training/mask_design/{name}.py": folder / f"{name}.py"
        for name in _OPTIMISES
    }
    return RecordedInputs(
        kind="mask",
        recipe=recipe.name,
        settings={
            **camera.settings,
            **{f"train.mask.{name}": value for name, value in design_settings.items()},
        },
        steps=camera.steps,
        laws=camera.laws,
        code={
            **node_digests,
            **{name: outline(file.read_bytes()).digest for name, file in program_files.items()},
        },
        files=(
            {} if settings.start is None else {"train.mask.start": RecordedFile.of(settings.start)}
        ),
    )


def mask_figures(terms: Terms, height: Tensor) -> dict[str, Any]:
    """Return laser suppression, background suppression and contrast of a mask, by spectral band
    and as means.
    """
    with torch.no_grad():
        psf = terms.psf(height)
        lsr, bsr = metrics.lsr(psf), metrics.bsr(psf)
        mtf, limits = metrics.mtf(psf), metrics.limits(psf)
    by_band = {
        "wavelength": terms.bands.centres,
        "lsr": lsr,
        "bsr": bsr,
        "median_mtf": mtf.median,
        "rms_mtf": mtf.rms,
        "energy_floor": limits.floor,
        "rms_all": limits.rms,
        "rms_all_bound": limits.bound,
        "rms_mtf_bound": limits.passed,
        "median_mtf_bound": limits.median,
    }
    plain_values = {name: [float(x) for x in value] for name, value in by_band.items()}
    means = {
        name: float(value.double().mean())
        for name, value in by_band.items()
        if name != "wavelength"
    }
    return {
        "mean": means,
        "bands": plain_values,
        "depth": float(height.amax() - height.amin()),
        "protected": against_stops(terms, height),
    }


def summary_line(figures: Mapping[str, Any]) -> str:
    """Return one line of text with the mean figures of merit of a mask."""
    mean = figures["mean"]
    return (
        f"mean LSR {mean['lsr']:.3g} (even light {mean['energy_floor']:.2g}), BSR"
        f" {mean['bsr']:.3f}, median MTF {mean['median_mtf']:.3g} (at most"
        f" {mean['median_mtf_bound']:.2g}), relief {figures['depth'] * 1e6:.3g} um deep"
    )
