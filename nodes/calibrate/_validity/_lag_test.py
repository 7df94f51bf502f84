"""A test of frames for lag: noise of a frame that persists in the next frame, apart from the patterns that stay."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neusee.nodes.calibrate._validity._frame_pairs import (
    FrameTest,
    Level,
    bounded,
    strongest,
    studentised,
    without_lines,
)
from neusee.nodes.calibrate._validity._hidden_faults import Hidden, probably_sound

_RARE = 4.5  #: standard deviations beyond which a pixel is defective, and left out
_LEAST = 3  #: least levels in excess of the patterns that are fitted
_CURVED = 6  #: lit levels from which a pattern may be a parabola of the signal
_KEPT = 0.02  #: scale of the prior of the share of the variance that lag takes


def lag(levels: Sequence[Level]) -> list[FrameTest]:
    """Test if the noise of a frame persists in the next frame of the same light.

    The pattern of each pixel is fitted over the levels, separately for first and for second frames: an offset, a part
    in proportion to the signal and to its square, and one in proportion to the exposure. What is left of the first
    frames and of the second frames is independent noise, unless the first frame persists in the second. With a share L
    that stays, the variance of a pair falls by the factor (1 - L)**2 / (1 + L).

    Shapes: a list of levels -> a list of one test, or of none.
    Units:  number and limit in standard deviations of chance.
    Error:  the test fails by chance with a probability of 1e-3. It needs three levels more than the parts of a pattern.
    Source: Janesick, Photon Transfer, SPIE Press 2007, chapter 8 (image lag); weighted least squares.
    """
    group = _comparable(levels)
    patterns = _patterns(group)
    if len(group) < patterns.shape[1] + _LEAST - 1:
        return []
    weight = torch.tensor([max(level.variance, 1e-12) for level in group], dtype=torch.float64).rsqrt()
    basis = torch.linalg.qr(weight[:, None] * patterns).Q
    lit = torch.tensor([not level.dark for level in group])
    lit = lit if bool(lit.any()) else ~lit
    pairs = min(len(level.apart) for level in group)
    products, powers = [], 0.0
    for pair in range(pairs):
        u, v = (
            _left(torch.stack([frames[pair].double() for frames in each]), weight, basis)[lit]
            for each in ([level.first for level in group], [level.second for level in group])
        )
        kept = (u.abs() < _RARE * _width(u)) & (v.abs() < _RARE * _width(v))
        products.append((u * v * kept).sum(0))
        powers += 0.5 * float(((u.square() + v.square()) * kept).sum())
    product = torch.stack(products)
    evidence = strongest([[studentised(product)]], sides=2)
    share, error = float(product.sum()) / powers, math.sqrt(float(product.square().sum())) / powers
    inside = min(max(share, -0.9), 0.9)
    lost = math.log((1 + inside) / (1 - inside) ** 2)
    sound = probably_sound(pairs * int(lit.sum()) * group[0].first[0].numel())
    width = max(3 * error, 1e-9)
    hidden = [Hidden("lag", lost, width, _KEPT, gain=1.0, noise=0.5, positive=True, sound=sound)]
    sentence = f"{share:.1%} of the noise of a frame persists in the next frame, as by lag"
    passed = f"the noise of a frame does not persist in the next frame ({share:.2%} ± {error:.2%})"
    return [bounded("no lag", evidence, hidden, sentence, passed)]


def _comparable(levels: Sequence[Level]) -> list[Level]:
    """Return the levels of frames of the most frequent shape, up to the level of the greatest variance."""
    shapes = [level.apart.shape[1:] for level in levels]
    common = max(shapes, key=shapes.count)
    top = max(levels, key=lambda level: level.variance).mean
    chosen = zip(levels, shapes, strict=True)
    return [level for level, shape in chosen if shape == common and (level.dark or level.mean <= top)]


def _patterns(levels: Sequence[Level]) -> Tensor:
    """Return the size (level, part) of each part of a pattern in each level, with as many parts as levels allow."""
    offset = min((level.mean for level in levels), default=0.0)
    signal = torch.tensor([level.mean - offset for level in levels], dtype=torch.float64)
    exposure = torch.tensor([level.exposure for level in levels], dtype=torch.float64)
    dark = torch.tensor([level.dark for level in levels])
    parts = [torch.ones_like(signal)]
    if not bool(dark.all()):
        parts.append(signal / signal.max().clamp_min(1e-12))
    if int((~dark).sum()) >= _CURVED:
        parts.append(parts[-1].square())
    times = exposure[dark] if bool(dark.any()) else exposure
    if len(set(times.tolist())) > 1:
        parts.append(exposure / exposure.max())
    return torch.stack(parts[: max(1, len(levels) - _LEAST + 1)], 1)


def _left(frames: Tensor, weight: Tensor, basis: Tensor) -> Tensor:
    """Return frames (level, y, x) over their standard deviations, without patterns and without means of lines."""
    flat = weight[:, None] * without_lines(frames).flatten(1)
    return (flat - basis @ (basis.T @ flat)).view_as(frames)


def _width(x: Tensor) -> Tensor:
    """Return a robust standard deviation (level, 1, 1) of each level."""
    return 1.4826 * x.abs().flatten(1).median(1).values[:, None, None] + 1e-9
