"""Spectra that could have been measured: mixtures of those that were, and others of the same colour."""

from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.spectra._linear_lift import lift_matrix
from neusee.nodes.spectra._spectral_tables import to_srgb
from neusee.nodes.units import Count
from neusee.nodes.values import Bands

_DARKEST = 1e-6  #: reflectance of which a layer's thickness is still told

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
    """Draw reflectances: mixtures of measured ones, in layers thinner and thicker, each with a metameric black.

    A layer of thickness p turns a reflectance s into s^p (Beer and Lambert), which makes colours paler and deeper than
    measured. A metameric black is what the linear estimate from the colour leaves of a measured spectrum: added, it
    changes the spectrum and not the colour. Its strength is normal with deviation `blacks`, 1 being that of measured
    spectra of the same brightness, and it is cut where the sum would leave [0, 1]. The mixtures do not depend on it.

    Shapes: reflectances (spectrum, band) -> (count, band) float64.
    Units:  reflectance.
    Error:  float64: a black moves the colour under D65 by less than 1e-12 of white.
    Raises: ParameterError before the run unless the thinnest layer comes first; ValueError where the bands differ.
    Source: metameric blacks: Wyszecki (1953), Cohen and Kappauf, Am. J. Psychol. 95, 537 (1982); here oblique to the
            colours, along the covariance of what was measured.
    """
    if reflectances.ndim != 2 or reflectances.shape[1] != len(bands.centres) or len(reflectances) < 4:
        raise ValueError(
            f"reflectances {tuple(reflectances.shape)} are not four spectra or more of {len(bands.centres)} bands: "
            "give both the same `bands` step"
        )
    known = reflectances.double()
    base = _mixtures(known, count, mixed, thickness, rng)
    black = metameric_blacks(known[_drawn(len(known), (count,), rng)] - known[_drawn(len(known), (count,), rng)],
                             known, bands)  # fmt: skip
    wanted = torch.randn(count, 1, generator=rng, device=rng.device, dtype=torch.float64)
    share = blacks * wanted * base.mean(1, keepdim=True) / known.mean()
    low, high = _room(base, black)
    return (base + share.maximum(low).minimum(high) * black).clamp(0.0, 1.0)


@metamers.preflight
def _(*, thickness: tuple[float, float] = (0.5, 2.0), **params: Any) -> list[str]:
    if thickness[0] > thickness[1]:
        raise ParameterError("thickness", f"{thickness[0]:g} is above {thickness[1]:g}: exchange them")
    return []


@metamers.check
def _(result: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    low, high = float(result.min()), float(result.max())
    return [Check(f"{len(result)} spectra, {low:.3g} to {high:.3g}", 0 <= low <= high <= 1)]


def metameric_blacks(spectra: Tensor, known: Tensor, bands: Bands) -> Tensor:
    """What the linear estimate from the colours of (spectrum, band) leaves of them; its colour is (0, 0, 0)."""
    centres = bands.centres.detach().cpu().double()
    estimate = lift_matrix(known.cpu(), centres) @ to_srgb(centres)
    return spectra - spectra @ estimate.T.to(spectra)


def _mixtures(known: Tensor, count: int, mixed: int, thickness: tuple[float, float], rng: torch.Generator) -> Tensor:
    """Convex sums, most of them ruled by one spectrum; the thickness is drawn evenly in its logarithm."""
    how = {"generator": rng, "device": rng.device, "dtype": torch.float64}
    weights = -torch.rand(count, mixed, **how).clamp_min(1e-12).log()  # type: ignore[call-overload]
    weights = weights.square()
    weights = weights / weights.sum(1, keepdim=True)
    sums = (weights[..., None] * known[_drawn(len(known), (count, mixed), rng)]).sum(1)
    even: Tensor = torch.rand(count, 1, **how)  # type: ignore[call-overload]
    power: Tensor = thickness[0] * (thickness[1] / thickness[0]) ** even
    found: Tensor = sums.clamp(_DARKEST, 1.0) ** power
    return found


def _drawn(of: int, shape: tuple[int, ...], rng: torch.Generator) -> Tensor:
    return torch.randint(of, shape, generator=rng, device=rng.device)


def _room(base: Tensor, black: Tensor) -> tuple[Tensor, Tensor]:
    """How much of a black, taken off and added, keeps each spectrum in [0, 1]: two of (spectrum, 1)."""
    to_white, to_dark = (1.0 - base) / black, -base / black
    high = torch.where(black > 0, to_white, torch.where(black < 0, to_dark, torch.inf))
    low = torch.where(black > 0, to_dark, torch.where(black < 0, to_white, -torch.inf))
    return low.amax(1, keepdim=True), high.amin(1, keepdim=True)
