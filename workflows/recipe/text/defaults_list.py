"""The list ``defaults`` of a recipe or an option: the recipes that it extends and the options of
its groups.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from neusee.workflows.graph.diagnostics import Diagnostic, Location
from neusee.workflows.recipe.text.hydra_habits import advice_on_group, advice_on_option
from neusee.workflows.recipe.text.yaml_values import Value, kind

SELF = "_self_"  #: entry for the values that the file itself writes
_OPTIONAL = "optional "
_FORM = (
    "must be one `group: option`, such as `doe: axicon`, or the name of a recipe, such as"
    " `first_light`"
)
_INNER = "must be an option of this group, such as `- small`, or one `group: option`"
_NAMES = "must be the name of an option, a list of names, or null"


@dataclass(frozen=True, slots=True)
class Option:
    """One option of a group that a recipe or an argument names."""

    group: str
    name: str
    mark: Location
    shown: str  #: the choice as the user wrote it, for a message
    is_optional: bool = False  #: whether a run goes on without it, if there is no such option


@dataclass(frozen=True, slots=True)
class Choice:
    """Entry ``group: option``: the options of a group, of which a later one wins; none for null."""

    group: str
    options: tuple[Option, ...]
    mark: Location
    shown: str  #: as the user wrote it
    is_optional: bool = False

    @property
    def names(self) -> list[str]:
        return [option.name for option in self.options]


@dataclass(frozen=True, slots=True)
class Extended:
    """Entry that names another recipe, by its name or by the path of its file."""

    name: str
    mark: Location


@dataclass(frozen=True, slots=True)
class OwnValues:
    """Entry ``_self_``: where the values of the file itself stand among the others."""

    mark: Location


Entry = Choice | Extended | OwnValues


def entries_of(root: Value, diagnostics: list[Diagnostic], group: str = "") -> list[Entry]:
    """Return the entries in the list ``defaults`` of a recipe, or of an option of ``group``, and
    report wrong entries.

    Without ``_self_`` the values of the file itself come last, as in Hydra 1.1 and later.
    """
    block = root.items.get("defaults")
    entries = [] if block is None else _listed(block, diagnostics, group)
    if not any(isinstance(entry, OwnValues) for entry in entries):
        entries.append(OwnValues(root.mark))
    return entries


def choice(
    group: str, values: Sequence[Value], mark: Location, shown: str, is_optional: bool = False
) -> Choice:
    """Return the choice of the options in ``values``, of which null is none."""
    options = tuple(
        Option(group, str(value.data), value.mark, shown, is_optional)
        for value in values
        if value.data is not None
    )
    return Choice(group, options, mark, shown, is_optional)


def _listed(block: Value, diagnostics: list[Diagnostic], group: str) -> list[Entry]:
    """Return the entries of a list ``defaults``; report wrong and repeated ones."""
    if not isinstance(block.data, list):
        expected_form = "options of this group, such as `[small]`" if group else "`group: option`"
        message = f"must be a list of {expected_form}, not {kind(block)}"
        diagnostics.append(Diagnostic(block.mark, "defaults", message))
        return []
    entries: list[Entry] = []
    first_lines: dict[tuple[str, str], int] = {}
    for value in block.data:
        entry = _entry(value, group)
        if isinstance(entry, Diagnostic):
            diagnostics.append(entry)
            continue
        name, identity = _identity(entry, group)
        if identity in first_lines:
            message = f"given twice, first in line {first_lines[identity]}"
            diagnostics.append(Diagnostic(value.mark, f"defaults.{name}", message))
            continue
        first_lines[identity] = value.mark.line
        entries.append(entry)
    return entries


def _identity(entry: Entry, group: str) -> tuple[str, tuple[str, str]]:
    """Return the name of an entry for a message, and what no second entry of the list may have."""
    if isinstance(entry, OwnValues):
        return SELF, (SELF, "")
    if isinstance(entry, Extended):
        return entry.name, ("", entry.name)
    # an option may extend several options of a group, in entries of their own
    return entry.group, (entry.group, str(entry.names) if group else "")


def _entry(value: Value, group: str) -> Entry | Diagnostic:
    """Return an entry of ``defaults``, or the mistake in it."""
    if value.data == SELF:
        return OwnValues(value.mark)
    if isinstance(value.data, str):
        # in the file of an option a name alone is another option of its group
        if group:
            return _choice(group, value, f"{group}: {value.data}")
        return Extended(value.data, value.mark)
    pairs = list(value.items.items()) if isinstance(value.data, dict) else []
    if len(pairs) != 1 or isinstance(pairs[0][1].data, dict):
        return Diagnostic(value.mark, value.name, _INNER if group else _FORM)
    name, options = str(pairs[0][0]), pairs[0][1]
    entry_text = f"{name}: {_text(options)}"
    if advice := advice_on_group(name, _text(options)):
        return Diagnostic(value.mark, entry_text, advice)
    is_optional = name.startswith(_OPTIONAL)
    return _choice(name.removeprefix(_OPTIONAL).strip(), options, entry_text, is_optional)


def _choice(
    group: str, options: Value, shown: str, is_optional: bool = False
) -> Choice | Diagnostic:
    """Return the choice of the options that an entry lists, or the mistake in them."""
    is_list = isinstance(options.data, list)
    values = options.data if is_list else [options]
    names = set[str]()
    for value in values:
        if isinstance(value.data, dict | list) or (is_list and value.data is None):
            return Diagnostic(value.mark, shown, _NAMES)
        if advice := advice_on_option(str(value.data)):
            return Diagnostic(value.mark, shown, advice)
        if str(value.data) in names:
            return Diagnostic(value.mark, shown, f"{value.data} is given twice")
        names.add(str(value.data))
    return choice(group, values, options.mark, shown, is_optional)


def _text(options: Value) -> str:
    """Return the options of an entry as a user writes them."""
    if isinstance(options.data, list):
        return f"[{', '.join(_text(value) for value in options.data)}]"
    return "null" if options.data is None else str(options.data)
