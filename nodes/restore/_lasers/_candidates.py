"""Where a pattern may lie: its likelihood at every place of the frame at once, by fast correlations."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics import psf as focus
from neusee.nodes.restore._lasers._line_pattern import Lens, index_at, response_at
from neusee.nodes.restore._lasers._whitening import Filter, Weights, fast_size
from neusee.nodes.values import Bands, Pupil

_STEP = 5e-9  #: m between the wavelengths that are tried
_REACH = 192  #: pixels from the spot, as far as a pattern is compared before it is fitted
_MORE = (1.0, 2.0)  #: clipped pixels of a pattern that are tried, over those of the frame
_APART = (1.5, 8e-9)  #: pixels and m, by which two candidates differ at least


class Candidate(NamedTuple):
    """A place and a wavelength, and the log likelihood that one pattern there gains, roughly."""

    gain: float
    spot: tuple[float, float]  #: pixels from the middle of the frame
    wavelength: float  #: m
    strength: float  #: electrons over the whole pattern in a channel of response 1


class Templates(NamedTuple):
    """Patterns on the axis, in windows of odd sides about the spot, with the response of each channel to them."""

    wavelengths: Tensor  #: (line,) float64, m; 0 for light of many wavelengths
    patterns: Tensor  #: (line, 1 or channel, y, x)
    responses: Tensor  #: (line, channel)


def line_templates(pupil: Pupil, responses: Tensor, bands: Bands, lens: Lens) -> Templates:
    """Return the patterns of spectral lines over the range of the bands."""
    low, high = float(bands.centres.min()), float(bands.centres.max())
    count = max(2, math.ceil((high - low) / _STEP) + 1)
    at = torch.linspace(low, high, count, dtype=torch.float64)
    heard = torch.stack([response_at(x, responses.cpu().double(), bands) for x in at])
    at, heard = at[heard.amax(1) > 0.01 * heard.max()], heard[heard.amax(1) > 0.01 * heard.max()]
    index = torch.stack([index_at(x, pupil) for x in at])
    reach = float(at.min()) * lens.focal_length / (2 * float(pupil.pitch) * lens.pixel_pitch)
    sides = tuple(2 * min(n - 1, int(reach) - 1, _REACH) + 1 for n in lens.shape)
    each = pupil._replace(wavelengths=at.to(pupil.wavelengths), index=index.to(pupil.index))
    camera = {"focal_length": lens.focal_length, "pixel_pitch": lens.pixel_pitch, "shape": sides}
    intensity = focus(each, sensor=lens.sensor, **camera).intensity
    return Templates(at, intensity[:, None], heard)


def candidates(residual: Tensor, use: Filter, weights: Weights, templates: Templates, count: int) -> list[Candidate]:
    """Return the most likely places and wavelengths of one more pattern in a filtered residual, the best first."""
    residual = residual.float()  # a start needs no more
    weights = Weights(*(x.float() for x in weights))
    white, frame = weights(residual), residual.shape[-2:]
    found: list[Candidate] = []
    for line, pattern, heard in zip(*templates, strict=True):
        size = _size(frame, pattern)
        own = use.sharp(pattern.to(residual))
        by = weights(heard.to(residual)[:, None, None].expand_as(residual))
        if len(pattern) == 1:
            top, low = (by * white).sum(0, keepdim=True), by.square().sum(0, keepdim=True)
        else:  # each channel has its own pattern: channels count as independent
            top, low = heard.to(residual)[:, None, None] * weights(white), by.square()
        product = _correlated(top, own, size).sum(0)
        norm = _correlated(low, own.square(), size).sum(0).clamp_min(0.0)
        found += _peaks(_gain(product, norm), product / norm.clamp_min(1e-30), float(line), pattern, frame, count)
    return _apart(sorted(found, reverse=True), count)


def clipped_candidates(
    picture: Tensor, full: float, use: Filter, weights: Weights, templates: Templates, count: int
) -> list[Candidate]:
    """Return candidates for a pattern that the sensor clips, in a frame with clipped pixels at ``full``.

    Each pattern is so strong that as many of its pixels are clipped as in the frame, or `_MORE` times as many, of which
    some lie beyond the frame. Each channel is clipped by itself: those that hardly see a wavelength show more of its
    pattern.
    """
    clipped = int((picture >= 0.98 * full).any(0).sum())
    picture, frame = picture.float(), picture.shape[-2:]
    weights = Weights(*(x.float() for x in weights))
    size = _size(frame, templates.patterns[0])
    pairs = list(itertools.combinations_with_replacement(range(len(picture)), 2))
    both = torch.fft.rfft2(weights.twice(use.sharp(picture)), s=size)
    inverse = torch.fft.rfft2(torch.stack([weights.pair(*pair) * (1 + (pair[0] != pair[1])) for pair in pairs]), s=size)
    found: list[Candidate] = []
    for (line, pattern, heard), more in itertools.product(zip(*templates, strict=True), _MORE):
        share, level = (heard / heard.max()).to(picture), _level(pattern, round(more * clipped))
        own = use.sharp((share[:, None, None] * pattern.to(picture) / level).clamp_max(1.0))
        squares = torch.stack([own[one] * own[other] for one, other in pairs])
        product, norm = (
            torch.fft.irfft2((data * torch.fft.rfft2(model, s=size).conj()).sum(0), s=size)
            for data, model in ((both, own), (inverse, squares))
        )
        strength = torch.full_like(norm, full / (level * float(heard.max())))
        found += _peaks(_gain(product, norm.clamp_min(0.0)), strength, float(line), pattern, frame, count)
    return _apart(sorted(found, reverse=True), count)


def _size(frame: torch.Size, pattern: Tensor) -> list[int]:
    return [fast_size(n + k - 1) for n, k in zip(frame, pattern.shape[-2:], strict=True)]


def _gain(product: Tensor, norm: Tensor) -> Tensor:
    return 0.5 * product.clamp_min(0.0).square() / (norm + 1e-6 * norm.max() + 1e-30)


def _level(pattern: Tensor, count: int) -> float:
    """Return the value that ``count`` pixels of a pattern exceed."""
    return float(torch.topk(pattern.flatten(), min(count + 1, pattern.numel())).values[-1])


def _correlated(picture: Tensor, pattern: Tensor, size: list[int]) -> Tensor:
    """Return the sum of picture x shifted pattern for every shift of the spot that lies in the frame or near it."""
    product = torch.fft.rfft2(picture, s=size) * torch.fft.rfft2(pattern, s=size).conj()
    result: Tensor = torch.fft.irfft2(product, s=size)
    return result


def _peaks(
    gain: Tensor, strength: Tensor, line: float, pattern: Tensor, frame: torch.Size, count: int
) -> list[Candidate]:
    """Return the largest gains with the spot within the frame."""
    rows, columns = (
        (torch.arange(n, device=gain.device) - k // 2) % s
        for n, k, s in zip(frame, pattern.shape[-2:], gain.shape, strict=True)
    )
    inside, sizes = gain[rows[:, None], columns], strength[rows[:, None], columns]
    best = torch.topk(inside.flatten(), min(3 * count, inside.numel()))
    found = []
    for value, at in zip(best.values.tolist(), best.indices.tolist(), strict=True):
        y, x = divmod(at, frame[1])
        found.append(Candidate(value, (y - frame[0] // 2, x - frame[1] // 2), line, float(sizes[y, x])))
    return _apart(found, count)


def _apart(found: list[Candidate], count: int) -> list[Candidate]:
    """Return the first candidates of a list that differ from all earlier ones in place or wavelength."""
    kept: list[Candidate] = []
    for one in found:
        if len(kept) < count and all(_differ(one, other) for other in kept):
            kept.append(one)
    return kept


def _differ(a: Candidate, b: Candidate) -> bool:
    away = math.dist(a.spot, b.spot)
    return away > _APART[0] or abs(a.wavelength - b.wavelength) > _APART[1]
