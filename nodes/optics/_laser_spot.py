"""The laser spot on the sensor: a PSF scaled by the irradiance that saturates a pixel behind the clear lens."""

import math
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, TensorStats, node
from neusee.nodes._half_precision import single
from neusee.nodes.sensor._saturation import Efficiency, Well, saturation
from neusee.nodes.units import PositiveLength, Time
from neusee.nodes.values import Bands, Psf

_LSR = 2.2  #: largest laser suppression ratio of a pupil that only absorbs and delays; derived in the bound


@node()
def laser_irradiance(
    psf: Psf,
    bands: Bands,
    *,
    strength: Annotated[float, Field(ge=0, allow_inf_nan=False)],
    full_well: Well,
    quantum_efficiency: Efficiency,
    pixel_pitch: PositiveLength,
    exposure: Time,
) -> Tensor:
    """Scale the PSF of a laser so that its peak behind the clear lens, on axis, is ``strength`` times saturation.

    That peak is the sum of I / I_sat over the wavelengths of the line. Each wavelength sends its share of the energy
    (``bands.weights``) through the pupil. The spot is added to the image of the scene and is not convolved.

    Shapes: psf.intensity (band, y, x), bands (band,) -> (band, y, x).
    Units:  result W/m2 of each sub-band; strength is a plain multiple.
    Error:  float32 of the PSF, 1e-6 of its peak; the scale is exact.
    Raises: ValueError where PSF and line have different bands.
    Source: NeuSee, Eq. (peak_irrad_laser_coded).
    """
    if psf.intensity.shape[0] != len(bands.centres):
        raise ValueError(
            f"PSF of {psf.intensity.shape[0]} bands and line of {len(bands.centres)} bands: "
            "the numbers of bands differ, so compute both from one `line` step"
        )
    sensor = {"full_well": full_well, "quantum_efficiency": quantum_efficiency, "pixel_pitch": pixel_pitch}
    saturating: Tensor = saturation(bands, **sensor, exposure=exposure)
    unit = (bands.weights * psf.clear_peak / saturating).sum()
    energy = strength * bands.weights / unit
    intensity = single(psf.intensity)
    return intensity * energy.to(intensity)[:, None, None]


@laser_irradiance.zero_bound
def _(psf: TensorStats, bands: TensorStats, *, strength: float, **sensor: float) -> float:
    """Return an upper bound of the spot's irradiance: saturation x strength x largest laser suppression ratio (LSR).

    The bound needs no PSF, so no PSF is computed for it. A pixel that samples a point is at most as bright as the clear
    peak, where all of the pupil is in phase. The same holds for a pixel that averages over a width up to lambda f / D,
    because within that width all pairs of pupil points still add up. A wider pixel within the alias-free field holds at
    least 1 / 2.2 of the clear pupil's light on axis, and no other pixel holds more than all of that light.
    """
    if strength == 0:
        return 0.0
    ends = torch.tensor([bands.min], dtype=torch.float64)  # the saturation irradiance falls with wavelength
    saturating: Tensor = saturation(Bands(ends, ends, ends), **sensor)
    return _LSR * strength * float(saturating)


@laser_irradiance.check
def _(result: Tensor, psf: Psf, bands: Bands, *, strength: float, **sensor: float) -> list[Check]:
    share = 1.0 / saturation(bands, **sensor)
    peak = float(torch.tensordot(share.to(result), result, 1).max())
    return [Check(f"peak of the spot {peak:.3g} I_sat, strength {strength:g} I_sat", math.isfinite(peak))]
