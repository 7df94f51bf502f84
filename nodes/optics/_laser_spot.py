"""The laser on the sensor: its PSF, scaled by what saturates a pixel of the unprotected lens."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, TensorStats, node
from neusee.nodes._half_precision import single
from neusee.nodes.sensor._saturation import Efficiency, Well, saturation
from neusee.nodes.units import PositiveLength, Time
from neusee.nodes.values import Bands, Psf

_LSR = 2.2  #: largest of a pupil that only absorbs and delays; see the bound


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
    """Scale the PSF of a laser so that through the clear lens, on axis, it would reach strength times saturation.

    That peak is the sum over the line of I / I_sat; each wavelength sends its share (``bands.weights``) of the energy
    through the pupil. The spot is added to the image of the scene and never convolved.

    Shapes: psf.intensity (band, y, x), bands (band,) -> (band, y, x).
    Units:  result W/m2 of each sub-band; strength is a plain multiple.
    Error:  float32 of the PSF, 1e-6 of its peak; exact in scale.
    Raises: ValueError where PSF and line have different bands.
    Source: NeuSee, Eq. (peak_irrad_laser_coded).
    """
    if psf.intensity.shape[0] != len(bands.centres):
        raise ValueError(
            f"PSF of {psf.intensity.shape[0]} bands and line of {len(bands.centres)}: give both the same `line` step"
        )
    sensor = {"full_well": full_well, "quantum_efficiency": quantum_efficiency}
    saturating: Tensor = saturation(bands, **sensor, pixel_pitch=pixel_pitch, exposure=exposure)
    unit = (bands.weights * psf.clear_peak / saturating).sum()
    energy = strength * bands.weights / unit
    intensity = single(psf.intensity)
    return intensity * energy.to(intensity)[:, None, None]


@laser_irradiance.zero_bound
def _(
    psf: TensorStats,
    bands: TensorStats,
    *,
    strength: float,
    full_well: float,
    quantum_efficiency: float,
    pixel_pitch: float,
    exposure: float,
) -> float:
    """What saturates, times strength, times the largest LSR: no PSF is asked for, so that none need be computed.

    No pixel that samples a point can be brighter than the clear peak, for there all of the pupil is in phase; nor one
    that averages, up to a width of lambda f / D, within which all pairs of the pupil still add up. A wider one, within
    the alias-free field, holds 1 / 2.2 of the clear pupil's light or more on axis, and no other more than all of it.
    """
    if strength == 0:
        return 0.0
    ends = torch.tensor([bands.min], dtype=torch.float64)  # what saturates falls with wavelength
    sensor = {"full_well": full_well, "quantum_efficiency": quantum_efficiency}
    saturating: Tensor = saturation(Bands(ends, ends, ends), **sensor, pixel_pitch=pixel_pitch, exposure=exposure)
    return _LSR * strength * float(saturating)


@laser_irradiance.check
def _(result: Tensor, psf: Psf, bands: Bands, **params: Any) -> list[Check]:
    sensor = {k: params[k] for k in ("full_well", "quantum_efficiency", "pixel_pitch", "exposure")}
    share = 1.0 / saturation(bands, **sensor)
    peak = float(torch.tensordot(share.to(result), result, 1).max())
    return [Check(f"peak {peak:.3g} I_sat of {params['strength']:g}", math.isfinite(peak))]
