"""Candidates for lasers and lamps: likelihood at every place of a frame, and local refinement."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics import psf as focus
from neusee.nodes.optics.transform._fft_transforms import fft_length
from neusee.nodes.restore.lasers._components import NANOMETRE, Camera
from neusee.nodes.restore.lasers._frame_likelihood import Data, Filter, Weights
from neusee.nodes.restore.lasers._line_pattern import Lens, grid_patterns, index_at, response_at
from neusee.nodes.values import Bands, Pupil

# --- candidates -----------------------------------------------------------------------------------

# The likelihood of a pattern at every place of the frame at once, by correlation with FFTs.


_WAVELENGTH_STEP = 5e-9  #: m between the wavelengths that are tried
_PATTERN_REACH = 192  #: largest distance from the spot in pixels at which patterns are compared
_CLIPPED_RATIOS = (1.0, 2.0)  #: numbers of clipped pixels that are tried, relative to the frame
_LEAST_SEPARATION = (1.5, 8e-9)  #: pixels, m: two candidates differ by more in one of these


class Candidate(NamedTuple):
    """A place, a wavelength and a strength, with the approximate gain in log likelihood of such a
    pattern.
    """

    gain: float
    spot: tuple[float, float]  #: pixels from the middle of the frame
    wavelength: float  #: m
    strength: float  #: electrons over the whole pattern in a channel of response 1


class Templates(NamedTuple):
    """Patterns of spots on the optical axis, in windows of odd sides around the spot, with the
    response of each channel.
    """

    wavelengths: Tensor  #: (line,) float64, m; 0 for light of many wavelengths
    patterns: Tensor  #: (line, 1 or channel, y, x)
    responses: Tensor  #: (line, channel)


def line_templates(pupil: Pupil, responses: Tensor, bands: Bands, lens: Lens) -> Templates:
    """Return the patterns of spectral lines over the range of the bands."""
    low, high = float(bands.centres.min()), float(bands.centres.max())
    count = max(2, math.ceil((high - low) / _WAVELENGTH_STEP) + 1)
    wavelengths = torch.linspace(low, high, count, dtype=torch.float64)
    line_responses = torch.stack(
        [response_at(x, responses.cpu().double(), bands) for x in wavelengths]
    )
    # lines to which the camera hardly responds are left out
    wavelengths, line_responses = (
        wavelengths[line_responses.amax(1) > 0.01 * line_responses.max()],
        line_responses[line_responses.amax(1) > 0.01 * line_responses.max()],
    )
    index = torch.stack([index_at(x, pupil) for x in wavelengths])
    half_field = (
        # pixels to half the alias-free field, beyond which a pattern repeats itself
        float(wavelengths.min()) * lens.focal_length / (2 * float(pupil.pitch) * lens.pixel_pitch)
    )
    window_sides = tuple(
        2 * min(n - 1, int(half_field) - 1, _PATTERN_REACH) + 1 for n in lens.shape
    )
    line_pupil = pupil._replace(
        wavelengths=wavelengths.to(pupil.wavelengths), index=index.to(pupil.index)
    )
    camera = {
        "focal_length": lens.focal_length,
        "pixel_pitch": lens.pixel_pitch,
        "shape": window_sides,
    }
    intensity = focus(line_pupil, sensor=lens.sensor, **camera).intensity
    return Templates(wavelengths, intensity[:, None], line_responses)


def candidates(
    residual: Tensor, use: Filter, weights: Weights, templates: Templates, count: int
) -> list[Candidate]:
    """Return the most likely places and wavelengths of one more pattern in a filtered residual,
    the best first.
    """
    residual = residual.float()  # precise enough for the start of a fit
    weights = Weights(*(x.float() for x in weights))
    white_residual, frame = weights(residual), residual.shape[-2:]
    peaks: list[Candidate] = []
    for line, pattern, line_response in zip(*templates, strict=True):
        size = _size(frame, pattern)
        sharp_pattern = use.sharp(pattern.to(residual))
        response_weights = weights(line_response.to(residual)[:, None, None].expand_as(residual))
        if len(pattern) == 1:
            # the least-squares strength is numerator over denominator, see `_gain`
            numerator, denominator = (
                (response_weights * white_residual).sum(0, keepdim=True),
                response_weights.square().sum(0, keepdim=True),
            )
        else:  # each channel has its own pattern: channels count as independent
            numerator, denominator = (
                line_response.to(residual)[:, None, None] * weights(white_residual),
                response_weights.square(),
            )
        product = _correlated(numerator, sharp_pattern, size).sum(0)
        norm = _correlated(denominator, sharp_pattern.square(), size).sum(0).clamp_min(0.0)
        peaks += _peaks(
            _gain(product, norm),
            product / norm.clamp_min(1e-30),
            float(line),
            pattern,
            frame,
            count,
        )
    return _distinct(sorted(peaks, reverse=True), count)


def clipped_candidates(
    picture: Tensor, full: float, use: Filter, weights: Weights, templates: Templates, count: int
) -> list[Candidate]:
    """Return candidates for a pattern that the sensor clips, the best first; clipped pixels of the
    frame have the value ``full``.

    The number of clipped pixels determines the strength of a pattern: the number in the frame times
    each of `_CLIPPED_RATIOS` is tried, because some may lie beyond the frame. Each channel is
    clipped separately: a channel with a low response shows more of the pattern.
    """
    # clipped pixels from which hardly any light of known parts has been subtracted
    clipped = int((picture >= 0.98 * full).any(0).sum())
    picture, frame = picture.float(), picture.shape[-2:]
    weights = Weights(*(x.float() for x in weights))
    size = _size(frame, templates.patterns[0])
    pairs = list(itertools.combinations_with_replacement(range(len(picture)), 2))
    weighted_spectra = torch.fft.rfft2(weights.twice(use.sharp(picture)), s=size)
    pair_spectra = torch.fft.rfft2(
        # a pair of different channels occurs twice in the quadratic form
        torch.stack([weights.pair(*pair) * (1 + (pair[0] != pair[1])) for pair in pairs]),
        s=size,
    )
    peaks: list[Candidate] = []
    for (line, pattern, line_response), margin in itertools.product(
        zip(*templates, strict=True), _CLIPPED_RATIOS
    ):
        relative_response, clip_value = (
            (line_response / line_response.max()).to(picture),
            _level(pattern, round(margin * clipped)),
        )
        # the pattern as shown by a sensor that clips at 1
        sharp_pattern = use.sharp(
            (relative_response[:, None, None] * pattern.to(picture) / clip_value).clamp_max(1.0)
        )
        squares = torch.stack(
            [sharp_pattern[first] * sharp_pattern[other] for first, other in pairs]
        )
        numerator, denominator = (
            torch.fft.irfft2((data * torch.fft.rfft2(model, s=size).conj()).sum(0), s=size)
            for data, model in ((weighted_spectra, sharp_pattern), (pair_spectra, squares))
        )
        strength = torch.full_like(denominator, full / (clip_value * float(line_response.max())))
        peaks += _peaks(
            _gain(numerator, denominator.clamp_min(0.0)),
            strength,
            float(line),
            pattern,
            frame,
            count,
        )
    return _distinct(sorted(peaks, reverse=True), count)


def _size(frame: torch.Size, pattern: Tensor) -> list[int]:
    """Return the size of the FFT for which the correlation of frame and pattern does not wrap
    around.
    """
    return [fft_length(n + k - 1) for n, k in zip(frame, pattern.shape[-2:], strict=True)]


def _gain(product: Tensor, norm: Tensor) -> Tensor:
    """Return the gain in log likelihood of a pattern with its best strength >= 0: product^2 / (2
    norm).
    """
    return 0.5 * product.clamp_min(0.0).square() / (norm + 1e-6 * norm.max() + 1e-30)


def _level(pattern: Tensor, count: int) -> float:
    """Return the value that ``count`` pixels of a pattern exceed."""
    return float(torch.topk(pattern.flatten(), min(count + 1, pattern.numel())).values[-1])


def _correlated(picture: Tensor, pattern: Tensor, size: list[int]) -> Tensor:
    """Return the cross-correlation of picture and pattern, for every place of the spot in the frame
    or near it.
    """
    product = torch.fft.rfft2(picture, s=size) * torch.fft.rfft2(pattern, s=size).conj()
    result: Tensor = torch.fft.irfft2(product, s=size)
    return result


def _peaks(
    gain: Tensor, strength: Tensor, line: float, pattern: Tensor, frame: torch.Size, count: int
) -> list[Candidate]:
    """Return the candidates of the largest gains whose spot lies within the frame."""
    rows, columns = (
        # a spot in row r has the shift r - k // 2, because the spot is the middle of the pattern
        (torch.arange(n, device=gain.device) - k // 2) % s
        for n, k, s in zip(frame, pattern.shape[-2:], gain.shape, strict=True)
    )
    gain_within, strength_within = gain[rows[:, None], columns], strength[rows[:, None], columns]
    # 3 times as many, because neighbours of a peak are dropped
    best = torch.topk(gain_within.flatten(), min(3 * count, gain_within.numel()))
    spots = []
    for value, index in zip(best.values.tolist(), best.indices.tolist(), strict=True):
        y, x = divmod(index, frame[1])
        spots.append(
            Candidate(
                value, (y - frame[0] // 2, x - frame[1] // 2), line, float(strength_within[y, x])
            )
        )
    return _distinct(spots, count)


def _distinct(ranked: list[Candidate], count: int) -> list[Candidate]:
    """Return the first candidates of a list that differ from all earlier ones in place or
    wavelength.
    """
    distinct: list[Candidate] = []
    for candidate in ranked:
        if len(distinct) < count and all(_differ(candidate, other) for other in distinct):
            distinct.append(candidate)
    return distinct


def _differ(a: Candidate, b: Candidate) -> bool:
    distance = math.dist(a.spot, b.spot)
    return (
        distance > _LEAST_SEPARATION[0] or abs(a.wavelength - b.wavelength) > _LEAST_SEPARATION[1]
    )


# --- nearest --------------------------------------------------------------------------------------

# The place and wavelength near a rough candidate at which a pattern gains most. Clipped pixels are
# left out, as in the fit.


#: offsets from a candidate: in pixels (y and x), and in nm
_HALVES, _NEAR = (-0.6, -0.3, 0.0, 0.3, 0.6), (-3.0, -1.5, 0.0, 1.5, 3.0)
#: offsets in nm from a laser whose responses are improbable at its wavelength
FAR = tuple(1.5 * n for n in range(-10, 11))
#: offsets in pixels from the centre of a tile, and of the tiles from a candidate
_COARSE, _TILES = (-0.5, 0.0, 0.5), (-3.0, -1.5, 0.0, 1.5, 3.0)
_COMPARED_SIDE = 256  #: side in pixels of the window in which candidates are compared


def nearest_of_many(camera: Camera, data: Data, residual: Tensor, start: Candidate) -> Candidate:
    """Return the best candidate within 3.5 pixels and 3 nm of a rough one; ``residual`` is
    filtered.

    Clipped pixels give the place of a wide pattern only to a few pixels, and a pattern of fine
    rings gains nothing if it is half a pixel off.
    """
    y, x = start.spot
    tiles = [
        start._replace(spot=(y + down, x + right))
        for down, right in itertools.product(_TILES, _TILES)
    ]
    best = max(nearest(camera, data, residual, tile, halves=_COARSE) for tile in tiles)
    return nearest(camera, data, residual, best)


def nearest(
    camera: Camera,
    data: Data,
    residual: Tensor,
    start: Candidate,
    *,
    halves: tuple[float, ...] = _HALVES,
    near: tuple[float, ...] = _NEAR,
) -> Candidate:
    """Return the best candidate on a grid around ``start``: offsets ``halves`` (pixels) in y and x,
    and ``near`` (nm).

    The grid is fine, because the rings far from a clipped spot are narrow. ``residual`` is
    filtered. The channels have the exact responses of the camera, so that a wrong wavelength gains
    less than in a fit, which has errors of responses.
    """
    window, middle = _window(residual, start.spot)
    local_filter = Filter(data.use.seen[..., *window], data.use.kernel)
    local_weights = Weights(*(x[..., *window] for x in data.weights))
    white, best_candidate = local_weights(residual[..., *window]), start._replace(gain=0.0)
    lens = camera.lens._replace(shape=(white.shape[-2], white.shape[-1]))
    row_places, column_places = (
        torch.tensor(
            [spot_place + half - m for half in halves], dtype=torch.float64, device=white.device
        )
        for spot_place, m in zip(start.spot, middle, strict=True)
    )
    for nm in near:
        wavelength = torch.tensor(
            start.wavelength + nm * NANOMETRE, dtype=torch.float64, device=white.device
        )
        line_response = start.strength * response_at(wavelength, camera.responses, camera.bands).to(
            white
        )
        patterns = grid_patterns(camera.pupil, row_places, column_places, wavelength, lens).to(
            white
        )
        light = local_weights(
            line_response[:, None, None] * local_filter(patterns.flatten(0, 1)[:, None])
        )
        numerator, denominator = (
            (light * white).sum((1, 2, 3)),
            light.square().sum((1, 2, 3)).clamp_min(1e-30),
        )
        # gain in log likelihood of a pattern with its best strength >= 0
        gain = 0.5 * numerator.clamp_min(0.0).square() / denominator
        best_number = int(gain.argmax())
        if float(gain[best_number]) > best_candidate.gain:
            y, x = divmod(best_number, len(halves))
            spot = (start.spot[0] + halves[y], start.spot[1] + halves[x])
            strength = (
                max(float(numerator[best_number] / denominator[best_number]), 0.01) * start.strength
            )
            best_candidate = Candidate(float(gain[best_number]), spot, float(wavelength), strength)
    return best_candidate


def _window(
    frame: Tensor, spot: tuple[float, float]
) -> tuple[tuple[slice, slice], tuple[int, int]]:
    """Return the rows and columns of the window around a spot, and the offset (y, x) in pixels from
    the middle of the frame to the middle of the window.
    """
    window, middle = [], []
    for n, spot_place in zip(frame.shape[-2:], spot, strict=True):
        side = min(n, _COMPARED_SIDE)
        first = min(max(round(spot_place) + n // 2 - side // 2, 0), n - side)
        window.append(slice(first, first + side))
        middle.append(first + side // 2 - n // 2)
    return (window[0], window[1]), (middle[0], middle[1])
