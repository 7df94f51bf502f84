"""Tests of the noise of frames: is it white and Gaussian, without drift and block compression?"""

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

# A test for compression in blocks of 8 x 8 pixels, such as JPEG, by the borders of blocks and their
# cosine transform (DCT).


_BLOCK_SIDE = 8  #: pixels of a block on a side
_STEPS = range(1, 33)  #: DN, quantisation steps of the DCT coefficients that are tested
#: noise of at least this many steps makes the DCT coefficients uniform modulo a step
_EVEN_COVER = 1.2
_COSINE_LEVELS = 4  #: number of levels whose DCT is computed, the noisiest ones
_COSINE_SIDE = 256  #: side in pixels of the area whose DCT is computed


def block_test(levels: Sequence[Level], white: Sequence[Tensor]) -> FrameTest:
    """Test if frames were compressed in blocks of 8 x 8 pixels.

    The mean product of neighbouring differences ``white`` must be the same across block borders and
    inside blocks. The DCT coefficients of a block must not be multiples of a step: without
    compression the mean of cos(2 pi coefficient / step) is 0.

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
    """Return the product of each pixel with its neighbour at a lag (y, x); the mean is 0 for
    independent pixels.

    Subtracting line means correlates the pixels of a line by -1 / length; this is corrected.
    """
    down, right = lag
    height, width = x.shape[1:]
    pixels = x[:, : height - down, max(0, -right) : width - max(0, right)]
    neighbours = x[:, down:, max(0, right) : width - max(0, -right)]
    # length of the row or column that contains both pixels; infinite for a diagonal lag
    line_length = math.inf
    if down == 0:
        line_length = width
    elif right == 0:
        line_length = height
    return pixels * neighbours + x.square().mean() / line_length


def _contrast_at_borders(products: Tensor, axis: int) -> float:
    """Return the difference of the mean products inside blocks and across block borders, in
    standard errors.
    """
    # the last pixel of a block is multiplied by the first pixel of the next block
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
    """Return a standard normal statistic for each DCT coefficient, large if its values are
    multiples of ``step`` DN, and last one for all coefficients together.

    Levels whose noise is too small for the step are left out; if none remains, the list is empty.
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
    # without coefficient 0, the mean of a block; the variance of cos(phase) is 1/2 for a uniform
    # phase
    standard_numbers = (sums_of_cosines[1:] / math.sqrt(block_count / 2)).tolist()
    return [*standard_numbers, sum(standard_numbers) / math.sqrt(len(standard_numbers))]


def _block_cosines(frame: Tensor) -> Tensor:
    """Return the orthonormal DCT coefficients (block, 64) of the 8 x 8 blocks of a frame (y, x)."""
    block_rows, block_columns = (min(size, _COSINE_SIDE) // _BLOCK_SIDE for size in frame.shape)
    frequency, pixel = (torch.arange(_BLOCK_SIDE, dtype=torch.float64) for _ in range(2))
    # cosine transform of type II (DCT-II), with basis vectors of length 1
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
# without drift.


_NEAREST_LAGS = ((0, 1), (1, 0))  #: lags in pixels (y, x)
_DIAGONAL_LAGS = ((1, 1), (1, -1))
_SECOND_LAGS = ((0, 2), (2, 0))
_NEIGHBOUR_NOISE = "the noise of neighbouring pixels"
_TELEGRAPH_TEST = "no telegraph noise"
_DRIFT_TEST = "no drift within a level"
_ROOT_MEAN_SQUARE = "stated is the root mean square of all pixels, as EMVA 1288 defines it"
#: prior scale of the relative change of the variance by mixing of neighbouring pixels
_MIXING_SCALE = 0.02
#: share of the variance that a flickering lamp may add, over uneven light, without a warning
_SMALL_FLICKER = 1e-3
#: half-width, in standard deviations, of the core of a distribution from which its width is
#: estimated
_CORE_HALF_WIDTH = 1.5


def noise_tests(levels: Sequence[Level]) -> list[FrameTest]:
    """Test the noise of pairs of frames for correlation, block compression, row and column noise,
    telegraph noise and drift.

    Only levels that the fit uses are tested. The difference of two frames of the same light has no
    fixed pattern. Sums of products of neighbouring differences are divided by the root of the sum
    of the squared products, so that they are standard normal for independent pixels of any
    variance; sums of squares of line means have a chi-square distribution.

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
    """Return the correlation coefficient of pixels at a lag (y, x), averaged over the levels."""
    return sum(
        float(neighbour_products(x, lag).mean() / x.square().mean().clamp_min(1e-12))
        for x in levels
    ) / len(levels)


def _whiteness(levels: Sequence[Level], white: Sequence[Tensor]) -> FrameTest:
    """Test if the noise of neighbouring pixels is uncorrelated.

    ``white`` has the differences of each level with row and column means subtracted. Correlation
    that the readout electronics cause, which shows in the dark only, counts as dark noise; any
    other correlation may come from a filter that lowered the variance.
    """
    # two lags of equal length combined: the sum of two standard normal values over sqrt(2)
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
    """Return the text on the correlation of neighbours along rows and along columns."""
    rows, columns = (_correlation(levels, lag) for lag in _NEAREST_LAGS)
    return f"correlates by {rows:.2g} along rows and {columns:.2g} along columns"


def _is_of_readout(darks: Sequence[Tensor], lit: Sequence[Tensor]) -> bool:
    """Return True if neighbours are anticorrelated in the dark, and more so than in light, beyond
    chance: a sign of readout electronics.

    A filter that anticorrelates neighbours does so in light too, and a filter that acts on weak
    noise only correlates them positively. Readout noise may have any correlation, and in light it
    is hidden by shot noise.
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
    """Yield the possible loss of variance by a filter, in light and in the dark, each as a hidden
    fault.

    A filter is assumed to mix a pixel with its eight neighbours; if the test has found one, also
    with pixels two away.
    """
    lags = (*_NEAREST_LAGS, *_DIAGONAL_LAGS, *(_SECOND_LAGS if alarm else ()))
    sound = chance_of_no_fault(sum(x.numel() for x in lit))
    if lit:
        yield Hidden(
            "mixing", *_log_variance_factor(lit, lags), _MIXING_SCALE, gain=1.0, sound=sound
        )
    if darks and not of_readout:  # correlated readout noise loses no variance in the dark
        yield Hidden(
            "mixing", *_log_variance_factor(darks, lags), _MIXING_SCALE, noise=0.5, sound=sound
        )


def _log_variance_factor(
    levels: Sequence[Tensor], lags: Sequence[tuple[int, int]]
) -> tuple[float, float]:
    """Return the logarithm of 1 + 2 x the sum of the correlations at ``lags``, averaged over
    levels, and its standard error.

    With all lags, this factor is the true over the measured variance of white noise behind a linear
    filter that keeps the mean.
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
    """Test if the means of rows (axis 2) or columns (axis 1) scatter more than white noise
    explains.
    """
    down, right = (0, 1) if axis == 2 else (1, 0)
    standard_numbers, line_shares = [], []
    # x: differences of a level with row and column means subtracted
    for level, x in zip(levels, white, strict=True):
        pair_count, height, width = x.shape
        line_means = level.differences.mean(axis)
        degrees_of_freedom = line_means.numel() - len(line_means)
        # the subtracted row and column means take as many degrees of freedom
        pixel_freedom = max(1, x.numel() - pair_count * (height + width - 1))
        pixel_variance = float(x.square().mean()) * x.numel() / pixel_freedom
        # correlated neighbours make the mean of a line scatter more
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
    """Convert a chi-square value to a standard normal value (Wilson and Hilferty: its cube root is
    nearly normal).
    """
    cube_root_variance = 2 / (9 * freedom)
    return float((max(chi, 0.0) / freedom) ** (1 / 3) - (1 - cube_root_variance)) / math.sqrt(
        cube_root_variance
    )


def _telegraph_noise(levels: Sequence[Level]) -> list[FrameTest]:
    """Test for telegraph noise, rare jumps of the dark noise, and report how much the noise differs
    from pixel to pixel.

    Large differences come from pixels that jump, or from pixels that are always noisier than
    others. For normal noise of any width, E(d1^4) / 3 = E(d1^2 d2^2) for the differences d1 and d2
    of two pairs of a pixel.
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
        # the mean variance of unequal pixels is less certain than that of equal ones
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
    """Return the kurtosis of the differences of a level; rounding lowers the fourth cumulant by
    1/60, which is corrected.
    """
    mean_square = float(level.differences.square().mean())
    return float(level.differences.pow(4).mean()) / mean_square**2 + 1 / 60 / mean_square**2


def _width_over_core(level: Level) -> float:
    """Return by what share the standard deviation of a level's differences exceeds that of a normal
    distribution with the same core.
    """
    return (
        math.sqrt(float(level.differences.square().mean()))
        / _core_deviation(level.differences + level.drift[:, None, None])
        - 1
    )


def _noise_is_of_pixels(levels: Sequence[Level]) -> bool:
    """Return True if the data agree with normal temporal noise of each pixel, whose standard
    deviation may differ from pixel to pixel.

    Then, for each pixel, a third of the mean fourth power of its differences is the mean product of
    the squared differences of two pairs.
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
    # mean product of two different squares: ((sum of squares)^2 - sum of fourth powers) / (n (n -
    # 1))
    products_of_pairs = (sum_of_squares.square() - fourth_powers) / (pair_count * (pair_count - 1))
    return abs(studentised(fourth_powers / (3 * pair_count) - products_of_pairs)) < normal_limit(
        FALSE_ALARM_RATE / 2
    )


def _kurtosis_as_normal(kurtosis: float, n: int) -> float:
    """Convert the sample kurtosis of n normal values to a standard normal value (Anscombe and Glynn
    1983).
    """
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    standardised = (kurtosis - 3 * (n - 1) / (n + 1)) / math.sqrt(variance)
    # skewness of the sample kurtosis; a chi-square distribution of the same skewness approximates
    # it
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
    # Wilson and Hilferty: the cube root of a chi-square value is nearly normal
    cube_root = math.copysign(abs(ratio) ** (1 / 3), ratio)
    return (1 - 2 / (9 * degrees_of_freedom) - cube_root) / math.sqrt(2 / (9 * degrees_of_freedom))


def _core_deviation(x: Tensor) -> float:
    """Return the standard deviation of the normal distribution with the same share of values within
    1.5 standard deviations as the differences ``x``, which are whole numbers.
    """
    largest_in_core = round(_CORE_HALF_WIDTH * float(x.std()))
    core_share = float((x.abs() <= largest_in_core + 0.5).double().mean())
    width = (largest_in_core + 0.5) / -float(
        torch.special.ndtri(torch.tensor((1 - core_share) / 2, dtype=torch.float64))
    )
    # rounding to whole numbers adds the variance 1/12
    return math.sqrt(width**2 + 1 / 12)


def _drift(levels: Sequence[Level]) -> FrameTest:
    """Test if the mean changes between the frames of a pair."""
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
        # the difference of two means of n pixels has the variance 2 s^2 / n
        level.drift / math.sqrt(2 * level.variance / level.differences[0].numel() + VARIANCE_FLOOR)
    ).tolist()
    return standard_numbers


def _largest_drift(levels: Sequence[Level]) -> float:
    """Return the largest share of the drift of the mean in the variance of a level."""
    return max(
        (
            float(level.drift.square().mean()) / 2 / (level.variance + VARIANCE_FLOOR)
            for level in levels
        ),
        default=0.0,
    )
