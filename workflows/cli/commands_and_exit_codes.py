"""The names of all commands, the exit codes, and the page of ``neusee --help``."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill

DONE, FAILED, BAD, MISSED, INTERRUPTED = 0, 1, 2, 3, 130  #: exit codes

TYPED: list[str] = []  #: the arguments of the command that runs, as the user typed them

SUMMARY = (
    "Simulate what a laser does to a camera: its light, its glass and its sensor, as recipes. "
    "Start with `neusee run`. Each command explains itself: `neusee run --help`."
)
EXIT_CODES = (
    "Exit codes: 0 done; 1 failed while running; 2 mistake in the recipe or the arguments; "
    "3 expected numbers missed, a check of a calibration failed, or damaged results found."
)

#: from the name of each command to the module that defines the command, and to the first line of
#: the command's help
COMMANDS = {
    "run": ("recipe_commands", "Run a recipe and write its report."),
    "validate": ("recipe_commands", "Check a recipe without running it."),
    "plan": ("recipe_commands", "Show which steps a run would compute, where and for how long."),
    "why": ("recipe_commands", "Explain why a step differs from its nearest earlier result."),
    "config": ("recipe_commands", "Print every final value and where it comes from."),
    "report": ("recipe_commands", "Write the page of a run again from stored results."),
    "compare": ("recipe_commands", "Compare two runs: numbers, pictures, recipe and code."),
    "safety": ("recipe_commands", "Estimate damage and dazzle by a laser, and the distances."),
    "restore": ("recipe_commands", "Restore the scene from frames that a camera took."),
    "sweep": ("recipe_commands", "Run a recipe at several values of its parameters."),
    "train": ("train_command", "Train the mask of a recipe and its restoring network."),
    "calibrate": (
        "calibration_commands",
        "Find the posterior of a sensor from calibration frames.",
    ),
    "sheet": ("calibration_commands", "Write the EMVA 1288 sheet of a camera from frames."),
    "evaluate": ("study_commands", "Compare masks and restorers on the same scenes and lasers."),
    "recipes": ("catalogue", "List the recipes and the groups of options."),
    "nodes": ("catalogue", "List the nodes, or explain one node."),
    "init": ("project_commands", "Make a folder for recipes, groups and nodes of your own."),
    "new": ("project_commands", "Write the start of a node, network, mask, recipe or sensor."),
    "check": ("project_commands", "Check whether nodes keep what the nodes of neusee keep."),
    "schema": ("catalogue", "Print the JSON schema of recipes for editors."),
    "handbook": ("handbook_command", "Build the handbook with its pictures and open it."),
    "study": ("study_commands", "Study how accurate, stable and certain a recipe's numbers are."),
    "cache": ("cache_commands", "List, check, remove and keep stored results."),
}
#: commands whose answer is stored
REPEATED = frozenset({"config", "plan", "run", "safety", "validate", "why"})
_OPTIONS = {
    "--version": "Show the version and exit.",
    "--no-code": "Refuse recipes that name code; also after a command.",
    "--install-completion": "Install completion for the current shell.",
    "--show-completion": (
        "Show completion for the current shell, to copy it or customize the installation."
    ),
    "-h, --help": "Show this message and exit.",
}
COLUMNS = 80  #: width of the widest page of help that typer prints


def help_page() -> str:
    """Return the page of ``neusee --help`` as typer prints that page on a terminal of 80 columns
    or more.
    """
    summary, exit_codes = (_filled("  ", text, "  ") for text in (SUMMARY, EXIT_CODES))
    commands = {name: text for name, (_, text) in COMMANDS.items()}
    usage = "Usage: neusee [OPTIONS] COMMAND [ARGS]..."
    return "\n\n".join(
        [
            usage,
            summary,
            f"Options:\n{_list(_OPTIONS)}",
            f"Commands:\n{_list(commands)}",
            exit_codes,
        ]
    )


def _list(texts: Mapping[str, str]) -> str:
    """Return names and texts as a list in two columns."""
    indent = max(map(len, texts)) + 4
    return "\n".join(
        _filled(f"  {name}".ljust(indent), text, " " * indent) for name, text in texts.items()
    )


def _filled(before: str, text: str, indent: str) -> str:
    """Return a text wrapped to the width of a page.

    `before` stands in front of it, and `indent` in front of its later lines.
    """
    return fill(text, COLUMNS - 2, initial_indent=before, subsequent_indent=indent)
