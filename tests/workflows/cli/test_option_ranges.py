"""Every number of a command has a least and a greatest value, so that one that slipped is
refused before any work.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args, get_type_hints

import pytest
import typer
from typer.models import OptionInfo

from neusee.workflows.cli.program_options import program

WITHOUT_GREATEST = {"fail_above"}  #: a limit that may be infinite, which is its default
#: by the evaluation, which says what to write: its own tests try 0, 2 and nan
REFUSED_IN_WORDS = {"equal_protection"}


def options(app: typer.Typer) -> Iterator[tuple[str, str, Any, OptionInfo]]:
    """Yield command, name, type and description of every option of a program and of its groups."""
    for command in app.registered_commands:
        for name, hint in get_type_hints(command.callback, include_extras=True).items():
            kind, *extras = get_args(hint) or (hint,)
            for extra in extras:
                if isinstance(extra, OptionInfo):
                    yield command.callback.__name__, name, kind, extra
    for group in app.registered_groups:
        yield from options(group.typer_instance)


NUMBERS = {
    f"{command} {name}": option
    for command, name, kind, option in options(program())
    if {int, float} & {kind, *get_args(kind)}
}


def test_there_are_numbers():
    assert len(NUMBERS) > 12


@pytest.mark.parametrize("place", NUMBERS)
def test_a_number_of_a_command_has_two_bounds(place):
    option, name = NUMBERS[place], place.split()[1]
    if name in REFUSED_IN_WORDS:
        return
    assert option.min is not None
    assert option.max is not None or name in WITHOUT_GREATEST
