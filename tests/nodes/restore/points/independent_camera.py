"""A camera in NumPy that shares no line with the package: a PSF that changes over the field,
points, noise, clipping.

The PSF is a sum of Gaussians, each integrated over the area of a pixel in closed form. One of them
moves with the place in the field, one with the colour.
"""

import numpy as np
from scipy.signal import fftconvolve
from scipy.special import erf

GAIN, OFFSET, READ, FULL = 2.0, 50.0, 4.0, 20000.0  # DN/e-, e-, e-, e- without offset
CAMERA = {
    "gain": GAIN,
    "offset": OFFSET,
    "full_well": FULL + OFFSET,
    "read_noise": READ,
    "bits": 16,
}
COLOURS = (1.0, 0.8, 0.6)


def over_pixel(at, deviation):
    """Integrate a Gaussian of area 1 over the pixel whose middle is ``at`` from its middle."""
    edge = deviation * np.sqrt(2)
    return (erf((at + 0.5) / edge) - erf((at - 0.5) / edge)) / 2


def spread(down, right, field, channel, lobe=0.13, far=2.2):
    """Give the share of the light at a distance from a point at ``field``, which runs from -0.5
    to 0.5 of the frame.
    """
    v, u = field
    sharp = 1.15 + 0.05 * channel
    parts = (
        (0.93 - lobe, 0.0, 0.0, sharp, sharp),
        (lobe, 0.7 * far * v + 0.8, far * u + 0.1 * channel, 2.0, 2.4),
        (0.07, 0.0, 0.0, 4.0, 4.0),
    )
    return sum(
        share * over_pixel(down - y, sy) * over_pixel(right - x, sx)
        for share, y, x, sy, sx in parts
    )


def place_in(place, shape):
    return tuple((p + 0.5) / n - 0.5 for p, n in zip(place, shape, strict=True))


def numbers(light, rng, dark=0.0):
    """Draw photons, add read noise and offset, cut at the well, and round to whole digital
    numbers.
    """
    electrons = rng.poisson(light) + rng.normal(0, READ, light.shape) + dark
    return np.clip(np.round((np.minimum(electrons, FULL) + OFFSET) * GAIN), 0, 65535).astype(
        np.uint16
    )


def points(rng, shape, places, signals, ground=5.0, dark=0.0, channels=3, **kind):
    """Take a frame of points of ``signals`` electrons at subpixel places."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    light = np.full((channels, *shape), ground)
    for place, signal in zip(places, signals, strict=True):
        for channel in range(channels):
            seen = spread(y - place[0], x - place[1], place_in(place, shape), channel, **kind)
            light[channel] += signal * COLOURS[channel] * seen
    return numbers(light, rng, dark)


def centred(field, window, **kind):
    """Give the true PSF (channel, y, x) of sum 1, the centre of its squared mean shifted into
    the middle pixel.
    """
    y, x = (np.arange(n) - n // 2 for n in window)
    shift = np.zeros(2)
    for _ in range(30):
        kernel = np.stack(
            [spread(y[:, None] - shift[0], x - shift[1], field, c, **kind) for c in range(3)]
        )
        power = kernel.mean(0) ** 2
        shift = shift - np.array([(power.sum(1) * y).sum(), (power.sum(0) * x).sum()]) / power.sum()
    return kernel / kernel.sum((1, 2), keepdims=True)


def blurred(scene, shape, block=5, reach=16, **kind):
    """Blur a scene (channel, y, x), wider than ``shape`` by the same rim on all sides, with the
    PSF of each block.
    """
    rim = (scene.shape[1] - shape[0]) // 2
    side = np.arange(-reach, reach + 1)
    wide = np.zeros((len(scene), *(n + 2 * reach for n in scene.shape[1:])))
    for top in range(0, scene.shape[1], block):
        for left in range(0, scene.shape[2], block):
            field = place_in((top + (block - 1) / 2 - rim, left + (block - 1) / 2 - rim), shape)
            for channel, plane in enumerate(scene):
                kernel = spread(side[:, None], side, field, channel, **kind)
                light = fftconvolve(plane[top : top + block, left : left + block], kernel)
                wide[channel, top : top + light.shape[0], left : left + light.shape[1]] += light
    cut = reach + rim
    return np.maximum(wide[:, cut : cut + shape[0], cut : cut + shape[1]], 0)
