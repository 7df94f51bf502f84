"""Differences between two runs in numbers, recipe, code and environment, as rows of tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from neusee.workflows.comparison.run_record import RunRecord

_MEASURED = frozenset({"engine", "peak memory"})  #: facts of a run that differ each time
_STATE, _PACKAGE, _SETTINGS, _PYTHON = "state of ", "package ", "settings", "Python"
_SEVERAL = 6  #: names that a line lists


@dataclass(frozen=True)
class NumberDifference:
    """One number in two runs; None stands for a number that a run does not have."""

    step: str
    field: str
    index: int | str
    left: float | None
    right: float | None

    @property
    def name(self) -> str:
        """Return the name of the number, such as ``lsr[mask]`` or ``restored_quality.psnr``."""
        return f"{self.step}.{self.field}".rstrip(".")

    @property
    def difference(self) -> float | None:
        """Return right minus left, 0 for equal numbers (also infinite or NaN ones), None where one is missing."""
        if self.left is None or self.right is None:
            return None
        if self.left == self.right or (math.isnan(self.left) and math.isnan(self.right)):
            return 0.0
        return self.right - self.left

    @property
    def relative(self) -> float:
        """Return the difference relative to the larger number of both, without sign; infinite where none is defined."""
        difference = self.difference
        if difference == 0:
            return 0.0
        if difference is None or not math.isfinite(difference):
            return math.inf
        return abs(difference) / max(abs(side) for side in (self.left, self.right) if side is not None)


@dataclass(frozen=True)
class ValueDifference:
    """One entry that differs, with its text in both runs and its sources; an empty text stands for no entry."""

    name: str
    left: str
    right: str
    left_source: str = ""
    right_source: str = ""


def numbers(left: RunRecord, right: RunRecord) -> list[NumberDifference]:
    """Return every number of two runs, in the order of the first run and then of the second."""
    sides = [{(s, f, i): math.nan if x is None else x for s, f, i, x in r.document.metrics} for r in (left, right)]
    names = dict.fromkeys([*sides[0], *sides[1]])
    return [NumberDifference(*name, sides[0].get(name), sides[1].get(name)) for name in names]


def largest(found: list[NumberDifference]) -> list[NumberDifference]:
    """Return, for each result that differs, its number with the largest relative difference; the largest first."""
    worst: dict[str, NumberDifference] = {}
    for each in found:
        if each.relative > 0 and (each.name not in worst or each.relative > worst[each.name].relative):
            worst[each.name] = each
    return sorted(worst.values(), key=lambda each: -each.relative)


def table(left: RunRecord, right: RunRecord) -> tuple[list[str], list[list[str]]]:
    """Return the result tables of two runs as one table, whose rows are the rows of both runs in turn."""
    sides = [record.document.table for record in (left, right)]
    columns = list(dict.fromkeys([*sides[0].columns, *sides[1].columns]))
    names = dict.fromkeys(str(row.get("name", "")) for side in sides for row in side.rows)
    rows = []
    for name in names:
        for side, word in zip(sides, ("left", "right"), strict=True):
            cells = next((dict(zip(side.columns, r.get("cells", []), strict=False)) for r in side.rows
                          if r.get("name") == name), None)  # fmt: skip
            if cells is not None:
                rows.append([name, word, *(str(cells.get(column, "")) for column in columns)])
    return ["", "run", *columns], rows


def recipe(left: RunRecord, right: RunRecord) -> list[ValueDifference]:
    """Return the final values that differ between two recipes, each with the places where it was written."""
    found = []
    for name in dict.fromkeys([*left.values, *right.values]):
        sides = [record.values.get(name) for record in (left, right)]
        texts = [side.text if side else "" for side in sides]
        if texts[0] != texts[1]:
            found.append(ValueDifference(name, *texts, *(side.source if side else "" for side in sides)))
    return found


def code(left: RunRecord, right: RunRecord) -> list[str] | None:
    """Return one line for each node whose code differs and for each changed definition; None without digests."""
    if left.code is None or right.code is None:
        return None
    one, other = left.code.nodes, right.code.nodes
    changed = sorted(node for node in one.keys() & other.keys() if one[node] != other[node])
    only = [f"only the {side} run uses the node {node}" for side, node in _only(one, other)]
    nodes = [f"the code of {_listed(changed)} differs"] if changed else []
    return [*nodes, *only, *_definitions(left.code.parts, right.code.parts, whole=not only)]


def environment(left: RunRecord, right: RunRecord) -> list[ValueDifference]:
    """Return what differs in command, device, machine, versions and settings of two runs."""
    documents = [record.document for record in (left, right)]
    facts = [{name: value for name, value in d.facts if name not in _MEASURED} for d in documents]
    for each, document in zip(facts, documents, strict=True):
        each |= {"neusee": document.version, "device": document.device, "recipe": document.recipe}
        each |= {"command": document.command}
    for each, record in zip(facts, (left, right), strict=True):
        parts = record.code.parts if record.code else {}
        packages = {name.removeprefix(_PACKAGE): _release(p) for name, p in parts.items() if name.startswith(_PACKAGE)}
        settings = parts.get(_SETTINGS, {})
        each |= {name: version for name, version in packages.items() if name not in each} | settings
    names = dict.fromkeys([*facts[0], *facts[1]])
    sides = [(name, facts[0].get(name, ""), facts[1].get(name, "")) for name in names]
    return [ValueDifference(*row) for row in sides if row[1] != row[2]]


def steps(left: RunRecord, right: RunRecord) -> list[str]:
    """Return lines that count the steps with other cache keys, and name the steps that only one run has."""
    one, other = ({row.step: row.key for row in r.document.steps} for r in (left, right))
    both = one.keys() & other.keys()
    differ = [name for name in one if name in both and one[name] != other[name]]
    lines = [f"{len(differ)} of {len(both)} common steps have another cache key: {_listed(differ)}"] if differ else []
    return [*lines, *(f"only the {side} run has the step {name}" for side, name in _only(one, other))]


def _release(package: Mapping[str, str]) -> str:
    """Return the version of a package, with the digest of its files where this digest counts."""
    content = package.get("content")
    return f"{package['version']} (files {content[:8]})" if content else package["version"]


def _definitions(
    left: Mapping[str, Mapping[str, str]], right: Mapping[str, Mapping[str, str]], whole: bool
) -> Iterator[str]:
    """Yield one line for each definition of a module, or declared file, that differs.

    With ``whole``, also for each module that only one run uses, which means little if their nodes are not the same.
    """
    for module in sorted(left.keys() | right.keys()):
        if module in (_SETTINGS, _PYTHON) or module.startswith(_PACKAGE):
            continue
        old, new = left.get(module), right.get(module)
        if old is None or new is None:
            if whole and not module.startswith(_STATE):
                yield f"only the {'left' if new is None else 'right'} run uses {module}"
        elif module.startswith(_STATE):
            name = module.removeprefix(_STATE)
            if old != new and left.get(name) == right.get(name):
                yield f"a value that {name} holds differs: a constant, a table or a default"
        else:
            labels = sorted(label for label in old.keys() | new.keys() if old.get(label) != new.get(label))
            yield from (f"{module}: {label} {_how(old, new, label)}" for label in labels)


def _how(old: Mapping[str, str], new: Mapping[str, str], label: str) -> str:
    if label in old and label in new:
        return "differs"
    return f"is only in the {'left' if label in old else 'right'} run"


def _only(left: Mapping[str, object], right: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    yield from (("left", name) for name in left if name not in right)
    yield from (("right", name) for name in right if name not in left)


def _listed(names: list[str]) -> str:
    rest = len(names) - _SEVERAL
    return ", ".join(names) if rest <= 0 else f"{', '.join(names[:_SEVERAL])} and {rest} more"
