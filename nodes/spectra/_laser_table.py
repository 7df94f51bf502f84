"""Spectrum of a laser from a table of separate lines or of spectral power."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from neusee.nodes import Check, node
from neusee.nodes.input_files import once_per_version
from neusee.nodes.spectra._bands import mean_wavelength
from neusee.nodes.spectra._spectral_tables import Table
from neusee.nodes.spectra._table_files import LENGTHS, Curves, Numbers, curves, refused
from neusee.nodes.units import Count, DataFile
from neusee.nodes.values import Bands

_COLUMNS = (
    "write a header such as wavelength (nm),power (mW) for separate lines, or wavelength (nm),power (mW/nm) for a "
    "spectrum, then two columns"
)
_PER_LENGTH = re.compile(r"(?:/|per )\s*(?:nm|um|µm|μm|m)\)?$")  #: end of a unit of spectral power
_LEFT = 1e-3  #: share of the energy of a spectrum that its bands leave out, half of it on each side
_MANY = 50  #: lines; each of them takes a PSF of its own


@node(rtol=1e-9, before_run=True)
def line_table(*, file: DataFile, count: Count = 5) -> Bands:
    """Read the spectrum of a laser from a CSV file: the power of separate lines, or the spectral power.

    The unit in the header decides. A power, such as ``power (mW)`` or ``share (%)``, belongs to one line, and each row
    becomes one band; a third column, such as ``fwhm (nm)``, may give the width of each line. A power for each nm, such
    as ``power (mW/nm)``, is a spectrum, which ``count`` equal bands divide. Only the ratio of the powers counts.

    Shapes: -> centres, widths, weights (band,) float64.
    Units:  centres and widths m; weights are shares of the energy of the laser, with the sum 1.
    Error:  lines: exact; the shape within the width of a line is left out. spectrum: linear between the rows, each band
            holds its exact energy; the 1e-3 of the energy furthest out is redistributed over the bands.
    Raises: ParameterError before the run for a file without such a table, and for a power that is negative or 0
            everywhere.
    Source: by definition.
    """
    laser = laser_table(file)
    table = laser.power.table()
    if laser.widths is None:
        return _divided(table, count)
    widths = torch.from_numpy(laser.widths.copy())
    return Bands(table.wavelengths, widths, table.values[0] / table.values[0].sum())


@line_table.preflight
def _(*, file: Path, count: int = 5) -> list[str]:
    laser = laser_table(file)
    rows = len(laser.power.wavelengths)
    if laser.widths is not None and rows > _MANY:
        return [f"{file.name}: each of the {rows} lines takes a PSF of its own: keep the strongest lines to save time"]
    return []


@line_table.check
def _(result: Bands, *, file: Path, count: int = 5) -> list[Check]:
    laser = laser_table(file)
    table = laser.power.table()
    lines = Bands(table.wavelengths, table.wavelengths, table.values[0])
    own = _mean(table) if laser.widths is None else mean_wavelength(lines)
    mean, range_ = mean_wavelength(result), float(result.centres.max() - result.centres.min())
    text = f"{file.name} in {len(result.centres)} bands: mean {mean * 1e9:.6g} nm, {own * 1e9:.6g} nm in the table"
    return [Check(text, abs(mean - own) <= 0.1 * range_ + 1e-13)]


class LaserTable(NamedTuple):
    """The spectrum of a laser from a file."""

    power: Curves  #: one curve
    widths: Numbers | None  #: m, of each separate line; None for a spectrum


def laser_table(file: Path) -> LaserTable:
    """Read the power of a laser over the wavelength from a CSV file."""
    try:
        return _laser_table(file)
    except (OSError, ValueError) as error:
        raise refused("file", _COLUMNS, error) from None


@once_per_version
def _laser_table(file: Path) -> LaserTable:
    found = curves(file, None, least=1)
    power, *others = found.columns
    if not power.unit:
        raise ValueError(f"{file.name}: column 2, {power.quantity}, has no unit")
    spectrum = _PER_LENGTH.search(power.unit) is not None
    if len(others) > (0 if spectrum else 1):
        raise ValueError(
            f"{file.name} has {len(found.columns) + 1} columns in place of {'2' if spectrum else '2 or 3'}"
        )
    found.refuse(found.values < 0, lambda value: f"a laser has no power or width of {value:g}")
    if not found.values[0].any():
        raise ValueError(f"{file.name} has no power at any wavelength")
    if spectrum and len(found.wavelengths) < 2:
        raise ValueError(f"{file.name} holds one wavelength: a spectrum needs at least two")
    alone = found._replace(columns=(power,), values=found.values[:1])
    return LaserTable(alone, None if spectrum else _widths(found))


def _widths(found: Curves) -> Numbers:
    """Return the widths of separate lines in m; lines without widths are 0 wide."""
    if len(found.columns) == 1:
        return np.zeros(len(found.wavelengths))
    unit = found.columns[1].unit
    if unit not in LENGTHS:
        heading = found.columns[1].heading
        raise ValueError(f"{found.file.name}: column 3, {heading}, has no widths: write fwhm (nm)")
    widths: Numbers = found.values[1] * LENGTHS[unit]
    return widths


def _divided(table: Table, count: int) -> Bands:
    """Divide a spectrum into equal bands that hold all but `_LEFT` of its energy."""
    low, high = _reached(table, _LEFT / 2), _reached(table, 1 - _LEFT / 2)
    edges = torch.linspace(low, high, count + 1, dtype=torch.float64)
    centres, width = (edges[1:] + edges[:-1]) / 2, (high - low) / count
    widths = torch.full_like(centres, width)
    energy = table.over(Bands(centres, widths, torch.ones_like(centres)))[0]
    return Bands(centres, widths, energy / energy.sum())


def _reached(table: Table, share: float) -> float:
    """Return the wavelength up to which a spectrum has a share of its energy, by bisection."""
    first, low, high = (float(table.wavelengths[i]) for i in (0, 0, -1))
    whole = _energy(table, first, high)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _energy(table, first, middle) < share * whole else (low, middle)
    return (low + high) / 2


def _energy(table: Table, low: float, high: float) -> float:
    """Return the integral of a spectrum between two wavelengths."""
    centre, width = torch.tensor([[(low + high) / 2], [high - low]], dtype=torch.float64)
    return float(table.over(Bands(centre, width, centre))[0]) * (high - low) if high > low else 0.0


def _mean(table: Table) -> float:
    """Return the mean wavelength of a spectrum that is linear between its samples, weighted by energy."""
    x, y = table.wavelengths, table.values[0]
    steps = x.diff()
    areas = (y[1:] + y[:-1]) / 2 * steps
    moments = steps * (x[1:] * (2 * y[1:] + y[:-1]) + x[:-1] * (2 * y[:-1] + y[1:])) / 6
    return float(moments.sum() / areas.sum())
