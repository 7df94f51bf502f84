"""Frames of the light levels as pairs, and the verdict of a test of these frames."""

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

# Faults that change the variance of noise in proportion: the error that frames leave open, found by
# a test or not.


_POSTERIOR_POINTS = 2001  #: evenly spaced
_POSTERIOR_REACH = 8.0  #: standard errors beyond estimate and zero
#: odds of no fault at all, before frames of at least `CLEAN_PAIRS` are seen
_ODDS_OF_NO_FAULT = 9.0
#: pairs of pixels in the lit levels of the fit from which frames that show no fault hide little
CLEAN_PAIRS = 4e6


@dataclass(frozen=True)
class Hidden:
    """A fault that changes the measured variance, and what the frames say of its size.

    The logarithm of the true over the measured variance has a normal likelihood about `estimate`.
    Before the frames are seen it is 0 with the probability `sound`, and else has a Cauchy
    distribution about 0, which leaves large values to the frames. Nothing is corrected by it: its
    root mean square is an error that gain and noise may have, so that a fault that is found widens
    by its whole size. Frames of many pixels that show nothing leave almost nothing open; with few
    pixels `sound` is small, and the whole standard error counts.
    """

    fault: str  #: "mixing", "lag" or "pattern"
    estimate: float
    error: float  #: standard error of `estimate`
    scale: float  #: of the Cauchy distribution
    gain: float = 0.0  #: change of the logarithm of the gain for 1
    noise: float = 0.0  #: change of the logarithm of the dark noise in DN for 1
    positive: bool = False  #: True if the logarithm cannot be negative
    sound: float = 0.0  #: probability of no fault, from `chance_of_no_fault`

    def posterior(self) -> tuple[Tensor, Tensor]:
        """Return points of the logarithm and their probabilities, both (point,)."""
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
        """Return the root mean square of the logarithm."""
        points, weight = self.posterior()
        return math.sqrt(float(weight @ points.square()))

    def _likelihood(self, points: Tensor) -> Tensor:
        """Return the likelihood of points relative to that of the likeliest value that is
        possible.
        """
        likeliest = max(0.0, self.estimate) if self.positive else self.estimate
        least_squares = ((likeliest - self.estimate) / self.error) ** 2
        return (-0.5 * (((points - self.estimate) / self.error).square() - least_squares)).exp()


def chance_of_no_fault(pairs: float) -> float:
    """Return the probability of no fault before frames are seen, for a number of pairs of pixels in
    lit levels.

    Frames of few pixels cannot show a fault that would matter: then nobody should believe that
    there is none. The odds rise with the square of the pairs, up to 9 at `CLEAN_PAIRS`.
    """
    odds = _ODDS_OF_NO_FAULT * min(1.0, pairs / CLEAN_PAIRS) ** 2
    return odds / (1 + odds)


def open_errors(hidden: Sequence[Hidden]) -> dict[str, float]:
    """Return the relative errors that independent faults leave open, by the names "gain" and
    "noise" (in DN).
    """
    sizes = [fault.size() for fault in hidden]
    # independent faults add in squares
    gain = math.hypot(*(fault.gain * size for fault, size in zip(hidden, sizes, strict=True)), 0.0)
    noise = math.hypot(
        *(fault.noise * size for fault, size in zip(hidden, sizes, strict=True)), 0.0
    )
    return {"gain": gain, "noise": noise}


# --- frame pairs ----------------------------------------------------------------------------------

# Frames of the light levels of a calibration as pairs, and the verdict of a test of these frames.


Verdict = Literal["passed", "modelled", "widened", "refused"]
#: probability with which chance alone fails one test of a whole measurement
FALSE_ALARM_RATE = 1e-3
#: relative error of gain or dark noise above which frames are refused, and below which intervals
#: widen
REFUSED_ERROR = 0.02
#: pixels of the central window on a side, in which patterns and noise are tested
_WINDOW_SIDE = 1024
_TESTED_PIXELS = 1 << 21  #: pixels of a level in all tested frames together
_BLOCK_SIDE = 8  #: pixels by which the window is aligned, as blocks of a compressed picture are
_PILE_SIGMA = 5.0  #: standard deviations of counting by which numbers pile up at an end
_PILE_PIXELS = 20  #: least count of pixels that pile up
_FLAT_SHARE = 0.5  #: share of the greatest variance below which a brighter level is saturated
_ZERO_SHARE = 5e-3  #: share of the pixels at 0, which hides numbers below 0
_TESTED_FRAMES = 16  #: frames of a level whose noise and patterns are tested
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
VARIANCE_FLOOR = 1e-12  #: DN2, so that frames without noise divide by more than 0


class Stack(NamedTuple):
    """The frames of one light level, as `reduce` receives them."""

    name: str
    photons: float  #: per pixel and exposure; 0 in the dark
    exposure: float  #: s
    scatter: Scatter  #: which variance `reduce` computes
    frames: Tensor  #: (frame, y, x) DN, whole numbers
    mask: Tensor | None = None  #: (y, x) True for a pixel that is left out


class Level(NamedTuple):
    """One light level: pairs of frames in the central window, and the histogram of the whole
    frames.
    """

    name: str
    photons: float
    exposure: float  #: s
    scatter: Scatter
    #: (pair, y, x) float32, DN, with the mean of each frame removed; 0 in pixels that are left out
    first: Tensor
    second: Tensor  #: (pair, y, x), as `first`
    #: (pair, y, x) DN, second less first, without what the lamp changed from the first to the
    #: second
    differences: Tensor
    drift: Tensor  #: (pair,) DN, mean of the second frame less mean of the first
    variance: float  #: DN2, temporal, without the drift of the mean
    mean: float  #: DN
    value: Tensor  #: (code,) digital numbers that occur, rising
    pixels: Tensor  #: (code,) count of each number
    flicker: float = 0.0  #: DN2, variance by the flicker of the lamp over light that is uneven
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
        """Return True if numbers pile up at the lowest number, or if 0 is a number of more than
        a few pixels.
        """
        at_zero = float(self.pixels[self.value == 0].sum())
        return at_zero > _ZERO_SHARE * float(self.pixels.sum()) or _piled(
            self, self.value, self.pixels
        )

    @property
    def high(self) -> bool:
        """Return True if numbers pile up at the highest number."""
        return _piled(self, -self.value.flip(0), self.pixels.flip(0))


@dataclass(frozen=True)
class FrameTest:
    """The result of one test of the frames of a measurement."""

    name: str
    number: float  #: in the unit of the limit
    limit: float  #: above the limit chance alone does not explain the number
    verdict: Verdict
    sentence: str
    #: relative errors of "gain" and "noise" that may follow
    shifts: Mapping[str, float] = field(default_factory=dict)
    explains_all: bool = False  #: True if other tests would only find consequences of this fault
    #: faults of which the frames tell a size, whether the test finds them or not
    hidden: tuple[Hidden, ...] = ()


class Evidence(NamedTuple):
    """The strongest of several standard normal deviations, and the value that chance alone
    exceeds rarely.
    """

    strength: float  #: standard deviations
    limit: float

    @property
    def found(self) -> bool:
        """Return True if chance alone does not explain the strength."""
        return self.strength > self.limit


def paired_level(stack: Stack) -> Level:
    """Return the pairs and the histogram of a light level; frame 0 forms a pair with 1, 2 with
    3, and so on.
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
    """Return the levels with what the fit uses: dark levels, and lit levels up to ``share`` of
    saturation.

    Saturation is at the lit level of the greatest variance, as for the likelihood. Without a
    ``share`` each level is used. What the lamp changed from frame to frame, which is proportional
    to the light of each pixel, is taken off the differences of the pairs.
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
    """Return the levels without light, and those with light."""
    dark = [level for level in levels if level.dark]
    lit = [level for level in levels if not level.dark]
    return dark, lit


def saturated_levels(levels: Sequence[Level]) -> list[Level]:
    """Return the levels whose numbers pile up at the highest number, or whose variance has fallen
    above its maximum.

    A well that differs from pixel to pixel, or that fills before the read noise is added, makes no
    pile.
    """
    lit_levels = [level for level in levels if not level.dark and level.paired]
    peak = max(lit_levels, key=lambda level: level.variance, default=None)
    if peak is None:
        return [level for level in levels if level.high]
    return [level for level in levels if level.high or _is_flat(level, peak)]


def levels_to_test(levels: Sequence[Level]) -> list[Level]:
    """Return the paired levels whose noise is tested: those that the fit uses, without a pile at
    an end.
    """
    fitted = [level for level in levels if level.paired and level.fitted]
    return [level for level in fitted if not level.high and not level.low]


def _is_flat(level: Level, peak: Level) -> bool:
    """Return True for a lit level that is brighter than the ``peak`` of the variance and has less
    than half of its variance.
    """
    return (
        level.paired
        and not level.dark
        and level.mean > peak.mean
        and level.variance < _FLAT_SHARE * peak.variance
    )


def _without_flicker(level: Level, dark: float) -> Level:
    """Return a lit level without what a change of the lamp between the frames of a pair adds to
    their difference.

    The light of the second frame is that of the first, times the ratio of their means above the
    dark.
    """
    signal = level.mean - dark
    if level.dark or not level.paired or signal <= 0:
        return level
    relative_drift = (level.drift / signal)[:, None, None]
    # both frames are brought to the mean of their lights
    differences = level.second * (1 - relative_drift / 2) - level.first * (1 + relative_drift / 2)
    pattern_power = (level.first * level.second).mean((1, 2)).clamp_min(0.0)
    # uneven light, the common pattern of both frames, times the change of the light
    flicker = float((relative_drift[:, 0, 0].square() * pattern_power).mean()) / 2
    return level._replace(differences=differences, variance=_variance(differences), flicker=flicker)


def _variance(differences: Tensor) -> float:
    """Return the temporal variance of differences (pair, y, x) of two frames, without the drift of
    the mean: half their mean square, with one degree of freedom a pair less; NaN without a pair.
    """
    return (
        float(differences.square().sum()) / 2 / max(1, differences.numel() - len(differences))
        if len(differences)
        else math.nan
    )


def _centred(frames: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the means (frame,) of frames, and the frames (frame, y, x) less their means, 0 in
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
    """Return frames (frame, y, x) without the means of their rows and columns."""
    return x - x.mean(2, keepdim=True) - x.mean(1, keepdim=True) + x.mean((1, 2), keepdim=True)


def _central_window(frames: Tensor) -> Tensor:
    """Return the middle of at most 16 frames, and fewer frames where they are large."""
    top, left = (
        max(0, n - _WINDOW_SIDE) // 2 // _BLOCK_SIDE * _BLOCK_SIDE for n in frames.shape[1:]
    )
    window = frames[:, top : top + _WINDOW_SIDE, left : left + _WINDOW_SIDE]
    # an even number, for pairs
    frame_count = _TESTED_PIXELS // max(1, window[0].numel()) // 2 * 2
    return window[: min(_TESTED_FRAMES, max(2, frame_count))]


def _piled(level: Level, value: Tensor, count: Tensor) -> bool:
    """Return True if the lowest number occurs more often than the next number, or the two lowest
    more often than the next two.

    The counts of numbers without a limit fall towards the ends. A full well fills two neighbouring
    numbers. Coarse numbers, with few values or little variance, are compared only at 0.
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
    """Return True if the count at an end exceeds that beside it by more than chance."""
    excess = count_at_end - count_beside - 2
    return count_at_end >= _PILE_PIXELS and excess > _PILE_SIGMA * math.sqrt(
        count_at_end + count_beside
    )


def strongest_evidence(
    z: Sequence[Sequence[float]], others: Sequence[float] = (), sides: int = 1
) -> Evidence:
    """Return the strongest evidence of independent standard normal numbers (statistic, level), and
    its limit.

    Each number counts alone, and all numbers of a statistic count together by their sum over the
    square root of their count; ``others`` are further standard normal numbers. The limit is
    Bonferroni's for all of these, and for both signs with two ``sides``.
    """
    sums_of_statistics = [sum(row) / math.sqrt(len(row)) for row in z if len(row) > 1]
    all_numbers = [*chain.from_iterable(z), *sums_of_statistics, *others]
    strengths = [abs(x) for x in all_numbers] if sides == 2 else all_numbers
    return Evidence(
        max(strengths, default=0.0),
        normal_limit(FALSE_ALARM_RATE / sides / max(1, len(all_numbers))),
    )


def normal_limit(probability: float) -> float:
    """Return the number of standard deviations that a standard normal number exceeds with a
    probability.
    """
    return -float(torch.special.ndtri(torch.tensor(probability, dtype=torch.float64)))


def studentised(product: Tensor) -> float:
    """Return the sum of independent numbers of mean 0 in its own standard deviations."""
    return float(product.sum()) / math.sqrt(float(product.square().sum()) + VARIANCE_FLOOR)


def outcome(
    name: str,
    evidence: Evidence,
    sentence: str,
    shifts: Mapping[str, float],
    passed: str,
    modelled: str = "",
) -> FrameTest:
    """Return the result of a test: passed, modelled, widened, or refused where an error exceeds
    2 %.
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
    """Return the result of a test of a fault of which the frames tell a size, found or not.

    Nothing is corrected. A fault that is found is refused where gain or noise may be wrong by more
    than 2 %, and else widens by its whole size.
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
