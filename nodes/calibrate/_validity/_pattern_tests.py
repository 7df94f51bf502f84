"""Tests of what two frames of the same light have in common: fixed patterns, uneven light, and lag between frames."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes.calibrate._validity._frame_pairs import (
    Evidence,
    FrameTest,
    Level,
    bounded,
    outcome,
    saturated,
    strongest,
    studentised,
    tested,
)
from neusee.nodes.calibrate._validity._hidden_faults import Hidden
from neusee.nodes.calibrate._validity._lag_test import lag

_BLOCKS = 8  #: blocks of a frame on a side, whose means show how even the light is
_EVEN = 0.03  #: difference of the largest and least irradiance that EMVA 1288 allows, relative to the mean
_UNLIKE = 0.01  #: scale of the prior of the share of the variance that is of patterns
_BENT = 0.1  #: largest relative bend of a response, by which uneven light shifts the gain
_NEARLY_FULL = 0.95  #: share of the well above which a part of a frame is nearly full
_SMALL = 5  #: pixels, over which uneven light is even
_NOISE = 8.0  #: standard errors by which the means of the brightest and the darkest block differ by chance


def pattern_tests(levels: Sequence[Level]) -> list[FrameTest]:
    """Test frames of the same light for fixed patterns, for lag, and for uneven light.

    Only levels that the fit uses are tested. The covariance of two frames of a level is that of the patterns that stay.

    Shapes: a list of levels -> a list of tests.
    Units:  numbers and limits in standard deviations of chance, and the difference of the light as a share of its mean.
    Error:  each test fails by chance with a probability of 1e-3.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 2.5 (non-uniformity) and 6.4 (homogeneity).
    """
    paired = tested(levels)
    if not paired:
        return []
    return [_pattern(paired), *lag(paired), *_uneven(paired, saturated(levels))]


def _pattern(levels: Sequence[Level]) -> FrameTest:
    """Test if the pixels of a level differ from each other in all frames, by DSNU and PRNU."""
    products = [level.first * level.second for level in levels]
    evidence = strongest([[studentised(x) for x in products]])
    common = [float(x.mean()) for x in products]
    of_dark = [c for c, level in zip(common, levels, strict=True) if level.dark]
    dsnu = math.sqrt(max(0.0, min(of_dark, default=0.0)))
    paired_lit = [level for level in levels if not level.dark]
    lit = [(c - dsnu**2, level) for c, level in zip(common, levels, strict=True) if not level.dark]
    offset = min((level.mean for level in levels if level.dark), default=0.0)
    relative = [math.sqrt(max(0.0, c)) / (level.mean - offset) for c, level in lit if level.mean > offset]
    prnu = sorted(relative)[len(relative) // 2] if relative else 0.0
    sentence = f"pixels differ by {dsnu:.2g} DN in the dark (DSNU) and by {prnu:.2%} in light (PRNU and uneven light)"
    passed = "the pixels are alike: the total variance is the temporal variance"
    if all(level.scatter != "all" for level in levels):
        modelled = "the temporal variance leaves these differences out"
        shifts = {"gain": _pixel_response(paired_lit, offset) ** 2}
        return outcome("total against temporal variance", evidence, sentence, shifts, passed, modelled)
    sentence += ", which `scatter: all` counts as noise; use calibrate.camera with `scatter: steady`"
    hidden = list(_counted_as_noise(levels, products))
    return bounded("total against temporal variance", evidence, hidden, sentence, passed)


def _pixel_response(lit: Sequence[Level], offset: float) -> float:
    """Return by how much the responses of neighbouring pixels differ, relative to the mean; uneven light is smooth.

    Pixels whose gains differ by a share s have a mean gain that is too large by s**2.
    """
    shares = []
    for level in lit:
        one, other = (frames.diff(dim=2) for frames in (level.first, level.second))
        shares.append(max(0.0, float((one * other).mean()) / 2) / (level.mean - offset) ** 2)
    return math.sqrt(sorted(shares)[len(shares) // 2]) if shares else 0.0


def _counted_as_noise(levels: Sequence[Level], products: Sequence[Tensor]) -> Iterator[Hidden]:
    """Yield the share of patterns in the slope of the total variance over the mean, and in the total dark variance."""
    mean = torch.tensor([level.mean for level in levels], dtype=torch.float64)
    pattern = torch.tensor([float(x.mean()) for x in products], dtype=torch.float64)
    error = torch.tensor([math.sqrt(float(x.square().sum())) / x.numel() for x in products], dtype=torch.float64)
    total = pattern + torch.tensor([level.variance for level in levels], dtype=torch.float64)
    lit = torch.tensor([not level.dark for level in levels])
    if len(levels) > 2 and float(mean.max()) > float(mean.min()):
        weight = total.clamp_min(1e-12).reciprocal()
        design = torch.stack([torch.ones_like(mean), mean], 1) * weight[:, None]
        slope = torch.linalg.pinv(design)[1] * weight
        yield _share(float(slope @ pattern), float((slope * error).norm()), float(slope @ total), gain=-1.0)
    if bool((~lit).any()):
        part, unsure, whole = pattern[~lit].mean(), error[~lit].norm() / int((~lit).sum()), total[~lit].mean()
        yield _share(float(part), float(unsure), float(whole), noise=-0.5)


def _share(part: float, error: float, whole: float, gain: float = 0.0, noise: float = 0.0) -> Hidden:
    """Return the fault of a part of the variance that is no noise in time."""
    left = max(1 - part / max(whole, 1e-12), 1e-3)
    error = max(error / max(whole, 1e-12) / left, 1e-9)
    return Hidden("pattern", -math.log(left), error, _UNLIKE, gain, noise, positive=True)


def _uneven(levels: Sequence[Level], full: Sequence[Level]) -> Iterator[FrameTest]:
    """Test if the light of the brightest level is even enough for the standard.

    Light that is uneven leaves the gain alone as long as the response is straight: mean and variance of each pixel grow
    alike. It does not where the brightest part of the frame is full before the mean is, which ``full`` levels show.
    """
    lit, dark = ([level for level in levels if level.dark == wanted] for wanted in (False, True))
    bright = max(lit, key=lambda level: level.mean, default=None)
    if bright is None or not dark or min(bright.first.shape[1:]) < 2 * _BLOCKS:
        return
    below = min(dark, key=lambda level: abs(level.exposure - bright.exposure))
    signal = bright.mean - below.mean
    if signal <= 0:
        return
    means, chance = _block_means(bright)
    number = max(0.0, float(means.max() - means.min()) - _NOISE * math.sqrt(chance)) / signal
    variation = max(0.0, float(means.var()) - chance) / signal**2
    shift = _BENT * variation + _filled(bright, full, below.mean)
    sentence = f"the brightest and the darkest part of the light differ by {number:.1%}, not at most {_EVEN:.0%}"
    passed = f"the parts of the light differ by less than the {_EVEN:.0%} that the standard allows"
    yield outcome("homogeneity of the light", Evidence(number, _EVEN), sentence, {"gain": shift}, passed)


def _block_means(level: Level) -> tuple[Tensor, float]:
    """Return the means (by, bx) of the parts of a level, DN less that of the level, and their variance by chance."""
    picture = (level.first + level.second).mean(0)[None, None] / 2
    side = [n // _BLOCKS for n in picture.shape[2:]]
    left = picture - avg_pool2d(picture, _SMALL, stride=1, padding=_SMALL // 2)
    return avg_pool2d(picture, side)[0, 0], float(left.var()) / math.prod(side)


def _filled(bright: Level, full: Sequence[Level], dark: float) -> float:
    """Return the share of the light of the brightest level that is in parts of the frame that are nearly full."""
    lit = [level for level in full if level.paired and level.first.shape == bright.first.shape]
    if not lit:
        return 0.0
    well = max(level.mean + float(_block_means(level)[0].max()) for level in lit) - dark
    signal = bright.mean - dark + _block_means(bright)[0]
    return float(signal[signal > _NEARLY_FULL * well].sum() / signal.sum())
