"""Weights of the spectral bands in each colour channel, and in the electrons that fill a pixel."""

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.values import Bands


@node(rtol=1e-12)
def rows(bands: Bands, responses: Tensor, *, well: bool = True) -> Tensor:
    """Return the weight of each spectral band in each colour channel, and in the electrons that fill a pixel.

    The first rows are for the colour channels. The last row is for the electrons that fill the well. A channel
    counts photons, so that the weights are response times wavelength. The weights of the last row are the wavelengths
    alone, because a photon of any wavelength frees one electron. With `well` false, the last row is omitted.

    Shapes: bands (band,), responses (channel, band) -> (channel + 1, band) float64, or (channel, band).
    Units:  m; the node that counts photons applies the common factor.
    Error:  exact.
    Raises: ValueError where responses and bands differ in the number of bands.
    Source: NeuSee, Eq. (photon_count) and Eq. (ThresSat).
    """
    if responses.ndim != 2 or responses.shape[1] != len(bands.centres):
        raise ValueError(
            f"responses have shape {tuple(responses.shape)}, not (channel, band) with {len(bands.centres)} bands: "
            "compute responses and bands from the same `bands` step"
        )
    centres = bands.centres.double().to(responses.device)
    channels = responses.double() * centres
    return torch.cat([channels, centres[None]]) if well else channels


@rows.check
def _(result: Tensor, *inputs: object, **params: object) -> list[Check]:
    rank = int(torch.linalg.matrix_rank(result / result.abs().amax(1, keepdim=True).clamp_min(1e-300)))
    return [Check(f"{len(result)} weighted sums over {result.shape[1]} bands; the matrix of weights has rank {rank}")]
