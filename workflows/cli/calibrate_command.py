"""The command ``neusee calibrate``: find the posterior of a sensor from calibration frames."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from neusee.workflows.cli.command_frame import fail, failing, load, refusing, say, say_line, split, the_store
from neusee.workflows.cli.command_list import FAILED, MISSED
from neusee.workflows.cli.command_options import AsJson, Debug, FewLines, Out, Quiet, Words, option_words
from neusee.workflows.cli.interruption import kept_in, resumable, say_folder
from neusee.workflows.keys.regular_file import text_of

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.store.result_store import Store


def calibrate(
    words: Words = None,
    walkers: Annotated[
        int, typer.Option("--walkers", min=16, max=100_000, help="Walkers in each of the four ensembles.")
    ] = 64,
    move: Annotated[
        str, typer.Option("--move", help="Move of the walkers: de (differential evolution) or stretch.")
    ] = "de",
    sensor: Annotated[
        str, typer.Option("--sensor", help="Of a folder of frames: also write the sensor group sensor/NAME.yaml here.")
    ] = "",
    draws: Annotated[
        int, typer.Option("--draws", min=100, max=10_000_000, help="Least number of independent draws.")
    ] = 1000,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Find the posterior of a sensor from calibration frames.

    In place of a recipe, name a folder of frames: neusee calibrate lab. Names, headers or a table frames.csv tell
    exposure and light. Before drawing, the command says which parameters the frames cannot constrain. Afterwards it
    checks chains and fit; where a check fails, the page has a red banner and the exit code is 3. Run the same command
    again to continue. Needs: pip install -e ".[calibrate]".
    """
    store, target = the_store(), _target(sensor)
    recipe, command, is_folder = _loaded(words, store, quiet or as_json)
    from neusee.workflows.api import verbs
    from neusee.workflows.calibration.run_calibration import CalibrationRefused
    from neusee.workflows.graph.run_error import RunError

    options: dict[str, Any] = {"walkers": walkers, "move": move, "draws": draws}
    command += option_words({**options, "sensor": sensor})
    if target and not is_folder:
        fail("--sensor needs a folder of frames, such as `neusee calibrate lab --sensor mine`")
    with (
        resumable(lambda: kept_in(store, "the draws up to the last line above are")),
        failing(RunError, ValueError, ImportError, code=FAILED),
        failing(CalibrationRefused, code=FAILED, before="refused, nothing was drawn: "),
    ):
        folder = verbs.calibrate(
            recipe, store=store, out=out, command=command, progress=FewLines(quiet or as_json), **options
        )
    _say_results(folder, quiet, as_json)
    if is_folder:
        _write_sensor(folder, recipe, store, target, quiet or as_json)


def _say_results(folder: Path, quiet: bool, as_json: bool) -> None:
    """Print a line for each parameter, and the folder; end the command with the reason if a check fails."""
    document = json.loads(text_of(folder / "posterior.json"))
    if not quiet and not as_json:
        say(_lines(document["parameters"]))
    say_folder(folder, as_json)
    if count := document["failed"]:
        wrong = "; ".join(f"{c['name']}: {c['found']}" for c in document["checks"] if c["mark"] == "fail")
        checks = "1 check fails" if count == 1 else f"{count} checks fail"
        fail(f"not fit for use: {checks} ({wrong}); see {folder / 'report.html'}", MISSED)


def _target(sensor: str) -> Path | None:
    if not sensor:
        return None
    from neusee.workflows.frames.sensor_group import sensor_target

    with failing(ValueError):
        return sensor_target(sensor, Path.cwd())


def _loaded(words: list[str] | None, store: Store, quiet: bool) -> tuple[Recipe, list[str], bool]:
    """Return the recipe of a folder of frames or the named recipe, the command line, and True for a folder."""
    name, changes, _ = split(words)
    if not Path(name).is_dir() or _is_recipe(name):
        return *load(words, "calibrate"), False
    from neusee.workflows.frames.folder_recipe import recipe_of_folder
    from neusee.workflows.report.study_folder import silent

    with failing(ValueError, before="nothing was drawn: "), refusing():
        told = silent if quiet else say_line
        recipe = recipe_of_folder(Path(name), store, changes, told)
        return recipe, ["neusee", "calibrate", name, *changes], True


def _is_recipe(name: str) -> bool:
    """Return True for the name of a recipe, which counts before a folder of the same name."""
    from neusee.workflows.recipe.loading import recipes

    return name in {recipe.name for recipe in recipes()}


def _write_sensor(results: Path, recipe: Recipe, store: Store, target: Path | None, quiet: bool) -> None:
    """Write the sensor group of a calibration into its folder, and to ``target`` if that is given."""
    from neusee.workflows.frames.sensor_group import frames_of_sensor, sensor_text

    with failing(ValueError, code=FAILED):
        text = sensor_text(results, frames_of_sensor(recipe, store))
    for file in filter(None, (results / "sensor" / "mine.yaml", target)):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
        if not quiet:
            say([f"sensor group: {file}"])


def _lines(parameters: dict[str, dict[str, object]]) -> list[str]:
    from neusee.workflows.calibration.calibration_page import ParameterEstimate

    unknown = dict.fromkeys(("mean", "sd", "low", "high"), math.nan)  # what the frames do not tell is not in the file
    rows = [ParameterEstimate(**{**unknown, **row}) for row in parameters.values()]  # type: ignore[arg-type]
    return [f"{row.name.replace('_', ' '):20s} {row.text}" for row in rows]
