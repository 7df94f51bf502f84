"""Causes of a changed result: differences between a new and an earlier result, in the step or upstream of it.

A pair is a new and an earlier result. The two results are compared by the parts of their keys, so that no
tensor is read. The search goes from a pair to the pairs of its inputs whose keys differ.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from neusee.workflows.engine.resolved_keys import Resolved
from neusee.workflows.explain.change_wording import Wording
from neusee.workflows.explain.code_changes import edits
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import Key, is_private
from neusee.workflows.store.result_store import Store

Origin = Mapping[str, Any]  #: the parts of a key: node, code, params, inputs, stream
_FEW = 4  #: steps of an input that a clause names
_FAR = 100  #: steps upstream that are searched for an inserted step


class Pair(NamedTuple):
    """A new result of a step and an earlier, stored result."""

    label: str
    new: Key
    old: Key


Found = tuple[list[str], list[Pair]]  #: differences at a pair itself, and the pairs of its inputs


@dataclass(frozen=True, slots=True)
class Roots:
    """Root causes of a changed result, the nearest first, with the path from the compared step to each cause."""

    found: dict[str, Pair]  #: by the description of the cause
    above: dict[Pair, Pair | None]

    def chain(self, text: str) -> list[str]:
        """Return the names of the steps from the compared step to the step with the cause ``text``."""
        way: list[str] = []
        pair: Pair | None = self.found[text]
        while pair is not None:
            way.append(pair.label)
            pair = self.above[pair]
        return way[::-1]


class Comparison:
    """Comparison of the results of a recipe, or of a stored result, with earlier stored results."""

    def __init__(self, store: Store, recipe: Recipe | None = None, resolved: Resolved | None = None) -> None:
        self.store, self.recipe, self.resolved = store, recipe, resolved or Resolved()
        self.wording = Wording(recipe)
        self.seen: dict[Pair, Found] = {}
        self.about = functools.cache(store.about)
        self._edited = functools.cache(functools.partial(edits, store.root))

    def roots(self, start: Pair, most: float = float("inf")) -> Roots | None:
        """Return the root causes of the change of a result, or None if there are more than ``most`` causes."""
        above: dict[Pair, Pair | None] = {start: None}
        found: dict[str, Pair] = {}
        todo = [start]
        for pair in todo:  # the list grows during the loop, so that the nearest pairs come first
            texts, below = self.compare(pair)
            for text in texts:
                found.setdefault(text, pair)
            if len(found) > most:
                return None
            for other in below:
                if other not in above:
                    above[other] = pair
                    todo.append(other)
        return Roots(found, above)

    def compare(self, pair: Pair) -> Found:
        """Return the differences between two results of a step, and the pairs of their inputs that differ."""
        if pair not in self.seen:
            self.seen[pair] = self._compare(pair)
        return self.seen[pair]

    def own(self, label: str, old: Origin, new: Origin) -> list[str]:
        """Return the differences between two results of a step in node, parameters, code and random stream."""
        if old["node"] != new["node"]:
            where = self.wording.source("steps", label.partition("[")[0], "node")
            return [f"{old['node']} -> {new['node']}{where}"]
        found = self.wording.params(label, old["params"], new["params"])
        if not found and old.get("written") != new.get("written"):
            found = ["a file of a parameter has another name, or a mapping another order"]
        if old["code"] != new["code"]:
            private = [f"the loaded code of {new['node']} is not that of its file any more: restart Python"]
            found += (
                private
                if is_private(new["code"])
                else self._edited(old["code"], new["code"]) or [f"the code of {new['node']} changed"]
            )
        return found + self._stream(old.get("stream"), new.get("stream"))

    def origin(self, key: Key) -> Origin | None:
        """Return the parts of a cache key, from the recipe or from the store, or None if the key is unknown."""
        return self.resolved.origins.get(key) or (self.about(key) or {}).get("origin")

    def step(self, key: Key) -> str | None:
        """Return the name of the first step with the cache key ``key``, or None if the key is unknown."""
        return self.resolved.makers.get(key) or (self.about(key) or {}).get("step")

    def _compare(self, pair: Pair) -> Found:
        old, new = self.origin(pair.old), self.origin(pair.new)
        if old is None or new is None:
            return [f"the {'earlier origin' if old is None else 'origin'} of {pair.label} is no longer known"], []
        texts = self.own(pair.label, old, new)
        if old["node"] != new["node"] or len(old["inputs"]) != len(new["inputs"]):
            return texts, []
        pairs: list[Pair] = []
        for (path, labels), after, before in zip(self._labels(pair, new), new["inputs"], old["inputs"], strict=True):
            if after != before:
                more, behind = self._input(path, labels, _listed(after), _listed(before))
                texts, pairs = texts + more, pairs + behind
        return texts, pairs

    def _labels(self, pair: Pair, origin: Origin) -> list[tuple[tuple[str, ...], list[str]]]:
        """Return the path of each input in the recipe, and the names of the steps that this input reads."""
        step = self.recipe.steps.get(pair.label) if self.recipe else None
        if step is None or self.resolved.keys.get(pair.label) != pair.new:
            return [((), [self.step(key) or "a step" for key in _listed(keys)]) for keys in origin["inputs"]]
        path = ("steps", pair.label.partition("[")[0], "from")
        wires = [(name, _listed(step.wires.get(name))) for name in step.node.inputs]
        return [((*path, name), [self.resolved.stands_for(wire) for wire in wired]) for name, wired in wires]

    def _input(self, path: tuple[str, ...], labels: list[str], new: list[Key], old: list[Key]) -> Found:
        """Return the differences between the new and the earlier steps that one input reads."""
        if len(new) == 1 and len(old) == 1:
            return self._source(path, labels[0], new[0], old[0])
        then = dict(zip([self.step(key) or key for key in old], old, strict=True))
        now = dict(zip(labels, new, strict=True))
        if len(old) == len(new) and (len(then) < len(old) or not then.keys() & now.keys()):
            found = [self._source(path, *row) for row in zip(labels, new, old, strict=True)]
            return [t for texts, _ in found for t in texts], [p for _, pairs in found for p in pairs]
        texts = self._joined(path, [n for n in now if n not in then], [n for n in then if n not in now])
        pairs = [Pair(name, key, then[name]) for name, key in now.items() if then.get(name, key) != key]
        return texts or ([] if pairs else ["the order of its sources changed"]), pairs

    def _source(self, path: tuple[str, ...], label: str, new: Key, old: Key) -> Found:
        """Return how one source of an input differs: a step has changed, or was exchanged, added or removed."""
        if new == old:
            return [], []
        was = self.step(old)
        if was in (None, label, self.step(new)):
            return [], [Pair(label, new, old)]
        exchanged = f"reads {label}, not {was}{self._wired(path)}"
        between, key = self._between(new, (was,))
        if key is not None:
            texts = [self._came(name) or exchanged for name in between]
            return list(dict.fromkeys(texts)), [Pair(str(was), key, old)] if key != old else []
        between, key = self._between(old, (label, self.step(new)))
        if key is not None:
            texts = [self._went(name) or exchanged for name in between]
            return list(dict.fromkeys(texts)), [Pair(label, new, key)] if key != new else []
        before, after = self.origin(old), self.origin(new)
        if before and after and before["node"] == after["node"]:
            return [], [Pair(label, new, old)]
        return [exchanged], []

    def _joined(self, path: tuple[str, ...], came: list[str], went: list[str]) -> list[str]:
        """Return one text clause for the added and one for the removed steps that an input reads."""
        where = self._wired(path) if any("[" not in name for name in came) else ""
        texts = [f"reads {_few(came)} now{where}"] if came else []
        null = self.recipe.absent.get(went[0].partition("[")[0]) if went and self.recipe else None
        return [*texts, f"reads {_few(went)} no more{f': it is {null}' if null else ''}"] if went else texts

    def _between(self, key: Key, wanted: tuple[str | None, ...]) -> tuple[list[str], Key | None]:
        """Go upstream along first inputs to a step in ``wanted``; return the passed steps and the key found."""
        passed: list[str] = []
        for _ in range(_FAR):
            first = next(iter((self.origin(key) or {}).get("inputs", ())), None)
            if not isinstance(first, str):
                break
            passed.append(self.step(key) or "a step")
            key = first
            if self.step(key) in wanted:
                return passed, key
        return [], None

    def _came(self, name: str) -> str:
        if name not in self.resolved.verdicts:
            return ""
        verdict = self.resolved.verdicts[name]
        return f"{name} is no longer left out: {verdict.why if verdict else 'its inputs decide'}"

    def _went(self, name: str) -> str:
        verdict = self.resolved.verdicts.get(name)
        return f"{name} is left out now: {verdict.why}" if verdict and verdict.left_out else ""

    def _wired(self, path: tuple[str, ...]) -> str:
        """Return the location of an input in the recipe as text in brackets, such as `` (recipe.yaml:3:7)``."""
        return self.wording.source(*path) or self.wording.source(*path[:-1]) if path else ""

    def _stream(self, old: list[Any] | None, new: list[Any] | None) -> list[str]:
        """Return one text clause for each difference in the random stream of a step."""
        if old is None or new is None:
            return [] if old == new else ["it draws noise now" if new else "it draws no noise any more"]
        texts = (
            f"seed {old[0]} -> {new[0]}{self.wording.source('seed')}",
            f"its noise uses the stream of {new[1]}, not of {old[1]}",
            f"its noise is drawn on {new[2]}, not on {old[2]}",
        )
        return [text for text, before, after in zip(texts, old, new, strict=True) if before != after]


def _few(names: list[str]) -> str:
    """Return the first names of a list as text, such as ``a, b and 4 more``."""
    rest = len(names) - _FEW
    return ", ".join(names) if rest <= 0 else f"{', '.join(names[:_FEW])} and {rest} more"


def _listed(value: Any) -> list[Any]:
    return [] if value is None else [value] if isinstance(value, str) else list(value)
