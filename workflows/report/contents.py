"""Contents of the report of a run: figures, result table and data files, and the steps whose results they show.

Only this file names the steps of the camera graph. A text names the source of one argument of a drawing function:

    psf[mask]                    the value of a step
    spot[mask,*]                 a dictionary with the value of each copy of a step
    psf[mask].pixel_pitch        a parameter of a step
    psf[mask]()                  a function: the node of a step with the parameters of the step

A leading ``?`` marks an optional argument: if the recipe lacks the step, the figure is drawn without this argument.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.tolerance.cheaper_steps import with_substitutions


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the report: title, caption, drawing function, and the steps that supply the function's arguments."""

    name: str
    title: str
    caption: str
    draw: str  #: the drawing function, as ``module:function`` below neusee.workflows
    needs: Mapping[str, str]


FIGURES = (
    Figure(
        "overview",
        "What the camera sees",
        "The scene without the laser, the scene with the laser through the plain lens and through the mask, the "
        "restored picture, and its error. All pictures have the same scale and are sRGB encoded. A ring marks each "
        "laser.",
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
        "Left: the peak of the PSF with the mask, divided by the peak of the clear lens. No phase mask can go below "
        "the dashed floor, where the light is spread evenly over the window. Right: the share of the background's "
        "energy that stays in the field.",
        "report.figures.optics:suppression",
        {"lsr": "lsr[mask]", "bands": "bands", "psf": "psf[mask]", "bsr": "?bsr[mask]"},
    ),
    Figure(
        "psf",
        "Point-spread functions",
        "Logarithm of the light in each pixel, divided by the peak of the clear lens; and the share of the pupil's "
        "light within a radius. If a curve ends below 1, the rest of the light falls outside the window.",
        "report.figures.optics:psf",
        {"plain": "psf[plain]", "mask": "psf[mask]", "bands": "bands", "pixel_pitch": "psf[mask].pixel_pitch"},
    ),
    Figure(
        "height",
        "The mask",
        "Height of the mask over the clear aperture, and the phase shift of the mask, wrapped to one turn.",
        "report.figures.optics:height",
        {"pupil": "pupil[mask]"},
    ),
    Figure(
        "spectra",
        "Spectra",
        "Three points of the scene: the RGB values, and the spectra reconstructed from these values. The illuminant "
        "and the spectral responses of the sensor's channels. Dotted lines mark the lasers.",
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
        "Simulated flat fields of increasing irradiance, as a laboratory measures them, and the curve that the "
        "parameters of the sensor predict.",
        "report.figures.photon_transfer:transfer",
        {"measured": "transfer"},
    ),
    Figure(
        "stability",
        "Round-off error of a strong laser in single precision",
        "Error in float32 compared with float64, for a random scene and the centre of the plain lens's PSF. The camera "
        "adds the laser as a shifted PSF. If the laser were convolved together with the scene, the round-off error "
        "would cover the whole picture.",
        "report.figures.numerics:stability",
        {"step": "image[plain]()", "psf": "psf[plain]"},
    ),
    Figure(
        "error_time",
        "Error against run time",
        "The PSF step of this recipe for one band, compared with the direct float64 sum over the pupil.",
        "report.figures.numerics:error_time",
        {"step": "psf[mask]()", "pupil": "pupil[mask]"},
    ),
)


def _row(arm: str) -> dict[str, str]:
    """Return the step whose result each column of the result table shows, for the ``plain`` lens or the ``mask``."""
    steps = {"peak/I_sat": "peak", "LSR": "lsr", "BSR": "bsr", "quality": "developed_quality", "saturated": "saturated"}
    return {column: f"{step}[{arm}]" for column, step in steps.items()}


#: Rows of the result table: the step that each column reads. `LSR` is taken at the wavelength of the first laser.
TABLE: Mapping[str, Mapping[str, str]] = {
    "plain lens": _row("plain"),
    "with mask": _row("mask"),
    "restored": {"quality": "restored_quality"},
}
#: Steps that only a figure reads. A run computes each of these steps if the recipe has the step.
SHOWN = ("transfer",)

BANDS = "bands"
LINES = "line[*]"

#: Files of ``data/``: the format of each file, and the needs of the function that writes the file.
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
    """Return the steps that a run must give: outputs of the recipe, sources of expected numbers and of the report."""
    promised = [e.step for e in recipe.expect]
    shown = [s for s in (*(s for row in TABLE.values() for s in row.values()), *SHOWN) if s in recipe.steps]
    return tuple(dict.fromkeys([*recipe.outputs, *promised, *shown]))


def steps_of(recipe: Recipe) -> list[str]:
    """Return every step that a run of ``recipe`` computes or loads from the cache, in running order."""
    return needed(with_substitutions(recipe, wanted(recipe)), wanted(recipe))
