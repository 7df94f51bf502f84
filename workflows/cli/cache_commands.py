"""``neusee cache``: what is stored, whether it is whole, what may go, what must stay, and why it is there."""

from __future__ import annotations

from typing import Annotated

import typer

from neusee.workflows.cli.command_frame import MISSED, fail, say, the_store

cache = typer.Typer(help="What was computed.", no_args_is_help=True, rich_markup_mode=None)

Key = Annotated[str, typer.Argument(metavar="KEY", help="The first digits of a key, as `cache ls` shows them.")]


@cache.command("ls")
def ls() -> None:
    """List what is stored: when it was made, bytes, seconds, the step and the recipe it was made for."""
    from neusee.workflows.cli.cache_lines import ls_lines

    say(ls_lines(the_store()))


@cache.command("verify")
def verify() -> None:
    """Read every result and compare its checksum; exit code 3 if one is damaged."""
    from neusee.workflows.cli.cache_lines import verify_lines

    lines, damaged = verify_lines(the_store())
    say(lines)
    if damaged:
        raise typer.Exit(MISSED)


@cache.command("gc")
def gc(
    budget: Annotated[str, typer.Option("--budget", help="Keep no more than this, such as 20 GB.")] = "",
    dry: Annotated[bool, typer.Option("--dry-run", help="Only say what would go.")] = False,
) -> None:
    """Remove what belongs to no result, and, beyond a budget, what saves the fewest seconds for its bytes."""
    from neusee.workflows.cli.cache_lines import gc_lines

    try:
        say(gc_lines(the_store(), budget or None, dry))
    except ValueError as error:
        fail(f"--budget: {error}")


@cache.command("pin")
def pin(key: Key) -> None:
    """Keep a result whatever the budget."""
    _pinned(key, True)


@cache.command("unpin")
def unpin(key: Key) -> None:
    """Let a result go again when the budget asks for it."""
    _pinned(key, False)


@cache.command("why")
def why(key: Key) -> None:
    """Say what went into a result, and how it differs from the nearest earlier one."""
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
