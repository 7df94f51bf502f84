"""Final values of a recipe, each with its source, and a YAML file of these values that can be
run again.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

_BARE = re.compile(r"[A-Za-z_µ/][\w µ./+-]*(?<! )|[-+]?\d[\d.eE+-]* [A-Za-zµ][\w/-]*")
_WORDS = {"true", "false", "null", "yes", "no", "on", "off"}


@dataclass(frozen=True, slots=True)
class Setting:
    """Final value of one recipe key with its source: a file location, a command argument or the
    default of a node.
    """

    value: Any
    source: str
    path: tuple[str | int, ...]  #: keys from the top of the recipe
    default: bool = False  #: whether the value is the node's default


@dataclass(frozen=True, slots=True)
class Config:
    """All final values of a recipe, each under its dotted path such as ``sensor.read_noise``, in
    recipe order.
    """

    settings: Mapping[str, Setting] = field(default_factory=dict)

    @property
    def values(self) -> dict[str, Any]:
        """Return the final values by recipe key, without their sources."""
        return {path: setting.value for path, setting in self.settings.items()}

    def __getitem__(self, path: str) -> Setting:
        return self.settings[path]

    def to_yaml(self) -> str:
        """Return the final values of a recipe as YAML text, with the source of each value in a
        comment.

        The text has no groups. Default values of nodes are commented out.
        """
        tree: dict[str | int, Any] = {}
        for setting in self.settings.values():
            *parents, key_of_value = setting.path
            branch = tree
            for key in parents:
                if not isinstance(branch.get(key), dict):  # only defaults follow after `with: {}`
                    branch[key] = {}
                branch = branch[key]
            branch[key_of_value] = setting
        return "".join(f"{line}\n" for line in _lines(tree, 0))


def changes(base: Config, other: Config, ignored_block: str) -> list[str]:
    """Return the overrides that turn the values of one recipe into those of another, except the
    block ``ignored_block``.
    """
    new_values, old_values = _given_values(other, ignored_block), _given_values(base, ignored_block)
    overrides = [f"~{path}" for path in old_values if path not in new_values]
    for path, value in new_values.items():
        if path not in old_values:
            overrides.append(f"+{path}={flow(value)}")
        elif old_values[path] != value:
            overrides.append(f"{path}={flow(value)}")
    return overrides


def _given_values(config: Config, ignored_block: str) -> dict[str, Any]:
    """Return the values of a recipe that are not defaults, except those of the block
    ``ignored_block``.
    """
    settings_given = {path: s for path, s in config.settings.items() if not s.default}
    return {
        path: setting.value
        for path, setting in settings_given.items()
        if setting.path[0] != ignored_block
    }


def _lines(tree: Mapping[str | int, Any], depth: int) -> Iterator[str]:
    """Yield the lines of YAML for a tree of settings, with the source of each value in a
    comment.
    """
    indent = "  " * depth
    for key, value in tree.items():
        if isinstance(value, Setting):
            text = f"{_scalar(key)}: {flow(value.value)}"
            # comments begin at column 46, behind the longest usual value
            yield (
                f"{indent}{'# ' if value.default else ''}{text:<{44 - len(indent)}} #"
                f" {value.source}"
            )
        else:
            yield f"{indent}{_scalar(key)}:"
            yield from _lines(value, depth + 1)


def flow(value: Any) -> str:
    """Return a recipe value as YAML text on one line."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_scalar(key)}: {flow(child)}' for key, child in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(flow, value))}]"
    return _scalar(value)


def _scalar(value: Any) -> str:
    """Return a single value as YAML; a text in quotes where it needs them."""
    if isinstance(value, float) and math.isnan(value):
        return ".nan"
    if isinstance(value, float) and math.isinf(value):
        return ".inf" if value > 0 else "-.inf"
    if value is None or isinstance(value, bool | int | float):
        return json.dumps(value)
    text = str(value)
    needs_no_quotes = _BARE.fullmatch(text) and text.lower() not in _WORDS
    return text if needs_no_quotes else f'"{"".join(map(_escaped, text))}"'


def _escaped(char: str) -> str:
    """Return a character as it is written in a quoted text."""
    if char in '"\\':
        return "\\" + char
    return char if char.isprintable() else f"\\U{ord(char):08X}"
