"""The commands of ``neusee study``, and ``neusee evaluate``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.command_frame import (
    AsJson,
    Debug,
    OneDevice,
    Out,
    Quiet,
    Words,
    check_device,
    fail,
    failing,
    kept_in,
    load,
    option_words,
    progress_lines,
    refusing,
    resumable,
    say_folder,
    split,
    the_store,
)
from neusee.workflows.cli.commands_and_exit_codes import BAD, FAILED
from neusee.workflows.graph.errors import nearest

if TYPE_CHECKING:
    from collections.abc import Callable

    from neusee.workflows.api.verbs import Kind
    from neusee.workflows.graph.recipe_graph import Recipe


# --- study commands -------------------------------------------------------------------------------

# The commands of ``neusee study``: accuracy, stability, leave-out, calibration, uncertainty and
# protection.


study = typer.Typer(
    help="Study how accurate, stable and certain a recipe's numbers are.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


class Move(StrEnum):
    """The choices of ``--move``: the proposals for the Markov chain walkers of a calibration."""

    DE = "de"
    STRETCH = "stretch"


class Points(StrEnum):
    """The choices of ``--points``: how the values of uncertain inputs are sampled."""

    DRAWS = "draws"
    SOBOL = "sobol"


class Method(StrEnum):
    """The choices of ``--method``: how uncertain inputs are propagated to the outputs."""

    SAMPLING = "sampling"
    LINEAR = "linear"


class Light(StrEnum):
    """The choices of ``--light``: the kind of laser light, which decides what must be equal behind
    all compared protections.
    """

    PULSE = "pulse"
    CONTINUOUS = "continuous"


@study.command()
def accuracy(
    words: Words = None,
    seeds: Annotated[
        int,
        typer.Option(
            "--seeds", min=1, max=1_000_000, help="Number of noise draws for the error bars."
        ),
    ] = 3,
    quick: Annotated[bool, typer.Option("--quick", help="Use fewer points.")] = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Plot the error of a recipe and of each step against the run time.

    The tolerances and the settings of accuracy are varied; the page names the cheapest setting for
    each error.
    """
    _run("accuracy", words, quiet, as_json, out, seeds=seeds, quick=quick)


@study.command()
def stability(
    words: Words = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Compare the steps of a recipe with float64 in stiff and extreme cases.

    Values and gradients are compared: each case passes, warns or fails with its number. The exit
    code is 1 if a case fails.
    """
    _run("stability", words, quiet, as_json, out)


@study.command("leave-out")
def leave_out(
    words: Words = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Measure the effect and the saved time of each omitted step.

    Each omitted step is computed in full as well. The page has the stated bound, the measured
    change and the seconds saved, and what simpler scenes cost. The exit code is 1 if a change
    exceeds its bound.
    """
    _run("leave-out", words, quiet, as_json, out)


@study.command()
def calibration(
    words: Words = None,
    simulations: Annotated[
        int,
        typer.Option(
            "--simulations", min=20, max=10_000_000, help="Number of sensors drawn from the prior."
        ),
    ] = 200,
    move: Annotated[Move, typer.Option("--move", help="Move of the walkers.")] = Move.DE,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Test the calibration on simulated sensors.

    Sensors are drawn from the prior, their frames are simulated, and the truth is ranked among
    draws from each posterior (simulation-based calibration, SBC). The page also shows the effect of
    doubling the width of each prior. The exit code is 1 if ranks or coverage are wrong.
    """
    _run("calibration", words, quiet, as_json, out, simulations=simulations, move=move.value)


@study.command()
def uncertainty(
    words: Words = None,
    error: Annotated[
        float,
        typer.Option(
            "--error",
            min=1e-3,
            max=1.0,
            help="Relative error of each standard deviation at which to stop.",
        ),
    ] = 0.05,
    draws: Annotated[
        int, typer.Option("--most", min=64, max=10_000_000, help="Largest number of draws.")
    ] = 1000,
    points: Annotated[
        Points,
        typer.Option("--points", help="Independent draws, or a Sobol sequence, which needs fewer."),
    ] = Points.DRAWS,
    method: Annotated[
        Method,
        typer.Option(
            "--method",
            help="Sampling, or first linear propagation, and sampling only where it is too wrong.",
        ),
    ] = Method.SAMPLING,
    until: Annotated[
        list[str] | None,
        typer.Option(
            "--until",
            metavar="NAME",
            help="Output or quantity that decides when to stop; may be repeated.",
        ),
    ] = None,
    workers: Annotated[
        int,
        typer.Option(
            "--workers",
            min=0,
            max=10_000,
            help="Number of draws computed at the same time; 0: by free processors.",
        ),
    ] = 0,
    device: OneDevice = "cpu",
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Propagate uncertain values to the outputs.

    Uncertain are values given as distributions, such as "normal(1 e-, 0.1 e-)", and those of a
    `posterior`. Draws go on until each standard deviation, or each that --until names, is known to
    --error; the page says which input causes the scatter. Run the same command again to continue.
    """
    check_device(device)
    options: dict[str, Any] = {
        "error": error,
        "most": draws,
        "points": points.value,
        "method": method.value,
        "workers": workers,
        "device": device,
    }
    options["until"] = tuple(until or ())
    _run("uncertainty", words, quiet, as_json, out, _refuse_unknown_until, **options)


@study.command()
def protection(
    words: Words = None,
    draws: Annotated[
        int,
        typer.Option(
            "--draws",
            min=2,
            max=10_000_000,
            help="Number of draws of wavelength, direction, defocus, dirt and scatter.",
        ),
    ] = 12,
    bands: Annotated[
        int,
        typer.Option(
            "--bands",
            min=1,
            max=100_000,
            help="Number of bands of the scene; the laser may have all.",
        ),
    ] = 7,
    light: Annotated[
        Light,
        typer.Option("--light", help="Equal peak for a pulse, or equal heat for continuous light."),
    ] = Light.PULSE,
    size: Annotated[
        float, typer.Option("--size", min=5.0, max=1e5, help="Height of the targets in pixels.")
    ] = 14.0,
    prnu: Annotated[
        float,
        typer.Option(
            "--prnu", min=0.0, max=1.0, help="Relative spread of the sensitivity of pixels."
        ),
    ] = 0.01,
    residual: Annotated[
        float,
        typer.Option(
            "--residual", min=0.0, max=1.0, help="Share of the glare that is subtracted wrongly."
        ),
    ] = 0.02,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Compare a mask with a grey filter and a smaller stop of equal protection.

    For a quiet frame and under attack: error of the filtered picture, information, NEQ, and
    detection of details, over scene light and protection, with the bounds of every mask. The page
    begins with a paragraph to quote.
    """
    options: dict[str, Any] = {"draws": draws, "bands": bands, "light": light.value, "size": size}
    options |= {"prnu": prnu, "residual": residual}
    _run("protection", words, quiet, as_json, out, **options)


def _refuse_unknown_until(recipe: Recipe, options: dict[str, Any]) -> None:
    """End the command for a name in ``--until`` that no output has."""
    for name in options["until"]:
        outputs = {output.partition("[")[0] for output in recipe.outputs}
        if name.partition("[")[0].partition(".")[0] not in outputs:
            fail(
                f"--until {name}: no output of {recipe.name} has this name;"
                f" {nearest(name, outputs)}"
            )


def _any_recipe(recipe: Recipe, options: dict[str, Any]) -> None:
    """Refuse nothing: the study itself knows what it needs."""


def _run(
    kind: Kind,
    words: list[str] | None,
    quiet: bool,
    as_json: bool,
    out: Path,
    refuse: Callable[[Recipe, dict[str, Any]], None] = _any_recipe,
    **options: Any,
) -> None:
    """Run a study of a recipe and print its page.

    The exit code is 1 if something in the study does not hold.
    """
    recipe, command = load(words, "study", kind)
    refuse(recipe, options)
    store = the_store()

    command += option_words(options)
    progress = progress_lines(quiet or as_json)
    when_stopped = resumable(lambda: kept_in(store, "the parts that are finished are"))
    with (
        when_stopped,
        failing(lazy.errors.RunError, ImportError, code=FAILED),
        failing(ValueError, code=BAD),
        refusing(),
    ):
        folder = lazy.verbs.study(
            recipe, kind=kind, store=store, out=out, command=command, progress=progress, **options
        )
    say_folder(folder, as_json)
    if count := lazy.run_study.count_failures(folder):
        fail(f"{count} do not hold: see {folder / 'report.html'}", FAILED)


# --- evaluate command -----------------------------------------------------------------------------

# The command ``neusee evaluate``: compare masks and restorers on the same scenes and lasers.


Pipelines = Annotated[
    str | None,
    typer.Option("--pipelines", help="MASK[@file]+RESTORER[@weights], …; none restores nothing."),
]
Strengths = Annotated[
    str, typer.Option("--strengths", help="Strengths of the laser, multiples of saturation.")
]
Reference = Annotated[
    str,
    typer.Option(
        "--reference", help="Pipeline that the others are compared with; by default the first."
    ),
]
EqualPeak = Annotated[
    float | None,
    typer.Option(
        "--equal-protection",
        help="Peak of a laser to which filters and stops bring each pipeline, 0 to 1.",
    ),
]
Scenes = Annotated[
    int | None, typer.Option("--scenes", min=1, max=1_000_000, help="Number of scenes, else 20.")
]
Small = Annotated[
    int, typer.Option("--small", min=11, max=100_000, help="Shorter side of the reduced pictures.")
]
By = Annotated[
    str | None,
    typer.Option("--by", help="What brings it there: best (stop and filter), filter or stop."),
]


def evaluate(
    words: Words = None,
    pipelines: Pipelines = None,
    data: Annotated[
        str, typer.Option("--data", help="Folder of photographs; else the recipe's own scene.")
    ] = "",
    scenes: Scenes = None,
    strengths: Strengths = "0,1e1,1e2,1e3,1e4,1e5,1e6",
    small: Small = 256,
    reference: Reference = "",
    equal_protection: EqualPeak = None,
    by: By = None,
    device: OneDevice = "cpu",
    as_json: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Compare masks and restorers on the same scenes and lasers.

    A pipeline is a mask and a restorer. Every pipeline sees the same scenes, lasers and noise. The
    page has L1, PSNR and SSIM with 95 % confidence intervals, suppression by wavelength (LSR, BSR),
    the contrast that is left, and the bound that no mask can pass. With --equal-protection each
    pipeline gets the filter and the stop that bring its peak to one share of the plain lens's.
    Values that the recipe gives as distributions are drawn for each scene. Options that are not
    given are those of the recipe's block evaluate. Run the same command again to continue.
    """
    name, changes, _ = split(words)
    check_device(device)
    options = {
        "data": data,
        "scenes": scenes,
        "strengths": strengths,
        "small": small,
        "reference": reference,
    }
    pipeline_options = {"pipelines": pipelines, "equal-protection": equal_protection, "by": by}
    folder = _evaluate(
        name,
        changes=changes,
        pipelines=pipelines,
        data=data or None,
        scenes=scenes,
        strengths=_numbers(strengths),
        small=small,
        reference=reference.replace(" ", ""),
        equal_protection=equal_protection,
        by=by,
        device=device,
        out=out,
        progress=progress_lines(quiet or as_json),
        command=["neusee", "evaluate", name, *changes, *option_words(options | pipeline_options)],
    )
    say_folder(folder, as_json)


def _evaluate(name: str, **options: Any) -> Path:
    """Run an evaluation and return its folder.

    Each kind of error ends the command with a message.
    """
    store = the_store()

    when_stopped = resumable(lambda: kept_in(store, "the points that are finished are"))
    with (
        when_stopped,
        failing(lazy.pipelines.EvaluationRefused),
        failing(lazy.errors.RunError, code=FAILED),
        refusing(),
    ):
        return lazy.verbs.evaluate(name, store=store, **options)


def _numbers(text: str) -> list[float]:
    """Return the numbers in a text with commas; end the command for a word that is no number."""
    numbers = []
    for word in text.split(","):
        try:
            numbers.append(float(word))
        except ValueError:
            fail(f"--strengths: {word.strip() or 'nothing'} is no number: write 0,1e1,1e3,1e6")
    return numbers
