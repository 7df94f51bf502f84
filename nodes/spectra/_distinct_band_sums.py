"""The few weighted sums over bands that a sensor can tell apart."""

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.values import Bands


@node(rtol=1e-12)
def rows(bands: Bands, responses: Tensor, *, well: bool = True) -> Tensor:
    """List the weights of the bands in all that a sensor makes of its light: each channel's photons, and the well.

    A channel counts photons, response times wavelength. What is told in parts of saturation goes as the wavelength
    itself, for a photon frees an electron of whatever colour; where no one asks that, it can do without `well`.

    Shapes: bands (band,), responses (channel, band) -> (channel + 1, band) float64; the last row is the well's.
    Units:  m; a common factor is left to whoever counts photons.
    Error:  exact.
    Raises: ValueError where the bands differ.
    Source: NeuSee, Eq. (photon_count) and Eq. (ThresSat).
    """
    if responses.ndim != 2 or responses.shape[1] != len(bands.centres):
        raise ValueError(
            f"responses {tuple(responses.shape)} are not (channel, band) of {len(bands.centres)} bands: "
            "give both the same `bands` step"
        )
    centres = bands.centres.double().to(responses.device)
    channels = responses.double() * centres
    return torch.cat([channels, centres[None]]) if well else channels


@rows.check
def _(result: Tensor, *inputs: object, **params: object) -> list[Check]:
    rank = int(torch.linalg.matrix_rank(result / result.abs().amax(1, keepdim=True).clamp_min(1e-300)))
    return [Check(f"{len(result)} rows of {result.shape[1]} bands, rank {rank}")]
