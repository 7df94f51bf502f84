"""Light levels and series of frames of a recipe, as the sheet of EMVA 1288 needs them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import numpy as np

from neusee.nodes.calibrate import (
    FrameTest,
    Nonuniformity,
    SpatialSeries,
    Stack,
    coarse,
    descriptor,
    descriptor_frames,
    descriptor_release,
    descriptor_series,
    inspect_frames,
    levels,
    reduce,
    refuse_descriptor,
    spatial_series,
)
from neusee.nodes.values import Levels
from neusee.workflows.engine.runner import run
from neusee.workflows.frames.descriptor_file import quoted
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

Release = Literal["4", "3"]
_STEADY = 3.1  #: release of EMVA 1288 since which the variance in time excludes the difference of means
#: what the standard wants to be told of the operating point
OPERATING_POINT = {
    "camera": "camera",
    "sensor": "sensor",
    "gain_setting": "gain setting",
    "offset_setting": "offset setting",
    "pixel_pitch": "pixel pitch",
    "wavelength": "centroid wavelength of the light",
    "bandwidth": "width of its spectrum (FWHM)",
    "spectrum": "spectrum of the lamp",
    "photometer": "calibration of the light: instrument and certificate",
    "temperature": "temperature",
    "laboratory": "laboratory and date",
}
_HALF = 0.5  #: share of saturation at which the lit series is taken
_TEXT = """# EMVA 1288: the sheet of the measurement {name}.
steps:
  measured: {{node: calibrate.descriptor, with: {{file: {file}, scatter: steady}}}}
outputs: [measured]
"""


class EmvaFrames(NamedTuple):
    """The input of a sheet."""

    levels: Levels
    spatial: Nonuniformity
    frames: int  #: least number of frames of a level
    tests: Sequence[FrameTest] = ()  #: of the frames themselves
    release: Release = "4"  #: whose variance in time the levels have
    stated: str = ""  #: release that the descriptor states


def descriptor_recipe(file: Path, changes: Sequence[str] = ()) -> Recipe:
    """Return the recipe of a sheet of the measurement that an EMVA 1288 descriptor file describes.

    Raises: ValueError for a descriptor or an image that is missing or cannot be read, `RecipeError` with all mistakes
    of ``changes``.
    """
    refuse_descriptor(file)
    name = "".join(c if c.isalnum() else "_" for c in file.parent.absolute().name or file.stem)
    text = _TEXT.format(name=file.name, file=quoted(str(file.absolute())))
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.yaml"
        path.write_text(text, encoding="utf-8")
        return load(path, changes)


def frames_of_recipe(recipe: Recipe, store: Store, release: Release | None = None) -> EmvaFrames:
    """Return levels with the variance in time, and the dark and the lit series, of a recipe that reads frames.

    In release 4 the variance of a level excludes the difference of the means of its frames; in 3 it includes it. By
    default the release is that which the descriptor states, and 4 where no descriptor states one.
    Raises: ValueError for a recipe that reads neither frames, a descriptor nor a table.
    """
    steps = {path: [s for s in recipe.steps.values() if s.node.path == path] for path in _READERS}
    if described := steps["calibrate.descriptor"]:
        stated = descriptor_release(described[0].params["file"])
        release = release or ("3" if stated and float(stated) < _STEADY else "4")
        return _described(described[0], _SCATTER[release])._replace(release=release, stated=stated)
    release = release or "4"
    if reduced := steps["calibrate.reduce"]:
        return _reduced(recipe, store, reduced, _SCATTER[release])._replace(release=release)
    if tables := steps["calibrate.table"]:
        found = run(recipe, store, (tables[0].name,)).values[tables[0].name]
        dark = found.variance[found.photons == 0]
        tests = [coarse(float(dark.min()), exact=False)] if len(dark) else []
        return EmvaFrames(found, Nonuniformity(None, None), 2, tests)
    raise ValueError(f"{recipe.name} has no step of the nodes {', '.join(_READERS)}, so that it has no frames of a "
                     "sheet of EMVA 1288: give a descriptor, or a recipe as in `neusee run calibrate`")  # fmt: skip


_READERS = ("calibrate.descriptor", "calibrate.reduce", "calibrate.table")
_FITTED = 0.7  #: share of saturation up to which the sheet fits its lines
_SCATTER: dict[Release, Any] = {"4": "steady", "3": "temporal"}  #: parameter of the nodes that reduce frames


def _described(step: Step, scatter: Any) -> EmvaFrames:
    files = step.params["file"]
    found = descriptor(file=files, scatter=scatter)
    series = [spatial_series(*each) for each in descriptor_series(files)]
    stacks = (Stack(name, light, time, scatter, frames) for name, light, time, frames in descriptor_frames(files))
    return EmvaFrames(found, _nearest_half(series, found), 2, inspect_frames(stacks, False, _FITTED))


def _reduced(recipe: Recipe, store: Store, steps: Sequence[Step], scatter: Any) -> EmvaFrames:
    """Return levels and series of the steps that reduce frames; the levels of most frames are the series."""
    parts, counts = [], []
    for step in steps:
        frames = _frames(recipe, store, step)
        parts.append(reduce(frames, photons=_of(step)[0], exposure=_of(step)[1], scatter=scatter))
        counts.append(len(frames))
    found: Levels = levels(parts)
    most = max(counts)
    chosen = [step for step, count in zip(steps, counts, strict=True) if count == most]
    pair = _dark_and_half([_of(step) for step in chosen], found)
    series = (spatial_series(*_of(chosen[i]), _frames(recipe, store, chosen[i])) for i in pair)
    stacks = (Stack(step.name, *_of(step), scatter, _frames(recipe, store, step)) for step in steps)
    return EmvaFrames(found, _pair(series), min(counts), inspect_frames(stacks, False, _FITTED))


def _of(step: Step) -> tuple[float, float]:
    return float(step.params["photons"]), float(step.params["exposure"])


def _frames(recipe: Recipe, store: Store, step: Step) -> Any:
    source = str(step.wires["frames"])
    return run(recipe, store, (source,)).values[source]


def _nearest_half(series: Sequence[SpatialSeries], found: Levels) -> Nonuniformity:
    return _pair(series[i] for i in _dark_and_half([(s.photons, s.exposure) for s in series], found))


def _pair(series: Iterator[SpatialSeries]) -> Nonuniformity:
    dark: SpatialSeries | None = None
    lit: SpatialSeries | None = None
    for each in series:
        dark, lit = (dark, each) if each.photons else (each, lit)
    return Nonuniformity(dark, lit)


def _dark_and_half(light: Sequence[tuple[float, float]], found: Levels) -> list[int]:
    """Return the indices of the dark and of the lit series nearest to half of saturation, with one exposure if can be.

    ``light`` has photons and exposure of each series.
    """
    top = float(found.photons[found.variance.argmax()])
    lit = [i for i, (photons, _) in enumerate(light) if photons > 0]
    dark = [i for i, (photons, _) in enumerate(light) if photons == 0]
    both = [i for i in lit if any(light[j][1] == light[i][1] for j in dark)]
    half = min(both or lit, key=lambda i: abs(light[i][0] - _HALF * top), default=None)
    if not dark:
        return [] if half is None else [half]
    times = np.array([light[j][1] for j in dark])
    own = dark[int(np.abs(times - (times.min() if half is None else light[half][1])).argmin())]
    return [own] if half is None else [own, half]
