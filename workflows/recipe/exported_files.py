"""Data files that a run writes: the key ``exports`` of a recipe, with the names of the files."""

from __future__ import annotations

from collections.abc import Iterator

from neusee.workflows.graph.diagnostics import nearest
from neusee.workflows.recipe.text.references import BROKEN, Scope
from neusee.workflows.recipe.text.yaml_values import Value
from neusee.workflows.recipe.wiring import Wiring

KEY, ALL, NONE, HALF = "exports", "all", "none", "@half"
#: files of the folder ``data`` of a run; `report.contents` says what each of them has
NAMES = (
    "radiance.exr",
    "psf_plain.exr",
    "psf_mask.exr",
    "raw_plain.png",
    "raw_mask.png",
    "raw_plain.exr",
    "raw_mask.exr",
    "restored.exr",
    "restored.png",
    "restored_spread.exr",
    "invented.png",
    "outputs.safetensors",
)


def exports_of(root: Value, wiring: Wiring) -> dict[str, bool] | None:
    """Return the names of the data files that a run writes, with True for half floats; None for all files."""
    given = root.items.get(KEY)
    if given is None:
        return None
    values = given.data if isinstance(given.data, list) else [given]
    words = [wiring.references.resolve(value, Scope({}, KEY)) for value in values]
    if not isinstance(given.data, list) and words[0].data in (None, ALL, NONE):
        return {} if words[0].data == NONE else None
    return dict(_named(words, wiring))


def _named(words: list[Value], wiring: Wiring) -> Iterator[tuple[str, bool]]:
    for word in words:
        name = str(word.data).removesuffix(HALF)
        half = str(word.data) != name
        if word.data is BROKEN:
            continue
        if name not in NAMES:
            text = f"no file of a run; {nearest(name, NAMES)}: write {ALL}, {NONE} or a list of names"
            wiring.refuse(word, f"{KEY} = {word.data}", text)
        elif half and not name.endswith(".exr"):
            wiring.refuse(word, f"{KEY} = {word.data}", "only an .exr file can have half floats")
        else:
            yield name, half
