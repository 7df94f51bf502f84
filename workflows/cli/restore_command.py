"""The command ``neusee restore``: the scene from a frame that somebody took, and what is not known of it."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from neusee.workflows.cli.command_frame import fail, failing, refusing, say, split_frames, the_store
from neusee.workflows.cli.command_list import FAILED
from neusee.workflows.cli.command_options import (
    AsJson,
    Debug,
    Device,
    Memory,
    Out,
    Quiet,
    check_device,
    option_words,
    within_memory,
)
from neusee.workflows.cli.interruption import kept_in, print_warning, resumable, say_json

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.simulation.simulate_recipe import Simulation
    from neusee.workflows.store.result_store import Store

Frames = Annotated[
    list[str],
    typer.Argument(
        metavar="FRAME... [OVERRIDE]...",
        help="Frames or folders of frames, then changes: a.b=1, +a.b=1, ~a.b, restore=wiener.",
        show_default=False,
    ),
]


def restore(
    words: Frames,
    camera: Annotated[str, typer.Option("--camera", help="Recipe of the camera, or file of its sensor group.")],
    mask: Annotated[str, typer.Option("--mask", help="Mask: an option of the group doe, or a height-map file.")] = "",
    psf: Annotated[str, typer.Option("--psf", help="Folder of frames of point sources: measure the PSF.")] = "",
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    device: Device = "cpu",
    memory: Memory = "",
    out: Out = Path("runs"),
) -> None:
    """Restore the scene from frames that a camera took.

    A frame has the digital numbers of the sensor in three channels, without a tone curve: PNG or TIFF of 8 or 16 bits,
    OpenEXR or .npy. Of the recipe --camera the lens, mask, sensor and illuminant count, not the scene and the laser.
    With --psf, the PSF by field is measured from frames of point sources, and its error enters the uncertainty.
    The page has the picture, the uncertainty of each pixel, and what is invented because pixels were saturated.
    """
    frames, changes, first = split_frames(words)
    check_device(device)
    folder = Path.cwd()
    from neusee.workflows.restoration.frame_files import named_frames
    from neusee.workflows.restoration.frame_recipes import recipes_of

    with within_memory(memory) as limit, refusing():
        files = named_frames(frames, folder)
        recipes = recipes_of(files, camera, mask, changes, folder, first, psf)
    store, silent = the_store(), quiet or as_json
    options = option_words({"camera": camera, "mask": mask, "psf": psf})
    from neusee.workflows.graph.run_error import RunError

    with resumable(lambda: kept_in(store, "finished steps are")), failing(RunError, code=FAILED):
        for file, recipe in zip(files, recipes, strict=True):
            command = ["neusee", "restore", str(file), *changes, *options]
            done = _restored(recipe, store, out, command, (device, limit), silent)
            _say(done, as_json, quiet)


def _restored(
    recipe: Recipe, store: Store, out: Path, command: list[str], place: tuple[str, int | None], silent: bool
) -> Simulation:
    """Run the recipe of a frame, with the lines of its steps unless the command is silent."""
    from neusee.workflows.explain.run_forecast import lanes_for, planned
    from neusee.workflows.report import console, contents
    from neusee.workflows.simulation.simulate_recipe import simulate
    from neusee.workflows.tolerance.cheaper_steps import with_substitutions

    device, limit = place
    plan = planned(recipe, store, lanes_for(recipe, device, limit))
    if plan.refused:
        fail(f"{'memory' if limit is None else '--memory'}: {plan.refused}; nothing was run")
    if not silent:
        say(console.opening(recipe, shlex.join(command[1:])))
    cheaper = with_substitutions(recipe, contents.wanted(recipe))
    with console.RunTable(cheaper, contents.steps_of(cheaper), console.mode_for(silent), {}) as table:
        return simulate(cheaper, store, out, command, device, table.watch, None, limit)


def _say(done: Simulation, as_json: bool, quiet: bool) -> None:
    if as_json:
        say_json({"report": str(done.page), **done.document})
    elif quiet:
        say([str(done.page)])
    else:
        from neusee.workflows.report.console import story_lines

        say(
            [
                *story_lines(done.document),
                "",
                f"restored {done.folder / 'data' / 'restored.png'}",
                f"report   {done.page}",
            ]
        )
    for line in done.document["warnings"] if quiet or as_json else ():
        print_warning(line)
