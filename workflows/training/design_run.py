"""The design of a mask without training images, and its page.

The mask spreads laser light and keeps the contrast of the scene. The height map is optimised
through the graph of the recipe with loss terms that depend on the mask alone. Then the figures of
merit of the mask are computed on every band and at the full sampling of the recipe. The page shows
the height map, these figures, and the rival of the mask at a peak limit.
"""

from __future__ import annotations

import itertools
import json
import math
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
from neusee.workflows.graph.errors import RecipeError
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
from neusee.workflows.report.figures import optics
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    canvas,
    drawn,
)
from neusee.workflows.report.run_crate import write_crate
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.report.study_report import Marked, Section, StudyReport
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.design_terms import Fabrication, Terms, stopped
from neusee.workflows.training.mask_optimisers import LearntMask, descend, evolve
from neusee.workflows.training.recorded_inputs import (
    CameraInputs,
    RecordedFile,
    RecordedInputs,
)
from neusee.workflows.training.resumable_loop import Progress, StateFile, TrainingSession

__all__ = ["DesignError", "MaskTraining", "Weights", "design", "mask_figures"]

#: program files that determine the loss and the optimiser steps
_PROGRAM_FILES = (
    "design_terms",
    "mask_optimisers",
    "design_run",
)
MASK = 0  #: number of the stage that designs the mask, before stage 1
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


def design_in(folder: Path, recipe: Recipe, training: Training, session: TrainingSession) -> None:
    """Design a mask in the folder of a training, or continue a stopped design.

    Raises `DesignError` as `design` does; ValueError if stage 1 has begun to train a mask, or no
    mask is to be trained.
    """
    if training.learn is None:
        raise ValueError(
            "train.learn is missing: write the name of the step whose mask is designed"
        )
    if designed(folder):
        session.progress("the mask is already designed")
        return
    if (folder / "state.pt").exists():
        raise ValueError(
            f"training stage 1 has begun in {folder}: remove this folder, or change a value of"
            " train.mask"
        )
    state = StateFile(folder / "mask.state")
    files = RunFolder(folder, {"began": timestamp()})
    mask = DesignedMask.of(
        recipe, training.design, session.store, state, session.progress, session.device
    )
    mask.write(files, session.command)
    state.path.unlink(missing_ok=True)
    write_crate(folder, folder.name, files.said)


@dataclass(frozen=True)
class DesignedMask:
    """A designed mask, with its height map on the pupil grid of the recipe and its figures of
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
        """Optimise a mask, or continue from the checkpoint ``state``, and compute its figures of
        merit.
        """
        design_terms = Terms(_during_design(recipe, settings), settings, store, device)
        progress(f"fabrication: {Fabrication.of(recipe, settings)}")
        optimise = evolve if design_terms.settings.kind == "five_half_rings" else descend
        learnt = optimise(design_terms, state, progress)
        full_terms = _full(design_terms, learnt, recipe, settings, store, device)
        with torch.no_grad():
            # on the pupil grid of the recipe, which may differ from that of the design
            height = learnt.height(full_terms.stop).detach().to("cpu", torch.float32).contiguous()
            figures = mask_figures(full_terms, height.to(full_terms.device))
        progress(summary_line(figures))
        if learnt.diameter is not None:
            progress(f"learnt stop: {learnt.diameter:.3g} of the diameter of the lens")
        if figures["protected"]:
            progress(stop_line(figures["protected"]))
        return cls(full_terms, learnt, height, figures)

    def write(self, folder: RunFolder, command: Sequence[str] = ()) -> None:
        """Write the files of a designed mask; the last one, ``mask.json``, marks a
        complete design.
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

        ``shown`` are the keys of the provenance that appear on the page.
        """
        from safetensors.torch import save

        terms, history = self.terms, self.learnt.history
        with torch.no_grad():
            drawings = design_pictures(terms, self.height.to(terms.device), self.learnt)
        header = list(dict.fromkeys(chain.from_iterable(history)))
        tables = {
            "history.csv": (header, [[row.get(name, "") for name in header] for row in history])
        }
        title, lead = (
            f"{terms.recipe.name}: a mask designed without images",
            summary_line(self.figures),
        )
        page_sections = design_sections(self.figures, terms.fabrication, drawings)
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
    """Return the terms for the recipe itself, with the learnt stop."""
    if learnt.diameter is not None and learning.shade is not None:
        recipe = stopped(recipe, learning.shade.step, learnt.diameter)
    return (
        Terms(recipe, settings, store, device)
        if settings.at or learnt.diameter is not None
        else learning
    )


def _during_design(recipe: Recipe, settings: MaskTraining) -> Recipe:
    """Return the recipe with the parameters that apply only during a mask design, such as coarser
    sampling.
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
    """Return everything that determines a designed mask: steps with their files and code, settings,
    and program code.
    """
    colour_steps = (settings.illuminant, settings.responses) if settings.weights.coloured else ()
    read_steps = (settings.psf, settings.plain, settings.height, *colour_steps)
    outputs = [name for name in read_steps if name in recipe.steps]
    camera = CameraInputs.of(recipe, outputs, code)
    if settings.at:
        # values in `at` define a second recipe for the design
        camera = camera.joined(
            CameraInputs.of(_during_design(recipe, settings), outputs, code).named(
                "in the design: "
            )
        )
    design_settings = settings.model_dump(mode="json", exclude={"save_every", "start", "at"})
    node_digests = {module: code.digest(module) for module in sorted(_LEARNT_WITH)}
    folder = Path(__file__).parent
    program_files = {
        f"neusee/workflows/training/{name}.py": folder / f"{name}.py" for name in _PROGRAM_FILES
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


# --- peak limit -----------------------------------------------------------------------------------

# A designed mask under a peak limit, compared with the best round stop with a grey filter under the
# same limit.


#: e- per pixel, in addition to the light of the design
_SCENE_LIGHTS = (10.0, 30.0, 100.0, 300.0, 1000.0)
# dB per unit of the natural logarithm of a power ratio
_DECIBELS = 10 / math.log(10)
_STOP_COLUMNS = (
    "light (e-)",
    "error, mask (dB)",
    "error, stop (dB)",
    "gain (dB)",
    "stop",
    "its filter",
    "bits, mask",
    "bits, stop",
    "more bits",
)


def against_stops(terms: Terms, height: Tensor) -> dict[str, Any]:
    """Return error and information of a mask under the peak limit and of the best stop, by scene
    light.

    The result is empty if the loss does not use a peak limit.
    """
    if not terms.settings.weights.protected:
        return {}
    with torch.no_grad():
        psf, exposure = terms.psf(height), terms.exposure()
        # peaks in all states; the first state is nominal
        peaks = [
            float(metrics.lsr(terms.psf(height, None, state)).max())
            for state, _ in terms.laws.points()
        ]
        peak_limit, highest_peak = exposure["limit"], max(peaks)
        # lower limit, so that the peak stays below the limit in the worst state too
        mask_exposure = {
            **terms.passed(),
            "limit": None if peak_limit is None else peak_limit * peaks[0] / highest_peak,
        }
        lights = sorted({*_SCENE_LIGHTS, exposure["light"]})
        rows = [
            _against_best_stop(terms, psf, {**exposure, "light": light}, mask_exposure)
            for light in lights
        ]
    # without a shade, the stop is the lens itself
    stop = 1.0 if terms.shade is None else terms.recipe.steps[terms.shade.step].params["diameter"]
    return {
        "limit": peak_limit,
        "lsr": highest_peak,
        "stop": stop,
        "filter": 1.0 if peak_limit is None else min(1.0, peak_limit / highest_peak),
        "rows": rows,
    }


def _against_best_stop(
    terms: Terms, psf: Any, exposure: dict[str, Any], own: dict[str, Any]
) -> dict[str, float]:
    """Return error and information of a mask, and of the best stop, at one scene light.

    ``own`` has the parameters of the mask: its transmittance, and the limit lowered for the
    uncertainties.
    """
    light_and_responses, row = terms.seen(), {"light": exposure["light"]}
    for name in ("filtered_error", "information"):
        row[name] = float(getattr(losses, name)(psf, *light_and_responses, **{**exposure, **own}))
        row[f"{name} of the stop"], stop_diameter, filter_transmittance = losses.best_stop(
            terms.plain(), *light_and_responses, losses.ProtectedPicture(**exposure), measure=name
        )
        if name == "filtered_error":
            row |= {"stop": stop_diameter, "filter of the stop": filter_transmittance}
    return row


def stop_section(facts: dict[str, Any]) -> Section:
    """Return the section that compares a mask with the best stop under the same peak limit."""
    limit = (
        "no peak limit"
        if facts["limit"] is None
        else f"a peak of at most {facts['limit']:.3g} of the clear lens"
    )
    text = f"""Error of the Wiener-filtered picture of a natural scene over its variance, and
        information per frequency, both for {limit}. The mask has an LSR of {facts["lsr"]:.3g} in
        its worst band and in the worst state of what is uncertain, a stop of {facts["stop"]:.3g}
        and a grey filter of {facts["filter"]:.3g}. The rival is the round stop, as a share of the
        aperture, with the grey filter that has the least error at the same limit. A gain above 0 is
        in favour of the mask. Unknown glare and clipping are neglected."""
    table_rows = []
    for row in facts["rows"]:
        mask_decibels, stop_decibels = (
            _DECIBELS * row["filtered_error"],
            _DECIBELS * row["filtered_error of the stop"],
        )
        # `losses.information` is a loss: the negative of the bits
        mask_bits, stop_bits = -row["information"], -row["information of the stop"]
        gain = Marked(
            stop_decibels - mask_decibels, "pass" if mask_decibels < stop_decibels else "fail"
        )
        more_bits = Marked(mask_bits - stop_bits, "pass" if mask_bits > stop_bits else "fail")
        last_cells = (row["stop"], row["filter of the stop"], mask_bits, stop_bits, more_bits)
        table_rows.append((row["light"], mask_decibels, stop_decibels, gain, *last_cells))
    return Section("Behind a peak limit", text, _STOP_COLUMNS, table_rows)


def stop_line(facts: dict[str, Any]) -> str:
    """Return a line of text with the gain of a mask over the best stop, by scene light."""
    gains = ", ".join(
        f"{_DECIBELS * (row['filtered_error of the stop'] - row['filtered_error']):+.2f} dB at"
        f" {row['light']:g} e-"
        for row in facts["rows"]
    )
    return f"filtered error against the best stop and filter: {gains}"


# --- design page ----------------------------------------------------------------------------------

# The report page of a designed mask: height map, figures of merit by wavelength, and losses by
# iteration.


_DESIGN_COLUMNS = (
    "nm",
    "LSR",
    "even light",
    "BSR",
    "median MTF",
    "at most",
    "rms MTF",
    "at most",
)
_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, BLACK, "#CC79A7", "#56B4E9", "#777777")
_STYLES = ("-", "--", ":", "-.")  #: line styles; the next one is used once all colours are used
_TERM_NAMES = (
    "lsr",
    "energy_floor",
    "bsr",
    "median_mtf",
    "median_mtf_bound",
    "rms_mtf",
    "rms_mtf_bound",
)


def design_pictures(terms: Terms, height: Tensor, learnt: LearntMask) -> dict[str, bytes]:
    """Return the pictures of a designed mask by name, as PNG bytes: height map, PSF, suppression
    and losses.
    """
    pupil, psf, plain = terms.pupil(height), terms.psf(height), terms.plain()
    pitch = terms.recipe.steps[terms.settings.psf].params["pixel_pitch"]
    bsr = metrics.bsr(psf)
    drawings = {
        "height": optics.height(pupil=pupil),
        "psf": optics.psf(plain=plain, mask=psf, bands=terms.bands, pixel_pitch=pitch),
        "suppression": optics.suppression(
            lsr=metrics.lsr(psf), bands=terms.bands, psf=psf, bsr=bsr
        ),
    }
    return drawings | ({"history": history_figure(learnt.history)} if learnt.history else {})


@drawn
def history_figure(rows: Sequence[Mapping[str, float]]) -> Any:
    """Draw the loss of a mask design and its terms against the iterations, with a curve for each
    start.
    """
    columns = dict.fromkeys(itertools.chain.from_iterable(rows))
    names = [name for name in columns if name not in ("start", "iteration")]
    figure, axes = canvas(3.6 * max(len(names), 2), 3.2, 1, len(names))
    starts = sorted({row["start"] for row in rows})
    line_styles = dict(
        zip(starts, itertools.cycle(itertools.product(_STYLES, _COLOURS)), strict=False)
    )
    for ax, name in zip(axes[0], names, strict=True):
        for start in starts:
            rows_of_start = [row for row in rows if row["start"] == start]
            _draw_term(ax, rows_of_start, name, line_styles[start], f"{start:g}")
        ax.set_title(name)
        ax.set_xlabel("iteration")
        ax.ticklabel_format(axis="y", useOffset=False)
    if len(starts) > 1:
        figure.legend(
            *axes[0, 0].get_legend_handles_labels(), title="start", loc="outside right upper"
        )
    return figure


def _draw_term(
    ax: Any, rows: Sequence[Mapping[str, float]], name: str, look: tuple[str, str], label: str
) -> None:
    """Draw one loss term of one optimisation against its iterations."""
    style, colour = look
    ax.plot(
        [row["iteration"] for row in rows],
        [row[name] for row in rows],
        linestyle=style,
        color=colour,
        linewidth=1.2,
        label=label,
    )


def design_sections(
    figures: Mapping[str, Any], limits: Fabrication, shown: Mapping[str, bytes]
) -> list[Section]:
    """Return the sections of a designed mask's page: pictures, figures of merit and fabrication
    limits.
    """
    bands = figures["bands"]
    columns = [
        [1e9 * value for value in bands["wavelength"]],
        *(bands[name] for name in _TERM_NAMES),
    ]
    bounds = (
        "`even light` is the LSR of light that is spread evenly over the window of the PSF. The sum"
        " of the squares of a PSF equals the sum of the squares of its contrast (Parseval), so that"
        " a low peak leaves little contrast: no PSF with this peak has more contrast than `at"
        " most`."
    )
    page_sections = [
        Section(
            "Mask",
            "The height map, and the phase at three wavelengths.",
            picture=shown.get("height"),
        ),
        Section("Fabrication", f"{limits}.", ("limit", "value"), limits.rows()),
        Section(
            "Light",
            "The PSF with the mask beside the PSF of the plain lens.",
            picture=shown.get("psf"),
        ),
        Section("Suppression", "", picture=shown.get("suppression")),
        Section("By wavelength", bounds, _DESIGN_COLUMNS, list(zip(*columns, strict=True))),
    ]
    if figures["protected"]:
        page_sections.insert(1, stop_section(figures["protected"]))
    if "history" in shown:
        text = (
            "The loss is the weighted sum of its terms. Each term is a mean over the bands of an"
            " iteration and has no unit. The term `lsr` is a natural logarithm, and so negative,"
            " unless the recipe sets `log: false`."
        )
        page_sections.append(Section("Learning", text, picture=shown["history"]))
    return page_sections
