"""Frames of the light levels of a calibration as pairs, and the verdict of a test of these frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neusee.nodes.calibrate._frames._frame_statistics import Scatter, histogram
from neusee.nodes.calibrate._validity._hidden_faults import Correction, Hidden, corrections

Verdict = Literal["passed", "modelled", "widened", "refused"]
ALARM = 1e-3  #: probability with which chance alone fails one test of a whole measurement
REFUSED = 0.02  #: relative error of gain or dark noise above which frames are refused, and below which intervals widen
_WINDOW = 512  #: pixels of the central window on a side, in which patterns and noise are tested
_BLOCK = 8  #: pixels by which the window is aligned, as blocks of a compressed picture are
_PILED = 5.0  #: standard deviations of counting by which numbers pile up at an end
_LEAST = 20  #: least count of pixels that pile up
_AT_ZERO = 5e-3  #: share of the pixels at 0, which hides numbers below 0
_MOST = 16  #: frames of a level whose noise and patterns are tested
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
_FLOOR = 1e-12  #: DN2, so that frames without noise divide by more than 0


class Stack(NamedTuple):
    """The frames of one light level, as `reduce` receives them."""

    name: str
    photons: float  #: per pixel and exposure; 0 in the dark
    exposure: float  #: s
    scatter: Scatter  #: which variance `reduce` computes
    frames: Tensor  #: (frame, y, x) DN, whole numbers


class Level(NamedTuple):
    """One light level: pairs of frames in the central window, and the histogram of the whole frames."""

    stack: Stack
    first: Tensor  #: (pair, y, x) float64, DN, with the mean of each frame removed
    second: Tensor  #: (pair, y, x), as `first`
    apart: Tensor  #: (pair, y, x) DN, second less first
    drift: Tensor  #: (pair,) DN, mean of the second frame less mean of the first
    variance: float  #: DN2, temporal, without the drift of the mean
    mean: float  #: DN
    value: Tensor  #: (code,) digital numbers that occur, rising
    pixels: Tensor  #: (code,) count of each number

    @property
    def dark(self) -> bool:
        """Return True for a level without light."""
        return self.stack.photons == 0

    @property
    def paired(self) -> bool:
        """Return True for a level of two or more frames."""
        return len(self.apart) > 0

    @property
    def low(self) -> bool:
        """Return True if numbers pile up at the lowest number, or if 0 is a number of more than a few pixels."""
        at_zero = float(self.pixels[self.value == 0].sum())
        return at_zero > _AT_ZERO * float(self.pixels.sum()) or _piled(self, self.value, self.pixels)

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
    shifts: Mapping[str, float] = field(default_factory=dict)  #: relative errors of "gain" and "noise" that may follow
    hidden: tuple[Hidden, ...] = ()  #: faults of which the frames tell a size, which corrects gain and noise


class Evidence(NamedTuple):
    """The strongest of several standard normal deviations, and the value that chance alone exceeds rarely."""

    strength: float  #: standard deviations
    limit: float

    @property
    def found(self) -> bool:
        """Return True if chance alone does not explain the strength."""
        return self.strength > self.limit


def prepared(stack: Stack) -> Level:
    """Return the pairs and the histogram of a light level; frame 0 forms a pair with 1, 2 with 3, and so on."""
    value, count = histogram(stack.frames)
    frames = _window(stack.frames[:_MOST]).double()
    means = frames.mean((1, 2))
    pairs = len(frames) // 2
    mean = float((value * count).sum()) / float(count.sum())
    first, second = ((frames - means[:, None, None])[at : 2 * pairs : 2] for at in (0, 1))
    apart = second - first
    freedom = max(1, apart.numel() - pairs)
    variance = float(apart.square().sum()) / 2 / freedom if pairs else math.nan
    return Level(
        stack, first, second, apart, means[1 : 2 * pairs : 2] - means[: 2 * pairs : 2], variance, mean, value, count
    )


def without_lines(x: Tensor) -> Tensor:
    """Return frames (frame, y, x) without the means of their rows and columns."""
    return x - x.mean(2, keepdim=True) - x.mean(1, keepdim=True) + x.mean((1, 2), keepdim=True)


def _window(frames: Tensor) -> Tensor:
    starts = [max(0, n - _WINDOW) // 2 // _BLOCK * _BLOCK for n in frames.shape[1:]]
    return frames[:, starts[0] : starts[0] + _WINDOW, starts[1] : starts[1] + _WINDOW]


def _piled(level: Level, value: Tensor, count: Tensor) -> bool:
    """Return True if the lowest number occurs more often than the next number.

    The counts of numbers without a limit fall towards the ends. A full well fills two neighbouring numbers.
    """
    last, at_zero = int(value[0]), int(value[0]) == 0
    counts = [float(count[value == last + i].sum()) for i in range(4)]
    if sum(counts) < _LEAST:
        return False
    one, two = counts[:2], (counts[0] + counts[1], counts[2] + counts[3])
    wide = level.paired and level.variance > 1.0 and len(value) > 8
    tests = [one] * (wide or at_zero) + [two] * wide
    return any(a >= _LEAST and a - b - 2 > _PILED * math.sqrt(a + b) for a, b in tests)


def strongest(z: Sequence[Sequence[float]], more: Sequence[float] = (), sides: int = 1) -> Evidence:
    """Return the strongest evidence of independent standard normal numbers (statistic, level), and its limit.

    Each number counts alone, and all numbers of a statistic count together by their sum over the square root of their
    count; ``more`` are further standard normal numbers. The limit is Bonferroni's for all of these, and for both signs
    with two ``sides``.
    """
    together = [sum(row) / math.sqrt(len(row)) for row in z if len(row) > 1]
    every = [*(x for row in z for x in row), *together, *more]
    strengths = [abs(x) for x in every] if sides == 2 else every
    return Evidence(max(strengths, default=0.0), normal_limit(ALARM / sides / max(1, len(every))))


def normal_limit(probability: float) -> float:
    """Return the number of standard deviations that a standard normal number exceeds with a probability."""
    return -float(torch.special.ndtri(torch.tensor(probability, dtype=torch.float64)))


def studentised(product: Tensor) -> float:
    """Return the sum of independent numbers of mean 0 in its own standard deviations."""
    return float(product.sum()) / math.sqrt(float(product.square().sum()) + _FLOOR)


def outcome(
    name: str, evidence: Evidence, sentence: str, shifts: Mapping[str, float], passed: str, modelled: str = ""
) -> FrameTest:
    """Return the result of a test: passed, modelled, widened, or refused where an error exceeds 2 %."""
    if not evidence.found:
        return FrameTest(name, evidence.strength, evidence.limit, "passed", passed)
    if modelled:
        return FrameTest(name, evidence.strength, evidence.limit, "modelled", f"{sentence}: {modelled}", shifts)
    worst = max(shifts.values(), default=math.inf)
    verdict: Verdict = "refused" if worst > REFUSED else "widened"
    means = f"an error of {100 * worst:.2g} % may follow" if math.isfinite(worst) else "no model describes such frames"
    text = f"{sentence}: {means}{_remedy(name, verdict)}"
    return FrameTest(name, evidence.strength, evidence.limit, verdict, text, shifts)


def _remedy(name: str, verdict: Verdict) -> str:
    return f"; {_REMEDIES[name]}" if verdict == "refused" and name in _REMEDIES else ""


def corrected(name: str, evidence: Evidence, hidden: Sequence[Hidden], sentence: str, passed: str) -> FrameTest:
    """Return the result of a test whose fault is corrected: refused where the correction is uncertain by over 2 %."""
    change = corrections(hidden)
    worst = max(change.values(), key=lambda x: x.sd, default=Correction(0.0, 0.0))
    verdict: Verdict = "passed"
    text = f"{passed}; the frames may hide {100 * worst.sd:.2g} %" if hidden else passed
    if evidence.found:
        verdict = "modelled" if worst.sd <= REFUSED else "refused"
        words = [f"{what} by {100 * x.mean:+.2g} % ± {100 * x.sd:.2g} %" for what, x in change.items() if x.sd]
        text = f"{sentence}: corrected, {' and '.join(words)}" if verdict == "modelled" else ""
        error = max(abs(x.mean) for x in change.values())
        text = text or f"{sentence}: an error of {100 * error:.2g} % may follow{_remedy(name, verdict)}"
    return FrameTest(name, evidence.strength, evidence.limit, verdict, text, hidden=tuple(hidden))


def uncorrected(test: FrameTest) -> FrameTest:
    """Return the result of a test for a program that corrects no fault: a fault that was found shifts its results."""
    if not test.hidden or test.verdict != "modelled":
        return test
    worst = max(abs(change.mean) + change.sd for change in corrections(test.hidden).values())
    verdict: Verdict = "refused" if worst > REFUSED else "widened"
    text = f"{test.sentence.partition(': corrected')[0]}: an error of {100 * worst:.2g} % may follow"
    return replace(test, verdict=verdict, sentence=text + _remedy(test.name, verdict))
