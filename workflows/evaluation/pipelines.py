"""The pipelines of an evaluation: a mask and a restorer each, with one recipe for each laser."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError, nearest
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.text.composition import groups_of, packaged
from neusee.workflows.recipe.text.overrides import Override

NONE = "none"  #: of restorers: the raw picture, developed; of cases: no laser
BEAM = "beam"  #: the laser's name in every recipe of an evaluation
FILES = ("file", "weights")  #: parameters by which an option may take a file

#: the paper's cases; where the paper names only a colour, the wavelength (m) of a common laser
CASES: dict[str, float | None] = {
    "violet": 405e-9,
    "blue": 450e-9,
    "green": 532e-9,
    "yellow": 589e-9,
    "red": 650e-9,
    NONE: None,
}
_PIPELINE = re.compile(r"(?P<mask>[\w-]+)(?:@(?P<height>[^+]+))?\+(?P<restorer>[\w-]+)(?:@(?P<weights>.+))?")
_HOW = "write MASK+RESTORER, such as flat+none, five_half_rings+wiener or pixelwise@mask.npy+nafnet@net.safetensors"


class EvaluationRefused(ValueError):
    """Mistakes in the arguments of an evaluation; nothing was run."""


@dataclass(frozen=True)
class Pipeline:
    """A mask in front of the lens and the restorer of its picture."""

    mask: str  #: an option of `doe`
    restorer: str  #: an option of `restore`, or none
    height_file: Path | None = None
    weights: Path | None = None

    @property
    def name(self) -> str:
        """Return the pipeline as it was asked for, files by their names."""
        return f"{self.front}+{self.back}"

    @property
    def front(self) -> str:
        """Return the mask with its file."""
        return self.mask + (f"@{self.height_file.name}" if self.height_file else "")

    @property
    def back(self) -> str:
        """Return the restorer with its file."""
        return self.restorer + (f"@{self.weights.name}" if self.weights else "")

    @property
    def picture(self) -> str:
        """Return the step whose picture is judged."""
        return "developed[mask]" if self.restorer == NONE else "restored"

    @property
    def quality(self) -> str:
        """Return the step that judges the picture."""
        return "developed_quality[mask]" if self.restorer == NONE else "restored_quality"

    @property
    def outputs(self) -> tuple[str, ...]:
        """Return the steps that an evaluation needs of a run."""
        return (self.picture, "truth", self.quality, "saturated[mask]", "peak[mask]", "bsr[mask]")


@dataclass(frozen=True)
class PipelineRecipes:
    """A pipeline with its recipe for each case."""

    pipeline: Pipeline
    recipes: _Recipes  #: by case

    @property
    def name(self) -> str:
        return self.pipeline.name


class _Recipes(dict[str, Recipe]):
    """The recipe of each case, read when it is first asked for; the recipes differ in one wavelength."""

    def __init__(self, recipe: str, words: Sequence[str | Override], fwhm: float, folder: Path) -> None:
        super().__init__()
        self._how = recipe, words, fwhm, folder

    def __missing__(self, case: str) -> Recipe:
        recipe, words, fwhm, folder = self._how
        self[case] = load(recipe, [*words, _laser(CASES[case], fwhm)], folder)
        return self[case]


def read_pipelines(text: str, folder: Path) -> list[Pipeline]:
    """Read text such as ``flat+none, five_half_rings+wiener``; raise `EvaluationRefused` with every mistake."""
    found: list[Pipeline] = []
    wrong: list[str] = []
    for word in filter(None, (part.strip() for part in text.split(","))):
        match = _PIPELINE.fullmatch(word)
        if match is None:
            wrong.append(f"{word}: {_HOW}")
            continue
        height, weights = (folder / Path(x).expanduser() if (x := match[k]) else None for k in ("height", "weights"))
        found.append(Pipeline(match["mask"], match["restorer"], height, weights))
        wrong += [f"{word}: no file {path}" for path in (height, weights) if path and not path.is_file()]
    twice = {p.name for p in found if [q.name for q in found].count(p.name) > 1}
    wrong += [f"{name}: stands twice" for name in sorted(twice)]
    if not found and not wrong:
        wrong = [f"no pipeline: {_HOW}"]
    if wrong:
        raise EvaluationRefused("\n".join(wrong))
    return found


def compose_pipelines(
    recipe: str, changes: Sequence[str | Override], pipelines: Sequence[Pipeline], folder: Path
) -> list[PipelineRecipes]:
    """Return every pipeline with its recipes; raise `EvaluationRefused` with the mistakes of all of them."""
    fwhm = _fwhm(recipe, changes, folder)
    found: list[PipelineRecipes] = []
    wrong: dict[str, None] = {}
    for pipeline in pipelines:
        try:
            words = [*changes, *_words(pipeline)]
            recipes = _Recipes(recipe, words, fwhm, folder)
            for case in (NONE, next(iter(CASES))):
                _check(recipes[case], pipeline)
            found.append(PipelineRecipes(pipeline, recipes))
        except RecipeError as error:
            wrong |= dict.fromkeys(f"{pipeline.name}: {_one_line(problem)}" for problem in error.diagnostics)
        except EvaluationRefused as error:
            wrong[f"{pipeline.name}: {error}"] = None
    if wrong:
        raise EvaluationRefused("\n".join(wrong))
    return found


def _one_line(problem: Diagnostic) -> str:
    return " ".join(str(RecipeError([problem])).split())


def _words(pipeline: Pipeline) -> list[str]:
    """Return the changes of the recipe that make it this pipeline."""
    words = [f"doe={pipeline.mask}"]
    if pipeline.height_file:
        words.append(f"doe.{_takes('doe', pipeline.mask)}={pipeline.height_file.absolute()}")
    if pipeline.restorer != NONE:
        words.append(f"restore={pipeline.restorer}")
    if pipeline.weights:
        words.append(f"restore.{_takes('restore', pipeline.restorer)}={pipeline.weights.absolute()}")
    return words


def _takes(group: str, option: str) -> str:
    """Return the parameter by which an option of a group takes a file."""
    options = groups_of(packaged()).get(group, [])
    path = packaged() / group / f"{option}.yaml"
    if option == NONE or (option in options and not path.is_file()):
        raise EvaluationRefused(f"{option} takes no file")
    if not path.is_file():
        raise EvaluationRefused(f"no option {option} in {group}; {nearest(option, options)}")
    text = path.read_text(encoding="utf-8")
    for name in FILES:
        if re.search(rf"\b{name}: null", text):
            return name
    raise EvaluationRefused(f"{option} takes no file")


def _laser(metres: float | None, fwhm: float) -> str:
    """Return the lasers of a case as an argument.

    The strength of 1 stands for all strengths, and a direction is drawn for each scene.
    """
    if metres is None:
        return "lasers={}"
    line = f"wavelength: {metres * 1e9:g} nm, fwhm: {fwhm * 1e9:g} nm"
    return f"lasers={{{BEAM}: {{{line}, strength: 1, angle: null}}}}"


def _fwhm(recipe: str, changes: Sequence[str | Override], folder: Path) -> float:
    """Return the width of the recipe's own first line; 10 nm where the recipe has no laser."""
    try:
        steps = load(recipe, changes, folder).steps
    except RecipeError as error:
        raise EvaluationRefused("\n".join(dict.fromkeys(map(_one_line, error.diagnostics)))) from None
    widths = [step.params["fwhm"] for name, step in steps.items() if name.startswith("line[")]
    return float(widths[0]) if widths else 10e-9


def _check(recipe: Recipe, pipeline: Pipeline) -> None:
    lacking = [name for name in ("scene", *pipeline.outputs, "lsr[mask]", "mtf[mask]") if name not in recipe.steps]
    if lacking:
        raise EvaluationRefused(f"an evaluation needs the steps {', '.join(lacking)}, which {recipe.name} lacks")
