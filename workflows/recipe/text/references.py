"""References such as ``${sensor.gain}``, by which a value of a recipe copies another value of
the recipe.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

from neusee.workflows.graph.errors import UNREAD, Diagnostic
from neusee.workflows.recipe.text.other_spellings import advice_on_reference, instead, new_name
from neusee.workflows.recipe.text.overrides import RESERVED
from neusee.workflows.recipe.text.recipe_files import packaged
from neusee.workflows.recipe.text.yaml_values import Value, Where, dotted

_REFERENCE = re.compile(r"\$\{([^${}]*)\}")
_DEEPEST = 50  #: longest chain of references
_MOST_VALUES = 100_000  #: values to which references may expand one value
_MOST_CHARACTERS = 100_000  #: characters to which references may expand one text
#: what to do about a block that lacks values, in a recipe and in an option of the user
_ADVICE_IN_RECIPE = "set these values, or name an option that sets them in `defaults`"
_ADVICE_IN_OPTION = "extend an option that sets these values, such as `defaults: [small]`"


@dataclass(frozen=True, slots=True)
class Scope:
    """The items, such as a laser, of one copy of a step; ``${item.x}`` and ``${each.lasers.x}``
    refer to them.
    """

    items: Mapping[str, Value]  #: by the name of the list of items
    step: str

    def find(self, parts: list[str]) -> tuple[Value | None, list[str], str]:
        """Return the item to which a reference such as ``${item.x}`` refers, and the path below the
        item.

        If no item fits, return None, an empty path and a message.
        """
        list_names = list(self.items)
        # `item` is clear only for a step with one list of items
        if parts[0] == "item" and len(list_names) == 1:
            return self.items[list_names[0]], parts[1:], ""
        if parts[0] == "each" and len(parts) > 1 and parts[1] in list_names:
            return self.items[parts[1]], parts[2:], ""
        if not list_names:
            return None, [], f"${{{'.'.join(parts)}}} needs `each` in steps.{self.step}"
        inner_path = "".join(f".{name}" for name in _below_item(parts))
        return (
            None,
            [],
            f"write {' or '.join(f'${{each.{dim}{inner_path}}}' for dim in list_names)}",
        )


def _below_item(parts: list[str]) -> list[str]:
    """Return the path below the item to which a reference such as ``${each.lasers.x}`` refers."""
    return parts[1:] if parts[0] == "item" else parts[2:]


class References:
    """Resolver of the references in a recipe, with a record of the values that the steps use."""

    def __init__(
        self,
        root: Value,
        diagnostics: list[Diagnostic],
        replaced: Mapping[Where, str] | None = None,
    ) -> None:
        self.root, self.diagnostics = root, diagnostics
        #: the argument that replaced an option, by the path of a value of the option
        self.replaced = replaced or {}
        self.notes: list[str] = []  #: on values of the user's recipe that the arguments make unused
        self.used: set[Where] = set()
        self.known: dict[Where, Value] = {}  #: resolved values
        #: each path that was looked up, with the value there
        self.trace: list[tuple[Where, Value | None]] = []
        self._traces: dict[Where, list[tuple[Where, Value | None]]] = {}  #: by resolved value
        self.open: list[Where] = []  #: values that are being resolved
        self.lacking: list[tuple[Where, Diagnostic]] = []  #: targets that do not exist
        self.spare: set[Where] = set()  #: unused values of packaged options
        #: paths of missing values to which optional references refer
        self.offered: set[Where] = set()
        self.followed = 0  #: references followed since the last value of a step was begun
        #: number of values in each list or mapping, by identity
        self.weights: dict[int, tuple[int, Any]] = {}

    def resolve(self, value: Value, scope: Scope) -> Value:
        """Return a recipe value with its references resolved; report a failed reference and return
        `BROKEN` for it.

        An optional reference, ``${scene.illuminance?}``, leaves its key out of the mapping if the
        value does not exist.
        """
        if isinstance(value.data, dict):
            data = {}
            for key, child in value.data.items():
                resolved = self.resolve(child, scope)
                if resolved.data is not ABSENT:
                    data[key] = replace(resolved, key=child.key)
            return replace(value, data=data)
        if isinstance(value.data, list):
            items = (self.resolve(child, scope) for child in value.data)
            return replace(value, data=[item for item in items if item.data is not ABSENT])
        if not isinstance(value.data, str) or "${" not in value.data:
            return value
        return self._text(value, scope)

    def _text(self, value: Value, scope: Scope) -> Value:
        """Return a string of a recipe with its references resolved, beginning with the innermost
        reference.
        """
        text = value.data
        while match := _REFERENCE.search(text):
            target = self._target(match[1], value, scope)
            if target is None:
                return replace(value, data=BROKEN)
            # the reference is the whole value, which keeps its type
            if match[0] == text:
                return target
            if target.data is ABSENT:
                return self._fail(
                    value, f"the optional reference ${{{match[1]}}} must be the whole value"
                )
            if target.data is BROKEN:
                return target
            if isinstance(target.data, dict | list):
                return self._fail(
                    value, f"${{{match[1]}}} is a list or a mapping: it cannot be part of a string"
                )
            text = text[: match.start()] + _pasted(target.data) + text[match.end() :]
            if len(text) > _MOST_CHARACTERS:
                return self._fail(
                    value, f"references expand this text to more than {_MOST_CHARACTERS} characters"
                )
        if "${" in text:
            return self._fail(
                value, "the reference is incomplete: write a reference as ${block.name}"
            )
        return replace(value, data=text)

    def _target(self, text: str, origin: Value, scope: Scope) -> Value | None:
        """Return the value to which a reference refers, or None after a report of the mistake.

        An optional reference to nothing gives a value with the data `ABSENT`.
        """
        if advice := advice_on_reference(text.strip()):
            self._fail(origin, advice)
            return None
        is_optional = text.rstrip().endswith("?")
        keys, start = text.strip().removesuffix("?").split("."), self.root
        if keys[0] in ("item", "each") and keys[0] not in self.root.items:
            item, keys, fault = scope.find(keys)
            if item is None:
                self._fail(origin, fault)
                return None
            start = item
        target = start.below(keys)
        self.trace.append(((*start.path, *keys), target))
        if target is None and is_optional:
            self.offered.add((*start.path, *keys))
            return replace(origin, data=ABSENT)
        if target is None:
            self._missing(start, keys, origin, scope)
            return None
        self.used.add(target.path)
        return self._followed(target, scope, origin)

    def _followed(self, target: Value, scope: Scope, origin: Value) -> Value | None:
        """Return the target value of a reference, with its own references resolved; report a
        cycle of references.
        """
        if target.path in self.known:
            self.trace += self._traces[target.path]
            return self.known[target.path]
        if fault := self._chain_fault(target):
            self._fail(origin, fault)
            return None
        self.open.append(target.path)
        first_trace = len(self.trace)
        # a value of a step may refer to its items, any other value may not
        value = self.resolve(
            target, scope if target.path[0] == "steps" else Scope({}, dotted(target.path))
        )
        self.open.pop()
        if self._weight(value) > _MOST_VALUES:
            value = self._fail(
                target, f"references expand this value to more than {_MOST_VALUES} values"
            )
        elif any(child.data is BROKEN for child in value.items.values()):
            value = replace(value, data=BROKEN)
        if target.path[0] != "steps":
            # each path once, because nested lists would repeat them
            self.trace[first_trace:] = dict(self.trace[first_trace:]).items()
            self.known[target.path], self._traces[target.path] = value, self.trace[first_trace:]
        return value

    def _chain_fault(self, target: Value) -> str:
        """Return why a reference cannot be followed (a cycle, a long chain, too many values), or an
        empty text.
        """
        if target.path in self.open:
            cycle = [*self.open[self.open.index(target.path) :], target.path]
            return f"the value refers to itself: {' -> '.join(map(dotted, cycle))}"
        if len(self.open) > _DEEPEST:
            return f"the value begins a chain of more than {_DEEPEST} references"
        # counted anew where no value is being resolved
        self.followed = self.followed + 1 if self.open else 0
        if self.followed > _MOST_VALUES:
            return f"references expand this value to more than {_MOST_VALUES} values"
        return ""

    def _weight(self, value: Value) -> int:
        """Return the number of values in a resolved value, in which references may repeat the
        same list many times.
        """
        if not isinstance(value.data, dict | list):
            return 1
        if id(value.data) not in self.weights:
            weight = 1 + sum(map(self._weight, value.items.values()))
            # the object is kept, so that no other object gets its identity
            self.weights[id(value.data)] = weight, value.data
        return self.weights[id(value.data)][0]

    def _missing(self, start: Value, parts: list[str], origin: Value, scope: Scope) -> None:
        """Report a reference to a missing value: at the item if other items have the value, else
        at the reference.
        """
        path = (*start.path, *parts)
        name = dotted(path)
        siblings = self.root.items[str(start.path[0])].items.values() if start.path else ()
        if any(sibling.below(parts) for sibling in siblings):
            message = f"has no {'.'.join(parts)}; steps.{scope.step} needs this value"
            self.lacking.append((path, Diagnostic(start.key, start.name, message)))
            return
        nearest_path = _nearest(
            path, {leaf.path for leaf in self.root.leaves() if leaf.path[0] not in RESERVED}
        )
        hint = (
            f" is unknown; did you mean {dotted(nearest_path)}?" if nearest_path else " is unknown"
        )
        if advice := instead(name):
            hint = f": {advice}" if new_name(name) is None else f" {advice}"
        self.lacking.append((path, Diagnostic(origin.mark, origin.name, f"${{{name}}}{hint}")))

    def _fail(self, origin: Value, message: str) -> Value:
        """Report a mistake, unless it was the last one reported; return the value as `BROKEN`."""
        problem = Diagnostic(origin.mark, origin.name, message)
        if problem not in self.diagnostics[-1:]:
            self.diagnostics.append(problem)
        return replace(origin, data=BROKEN)

    def touch(self, value: Value, dims: Sequence[str]) -> None:
        """Mark the values to which a step without copies refers as used, so that they are not
        reported as unused.
        """
        for text in _texts(value):
            for match in _REFERENCE.finditer(text.data):
                keys = match[1].strip().removesuffix("?").split(".")
                if keys[0] not in ("item", "each"):
                    self._target(match[1], text, Scope({}, ""))
                    continue
                inner_path = _below_item(keys)
                for dim in dims or self.root.items:
                    self.used |= {(dim, name, *inner_path) for name in self.root.items[dim].items}

    def finish(self) -> None:
        """Report values of the recipe that no step uses, and references to values that do not
        exist.

        An unused value with a name similar to a missing target is one mistake. A packaged option
        may set more values than a recipe uses: a camera needs the pixel pitch, a bench does not.
        """
        targets = dict(self.lacking)
        misspelt = set[Where]()
        for leaf in self._unused():
            meant_path = self._meant(leaf) or ()
            if meant_path not in targets and self._may_be_unused(leaf):
                self.spare.add(leaf.path)
                continue
            misspelt.add(meant_path)
            self.diagnostics.append(_unknown(leaf, meant_path, targets.get(meant_path)))
        self._report_lacking(misspelt)

    def _report_lacking(self, misspelt: Container[Where]) -> None:
        """Report the references to values that do not exist, except those in ``misspelt``."""
        lacking = [(path, problem) for path, problem in self.lacking if path not in misspelt]
        incomplete = dict(self._incomplete({path for path, _ in lacking}))
        self.diagnostics += incomplete.values()
        self.diagnostics += [
            problem for path, problem in lacking if path[0] not in incomplete or len(path) != 2
        ]

    def _may_be_unused(self, leaf: Value) -> bool:
        """Return True for a value of a packaged option, and, with a note, for a value of an option
        that an argument replaces.
        """
        if _is_packaged(leaf):
            return True
        if leaf.path not in self.replaced or not leaf.mark.line or not leaf.key.line:
            return False
        self.notes.append(f"{leaf.name} ({leaf.mark}) is not used with {self.replaced[leaf.path]}")
        return True

    def _incomplete(self, lacking: set[Where]) -> Iterator[tuple[str | int, Diagnostic]]:
        """Yield one diagnostic for each block of the user that lacks values, at the block
        instead of at each step.
        """
        for key in dict.fromkeys(path[0] for path in sorted(lacking, key=str)):
            block = self.root.items.get(str(key))
            paths = [path for path in lacking if path[0] == key and len(path) == 2]
            if block is not None and (message := _lacking_message(block, paths)):
                yield key, Diagnostic(block.key, str(key), message)

    def _unused(self) -> list[Value]:
        """Return the values that no step uses; reserved blocks and empty mappings do not count."""
        blocks = (block for key, block in self.root.items.items() if key not in RESERVED)
        leaves = chain.from_iterable(block.leaves() for block in blocks)
        return [leaf for leaf in leaves if leaf.data != {} and not self._is_used(leaf)]

    def _is_used(self, leaf: Value) -> bool:
        """Return True if a step uses a value, or a block that has the value."""
        return any(leaf.path[:depth] in self.used for depth in range(1, len(leaf.path) + 1))

    def _meant(self, leaf: Value) -> Where | None:
        """Return the path that a user probably meant by an unused path: its new name, or a
        similar path in use.
        """
        if present_name := new_name(leaf.name):
            return tuple(present_name.split("."))
        candidates = {*self.used, *self.offered, *(path for path, _ in self.lacking)}
        candidates |= (
            {(name,) for name in (*RESERVED, "defaults")} if len(leaf.path) == 1 else set()
        )
        return _nearest(leaf.path, candidates)


def _lacking_message(block: Value, paths: Iterable[Where]) -> str:
    """Return the message for a block of the user that lacks the values at ``paths``, or an empty
    text if each step reports this itself.
    """
    if not block.mark.line or not isinstance(block.data, dict):
        return ""
    names, origin = sorted(dotted(path[1:]) for path in paths), _place(block)
    # a recipe that lacks one or two values: each step says it better
    if origin == "packaged" or len(names) < (3 if origin == "recipe" else 1):
        return ""
    listed_names = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
    advice = _ADVICE_IN_RECIPE if origin == "recipe" else _ADVICE_IN_OPTION
    return f"lacks {listed_names}, which steps need: {advice}"


def _unknown(leaf: Value, meant: Where, needed: Diagnostic | None) -> Diagnostic:
    """Return the diagnostic for a value that no step uses; ``needed`` is the diagnostic for a
    missing value that the user probably ``meant``.
    """
    if advice := instead(leaf.name):
        return Diagnostic(leaf.key, leaf.name, advice)
    meant_text = dotted(meant[-1:] if meant[:-1] == leaf.path[:-1] else meant)
    hint = f"; did you mean {meant_text}?" if meant_text else ": no step refers to this value"
    needed_text = f" (needed at {needed.mark})" if needed else ""
    return Diagnostic(
        leaf.key, leaf.name, f"unknown{hint}{needed_text}", "" if meant_text else UNREAD
    )


def _place(block: Value) -> Literal["packaged", "option", "recipe"]:
    """Return where a block of a recipe is from: a packaged file, an option of a user's group, or a
    user's recipe.
    """
    folder = Path(block.mark.folder)
    if packaged() in (folder, folder.parent):
        return "packaged"
    return "option" if (packaged() / folder.name).is_dir() else "recipe"


def _is_packaged(leaf: Value) -> bool:
    """Return True if a value comes from a packaged option of a group, and not from a user's
    recipe or an argument.
    """
    return leaf.key.line > 0 and leaf.mark.line > 0 and Path(leaf.mark.folder).parent == packaged()


def _nearest(path: Where, candidates: set[Where]) -> Where | None:
    """Return the path in ``candidates`` with the last name most similar to that of ``path``, if
    possible in its block.
    """
    paths_by_name = {str(candidate[-1]): candidate for candidate in sorted(candidates, key=str)}
    paths_beside = {
        str(candidate[-1]): candidate for candidate in candidates if candidate[:-1] == path[:-1]
    }
    for paths in (paths_beside, paths_by_name):
        matches = difflib.get_close_matches(str(path[-1]), paths, 1, 0.75)
        if matches:
            return paths[matches[0]]
    return None


BROKEN = type(
    "Broken", (), {"__repr__": lambda self: "?", "__doc__": "Value of a failed reference."}
)()
ABSENT = type(
    "Absent",
    (),
    {"__repr__": lambda self: "-", "__doc__": "Value of an optional reference to nothing."},
)()


def broken(value: Value) -> bool:
    """Return True if a value of a recipe, or a value within it, is `BROKEN` because a reference
    failed.
    """
    return value.data is BROKEN or any(map(broken, value.items.values()))


def _pasted(data: Any) -> str:
    """Return a value as the text that stands for it in YAML."""
    return str(data).lower() if isinstance(data, bool) else "null" if data is None else str(data)


def _texts(value: Value) -> Iterator[Value]:
    """Yield all strings in a value."""
    if isinstance(value.data, str):
        yield value
    for child in value.items.values():
        yield from _texts(child)
