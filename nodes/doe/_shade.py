"""Shades: what anyone can buy in place of a mask, which are a grey filter, a smaller stop and a notch filter."""

from typing import Annotated, Any

import torch
from pydantic import Field

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.optics._pupil_grid import axes, grid_of
from neusee.nodes.units import Fraction, Linewidth, Wavelength
from neusee.nodes.values import Shade, Stop

Share = Annotated[float, Field(gt=0, le=1)]  #: number above 0, at most 1


@node()
def shade(
    stop: Stop,
    *,
    transmittance: Share = 1.0,
    diameter: Share = 1.0,
    notches: tuple[Wavelength, ...] = (),
    width: Linewidth = 20e-9,
    depth: Fraction = 0.99,
) -> Shade:
    """Shade one arm by a grey filter of a ``transmittance``, by a smaller stop and by notch filters.

    The grey filter passes the same share of the light at every wavelength. The smaller stop has ``diameter`` times the
    diameter of the lens: an overfilled lens then collects diameter**2 of the light, and the peak of the clear lens
    falls with diameter**4. Each notch passes 1 - depth at its centre; ``width`` is its full width at half depth.

    Shapes: stop -> amplitude (v, u), notches (notch, 3).
    Units:  transmittance and depth shares of the light; diameter relative to the stop; width m.
    Error:  amplitude 3e-8 (float32); area of the staircase rim 2 / samples. A notch is Gaussian in wavelength, taken
            at the centre of each band: for bands as wide as the notch, the light that it removes is off by up to 6 %. A
            real notch moves to shorter wavelengths at larger angles, which is left out.
    Raises: ParameterError before the run where ``width`` is wider than the spectrum of a notch centre.
    Source: by definition; Born and Wolf, Principles of Optics, 7th ed., section 8.5.2 (peak of a circular aperture).
    """
    grid = grid_of(stop)
    v, u = axes(grid)
    open_ = (v.square() + u.square() <= diameter**2).float()
    rows = [(centre, width, depth) for centre in notches]
    return Shade(open_ * transmittance**0.5, torch.tensor(rows, dtype=torch.float64).reshape(-1, 3))


@shade.preflight
def _(*, width: float = 20e-9, notches: tuple[float, ...] = (), diameter: float = 1.0, **params: Any) -> list[str]:
    for centre in notches:
        if width >= centre:
            found = f"{width * 1e9:.4g} nm about {centre * 1e9:.4g} nm"
            raise ParameterError("width", f"a notch of {found} is wider than its centre: use a narrower notch")
    return []


@shade.check
def _(result: Shade, stop: Stop, **params: Any) -> list[Check]:
    grid = grid_of(stop)
    v, u = axes(grid)
    share = float(result.amplitude.double().square().sum() / (v.square() + u.square() <= 1).sum())
    return [Check(f"the shade passes {share:.4g} of the light, away from its notches", share > 0)]
