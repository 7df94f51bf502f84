"""The command line: few commands, the same words everywhere, one line for each mistake.

Nothing heavy is imported before a command asks for it: ``neusee --help`` never sees torch.
"""

from __future__ import annotations

import gc
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

if TYPE_CHECKING:
    from neusee.workflows._graph import Recipe
    from neusee.workflows.simulate import Simulation

DONE, FAILED, BAD, MISSED = 0, 1, 2, 3
DEFAULT = "first_light"

app = typer.Typer(
    name="neusee",
    help="What a laser does to a camera: its light, its glass and its sensor, as recipes. "
    "`neusee run` is the place to start.",
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
cache = typer.Typer(help="What was computed.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(cache, name="cache")

Words = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[RECIPE] [OVERRIDE]...",
        help="A recipe's name or file, then changes: a.b=1, +a.b=1, ~a.b, laser=six.",
        show_default=False,
    ),
]
Debug = Annotated[bool, typer.Option("--debug", help="Show where in the code an error arose.")]
Device = Annotated[str, typer.Option("--device", help="Where to compute: cpu, cuda, cuda:1.")]


@app.command()
def run(
    words: Words = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="The report's path alone.")] = False,
    debug: Debug = False,
    device: Device = "cpu",
    out: Annotated[Path, typer.Option("--out", help="Folder for the run's folder.")] = Path("runs"),
) -> None:
    """Run a recipe, from the cache where it can, and write its report."""
    recipe, command = load(words)
    from neusee.workflows import _console as console

    check_device(device)
    if not (as_json or quiet):
        say(console.opening(recipe, " ".join(command[1:])))
    done = _simulate(recipe, command, device, out, as_json or quiet)
    if as_json:
        import json

        say([json.dumps({"report": str(done.page), **done.document}, ensure_ascii=False)])
    elif quiet:
        say([str(done.page)])
    else:
        say(console.closing(done.document, str(done.page), console.next_commands(recipe)))
    if done.document["missed"]:
        raise typer.Exit(MISSED)


def _simulate(recipe: Recipe, command: list[str], device: str, out: Path, silent: bool) -> Simulation:
    from neusee.workflows._console import screen
    from neusee.workflows._store import Store
    from neusee.workflows.simulate import simulate, steps_of

    with screen(recipe, steps_of(recipe), silent) as shown:
        return simulate(recipe, Store(), out, command, device, shown.watch)


@app.command()
def validate(words: Words = None, debug: Debug = False) -> None:
    """Check a recipe: every mistake at once, and nothing is run."""
    recipe, command = load(words)
    from neusee.workflows._console import opening

    say(opening(recipe, " ".join(command[1:])))


@app.command()
def plan(words: Words = None, debug: Debug = False, device: Device = "cpu") -> None:
    """Say what would run, and for how long; compute nothing."""
    recipe, _ = load(words)
    from neusee.workflows._plan import plan_lines
    from neusee.workflows._store import Store

    say(plan_lines(recipe, Store(), device))


@app.command()
def config(words: Words = None, debug: Debug = False) -> None:
    """Print every final value and where it comes from."""
    recipe, _ = load(words)
    from neusee.workflows.simulate import recipe_text

    say(recipe_text(recipe).splitlines())


@app.command()
def recipes() -> None:
    """List the recipes, each with what it shows."""
    from neusee.workflows._catalogue import recipe_lines

    say(recipe_lines())


@app.command()
def nodes(
    name: Annotated[str | None, typer.Argument(help="One node, such as optics.psf, or `reading`.")] = None,
    debug: Debug = False,
) -> None:
    """List what a step can compute, or explain one node."""
    from neusee.workflows import _catalogue as catalogue

    try:
        say(catalogue.node_lines(name) if name else catalogue.nodes_lines())
    except LookupError as error:
        fail(str(error.args[0]))


@app.command()
def schema() -> None:
    """Print the JSON schema of recipes, for editors."""
    import json

    from neusee.workflows._schema import schema as of_recipes

    say([json.dumps(of_recipes(), indent=1)])


@app.command()
def report(
    folder: Annotated[str, typer.Argument(metavar="RUN_FOLDER", help="A run's folder, or `latest`.")] = "latest",
    out: Annotated[Path, typer.Option("--out", help="Where the run's folders lie.")] = Path("runs"),
    debug: Debug = False,
) -> None:
    """Write a run's page again from what is stored."""
    from neusee.workflows._files import find_run
    from neusee.workflows.report import rebuild

    try:
        say([str(rebuild(find_run(folder, out)))])
    except FileNotFoundError as error:
        fail(str(error))


@cache.command("ls")
def cache_ls() -> None:
    """List what is stored: when it was made, bytes, seconds, the step and the recipe it was made for."""
    from neusee.workflows._plan import cache_lines
    from neusee.workflows._store import Store

    say(cache_lines(Store()))


def load(words: list[str] | None) -> tuple[Recipe, list[str]]:
    """The recipe that the words name (`first_light` if none does) with its changes, and the words to run it again."""
    words = list(words or [])
    named = bool(words) and not _is_change(words[0])
    name = words.pop(0) if named else DEFAULT
    for word in words:
        if not _is_change(word):
            fail(f"{word}: not a change of a value: write key=value, +key=value or ~key")
    from neusee.workflows._marks import RecipeError
    from neusee.workflows._recipe import load as read

    try:
        recipe = read(name, words, first=1 + named)
    except RecipeError as error:
        count = len(error.problems)
        fail(f"{error}\n{count} problem{'s' * (count > 1)}, nothing was run")
    gc.freeze()
    gc.enable()
    return recipe, ["neusee", "run", name, *words]


def check_device(device: str) -> None:
    """Refuse a device that is no device, or is not here."""
    import torch

    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        fail(f"--device {device}: {str(error).partition(chr(10))[0]}")


def _is_change(word: str) -> bool:
    return "=" in word or word.startswith(("~", "+"))


def say(lines: list[str]) -> None:
    """Print lines to stdout."""
    print(*lines, sep="\n", flush=True)


def fail(message: str, code: int = BAD) -> NoReturn:
    """Say on stderr what is wrong and stop."""
    print(message, file=sys.stderr)
    raise typer.Exit(code)


def main(arguments: list[str] | None = None) -> None:
    """Entry point: every error is one line and an exit code, unless ``--debug`` asks for the stack."""
    arguments = sys.argv[1:] if arguments is None else arguments
    gc.disable()  # what is imported stays: to look for garbage in it costs a tenth of the start
    try:
        sys.exit(app(arguments, standalone_mode=False) or DONE)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(DONE)
    except (KeyboardInterrupt, typer.Abort):
        print("stopped; what was finished is kept, and a next run goes on from there", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if "--debug" in arguments:
            raise
        sys.exit(_explained(error))


def _explained(error: Exception) -> int:
    """Print an error as one line; a mistake in the arguments and a failure while running differ in their code."""
    message = getattr(error, "format_message", None)
    if message is not None:
        print(f"{message()} (try `neusee --help`)", file=sys.stderr)
        return BAD
    cause = type(error).__name__
    text = str(error) if cause == "RunError" else f"{cause}: {error}"
    print(f"{text}   (--debug shows where)", file=sys.stderr)
    return FAILED


if __name__ == "__main__":
    main()
