"""Light sources in a frame besides the scene: a laser (one line) and a lamp (many bands)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.optics import psf as focus
from neusee.nodes.optics.transform._fft_transforms import fft_length
from neusee.nodes.restore.inverse._masked_blur import grey_shares
from neusee.nodes.restore.inverse._wiener import View
from neusee.nodes.restore.lasers._line_pattern import (
    Lens,
    deviation,
    line_moves,
    line_pattern,
    response_at,
)
from neusee.nodes.values import Bands, Pupil

# --- lamp light -----------------------------------------------------------------------------------

# The light of a point source with a broad spectrum in each channel, over the whole frame.


_TILT_SCALE = 50e-9  #: m, unit of the wavelength in the linear and quadratic spectra of a lamp
_FINEST_SAMPLING, _MOST_SAMPLES = (
    4,
    4096,
)  #: largest number of samples per pixel, and of samples along a side of a pattern
#: pixels beyond the frame over which a pattern fades to 0: a sharp edge would ring when the pattern
#: is shifted
_RIM = 10


class LampLight(NamedTuple):
    """Patterns of a broadband point source in each channel, for three kinds of spectrum: constant,
    linear and quadratic in wavelength, relative to the illuminant.
    """

    #: (kind, channel, fy, fx), Fourier transforms (`rfft2`) of the patterns on a periodic grid; the
    #: spot is at its first sample
    spectra: Tensor
    torus: tuple[int, int]  #: size of the periodic grid in samples
    finer: int  #: samples per pixel along each axis, for the finest fringe within the limits
    #: (channel,), electrons of each channel from the illuminant, relative to the largest
    colour: Tensor
    patterns: Tensor  #: (channel, y, x), patterns of the constant spectrum, sampled in pixels


def lamp_light(view: View, pupil: Pupil, lens: Lens, dtype: torch.dtype) -> LampLight:
    """Return the patterns of a lamp in each channel, large enough for a spot anywhere in the frame.

    A lamp that clips the sensor adds light beyond the window of the PSF, and its spot lies between
    pixels: a pattern that is sampled in pixels cannot be shifted there. So the pattern is computed
    from ``pupil``, as for a laser, over the whole frame and on a finer grid. The difference between
    the PSF and this pattern in the window of the PSF, such as stray light, is added.
    """
    psf, illuminant, responses, bands = view
    kinds = _kinds(illuminant, responses, bands).to(psf.intensity.device, dtype)
    finer, (y, x) = _finer(pupil, lens), (lens.shape[0] + _RIM, lens.shape[1] + _RIM)
    torus = (fft_length(2 * y + 1), fft_length(2 * x + 1))  # pixels
    fine_torus = (finer * torus[0], finer * torus[1])
    spectra = torch.fft.rfft2(_fine_patterns(kinds, pupil, lens, finer), s=fine_torus)
    # shift the spot from the middle of the window to the first sample
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
    """Return the phase factor (fy, fx) of an `rfft2` spectrum that shifts a picture by (y, x)
    samples.
    """
    y, x = torus
    fy, fx = torch.fft.fftfreq(y).to(move), torch.fft.rfftfreq(x).to(move)
    turns = fy[:, None] * move[0] + fx * move[1]
    return torch.polar(torch.ones_like(turns), -2 * torch.pi * turns)


def _kinds(illuminant: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return the weight of each band in each channel for the three kinds of spectrum: (kind,
    channel, band).
    """
    shares, centres = grey_shares(illuminant, responses, bands), bands.centres.cpu()
    tilt = (centres - (shares * centres).sum(-1, keepdim=True)) / _TILT_SCALE
    return torch.stack([shares, shares * tilt, shares * tilt.square()])


def _finer(pupil: Pupil, lens: Lens) -> int:
    """Return the number of samples per pixel that the finest fringe of the lens needs, limited to
    save time and memory.
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
    """Return the patterns (kind, channel, y, x) on the finer grid, as light per sample, with the
    spot at the middle sample.
    """
    window_sides = tuple(2 * finer * (n + _RIM) + 1 for n in lens.shape)
    pitch = lens.pixel_pitch / finer
    total = torch.zeros(*kinds.shape[:2], *window_sides).to(kinds)
    for band in range(kinds.shape[-1]):
        band_pupil = pupil._replace(
            wavelengths=pupil.wavelengths[band][None], index=pupil.index[band][None]
        )
        # width of the alias-free field in samples
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
    """Return the fading factor of the samples along one axis: 1 up to the largest distance between
    two pixels of the frame, then falling to 0.
    """
    distance = torch.arange(-finer * (pixels + _RIM), finer * (pixels + _RIM) + 1).abs() / finer
    return 0.5 + 0.5 * torch.cos(torch.pi * ((distance - pixels - 1) / (_RIM - 1)).clamp(0.0, 1.0))


def _pixel(fine: tuple[int, int], finer: int, lens: Lens) -> Tensor:
    """Return the factor of an `rfft2` spectrum that converts light per sample to light per pixel
    around each sample.
    """
    if lens.sensor != "integrated":  # irradiance at the centre of the pixel, times its area
        return torch.tensor(float(finer**2))
    sample_offsets = torch.arange(finer, dtype=torch.float64) - (finer - 1) / 2
    fy, fx = torch.fft.fftfreq(fine[0]).double(), torch.fft.rfftfreq(fine[1]).double()
    # transfer function of the sum over the samples in a pixel, symmetric about its centre
    row_factor, column_factor = (
        torch.cos(2 * torch.pi * f[:, None] * sample_offsets).sum(1) for f in (fy, fx)
    )
    return row_factor[:, None] * column_factor


def _beyond_pupil(inner: Tensor, coarse: Tensor) -> Tensor:
    """Return the patterns ``inner`` minus the patterns ``coarse``, in the size of ``coarse``; 0
    outside the window of ``inner``.
    """
    sides = coarse.shape[-2:]
    inside = _framed(torch.ones_like(inner), sides) > 0
    return torch.where(inside, _framed(inner, sides) - coarse, 0.0)


def _between_pixels(spectra: Tensor, torus: tuple[int, int], finer: int) -> Tensor:
    """Return `rfft2` spectra on the finer grid, from those of pictures in pixels (Fourier
    interpolation).
    """
    (y, x), columns = torus, (torus[1] + 1) // 2
    fine_spectra = spectra.new_zeros(*spectra.shape[:-2], finer * y, finer * x // 2 + 1)
    fine_spectra[..., : (y + 1) // 2, :columns] = spectra[..., : (y + 1) // 2, :columns]
    fine_spectra[..., finer * y - (y - 1) // 2 :, :columns] = spectra[
        ..., y - (y - 1) // 2 :, :columns
    ]
    # a transform on the finer grid sums over finer^2 times as many samples
    return fine_spectra * finer**2


def _framed(picture: Tensor, sides: tuple[int, ...]) -> Tensor:
    """Return pictures (..., y, x), cropped or padded with 0 to the given sides; the middle pixel
    stays in the middle.
    """
    rims = []
    # `pad` starts with the last axis
    for n, side in zip(picture.shape[:-3:-1], sides[::-1], strict=True):
        rims += [side // 2 - n // 2, side - side // 2 - (n - n // 2)]
    return pad(picture, rims)


# --- components -----------------------------------------------------------------------------------

# The light sources in a frame besides the scene: a laser (one spectral line) and a lamp (many
# bands).


NANOMETRE = 1e-9
#: nm^2, smallest prior standard deviation of the variance of a line; it is the nominal variance
#: itself if that is larger
_WIDTH = 0.5
_WIDEST_VARIANCE = 50.0  #: nm^2, largest addition to the variance of a line
_RESPONSE_ERROR = 0.03  #: relative standard deviation of the response of a channel to one line
#: further standard deviation relative to the largest response, for channels with a low response
_BLIND = 0.003


class Camera(NamedTuple):
    """The known properties of the camera."""

    pupil: Pupil
    responses: Tensor  #: (channel, band)
    bands: Bands
    lens: Lens
    fwhm: Tensor  #: () float64, m, of a line


@dataclass(frozen=True)
class Laser:
    """A laser: place of the spot, wavelength, strength, width of the line, and errors of the
    channel responses.
    """

    camera: Camera
    #: (5 + channel,): y and x (pixels from the middle), wavelength (nm), electrons at response 1,
    #: variance of the line minus the variance for the camera's ``fwhm`` (nm^2), and the errors of
    #: the responses in standard deviations
    values: Tensor

    @property
    def precision(self) -> Tensor:
        """Return the prior precision (1 / variance) of each value; 0 for a value without a
        prior.
        """
        width = torch.tensor([max(self._variance(), _WIDTH) ** -2])
        return torch.cat([torch.zeros(4), width, torch.ones(len(self.values) - 5)]).to(self.values)

    @property
    def fwhm(self) -> Tensor:
        """Return the full width at half maximum of the line in m: () float64."""
        variance = (self._variance() + self.values[4].double()).clamp_min(0.0)
        return self.camera.fwhm * (variance / self._variance()).sqrt()

    def _variance(self) -> float:
        return float(deviation(self.camera.fwhm) / NANOMETRE) ** 2

    def electrons(self) -> Tensor:
        """Return the light of the laser in each pixel of each channel."""
        return self.channels()[:, None, None] * self._pattern(self.values[:3])

    def channels(self) -> Tensor:
        """Return the electrons (channel,) of the whole pattern in each channel."""
        response, spread = self._response(self.values[2])
        return self.values[3] * (response + spread * self.values[5:])

    def columns(self, of: Callable[[Tensor], Tensor]) -> Tensor:
        """Return ``of`` applied to the derivative of the light with respect to each value: (value,
        channel, ...).

        ``of`` is linear, acts on each channel separately, and takes pictures (picture, 1 or
        channel, y, x).
        """
        # the patterns are the same in all channels; `of` returns one result for each channel
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
        """Return the pattern and its derivatives with respect to y, x (pixels), wavelength (nm) and
        variance of the line (nm^2): (5, y, x).
        """
        camera, place = self.camera, self.values[:3].double()
        moves = line_moves(camera.pupil, place[:2], place[2] * NANOMETRE, camera.lens, self.fwhm)
        moves = moves._replace(wave=moves.wave * NANOMETRE, blur=moves.blur * NANOMETRE**2)
        return torch.stack(list(moves)).to(self.values)

    def moved(self, step: Tensor) -> Laser:
        """Return the laser after a step; its wavelength is limited to the bands, and its spot to
        the frame and 1 pixel around it.
        """
        centres, shape = self.camera.bands.centres / NANOMETRE, self.camera.lens.shape
        # pixels, pixels and nm: the linear model of a Gauss-Newton step holds only near the fit
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
        """Return the derivatives (channel, value) of the electrons of each channel with respect to
        each value.
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
        """Return the derivative of the electrons of each channel with respect to wavelength, per
        nm, as a central difference.
        """
        responses = [self._response(self.values[2] + sign)[0] for sign in (1, -1)]
        return self.values[3] * (responses[0] - responses[1]) / 2.0

    def _pattern(self, place: Tensor) -> Tensor:
        """Return the fraction (y, x) of the light in each pixel, for a place (y and x in pixels,
        wavelength in nm).
        """
        lens = self.camera.lens
        place = place.double()  # phases of many turns need float64
        direction = place[:2] * (lens.pixel_pitch / lens.focal_length)
        pattern = line_pattern(self.camera.pupil, direction, place[2] * NANOMETRE, lens, self.fwhm)
        return pattern.to(self.values)


@dataclass(frozen=True)
class Lamp:
    """A lamp: place of its spot, and electrons in each channel for each kind of spectrum."""

    light: LampLight
    shape: tuple[int, int]
    #: (2 + kind x channel,): y and x (pixels from the middle), then the electrons of each kind and
    #: channel
    values: Tensor

    @property
    def precision(self) -> Tensor:
        """Return the prior precision of each value: 0, because a lamp has no prior."""
        return torch.zeros_like(self.values)

    def electrons(self) -> Tensor:
        """Return the light of the lamp in each pixel of each channel."""
        return self._pictures(self._spectra())

    def columns(self, of: Callable[[Tensor], Tensor]) -> Tensor:
        """Return ``of`` applied to the derivative of the light with respect to each value: (value,
        channel, ...).

        ``of`` is linear, acts on each channel separately, and takes pictures (picture, channel, y,
        x).
        """
        kinds, channels = self.light.spectra.shape[:2]
        filtered = of(torch.stack([self._pictures(slope) for slope in self._slopes()]))
        amounts = filtered.new_zeros(kinds * channels, *filtered.shape[1:])
        for k in range(kinds):
            for c in range(channels):
                # the amount of a kind in a channel changes only this channel; indices 0 and 1 are
                # the derivatives with respect to y and x
                amounts[k * channels + c, c] = filtered[2 + k, c]
        return torch.cat([filtered[:2], amounts])

    def _slopes(self) -> Iterator[Tensor]:
        """Yield the spectra of the derivatives with respect to y, x (pixels) and each kind, one by
        one to save memory.
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
        """Return the lamp after a step; its spot moves by at most 1 pixel along each axis."""
        values = self.values + torch.cat([step[:2].clamp(-1.0, 1.0), step[2:]])
        for i in range(2):
            values[i] = values[i].clamp(-0.5 * self.shape[i] - 1, 0.5 * self.shape[i] + 1)
        return replace(self, values=values)

    def _spectra(self) -> Tensor:
        """Return the `rfft2` spectra (channel, fy, fx) of the light of the lamp, with its spot in
        place.
        """
        amount_by_kind = self.values[2:].view(len(self.light.spectra), -1, 1, 1)
        return (amount_by_kind * self.light.spectra).sum(0) * self._phase()

    def _phase(self) -> Tensor:
        """Return the phase factor (fy, fx) that shifts a spot from the first sample to its
        place.
        """
        middle_pixel = torch.tensor([self.shape[0] // 2, self.shape[1] // 2]).to(self.values)
        return phases(self.light.torus, self.light.finer * (self.values[:2] + middle_pixel))

    def _pictures(self, spectra: Tensor) -> Tensor:
        """Return the pictures (..., y, x) in pixels, from `rfft2` spectra on the finer grid: every
        ``finer``-th sample.
        """
        samples_per_pixel, (y, x) = self.light.finer, self.light.torus
        rows = torch.fft.ifft(spectra, n=y, dim=-2)[
            ..., : samples_per_pixel * self.shape[0] : samples_per_pixel, :
        ]
        row_samples: Tensor = torch.fft.irfft(rows, n=x, dim=-1)
        return row_samples[..., : samples_per_pixel * self.shape[1] : samples_per_pixel]
