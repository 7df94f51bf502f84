"""References ``${a.b}``: values that copy other values, resolved from the steps that use them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neusee.workflows.graph.diagnostics import UNREAD, Diagnostic
from neusee.workflows.recipe.text import renamed_keys
from neusee.workflows.recipe.text.composition import packaged
from neusee.workflows.recipe.text.overrides import RESERVED
from neusee.workflows.recipe.text.renamed_keys import new_name
from neusee.workflows.recipe.text.yaml_values import Value, Where, dotted

_REFERENCE = re.compile(r"\$\{([^${}]*)\}")
_DEEPEST = 50  #: depth of references to references


@dataclass(frozen=True, slots=True)
class Scope:
    """Meaning of ``${item.x}`` and ``${each.lasers.x}`` in one copy of a step."""

    items: Mapping[str, Value]  #: by dimension
    step: str

    def find(self, parts: list[str]) -> tuple[Value | None, list[str], str]:
        """Return the start, the path to follow and, where no start exists, the mistake."""
        dims = list(self.items)
        if parts[0] == "item" and len(dims) == 1:
            return self.items[dims[0]], parts[1:], ""
        if parts[0] == "each" and len(parts) > 1 and parts[1] in dims:
            return self.items[parts[1]], parts[2:], ""
        if not dims:
            return None, [], f"${{{'.'.join(parts)}}} needs `each` in steps.{self.step}"
        rest = "".join(f".{part}" for part in parts[1 if parts[0] == "item" else 2 :])
        return None, [], f"write {' or '.join(f'${{each.{dim}{rest}}}' for dim in dims)}"


class References:
    """Resolution of the references in one recipe, which records the values in use."""

    def __init__(self, root: Value, diagnostics: list[Diagnostic]) -> None:
        self.root, self.diagnostics = root, diagnostics
        self.used: set[Where] = set()
        self.known: dict[Where, Value] = {}
        self.open: list[Where] = []
        self.lacking: list[tuple[Where, Diagnostic]] = []
        self.spare: set[Where] = set()  #: unused values of packaged options

    def resolve(self, value: Value, scope: Scope) -> Value:
        """Return ``value`` with every reference resolved; report a failed one and return `BROKEN` in its place."""
        if isinstance(value.data, dict):
            children = ((key, child, self.resolve(child, scope)) for key, child in value.data.items())
            return replace(value, data={key: replace(found, key=child.key) for key, child, found in children})
        if isinstance(value.data, list):
            return replace(value, data=[self.resolve(child, scope) for child in value.data])
        if not isinstance(value.data, str) or "${" not in value.data:
            return value
        return self._text(value, scope)

    def _text(self, value: Value, scope: Scope) -> Value:
        """Return a string with its references resolved, the innermost first."""
        text = value.data
        while match := _REFERENCE.search(text):
            target = self._target(match[1], value, scope)
            if target is None:
                return replace(value, data=BROKEN)
            if match[0] == text:
                return target
            if isinstance(target.data, dict | list):
                return self._fail(value, f"${{{match[1]}}} is a list or a mapping: it cannot be part of a string")
            text = text[: match.start()] + _pasted(target.data) + text[match.end() :]
        if "${" in text:
            return self._fail(value, "write a reference as ${block.name}")
        return replace(value, data=text)

    def _target(self, text: str, origin: Value, scope: Scope) -> Value | None:
        parts, start = text.strip().split("."), self.root
        item = parts[0] in ("item", "each") and parts[0] not in self.root.items
        if item:
            found, parts, wrong = scope.find(parts)
            if found is None:
                self._fail(origin, wrong)
                return None
            start = found
        target = _follow(start, parts)
        if target is None:
            self._missing(start, parts, origin, scope)
            return None
        self.used.add(target.path)
        return self._followed(target, scope, origin)

    def _followed(self, target: Value, scope: Scope, origin: Value) -> Value | None:
        """Return a target with its own references resolved, once; report a cycle."""
        if target.path in self.known:
            return self.known[target.path]
        if target.path in self.open:
            loop = [*self.open[self.open.index(target.path) :], target.path]
            self._fail(origin, f"refers to itself: {' -> '.join(map(dotted, loop))}")
            return None
        if len(self.open) > _DEEPEST:
            self._fail(origin, f"more than {_DEEPEST} references to references")
            return None
        self.open.append(target.path)
        value = self.resolve(target, scope if target.path[0] == "steps" else Scope({}, dotted(target.path)))
        self.open.pop()
        if target.path[0] != "steps":
            self.known[target.path] = value
        return value

    def _missing(self, start: Value, parts: list[str], origin: Value, scope: Scope) -> None:
        """Report a missing target: as a mistake of the item if other items have the target, else of the reference."""
        name, wanted = ".".join(parts), (*start.path, *parts)
        siblings = self.root.items[str(start.path[0])].items.values() if start.path else ()
        if any(_follow(other, parts) for other in siblings):
            problem = Diagnostic(start.key, start.name, f"has no {name}; steps.{scope.step} needs this value")
        else:
            near = _nearest(wanted, {leaf.path for leaf in self.root.leaves() if leaf.path[0] not in RESERVED})
            hint = f" is unknown; did you mean {dotted(near)}?" if near else " is unknown"
            if now := renamed_keys.instead(dotted(wanted)):
                hint = f": {now}" if new_name(dotted(wanted)) is None else f" {now}"
            problem = Diagnostic(origin.mark, origin.name, f"${{{dotted(wanted)}}}{hint}")
        self.lacking.append((wanted, problem))

    def _fail(self, origin: Value, message: str) -> Value:
        self.diagnostics.append(Diagnostic(origin.mark, origin.name, message))
        return replace(origin, data=BROKEN)

    def touch(self, value: Value, dims: Sequence[str]) -> None:
        """Mark the values that a step without items would read as used, so that they are not reported."""
        for text in _texts(value):
            for match in _REFERENCE.finditer(text.data):
                parts = match[1].strip().split(".")
                if parts[0] not in ("item", "each"):
                    self._target(match[1], text, Scope({}, ""))
                    continue
                rest = parts[1 if parts[0] == "item" else 2 :]
                self.used |= {(dim, *item, *rest) for dim in dims or self.root.items for item in self._names(str(dim))}

    def _names(self, dim: str) -> Iterator[tuple[str | int]]:
        block = self.root.items.get(dim)
        return ((name,) for name in (block.items if block else ()))

    def finish(self) -> None:
        """Report values without a reader and references without a target; a matching pair is one mistake.

        A packaged option may set more values than a recipe uses: a camera needs the pixel pitch, a bench does not.
        """
        wanted = dict(self.lacking)
        misspelt = set()
        for leaf in [leaf for leaf in self._block_leaves() if not self._is_used(leaf.path)]:
            instead = self._instead(leaf) or ()
            if _is_packaged(leaf) and instead not in wanted:
                self.spare.add(leaf.path)
                continue
            misspelt.add(instead)
            if now := renamed_keys.instead(leaf.name):
                self.diagnostics.append(Diagnostic(leaf.key, leaf.name, now))
                continue
            shown = dotted(instead[-1:] if instead[:-1] == leaf.path[:-1] else instead)
            hint = f"; did you mean {shown}?" if shown else ": no step refers to this value"
            asker = f" (needed at {wanted[instead].mark})" if instead in wanted else ""
            code = "" if shown else UNREAD
            self.diagnostics.append(Diagnostic(leaf.key, leaf.name, f"unknown{hint}{asker}", code))
        self.diagnostics += [problem for path, problem in self.lacking if path not in misspelt]

    def _block_leaves(self) -> Iterator[Value]:
        blocks = (block for key, block in self.root.items.items() if key not in RESERVED)
        return (leaf for block in blocks for leaf in block.leaves() if leaf.data != {})

    def _is_used(self, path: Where) -> bool:
        return any(path[:n] in self.used for n in range(1, len(path) + 1))

    def _instead(self, leaf: Value) -> Where | None:
        """Return the new name of an old path, or the nearest path that steps refer to, first among those beside it."""
        if now := new_name(leaf.name):
            return tuple(now.split("."))
        known = {*self.used, *(wanted for wanted, _ in self.lacking)}
        known |= {(name,) for name in (*RESERVED, "defaults")} if len(leaf.path) == 1 else set()
        return _nearest(leaf.path, known)


def _is_packaged(leaf: Value) -> bool:
    """Return True if a value belongs to a packaged option, and not to a recipe or an argument."""
    return leaf.key.line > 0 and leaf.mark.line > 0 and Path(leaf.mark.folder).parent == packaged()


def _nearest(path: Where, known: set[Where]) -> Where | None:
    """Return the path whose last name is nearest, first among the paths beside it."""
    beside = {str(other[-1]): other for other in known if other[:-1] == path[:-1]}
    for paths in (beside, {str(other[-1]): other for other in known}):
        close = difflib.get_close_matches(str(path[-1]), paths, 1, 0.75)
        if close:
            return paths[close[0]]
    return None


BROKEN = type("Broken", (), {"__repr__": lambda self: "?", "__doc__": "The value of a failed reference."})()


def broken(value: Value) -> bool:
    """Return True if a part of a value could not be resolved."""
    return value.data is BROKEN or any(map(broken, value.items.values()))


def _pasted(data: Any) -> str:
    return str(data).lower() if isinstance(data, bool) else "null" if data is None else str(data)


def _texts(value: Value) -> Iterator[Value]:
    if isinstance(value.data, str):
        yield value
    for child in value.items.values():
        yield from _texts(child)


def _follow(start: Value, parts: list[str]) -> Value | None:
    here: Value | None = start
    for part in parts:
        items = here.items if here else {}
        here = items.get(part) if part in items else items.get(int(part)) if part.isdecimal() else None
    return here
