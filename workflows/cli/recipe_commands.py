"""Commands on recipes and runs: run, validate, plan, why, report, safety, sweep, restore …"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.command_frame import (
    AsJson,
    Debug,
    Device,
    Exact,
    Memory,
    Out,
    Quiet,
    Words,
    check_device,
    check_executor,
    executor_of,
    fail,
    failing,
    kept_in,
    load,
    option_words,
    print_warning,
    refusing,
    resumable,
    say,
    say_json,
    say_line,
    search_for_garbage,
    split,
    split_frames,
    the_store,
    within_memory,
)
from neusee.workflows.cli.commands_and_exit_codes import FAILED, MISSED, TYPED
from neusee.workflows.cli.repetition import keep_answer, keep_run, say_and_keep
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.report.run_folder import find_run, rebuild
from neusee.workflows.report.terminal_text import commands_to_try, json_line

if TYPE_CHECKING:
    from neusee.workflows.explain.run_forecast import Plan
    from neusee.workflows.graph.recipe_graph import Recipe
    from neusee.workflows.simulation.simulate_recipe import RunOptions, Simulation
    from neusee.workflows.store.result_store import Store
    from neusee.workflows.sweeps.sweep_points import OnError


# --- recipe commands ------------------------------------------------------------------------------

# The commands for one recipe or one run of a recipe: run, validate, plan, why, config and report.


Rerun = Annotated[
    list[str] | None,
    typer.Option(
        "--rerun",
        metavar="STEP",
        help="Compute this step, and all that follow, though stored; repeatable.",
    ),
]
Where = Annotated[
    str,
    typer.Option(
        "--executor",
        help="Who computes: local, dask:4 (workers), slurm:4 (jobs), or tcp://scheduler:8786.",
    ),
]
Job = Annotated[
    list[str] | None,
    typer.Option(
        "--job",
        metavar="NAME=VALUE",
        help="What a job of SLURM asks for: queue=gpu, cores=4; repeatable.",
    ),
]


def run(
    words: Words = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
    device: Device = "cpu",
    executor: Where = "local",
    job: Job = None,
    memory: Memory = "",
    exact: Exact = False,
    rerun: Rerun = None,
    out: Out = Path("runs"),
) -> None:
    """Run a recipe and write its report.

    Steps whose results are in the cache are not computed again. Without a name the recipe is
    first_light. The folder of results holds report.html, the numbers, the pictures and the recipe
    with every final value.
    """
    job_options, steps_to_rerun = job or [], rerun or []
    check_executor(executor, job_options)
    with within_memory(memory) as limit:
        recipe, command = load(words, "run", exact=exact)
    _check_rerun(recipe, steps_to_rerun)

    check_device(device)
    is_silent = as_json or quiet
    # the lines are kept, so that a repetition can print them again
    printed_before = _opening(recipe, command, is_silent)
    store = the_store()
    predicted_seconds = _predicted(recipe, store, device, limit, executor == "local", is_silent)
    cheaper_recipe = lazy.cheaper_steps.with_substitutions(recipe, lazy.wanted_steps.wanted(recipe))
    table = lazy.console.RunTable(
        cheaper_recipe,
        lazy.wanted_steps.steps_of(cheaper_recipe),
        lazy.console.mode_for(is_silent),
        predicted_seconds,
    )
    # imported before the table appears
    simulation_module = lazy.simulate_recipe
    with (
        resumable(
            lambda: kept_in(
                store, f"{table.finished} steps are finished, and results that take time are"
            )
        ),
        executor_of(executor, store, job_options, _speaker(is_silent)) as cluster,
        table,
    ):
        options = simulation_module.RunOptions(
            device, cluster, limit, steps_to_rerun, watch=table.watch
        )
        simulation = simulation_module.simulate(cheaper_recipe, store, out, command, options)
    if is_silent:
        hints = []
        _say_briefly(simulation, as_json)
    else:
        # without `neusee run`, and without --exact
        recipe_words = command[2:-1] if exact else command[2:]
        hints = commands_to_try(recipe, recipe_words, _loads)
        say(lazy.console.closing(simulation.document, str(simulation.page), hints))
    if simulation.document["missed"]:
        raise typer.Exit(MISSED)
    # such a run can be answered from what is stored
    if executor == "local" and not steps_to_rerun:
        keep_run(
            _text([*printed_before, *table.printed()], simulation, hints),
            as_json,
            out,
            simulation,
            recipe,
            store,
        )


def _speaker(silent: bool) -> Callable[[str], None]:
    """Return a function that prints a line, or that prints nothing if ``silent``."""

    def speak(line: str) -> None:
        if not silent:
            say_line(line)

    return speak


def _opening(recipe: Recipe, command: Sequence[str], silent: bool) -> list[str]:
    """Print the lines before a run, unless silent, and return them."""
    if silent:
        return []
    lines = lazy.checked_recipe.opening(recipe, shlex.join(command[1:]))
    say(lines)
    return lines


def _check_rerun(recipe: Recipe, names: Sequence[str]) -> None:
    """End the command for a name in ``--rerun`` that no step has."""
    try:
        lazy.recipe_graph.copies_of(recipe, names)
    except ValueError as error:
        fail(f"--rerun: {error}")


def _text(
    before: Sequence[str], done: Simulation, hints: Sequence[str]
) -> Callable[[str, str], str]:
    """Return a function that returns all that a run has printed, for the folder and the seconds of
    the run.

    Without ``hints`` that is the path of the page alone.
    """

    def text(folder: str, took: str) -> str:
        page = f"{folder}/report.html"
        return (
            "\n".join([*before, *lazy.console.closing(done.document, page, hints, took)])
            if hints
            else page
        )

    return text


def _say_briefly(done: Simulation, as_json: bool) -> None:
    """Print the path of the page of a run, or its document as JSON, and the warnings of the run
    on stderr.
    """
    if as_json:
        say_json({"report": str(done.page), **done.document})
    else:
        say([str(done.page)])
    for line in done.document["warnings"]:
        print_warning(line)


def _predicted(
    recipe: Recipe, store: Store, device: str, memory: int | None, local: bool, silent: bool
) -> dict[str, float]:
    """Print how long a run will take, and return the predicted seconds of each step, as far as they
    are known.

    A run on this machine ends before any step if the limit of memory, or the memory that is free,
    is too small.
    """
    if silent and not local:
        return {}
    plan = lazy.run_forecast.planned(
        recipe, store, lazy.run_forecast.lanes_for(recipe, device, memory)
    )
    if local:
        _refuse_beyond_memory(plan, memory)
    line = _forecast_of(plan)
    if line and not silent:
        say([line])
    slots = plan.schedule.slots if plan.schedule else ()
    return {slot.task: slot.end - slot.start for slot in slots if plan.expected[slot.task].known}


def _refuse_beyond_memory(plan: Plan, memory: int | None) -> None:
    """End the command for a run that needs more than ``--memory``, or than the free memory."""
    if plan.refused:
        fail(f"{'memory' if memory is None else '--memory'}: {plan.refused}; nothing was run")


def _forecast_of(plan: Plan) -> str:
    """Return the line that says how long a run will take; empty if its steps take less than a
    second, or if no time of a step is known.
    """
    estimates = plan.expected.values()
    unknown_count = sum(not estimate.known for estimate in estimates)
    seconds_of_steps = plan.schedule.makespan if plan.schedule else 0.0
    if seconds_of_steps < 1 or unknown_count == len(estimates):
        return ""
    return lazy.console.forecast_line(
        seconds_of_steps + lazy.run_forecast.report_seconds(plan),
        len(estimates),
        unknown_count,
        sum(estimate.measured for estimate in estimates),
    )


def _loads(words: Sequence[str]) -> bool:
    """Return True if a recipe with its changes has no mistake."""
    try:
        lazy.loading.load(words[0], list(words[1:]))
    except RecipeError:
        return False
    return True


def validate(words: Words = None, as_json: AsJson = False, debug: Debug = False) -> None:
    """Check a recipe without running it.

    All mistakes are listed at once, each with its file, line and column and the nearest known name.
    """
    recipe, command = load(words, "run", runs=False)

    if as_json:
        text = json_line(
            {
                "valid": True,
                "command": shlex.join(command),
                **lazy.checked_recipe.contents_of(recipe),
            }
        )
    else:
        text = "\n".join(lazy.checked_recipe.opening(recipe, shlex.join(command[1:])))
    say_and_keep(text, recipe)


def plan(
    words: Words = None,
    as_json: AsJson = False,
    debug: Debug = False,
    device: Device = "cpu",
    memory: Memory = "",
    exact: Exact = False,
    devices: Annotated[
        str,
        typer.Option(
            "--devices", help="Simulate these machines: a YAML file, or the example eight_a100."
        ),
    ] = "",
) -> None:
    """Show which steps a run would compute, where and for how long.

    Nothing is computed. Bytes follow from the shape of each result; seconds and memory from laws of
    each node that were measured, and from earlier runs on this machine, each with its range. A
    guess for a node without a measurement is marked and counts at its upper end. Of a recipe that
    trains, the answer is the training: iterations, hours and memory. With --devices the
    run is simulated on machines that you do not have: makespan, utilisation and critical path.
    """
    with within_memory(memory) as limit:
        recipe, command = load(words, "plan", exact=exact)

    check_device(device)
    store = the_store()
    if devices:
        with refusing():
            forecast = lazy.run_forecast.Forecast(
                lazy.run_forecast.simulated_lines(recipe, store, devices), [], {}, False
            )
    elif recipe.training is not None or recipe.lifting is not None:
        forecast = lazy.training_forecast.forecast_training(recipe, store)
    else:
        forecast = lazy.run_forecast.forecast(recipe, store, device, limit)
    text = (
        json_line({"command": shlex.join(command), **asdict(forecast)})
        if as_json
        else "\n".join(forecast.lines)
    )
    # the answer holds while every result is stored
    if forecast.totals.get("steps") == 0 and not forecast.refused:
        say_and_keep(text, recipe, store, forecast.totals["memory_of_report"] or 0.0)
    else:
        say([text])
    if forecast.refused:
        raise typer.Exit(FAILED)


def why(
    step: Annotated[str, typer.Argument(help="A step, such as raw or raw[mask].")],
    words: Words = None,
    debug: Debug = False,
    device: Device = "cpu",
) -> None:
    """Explain why a step differs from its nearest earlier result.

    The answer names the value that changed and where it was written, such as
    `sensor.read_noise 10.5 -> 20 e- (argument 2)`, or the code that changed.
    """
    recipe, _ = load(words, before=1)

    store = the_store()
    with failing(ValueError):
        lines = lazy.why_rerun.why_lines(recipe, store, step, device)
    say_and_keep("\n".join(lines), recipe, store)


def config(words: Words = None, debug: Debug = False) -> None:
    """Print every final value and where it comes from.

    The output is YAML: a recipe that can be run.
    """
    recipe, _ = load(words, runs=False)

    say_and_keep("\n".join(lazy.checked_recipe.recipe_text(recipe).splitlines()), recipe)


def report(
    folder: Annotated[
        str, typer.Argument(metavar="RUN_FOLDER", help="A run's folder, or `latest`.")
    ] = "latest",
    out: Annotated[
        Path, typer.Option("--out", help="Folder that holds the folders of runs.")
    ] = Path("runs"),
    debug: Debug = False,
) -> None:
    """Write the page of a run again from stored results."""
    with failing(FileNotFoundError):
        say([str(rebuild(find_run(folder, out)))])


# --- safety command -------------------------------------------------------------------------------

# The command ``neusee safety``: is the sensor damaged or dazzled by a laser, and from which
# distance?


def safety(
    words: Words = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Estimate damage and dazzle by a laser, and the distances.

    The recipe needs a block `safety` and a laser in watts: see safety_pointer. The page has the
    limits of the sensor with their sources, the distances where the laser exceeds them, behind the
    plain lens, a mask, a grey filter and a smaller stop, and the limit of the eye beside them. It
    is an estimate, not a certificate.
    """
    recipe, command = load(words, "safety")
    store = the_store()

    with refusing(), failing(lazy.errors.RunError, code=FAILED):
        folder, assessment = lazy.run_safety.assess(recipe, store, out, command)

    def text(page: str) -> str:
        if as_json:
            return json_line({"report": page, **assessment.document})
        return (
            page
            if quiet
            else "\n".join([*lazy.safety_text.lines(assessment.paragraphs), "", f"page   {page}"])
        )

    say([text(str(folder / "report.html"))])
    keep_answer(text, as_json, out, folder, assessment.report, recipe)


# --- sweep command --------------------------------------------------------------------------------

# The command ``neusee sweep``: run a recipe at several values of its parameters.


def sweep(
    words: Words = None,
    paired: Annotated[
        bool, typer.Option("--zip", help="Pair the values of the axes instead of combining them.")
    ] = False,
    on_error: Annotated[
        str,
        typer.Option("--on-error", help="After a failed point: stop, or continue with the next."),
    ] = "stop",
    workers: Annotated[
        int,
        typer.Option(
            "--workers",
            min=0,
            max=10_000,
            help="Number of points that run at the same time; 0: by free processors.",
        ),
    ] = 0,
    netcdf: Annotated[
        bool, typer.Option("--netcdf", help="Write sweep.nc too (needs neusee[xarray]).")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
    device: Device = "cpu",
    out: Out = Path("runs"),
) -> None:
    """Run a recipe at several values of its parameters.

    Write values as a=1,2,3 or b='linspace(450 nm, 650 nm, 5)'. All combinations run unless --zip
    pairs them. Run the same command again to continue a sweep that was stopped.
    """
    name, words, first_number = split(words)
    if on_error not in ("stop", "continue"):
        fail(f"--on-error {on_error}: write stop or continue")
    check_device(device)
    store = the_store()

    # the comparison tells the type checker that the text is one of the two
    error_policy: OnError = "continue" if on_error == "continue" else "stop"
    with refusing(), resumable(lambda: kept_in(store, "the points that are finished are")):
        # many points create garbage, which the program otherwise never collects
        search_for_garbage()
        options = lazy.sweep_screen.SweepCommandOptions(
            zip=paired,
            on_error=error_policy,
            netcdf=netcdf,
            device=device,
            workers=workers,
            out=out,
            quiet=quiet,
            as_json=as_json,
        )
        code = lazy.sweep_screen.run_sweep(name, words, store, options, first_number)
    if code:
        raise typer.Exit(code)


# --- restore command ------------------------------------------------------------------------------

# The command ``neusee restore``: the scene from a frame of a real camera, and its uncertainty.


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
    camera: Annotated[
        str, typer.Option("--camera", help="Recipe of the camera, or file of its sensor group.")
    ],
    mask: Annotated[
        str, typer.Option("--mask", help="Mask: an option of the group doe, or a height-map file.")
    ] = "",
    psf: Annotated[
        str, typer.Option("--psf", help="Folder of frames of point sources: measure the PSF.")
    ] = "",
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    device: Device = "cpu",
    memory: Memory = "",
    out: Out = Path("runs"),
) -> None:
    """Restore the scene from frames that a camera took.

    A frame has the digital numbers of the sensor in three channels, without a tone curve: PNG or
    TIFF of 8 or 16 bits, OpenEXR or .npy. Of the recipe --camera the lens, mask, sensor and
    illuminant count, not the scene and the laser. With --psf, the PSF by field is measured from
    frames of point sources, and its error enters the uncertainty. The page has the picture, the
    uncertainty of each pixel, and what is invented because pixels were saturated.
    """
    frames, changes, first_number = split_frames(words)
    check_device(device)
    folder = Path.cwd()

    with within_memory(memory) as limit, refusing():
        files = lazy.frame_recipes.named_frames(frames, folder)
        frame_camera = lazy.frame_recipes.FrameCamera(camera, mask, psf)
        recipes = lazy.frame_recipes.recipes_of(files, frame_camera, changes, folder, first_number)
    store, silent = the_store(), quiet or as_json
    option_texts = option_words({"camera": camera, "mask": mask, "psf": psf})
    options = lazy.simulate_recipe.RunOptions(device, memory=limit)

    with (
        resumable(lambda: kept_in(store, "finished steps are")),
        failing(lazy.errors.RunError, code=FAILED),
    ):
        for file, recipe in zip(files, recipes, strict=True):
            command = ["neusee", "restore", str(file), *changes, *option_texts]
            simulation = _restored(recipe, store, out, command, options, silent)
            _say(simulation, as_json, quiet)


def _restored(
    recipe: Recipe,
    store: Store,
    out: Path,
    command: list[str],
    options: RunOptions,
    silent: bool,
) -> Simulation:
    """Run the recipe of a frame, with the lines of its steps unless the command is silent."""
    _refuse_beyond_memory(
        lazy.run_forecast.planned(
            recipe, store, lazy.run_forecast.lanes_for(recipe, options.device, options.memory)
        ),
        options.memory,
    )
    if not silent:
        say(lazy.checked_recipe.opening(recipe, shlex.join(command[1:])))
    cheaper_recipe = lazy.cheaper_steps.with_substitutions(recipe, lazy.wanted_steps.wanted(recipe))
    with lazy.console.RunTable(
        cheaper_recipe,
        lazy.wanted_steps.steps_of(cheaper_recipe),
        lazy.console.mode_for(silent),
        {},
    ) as table:
        return lazy.simulate_recipe.simulate(
            cheaper_recipe, store, out, command, replace(options, watch=table.watch)
        )


def _say(done: Simulation, as_json: bool, quiet: bool) -> None:
    """Print the result of one frame: its document, its page, or the lines of its story."""
    if as_json:
        say_json({"report": str(done.page), **done.document})
    elif quiet:
        say([str(done.page)])
    else:
        say(
            [
                *lazy.console.story_lines(done.document),
                "",
                f"restored {done.folder / 'data' / 'restored.png'}",
                f"report   {done.page}",
            ]
        )
    for line in done.document["warnings"] if quiet or as_json else ():
        print_warning(line)


# --- compare command ------------------------------------------------------------------------------

# The command ``neusee compare``: what differs between two runs?


_RUN = "A run's folder: a name below --out, a path, or `latest`."


def compare(
    left: Annotated[str, typer.Argument(help=_RUN)],
    right: Annotated[str, typer.Argument(help=_RUN)],
    fail_above: Annotated[
        float,
        typer.Option(
            "--fail-above",
            min=0.0,
            help="Exit with code 3 if a number differs by more, relatively.",
        ),
    ] = float("inf"),
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Compare two runs: numbers, pictures, recipe and code.

    The environment is compared too, and nothing is computed again. The page shows the pictures side
    by side with their difference. The exit code is 0 also where the runs differ, unless
    --fail-above says what may differ at most; a number that only one run has differs by more than
    any limit.
    """
    with failing(lazy.run_record.NotComparable):
        records = [lazy.run_record.read_record(where, out) for where in (left, right)]
        comparison = lazy.comparison_report.compare(*records)
    page = (
        lazy.comparison_report.write_comparison(comparison, out, ["neusee", *TYPED]) / "report.html"
    )
    if as_json:
        say_json({"report": str(page), **lazy.comparison_report.document(comparison)})
    elif quiet:
        say([str(page)])
    else:
        say([*lazy.comparison_report.lines(comparison), "", f"page   {page}"])
    if comparison.largest > fail_above:
        worst = max(comparison.numbers, key=lambda number: number.relative)
        fail(
            f"{worst.name} differs by {comparison.largest:.3g} relatively, more than"
            f" {fail_above:g}",
            MISSED,
        )
