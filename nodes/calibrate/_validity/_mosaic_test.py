"""A test of frames for a mosaic of colours, whose pixels have several quantum efficiencies."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from torch import Tensor

from neusee.nodes.calibrate._validity._frame_pairs import FrameTest, Level, tested

_PERIODS = {2: "2 x 2 pixels, as of Bayer", 4: "4 x 4 pixels, as of a quad mosaic", 6: "6 x 6 pixels, as of X-Trans"}
_UNLIKE = 0.05  #: largest relative difference of the positions of a monochrome sensor with several readouts
_CHANCE = 8.0  #: standard errors by which the brightest and the darkest position differ by chance


def mosaic(levels: Sequence[Level]) -> Iterator[FrameTest]:
    """Test if the light of pixels depends on their position in a small cell that repeats over the frame.

    Shapes: a list of levels -> a test, or none without light.
    Units:  number and limit: relative difference of the brightest and the darkest position of the cell.
    Error:  positions of a monochrome sensor that differ by more than 5 % count as a mosaic.
    Source: Bayer, US patent 3971065 (1976), for the cell of 2 x 2 pixels.
    """
    dark = min((level.mean for level in levels if level.dark), default=math.inf)
    bright = max(tested(levels), key=lambda level: level.mean, default=None)
    if bright is None or bright.dark or bright.mean <= dark:
        return
    signal = bright.mean - dark
    picture = (bright.first + bright.second).double().mean(0) / 2
    for period, cell in _PERIODS.items():
        number = _difference(picture, period) / signal
        if number > _UNLIKE:
            colours = f"the light of pixels differs by {number:.0%} over a cell of {cell}"
            text = f"{colours}: the frames are a mosaic of colours, whose calibration is not offered; give frames of"
            text += " one colour alone, such as every second pixel of every second row"
            yield FrameTest("one colour", number, _UNLIKE, "refused", text, explains_all=True)
            return


def _difference(picture: Tensor, period: int) -> float:
    """Return the difference of the brightest and the darkest position of a cell, DN; 0 if chance explains it."""
    if min(picture.shape) < 2 * period:
        return 0.0
    means, error = _positions(picture, period)
    difference = float(means.max() - means.min())
    return difference if difference > _CHANCE * error else 0.0


def _positions(picture: Tensor, period: int) -> tuple[Tensor, float]:
    """Return the mean of each position of a cell (y, x), and the standard error of a mean."""
    high, wide = (n // period for n in picture.shape)
    cells = picture[: high * period, : wide * period].reshape(high, period, wide, period)
    within = cells - cells.mean((1, 3), keepdim=True)
    means = cells.mean((0, 2))
    spread = (within - (means - means.mean())[None, :, None, :]).square().mean()
    return means, math.sqrt(float(spread) / (high * wide))
