"""Nominal values of a recipe's uncertain inputs: distributions in place of values, and a ``posterior`` over several.

A run uses the median of a distribution, and the value that ``posterior`` chooses; the study of uncertainty draws both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from neusee.nodes.units import read_any
from neusee.workflows.graph.diagnostics import Diagnostic, Location, nearest
from neusee.workflows.recipe.distributions.joint import (
    BARE_GAIN,
    GAIN_UNIT,
    Joint,
    Posterior,
    read_posterior,
    summarised,
)
from neusee.workflows.recipe.distributions.scalar import Law, is_law, read_law, written
from neusee.workflows.recipe.text.composition import Composed
from neusee.workflows.recipe.text.references import BROKEN
from neusee.workflows.recipe.text.renamed_keys import POSTERIOR_NAMES
from neusee.workflows.recipe.text.yaml_values import Value, Where, dotted

KEY = "posterior"  #: key of the block in a recipe
_BLOCK = "sensor"  #: block of the values that a calibration names without a block
_SAID = ("file", "use", "values")
_SUMMARY = ("mean", "sd", "correlation", "covariance")
_FAR = 0.005  #: tail probability of a posterior beyond which a recipe's own value counts as far off


@dataclass(frozen=True)
class Standing:
    """A value of the recipe compared with its posterior."""

    path: str
    own: str  #: the recipe's own value
    kind: str  #: estimate, upper, lower, none
    mean: float
    sd: float
    low: float  #: 5 %
    high: float  #: 95 %
    unit: str
    below: float  #: probability of the posterior below the recipe's own value
    used: str  #: the value that a run uses
    why: str  #: source of the value that a run uses

    @property
    def far(self) -> bool:
        """Return True if the recipe's own value lies in the far tails of its posterior."""
        return not _FAR <= self.below <= 1 - _FAR


@dataclass(frozen=True)
class Uncertain:
    """The uncertain inputs of a recipe, and the recipe itself."""

    composed: Composed  #: with a value in place of every distribution
    laws: Mapping[str, Law]  #: by path
    joint: Joint | None  #: its names are paths
    standings: tuple[Standing, ...] = ()
    notes: tuple[str, ...] = ()
    source: str = ""  #: of the posterior
    units: Mapping[str, str] = field(default_factory=dict)  #: SI unit by path of the values in the joint distribution

    @property
    def names(self) -> tuple[str, ...]:
        """Return the paths of all uncertain values."""
        return (*self.laws, *(self.joint.names if self.joint else ()))

    def said(self, name: str) -> str:
        """Return the distribution of a value as text, or the source of its posterior."""
        return self.laws[name].text if name in self.laws else f"posterior {self.source}"

    def at(self, values: Mapping[str, float]) -> Any:
        """Return the recipe checked with these values, in SI; raise `RecipeError` for a bad value."""
        from neusee.workflows.recipe.loading import check

        root = self.composed.root
        for path, value in values.items():
            unit = self.laws[path].unit if path in self.laws else self.units[path]
            root = put(root, tuple(path.split(".")), written(value, unit))
        return check(replace(self.composed, root=root))


def settle(composed: Composed) -> tuple[Composed, Uncertain | None]:
    """Return the recipe with a value in place of every distribution; return a recipe without them unchanged."""
    laws, root = dict[str, Law](), composed.root
    diagnostics = list(composed.diagnostics)
    for path, leaf in _laws(root):
        try:
            laws[dotted(path)] = law = read_law(leaf.data)
        except ValueError as error:
            diagnostics.append(Diagnostic(leaf.mark, f"{dotted(path)} = {leaf.data}", str(error)))
            root = put(root, path, BROKEN)
            continue
        root = put(root, path, written(law.median, law.unit))
    given = root.items.get(KEY)
    if given is None and not laws and len(diagnostics) == len(composed.diagnostics):
        return composed, None
    notes = [f"{path} is {law.text}: this run uses {_said(law.median, law.unit)}" for path, law in laws.items()]
    found = _Reader(replace(root, data={key: v for key, v in root.data.items() if key != KEY}), laws, diagnostics)
    if given is not None:
        found.read(given)
    settled = replace(composed, root=found.root, diagnostics=tuple(diagnostics))
    rest = (tuple(found.standings), (*notes, *found.notes), found.source, found.units)
    return settled, Uncertain(replace(settled, diagnostics=()), laws, found.joint, *rest)


def _laws(root: Value) -> Iterator[tuple[Where, Value]]:
    """Yield every scalar that is written as a distribution, by its keys; an alias occurs at several places."""
    stack: list[tuple[Where, Value]] = [((key,), value) for key, value in root.items.items() if key != KEY]
    while stack:
        path, value = stack.pop()
        if is_law(value.data):
            yield path, value
        stack += [((*path, key), child) for key, child in value.items.items()]


def put(root: Value, path: Where, data: Any, mark: Location | None = None) -> Value:
    """Return ``root`` with another scalar at ``path``, which must exist."""
    if not path:
        return replace(root, data=data, mark=mark or root.mark)
    key = next(key for key in root.items if str(key) == str(path[0]))
    child = put(root.items[key], path[1:], data, mark)
    if isinstance(root.data, list):
        return replace(root, data=[child if i == key else value for i, value in enumerate(root.data)])
    return replace(root, data={**root.data, key: child})


def _at(root: Value, path: str) -> Value | None:
    here: Value | None = root
    for part in path.split("."):
        here = next((value for key, value in here.items.items() if str(key) == part), None) if here else None
    return here


class _Reader:
    """Reader of a recipe's ``posterior``, which puts the chosen values into the recipe."""

    def __init__(self, root: Value, laws: Mapping[str, Law], diagnostics: list[Diagnostic]) -> None:
        self.root, self.laws, self.diagnostics = root, laws, diagnostics
        self.joint: Joint | None = None
        self.standings: list[Standing] = []
        self.notes: list[str] = []
        self.units: dict[str, str] = {}
        self.source = ""

    def read(self, given: Value) -> None:
        """Read the posterior and apply it; report each mistake at the place where it was written."""
        if given.data is None:
            return
        said = given.items if isinstance(given.data, dict) else {"file": given}
        if strange := [v for key, v in said.items() if key not in (*_SAID, *_SUMMARY)]:
            return self._fail(strange[0].key, strange[0].name, f"unknown; {nearest(strange[0].name, _SAID)}")
        try:
            posterior = self._posterior(given, said)
            use = self._use(said.get("use"), posterior)
            pairs = self._pairs(said.get("values"), posterior, given)
        except ValueError as error:
            return self._fail(given.mark, KEY, str(error))
        self._apply(posterior, pairs, use, given.mark)

    def _posterior(self, given: Value, said: Mapping[Any, Value]) -> Posterior:
        if any(key in said for key in _SUMMARY):
            self.source = f"summary at {given.mark}"
            return summarised({key: _flat(v) for key, v in said.items() if key in _SUMMARY})
        file = said.get("file")
        if file is None or not isinstance(file.data, str):
            raise ValueError("write posterior: PATH, or posterior: {file: PATH, use: mean}")
        path = Path(file.mark.folder) / Path(file.data).expanduser()
        self.source = str(file.data)
        return read_posterior(path)

    def _use(self, given: Value | None, posterior: Posterior) -> str | int:
        use = "mean" if given is None else given.data
        drawn = posterior.joint.draws
        if use in ("mean", "nominal"):
            return str(use)
        if isinstance(use, int) and not isinstance(use, bool) and drawn is not None and 0 <= use < len(drawn):
            return use
        some = f", or the number of a draw, 0 to {len(drawn) - 1}" if drawn is not None else ""
        raise ValueError(f"use = {use}: write mean, nominal (the recipe's own value){some}")

    def _pairs(self, given: Value | None, posterior: Posterior, whole: Value) -> dict[str, str]:
        """Return the names in the posterior by the path of the recipe's value."""
        names = posterior.joint.names
        if given is not None and not isinstance(given.data, dict):
            raise ValueError("values: write {path of the recipe: name in the posterior}")
        if given is not None:
            pairs = {path: str(name) for path, name in _flat(given).items()}
            if wrong := [name for name in pairs.values() if name not in names]:
                now = POSTERIOR_NAMES.get(wrong[0])
                hint = (
                    f"is called {now} now" if now in names else f"is not in the posterior; {nearest(wrong[0], names)}"
                )
                raise ValueError(f"values: {wrong[0]} {hint}")
        else:
            all_pairs = {name if "." in name else f"{_BLOCK}.{name}": name for name in names}
            pairs = {path: name for path, name in all_pairs.items() if _at(self.root, path) is not None}
            if lost := [name for path, name in all_pairs.items() if path not in pairs]:
                self.notes.append(f"this recipe does not have these values of the posterior: {', '.join(lost)}")
        if wrong := [path for path in pairs if _at(self.root, path) is None]:
            raise ValueError(f"values: the recipe has no value {wrong[0]}")
        if not pairs:
            raise ValueError(f"no value of the recipe is in the posterior, which contains {', '.join(names)}")
        self._conventions(posterior, pairs)
        return pairs

    def _conventions(self, posterior: Posterior, pairs: Mapping[str, str]) -> None:
        """Raise ValueError where the posterior's gain has no unit, or where its exposure is not the recipe's."""
        for path, name in pairs.items():
            if self._is_gain(path) and posterior.units.get(name) != GAIN_UNIT:
                raise ValueError(f"its {name} has no unit: {BARE_GAIN}")
        exposure = _at(self.root, f"{_BLOCK}.exposure")
        words = posterior.units.get("dark_current", "")
        if "dark_current" in pairs.values() and exposure is not None and " in " in words:
            told, own = read_any(words.partition(" in ")[2])[0], read_any(exposure.data)[0]
            if abs(told - own) > 1e-9 * own:
                raise ValueError(f"the posterior's dark current is for {told:g} s, the recipe's exposure is {own:g} s")

    def _is_gain(self, path: str) -> bool:
        value = _at(self.root, path)
        return value is not None and isinstance(value.data, str) and value.data.strip().endswith(("e-/DN", GAIN_UNIT))

    def _apply(self, posterior: Posterior, pairs: Mapping[str, str], use: str | int, mark: Location) -> None:
        kept = {}
        for path, name in pairs.items():
            value = _at(self.root, path)
            assert value is not None
            if path in self.laws or value.mark.line == 0:
                if path in self.laws and value.mark.line:
                    self._fail(value.mark, path, "has a distribution here and in the posterior: remove one of the two")
                self.notes.append(f"{path} comes from the argument, not from the posterior")
                continue
            try:
                own, unit = read_any(value.data)
            except ValueError as error:
                self._fail(value.mark, path, f"is in the posterior, but {error}")
                continue
            kept[path] = name
            self.units[path] = unit
            self._stand(posterior, path, name, own, use, mark)
        if kept:
            joint = posterior.joint.only(tuple(kept.values()))
            self.joint = replace(joint, names=tuple(kept))

    def _stand(self, posterior: Posterior, path: str, name: str, own: float, use: str | int, mark: Location) -> None:
        """Compare the recipe's own value with its posterior, and put the value for a run into the recipe."""
        joint, unit, kind = posterior.joint, self.units[path], posterior.kind(name)
        i = joint.names.index(name)
        taken, why = own, "recipe"
        if isinstance(use, int):
            assert joint.draws is not None
            taken, why = float(joint.draws[use, i]), f"draw {use}"
        elif kind == "estimate" and use == "mean":
            taken, why = float(joint.mean[i]), "mean"
        if taken != own:
            self.root = put(self.root, tuple(path.split(".")), written(taken, unit), mark)
        low, high = joint.interval(name)
        numbers = (float(joint.mean[i]), float(joint.sd[i]), low, high)
        words = (unit, joint.below(name, own), _said(taken, unit), why)
        standing = Standing(path, _said(own, unit), kind, *numbers, *words)
        self.standings.append(standing)
        if standing.far:
            law = f"{standing.mean:.6g} ± {standing.sd:.2g} {unit}".rstrip()
            self.notes.append(f"{path} = {standing.own} is far from its posterior, {law} ({self.source})")

    def _fail(self, mark: Location, path: str, message: str) -> None:
        self.diagnostics.append(Diagnostic(mark, path, message))


def _flat(value: Value) -> Any:
    """Return a mapping by dotted paths, however deep; return the plain value of anything else."""
    if not isinstance(value.data, dict):
        return value.plain
    return {dotted(leaf.path[len(value.path) :]): leaf.plain for leaf in value.leaves() if leaf is not value}


def _said(value: float, unit: str) -> str:
    return f"{value:.6g} {unit}".rstrip()


def told(standings: Sequence[Standing]) -> list[dict[str, Any]]:
    """Return the comparisons as plain JSON."""
    return [{**{name: getattr(s, name) for name in Standing.__dataclass_fields__}, "far": s.far} for s in standings]
