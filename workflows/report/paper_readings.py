"""Contradictions in the paper of Peng et al., the interpretation that the recipes choose for each,
and the reason.

Source: Peng et al., "Learning to See Through Flare", ICCV 2025 workshops. The groups ``reading``
and ``train`` make each choice.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from typing import NamedTuple


class Reading(NamedTuple):
    """A contradiction in the paper: the recipe key, its coherent and printed value, and the
    reason for the choice.
    """

    path: str  #: of the recipe key
    number: str
    matter: str
    coherent: object
    as_printed: object
    reason: str
    consequence: str = ""  #: visible effect of the printed value, with keys of the recipe in braces

    @property
    def argument(self) -> str:
        """Return the argument of a command that sets the printed value of the recipe key."""
        group = self.path.partition(".")[0]
        return {
            "reading": "reading=as_printed",
            "sensor": "reading=as_printed",
            "train": "train=as_printed",
        }.get(group, f'{self.path}="{self.as_printed}"')


class Settled(NamedTuple):
    """A contradiction in the paper that no recipe key resolves, and the reason why no key is
    needed.
    """

    number: str
    matter: str
    why: str


_TABLE = tomllib.loads(
    resources.files(__package__).joinpath("paper_contradictions.toml").read_text(encoding="utf-8")
)
READINGS = tuple(Reading(**row) for row in _TABLE["reading"])
SETTLED = tuple(Settled(**row) for row in _TABLE["settled"])


def in_force(values: Mapping[str, object]) -> Iterable[tuple[Reading, str]]:
    """Yield each contradiction in the paper that a recipe resolves, with the recipe's choice.

    The choice is ``coherent``, ``as printed`` or the recipe's own value. ``values`` are the
    recipe's values by key.
    """
    for contradiction in READINGS:
        if contradiction.path in values:
            value = values[contradiction.path]
            # values of any type are compared as the text that a recipe writes
            choices = {
                str(contradiction.coherent): "coherent",
                str(contradiction.as_printed): "as printed",
            }
            yield contradiction, choices.get(str(value), str(value))


def consequences(values: Mapping[str, object]) -> list[str]:
    """Return a sentence on the visible effect of each printed value that is in force in a
    recipe.
    """
    visible_contradictions = (
        (contradiction, contradiction.consequence)
        for contradiction, state in in_force(values)
        if state == "as printed" and contradiction.consequence
    )
    return [
        f"{contradiction.path} as printed ({contradiction.number}): {_filled(text, values)}"
        for contradiction, text in visible_contradictions
    ]


def _filled(text: str, values: Mapping[str, object]) -> str:
    """Replace each key in braces, such as ``{sensor.c1}``, by its value."""
    return re.sub(r"\{([\w.]+)\}", lambda match: str(values.get(match[1], match[0])), text)
