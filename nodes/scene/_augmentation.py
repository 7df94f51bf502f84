"""Changes of photographs that give a training more scenes: symmetries of the square, sharpness,
exposure and colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from neusee.nodes.resampling import resize


@dataclass(frozen=True)
class Change:
    """One drawn change of a photograph; the default changes nothing."""

    quarters: int = 0  #: quarter turns, counter-clockwise
    stops: float = 0.0  #: a scene of 2**stops times the light
    saturation: float = 1.0  #: of the colours; 0 is grey
    #: factor by which a part of the photograph becomes larger, and so less sharp
    enlarged: float = 1.0

    @classmethod
    def drawn(
        cls,
        seed: tuple[int, ...],
        turned: bool,
        darker: float,
        colour: float,
        enlarged: float = 1.0,
    ) -> Change:
        """Return the change that a seed draws, at most ``darker`` stops darker and with a
        saturation of 1 ± ``colour``.

        The factor of size is drawn by its logarithm from 1 to ``enlarged``. If ``turned``, the
        number of quarter turns is drawn from 0 to 3; with a mirror these are the eight symmetries.
        """
        rng = np.random.default_rng(seed)
        quarters, stops, saturation = (
            int(rng.integers(4)),
            -float(rng.random()),
            2.0 * float(rng.random()) - 1.0,
        )
        factor = enlarged ** float(rng.random())
        return cls(quarters if turned else 0, darker * stops, 1.0 + colour * saturation, factor)

    def frame(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Return the rows and columns of a photograph that this change turns into a picture of
        ``shape``.
        """
        rows, columns = (max(1, round(side / self.enlarged)) for side in shape)
        # an odd number of quarter turns exchanges rows and columns
        return (columns, rows) if self.quarters % 2 else (rows, columns)

    def of(self, picture: Tensor, shape: tuple[int, int]) -> Tensor:
        """Change a picture (3, y, x) in linear sRGB from 0 to 1 of the size of `frame`: colours,
        light, place and size.

        The result has the rows and columns ``shape``; bicubic interpolation of a part enlarges it,
        without negatives. The saturation is that of kornia: each encoded colour moves along the
        line to the grey of its luma (ITU-R BT.601), and is clipped to the range from 0 to 1. The
        random augmentations of kornia draw from the one random stream of torch, whereas these
        values are given.
        """
        if self.saturation != 1.0:
            picture = _saturated(picture, self.saturation)
        if self.stops:
            picture = picture * 2.0**self.stops
        picture = picture.rot90(self.quarters, (-2, -1)).contiguous() if self.quarters else picture
        return picture if picture.shape[-2:] == shape else resize(picture, *shape).clamp_min(0.0)


def _saturated(picture: Tensor, factor: float) -> Tensor:
    """Return a picture (3, y, x) in linear sRGB with the saturation of its colours multiplied by
    ``factor``.
    """
    from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
    from kornia.enhance import adjust_saturation_with_gray_subtraction

    # the saturation of kornia is defined for encoded sRGB
    saturated: Tensor = rgb_to_linear_rgb(
        adjust_saturation_with_gray_subtraction(linear_rgb_to_rgb(picture), factor)
    )
    return saturated


def symmetry(pictures: Tensor, seed: tuple[int, ...]) -> Tensor:
    """Turn and mirror pictures (..., y, x) by a symmetry that a seed draws: one of eight, or of
    four if y is not x.
    """
    rng = np.random.default_rng(seed)
    quarters, mirrored = int(rng.integers(4)), bool(rng.integers(2))
    if pictures.shape[-1] != pictures.shape[-2]:
        # only half turns keep the shape of a picture that is no square
        quarters -= quarters % 2
    turned = pictures.rot90(quarters, (-2, -1))
    return (turned.flip(-1) if mirrored else turned).contiguous()
