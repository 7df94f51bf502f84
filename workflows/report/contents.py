"""Contents of the report of a run: figures, result table and data files, and the steps whose results they show.

The report shows what the outputs of the recipe need; no step runs for the report alone.

Only this file and ``contents.toml`` name the steps of the camera graph. A text names the source of one argument of a
drawing function:

    psf[mask]                    the value of a step
    spot[mask,*]                 a dictionary with the value of each copy of a step
    psf[mask].pixel_pitch        a parameter of a step
    line[*].file                 a dictionary with a parameter of each copy of a step
    variants of psf              errors and run times of variants of a step, from the last study of accuracy
    psf[mask]()                  a function: the node of a step with the parameters of the step

A leading ``?`` marks an optional argument: if the recipe lacks the step, the figure is drawn without this argument.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources

from neusee.workflows.graph.recipe_graph import Expectation, Recipe, needed
from neusee.workflows.tolerance.cheaper_steps import with_substitutions


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the report: title, caption, drawing function, and the steps that supply the function's arguments."""

    name: str
    title: str
    caption: str
    draw: str  #: the drawing function, as ``module:function`` below neusee.workflows
    needs: Mapping[str, str]
    only_tables: bool = False  #: True for a figure that is drawn only if an argument is a table of the user


_TABLES = tomllib.loads(resources.files(__package__).joinpath("contents.toml").read_text(encoding="utf-8"))
FIGURES = tuple(Figure(**figure) for figure in _TABLES["figure"])


def _row(arm: str) -> dict[str, str]:
    """Return the step whose result each column of the result table shows, for the ``plain`` lens or the ``mask``."""
    steps = {"peak/I_sat": "peak", "LSR": "lsr", "BSR": "bsr", "outside": "outside", "quality": "developed_quality",
             "saturated": "saturated"}  # fmt: skip
    return {column: f"{step}[{arm}]" for column, step in steps.items()}


#: Rows of the result table: the step that each column reads. `LSR` is taken at the wavelength of the first laser.
TABLE: Mapping[str, Mapping[str, str]] = {
    "plain lens": _row("plain"),
    "with mask": _row("mask"),
    "restored": {"quality": "restored_quality"},
    "grey filter, restored": {"quality": "rival_quality", "saturated": "rival_saturated"},
}
RIVAL = "grey filter, restored"

#: Steps that give the error by the number of bands, by what they are the error of.
SPECTRAL: Mapping[str, str] = {"spectral": "of the PSF of a white point", "laser_spectral": "of a laser spot"}

BANDS = "bands"
LINES = "line[*]"

#: Files of ``data/``: the format of each file, and the needs of the function that writes the file.
FILES: Mapping[str, tuple[str, Mapping[str, str]]] = {
    name: (file["format"], file["needs"]) for name, file in _TABLES["files"].items()
}


OUTPUTS = "outputs.safetensors"


def files_of(recipe: Recipe) -> dict[str, tuple[str, Mapping[str, str]]]:
    """Return format and needs of the data files that a recipe asks for, by name."""
    files = {**FILES, OUTPUTS: ("safetensors", {step: step for step in recipe.outputs})}
    return {name: file for name, file in files.items() if recipe.exports is None or name in recipe.exports}


def wanted(recipe: Recipe) -> tuple[str, ...]:
    """Return the steps that a run must give: outputs, steps of expected numbers, spectral errors, and a mask's rival.

    An expected number counts if an output needs its step, and a spectral error if the outputs need all its inputs. The
    rival of a mask counts if the outputs tell how the mask protects and how the restored picture looks.
    """
    asked = _asked(recipe)
    errors = (name for name in spectral_steps(recipe) if asked.issuperset(recipe.steps[name].sources))
    numbers = (e.step for e in compared(recipe)[0])
    return tuple(dict.fromkeys([*recipe.outputs, *numbers, *errors, *_rival(recipe, asked)]))


def _rival(recipe: Recipe, asked: set[str]) -> Iterable[str]:
    """Return the steps of the grey filter that is the rival of a mask; none if the recipe has a filter of its own."""
    steps = TABLE[RIVAL].values()
    told = asked.issuperset((TABLE["with mask"]["LSR"], *TABLE["restored"].values()))
    return steps if told and not shade_of(recipe) and recipe.steps.keys() >= set(steps) else ()


def shade_of(recipe: Recipe) -> str | None:
    """Return the step of the grey filter, stop or notch in the arm of the mask, or None."""
    pupil = recipe.steps.get("pupil[mask]")
    shade = pupil.wires.get("shade") if pupil else None
    return shade if isinstance(shade, str) else None


def compared(recipe: Recipe) -> tuple[list[Expectation], list[Expectation]]:
    """Return the expected numbers that a run compares, and the others, whose steps no output of the recipe needs."""
    asked = _asked(recipe)
    found: tuple[list[Expectation], list[Expectation]] = ([], [])
    for number in recipe.expect:
        found[number.step not in asked].append(number)
    return found


def _asked(recipe: Recipe) -> set[str]:
    return set(needed(recipe.unsubstituted or recipe, recipe.outputs))


def spectral_steps(recipe: Recipe) -> list[str]:
    """Return the steps of the recipe that estimate the error by the number of spectral bands."""
    return [name for name in recipe.steps if name.partition("[")[0] in SPECTRAL]


def steps_of(recipe: Recipe) -> list[str]:
    """Return every step that a run of ``recipe`` computes or loads from the cache, in running order."""
    return needed(with_substitutions(recipe, wanted(recipe)), wanted(recipe))
