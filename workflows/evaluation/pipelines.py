"""The pipelines that an evaluation compares: each a mask with a restorer and one recipe per laser,
at equal protection of the sensor if requested.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.protection.equal_rivals import (
    WAYS,
    EqualProtection,
    EqualShade,
    shade_equally,
)
from neusee.workflows.protection.protection_camera import ProtectionCamera
from neusee.workflows.recipe.blocks.settings_block import EvaluateSettings
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.text.composition import compose
from neusee.workflows.recipe.text.overrides import Override
from neusee.workflows.recipe.text.recipe_files import refuse_outside
from neusee.workflows.report.study_report import Progress, Section
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from neusee.workflows.evaluation.evaluation_result import EvaluationResult


NONE = "none"  #: name for "no restorer", and for the case without a laser
FLAT = "flat"  #: option of `doe` without a mask
BEAM = "beam"  #: name of the laser in all recipes of an evaluation

#: lasers of the paper with wavelengths in m; where the paper gives only a colour, a common laser of
#: this colour
CASES: dict[str, float | None] = {
    "violet": 405e-9,
    "blue": 450e-9,
    "green": 532e-9,
    "yellow": 589e-9,
    "red": 650e-9,
    NONE: None,
}
DRAWN = "drawn"  #: name of a laser whose wavelength is drawn from the law in the recipe
#: lasers of the figure with six lasers, with wavelengths in m
SIX: dict[str, float | None] = {
    "violet": 405e-9,
    "blue": 450e-9,
    "cyan": 488e-9,
    **dict(list(CASES.items())[2:]),
}
WAVELENGTHS = {name: metres for name, metres in SIX.items() if metres is not None}
_PIPELINE = re.compile(
    r"(?P<mask>[\w-]+)(?:@(?P<height>[^+]+))?\+(?P<restorer>[\w-]+)(?:@(?P<weights>.+))?"
)
_HOW_TO_WRITE = (
    "write MASK+RESTORER, such as flat+none, five_half_rings+wiener or"
    " pixelwise@mask.npy+nafnet@net.safetensors"
)


class NamedRecipe(NamedTuple):
    """A recipe as given on a command line: a name, changes, and the folder for relative paths."""

    name: str
    changes: Sequence[str | Override]
    folder: Path

    def changed(self, words: Sequence[str | Override]) -> NamedRecipe:
        """Return the recipe with further changes."""
        return self._replace(changes=[*self.changes, *words])

    def load(self) -> Recipe:
        """Load the recipe; raise `RecipeError` with all mistakes."""
        return load(self.name, self.changes, self.folder)


class EvaluationRefused(ValueError):
    """Error for mistakes in the arguments or in the photographs of an evaluation."""


@dataclass(frozen=True)
class Pipeline:
    """A mask in front of the lens, with the method that restores the picture behind it."""

    mask: str  #: an option of `doe`
    restorer: str  #: an option of `restore`, or none
    height_file: Path | None = None
    weights: Path | None = None
    #: filter and stop that give all pipelines equal protection
    shade: EqualShade | None = None
    height_name: str = ""  #: displayed name of the height map; empty: its file name
    weights_name: str = ""  #: displayed name of the weights; empty: their file name

    @property
    def name(self) -> str:
        """Return the name of the pipeline, such as ``flat+none`` or ``plain lens + filter 0.01,
        wiener``.
        """
        if self.shade is not None:
            return f"{self.front}, {'not restored' if self.restorer == NONE else self.back}"
        return f"{self.front}+{self.back}"

    @property
    def front(self) -> str:
        """Return the name of the mask with its file, or a phrase with its filter and stop."""
        file_text = f"@{self.height_name or self.height_file.name}" if self.height_file else ""
        if self.shade is None:
            return self.mask + file_text
        mask_in_words = (
            "plain lens"
            if self.mask == FLAT
            else self.mask.replace("half_ring", "half-ring").replace("_", " ")
        )
        return mask_in_words + file_text + self.shade.said

    @property
    def back(self) -> str:
        """Return the name of the restorer, with its file if it has one."""
        return self.restorer + (
            f"@{self.weights_name or self.weights.name}" if self.weights else ""
        )

    @property
    def picture(self) -> str:
        """Return the step of the picture that is compared with the true picture."""
        return "developed[mask]" if self.restorer == NONE else "restored"

    @property
    def quality(self) -> str:
        """Return the step that measures the error of the picture against the true picture."""
        return "developed_quality[mask]" if self.restorer == NONE else "restored_quality"

    @property
    def outputs(self) -> tuple[str, ...]:
        """Return the steps whose results an evaluation needs."""
        return (self.picture, "truth", self.quality, "saturated[mask]", "peak[mask]", "bsr[mask]")


@dataclass(frozen=True)
class PipelineRecipes:
    """A pipeline with one recipe for each laser; these differ only in the laser."""

    pipeline: Pipeline
    #: function from the name of a laser, and optionally its direction and wavelength, to the recipe
    recipe: Callable[..., Recipe]
    told: str = ""  #: the error in the data of the restorer, as text
    #: the error, as an offset for each affected parameter of the restorer's data
    error: Mapping[str, Any] = field(default_factory=dict)
    true: Callable[..., Recipe] | None = None  #: function as ``recipe``, without the error
    #: recipe arguments that set its mask and restorer
    words: tuple[str, ...] = ()
    fwhm: float = 10e-9  #: spectral width of its lasers in m

    @property
    def name(self) -> str:
        return self.pipeline.name + (f", {self.told}" if self.told else "")


def read_pipelines(text: str, folder: Path, mark: Location | None = None) -> list[Pipeline]:
    """Parse a list such as ``flat+none, five_half_rings+wiener``; raise `EvaluationRefused` with
    all errors.

    ``mark`` is the place of the text in a recipe, if it is from one.
    """
    pipeline_words = [word for word in map(str.strip, text.split(",")) if word]
    pipelines: list[Pipeline] = []
    mistakes: list[str] = []
    for word in pipeline_words:
        try:
            pipelines.append(_pipeline(word, folder))
        except ValueError as error:
            mistakes.append(f"{word}: {error}")
        else:
            mistakes += [f"{word}: {file_fault}" for file_fault in _faults(pipelines[-1], mark)]
    pipelines = named_apart(pipelines)
    mistakes += [f"{name} is listed twice: remove one" for name in _twice(pipelines)]
    if not pipeline_words:
        mistakes = [f"there is no pipeline: {_HOW_TO_WRITE}"]
    if mistakes:
        raise EvaluationRefused("\n".join(mistakes))
    return pipelines


def _pipeline(word: str, folder: Path) -> Pipeline:
    """Parse one pipeline; raise `ValueError` for a malformed one."""
    match = _PIPELINE.fullmatch(word)
    if match is None:
        raise ValueError(_HOW_TO_WRITE)
    height_file, weights_file = (
        _named_file(match[group], folder) for group in ("height", "weights")
    )
    return Pipeline(match["mask"], match["restorer"], height_file, weights_file)


def _faults(pipeline: Pipeline, mark: Location | None) -> list[str]:
    """Return the reasons why files of a pipeline cannot be used."""
    faults = [_fault(path, mark) for path in (pipeline.height_file, pipeline.weights) if path]
    return [fault for fault in faults if fault]


def _named_file(text: str | None, folder: Path) -> Path | None:
    """Return the path of a file in a pipeline, or None."""
    return folder / Path(text).expanduser() if text else None


def _twice(pipelines: Sequence[Pipeline]) -> list[str]:
    """Return the names that occur more than once, in alphabetical order."""
    counts = Counter(pipeline.name for pipeline in pipelines)
    return sorted(name for name, count in counts.items() if count > 1)


def _fault(path: Path, mark: Location | None) -> str:
    """Return the reason why a file of a pipeline cannot be used; empty if it can."""
    try:
        if mark is not None:
            refuse_outside(path, mark)
    except ValueError as error:
        return f"{path.name} {error}"
    return "" if path.is_file() else f"no such file: {path}"


def named_apart(pipelines: Sequence[Pipeline]) -> list[Pipeline]:
    """Return the pipelines with a different name for each different file, with as many parent
    folders as needed.
    """
    files: list[Path | None] = []
    for pipeline in pipelines:
        files += [pipeline.height_file, pipeline.weights]
    names = _shortest_names([file for file in files if file is not None])
    return [
        replace(
            pipeline,
            height_name=names.get(pipeline.height_file, ""),
            weights_name=names.get(pipeline.weights, ""),
        )
        for pipeline in pipelines
    ]


def _shortest_names(files: Sequence[Path]) -> dict[Path | None, str]:
    """Return the shortest end of each path that is unique among the files; equal paths count as one
    file.
    """
    absolute_paths = {file: Path(os.path.abspath(file)) for file in files}
    names: dict[Path | None, str] = {}
    for file, absolute_path in absolute_paths.items():
        other_paths = [
            other_path for other_path in absolute_paths.values() if other_path != absolute_path
        ]
        # ends of the path, from the file name on, each with one more folder
        path_ends = (
            Path(*absolute_path.parts[-count:]) for count in range(1, len(absolute_path.parts) + 1)
        )
        shortest = next(
            path_end
            for path_end in path_ends
            if not any(
                other_path.parts[-len(path_end.parts) :] == path_end.parts
                for other_path in other_paths
            )
        )
        names[file] = shortest.as_posix()
    return names


def compose_pipelines(named: NamedRecipe, pipelines: Sequence[Pipeline]) -> list[PipelineRecipes]:
    """Return each pipeline with its recipes; raise `EvaluationRefused` with all errors."""
    own_laser = _own_laser(named)
    composed: list[PipelineRecipes] = []
    mistakes: dict[str, None] = {}
    for pipeline in pipelines:
        try:
            words = _words(pipeline, partial(_takes, named))
            recipe_of = cache(partial(_with_laser, named.changed(words), own_laser))
            # check the recipes without a laser and with the first one
            for case in (NONE, next(iter(CASES))):
                _check(recipe_of(case), pipeline)
            composed.append(
                PipelineRecipes(pipeline, recipe_of, words=tuple(words), fwhm=own_laser.fwhm)
            )
        except RecipeError as error:
            mistakes |= dict.fromkeys(
                f"{pipeline.name}: {one_line(problem)}" for problem in error.diagnostics
            )
        except EvaluationRefused as error:
            mistakes[f"{pipeline.name}: {error}"] = None
    if mistakes:
        raise EvaluationRefused("\n".join(mistakes))
    return composed


def one_line(problem: Diagnostic) -> str:
    """Return an error in a recipe as one line of text."""
    return " ".join(str(RecipeError([problem])).split())


def _words(pipeline: Pipeline, takes: Callable[[str, str], str]) -> list[str]:
    """Return the recipe arguments that set mask and restorer of a pipeline, such as
    ``doe=flat``.
    """
    words = [f"doe={pipeline.mask}"]
    if pipeline.height_file:
        words.append(f"doe.{takes('doe', pipeline.mask)}={pipeline.height_file.absolute()}")
    if pipeline.restorer != NONE:
        words.append(f"restore={pipeline.restorer}")
    if pipeline.weights:
        words.append(f"restore.{takes('restore', pipeline.restorer)}={pipeline.weights.absolute()}")
    return words + (pipeline.shade.words if pipeline.shade else [])


def _takes(named: NamedRecipe, group: str, option: str) -> str:
    """Return the name of the file parameter of a mask or restorer; raise `EvaluationRefused` if it
    has none.

    The option may be built in, or one of the user's, next to the recipe or in a folder that all
    recipes search.
    """
    name, changes, folder = named.changed([f"{group}={option}"])
    composed = compose(name, changes, folder) if option != NONE else None
    if composed and (
        problem := next(
            (
                diagnostic
                for diagnostic in composed.diagnostics
                if diagnostic.message.startswith("no option")
            ),
            None,
        )
    ):
        raise EvaluationRefused(problem.message)
    block = composed.root.items.get(group) if composed else None
    for parameter in ("file", "weights"):
        if block is not None and parameter in block.items:
            return parameter
    raise EvaluationRefused(f"{option} takes no file: remove @ and the file name")


def _with_laser(
    named: NamedRecipe,
    own: _OwnLaser,
    case: str,
    direction: tuple[float, float] | None = None,
    wavelength: float | None = None,
) -> Recipe:
    """Load a recipe with the laser ``case``; its strength, and usually its direction, is set later
    for each point.
    """
    laser = ""
    if case != NONE:
        laser_wavelength = wavelength or WAVELENGTHS.get(case)
        # without a fixed wavelength use that of the recipe, with its law
        laser_text = (
            own.drawn if laser_wavelength is None else laser_line(laser_wavelength, own.fwhm)
        )
        angle = "null" if direction is None else f"[{direction[0]!r} rad, {direction[1]!r} rad]"
        laser = f"{BEAM}: {{{laser_text}, strength: 1, angle: {angle}}}"
    return named.changed([f"lasers={{{laser}}}"]).load()


def laser_line(wavelength: float, fwhm: float) -> str:
    """Return the recipe text for wavelength and spectral width (both in m) of a laser."""
    return f"wavelength: {wavelength * 1e9:.12g} nm, fwhm: {fwhm * 1e9:g} nm"


class _OwnLaser(NamedTuple):
    """The first laser of a recipe, or a default with a width of 10 nm."""

    fwhm: float  #: spectral width in m
    drawn: str  #: wavelength and width as written in the recipe, with their laws


def _own_laser(named: NamedRecipe) -> _OwnLaser:
    """Return the first laser of a recipe."""
    steps = base_recipe(named).steps
    spectral_widths = [
        step.params["fwhm"] for name, step in steps.items() if name.startswith("line[")
    ]
    fwhm = float(spectral_widths[0]) if spectral_widths else 10e-9
    written_lasers = compose(*named).root.below(["lasers"])
    laser = next(iter(written_lasers.items.values()), None) if written_lasers else None
    texts = {"fwhm": f"{fwhm * 1e9:g} nm", **(laser.plain if laser else {})}
    return _OwnLaser(
        fwhm,
        ", ".join(
            f"{field_name}: '{texts[field_name]}'"
            for field_name in ("wavelength", "fwhm")
            if field_name in texts
        ),
    )


def base_recipe(named: NamedRecipe) -> Recipe:
    """Load the recipe of an evaluation; raise `EvaluationRefused` with all its errors."""
    try:
        return named.load()
    except RecipeError as error:
        raise EvaluationRefused(
            "\n".join(dict.fromkeys(map(one_line, error.diagnostics)))
        ) from None


def read_settings(named: NamedRecipe) -> EvaluateSettings:
    """Return the block ``evaluate`` of a recipe; raise `EvaluationRefused` with all errors in the
    recipe.
    """
    return base_recipe(named).evaluation or EvaluateSettings()


def refuse_fixed_laser(recipe: Recipe) -> None:
    """Raise `EvaluationRefused` if the wavelength of the recipe's first laser is not drawn from a
    law.
    """
    # the laser's name in line[name]
    first_laser = next(
        (name.partition("[")[2][:-1] for name in recipe.steps if name.startswith("line[")), None
    )
    if recipe.uncertain is None or f"lasers.{first_laser}.wavelength" not in recipe.uncertain.names:
        raise EvaluationRefused(
            "evaluate.lasers is drawn, but no law says which wavelength the first laser of the"
            ' recipe has: add laser=drawn, or write a law such as wavelength: "uniform(400 nm, 700'
            ' nm)"'
        )


def _check(recipe: Recipe, pipeline: Pipeline) -> None:
    """Raise `EvaluationRefused` if the recipe lacks a step that an evaluation needs."""
    missing = [
        name
        for name in ("scene", *pipeline.outputs, "lsr[mask]", "mtf[mask]")
        if name not in recipe.steps
    ]
    if missing:
        raise EvaluationRefused(
            f"{recipe.name} lacks these steps, which an evaluation needs: {', '.join(missing)}"
        )


# --- equal protection -----------------------------------------------------------------------------

# Each pipeline gets the filter and the stop that bring its peak to the same value.

_STOP_BANDS = 7  #: number of wavelengths at which stops are compared
PROTECTION_COLUMNS = ("pipeline", "mask alone", "stop", "filter", "exposure", "peak")


def read_protection(level: float | None, way: str) -> EqualProtection | None:
    """Return the requested protection, or None; raise `EvaluationRefused` for an
    impossible value.
    """
    if way not in WAYS:
        raise EvaluationRefused(f"--by {way}: write one of {', '.join(WAYS)}")
    if level is None:
        return None
    if not 0 < level < 1:
        raise EvaluationRefused(
            f"--equal-protection {level:g}: write the peak of a laser as a share of that behind the"
            " plain lens, above 0 and below 1, such as 0.001"
        )
    return EqualProtection(level, way)


def protect(
    named: NamedRecipe,
    pipelines: Sequence[PipelineRecipes],
    asked: EqualProtection,
    store: Store,
    progress: Progress,
) -> list[PipelineRecipes]:
    """Return the pipelines with the filters and stops that bring every peak to the requested level.

    Raises: `EvaluationRefused` with every mask that is already shaded or already protects more than
    requested, before any scene is computed.
    """
    shades: dict[str, EqualShade] = {}
    faults: dict[str, None] = {}
    for pipeline in pipelines:
        front = pipeline.pipeline.front
        if front in shades:
            continue
        try:
            shades[front] = _shade(named, pipeline, asked, store)
            progress(
                f"{front}: peak"
                f" {shades[front].alone:.3g}{shades[front].said or ', without a filter'}"
            )
        except ValueError as error:
            faults[f"--equal-protection {asked.level:g}: {front} {error}"] = None
    if faults:
        raise EvaluationRefused("\n".join(faults))
    return compose_pipelines(
        named,
        [
            replace(composed.pipeline, shade=shades[composed.pipeline.front])
            for composed in pipelines
        ],
    )


def _shade(
    named: NamedRecipe, pipeline: PipelineRecipes, asked: EqualProtection, store: Store
) -> EqualShade:
    """Return the stop and the filter that bring the peak of a pipeline's mask to the requested
    level.

    Raises `EvaluationRefused` for a mask that is already shaded.
    """
    without_laser = pipeline.recipe(NONE)
    if without_laser.steps["pupil[mask]"].wires.get("shade"):
        raise EvaluationRefused(
            "has a filter or a stop of its own: leave it out, because every pipeline gets one"
        )
    camera = ProtectionCamera.of(without_laser, store, _STOP_BANDS)

    def peak_of(shade: EqualShade) -> float:
        shaded = replace(pipeline.pipeline, shade=shade)
        (shaded_recipes,) = compose_pipelines(named, [shaded])
        return float(
            run(shaded_recipes.recipe(NONE), store, ["lsr[mask]"]).values["lsr[mask]"].max()
        )

    return shade_equally(
        camera, store, asked.level, asked.way, partial(_scene_light, without_laser, store), peak_of
    )


def _scene_light(recipe: Recipe, store: Store) -> float:
    """Return the mean light of the recipe's scene behind the plain lens, in e- per pixel."""
    return max(
        1.0, float(run(recipe, store, ["signal[plain]"]).values["signal[plain]"].double().mean())
    )


def protection_document(result: EvaluationResult) -> dict[str, Any]:
    """Return the protection and the recipe arguments of each pipeline as JSON values; empty if no
    protection was requested.
    """
    if result.protection is None:
        return {}
    shades = {
        pipeline.name: pipeline.shade for pipeline in result.pipelines if pipeline.shade is not None
    }
    protections = {name: {**asdict(shade), "words": shade.words} for name, shade in shades.items()}
    return {
        "equal protection": {
            "peak": result.protection.level,
            "by": result.protection.way,
            "pipelines": protections,
        }
    }


def protection_rows(result: EvaluationResult) -> list[Sequence[Any]]:
    """Return a row for each pipeline: peak with the mask alone, stop, filter, exposure factor, and
    final peak.
    """
    rows: list[Sequence[Any]] = []
    for pipeline in result.pipelines:
        shade = pipeline.shade
        if shade is not None:
            peak = float(result.masks[pipeline.front].lsr.max())
            rows.append(
                (
                    pipeline.name,
                    shade.alone,
                    shade.diameter,
                    shade.transmittance,
                    shade.brightness,
                    peak,
                )
            )
    return rows


def protection_section(result: EvaluationResult) -> list[Section]:
    """Return the section with the filter and the stop of each pipeline; empty if no protection was
    requested.
    """
    if result.protection is None:
        return []
    ways = {
        "best": (
            "the stop and the filter with the least error of the filtered picture at the light of"
            " the scene"
        ),
        "filter": "a grey filter",
        "stop": "a smaller stop, and a filter for the rest",
    }
    text = f"""Every pipeline of this table lowers the peak of a laser to
        {result.protection.level:g} of that behind the plain lens, at the worst wavelength: each has
        {ways[result.protection.way]}. Mask alone: its peak without them. Stop: diameter relative to
        the lens. Filter: transmittance. Exposure: no picture is scored as dark as filter and stop
        make it. One that is not restored is brightened by this factor, 1 over the light that they
        pass, which makes its noise brighter too; a Wiener filter knows the PSF with filter and
        stop, and brightens its picture itself."""
    return [Section("Equal protection", text, PROTECTION_COLUMNS, protection_rows(result))]
