"""The brightness of a scene in lux or cd/m2, as the irradiance of a white surface on the sensor."""

import math
from pathlib import Path

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.optics._pupil_grid import clear_area
from neusee.nodes.spectra._illuminant import Kind, luminous_share
from neusee.nodes.units import (
    DataFile,
    FocalLength,
    Illuminance,
    Luminance,
    Temperature,
    Transmittance,
)
from neusee.nodes.values import Bands, Stop

_EQUAL = 1e-6  #: largest relative difference of widths of bands that count as equal


@node(rtol=1e-9)
def white_irradiance(
    bands: Bands,
    stop: Stop,
    *,
    illuminance: Illuminance | None = None,
    luminance: Luminance | None = None,
    kind: Kind | DataFile = "daylight",
    temperature: Temperature = 6504.0,
    focal_length: FocalLength,
    lens_transmittance: Transmittance = 1.0,
) -> Tensor:
    """Compute the irradiance of one band on the sensor, for a scene of relative radiance 1 without
    a mask.

    A white surface (reflectance 1, Lambertian) has the luminance illuminance / pi, and the spectrum
    of the illuminant. The lens images its radiance as the area of the clear pupil / focal length^2
    x transmittance.

    Shapes: -> () float64.
    Units:  result W/m2 in a band per unit of the image, whose white has mean 1 over the bands; 0 if
            neither illuminance nor luminance is given.
    Error:  a distant scene, on the axis: the falling off to the corners (cos^4) is left out.
    Raises: ParameterError before the run for an illuminance beside a luminance, for bands of
            different widths, and for a table of light that does not reach over the visible
            wavelengths.
    Source: CIE 18:2019 (683 lm/W); Goodman, Introduction to Fourier Optics, 3rd ed., section 5.3;
            by definition.
    """
    if illuminance is None and luminance is None:
        return torch.zeros((), dtype=torch.float64)
    luminance_of_white = 0.0 if luminance is None else luminance
    if illuminance is not None:
        # a white surface that scatters evenly: luminance = illuminance / pi
        luminance_of_white = illuminance / math.pi
    widths = bands.widths.detach().cpu().double()
    radiance = luminance_of_white * luminous_share(bands, kind, temperature)
    if float(widths.max() / widths.min()) > 1 + _EQUAL:
        raise ParameterError("illuminance", _WIDTHS)
    return torch.as_tensor(
        radiance * clear_area(stop) / focal_length**2 * lens_transmittance, dtype=torch.float64
    )


_WIDTHS = (
    "the bands differ in width, so that one unit of the image is another power in each: use the"
    " node spectra.bands"
)


@white_irradiance.preflight
def _(
    *,
    bands: Bands | None = None,
    illuminance: float | None = None,
    luminance: float | None = None,
    kind: str | Path = "daylight",
    temperature: float = 6504.0,
    focal_length: float,
    lens_transmittance: float = 1.0,
) -> list[str]:
    if illuminance is None and luminance is None:
        return []
    stated = "illuminance" if illuminance is not None else "luminance"
    if illuminance is not None and luminance is not None:
        text = (
            "the brightness of white is stated twice: leave scene.illuminance or"
            " scene.luminance out"
        )
        raise ParameterError("luminance", text)
    if (
        bands is not None
        and not bands.widths.is_meta
        and float(bands.widths.max() / bands.widths.min()) > 1 + _EQUAL
    ):
        raise ParameterError(stated, _WIDTHS)
    if isinstance(kind, Path):
        luminous_share(bands, kind, temperature)
    return []


@white_irradiance.check
def _(
    result: Tensor, bands: Bands, stop: Stop, *, focal_length: float, **params: object
) -> list[Check]:
    if not float(result) > 0:
        return [Check("no brightness in lux or cd/m2")]
    f_number = focal_length / (2 * math.sqrt(clear_area(stop) / math.pi))
    total = float(result) * len(bands.centres)
    return [Check(f"white: {total:.4g} W/m2 on the sensor in all bands, at f/{f_number:.3g}")]
