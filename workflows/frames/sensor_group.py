"""The option of the group ``sensor`` that a calibration gives, with its uncertainties as a joint
distribution.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neusee.nodes.calibrate import SaturationSignal, frame_header, saturation_signal
from neusee.nodes.file_headers import npz_needs
from neusee.nodes.values import Levels
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.keys.sealed_files import head_of, text_of
from neusee.workflows.store.result_store import Store

_NAME = re.compile(r"[a-z][a-z0-9_]*")
FIRST = "# Sensor by `neusee calibrate`"  #: begins each file that this module writes
#: parameter of the posterior: value of a sensor, and its unit
_VALUES = {
    "gain": ("gain", "DN/e-"),
    "quantum_efficiency": ("quantum_efficiency", ""),
    "temporal_dark_noise": ("read_noise", "e-"),
    "read_noise": ("read_noise", "e-"),
    "offset": ("offset", "e-"),
}
_STREAM = 11  #: of random numbers, apart from those of the draws
_BITS = (8, 10, 12, 14, 16)  #: of common converters
_NOTES = {
    "quantum_efficiency": "electrons per photon",
    "read_noise": "temporal dark noise of the shortest dark frames",
    "offset": "dark signal over gain",
    "full_well": "signal of full pixels over gain, without the dark signal",
    "dark_current": "mean of one exposure, as long as `exposure` says",
}


class SensorFrames(NamedTuple):
    """Properties of the sensor that are read from its frames and are not in the posterior."""

    shape: tuple[int, int]  #: (y, x)
    bits: int  #: of a digital number
    full: SaturationSignal | None  #: DN; None if no level reached saturation
    exposure: float  #: s, of the shortest dark frames


def sensor_target(name: str, folder: Path) -> Path:
    """Return the path of the recipe group ``sensor/NAME.yaml`` that a calibration writes.

    Raises: ValueError for a name that is no word, and for a file that no calibration wrote.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(f"--sensor {name}: write a word of a-z, 0-9 and _, such as mine")
    file = folder / "sensor" / f"{name}.yaml"
    if file.exists() and not head_of(file, len(FIRST)).decode("utf-8", "replace").startswith(FIRST):
        raise ValueError(
            f"--sensor {name}: {file} exists and was not written by a calibration: choose another"
            " name"
        )
    return file


def frames_of_sensor(recipe: Recipe, store: Store) -> SensorFrames:
    """Return the properties of the sensor that the frames of a calibration of a folder show.

    A level is saturated if its variance has dropped.
    """
    files: list[Path] = []
    for step in recipe.steps.values():
        files += _files(step)
    header = frame_header(files[0])
    levels: Levels = run(recipe, store, ("measured",)).values["measured"]
    largest_value = float(levels.cell_value.max()) if len(levels.cell_value) else 0.0
    brightest = max(float(levels.mean.max()), largest_value)
    # the fewest bits of a common converter that hold the largest number
    bits = next((bit_count for bit_count in _BITS if brightest < 2**bit_count), header.bits)
    dark_exposures = levels.exposure[levels.photons == 0]
    return SensorFrames(header.shape, bits, saturation_signal(levels), float(dark_exposures.min()))


def _files(step: Step) -> Sequence[Path]:
    """Return the files of frames that a step reads.

    The first file of a descriptor step is the descriptor itself.
    """
    if step.node.path == "calibrate.frames":
        return tuple(step.params["files"])
    return tuple(step.params["file"][1:]) if step.node.path == "calibrate.descriptor" else ()


def sensor_text(results: Path, frames: SensorFrames) -> str:
    """Return the text of the option of the group ``sensor`` from the results of a calibration.

    Values and standard uncertainties are those of the budget, correlations those of the draws.
    Raises: ValueError for a calibration that failed a check, or whose frames do not tell the gain.
    """
    posterior = json.loads(text_of(results / "posterior.json"))
    budget = json.loads(text_of(results / "budget.json"))["quantities"]
    if posterior["failed"]:
        raise ValueError(
            f"{posterior['failed']} checks of the calibration fail, so no sensor group is written"
        )
    if "gain" not in budget:
        raise ValueError("the frames do not determine the gain, so no sensor group is written")
    npz_needs(results / "draws.npz", 1.0, 8.0)
    with np.load(results / "draws.npz") as file:
        draws = {name: np.asarray(file[name], np.float64) for name in file}
    values = _values(budget, draws, frames)
    return _written(values, frames, results.name)


class _Value(NamedTuple):
    mean: float
    unit: str
    draws: NDArray[np.float64]  #: with the mean and the standard uncertainty of the budget


def _values(
    budget: Mapping[str, Any], draws: Mapping[str, NDArray[np.float64]], frames: SensorFrames
) -> dict[str, _Value]:
    """Return each value of a sensor that the budget has, by its name in the group."""
    # draws with the values and uncertainties of the budget, which includes more sources than the
    # draws
    scaled_draws = {name: _moved(draws[name], row) for name, row in budget.items() if name in draws}
    values = {
        group_name: _Value(budget[name]["value"], unit, scaled_draws[name])
        for name, (group_name, unit) in _VALUES.items()
        if name in scaled_draws
    }
    # offset in electrons: dark signal in DN over the gain
    if "dark_signal" in scaled_draws:
        offset_draws = scaled_draws["dark_signal"] / scaled_draws["gain"]
        values["offset"] = _Value(
            budget["dark_signal"]["value"] / budget["gain"]["value"], "e-", offset_draws
        )
    if "dark_current" in scaled_draws:
        # its unit is such as ``e- in 1 s``
        posterior_exposure = float(
            str(budget["dark_current"]["unit"]).removeprefix("e- in ").removesuffix(" s")
        )
        exposure_ratio = frames.exposure / posterior_exposure
        values["dark_current"] = _Value(
            exposure_ratio * budget["dark_current"]["value"],
            "e-",
            exposure_ratio * scaled_draws["dark_current"],
        )
    if frames.full is not None:
        normal_draws = np.random.default_rng(_STREAM).standard_normal(len(scaled_draws["gain"]))
        signal_draws = frames.full.signal + frames.full.uncertainty * normal_draws
        values["full_well"] = _Value(
            frames.full.signal / budget["gain"]["value"], "e-", signal_draws / scaled_draws["gain"]
        )
    return values


def _moved(draws: NDArray[np.float64], row: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return draws that are shifted and scaled to the value and the combined standard
    uncertainty of a budget.
    """
    standardised: NDArray[np.float64] = (draws - draws.mean()) / draws.std(ddof=1)
    scaled_draws: NDArray[np.float64] = (
        row["value"] + row["combined standard uncertainty"] * standardised
    )
    return scaled_draws


def _written(values: Mapping[str, _Value], frames: SensorFrames, source: str) -> str:
    """Return the text of the file.

    It has the properties that the frames show, the values, and their joint distribution.
    """
    return "\n".join([*_head(frames, source), *_sensor(values, frames), *_posterior(values), ""])


def _head(frames: SensorFrames, source: str) -> list[str]:
    """Return the lines of the values that do not follow from the calibration."""
    return [
        f"{FIRST}: {source}.",
        "# Values that the frames do not determine come from the packaged sensor: check"
        " pixel_pitch.",
        "defaults: [small]",
        "sensor:",
        f"  shape: [{frames.shape[0]}, {frames.shape[1]}]",
        f"  exposure: {frames.exposure:.9g} s",
        f"  bits: {frames.bits}",
    ]


def _sensor(values: Mapping[str, _Value], frames: SensorFrames) -> list[str]:
    """Return the lines of the values, and of those that the frames do not give."""
    lines = []
    if frames.full is None:
        lines.append("  # full_well: no frame reached saturation")
    for name, value in values.items():
        note = f"   # {_NOTES[name]}" if name in _NOTES else ""
        lines.append(f"  {name}: {_text(value.mean, value.unit)}{note}")
    missing = [name for name in ("quantum_efficiency", "dark_current") if name not in values]
    return [*lines, *(f"  # {name}: no value from these frames" for name in missing)]


def _posterior(values: Mapping[str, _Value]) -> list[str]:
    """Return the lines of means, standard uncertainties and correlations."""
    correlation = np.atleast_2d(np.corrcoef([value.draws for value in values.values()]))
    mean_texts = ", ".join(
        f"sensor.{name}: {_text(value.mean, value.unit)}" for name, value in values.items()
    )
    sd_texts = ", ".join(
        f"sensor.{name}: {_text(float(sensor_value.draws.std(ddof=1)), sensor_value.unit)}"
        for name, sensor_value in values.items()
    )
    rows = ", ".join(map(_numbers, _symmetric(correlation)))
    return [
        "posterior:   # standard uncertainties, which `neusee study uncertainty` draws together",
        f"  mean: {{{mean_texts}}}",
        f"  sd: {{{sd_texts}}}",
        f"  correlation: [{rows}]",
    ]


def _numbers(row: Iterable[float]) -> str:
    """Return a row of a matrix as a YAML list."""
    return "[" + ", ".join(f"{x:.6f}" for x in row) + "]"


def _symmetric(correlation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a correlation rounded to six digits.

    It is still symmetric, with ones on its diagonal.
    """
    rounded = np.round((correlation + correlation.T) / 2, 6)
    np.fill_diagonal(rounded, 1.0)
    return rounded


def _text(value: float, unit: str) -> str:
    return f"{value:.6g} {unit}".rstrip()
