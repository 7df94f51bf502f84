"""``neusee cache``: what is stored, whether it is whole, what may go, what must stay, and why it is there."""

from __future__ import annotations

from typing import Annotated

import typer

from neusee.workflows.cli.command_frame import MISSED, fail, say, the_store

cache = typer.Typer(help="List, check, remove and keep stored results.", no_args_is_help=True, rich_markup_mode=None)

Key = Annotated[str, typer.Argument(metavar="KEY", help="The first digits of a key, as `cache ls` shows them.")]


@cache.command("ls")
def ls() -> None:
    """List the stored results.

    For each result: when it was computed, its bytes and seconds, its step and the recipe that first needed it.
    """
    from neusee.workflows.cli.cache_lines import ls_lines

    say(ls_lines(the_store()))


@cache.command("verify")
def verify() -> None:
    """Compare the checksum of every stored result.

    The exit code is 3 where a result is damaged.
    """
    from neusee.workflows.cli.cache_lines import verify_lines

    lines, damaged = verify_lines(the_store())
    say(lines)
    if damaged:
        raise typer.Exit(MISSED)


@cache.command("gc")
def gc(
    budget: Annotated[str, typer.Option("--budget", help="Largest size of the cache, such as 20 GB.")] = "",
    dry: Annotated[bool, typer.Option("--dry-run", help="Say what would be removed, and remove nothing.")] = False,
) -> None:
    """Remove files that belong to no result, and results beyond a budget.

    Beyond the budget, the results that save the fewest seconds for their bytes go first. Pinned results stay.
    """
    from neusee.workflows.cli.cache_lines import gc_lines

    try:
        say(gc_lines(the_store(), budget or None, dry))
    except ValueError as error:
        fail(f"--budget: {error}")


@cache.command("pin")
def pin(key: Key) -> None:
    """Keep a result whatever the budget is."""
    _pinned(key, True)


@cache.command("unpin")
def unpin(key: Key) -> None:
    """Allow a pinned result to be removed again."""
    _pinned(key, False)


@cache.command("why")
def why(key: Key) -> None:
    """Say what a result was computed from.

    Also says how that differs from the nearest earlier result.
    """
    from neusee.workflows.explain.why_rerun import why_key_lines

    try:
        say(why_key_lines(the_store(), key))
    except LookupError as error:
        fail(str(error.args[0]))


def _pinned(key: str, keep: bool) -> None:
    from neusee.workflows.cli.cache_lines import pin_lines

    try:
        say(pin_lines(the_store(), key, keep))
    except ValueError as error:
        fail(str(error))
