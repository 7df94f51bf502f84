"""The page of a designed mask: height map, figures of merit, and its rival at a peak limit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import losses, metrics
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
from neusee.workflows.report.study_page import Marked, Section
from neusee.workflows.training.mask_design.design_terms import Fabrication, Terms
from neusee.workflows.training.mask_design.mask_optimisers import LearntMask

# --- peak limit -----------------------------------------------------------------------------------

# A designed mask behind a peak limit, against its rival: the best round stop with a grey filter at
# the same limit.


_LIGHTS = (10.0, 30.0, 100.0, 300.0, 1000.0)  #: e- in a pixel, beside that of the design
# the figures are natural logarithms of ratios of powers
_DECIBELS = 10 / math.log(10)
_COLUMNS = (
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
    """Return error and information of a mask behind the peak limit, and those of the best stop, by
    light of the scene.

    The result is empty if the loss has no such term.
    """
    if not terms.settings.weights.protected:
        return {}
    with torch.no_grad():
        psf, exposure = terms.psf(height), terms.exposure()
        # the first state is the nominal one
        peaks = [
            float(metrics.lsr(terms.psf(height, None, state)).max())
            for state, _ in terms.laws.points()
        ]
        peak_limit, highest_peak = exposure["limit"], max(peaks)
        # lowered so that the limit holds in the worst state too
        mask_exposure = {
            **terms.passed(),
            "limit": None if peak_limit is None else peak_limit * peaks[0] / highest_peak,
        }
        lights = sorted({*_LIGHTS, exposure["light"]})
        rows = [_row(terms, psf, {**exposure, "light": light}, mask_exposure) for light in lights]
    # a pupil without a shade has no stop of its own
    stop = 1.0 if terms.shade is None else terms.recipe.steps[terms.shade.step].params["diameter"]
    return {
        "limit": peak_limit,
        "lsr": highest_peak,
        "stop": stop,
        "filter": 1.0 if peak_limit is None else min(1.0, peak_limit / highest_peak),
        "rows": rows,
    }


def _row(terms: Terms, psf: Any, exposure: dict[str, Any], own: dict[str, Any]) -> dict[str, float]:
    """Return error and information of a mask, and of the best stop, at one light of the scene.

    `own` has the parameters of the mask: its transmittance, and a limit lowered by what is
    uncertain.
    """
    light_and_responses, row = terms.seen(), {"light": exposure["light"]}
    for name in ("filtered_error", "information"):
        row[name] = float(getattr(losses, name)(psf, *light_and_responses, **{**exposure, **own}))
        row[f"{name} of the stop"], stop_diameter, filter_transmittance = losses.best_stop(
            terms.plain(), *light_and_responses, **exposure, measure=name
        )
        if name == "filtered_error":
            row |= {"stop": stop_diameter, "filter of the stop": filter_transmittance}
    return row


def section(facts: dict[str, Any]) -> Section:
    """Return the section of the report page that compares a mask with the best stop at the same
    peak limit.
    """
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
    return Section("Behind a peak limit", text, _COLUMNS, table_rows)


def line(facts: dict[str, Any]) -> str:
    """Return the gain of a mask over the best stop by light of the scene as a line of text."""
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
_STYLES = ("-", "--", ":", "-.")  #: line styles, of which the next begins when all colours are used
_NAMES = (
    "lsr",
    "energy_floor",
    "bsr",
    "median_mtf",
    "median_mtf_bound",
    "rms_mtf",
    "rms_mtf_bound",
)


def pictures(terms: Terms, height: Tensor, learnt: LearntMask) -> dict[str, bytes]:
    """Draw the height map, PSF, laser suppression and losses of a designed mask, and return the
    PNG files by name.
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
    return drawings | ({"history": history(learnt.history)} if learnt.history else {})


@drawn
def history(rows: Sequence[Mapping[str, float]]) -> Any:
    """Draw the loss of a mask design and the loss terms over the iterations, with a curve for
    each optimisation.
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
    """Draw a term of the loss of one optimisation over its iterations."""
    style, colour = look
    ax.plot(
        [row["iteration"] for row in rows],
        [row[name] for row in rows],
        linestyle=style,
        color=colour,
        linewidth=1.2,
        label=label,
    )


def sections(
    figures: Mapping[str, Any], limits: Fabrication, shown: Mapping[str, bytes]
) -> list[Section]:
    """Return the sections of the report page of a designed mask: pictures, figures of merit and
    fabrication limits.
    """
    bands = figures["bands"]
    columns = [[1e9 * value for value in bands["wavelength"]], *(bands[name] for name in _NAMES)]
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
        page_sections.insert(1, section(figures["protected"]))
    if "history" in shown:
        text = (
            "The loss is the weighted sum of its terms. Each term is a mean over the bands of an"
            " iteration and has no unit. The term `lsr` is a natural logarithm, and so negative,"
            " unless the recipe sets `log: false`."
        )
        page_sections.append(Section("Learning", text, picture=shown["history"]))
    return page_sections
