"""Tests of the noise of frames: white, Gaussian, without trend or compressed blocks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain

import torch
from torch import Tensor

from neusee.nodes.calibrate._frame_pairs import (
    ALARM,
    FrameTest,
    Hidden,
    Level,
    bounded,
    dark_and_lit,
    normal_limit,
    outcome,
    probably_sound,
    strongest,
    studentised,
    tested,
    without_lines,
)

# --- block test -----------------------------------------------------------------------------------

# A test of frames for compression in blocks of 8 x 8 pixels, by borders and cosines of blocks.


_BLOCK = 8  #: pixels of a block on a side
_STEPS = range(1, 33)  #: DN, steps to which compression may round the cosines of a block
#: standard deviations of a cosine over a step, above which noise covers the step evenly
_SMOOTH = 1.2
_LEVELS, _SIDE = 4, 256  #: levels, and pixels on a side, whose cosines are computed


def blocks(levels: Sequence[Level], white: Sequence[Tensor]) -> FrameTest:
    """Test if pixels were compressed in blocks of 8 x 8.

    Products of neighbouring differences ``white`` must be alike across the borders of blocks and
    inside blocks. The cosines of a block must not keep to multiples of a step: the mean of cos(2 pi
    cosine / step) is 0 without compression.

    Shapes: differences (pair, y, x) of each level -> a test.
    Units:  the number and the limit in standard deviations of chance.
    Error:  steps that are whole numbers up to 32 DN, of the orthonormal transform. It fails by
            chance once in 1000.
    Source: ITU-T Recommendation T.81 (JPEG), sections A.3.3 and A.3.4.
    """
    large = [x for x in white if min(x.shape[1:]) > 2 * _BLOCK]
    lags = (((0, 1), 2), ((1, 0), 1))
    across = [[abs(_across(products(x, lag), axis)) for x in large] for lag, axis in lags]
    bright = sorted(levels, key=lambda level: level.variance)[-_LEVELS:]
    steps = list(chain.from_iterable(_kept_to(step, bright) for step in _STEPS))
    evidence = strongest([[x] for x in [*across[0], *across[1], *steps]])
    sentence = (
        "neighbours correlate otherwise across the borders of blocks of 8 pixels, or the cosines of"
        " blocks keep to"
    )
    sentence += " multiples of a step, as in a compressed picture"
    return outcome(
        "no blocks", evidence, sentence, {}, "no trace of compression in blocks of 8 pixels"
    )


def products(x: Tensor, lag: tuple[int, int]) -> Tensor:
    """Return the product of each pixel with its neighbour at a lag, of which the mean is 0 for
    independent pixels.

    The removal of the means of lines correlates the pixels of a line by minus one over the length
    of the line.
    """
    down, right = lag
    height, width = x.shape[1:]
    first = x[:, : height - down, max(0, -right) : width - max(0, right)]
    other = x[:, down:, max(0, right) : width - max(0, -right)]
    length = math.inf  # of the line that holds both pixels, if one does
    if down == 0:
        length = width
    elif right == 0:
        length = height
    return first * other + x.square().mean() / length


def _across(products: Tensor, axis: int) -> float:
    """Return the difference between products across block borders and products inside blocks, in
    standard errors.
    """
    border = torch.arange(products.shape[axis]) % _BLOCK == _BLOCK - 1
    across, inside = (
        products[(slice(None),) * axis + (places,)].reshape(-1) for places in (border, ~border)
    )
    error = (across.var() / len(across) + inside.var() / len(inside)).sqrt()
    return float((inside.mean() - across.mean()) / error.clamp_min(1e-12))


def _kept_to(step: int, levels: Sequence[Level]) -> list[float]:
    """Return how strongly each cosine keeps to multiples of a step, as standard normal numbers,
    and all together.
    """
    sums, count = torch.zeros(_BLOCK * _BLOCK, dtype=torch.float64), 0
    for level in levels:
        if level.variance < (_SMOOTH * step) ** 2:
            continue
        cosines = _cosines(level.first[0])
        sums += (2 * math.pi / step * cosines).cos().sum(0)
        count += len(cosines)
    if not count:
        return []
    z = (sums[1:] / math.sqrt(count / 2)).tolist()
    return [*z, sum(z) / math.sqrt(len(z))]


def _cosines(frame: Tensor) -> Tensor:
    """Return the orthonormal cosine transform (block, 64) of the blocks of a frame (y, x)."""
    n, m = (min(size, _SIDE) // _BLOCK for size in frame.shape)
    k, x = (torch.arange(_BLOCK, dtype=torch.float64) for _ in range(2))
    basis = (math.pi / _BLOCK * k[:, None] * (x + 0.5)).cos() * math.sqrt(2 / _BLOCK)
    basis[0] /= math.sqrt(2)
    blocks = (
        frame.double()[: n * _BLOCK, : m * _BLOCK].reshape(n, _BLOCK, m, _BLOCK).transpose(1, 2)
    )
    coefficients: Tensor = (basis @ blocks @ basis.T).reshape(n * m, -1)
    return coefficients


# --- noise tests ----------------------------------------------------------------------------------

# Tests of the difference of two frames of the same light: its noise must be white, Gaussian and
# without a trend.


_NEAR = ((0, 1), (1, 0))  #: lags in pixels (y, x)
_CORNERS = ((1, 1), (1, -1))
_FAR = ((0, 2), (2, 0))
_NOISE = "the noise of neighbouring pixels"
_JUMPS, _DRIFT = "no telegraph noise", "no drift within a level"
_ROOT_MEAN_SQUARE = "stated is the root mean square of all pixels, as EMVA 1288 defines it"
#: scale of the prior of the share of the variance that neighbours take from each other
_MIXED = 0.02
_STEADY = 1e-3  #: share of the variance that flicker over uneven light may add without a word
_QUIET = 0.24  #: DN2, least variance of EMVA 1288
_TINY = 1e-12  #: DN2
_CORE = 1.5  #: standard deviations of the middle of a distribution that gives its robust width


def noise_tests(levels: Sequence[Level]) -> list[FrameTest]:
    """Test the noise of pairs of frames for correlation, block compression, lines, rare jumps and
    drift.

    Only levels that the fit uses are tested. The differences of two frames of the same light hold
    no fixed pattern. Sums of products of neighbouring differences are divided by the root of the
    sum of their squares, so that they are standard normal for independent pixels of any variance;
    sums of squares of line means have a chi-square distribution.

    Shapes: a list of levels -> a list of tests.
    Units:  numbers and limits in standard deviations of chance.
    Error:  each test fails by chance with a probability of 1e-3, for large frames.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 2.4 (white noise) and 6.6; Bonferroni;
            Wilson and Hilferty, PNAS 17, 684 (1931); Anscombe and Glynn, Biometrika 70, 227 (1983).
    """
    paired = tested(levels)
    if not paired:
        return []
    white = [without_lines(level.apart) for level in paired]
    lines = [_lines(name, axis, paired, white) for name, axis in (("row", 2), ("column", 1))]
    return [
        _whiteness(paired, white),
        blocks(paired, white),
        *lines,
        *_telegraph(paired),
        _drift(paired),
    ]


def _correlation(levels: Sequence[Tensor], lag: tuple[int, int]) -> float:
    """Return the correlation at a lag, of all levels with equal weight."""
    return sum(
        float(products(x, lag).mean() / x.square().mean().clamp_min(1e-12)) for x in levels
    ) / len(levels)


def _whiteness(levels: Sequence[Level], white: Sequence[Tensor]) -> FrameTest:
    near, corners, far = (
        [sum(studentised(products(x, lag)) for lag in lags) / math.sqrt(2) for x in white]
        for lags in (_NEAR, _CORNERS, _FAR)
    )
    evidence = strongest([near, corners, far], sides=2)
    pairs = list(zip(white, levels, strict=True))
    darks = [x for x, level in pairs if level.dark]
    lit = [x for x, level in pairs if not level.dark]
    of_readout = _from_readout(darks, lit)
    text = f"{_NOISE} {_correlates(white)}"
    sentence = f"{text}, as in frames that are mixed, denoised, interpolated or compressed"
    modelled = ""
    if of_readout:
        sentence = f"in the dark {_NOISE} {_correlates(darks)}, as noise of the readout does"
        modelled = f"it counts as dark noise; in light it {_correlates(lit)}"
    hidden = [*_of_mixing(darks, lit, of_readout, evidence.found)]
    return bounded("white noise", evidence, hidden, sentence, text, modelled)


def _correlates(levels: Sequence[Tensor]) -> str:
    rows, columns = (_correlation(levels, lag) for lag in _NEAR)
    return f"correlates by {rows:.2g} along rows and {columns:.2g} along columns"


def _from_readout(darks: Sequence[Tensor], lit: Sequence[Tensor]) -> bool:
    """Return True if neighbours are unlike in the dark, and more so than in light, beyond chance.

    A filter that makes neighbours unlike acts on light too; those that act on weak noise alone make
    neighbours alike. An electronic readout adds noise of any correlation, which shot noise hides in
    light.
    """
    if not darks or not lit:
        return False
    (dark, error), (light, other) = (_missing(levels, _NEAR) for levels in (darks, lit))
    limit = normal_limit(ALARM)
    return dark < -limit * error and dark - light < -limit * math.hypot(error, other)


def _of_mixing(
    darks: Sequence[Tensor], lit: Sequence[Tensor], of_readout: bool, alarm: bool
) -> Iterator[Hidden]:
    """Yield what a filter may have taken from the variance in light, and from that in the dark.

    A filter reaches the eight neighbours of a pixel; one that is found may reach farther.
    """
    lags = (*_NEAR, *_CORNERS, *(_FAR if alarm else ()))
    sound = probably_sound(sum(x.numel() for x in lit))
    if lit:
        yield Hidden("mixing", *_missing(lit, lags), _MIXED, gain=1.0, sound=sound)
    if darks and not of_readout:  # the noise of a readout lacks nothing in the dark
        yield Hidden("mixing", *_missing(darks, lags), _MIXED, noise=0.5, sound=sound)


def _missing(levels: Sequence[Tensor], lags: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Return the logarithm of one plus twice the sum of the correlations at lags, and its standard
    error.

    A linear filter that keeps the mean lowers the variance of white noise by the factor of all
    lags.
    """
    total, square = 0.0, 0.0
    for x in levels:
        power = float(x.square().sum()) + 1e-12
        for lag in lags:
            product = products(x, lag)
            total += float(product.sum()) / power
            square += float(product.square().sum()) / power**2
    remaining = max(1 + 2 * total / len(levels), 1e-3)
    return math.log(remaining), max(2 * math.sqrt(square) / len(levels) / remaining, 1e-9)


def _lines(name: str, axis: int, levels: Sequence[Level], white: Sequence[Tensor]) -> FrameTest:
    """Test if the means of rows (axis 2) or columns (axis 1) scatter more than white noise lets
    them.
    """
    lag = _NEAR[0] if axis == 2 else _NEAR[1]
    z, shares = [], []
    for level, x in zip(levels, white, strict=True):
        means = level.apart.mean(axis)
        freedom = means.numel() - len(means)
        pixel = (
            float(x.square().mean())
            * x.numel()
            / max(1, x.numel() - len(x) * (x.shape[1] + x.shape[2] - 1))
        )
        together = (
            1
            + 2 * max(0.0, _correlation([x], lag))
            + 2 * max(0.0, _correlation([x], (2 * lag[0], 2 * lag[1])))
        )
        ratio = (
            float((means - means.mean(1, keepdim=True)).square().sum())
            * level.apart.shape[axis]
            / (pixel + 1e-12)
        )
        z.append(_hilferty(ratio / together, freedom))
        shares.append((ratio / together / freedom - 1) / level.apart.shape[axis])
    darks = [x for x, level in zip(z, levels, strict=True) if level.dark]
    evidence = strongest([z], others=[sum(darks) / math.sqrt(len(darks))] if darks else [])
    dark = [s for s, level in zip(shares, levels, strict=True) if level.dark] or shares
    noise, gain = (abs(sum(s) / len(s)) / 2 for s in (dark, shares))
    sentence = (
        f"whole {name}s vary together from frame to frame by {math.sqrt(2 * noise):.2g} of the"
        " noise of a pixel"
    )
    passed = f"whole {name}s do not vary together from frame to frame"
    return outcome(
        f"no {name} noise", evidence, sentence, {"noise": noise, "gain": 2 * gain}, passed
    )


def _hilferty(chi: float, freedom: float) -> float:
    """Return a chi-square number as a standard normal number."""
    third = 2 / (9 * freedom)
    return float((max(chi, 0.0) / freedom) ** (1 / 3) - (1 - third)) / math.sqrt(third)


def _telegraph(levels: Sequence[Level]) -> list[FrameTest]:
    """Test if the noise of a pixel in the dark jumps, and tell how much the noise differs from
    pixel to pixel.

    Large differences are of pixels that jump, or of pixels that are noisier than others. A pixel
    that is noisier is so in each pair: then a third of the fourth power of its differences is the
    product of the squares of two of them.
    """
    darks = [level for level in levels if level.dark and level.variance >= _QUIET]
    if not darks:
        return []
    fourths = [_fourth(level) for level in darks]
    evidence = strongest([list(map(_glynn, fourths, [level.apart.numel() for level in darks]))])
    error = abs(sum(map(_width_over_core, darks)) / len(darks))
    excess = max(1.0, sum(fourths) / len(fourths) / 3)
    if evidence.found and _same_in_each_pair(darks):
        # unequal pixels leave the mean of their variances less certain than equal ones
        unsure = math.sqrt((excess - 1) / 2 / sum(level.apart.numel() for level in darks))
        text = (
            f"the dark noise differs from pixel to pixel by about {math.sqrt(excess**0.25 - 1):.0%}"
        )
        text += f", and is {error:.1%} wider than its middle"
        return [outcome(_JUMPS, evidence, text, {"noise": unsure}, "", _ROOT_MEAN_SQUARE)]
    sentence = (
        f"the dark noise has rare large jumps, and is {error:.1%} wider than its middle, as of"
        " telegraph pixels"
    )
    passed = "the dark noise is normal: no telegraph pixels"
    return [outcome(_JUMPS, evidence, sentence, {"noise": error}, passed)]


def _fourth(level: Level) -> float:
    """Return the kurtosis of the differences of a level; rounding takes 1/60 from the cumulant."""
    square = float(level.apart.square().mean())
    return float(level.apart.pow(4).mean()) / square**2 + 1 / 60 / square**2


def _width_over_core(level: Level) -> float:
    """Return the relative excess of the standard deviation of differences over that of their
    middle.
    """
    return (
        math.sqrt(float(level.apart.square().mean()))
        / _core(level.apart + level.drift[:, None, None])
        - 1
    )


def _same_in_each_pair(levels: Sequence[Level]) -> bool:
    """Return True if each pixel has normal noise, of a width that may differ from pixel to
    pixel, beyond chance.
    """
    shapes = [level.apart.shape[1:] for level in levels]
    common = max(shapes, key=shapes.count)
    scaled = [
        level.apart.square() / float(level.apart.square().mean())
        for level, shape in zip(levels, shapes, strict=True)
        if shape == common
    ]
    squares = torch.cat(scaled)
    count = len(squares)
    if count < 2:
        return False
    sums, fourths = squares.sum(0), squares.square().sum(0)
    across = (sums.square() - fourths) / (count * (count - 1))
    return abs(studentised(fourths / (3 * count) - across)) < normal_limit(ALARM / 2)


def _glynn(kurtosis: float, n: int) -> float:
    """Return the kurtosis of a sample of n normal numbers as a standard normal number (Anscombe
    and Glynn 1983).
    """
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    away = (kurtosis - 3 * (n - 1) / (n + 1)) / math.sqrt(variance)
    skew = (
        6
        * (n * n - 5 * n + 2)
        / ((n + 7) * (n + 9))
        * math.sqrt(6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    )
    freedom = 6 + 8 / skew * (2 / skew + math.sqrt(1 + 4 / skew**2))
    ratio = (1 - 2 / freedom) / (1 + away * math.sqrt(2 / (freedom - 4)))
    root = math.copysign(abs(ratio) ** (1 / 3), ratio)
    return (1 - 2 / (9 * freedom) - root) / math.sqrt(2 / (9 * freedom))


def _core(x: Tensor) -> float:
    """Return the standard deviation of the normal distribution with the same share of small
    whole numbers.
    """
    end = round(_CORE * float(x.std()))
    share = float((x.abs() <= end + 0.5).double().mean())
    width = (end + 0.5) / -float(
        torch.special.ndtri(torch.tensor((1 - share) / 2, dtype=torch.float64))
    )
    return math.sqrt(width**2 + 1 / 12)


def _drift(levels: Sequence[Level]) -> FrameTest:
    """Test if the mean moves between the frames of a pair."""
    drifts = list(chain.from_iterable(_drift_over_chance(level) for level in levels))
    evidence = strongest([[z] for z in drifts], sides=2)
    dark, lit = dark_and_lit(levels)
    uneven = sum(level.flicker / (level.variance + _TINY) for level in lit) / max(1, len(lit))
    moved = _farthest_drift(levels)
    sentence = (
        f"the mean moves by up to {moved:.3g} DN between two frames of a level, as under a drifting"
        " lamp"
    )
    passed = "the mean keeps from frame to frame"
    if any(level.scatter != "steady" for level in levels):
        shifts = {"gain": _largest_drift(lit) + uneven, "noise": _largest_drift(dark) / 2}
        return outcome(_DRIFT, evidence, sentence, shifts, passed)
    if uneven < _STEADY:
        modelled = "`scatter: steady` removes it from the variance"
        return outcome(_DRIFT, evidence, sentence, {"gain": uneven}, passed, modelled)
    sentence += (
        f", whose light is uneven: this adds {uneven:.2%} to the variance, which a mean cannot"
        " remove"
    )
    return outcome(_DRIFT, evidence, sentence, {"gain": uneven}, passed)


def _farthest_drift(levels: Sequence[Level]) -> float:
    """Return the largest drift between the two frames of a pair, in DN."""
    return max((float(level.drift.abs().max()) for level in levels), default=0.0)


def _drift_over_chance(level: Level) -> list[float]:
    """Return the drift of each pair in standard errors."""
    z: list[float] = (
        level.drift / math.sqrt(2 * level.variance / level.apart[0].numel() + _TINY)
    ).tolist()
    return z


def _largest_drift(levels: Sequence[Level]) -> float:
    """Return the largest share of the variance of a level that is the drift of its mean."""
    return max(
        (float(level.drift.square().mean()) / 2 / (level.variance + _TINY) for level in levels),
        default=0.0,
    )
