"""Spellings of Hydra and of neusee 0.1 that a recipe does not have, with those to write instead:
habits of Hydra, and former names of keys, nodes and parameters.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from importlib import resources
from itertools import product

# --- habits of Hydra ------------------------------------------------------------------------------

_PACKAGE = "a recipe has no packages"
_NO_SETTINGS = (
    "a recipe has no settings of Hydra: remove this setting; `--out` names the folder of a run,"
    " and `neusee sweep` runs several values"
)
_NODE = "a recipe contains no Python objects: write a step, `steps: {NAME: {node: family.name}}`"
_ADVICE_ON_KEYS = {
    "_target_": _NODE,
    "_partial_": _NODE,
    "_recursive_": _NODE,
    "_convert_": _NODE,
    "_args_": _NODE,
}
_HEADER = re.compile(r"#\s*@package\b.*")


def advice_on_key(key: str | int, is_top: bool) -> str:
    """Return what to write in place of a key of Hydra in a mapping, or an empty text for another
    key.
    """
    if key == "hydra" and is_top:
        return _NO_SETTINGS
    return _ADVICE_ON_KEYS.get(str(key), "")


def package_line(text: str) -> int | None:
    """Return the index of the line ``# @package`` among the first comments of a file, or None."""
    for number, line in enumerate(text.splitlines()):
        if _HEADER.fullmatch(line.strip()):
            return number
        if line.strip() and not line.lstrip().startswith("#"):
            return None
    return None


#: message for the line that `package_line` finds
ADVICE_ON_HEADER = (
    f"{_PACKAGE}: remove this line, and write each block with its whole path, such as"
    " `lasers: {green: …}`"
)


def advice_on_group(written: str, option: str) -> str:
    """Return what to write in place of the group of an entry in ``defaults``, or an empty text.

    ``option`` is the option as the entry has it, for the message.
    """
    words = written.replace("optional ", "").split()
    group = words[-1].partition("@")[0].strip("/") if words else ""
    if group.partition("/")[0] == "hydra":
        return _NO_SETTINGS
    if "override" in words[:-1]:
        return (
            f"write `{group}: {option}`: an option in this list replaces the option of an"
            " extended recipe"
        )
    if "@" in written:
        return f"{_PACKAGE}: write `{group}: {option}`"
    if "/" in written:
        return f"the name of a group contains no path: write `{group.rpartition('/')[2]}: {option}`"
    return ""


def advice_on_option(option: str) -> str:
    """Return what to write in place of the option of an entry in ``defaults``, or an empty text."""
    if "${" in option:
        return "an entry of `defaults` cannot contain a reference: write the name of the option"
    if option == "???":
        return "write the name of an option, or null for none; an argument can replace it"
    return ""


def advice_on_recipe(name: str, groups: Iterable[str]) -> str:
    """Return what to write in place of the name of a recipe in ``defaults``, or an empty text."""
    if name.startswith(("optional ", "override ")):
        return "only a group can be optional: write `optional group: option`"
    plain = name.partition("@")[0]
    if "@" in name:
        return f"{_PACKAGE}: write `{plain}`"
    group, slash, option = plain.strip("/").rpartition("/")
    if slash and group in groups:
        return f"write `{group}: {option}` for an option of a group"
    if slash:
        return f"write `{plain}.yaml` for a recipe in another folder"
    return ""


def advice_on_argument(text: str, path: str) -> str:
    """Return what to write in place of an argument for ``path``, or an empty text."""
    name, _, value = text.lstrip("+~").partition("=")
    if text.startswith("++"):
        return f"write {name}={value} to change a value, or +{name}={value} to add one"
    block = path.partition(".")[0]
    group = block.partition("@")[0].strip("/")
    if group.partition("/")[0] == "hydra":
        return _NO_SETTINGS
    if "@" in block:
        return f"{_PACKAGE}: write {group}={value}"
    return ""


def advice_on_reference(text: str) -> str:
    """Return what to write in place of a reference with the text ``text``, or an empty text."""
    if ":" in text:
        return (
            f"${{{text}}} is a function of Hydra, which recipes do not have: write the value, or"
            " give the value as an argument"
        )
    if text.startswith("."):
        return f"a reference contains the whole path: write ${{block.name}}, not ${{{text}}}"
    return ""


# --- names of neusee 0.1 --------------------------------------------------------------------------

_TABLE = tomllib.loads(
    resources.files(__package__).joinpath("renamed_keys.toml").read_text(encoding="utf-8")
)
_CALLED: dict[str, str] = _TABLE["called"]
_GRID, _ON_A_GRID = _TABLE["pupil_grid"]["parameters"], _TABLE["pupil_grid"]["nodes"]
_REMOVED: dict[str, str] = {
    **dict.fromkeys(
        (f"{node}.{name}" for node, name in product(_ON_A_GRID, _GRID)),
        _TABLE["pupil_grid"]["instead"],
    ),
    **_TABLE["removed"],
}
#: present name of a parameter by its name in version 0.1
POSTERIOR_NAMES: dict[str, str] = _TABLE["posterior"]


def new_name(old: str) -> str | None:
    """Return the present name of an old recipe path, or None for a path that was never renamed."""
    keys = old.split(".")
    for length in range(len(keys), 0, -1):
        if present_name := _CALLED.get(".".join(keys[:length])):
            return ".".join([present_name, *keys[length:]])
    return None


def instead(old: str) -> str:
    """Return a message that says what to write instead of an old recipe path, or an empty text
    for any other path.
    """
    if present_name := new_name(old):
        return f"is called {present_name} now"
    return _REMOVED.get(old, "")


def became_input(node: str, parameters: Iterable[str]) -> bool:
    """Return True if a node's ``parameters`` contain those of the pupil grid, which is now an
    input of the node.
    """
    return node in _ON_A_GRID and not set(_GRID).isdisjoint(parameters)


def old_names() -> tuple[str, ...]:
    """Return the old names of all renamed or removed recipe keys, nodes and parameters."""
    return (*_CALLED, *_REMOVED)
