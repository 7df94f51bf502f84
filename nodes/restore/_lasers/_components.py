"""What adds light to a frame beside the scene: a laser of one line, a lamp of many bands."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.optics import psf as focus
from neusee.nodes.optics._transform._fft_transforms import fft_length
from neusee.nodes.restore._inverse._masked_blur import grey_shares
from neusee.nodes.restore._inverse._wiener import View
from neusee.nodes.restore._lasers._line_pattern import (
    Lens,
    deviation,
    line_moves,
    line_pattern,
    response_at,
)
from neusee.nodes.values import Bands, Pupil

# --- lamp light -----------------------------------------------------------------------------------

# The light that a point source of many wavelengths adds to each channel, over the whole frame.


_TILT_SCALE = 50e-9  #: m, the scale of the tilt and the bend of a lamp's spectrum
_FINEST_SAMPLING, _MOST_SAMPLES = (
    4,
    4096,
)  #: samples a pixel, and samples a side of a pattern, at most
#: pixels beyond the farthest of the frame, over which a pattern fades, for a step rings when it is
#: moved
_RIM = 10


class LampLight(NamedTuple):
    """Patterns of a point source of many wavelengths: even, tilted and bent spectra, as each
    channel sees them.
    """

    #: (kind, channel, fy, fx), half spectra on a torus, with the spot in its first sample
    spectra: Tensor
    torus: tuple[int, int]  #: samples
    finer: int  #: samples a pixel along each axis, enough for the finest detail of a pattern
    #: (channel,), electrons of each channel from the illuminant, relative to the largest
    colour: Tensor
    patterns: Tensor  #: (channel, y, x) of the even spectrum, in pixels


def lamp_light(view: View, pupil: Pupil, lens: Lens, dtype: torch.dtype) -> LampLight:
    """Return what a lamp adds to each channel, from a spot anywhere in the frame to every pixel.

    A lamp that clips the sensor adds light farther from its spot than the window of the PSF
    reaches, and its spot lies between pixels, where a pattern that is sampled by pixels cannot be
    moved to. So the pattern is computed from ``pupil``, as that of a laser is, over the whole frame
    and on a finer grid. What the PSF has beyond it within its window, such as stray light, is
    added.
    """
    psf, illuminant, responses, bands = view
    kinds = _kinds(illuminant, responses, bands).to(psf.intensity.device, dtype)
    finer, (y, x) = _finer(pupil, lens), (lens.shape[0] + _RIM, lens.shape[1] + _RIM)
    torus = (fft_length(2 * y + 1), fft_length(2 * x + 1))  # pixels
    fine_torus = (finer * torus[0], finer * torus[1])
    spectra = torch.fft.rfft2(_fine_patterns(kinds, pupil, lens, finer), s=fine_torus)
    # the spot from the middle of the window to the first sample
    spectra = spectra * phases(
        fine_torus, torch.tensor([-float(finer * y), -float(finer * x)]).to(kinds)
    )
    spectra = spectra * _pixel(fine_torus, finer, lens).to(kinds)
    coarse_patterns = torch.fft.irfft2(spectra, s=fine_torus)[..., ::finer, ::finer].roll(
        (y, x), (-2, -1)
    )
    coarse_patterns = coarse_patterns[..., : 2 * y + 1, : 2 * x + 1]
    beyond_pupil = _beyond_pupil(
        torch.einsum("kcb,byx->kcyx", kinds, psf.intensity.to(kinds)), coarse_patterns
    )
    phase_to_corner = phases(torus, torch.tensor([-float(y), -float(x)]).to(kinds))
    spectra = spectra + _between_pixels(
        torch.fft.rfft2(beyond_pupil, s=torus) * phase_to_corner, torus, finer
    )
    channel_light = (
        responses.cpu().double() * illuminant.cpu().double() * bands.centres.cpu()
    ).sum(-1)
    return LampLight(
        spectra,
        fine_torus,
        finer,
        (channel_light / channel_light.max()).to(kinds),
        (coarse_patterns + beyond_pupil)[0],
    )


def phases(torus: tuple[int, int], move: Tensor) -> Tensor:
    """Return the factor of a half spectrum that moves a picture by (y, x) samples."""
    y, x = torus
    fy, fx = torch.fft.fftfreq(y).to(move), torch.fft.rfftfreq(x).to(move)
    turns = fy[:, None] * move[0] + fx * move[1]
    return torch.polar(torch.ones_like(turns), -2 * torch.pi * turns)


def _kinds(illuminant: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return the share of each band in each channel for the three kinds of spectra: (kind,
    channel, band).
    """
    shares, centres = grey_shares(illuminant, responses, bands), bands.centres.cpu()
    tilt = (centres - (shares * centres).sum(-1, keepdim=True)) / _TILT_SCALE
    return torch.stack([shares, shares * tilt, shares * tilt.square()])


def _finer(pupil: Pupil, lens: Lens) -> int:
    """Return how many samples a pixel the finest fringe of the lens asks for, within limits of
    time and memory.
    """
    pupil_width = max(int((pupil.aperture.amax(axis) > 0).sum()) for axis in (0, 1)) * float(
        pupil.pitch
    )
    # Nyquist: two samples for the finest fringe, wavelength x focal length / pupil width
    samples_needed = (
        2.0 * lens.pixel_pitch * pupil_width / (float(pupil.wavelengths.min()) * lens.focal_length)
    )
    return max(
        1,
        min(
            math.ceil(samples_needed), _FINEST_SAMPLING, _MOST_SAMPLES // (2 * max(lens.shape) + 1)
        ),
    )


def _fine_patterns(kinds: Tensor, pupil: Pupil, lens: Lens, finer: int) -> Tensor:
    """Return the patterns (kind, channel, y, x) with the spot in the middle sample, as the light
    in each sample.
    """
    window_sides = tuple(2 * finer * (n + _RIM) + 1 for n in lens.shape)
    pitch = lens.pixel_pitch / finer
    total = torch.zeros(*kinds.shape[:2], *window_sides).to(kinds)
    for band in range(kinds.shape[-1]):
        band_pupil = pupil._replace(
            wavelengths=pupil.wavelengths[band][None], index=pupil.index[band][None]
        )
        # samples
        alias_free = (
            float(band_pupil.wavelengths[0]) * lens.focal_length / (float(pupil.pitch) * pitch)
        )
        pattern_sides = tuple(
            min(side, 2 * max(int(alias_free / 2) - 1, 0) + 1) for side in window_sides
        )
        camera = {"focal_length": lens.focal_length, "pixel_pitch": pitch, "sensor": lens.sensor}
        light = _framed(
            focus(band_pupil, shape=pattern_sides, **camera).intensity[0].to(kinds), window_sides
        )
        total += kinds[:, :, band, None, None] * light
    row_fading, column_fading = (_fading(n, finer).to(kinds) for n in lens.shape)
    return total * row_fading[:, None] * column_fading


def _fading(pixels: int, finer: int) -> Tensor:
    """Return the factor of the samples along one axis, 1 as far as the frame reaches from any
    spot in it.
    """
    distance = torch.arange(-finer * (pixels + _RIM), finer * (pixels + _RIM) + 1).abs() / finer
    return 0.5 + 0.5 * torch.cos(torch.pi * ((distance - pixels - 1) / (_RIM - 1)).clamp(0.0, 1.0))


def _pixel(fine: tuple[int, int], finer: int, lens: Lens) -> Tensor:
    """Return the factor of a half spectrum of the light in samples that makes it the light in
    the pixel around each.
    """
    if lens.sensor != "integrated":  # a pixel has the light of its middle, times its area
        return torch.tensor(float(finer**2))
    sample_offsets = torch.arange(finer, dtype=torch.float64) - (finer - 1) / 2
    fy, fx = torch.fft.fftfreq(fine[0]).double(), torch.fft.rfftfreq(fine[1]).double()
    # sum of the phases of the samples in a pixel, symmetric about its middle
    row_factor, column_factor = (
        torch.cos(2 * torch.pi * f[:, None] * sample_offsets).sum(1) for f in (fy, fx)
    )
    return row_factor[:, None] * column_factor


def _beyond_pupil(inner: Tensor, coarse: Tensor) -> Tensor:
    """Return what patterns have in their window beyond others of odd sides, in the size of the
    latter.
    """
    sides = coarse.shape[-2:]
    inside = _framed(torch.ones_like(inner), sides) > 0
    return torch.where(inside, _framed(inner, sides) - coarse, 0.0)


def _between_pixels(spectra: Tensor, torus: tuple[int, int], finer: int) -> Tensor:
    """Return half spectra of pictures in pixels as those of the smoothest pictures on the finer
    grid.
    """
    (y, x), columns = torus, (torus[1] + 1) // 2
    fine_spectra = spectra.new_zeros(*spectra.shape[:-2], finer * y, finer * x // 2 + 1)
    fine_spectra[..., : (y + 1) // 2, :columns] = spectra[..., : (y + 1) // 2, :columns]
    fine_spectra[..., finer * y - (y - 1) // 2 :, :columns] = spectra[
        ..., y - (y - 1) // 2 :, :columns
    ]
    # an FFT on a finer grid sums over so many more samples
    return fine_spectra * finer**2


def _framed(picture: Tensor, sides: tuple[int, ...]) -> Tensor:
    """Return pictures (..., y, x), cropped or continued with 0, whose middle pixel stays in the
    middle.
    """
    rims = []
    # `pad` counts from the last axis
    for n, side in zip(picture.shape[:-3:-1], sides[::-1], strict=True):
        rims += [side // 2 - n // 2, side - side // 2 - (n - n // 2)]
    return pad(picture, rims)


# --- components -----------------------------------------------------------------------------------

# What adds light to a frame beside the scene: a laser, of one spectral line, and a lamp, of light
# in many bands.


NANOMETRE = 1e-9
#: nm^2, standard deviation of the variance of a line, or that variance itself where it is more
_WIDTH = 0.5
_WIDEST_VARIANCE = 50.0  #: nm^2, most that is added to the variance of a line
_RESPONSE_ERROR = 0.03  #: relative standard deviation of the response of a channel to one line
#: the same as a share of the largest response, for a channel that hardly sees the line
_BLIND = 0.003


class Camera(NamedTuple):
    """What is known of the camera, on one device in float64."""

    pupil: Pupil
    responses: Tensor  #: (channel, band)
    bands: Bands
    lens: Lens
    fwhm: Tensor  #: () float64, m, of a line


@dataclass(frozen=True)
class Laser:
    """A laser: place (y, x) of the spot in pixels from the middle, wavelength in nm, strength,
    width, errors.
    """

    camera: Camera
    #: (5 + channel,): y, x, nm, electrons at response 1, nm^2 of the variance of the line beyond
    #: that of the camera's ``fwhm``, and the errors of the responses over their spread
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
        response, spread = self._response(self.values[2])
        return self.values[3] * (response + spread * self.values[5:])

    def columns(self, of: Callable[[Tensor], Tensor]) -> Tensor:
        """Return ``of`` of the change of the light for a unit change of each value: (value,
        channel, ...).

        ``of`` is linear, treats each channel by itself, and takes pictures (picture, 1 or channel,
        y, x).
        """
        # one picture for all channels before, one for each after
        filtered = of(self._slopes()[:, None])
        ones = (1,) * (filtered.ndim - 2)
        channels = self.channels().view(-1, *ones)
        response, spread = self._response(self.values[2])
        wavelength_column = (
            channels * filtered[3] + self._response_slope().view(-1, *ones) * filtered[0]
        )
        # in the order of `values`: y, x, nm, strength, variance of the line, errors of responses
        columns = [
            channels * filtered[1],
            channels * filtered[2],
            wavelength_column,
            (channels / self.values[3].clamp_min(1e-9)) * filtered[0],
        ]
        columns.append(channels * filtered[4])
        for i in range(len(response)):
            response_column = torch.zeros_like(response)
            response_column[i] = self.values[3] * spread[i]
            columns.append(response_column.view(-1, *ones) * filtered[0])
        return torch.stack(columns)

    def _slopes(self) -> Tensor:
        """Return the pattern and its change with y, x (pixels), wavelength (nm) and variance
        (nm^2): (5, y, x).
        """
        camera, place = self.camera, self.values[:3].double()
        moves = line_moves(camera.pupil, place[:2], place[2] * NANOMETRE, camera.lens, self.fwhm)
        moves = moves._replace(wave=moves.wave * NANOMETRE, blur=moves.blur * NANOMETRE**2)
        return torch.stack(list(moves)).to(self.values)

    def moved(self, step: Tensor) -> Laser:
        """Return the laser after a step, which stays in the range of the bands and near the
        frame.
        """
        centres, shape = self.camera.bands.centres / NANOMETRE, self.camera.lens.shape
        longest_step = torch.tensor([1.0, 1.0, 5.0]).to(step)
        step = torch.cat(
            [torch.maximum(torch.minimum(step[:3], longest_step), -longest_step), step[3:]]
        )
        values = self.values + step
        for i in range(2):
            values[i] = values[i].clamp(-0.5 * shape[i] - 1, 0.5 * shape[i] + 1)
        values[2] = values[2].clamp(float(centres.min()), float(centres.max()))
        values[3] = values[3].clamp_min(1e-3 * self.values[3].abs())
        values[4] = values[4].clamp(-self._variance(), _WIDEST_VARIANCE)
        return replace(self, values=values)

    def channel_slopes(self) -> Tensor:
        """Return the change of the electrons of each channel for a unit change of each value:
        (channel, value).
        """
        response, spread = self._response(self.values[2])
        slopes = torch.zeros(len(response), len(self.values)).to(self.values)
        slopes[:, 2] = self._response_slope()
        slopes[:, 3] = response + spread * self.values[5:]
        slopes[:, 5:] = torch.diag(self.values[3] * spread)
        return slopes

    def _response(self, nm: Tensor) -> tuple[Tensor, Tensor]:
        """Return the response (channel,) at a wavelength in nm, and its standard deviation."""
        response = response_at(nm * NANOMETRE, self.camera.responses, self.camera.bands)
        return response, _RESPONSE_ERROR * response + _BLIND * self.camera.responses.max()

    def _response_slope(self) -> Tensor:
        """Return the change of each channel's electrons with wavelength, by nm: a central
        difference.
        """
        responses = [self._response(self.values[2] + sign)[0] for sign in (1, -1)]
        return self.values[3] * (responses[0] - responses[1]) / 2.0

    def _pattern(self, place: Tensor) -> Tensor:
        """Return the share (y, x) of the light in each pixel, for y, x in pixels and nm."""
        lens = self.camera.lens
        place = place.double()  # phases need that
        direction = place[:2] * (lens.pixel_pitch / lens.focal_length)
        pattern = line_pattern(self.camera.pupil, direction, place[2] * NANOMETRE, lens, self.fwhm)
        return pattern.to(self.values)


@dataclass(frozen=True)
class Lamp:
    """A lamp: place (y, x) of its spot in pixels from the middle, and electrons in each channel
    by kind of spectrum.
    """

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
        """Return ``of`` of the change of the light for a unit change of each value: (value,
        channel, ...).

        ``of`` is linear, treats each channel by itself, and takes pictures (picture, channel, y,
        x).
        """
        kinds, channels = self.light.spectra.shape[:2]
        filtered = of(torch.stack([self._pictures(slope) for slope in self._slopes()]))
        amounts = filtered.new_zeros(kinds * channels, *filtered.shape[1:])
        for k in range(kinds):
            for c in range(channels):
                # an amount of a kind changes its own channel alone; the first two are y and x
                amounts[k * channels + c, c] = filtered[2 + k, c]
        return torch.cat([filtered[:2], amounts])

    def _slopes(self) -> Iterator[Tensor]:
        """Yield the spectra of the changes with y, x (pixels) and each kind, one after another
        to save memory.
        """
        (y, x), spectra = self.light.torus, self._spectra()
        fy, fx = (
            torch.fft.fftfreq(y).to(self.values)[:, None],
            torch.fft.rfftfreq(x).to(self.values),
        )
        for frequency in (fy, fx):
            yield -2j * torch.pi * self.light.finer * frequency * spectra
        for kind in self.light.spectra:
            yield kind * self._phase()

    def moved(self, step: Tensor) -> Lamp:
        """Return the lamp after a step of at most a pixel."""
        values = self.values + torch.cat([step[:2].clamp(-1.0, 1.0), step[2:]])
        for i in range(2):
            values[i] = values[i].clamp(-0.5 * self.shape[i] - 1, 0.5 * self.shape[i] + 1)
        return replace(self, values=values)

    def _spectra(self) -> Tensor:
        """Return the spectra (channel, fy, fx) of the lamp's light, with its spot in place."""
        amount_by_kind = self.values[2:].view(len(self.light.spectra), -1, 1, 1)
        return (amount_by_kind * self.light.spectra).sum(0) * self._phase()

    def _phase(self) -> Tensor:
        """Return the factor (fy, fx) that moves a spot from the first sample to its place."""
        middle_pixel = torch.tensor([self.shape[0] // 2, self.shape[1] // 2]).to(self.values)
        return phases(self.light.torus, self.light.finer * (self.values[:2] + middle_pixel))

    def _pictures(self, spectra: Tensor) -> Tensor:
        """Return the pictures (..., y, x) of half spectra on the torus of fine samples: one sample
        of each pixel of the frame.
        """
        samples_per_pixel, (y, x) = self.light.finer, self.light.torus
        rows = torch.fft.ifft(spectra, n=y, dim=-2)[
            ..., : samples_per_pixel * self.shape[0] : samples_per_pixel, :
        ]
        row_samples: Tensor = torch.fft.irfft(rows, n=x, dim=-1)
        return row_samples[..., : samples_per_pixel * self.shape[1] : samples_per_pixel]
