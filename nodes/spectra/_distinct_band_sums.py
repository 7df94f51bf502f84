"""Weights of the spectral bands in the sums that a sensor forms from an image."""

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.values import Bands


@node(rtol=1e-12)
def rows(bands: Bands, responses: Tensor, *, well: bool = True) -> Tensor:
    """Return the weights of the spectral bands in each sum that a sensor forms from an image.

    The first rows are for the colour channels; the last row is for the fill of the well. A channel counts photons, so
    its weights are response times wavelength. The fill of the well is weighted by the wavelength alone, because a
    photon of any wavelength frees one electron. With `well` false, the last row is omitted.

    Shapes: bands (band,), responses (channel, band) -> (channel + 1, band) float64, or (channel, band).
    Units:  m; the node that counts photons applies the common factor.
    Error:  exact.
    Raises: ValueError where responses and bands differ in the number of bands.
    Source: NeuSee, Eq. (photon_count) and Eq. (ThresSat).
    """
    if responses.ndim != 2 or responses.shape[1] != len(bands.centres):
        raise ValueError(
            f"responses have shape {tuple(responses.shape)}, not (channel, band) with {len(bands.centres)} bands: "
            "compute both from the same `bands` step"
        )
    centres = bands.centres.double().to(responses.device)
    channels = responses.double() * centres
    return torch.cat([channels, centres[None]]) if well else channels


@rows.check
def _(result: Tensor, *inputs: object, **params: object) -> list[Check]:
    rank = int(torch.linalg.matrix_rank(result / result.abs().amax(1, keepdim=True).clamp_min(1e-300)))
    return [Check(f"{len(result)} rows of weights for {result.shape[1]} bands, rank {rank}")]
