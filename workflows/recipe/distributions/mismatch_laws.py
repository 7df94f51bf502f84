"""Laws of how a camera differs from what a recipe says of it: a training draws them, and the restorer is not told.

A ``lognormal`` or ``loguniform`` law multiplies the value of the recipe; any other law, or a single value, is added
to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from neusee.nodes.units import read_any
from neusee.workflows.graph.diagnostics import Diagnostic, Location, nearest
from neusee.workflows.recipe.distributions.law_text import is_law, read_law
from neusee.workflows.recipe.distributions.scalar import Law
from neusee.workflows.recipe.distributions.shapes import Moved, Normal, Shape
from neusee.workflows.recipe.text.yaml_values import Value

_NARROW = 1e-3  #: standard deviation of a true value that is certain, relative to the value of the recipe
_NARROWEST = 1e-9  #: standard deviation in SI if the value of the recipe is 0
ANGLE = "angle"  #: key of the direction of a laser, of which y and x differ independently


@dataclass(frozen=True)
class Difference:
    """The law of the difference of one value from that of the recipe."""

    law: Law
    own: float  #: value of the recipe, in SI
    mark: Location

    def of(self, value: float, drawn: float) -> float:
        """Return the true value of the camera from the value of the recipe and a draw."""
        return value * drawn if self.law.multiplies else value + drawn

    @property
    def truth(self) -> Law:
        """Return the distribution of the true value, which is nowhere a single value."""
        shape: Shape = self.law.shape
        if isinstance(shape, Normal) and not shape.sd:
            shape = Normal(shape.mean, abs(self.own) * _NARROW or _NARROWEST)
        if self.law.multiplies:
            return replace(self.law, shape=Moved(shape, factor=self.own))
        return replace(self.law, shape=Moved(shape, offset=self.own))


def read_mismatch(block: Value, root: Value, diagnostics: list[Diagnostic]) -> dict[str, Difference]:
    """Return the differences that ``train.mismatch`` states, by the path of the value in the recipe ``root``."""
    found = {}
    for path, leaf in _laws(block):
        try:
            found[path] = _difference(path, leaf, root)
        except ValueError as error:
            diagnostics.append(Diagnostic(leaf.mark, f"{block.name}.{path}", str(error)))
    return found


def _laws(block: Value, above: str = "") -> Iterator[tuple[str, Value]]:
    for key, value in block.items.items():
        if isinstance(value.data, dict):
            yield from _laws(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def _difference(path: str, leaf: Value, root: Value) -> Difference:
    own = root.below(path.split("."))
    if own is None:
        raise ValueError(f"the recipe has no value {path}; {nearest(path, [each.name for each in root.leaves()])}")
    value, unit = _own(path, own)
    law = read_law(leaf.data, Path(leaf.mark.folder), leaf.mark) if is_law(leaf.data) else _single(leaf)
    if law.reciprocal:
        raise ValueError(f"a gain in e-/DN has no difference that is added: write lognormal(1, …), not {law.text}")
    if law.multiplies:
        if law.unit:
            raise ValueError(f"{law.kind} multiplies {path}: write it without the unit {law.unit}")
        if not value:
            raise ValueError(f"{path} is 0, which {law.text} would multiply: write normal(…, …) or uniform(…, …)")
    elif law.unit != unit:
        raise ValueError(f"{law.text} is added to {path}, whose unit is {unit or 'none'}, not {law.unit or 'none'}")
    return Difference(replace(law, unit=unit), value, leaf.mark)


def _own(path: str, own: Value) -> tuple[float, str]:
    """Return the value of the recipe and its unit; a direction counts as 0 rad, because it may be drawn."""
    if path.rpartition(".")[2] == ANGLE:
        return 0.0, "rad"
    if own.data is None:
        raise ValueError(f"{path} is null, from which nothing can differ: give it a value first")
    return read_any(own.plain)


def _single(leaf: Value) -> Law:
    value, unit = read_any(leaf.plain)
    return Law("normal", str(leaf.data), Normal(value, 0.0), unit)
