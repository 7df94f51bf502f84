"""What the channels of a sensor see of a grey scene: the PSF of each, shares of the bands, and the white."""

from __future__ import annotations

import torch
from torch import Tensor

from neusee.nodes._half_precision import single
from neusee.nodes.values import Bands, Psf


def effective_psf(
    psf: Psf, illuminant: Tensor, responses: Tensor, bands: Bands, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Return the PSF of each channel of the sensor for a grey scene, (channel, y, x), in the more precise of the types
    of the PSF and ``dtype``.
    """
    lengths = {len(psf.intensity), len(illuminant), responses.shape[-1], len(bands.centres)}
    if len(lengths) > 1:
        raise ValueError(f"PSF, illuminant, responses and bands have {sorted(lengths)} bands: use one `bands` step")
    intensity = single(psf.intensity)
    shares = grey_shares(illuminant, responses, bands).to(intensity.device)
    if torch.promote_types(intensity.dtype, dtype) == intensity.dtype:
        whole: Tensor = torch.tensordot(shares.to(intensity), intensity, 1)
        return whole
    planes = zip(shares.to(dtype).T, intensity, strict=True)  # band by band, without a copy of all bands
    seen = torch.zeros(len(shares), *intensity.shape[-2:], dtype=dtype, device=intensity.device)
    for share, plane in planes:
        seen = seen + share[:, None, None] * plane.to(dtype)
    return seen


def grey_shares(illuminant: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return the share of each band in the signal of each channel from a grey scene: (channel, band), float64."""
    share = responses.cpu().double() * illuminant.cpu().double() * bands.centres.cpu()
    blind = share.sum(-1, keepdim=True) <= 0  # a channel without response gets equal shares
    share = share.where(~blind, 1.0)
    return share / share.sum(-1, keepdim=True)


def grey_white(illuminant: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return what each channel sees of a grey scene, (channel, 1, 1) float64, over what the best channel sees."""
    light = (responses.cpu().double() * illuminant.cpu().double() * bands.centres.cpu()).sum(-1)
    return (light / light.max().clamp_min(1e-30)).clamp_min(1e-3)[:, None, None]
