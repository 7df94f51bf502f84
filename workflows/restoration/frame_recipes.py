"""The recipe that restores a frame, from a camera and the frames given by a user."""

from __future__ import annotations

import json
import re
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from neusee.nodes.sensor import FRAME_SUFFIXES
from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.text.composition import compose
from neusee.workflows.recipe.text.overrides import Override, read_override
from neusee.workflows.recipe.text.yaml_values import Value, read

# --- frame files ----------------------------------------------------------------------------------

# The frame files given by a user: single files, or all frames in a folder.


def named_frames(words: Iterable[str], folder: Path) -> list[Path]:
    """Return the absolute paths of frames; a folder is replaced by its frames, sorted by name.

    Raises `RecipeError` with every argument that is no file, no folder, or a folder without frames.
    """
    paths, problems = list[Path](), list[Diagnostic]()
    for number, word in enumerate(words, 1):
        files = list(_named(folder / Path(word).expanduser()))
        if not files:
            problems.append(
                Diagnostic(Location(f"argument {number}"), word, _absent(folder / word))
            )
        paths += files
    if problems:
        raise RecipeError(problems)
    return list(dict.fromkeys(paths))


def _named(path: Path) -> Iterator[Path]:
    """Yield the frames of a path.

    A file is a frame; a folder yields the frames in it, sorted by name.
    """
    if path.is_file():
        yield path
    elif path.is_dir():
        files = (
            file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")
        )
        yield from sorted(file for file in files if file.suffix.lower() in FRAME_SUFFIXES)


def _absent(path: Path) -> str:
    """Return the reason why a path gives no frame."""
    if path.is_dir():
        return f"the folder has no frames: give files that end in {', '.join(FRAME_SUFFIXES)}"
    return "no such file or folder: give the path of a frame, or of a folder of frames"


# --- frame recipes --------------------------------------------------------------------------------

# The recipe that restores a frame: the camera of another recipe or of a sensor file, with the frame
# as its picture.


OUTPUTS = ("raw[mask]", "developed[mask]", "clipped[mask]", "restored", "restored_spread")
PLAIN_CAMERA = "first_light"  #: recipe for a sensor file, with a plain lens
#: steps of the groups `scene` and `lift`, which a measured frame does not need
_SCENE = ("scene", "cube")
_DROPPED = ("rival", "damage", "safety")  #: groups that compare or judge a simulated laser
#: restorers for a measured PSF
_WITH_PSF = {"restore=measured": "measured", "restore=search": "measured_search"}
_STEM = re.compile(r"[^\w-]+")


class FrameCamera(NamedTuple):
    """The camera that took the frames, as given by a user; empty for values not given."""

    camera: str  #: a recipe, or the file of a sensor group
    mask: str = ""  #: an option of the group `doe`, or the file of a height map
    psf: str = ""  #: a folder of frames of point sources, from which the PSF is measured


class _CameraRecipe(NamedTuple):
    """The recipe of a camera, the base folder of its paths, and the overrides that choose sensor,
    mask and PSF.
    """

    name: str
    folder: Path
    words: list[Override]


def recipes_of(
    frames: Iterable[Path], camera: FrameCamera, changes: Sequence[str], folder: Path, first: int
) -> list[Recipe]:
    """Return a checked recipe for each frame.

    ``changes`` are the user's overrides, numbered from ``first``. Raises `RecipeError` with the
    errors of all frames, each error once.
    """
    camera_recipe = _camera(camera.camera, folder)
    camera_recipe.words.extend(_mask(camera.mask, folder))
    camera_recipe.words.extend(_psf(camera.psf, changes, folder, first))
    frames, recipes, problems = list(frames), list[Recipe](), dict[Diagnostic, None]()
    # the restorer for a measured PSF is already among the overrides
    numbered_changes = [
        (number, text)
        for number, text in enumerate(changes, first)
        if not camera.psf or text not in _WITH_PSF
    ]
    for frame in frames:
        try:
            recipes.append(_recipe_of(frame, camera_recipe, numbered_changes, folder))
        except RecipeError as error:
            problems |= dict.fromkeys(error.diagnostics)
    if problems:
        raise RecipeError(problems)
    return recipes


def _recipe_of(
    frame: Path, camera: _CameraRecipe, changes: Sequence[tuple[int, str]], folder: Path
) -> Recipe:
    """Return the recipe that restores one frame; ``changes`` are the numbered overrides of the
    user.
    """
    overrides = [
        read_override(text, Location(f"argument {number}", folder=str(folder)))
        for number, text in changes
    ]
    file = _program_word(
        "frame", f"frame.file={_quoted(frame)}", folder, shown_as=str(_near(frame, folder))
    )
    # the user's overrides come last, so that they take precedence
    recipe = load(
        camera.name,
        [*_prepared(camera.name, camera.folder, overrides), *camera.words, file, *overrides],
        camera.folder,
    )
    title = f"The frame {frame.name}, restored with the camera {camera.name}"
    return replace(recipe, name=f"restore_{_STEM.sub('_', frame.stem)}", title=title)


def _camera(camera: str, folder: Path) -> _CameraRecipe:
    """Return the recipe of a camera, with the overrides that choose a sensor."""
    path = folder / Path(camera).expanduser()
    if (
        not camera.endswith((".yaml", ".yml"))
        or not path.is_file()
        or "steps" in (items := _items(path))
    ):
        return _CameraRecipe(camera, folder, [])
    if "sensor" not in items or ("defaults" in items and path.parent.name != "sensor"):
        return _CameraRecipe(camera, folder, [])
    if path.parent.name != "sensor" or path.suffix != ".yaml":
        message = (
            "the file has only a sensor: put it into a folder called sensor, as neusee new sensor"
            " does"
        )
        raise RecipeError([Diagnostic(Location("--camera"), camera, message)])
    words = [f"sensor={path.stem}", "doe=flat"]
    return _CameraRecipe(
        PLAIN_CAMERA,
        path.absolute().parent.parent,
        [_program_word("--camera", word, folder) for word in words],
    )


def _items(path: Path) -> set[str]:
    """Return the top-level keys of a YAML file."""
    return set(map(str, read(path, path.name).root.items))


def _mask(mask: str, folder: Path) -> list[Override]:
    """Return the overrides that put a mask into the pupil; ``mask`` is an option of the group `doe`
    or a height-map file.
    """
    if not mask:
        return []
    path = folder / Path(mask).expanduser()
    if path.is_file():
        return [
            _program_word("--mask", word, folder)
            for word in ("doe=pixelwise", f"doe.file={_quoted(path)}")
        ]
    if path.suffix or "/" in mask:
        message = "no such file: give a height map, or the name of an option of the group doe"
        raise RecipeError([Diagnostic(Location("--mask"), mask, message)])
    return [_program_word("--mask", f"doe={mask}", folder)]


def _psf(psf: str, changes: Sequence[str], folder: Path, first: int) -> list[Override]:
    """Return the overrides that replace the PSF of the recipe by one measured from the frames of a
    folder.
    """
    if not psf:
        return []
    restorer = "measured"
    for number, text in enumerate(changes, first):
        if text.startswith("restore="):
            restorer = _WITH_PSF.get(text, "")
        if not restorer:
            message = (
                "a measured PSF has a filter of its own, or restore=search: leave out --psf, or"
                " this restorer"
            )
            raise RecipeError([Diagnostic(Location(f"argument {number}"), text, message)])
    try:
        files = named_frames([psf], folder)
    except RecipeError as error:
        raise RecipeError(
            [replace(problem, mark=Location("--psf")) for problem in error.diagnostics]
        ) from None
    points_text = "points.files=[" + ", ".join(map(_quoted, files)) + "]"
    # (override, text shown in messages instead of it)
    words = [(f"restore={restorer}", ""), ("steps.level.from.psf=measured", ""), (points_text, psf)]
    return [_program_word("--psf", word, folder, shown_as) for word, shown_as in words]


def _prepared(name: str, base: Path, own: Sequence[Override]) -> list[Override]:
    """Return the overrides that turn a camera recipe into one for restoration: no scene, no laser,
    other outputs.
    """
    composed_recipe = compose(name, (), base)
    root, groups = composed_recipe.root, set(composed_recipe.groups)
    overridden = {override.path[0] for override in own}
    words = _without_scene(groups)
    if not overridden & {"laser", "lasers"}:
        words += _no_laser(groups, composed_recipe.own_blocks)
    if "restore" not in overridden:
        words.append("restore=wiener_blind" if "restore" in groups else "+restore=wiener_blind")
    words += _simulated_steps(root)
    # expected numbers apply only to the simulated scene
    if "expect" in root.items.keys() - overridden:
        words.append("~expect")
    if "outputs" not in overridden:
        words.append("outputs=" + json.dumps(OUTPUTS))
    return [_program_word("neusee restore", word, base) for word in words]


def _simulated_steps(root: Value) -> list[str]:
    """Return the overrides that keep the steps of the scene in the simulated arm."""
    steps = root.items["steps"].items if "steps" in root.items else {}
    return [f"+steps.{step}.each=simulated" for step in _SCENE if step in steps]


def _without_scene(groups: Container[str]) -> list[str]:
    """Return the overrides that put frames in place of the camera, and remove groups for simulated
    lasers.
    """
    words = ["camera=frame"] if "camera" in groups else []
    return [*words, *(f"~{group}" for group in _DROPPED if group in groups)]


def _no_laser(groups: Container[str], blocks: Container[str]) -> list[str]:
    """Return the overrides that remove the lasers from a recipe."""
    words = ["laser=none"] if "laser" in groups else []
    return [*words, "lasers={}"] if "lasers" in blocks else words


def _program_word(where: str, text: str, folder: Path, shown_as: str = "") -> Override:
    """Return an override that the program itself adds.

    In messages ``where`` is its place, and ``shown_as`` its text if given.
    """
    override = read_override(text, Location(where, folder=str(folder)))
    return replace(override, text=shown_as) if shown_as else override


def _quoted(path: Path) -> str:
    """Return a path as a quoted YAML text, so that no character has a special meaning."""
    return "'" + str(path.absolute()).replace("'", "''") + "'"


def _near(path: Path, folder: Path) -> Path:
    """Return a path relative to ``folder`` if it is inside it; else unchanged."""
    return path.relative_to(folder) if path.is_relative_to(folder) else path
