"""Spectral responses of the channels of a sensor, and weights of the bands in them."""

import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.constants import ELEMENTARY_CHARGE, PLANCK, SPEED_OF_LIGHT
from neusee.nodes.input_files import once_per_version
from neusee.nodes.spectra._cie_tables import Table, measured_camera, observer
from neusee.nodes.spectra._table_files import Curves, curves, table_error
from neusee.nodes.units import DataFile, Efficiency
from neusee.nodes.values import Bands

# --- channel responses ----------------------------------------------------------------------------

# Spectral responses of the colour channels of a sensor.


Camera = Literal["CIE 1931", "Nikon 5100", "Sigma SDMerill"]
#: a band is unseen if every channel has less than this share of the largest sensitivity
_UNSEEN_SHARE = 1e-3
#: nm, range in which some channel exceeds `_UNSEEN_SHARE`, with a margin; constants, so that the
#: tables need not be read
_SEEN_RANGE: dict[str, tuple[float, float]] = {
    "CIE 1931": (375.0, 720.0),
    "Nikon 5100": (405.0, 690.0),
    "Sigma SDMerill": (405.0, 675.0),
}
_COLUMNS = (
    "write a header, then wavelength in nm, red, green and blue, separated by commas, or one column"
    " for a mono camera"
)
#: V m; responsivity (A/W) = QE x wavelength (m) / this constant
_ELECTRON_VOLT_METRES = PLANCK * SPEED_OF_LIGHT / ELEMENTARY_CHARGE


@node(rtol=1e-9)
def responses(
    bands: Bands,
    *,
    camera: Camera | DataFile = "CIE 1931",
    quantum_efficiency: Efficiency | None = None,
) -> Tensor:
    """Average the sensitivity of each colour channel over each band, for the CIE observer or a
    measured camera.

    ``camera`` is one of three names, or a CSV file of your own camera: a header such as
    ``wavelength (nm),QE (%)``, then the wavelength and either the sensitivity of one channel (a
    mono camera) or of red, green and blue. A column is a quantum efficiency (QE, in 1 or %), a
    responsivity in A/W, or a relative sensitivity in any unit common to the channels. A header
    without units means nm and relative sensitivities.

    An absolute table, of a quantum efficiency or a responsivity, is relative to
    ``quantum_efficiency`` if that is given, so that a sensor that multiplies by
    ``quantum_efficiency`` later has the electrons of the table.

    Shapes: -> (channel, band) float64, with 3 channels or 1.
    Units:  relative to the largest sensitivity of any channel at any wavelength, or, of an absolute
            table, to ``quantum_efficiency``; no response is negative.
    Error:  linear interpolation between the samples of the table (1, 5 and 10 nm); 0 beyond the
            table, whose ends are below 6e-3 of the peak (CIE 360-830 nm, Nikon 380-780 nm, Sigma
            400-680 nm; except that the blue of Sigma is still 0.16 at 400 nm).
    Raises: ParameterError before the run for a file without two or four columns of finite numbers,
            wavelengths in rising order, a channel without sensitivity, sensitivities below -1 % of
            the largest, or a QE above 1.
    Source: CIE 1931 2 degree observer; NPL measurements of the Nikon 5100 and Sigma SD Merrill in
            colour-science.
    """
    table = _table(camera)
    largest = table.values.max()
    if quantum_efficiency is not None and isinstance(camera, Path) and camera_curves(camera)[1]:
        largest = largest.new_tensor(quantum_efficiency)
    return (table.over(bands) / largest).clamp_min(0).to(bands.centres.device)


@responses.unused
def _(params: Mapping[str, Any]) -> Collection[str]:
    # only a table of the user may be absolute
    return () if isinstance(params["camera"], Path) else ("quantum_efficiency",)


@responses.preflight
def _(
    *,
    bands: Bands | None = None,
    camera: Camera | Path = "CIE 1931",
    quantum_efficiency: float | None = None,
) -> list[str]:
    shortest_nm, longest_nm = seen_range(camera)
    notes = _peak_note(camera, quantum_efficiency) if isinstance(camera, Path) else []
    if bands is None or bands.centres.is_meta:
        return notes
    centres = bands.centres * 1e9
    if shortest_nm <= float(centres.min()) and float(centres.max()) <= longest_nm:
        return notes  # the usual case: no import of colour-science, which takes a second
    strongest = responses(bands, camera=camera).amax(0)
    unseen = centres[strongest < _UNSEEN_SHARE]
    if not len(unseen):
        return notes
    range_nm = f"{float(unseen.min()):.5g} nm" + (
        f" to {float(unseen.max()):.5g} nm" if len(unseen) > 1 else ""
    )
    largest = float(strongest[strongest < _UNSEEN_SHARE].max())
    return [
        *notes,
        (
            f"no channel of {_name(camera)} sees {len(unseen)} of {len(centres)} bands, {range_nm}:"
            f" the largest relative response is {largest:.2g}, below {_UNSEEN_SHARE:g}, so their"
            f" light is missing from the picture; choose {shortest_nm:g} to {longest_nm:g} nm"
        ),
    ]


@responses.check
def _(
    result: Tensor, bands: Bands, *, camera: Camera | Path = "CIE 1931", **params: object
) -> list[Check]:
    peaks = [float(bands.centres[int(row.argmax())]) * 1e9 for row in result]
    all_respond = bool((result.amax(1) > 0).all())
    text = (
        f"{_name(camera)}: peak{'s' * (len(peaks) > 1)} at"
        f" {', '.join(f'{peak:.4g}' for peak in peaks)} nm"
    )
    return [Check(text, all_respond or len(bands.centres) < 10)]


def channel_count(camera: str | Path) -> int:
    """Return the number of colour channels of a camera."""
    return len(_from_file(camera).values) if isinstance(camera, Path) else 3


def camera_curves(file: Path) -> tuple[Curves, bool]:
    """Read the curves of a camera from a CSV file; return them, and True if they are absolute
    quantum efficiencies.

    A quantum efficiency in percent and a responsivity in A/W become fractions.
    """
    try:
        return _camera_curves(file)
    except (OSError, ValueError) as error:
        raise table_error("camera", _COLUMNS, error) from None


def _camera_curves(file: Path) -> tuple[Curves, bool]:
    """Read and check the curves of a camera; return them, and True if they are absolute quantum
    efficiencies.

    Raises ValueError for a wrong table. Responsivities in A/W become quantum efficiencies.
    """
    table = curves(file, None, assumed="nm")
    if len(table.values) not in (1, 3):
        column_text = f"{len(table.values) + 1} columns in place of 4"
        raise ValueError(
            f"{file.name}: the file has {column_text} for red, green and blue, or 2 for one channel"
        )
    unit = _only_unit(table)
    absolute = unit == "A/W" or any(_is_efficiency(column.quantity) for column in table.columns)
    _refuse_no_sensitivity(table)
    if absolute and unit not in ("1", "%", "A/W"):
        raise ValueError(
            f"{file.name}: {table.columns[0].heading} needs the unit (1), (%) or (A/W)"
        )
    factor = 0.01 if unit == "%" else 1
    # QE = responsivity x h c / (e wavelength)
    shares = table.values * (_ELECTRON_VOLT_METRES / table.wavelengths if unit == "A/W" else factor)
    if absolute:
        table.refuse(shares > 1, lambda value: _above_one(value, unit))
    return table._replace(values=shares), absolute


def _only_unit(table: Curves) -> str:
    """Return the unit of all channels; raise ValueError if they have several."""
    units = {column.unit for column in table.columns}
    if len(units) > 1:
        raise ValueError(
            f"{table.file.name}: the channels have the units {', '.join(sorted(units))}: give all"
            " the same unit"
        )
    return units.pop()


def _refuse_no_sensitivity(table: Curves) -> None:
    """Raise ValueError for a channel without sensitivity, or with a negative one."""
    is_blind = table.values.max(1) <= 0
    if is_blind.any():
        name = table.columns[int(is_blind.argmax())].heading
        raise ValueError(
            f"{table.file.name}: a channel has no sensitivity at any wavelength, {name}"
        )
    lowest = table.values.min()
    if lowest < -0.01 * table.values.max():
        table.refuse(table.values == lowest, _negative)


def _is_efficiency(quantity: str) -> bool:
    return re.search(r"quantum efficiency|(?<![a-z])qe(?![a-z])", quantity.lower()) is not None


def _negative(value: float) -> str:
    return f"a sensitivity is {value:.3g}, but no channel gives electrons back"


def _above_one(value: float, unit: str) -> str:
    fix = "write QE (%) for percent" if unit == "1" else "check the numbers and the unit"
    return f"{value:g} {unit} is more than one electron for each photon: {fix}"


def _peak_note(file: Path, quantum_efficiency: float | None) -> list[str]:
    """Return a note on the largest QE of a file, and on the QE that counts for electrons.

    With a quantum efficiency of the sensor, the QE of the table counts. Without it, the responses
    are relative to the largest QE.
    """
    table, absolute = camera_curves(file)
    if not absolute:
        return []
    largest = table.values.max()
    peak_nm = table.wavelengths[table.values.max(0).argmax()] * 1e9
    peak_text = f"{file.name}: the largest QE is {largest:.4g}, at {peak_nm:g} nm"
    if quantum_efficiency is not None:
        setting = f"sensor.quantum_efficiency={quantum_efficiency:.4g}"
        is_same = abs(quantum_efficiency / largest - 1) < 1e-3
        return (
            [f"{peak_text}, as {setting}"]
            if is_same
            else [f"{peak_text}, and the QE of the table counts for electrons, not {setting}"]
        )
    return [
        f"{peak_text}, and responses are relative to it: electrons are right with"
        f" sensor.quantum_efficiency={largest:.4g}"
    ]


def _name(camera: str | Path) -> str:
    return camera.name if isinstance(camera, Path) else camera


def _table(camera: str | Path) -> Table:
    if isinstance(camera, Path):
        return _from_file(camera)
    return observer() if camera == "CIE 1931" else measured_camera(camera)


def seen_range(camera: str | Path) -> tuple[float, float]:
    """Return the wavelengths in nm between which some channel sees more than a thousandth of the
    largest value.
    """
    if not isinstance(camera, Path):
        return _SEEN_RANGE[camera]
    table = _from_file(camera)
    sensitive = table.wavelengths[table.values.amax(0) >= _UNSEEN_SHARE * table.values.max()] * 1e9
    return float(sensitive[0]), float(sensitive[-1])


@once_per_version
def _from_file(file: Path) -> Table:
    return camera_curves(file)[0].table()


# --- distinct band sums ---------------------------------------------------------------------------

# Weights of the spectral bands in each colour channel, and in the electrons that fill a pixel.


@node(rtol=1e-12)
def rows(bands: Bands, responses: Tensor, *, well: bool = True) -> Tensor:
    """Return the weight of each spectral band in each colour channel, and in the electrons that
    fill a pixel.

    The first rows are for the colour channels. The last row is for the electrons that fill the
    well. A channel counts photons, so that the weights are response times wavelength. The weights
    of the last row are the wavelengths alone, because a photon of any wavelength frees one
    electron. With `well` false, the last row is omitted.

    Shapes: bands (band,), responses (channel, band) -> (channel + 1, band) float64, or (channel,
            band).
    Units:  m; the node that counts photons applies the common factor.
    Error:  exact.
    Raises: ValueError where responses and bands differ in the number of bands.
    Source: NeuSee, Eq. (photon_count) and Eq. (ThresSat).
    """
    if responses.ndim != 2 or responses.shape[1] != len(bands.centres):
        raise ValueError(
            f"responses have shape {tuple(responses.shape)}, not (channel, band) with"
            f" {len(bands.centres)} bands: compute responses and bands from the same `bands` step"
        )
    centres = bands.centres.double().to(responses.device)
    channels = responses.double() * centres
    return torch.cat([channels, centres[None]]) if well else channels


@rows.check
def _(result: Tensor, *inputs: object, **params: object) -> list[Check]:
    rank = int(
        torch.linalg.matrix_rank(result / result.abs().amax(1, keepdim=True).clamp_min(1e-300))
    )
    return [
        Check(
            f"{len(result)} weighted sums over {result.shape[1]} bands; the matrix of weights has"
            f" rank {rank}"
        )
    ]
