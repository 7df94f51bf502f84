"""The recipe of a calibration of a folder of frames, and the EMVA 1288 descriptor file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from neusee.nodes.calibrate import (
    LeastSquares,
    frame_divisor,
    hot_pixels,
    least_squares,
    refuse_descriptor,
)
from neusee.workflows.engine.runner import run
from neusee.workflows.frames.frame_folder import (
    FolderLevel,
    FolderLevels,
    FolderRefused,
    find_levels,
)
from neusee.workflows.graph.final_values import Config
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.sealed_files import text_of
from neusee.workflows.recipe.loading import load
from neusee.workflows.report.study_report import Progress, silent
from neusee.workflows.store.result_store import Store

# --- descriptor file ------------------------------------------------------------------------------

# The descriptor file of a measurement in the data format of EMVA 1288.


#: a line of a descriptor that begins a light level
_LEVEL = re.compile(r"^[bd]\s+[\d.,]+(\s|$)", re.MULTILINE)


def descriptors_in(folder: Path) -> list[Path]:
    """Return the descriptor files of a folder."""
    return [file for file in sorted(folder.glob("*.txt")) if _LEVEL.search(_text(file))]


def _text(file: Path) -> str:
    """Return the text of a file, or an empty text if it is not a text file, such as a pipe."""
    try:
        return text_of(file, "utf-8-sig", "replace")
    except ValueError:
        return ""


def descriptor_of(path: Path) -> Path:
    """Return the descriptor file at a path, or the only one in the folder at this path.

    Raises: ValueError for a folder without a descriptor, or with several.
    """
    if not path.is_dir():
        return path
    descriptors = descriptors_in(path)
    if len(descriptors) == 1:
        return descriptors[0]
    finding = (
        f"has {len(descriptors)} descriptors"
        if descriptors
        else "has no descriptor, which is a .txt file with levels in lines b and d"
    )
    raise ValueError(f"{path} {finding}: name one descriptor file")


def quoted(text: str) -> str:
    """Return a text as a scalar of YAML in single quotes."""
    return "'" + text.replace("'", "''") + "'"


# --- folder recipe --------------------------------------------------------------------------------

# The recipe of a calibration of the frames in a folder, which is written into the results.


_BITS = (8, 10, 12, 14)  #: of converters whose numbers are shifted to the left in files of 16 bits
_EFFICIENCY = 0.5  #: electrons per photon, which relative light is scaled to
_DESCRIBED = """# The sensor of the frames in {folder}, as the descriptor {name} describes them.
steps:
  measured: {{node: calibrate.descriptor, with: {{file: {file}, scatter: steady}}}}
"""
_READ = """# The sensor of the frames in {folder}, found by {source}.
levels:
{levels}
steps:
  frames: {{node: calibrate.frames, each: levels, with: {{files: "${{item.files}}"{divisor}}}}}
{hot}  level:
    node: calibrate.reduce
    each: levels
    from: {source_of_level}
    with: {{photons: "${{item.photons}}", exposure: "${{item.exposure}}", scatter: steady}}
  measured: {{node: calibrate.levels, from: level}}
"""
_REST = """  least_squares: {{node: calibrate.least_squares, from: measured}}
  # free parameters, with a median and a factor each; signal and bends with mean and deviation
  prior:
    node: calibrate.camera_prior
    with:
      gain: ["${{camera.gain}}", 10]
      quantum_efficiency: ["${{camera.quantum_efficiency}}", 3]
      dark_signal: ["${{camera.dark_signal}}", 1000]
      temporal_dark_noise: ["${{camera.temporal_dark_noise}}", 5]
      dark_current: {current}
      scatter: ["${{camera.scatter}}", 3]
      lamp: ["${{camera.lamp}}", 10]
      drift: ["${{camera.drift}}", 5]
      bend: [0, 0.05]      # y = K e (1 + bend x + twist x2), x = 1 at the brightest level used
      twist: [0, 0.05]
  camera:
    node: calibrate.camera
    from: {{levels: measured}}
    with:
      gain: "${{camera.gain}}"
      quantum_efficiency: "${{camera.quantum_efficiency}}"
      dark_signal: "${{camera.dark_signal}}"
      temporal_dark_noise: "${{camera.temporal_dark_noise}}"
      dark_current: "${{camera.dark_current}}"
      dark_exposure: 1 s
      scatter: "${{camera.scatter}}"
      lamp: "${{camera.lamp}}"
      drift: "${{camera.drift}}"
camera:                    # first estimates by least squares; the frames decide
  gain: {gain:.4g} DN/e-
  quantum_efficiency: {efficiency:.4g}
  dark_signal: {signal:.6g}
  temporal_dark_noise: {noise:.4g} e-
  dark_current: {dark:.4g} e-     # per second
  scatter: 0.003
  lamp: 0.01
  drift: {drift:.3g}
{traced}outputs: [measured, least_squares, camera]
"""
_HOT = """  # in the longest dark exposure
  hot: {{node: calibrate.hot_pixels, with: {{files: [{files}]{divisor}}}}}
"""
_RELATIVE = """traceability:
  photons: {known: relative}   # no radiometry: no quantum efficiency is told
"""


@dataclass(frozen=True)
class _Corrections:
    """Corrections of the frames of a folder before they are reduced to moments."""

    divisor: int  #: 1 for numbers that are not shifted
    hot: tuple[Path, ...]  #: dark frames that show hot pixels; none without hot pixels


def recipe_of_folder(
    folder: Path,
    store: Store,
    changes: Sequence[str] = (),
    progress: Progress = silent,
    every_pixel: bool = False,
) -> Recipe:
    """Return the recipe of a calibration of the frames in a folder; the frames are read, and
    reduced to moments.

    ``progress`` receives lines on the exposures before any frame is reduced, on the divisor of the
    numbers, and on pixels that are left out. With ``every_pixel`` hot pixels count too, as EMVA
    1288 demands of a sheet.

    Raises: `FolderRefused` with all reasons why the frames are no measurement, `RecipeError`
    with all mistakes of ``changes``.
    """
    name = (
        "".join(character if character.isalnum() else "_" for character in folder.absolute().name)
        or "frames"
    )
    if descriptors_in(folder):
        return _described(descriptor_of(folder), name, store, changes)
    levels, scale = find_levels(folder, progress), 1.0
    corrections = _corrections(levels, progress, every_pixel)
    # a first recipe without model, whose levels give the first estimates
    fit = _fit(
        _loaded(name, _read(folder, levels, scale, corrections) + "outputs: [measured]\n"), store
    )
    if levels.light != "photons":
        # relative light is scaled so that a usual efficiency comes out
        scale = float(fit.efficiency) / _EFFICIENCY
    dark_exposures = len({level.exposure for level in levels.levels if level.dark})
    model_text = _estimate_steps(
        fit, float(fit.efficiency) / scale, dark_exposures, levels.light != "photons"
    )
    return _loaded(name, _read(folder, levels, scale, corrections) + model_text, changes)


def _corrections(levels: FolderLevels, progress: Progress, every_pixel: bool) -> _Corrections:
    """Return the divisor of the numbers and the dark frames that show hot pixels, and
    report both.
    """
    divisor = _shift(levels)
    if divisor > 1:
        progress(
            f"all numbers are multiples of {divisor}: they are shifted to the left in the files,"
            f" and divided by {divisor} here"
        )
    if every_pixel:
        return _Corrections(divisor, ())
    longest_dark = max(
        (level for level in levels.levels if level.dark), key=lambda level: level.exposure
    )
    mask = hot_pixels(files=longest_dark.files, divisor=divisor)
    count = int(mask.sum())
    if not count:
        return _Corrections(divisor, ())
    share = f"{count} of {mask.numel()} pixels ({count / mask.numel():.2%})"
    progress(
        f"{share} are hot in the dark frames of {longest_dark.exposure:g} s: they are left"
        " out of all levels"
    )
    return _Corrections(divisor, longest_dark.files)


def _shift(levels: FolderLevels) -> int:
    """Return the divisor of numbers of a converter of 8 to 14 bits that are shifted to the left
    in 16 bits, else 1.
    """
    divisor = 0
    for level in levels.levels:
        divisor = int(np.gcd(divisor, frame_divisor(level.files[0])))
        if divisor == 1:
            return 1
    # the numbers of a converter of b bits are shifted by 16 - b bits
    return divisor if divisor in [2 ** (16 - bits) for bits in _BITS] else 1


def _described(file: Path, name: str, store: Store, changes: Sequence[str]) -> Recipe:
    """Return the recipe of a calibration of the frames that a descriptor of EMVA 1288 names."""
    refuse_descriptor(file)
    measured_text = _DESCRIBED.format(
        folder=name, name=file.name, file=quoted(str(file.absolute()))
    )
    recipe = _loaded(name, measured_text + "outputs: [measured]\n")
    levels = run(recipe, store, ("measured",)).values["measured"]
    fit = _fit(recipe, store)
    dark_exposures = len(set(levels.exposure[levels.photons == 0].tolist()))
    return _loaded(
        name,
        measured_text + _estimate_steps(fit, float(fit.efficiency), dark_exposures, False),
        changes,
    )


def _fit(recipe: Recipe, store: Store) -> LeastSquares:
    """Return the standard's least-squares fit of the levels of a recipe.

    Raise `FolderRefused` where it is impossible.
    """
    try:
        fit: LeastSquares = least_squares(run(recipe, store, ("measured",)).values["measured"])
    except ValueError as error:
        raise FolderRefused(str(error)) from None
    return fit


def _loaded(name: str, text: str, changes: Sequence[str] = ()) -> Recipe:
    """Return the recipe in a text, with changes by the user.

    It is read from a temporary file, whose folder the sources of its values do not name.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.yaml"
        path.write_text(text, encoding="utf-8")
        recipe = load(path, changes)
    settings = recipe.config.settings.items()
    temporary_name = f"{path.parent.name}/"  # the sources of values name no folder that is gone
    renamed_settings = {
        key: replace(setting, source=setting.source.rpartition(temporary_name)[-1])
        for key, setting in settings
    }
    return replace(recipe, config=Config(renamed_settings))


def _read(folder: Path, folder_levels: FolderLevels, scale: float, needs: _Corrections) -> str:
    """Return the text of a recipe up to its levels, from frames, their light and their corrections.

    `scale` is the factor from the light of the folder to photons.
    """
    levels = "\n".join(_level(level, scale) for level in folder_levels.levels)
    divisor = f", divisor: {needs.divisor}" if needs.divisor > 1 else ""
    hot, source_of_level = "", "frames"
    if needs.hot:
        hot = _HOT.format(files=_listed(needs.hot), divisor=divisor)
        source_of_level = "{frames: frames, mask: hot}"
    return _READ.format(
        folder=" ".join(folder.name.split()) or ".",
        source=folder_levels.source,
        levels=levels,
        divisor=divisor,
        hot=hot,
        source_of_level=source_of_level,
    )


def _listed(files: Sequence[Path]) -> str:
    """Return the paths of files as the items of a YAML list."""
    return ", ".join(quoted(str(file.absolute())) for file in files)


def _level(level: FolderLevel, scale: float) -> str:
    """Return the line of a level: its photons, its exposure and its files."""
    files = _listed(level.files)
    return (
        f"  {level.name}: {{photons: {level.light * scale:.8g}, exposure: {level.exposure:.9g} s,"
        f" files: [{files}]}}"
    )


def _estimate_steps(fit: LeastSquares, efficiency: float, times: int, relative: bool) -> str:
    """Return the steps after the levels, with first estimates; ``times`` is the number of different
    exposures of the dark frames.
    """
    gain, noise = float(fit.gain), max(float(fit.temporal_dark_noise), 0.1)
    dark = float(fit.dark_current)
    if not dark > 0:  # NaN where all darks have one exposure
        # 1 e-/s to begin with, or 0 where all darks have one exposure
        dark = float(times > 1)
    current = "null   # all darks have one exposure"
    if times > 1:
        current = '["${camera.dark_current}", 10]'
    traced = _RELATIVE if relative else ""
    return _REST.format(
        gain=gain,
        # first estimates must be inside the priors
        efficiency=min(max(efficiency, 0.02), 0.98),
        signal=float(fit.dark_signal),
        noise=noise,
        dark=dark,
        current=current,
        drift=max(0.01 * noise * gain, 0.003),
        traced=traced,
    )
