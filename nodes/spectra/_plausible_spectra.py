"""Plausible reflectance spectra: measured ones, mixtures of them, and metamers (other spectra of
the same colour).
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.file_headers import mat_needs, npz_needs
from neusee.nodes.input_files import csv_rows, once_per_version
from neusee.nodes.spectra._cie_tables import Table, gamut_samples, paints, require_range, to_srgb
from neusee.nodes.spectra._lift import inside_charts, lift_matrix
from neusee.nodes.units import Count, DataFiles
from neusee.nodes.values import Bands

_DARKEST_LAYER = 1e-6  #: smallest reflectance to which the thickness of a layer is applied

Thickness = Annotated[float, Field(gt=0, le=10)]
Strength = Annotated[float, Field(ge=0, le=10)]


@node(rtol=1e-9)
def metamers(
    reflectances: Tensor,
    bands: Bands,
    *,
    count: Count = 48,
    mixed: Count = 3,
    thickness: tuple[Thickness, Thickness] = (0.5, 2.0),
    blacks: Strength = 0.5,
    rng: torch.Generator,
) -> Tensor:
    """Generate random reflectance spectra: mixtures of measured spectra, each with a metameric
    black added.

    A layer of thickness p turns a reflectance s into s^p (Beer and Lambert), which makes colours
    paler or deeper than measured. A metameric black is a measured spectrum minus the linear
    estimate from its colour: a black changes the spectrum and not the colour. The strength of a
    black is normal with standard deviation `blacks`, where 1 is the strength in measured spectra of
    the same brightness. The strength is limited where the sum would leave [0, 1]. The mixtures do
    not depend on `blacks`.

    Shapes: reflectances (spectrum, band) -> (count, band) float64.
    Units:  reflectance.
    Error:  float64: a black moves the colour under D65 by less than 1e-12 of white.
    Raises: ParameterError before the run unless the thinnest layer comes first; ValueError where
            reflectances and bands differ in the number of bands, and for fewer than four spectra.
    Source: metameric blacks: Wyszecki (1953), Cohen and Kappauf, Am. J. Psychol. 95, 537 (1982);
            here oblique to the colours, along the covariance of the measured spectra.
    """
    if (
        reflectances.ndim != 2
        or reflectances.shape[1] != len(bands.centres)
        or len(reflectances) < 4
    ):
        raise ValueError(
            f"reflectances have shape {tuple(reflectances.shape)}, but at least four spectra of"
            f" {len(bands.centres)} bands are needed: compute reflectances and bands from the same"
            " `bands` step"
        )
    measured = reflectances.double()
    mixture = _mixtures(measured, count, mixed, thickness, rng)
    black = metameric_blacks(
        measured[_random_indices(len(measured), (count,), rng)]
        - measured[_random_indices(len(measured), (count,), rng)],
        measured,
        bands,
    )
    normal = torch.randn(count, 1, generator=rng, device=rng.device, dtype=torch.float64)
    # proportional to the brightness of each mixture
    share = blacks * normal * mixture.mean(1, keepdim=True) / measured.mean()
    least_share, greatest_share = _factor_limits(mixture, black)
    return (mixture + share.maximum(least_share).minimum(greatest_share) * black).clamp(0.0, 1.0)


@metamers.preflight
def _(*, thickness: tuple[float, float] = (0.5, 2.0), **params: Any) -> list[str]:
    if thickness[0] > thickness[1]:
        raise ParameterError(
            "thickness",
            f"the first thickness {thickness[0]:g} exceeds the second {thickness[1]:g}: exchange"
            " the two numbers",
        )
    return []


@metamers.check
def _(result: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [
        Check(
            f"{len(result)} random spectra, reflectance {low:.3g} to {high:.3g}",
            0 <= low <= high <= 1,
        )
    ]


def metameric_blacks(spectra: Tensor, measured: Tensor, bands: Bands) -> Tensor:
    """Return the part of each spectrum that does not contribute to the colour, called metameric
    black.

    A metameric black is a spectrum minus the linear estimate from its colour. Shapes: (spectrum,
    band) both.
    """
    centres = bands.centres.detach().cpu().double()
    estimate = lift_matrix(measured.cpu(), centres) @ to_srgb(centres)
    return spectra - spectra @ estimate.T.to(spectra)


def _mixtures(
    measured: Tensor, count: int, mixed: int, thickness: tuple[float, float], rng: torch.Generator
) -> Tensor:
    """Return random mixtures of measured spectra, each with a random layer thickness (Beer-Lambert
    law).

    The thickness is log-uniform. One spectrum dominates most mixtures.
    """
    options = {"generator": rng, "device": rng.device, "dtype": torch.float64}
    weights = -torch.rand(count, mixed, **options).clamp_min(1e-12).log()  # type: ignore[call-overload]
    # squares of exponential random numbers differ widely, so that one dominates
    weights = weights.square()
    weights = weights / weights.sum(1, keepdim=True)
    mixtures = (
        weights[..., None] * measured[_random_indices(len(measured), (count, mixed), rng)]
    ).sum(1)
    uniform: Tensor = torch.rand(count, 1, **options)  # type: ignore[call-overload]
    layer_thickness: Tensor = thickness[0] * (thickness[1] / thickness[0]) ** uniform
    # Beer-Lambert law: transmittance of a layer to the power of its thickness
    layers: Tensor = mixtures.clamp(_DARKEST_LAYER, 1.0) ** layer_thickness
    return layers


def _random_indices(of: int, shape: tuple[int, ...], rng: torch.Generator) -> Tensor:
    """Return random indices below ``of``."""
    return torch.randint(of, shape, generator=rng, device=rng.device)


def _factor_limits(base: Tensor, black: Tensor) -> tuple[Tensor, Tensor]:
    """Return the smallest and the largest factor that keep each spectrum ``base + factor *
    black`` in [0, 1].
    """
    factor_to_white, factor_to_dark = (1.0 - base) / black, -base / black
    greatest_by_band = torch.where(
        black > 0, factor_to_white, torch.where(black < 0, factor_to_dark, torch.inf)
    )
    least_by_band = torch.where(
        black > 0, factor_to_dark, torch.where(black < 0, factor_to_white, -torch.inf)
    )
    return least_by_band.amax(1, keepdim=True), greatest_by_band.amin(1, keepdim=True)


# --- spectrum tables ------------------------------------------------------------------------------

# CSV files of spectra: a header, wavelengths in nm in the first column, and one further column for
# each spectrum.


Numbers = NDArray[np.float64]


def csv_spectra(file: Path) -> tuple[Numbers, Numbers]:
    """Read the wavelengths of a CSV file, in nm, and its spectra (spectrum, wavelength).

    Raises ValueError for lines of different length, for a cell that is not a number, and for a file
    without columns.
    """
    rows = [[_number(cell, file, line) for cell in row] for line, row in list(csv_rows(file))[1:]]
    if len({len(row) for row in rows}) > 1:
        raise ValueError("the lines have different numbers of cells")
    numbers = np.array(rows, np.float64)
    if numbers.ndim != 2 or numbers.shape[1] < 2:
        raise ValueError("the file has no columns of numbers below a header")
    return numbers[:, 0].copy(), numbers[:, 1:].T


def wavelength_problem(wavelengths: Numbers, values: Numbers) -> str:
    """Return the reason why numbers from a file cannot be wavelengths in nm and their spectra,
    or an empty text.
    """
    if not (np.isfinite(wavelengths).all() and np.isfinite(values).all()):
        return "some of its numbers are NaN or infinite"
    if len(wavelengths) < 2 or not (np.diff(wavelengths) > 0).all() or wavelengths[0] < 100:
        return "the file needs at least two wavelengths in nm, in rising order"
    return ""


def _number(cell: str, file: Path, line: int) -> float:
    """Return the number in a cell; raise ValueError with file and line for another text."""
    try:
        return float(cell)
    except ValueError:
        raise ValueError(f"{file.name}:{line}: {cell!r} is not a number") from None


# --- measured reflectances ------------------------------------------------------------------------

# Measured reflectances from colour-science and from the user's files.


MeasuredSet = Literal["charts", "CIE 2017", "CQS"]
_LARGEST_REFLECTANCE = 1.5  #: largest reflectance; a file with larger values is probably in percent
_FILE_FORMS = (
    "give .csv (first column wavelength in nm), .npz (wavelengths, reflectances) or .mat (S_name,"
    " sur_name)"
)


@node(rtol=1e-12)
def reflectances(
    bands: Bands,
    *,
    sets: tuple[MeasuredSet, ...] = ("charts", "CIE 2017", "CQS"),
    files: DataFiles | None = None,
) -> Tensor:
    """Return measured reflectances from colour-science and from the user's files, one spectrum in
    each row.

    `charts` are the 102 patches of `spectra.lift_lmmse`, `CIE 2017` the 99 objects of the colour
    fidelity index, `CQS` 15 saturated paints. A file is .csv (a header; first column nm, then one
    column for each spectrum), .npz (`wavelengths` in nm and `reflectances`, (spectrum,
    wavelength)), or a .mat of the Psychtoolbox (`S_name`: start, step, count; `sur_name`).

    Shapes: -> (spectrum, band) float64.
    Units:  reflectance, 1 = white; values outside [0, 1] are clipped.
    Error:  linear interpolation between the samples: some 1e-3 for paints at 10 nm.
    Raises: ParameterError before the run for a file that holds no reflectances; ValueError where
            bands leave 380 to 780 nm, or the range of a file.
    Source: charts and NIST CQS 9.0 (Davis and Ohno 2010) by colour-science; CIE 224:2017.
    """
    if sets:
        inside_charts(bands)
    tables: list[Table] = []
    for name in sets:
        tables += _MEASURED_SETS[name]()
    for file in files or ():
        tables.append(_spectra_of_file(file))
        fix = "leave the file out, or choose bands inside that range"
        require_range(bands.centres, tables[-1].wavelengths, f"{file.name} holds", fix)
    return (
        torch.cat([table.at(bands.centres) for table in tables])
        .clamp(0.0, 1.0)
        .to(bands.centres.device)
    )


@reflectances.preflight
def _(
    *, sets: tuple[MeasuredSet, ...] = ("charts",), files: tuple[Path, ...] | None = None
) -> list[str]:
    if not sets and not files:
        raise ParameterError(
            "files", f"the parameters sets and files are both empty: {_FILE_FORMS}"
        )
    for file in files or ():
        _spectra_of_file(file)
    return []


@reflectances.check
def _(result: Tensor, bands: Bands, **params: Any) -> list[Check]:
    return [
        Check(
            f"{len(result)} spectra, reflectance {float(result.min()):.3g} to"
            f" {float(result.max()):.3g}",
            len(result) > 3,
        )
    ]


_MEASURED_SETS: dict[str, Callable[[], tuple[Table, ...]]] = {
    "charts": paints,
    "CIE 2017": lambda: (gamut_samples("CIE 2017"),),
    "CQS": lambda: (gamut_samples("CQS"),),
}


# --- files ----------------------------------------------------------------------------------------


@once_per_version
def _spectra_of_file(file: Path) -> Table:
    """Read the spectra of a file, or return them from memory while the file is unchanged."""
    reader = {".csv": csv_spectra, ".npz": _npz_spectra, ".mat": _mat_spectra}.get(
        file.suffix.lower()
    )
    if reader is None:
        raise ParameterError("files", f"{file.name} holds no reflectances: {_FILE_FORMS}")
    try:
        wavelengths, values = reader(file)
    except ParameterError:
        raise
    except (OSError, KeyError, ValueError, TypeError, BadZipFile, UnicodeDecodeError) as error:
        raise ParameterError(
            "files", f"{file.name} cannot be read as reflectances ({error}): {_FILE_FORMS}"
        ) from None
    problem = _reflectance_problem(wavelengths, values)
    if problem:
        raise ParameterError("files", f"{file.name}: {problem}")
    return Table(
        torch.from_numpy(wavelengths) * 1e-9, torch.from_numpy(np.ascontiguousarray(values))
    )


def _reflectance_problem(wavelengths: Numbers, values: Numbers) -> str:
    """Return the reason why arrays from a file cannot be wavelengths and reflectances, or an
    empty text if they can.
    """
    if (
        wavelengths.ndim != 1
        or values.ndim != 2
        or values.shape[1] != len(wavelengths)
        or values.size == 0
    ):
        return (
            f"{wavelengths.shape} wavelengths and {values.shape} reflectances: write (spectrum,"
            " wavelength)"
        )
    if wrong := wavelength_problem(wavelengths, values):
        return wrong
    if values.max() > _LARGEST_REFLECTANCE or values.min() < -0.1:
        return (
            f"values from {values.min():.3g} to {values.max():.3g} are not reflectances: write 1"
            " for white, not 100"
        )
    return ""


def _npz_spectra(file: Path) -> tuple[Numbers, Numbers]:
    """Read wavelengths in nm and reflectances (spectrum, wavelength) from a .npz file."""
    npz_needs(file, 1.0, 8.0, "files")
    with np.load(file, allow_pickle=False) as arrays:
        return _real_numbers(arrays["wavelengths"]), _real_numbers(arrays["reflectances"])


def _mat_spectra(file: Path) -> tuple[Numbers, Numbers]:
    """Read wavelengths in nm and reflectances (spectrum, wavelength) from a .mat file."""
    from scipy.io import loadmat

    mat_needs(file, 2.0, together=True, parameter="files")
    try:
        variables = loadmat(file)
    except Exception as read_error:  # scipy raises many kinds of errors for foreign bytes
        raise ValueError(
            f"the file is not a .mat file of version 7 or older: {read_error}"
        ) from None
    # variables of the Psychtoolbox: S_name (start, step, count) and sur_name
    name = next(
        name.removeprefix("sur_") for name in [*variables, "sur_"] if name.startswith("sur_")
    )
    start, step, count = _real_numbers(variables[f"S_{name}"]).ravel()
    return start + step * np.arange(int(count)), _real_numbers(variables[f"sur_{name}"]).T


def _real_numbers(values: Any) -> Numbers:
    """Return the values as float64; raise ValueError for complex values, whose imaginary part
    would be lost.
    """
    if np.iscomplexobj(values):
        raise ValueError("its values are complex: save real numbers")
    return np.asarray(values, np.float64)
