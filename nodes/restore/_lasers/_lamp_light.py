"""The light that a point source of many wavelengths adds to each channel, over the whole frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.optics import psf as focus
from neusee.nodes.restore._inverse._grey_psf import grey_shares
from neusee.nodes.restore._lasers._line_pattern import Lens
from neusee.nodes.restore._lasers._whitening import fast_size
from neusee.nodes.values import Bands, Psf, Pupil

_TILT = 50e-9  #: m, the scale of the tilt and the bend of a lamp's spectrum
_FINEST, _MOST = 4, 4096  #: samples a pixel, and samples a side of a pattern, at most
_RIM = 10  #: pixels beyond the farthest of the frame, over which a pattern fades, for a step rings when it is moved


class LampLight(NamedTuple):
    """Patterns of a point source of many wavelengths: even, tilted and bent spectra, as each channel sees them."""

    spectra: Tensor  #: (kind, channel, fy, fx), half spectra on a torus, with the spot in its first sample
    torus: tuple[int, int]  #: samples
    finer: int  #: samples a pixel along each axis, enough for the finest detail of a pattern
    colour: Tensor  #: (channel,), electrons of each channel from the illuminant, relative to the largest
    patterns: Tensor  #: (channel, y, x) of the even spectrum, in pixels


def lamp_light(
    psf: Psf, pupil: Pupil, illuminant: Tensor, responses: Tensor, bands: Bands, lens: Lens, kind: torch.dtype
) -> LampLight:
    """Return what a lamp adds to each channel, from a spot anywhere in the frame to every pixel.

    A lamp that clips the sensor adds light farther from its spot than the window of ``psf`` reaches, and its spot lies
    between pixels, where a pattern that is sampled by pixels cannot be moved to. So the pattern is computed from
    ``pupil``, as that of a laser is, over the whole frame and on a finer grid. What ``psf`` has beyond it within its
    window, such as stray light, is added.
    """
    kinds = _kinds(illuminant, responses, bands).to(psf.intensity.device, kind)
    finer, (y, x) = _finer(pupil, lens), (lens.shape[0] + _RIM, lens.shape[1] + _RIM)
    torus = (fast_size(2 * y + 1), fast_size(2 * x + 1))  # pixels
    fine = (finer * torus[0], finer * torus[1])
    spectra = torch.fft.rfft2(_fine_patterns(kinds, pupil, lens, finer), s=fine)
    spectra = spectra * phases(fine, torch.tensor([-float(finer * y), -float(finer * x)]).to(kinds))
    spectra = spectra * _pixel(fine, finer, lens).to(kinds)
    coarse = torch.fft.irfft2(spectra, s=fine)[..., ::finer, ::finer].roll((y, x), (-2, -1))
    coarse = coarse[..., : 2 * y + 1, : 2 * x + 1]
    more = _beyond_pupil(torch.einsum("kcb,byx->kcyx", kinds, psf.intensity.to(kinds)), coarse)
    back = phases(torus, torch.tensor([-float(y), -float(x)]).to(kinds))
    spectra = spectra + _between_pixels(torch.fft.rfft2(more, s=torus) * back, torus, finer)
    heard = (responses.cpu().double() * illuminant.cpu().double() * bands.centres.cpu()).sum(-1)
    return LampLight(spectra, fine, finer, (heard / heard.max()).to(kinds), (coarse + more)[0])


def phases(torus: tuple[int, int], move: Tensor) -> Tensor:
    """Return the factor of a half spectrum that moves a picture by (y, x) samples."""
    y, x = torus
    fy, fx = torch.fft.fftfreq(y).to(move), torch.fft.rfftfreq(x).to(move)
    turns = fy[:, None] * move[0] + fx * move[1]
    return torch.polar(torch.ones_like(turns), -2 * torch.pi * turns)


def _kinds(illuminant: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return the share of each band in each channel for the three kinds of spectra: (kind, channel, band)."""
    shares, centres = grey_shares(illuminant, responses, bands), bands.centres.cpu()
    tilt = (centres - (shares * centres).sum(-1, keepdim=True)) / _TILT
    return torch.stack([shares, shares * tilt, shares * tilt.square()])


def _finer(pupil: Pupil, lens: Lens) -> int:
    """Return how many samples a pixel the finest fringe of the lens asks for, within limits of time and memory."""
    width = max(int((pupil.aperture.amax(axis) > 0).sum()) for axis in (0, 1)) * float(pupil.pitch)
    needed = 2.0 * lens.pixel_pitch * width / (float(pupil.wavelengths.min()) * lens.focal_length)
    return max(1, min(math.ceil(needed), _FINEST, _MOST // (2 * max(lens.shape) + 1)))


def _fine_patterns(kinds: Tensor, pupil: Pupil, lens: Lens, finer: int) -> Tensor:
    """Return the patterns (kind, channel, y, x) with the spot in the middle sample, as the light in each sample."""
    sides = tuple(2 * finer * (n + _RIM) + 1 for n in lens.shape)
    pitch = lens.pixel_pitch / finer
    total = torch.zeros(*kinds.shape[:2], *sides).to(kinds)
    for band in range(kinds.shape[-1]):
        one = pupil._replace(wavelengths=pupil.wavelengths[band][None], index=pupil.index[band][None])
        free = float(one.wavelengths[0]) * lens.focal_length / (float(pupil.pitch) * pitch)  # samples
        shape = tuple(min(side, 2 * max(int(free / 2) - 1, 0) + 1) for side in sides)
        camera = {"focal_length": lens.focal_length, "pixel_pitch": pitch, "sensor": lens.sensor}
        light = _framed(focus(one, shape=shape, **camera).intensity[0].to(kinds), sides)
        total += kinds[:, :, band, None, None] * light
    down, right = (_fading(n, finer).to(kinds) for n in lens.shape)
    return total * down[:, None] * right


def _fading(pixels: int, finer: int) -> Tensor:
    """Return the factor of the samples along one axis, 1 as far as the frame reaches from any spot in it."""
    away = torch.arange(-finer * (pixels + _RIM), finer * (pixels + _RIM) + 1).abs() / finer
    return 0.5 + 0.5 * torch.cos(torch.pi * ((away - pixels - 1) / (_RIM - 1)).clamp(0.0, 1.0))


def _pixel(fine: tuple[int, int], finer: int, lens: Lens) -> Tensor:
    """Return the factor of a half spectrum of the light in samples that makes it the light in the pixel around each."""
    if lens.sensor != "integrated":  # a pixel has the light of its middle, times its area
        return torch.tensor(float(finer**2))
    steps = torch.arange(finer, dtype=torch.float64) - (finer - 1) / 2
    fy, fx = torch.fft.fftfreq(fine[0]).double(), torch.fft.rfftfreq(fine[1]).double()
    y, x = (torch.cos(2 * torch.pi * f[:, None] * steps).sum(1) for f in (fy, fx))
    return y[:, None] * x


def _beyond_pupil(known: Tensor, coarse: Tensor) -> Tensor:
    """Return what patterns have in their window beyond others of odd sides, in the size of the latter."""
    sides = coarse.shape[-2:]
    inside = _framed(torch.ones_like(known), sides) > 0
    return torch.where(inside, _framed(known, sides) - coarse, 0.0)


def _between_pixels(spectra: Tensor, torus: tuple[int, int], finer: int) -> Tensor:
    """Return half spectra of pictures in pixels as those of the smoothest pictures on the finer grid."""
    (y, x), some = torus, (torus[1] + 1) // 2
    wide = spectra.new_zeros(*spectra.shape[:-2], finer * y, finer * x // 2 + 1)
    wide[..., : (y + 1) // 2, :some] = spectra[..., : (y + 1) // 2, :some]
    wide[..., finer * y - (y - 1) // 2 :, :some] = spectra[..., y - (y - 1) // 2 :, :some]
    return wide * finer**2


def _framed(picture: Tensor, sides: tuple[int, ...]) -> Tensor:
    """Return pictures (..., y, x), cropped or continued with 0, whose middle pixel stays in the middle."""
    rims = []
    for n, side in zip(picture.shape[:-3:-1], sides[::-1], strict=True):  # `pad` counts from the last axis
        rims += [side // 2 - n // 2, side - side // 2 - (n - n // 2)]
    return pad(picture, rims)
