"""Random plausible spectra: mixtures of measured spectra, and metamers (other spectra of the
same colour).
"""

from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.spectra._cie_tables import to_srgb
from neusee.nodes.spectra._linear_lift import lift_matrix
from neusee.nodes.units import Count
from neusee.nodes.values import Bands

_DARKEST = 1e-6  #: smallest reflectance to which the thickness of a layer is applied

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
        measured[_drawn(len(measured), (count,), rng)]
        - measured[_drawn(len(measured), (count,), rng)],
        measured,
        bands,
    )
    normal = torch.randn(count, 1, generator=rng, device=rng.device, dtype=torch.float64)
    # in proportion to the brightness of each mixture
    share = blacks * normal * mixture.mean(1, keepdim=True) / measured.mean()
    least_share, greatest_share = _limits(mixture, black)
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
    """Mix measured spectra at random, and apply a random layer thickness to each mixture (Beer and
    Lambert).

    The thickness is log-uniform. One spectrum dominates most mixtures.
    """
    options = {"generator": rng, "device": rng.device, "dtype": torch.float64}
    weights = -torch.rand(count, mixed, **options).clamp_min(1e-12).log()  # type: ignore[call-overload]
    # squares of exponential numbers differ widely: one dominates
    weights = weights.square()
    weights = weights / weights.sum(1, keepdim=True)
    mixtures = (weights[..., None] * measured[_drawn(len(measured), (count, mixed), rng)]).sum(1)
    uniform: Tensor = torch.rand(count, 1, **options)  # type: ignore[call-overload]
    layer_thickness: Tensor = thickness[0] * (thickness[1] / thickness[0]) ** uniform
    # Beer and Lambert: the transmission of a layer to the power of its thickness
    layers: Tensor = mixtures.clamp(_DARKEST, 1.0) ** layer_thickness
    return layers


def _drawn(of: int, shape: tuple[int, ...], rng: torch.Generator) -> Tensor:
    """Return random indices below ``of``."""
    return torch.randint(of, shape, generator=rng, device=rng.device)


def _limits(base: Tensor, black: Tensor) -> tuple[Tensor, Tensor]:
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
