"""What adds light to a frame beside the scene: a laser, of one spectral line, and a lamp, of light in many bands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._lasers._lamp_light import LampLight, phases
from neusee.nodes.restore._lasers._line_pattern import Lens, deviation, line_moves, line_pattern, response_at
from neusee.nodes.values import Bands, Pupil

NANOMETRE = 1e-9
_WIDTH = 0.5  #: nm^2, standard deviation of the variance of a line, or that variance itself where it is more
_WIDEST = 50.0  #: nm^2, most that is added to the variance of a line
_KNOWN = 0.03  #: relative standard deviation of the response of a channel to one line
_BLIND = 0.003  #: the same as a share of the largest response, for a channel that hardly sees the line


class Camera(NamedTuple):
    """What is known of the camera, on one device in float64."""

    pupil: Pupil
    responses: Tensor  #: (channel, band)
    bands: Bands
    lens: Lens
    fwhm: Tensor  #: () float64, m, of a line


@dataclass(frozen=True)
class Laser:
    """A laser: place (y, x) of the spot in pixels from the middle, wavelength in nm, strength, width, errors."""

    camera: Camera
    #: (5 + channel,): y, x, nm, electrons at response 1, nm^2 of the variance of the line beyond that of the camera's
    #: ``fwhm``, and the errors of the responses over their spread
    values: Tensor

    @property
    def precision(self) -> Tensor:
        """Return the prior precision of each value."""
        width = torch.tensor([max(self._variance(), _WIDTH) ** -2])
        return torch.cat([torch.zeros(4), width, torch.ones(len(self.values) - 5)]).to(self.values)

    @property
    def fwhm(self) -> Tensor:
        """Return the width of the line in m, at half maximum: () float64."""
        variance = (self._variance() + self.values[4].double()).clamp_min(0.0)
        return self.camera.fwhm * (variance / self._variance()).sqrt()

    def _variance(self) -> float:
        return float(deviation(self.camera.fwhm) / NANOMETRE) ** 2

    def electrons(self) -> Tensor:
        """Return the light of the laser in each pixel of each channel."""
        return self.channels()[:, None, None] * self._pattern(self.values[:3])

    def channels(self) -> Tensor:
        """Return the electrons of each channel over the whole pattern."""
        heard, spread = self._response(self.values[2])
        return self.values[3] * (heard + spread * self.values[5:])

    def columns(self, of: Callable[[Tensor], Tensor]) -> Tensor:
        """Return ``of`` of the change of the light for a unit change of each value: (value, channel, ...).

        ``of`` is linear, treats each channel by itself, and takes pictures (picture, 1 or channel, y, x).
        """
        seen = of(self._slopes()[:, None])  # one picture for all channels before, one for each after
        ones = (1,) * (seen.ndim - 2)
        channels = self.channels().view(-1, *ones)
        heard, spread = self._response(self.values[2])
        wave = channels * seen[3] + self._response_slope().view(-1, *ones) * seen[0]
        columns = [channels * seen[1], channels * seen[2], wave, (channels / self.values[3].clamp_min(1e-9)) * seen[0]]
        columns.append(channels * seen[4])
        for i in range(len(heard)):
            one = torch.zeros_like(heard)
            one[i] = self.values[3] * spread[i]
            columns.append(one.view(-1, *ones) * seen[0])
        return torch.stack(columns)

    def _slopes(self) -> Tensor:
        """Return the pattern and its change with y, x (pixels), wavelength (nm) and variance (nm^2): (5, y, x)."""
        camera, at = self.camera, self.values[:3].double()
        moves = line_moves(camera.pupil, at[:2], at[2] * NANOMETRE, camera.lens, self.fwhm)
        moves = moves._replace(wave=moves.wave * NANOMETRE, blur=moves.blur * NANOMETRE**2)
        return torch.stack(list(moves)).to(self.values)

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
        values[4] = values[4].clamp(-self._variance(), _WIDEST)
        return replace(self, values=values)

    def channel_slopes(self) -> Tensor:
        """Return the change of the electrons of each channel for a unit change of each value: (channel, value)."""
        heard, spread = self._response(self.values[2])
        slopes = torch.zeros(len(heard), len(self.values)).to(self.values)
        slopes[:, 2] = self._response_slope()
        slopes[:, 3] = heard + spread * self.values[5:]
        slopes[:, 5:] = torch.diag(self.values[3] * spread)
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
        pattern = line_pattern(self.camera.pupil, towards, at[2] * NANOMETRE, lens, self.fwhm)
        return pattern.to(self.values)


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

    def columns(self, of: Callable[[Tensor], Tensor]) -> Tensor:
        """Return ``of`` of the change of the light for a unit change of each value: (value, channel, ...).

        ``of`` is linear, treats each channel by itself, and takes pictures (picture, channel, y, x).
        """
        kinds, channels = self.light.spectra.shape[:2]
        seen = of(torch.stack([self._pictures(each) for each in self._slopes()]))
        amounts = seen.new_zeros(kinds * channels, *seen.shape[1:])
        for k in range(kinds):
            for c in range(channels):
                amounts[k * channels + c, c] = seen[2 + k, c]
        return torch.cat([seen[:2], amounts])

    def _slopes(self) -> Iterator[Tensor]:
        """Yield the spectra of the changes with y, x (pixels) and each kind, one after another to save memory."""
        (y, x), whole = self.light.torus, self._spectra()
        fy, fx = torch.fft.fftfreq(y).to(self.values)[:, None], torch.fft.rfftfreq(x).to(self.values)
        for frequency in (fy, fx):
            yield -2j * torch.pi * self.light.finer * frequency * whole
        for kind in self.light.spectra:
            yield kind * self._phase()

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
        return phases(self.light.torus, self.light.finer * (self.values[:2] + middle))

    def _pictures(self, spectra: Tensor) -> Tensor:
        step, (y, x) = self.light.finer, self.light.torus
        rows = torch.fft.ifft(spectra, n=y, dim=-2)[..., : step * self.shape[0] : step, :]
        whole: Tensor = torch.fft.irfft(rows, n=x, dim=-1)
        return whole[..., : step * self.shape[1] : step]
