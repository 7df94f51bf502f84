"""The page of the EMVA 1288 sheet: quantities, pictures, and what of the standard was measured and told."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from neusee.nodes.calibrate import EmvaSheet, FrameTest, Quantity, SpatialSeries, Traceability
from neusee.workflows.calibration.budget_page import of_traceability
from neusee.workflows.calibration.emva_frames import OPERATING_POINT, EmvaFrames, Release
from neusee.workflows.calibration.frame_validity import frame_section
from neusee.workflows.report.study_page import Mark, Section

_LEVELS, _EXPOSURES, _SERIES = (
    50,
    6,
    16,
)  #: lit levels, exposures of darks, frames of a series that the standard asks for
_ROUNDING = "the dark noise exceeds rounding"  #: name of the test of frames that says the same as `_COARSE`
_COARSE = """the temporal dark noise is below 0.49 DN; the standard asks for more, because rounding hides the noise: \
dark noise, thresholds and dynamic range are limits only, and K is doubtful"""
_TESTED = """Each test asks if the frames are such as the model of the standard describes. Modelled: the quantities
allow for it. Widened: it is found, and the error of K or of the noise that may follow is small. Refused: this error may
exceed 2 %, or is unknown. Numbers and limits of noise and patterns are in standard deviations of chance."""
_MOMENTS = "Only moments are given, so that noise, patterns and numbers of the frames are not tested."
_VARIANCE: dict[Release, str] = {
    "3": "includes the difference of the means of its frames, as in release 3.0",
    "4": "excludes the difference of the means of its frames, as since release 3.1",
}
_HALF = (0.45, 0.55)  #: shares of saturation that count as 50 %
_TABLES = {
    "Quantities": ("eta", "DR_bit"),
    "General model": ("mu_p_min_general", "DR_general"),
    "Linearity": ("LE_min", "LE_max"),
    "Dark current": ("mu_I_mean", "mu_I_var"),
    "Spatial nonuniformity": ("DSNU1288_DN", "PRNU1288_pixel"),
}
#: heading, picture and text of each section, in the order of the standard
_SECTIONS = (
    ("Quantities", "",
        """Sensitivity, noise, saturation, signal-to-noise ratio and dynamic range, with the symbols of the
        standard."""),
    ("Photon transfer", "photon_transfer",
        """The variance in time over the signal, both above the dark. The slope up to 70 % of saturation is the
        system gain K; saturation is where the variance is greatest."""),
    ("Response", "sensitivity",
        """The signal over the photons. The slope up to 70 % of saturation is the responsivity R, and R over K the
        quantum efficiency η."""),
    ("Signal-to-noise ratio", "snr",
        """Measured in time at each level, and of the linear model with the quantities above. The total SNR has the
        spatial nonuniformity in its noise too. At μ_p.min the model is 1."""),
    ("General model", "general_model",
        """As release 4.0 General, which needs no linear camera and no K: the slope of the response at each level refers
        the noise in time to the light. For a linear camera it agrees with the linear model."""),
    ("Linearity", "linearity",
        """The line has the least squares of relative deviations from 5 to 95 % of saturation; its greatest
        deviations are the linearity errors."""),
    ("Dark current", "dark_current",
        """Mean and variance of dark frames over the exposure, with lines of least squares."""),
    ("Spatial nonuniformity", "",
        """DSNU1288 and PRNU1288 of averaged frames, without what noise in time leaves in the average: in total,
        and of rows, columns and single pixels, which add up to the total in squares."""),
    ("Spectrograms", "spectrograms",
        """Root of the mean power of all rows and of all columns, of the averaged frames. White noise is a level
        line at its standard deviation; a peak is a periodic pattern."""),
    ("Profiles", "profiles",
        """Middle line, mean, least and greatest number of the averaged frames, along rows and along columns."""),
    ("Defect pixels", "defect_pixels",
        """Logarithmic and accumulated histograms of the averaged frames. Of the lit frame the mean of 5 x 5 pixels
        is subtracted first, against uneven light. Pixels beyond the normal distribution are candidates for
        defects."""),
)  # fmt: skip


class Requirement(NamedTuple):
    """A demand of the standard, what was found, and if it is met."""

    demand: str
    found: str
    mark: Mark


def banner(sheet: EmvaSheet, tests: Sequence[FrameTest] = ()) -> str:
    """Return why the linear model of the standard does not hold for these frames, or an empty text."""
    coarse = sheet["sigma_y_dark"].bound != ""
    reasons = [_COARSE] if coarse else [f"K is not told: {sheet['K'].reason}"] if sheet["K"].value is None else []
    wrong = (test for test in tests if test.verdict == "refused" and not (coarse and test.name == _ROUNDING))
    reasons += [f"{test.name}: {test.sentence}" for test in wrong]
    return f"Not fit for use: {'; '.join(reasons)}." if reasons else ""


def temporal_variance(frames: EmvaFrames, chosen: bool) -> str:
    """Return which variance in time the sheet has, and why; ``chosen`` is True if the user chose the release."""
    text = f"The variance of a level {_VARIANCE[frames.release]}"
    if not frames.stated:
        return f"{text}."
    if chosen:
        return f"{text}: `--release {frames.release}`. The descriptor states release {frames.stated}."
    other = {"3": "`--release 4` excludes it", "4": "`--release 3` includes it"}
    return f"{text}, because the descriptor states release {frames.stated}; {other[frames.release]}."


def lead(sheet: EmvaSheet, variance: str) -> str:
    """Return the summary of the page; ``variance`` is the sentence of `temporal_variance`."""
    named = ("eta", "K", "sigma_d", "mu_p_min", "mu_e_sat", "SNR_max_dB", "DR_dB", "DSNU1288", "PRNU1288")
    told = "; ".join(f"{sheet[key].symbol} {sheet[key].text}" for key in named if sheet[key].value is not None)
    return f"The quantities of EMVA 1288, release 4.0 Linear: {told}. {variance}"


def sections(
    sheet: EmvaSheet,
    frames: EmvaFrames,
    told: Mapping[str, Any],
    pictures: Mapping[str, bytes],
    budget: Sequence[Section] = (),
) -> list[Section]:
    """Return the sections of the page in the order of the standard, without plots that the frames do not allow.

    The sections ``budget`` have the uncertainty of the quantities.
    """
    found = (_section(sheet, heading, text, pictures.get(name)) for heading, name, text in _SECTIONS)
    kept = (s for s in found if s.rows or s.picture)
    tested = replace(frame_section(frames.tests), text=_TESTED if len(frames.tests) > 1 else _MOMENTS)
    return [*kept, *budget, tested, _compliance(sheet, frames, told)]


def requirements(sheet: EmvaSheet, frames: EmvaFrames, told: Mapping[str, Any]) -> list[Requirement]:
    """Return each demand of the standard on the frames and on what is told of them."""
    return [*_of_transfer(sheet, frames), *_of_series(sheet), *_of_told(told), *_elsewhere()]


def operating_point(statements: Sequence[str], traced: Traceability | None = None) -> dict[str, str | None]:
    """Return what statements such as ``temperature=25 °C`` tell of the operating point; None where nothing is told.

    What the recipe states in the block ``traceability`` counts where no statement says otherwise.
    Raises: ValueError for a statement that is not a key of `OPERATING_POINT`, ``=`` and a text.
    """
    told: dict[str, str | None] = {**dict.fromkeys(OPERATING_POINT), **(of_traceability(traced) if traced else {})}
    for statement in statements:
        key, sign, value = (part.strip() for part in statement.partition("="))
        if key not in told or not sign or not value:
            raise ValueError(f"--state {statement!r}: write one of {', '.join(told)}, then = and a text")
        told[key] = value
    return told


def group_of(quantity: Quantity, sheet: EmvaSheet) -> str:
    """Return the heading under which the sheet has a quantity."""
    keys = [each.key for each in sheet.quantities]
    at = keys.index(quantity.key)
    return next(name for name, (first, last) in _TABLES.items() if keys.index(first) <= at <= keys.index(last))


def _section(sheet: EmvaSheet, heading: str, text: str, picture: bytes | None) -> Section:
    rows: list[Sequence[Any]] = []
    marks: dict[tuple[int, int], Mark] = {}
    columns: Sequence[str] = ("symbol", "quantity", "value", "why not, or why a limit")
    for quantity in (q for q in sheet.quantities if heading in _TABLES and group_of(q, sheet) == heading):
        if quantity.reason:
            marks[len(rows), 2] = "warn"
        rows.append((quantity.symbol, quantity.name, quantity.text, quantity.reason))
    if not marks:
        columns, rows = columns[:-1], [row[:-1] for row in rows]
    return Section(heading, text, columns if rows else (), rows, picture, marks)


def _compliance(sheet: EmvaSheet, frames: EmvaFrames, told: Mapping[str, Any]) -> Section:
    found = requirements(sheet, frames, told)
    marks: dict[tuple[int, int], Mark] = {(i, 2): row.mark for i, row in enumerate(found)}
    rows = [(row.demand, row.found, "yes" if row.mark == "pass" else "no") for row in found]
    open_ones = sum(row.mark != "pass" for row in found)
    text = f"""The quantities are computed as EMVA 1288, release 4.0 Linear, says. This is a computation from frames and
        no certificate: geometry, homogeneity and calibration of the light are the laboratory's part, and frames do
        not show them.

        {open_ones} of {len(rows)} demands of the standard are not met, or not shown here. Only those who measured can
        state that the measurement complies."""
    return Section("Compliance: what was measured and told", text, ("demand", "found", "met"), rows, marks=marks)


def _of_transfer(sheet: EmvaSheet, frames: EmvaFrames) -> Iterator[Requirement]:
    found, noise = sheet.transfer, sheet["sigma_y_dark"]
    count, times = len(found.photons), len(np.unique(found.dark_exposure))
    pairs = set(found.exposure.tolist()) <= set(found.dark_exposure.tolist())
    top = "reached" if found.saturated else "not reached"
    yield _asked(f"{_LEVELS} or more lit levels", f"{count}", count >= _LEVELS)
    yield _asked("two frames or more at each level", f"{frames.frames}", frames.frames >= 2)
    yield _asked("dark frames at the exposure of each lit level", "yes" if pairs else "of the nearest exposure", pairs)
    yield _asked("levels from dark to saturation", f"saturation {top}", found.saturated)
    yield Requirement("temporal dark noise of 0.49 DN or more", noise.text, "fail" if noise.bound else "pass")
    text = f"{times} exposure{'s' * (times != 1)}"
    yield _asked(f"dark current from {_EXPOSURES} or more exposures", text, times >= _EXPOSURES)


def _of_series(sheet: EmvaSheet) -> Iterator[Requirement]:
    dark, lit = sheet.spatial
    for name, series in (("dark", dark), ("lit", lit)):
        demand = f"series of {_SERIES} or more {name} frames for spatial quantities"
        count = 0 if series is None else series.count
        yield _asked(demand, f"{count} frames" if count else "no series", count >= _SERIES)
    if dark is not None and lit is not None:
        yield _asked("both series at one exposure", _exposures(dark, lit), dark.exposure == lit.exposure)
        full = float(sheet.transfer.signal[sheet.transfer.saturation])
        share = float(lit.average.mean() - dark.average.mean()) / full
        yield _asked("lit series at 50 % of saturation", f"{share:.1%}", _HALF[0] <= share <= _HALF[1])


def _of_told(told: Mapping[str, Any]) -> Iterator[Requirement]:
    for key, name in OPERATING_POINT.items():
        value = told.get(key)
        yield _asked(f"stated: {name}", "not stated" if value is None else str(value), value is not None)


def _elsewhere() -> Iterator[Requirement]:
    """Yield what the standard asks for, or offers, that frames of one light and one temperature cannot show."""
    yield Requirement("spectral sensitivity η(λ)", "not measured: one light", "warn")
    yield Requirement("dark current over temperature", "not measured: one temperature", "warn")
    yield Requirement("homogeneity of the light better than 3 %, from a disk at f/8", "not shown by frames", "warn")


def _asked(demand: str, found: str, met: bool) -> Requirement:
    return Requirement(demand, found, "pass" if met else "warn")


def _exposures(dark: SpatialSeries, lit: SpatialSeries) -> str:
    return f"{dark.exposure:.4g} s and {lit.exposure:.4g} s"
