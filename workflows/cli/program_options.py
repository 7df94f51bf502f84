"""The typer program: options such as ``--version``, and the import of a named command."""

from __future__ import annotations

import importlib
import os
from collections.abc import Collection
from typing import Annotated

import typer

from neusee import __version__
from neusee.workflows.cli.command_frame import say
from neusee.workflows.cli.commands_and_exit_codes import COMMANDS, DONE, EXIT_CODES, SUMMARY

NO_CODE = "--no-code"


def _print_version(asked: bool) -> None:
    if asked:
        say([f"neusee {__version__}"])
        raise typer.Exit(DONE)


def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", callback=_print_version, is_eager=True
        ),
    ] = False,
    no_code: Annotated[
        bool, typer.Option(NO_CODE, help="Refuse recipes that name code; also after a command.")
    ] = False,
) -> None:
    pass


def program(names: Collection[str] = tuple(COMMANDS)) -> typer.Typer:
    """Return the program with the options of the commands ``names``, and one line of help for
    every other command.
    """
    app = typer.Typer(
        name="neusee",
        help=SUMMARY,
        epilog=EXIT_CODES,
        context_settings={"help_option_names": ["-h", "--help"]},
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(_options)
    for name, (module, text) in COMMANDS.items():
        if name not in names:
            app.command(name, help=text)(_nothing)
            continue
        command = getattr(importlib.import_module(f"neusee.workflows.cli.{module}"), name)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            app.command(name)(command)
    return app


def _nothing() -> None:
    pass


def run_program(arguments: list[str], completes: bool) -> int:
    """Run the command that ``arguments`` name and return its exit code.

    ``completes`` is True if a shell asks for completions, which need the options of all commands.
    """
    if NO_CODE in arguments:
        os.environ["NEUSEE_NO_CODE"] = "1"
        arguments = [argument for argument in arguments if argument != NO_CODE]
    names: Collection[str] = COMMANDS if completes else arguments
    try:
        return program(names)(arguments, standalone_mode=False, prog_name="neusee") or 0
    except typer.Abort:
        raise KeyboardInterrupt from None
