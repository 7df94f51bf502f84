"""All tests of the frames of a calibration, made before a likelihood is computed.

This file has the tests of the digital numbers: missing codes, clipping, and noise below the
rounding step. The tests of noise and of patterns have files of their own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor

from neusee.nodes.calibrate._emva_quantities import LEAST_DARK_VARIANCE
from neusee.nodes.calibrate._frame_pairs import (
    FrameTest,
    Level,
    Stack,
    fitted_levels,
    paired_level,
    saturated_levels,
)
from neusee.nodes.calibrate._noise_tests import noise_tests
from neusee.nodes.calibrate._pattern_tests import mosaic_test, pattern_tests

_NEIGHBOURS = 8  #: codes on either side of a code, from whose counts its count is predicted
#: least expected count of a code that counts as missing; by chance such a code is absent once in
#: 1e11
_EXPECTED_COUNT = 25.0
_CLIFF_COUNT = 50.0  #: least count of each of the three codes beside a block of missing codes
_CLIFF_RATIO = 3.0  #: largest ratio of the counts of these three codes
_TAIL_SHARE = 0.005  #: share of the pixels of a level in either tail, where codes may be absent


def number_tests(levels: Sequence[Level], exact: bool) -> list[FrameTest]:
    """Test the digital numbers for missing codes, clipping at either end, and dark noise too small
    to be resolved.

    ``exact`` is True if the likelihood uses the probability of each digital number, as `density`
    does: it then models clipping and rounding.

    Shapes: a list of levels -> a list of tests.
    Units:  counts of codes and levels; DN for the dark noise.
    Error:  a code of 25 expected pixels is missing by chance once in 1e11; an end piles up by
            chance at 5 sigma.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 6.5 (bit depth, saturation) and 6.6
            (variance >= 0.24).
    """
    fitted = [level for level in levels if level.fitted]
    return [
        missing_codes(fitted),
        _clipped_black(fitted, exact),
        _saturation(levels, exact),
        *_dark_noise(fitted, exact),
    ]


def missing_codes(levels: Sequence[Level]) -> FrameTest:
    """Test for missing codes: digital numbers that never occur although their neighbours are
    frequent.
    """
    code_count = max(int(level.value[-1]) for level in levels) + 1
    lowest = min(int(level.value[0]) for level in levels)
    level_counts = [
        torch.zeros(code_count, dtype=torch.float64).index_add(0, x.value, x.pixels.double())
        for x in levels
    ]
    total = sum(level_counts, torch.zeros(code_count, dtype=torch.float64))
    expected = sum(
        (_expected_counts(count) for count in level_counts),
        torch.zeros(code_count, dtype=torch.float64),
    )
    is_missing = (total == 0) & ((expected >= _EXPECTED_COUNT) | _beside_cliff(total))
    # codes up to the lowest one that occurs need not occur
    is_missing[: lowest + 1] = False
    missing_count, expected_count = (
        int(is_missing.sum()),
        int(((expected >= _EXPECTED_COUNT) | (total >= _EXPECTED_COUNT)).sum()),
    )
    if not missing_count:
        return FrameTest(
            "no missing codes",
            0.0,
            0.0,
            "passed",
            f"each of {expected_count} expected codes occurs",
        )
    present_codes = (total > 0).nonzero().squeeze(1)
    step = math.gcd(*(present_codes - present_codes[0]).tolist())
    text = (
        f"{missing_count} of {expected_count} expected codes never occur, such as"
        f" {int(is_missing.nonzero()[0])}"
    )
    if step > 1:
        text += (
            f": all numbers are {int(present_codes[0])} plus a multiple of {step}: a bit is stuck,"
            " or shifted"
        )
        if int(present_codes[0]) % step == 0:
            text += (
                "; where the numbers are shifted, give the step of `calibrate.frames` the divisor"
                f" {step}"
            )
    else:
        text += ": a bit is stuck, or the numbers were stretched or compressed"
    text += "; take the numbers as the converter gives them"
    return FrameTest(
        "no missing codes", float(missing_count), 0.0, "refused", text, explains_all=step > 1
    )


def _expected_counts(count: Tensor) -> Tensor:
    """Return the expected count (code,) of each code of one level, predicted from its neighbours on
    both sides; 0 in the tails, where codes may be absent.

    ``count`` has the counts of all codes from 0 on. The prediction is the smaller of the mean
    counts of `_NEIGHBOURS` codes on each side.
    """
    cumulated_share = count.cumsum(0) / count.sum()
    in_middle = ((cumulated_share > _TAIL_SHARE) & (cumulated_share < 1 - _TAIL_SHARE)).double()
    # means over a window are differences of cumulated sums
    cumulated_counts, cumulated_numbers = (
        (x * in_middle).cumsum(0) for x in (count, torch.ones_like(count))
    )
    index = torch.arange(len(count))
    before_window, end_of_window = (
        (index - _NEIGHBOURS - 1).clamp_min(0),
        (index + _NEIGHBOURS).clamp_max(len(count) - 1),
    )
    mean_below = (cumulated_counts[(index - 1).clamp_min(0)] - cumulated_counts[before_window]) / (
        cumulated_numbers[(index - 1).clamp_min(0)] - cumulated_numbers[before_window]
    ).clamp_min(1)
    mean_above = (cumulated_counts[end_of_window] - cumulated_counts) / (
        cumulated_numbers[end_of_window] - cumulated_numbers
    ).clamp_min(1)
    return torch.minimum(mean_below, mean_above) * in_middle


def _beside_cliff(total: Tensor) -> Tensor:
    """Return a mask of the codes next to three codes that occur often and about equally often."""
    # the three codes below each code, and the three above
    neighbours = (
        [torch.roll(total, i) for i in (1, 2, 3)],
        [torch.roll(total, -i) for i in (1, 2, 3)],
    )
    cliffs = torch.zeros_like(total, dtype=torch.bool)
    for three_counts in neighbours:
        stacked = torch.stack(three_counts)
        least, greatest = stacked.amin(0), stacked.amax(0)
        cliffs |= (least >= _CLIFF_COUNT) & (greatest <= _CLIFF_RATIO * least)
    # `roll` wraps around at both ends
    cliffs[:3], cliffs[-3:] = False, False
    return cliffs


def _clipped_black(levels: Sequence[Level], exact: bool) -> FrameTest:
    """Test for clipping at the lowest code; an ``exact`` likelihood models clipping at 0."""
    clipped_levels = [level for level in levels if level.low]
    name, count = "no pile at the lowest number", float(len(clipped_levels))
    if not clipped_levels:
        return FrameTest(name, 0.0, 0.0, "passed", "no level is clipped at the lowest number")
    names = ", ".join(level.name for level in clipped_levels)
    text = (
        f"numbers pile up at {int(min(level.value[0] for level in clipped_levels))} DN in {names}"
    )
    if exact and all(int(level.value[0]) == 0 for level in clipped_levels):
        return FrameTest(
            name, count, 0.0, "modelled", f"{text}: the likelihood counts the pixels at 0"
        )
    return FrameTest(
        name, count, 0.0, "refused", f"{text}: the black is clipped; raise the offset of the camera"
    )


def _saturation(levels: Sequence[Level], exact: bool) -> FrameTest:
    """Report which levels are saturated; a saturated dark level refuses the frames unless the
    likelihood is ``exact``.
    """
    full_levels = saturated_levels(levels)
    name, count = "saturated levels are told", float(len(full_levels))
    if not full_levels:
        return FrameTest(name, 0.0, 0.0, "passed", "no level is saturated")
    consequence = (
        "the likelihood counts its numbers" if exact else "such levels only bound the saturation"
    )
    text = f"{'; '.join(_kinds_of_saturation(full_levels))}: {consequence}"
    dark_names = [level.name for level in full_levels if level.dark]
    if dark_names and not exact:
        return FrameTest(name, count, 0.0, "refused", f"{text}; {', '.join(dark_names)} is dark")
    return FrameTest(name, count, 0.0, "modelled", text)


def _kinds_of_saturation(full: Sequence[Level]) -> Iterator[str]:
    """Yield a clause on the levels with a pile at the highest code, and one on levels saturated
    without a pile.
    """
    if piled_names := [level.name for level in full if level.high]:
        yield f"numbers pile up at the highest number in {', '.join(piled_names)}"
    if flat_levels := [level for level in full if not level.high]:
        names = ", ".join(level.name for level in flat_levels)
        yield (
            f"the variance has fallen in {names}, full at about"
            f" {max(level.mean for level in flat_levels):.0f} DN"
        )


def _dark_noise(levels: Sequence[Level], exact: bool) -> list[FrameTest]:
    """Return the test of the smallest dark variance; no test without a pair of dark frames."""
    darks = [level.variance for level in levels if level.dark and level.paired]
    return [coarse(min(darks), exact)] if darks else []


def coarse(variance: float, exact: bool) -> FrameTest:
    """Return the test of the smallest temporal dark variance, DN2, against the limit of EMVA
    1288.
    """
    deviation, least_deviation = (math.sqrt(max(x, 0.0)) for x in (variance, LEAST_DARK_VARIANCE))
    name = "the dark noise exceeds rounding"
    text = f"the dark noise is {deviation:.2f} DN; the standard asks for {least_deviation:.2f} DN"
    if variance >= LEAST_DARK_VARIANCE:
        # a smaller deviation is worse: both numbers are negative
        return FrameTest(name, -deviation, -least_deviation, "passed", text)
    if exact:
        return FrameTest(
            name,
            -deviation,
            -least_deviation,
            "modelled",
            f"{text}: the likelihood counts each number",
        )
    reason = (
        "below it rounding is not independent noise, and the dark noise and the gain have only"
        " limits"
    )
    return FrameTest(
        name,
        -deviation,
        -least_deviation,
        "refused",
        f"{text}: {reason}; raise the gain of the camera",
    )


# --- all tests ------------------------------------------------------------------------------------


def inspect_frames(
    stacks: Iterable[Stack], exact: bool, share: float | None = None
) -> list[FrameTest]:
    """Test the frames of all light levels for faults that no likelihood of this package models.

    ``exact`` is True for `density`, which uses the probability of each digital number, and False
    for `camera`. Levels above ``share`` of saturation, which the likelihood excludes, are tested
    only for saturation. Noise and patterns are tested in the central 1024 x 1024 pixels, digital
    numbers in the full frames. If the frames are a colour mosaic or have shifted numbers, only this
    is reported.

    Shapes: frames (frame, y, x) of each level -> a list of tests.
    Units:  frames DN.
    Error:  each test fails by chance with a probability of 1e-3. A fault too small to be found is
            in `hidden` of a test that passed.
    Raises: ValueError for frames that hold other than digital numbers.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 2 and 6 (assumptions of the model).
    """
    levels = fitted_levels([paired_level(stack) for stack in stacks], share)
    if not levels:
        return []
    # a mosaic or shifted numbers explain what all other tests would find
    for frame_test in (
        *mosaic_test(levels),
        missing_codes([level for level in levels if level.fitted]),
    ):
        if frame_test.verdict == "refused" and frame_test.explains_all:
            return [frame_test]
    return [*noise_tests(levels), *pattern_tests(levels), *number_tests(levels, exact)]
