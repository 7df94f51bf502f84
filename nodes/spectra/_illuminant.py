"""Illuminants, and the radiance of a scene under an illuminant."""

import re
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.input_files import once_per_version
from neusee.nodes.precision import single
from neusee.nodes.spectra._cie_tables import Table, daylight, light, observer, require_range
from neusee.nodes.spectra._table_files import Curves, curves, table_error
from neusee.nodes.units import DataFile, Temperature
from neusee.nodes.values import Bands, LowRankCube

Kind = Literal[
    "daylight", "D50", "D55", "D65", "D75", "A", "E", "FL2", "FL7", "FL11", "HP1",
    "LED-B1", "LED-B2", "LED-B3", "LED-B4", "LED-B5", "LED-BH1", "LED-RGB1", "LED-V1", "LED-V2",
]  # fmt: skip
_COLUMNS = "write a header such as wavelength (nm),power (W/nm), then two columns"
#: smallest share of the luminous efficiency function within the range of a table, for lux
_LEAST_EFFICIENCY_SHARE = 0.99
_LUMENS_PER_WATT = 683.0  #: lm/W at 555 nm
_LONGER_TABLE = "give a longer table, or choose bands inside that range"


@node(rtol=1e-9)
def illuminant(
    bands: Bands, *, kind: Kind | DataFile = "daylight", temperature: Temperature = 6504.0
) -> Tensor:
    """Average the relative spectral power of an illuminant over each band: a CIE illuminant, or a
    table of your own.

    Only the kind `daylight` uses `temperature`. A table is a CSV file with a header such as
    ``wavelength (nm),power (W/nm)`` and two columns; only the ratio of its powers counts.

    Shapes: -> (band,) float64.
    Units:  relative, mean 1 over the bands.
    Error:  linear interpolation between samples 1 to 10 nm apart; 31 bands shift the white of D65
            by 0.2 %. A table is not extrapolated.
    Raises: ParameterError before the run for daylight outside 4000 to 25 000 K, and for a file
            without such a table or with a table that does not reach over all bands; ValueError
            where bands leave the table.
    Source: CIE 15:2004 (D series, A, E, FL, HP), CIE 15:2018 (LED), by way of colour-science.
    """
    table = _light(kind, temperature)
    name = _name(kind)
    edges = _band_edges(bands)
    require_range(edges, table.wavelengths, f"{name} is tabulated from")
    power = table.over(bands)[0]
    if not float(power.mean()) > 0:
        low, high = float(edges.min()) * 1e9, float(edges.max()) * 1e9
        raise ValueError(
            f"illuminant {name} gives no light from {low:.4g} to {high:.4g} nm: choose other bands"
        )
    return (power / power.mean()).to(bands.centres.device)


@illuminant.preflight
def _(
    *, bands: Bands | None = None, kind: str | Path = "daylight", temperature: float = 6504.0
) -> list[str]:
    if kind == "daylight" and not 4000 <= temperature <= 25000:
        raise ParameterError(
            "temperature",
            f"CIE daylight is defined from 4000 K to 25000 K, not at {temperature:g} K: choose kind"
            " A or an LED",
        )
    if isinstance(kind, Path):
        table = light_curve(kind).table()
        if bands is not None and not bands.centres.is_meta:
            try:
                require_range(
                    _band_edges(bands),
                    table.wavelengths,
                    f"{kind.name} is tabulated from",
                    _LONGER_TABLE,
                )
            except ValueError as error:
                raise ParameterError("kind", str(error)) from None
    return []


@illuminant.check
def _(
    result: Tensor, bands: Bands, *, kind: str | Path = "daylight", temperature: float = 6504.0
) -> list[Check]:
    name = f"{kind} {temperature:g} K" if kind == "daylight" else _name(kind)
    peak = float(bands.centres[int(result.argmax())]) * 1e9
    return [
        Check(
            f"{name}: relative power {float(result.min()):.2f} to {float(result.max()):.2f},"
            f" largest at {peak:.4g} nm"
        )
    ]


def luminous_share(bands: Bands | None, kind: str | Path, temperature: float) -> float:
    """Return the mean radiance in one band of a light of 1 cd/m2, in W/(m2 sr); 0 without bands.

    Raises ParameterError for a table of light whose range contains less than 99 % of the luminous
    efficiency function.
    """
    table, observer_table = _light(kind, temperature), observer()
    in_range = (observer_table.wavelengths >= table.wavelengths[0]) & (
        observer_table.wavelengths <= table.wavelengths[-1]
    )
    # `values[1]`: the second colour-matching function is the luminous efficiency
    efficiency = observer_table.values[1] * in_range
    if float(efficiency.sum() / observer_table.values[1].sum()) < _LEAST_EFFICIENCY_SHARE:
        low, high = float(table.wavelengths[0]) * 1e9, float(table.wavelengths[-1]) * 1e9
        text = (
            f"{_name(kind)} is tabulated from {low:.4g} to {high:.4g} nm, which does not reach over"
            " the visible"
        )
        raise ParameterError(
            "kind", f"{text} wavelengths: lux and cd/m2 need light from 430 to 680 nm"
        )
    lumens = _LUMENS_PER_WATT * float(
        torch.trapezoid(
            efficiency * table.at(observer_table.wavelengths)[0], observer_table.wavelengths
        )
    )
    # without bands (before the run), only the checks above are needed
    if bands is None or bands.centres.is_meta:
        return 0.0
    if not lumens > 0:
        raise ParameterError(
            "kind", f"{_name(kind)} gives no visible light: state sensor.background in place of lux"
        )
    # mean power of a band / lumens of the same light
    return float((table.over(bands)[0] * bands.widths.cpu()).mean()) / lumens


def light_curve(file: Path) -> Curves:
    """Read the spectral power of a light from a CSV file."""
    try:
        return _light_curve(file)
    except (OSError, ValueError) as error:
        raise table_error("kind", _COLUMNS, error) from None


@once_per_version
def _light_curve(file: Path) -> Curves:
    """Read and check the spectral power of a light; raise ValueError for another quantity."""
    table = curves(file, None)
    if len(table.values) != 1:
        raise ValueError(f"{file.name} has {len(table.values) + 1} columns in place of 2")
    heading = table.columns[0].heading
    if re.search(r"photon|mol|%", heading):
        fix = "divide photons by the wavelength, and write a unit of power, such as W/nm or 1"
        raise ValueError(f"{file.name}: {heading} is no spectral power: {fix}")
    if not table.columns[0].unit:
        raise ValueError(
            f"{file.name}: column 2, {heading}, has no unit: write power (W/nm), or power (1) if"
            " relative"
        )
    table.refuse(table.values < 0, lambda value: f"a light cannot have the power {value:g}")
    if not table.values.any():
        raise ValueError(f"{file.name} has no power at any wavelength")
    return table


def _light(kind: str | Path, temperature: float) -> Table:
    """Return the spectral power of a kind of light, or of a file."""
    if isinstance(kind, Path):
        return light_curve(kind).table()
    return daylight(temperature) if kind == "daylight" else light(kind)


def _name(kind: str | Path) -> str:
    return kind.name if isinstance(kind, Path) else kind


def _band_edges(bands: Bands) -> Tensor:
    """Return the lower edges of all bands, then the upper ones, in m."""
    return torch.cat([bands.centres - bands.widths / 2, bands.centres + bands.widths / 2])


@node(bands={"reflectance": -3, "illuminant": 0, "return": -3}, accepts_low_rank=("reflectance",))
def illuminate(
    reflectance: Tensor | LowRankCube,
    illuminant: Tensor,
    *,
    times: Literal["once", "twice"] = "once",
) -> Tensor | LowRankCube:
    """Compute the radiance of a scene: reflectance times illuminant.

    `once` is physical; `twice` multiplies by the square of the illuminant, as the paper prints. In
    a `LowRankCube`, only the basis spectra are multiplied, and the basis images stay unchanged.

    Shapes: reflectance (..., band, y, x), illuminant (band,) -> (..., band, y, x).
    Units:  relative spectral radiance; the radiance of a white scene has mean 1 over the bands.
    Error:  float32: 6e-8.
    Raises: ValueError where reflectance and illuminant differ in the number of bands.
    Source: NeuSee, T_b and the CIE formula after T_b; `twice` is contradiction C5 in the list of
            ambiguous statements of the paper.
    """
    _same_bands(reflectance, illuminant)
    power = illuminant if times == "once" else illuminant.square()
    if isinstance(reflectance, LowRankCube):
        basis = reflectance.basis * power.to(reflectance.basis)[:, None]
        band_power = power.detach().abs().to(reflectance.residual_max)
        rms = (
            reflectance.residual_rms * band_power
            if reflectance.residual_rms.numel()
            else reflectance.residual_rms
        )
        largest = reflectance.residual_map * float(band_power.max())
        return LowRankCube(
            reflectance.planes, basis, reflectance.residual_max * band_power, rms, largest
        )
    reflectance = single(reflectance)
    return reflectance * power.to(reflectance)[:, None, None]


def _same_bands(reflectance: Tensor | LowRankCube, illuminant: Tensor) -> None:
    """Raise ValueError unless reflectance and illuminant have the same bands."""
    if isinstance(reflectance, LowRankCube):
        shape: tuple[int, ...] = (len(reflectance.basis), *reflectance.planes.shape[1:])
    else:
        shape = tuple(reflectance.shape)
    if len(shape) < 3 or illuminant.ndim != 1 or shape[-3] != len(illuminant):
        raise ValueError(
            f"reflectance {shape} and illuminant {tuple(illuminant.shape)} must have the shapes"
            " (band, y, x) and (band,): compute reflectance and illuminant from the same `bands`"
            " step"
        )


@illuminate.reference
def _(
    reflectance: Tensor | LowRankCube, illuminant: Tensor, *, times: str = "once"
) -> Tensor | LowRankCube:
    power = [float(p) ** (1 if times == "once" else 2) for p in illuminant]
    if isinstance(reflectance, LowRankCube):
        basis = torch.stack(
            [row.double() * p for row, p in zip(reflectance.basis, power, strict=True)]
        )
        residual = torch.stack(
            [column * p for column, p in zip(reflectance.residual_max.T, power, strict=True)], 1
        )
        columns = [column * p for column, p in zip(reflectance.residual_rms.T, power, strict=False)]
        rms = torch.stack(columns, 1) if columns else residual[:0, :0]
        largest = reflectance.residual_map.double() * max(power)
        return LowRankCube(reflectance.planes.double(), basis, residual, rms, largest)
    return torch.stack([reflectance[..., b, :, :].double() * p for b, p in enumerate(power)], -3)


@illuminate.preflight
def _(*, times: str = "once") -> list[str]:
    return (
        ["the illuminant is applied twice, as the paper prints: its spectrum is squared"]
        if times == "twice"
        else []
    )


@illuminate.check
def _(result: Tensor | LowRankCube, *inputs: Any, **params: Any) -> list[Check]:
    if isinstance(result, LowRankCube):
        return [Check(f"{len(result.planes)} basis images for {len(result.basis)} bands")]
    low = float(result.min())
    return [Check(f"scene radiance from {low:.3g} to {float(result.max()):.4g}", low >= 0)]
