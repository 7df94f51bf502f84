"""Which steps the pictures, the table and the files read: the one place that knows the names of the camera graph.

A need is written as a recipe would say it:

    psf[mask]                    the value of a step
    spot[mask,*]                 the values of all its items, by item
    psf[mask].pixel_pitch        a parameter of the step
    psf[mask]()                  the step itself, bound to its parameters, to be tried out

A leading ``?`` marks what a figure can do without.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe

from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.tolerance.cheaper_steps import with_substitutions


@dataclass(frozen=True, slots=True)
class Figure:
    """One picture: what draws it, and what that reads."""

    name: str
    title: str
    caption: str
    draw: str  #: ``module:function`` of neusee.workflows
    needs: Mapping[str, str]


FIGURES = (
    Figure(
        "overview",
        "What the camera sees",
        "The scene, the same scene with the laser through the plain lens and through the mask, what is restored, and "
        "what is still wrong. One stretch for all, sRGB encoded; a ring marks each laser.",
        "report.figures.camera_overview:overview",
        {
            "truth": "truth",
            "plain": "developed[plain]",
            "mask": "developed[mask]",
            "restored": "restored",
            "spots": "?spot[plain,*]",
        },
    ),
    Figure(
        "suppression",
        "Suppression against wavelength",
        "Left: the peak of the masked PSF over the peak of the clear lens. No phase mask can go below the dashed "
        "floor, where the light is spread evenly over the window. Right: the background's energy kept in the field.",
        "report.figures.optics:suppression",
        {"lsr": "lsr[mask]", "bands": "bands", "psf": "psf[mask]", "bsr": "?bsr[mask]"},
    ),
    Figure(
        "psf",
        "Point-spread functions",
        "Logarithm of the light per pixel over the peak of the clear lens, and the share of the pupil's light within a "
        "radius. Where a curve ends below 1, the rest fell outside the window.",
        "report.figures.optics:psf",
        {"plain": "psf[plain]", "mask": "psf[mask]", "bands": "bands", "pixel_pitch": "psf[mask].pixel_pitch"},
    ),
    Figure(
        "height",
        "The mask",
        "Height over the clear aperture, and the phase it gives, wrapped to one turn.",
        "report.figures.optics:height",
        {"pupil": "pupil[mask]"},
    ),
    Figure(
        "spectra",
        "Spectra",
        "Three points of the scene as RGB and as the spectrum lifted from it; the light on the scene and the channels "
        "of the sensor; dotted, the lasers.",
        "report.figures.scene_spectra:spectra",
        {
            "scene": "scene",
            "radiance": "radiance",
            "bands": "bands",
            "illuminant": "illuminant",
            "responses": "responses",
            "lines": "?line[*]",
        },
    ),
    Figure(
        "sensor",
        "The sensor, measured",
        "Flat fields of rising light through this sensor, as a laboratory would measure them, and what "
        "its parameters predict.",
        "report.figures.photon_transfer:transfer",
        {"measured": "transfer"},
    ),
    Figure(
        "stability",
        "What a strong laser does to single precision",
        "Error against float64, on a random scene with the middle of the plain lens's PSF. A laser is added as a "
        "shifted PSF; convolved together with the scene, its rounding error would cover the whole picture.",
        "report.figures.numerics:stability",
        {"step": "image[plain]()", "psf": "psf[plain]"},
    ),
    Figure(
        "error_time",
        "Error against run time",
        "The PSF step of this recipe for one band, against the plain float64 sum over the pupil.",
        "report.figures.numerics:error_time",
        {"step": "psf[mask]()", "pupil": "pupil[mask]"},
    ),
)

#: Rows of the result table: column -> step. `LSR` is read at the first laser's wavelength.
TABLE: Mapping[str, Mapping[str, str]] = {
    "plain lens": {
        "peak/I_sat": "peak[plain]",
        "LSR": "lsr[plain]",
        "BSR": "bsr[plain]",
        "quality": "developed_quality[plain]",
        "saturated": "saturated[plain]",
    },
    "with mask": {
        "peak/I_sat": "peak[mask]",
        "LSR": "lsr[mask]",
        "BSR": "bsr[mask]",
        "quality": "developed_quality[mask]",
        "saturated": "saturated[mask]",
    },
    "restored": {"quality": "restored_quality"},
}
#: Steps that only a picture reads; a run makes them where the recipe has them.
SHOWN = ("transfer",)

BANDS = "bands"
LINES = "line[*]"

#: Files of ``data/``: how they are written, and from what.
FILES: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "radiance.exr": ("spectral", {"cube": "radiance", "bands": "bands"}),
    "psf_plain.exr": ("spectral", {"cube": "psf[plain]", "bands": "bands"}),
    "psf_mask.exr": ("spectral", {"cube": "psf[mask]", "bands": "bands"}),
    "raw_plain.png": ("png16", {"image": "raw[plain]"}),
    "raw_mask.png": ("png16", {"image": "raw[mask]"}),
    "raw_plain.exr": ("exr", {"image": "raw[plain]"}),
    "raw_mask.exr": ("exr", {"image": "raw[mask]"}),
    "restored.exr": ("exr", {"image": "restored"}),
}


def wanted(recipe: Recipe) -> tuple[str, ...]:
    """Return the recipe's outputs, the steps of its expected numbers, and those that the result table shows."""
    promised = [e.step for e in recipe.expect]
    shown = [s for s in (*(s for row in TABLE.values() for s in row.values()), *SHOWN) if s in recipe.steps]
    return tuple(dict.fromkeys([*recipe.outputs, *promised, *shown]))


def steps_of(recipe: Recipe) -> list[str]:
    """Return every step that a run of ``recipe`` looks at, in running order."""
    return needed(with_substitutions(recipe, wanted(recipe)), wanted(recipe))
