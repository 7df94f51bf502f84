"""The report page of a designed mask: height map, figures of merit by wavelength, and losses by iteration."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from neusee.nodes import metrics
from neusee.workflows.report.figures import optics
from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn
from neusee.workflows.report.study_page import Section
from neusee.workflows.training.mask_design.design_terms import Fabrication, Terms
from neusee.workflows.training.mask_design.learnt_mask import LearntMask
from neusee.workflows.training.mask_design.peak_limit import section

_COLUMNS = ("nm", "LSR", "even light", "BSR", "median MTF", "at most", "rms MTF", "at most")
_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, BLACK, "#CC79A7", "#56B4E9", "#777777")
_STYLES = ("-", "--", ":", "-.")  #: line styles, of which the next begins when all colours are used
_NAMES = ("lsr", "energy_floor", "bsr", "median_mtf", "median_mtf_bound", "rms_mtf", "rms_mtf_bound")


def pictures(terms: Terms, height: Tensor, learnt: LearntMask) -> dict[str, bytes]:
    """Draw the height map, PSF, laser suppression and losses of a designed mask, and return the PNG files by name."""
    pupil, psf, plain = terms.pupil(height), terms.psf(height), terms.plain()
    pitch = terms.recipe.steps[terms.settings.psf].params["pixel_pitch"]
    bsr = metrics.bsr(psf)
    drawings = {
        "height": optics.height(pupil=pupil),
        "psf": optics.psf(plain=plain, mask=psf, bands=terms.bands, pixel_pitch=pitch),
        "suppression": optics.suppression(lsr=metrics.lsr(psf), bands=terms.bands, psf=psf, bsr=bsr),
    }
    return drawings | ({"history": history(learnt.history)} if learnt.history else {})


@drawn
def history(rows: Sequence[Mapping[str, float]]) -> Any:
    """Draw the loss of a mask design and the loss terms over the iterations, with a curve for each optimisation."""
    names = [name for name in dict.fromkeys(n for row in rows for n in row) if name not in ("start", "iteration")]
    figure, axes = canvas(3.6 * max(len(names), 2), 3.2, 1, len(names))
    starts = sorted({row["start"] for row in rows})
    looks = dict(zip(starts, itertools.cycle(itertools.product(_STYLES, _COLOURS)), strict=False))
    for ax, name in zip(axes[0], names, strict=True):
        for start in starts:
            own = [row for row in rows if row["start"] == start]
            style, colour = looks[start]
            look = {"linestyle": style, "color": colour, "linewidth": 1.2, "label": f"{start:g}"}
            ax.plot([row["iteration"] for row in own], [row[name] for row in own], **look)
        ax.set_title(name)
        ax.set_xlabel("iteration")
        ax.ticklabel_format(axis="y", useOffset=False)
    if len(starts) > 1:
        figure.legend(*axes[0, 0].get_legend_handles_labels(), title="start", loc="outside right upper")
    return figure


def sections(figures: Mapping[str, Any], limits: Fabrication, shown: Mapping[str, bytes]) -> list[Section]:
    """Return the sections of the report page of a designed mask: pictures, figures of merit and fabrication limits."""
    bands = figures["bands"]
    columns = [[1e9 * value for value in bands["wavelength"]], *(bands[name] for name in _NAMES)]
    bounds = (
        "`even light` is the LSR of light that is spread evenly over the window of the PSF. "
        "The sum of the squares of a PSF equals the sum of the squares of its contrast (Parseval), so that a low peak "
        "leaves little contrast: no PSF with this peak has more contrast than `at most`."
    )
    parts = [
        Section("Mask", "The height map, and the phase at three wavelengths.", picture=shown.get("height")),
        Section("Fabrication", f"{limits}.", ("limit", "value"), limits.rows()),
        Section("Light", "The PSF with the mask beside the PSF of the plain lens.", picture=shown.get("psf")),
        Section("Suppression", "", picture=shown.get("suppression")),
        Section("By wavelength", bounds, _COLUMNS, list(zip(*columns, strict=True))),
    ]
    if figures["protected"]:
        parts.insert(1, section(figures["protected"]))
    if "history" in shown:
        text = (
            "The loss is the weighted sum of its terms. Each term is a mean over the bands of an iteration and has no "
            "unit. The term `lsr` is a natural logarithm, and so negative, unless the recipe sets `log: false`."
        )
        parts.append(Section("Learning", text, picture=shown["history"]))
    return parts
