"""Spectral bands of a scene, and the spectrum of a laser as lines or from a table."""

import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.input_files import once_per_version
from neusee.nodes.spectra._cie_tables import Table
from neusee.nodes.spectra._table_files import LENGTHS, Curves, Numbers, curves, table_error
from neusee.nodes.units import Count, DataFile, Fraction, Linewidth, Wavelength
from neusee.nodes.values import Bands
from neusee.nodes.values import Bands as Samples

# --- bands ----------------------------------------------------------------------------------------

# Spectral bands of a scene, and spectral sampling of a laser line.


_MOST_BANDS = 100_000  #: largest number of bands: 0.003 nm each from 400 to 700 nm
#: m, spacing of the bands of a scene; the paper samples laser lines on the same grid
_GRID_SPACING = 10e-9


@node(rtol=1e-12, before_run=True)
def bands(*, start: Wavelength, stop: Wavelength, count: Count) -> Samples:
    """Divide the spectrum into bands with evenly spaced centres from `start` to `stop`.

    A single band lies in the middle and covers the whole range.

    Shapes: -> centres, widths, weights (band,) float64.
    Units:  centres and widths m; weights 1.
    Error:  the first and last bands reach half a width beyond the ends.
    Raises: ParameterError before the run unless start is below stop, and for more than 100 000
            bands.
    Source: NeuSee: 400 to 700 nm by 10 nm.
    """
    if count == 1:
        centres, width = torch.tensor([(start + stop) / 2], dtype=torch.float64), stop - start
    else:
        centres, width = (
            torch.linspace(start, stop, count, dtype=torch.float64),
            (stop - start) / (count - 1),
        )
    return Samples(centres, torch.full_like(centres, width), torch.ones_like(centres))


@bands.preflight
def _(*, start: float, stop: float, count: int = 1) -> list[str]:
    _refuse_many(count)
    if not start < stop:
        raise ParameterError(
            "start",
            f"start {start * 1e9:g} nm must be below stop {stop * 1e9:g} nm: exchange start and"
            " stop",
        )
    return []


def _refuse_many(count: int) -> None:
    """Raise ParameterError for more than `_MOST_BANDS` bands."""
    if count > _MOST_BANDS:
        raise ParameterError(
            "count", f"{count} bands exceed the limit of {_MOST_BANDS}: choose fewer bands"
        )


@bands.check
def _(result: Samples, **params: Any) -> list[Check]:
    ends = f"{float(result.centres[0]) * 1e9:.4g} to {float(result.centres[-1]) * 1e9:.4g} nm"
    return [
        Check(
            f"{len(result.centres)} bands with centres from {ends}, each"
            f" {float(result.widths[0]) * 1e9:.3g} nm wide"
        )
    ]


@node(rtol=1e-12, before_run=True)
def filters(
    *,
    centres: Annotated[tuple[Wavelength, ...], Field(min_length=1)],
    widths: Annotated[tuple[Linewidth, ...], Field(min_length=1)],
) -> Samples:
    """Return spectral bands with individual centres and widths, such as the passbands of a filter
    set.

    A single width applies to all bands. A change of one band leaves the other bands unchanged to
    the last bit.

    Shapes: -> centres, widths, weights (band,) float64.
    Units:  centres and widths m; weights 1.
    Error:  each filter passes all light inside its width and none outside; real filters have edges
            of some nm.
    Raises: ParameterError before the run unless one width, or one width for each centre, is given.
    Source: the filters' data sheets: central wavelength and full width at half maximum.
    """
    centre = torch.tensor(centres, dtype=torch.float64)
    return Samples(
        centre, torch.tensor(widths, dtype=torch.float64).expand_as(centre), torch.ones_like(centre)
    )


@filters.preflight
def _(*, centres: tuple[float, ...], widths: tuple[float, ...]) -> list[str]:
    if len(widths) not in (1, len(centres)):
        text = (
            f"{len(widths)} widths for {len(centres)} centres: give one width, or one width for"
            " each centre"
        )
        raise ParameterError("widths", text)
    return []


@filters.check
def _(result: Samples, **params: Any) -> list[Check]:
    low, high = float(result.centres.min()) * 1e9, float(result.centres.max()) * 1e9
    return [Check(f"{len(result.centres)} filters with centres from {low:.4g} to {high:.4g} nm")]


@node(rtol=1e-9, before_run=True)
def line(
    *,
    wavelength: Wavelength,
    fwhm: Linewidth = 10e-9,
    count: Count = 5,
    span: Linewidth | None = None,
    floor: Fraction = 1e-3,
    sampling: Literal["integrated", "point"] = "integrated",
) -> Samples:
    """Sample a Gaussian laser line in a few spectral bands, weighted by the energy of the line in
    each band.

    `floor` is a constant background of the line, relative to the peak.

    `integrated`: `count` equal bands cover `span` (3 fwhm). A weight is the exact energy in a band;
    the weights sum to 1. `point`: the bands are the `count` nearest multiples of 10 nm. A weight is
    the value of the line at the centre, as printed in the paper; the weights do not sum to 1.

    Shapes: -> centres, widths, weights (band,) float64.
    Units:  centres and widths m; weights relative to the energy of the line.
    Error:  integrated: the 4e-4 of the line beyond 3 fwhm is redistributed over the bands; the
            floor beyond `span` (3 % over 400-700 nm) is neglected. point: the sum is off by up to
            5.7 % at fwhm 10 nm.
    Raises: ParameterError before the run where the bands would reach below 100 nm, and for more
            than 100 000 bands.
    Source: NeuSee, laser of 10 nm FWHM with 0.1 % floor; bin integrals by the error function.
    """
    sigma = fwhm / (2 * math.sqrt(2 * math.log(2)))
    if sampling == "point":
        return _grid_points(wavelength, sigma, count, floor)
    width = (3 * fwhm if span is None else span) / count
    edges = width * (torch.arange(count + 1, dtype=torch.float64) - count / 2)
    line_share = torch.erf(edges / (sigma * math.sqrt(2))).diff() / 2
    # the floor is relative to the peak density of the line
    weights = line_share + floor * width / (sigma * math.sqrt(2 * math.pi))
    centres = wavelength + (edges[1:] + edges[:-1]) / 2
    return Samples(centres, torch.full_like(centres, width), weights / weights.sum())


@line.preflight
def _(
    *,
    wavelength: float,
    fwhm: float = 10e-9,
    count: int = 5,
    span: float | None = None,
    **params: Any,
) -> list[str]:
    _refuse_many(count)
    points = params.get("sampling") == "point"
    name, width = ("fwhm", 3 * fwhm) if span is None else ("span", span)
    if points:
        name, width = "count", _GRID_SPACING * count
    reach = width / 2
    if wavelength - reach < 100e-9:
        text = (
            f"the bands of the laser reach down to {(wavelength - reach) * 1e9:.3g} nm: keep all"
            " bands above 100 nm"
        )
        raise ParameterError(name, text)
    return (
        ["laser sampled at points of the 10 nm grid: the energy of the laser is off by up to 5.7 %"]
        if points
        else []
    )


@line.check
def _(result: Samples, *, wavelength: float, **params: Any) -> list[Check]:
    total = float(result.weights.sum())
    mean = float((result.weights * result.centres).sum()) / total
    text = (
        f"{wavelength * 1e9:.5g} nm in {len(result.centres)} bands: energy {total:.4f}, mean"
        f" {mean * 1e9:.5g} nm"
    )
    return [Check(text, abs(total - 1) < 0.01)]


def _grid_points(wavelength: float, sigma: float, count: int, floor: float) -> Samples:
    """Return ``count`` points of the 10 nm grid around a line; the weight of a point is the power
    density there times 10 nm.
    """
    first_multiple = math.floor(wavelength / _GRID_SPACING - count / 2 + 1 + 1e-9)
    centres = _GRID_SPACING * (first_multiple + torch.arange(count, dtype=torch.float64))
    relative_power: Tensor = torch.exp(-(((centres - wavelength) / sigma) ** 2) / 2) + floor
    weights = relative_power * _GRID_SPACING / (sigma * math.sqrt(2 * math.pi))
    return Samples(centres, torch.full_like(centres, _GRID_SPACING), weights)


def mean_wavelength(line: Samples) -> float:
    """Return the mean wavelength of a laser line in m, weighted by the energy in each band."""
    return float((line.centres * line.weights).sum() / line.weights.sum())


# --- laser table ----------------------------------------------------------------------------------

# Spectrum of a laser from a table of separate lines or of spectral power.


_COLUMNS = (
    "write a header such as wavelength (nm),power (mW) for separate lines, or wavelength (nm),power"
    " (mW/nm) for a spectrum, then two columns"
)
_PER_LENGTH = re.compile(r"(?:/|per )\s*(?:nm|um|µm|μm|m)\)?$")  #: end of a unit of spectral power
#: share of the energy of a spectrum outside its bands, half of it on each side
_OMITTED_ENERGY = 1e-3
_MANY_LINES = 50  #: number of lines above which a note warns: each line needs its own PSF


@node(rtol=1e-9, before_run=True)
def line_table(*, file: DataFile, count: Count = 5) -> Bands:
    """Read the spectrum of a laser from a CSV file: the power of separate lines, or the spectral
    power.

    The unit in the header decides. A power, such as ``power (mW)`` or ``share (%)``, belongs to one
    line, and each row becomes one band; a third column, such as ``fwhm (nm)``, may give the width
    of each line. A power for each nm, such as ``power (mW/nm)``, is a spectrum, which ``count``
    equal bands divide. Only the ratio of the powers counts.

    Shapes: -> centres, widths, weights (band,) float64.
    Units:  centres and widths m; weights are shares of the energy of the laser, with the sum 1.
    Error:  lines: exact; the shape within the width of a line is left out. spectrum: linear between
            the rows, each band holds its exact energy; the 1e-3 of the energy furthest out is
            redistributed over the bands.
    Raises: ParameterError before the run for a file without such a table, and for a power that is
            negative or 0 everywhere.
    Source: by definition.
    """
    laser = laser_table(file)
    table = laser.power.table()
    if laser.widths is None:
        return _divided_spectrum(table, count)
    widths = torch.from_numpy(laser.widths.copy())
    return Bands(table.wavelengths, widths, table.values[0] / table.values[0].sum())


@line_table.preflight
def _(*, file: Path, count: int = 5) -> list[str]:
    laser = laser_table(file)
    rows = len(laser.power.wavelengths)
    if laser.widths is not None and rows > _MANY_LINES:
        return [
            f"{file.name}: each of the {rows} lines takes a PSF of its own: keep the strongest"
            " lines to save time"
        ]
    return []


@line_table.check
def _(result: Bands, *, file: Path, count: int = 5) -> list[Check]:
    laser = laser_table(file)
    table = laser.power.table()
    lines = Bands(table.wavelengths, table.wavelengths, table.values[0])
    own = _mean_of_spectrum(table) if laser.widths is None else mean_wavelength(lines)
    mean, band_range = mean_wavelength(result), float(result.centres.max() - result.centres.min())
    text = (
        f"{file.name} in {len(result.centres)} bands: mean {mean * 1e9:.6g} nm, {own * 1e9:.6g} nm"
        " in the table"
    )
    return [Check(text, abs(mean - own) <= 0.1 * band_range + 1e-13)]


class LaserTable(NamedTuple):
    """The spectrum of a laser from a file."""

    power: Curves  #: one curve
    widths: Numbers | None  #: widths of separate lines in m; None for a continuous spectrum


def laser_table(file: Path) -> LaserTable:
    """Read the power of a laser over the wavelength from a CSV file."""
    try:
        return _laser_table(file)
    except (OSError, ValueError) as error:
        raise table_error("file", _COLUMNS, error) from None


@once_per_version
def _laser_table(file: Path) -> LaserTable:
    """Read and check the spectrum of a laser; raise ValueError for a wrong table."""
    table = curves(file, None, fewest=1)
    power, *others = table.columns
    if not power.unit:
        raise ValueError(f"{file.name}: column 2, {power.quantity}, has no unit")
    spectrum = _PER_LENGTH.search(power.unit) is not None
    # separate lines may have widths in a third column
    if len(others) > (0 if spectrum else 1):
        raise ValueError(
            f"{file.name} has {len(table.columns) + 1} columns in place of"
            f" {'2' if spectrum else '2 or 3'}"
        )
    table.refuse(table.values < 0, lambda value: f"a laser has no power or width of {value:g}")
    if not table.values[0].any():
        raise ValueError(f"{file.name} has no power at any wavelength")
    if spectrum and len(table.wavelengths) < 2:
        raise ValueError(f"{file.name} holds one wavelength: a spectrum needs at least two")
    power_curve = table._replace(columns=(power,), values=table.values[:1])
    widths = None if spectrum else _widths(table)
    return LaserTable(power_curve, widths)


def _widths(table: Curves) -> Numbers:
    """Return the widths of separate lines in m; lines without widths are 0 wide."""
    if len(table.columns) == 1:
        return np.zeros(len(table.wavelengths))
    unit = table.columns[1].unit
    if unit not in LENGTHS:
        heading = table.columns[1].heading
        raise ValueError(f"{table.file.name}: column 3, {heading}, has no widths: write fwhm (nm)")
    widths: Numbers = table.values[1] * LENGTHS[unit]
    return widths


def _divided_spectrum(table: Table, count: int) -> Bands:
    """Return equal bands that together contain all but `_OMITTED_ENERGY` of a spectrum's energy."""
    lowest, highest = (
        _wavelength_of_share(table, _OMITTED_ENERGY / 2),
        _wavelength_of_share(table, 1 - _OMITTED_ENERGY / 2),
    )
    edges = torch.linspace(lowest, highest, count + 1, dtype=torch.float64)
    centres, width = (edges[1:] + edges[:-1]) / 2, (highest - lowest) / count
    widths = torch.full_like(centres, width)
    energy = table.over(Bands(centres, widths, torch.ones_like(centres)))[0]
    return Bands(centres, widths, energy / energy.sum())


def _wavelength_of_share(table: Table, share: float) -> float:
    """Return the wavelength below which a spectrum has a given share of its energy, by
    bisection.
    """
    first, low, high = (float(table.wavelengths[i]) for i in (0, 0, -1))
    total = _energy(table, first, high)
    # bisection to the last digit of float64
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (
            (middle, high) if _energy(table, first, middle) < share * total else (low, middle)
        )
    return (low + high) / 2


def _energy(table: Table, low: float, high: float) -> float:
    """Return the integral of a spectrum between two wavelengths."""
    centre, width = torch.tensor([[(low + high) / 2], [high - low]], dtype=torch.float64)
    return float(table.over(Bands(centre, width, centre))[0]) * (high - low) if high > low else 0.0


def _mean_of_spectrum(table: Table) -> float:
    """Return the mean wavelength of a spectrum that is linear between its samples, weighted by
    energy.
    """
    wavelengths, power = table.wavelengths, table.values[0]
    steps = wavelengths.diff()
    areas = (power[1:] + power[:-1]) / 2 * steps
    # integral of x y over a step in which both are linear
    first_moments = (
        steps
        * (
            wavelengths[1:] * (2 * power[1:] + power[:-1])
            + wavelengths[:-1] * (2 * power[:-1] + power[1:])
        )
        / 6
    )
    return float(first_moments.sum() / areas.sum())
