"""What adds light to a frame beside the scene: a laser, of one spectral line, and a lamp, of light in many bands."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._inverse._wiener import grey_shares
from neusee.nodes.restore._lasers._line_pattern import Lens, line_pattern, response_at
from neusee.nodes.restore._lasers._whitening import fast_size
from neusee.nodes.values import Bands, Psf, Pupil

NANOMETRE = 1e-9
_STEP = (0.02, 0.02, 0.1)  #: pixels, pixels and nm, over which the slope of a pattern is taken
_KNOWN = 0.03  #: relative standard deviation of the response of a channel to one line
_BLIND = 0.003  #: the same as a share of the largest response, for a channel that hardly sees the line
_TILT = 50e-9  #: m, the scale of the tilt and the bend of a lamp's spectrum


class Camera(NamedTuple):
    """What is known of the camera, on one device in float64."""

    pupil: Pupil
    responses: Tensor  #: (channel, band)
    bands: Bands
    lens: Lens
    fwhm: Tensor  #: () float64, m, of a line


@dataclass(frozen=True)
class Laser:
    """A laser: place (y, x) of the spot in pixels from the middle, wavelength in nm, strength, errors of response."""

    camera: Camera
    values: Tensor  #: (4 + channel,): y, x, nm, electrons at response 1, errors of the responses over their spread

    @property
    def precision(self) -> Tensor:
        """Return the prior precision of each value."""
        return torch.cat([torch.zeros(4), torch.ones(len(self.values) - 4)]).to(self.values)

    def electrons(self) -> Tensor:
        """Return the light of the laser in each pixel of each channel."""
        return self.channels()[:, None, None] * self._pattern(self.values[:3])

    def channels(self) -> Tensor:
        """Return the electrons of each channel over the whole pattern."""
        heard, spread = self._response(self.values[2])
        return self.values[3] * (heard + spread * self.values[4:])

    def columns(self) -> Tensor:
        """Return the change of the light for a unit change of each value: (value, channel, y, x)."""
        pattern, channels = self._pattern(self.values[:3]), self.channels()[:, None, None]
        columns = []
        for i, step in enumerate(_STEP):
            move = torch.zeros(3).to(self.values)
            move[i] = step
            ends = [self._pattern(self.values[:3] + sign * move) for sign in (1, -1)]
            columns.append(channels * (ends[0] - ends[1]) / (2 * step))
        columns[2] = columns[2] + self._response_slope()[:, None, None] * pattern
        heard, spread = self._response(self.values[2])
        columns.append((channels / self.values[3].clamp_min(1e-9)) * pattern)
        for i in range(len(heard)):
            one = torch.zeros_like(heard)
            one[i] = self.values[3] * spread[i]
            columns.append(one[:, None, None] * pattern)
        return torch.stack(columns)

    def moved(self, step: Tensor) -> Laser:
        """Return the laser after a step, which stays in the range of the bands and near the frame."""
        centres, shape = self.camera.bands.centres / NANOMETRE, self.camera.lens.shape
        most = torch.tensor([1.0, 1.0, 5.0]).to(step)
        step = torch.cat([torch.maximum(torch.minimum(step[:3], most), -most), step[3:]])
        values = self.values + step
        for i in range(2):
            values[i] = values[i].clamp(-0.5 * shape[i] - 1, 0.5 * shape[i] + 1)
        values[2] = values[2].clamp(float(centres.min()), float(centres.max()))
        values[3] = values[3].clamp_min(1e-3 * self.values[3].abs())
        return replace(self, values=values)

    def channel_slopes(self) -> Tensor:
        """Return the change of the electrons of each channel for a unit change of each value: (channel, value)."""
        heard, spread = self._response(self.values[2])
        slopes = torch.zeros(len(heard), len(self.values)).to(self.values)
        slopes[:, 2] = self._response_slope()
        slopes[:, 3] = heard + spread * self.values[4:]
        slopes[:, 4:] = torch.diag(self.values[3] * spread)
        return slopes

    def _response(self, nm: Tensor) -> tuple[Tensor, Tensor]:
        heard = response_at(nm * NANOMETRE, self.camera.responses, self.camera.bands)
        return heard, _KNOWN * heard + _BLIND * self.camera.responses.max()

    def _response_slope(self) -> Tensor:
        ends = [self._response(self.values[2] + sign)[0] for sign in (1, -1)]
        return self.values[3] * (ends[0] - ends[1]) / 2.0

    def _pattern(self, at: Tensor) -> Tensor:
        lens = self.camera.lens
        at = at.double()  # phases need that
        towards = at[:2] * (lens.pixel_pitch / lens.focal_length)
        pattern = line_pattern(self.camera.pupil, towards, at[2] * NANOMETRE, lens, self.camera.fwhm)
        return pattern.to(self.values)


class LampLight(NamedTuple):
    """Patterns of a point source of many wavelengths: even, tilted and bent spectra, as each channel sees them."""

    spectra: Tensor  #: (kind, channel, fy, fx), half spectra on a torus, with the spot in its first pixel
    torus: tuple[int, int]
    colour: Tensor  #: (channel,), electrons of each channel from the illuminant, relative to the largest
    patterns: Tensor  #: (channel, y, x) of the even spectrum


def lamp_light(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    frame: tuple[int, int],
    kind: torch.dtype = torch.float64,
) -> LampLight:
    """Return what a lamp adds to each channel."""
    intensity = psf.intensity.to(kind)
    shares = grey_shares(illuminant, responses, bands)
    middle = (shares * bands.centres.cpu()).sum(-1, keepdim=True)
    tilt = (bands.centres.cpu() - middle) / _TILT
    kinds = torch.stack([shares, shares * tilt, shares * tilt.square()]).to(intensity)
    patterns = torch.einsum("kcb,byx->kcyx", kinds, intensity)
    torus = (fast_size(frame[0] + intensity.shape[-2]), fast_size(frame[1] + intensity.shape[-1]))
    y, x = (n // 2 for n in intensity.shape[-2:])
    spectra = torch.fft.rfft2(patterns, s=torus)
    light = (responses.cpu().double() * illuminant.cpu().double() * bands.centres.cpu()).sum(-1)
    back = _phase(torus, torch.tensor([-float(y), -float(x)]).to(intensity))
    return LampLight(spectra * back, torus, (light / light.max()).to(intensity), patterns[0])


def _phase(torus: tuple[int, int], move: Tensor) -> Tensor:
    """Return the factor of a spectrum that moves a picture by (y, x) pixels."""
    y, x = torus
    fy, fx = torch.fft.fftfreq(y).to(move), torch.fft.rfftfreq(x).to(move)
    turns = fy[:, None] * move[0] + fx * move[1]
    return torch.polar(torch.ones_like(turns), -2 * torch.pi * turns)


@dataclass(frozen=True)
class Lamp:
    """A lamp: place (y, x) of its spot in pixels from the middle, and electrons in each channel by kind of spectrum."""

    light: LampLight
    shape: tuple[int, int]
    values: Tensor  #: (2 + kind x channel,)

    @property
    def precision(self) -> Tensor:
        """Return the prior precision of each value: none."""
        return torch.zeros_like(self.values)

    def electrons(self) -> Tensor:
        """Return the light of the lamp in each pixel of each channel."""
        return self._pictures(self._spectra())

    def columns(self) -> Tensor:
        """Return the change of the light for a unit change of each value: (value, channel, y, x)."""
        (kinds, channels), (y, x) = self.light.spectra.shape[:2], self.light.torus
        whole = self._spectra()
        fy, fx = torch.fft.fftfreq(y).to(self.values)[:, None], torch.fft.rfftfreq(x).to(self.values)
        places = [self._pictures(-2j * torch.pi * turns * whole) for turns in (fy, fx)]
        patterns = self._pictures(self.light.spectra * self._phase())
        amounts = torch.zeros(kinds * channels, channels, *self.shape).to(patterns)
        for k in range(kinds):
            for c in range(channels):
                amounts[k * channels + c, c] = patterns[k, c]
        return torch.cat([torch.stack(places), amounts])

    def moved(self, step: Tensor) -> Lamp:
        """Return the lamp after a step of at most a pixel."""
        values = self.values + torch.cat([step[:2].clamp(-1.0, 1.0), step[2:]])
        for i in range(2):
            values[i] = values[i].clamp(-0.5 * self.shape[i] - 1, 0.5 * self.shape[i] + 1)
        return replace(self, values=values)

    def _spectra(self) -> Tensor:
        amounts = self.values[2:].view(len(self.light.spectra), -1, 1, 1)
        return (amounts * self.light.spectra).sum(0) * self._phase()

    def _phase(self) -> Tensor:
        middle = torch.tensor([self.shape[0] // 2, self.shape[1] // 2]).to(self.values)
        return _phase(self.light.torus, self.values[:2] + middle)

    def _pictures(self, spectra: Tensor) -> Tensor:
        whole: Tensor = torch.fft.irfft2(spectra, s=self.light.torus)
        return whole[..., : self.shape[0], : self.shape[1]]
