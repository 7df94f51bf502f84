"""Causes of a changed result: parameters, files and code that differ, described in words."""

from __future__ import annotations

import ast
import functools
import math
import re
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from neusee.nodes.units import read_quantity
from neusee.workflows.engine.resolved_keys import Resolved
from neusee.workflows.graph.final_values import Setting, flow
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.cache_key import USUAL, Key, is_private
from neusee.workflows.keys.module_digest import read_parts
from neusee.workflows.keys.module_origin import source_file
from neusee.workflows.store.result_store import Store

# --- code changes ---------------------------------------------------------------------------------

# Changes of code: the functions, classes and constants that differ between two digests of code.


_STATE, _SETTINGS = "state of ", "settings"
_PROGRAM = "neusee.workflows"
_OTHER = frozenset({"Python", _SETTINGS, "closure", _PROGRAM})


def edits(root: Path, old: str, new: str) -> list[str]:
    """Return one text clause for each definition that differs between two versions of code; an
    empty list if no record exists.
    """
    old_parts, new_parts = read_parts(root, old), read_parts(root, new)
    if not old_parts or not new_parts:
        return []
    source_clauses = _edited_modules(old_parts, new_parts)
    other_clauses: list[str] = []
    for name in dict.fromkeys([*new_parts, *old_parts]):
        if not _is_module(name) and not name.startswith(_STATE):
            other_clauses += _beside(name, old_parts.get(name, {}), new_parts.get(name, {}))
    # a changed value is reported only if nothing else explains the change
    return source_clauses + other_clauses or [
        f"a value that {_file(name.removeprefix(_STATE))} holds was changed while the program ran:"
        " a constant, a table, a default or a function"
        for name in new_parts
        if name.startswith(_STATE) and old_parts.get(name, new_parts[name]) != new_parts[name]
    ]


def _edited_modules(
    before: Mapping[str, dict[str, str]], after: Mapping[str, dict[str, str]]
) -> list[str]:
    """Return one text clause for each definition that differs, and for each module that is newly
    imported or no longer imported.
    """
    new_modules, old_modules = list(filter(_is_module, after)), list(filter(_is_module, before))
    definition_clauses: list[str] = []
    for name in new_modules:
        if name in before:
            definition_clauses += _inside(name, before[name], after[name])
    import_clauses = [
        f"{_file(name)} is imported now" for name in new_modules if name not in before
    ]
    removal_clauses = [
        f"{_file(name)} is no longer imported" for name in old_modules if name not in after
    ]
    # named functions and constants before "the imports" and "the other statements"
    return (
        sorted(definition_clauses, key=lambda text: text.startswith("the "))
        + import_clauses
        + removal_clauses
    )


def _is_module(name: str) -> bool:
    """Return True if the name of a part of a digest is the name of a module."""
    return all(word.isidentifier() for word in name.split(".")) and name not in _OTHER


def _beside(name: str, old: dict[str, str], new: dict[str, str]) -> list[str]:
    """Return one text clause for each difference in versions, settings and declared
    dependencies.
    """
    labels = [label for label in dict.fromkeys([*new, *old]) if old.get(label) != new.get(label)]
    if not labels:
        return []
    if name == _SETTINGS:
        return [_other_setting(label, old, new) for label in labels]
    return [_other_cause(name, old, new)]


def _other_setting(label: str, old: dict[str, str], new: dict[str, str]) -> str:
    """Return the text clause for a setting of the process that differs."""
    # a setting without a record has its usual value
    old_value, new_value = old.get(label, USUAL.get(label)), new.get(label, USUAL.get(label))
    return f"{label} {old_value} -> {new_value}, a setting of this process"


def _other_cause(name: str, old: dict[str, str], new: dict[str, str]) -> str:
    """Return the text clause for a version or a dependency that differs."""
    if name == "Python" or name.startswith("package "):
        return _other_version(name, old.get("version"), new.get("version"))
    if name == "closure":
        return "a value that the function of the node holds from the function around it changed"
    if name == _PROGRAM:
        return "the program itself changed, which the node imports (neusee/workflows)"
    if not old or not new:
        return f"{name} is declared {'now' if new else 'no more'}"
    return f"declared {name} changed" if name.startswith("file ") else f"{name} changed"


def _other_version(name: str, before: str | None, after: str | None) -> str:
    """Return the text clause for Python or a package of another version, or with other files."""
    if not before or not after:
        return f"{name} is {'used now' if after else 'no longer used'}"
    if before == after:
        return f"{name} has other files, under the same version: {after}"
    return f"{before} -> {after}{', an installed package' if name != 'Python' else ''}"


def _inside(module: str, old: dict[str, str], new: dict[str, str]) -> list[str]:
    """Return one text clause for each changed, added or removed definition of a module."""
    file = _file(module)
    changed_labels = [label for label in new if label in old and old[label] != new[label]]
    lines = _lines(module) if changed_labels else {}
    change_clauses = [
        _changed_definition(label, file, lines.get(label)) for label in changed_labels
    ]
    addition_clauses = [f"{_named(label)} was added to {file}" for label in new if label not in old]
    removal_clauses = [
        f"{_named(label)} was removed from {file}" for label in old if label not in new
    ]
    return change_clauses + addition_clauses + removal_clauses


def _changed_definition(label: str, file: str, line: int | None) -> str:
    """Return the text clause for a definition that changed, with its line."""
    definition = f"code of {label}" if label.endswith("()") else _named(label)
    return f"{definition} in {file} changed{f' (line {line})' if line is not None else ''}"


def _lines(module: str) -> dict[str, int]:
    """Return the line of each function, hook, class and constant at the top level of a module, in
    the present file.
    """
    path = source_file(module)
    try:
        body = ast.parse(path.read_bytes()).body if path else []
    except (OSError, SyntaxError):
        return {}
    lines = dict[str, int]()
    for item in body:
        lines |= dict.fromkeys(_labels_of(item), item.lineno)
    return lines


def _labels_of(item: ast.stmt) -> list[str]:
    """Return the labels of the definitions in a statement, in the form that the parts of a digest
    use.
    """
    if isinstance(item, ast.ClassDef):
        return [f"class {item.name}"]
    if isinstance(item, ast.FunctionDef):
        hooks = [ast.unparse(decorator) for decorator in item.decorator_list]
        # a hook is a function `_` with a decorator such as `@psf.check`
        return [f"{name}()" for name in (hooks if item.name == "_" and hooks else [item.name])]
    targets = item.targets if isinstance(item, ast.Assign) else []
    return [f"constant {target.id}" for target in targets if isinstance(target, ast.Name)]


def _named(label: str) -> str:
    """Return the name of a definition with its kind, such as ``function psf()`` or ``the
    imports``.
    """
    if label.endswith("()"):
        return f"function {label}"
    return label if label.startswith(("class ", "constant ")) else f"the {label}"


def _file(module: str) -> str:
    """Return the path of the file of a module, such as ``neusee/nodes/optics/psf.py``."""
    path = source_file(module)
    is_package = path is not None and path.name == "__init__.py"
    return module.replace(".", "/") + ("/__init__.py" if is_package else ".py")


# --- change wording -------------------------------------------------------------------------------

# Texts that describe changed parameters, with path, unit and location in the recipe.


_QUANTITY = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\D.*)")
_ABSENT = object()


class Wording:
    """Texts that describe changed parameters in the units of a recipe, or in SI units if there is
    no recipe.
    """

    def __init__(self, recipe: Recipe | None = None) -> None:
        self._recipe = recipe

    def params(self, label: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
        """Return one text clause for each parameter that differs between two results of the step
        ``label``.
        """
        step = self._recipe.steps.get(label) if self._recipe else None
        names = [name for name in dict.fromkeys([*old, *new]) if old.get(name) != new.get(name)]
        return [
            self._param(step, name, old.get(name, _ABSENT), new.get(name, _ABSENT))
            for name in names
        ]

    def source(self, *path: str) -> str:
        """Return the location of a value in the recipe, such as `` (recipe.yaml:3:7)``, or an
        empty string.
        """
        setting = self._recipe.config.settings.get(".".join(path)) if self._recipe else None
        return f" ({setting.source})" if setting else ""

    def _param(self, step: Step | None, name: str, old: Any, new: Any) -> str:
        """Return the text clause for one parameter that differs."""
        if new is _ABSENT:
            return f"{name} is no longer a parameter"
        setting, source = self._setting(step, name)
        path = ".".join(map(str, setting.path)) if setting else name
        place = f" ({source})" if source else ""
        if isinstance(new, Mapping) and "file" in new:
            place_of_value = f" ({path}{f', {source}' if source else ''})" if setting else place
            return f"file {_file_wording(step, name)}: {_other_file(old, new)}{place_of_value}"
        written_value = _written_value(setting)
        if old is _ABSENT:
            return f"{path} is new: {_as_written(written_value, new)}{place}"
        old_text, new_text = _both(written_value, old, new)
        return f"{path} {old_text} -> {new_text}{place}"

    def _setting(self, step: Step | None, name: str) -> tuple[Setting | None, str]:
        """Return the recipe setting that gives a parameter its value, or None, and the location
        of the value.
        """
        if step is None:
            return None, ""
        if name not in step.param_marks:
            return None, f"default of {step.node.path}"
        mark = str(step.param_marks[name])
        setting = _setting_of(self._marked.get(mark, []), step, name)
        return setting, setting.source if setting else mark

    @cached_property
    def _marked(self) -> Mapping[str, list[Setting]]:
        """Return the settings that the user wrote, by location in the recipe files."""
        settings = defaultdict(list)
        for setting in self._recipe.config.settings.values() if self._recipe else ():
            if not setting.default:
                settings[setting.source.partition(", ")[0]].append(setting)
        return settings


def _setting_of(marked: list[Setting], step: Step, name: str) -> Setting | None:
    """Return the setting, among those at one location, that gives the parameter ``name`` its value;
    None if this is ambiguous.
    """
    recipe_path = ("steps", step.name.partition("[")[0], "with", name)
    of_step = [setting for setting in marked if setting.path == recipe_path]
    candidates = of_step or [setting for setting in marked if setting.path[-1:] == (name,)]
    # a single setting at the location gives the value, whatever its name
    return (candidates or marked)[0] if candidates or len(marked) == 1 else None


def _written_value(setting: Setting | None) -> Any:
    """Return the value that the user wrote, or None for a reference to another value."""
    if setting is None or (isinstance(setting.value, str) and "${" in setting.value):
        return None
    return setting.value


def _file_wording(step: Step | None, name: str) -> str:
    """Return the name of the file in a parameter, or the name of the parameter if it contains no
    file.
    """
    value = step.params.get(name) if step else None
    return value.name if isinstance(value, Path) else name


def _other_file(old: Any, new: Mapping[str, Any]) -> str:
    """Return a text that describes how a parameter with a file has changed."""
    if not isinstance(old, Mapping) or "file" not in old:
        return "is given now"
    return (
        "other content" if old["file"] != new["file"] else f"{new['suffix']}, not {old['suffix']}"
    )


def _both(written: Any, old: Any, new: Any) -> tuple[str, str]:
    """Return the old and the new value of a parameter as text, both in the unit of the new
    value.
    """
    new_text = _as_written(written, new)
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        return _parts_in_units_of(written, new, old), new_text
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        # of two mappings, show only the entries that differ
        return _items(old, new)
    # (function from SI units, name of the unit)
    conversion_and_unit = _unit(written, new)
    old_text = (
        spoken(conversion_and_unit[0](old))
        if conversion_and_unit and _is_number(old)
        else spoken(old)
    )
    # the values differ by less than the shown digits
    if old_text in (spoken(new), new_text.partition(" ")[0]):
        return repr(old), repr(new)
    return old_text, new_text


def _parts_in_units_of(written: Any, new: list[Any], old: list[Any]) -> str:
    """Return the old list as text, each item in the unit of the corresponding new item."""
    has_all_items = isinstance(written, list) and len(written) == len(old)
    written_items = written if has_all_items else [None] * len(old)
    return f"[{', '.join(map(_in_unit_of, written_items, new, old))}]"


def _in_unit_of(written: Any, new: Any, old: Any) -> str:
    """Return an old value as text in the unit in which the new value was written."""
    conversion_and_unit = _unit(written, new)
    return (
        f"{spoken(conversion_and_unit[0](old))} {conversion_and_unit[1]}"
        if conversion_and_unit and _is_number(old)
        else spoken(old)
    )


def _is_number(value: Any) -> bool:
    """Return True for a number; bool does not count as a number."""
    return isinstance(value, float | int) and not isinstance(value, bool)


def _items(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, str]:
    """Return two texts: the entries that only the old mapping has, and the entries that only the
    new mapping has.
    """
    old_and_new_pairs = [
        [(str(key), value) for key, value in mapping.get("items", ())] for mapping in (old, new)
    ]
    # 0 is the old mapping, 1 the new one
    only_in_one = [
        [
            f"{k}: {spoken(v)}"
            for k, v in old_and_new_pairs[i]
            if (k, v) not in old_and_new_pairs[1 - i]
        ]
        for i in (0, 1)
    ]
    return f"{{{', '.join(only_in_one[0])}}}", f"{{{', '.join(only_in_one[1])}}}"


def _as_written(written: Any, new: Any) -> str:
    """Return a parameter value as text: as the user wrote the value if that text has a unit,
    else in short form.
    """
    if _unit(written, new) or (isinstance(written, list) and isinstance(new, list)):
        return flow(written)
    return spoken(new)


def _unit(written: Any, new: Any) -> tuple[Callable[[float], float], str] | None:
    """Return a function from SI units to the unit that the user wrote, and this unit; None if
    there is no unit.
    """
    match = _QUANTITY.fullmatch(written.strip()) if isinstance(written, str) else None
    if match is None or not _is_number(new):
        return None
    # a gain is stored as its inverse
    if match[2].strip() == "e-/DN":
        return (lambda si: 1.0 / si if si else math.inf), match[2]
    # the ratio of the written number to the SI value is the factor of the unit
    if new and float(match[1]):
        return _times(float(match[1]) / new), match[2]
    # for the value 0, the factor follows from the unit alone
    for si in ("m", "s", "rad", "K", "e-", "waves", "DN/e-"):
        with suppress(ValueError):
            return _times(1.0 / read_quantity(f"1 {match[2]}", si)), match[2]
    return None


def _times(factor: float) -> Callable[[float], float]:
    """Return a function that multiplies by a factor."""
    return lambda si: si * factor


def spoken(value: Any) -> str:
    """Return a short text for the value of a parameter."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        items = ", ".join(f"{spoken(k)}: {spoken(v)}" for k, v in value.get("items", ()))
        return f"a {value['suffix']} file".replace("  ", " ") if "file" in value else f"{{{items}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(spoken, value))}]"
    return "none" if value is None else flow(value)


# --- change causes --------------------------------------------------------------------------------

# Causes of a changed result: differences between a new and an earlier result, in the step or
# upstream of it.
#
# A pair is a new and an earlier result. The two results are compared by the parts of their keys, so
# that no tensor is read. The search goes from a pair to the pairs of its inputs whose keys differ.


Origin = Mapping[str, Any]  #: the parts of a key: node, code, params, inputs, stream
_MOST_NAMED_STEPS = 4  #: greatest number of steps of an input that a clause names
#: greatest number of upstream steps that are searched for an inserted step
_MOST_SEARCHED_STEPS = 100


class Pair(NamedTuple):
    """A new result of a step and an earlier, stored result."""

    label: str
    new: Key
    old: Key


Found = tuple[list[str], list[Pair]]  #: differences at a pair itself, and the pairs of its inputs


@dataclass(frozen=True, slots=True)
class Roots:
    """Root causes of a changed result, the nearest first, with the path from the compared step
    to each cause.
    """

    found: dict[str, Pair]  #: pair of results with each cause, by the description of the cause
    above: dict[Pair, Pair | None]

    def chain(self, text: str) -> list[str]:
        """Return the names of the steps from the compared step to the step with the cause
        ``text``.
        """
        labels: list[str] = []
        pair: Pair | None = self.found[text]
        while pair is not None:
            labels.append(pair.label)
            pair = self.above[pair]
        return labels[::-1]


def _only_in(names: Iterable[str], others: Container[str]) -> list[str]:
    """Return the names that are not among the others."""
    return [name for name in names if name not in others]


def _changed_pairs(now: Mapping[str, Key], then: Mapping[str, Key]) -> list[Pair]:
    """Return a pair for each name that both mappings contain with different keys."""
    return [Pair(name, key, then[name]) for name, key in now.items() if then.get(name, key) != key]


def _each_once(texts: Iterable[str], instead: str) -> list[str]:
    """Return each text once, with ``instead`` in place of an empty text."""
    return list(dict.fromkeys(text or instead for text in texts))


class Comparison:
    """Comparison of the results of a recipe, or of a stored result, with earlier stored results."""

    def __init__(
        self, store: Store, recipe: Recipe | None = None, resolved: Resolved | None = None
    ) -> None:
        self.store, self.recipe, self.resolved = store, recipe, resolved or Resolved()
        self.wording = Wording(recipe)
        self.seen: dict[Pair, Found] = {}
        self.about = functools.cache(store.about)
        self._edited = functools.cache(functools.partial(edits, store.root))

    def roots(self, start: Pair, limit: float = float("inf")) -> Roots | None:
        """Return the root causes of the change of a result, or None if there are more than
        ``limit`` causes.
        """
        pair_above: dict[Pair, Pair | None] = {start: None}
        pair_of_cause: dict[str, Pair] = {}
        pairs_to_compare = [start]
        for pair in (
            pairs_to_compare
        ):  # the list grows during the loop, so that the nearest pairs come first
            texts, input_pairs = self.compare(pair)
            for text in texts:
                pair_of_cause.setdefault(text, pair)
            # more causes than the limit: another earlier result is more similar
            if len(pair_of_cause) > limit:
                return None
            for input_pair in input_pairs:
                if input_pair not in pair_above:
                    pair_above[input_pair] = pair
                    pairs_to_compare.append(input_pair)
        return Roots(pair_of_cause, pair_above)

    def compare(self, pair: Pair) -> Found:
        """Return the differences between two results of a step, and the pairs of their inputs
        that differ.
        """
        if pair not in self.seen:
            self.seen[pair] = self._compare(pair)
        return self.seen[pair]

    def own(self, label: str, old: Origin, new: Origin) -> list[str]:
        """Return the differences between two results of a step in node, parameters, code and
        random stream.
        """
        if old["node"] != new["node"]:
            place = self.wording.source("steps", label.partition("[")[0], "node")
            return [f"{old['node']} -> {new['node']}{place}"]
        clauses = self.wording.params(label, old["params"], new["params"])
        # names of files and the order of mappings count for nodes of the user
        if not clauses and old.get("written") != new.get("written"):
            clauses = ["a file of a parameter has another name, or a mapping another order"]
        if old["code"] != new["code"]:
            private = [
                f"the loaded code of {new['node']} is not that of its file any more: restart Python"
            ]
            clauses += (
                private
                if is_private(new["code"])
                else self._edited(old["code"], new["code"])
                or [f"the code of {new['node']} changed"]
            )
        return clauses + self._stream(old.get("stream"), new.get("stream"))

    def origin(self, key: Key) -> Origin | None:
        """Return the parts of a cache key, from the recipe or from the store, or None if the key
        is unknown.
        """
        return self.resolved.origins.get(key) or (self.about(key) or {}).get("origin")

    def step(self, key: Key) -> str | None:
        """Return the name of the first step with the cache key ``key``, or None if the key is
        unknown.
        """
        return self.resolved.makers.get(key) or (self.about(key) or {}).get("step")

    def _compare(self, pair: Pair) -> Found:
        """Return what `compare` returns, from the parts of both keys."""
        old_origin, new_origin = self.origin(pair.old), self.origin(pair.new)
        if old_origin is None or new_origin is None:
            return [
                f"the {'earlier origin' if old_origin is None else 'origin'} of {pair.label}"
                " is no longer known"
            ], []
        causes = self.own(pair.label, old_origin, new_origin)
        # inputs of different nodes cannot be compared one by one
        if old_origin["node"] != new_origin["node"] or len(old_origin["inputs"]) != len(
            new_origin["inputs"]
        ):
            return causes, []
        input_pairs: list[Pair] = []
        for (path, labels), new_keys, old_keys in zip(
            self._labels(pair, new_origin), new_origin["inputs"], old_origin["inputs"], strict=True
        ):
            if new_keys != old_keys:
                input_texts, pairs_of_input = self._input(
                    path, labels, _listed(new_keys), _listed(old_keys)
                )
                causes, input_pairs = causes + input_texts, input_pairs + pairs_of_input
        return causes, input_pairs

    def _labels(self, pair: Pair, origin: Origin) -> list[tuple[tuple[str, ...], list[str]]]:
        """Return the path of each input in the recipe, and the names of the steps that this
        input reads.
        """
        step = self.recipe.steps.get(pair.label) if self.recipe else None
        # for a stored result of another recipe, its own record names the steps
        if step is None or self.resolved.keys.get(pair.label) != pair.new:
            return [
                ((), [self.step(key) or "a step" for key in _listed(keys)])
                for keys in origin["inputs"]
            ]
        path = ("steps", pair.label.partition("[")[0], "from")
        wires = [(name, _listed(step.wires.get(name))) for name in step.node.inputs]
        return [
            ((*path, name), [self.resolved.stands_for(wire) for wire in wired_steps])
            for name, wired_steps in wires
        ]

    def _input(
        self, path: tuple[str, ...], labels: list[str], new: list[Key], old: list[Key]
    ) -> Found:
        """Return the differences between the new and the earlier steps that one input reads."""
        if len(new) == 1 and len(old) == 1:
            return self._source(path, labels[0], new[0], old[0])
        old_key_of_step = dict(zip([self.step(key) or key for key in old], old, strict=True))
        new_key_of_step = dict(zip(labels, new, strict=True))
        # True if the earlier steps have different names, some of which still exist
        has_names = len(old_key_of_step) == len(old) and not old_key_of_step.keys().isdisjoint(
            new_key_of_step
        )
        if len(old) == len(new) and not has_names:
            return self._one_by_one(path, labels, new, old)
        texts = self._joined(
            path,
            _only_in(new_key_of_step, old_key_of_step),
            _only_in(old_key_of_step, new_key_of_step),
        )
        pairs = _changed_pairs(new_key_of_step, old_key_of_step)
        return texts or ([] if pairs else ["the order of its sources changed"]), pairs

    def _one_by_one(
        self, path: tuple[str, ...], labels: list[str], new: list[Key], old: list[Key]
    ) -> Found:
        """Return the differences between steps that correspond by their order."""
        texts, pairs = list[str](), list[Pair]()
        for label, key, earlier in zip(labels, new, old, strict=True):
            causes_and_pairs = self._source(path, label, key, earlier)
            texts += causes_and_pairs[0]
            pairs += causes_and_pairs[1]
        return texts, pairs

    def _source(self, path: tuple[str, ...], label: str, new: Key, old: Key) -> Found:
        """Return how one source of an input differs: its step has changed, or was exchanged, added
        or removed.
        """
        if new == old:
            return [], []
        old_step = self.step(old)
        if old_step in (None, label, self.step(new)):
            return [], [Pair(label, new, old)]
        exchange_clause = f"reads {label}, not {old_step}{self._wired(path)}"
        # the earlier step is still upstream: steps were added in between
        steps_between, key = self._between(new, (old_step,))
        if key is not None:
            texts = _each_once(map(self._came, steps_between), exchange_clause)
            return texts, [Pair(str(old_step), key, old)] if key != old else []
        # the present step was upstream before: steps were removed in between
        steps_between, key = self._between(old, (label, self.step(new)))
        if key is not None:
            texts = _each_once(map(self._went, steps_between), exchange_clause)
            return texts, [Pair(label, new, key)] if key != new else []
        old_origin, new_origin = self.origin(old), self.origin(new)
        # a step with the same node under another name
        if old_origin and new_origin and old_origin["node"] == new_origin["node"]:
            return [], [Pair(label, new, old)]
        return [exchange_clause], []

    def _joined(self, path: tuple[str, ...], came: list[str], went: list[str]) -> list[str]:
        """Return one text clause for the added and one for the removed steps that an input
        reads.
        """
        # inputs such as psf[mask] are not written by hand in the recipe
        place_of_wire = self._wired(path) if any("[" not in name for name in came) else ""
        texts = [f"reads {_few(came)} now{place_of_wire}"] if came else []
        reason_absent = (
            self.recipe.absent.get(went[0].partition("[")[0]) if went and self.recipe else None
        )
        return (
            [
                *texts,
                f"reads {_few(went)} no more{f': it is {reason_absent}' if reason_absent else ''}",
            ]
            if went
            else texts
        )

    def _between(self, key: Key, steps: tuple[str | None, ...]) -> tuple[list[str], Key | None]:
        """Go upstream along first inputs to a step in ``steps``; return the names of the steps in
        between, and the key that was found.
        """
        passed: list[str] = []
        for _ in range(_MOST_SEARCHED_STEPS):
            first_input = next(iter((self.origin(key) or {}).get("inputs", ())), None)
            if not isinstance(first_input, str):
                break
            # one step further upstream
            passed.append(self.step(key) or "a step")
            key = first_input
            if self.step(key) in steps:
                return passed, key
        return [], None

    def _came(self, name: str) -> str:
        """Return the reason why a step is no longer left out; an empty text for a step that is
        never left out.
        """
        if name not in self.resolved.verdicts:
            return ""
        verdict = self.resolved.verdicts[name]
        return f"{name} is no longer left out: {verdict.why if verdict else 'its inputs decide'}"

    def _went(self, name: str) -> str:
        """Return the reason why a step is left out now; an empty text if it is not."""
        verdict = self.resolved.verdicts.get(name)
        return f"{name} is left out now: {verdict.why}" if verdict and verdict.left_out else ""

    def _wired(self, path: tuple[str, ...]) -> str:
        """Return the location of an input in the recipe as text in brackets, such as ``
        (recipe.yaml:3:7)``.
        """
        return self.wording.source(*path) or self.wording.source(*path[:-1]) if path else ""

    def _stream(self, old: list[Any] | None, new: list[Any] | None) -> list[str]:
        """Return one text clause for each difference in the random stream of a step."""
        if old is None or new is None:
            return (
                []
                if old == new
                else ["it draws noise now" if new else "it draws no noise any more"]
            )
        texts = (
            # a stream is (seed, step, kind of device)
            f"seed {old[0]} -> {new[0]}{self.wording.source('seed')}",
            f"its noise uses the stream of {new[1]}, not of {old[1]}",
            f"its noise is drawn on {new[2]}, not on {old[2]}",
        )
        return [
            text
            for text, old_item, new_item in zip(texts, old, new, strict=True)
            if old_item != new_item
        ]


def _few(names: list[str]) -> str:
    """Return the first names of a list as text, such as ``a, b and 4 more``."""
    hidden = len(names) - _MOST_NAMED_STEPS
    return (
        ", ".join(names)
        if hidden <= 0
        else f"{', '.join(names[:_MOST_NAMED_STEPS])} and {hidden} more"
    )


def _listed(value: Any) -> list[Any]:
    """Return a value or a list of values as a list; None gives an empty list."""
    if value is None:
        return []
    return [value] if isinstance(value, str) else list(value)
