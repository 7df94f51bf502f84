"""The command ``neusee sheet``: the quantities and plots of EMVA 1288 from frames of flat light."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from neusee.workflows.cli.command_frame import fail, failing, load, refusing, say, say_line, split, the_store
from neusee.workflows.cli.command_list import FAILED, MISSED
from neusee.workflows.cli.command_options import AsJson, Debug, Out, Quiet, Words, option_words
from neusee.workflows.cli.interruption import say_folder
from neusee.workflows.keys.regular_file import text_of

if TYPE_CHECKING:
    from neusee.workflows.calibration.emva_frames import Release
    from neusee.workflows.graph.recipe_graph import Recipe


class StandardRelease(StrEnum):
    """Release of EMVA 1288 whose variance in time is taken."""

    four = "4"
    three = "3"


def sheet(
    words: Words = None,
    release: Annotated[
        StandardRelease | None,
        typer.Option(
            "--release",
            help="3 keeps the difference of the means of a pair in its variance. Default: as the descriptor states, "
            "else 4.",
        ),
    ] = None,
    relative: Annotated[
        bool, typer.Option("--relative", help="Photons are known up to a factor: state nothing in photons.")
    ] = False,
    state: Annotated[
        list[str] | None,
        typer.Option(
            "--state", help="State a fact that the standard asks for: --state 'temperature=25 °C'; repeatable."
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Write the EMVA 1288 sheet of a camera from frames.

    In place of a recipe, name the descriptor of a measurement, its folder, or a folder of frames: neusee sheet set.
    Page, PDF, JSON and CSV have every quantity with the symbol of the standard, or the reason why the frames do not
    tell it. Where rounding hides the dark noise, the page has a red banner and the exit code is 3.
    """
    from neusee.workflows.calibration.run_sheet import write_sheet
    from neusee.workflows.graph.run_error import RunError

    recipe, command = _loaded(words, quiet or as_json)
    said = [word for fact in state or () for word in ("--state", fact)]
    chosen: Release | None = None if release is None else "3" if release is StandardRelease.three else "4"
    command += [*option_words({"release": chosen, "relative": relative}), *said]
    with failing(RunError, code=FAILED), failing(ValueError):
        folder = write_sheet(recipe, the_store(), out, command, release=chosen, relative=relative, state=state or ())
    document = json.loads(text_of(folder / "emva1288.json"))
    if not quiet and not as_json:
        say([*(_line(each) for each in document["quantities"].values()), document["temporal variance"]])
    say_folder(folder, as_json)
    if document["fails"]:
        fail(f"{document['fails']} See {folder / 'report.html'}", MISSED)


def _loaded(words: list[str] | None, quiet: bool) -> tuple[Recipe, list[str]]:
    """Return the recipe of a descriptor or the named recipe, and the command line."""
    name, changes, _ = split(words)
    if Path(name).suffix.lower() != ".txt" and not Path(name).is_dir():
        return load(words, "sheet")
    from neusee.workflows.calibration.emva_frames import descriptor_recipe
    from neusee.workflows.frames.descriptor_file import descriptor_of, descriptors_in
    from neusee.workflows.frames.folder_recipe import recipe_of_folder
    from neusee.workflows.report.study_folder import silent

    with failing(ValueError, before="nothing was computed: "), refusing():
        if Path(name).is_dir() and not descriptors_in(Path(name)):
            told = silent if quiet else say_line
            recipe = recipe_of_folder(Path(name), the_store(), changes, told, every_pixel=True)
            return recipe, ["neusee", "sheet", name, *changes]
        return descriptor_recipe(descriptor_of(Path(name)), changes), ["neusee", "sheet", name, *changes]


def _line(quantity: dict[str, object]) -> str:
    from neusee.nodes.calibrate import Quantity

    found = Quantity(**{name: value for name, value in quantity.items() if name != "section"})  # type: ignore[arg-type]
    return f"{found.symbol:18s} {found.text:22s} {found.name}" + f" ({found.reason})" * bool(found.reason)
