"""Tests of what frames have in common: fixed patterns, uneven light, lag, a colour mosaic."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from neusee.nodes.calibrate._frame_pairs import (
    Evidence,
    FrameTest,
    Hidden,
    Level,
    chance_of_no_fault,
    dark_and_lit,
    levels_to_test,
    outcome,
    saturated_levels,
    sized_outcome,
    strongest_evidence,
    studentised,
    without_lines,
)

# --- lag test -------------------------------------------------------------------------------------

# A test for image lag: noise of a frame that persists in the next frame, apart from fixed patterns.


#: pixels beyond this number of standard deviations count as defective and are left out
_OUTLIER_SIGMA = 4.5
_SPARE_LEVELS = 3  #: least number of levels in excess of the fitted pattern terms
_CURVED_LEVELS = 6  #: least number of lit levels for a term in the square of the signal
_LAG_SCALE = 0.02  #: prior scale of the relative change of the variance by lag


def lag_test(levels: Sequence[Level]) -> list[FrameTest]:
    """Test if the noise of a frame persists in the next frame of the same light.

    The pattern of each pixel is fitted over the levels, separately for first and for second frames:
    an offset, and terms in proportion to the signal, to its square, and to the exposure. The
    residuals of first and second frames are independent noise, unless the first frame persists in
    the second. If a share L persists, the variance of a pair is multiplied by (1 - L)**2 / (1 + L).

    Shapes: a list of levels -> a list of one test, or of none.
    Units:  number and limit in standard deviations of chance.
    Error:  the test fails by chance with a probability of 1e-3. It needs three levels more than the
            parts of a pattern.
    Source: Janesick, Photon Transfer, SPIE Press 2007, chapter 8 (image lag); weighted least
            squares.
    """
    comparable_levels = _comparable_levels(levels)
    patterns = _pattern_parts(comparable_levels)
    if len(comparable_levels) < patterns.shape[1] + _SPARE_LEVELS - 1:
        return []
    weight = torch.tensor(
        [max(level.variance, 1e-12) for level in comparable_levels], dtype=torch.float64
    ).rsqrt()
    # orthonormal basis of the pattern terms over the levels, each level over its standard deviation
    pattern_basis = torch.linalg.qr(weight[:, None] * patterns).Q
    counted_levels = torch.tensor([not level.dark for level in comparable_levels])
    # without lit levels, the dark ones are used
    counted_levels = counted_levels if bool(counted_levels.any()) else ~counted_levels
    pairs = min(len(level.differences) for level in comparable_levels)
    first, second = (
        [level.first for level in comparable_levels],
        [level.second for level in comparable_levels],
    )
    products, total_power = [], 0.0
    for pair in range(pairs):
        first_noise = _noise_of_pair(first, pair, weight, pattern_basis)[counted_levels]
        second_noise = _noise_of_pair(second, pair, weight, pattern_basis)[counted_levels]
        product_of_pair, power = _product_and_power(first_noise, second_noise)
        products.append(product_of_pair)
        total_power += power
    product_of_all = torch.stack(products)
    evidence = strongest_evidence([[studentised(product_of_all)]], sides=2)
    share, error = (
        float(product_of_all.sum()) / total_power,
        math.sqrt(float(product_of_all.square().sum())) / total_power,
    )
    limited_share = min(max(share, -0.9), 0.9)
    # logarithm of true over measured variance, (1 + L) / (1 - L)^2
    log_variance_factor = math.log((1 + limited_share) / (1 - limited_share) ** 2)
    sound = chance_of_no_fault(
        pairs * int(counted_levels.sum()) * comparable_levels[0].first[0].numel()
    )
    error_of_log = max(3 * error, 1e-9)
    hidden = [
        Hidden(
            "lag",
            log_variance_factor,
            error_of_log,
            _LAG_SCALE,
            gain=1.0,
            noise=0.5,
            positive=True,
            sound=sound,
        )
    ]
    sentence = f"{share:.1%} of the noise of a frame persists in the next frame, as by lag"
    passed = f"the noise of a frame does not persist in the next frame ({share:.2%} ± {error:.2%})"
    return [sized_outcome("no lag", evidence, hidden, sentence, passed)]


def _noise_of_pair(frames: Sequence[Tensor], pair: int, weight: Tensor, basis: Tensor) -> Tensor:
    """Return the residuals (level, y, x) of one frame per level, of the pair with index ``pair``,
    after the patterns are removed, in standard deviations.
    """
    return _without_patterns(
        torch.stack([of_level[pair].double() for of_level in frames]), weight, basis
    )


def _product_and_power(u: Tensor, v: Tensor) -> tuple[Tensor, float]:
    """Return the product of the noise of two frames, summed over the levels, and the mean power of
    the noise, both without outliers.
    """
    inliers = (u.abs() < _OUTLIER_SIGMA * _robust_deviation(u)) & (
        v.abs() < _OUTLIER_SIGMA * _robust_deviation(v)
    )
    power = 0.5 * float(((u.square() + v.square()) * inliers).sum())
    return (u * v * inliers).sum(0), power


def _comparable_levels(levels: Sequence[Level]) -> list[Level]:
    """Return the dark levels, and the lit levels up to that of the greatest variance, whose frames
    have the most frequent shape.
    """
    shapes = [level.differences.shape[1:] for level in levels]
    common_shape = max(shapes, key=shapes.count)
    mean_at_peak = max(levels, key=lambda level: level.variance).mean
    candidates = zip(levels, shapes, strict=True)
    return [
        level
        for level, shape in candidates
        if shape == common_shape and (level.dark or level.mean <= mean_at_peak)
    ]


def _pattern_parts(levels: Sequence[Level]) -> Tensor:
    """Return the design matrix (level, term) of the pattern fit: offset, signal, squared signal and
    exposure, as far as the number of levels allows.
    """
    darkest = min((level.mean for level in levels), default=0.0)
    signal = torch.tensor([level.mean - darkest for level in levels], dtype=torch.float64)
    exposure = torch.tensor([level.exposure for level in levels], dtype=torch.float64)
    dark = torch.tensor([level.dark for level in levels])
    parts = [torch.ones_like(signal)]
    if not bool(dark.all()):
        parts.append(signal / signal.max().clamp_min(1e-12))
    if int((~dark).sum()) >= _CURVED_LEVELS:
        # a curved response needs several lit levels
        parts.append(parts[-1].square())
    exposures_in_dark = exposure[dark] if bool(dark.any()) else exposure
    if len(set(exposures_in_dark.tolist())) > 1:
        parts.append(exposure / exposure.max())
    return torch.stack(parts[: max(1, len(levels) - _SPARE_LEVELS + 1)], 1)


def _without_patterns(frames: Tensor, weight: Tensor, basis: Tensor) -> Tensor:
    """Return frames (level, y, x) over their standard deviations, with fixed patterns and line
    means removed.
    """
    scaled_frames = weight[:, None] * without_lines(frames).flatten(1)
    # subtract the projection on the pattern terms
    return (scaled_frames - basis @ (basis.T @ scaled_frames)).view_as(frames)


def _robust_deviation(x: Tensor) -> Tensor:
    """Return the robust standard deviation (level, 1, 1) of each level."""
    # 1.4826: standard deviation over median absolute value of a normal distribution
    return 1.4826 * x.abs().flatten(1).median(1).values[:, None, None] + 1e-9


# --- mosaic test ----------------------------------------------------------------------------------

# A test for a colour mosaic, whose pixels differ in quantum efficiency.


_PERIODS = {
    2: "2 x 2 pixels, as of Bayer",
    4: "4 x 4 pixels, as of a quad mosaic",
    6: "6 x 6 pixels, as of X-Trans",
}
#: largest relative difference between the positions of a cell on a monochrome sensor with several
#: readout channels
_MONOCHROME_DIFFERENCE = 0.05
#: least difference of the brightest and darkest position, in standard errors, that is not chance
_POSITION_SIGMA = 8.0


def mosaic_test(levels: Sequence[Level]) -> Iterator[FrameTest]:
    """Test if the signal depends on the position of a pixel in a small cell that repeats over the
    frame, as in a colour mosaic.

    Shapes: a list of levels -> a test, or none without light.
    Units:  number and limit: relative difference of the brightest and the darkest position of the
            cell.
    Error:  positions of a monochrome sensor that differ by more than 5 % count as a mosaic.
    Source: Bayer, US patent 3971065 (1976), for the cell of 2 x 2 pixels.
    """
    dark = min((level.mean for level in levels if level.dark), default=math.inf)
    brightest = max(levels_to_test(levels), key=lambda level: level.mean, default=None)
    if brightest is None or brightest.dark or brightest.mean <= dark:
        return
    signal = brightest.mean - dark
    mean_picture = (brightest.first + brightest.second).double().mean(0) / 2
    for period, cell in _PERIODS.items():
        relative_difference = _cell_contrast(mean_picture, period) / signal
        if relative_difference > _MONOCHROME_DIFFERENCE:
            difference_text = (
                f"the light of pixels differs by {relative_difference:.0%} over a cell of {cell}"
            )
            text = (
                f"{difference_text}: the frames are a mosaic of colours, whose calibration is not"
                " offered; give frames of"
            )
            text += " one colour alone, such as every second pixel of every second row"
            yield FrameTest(
                "one colour",
                relative_difference,
                _MONOCHROME_DIFFERENCE,
                "refused",
                text,
                explains_all=True,
            )
            return


def _cell_contrast(picture: Tensor, period: int) -> float:
    """Return the difference in DN between the brightest and the darkest position of a cell; 0 if
    chance explains it.
    """
    if min(picture.shape) < 2 * period:
        return 0.0
    means, error = _position_means(picture, period)
    difference = float(means.max() - means.min())
    return difference if difference > _POSITION_SIGMA * error else 0.0


def _position_means(picture: Tensor, period: int) -> tuple[Tensor, float]:
    """Return the mean of each position of a cell (y, x), and the standard error of a mean."""
    cell_rows, cell_columns = (n // period for n in picture.shape)
    # axes: cell along y, position along y, cell along x, position along x
    cells = picture[: cell_rows * period, : cell_columns * period].reshape(
        cell_rows, period, cell_columns, period
    )
    # less the mean of each cell, so that uneven light does not count
    deviations = cells - cells.mean((1, 3), keepdim=True)
    means = cells.mean((0, 2))
    variance = (deviations - (means - means.mean())[None, :, None, :]).square().mean()
    return means, math.sqrt(float(variance) / (cell_rows * cell_columns))


# --- pattern tests --------------------------------------------------------------------------------

# Tests of what two frames of the same light have in common: fixed patterns, uneven light and lag.


_BLOCKS_ON_SIDE = 8  #: blocks along each side of a frame; their means show how even the light is
#: difference of the largest and least irradiance that EMVA 1288 allows, relative to the mean
_EVEN_LIGHT = 0.03
_PATTERN_SCALE = 0.01  #: prior scale of the relative change of the variance by fixed patterns
#: largest assumed relative curvature of a response; with it uneven light shifts the gain
_LARGEST_BEND = 0.1
_NEARLY_FULL = 0.95  #: share of the full well above which a block of a frame counts as nearly full
_SMOOTH_PIXELS = 5  #: pixels; over this length the light counts as even
#: difference of the brightest and darkest block mean, in standard errors, that chance may cause
_BLOCK_SIGMA = 8.0


def pattern_tests(levels: Sequence[Level]) -> list[FrameTest]:
    """Test frames of the same light for fixed patterns, for lag, and for uneven light.

    Only levels that the fit uses are tested. The covariance of two frames of a level is the
    variance of their common pattern.

    Shapes: a list of levels -> a list of tests.
    Units:  numbers and limits in standard deviations of chance, and the difference of the light as
            a share of its mean.
    Error:  each test fails by chance with a probability of 1e-3.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 2.5 (non-uniformity) and 6.4
            (homogeneity).
    """
    paired = levels_to_test(levels)
    if not paired:
        return []
    return [
        _total_against_temporal(paired),
        *lag_test(paired),
        *_homogeneity(paired, saturated_levels(levels)),
    ]


def _total_against_temporal(levels: Sequence[Level]) -> FrameTest:
    """Test for fixed patterns: differences between pixels that are the same in all frames (DSNU,
    PRNU).

    The temporal variance excludes these differences; the variance over all pixels and frames counts
    them as noise.
    """
    products = [level.first * level.second for level in levels]
    evidence = strongest_evidence([[studentised(x) for x in products]])
    darkest = min((level.mean for level in levels if level.dark), default=0.0)
    dsnu, prnu = _dsnu_and_prnu(levels, [float(x.mean()) for x in products], darkest)
    sentence = (
        f"pixels differ by {dsnu:.2g} DN in the dark (DSNU) and by {prnu:.2%} in light (PRNU and"
        " uneven light)"
    )
    passed = "the pixels are alike: the total variance is the temporal variance"
    if all(level.scatter != "all" for level in levels):
        modelled = "the temporal variance leaves these differences out"
        lit = [level for level in levels if not level.dark]
        shifts = {"gain": _pixel_response(lit, darkest) ** 2}
        return outcome(
            "total against temporal variance", evidence, sentence, shifts, passed, modelled
        )
    sentence += (
        ", which `scatter: all` counts as noise; use calibrate.camera with `scatter: steady`"
    )
    hidden = list(_counted_as_noise(levels, products))
    return sized_outcome("total against temporal variance", evidence, hidden, sentence, passed)


def _dsnu_and_prnu(
    levels: Sequence[Level], common: Sequence[float], offset: float
) -> tuple[float, float]:
    """Return DSNU in DN, and PRNU relative to the signal, from ``common``, the variance of the
    common pattern of the frames of each level; ``offset`` is the dark level in DN.
    """
    pairs = list(zip(common, levels, strict=True))
    dark_variance = min((variance for variance, level in pairs if level.dark), default=0.0)
    dsnu = math.sqrt(max(0.0, dark_variance))
    lit_variances = [
        (variance - dsnu**2, level.mean) for variance, level in pairs if not level.dark
    ]
    relative = [
        math.sqrt(max(0.0, variance)) / (mean - offset)
        for variance, mean in lit_variances
        if mean > offset
    ]
    # median over the lit levels
    return dsnu, sorted(relative)[len(relative) // 2] if relative else 0.0


def _pixel_response(lit: Sequence[Level], offset: float) -> float:
    """Return the relative standard deviation of the response between neighbouring pixels, without
    uneven light, which is smooth.

    A relative standard deviation s of the pixel gains makes the fitted gain too large by s**2.
    """
    squared_shares = []
    for level in lit:
        first_frames, second_frames = (frames.diff(dim=2) for frames in (level.first, level.second))
        squared_shares.append(
            # differences of neighbours have twice the variance of a pixel, and cancel smooth light
            max(0.0, float((first_frames * second_frames).mean()) / 2) / (level.mean - offset) ** 2
        )
    return math.sqrt(sorted(squared_shares)[len(squared_shares) // 2]) if squared_shares else 0.0


def _counted_as_noise(levels: Sequence[Level], products: Sequence[Tensor]) -> Iterator[Hidden]:
    """Yield two hidden faults, the share of fixed patterns in the slope of total variance over
    mean, and in the total dark variance.
    """
    mean = torch.tensor([level.mean for level in levels], dtype=torch.float64)
    level_patterns = torch.tensor([float(x.mean()) for x in products], dtype=torch.float64)
    pattern_error = torch.tensor(
        [math.sqrt(float(x.square().sum())) / x.numel() for x in products], dtype=torch.float64
    )
    total_variance = level_patterns + torch.tensor(
        [level.variance for level in levels], dtype=torch.float64
    )
    is_lit = torch.tensor([not level.dark for level in levels])
    if len(levels) > 2 and float(mean.max()) > float(mean.min()):
        weights = total_variance.clamp_min(1e-12).reciprocal()
        design = torch.stack([torch.ones_like(mean), mean], 1) * weights[:, None]
        # weights with which the variances of the levels enter the slope of a weighted line fit
        slope_weights = torch.linalg.pinv(design)[1] * weights
        yield _pattern_fault(
            float(slope_weights @ level_patterns),
            float((slope_weights * pattern_error).norm()),
            float(slope_weights @ total_variance),
            gain=-1.0,
        )
    if bool((~is_lit).any()):
        dark_pattern, dark_error, dark_total = (
            level_patterns[~is_lit].mean(),
            pattern_error[~is_lit].norm() / int((~is_lit).sum()),
            total_variance[~is_lit].mean(),
        )
        yield _pattern_fault(float(dark_pattern), float(dark_error), float(dark_total), noise=-0.5)


def _pattern_fault(
    pattern: float, error: float, total: float, gain: float = 0.0, noise: float = 0.0
) -> Hidden:
    """Return the hidden fault of fixed patterns: ``pattern``, with its standard ``error``, is the
    part of the ``total`` variance that is not temporal noise.
    """
    temporal_share = max(1 - pattern / max(total, 1e-12), 1e-3)
    error = max(error / max(total, 1e-12) / temporal_share, 1e-9)
    return Hidden(
        "pattern", -math.log(temporal_share), error, _PATTERN_SCALE, gain, noise, positive=True
    )


def _homogeneity(levels: Sequence[Level], full: Sequence[Level]) -> Iterator[FrameTest]:
    """Test if the light of the brightest level is as even as the standard demands.

    Uneven light does not change the gain of a linear response, because mean and variance of each
    pixel grow in proportion. It does if the brightest part of the frame saturates first, which the
    ``full`` levels show.
    """
    dark, lit = dark_and_lit(levels)
    brightest = max(lit, key=lambda level: level.mean, default=None)
    if brightest is None or not dark or min(brightest.first.shape[1:]) < 2 * _BLOCKS_ON_SIDE:
        return
    nearest_dark = min(dark, key=lambda level: abs(level.exposure - brightest.exposure))
    signal = brightest.mean - nearest_dark.mean
    if signal <= 0:
        return
    means, variance_by_chance = _block_means(brightest)
    # less the largest difference that chance explains
    relative_difference = (
        max(0.0, float(means.max() - means.min()) - _BLOCK_SIGMA * math.sqrt(variance_by_chance))
        / signal
    )
    variation = max(0.0, float(means.var()) - variance_by_chance) / signal**2
    # by a curved response, and by nearly full parts of the frame
    gain_shift = _LARGEST_BEND * variation + _nearly_full_share(brightest, full, nearest_dark.mean)
    sentence = (
        f"the brightest and the darkest part of the light differ by {relative_difference:.1%}, not"
        f" at most {_EVEN_LIGHT:.0%}"
    )
    passed = (
        f"the parts of the light differ by less than the {_EVEN_LIGHT:.0%} that the standard allows"
    )
    yield outcome(
        "homogeneity of the light",
        Evidence(relative_difference, _EVEN_LIGHT),
        sentence,
        {"gain": gain_shift},
        passed,
    )


def _block_means(level: Level) -> tuple[Tensor, float]:
    """Return the means (8, 8) of the blocks of a level, in DN less the mean of the level, and the
    variance of a block mean by chance, DN2.
    """
    mean_picture = (level.first + level.second).mean(0)[None, None] / 2
    block_size = [n // _BLOCKS_ON_SIDE for n in mean_picture.shape[2:]]
    without_light = mean_picture - avg_pool2d(
        mean_picture, _SMOOTH_PIXELS, stride=1, padding=_SMOOTH_PIXELS // 2
    )
    return avg_pool2d(mean_picture, block_size)[0, 0], float(without_light.var()) / math.prod(
        block_size
    )


def _nearly_full_share(bright: Level, full: Sequence[Level], dark: float) -> float:
    """Return the share of the signal of the brightest level in nearly full blocks; the full well is
    taken from the ``full`` levels, and ``dark`` is the dark mean in DN.
    """
    comparable_levels = [
        level for level in full if level.paired and level.first.shape == bright.first.shape
    ]
    if not comparable_levels:
        return 0.0
    well = (
        max(level.mean + float(_block_means(level)[0].max()) for level in comparable_levels) - dark
    )
    block_signals = bright.mean - dark + _block_means(bright)[0]
    return float(block_signals[block_signals > _NEARLY_FULL * well].sum() / block_signals.sum())
