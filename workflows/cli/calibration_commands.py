"""The commands ``neusee calibrate`` and ``neusee sheet``, both from calibration frames."""

from __future__ import annotations

import json
import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.command_frame import (
    AsJson,
    Debug,
    FewLines,
    Out,
    Quiet,
    Words,
    fail,
    failing,
    kept_in,
    load,
    option_words,
    refusing,
    resumable,
    say,
    say_folder,
    say_line,
    split,
    the_store,
)
from neusee.workflows.cli.commands_and_exit_codes import FAILED, MISSED
from neusee.workflows.keys.sealed_files import text_of

if TYPE_CHECKING:
    from neusee.workflows.calibration.emva_sheet import Release
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.store.result_store import Store


# --- calibrate command ----------------------------------------------------------------------------

# The command ``neusee calibrate``: find the posterior of a sensor from calibration frames.


def calibrate(
    words: Words = None,
    walkers: Annotated[
        int,
        typer.Option(
            "--walkers", min=16, max=100_000, help="Walkers in each of the four ensembles."
        ),
    ] = 64,
    move: Annotated[
        str,
        typer.Option("--move", help="Move of the walkers: de (differential evolution) or stretch."),
    ] = "de",
    sensor: Annotated[
        str,
        typer.Option(
            "--sensor",
            help="Of a folder of frames: also write the sensor group sensor/NAME.yaml here.",
        ),
    ] = "",
    draws: Annotated[
        int,
        typer.Option("--draws", min=100, max=10_000_000, help="Least number of independent draws."),
    ] = 1000,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Find the posterior of a sensor from calibration frames.

    In place of a recipe, name a folder of frames: neusee calibrate lab. Names, headers or a table
    frames.csv tell exposure and light. Before drawing, the command says which parameters the frames
    cannot constrain. Afterwards it checks chains and fit; where a check fails, the page has a red
    banner and the exit code is 3. Run the same command again to continue. Needs: pip install -e
    ".[calibrate]".
    """
    store, target = the_store(), _target(sensor)
    recipe, command, is_folder = _loaded(words, store, quiet or as_json)

    options: dict[str, Any] = {"walkers": walkers, "move": move, "draws": draws}
    command += option_words({**options, "sensor": sensor})
    if target and not is_folder:
        fail("--sensor needs a folder of frames, such as `neusee calibrate lab --sensor mine`")
    with (
        resumable(lambda: kept_in(store, "the draws up to the last line above are")),
        failing(lazy.errors.RunError, ValueError, ImportError, code=FAILED),
        failing(
            lazy.run_calibration.CalibrationRefused,
            code=FAILED,
            before="refused, nothing was drawn: ",
        ),
    ):
        folder = lazy.verbs.calibrate(
            recipe,
            store=store,
            out=out,
            command=command,
            progress=FewLines(quiet or as_json),
            **options,
        )
    _say_results(folder, quiet, as_json)
    if is_folder:
        _write_sensor(folder, recipe, store, target, quiet or as_json)


def _say_results(folder: Path, quiet: bool, as_json: bool) -> None:
    """Print a line for each parameter, and the folder; end the command with the reason if a
    check fails.
    """
    document = json.loads(text_of(folder / "posterior.json"))
    if not quiet and not as_json:
        say(_lines(document["parameters"]))
    say_folder(folder, as_json)
    if count := document["failed"]:
        failed_checks = "; ".join(
            f"{check['name']}: {check['found']}"
            for check in document["checks"]
            if check["mark"] == "fail"
        )
        checks = "1 check fails" if count == 1 else f"{count} checks fail"
        fail(f"not fit for use: {checks} ({failed_checks}); see {folder / 'report.html'}", MISSED)


def _target(sensor: str) -> Path | None:
    """Return the file of the sensor group that ``--sensor`` names, or None.

    A wrong name ends the command.
    """
    if not sensor:
        return None

    with failing(ValueError):
        return lazy.sensor_group.sensor_target(sensor, Path.cwd())


def _loaded(words: list[str] | None, store: Store, quiet: bool) -> tuple[Recipe, list[str], bool]:
    """Return the recipe of a folder of frames or the named recipe, the command line, and True
    for a folder.
    """
    name, changes, _ = split(words)
    if not Path(name).is_dir() or _is_recipe(name):
        return *load(words, "calibrate"), False

    with failing(ValueError, before="nothing was drawn: "), refusing():
        report = lazy.study_report.silent if quiet else say_line
        recipe = lazy.folder_recipe.recipe_of_folder(Path(name), store, changes, report)
        return recipe, ["neusee", "calibrate", name, *changes], True


def _is_recipe(name: str) -> bool:
    """Return True for the name of a recipe, which takes precedence over a folder of the
    same name.
    """
    return name in {recipe.name for recipe in lazy.loading.recipes()}


def _write_sensor(
    results: Path, recipe: Recipe, store: Store, target: Path | None, quiet: bool
) -> None:
    """Write the sensor group of a calibration into its folder, and to ``target`` if that is
    given.
    """
    with failing(ValueError, code=FAILED):
        text = lazy.sensor_group.sensor_text(
            results, lazy.sensor_group.frames_of_sensor(recipe, store)
        )
    for file in filter(None, (results / "sensor" / "mine.yaml", target)):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
        if not quiet:
            say([f"sensor group: {file}"])


def _lines(parameters: dict[str, dict[str, object]]) -> list[str]:
    """Return a line for each parameter in the document of a calibration."""
    # NaN for what the frames do not determine, which the file does not contain
    unknown = dict.fromkeys(("mean", "sd", "low", "high"), math.nan)
    row_type = lazy.calibration_page.ParameterEstimate
    rows = [row_type(**{**unknown, **row}) for row in parameters.values()]  # type: ignore[arg-type]
    return [f"{row.name.replace('_', ' '):20s} {row.text}" for row in rows]


# --- sheet command --------------------------------------------------------------------------------

# The command ``neusee sheet``: the quantities and plots of EMVA 1288 from frames of flat light.


class StandardRelease(StrEnum):
    """Release of EMVA 1288 whose temporal variance is used."""

    four = "4"
    three = "3"


def sheet(
    words: Words = None,
    release: Annotated[
        StandardRelease | None,
        typer.Option(
            "--release",
            help=(
                "3 keeps the difference of the means of a pair in its variance. Default: as the"
                " descriptor states, "
                "else 4."
            ),
        ),
    ] = None,
    relative: Annotated[
        bool,
        typer.Option(
            "--relative", help="Photons are known up to a factor: state nothing in photons."
        ),
    ] = False,
    state: Annotated[
        list[str] | None,
        typer.Option(
            "--state",
            help=(
                "State a fact that the standard asks for: --state 'temperature=25 °C'; repeatable."
            ),
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Write the EMVA 1288 sheet of a camera from frames.

    In place of a recipe, name the descriptor of a measurement, its folder, or a folder of frames:
    neusee sheet set. Page, PDF, JSON and CSV have every quantity with the symbol of the standard,
    or the reason why the frames do not tell it. Where rounding hides the dark noise, the page has a
    red banner and the exit code is 3.
    """
    recipe, command = _loaded_camera(words, quiet or as_json)
    stated_facts, edition = state or (), _edition(release)
    command += option_words({"release": edition, "relative": relative})
    for fact in stated_facts:
        command += ["--state", fact]
    with failing(lazy.errors.RunError, code=FAILED), failing(ValueError):
        statements = lazy.run_sheet.SheetStatements(edition, relative, stated_facts)
        folder = lazy.run_sheet.write_sheet(recipe, the_store(), out, command, statements)
    document = json.loads(text_of(folder / "emva1288.json"))
    if not quiet and not as_json:
        say(
            [
                *(_line(quantity) for quantity in document["quantities"].values()),
                document["temporal variance"],
            ]
        )
    say_folder(folder, as_json)
    if document["fails"]:
        fail(f"{document['fails']} See {folder / 'report.html'}", MISSED)


def _edition(release: StandardRelease | None) -> Release | None:
    """Return the release of the standard as the sheet names it."""
    if release is None:
        return None
    return "3" if release is StandardRelease.three else "4"


def _loaded_camera(words: list[str] | None, quiet: bool) -> tuple[Recipe, list[str]]:
    """Return the recipe of a descriptor or the named recipe, and the command line."""
    name, changes, _ = split(words)
    if Path(name).suffix.lower() != ".txt" and not Path(name).is_dir():
        return load(words, "sheet")

    with failing(ValueError, before="nothing was computed: "), refusing():
        if Path(name).is_dir() and not lazy.folder_recipe.descriptors_in(Path(name)):
            report = lazy.study_report.silent if quiet else say_line
            recipe = lazy.folder_recipe.recipe_of_folder(
                Path(name), the_store(), changes, report, every_pixel=True
            )
            return recipe, ["neusee", "sheet", name, *changes]
        descriptor = lazy.folder_recipe.descriptor_of(Path(name))
        return lazy.emva_sheet.descriptor_recipe(descriptor, changes), [
            "neusee",
            "sheet",
            name,
            *changes,
        ]


def _line(quantity: dict[str, object]) -> str:
    """Return the line of a quantity in the document of a sheet.

    It has symbol, value and name, and in brackets a reason why there is no value or only a limit.
    """
    fields = {name: value for name, value in quantity.items() if name != "section"}
    quantity_of_sheet = lazy.calibrate.Quantity(**fields)  # type: ignore[arg-type]
    return (
        f"{quantity_of_sheet.symbol:18s} {quantity_of_sheet.text:22s} {quantity_of_sheet.name}"
        + f" ({quantity_of_sheet.reason})" * bool(quantity_of_sheet.reason)
    )
