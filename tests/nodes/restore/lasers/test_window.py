"""The window around a candidate: a place has the same pixel in it and in the frame, at edges and
for odd sides too.
"""

import pytest
import torch

from neusee.nodes.restore.lasers._candidates import _COMPARED_SIDE, _window


@pytest.mark.parametrize("sides", [(640, 500), (641, 257), (90, 300)])
@pytest.mark.parametrize("share", [(0.0, 0.0), (0.49, -0.49), (-0.37, 0.21)])
def test_a_place_has_the_same_pixel_in_the_window_and_in_the_frame(sides, share):
    # pixels from the middle, n // 2
    place = tuple(round(part * n) for part, n in zip(share, sides, strict=True))
    frame = torch.zeros(3, *sides)
    frame[:, place[0] + sides[0] // 2, place[1] + sides[1] // 2] = 1.0
    window, middle = _window(frame, place)
    inside = frame[..., *window]
    assert inside.shape[-2:] == tuple(min(n, _COMPARED_SIDE) for n in sides)
    y, x = (at - m + n // 2 for at, m, n in zip(place, middle, inside.shape[-2:], strict=True))
    assert float(inside[0, y, x]) == 1.0
