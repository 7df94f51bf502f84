"""Spectral bands of a scene, and spectral sampling of a laser line."""

import math
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.units import Count, Fraction, Linewidth, Wavelength
from neusee.nodes.values import Bands as Samples

_MOST = 100_000  #: bands, at most; 0.003 nm each from 400 to 700 nm
_GRID = 10e-9  #: m, spacing of the bands of a scene; the paper samples laser lines on the same grid


@node(rtol=1e-12, before_run=True)
def bands(*, start: Wavelength, stop: Wavelength, count: Count) -> Samples:
    """Divide the spectrum into bands with evenly spaced centres from `start` to `stop`.

    A single band lies in the middle and covers the whole range.

    Shapes: -> centres, widths, weights (band,) float64.
    Units:  centres and widths m; weights 1.
    Error:  the first and last bands reach half a width beyond the ends.
    Raises: ParameterError before the run unless start is below stop, and for more than 100 000 bands.
    Source: NeuSee: 400 to 700 nm by 10 nm.
    """
    if count == 1:
        centres, width = torch.tensor([(start + stop) / 2], dtype=torch.float64), stop - start
    else:
        centres, width = torch.linspace(start, stop, count, dtype=torch.float64), (stop - start) / (count - 1)
    return Samples(centres, torch.full_like(centres, width), torch.ones_like(centres))


@bands.preflight
def _(*, start: float, stop: float, count: int = 1) -> list[str]:
    _refuse_many(count)
    if not start < stop:
        raise ParameterError(
            "start", f"start {start * 1e9:g} nm must be below stop {stop * 1e9:g} nm: exchange start and stop"
        )
    return []


def _refuse_many(count: int) -> None:
    """Raise ParameterError for more bands than any computation here can use."""
    if count > _MOST:
        raise ParameterError("count", f"{count} bands exceed the limit of {_MOST}: choose fewer bands")


@bands.check
def _(result: Samples, **params: Any) -> list[Check]:
    ends = f"{float(result.centres[0]) * 1e9:.4g} to {float(result.centres[-1]) * 1e9:.4g} nm"
    return [
        Check(f"{len(result.centres)} bands with centres from {ends}, each {float(result.widths[0]) * 1e9:.3g} nm wide")
    ]


@node(rtol=1e-12, before_run=True)
def filters(
    *,
    centres: Annotated[tuple[Wavelength, ...], Field(min_length=1)],
    widths: Annotated[tuple[Linewidth, ...], Field(min_length=1)],
) -> Samples:
    """Return spectral bands with individual centres and widths, such as the passbands of a filter set.

    A single width applies to all bands. A change of one band leaves the other bands unchanged to the last bit.

    Shapes: -> centres, widths, weights (band,) float64.
    Units:  centres and widths m; weights 1.
    Error:  each filter passes all light inside its width and none outside; real filters have edges of some nm.
    Raises: ParameterError before the run unless one width, or one width for each centre, is given.
    Source: the filters' data sheets: central wavelength and full width at half maximum.
    """
    centre = torch.tensor(centres, dtype=torch.float64)
    return Samples(centre, torch.tensor(widths, dtype=torch.float64).expand_as(centre), torch.ones_like(centre))


@filters.preflight
def _(*, centres: tuple[float, ...], widths: tuple[float, ...]) -> list[str]:
    if len(widths) not in (1, len(centres)):
        text = f"{len(widths)} widths for {len(centres)} centres: give one width, or one width for each centre"
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
    """Sample a Gaussian laser line in a few spectral bands, weighted by the energy of the line in each band.

    `floor` is a constant background of the line, relative to the peak.

    `integrated`: `count` equal bands cover `span` (3 fwhm). A weight is the exact energy in a band; the weights sum
    to 1. `point`: the bands are the `count` nearest multiples of 10 nm. A weight is the value of the line at the
    centre, as printed in the paper; the weights do not sum to 1.

    Shapes: -> centres, widths, weights (band,) float64.
    Units:  centres and widths m; weights relative to the energy of the line.
    Error:  integrated: the 4e-4 of the line beyond 3 fwhm is redistributed over the bands; the floor beyond `span`
            (3 % over 400-700 nm) is neglected. point: the sum is off by up to 5.7 % at fwhm 10 nm.
    Raises: ParameterError before the run where the bands would reach below 100 nm, and for more than 100 000 bands.
    Source: NeuSee, laser of 10 nm FWHM with 0.1 % floor; bin integrals by the error function.
    """
    sigma = fwhm / (2 * math.sqrt(2 * math.log(2)))
    if sampling == "point":
        return _points(wavelength, sigma, count, floor)
    width = (3 * fwhm if span is None else span) / count
    edges = width * (torch.arange(count + 1, dtype=torch.float64) - count / 2)
    inside = torch.erf(edges / (sigma * math.sqrt(2))).diff() / 2
    weights = inside + floor * width / (sigma * math.sqrt(2 * math.pi))
    centres = wavelength + (edges[1:] + edges[:-1]) / 2
    return Samples(centres, torch.full_like(centres, width), weights / weights.sum())


@line.preflight
def _(*, wavelength: float, fwhm: float = 10e-9, count: int = 5, span: float | None = None, **params: Any) -> list[str]:
    _refuse_many(count)
    points = params.get("sampling") == "point"
    reach = _GRID * count / 2 if points else (3 * fwhm if span is None else span) / 2
    if wavelength - reach < 100e-9:
        name = "count" if points else "fwhm" if span is None else "span"
        text = f"the bands of the laser reach down to {(wavelength - reach) * 1e9:.3g} nm: keep all bands above 100 nm"
        raise ParameterError(name, text)
    return (
        ["laser sampled at points of the 10 nm grid: the energy of the laser is off by up to 5.7 %"] if points else []
    )


@line.check
def _(result: Samples, *, wavelength: float, **params: Any) -> list[Check]:
    total = float(result.weights.sum())
    mean = float((result.weights * result.centres).sum()) / total
    text = f"{wavelength * 1e9:.5g} nm in {len(result.centres)} bands: energy {total:.4f}, mean {mean * 1e9:.5g} nm"
    return [Check(text, abs(total - 1) < 0.01)]


def _points(wavelength: float, sigma: float, count: int, floor: float) -> Samples:
    first = math.floor(wavelength / _GRID - count / 2 + 1 + 1e-9)
    centres = _GRID * (first + torch.arange(count, dtype=torch.float64))
    shape: Tensor = torch.exp(-(((centres - wavelength) / sigma) ** 2) / 2) + floor
    weights = shape * _GRID / (sigma * math.sqrt(2 * math.pi))
    return Samples(centres, torch.full_like(centres, _GRID), weights)


def mean_wavelength(line: Samples) -> float:
    """Return the mean wavelength of a laser line in m, weighted by the energy in each band."""
    return float((line.centres * line.weights).sum() / line.weights.sum())
