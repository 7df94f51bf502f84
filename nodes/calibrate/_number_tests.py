"""Tests of the digital numbers of frames: missing, piled-up and too coarse numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from neusee.nodes.calibrate._frame_pairs import FrameTest, Level, saturated

_REACH = 8  #: numbers on either side of a number, which say how often it should occur
#: least expected count of a number that is missing; chance leaves it out once in 1e11
_EXPECTED = 25.0
_CLIFF = 50.0  #: least count of each of three numbers beside a block of missing numbers
_SIMILAR = 3.0  #: largest ratio of the counts of these three numbers
_TAIL = 0.005  #: share of the pixels of a level at either end, where numbers need not occur
_QUIET = 0.24  #: DN2, least dark variance of EMVA 1288: a standard deviation of 0.49 DN


def number_tests(levels: Sequence[Level], exact: bool) -> list[FrameTest]:
    """Test digital numbers for missing codes, for a pile at either end, and for noise that the
    numbers resolve.

    ``exact`` says that the likelihood uses the probability of each number, as `density` does, so
    that the limits of the converter and rounding are modelled.

    Shapes: a list of levels -> a list of tests.
    Units:  counts of codes and levels; DN for the dark noise.
    Error:  a code of 25 expected pixels is missing by chance once in 1e11; an end piles up by
            chance at 5 sigma.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 6.5 (bit depth, saturation) and 6.6
            (variance >= 0.24).
    """
    fitted = [level for level in levels if level.fitted]
    return [codes(fitted), _black(fitted, exact), _white(levels, exact), *_coarse(fitted, exact)]


def codes(levels: Sequence[Level]) -> FrameTest:
    top = max(int(level.value[-1]) for level in levels) + 1
    low = min(int(level.value[0]) for level in levels)
    counts = [
        torch.zeros(top, dtype=torch.float64).index_add(0, x.value, x.pixels.double())
        for x in levels
    ]
    total = sum(counts, torch.zeros(top, dtype=torch.float64))
    expected = sum((_expected(count) for count in counts), torch.zeros(top, dtype=torch.float64))
    missing = (total == 0) & ((expected >= _EXPECTED) | _beside_cliff(total))
    missing[: low + 1] = False
    number, looked = int(missing.sum()), int(((expected >= _EXPECTED) | (total >= _EXPECTED)).sum())
    if not number:
        return FrameTest(
            "no missing codes", 0.0, 0.0, "passed", f"each of {looked} expected codes occurs"
        )
    present = (total > 0).nonzero().squeeze(1)
    step = math.gcd(*(present - present[0]).tolist())
    text = f"{number} of {looked} expected codes never occur, such as {int(missing.nonzero()[0])}"
    if step > 1:
        text += (
            f": all numbers are {int(present[0])} plus a multiple of {step}: a bit is stuck, or"
            " shifted"
        )
        if int(present[0]) % step == 0:
            text += (
                "; where the numbers are shifted, give the step of `calibrate.frames` the divisor"
                f" {step}"
            )
    else:
        text += ": a bit is stuck, or the numbers were stretched or compressed"
    text += "; take the numbers as the converter gives them"
    return FrameTest("no missing codes", float(number), 0.0, "refused", text, explains_all=step > 1)


def _expected(count: Tensor) -> Tensor:
    """Return the count that the neighbours on both sides predict for each number in the middle
    of one level.
    """
    share = count.cumsum(0) / count.sum()
    inside = ((share > _TAIL) & (share < 1 - _TAIL)).double()
    sums, number = ((x * inside).cumsum(0) for x in (count, torch.ones_like(count)))
    index = torch.arange(len(count))
    before, after = (index - _REACH - 1).clamp_min(0), (index + _REACH).clamp_max(len(count) - 1)
    left = (sums[(index - 1).clamp_min(0)] - sums[before]) / (
        number[(index - 1).clamp_min(0)] - number[before]
    ).clamp_min(1)
    right = (sums[after] - sums) / (number[after] - number).clamp_min(1)
    return torch.minimum(left, right) * inside


def _beside_cliff(total: Tensor) -> Tensor:
    """Return a mask of the numbers beside three numbers that occur often and about equally
    often.
    """
    shifted = [torch.roll(total, i) for i in (1, 2, 3)], [torch.roll(total, -i) for i in (1, 2, 3)]
    cliffs = torch.zeros_like(total, dtype=torch.bool)
    for three in shifted:
        stacked = torch.stack(three)
        low, high = stacked.amin(0), stacked.amax(0)
        cliffs |= (low >= _CLIFF) & (high <= _SIMILAR * low)
    cliffs[:3], cliffs[-3:] = False, False
    return cliffs


def _black(levels: Sequence[Level], exact: bool) -> FrameTest:
    cut = [level for level in levels if level.low]
    name, count = "no pile at the lowest number", float(len(cut))
    if not cut:
        return FrameTest(name, 0.0, 0.0, "passed", "no level is clipped at the lowest number")
    names = ", ".join(level.name for level in cut)
    text = f"numbers pile up at {int(min(level.value[0] for level in cut))} DN in {names}"
    if exact and all(int(level.value[0]) == 0 for level in cut):
        return FrameTest(
            name, count, 0.0, "modelled", f"{text}: the likelihood counts the pixels at 0"
        )
    return FrameTest(
        name, count, 0.0, "refused", f"{text}: the black is clipped; raise the offset of the camera"
    )


def _white(levels: Sequence[Level], exact: bool) -> FrameTest:
    full = saturated(levels)
    name, count = "saturated levels are told", float(len(full))
    if not full:
        return FrameTest(name, 0.0, 0.0, "passed", "no level is saturated")
    use = "the likelihood counts its numbers" if exact else "such levels only bound the saturation"
    text = f"{'; '.join(_kinds_of_saturation(full))}: {use}"
    dark = [level.name for level in full if level.dark]
    if dark and not exact:
        return FrameTest(name, count, 0.0, "refused", f"{text}; {', '.join(dark)} is dark")
    return FrameTest(name, count, 0.0, "modelled", text)


def _kinds_of_saturation(full: Sequence[Level]) -> Iterator[str]:
    """Yield a clause for levels that pile up at an end, and one for levels of unequal wells."""
    if piled := [level.name for level in full if level.high]:
        yield f"numbers pile up at the highest number in {', '.join(piled)}"
    if flat := [level for level in full if not level.high]:
        names = ", ".join(level.name for level in flat)
        yield (
            f"the variance has fallen in {names}, full at about"
            f" {max(level.mean for level in flat):.0f} DN"
        )


def _coarse(levels: Sequence[Level], exact: bool) -> list[FrameTest]:
    darks = [level.variance for level in levels if level.dark and level.paired]
    return [coarse(min(darks), exact)] if darks else []


def coarse(variance: float, exact: bool) -> FrameTest:
    """Return the test of the least variance of dark levels, DN2, against the limit of EMVA 1288."""
    sd, limit = (math.sqrt(max(x, 0.0)) for x in (variance, _QUIET))
    name = "the dark noise exceeds rounding"
    text = f"the dark noise is {sd:.2f} DN; the standard asks for {limit:.2f} DN"
    if variance >= _QUIET:
        return FrameTest(name, -sd, -limit, "passed", text)
    if exact:
        return FrameTest(
            name, -sd, -limit, "modelled", f"{text}: the likelihood counts each number"
        )
    why = (
        "below it rounding is not independent noise, and the dark noise and the gain have only"
        " limits"
    )
    return FrameTest(name, -sd, -limit, "refused", f"{text}: {why}; raise the gain of the camera")
