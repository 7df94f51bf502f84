"""The command ``neusee evaluate``: compare masks and restorers on the same scenes and lasers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from neusee.workflows.cli.command_frame import fail, failing, refusing, split, the_store
from neusee.workflows.cli.command_list import FAILED
from neusee.workflows.cli.command_options import (
    AsJson,
    Debug,
    OneDevice,
    Out,
    Quiet,
    Words,
    check_device,
    option_words,
    progress_lines,
)
from neusee.workflows.cli.interruption import kept_in, resumable, say_folder

Pipelines = Annotated[
    str | None, typer.Option("--pipelines", help="MASK[@file]+RESTORER[@weights], …; none restores nothing.")
]
Strengths = Annotated[str, typer.Option("--strengths", help="Strengths of the laser, multiples of saturation.")]
Reference = Annotated[
    str, typer.Option("--reference", help="Pipeline that the others are compared with; by default the first.")
]
EqualPeak = Annotated[
    float | None,
    typer.Option("--equal-protection", help="Peak of a laser to which filters and stops bring each pipeline, 0 to 1."),
]
Scenes = Annotated[int | None, typer.Option("--scenes", min=1, max=1_000_000, help="Number of scenes, else 20.")]
Small = Annotated[int, typer.Option("--small", min=11, max=100_000, help="Shorter side of the reduced pictures.")]
By = Annotated[str | None, typer.Option("--by", help="What brings it there: best (stop and filter), filter or stop.")]


def evaluate(
    words: Words = None,
    pipelines: Pipelines = None,
    data: Annotated[str, typer.Option("--data", help="Folder of photographs; else the recipe's own scene.")] = "",
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

    A pipeline is a mask and a restorer. Every pipeline sees the same scenes, lasers and noise. The page has L1, PSNR
    and SSIM with 95 % confidence intervals, suppression by wavelength (LSR, BSR), the contrast that is left, and the
    bound that no mask can pass. With --equal-protection each pipeline gets the filter and the stop that bring its peak
    to one share of the plain lens's. Values that the recipe gives as distributions are drawn for each scene. Options
    that are not given are those of the recipe's block evaluate. Run the same command again to continue.
    """
    name, changes, _ = split(words)
    check_device(device)
    options = {"data": data, "scenes": scenes, "strengths": strengths, "small": small, "reference": reference}
    shared = {"pipelines": pipelines, "equal-protection": equal_protection, "by": by}
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
        command=["neusee", "evaluate", name, *changes, *option_words(options | shared)],
    )
    say_folder(folder, as_json)


def _evaluate(name: str, **options: Any) -> Path:
    store = the_store()
    from neusee.workflows.api import verbs
    from neusee.workflows.evaluation.pipelines import EvaluationRefused
    from neusee.workflows.graph.run_error import RunError

    kept = resumable(lambda: kept_in(store, "the points that are finished are"))
    with kept, failing(EvaluationRefused), failing(RunError, code=FAILED), refusing():
        return verbs.evaluate(name, store=store, **options)


def _numbers(text: str) -> list[float]:
    numbers = []
    for word in text.split(","):
        try:
            numbers.append(float(word))
        except ValueError:
            fail(f"--strengths: {word.strip() or 'nothing'} is no number: write 0,1e1,1e3,1e6")
    return numbers
