"""Spectral responses of the colour channels of a sensor."""

import re
from pathlib import Path
from typing import Literal

from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.constants import ELEMENTARY_CHARGE, PLANCK, SPEED_OF_LIGHT
from neusee.nodes.input_files import once_per_version
from neusee.nodes.spectra._spectral_tables import Table, measured_camera, observer
from neusee.nodes.spectra._table_files import Curves, curves, refused
from neusee.nodes.units import DataFile, Efficiency
from neusee.nodes.values import Bands

Camera = Literal["CIE 1931", "Nikon 5100", "Sigma SDMerill"]
_UNSEEN = 1e-3  #: of the largest sensitivity; a band that every channel sees less counts as unseen
#: nm, ends of the range in which some channel has more than `_UNSEEN`, with a margin; found without the table
_SEEN: dict[str, tuple[float, float]] = {
    "CIE 1931": (375.0, 720.0),
    "Nikon 5100": (405.0, 690.0),
    "Sigma SDMerill": (405.0, 675.0),
}
_COLUMNS = (
    "write a header, then wavelength in nm, red, green and blue, separated by commas, or one column for a mono camera"
)
_ELECTRON_VOLT_METRES = PLANCK * SPEED_OF_LIGHT / ELEMENTARY_CHARGE  #: V m; responsivity in A/W is QE times m over this


@node(rtol=1e-9)
def responses(
    bands: Bands, *, camera: Camera | DataFile = "CIE 1931", quantum_efficiency: Efficiency | None = None
) -> Tensor:
    """Average the sensitivity of each colour channel over each band, for the CIE observer or a measured camera.

    ``camera`` is one of three names, or a CSV file of your own camera: a header such as ``wavelength (nm),QE (%)``,
    then the wavelength and either the sensitivity of one channel (a mono camera) or of red, green and blue. A column
    is a quantum efficiency (QE, in 1 or %), a responsivity in A/W, or a relative sensitivity in any unit common to the
    channels. A header without units means nm and relative sensitivities.

    An absolute table, of a quantum efficiency or a responsivity, is relative to ``quantum_efficiency`` if that is
    given, so that a sensor that multiplies by ``quantum_efficiency`` later has the electrons of the table.

    Shapes: -> (channel, band) float64, with 3 channels or 1.
    Units:  relative to the largest sensitivity of any channel at any wavelength, or, of an absolute table, to
            ``quantum_efficiency``; no response is negative.
    Error:  linear interpolation between the samples of the table (1, 5 and 10 nm); 0 beyond the table, whose ends are
            below 6e-3 of the peak (CIE 360-830 nm, Nikon 380-780 nm, Sigma 400-680 nm; except that the blue of Sigma
            is still 0.16 at 400 nm).
    Raises: ParameterError before the run for a file without two or four columns of finite numbers, wavelengths in
            rising order, a channel without sensitivity, sensitivities below -1 % of the largest, or a QE above 1.
    Source: CIE 1931 2 degree observer; NPL measurements of the Nikon 5100 and Sigma SD Merrill in colour-science.
    """
    table = _table(camera)
    largest = table.values.max()
    if quantum_efficiency is not None and isinstance(camera, Path) and camera_curves(camera)[1]:
        largest = largest.new_tensor(quantum_efficiency)
    return (table.over(bands) / largest).clamp_min(0).to(bands.centres.device)


@responses.preflight
def _(
    *, bands: Bands | None = None, camera: Camera | Path = "CIE 1931", quantum_efficiency: float | None = None
) -> list[str]:
    low, high = seen_range(camera)
    notes = _peak_note(camera, quantum_efficiency) if isinstance(camera, Path) else []
    if bands is None or bands.centres.is_meta:
        return notes
    centres = bands.centres * 1e9
    if low <= float(centres.min()) and float(centres.max()) <= high:
        return notes  # most recipes: colour-science, whose import takes a second, is not needed
    most = responses(bands, camera=camera).amax(0)
    unseen = centres[most < _UNSEEN]
    if not len(unseen):
        return notes
    which = f"{float(unseen.min()):.5g} nm" + (f" to {float(unseen.max()):.5g} nm" if len(unseen) > 1 else "")
    largest = float(most[most < _UNSEEN].max())
    return [
        *notes,
        f"no channel of {_name(camera)} sees {len(unseen)} of {len(centres)} bands, {which}: the largest relative "
        f"response is {largest:.2g}, below {_UNSEEN:g}, so their light is missing from the picture; choose "
        f"{low:g} to {high:g} nm",
    ]


@responses.check
def _(result: Tensor, bands: Bands, *, camera: Camera | Path = "CIE 1931", **params: object) -> list[Check]:
    peaks = [float(bands.centres[int(row.argmax())]) * 1e9 for row in result]
    lit = bool((result.amax(1) > 0).all())
    text = f"{_name(camera)}: peak{'s' * (len(peaks) > 1)} at {', '.join(f'{peak:.4g}' for peak in peaks)} nm"
    return [Check(text, lit or len(bands.centres) < 10)]


def channel_count(camera: str | Path) -> int:
    """Return the number of colour channels of a camera."""
    return len(_from_file(camera).values) if isinstance(camera, Path) else 3


def camera_curves(file: Path) -> tuple[Curves, bool]:
    """Read the curves of a camera from a CSV file; return them, and True if they are absolute quantum efficiencies.

    A quantum efficiency in percent and a responsivity in A/W become fractions.
    """
    try:
        return _camera_curves(file)
    except (OSError, ValueError) as error:
        raise refused("camera", _COLUMNS, error) from None


def _camera_curves(file: Path) -> tuple[Curves, bool]:
    found = curves(file, None, assumed="nm")
    if len(found.values) not in (1, 3):
        count = f"{len(found.values) + 1} columns in place of 4"
        raise ValueError(f"{file.name}: the file has {count} for red, green and blue, or 2 for one channel")
    units = {column.unit for column in found.columns}
    if len(units) > 1:
        raise ValueError(f"{file.name}: the channels have the units {', '.join(sorted(units))}: give all the same unit")
    (unit,) = units
    absolute = unit == "A/W" or any(_is_efficiency(column.quantity) for column in found.columns)
    dark = found.values.max(1) <= 0
    if dark.any():
        name = found.columns[int(dark.argmax())].heading
        raise ValueError(f"{file.name}: a channel has no sensitivity at any wavelength, {name}")
    least = found.values.min()
    if least < -0.01 * found.values.max():
        found.refuse(found.values == least, _negative)
    if absolute and unit not in ("1", "%", "A/W"):
        raise ValueError(f"{file.name}: {found.columns[0].heading} needs the unit (1), (%) or (A/W)")
    shares = found.values * (_ELECTRON_VOLT_METRES / found.wavelengths if unit == "A/W" else 0.01 if unit == "%" else 1)
    if absolute:
        found.refuse(shares > 1, lambda value: _above_one(value, unit))
    return found._replace(values=shares), absolute


def _is_efficiency(quantity: str) -> bool:
    return re.search(r"quantum efficiency|(?<![a-z])qe(?![a-z])", quantity.lower()) is not None


def _negative(value: float) -> str:
    return f"a sensitivity is {value:.3g}, but no channel gives electrons back"


def _above_one(value: float, unit: str) -> str:
    fix = "write QE (%) for percent" if unit == "1" else "check the numbers and the unit"
    return f"{value:g} {unit} is more than one electron for each photon: {fix}"


def _peak_note(file: Path, quantum_efficiency: float | None) -> list[str]:
    """Return a note on the largest QE of a file: responses are relative to it, or the QE of the sensor does not count.

    Without a quantum efficiency of the sensor, responses are relative.
    """
    found, absolute = camera_curves(file)
    if not absolute:
        return []
    largest = found.values.max()
    at = found.wavelengths[found.values.max(0).argmax()] * 1e9
    peak = f"{file.name}: the largest QE is {largest:.4g}, at {at:g} nm"
    if quantum_efficiency is not None:
        told = f"sensor.quantum_efficiency={quantum_efficiency:.4g}"
        same = abs(quantum_efficiency / largest - 1) < 1e-3
        return [f"{peak}, as {told}"] if same else [f"{peak}, and the QE of the table counts for electrons, not {told}"]
    return [
        f"{peak}, and responses are relative to it: electrons are right with sensor.quantum_efficiency={largest:.4g}"
    ]


def _name(camera: str | Path) -> str:
    return camera.name if isinstance(camera, Path) else camera


def _table(camera: str | Path) -> Table:
    if isinstance(camera, Path):
        return _from_file(camera)
    return observer() if camera == "CIE 1931" else measured_camera(camera)


def seen_range(camera: str | Path) -> tuple[float, float]:
    """Return the wavelengths in nm between which some channel sees more than a thousandth of the largest value."""
    if not isinstance(camera, Path):
        return _SEEN[camera]
    table = _from_file(camera)
    seen = table.wavelengths[table.values.amax(0) >= _UNSEEN * table.values.max()] * 1e9
    return float(seen[0]), float(seen[-1])


@once_per_version
def _from_file(file: Path) -> Table:
    return camera_curves(file)[0].table()
