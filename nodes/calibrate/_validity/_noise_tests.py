"""Tests of the difference of two frames of the same light: its noise must be white, Gaussian and without a trend."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from neusee.nodes.calibrate._validity._block_test import blocks, products
from neusee.nodes.calibrate._validity._frame_pairs import (
    ALARM,
    FrameTest,
    Level,
    corrected,
    normal_limit,
    outcome,
    strongest,
    studentised,
    without_lines,
)
from neusee.nodes.calibrate._validity._hidden_faults import Hidden

_NEAR = ((0, 1), (1, 0))  #: lags in pixels (y, x)
_BOTH = ((1, 1), (1, -1))
_FAR = ((0, 2), (2, 0))
_NOISE = "the noise of neighbouring pixels"
_MIXED = 0.02  #: scale of the prior of the share of the variance that neighbours take from each other
_QUIET = 0.24  #: DN2, least variance of EMVA 1288
_CORE = 1.5  #: standard deviations of the middle of a distribution that gives its robust width


def noise_tests(levels: Sequence[Level]) -> list[FrameTest]:
    """Test the noise of pairs of frames for correlation, block compression, lines, rare jumps and drift.

    The differences of two frames of the same light hold no fixed pattern. Sums of products of neighbouring differences
    are divided by the root of the sum of their squares, so that they are standard normal for independent pixels of any
    variance; sums of squares of line means have a chi-square distribution.

    Shapes: a list of levels -> a list of tests.
    Units:  numbers and limits in standard deviations of chance.
    Error:  each test fails by chance with a probability of 1e-3, for large frames.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 2.4 (white noise) and 6.6; Bonferroni; Wilson and
            Hilferty, PNAS 17, 684 (1931); Anscombe and Glynn, Biometrika 70, 227 (1983).
    """
    paired = [level for level in levels if level.paired and not level.high and not level.low]
    if not paired:
        return []
    white = [without_lines(level.apart) for level in paired]
    lines = [_lines(name, axis, paired, white) for name, axis in (("row", 2), ("column", 1))]
    return [_whiteness(paired, white), blocks(paired, white), *lines, *_telegraph(paired), _drift(paired)]


def _correlation(levels: Sequence[Tensor], lag: tuple[int, int]) -> float:
    """Return the correlation at a lag, of all levels with equal weight."""
    return sum(float(products(x, lag).mean() / x.square().mean().clamp_min(1e-12)) for x in levels) / len(levels)


def _whiteness(levels: Sequence[Level], white: Sequence[Tensor]) -> FrameTest:
    near, far = (
        [sum(studentised(products(x, lag)) for lag in lags) / math.sqrt(2) for x in white] for lags in (_NEAR, _FAR)
    )
    evidence = strongest([near, far], sides=2)
    darks, lit = ([x for x, each in zip(white, levels, strict=True) if each.dark == dark] for dark in (True, False))
    of_readout = _from_readout(darks, lit)
    text = f"{_NOISE} {_correlates(white)}"
    sentence = f"{text}, as in frames that are mixed, denoised, interpolated or compressed"
    if of_readout:
        sentence = (
            f"in the dark {_NOISE} {_correlates(darks)}, as noise of the readout does, which counts as dark noise"
        )
        sentence += f"; in light it {_correlates(lit)}"
    return corrected("white noise", evidence, [*_of_mixing(darks, lit, of_readout)], sentence, text)


def _correlates(levels: Sequence[Tensor]) -> str:
    rows, columns = (_correlation(levels, lag) for lag in _NEAR)
    return f"correlates by {rows:.2g} along rows and {columns:.2g} along columns"


def _from_readout(darks: Sequence[Tensor], lit: Sequence[Tensor]) -> bool:
    """Return True if neighbours are unlike in the dark, and more so than in light, beyond chance.

    A filter that makes neighbours unlike acts on light too; those that act on weak noise alone make neighbours alike.
    An electronic readout adds noise of any correlation, which shot noise hides in light.
    """
    if not darks or not lit:
        return False
    (dark, error), (light, other) = (_missing(levels, _NEAR) for levels in (darks, lit))
    limit = normal_limit(ALARM)
    return dark < -limit * error and dark - light < -limit * math.hypot(error, other)


def _of_mixing(darks: Sequence[Tensor], lit: Sequence[Tensor], of_readout: bool) -> Iterator[Hidden]:
    """Yield what a filter may have taken from the variance in light, and from that in the dark."""
    for chosen, gain, noise in ((lit, 1.0, 0.5 * of_readout), (() if of_readout else darks, 0.0, 0.5)):
        for lags, scale in ((_NEAR, _MIXED), ((*_BOTH, *_FAR), _MIXED / 2)):
            if chosen:  # noise that is made correlated, as by rows of a readout, lacks nothing in the dark
                yield Hidden("mixing", *_missing(chosen, lags), scale, gain, noise, partly=noise > 0)


def _missing(levels: Sequence[Tensor], lags: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Return the logarithm of one plus twice the sum of the correlations at lags, and its standard error.

    A linear filter that keeps the mean lowers the variance of white noise by the factor of all lags.
    """
    total, square = 0.0, 0.0
    for x in levels:
        power = float(x.square().sum()) + 1e-12
        for lag in lags:
            product = products(x, lag)
            total += float(product.sum()) / power
            square += float(product.square().sum()) / power**2
    whole = max(1 + 2 * total / len(levels), 1e-3)
    return math.log(whole), max(2 * math.sqrt(square) / len(levels) / whole, 1e-9)


def _lines(name: str, axis: int, levels: Sequence[Level], white: Sequence[Tensor]) -> FrameTest:
    """Test if the means of rows (axis 2) or columns (axis 1) scatter more than white noise lets them."""
    lag = _NEAR[0] if axis == 2 else _NEAR[1]
    z, shares = [], []
    for level, x in zip(levels, white, strict=True):
        means = level.apart.mean(axis)
        freedom = means.numel() - len(means)
        pixel = float(x.square().mean()) * x.numel() / max(1, x.numel() - len(x) * (x.shape[1] + x.shape[2] - 1))
        together = 1 + 2 * max(0.0, _correlation([x], lag)) + 2 * max(0.0, _correlation([x], (2 * lag[0], 2 * lag[1])))
        ratio = float((means - means.mean(1, keepdim=True)).square().sum()) * level.apart.shape[axis] / (pixel + 1e-12)
        z.append(_hilferty(ratio / together, freedom))
        shares.append((ratio / together / freedom - 1) / level.apart.shape[axis])
    darks = [x for x, level in zip(z, levels, strict=True) if level.dark]
    evidence = strongest([z], more=[sum(darks) / math.sqrt(len(darks))] if darks else [])
    dark = [s for s, level in zip(shares, levels, strict=True) if level.dark] or shares
    noise, gain = (abs(sum(s) / len(s)) / 2 for s in (dark, shares))
    sentence = f"whole {name}s vary together from frame to frame by {math.sqrt(2 * noise):.2g} of the noise of a pixel"
    passed = f"whole {name}s do not vary together from frame to frame"
    return outcome(f"no {name} noise", evidence, sentence, {"noise": noise, "gain": 2 * gain}, passed)


def _hilferty(chi: float, freedom: float) -> float:
    """Return a chi-square number as a standard normal number."""
    third = 2 / (9 * freedom)
    return float((max(chi, 0.0) / freedom) ** (1 / 3) - (1 - third)) / math.sqrt(third)


def _telegraph(levels: Sequence[Level]) -> list[FrameTest]:
    """Test if the noise of dark frames has more large differences than a normal distribution."""
    darks = [level for level in levels if level.dark and level.variance >= _QUIET]
    if not darks:
        return []
    z, wider = [], []
    for level in darks:
        x = level.apart
        square = float(x.square().mean())
        fourth = float(x.pow(4).mean()) / square**2 - 3 + 1 / 60 / square**2  # rounding takes 1/60 of the cumulant
        z.append(_glynn(fourth + 3, x.numel()))
        wider.append(math.sqrt(square) / _core(x + level.drift[:, None, None]) - 1)
    evidence = strongest([z])
    error = abs(sum(wider) / len(wider))
    sentence = f"the dark noise has rare large jumps, and is {error:.1%} wider than its middle, as of telegraph pixels"
    passed = "the dark noise is normal: no telegraph pixels"
    return [outcome("no telegraph noise", evidence, sentence, {"noise": error}, passed)]


def _glynn(kurtosis: float, n: int) -> float:
    """Return the kurtosis of a sample of n normal numbers as a standard normal number (Anscombe and Glynn 1983)."""
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    away = (kurtosis - 3 * (n - 1) / (n + 1)) / math.sqrt(variance)
    skew = 6 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9)) * math.sqrt(6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    freedom = 6 + 8 / skew * (2 / skew + math.sqrt(1 + 4 / skew**2))
    ratio = (1 - 2 / freedom) / (1 + away * math.sqrt(2 / (freedom - 4)))
    root = math.copysign(abs(ratio) ** (1 / 3), ratio)
    return (1 - 2 / (9 * freedom) - root) / math.sqrt(2 / (9 * freedom))


def _core(x: Tensor) -> float:
    """Return the standard deviation of the normal distribution with the same share of small whole numbers."""
    end = round(_CORE * float(x.std()))
    share = float((x.abs() <= end + 0.5).double().mean())
    width = (end + 0.5) / -float(torch.special.ndtri(torch.tensor((1 - share) / 2, dtype=torch.float64)))
    return math.sqrt(width**2 + 1 / 12)


def _drift(levels: Sequence[Level]) -> FrameTest:
    """Test if the mean moves between the frames of a pair."""
    z, shares = [], []
    for level in levels:
        error = math.sqrt(2 * level.variance / level.apart[0].numel() + 1e-12)
        z += (level.drift / error).tolist()
        shares.append(float(level.drift.square().mean()) / 2 / (level.variance + 1e-12))
    evidence = strongest([[x] for x in z], sides=2)
    dark = [s for s, level in zip(shares, levels, strict=True) if level.dark] or [0.0]
    lit = [s for s, level in zip(shares, levels, strict=True) if not level.dark] or [0.0]
    steady = all(level.stack.scatter == "steady" for level in levels)
    shifts = {} if steady else {"gain": max(lit), "noise": max(dark) / 2}
    moved = max((float(level.drift.abs().max()) for level in levels), default=0.0)
    passed = "the mean keeps from frame to frame"
    modelled = "`scatter: steady` removes it from the variance" if steady else ""
    sentence = f"the mean moves by up to {moved:.3g} DN between two frames of a level, as under a drifting lamp"
    return outcome("no drift within a level", evidence, sentence, shifts, passed, modelled)
