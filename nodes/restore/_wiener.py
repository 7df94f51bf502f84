"""Wiener deconvolution with the known PSF: the baseline that learns nothing."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from neusee.nodes import Check, node
from neusee.nodes.optics._image import reach, smooth
from neusee.nodes.units import Electrons
from neusee.nodes.values import Bands, Psf


@node()
def wiener(
    electrons: Tensor,
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    clipped: Tensor,
    *,
    balance: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0,
    read_noise: Electrons,
) -> Tensor:
    """Undo the blur of each channel as far as its noise allows: conj(H) / (|H|^2 + balance x noise / signal).

    H belongs to the PSF that the channel sees of a grey scene: the mean over bands, weighted by illuminant x response x
    wavelength. The signal falls as 1 / frequency^2, as pictures do, with the power that this picture has. The noise is
    shot and read noise plus what is not known at all: clipped values, which are first filled from around them, and
    light that came over the edge, where the picture is mirrored and faded to its mean; that falls like the signal.

    Shapes: electrons and clipped (3, y, x), psf.intensity (band, any, any), responses (3, band) -> (3, y, x).
    Units:  e-; the result as if the lens were perfect and lost nothing.
    Error:  white noise and a grey scene are assumed; a laser's glare that does not clip is taken for scene. Unknown
            light counts as large as the mean of the picture.
    Raises: ValueError where shapes or bands differ.
    Source: Wiener filter as in Gonzalez and Woods, Digital Image Processing, 4th ed., ch. 5; filling by push and pull,
            Gortler et al., The Lumigraph, SIGGRAPH 1996.
    """
    if electrons.shape != clipped.shape or len(responses) != electrons.shape[-3]:
        raise ValueError(
            f"electrons {tuple(electrons.shape)}, clipped {tuple(clipped.shape)} and responses "
            f"{tuple(responses.shape)} must have the same channels and pixels"
        )
    kernels = effective_psf(psf, illuminant, responses, bands).to(electrons)
    layers = zip(electrons, clipped, kernels, strict=True)
    return torch.stack([_deconvolve(e, c, k, balance, read_noise) for e, c, k in layers])


@wiener.check
def _(result: Tensor, electrons: Tensor, *inputs: Any, **params: float) -> list[Check]:
    share = float(inputs[-1].any(-3).double().mean())
    finite = math.isfinite(float(result.sum()))
    return [
        Check(f"{share:.2%} filled in before, mean {float(result.mean() / electrons.mean()):.2f} of the raw", finite)
    ]


def effective_psf(psf: Psf, illuminant: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """The PSF that each channel sees of a grey scene: (channel, y, x)."""
    lengths = {len(psf.intensity), len(illuminant), responses.shape[-1], len(bands.centres)}
    if len(lengths) > 1:
        raise ValueError(f"PSF, illuminant, responses and bands have {sorted(lengths)} bands: give one `bands` step")
    share = responses.cpu().double() * illuminant.cpu().double() * bands.centres.cpu()
    share = share / share.sum(-1, keepdim=True)
    seen: Tensor = torch.tensordot(share.to(psf.intensity), psf.intensity, 1)
    return seen


def _deconvolve(electrons: Tensor, clipped: Tensor, kernel: Tensor, balance: float, read: float) -> Tensor:
    (y, x), kernel = electrons.shape, reach(reach(kernel, -2, electrons.shape[0]), -1, electrons.shape[1])
    edge = (kernel.shape[0] // 2, kernel.shape[1] // 2)
    size = (smooth(y + 2 * edge[0]), smooth(x + 2 * edge[1]))
    picture = filled(electrons, ~clipped)
    mean = picture.mean()
    spectrum = torch.fft.rfft2(_faded(picture - mean, edge), s=size)
    transfer = torch.fft.rfft2(_centred(kernel, size))
    shape = _fall(size).to(picture)
    white = (mean + read**2).clamp_min(1e-3) + mean.square() * clipped.double().mean().to(mean)
    noise = white + mean.square() * _over_the_edge(transfer, (y, x), size) * shape
    power = _power(spectrum, transfer, shape, white)
    gain = transfer.conj() / (transfer.abs().square() + balance * noise / (power * shape))
    sharp: Tensor = torch.fft.irfft2(gain * spectrum, s=size)[edge[0] : edge[0] + y, edge[1] : edge[1] + x]
    return sharp + mean / kernel.sum().clamp_min(1e-3)


def _fall(size: tuple[int, int]) -> Tensor:
    """Power of pictures by frequency, 1 / frequency^2, with mean 1."""
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in size)
    fall: Tensor = 1.0 / (fy[:, None].square() + fx[None, : size[1] // 2 + 1].square() + 1.0 / (size[0] * size[1]))
    return fall / fall.mean()


def _power(spectrum: Tensor, transfer: Tensor, shape: Tensor, noise: Tensor) -> Tensor:
    """Variance of the scene that explains the variance of this picture, a hundredth of it at least."""
    seen: Tensor = spectrum.abs().square().mean() / spectrum.shape[0] / (2 * spectrum.shape[1] - 1)
    passed: Tensor = (transfer.abs().square() * shape).mean()
    power: Tensor = torch.maximum(seen - noise, 0.01 * seen) / passed.clamp_min(1e-6)
    return power.clamp_min(1e-6)


def _over_the_edge(transfer: Tensor, inside: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Mean square share of the light of a pixel that comes from outside the picture."""
    window = torch.ones(inside, device=transfer.device, dtype=transfer.real.dtype)
    kept: Tensor = torch.fft.irfft2(torch.fft.rfft2(window, s=size) * transfer, s=size)[: inside[0], : inside[1]]
    lost: Tensor = transfer[0, 0].real - kept
    return lost.square().mean()


def _centred(kernel: Tensor, size: tuple[int, int]) -> Tensor:
    """The kernel in zeros, its centre at the first sample."""
    m, n = kernel.shape
    return pad(kernel, (0, size[1] - n, 0, size[0] - m)).roll((-(m // 2), -(n // 2)), (0, 1))


def _faded(picture: Tensor, edge: tuple[int, int]) -> Tensor:
    """Mirror the picture at its edges and fade it to nothing."""
    wide = pad(picture[None, None], (edge[1], edge[1], edge[0], edge[0]), mode="reflect")[0, 0]
    for dim, width in enumerate(edge):
        ramp = torch.ones(wide.shape[dim], dtype=wide.dtype, device=wide.device)
        rise = 0.5 - 0.5 * torch.cos(math.pi * (torch.arange(width, device=wide.device) + 0.5) / max(width, 1))
        ramp[:width], ramp[wide.shape[dim] - width :] = rise, rise.flip(0)
        wide = wide * (ramp[:, None] if dim == 0 else ramp)
    return wide


def filled(picture: Tensor, known: Tensor) -> Tensor:
    """Fill the unknown from ever coarser means of the known around it; nothing known leaves the picture."""
    if not bool(known.any()):
        return picture
    weight = known.to(picture)[None, None]
    levels = [(picture * weight, weight)]
    while max(levels[-1][0].shape[-2:]) > 1:
        levels.append(tuple(avg_pool2d(t, 2, ceil_mode=True) for t in levels[-1]))  # type: ignore[arg-type]
    total, weight = levels.pop()
    guess = total / weight
    for total, weight in reversed(levels):
        coarse = interpolate(guess, size=total.shape[-2:], mode="bilinear", align_corners=False)
        guess = torch.where(weight > 0, total / weight.where(weight > 0, 1.0), coarse)
    return torch.where(known, picture, guess[0, 0])
