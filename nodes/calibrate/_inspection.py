"""All tests of the frames of a calibration, before any likelihood."""

from __future__ import annotations

from collections.abc import Iterable

from neusee.nodes.calibrate._frame_pairs import FrameTest, Stack, fitted_levels, prepared
from neusee.nodes.calibrate._noise_tests import noise_tests
from neusee.nodes.calibrate._number_tests import codes, number_tests
from neusee.nodes.calibrate._pattern_tests import mosaic, pattern_tests


def inspect_frames(
    stacks: Iterable[Stack], exact: bool, share: float | None = None
) -> list[FrameTest]:
    """Test the frames of all light levels for what no likelihood of this package describes.

    ``exact`` is True for `density`, which uses the probability of each digital number, and False
    for `camera`. Levels above ``share`` of saturation, which the likelihood leaves out, are not
    tested, but for saturation itself. Noise and patterns are tested in the central 1024 x 1024
    pixels, digital numbers in the whole frames. Of a colour mosaic, and of shifted numbers, that
    alone is said.

    Shapes: frames (frame, y, x) of each level -> a list of tests.
    Units:  frames DN.
    Error:  each test fails by chance with a probability of 1e-3. A fault too small to be found is
            in `hidden` of a test that passed.
    Raises: ValueError for frames that hold other than digital numbers.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 2 and 6 (assumptions of the model).
    """
    levels = fitted_levels([prepared(stack) for stack in stacks], share)
    if not levels:
        return []
    # a mosaic or shifted numbers explain what all other tests would find
    for frame_test in (*mosaic(levels), codes([level for level in levels if level.fitted])):
        if frame_test.verdict == "refused" and frame_test.explains_all:
            return [frame_test]
    return [*noise_tests(levels), *pattern_tests(levels), *number_tests(levels, exact)]
