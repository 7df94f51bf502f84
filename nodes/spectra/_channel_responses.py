"""Spectral responses of the colour channels of a sensor."""

from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.input_files import once_per_version
from neusee.nodes.spectra._spectral_tables import Table, measured_camera, observer
from neusee.nodes.spectra._spectrum_tables import csv_spectra, wrong_wavelengths
from neusee.nodes.units import DataFile
from neusee.nodes.values import Bands

Camera = Literal["CIE 1931", "Nikon 5100", "Sigma SDMerill"]
_UNSEEN = 1e-3  #: of the largest sensitivity; a band that every channel sees less counts as unseen
#: nm, ends of the range in which some channel has more than `_UNSEEN`, with a margin; found without the table
_SEEN: dict[str, tuple[float, float]] = {
    "CIE 1931": (375.0, 720.0),
    "Nikon 5100": (405.0, 690.0),
    "Sigma SDMerill": (405.0, 675.0),
}
_COLUMNS = "write a header, then wavelength in nm, red, green and blue, separated by commas"


@node(rtol=1e-9)
def responses(bands: Bands, *, camera: Camera | DataFile = "CIE 1931") -> Tensor:
    """Average the sensitivity of each colour channel over each band, for the CIE observer or a measured camera.

    ``camera`` is one of three names, or a CSV file of your own camera: a header, then four columns with the wavelength
    in nm and the relative sensitivity of red, green and blue, in any unit common to the three.

    Shapes: -> (3, band) float64.
    Units:  relative to the largest sensitivity of any channel at any wavelength; no response is negative.
    Error:  linear interpolation between the samples of the table (1, 5 and 10 nm); 0 beyond the table, whose ends are
            below 6e-3 of the peak (CIE 360-830 nm, Nikon 380-780 nm, Sigma 400-680 nm; except that the blue of Sigma
            is still 0.16 at 400 nm).
    Raises: ParameterError before the run for a file without four columns of finite numbers, wavelengths in rising
            order, a channel without sensitivity, or sensitivities below -1 % of the largest.
    Source: CIE 1931 2 degree observer; NPL measurements of the Nikon 5100 and Sigma SD Merrill in colour-science.
    """
    table = _table(camera)
    return (table.over(bands) / table.values.max()).clamp_min(0).to(bands.centres.device)


@responses.preflight
def _(*, bands: Bands | None = None, camera: Camera | Path = "CIE 1931") -> list[str]:
    low, high = _seen(camera)
    if bands is None or bands.centres.is_meta:
        return []
    centres = bands.centres * 1e9
    if low <= float(centres.min()) and float(centres.max()) <= high:
        return []  # most recipes: colour-science, whose import takes a second, is not needed
    most = responses(bands, camera=camera).amax(0)
    unseen = centres[most < _UNSEEN]
    if not len(unseen):
        return []
    which = f"{float(unseen.min()):.5g} nm" + (f" to {float(unseen.max()):.5g} nm" if len(unseen) > 1 else "")
    largest = float(most[most < _UNSEEN].max())
    return [
        f"no channel of {_name(camera)} sees {len(unseen)} of {len(centres)} bands, {which}: the largest relative "
        f"response is {largest:.2g}, below {_UNSEEN:g}, so their light is missing from the picture; choose "
        f"{low:g} to {high:g} nm"
    ]


@responses.check
def _(result: Tensor, bands: Bands, *, camera: Camera | Path = "CIE 1931") -> list[Check]:
    peaks = [float(bands.centres[int(row.argmax())]) * 1e9 for row in result]
    lit = bool((result.amax(1) > 0).all())
    text = f"{_name(camera)}: peaks at {peaks[0]:.4g}, {peaks[1]:.4g}, {peaks[2]:.4g} nm"
    return [Check(text, lit or len(bands.centres) < 10)]


def _name(camera: str | Path) -> str:
    return camera.name if isinstance(camera, Path) else camera


def _table(camera: str | Path) -> Table:
    if isinstance(camera, Path):
        return _from_file(camera)
    return observer() if camera == "CIE 1931" else measured_camera(camera)


def _seen(camera: str | Path) -> tuple[float, float]:
    """Return the wavelengths in nm between which some channel sees more than a thousandth of the largest value."""
    if not isinstance(camera, Path):
        return _SEEN[camera]
    table = _from_file(camera)
    seen = table.wavelengths[table.values.amax(0) >= _UNSEEN * table.values.max()] * 1e9
    return float(seen[0]), float(seen[-1])


@once_per_version
def _from_file(file: Path) -> Table:
    try:
        wavelengths, values = csv_spectra(file)
    except (OSError, ValueError) as error:
        raise ParameterError("camera", f"{file.name} holds no sensitivities ({error}): {_COLUMNS}") from None
    wrong = f"the file has {len(values) + 1} columns in place of 4" if len(values) != 3 else ""
    wrong = wrong or wrong_wavelengths(wavelengths, values)
    if not wrong and not (values.max(1) > 0).all():
        wrong = "a channel has no sensitivity at any wavelength"
    if not wrong and values.min() < -0.01 * values.max():
        wrong = f"a sensitivity is {values.min():.3g}, but no channel gives electrons back"
    if wrong:
        raise ParameterError("camera", f"{file.name}: {wrong}: {_COLUMNS}")
    return Table(torch.from_numpy(wavelengths) * 1e-9, torch.from_numpy(values.copy()))
