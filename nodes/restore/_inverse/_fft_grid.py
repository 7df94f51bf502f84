"""Size of the periodic grid on which a picture is deblurred: unknown pixels around the picture, and fast FFTs."""

import math

from neusee.nodes.restore._inverse._masked_blur import Size

DENSE = 20  #: pixels a side, up to which a picture is solved exactly


def torus(picture: Size, edge: Size) -> Size:
    """Return the size of a periodic grid for the picture and `edge` unknown pixels on each side."""
    whole = 2 ** halvings(picture)
    y, x = (whole * _smooth(-(-(n + 2 * e) // whole)) for n, e in zip(picture, edge, strict=True))
    return y, x


def _smooth(n: int) -> int:
    """Return the least whole number of at least ``n`` without prime factors above 7, for which FFTs are fast."""
    while 210**32 % n:
        n += 1
    return n


def halvings(picture: Size) -> int:
    """Return how often the grid of a picture is halved until the picture is small enough to be solved exactly."""
    return max(0, math.ceil(math.log2(max(picture) / DENSE)))
