"""Shades, the commercially available alternatives to a mask, and the grey filter with equal
protection.
"""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ErrorBound, ParameterError, TensorStats, node
from neusee.nodes.optics._pupil_grid import grid_of, pupil_axes
from neusee.nodes.precision import single
from neusee.nodes.units import Fraction, Linewidth, Wavelength
from neusee.nodes.values import Bands, Shade, Stop

# --- shade ----------------------------------------------------------------------------------------

# Shades are commercially available alternatives to a mask: a grey filter, a smaller stop and notch
# filters.


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
    """Shade one arm by a grey filter of a ``transmittance``, by a smaller stop and by notch
    filters.

    The grey filter passes the same share of the light at every wavelength. The smaller stop has
    ``diameter`` times the diameter of the lens: an overfilled lens then collects diameter**2 of the
    light, and the peak of the clear lens falls with diameter**4. Each notch passes 1 - depth at its
    centre; ``width`` is its full width at half depth.

    Shapes: stop -> amplitude (v, u), notches (notch, 3).
    Units:  transmittance and depth shares of the light; diameter relative to the stop; width m.
    Error:  amplitude 3e-8 (float32); area of the staircase rim 2 / samples. A notch is Gaussian in
            wavelength, taken at the centre of each band: for bands as wide as the notch, the light
            that it removes is off by up to 6 %. A real notch moves to shorter wavelengths at larger
            angles, which is left out.
    Raises: ParameterError before the run where ``width`` is wider than the spectrum of a notch
            centre.
    Source: by definition; Born and Wolf, Principles of Optics, 7th ed., section 8.5.2 (peak of a
            circular aperture).
    """
    grid = grid_of(stop)
    v, u = pupil_axes(grid)
    is_open = (v.square() + u.square() <= diameter**2).float()
    rows = [(centre, width, depth) for centre in notches]
    # the amplitude is the square root of the transmittance
    return Shade(
        is_open * transmittance**0.5, torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
    )


@shade.preflight
def _(
    *, width: float = 20e-9, notches: tuple[float, ...] = (), diameter: float = 1.0, **params: Any
) -> list[str]:
    for centre in notches:
        if width >= centre:
            notch = f"{width * 1e9:.4g} nm about {centre * 1e9:.4g} nm"
            raise ParameterError(
                "width", f"a notch of {notch} is wider than its centre: use a narrower notch"
            )
    return []


@shade.check
def _(result: Shade, stop: Stop, **params: Any) -> list[Check]:
    grid = grid_of(stop)
    v, u = pupil_axes(grid)
    share = float(result.amplitude.double().square().sum() / (v.square() + u.square() <= 1).sum())
    return [Check(f"the shade passes {share:.4g} of the light, away from its notches", share > 0)]


# --- equal filter ---------------------------------------------------------------------------------

# The grey filter that protects the sensor as well as a mask: the commercially available
# alternative.


@node(rtol=1e-6)
def equal_filter(
    light: Tensor, lsr: Tensor, bands: Bands, lines: list[Bands] | None = None
) -> Tensor:
    """Weaken light by the grey filter behind which every laser is at least as weak as behind a
    mask.

    The transmittance of the filter is the laser suppression ratio of the mask at the wavelength of
    the laser, and of several lasers the largest of these; without a laser, the largest ratio of all
    bands. It is at most 1. The filter scales the irradiance and the photons of a clear lens, and
    needs no point-spread function of its own.

    Shapes: light (any), lsr (band,), bands (band,), each line (line band,) -> as light.
    Units:  result as light, irradiance or photons; lsr none.
    Error:  float32: 6e-8 of the light. The ratio is that of the band nearest to the mean wavelength
            of the laser.
    Raises: ValueError where ratios and bands differ in number.
    Source: by definition of the laser suppression ratio: NeuSee, section Sensor Image.
    """
    light = single(light)
    return light * transmittance(lsr, bands, lines).to(light)


@equal_filter.propagate_error
def _(light: ErrorBound, *others: ErrorBound | None, result: TensorStats, **params: Any) -> float:
    """Return a bound of the rms error of the result from the errors of the light and of the ratio.

    The filter uses the ratio of one band, which may have the whole error of the ratios. The product
    of both errors is included.
    """
    ratio = others[0] if others else None
    if light.stats is None or (ratio is not None and ratio.rms and ratio.stats is None):
        return math.inf
    largest = max(abs(result.min), abs(result.max))
    filter_transmittance = largest / light.top if light.top > 0 else 1.0
    # the whole rms error may be in one band
    largest_ratio_error = (
        ratio.rms * math.sqrt(math.prod(ratio.stats.shape)) if ratio and ratio.stats else 0.0
    )
    return (
        light.rms * (filter_transmittance + largest_ratio_error) + largest_ratio_error * light.top
    )


@equal_filter.check
def _(
    result: Tensor, light: Tensor, lsr: Tensor, bands: Bands, lines: Any = None, **params: Any
) -> list[Check]:
    share = float(transmittance(lsr, bands, lines))
    return [Check(f"a grey filter that passes {share:.3g} of the light", share > 0)]


def transmittance(lsr: Tensor, bands: Bands, lines: list[Bands] | None) -> Tensor:
    """Return the transmittance () of the filter."""
    if len(lsr) != len(bands.centres):
        raise ValueError(
            f"{len(lsr)} ratios and {len(bands.centres)} bands: compute the ratios from the same"
            " `bands`"
        )
    ratios = lsr
    if lines:
        line_wavelengths = torch.stack(
            [(line.centres * line.weights).sum() / line.weights.sum() for line in lines]
        )
        # the ratio of the band nearest to each line
        ratios = lsr[(line_wavelengths[:, None] - bands.centres).abs().argmin(-1).to(lsr.device)]
    return ratios.amax().clamp(max=1.0)
