"""``neusee study``: error against run time, stiff and extreme cases, and what is left out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from neusee.workflows._words import FAILED, Debug, Out, Words, fail, load, say, the_store

study = typer.Typer(
    help="What a recipe's numbers are worth, where it breaks, what it need not compute.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Quiet = Annotated[bool, typer.Option("--quiet", help="The page's path alone.")]


@study.command()
def accuracy(
    words: Words = None,
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Draws of the noise, for the error bars.")] = 3,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer points.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Draw error against run time, of the whole recipe and of each step, over tolerances and knobs."""
    _made("accuracy", words, quiet, out, seeds=seeds, quick=quick)


@study.command()
def stability(words: Words = None, quiet: Quiet = False, debug: Debug = False, out: Out = Path("runs")) -> None:
    """Run stiff and extreme cases against float64, forward and gradient; fail where one does not hold."""
    _made("stability", words, quiet, out)


@study.command("leave-out")
def leave_out(words: Words = None, quiet: Quiet = False, debug: Debug = False, out: Out = Path("runs")) -> None:
    """Compute each omission in full beside it; fail where one changes more than was said."""
    _made("leave-out", words, quiet, out)


def _made(kind: str, words: list[str] | None, quiet: bool, out: Path, **options: Any) -> None:
    recipe, command = load(words)
    from neusee.workflows import study as studies
    from neusee.workflows._call import RunError

    given = [f"--{name}" if value is True else f"--{name} {value}" for name, value in options.items() if value]
    command = ["neusee", "study", kind, *command[2:], *given]
    tell = (lambda line: None) if quiet else (lambda line: say([line]))
    try:
        folder = studies.made(kind, recipe, the_store(), out, command, tell, **options)
    except (RunError, ValueError) as error:
        fail(str(error), FAILED)
    say([str(folder / "report.html")])
    if count := studies.failed(folder):
        fail(f"{count} do not hold: see {folder / 'report.html'}", FAILED)
