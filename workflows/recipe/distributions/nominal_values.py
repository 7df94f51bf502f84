"""Nominal values of uncertain inputs: the single values that a run uses in place of probability
distributions and of a posterior.

A run uses the median of a distribution and the value that ``posterior`` chooses; the study of
uncertainty draws values.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from neusee.nodes.units import KNOWN_UNITS, read_any
from neusee.workflows.graph.errors import Diagnostic, Location, nearest
from neusee.workflows.recipe.distributions.joint_distribution import (
    BARE_GAIN,
    GAIN_UNIT,
    Joint,
    Posterior,
    read_posterior,
    summary,
)
from neusee.workflows.recipe.distributions.law_text import Difference, is_law, read_law
from neusee.workflows.recipe.distributions.shapes import Law, written
from neusee.workflows.recipe.text.composition import Composed
from neusee.workflows.recipe.text.other_spellings import POSTERIOR_NAMES
from neusee.workflows.recipe.text.references import BROKEN
from neusee.workflows.recipe.text.yaml_values import Value, Where, dotted

KEY = "posterior"  #: key of the block in a recipe
_BLOCK = "sensor"  #: block of the values that a calibration names without their block
_KEYS = ("file", "use", "values")
_SUMMARY = ("mean", "sd", "correlation", "covariance")
#: units in which a number without a unit could mean another multiple, such as mm
_MANY_SCALES = ("m", "s", "rad", "W", "J", "Hz")
#: probability of each tail of a posterior in which a recipe's own value counts as far off
_FAR = 0.005


@dataclass(frozen=True)
class Standing:
    """Comparison of a value in a recipe with the posterior distribution of that value."""

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
        """Return True if the recipe's own value lies in one of the two tails of the posterior
        with 0.5 % each.
        """
        return not _FAR <= self.below <= 1 - _FAR


@dataclass(frozen=True)
class Uncertain:
    """The uncertain values of a recipe, with their probability distributions."""

    composed: Composed  #: the recipe with a value in place of every distribution
    laws: Mapping[str, Law]  #: by path
    joint: Joint | None  #: joint distribution of the posterior's values, whose names are paths
    standings: tuple[Standing, ...] = ()
    notes: tuple[str, ...] = ()
    source: str = ""  #: of the posterior
    #: SI unit by path of the values in the joint distribution
    units: Mapping[str, str] = field(default_factory=dict)
    #: by path: difference between the true value in a training and the value of the recipe
    mismatch: Mapping[str, Difference] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the paths of all uncertain values of a recipe."""
        return (*self.laws, *(self.joint.names if self.joint else ()))

    def said(self, name: str) -> str:
        """Return the distribution of an uncertain value as text, or the source of the posterior
        with this value.
        """
        return self.laws[name].text if name in self.laws else f"posterior {self.source}"

    def composed_at(self, values: Mapping[str, float]) -> Composed:
        """Return the recipe, not yet checked, with the given numbers in SI units in place of its
        uncertain values.
        """
        root = self.composed.root
        for path, value in values.items():
            unit = self.laws[path].unit if path in self.laws else self.units[path]
            root = put(root, tuple(path.split(".")), written(value, unit))
        return replace(self.composed, root=root)


def settle(composed: Composed) -> tuple[Composed, Uncertain | None]:
    """Return a recipe with a number in place of every distribution, and its uncertain values, or
    None for none.
    """
    laws, root = dict[str, Law](), composed.root
    diagnostics = list(composed.diagnostics)
    for path, leaf in _laws(root):
        try:
            laws[dotted(path)] = law = read_law(leaf.data, Path(leaf.mark.folder), leaf.mark)
        except ValueError as error:
            diagnostics.append(Diagnostic(leaf.mark, f"{dotted(path)} = {leaf.data}", str(error)))
            root = put(root, path, BROKEN)
            continue
        # a run without draws uses the median
        root = put(root, path, written(law.median, law.unit))
    block = root.items.get(KEY)
    if block is None and not laws and len(diagnostics) == len(composed.diagnostics):
        return composed, None
    notes = [
        f"{path} is {law.text}: this run uses {_rounded(law.median, law.unit)}"
        for path, law in laws.items()
    ]
    reader = _Reader(root.without(KEY), laws, diagnostics)
    if block is not None:
        reader.read(block)
    settled = replace(composed, root=reader.root, diagnostics=tuple(diagnostics))
    return settled, Uncertain(
        replace(settled, diagnostics=()),
        laws,
        reader.joint,
        standings=tuple(reader.standings),
        notes=(*notes, *reader.notes),
        source=reader.source,
        units=reader.units,
    )


def _laws(root: Value) -> Iterator[tuple[Where, Value]]:
    """Yield the path and the value of every distribution in a recipe; a value with YAML aliases
    has several paths.
    """
    # reversed, because `_laws_in` takes from the end of its stack: together they keep one order
    for key, block in reversed(root.items.items()):
        if key != KEY:
            yield from (((key, *path), value) for path, value in _laws_in(block))


@functools.lru_cache(maxsize=64)
def _laws_in(block: Value) -> tuple[tuple[Where, Value], ...]:
    """Return the distributions in a block with their paths; cached, because the points of a sweep
    share unchanged blocks.
    """
    laws: list[tuple[Where, Value]] = []
    stack: list[tuple[Where, Value]] = [((), block)]
    while stack:
        path, value = stack.pop()
        if is_law(value.data):
            laws.append((path, value))
        stack += [((*path, key), child) for key, child in value.items.items()]
    return tuple(laws)


def put(root: Value, path: Where, data: Any, mark: Location | None = None) -> Value:
    """Return a recipe in which ``data`` replaces the value at an existing path."""
    if not path:
        return replace(root, data=data, mark=mark or root.mark)
    block_key = next(block_key for block_key in root.items if str(block_key) == str(path[0]))
    return root.replaced(block_key, put(root.items[block_key], path[1:], data, mark))


class _Reader:
    """Reader of the recipe key ``posterior``, which replaces values of the recipe by values from
    the posterior.
    """

    def __init__(self, root: Value, laws: Mapping[str, Law], diagnostics: list[Diagnostic]) -> None:
        self.root, self.laws, self.diagnostics = root, laws, diagnostics
        self.joint: Joint | None = None
        self.standings: list[Standing] = []
        self.notes: list[str] = []
        self.units: dict[str, str] = {}
        self.source = ""

    def read(self, block: Value) -> None:
        """Read the posterior that a recipe names, and put its values into the recipe; report
        each mistake.
        """
        if block.data is None:
            return None
        items = block.items if isinstance(block.data, dict) else {"file": block}
        if unknown_values := [v for key, v in items.items() if key not in (*_KEYS, *_SUMMARY)]:
            return self._fail(
                unknown_values[0].key,
                unknown_values[0].name,
                f"unknown; {nearest(unknown_values[0].name, _KEYS)}",
            )
        try:
            posterior = self._posterior(block, items)
        except ValueError as error:
            faulty = items.get("covariance") or items.get("correlation") or block
            return self._fail(faulty.mark, faulty.name, str(error))
        try:
            use = self._use(items.get("use"), posterior)
            pairs = self._pairs(items.get("values"), posterior)
        except ValueError as error:
            return self._fail(block.mark, KEY, str(error))
        self._apply(posterior, pairs, use, block.mark)
        return None

    def _posterior(self, block: Value, items: Mapping[Any, Value]) -> Posterior:
        """Return the posterior that the block names.

        It stands in the block itself, as means and deviations, or in a file.
        """
        if any(key in items for key in _SUMMARY):
            self.source = f"summary at {block.mark}"
            return summary({key: _flat(v) for key, v in items.items() if key in _SUMMARY})
        file = items.get("file")
        if file is None or not isinstance(file.data, str):
            raise ValueError(
                "the posterior has no file: write posterior: PATH, or posterior: {file: PATH, use:"
                " mean}"
            )
        self.source = file.data
        return read_posterior(Path(file.mark.folder) / Path(file.data).expanduser(), file.mark)

    def _use(self, setting: Value | None, posterior: Posterior) -> str | int:
        """Return which value of the posterior a run uses.

        It is ``mean``, ``nominal``, or the number of a draw.
        """
        use = "mean" if setting is None else setting.data
        draws = posterior.joint.draws
        if use in ("mean", "nominal"):
            return str(use)
        if (
            isinstance(use, int)
            and not isinstance(use, bool)
            and draws is not None
            and 0 <= use < len(draws)
        ):
            return use
        number = f", or the number of a draw, 0 to {len(draws) - 1}" if draws is not None else ""
        raise ValueError(f"use = {use}: write mean, nominal (the recipe's own value){number}")

    def _pairs(self, setting: Value | None, posterior: Posterior) -> dict[str, str]:
        """Return, by recipe path, the name in the posterior of each value that the recipe takes
        from it.
        """
        names = posterior.joint.names
        pairs = self._own_pairs(names) if setting is None else _stated_pairs(setting, names)
        if paths_without_value := [path for path in pairs if self._value(path) is None]:
            raise ValueError(
                f"values: the recipe has no value at the path {paths_without_value[0]}"
            )
        if not pairs:
            raise ValueError(
                f"no value of the recipe is in the posterior, which contains {', '.join(names)}"
            )
        untold_values = [
            name for name in posterior.untold if self._value(f"{_BLOCK}.{name}") is not None
        ]
        if untold_values and setting is None:
            self.notes.append(
                f"the posterior does not contain {', '.join(untold_values)}: the recipe's own"
                " value counts as certain"
            )
        self._conventions(posterior, pairs)
        return pairs

    def _own_pairs(self, names: Sequence[str]) -> dict[str, str]:
        """Return, by recipe path, the names in the posterior that values of the recipe have; note
        the names without a value.
        """
        all_pairs = {name if "." in name else f"{_BLOCK}.{name}": name for name in names}
        pairs = {path: name for path, name in all_pairs.items() if self._value(path) is not None}
        if names_without_value := [name for path, name in all_pairs.items() if path not in pairs]:
            self.notes.append(
                "this recipe does not have these values of the posterior:"
                f" {', '.join(names_without_value)}"
            )
        return pairs

    def _conventions(self, posterior: Posterior, pairs: Mapping[str, str]) -> None:
        """Raise ValueError if a posterior has a gain without a unit, or a dark current for
        another exposure time.
        """
        for path, name in pairs.items():
            value = self._value(path)
            is_gain = (
                value
                and isinstance(value.data, str)
                and value.data.strip().endswith(("e-/DN", GAIN_UNIT))
            )
            if is_gain and posterior.units.get(name) != GAIN_UNIT:
                raise ValueError(f"the {name} of the posterior has no unit: {BARE_GAIN}")
        exposure = self._value(f"{_BLOCK}.exposure")
        dark_current_unit = posterior.units.get("dark_current", "")
        if (
            "dark_current" in pairs.values()
            and exposure is not None
            and " in " in dark_current_unit
        ):
            # a dark current has a unit such as ``e- in 1 s``
            posterior_exposure, recipe_exposure = (
                read_any(dark_current_unit.partition(" in ")[2])[0],
                read_any(exposure.data)[0],
            )
            if abs(posterior_exposure - recipe_exposure) > 1e-9 * recipe_exposure:
                raise ValueError(
                    f"the dark current is for {posterior_exposure:g} s in the posterior and"
                    f" {recipe_exposure:g} s in the"
                    " recipe"
                )

    def _value(self, path: str) -> Value | None:
        return self.root.below(path.split("."))

    def _apply(
        self, posterior: Posterior, pairs: Mapping[str, str], use: str | int, mark: Location
    ) -> None:
        """Put the values of the posterior into the recipe, and compare them with the recipe's own
        values.

        A value that an argument sets stays; a distribution in the recipe is a mistake.
        """
        name_by_path = {}
        for path, name in pairs.items():
            value = self._value(path)
            assert value is not None
            # line 0: an argument of the command sets this value
            if path in self.laws or value.mark.line == 0:
                if path in self.laws and value.mark.line:
                    self._fail(
                        value.mark,
                        path,
                        "the value has a distribution both here and in the posterior: remove one"
                        " of the two",
                    )
                self.notes.append(f"{path} comes from the argument, not from the posterior")
                continue
            try:
                recipe_value, unit = read_any(value.data)
            except ValueError as error:
                self._fail(value.mark, path, f"the posterior contains this value, but {error}")
                continue
            if fault := _unit_fault(name, posterior.units.get(name, ""), unit):
                self._fail(mark, KEY, fault)
                continue
            name_by_path[path] = name
            self.units[path] = unit
            self._stand(posterior, path, name, recipe_value, use, mark)
        if name_by_path:
            # the values that were taken keep their correlations; their names are now paths
            joint = posterior.joint.only(tuple(name_by_path.values()))
            self.joint = replace(joint, names=tuple(name_by_path))

    def _stand(
        self, posterior: Posterior, path: str, name: str, own: float, use: str | int, mark: Location
    ) -> None:
        """Compare a value in the recipe with the posterior, and replace it by the value that a
        run uses.
        """
        joint, unit, kind = posterior.joint, self.units[path], posterior.kinds.get(name, "estimate")
        i = joint.names.index(name)
        # a value that the frames do not estimate stays that of the recipe
        used_value, origin = own, "recipe"
        if isinstance(use, int):
            assert joint.draws is not None
            used_value, origin = float(joint.draws[use, i]), f"draw {use}"
        elif kind == "estimate" and use == "mean":
            used_value, origin = float(joint.mean[i]), "mean"
        if used_value != own:
            self.root = put(self.root, tuple(path.split(".")), written(used_value, unit), mark)
        interval_low, interval_high = joint.interval(name)
        standing = Standing(
            path,
            own=_rounded(own, unit),
            kind=kind,
            mean=float(joint.mean[i]),
            sd=float(joint.sd[i]),
            low=interval_low,
            high=interval_high,
            unit=unit,
            below=joint.below(name, own),
            used=_rounded(used_value, unit),
            why=origin,
        )
        self.standings.append(standing)
        if standing.far:
            law = f"{standing.mean:.6g} ± {standing.sd:.2g} {unit}".rstrip()
            self.notes.append(
                f"{path} = {standing.own} is far from its posterior, {law} ({self.source})"
            )

    def _fail(self, mark: Location, path: str, message: str) -> None:
        self.diagnostics.append(Diagnostic(mark, path, message))


def _unit_fault(name: str, unit: str, own: str) -> str:
    """Return what is wrong with the unit of a posterior's value, compared with the unit ``own`` of
    the recipe's value; empty if nothing is wrong.
    """
    if not unit and own in _MANY_SCALES:
        return (
            f"the {name} of the posterior has no unit: write it after the mean, or in the heading,"
            f" {name} [{own}]"
        )
    if unit in KNOWN_UNITS and unit != own:
        return (
            f"the {name} of the posterior is in {unit}, and the value of the recipe in"
            f" {own or 'no unit'}"
        )
    return ""


def _stated_pairs(setting: Value, names: Sequence[str]) -> dict[str, str]:
    """Return, by recipe path, the names in the posterior that a recipe states."""
    if not isinstance(setting.data, dict):
        raise ValueError(
            "values must be a mapping: write values: {path in the recipe: name in the posterior}"
        )
    pairs = {path: str(name) for path, name in _flat(setting).items()}
    if unknown_names := [name for name in pairs.values() if name not in names]:
        present_name = POSTERIOR_NAMES.get(unknown_names[0])
        hint = (
            f"called {present_name} now"
            if present_name in names
            else f"not in the posterior; {nearest(unknown_names[0], names)}"
        )
        raise ValueError(f"values: {unknown_names[0]} is {hint}")
    return pairs


def _flat(value: Value) -> Any:
    """Return the values of a nested YAML mapping by dotted path; return any other YAML value as
    plain data.
    """
    if not isinstance(value.data, dict):
        return value.plain
    return {
        dotted(leaf.path[len(value.path) :]): leaf.plain
        for leaf in value.leaves()
        if leaf is not value
    }


def _rounded(value: float, unit: str) -> str:
    return f"{value:.6g} {unit}".rstrip()


def standing_rows(standings: Sequence[Standing]) -> list[dict[str, Any]]:
    """Return comparisons of recipe values with their posteriors as data for JSON."""
    return [{**asdict(standing), "far": standing.far} for standing in standings]
