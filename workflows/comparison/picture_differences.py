"""Differences between the pictures and data files of two runs, and drawings of both sides with their difference."""

from __future__ import annotations

import filecmp
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neusee.workflows.comparison.run_record import NotComparable
from neusee.workflows.keys.regular_file import refuse_other_than_file
from neusee.workflows.report.figures.style import canvas, drawn, picture

_TIMES = frozenset({"timeline", "graph", "error_time"})  #: figures of one run's times and states, which are no results
_COLOURS = 4  #: channels of a data file that is drawn as a picture
_WIDE = 1.7  #: width over height, above which the two sides stand one above the other
_BROKEN = "the file is damaged: run the recipe again"


@dataclass(frozen=True)
class FileDifference:
    """The difference between a file of one run and the file of the same name of another run, and a drawing of both."""

    name: str
    state: str  #: "same", "differs", or why the contents cannot be subtracted
    largest: float | None = None  #: largest absolute difference, in the unit of the file or in levels of 0 to 255
    rms: float | None = None  #: root mean square of the difference
    scale: float | None = None  #: largest absolute value of both files
    drawing: bytes | None = None  #: PNG


def figures(left: Path, right: Path) -> list[FileDifference]:
    """Return the difference of each figure that both runs have, apart from figures of times."""
    names = [name for name in _common(left / "figures", right / "figures", ".png") if Path(name).stem not in _TIMES]
    return [_figure(name, left / "figures" / name, right / "figures" / name) for name in names]


def data_files(left: Path, right: Path) -> list[FileDifference]:
    """Return the difference of each data file that both runs have: each EXR file and each tensor of a safetensors file.

    Only the bytes of other files are compared.
    """
    found: list[FileDifference] = []
    for name in _common(left / "data", right / "data"):
        one, other = left / "data" / name, right / "data" / name
        if filecmp.cmp(one, other, shallow=False):
            found.append(FileDifference(name, "same"))
        elif name.endswith(".exr"):
            found.append(_exr(name, one, other))
        elif name.endswith(".safetensors"):
            found += _tensors(name, one, other)
        else:
            found.append(FileDifference(name, "differs"))
    return found


def only_one_has(left: Path, right: Path) -> list[str]:
    """Return a line for each figure and each data file that only one of two runs has."""
    lines = []
    for folder in ("figures", "data"):
        here, there = _names(left / folder), _names(right / folder)
        lines += [f"only the left run has {folder}/{name}" for name in sorted(here - there) if _counts(name)]
        lines += [f"only the right run has {folder}/{name}" for name in sorted(there - here) if _counts(name)]
    return lines


def _counts(name: str) -> bool:
    return Path(name).stem not in _TIMES


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if path.is_file()} if folder.is_dir() else set()


def _common(left: Path, right: Path, suffix: str = "") -> list[str]:
    return sorted(name for name in _names(left) & _names(right) if name.endswith(suffix))


def _figure(name: str, left: Path, right: Path) -> FileDifference:
    """Return the difference of two drawn figures, in levels of 0 to 255."""
    import numpy as np

    if filecmp.cmp(left, right, shallow=False):
        return FileDifference(name, "same")
    one, other = _levels(left), _levels(right)
    if one.shape != other.shape:
        sizes = " and ".join(f"{x.shape[1]} x {x.shape[0]}" for x in (one, other))
        return FileDifference(name, f"drawn in two sizes, {sizes} pixels", drawing=drawing(one, other, None, ""))
    change = np.abs(one.astype(np.int16) - other).max(-1)
    largest = int(change.max())
    if not largest:
        return FileDifference(name, "same")
    rms = float(np.sqrt(np.mean(change.astype(float) ** 2)))
    shown = drawing(one, other, change, f"difference, at most {largest} of 255 levels")
    return FileDifference(name, "differs", largest, rms, 255.0, shown)


def _levels(path: Path) -> Any:
    import numpy as np
    from PIL import Image, UnidentifiedImageError

    from neusee.nodes.picture_bytes import picture_needs

    try:
        refuse_other_than_file(path)
        with Image.open(path) as image:
            picture_needs(path, image, 3)
            return np.asarray(image.convert("RGB"))
    except ValueError as error:
        raise NotComparable(str(error)) from None
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise NotComparable(f"{path}: {error}: {_BROKEN}") from None


def _exr(name: str, left: Path, right: Path) -> FileDifference:
    import numpy as np

    one, other = _channels(left), _channels(right)
    if one.keys() != other.keys() or any(one[c].shape != other[c].shape for c in one):
        return FileDifference(name, f"differs in channels or size: {_form(one)} and {_form(other)}")
    a, b = (np.stack([channels[c] for c in one]).astype(np.float64) for channels in (one, other))
    found = _numbers(name, a, b)
    if found.largest and len(one) <= _COLOURS:
        top = float(np.nanpercentile(np.maximum(np.abs(a), np.abs(b)), 99.9)) or 1.0
        one_view, other_view = (_viewed(x / top, list(one)) for x in (a, b))
        text = f"difference, at most {found.largest:.4g}"
        return replace(found, drawing=drawing(one_view, other_view, np.abs(a - b).max(0), text))
    return found


def _channels(path: Path) -> dict[str, Any]:
    import OpenEXR

    from neusee.nodes.picture_bytes import exr_needs

    try:
        exr_needs(path, 8.0)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: channel.pixels for name, channel in file.parts[0].channels.items()}
    except Exception as error:  # OpenEXR raises plain errors of several kinds
        raise NotComparable(f"{path}: {error}: {_BROKEN}") from None


def _form(channels: Mapping[str, Any]) -> str:
    first = next(iter(channels.values()))
    return f"{len(channels)} channels of {first.shape[1]} x {first.shape[0]}"


def _viewed(image: Any, names: list[str]) -> Any:
    """Return channels as RGB for the screen: in the order R, G, B, else grey, with the gamma of a screen."""
    import numpy as np

    order = [names.index(c) for c in "RGB"] if {"R", "G", "B"} <= set(names) else [0, 0, 0]
    return np.clip(np.nan_to_num(image[order]), 0, 1).transpose(1, 2, 0) ** (1 / 2.2)


def _tensors(name: str, left: Path, right: Path) -> Iterator[FileDifference]:
    """Yield the difference of each tensor with several elements; the numbers of a run have the others."""
    one, other = _loaded(left), _loaded(right)
    for key in dict.fromkeys([*one, *other]):
        title = f"{name}: {key}"
        if key in one and key in other and one[key].size == other[key].size == 1:
            continue  # a single number is one of the numbers of the run
        if key not in one or key not in other:
            yield FileDifference(title, f"only the {'left' if key in one else 'right'} run has it")
        elif one[key].shape != other[key].shape:
            yield FileDifference(title, f"differs in shape: {tuple(one[key].shape)} and {tuple(other[key].shape)}")
        else:
            yield _numbers(title, one[key], other[key])


def _loaded(path: Path) -> dict[str, Any]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    from neusee.nodes.array_bytes import safetensors_need

    try:
        safetensors_need(path, 3.0)
        return {key: value.double().numpy() for key, value in load_file(path).items()}
    except (SafetensorError, OSError, ValueError) as error:
        raise NotComparable(f"{path}: {error}: {_BROKEN}") from None


def _numbers(name: str, one: Any, other: Any) -> FileDifference:
    """Return the largest and the root mean square difference of two arrays; equal and paired NaN values differ by 0."""
    import numpy as np

    with np.errstate(invalid="ignore"):
        change = np.where((one == other) | (np.isnan(one) & np.isnan(other)), 0.0, np.abs(one - other))
    if not change.size or not change.any():
        return FileDifference(name, "same")
    if not np.isfinite(change).all():
        places = int((~np.isfinite(change)).sum())
        return FileDifference(name, f"differs, with NaN or infinity in one run alone at {places} places")
    scale = float(max(np.nanmax(np.abs(x)) for x in (one, other)))
    return FileDifference(name, "differs", float(change.max()), float(np.sqrt(np.mean(change**2))), scale)


@drawn
def drawing(left: Any, right: Any, change: Any, title: str) -> Any:
    """Draw two pictures side by side, or one above the other if they are wide, and their difference behind them."""
    height, width = left.shape[:2]
    panels = 2 if change is None else 3
    wide = width / height > _WIDE
    long, rows, columns = 9.6 * min(1.0, height / width) + 0.5, panels if wide else 1, 1 if wide else panels
    figure, axes = canvas(9.6 if wide else 3.7 * panels + 0.5, panels * long if wide else 4.2, rows, columns)
    places = axes.ravel()
    for place, image, name in zip(places, (left, right), ("left", "right"), strict=False):
        picture(place, image, name, interpolation="antialiased")
    if change is not None:
        top = _upper_end(change)
        shown = picture(places[2], change, title, cmap="magma", vmin=0.0, vmax=top, interpolation="antialiased")
        figure.colorbar(shown, ax=places[2], shrink=0.8, extend="max" if change.max() > top else "neither")
    return figure


def _upper_end(change: Any) -> float:
    """Return the upper end of the colours of a difference: 99.5 % of the pixels that differ are below."""
    import numpy as np

    return float(np.percentile(change[change > 0], 99.5))
