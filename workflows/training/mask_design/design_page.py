"""The page of a designed mask: what it is, what it does at each wavelength, what bounds it, how it was learnt."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from neusee.nodes import metrics
from neusee.workflows.report.figures import optics
from neusee.workflows.report.figures.style import canvas, drawn
from neusee.workflows.report.study_page import Section
from neusee.workflows.training.mask_design.design_terms import Fabrication, Terms
from neusee.workflows.training.mask_design.optimizers import Learnt

_COLUMNS = ("nm", "LSR", "even light", "BSR", "median MTF", "at most", "rms MTF", "at most")
_NAMES = ("lsr", "energy_floor", "bsr", "median_mtf", "median_mtf_bound", "rms_mtf", "rms_mtf_bound")


def pictures(terms: Terms, height: Tensor, learnt: Learnt) -> dict[str, bytes]:
    """Relief, PSF, suppression by wavelength and the way of the loss, as PNG."""
    pupil, psf, plain = terms.pupil(height), terms.psf(height), terms.plain()
    pitch = terms.recipe.steps[terms.how.psf].params["pixel_pitch"]
    shown = {
        "height": optics.height(pupil=pupil),
        "psf": optics.psf(plain=plain, mask=psf, bands=terms.bands, pixel_pitch=pitch),
        "suppression": optics.suppression(lsr=metrics.lsr(psf), bands=terms.bands, psf=psf),
    }
    return shown | ({"history": history(learnt.history)} if learnt.history else {})


@drawn
def history(rows: Sequence[Mapping[str, float]]) -> Any:
    """The loss and its terms, iteration by iteration, one line a start."""
    names = [name for name in dict.fromkeys(n for row in rows for n in row) if name not in ("start", "iteration")]
    figure, axes = canvas(3.6 * len(names), 3.2, 1, len(names))
    for ax, name in zip(axes[0], names, strict=True):
        for start in sorted({row["start"] for row in rows}):
            own = [row for row in rows if row["start"] == start]
            ax.plot([row["iteration"] for row in own], [row[name] for row in own], linewidth=1.2)
        ax.set_title(name)
        ax.set_xlabel("iteration")
    return figure


def sections(found: Mapping[str, Any], made: Fabrication, shown: Mapping[str, bytes]) -> list[Section]:
    """What the page says."""
    bands = found["bands"]
    columns = [[1e9 * value for value in bands["wavelength"]], *(bands[name] for name in _NAMES)]
    bounds = (
        "Light that stays in the field shines somewhere: spread evenly over the window it would reach `even light`. "
        "And the sum of the squares of a PSF is that of its contrast, so that a low peak leaves little contrast: "
        "no PSF with this peak has more than `at most`."
    )
    parts = [
        Section("Height map", "Height, and the phase that it is at three wavelengths.", picture=shown.get("height")),
        Section("To be made", f"{made}.", ("limit", "value"), [(name, text) for name, text in made.rows()]),
        Section("Light", "The spread light beside the plain lens's.", picture=shown.get("psf")),
        Section("Suppression", "", picture=shown.get("suppression")),
        Section("By wavelength", bounds, _COLUMNS, list(zip(*columns, strict=True))),
    ]
    if "history" in shown:
        parts.append(
            Section("Learning", "Each term is a mean over the bands of that iteration.", picture=shown["history"])
        )
    return parts
