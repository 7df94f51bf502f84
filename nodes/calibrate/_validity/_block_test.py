"""A test of frames for compression in blocks of 8 x 8 pixels, by borders and cosines of blocks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neusee.nodes.calibrate._validity._frame_pairs import FrameTest, Level, outcome, strongest

_BLOCK = 8  #: pixels of a block on a side
_STEPS = range(1, 33)  #: DN, steps to which compression may round the cosines of a block
_SMOOTH = 1.2  #: standard deviations of a cosine over a step, above which noise covers the step evenly
_LEVELS, _SIDE = 4, 256  #: levels, and pixels on a side, whose cosines are computed


def blocks(levels: Sequence[Level], white: Sequence[Tensor]) -> FrameTest:
    """Test if pixels were compressed in blocks of 8 x 8.

    Products of neighbouring differences ``white`` must be alike across the borders of blocks and inside blocks. The
    cosines of a block must not keep to multiples of a step: the mean of cos(2 pi cosine / step) is 0 without
    compression.

    Shapes: differences (pair, y, x) of each level -> a test.
    Units:  the number and the limit in standard deviations of chance.
    Error:  steps that are whole numbers up to 32 DN, of the orthonormal transform. It fails by chance once in 1000.
    Source: ITU-T Recommendation T.81 (JPEG), sections A.3.3 and A.3.4.
    """
    large = [x for x in white if min(x.shape[1:]) > 2 * _BLOCK]
    lags = (((0, 1), 2), ((1, 0), 1))
    across = [[abs(_across(products(x, lag), axis)) for x in large] for lag, axis in lags]
    bright = sorted(levels, key=lambda level: level.variance)[-_LEVELS:]
    steps = [z for step in _STEPS for z in _kept_to(step, bright)]
    evidence = strongest([[x] for x in [*across[0], *across[1], *steps]])
    sentence = (
        "neighbours correlate otherwise across the borders of blocks of 8 pixels, or the cosines of blocks keep to"
    )
    sentence += " multiples of a step, as in a compressed picture"
    return outcome("no blocks", evidence, sentence, {}, "no trace of compression in blocks of 8 pixels")


def products(x: Tensor, lag: tuple[int, int]) -> Tensor:
    """Return the product of each pixel with its neighbour at a lag, of which the mean is 0 for independent pixels.

    The removal of the means of lines correlates the pixels of a line by minus one over the length of the line.
    """
    down, right = lag
    height, width = x.shape[1:]
    one = x[:, : height - down, max(0, -right) : width - max(0, right)]
    other = x[:, down:, max(0, right) : width - max(0, -right)]
    length = width if down == 0 else height if right == 0 else math.inf
    return one * other + x.square().mean() / length


def _across(products: Tensor, axis: int) -> float:
    """Return the difference between products across block borders and products inside blocks, in standard errors."""
    border = torch.arange(products.shape[axis]) % _BLOCK == _BLOCK - 1
    across, inside = (products[(slice(None),) * axis + (at,)].reshape(-1) for at in (border, ~border))
    error = (across.var() / len(across) + inside.var() / len(inside)).sqrt()
    return float((inside.mean() - across.mean()) / error.clamp_min(1e-12))


def _kept_to(step: int, levels: Sequence[Level]) -> list[float]:
    """Return how strongly each cosine keeps to multiples of a step, as standard normal numbers, and all together."""
    sums, count = torch.zeros(_BLOCK * _BLOCK, dtype=torch.float64), 0
    for level in levels:
        if level.variance < (_SMOOTH * step) ** 2:
            continue
        cosines = _cosines(level.first[0])
        sums += (2 * math.pi / step * cosines).cos().sum(0)
        count += len(cosines)
    if not count:
        return []
    z = (sums[1:] / math.sqrt(count / 2)).tolist()
    return [*z, sum(z) / math.sqrt(len(z))]


def _cosines(frame: Tensor) -> Tensor:
    """Return the orthonormal cosine transform (block, 64) of the blocks of a frame (y, x)."""
    n, m = (min(size, _SIDE) // _BLOCK for size in frame.shape)
    k, x = (torch.arange(_BLOCK, dtype=torch.float64) for _ in range(2))
    basis = (math.pi / _BLOCK * k[:, None] * (x + 0.5)).cos() * math.sqrt(2 / _BLOCK)
    basis[0] /= math.sqrt(2)
    part = frame.double()[: n * _BLOCK, : m * _BLOCK].reshape(n, _BLOCK, m, _BLOCK).transpose(1, 2)
    found: Tensor = (basis @ part @ basis.T).reshape(n * m, -1)
    return found
