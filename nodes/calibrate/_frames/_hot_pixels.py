"""Hot pixels of a sensor, which collect far more dark current than the others."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._frames._level_frames import Divisor, refuse_unreadable, stack
from neusee.nodes.units import DataFiles

_FAR = 10.0  #: robust standard deviations of the pixels above their median from which a pixel is hot
_NORMAL = 1.4826  #: standard deviation of a normal distribution over its median absolute deviation
_MOST = 0.05  #: share of the pixels above which they are no exceptions


@node(rtol=0.0)
def hot_pixels(*, files: DataFiles, divisor: Divisor = 1) -> Tensor:
    """Find the hot pixels in dark frames of one exposure, the longest there is; `reduce` leaves them out.

    A hot pixel lies in each frame above the median of all pixels by more than 10 robust standard deviations of their
    means over the frames; a pixel that is merely noisy does so in some frames alone. Where more than 5 % of the pixels
    are hot, they are no exceptions, and none is hot.

    Shapes: -> (y, x) True for a hot pixel.
    Units:  none.
    Error:  no pixel is hot by chance; of pixels whose noise differs by 40 %, fewer than one in 10,000.
    Raises: ParameterError before the run for files that hold no raw frames; ValueError for frames that differ in size.
    Source: EMVA Standard 1288, release 4.0 Linear, section 8 (defect pixels); Hampel, J. Am. Stat. Assoc. 69, 383.
    """
    numbers = torch.from_numpy(stack(files)).double().div(divisor)
    mean = numbers.mean(0)
    middle = mean.median()
    # the mean of a few whole numbers is a multiple of a step, which hides a smaller deviation
    step = 1 / (12**0.5 * len(numbers))
    width = _NORMAL * float((mean - middle).abs().median()) + step
    hot: Tensor = numbers.amin(0) - middle > _FAR * width
    return hot if float(hot.double().mean()) <= _MOST else torch.zeros_like(hot)


@hot_pixels.preflight
def _(*, files: Any, **params: Any) -> list[str]:
    return refuse_unreadable("files", files)


@hot_pixels.check
def _(result: Tensor, **params: Any) -> list[Check]:
    count = int(result.sum())
    return [Check(f"{count} of {result.numel()} pixels are hot ({count / result.numel():.2%}), and left out")]
