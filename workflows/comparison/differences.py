"""Differences between two runs: numbers, recipe, code, environment, pictures, data files."""

from __future__ import annotations

import filecmp
import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neusee.nodes.file_headers import exr_needs, picture_needs, safetensors_need
from neusee.workflows.comparison.run_record import FinalValue, NotComparable, RunRecord
from neusee.workflows.keys.sealed_files import refuse_other_than_file
from neusee.workflows.report.figures.style import canvas, drawn, picture

# --- differences ----------------------------------------------------------------------------------

# Differences between two runs in numbers, recipe, code and environment, as rows of tables.


_MEASURED = frozenset({"engine", "peak memory"})  #: facts of a run that differ each time
_STATE, _PACKAGE, _SETTINGS, _PYTHON = "state of ", "package ", "settings", "Python"
_NAMES_OF_LINE = 6  #: names that a line lists
_NO_VALUE = FinalValue("", "")


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
        """Return right minus left, 0 for equal numbers (also infinite or NaN ones), None where
        one is missing.
        """
        if self.left is None or self.right is None:
            return None
        if self.left == self.right or (math.isnan(self.left) and math.isnan(self.right)):
            return 0.0
        return self.right - self.left

    @property
    def relative(self) -> float:
        """Return the difference relative to the larger number of both, without sign; infinite
        where none is defined.
        """
        difference = self.difference
        if difference == 0:
            return 0.0
        if difference is None or not math.isfinite(difference):
            return math.inf
        return abs(difference) / max(
            abs(side) for side in (self.left, self.right) if side is not None
        )


@dataclass(frozen=True)
class ValueDifference:
    """One entry that differs, with its text in both runs and its sources; an empty text stands
    for no entry.
    """

    name: str
    left: str
    right: str
    left_source: str = ""
    right_source: str = ""


def numbers(left: RunRecord, right: RunRecord) -> list[NumberDifference]:
    """Return every number of two runs, in the order of the first run and then of the second."""
    sides = [
        # the document writes NaN and infinity as null
        {
            (step, field, index): math.nan if value is None else value
            for step, field, index, value in record.document.metrics
        }
        for record in (left, right)
    ]
    names = dict.fromkeys([*sides[0], *sides[1]])
    return [NumberDifference(*name, sides[0].get(name), sides[1].get(name)) for name in names]


def largest(numbers: list[NumberDifference]) -> list[NumberDifference]:
    """Return, for each result that differs, its number with the largest relative difference; the
    largest first.
    """
    largest_of_result: dict[str, NumberDifference] = {}
    for number in numbers:
        largest_so_far = (
            largest_of_result[number.name].relative if number.name in largest_of_result else 0.0
        )
        if number.relative > largest_so_far:
            largest_of_result[number.name] = number
    return sorted(largest_of_result.values(), key=lambda number: -number.relative)


def table(left: RunRecord, right: RunRecord) -> tuple[list[str], list[list[str]]]:
    """Return the result tables of two runs as one table, whose rows are the rows of both runs in
    turn.
    """
    sides = [record.document.table for record in (left, right)]
    columns = list(dict.fromkeys([*sides[0].columns, *sides[1].columns]))
    rows_of_both = itertools.chain(*(side.rows for side in sides))
    names = dict.fromkeys(str(row.get("name", "")) for row in rows_of_both)
    rows = []
    for name in names:
        for side, run_word in zip(sides, ("left", "right"), strict=True):
            cells = next(
                (
                    dict(zip(side.columns, r.get("cells", []), strict=False))
                    for r in side.rows
                    if r.get("name") == name
                ),
                None,
            )
            if cells is not None:
                rows.append([name, run_word, *(str(cells.get(column, "")) for column in columns)])
    return ["", "run", *columns], rows


def recipe(left: RunRecord, right: RunRecord) -> list[ValueDifference]:
    """Return the final values that differ between two recipes, each with the places where it was
    written.
    """
    differing = []
    for name in dict.fromkeys([*left.values, *right.values]):
        left_value, right_value = (record.values.get(name, _NO_VALUE) for record in (left, right))
        if left_value.text != right_value.text:
            differing.append(
                ValueDifference(
                    name, left_value.text, right_value.text, left_value.source, right_value.source
                )
            )
    return differing


def code(left: RunRecord, right: RunRecord) -> list[str] | None:
    """Return one line for each node whose code differs and for each changed definition; None
    without digests.
    """
    if left.code is None or right.code is None:
        return None
    left_nodes, right_nodes = left.code.nodes, right.code.nodes
    changed = sorted(
        node
        for node in left_nodes.keys() & right_nodes.keys()
        if left_nodes[node] != right_nodes[node]
    )
    only_one_uses = [
        f"only the {side} run uses the node {node}"
        for side, node in _names_of_one_side(left_nodes, right_nodes)
    ]
    nodes = [f"the code of {_listed(changed)} differs"] if changed else []
    return [
        *nodes,
        *only_one_uses,
        *_definitions(left.code.parts, right.code.parts, complete=not only_one_uses),
    ]


def environment(left: RunRecord, right: RunRecord) -> list[ValueDifference]:
    """Return what differs in command, device, machine, versions and settings of two runs."""
    sides = [_surroundings(record) for record in (left, right)]
    differing = []
    for name in dict.fromkeys([*sides[0], *sides[1]]):
        values = [side.get(name, "") for side in sides]
        if values[0] != values[1]:
            differing.append(ValueDifference(name, left=values[0], right=values[1]))
    return differing


def _surroundings(record: RunRecord) -> dict[str, str]:
    """Return command, device, machine, versions and settings of a run, by name."""
    document = record.document
    facts = {name: value for name, value in document.facts if name not in _MEASURED}
    facts |= {"neusee": document.version, "device": document.device, "recipe": document.recipe}
    facts |= {"command": document.command}
    parts = record.code.parts if record.code else {}
    for name, definitions in parts.items():
        if name.startswith(_PACKAGE):
            facts.setdefault(name.removeprefix(_PACKAGE), _release(definitions))
    return facts | parts.get(_SETTINGS, {})


def steps(left: RunRecord, right: RunRecord) -> list[str]:
    """Return lines that count the steps with other cache keys, and name the steps that only one
    run has.
    """
    left_keys, right_keys = (
        {row.step: row.key for row in record.document.steps} for record in (left, right)
    )
    common = left_keys.keys() & right_keys.keys()
    differ = [name for name in left_keys if name in common and left_keys[name] != right_keys[name]]
    lines = (
        [f"{len(differ)} of {len(common)} common steps have another cache key: {_listed(differ)}"]
        if differ
        else []
    )
    return [
        *lines,
        *(
            f"only the {side} run has the step {name}"
            for side, name in _names_of_one_side(left_keys, right_keys)
        ),
    ]


def _release(package: Mapping[str, str]) -> str:
    """Return the version of a package, with the digest of its files if it was recorded."""
    content = package.get("content")
    return f"{package['version']} (files {content[:8]})" if content else package["version"]


def _definitions(
    left: Mapping[str, Mapping[str, str]], right: Mapping[str, Mapping[str, str]], complete: bool
) -> Iterator[str]:
    """Yield one line for each definition of a module, or declared file, that differs.

    With ``complete``, also for each module that only one run uses, which means little if their
    nodes are not the same.
    """
    for module in sorted(left.keys() | right.keys()):
        if module in (_SETTINGS, _PYTHON) or module.startswith(_PACKAGE):
            continue
        if module in left and module in right:
            yield from _changes(left, right, module)
        elif complete and not module.startswith(_STATE):
            yield f"only the {'left' if module in left else 'right'} run uses {module}"


def _changes(
    left: Mapping[str, Mapping[str, str]], right: Mapping[str, Mapping[str, str]], module: str
) -> Iterator[str]:
    """Yield the differences in a module that both runs use, or in the values that the
    module holds.
    """
    left_definitions, right_definitions = left[module], right[module]
    if module.startswith(_STATE):
        name = module.removeprefix(_STATE)
        if left_definitions != right_definitions and left.get(name) == right.get(name):
            yield f"a value that {name} holds differs: a constant, a table or a default"
        return
    for label in sorted(left_definitions.keys() | right_definitions.keys()):
        if left_definitions.get(label) != right_definitions.get(label):
            change = _definition_change(left_definitions, right_definitions, label)
            yield f"{module}: {label} {change}"


def _definition_change(old: Mapping[str, str], new: Mapping[str, str], label: str) -> str:
    """Return how a definition differs: in both runs, or only in one of them."""
    if label in old and label in new:
        return "differs"
    return f"is only in the {'left' if label in old else 'right'} run"


def _names_of_one_side(
    left: Mapping[str, object], right: Mapping[str, object]
) -> Iterator[tuple[str, str]]:
    """Yield (``left`` or ``right``, name) for each name that only one side has."""
    yield from (("left", name) for name in left if name not in right)
    yield from (("right", name) for name in right if name not in left)


def _listed(names: list[str]) -> str:
    """Return names as text, at most `_NAMES_OF_LINE` of them, and how many more there are."""
    more_names = len(names) - _NAMES_OF_LINE
    return (
        ", ".join(names)
        if more_names <= 0
        else f"{', '.join(names[:_NAMES_OF_LINE])} and {more_names} more"
    )


# --- picture differences --------------------------------------------------------------------------

# Differences between the pictures and data files of two runs, and drawings of both sides with their
# difference.


#: figures of one run's times and states, which are no results
_TIMES = frozenset({"timeline", "graph", "error_time"})
_COLOURS = 4  #: channels of a data file that is drawn as a picture
_WIDE_RATIO = 1.7  #: width over height, above which the two sides stand one above the other
_DAMAGED = "the file is damaged: run the recipe again"


@dataclass(frozen=True)
class FileDifference:
    """The difference between a file of one run and the file of the same name of another run, and
    a drawing of both.
    """

    name: str
    state: str  #: "same", "differs", or why the contents cannot be subtracted
    #: largest absolute difference, in the unit of the file or in levels of 0 to 255
    largest: float | None = None
    rms: float | None = None  #: root mean square of the difference
    scale: float | None = None  #: largest absolute value of both files
    drawing: bytes | None = None  #: PNG


def figures(left: Path, right: Path) -> list[FileDifference]:
    """Return the difference of each figure that both runs have, apart from figures of times."""
    names = [
        name
        for name in _common(left / "figures", right / "figures", ".png")
        if Path(name).stem not in _TIMES
    ]
    return [_figure(name, left / "figures" / name, right / "figures" / name) for name in names]


def data_files(left: Path, right: Path) -> list[FileDifference]:
    """Return the difference of each data file that both runs have: each EXR file and each tensor of
    a safetensors file.

    Only the bytes of other files are compared.
    """
    differences: list[FileDifference] = []
    for name in _common(left / "data", right / "data"):
        left_file, right_file = left / "data" / name, right / "data" / name
        if filecmp.cmp(left_file, right_file, shallow=False):
            differences.append(FileDifference(name, "same"))
        elif name.endswith(".exr"):
            differences.append(_exr(name, left_file, right_file))
        elif name.endswith(".safetensors"):
            differences += _tensors(name, left_file, right_file)
        else:
            differences.append(FileDifference(name, "differs"))
    return differences


def only_one_has(left: Path, right: Path) -> list[str]:
    """Return a line for each figure and each data file that only one of two runs has."""
    lines = []
    for folder in ("figures", "data"):
        left_names, right_names = _names(left / folder), _names(right / folder)
        lines += [
            f"only the left run has {folder}/{name}"
            for name in sorted(left_names - right_names)
            if _counts(name)
        ]
        lines += [
            f"only the right run has {folder}/{name}"
            for name in sorted(right_names - left_names)
            if _counts(name)
        ]
    return lines


def _counts(name: str) -> bool:
    """Return True for a file that shows results, not times."""
    return Path(name).stem not in _TIMES


def _names(folder: Path) -> set[str]:
    """Return the names of the files in a folder; none without the folder."""
    return {path.name for path in folder.iterdir() if path.is_file()} if folder.is_dir() else set()


def _common(left: Path, right: Path, suffix: str = "") -> list[str]:
    """Return the names with a suffix that both folders have, in alphabetical order."""
    return sorted(name for name in _names(left) & _names(right) if name.endswith(suffix))


def _figure(name: str, left: Path, right: Path) -> FileDifference:
    """Return the difference of two drawn figures, in levels of 0 to 255."""
    import numpy as np

    if filecmp.cmp(left, right, shallow=False):
        return FileDifference(name, "same")
    left_levels, right_levels = _levels(left), _levels(right)
    if left_levels.shape != right_levels.shape:
        sizes = " and ".join(
            f"{levels.shape[1]} x {levels.shape[0]}" for levels in (left_levels, right_levels)
        )
        return FileDifference(
            name,
            f"drawn in two sizes, {sizes} pixels",
            drawing=drawing(left_levels, right_levels, None, ""),
        )
    # int16, because the difference of two bytes may be negative; the largest of R, G, B
    differences_of_pixels = np.abs(left_levels.astype(np.int16) - right_levels).max(-1)
    largest = int(differences_of_pixels.max())
    if not largest:
        return FileDifference(name, "same")
    rms = float(np.sqrt(np.mean(differences_of_pixels.astype(float) ** 2)))
    drawing_of_both = drawing(
        left_levels,
        right_levels,
        differences_of_pixels,
        f"difference, at most {largest} of 255 levels",
    )
    return FileDifference(name, "differs", largest, rms, 255.0, drawing_of_both)


def _levels(path: Path) -> Any:
    """Return a picture file as RGB (y, x, 3) from 0 to 255; raise `NotComparable` for a bad one."""
    import numpy as np
    from PIL import Image, UnidentifiedImageError

    try:
        refuse_other_than_file(path)
        with Image.open(path) as image:
            picture_needs(path, image, 3)
            return np.asarray(image.convert("RGB"))
    except ValueError as error:
        raise NotComparable(str(error)) from None
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise NotComparable(f"{path}: {error}: {_DAMAGED}") from None


def _exr(name: str, left: Path, right: Path) -> FileDifference:
    """Return the difference of two EXR files, drawn if they have few channels."""
    import numpy as np

    left_channels, right_channels = _channels(left), _channels(right)
    if left_channels.keys() != right_channels.keys() or any(
        left_channels[channel].shape != right_channels[channel].shape for channel in left_channels
    ):
        return FileDifference(
            name, f"differs in channels or size: {_form(left_channels)} and {_form(right_channels)}"
        )
    left_values, right_values = (
        np.stack([channels[channel] for channel in left_channels]).astype(np.float64)
        for channels in (left_channels, right_channels)
    )
    difference = _numbers(name, left_values, right_values)
    if difference.largest and len(left_channels) <= _COLOURS:
        # not the maximum, which a single bright pixel decides
        white = (
            float(np.nanpercentile(np.maximum(np.abs(left_values), np.abs(right_values)), 99.9))
            or 1.0
        )
        one_view, other_view = (
            _viewed(values / white, list(left_channels)) for values in (left_values, right_values)
        )
        text = f"difference, at most {difference.largest:.4g}"
        return replace(
            difference,
            drawing=drawing(one_view, other_view, np.abs(left_values - right_values).max(0), text),
        )
    return difference


def _channels(path: Path) -> dict[str, Any]:
    """Return the channels of an EXR file by name; raise `NotComparable` for a damaged one."""
    import OpenEXR

    try:
        exr_needs(path, 8.0)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: channel.pixels for name, channel in file.parts[0].channels.items()}
    except Exception as error:  # OpenEXR raises plain errors of several kinds
        raise NotComparable(f"{path}: {error}: {_DAMAGED}") from None


def _form(channels: Mapping[str, Any]) -> str:
    """Return number and size of the channels of a file as text."""
    first_channel = next(iter(channels.values()))
    return f"{len(channels)} channels of {first_channel.shape[1]} x {first_channel.shape[0]}"


def _viewed(image: Any, names: list[str]) -> Any:
    """Return channels as RGB for the screen: in the order R, G, B, else grey, with the gamma of
    a screen.
    """
    import numpy as np

    order = (
        [names.index(colour) for colour in "RGB"] if {"R", "G", "B"} <= set(names) else [0, 0, 0]
    )
    # 1 / 2.2 is the gamma of a screen
    return np.clip(np.nan_to_num(image[order]), 0, 1).transpose(1, 2, 0) ** (1 / 2.2)


def _tensors(name: str, left: Path, right: Path) -> Iterator[FileDifference]:
    """Yield the difference of each tensor with several elements; single numbers are compared with
    the numbers of the run.
    """
    left_tensors, right_tensors = _loaded(left), _loaded(right)
    for key in dict.fromkeys([*left_tensors, *right_tensors]):
        title = f"{name}: {key}"
        if (
            key in left_tensors
            and key in right_tensors
            and left_tensors[key].size == right_tensors[key].size == 1
        ):
            continue  # a single number is one of the numbers of the run
        if key not in left_tensors or key not in right_tensors:
            yield FileDifference(
                title, f"only the {'left' if key in left_tensors else 'right'} run has it"
            )
        elif left_tensors[key].shape != right_tensors[key].shape:
            shapes = (tuple(tensors[key].shape) for tensors in (left_tensors, right_tensors))
            yield FileDifference(title, f"differs in shape: {' and '.join(map(str, shapes))}")
        else:
            yield _numbers(title, left_tensors[key], right_tensors[key])


def _loaded(path: Path) -> dict[str, Any]:
    """Return the tensors of a safetensors file by name, in float64; raise `NotComparable` for a bad
    one.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        safetensors_need(path, 3.0)
        return {key: value.double().numpy() for key, value in load_file(path).items()}
    except (SafetensorError, OSError, ValueError) as error:
        raise NotComparable(f"{path}: {error}: {_DAMAGED}") from None


def _numbers(name: str, left: Any, right: Any) -> FileDifference:
    """Return the largest and the root mean square difference of two arrays; equal and paired NaN
    values differ by 0.
    """
    import numpy as np

    with np.errstate(invalid="ignore"):
        absolute_difference = np.where(
            (left == right) | (np.isnan(left) & np.isnan(right)), 0.0, np.abs(left - right)
        )
    if not absolute_difference.size or not absolute_difference.any():
        return FileDifference(name, "same")
    if not np.isfinite(absolute_difference).all():
        place_count = int((~np.isfinite(absolute_difference)).sum())
        return FileDifference(
            name, f"differs, with NaN or infinity in one run alone at {place_count} places"
        )
    scale = float(max(np.nanmax(np.abs(values)) for values in (left, right)))
    return FileDifference(
        name,
        "differs",
        float(absolute_difference.max()),
        float(np.sqrt(np.mean(absolute_difference**2))),
        scale,
    )


@drawn
def drawing(left: Any, right: Any, change: Any, title: str) -> Any:
    """Draw two pictures side by side, or one above the other if they are wide, and then their
    difference.
    """
    height, width = left.shape[:2]
    panels = 2 if change is None else 3
    is_wide = width / height > _WIDE_RATIO
    panel_height, rows, columns = (
        9.6 * min(1.0, height / width) + 0.5,
        panels if is_wide else 1,
        1 if is_wide else panels,
    )
    figure, axes = canvas(
        9.6 if is_wide else 3.7 * panels + 0.5,
        panels * panel_height if is_wide else 4.2,
        rows,
        columns,
    )
    panels_in_order = axes.ravel()
    for panel, image, name in zip(panels_in_order, (left, right), ("left", "right"), strict=False):
        picture(panel, image, name, interpolation="antialiased")
    if change is not None:
        upper_end = _upper_end(change)
        colour_image = picture(
            panels_in_order[2],
            change,
            title,
            cmap="magma",
            vmin=0.0,
            vmax=upper_end,
            interpolation="antialiased",
        )
        figure.colorbar(
            colour_image,
            ax=panels_in_order[2],
            shrink=0.8,
            extend="max" if change.max() > upper_end else "neither",
        )
    return figure


def _upper_end(change: Any) -> float:
    """Return the upper end of the colours of a difference: 99.5 % of the pixels that differ are
    below.
    """
    import numpy as np

    return float(np.percentile(change[change > 0], 99.5))
