"""The EMVA 1288 sheet: the frames it reads, spectrograms and defect histograms, and its page of
quantities.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from neusee.nodes.calibrate import (
    DefectHistogram,
    EmvaSheet,
    FrameTest,
    Nonuniformity,
    Profiles,
    Quantity,
    SpatialSeries,
    Spectrogram,
    Stack,
    Traceability,
    coarse,
    defects,
    descriptor,
    descriptor_frames,
    descriptor_release,
    descriptor_series,
    inspect_frames,
    levels,
    profiles,
    reduce,
    refuse_descriptor,
    spatial_series,
    spectrogram,
    without_trend,
)
from neusee.nodes.values import Levels
from neusee.workflows.calibration.frame_validity import frame_section
from neusee.workflows.calibration.uncertainty_budget import of_traceability
from neusee.workflows.engine.runner import run
from neusee.workflows.frames.folder_recipe import quoted
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.recipe.loading import load
from neusee.workflows.report.study_report import CsvTable, Mark, Marked, Section
from neusee.workflows.store.result_store import Store

T = TypeVar("T")

# --- emva frames ----------------------------------------------------------------------------------

# Light levels and series of frames of a recipe, in the form that the EMVA 1288 sheet needs.


Release = Literal["4", "3"]
#: first release of EMVA 1288 whose temporal variance excludes the differences between frame means
_STEADY = 3.1
#: statements on the operating point that the standard requires
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
_HALF = 0.5  #: share of saturation at which the series of lit frames should be taken
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
    tests: Sequence[FrameTest] = ()  #: tests of the frames themselves
    release: Release = "4"  #: release that defines the temporal variance of the levels
    stated: str = ""  #: release that the descriptor states


def descriptor_recipe(file: Path, changes: Sequence[str] = ()) -> Recipe:
    """Return a recipe for the sheet of the measurement that an EMVA 1288 descriptor file describes.

    Raises: ValueError for a descriptor or an image that is missing or cannot be read, `RecipeError`
            with all mistakes of ``changes``.
    """
    refuse_descriptor(file)
    name = "".join(c if c.isalnum() else "_" for c in file.parent.absolute().name or file.stem)
    text = _TEXT.format(name=file.name, file=quoted(str(file.absolute())))
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.yaml"
        path.write_text(text, encoding="utf-8")
        return load(path, changes)


def frames_of_recipe(recipe: Recipe, store: Store, release: Release | None = None) -> EmvaFrames:
    """Return the light levels with their temporal variance, and the dark and lit series, of a
    recipe that reads frames.

    In release 4 the variance of a level excludes the difference of the means of its frames; in 3 it
    includes it. By default the release is that which the descriptor states, and 4 where no
    descriptor states one.
    Raises: ValueError for a recipe that reads neither frames, a descriptor nor a table.
    """
    if descriptor_steps := _steps_of(recipe, "calibrate.descriptor"):
        stated = descriptor_release(descriptor_steps[0].params["file"])
        release = release or ("3" if stated and float(stated) < _STEADY else "4")
        return _described(descriptor_steps[0], _SCATTER[release])._replace(
            release=release, stated=stated
        )
    release = release or "4"
    if reduce_steps := _steps_of(recipe, "calibrate.reduce"):
        return _reduced(recipe, store, reduce_steps, _SCATTER[release])._replace(release=release)
    if table_steps := _steps_of(recipe, "calibrate.table"):
        return _tabled(recipe, store, table_steps[0].name)
    raise ValueError(
        f"{recipe.name} has no step of the nodes {', '.join(_READERS)}, so it has no frames"
        " for a sheet of EMVA 1288: give a descriptor, or a recipe as in `neusee run calibrate`"
    )


def _steps_of(recipe: Recipe, node: str) -> list[Step]:
    return [step for step in recipe.steps.values() if step.node.path == node]


def _tabled(recipe: Recipe, store: Store, name: str) -> EmvaFrames:
    """Return the levels from a table of mean and variance, which has no series of frames."""
    measured = run(recipe, store, (name,)).values[name]
    dark_variances = measured.variance[measured.photons == 0]
    tests = [coarse(float(dark_variances.min()), exact=False)] if len(dark_variances) else []
    # a table has mean and variance of two frames or more, and no averaged frames
    return EmvaFrames(measured, Nonuniformity(None, None), 2, tests)


_READERS = ("calibrate.descriptor", "calibrate.reduce", "calibrate.table")
_FITTED = 0.7  #: share of saturation up to which the sheet fits its lines
#: value of the parameter ``scatter`` of the nodes that reduce frames, by release
_SCATTER: dict[Release, Any] = {"4": "steady", "3": "temporal"}


def _described(step: Step, scatter: Any) -> EmvaFrames:
    """Return levels, series and tests of the frames listed in a descriptor file."""
    files = step.params["file"]
    measured = descriptor(file=files, scatter=scatter)
    averaged_series = [spatial_series(*entry) for entry in descriptor_series(files)]
    stacks = (
        Stack(name, light, time, scatter, frames)
        for name, light, time, frames in descriptor_frames(files)
    )
    return EmvaFrames(
        measured,
        _nearest_half(averaged_series, measured),
        2,
        inspect_frames(stacks, False, _FITTED),
    )


def _reduced(recipe: Recipe, store: Store, steps: Sequence[Step], scatter: Any) -> EmvaFrames:
    """Return levels and series of the steps that reduce frames; the series are the levels with the
    most frames.
    """
    level_parts, frame_counts = [], []
    for step in steps:
        frames = _frames(recipe, store, step)
        level_parts.append(
            reduce(frames, photons=_of(step)[0], exposure=_of(step)[1], scatter=scatter)
        )
        frame_counts.append(len(frames))
    measured: Levels = levels(level_parts)
    # a series for spatial quantities has more frames than the other levels
    largest = max(frame_counts)
    fullest = [step for step, count in zip(steps, frame_counts, strict=True) if count == largest]
    dark_and_half = _dark_and_half([_of(step) for step in fullest], measured)
    averaged_series = (
        spatial_series(*_of(fullest[i]), _frames(recipe, store, fullest[i])) for i in dark_and_half
    )
    stacks = (Stack(step.name, *_of(step), scatter, _frames(recipe, store, step)) for step in steps)
    return EmvaFrames(
        measured, _pair(averaged_series), min(frame_counts), inspect_frames(stacks, False, _FITTED)
    )


def _of(step: Step) -> tuple[float, float]:
    """Return photons per pixel and exposure in s of a step that reduces frames."""
    return float(step.params["photons"]), float(step.params["exposure"])


def _frames(recipe: Recipe, store: Store, step: Step) -> Any:
    """Return the frames that a step of `calibrate.reduce` receives."""
    source = str(step.wires["frames"])
    return run(recipe, store, (source,)).values[source]


def _nearest_half(series: Sequence[SpatialSeries], measured: Levels) -> Nonuniformity:
    """Return the dark series and the lit series nearest to half of saturation."""
    photons_and_exposure = [(averaged.photons, averaged.exposure) for averaged in series]
    return _pair(series[i] for i in _dark_and_half(photons_and_exposure, measured))


def _pair(series: Iterator[SpatialSeries]) -> Nonuniformity:
    """Return the dark and the lit series out of at most two; a series without photons is dark."""
    dark: SpatialSeries | None = None
    lit: SpatialSeries | None = None
    for averaged in series:
        dark, lit = (dark, averaged) if averaged.photons else (averaged, lit)
    return Nonuniformity(dark, lit)


def _dark_and_half(light: Sequence[tuple[float, float]], measured: Levels) -> list[int]:
    """Return the indices of the dark series, and of the lit series nearest to half of saturation,
    with equal exposures if possible.

    ``light`` has photons and exposure of each series.
    """
    dark_numbers = [i for i, (photons, _) in enumerate(light) if photons == 0]
    dark_times = [light[i][1] for i in dark_numbers]
    # EMVA 1288: saturation is where the variance is greatest
    saturating_photons = float(measured.photons[measured.variance.argmax()])
    half_number = _half_of_saturation(light, saturating_photons, dark_times)
    numbers = [] if half_number is None else [half_number]
    if dark_numbers:
        # the dark series whose exposure is nearest to that of the lit series
        exposure = min(dark_times) if half_number is None else light[half_number][1]
        nearest_dark = int(np.abs(np.array(dark_times) - exposure).argmin())
        numbers.insert(0, dark_numbers[nearest_dark])
    return numbers


def _half_of_saturation(
    light: Sequence[tuple[float, float]], top: float, dark_times: Sequence[float]
) -> int | None:
    """Return the index of the lit series nearest to half of ``top`` photons, preferably with the
    exposure of a dark series; None without a lit series.
    """
    lit_numbers = [i for i, (photons, _) in enumerate(light) if photons > 0]
    lit_with_dark = [i for i in lit_numbers if light[i][1] in dark_times]
    return min(
        lit_with_dark or lit_numbers, key=lambda i: abs(light[i][0] - _HALF * top), default=None
    )


# --- emva patterns --------------------------------------------------------------------------------

# Spectrograms, profiles and defect-pixel histograms of an EMVA 1288 sheet, for its pictures and
# tables.


_DIRECTIONS = {"horizontal": False, "vertical": True}
# `without_trend` multiplies by 25 = 5 x 5 pixels instead of dividing, so that integers stay
# integers
_HIGHPASS = 25  #: factor by which `without_trend` multiplies
_SPECTROGRAMS = ("frame", "unit", "direction", "cycles_per_pixel", "amplitude")
_PROFILES = ("frame", "direction", "pixel", *Profiles._fields)
_DEFECTS = ("frame", "unit", "deviation", "pixels", "normal")
_BEYOND = ("frame", "unit", "distance", "percent_beyond")


def spectrograms(sheet: EmvaSheet) -> dict[tuple[str, str], dict[str, Spectrogram]]:
    """Return the spectrograms by name and unit (DSNU in DN, PRNU in percent), and then by
    direction.
    """
    dark, lit = sheet.spatial
    images: dict[tuple[str, str], Any] = {}
    if dark is not None:
        images["DSNU", "DN"] = dark.average
    if dark is not None and lit is not None and (signal := signal_of(dark, lit)) > 0:
        images["PRNU", "%"] = (lit.average - dark.average) * (100 / signal)
    return {key: _by_direction(spectrogram, image) for key, image in images.items()}


def line_profiles(sheet: EmvaSheet) -> dict[str, dict[str, Profiles]]:
    """Return the profiles in DN by the name of the averaged frame and by direction."""
    dark, lit = sheet.spatial
    images = {} if dark is None else {"dark": dark.average}
    if lit is not None and dark is not None:
        images["lit, less the dark"] = lit.average - dark.average
    elif lit is not None:
        images["lit"] = lit.average
    return {key: _by_direction(profiles, image) for key, image in images.items()}


def _by_direction(measure: Callable[[Any, bool], T], image: Any) -> dict[str, T]:
    """Return the result of ``measure`` along the rows and along the columns of an image."""
    return {name: measure(image, is_vertical) for name, is_vertical in _DIRECTIONS.items()}


def defect_histograms(sheet: EmvaSheet) -> dict[tuple[str, str], DefectHistogram]:
    """Return the histograms of defect pixels by name and unit: DSNU in DN, PRNU in percent of the
    signal.
    """
    dark, lit = sheet.spatial
    histograms = {}
    if dark is not None:
        histograms["DSNU", "DN"] = defects(dark.total, 1 / dark.count)
    if dark is not None and lit is not None and (signal := signal_of(dark, lit)) > 0:
        # integers stay integers: both means are multiplied by the least common multiple of the
        # frame counts
        common_divisor = math.gcd(dark.count, lit.count)
        trendless = without_trend(
            (lit.total * dark.count - dark.total * lit.count) // common_divisor
        )
        # the second argument scales these integers to percent of the signal
        histograms["PRNU", "%"] = defects(
            trendless, 100 * common_divisor / (_HIGHPASS * dark.count * lit.count * signal)
        )
    return histograms


def noise_in_time(sheet: EmvaSheet, name: str) -> tuple[float, float]:
    """Return the temporal standard deviations of one frame and of the average of all frames, in the
    unit of the spectrogram.
    """
    dark, lit = sheet.spatial
    assert dark is not None
    if name == "DSNU" or lit is None:
        return math.sqrt(dark.temporal), math.sqrt(dark.temporal / dark.count)
    percent_per_dn = 100 / signal_of(dark, lit)
    # average of the lit frames minus average of the darks: the variances of both means add
    return percent_per_dn * math.sqrt(lit.temporal), percent_per_dn * math.sqrt(
        lit.temporal / lit.count + dark.temporal / dark.count
    )


def signal_of(dark: SpatialSeries, lit: SpatialSeries) -> float:
    """Return the mean signal in DN of the lit series above the dark series."""
    return float(lit.average.mean() - dark.average.mean())


def pattern_tables(sheet: EmvaSheet) -> Mapping[str, CsvTable]:
    """Return the curves as CSV tables by file name; empty without a series of frames."""
    if not (histograms := defect_histograms(sheet)):
        return {}
    return {
        "spectrograms.csv": (_SPECTROGRAMS, _spectrogram_rows(sheet)),
        "profiles.csv": (_PROFILES, _profile_rows(sheet)),
        "defects.csv": (_DEFECTS, _histogram_rows(histograms, slice(3))),
        "defects_accumulated.csv": (_BEYOND, _histogram_rows(histograms, slice(3, None))),
    }


def _histogram_rows(
    histograms: Mapping[tuple[str, str], DefectHistogram], fields: slice
) -> Iterator[tuple[Any, ...]]:
    """Yield a row for each class of each histogram: name, unit, and the selected ``fields``."""
    for key, histogram in histograms.items():
        yield from ((*key, *row) for row in zip(*map(_plain, histogram[fields]), strict=True))


def _spectrogram_rows(sheet: EmvaSheet) -> Iterator[tuple[Any, ...]]:
    """Yield a row of the table for each frequency of each spectrogram."""
    for key, directions in spectrograms(sheet).items():
        for direction, transform in directions.items():
            yield from (
                (*key, direction, *row) for row in zip(*map(_plain, transform), strict=True)
            )


def _profile_rows(sheet: EmvaSheet) -> Iterator[tuple[Any, ...]]:
    """Yield a row of the table for each pixel of each profile."""
    for key, directions in line_profiles(sheet).items():
        for direction, profile in directions.items():
            yield from (
                (key, direction, position, *row)
                for position, row in enumerate(zip(*map(_plain, profile), strict=True))
            )


def _plain(values: Any) -> list[Any]:
    listed: list[Any] = values.tolist()
    return listed


# --- emva page ------------------------------------------------------------------------------------

# The page of the EMVA 1288 sheet: quantities, pictures, and which demands of the standard are met.


_LEVELS, _EXPOSURES, _SERIES = (
    50,
    6,
    16,
)  #: number of lit levels, dark exposures and frames per series that the standard requires
#: name of the frame test that has the same meaning as `_COARSE`
_ROUNDING = "the dark noise exceeds rounding"
_COARSE = """the temporal dark noise is below 0.49 DN; the standard requires more, because \
rounding hides the noise: \
dark noise, thresholds and dynamic range are only limits, and K is doubtful"""
_TESTED = """Each test asks if the frames agree with the model of the standard. Modelled:
the quantities allow for it. Widened: the fault is found, and the error of K or of the noise that
may follow is small. Refused: this error may exceed 2 %, or is unknown. Numbers and limits of noise
and patterns are in standard deviations of chance."""
_MOMENTS = "Only moments are given, so noise, patterns and numbers of the frames are not tested."
_VARIANCE: dict[Release, str] = {
    "3": "includes the difference of the means of its frames, as in release 3.0",
    "4": "excludes the difference of the means of its frames, as since release 3.1",
}
_HALF_OF_PAGE = (0.45, 0.55)  #: shares of saturation that count as 50 %
_TABLES = {
    "Quantities": ("eta", "DR_bit"),
    "General model": ("mu_p_min_general", "DR_general"),
    "Linearity": ("LE_min", "LE_max"),
    "Dark current": ("mu_I_mean", "mu_I_var"),
    "Spatial nonuniformity": ("DSNU1288_DN", "PRNU1288_pixel"),
}
#: heading, picture and text of each section, in the order of the standard
_SECTIONS = (
    (
        "Quantities",
        "",
        """Sensitivity, noise, saturation, signal-to-noise ratio and dynamic range, with the symbols
        of the standard.""",
    ),
    (
        "Photon transfer",
        "photon_transfer",
        """The variance in time over the signal, both above the dark. The slope up to 70 % of
        saturation is the system gain K; saturation is where the variance is greatest.""",
    ),
    (
        "Response",
        "sensitivity",
        """The signal over the photons. The slope up to 70 % of saturation is the responsivity R,
        and R over K the quantum efficiency η.""",
    ),
    (
        "Signal-to-noise ratio",
        "snr",
        """Measured in time at each level, and of the linear model with the quantities above. The
        total SNR has the spatial nonuniformity in its noise too. At μ_p.min the model is 1.""",
    ),
    (
        "General model",
        "general_model",
        """As release 4.0 General, which needs no linear camera and no K: the slope of the response
        at each level refers the noise in time to the light. For a linear camera it agrees with the
        linear model.""",
    ),
    (
        "Linearity",
        "linearity",
        """The line has the least squares of relative deviations from 5 to 95 % of saturation; its
        greatest deviations are the linearity errors.""",
    ),
    (
        "Dark current",
        "dark_current",
        """Mean and variance of dark frames over the exposure, with lines of least squares.""",
    ),
    (
        "Spatial nonuniformity",
        "",
        """DSNU1288 and PRNU1288 of averaged frames, without what noise in time leaves in the
        average: in total, and of rows, columns and single pixels, which add up to the total in
        squares.""",
    ),
    (
        "Spectrograms",
        "spectrograms",
        """Root of the mean power of all rows and of all columns, of the averaged frames. White
        noise is a level line at its standard deviation; a peak is a periodic pattern.""",
    ),
    (
        "Profiles",
        "profiles",
        "Middle line, mean, least and greatest number of the averaged frames, "
        "along rows and along columns.",
    ),
    (
        "Defect pixels",
        "defect_pixels",
        """Logarithmic and accumulated histograms of the averaged frames. Of the lit frame the mean
        of 5 x 5 pixels is subtracted first, against uneven light. Pixels beyond the normal
        distribution are candidates for defects.""",
    ),
)


class Requirement(NamedTuple):
    """A demand of the standard, what was found, and whether it is met."""

    demand: str
    found: str
    mark: Mark


def banner(sheet: EmvaSheet, tests: Sequence[FrameTest] = ()) -> str:
    """Return the reasons why the linear model of the standard does not hold for these frames; empty
    if it holds.
    """
    is_coarse = sheet["sigma_y_dark"].bound != ""
    reasons: list[str] = []
    if is_coarse:
        reasons.append(_COARSE)
    elif sheet["K"].value is None:
        reasons.append(f"K is not told: {sheet['K'].reason}")
    refusals = (
        test
        for test in tests
        if test.verdict == "refused" and not (is_coarse and test.name == _ROUNDING)
    )
    reasons += [f"{test.name}: {test.sentence}" for test in refusals]
    return f"Not fit for use: {'; '.join(reasons)}." if reasons else ""


def temporal_variance(frames: EmvaFrames, by_user: bool) -> str:
    """Return a sentence on which temporal variance the sheet uses and why; ``by_user`` is True if
    the user chose the release.
    """
    text = f"The variance of a level {_VARIANCE[frames.release]}"
    if not frames.stated:
        return f"{text}."
    if by_user:
        return (
            f"{text}: `--release {frames.release}`. The descriptor states release {frames.stated}."
        )
    alternative = {"3": "`--release 4` excludes it", "4": "`--release 3` includes it"}
    return (
        f"{text}, because the descriptor states release {frames.stated};"
        f" {alternative[frames.release]}."
    )


def lead(sheet: EmvaSheet, variance: str) -> str:
    """Return the summary of the page; ``variance`` is the sentence of `temporal_variance`."""
    keys = (
        "eta",
        "K",
        "sigma_d",
        "mu_p_min",
        "mu_e_sat",
        "SNR_max_dB",
        "DR_dB",
        "DSNU1288",
        "PRNU1288",
    )
    quantities = "; ".join(
        f"{sheet[key].symbol} {sheet[key].text}" for key in keys if sheet[key].value is not None
    )
    return f"The quantities of EMVA 1288, release 4.0 Linear: {quantities}. {variance}"


def sections(
    sheet: EmvaSheet,
    frames: EmvaFrames,
    statements: Mapping[str, Any],
    pictures: Mapping[str, bytes],
    budget: Sequence[Section] = (),
) -> list[Section]:
    """Return the sections of the page in the order of the standard; sections without rows or
    picture are left out.

    The sections ``budget`` have the uncertainty of the quantities.
    """
    candidates = (
        _section(sheet, heading, text, pictures.get(name)) for heading, name, text in _SECTIONS
    )
    filled = (s for s in candidates if s.rows or s.picture)
    text_of_tests = _TESTED if len(frames.tests) > 1 else _MOMENTS
    tested = replace(frame_section(frames.tests), text=text_of_tests)
    return [*filled, *budget, tested, _compliance(sheet, frames, statements)]


def requirements(
    sheet: EmvaSheet, frames: EmvaFrames, statements: Mapping[str, Any]
) -> list[Requirement]:
    """Return each demand of the standard on the frames and on the statements about them."""
    return [*_of_transfer(sheet, frames), *_of_series(sheet), *_of_told(statements), *_elsewhere()]


def operating_point(
    statements: Sequence[str], traced: Traceability | None = None
) -> dict[str, str | None]:
    """Return the statements on the operating point by key, from texts such as ``temperature=25
    °C``; None where nothing is stated.

    What the recipe states in the block ``traceability`` counts where no statement says otherwise.
    Raises: ValueError for a statement that is not a key of `OPERATING_POINT`, ``=`` and a text.
    """
    point: dict[str, str | None] = {
        **dict.fromkeys(OPERATING_POINT),
        **(of_traceability(traced) if traced else {}),
    }
    for statement in statements:
        key, sign, value = (text.strip() for text in statement.partition("="))
        if key not in point or not sign or not value:
            raise ValueError(
                f"--state {statement!r}: write one of {', '.join(point)}, then = and a text"
            )
        point[key] = value
    return point


def group_of(quantity: Quantity, sheet: EmvaSheet) -> str:
    """Return the heading of the table in which the sheet lists a quantity."""
    keys = [row.key for row in sheet.quantities]
    position = keys.index(quantity.key)
    return next(
        name
        for name, (first_key, last_key) in _TABLES.items()
        if keys.index(first_key) <= position <= keys.index(last_key)
    )


def _section(sheet: EmvaSheet, heading: str, text: str, picture: bytes | None) -> Section:
    """Return one section of the page, with its table of quantities if its heading has one.

    The column of reasons is left out where no quantity has a reason.
    """
    rows: list[Sequence[Any]] = []
    columns: Sequence[str] = ("symbol", "quantity", "value", "why not, or why a limit")
    candidates = sheet.quantities if heading in _TABLES else ()
    quantities = [quantity for quantity in candidates if group_of(quantity, sheet) == heading]
    for quantity in quantities:
        value = Marked(quantity.text, "warn" if quantity.reason else None)
        rows.append((quantity.symbol, quantity.name, value, quantity.reason))
    if not any(quantity.reason for quantity in quantities):
        columns, rows = columns[:-1], [row[:-1] for row in rows]
    if not rows:
        columns = ()
    return Section(heading, text, columns, rows, picture)


def _compliance(sheet: EmvaSheet, frames: EmvaFrames, statements: Mapping[str, Any]) -> Section:
    """Return the section that lists the demands of the standard, and which of them are met."""
    demands = requirements(sheet, frames, statements)
    rows = [
        (row.demand, row.found, Marked("yes" if row.mark == "pass" else "no", row.mark))
        for row in demands
    ]
    open_demands = sum(row.mark != "pass" for row in demands)
    text = f"""The quantities are computed as EMVA 1288, release 4.0 Linear, says. This is a
        computation from frames and no certificate: geometry, homogeneity and calibration of the
        light are the laboratory's part, and frames do not show them.

        {open_demands} of {len(rows)} demands of the standard are not met, or not shown here. Only
        those who measured can state that the measurement complies."""
    return Section(
        "Compliance: what was measured and told",
        text,
        ("demand", "found", "met"),
        rows,
    )


def _of_transfer(sheet: EmvaSheet, frames: EmvaFrames) -> Iterator[Requirement]:
    """Yield the demands on the levels and their darks: number, exposures, saturation and dark
    noise.

    They are of number, exposures, saturation and dark noise.
    """
    transfer, noise = sheet.transfer, sheet["sigma_y_dark"]
    level_count, dark_exposures = len(transfer.photons), len(np.unique(transfer.dark_exposure))
    has_own_darks = set(transfer.exposure.tolist()) <= set(transfer.dark_exposure.tolist())
    saturation_text = "reached" if transfer.saturated else "not reached"
    yield _asked(f"{_LEVELS} or more lit levels", f"{level_count}", level_count >= _LEVELS)
    yield _asked("two frames or more at each level", f"{frames.frames}", frames.frames >= 2)
    text = "yes" if has_own_darks else "of the nearest exposure"
    yield _asked("dark frames at the exposure of each lit level", text, has_own_darks)
    yield _asked(
        "levels from dark to saturation", f"saturation {saturation_text}", transfer.saturated
    )
    mark: Mark = "fail" if noise.bound else "pass"
    yield Requirement("temporal dark noise of 0.49 DN or more", noise.text, mark)
    text = f"{dark_exposures} exposure{'s' * (dark_exposures != 1)}"
    yield _asked(
        f"dark current from {_EXPOSURES} or more exposures", text, dark_exposures >= _EXPOSURES
    )


def _of_series(sheet: EmvaSheet) -> Iterator[Requirement]:
    """Yield the demands on the dark and the lit series, from which the spatial quantities are
    computed.
    """
    dark, lit = sheet.spatial
    for name, series in (("dark", dark), ("lit", lit)):
        demand = f"series of {_SERIES} or more {name} frames for spatial quantities"
        count = 0 if series is None else series.count
        text = f"{count} frames" if count else "no series"
        yield _asked(demand, text, count >= _SERIES)
    if dark is not None and lit is not None:
        yield _asked(
            "both series at one exposure", _exposures(dark, lit), dark.exposure == lit.exposure
        )
        saturation_signal = float(sheet.transfer.signal[sheet.transfer.saturation])
        saturation_share = float(lit.average.mean() - dark.average.mean()) / saturation_signal
        yield _asked(
            "lit series at 50 % of saturation",
            f"{saturation_share:.1%}",
            _HALF_OF_PAGE[0] <= saturation_share <= _HALF_OF_PAGE[1],
        )


def _of_told(statements: Mapping[str, Any]) -> Iterator[Requirement]:
    """Yield one demand for each statement on the operating point; ``statements`` maps keys to
    values.
    """
    for key, name in OPERATING_POINT.items():
        value = statements.get(key)
        text = "not stated" if value is None else str(value)
        yield _asked(f"stated: {name}", text, value is not None)


def _elsewhere() -> Iterator[Requirement]:
    """Yield the quantities of the standard that frames of one light and one temperature cannot
    show.
    """
    yield Requirement("spectral sensitivity η(λ)", "not measured: one light", "warn")
    yield Requirement("dark current over temperature", "not measured: one temperature", "warn")
    yield Requirement(
        "homogeneity of the light better than 3 %, from a disk at f/8",
        "not shown by frames",
        "warn",
    )


def _asked(demand: str, text: str, met: bool) -> Requirement:
    """Return a demand with its mark: pass if it is met, else a warning."""
    mark: Mark = "pass" if met else "warn"
    return Requirement(demand, text, mark)


def _exposures(dark: SpatialSeries, lit: SpatialSeries) -> str:
    return f"{dark.exposure:.4g} s and {lit.exposure:.4g} s"
