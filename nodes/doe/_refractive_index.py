"""Materials of the mask, and their refractive indices relative to air."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.values import Bands

Material = Literal["fused silica", "PMMA", "BK7", "photoresist"]


class _Dispersion(NamedTuple):
    sellmeier: tuple[tuple[float, float], ...]  #: (B, C): n**2 = 1 + sum of B w**2 / (w**2 - C), w in µm
    cauchy: tuple[float, ...]  #: n = a0 + a1 / w**2 + a2 / w**4; empty where Sellmeier is given
    fit: tuple[float, float]  #: wavelengths, m, over which the formula was fitted


_DISPERSION: dict[str, _Dispersion] = {
    # Malitson, J. Opt. Soc. Am. 55, 1205 (1965), at 20 °C
    "fused silica": _Dispersion(
        ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)), (), (0.21e-6, 3.71e-6)
    ),
    # one-term fit to Sultanova, Kasarova, Nikolov, Acta Phys. Pol. A 116, 585 (2009), at 20 °C
    "PMMA": _Dispersion(((1.1819, 0.011313),), (), (0.4368e-6, 1.052e-6)),
    # SCHOTT, optical glass data sheet N-BK7
    "BK7": _Dispersion(
        ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)), (), (0.3e-6, 2.5e-6)
    ),
    # MicroChem, SU-8 3000 data sheet (2011)
    "photoresist": _Dispersion((), (1.5525, 0.00629, 0.0004), (0.32e-6, 1.7e-6)),
}


def excess_index(name: Material, wavelengths: Tensor) -> Tensor:
    """Return n - 1 of a material at wavelengths in m; the result is differentiable and keeps the dtype."""
    material, square = _DISPERSION[name], (wavelengths * 1e6).square()
    if material.cauchy:
        return torch.stack([a / square**k for k, a in enumerate(material.cauchy)]).sum(0) - 1
    return (1 + torch.stack([b * square / (square - c) for b, c in material.sellmeier]).sum(0)).sqrt() - 1


def wave_height(name: Material, wavelength: float) -> float:
    """Return the height of the mask, in m, that delays light of ``wavelength`` by one wave."""
    return wavelength / float(excess_index(name, torch.tensor(wavelength, dtype=torch.float64)))


@node(rtol=1e-12)
def material(bands: Bands, *, material: Material = "fused silica") -> Tensor:
    """Compute the refractive index of the mask minus the refractive index of air, which is taken as 1.

    Shapes: bands -> (band,), float64.
    Units:  wavelengths m; result 1.
    Error:  error of the fit: 1e-5 for the glasses, 1e-3 for the polymers.
    Source: fused silica: Malitson, J. Opt. Soc. Am. 55, 1205 (1965); N-BK7: SCHOTT data sheet; PMMA: fit to
        Sultanova et al., Acta Phys. Pol. A 116, 585 (2009); photoresist: MicroChem SU-8 3000 data sheet (2011), Cauchy.
    """
    return excess_index(material, bands.centres.to(torch.float64))


@material.check
def _(result: Tensor, bands: Bands, *, material: Material) -> list[Check]:
    (low, high), centres = _DISPERSION[material].fit, bands.centres
    text = f"{material}: n - 1 from {float(result[0]):.4f} to {float(result[-1]):.4f}"
    fitted = low <= float(centres.min()) and float(centres.max()) <= high
    extent = f"formula fitted over {low * 1e9:.0f} to {high * 1e9:.0f} nm"
    return [Check(text, bool((result > 0).all())), Check(extent if fitted else f"{extent}, used outside it", fitted)]
