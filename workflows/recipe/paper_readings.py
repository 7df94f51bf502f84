"""Contradictions in the paper of Peng et al., the interpretation that the recipes choose for each, and the reason.

Source: Peng et al., "Learning to See Through Flare", ICCV 2025 workshops. The group ``reading`` makes each choice.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from importlib import resources
from typing import NamedTuple


class Reading(NamedTuple):
    """A contradiction in the paper: the recipe key, its coherent and printed value, and the reason for the choice."""

    path: str  #: of the recipe key
    number: str
    matter: str
    coherent: object
    as_printed: object
    reason: str

    @property
    def name(self) -> str:
        return self.path.partition(".")[2]


_TABLE = tomllib.loads(resources.files(__package__).joinpath("paper_contradictions.toml").read_text(encoding="utf-8"))
READINGS = tuple(Reading(**row) for row in _TABLE["reading"])


def in_force(values: dict[str, object]) -> Iterable[tuple[Reading, str]]:
    """Yield each contradiction in the paper that a recipe resolves, with the recipe's choice.

    The choice is ``coherent``, ``as printed`` or the recipe's own value.
    """
    for row in READINGS:
        if row.path in values:
            value = values[row.path]
            known = {str(row.coherent): "coherent", str(row.as_printed): "as printed"}
            yield row, known.get(str(value), str(value))
