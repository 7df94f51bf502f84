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
    outcome,
    strongest,
    studentised,
)

_BLOCKS = 8  #: blocks of a frame on a side, whose means show how even the light is
_EVEN = 0.03  #: difference of the largest and least irradiance that EMVA 1288 allows, relative to the mean
_RARE = 4.5  #: standard deviations beyond which a pixel is defective, and left out of the test of lag
_FAR = 2.0  #: largest share of a neighbouring level in the pattern of a level
_NOISE = 8.0  #: standard errors by which the means of the brightest and the darkest block differ by chance


def pattern_tests(levels: Sequence[Level]) -> list[FrameTest]:
    """Test frames of the same light for fixed patterns, for lag, and for uneven light.

    The covariance of two frames of a level is that of the patterns that stay. Lag adds to it, in proportion to the
    temporal variance: the pattern of a level is interpolated from the frames of its two neighbours and subtracted,
    which leaves independent noise in both frames, unless the first frame persists in the second.

    Shapes: a list of levels -> a list of tests.
    Units:  numbers and limits in standard deviations of chance, and the difference of the light as a share of its mean.
    Error:  each test fails by chance with a probability of 1e-3. Lag needs three lit levels below saturation, or three
            dark ones; patterns are taken as linear between neighbouring levels.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 2.5 (non-uniformity) and 6.4 (homogeneity).
    """
    paired = [level for level in levels if level.paired and not level.high and not level.low]
    if not paired:
        return []
    return [_pattern(paired), *_lag(paired), *_uneven(paired)]


def _pattern(levels: Sequence[Level]) -> FrameTest:
    """Test if the pixels of a level differ from each other in all frames, by DSNU and PRNU."""
    products = [level.first * level.second for level in levels]
    evidence = strongest([[studentised(x) for x in products]])
    common = [float(x.mean()) for x in products]
    of_dark = [c for c, level in zip(common, levels, strict=True) if level.dark]
    dsnu = math.sqrt(max(0.0, min(of_dark, default=0.0)))
    lit = [(c - dsnu**2, level) for c, level in zip(common, levels, strict=True) if not level.dark]
    offset = min((level.mean for level in levels if level.dark), default=0.0)
    relative = [math.sqrt(max(0.0, c)) / (level.mean - offset) for c, level in lit if level.mean > offset]
    prnu = sorted(relative)[len(relative) // 2] if relative else 0.0
    sentence = f"pixels differ by {dsnu:.2g} DN in the dark (DSNU) and by {prnu:.2%} in light (PRNU and uneven light)"
    passed = "the pixels are alike: the total variance is the temporal variance"
    if all(level.stack.scatter != "all" for level in levels):
        modelled = "the temporal variance leaves these differences out"
        return outcome("total against temporal variance", evidence, sentence, {"gain": prnu**2}, passed, modelled)
    shares = [
        (abs(c) / (c + level.variance) if c + level.variance else 0.0, level.dark)
        for c, level in zip(common, levels, strict=True)
    ]
    shifts = {"noise": max((s / 2 for s, dark in shares if dark), default=0.0)}
    shifts["gain"] = max((s for s, dark in shares if not dark), default=0.0)
    sentence += ", which `scatter: all` counts as noise; use calibrate.camera with `scatter: steady`"
    return outcome("total against temporal variance", evidence, sentence, shifts, passed)


def _lag(levels: Sequence[Level]) -> Iterator[FrameTest]:
    """Test if the noise of a frame persists in the next frame."""
    lit = sorted((level for level in levels if not level.dark), key=lambda level: level.mean)
    dark = sorted((level for level in levels if level.dark), key=lambda level: level.stack.exposure)
    rows, shares = [], []
    for group, at in ((lit, [x.mean for x in lit]), (dark, [x.stack.exposure for x in dark])):
        found = list(_persistence(group, at)) if _alike(group) else []
        if not found:
            continue
        total = torch.stack([product / product.square().mean().sqrt().clamp_min(1e-12) for product, _ in found]).sum(0)
        rows.append([studentised(product) for product, _ in found])
        rows[-1].append(studentised(total))  # levels share neighbours, so that their numbers are not independent
        shares += [share for _, share in found]
    if not rows:
        return
    every = [z for row in rows for z in row]
    evidence = strongest([[z] for z in every])
    share = sum(shares) / len(shares)
    sentence = f"{share:.1%} of the noise of a frame persists in the next frame, as by lag"
    kept = min(abs(share), 0.5)
    lost = math.log((1 + 2 * kept) / (1 - kept))  # of the variance of a pair, where lag takes what it gives
    shifts = {"gain": lost, "noise": lost / 2}
    yield outcome("no lag", evidence, sentence, shifts, "the noise of a frame does not persist in the next frame")


def _alike(group: Sequence[Level]) -> bool:
    return len(group) >= 3 and len({level.apart.shape[1:] for level in group}) == 1


def _persistence(group: Sequence[Level], at: Sequence[float]) -> Iterator[tuple[Tensor, float]]:
    """Yield the product (y, x) of the noise of two frames of each level, and its share of the variance."""
    for i in range(len(group)):
        one = max(0, i - 1) if i < len(group) - 1 else i - 2
        other = one + (2 if 0 < i < len(group) - 1 else 1) if i else 2
        one = 1 if not i else one
        gap = at[one] - at[other]
        weight = (at[i] - at[other]) / gap if gap else 0.5
        if not -_FAR <= weight <= 1 + _FAR:
            continue
        u, v = (
            frames[i] - weight * frames[one] - (1 - weight) * frames[other]
            for frames in ([x.first[0] for x in group], [x.second[0] for x in group])
        )
        kept = (u.abs() < _RARE * _robust(u)) & (v.abs() < _RARE * _robust(v))
        u, v = u * kept, v * kept
        yield u * v, float(2 * (u * v).mean() / (u.square() + v.square()).mean().clamp_min(1e-12))


def _robust(x: Tensor) -> float:
    return 1.4826 * float(x.abs().median()) + 0.5


def _uneven(levels: Sequence[Level]) -> Iterator[FrameTest]:
    """Test if the light of the brightest level is even enough for the standard."""
    lit, dark = ([level for level in levels if level.dark == wanted] for wanted in (False, True))
    bright = max(lit, key=lambda level: level.mean, default=None)
    if bright is None or not dark or min(bright.first.shape[1:]) < 2 * _BLOCKS:
        return
    below = min(dark, key=lambda level: abs(level.stack.exposure - bright.stack.exposure))
    signal = bright.mean - below.mean
    if signal <= 0:
        return
    picture = (bright.first + bright.second).mean(0)[None, None] / 2
    side = [n // _BLOCKS for n in picture.shape[2:]]
    means = avg_pool2d(picture, side)
    chance = float(picture.var()) / math.prod(side)
    number = max(0.0, float(means.max() - means.min()) - _NOISE * math.sqrt(chance)) / signal
    shift = max(0.0, float(means.var()) - chance) / signal**2
    sentence = f"the brightest and the darkest part of the light differ by {number:.1%}, not at most {_EVEN:.0%}"
    passed = f"the parts of the light differ by less than the {_EVEN:.0%} that the standard allows"
    yield outcome("homogeneity of the light", Evidence(number, _EVEN), sentence, {"gain": shift}, passed)
