"""Pairs of frames of each light level, and the results of the tests of these frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neusee.nodes.calibrate._light_levels import Scatter, histogram

# --- hidden faults --------------------------------------------------------------------------------

# Faults that multiply the measured noise variance by a factor: the error that remains possible,
# whether a test finds the fault or not.


_POSTERIOR_POINTS = 2001  #: evenly spaced points of the posterior
_POSTERIOR_REACH = 8.0  #: reach of these points beyond the estimate and zero, in standard errors
#: prior odds of no fault, for frames of at least `CLEAN_PAIRS` pairs
_ODDS_OF_NO_FAULT = 9.0
#: pairs of pixels in the fitted lit levels; with so many, frames that show no fault can hide little
CLEAN_PAIRS = 4e6


@dataclass(frozen=True)
class Hidden:
    """A fault that changes the measured variance, and the estimate of its size from the frames.

    The size of the fault is the logarithm of true over measured variance, with a normal likelihood
    about `estimate`. Its prior is 0 with the probability `sound`, and else a Cauchy distribution
    about 0, whose long tails hardly limit large values. Nothing is corrected: the root mean square
    of the posterior is added as an error of gain and noise, so that a fault that is found widens
    their intervals by its whole size. Frames of many pixels without a sign of a fault leave almost
    no error; with few pixels `sound` is small, and the whole standard error counts.
    """

    fault: str  #: "mixing", "lag" or "pattern"
    estimate: float
    error: float  #: standard error of `estimate`
    scale: float  #: of the Cauchy distribution
    gain: float = 0.0  #: change of the log gain per unit of the size
    noise: float = 0.0  #: change of the log dark noise (DN) per unit of the size
    positive: bool = False  #: True if the size cannot be negative
    sound: float = 0.0  #: prior probability of no fault, from `chance_of_no_fault`

    def posterior(self) -> tuple[Tensor, Tensor]:
        """Return points of the size and their posterior probabilities, both (point,)."""
        lowest = min(0.0, self.estimate) - _POSTERIOR_REACH * self.error
        if self.positive:
            lowest = 0.0
        highest = max(0.0, self.estimate) + _POSTERIOR_REACH * self.error
        points = torch.linspace(lowest, highest, _POSTERIOR_POINTS, dtype=torch.float64)
        # Cauchy distribution about 0; of a logarithm that cannot be negative, its upper half
        density = 1 / (math.pi * self.scale * (1 + (points / self.scale).square()))
        if self.positive:
            density = 2 * density
        probability = (
            self._likelihood(points) * density * (points[1] - points[0]) * (1 - self.sound)
        )
        # the value 0 itself has the probability `sound`
        points = torch.cat([points, points.new_zeros(1)])
        probability = torch.cat([probability, self.sound * self._likelihood(points[-1:])])
        return points, probability / probability.sum()

    def size(self) -> float:
        """Return the root mean square of the size under its posterior."""
        points, weight = self.posterior()
        return math.sqrt(float(weight @ points.square()))

    def _likelihood(self, points: Tensor) -> Tensor:
        """Return the likelihood of each point over the maximum likelihood among possible sizes."""
        likeliest = max(0.0, self.estimate) if self.positive else self.estimate
        least_squares = ((likeliest - self.estimate) / self.error) ** 2
        return (-0.5 * (((points - self.estimate) / self.error).square() - least_squares)).exp()


def chance_of_no_fault(pairs: float) -> float:
    """Return the prior probability of no fault, from the number of pairs of pixels in the lit
    levels.

    Frames of few pixels could not show a fault that matters, so the absence of a sign is no
    evidence. The odds rise with the square of the number of pairs, up to 9 at `CLEAN_PAIRS`.
    """
    odds = _ODDS_OF_NO_FAULT * min(1.0, pairs / CLEAN_PAIRS) ** 2
    return odds / (1 + odds)


def open_errors(hidden: Sequence[Hidden]) -> dict[str, float]:
    """Return the relative errors of "gain" and of "noise" (dark noise in DN) that undetected or
    uncorrected faults may cause.
    """
    sizes = [fault.size() for fault in hidden]
    # independent faults add in squares
    gain = math.hypot(*(fault.gain * size for fault, size in zip(hidden, sizes, strict=True)), 0.0)
    noise = math.hypot(
        *(fault.noise * size for fault, size in zip(hidden, sizes, strict=True)), 0.0
    )
    return {"gain": gain, "noise": noise}


# --- frame pairs ----------------------------------------------------------------------------------

# Pairs of frames of each light level of a calibration, and the verdict of a test of these frames.


Verdict = Literal["passed", "modelled", "widened", "refused"]
#: probability that one test of a whole measurement fails by chance
FALSE_ALARM_RATE = 1e-3
#: relative error of gain or dark noise; above it frames are refused, below it intervals are widened
REFUSED_ERROR = 0.02
#: side in pixels of the central window in which patterns and noise are tested
_WINDOW_SIDE = 1024
_TESTED_PIXELS = 1 << 21  #: largest number of tested pixels of a level, all frames together
#: pixels; the window starts at a multiple of it, like the blocks of a compressed picture
_BLOCK_SIDE = 8
#: least excess of a pile at an end over the numbers beside it, in standard deviations of the counts
_PILE_SIGMA = 5.0
_PILE_PIXELS = 20  #: least number of pixels of a pile
_FLAT_SHARE = 0.5  #: share of the greatest variance below which a brighter level is saturated
_ZERO_SHARE = 5e-3  #: share of pixels at 0 from which values below 0 count as cut off
_TESTED_FRAMES = 16  #: largest number of frames of a level that are tested for noise and patterns
#: what to do about refused frames, by the name of the test
_REMEDIES = {
    "white noise": "take raw frames: without denoising, sharpening, interpolation and compression",
    "no blocks": "save the frames without compression",
    "no lag": "reset the sensor, or take a frame that is not used, before each frame",
    "no row noise": "remove the interference from the readout",
    "no column noise": "remove the interference from the readout",
    "no drift within a level": "write `scatter: steady`, or let the lamp settle",
    "homogeneity of the light": "light the sensor evenly, or cut the frames to their even part",
}
VARIANCE_FLOOR = 1e-12  #: DN2, added to variances so that frames without noise do not divide by 0


class Stack(NamedTuple):
    """The raw frames of one light level, before `reduce`."""

    name: str
    photons: float  #: per pixel and exposure; 0 in the dark
    exposure: float  #: s
    scatter: Scatter  #: which variance `reduce` computes
    frames: Tensor  #: (frame, y, x) DN, whole numbers
    mask: Tensor | None = None  #: (y, x) True for a pixel that is left out


class Level(NamedTuple):
    """One light level as the tests use it: pairs of frames in the central window, and the histogram
    of the full frames.
    """

    name: str
    photons: float
    exposure: float  #: s
    scatter: Scatter
    #: (pair, y, x) float32, DN, with the mean of each frame removed; 0 in pixels that are left out
    first: Tensor
    second: Tensor  #: (pair, y, x), as `first`
    #: (pair, y, x) DN, second less first, corrected for the change of the lamp between the two
    differences: Tensor
    drift: Tensor  #: (pair,) DN, mean of the second frame less mean of the first
    variance: float  #: DN2, temporal, without the drift of the mean
    mean: float  #: DN
    value: Tensor  #: (code,) digital numbers that occur, rising
    pixels: Tensor  #: (code,) count of each number
    flicker: float = 0.0  #: DN2, variance that a flickering lamp adds where the light is uneven
    fitted: bool = True  #: True if the likelihood uses the level

    @property
    def dark(self) -> bool:
        """Return True for a level without light."""
        return self.photons == 0

    @property
    def paired(self) -> bool:
        """Return True for a level of two or more frames."""
        return len(self.differences) > 0

    @property
    def low(self) -> bool:
        """Return True if pixel values pile up at the lowest value, or if more than 0.5 % of the
        pixels are 0.
        """
        at_zero = float(self.pixels[self.value == 0].sum())
        return at_zero > _ZERO_SHARE * float(self.pixels.sum()) or _piled(
            self, self.value, self.pixels
        )

    @property
    def high(self) -> bool:
        """Return True if pixel values pile up at the highest value."""
        return _piled(self, -self.value.flip(0), self.pixels.flip(0))


@dataclass(frozen=True)
class FrameTest:
    """The result of one test of the frames of a measurement."""

    name: str
    number: float  #: test statistic, in the unit of the limit
    limit: float  #: chance rarely exceeds this value
    verdict: Verdict
    sentence: str
    #: relative errors of "gain" and "noise" that the fault may cause
    shifts: Mapping[str, float] = field(default_factory=dict)
    explains_all: bool = False  #: True if other tests would only find consequences of this fault
    #: faults whose size the frames allow to estimate, whether the test finds them or not
    hidden: tuple[Hidden, ...] = ()


class Evidence(NamedTuple):
    """The largest of several standard normal statistics, and the value that chance rarely
    exceeds.
    """

    strength: float  #: standard deviations
    limit: float

    @property
    def found(self) -> bool:
        """Return True if chance alone does not explain the strength."""
        return self.strength > self.limit


def paired_level(stack: Stack) -> Level:
    """Return the pairs and the histogram of a light level; frames 0 and 1 form a pair, 2 and 3, and
    so on.
    """
    unmasked = stack.frames if stack.mask is None else stack.frames[:, ~stack.mask]
    numbers, counts = histogram(unmasked)
    frames = _central_window(stack.frames)
    pairs = len(frames) // 2
    means, centred = _centred(frames, stack.mask)
    # frames 0, 2, 4 ... and 1, 3, 5 ...
    first, second = centred[: 2 * pairs : 2], centred[1 : 2 * pairs : 2]
    differences = second - first
    return Level(
        name=stack.name,
        photons=stack.photons,
        exposure=stack.exposure,
        scatter=stack.scatter,
        first=first,
        second=second,
        differences=differences,
        drift=means[1 : 2 * pairs : 2] - means[: 2 * pairs : 2],
        variance=_variance(differences),
        mean=float((numbers * counts).sum()) / float(counts.sum()),
        value=numbers,
        pixels=counts,
    )


def fitted_levels(levels: Sequence[Level], share: float | None) -> list[Level]:
    """Return the levels with `fitted` set for those that the fit uses: dark levels, and lit levels
    up to ``share`` of saturation.

    Saturation is at the lit level of the greatest variance, as for the likelihood. Without a
    ``share`` every level is used. The change of the lamp between the frames of a pair, which is
    proportional to the light of each pixel, is subtracted from their difference.
    """
    dark = min((level.mean for level in levels if level.dark), default=0.0)
    lit_levels = [level for level in levels if not level.dark and level.paired]
    saturation_signal = (
        max(lit_levels, key=lambda level: level.variance).mean - dark if lit_levels else math.inf
    )
    largest_signal = math.inf if share is None else share * saturation_signal
    return [
        _without_flicker(level, dark)._replace(
            fitted=level.dark or level.mean - dark <= largest_signal
        )
        for level in levels
    ]


def dark_and_lit(levels: Sequence[Level]) -> tuple[list[Level], list[Level]]:
    """Return the dark levels and the lit levels."""
    dark = [level for level in levels if level.dark]
    lit = [level for level in levels if not level.dark]
    return dark, lit


def saturated_levels(levels: Sequence[Level]) -> list[Level]:
    """Return the saturated levels: pixel values pile up at the highest value, or the variance has
    fallen below half of its maximum.

    There is no pile if the full well differs from pixel to pixel, or if read noise is added after
    clipping.
    """
    lit_levels = [level for level in levels if not level.dark and level.paired]
    peak = max(lit_levels, key=lambda level: level.variance, default=None)
    if peak is None:
        return [level for level in levels if level.high]
    return [level for level in levels if level.high or _is_flat(level, peak)]


def levels_to_test(levels: Sequence[Level]) -> list[Level]:
    """Return the levels whose noise is tested: levels of the fit with pairs of frames and without
    clipping at either end.
    """
    fitted = [level for level in levels if level.paired and level.fitted]
    return [level for level in fitted if not level.high and not level.low]


def _is_flat(level: Level, peak: Level) -> bool:
    """Return True for a lit level that is brighter than the level ``peak`` of the greatest variance
    and has less than half of its variance.
    """
    return (
        level.paired
        and not level.dark
        and level.mean > peak.mean
        and level.variance < _FLAT_SHARE * peak.variance
    )


def _without_flicker(level: Level, dark: float) -> Level:
    """Return a level whose differences are corrected for the change of the lamp between the frames
    of a pair.

    The light of the second frame is taken as that of the first times the ratio of their means above
    the dark.
    """
    signal = level.mean - dark
    if level.dark or not level.paired or signal <= 0:
        return level
    relative_drift = (level.drift / signal)[:, None, None]
    # both frames are scaled to the mean of their signals
    differences = level.second * (1 - relative_drift / 2) - level.first * (1 + relative_drift / 2)
    pattern_power = (level.first * level.second).mean((1, 2)).clamp_min(0.0)
    # variance of the common pattern of both frames, times the squared relative change of the light
    flicker = float((relative_drift[:, 0, 0].square() * pattern_power).mean()) / 2
    return level._replace(differences=differences, variance=_variance(differences), flicker=flicker)


def _variance(differences: Tensor) -> float:
    """Return the temporal variance from the differences (pair, y, x) of two frames: half their mean
    square, with one degree of freedom less per pair for the removed mean; NaN without a pair.
    """
    return (
        float(differences.square().sum()) / 2 / max(1, differences.numel() - len(differences))
        if len(differences)
        else math.nan
    )


def _centred(frames: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the means (frame,) of frames, and the frames (frame, y, x) less their means; 0 in
    masked pixels.
    """
    numbers = frames.double()
    if mask is None:
        means = numbers.mean((1, 2))
        return means, (numbers - means[:, None, None]).float()
    unmasked = ~_central_window(mask[None])[0]
    means = (numbers * unmasked).sum((1, 2)) / unmasked.sum().clamp_min(1)
    return means, ((numbers - means[:, None, None]) * unmasked).float()


def without_lines(x: Tensor) -> Tensor:
    """Return frames (frame, y, x) with the means of their rows and columns subtracted."""
    return x - x.mean(2, keepdim=True) - x.mean(1, keepdim=True) + x.mean((1, 2), keepdim=True)


def _central_window(frames: Tensor) -> Tensor:
    """Return the central window of the first frames: at most 16, an even number, and fewer of large
    frames.
    """
    top, left = (
        max(0, n - _WINDOW_SIDE) // 2 // _BLOCK_SIDE * _BLOCK_SIDE for n in frames.shape[1:]
    )
    window = frames[:, top : top + _WINDOW_SIDE, left : left + _WINDOW_SIDE]
    # an even number, for pairs
    frame_count = _TESTED_PIXELS // max(1, window[0].numel()) // 2 * 2
    return window[: min(_TESTED_FRAMES, max(2, frame_count))]


def _piled(level: Level, value: Tensor, count: Tensor) -> bool:
    """Return True if the lowest pixel value occurs more often than the next one, or the two lowest
    more often than the next two.

    Without clipping, counts fall towards the ends of a histogram. A full well fills two
    neighbouring values. A level with few distinct values or little variance is tested only at the
    value 0.
    """
    lowest = int(value[0])
    first, second, third, fourth = (float(count[value == lowest + i].sum()) for i in range(4))
    if first + second + third + fourth < _PILE_PIXELS:
        return False
    is_fine = level.paired and level.variance > 1.0 and len(value) > 8
    if (is_fine or lowest == 0) and _exceeds(first, second):
        return True
    return is_fine and _exceeds(first + second, third + fourth)


def _exceeds(count_at_end: float, count_beside: float) -> bool:
    """Return True if the count at an end exceeds the count beside it by more than chance
    explains.
    """
    excess = count_at_end - count_beside - 2
    return count_at_end >= _PILE_PIXELS and excess > _PILE_SIGMA * math.sqrt(
        count_at_end + count_beside
    )


def strongest_evidence(
    z: Sequence[Sequence[float]], others: Sequence[float] = (), sides: int = 1
) -> Evidence:
    """Return the largest of independent standard normal statistics (statistic, level), with its
    limit.

    Each value is tested alone, and so is the sum over the levels of each statistic, divided by the
    square root of their number; ``others`` are further standard normal values. The limit has the
    Bonferroni correction for all of these tests, and is two-sided if ``sides`` is 2.
    """
    sums_of_statistics = [sum(row) / math.sqrt(len(row)) for row in z if len(row) > 1]
    all_numbers = [*chain.from_iterable(z), *sums_of_statistics, *others]
    strengths = [abs(x) for x in all_numbers] if sides == 2 else all_numbers
    return Evidence(
        max(strengths, default=0.0),
        normal_limit(FALSE_ALARM_RATE / sides / max(1, len(all_numbers))),
    )


def normal_limit(probability: float) -> float:
    """Return the value that a standard normal variable exceeds with a probability."""
    return -float(torch.special.ndtri(torch.tensor(probability, dtype=torch.float64)))


def studentised(product: Tensor) -> float:
    """Return the sum of independent values of mean 0, divided by its estimated standard
    deviation.
    """
    return float(product.sum()) / math.sqrt(float(product.square().sum()) + VARIANCE_FLOOR)


def outcome(
    name: str,
    evidence: Evidence,
    sentence: str,
    shifts: Mapping[str, float],
    passed: str,
    modelled: str = "",
) -> FrameTest:
    """Return the result of a test: passed, modelled, widened, or refused if the error exceeds 2
    %.
    """
    if not evidence.found:
        return FrameTest(name, evidence.strength, evidence.limit, "passed", passed)
    if modelled:
        return FrameTest(
            name, evidence.strength, evidence.limit, "modelled", f"{sentence}: {modelled}", shifts
        )
    largest_shift = max(shifts.values(), default=math.inf)
    verdict: Verdict = "refused" if largest_shift > REFUSED_ERROR else "widened"
    consequence = (
        f"an error of {100 * largest_shift:.2g} % may follow"
        if math.isfinite(largest_shift)
        else "no model describes such frames"
    )
    text = f"{sentence}: {consequence}{_remedy(name, verdict)}"
    return FrameTest(name, evidence.strength, evidence.limit, verdict, text, shifts)


def _remedy(name: str, verdict: Verdict) -> str:
    return f"; {_REMEDIES[name]}" if verdict == "refused" and name in _REMEDIES else ""


def sized_outcome(
    name: str,
    evidence: Evidence,
    hidden: Sequence[Hidden],
    sentence: str,
    passed: str,
    modelled: str = "",
) -> FrameTest:
    """Return the result of a test for a fault whose size the frames allow to estimate, whether it
    is found or not.

    Nothing is corrected. If a fault is found, the frames are refused where gain or noise may be
    wrong by more than 2 %; else the intervals widen by its whole size.
    """
    largest_error = max(open_errors(hidden).values())
    if not evidence.found:
        text = f"{passed}; the frames may hide {100 * largest_error:.2g} %" if hidden else passed
        return FrameTest(
            name, evidence.strength, evidence.limit, "passed", text, hidden=tuple(hidden)
        )
    verdict: Verdict = "modelled" if modelled else "widened"
    if largest_error > REFUSED_ERROR:
        verdict = "refused"
    text = (
        f"{sentence}: an error of {100 * largest_error:.2g} % may follow, and nothing is"
        f" corrected{_remedy(name, verdict)}"
    )
    if verdict == "modelled":
        text = f"{sentence}: {modelled}"
    return FrameTest(name, evidence.strength, evidence.limit, verdict, text, hidden=tuple(hidden))
