"""Materials of the mask, their refractive indices, and the height that gives a phase."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Discriminator, Tag, WithJsonSchema
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.doe._glass_table import (
    SELLMEIER_SCHEMA,
    Sellmeier,
    glass_index,
    glass_range,
    refuse_glass,
)
from neusee.nodes.optics._pupil_grid import PupilGrid, inside
from neusee.nodes.units import DataFile
from neusee.nodes.values import Bands

# --- refractive index -----------------------------------------------------------------------------

# Materials of the mask, and their refractive indices relative to air.


Material = Literal["fused silica", "PMMA", "BK7", "photoresist"]
#: a known material, a file with a table or coefficients, or coefficients
Glass = Annotated[
    Annotated[Material | DataFile, Tag("file")]
    | Annotated[Sellmeier, Tag("coefficients"), WithJsonSchema(SELLMEIER_SCHEMA)],
    Discriminator(lambda value: "coefficients" if isinstance(value, Mapping) else "file"),
]
AnyGlass = str | Path | Sellmeier  #: `Glass` as a function receives it


class _Dispersion(NamedTuple):
    #: (B, C): n**2 = 1 + sum of B w**2 / (w**2 - C), w in µm
    sellmeier: tuple[tuple[float, float], ...]
    cauchy: tuple[float, ...]  #: n = a0 + a1 / w**2 + a2 / w**4; empty where Sellmeier is given
    fit: tuple[float, float]  #: wavelengths, m, over which the formula was fitted


_DISPERSION: dict[str, _Dispersion] = {
    # Malitson, J. Opt. Soc. Am. 55, 1205 (1965), at 20 °C
    "fused silica": _Dispersion(
        ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)),
        (),
        (0.21e-6, 3.71e-6),
    ),
    # one-term fit to Sultanova, Kasarova, Nikolov, Acta Phys. Pol. A 116, 585 (2009), at 20 °C
    "PMMA": _Dispersion(((1.1819, 0.011313),), (), (0.4368e-6, 1.052e-6)),
    # SCHOTT, optical glass data sheet N-BK7
    "BK7": _Dispersion(
        ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)),
        (),
        (0.3e-6, 2.5e-6),
    ),
    # MicroChem, SU-8 3000 data sheet (2011)
    "photoresist": _Dispersion((), (1.5525, 0.00629, 0.0004), (0.32e-6, 1.7e-6)),
}


def excess_index(name: AnyGlass, wavelengths: Tensor) -> Tensor:
    """Return n - 1 of a material at wavelengths in m; the result is differentiable and keeps the
    dtype.

    Raises ValueError for wavelengths outside the range of a material of your own.
    """
    if not isinstance(name, str):
        return glass_index(name, wavelengths) - 1
    material, squared_um = _DISPERSION[name], (wavelengths * 1e6).square()
    if material.cauchy:
        return torch.stack([a / squared_um**k for k, a in enumerate(material.cauchy)]).sum(0) - 1
    return (
        1 + torch.stack([b * squared_um / (squared_um - c) for b, c in material.sellmeier]).sum(0)
    ).sqrt() - 1


def wave_height(name: AnyGlass, wavelength: float) -> float:
    """Return the height of the mask, in m, that delays light of ``wavelength`` by one wave."""
    return wavelength / float(excess_index(name, torch.tensor(wavelength, dtype=torch.float64)))


def index_curve(glass: AnyGlass, count: int = 400) -> tuple[Tensor, Tensor]:
    """Return ``count`` wavelengths in m over the range in which a material is known, and its
    refractive index there.
    """
    low, high = _name_and_range(glass)[1]
    wavelengths = torch.linspace(low, high, count, dtype=torch.float64)
    return wavelengths, excess_index(glass, wavelengths) + 1


def nearest_known(name: AnyGlass, wavelength: float) -> float:
    """Return the wavelength in m nearest to ``wavelength`` at which the index of a material of
    your own is known.
    """
    if isinstance(name, str):
        return wavelength
    low, high = glass_range(name)
    return min(max(wavelength, low), high)


@node(rtol=1e-12)
def material(bands: Bands, *, material: Glass = "fused silica") -> Tensor:
    """Compute the refractive index of the mask minus the refractive index of air, which is taken as
    1.

    ``material`` is one of four names; or Sellmeier coefficients, B without unit and C in um^2, with
    the range of wavelengths over which they were fitted; or a CSV file with either, with a header
    such as ``wavelength (um),n (1)`` or ``B (1),C (um^2),from (nm),to (nm)``.

    Shapes: bands -> (band,), float64.
    Units:  wavelengths m; result 1.
    Error:  error of the fit: 1e-5 for the glasses, 1e-3 for the polymers. A table is interpolated
            by the cubic through the four nearest rows: 1e-7 for glass in steps of 10 nm. A glass of
            your own is never extrapolated.
    Raises: ParameterError before the run for a glass that does not reach over the bands, and for a
            file without such numbers.
    Source: fused silica: Malitson, J. Opt. Soc. Am. 55, 1205 (1965); N-BK7: SCHOTT data sheet;
        PMMA: fit to Sultanova et al., Acta Phys. Pol. A 116, 585 (2009); photoresist: MicroChem
                SU-8 3000 data sheet (2011), Cauchy.
    """
    return excess_index(material, bands.centres.to(torch.float64))


@material.preflight
def _(*, bands: Bands | None = None, material: AnyGlass = "fused silica") -> list[str]:
    return refuse_material(
        "material", material, None if bands is None or bands.centres.is_meta else bands.centres
    )


def refuse_material(parameter: str, material: AnyGlass, wavelengths: Tensor | None) -> list[str]:
    """Raise ParameterError for a material of your own that is wrong or not known at wavelengths in
    m; return no notes.

    ``parameter`` is the parameter that the wavelengths come from; a wrong file is always a mistake
    of ``material``.
    """
    if isinstance(material, str):
        return []
    refuse_glass(material)
    if wavelengths is not None:
        try:
            glass_index(material, wavelengths)
        except ValueError as error:
            raise ParameterError(parameter, str(error)) from None
    return []


@material.check
def _(result: Tensor, bands: Bands, *, material: AnyGlass) -> list[Check]:
    name, (shortest, longest) = _name_and_range(material)
    text = f"{name}: n - 1 from {float(result[0]):.4f} to {float(result[-1]):.4f}"
    range_text = f"formula fitted over {shortest * 1e9:.0f} to {longest * 1e9:.0f} nm"
    if not isinstance(material, str):
        range_text = f"known from {shortest * 1e9:.0f} to {longest * 1e9:.0f} nm"
    is_covered = shortest <= float(bands.centres.min()) and float(bands.centres.max()) <= longest
    return [
        Check(text, bool((result > 0).all())),
        Check(range_text if is_covered else f"{range_text}, used outside it", is_covered),
    ]


def _name_and_range(material: AnyGlass) -> tuple[str, tuple[float, float]]:
    """Return the name of a material, and the wavelengths in m between which its index is known."""
    if isinstance(material, str):
        return material, _DISPERSION[material].fit
    return material.name if isinstance(
        material, Path
    ) else "own Sellmeier coefficients", glass_range(material)


# --- height from phase ----------------------------------------------------------------------------

# The height map of a mask that produces a given phase, and the check of a height map.


def height_from_phase(
    phase: Tensor, grid: PupilGrid, wavelength: float, material: AnyGlass
) -> Tensor:
    """Return the height map (float32, m) that delays ``wavelength`` by ``phase``; the least height
    is 0.

    The height outside the stop is 0 too.
    """
    in_stop = inside(grid, phase.device)
    phase_from_lowest = phase - torch.where(in_stop, phase, math.inf).min()
    return torch.where(
        in_stop, phase_from_lowest * (wave_height(material, wavelength) / (2 * math.pi)), 0.0
    ).to(torch.float32)


def height_checks(height: Tensor, *_: Any, **__: Any) -> list[Check]:
    """Check that all heights are finite and at least 0, and state the least and the greatest
    height.
    """
    lowest, highest = (float(value) for value in torch.aminmax(height))
    is_valid = math.isfinite(lowest) and math.isfinite(highest) and lowest >= 0
    return [Check(f"height map from {lowest * 1e6:.3g} to {highest * 1e6:.4g} um", is_valid)]
