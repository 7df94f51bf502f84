"""The likelihood of the rings about an overexposed point source under the Harvey-Shack scatter of a lens."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor
from torch.special import log_ndtr

from neusee.nodes import Check, node
from neusee.nodes.calibrate._likelihood._linear_sensor import Likelihood
from neusee.nodes.calibrate._scatter._point_source import Rings
from neusee.nodes.flare._harvey_shack import lobe, on_far_pixels, scattered_share
from neusee.nodes.units import Diameter, Electrons, FocalLength, Gain, PixelPitch, Real, Wavelength

Positive = Annotated[float, Field(ge=1e-12, le=1e12)]
Scattered = Annotated[float, Field(ge=0, le=100)]  #: a standard deviation; 0 for none
_FRINGES = 0.02  #: relative: how well the mean wing of the core is that of a ring that is one pixel wide


@node()
def stray_light(
    rings: Rings,
    *,
    b0: Positive,
    l: Positive,  # noqa: E741 (the symbol of the literature)
    s: Real,
    electrons: Annotated[Electrons, Field(gt=0)],
    background: Real = 0.0,
    core: Scattered = 1.0,
    scatter: Scattered = 0.0,
    read_noise: Electrons,
    gain: Gain,
    focal_length: FocalLength,
    diameter: Diameter,
    pixel_pitch: PixelPitch,
    wavelength: Wavelength,
    told: bool = True,
) -> Likelihood:
    """Compute the likelihood of the rings about a point source under one Harvey-Shack surface at the entrance pupil.

    The mean of a pixel is ``electrons`` times ((1 - TIS) core + scattered light) plus ``background``; ``electrons`` are
    those of the whole source in one exposure, and the distance r stands for the direction cosine r / focal_length. The
    core is ``core`` times the mean diffraction wing of a round aperture, wavelength N pitch**2 / (pi**3 r**3) with
    N = focal_length / diameter. The mean of a ring is normal, with shot noise, ``read_noise``, rounding, and a relative
    standard deviation ``scatter`` for what the model lacks, such as fringes and unequal pixels. The mean of a ring
    whose every pixel is cut off is at least the cut. Any number may be a tensor (walker,).

    Shapes: rings -> log (walker,), deviance (walker, ring), scaled (walker, row).
    Units:  b0 1/sr; electrons, background, read_noise e- of one exposure; log in nats.
    Error:  parts of rings are averaged over squared distance, 1e-4 of a ring. Diffraction fringes are averaged; a ring
            one fringe wide keeps a few per cent of them, which ``scatter`` must cover.
    Source: Harvey, thesis, Univ. of Arizona (1976); Peterson, Proc. SPIE 5178 (2004), 184; wing of the core: Born and
            Wolf, Principles of Optics, 7th ed., section 8.5.2, the energy outside a radius for large radii.
    """
    source = {"electrons": electrons, "background": background, "core": core, "scatter": scatter}
    given = {"b0": b0, "l": l, "s": s, **source}
    numbers = {name: torch.as_tensor(x, dtype=torch.float64)[..., None] for name, x in given.items()}
    lens = (wavelength * focal_length / (diameter * pixel_pitch), pixel_pitch / focal_length)
    mean = _averaged(_light(numbers, rings.square, *lens), rings) + numbers["background"]
    alone = mean.clamp_min(0) + read_noise**2 + 1 / (12 * gain**2)
    variance = alone / rings.pixels + (numbers["scatter"] * (mean - numbers["background"])).square()
    away = (rings.mean - mean) / variance.sqrt()
    hidden = _light(numbers, rings.cut_square, *lens) + numbers["background"]
    above = log_ndtr((hidden - rings.cut) / (hidden * torch.hypot(numbers["scatter"], _ripple())))
    log = -0.5 * (away.square() + variance.log()).sum(-1) + above.sum(-1)
    total = log.where(_total(numbers)[..., 0] < 1, -torch.inf)
    if not told:
        return Likelihood(total, *(torch.zeros(0, dtype=torch.float64) for _ in range(5)))
    # squared derivatives of a residual and of its log width sum, on average, to the Fisher information
    rows = torch.cat(torch.broadcast_tensors(away, 0.5 * variance.log()), -1)  # type: ignore[no-untyped-call]
    return Likelihood(total, away.square(), torch.ones_like(rings.mean), rows, mean, variance)


@stray_light.check
def _(result: Likelihood, rings: Rings, **params: Any) -> list[Check]:
    if not len(result.degrees_of_freedom):
        return []
    return [Check(f"deviance {float(result.deviance.sum()):.4g} of {len(rings.mean)} rings")]


def _ripple() -> Tensor:
    return torch.tensor(_FRINGES, dtype=torch.float64)


def _total(numbers: Mapping[str, Tensor]) -> Tensor:
    return scattered_share(numbers["b0"], numbers["l"], numbers["s"])


def _light(numbers: dict[str, Tensor], square: Tensor, fringe: float, scale: float) -> Tensor:
    """Return the electrons of the source in pixels at squared distances; ``fringe`` is wavelength N in pixels."""
    light: Tensor = numbers["electrons"] * share_of_light(numbers, square, fringe, scale)
    return light


def share_of_light(numbers: Mapping[str, Tensor], square: Tensor, fringe: float, scale: float) -> Tensor:
    """Return the share of the light that core and scatter send into pixels at squared distances from the source.

    ``fringe`` is wavelength N in pixels, and ``scale`` the direction cosine of a pixel.
    """
    b0, l, s = (numbers[name] for name in ("b0", "l", "s"))  # noqa: E741
    veil = on_far_pixels(lobe(b0, l, s, torch.tensor(scale, dtype=torch.float64)), square)
    return (1 - _total(numbers).clamp_max(1)) * numbers["core"] * diffraction_wing(square, fringe) + veil


def diffraction_wing(square: Tensor, fringe: float) -> Tensor:
    """Return the mean share of light per pixel of a round aperture far from the source, with the pixel integrated."""
    return fringe / (math.pi**3 * square**1.5) * (1 + 9 / (24 * square))


def _averaged(parts: Tensor, rings: Rings) -> Tensor:
    """Return the mean over the parts of each ring, (..., ring)."""
    share = rings.weight / torch.zeros_like(rings.mean).index_add(0, rings.ring, rings.weight)[rings.ring]
    return parts.new_zeros(*parts.shape[:-1], len(rings.mean)).index_add(-1, rings.ring, parts * share)


def guess_scatter(rings: Rings, believed: Mapping[str, float], params: Mapping[str, Any]) -> dict[str, float]:
    """Return a first guess of the scatter: over a grid of l and s, the b0 and background that fit the rings best.

    Guesses that scatter more than all light are left out.

    Shapes: rings; numbers by name, with the names of ``believed``; ``params`` are those of `stray_light`.
    Units:  those of `stray_light`.
    Error:  a start for a search, not an estimate.
    Source: linear least squares.
    """
    scale, best, least = params["pixel_pitch"] / params["focal_length"], dict(believed), math.inf
    weight = (rings.pixels / (rings.mean.clamp_min(0) + params["read_noise"] ** 2 + 1 / params["gain"] ** 2)).sqrt()
    fringe = params["wavelength"] * params["focal_length"] / (params["diameter"] * params["pixel_pitch"])
    wing = diffraction_wing(rings.square, fringe)
    for l in (believed["l"] * 3.0**n for n in range(-4, 5)):  # noqa: E741
        for s in (believed["s"] + 0.35 * n for n in range(-4, 5)):
            unit = lobe(*(torch.tensor(x, dtype=torch.float64) for x in (1.0, l, s, scale)))
            rows = torch.stack([_averaged(on_far_pixels(unit, rings.square), rings), torch.ones_like(rings.mean)], 1)
            rows[:, 0] *= believed["electrons"]
            rest = rings.mean - believed["electrons"] * believed["core"] * _averaged(wing, rings)
            fit = torch.linalg.lstsq(rows * weight[:, None], (rest * weight)[:, None]).solution[:, 0]
            off = float(((rows @ fit - rest) * weight).square().sum())
            share = float(fit[0]) * float(scattered_share(*(torch.tensor(x, dtype=torch.float64) for x in (1.0, l, s))))
            if off < least and 0 < share < 1:
                least, best = off, best | {"b0": float(fit[0]), "l": l, "s": s}
    return best
