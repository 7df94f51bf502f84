"""Tests of the noise of frames: white, Gaussian, without trend or compressed blocks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain

import torch
from torch import Tensor

from neusee.nodes.calibrate._emva_quantities import LEAST_DARK_VARIANCE
from neusee.nodes.calibrate._frame_pairs import (
    FALSE_ALARM_RATE,
    VARIANCE_FLOOR,
    FrameTest,
    Hidden,
    Level,
    chance_of_no_fault,
    dark_and_lit,
    levels_to_test,
    normal_limit,
    outcome,
    sized_outcome,
    strongest_evidence,
    studentised,
    without_lines,
)

# --- block test -----------------------------------------------------------------------------------

# A test of frames for compression in blocks of 8 x 8 pixels, by borders and cosines of blocks.


_BLOCK_SIDE = 8  #: pixels of a block on a side
_STEPS = range(1, 33)  #: DN, steps to which compression may round the cosines of a block
#: standard deviations of a cosine over a step, above which noise covers the step evenly
_EVEN_COVER = 1.2
_COSINE_LEVELS = 4  #: levels whose cosines are computed, those of the most noise
_COSINE_SIDE = 256  #: pixels on a side whose cosines are computed


def block_test(levels: Sequence[Level], white: Sequence[Tensor]) -> FrameTest:
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
    large_levels = [x for x in white if min(x.shape[1:]) > 2 * _BLOCK_SIDE]
    # neighbours across a column border differ along x, those across a row border along y
    border_contrasts = []
    for lag, axis in (((0, 1), 2), ((1, 0), 1)):
        for x in large_levels:
            border_contrasts.append(abs(_contrast_at_borders(neighbour_products(x, lag), axis)))
    noisiest = sorted(levels, key=lambda level: level.variance)[-_COSINE_LEVELS:]
    step_numbers = list(chain.from_iterable(_step_evidence(step, noisiest) for step in _STEPS))
    evidence = strongest_evidence([[x] for x in [*border_contrasts, *step_numbers]])
    sentence = (
        "neighbours correlate otherwise across the borders of blocks of 8 pixels, or the cosines of"
        " blocks keep to"
    )
    sentence += " multiples of a step, as in a compressed picture"
    return outcome(
        "no blocks", evidence, sentence, {}, "no trace of compression in blocks of 8 pixels"
    )


def neighbour_products(x: Tensor, lag: tuple[int, int]) -> Tensor:
    """Return the product of each pixel with its neighbour at a lag, of which the mean is 0 for
    independent pixels.

    The removal of the means of lines correlates the pixels of a line by minus one over the length
    of the line.
    """
    down, right = lag
    height, width = x.shape[1:]
    pixels = x[:, : height - down, max(0, -right) : width - max(0, right)]
    neighbours = x[:, down:, max(0, right) : width - max(0, -right)]
    line_length = math.inf  # of the line that holds both pixels, if one does
    if down == 0:
        line_length = width
    elif right == 0:
        line_length = height
    return pixels * neighbours + x.square().mean() / line_length


def _contrast_at_borders(products: Tensor, axis: int) -> float:
    """Return the difference between products across block borders and products inside blocks, in
    standard errors.
    """
    # the product of the last pixel of a block is that with the first of the next one
    is_last_of_block = torch.arange(products.shape[axis]) % _BLOCK_SIDE == _BLOCK_SIDE - 1
    across_border, inside_blocks = (
        products[(slice(None),) * axis + (places,)].reshape(-1)
        for places in (is_last_of_block, ~is_last_of_block)
    )
    standard_error = (
        across_border.var() / len(across_border) + inside_blocks.var() / len(inside_blocks)
    ).sqrt()
    return float((inside_blocks.mean() - across_border.mean()) / standard_error.clamp_min(1e-12))


def _step_evidence(step: int, levels: Sequence[Level]) -> list[float]:
    """Return how strongly each cosine of the blocks keeps to multiples of a ``step`` in DN, as
    standard normal numbers, and last all cosines together.

    Levels whose noise does not cover the step evenly are left out; without a level the list is
    empty.
    """
    sums_of_cosines, block_count = torch.zeros(_BLOCK_SIDE * _BLOCK_SIDE, dtype=torch.float64), 0
    for level in levels:
        if level.variance < (_EVEN_COVER * step) ** 2:
            continue
        cosines = _block_cosines(level.first[0])
        sums_of_cosines += (2 * math.pi / step * cosines).cos().sum(0)
        block_count += len(cosines)
    if not block_count:
        return []
    # the first cosine is the mean of a block; the variance of cos of an even phase is 1/2
    standard_numbers = (sums_of_cosines[1:] / math.sqrt(block_count / 2)).tolist()
    return [*standard_numbers, sum(standard_numbers) / math.sqrt(len(standard_numbers))]


def _block_cosines(frame: Tensor) -> Tensor:
    """Return the orthonormal cosine transform (block, 64) of the blocks of a frame (y, x)."""
    block_rows, block_columns = (min(size, _COSINE_SIDE) // _BLOCK_SIDE for size in frame.shape)
    frequency, pixel = (torch.arange(_BLOCK_SIDE, dtype=torch.float64) for _ in range(2))
    # cosine transform of type II, with rows of length 1
    basis = (math.pi / _BLOCK_SIDE * frequency[:, None] * (pixel + 0.5)).cos() * math.sqrt(
        2 / _BLOCK_SIDE
    )
    basis[0] /= math.sqrt(2)
    blocks = (
        frame.double()[: block_rows * _BLOCK_SIDE, : block_columns * _BLOCK_SIDE]
        .reshape(block_rows, _BLOCK_SIDE, block_columns, _BLOCK_SIDE)
        .transpose(1, 2)
    )
    coefficients: Tensor = (basis @ blocks @ basis.T).reshape(block_rows * block_columns, -1)
    return coefficients


# --- noise tests ----------------------------------------------------------------------------------

# Tests of the difference of two frames of the same light: its noise must be white, Gaussian and
# without a trend.


_NEAREST_LAGS = ((0, 1), (1, 0))  #: lags in pixels (y, x)
_DIAGONAL_LAGS = ((1, 1), (1, -1))
_SECOND_LAGS = ((0, 2), (2, 0))
_NEIGHBOUR_NOISE = "the noise of neighbouring pixels"
_TELEGRAPH_TEST = "no telegraph noise"
_DRIFT_TEST = "no drift within a level"
_ROOT_MEAN_SQUARE = "stated is the root mean square of all pixels, as EMVA 1288 defines it"
#: scale of the prior of the share of the variance that neighbours take from each other
_MIXING_SCALE = 0.02
#: share of the variance that flicker over uneven light may add without a word
_SMALL_FLICKER = 1e-3
#: standard deviations of the middle of a distribution that gives its robust width
_CORE_HALF_WIDTH = 1.5


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
    paired = levels_to_test(levels)
    if not paired:
        return []
    without_line_means = [without_lines(level.differences) for level in paired]
    line_tests = [
        _line_noise(name, axis, paired, without_line_means)
        for name, axis in (("row", 2), ("column", 1))
    ]
    return [
        _whiteness(paired, without_line_means),
        block_test(paired, without_line_means),
        *line_tests,
        *_telegraph_noise(paired),
        _drift(paired),
    ]


def _correlation(levels: Sequence[Tensor], lag: tuple[int, int]) -> float:
    """Return the correlation at a lag, of all levels with equal weight."""
    return sum(
        float(neighbour_products(x, lag).mean() / x.square().mean().clamp_min(1e-12))
        for x in levels
    ) / len(levels)


def _whiteness(levels: Sequence[Level], white: Sequence[Tensor]) -> FrameTest:
    """Test if the noise of neighbouring pixels is independent.

    ``white`` has the differences of each level without the means of their lines. Correlation of an
    electronic readout, which is in the dark alone, counts as dark noise; any other may have lowered
    the variance.
    """
    # two lags of equal length together: their sum over sqrt(2) is standard normal
    nearest, diagonal, second_nearest = (
        [sum(studentised(neighbour_products(x, lag)) for lag in lags) / math.sqrt(2) for x in white]
        for lags in (_NEAREST_LAGS, _DIAGONAL_LAGS, _SECOND_LAGS)
    )
    evidence = strongest_evidence([nearest, diagonal, second_nearest], sides=2)
    pairs = list(zip(white, levels, strict=True))
    dark_differences = [x for x, level in pairs if level.dark]
    lit_differences = [x for x, level in pairs if not level.dark]
    is_readout = _is_of_readout(dark_differences, lit_differences)
    text = f"{_NEIGHBOUR_NOISE} {_correlation_clause(white)}"
    sentence = f"{text}, as in frames that are mixed, denoised, interpolated or compressed"
    modelled = ""
    if is_readout:
        clause = _correlation_clause(dark_differences)
        sentence = f"in the dark {_NEIGHBOUR_NOISE} {clause}, as noise of the readout does"
        modelled = f"it counts as dark noise; in light it {_correlation_clause(lit_differences)}"
    hidden = [*_hidden_mixing(dark_differences, lit_differences, is_readout, evidence.found)]
    return sized_outcome("white noise", evidence, hidden, sentence, text, modelled)


def _correlation_clause(levels: Sequence[Tensor]) -> str:
    """Return the clause of a sentence on the correlation of neighbours along rows and columns."""
    rows, columns = (_correlation(levels, lag) for lag in _NEAREST_LAGS)
    return f"correlates by {rows:.2g} along rows and {columns:.2g} along columns"


def _is_of_readout(darks: Sequence[Tensor], lit: Sequence[Tensor]) -> bool:
    """Return True if neighbours are unlike in the dark, and more so than in light, beyond chance.

    A filter that makes neighbours unlike acts on light too; those that act on weak noise alone make
    neighbours alike. An electronic readout adds noise of any correlation, which shot noise hides in
    light.
    """
    if not darks or not lit:
        return False
    (dark_log, dark_error), (lit_log, lit_error) = (
        _log_variance_factor(levels, _NEAREST_LAGS) for levels in (darks, lit)
    )
    largest_by_chance = normal_limit(FALSE_ALARM_RATE)
    return (
        dark_log < -largest_by_chance * dark_error
        and dark_log - lit_log < -largest_by_chance * math.hypot(dark_error, lit_error)
    )


def _hidden_mixing(
    darks: Sequence[Tensor], lit: Sequence[Tensor], of_readout: bool, alarm: bool
) -> Iterator[Hidden]:
    """Yield what a filter may have taken from the variance in light, and from that in the dark.

    A filter reaches the eight neighbours of a pixel; one that is found may reach farther.
    """
    lags = (*_NEAREST_LAGS, *_DIAGONAL_LAGS, *(_SECOND_LAGS if alarm else ()))
    sound = chance_of_no_fault(sum(x.numel() for x in lit))
    if lit:
        yield Hidden(
            "mixing", *_log_variance_factor(lit, lags), _MIXING_SCALE, gain=1.0, sound=sound
        )
    if darks and not of_readout:  # the noise of a readout lacks nothing in the dark
        yield Hidden(
            "mixing", *_log_variance_factor(darks, lags), _MIXING_SCALE, noise=0.5, sound=sound
        )


def _log_variance_factor(
    levels: Sequence[Tensor], lags: Sequence[tuple[int, int]]
) -> tuple[float, float]:
    """Return the logarithm of one plus twice the sum of the correlations at ``lags``, as a mean
    over levels, and its standard error.

    A linear filter that keeps the mean lowers the variance of white noise by the factor of all
    lags.
    """
    sum_of_correlations, sum_of_variances = 0.0, 0.0
    for x in levels:
        sum_of_squares = float(x.square().sum()) + 1e-12
        for lag in lags:
            product = neighbour_products(x, lag)
            sum_of_correlations += float(product.sum()) / sum_of_squares
            sum_of_variances += float(product.square().sum()) / sum_of_squares**2
    variance_factor = max(1 + 2 * sum_of_correlations / len(levels), 1e-3)
    return math.log(variance_factor), max(
        2 * math.sqrt(sum_of_variances) / len(levels) / variance_factor, 1e-9
    )


def _line_noise(
    name: str, axis: int, levels: Sequence[Level], white: Sequence[Tensor]
) -> FrameTest:
    """Test if the means of rows (axis 2) or columns (axis 1) scatter more than white noise lets
    them.
    """
    down, right = (0, 1) if axis == 2 else (1, 0)
    standard_numbers, line_shares = [], []
    # x: differences of a level without the means of their lines
    for level, x in zip(levels, white, strict=True):
        pair_count, height, width = x.shape
        line_means = level.differences.mean(axis)
        degrees_of_freedom = line_means.numel() - len(line_means)
        # the means of all lines were fitted: as many degrees of freedom less
        pixel_freedom = max(1, x.numel() - pair_count * (height + width - 1))
        pixel_variance = float(x.square().mean()) * x.numel() / pixel_freedom
        # neighbours that correlate make the mean of a line scatter more
        correlation_factor = (
            1
            + 2 * max(0.0, _correlation([x], (down, right)))
            + 2 * max(0.0, _correlation([x], (2 * down, 2 * right)))
        )
        chi_square = (
            float((line_means - line_means.mean(1, keepdim=True)).square().sum())
            * level.differences.shape[axis]
            / (pixel_variance + 1e-12)
        )
        standard_numbers.append(
            _chi_square_as_normal(chi_square / correlation_factor, degrees_of_freedom)
        )
        # excess of the variance of line means over that of independent pixels
        line_shares.append(
            (chi_square / correlation_factor / degrees_of_freedom - 1)
            / level.differences.shape[axis]
        )
    dark_numbers = [x for x, level in zip(standard_numbers, levels, strict=True) if level.dark]
    dark_sums = [sum(dark_numbers) / math.sqrt(len(dark_numbers))] if dark_numbers else []
    evidence = strongest_evidence([standard_numbers], others=dark_sums)
    dark_shares = [
        s for s, level in zip(line_shares, levels, strict=True) if level.dark
    ] or line_shares
    noise_share, gain_share = (abs(sum(s) / len(s)) / 2 for s in (dark_shares, line_shares))
    sentence = (
        f"whole {name}s vary together from frame to frame by {math.sqrt(2 * noise_share):.2g} of"
        " the noise of a pixel"
    )
    passed = f"whole {name}s do not vary together from frame to frame"
    return outcome(
        f"no {name} noise",
        evidence,
        sentence,
        {"noise": noise_share, "gain": 2 * gain_share},
        passed,
    )


def _chi_square_as_normal(chi: float, freedom: float) -> float:
    """Return a chi-square number as a standard normal number (Wilson and Hilferty: its cube root
    is nearly normal).
    """
    cube_root_variance = 2 / (9 * freedom)
    return float((max(chi, 0.0) / freedom) ** (1 / 3) - (1 - cube_root_variance)) / math.sqrt(
        cube_root_variance
    )


def _telegraph_noise(levels: Sequence[Level]) -> list[FrameTest]:
    """Test if the noise of a pixel in the dark jumps, and tell how much the noise differs from
    pixel to pixel.

    Large differences are of pixels that jump, or of pixels that are noisier than others. A pixel
    that is noisier is so in each pair: then a third of the fourth power of its differences is the
    product of the squares of two of them.
    """
    darks = [level for level in levels if level.dark and level.variance >= LEAST_DARK_VARIANCE]
    if not darks:
        return []
    kurtoses = [_kurtosis(level) for level in darks]
    evidence = strongest_evidence(
        [list(map(_kurtosis_as_normal, kurtoses, [level.differences.numel() for level in darks]))]
    )
    width_excess = abs(sum(map(_width_over_core, darks)) / len(darks))
    # the kurtosis of normal noise is 3
    excess = max(1.0, sum(kurtoses) / len(kurtoses) / 3)
    if evidence.found and _noise_is_of_pixels(darks):
        # unequal pixels leave the mean of their variances less certain than equal ones
        variance_error = math.sqrt(
            (excess - 1) / 2 / sum(level.differences.numel() for level in darks)
        )
        text = (
            f"the dark noise differs from pixel to pixel by about {math.sqrt(excess**0.25 - 1):.0%}"
        )
        text += f", and is {width_excess:.1%} wider than its middle"
        return [
            outcome(
                _TELEGRAPH_TEST, evidence, text, {"noise": variance_error}, "", _ROOT_MEAN_SQUARE
            )
        ]
    sentence = (
        f"the dark noise has rare large jumps, and is {width_excess:.1%} wider than its middle, as"
        " of telegraph pixels"
    )
    passed = "the dark noise is normal: no telegraph pixels"
    return [outcome(_TELEGRAPH_TEST, evidence, sentence, {"noise": width_excess}, passed)]


def _kurtosis(level: Level) -> float:
    """Return the kurtosis of the differences of a level; rounding takes 1/60 from the cumulant."""
    mean_square = float(level.differences.square().mean())
    return float(level.differences.pow(4).mean()) / mean_square**2 + 1 / 60 / mean_square**2


def _width_over_core(level: Level) -> float:
    """Return the relative excess of the standard deviation of a level's differences over that of a
    normal distribution with the same middle.
    """
    return (
        math.sqrt(float(level.differences.square().mean()))
        / _core_deviation(level.differences + level.drift[:, None, None])
        - 1
    )


def _noise_is_of_pixels(levels: Sequence[Level]) -> bool:
    """Return True if each pixel has normal noise in time, of a width that may differ from pixel to
    pixel, as far as chance lets it be told.

    Then the mean fourth power over 3 of a pixel is the mean product of the squares of two different
    pairs.
    """
    shapes = [level.differences.shape[1:] for level in levels]
    common_shape = max(shapes, key=shapes.count)
    scaled_squares = [
        level.differences.square() / float(level.differences.square().mean())
        for level, shape in zip(levels, shapes, strict=True)
        if shape == common_shape
    ]
    squares = torch.cat(scaled_squares)
    pair_count = len(squares)
    if pair_count < 2:
        return False
    sum_of_squares, fourth_powers = squares.sum(0), squares.square().sum(0)
    # (sum of squares)^2 less the squares of each pair, over the number of ordered pairs
    products_of_pairs = (sum_of_squares.square() - fourth_powers) / (pair_count * (pair_count - 1))
    return abs(studentised(fourth_powers / (3 * pair_count) - products_of_pairs)) < normal_limit(
        FALSE_ALARM_RATE / 2
    )


def _kurtosis_as_normal(kurtosis: float, n: int) -> float:
    """Return the kurtosis of a sample of n normal numbers as a standard normal number (Anscombe
    and Glynn 1983).
    """
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    standardised = (kurtosis - 3 * (n - 1) / (n + 1)) / math.sqrt(variance)
    # of the kurtosis, for which a chi-square law of as many degrees of freedom is taken
    skewness = (
        6
        * (n * n - 5 * n + 2)
        / ((n + 7) * (n + 9))
        * math.sqrt(6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    )
    degrees_of_freedom = 6 + 8 / skewness * (2 / skewness + math.sqrt(1 + 4 / skewness**2))
    ratio = (1 - 2 / degrees_of_freedom) / (
        1 + standardised * math.sqrt(2 / (degrees_of_freedom - 4))
    )
    # Wilson and Hilferty: the cube root of such a number is nearly normal
    cube_root = math.copysign(abs(ratio) ** (1 / 3), ratio)
    return (1 - 2 / (9 * degrees_of_freedom) - cube_root) / math.sqrt(2 / (9 * degrees_of_freedom))


def _core_deviation(x: Tensor) -> float:
    """Return the standard deviation of the normal distribution that has the same share of small
    whole numbers as the differences ``x``.
    """
    largest_in_core = round(_CORE_HALF_WIDTH * float(x.std()))
    core_share = float((x.abs() <= largest_in_core + 0.5).double().mean())
    width = (largest_in_core + 0.5) / -float(
        torch.special.ndtri(torch.tensor((1 - core_share) / 2, dtype=torch.float64))
    )
    # whole numbers have 1/12 more variance than the normal distribution that they round
    return math.sqrt(width**2 + 1 / 12)


def _drift(levels: Sequence[Level]) -> FrameTest:
    """Test if the mean moves between the frames of a pair."""
    drift_numbers = list(chain.from_iterable(_drift_over_chance(level) for level in levels))
    evidence = strongest_evidence([[z] for z in drift_numbers], sides=2)
    dark, lit = dark_and_lit(levels)
    uneven_share = sum(level.flicker / (level.variance + VARIANCE_FLOOR) for level in lit) / max(
        1, len(lit)
    )
    farthest = _farthest_drift(levels)
    sentence = (
        f"the mean moves by up to {farthest:.3g} DN between two frames of a level, as under a"
        " drifting lamp"
    )
    passed = "the mean keeps from frame to frame"
    if any(level.scatter != "steady" for level in levels):
        shifts = {"gain": _largest_drift(lit) + uneven_share, "noise": _largest_drift(dark) / 2}
        return outcome(_DRIFT_TEST, evidence, sentence, shifts, passed)
    if uneven_share < _SMALL_FLICKER:
        modelled = "`scatter: steady` removes it from the variance"
        return outcome(_DRIFT_TEST, evidence, sentence, {"gain": uneven_share}, passed, modelled)
    sentence += (
        f", whose light is uneven: this adds {uneven_share:.2%} to the variance, which a mean"
        " cannot remove"
    )
    return outcome(_DRIFT_TEST, evidence, sentence, {"gain": uneven_share}, passed)


def _farthest_drift(levels: Sequence[Level]) -> float:
    """Return the largest drift between the two frames of a pair, in DN."""
    return max((float(level.drift.abs().max()) for level in levels), default=0.0)


def _drift_over_chance(level: Level) -> list[float]:
    """Return the drift of each pair in standard errors."""
    standard_numbers: list[float] = (
        # a mean of n pixels has the variance s^2 / n, the difference of two means twice that
        level.drift / math.sqrt(2 * level.variance / level.differences[0].numel() + VARIANCE_FLOOR)
    ).tolist()
    return standard_numbers


def _largest_drift(levels: Sequence[Level]) -> float:
    """Return the largest share of the variance of a level that is the drift of its mean."""
    return max(
        (
            float(level.drift.square().mean()) / 2 / (level.variance + VARIANCE_FLOOR)
            for level in levels
        ),
        default=0.0,
    )
