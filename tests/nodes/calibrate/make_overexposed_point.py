"""Draw recipes/samples/overexposed_point.png again: a point source of 540 to 560 nm behind a lens
that scatters.

    python tests/nodes/calibrate/make_overexposed_point.py recipes/samples/overexposed_point.png

The core is the Airy pattern of f/10 by SciPy's Bessel function at nine wavelengths, on 10 x 10
points of a pixel.
"""

import sys

import numpy as np
from PIL import Image
from scipy.special import j1

SIZE, PITCH, FOCAL, DIAMETER = 192, 5e-6, 50e-3, 5e-3
WAVES = 550e-9 + np.linspace(-10e-9, 10e-9, 9)
ELECTRONS, B0, WIDTH, SLOPE = 3e9, 15.0, 4e-3, -2.5
GAIN, OFFSET, READ_NOISE, WELL, BITS = 0.5, 100, 5, 20000, 14


def mean_light():
    """Return the mean electrons of each pixel."""
    core, scattered = np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE))
    points, line = (np.arange(10) + 0.5) / 10 - 0.5, np.arange(SIZE) - SIZE // 2
    for y in points:
        for x in points:
            radius = np.hypot((line + y)[:, None], (line + x)[None]) * PITCH
            scattered += (1 + (radius / FOCAL / WIDTH) ** 2) ** (SLOPE / 2) / 100
            for wave in WAVES:
                v = np.pi * radius * DIAMETER / (wave * FOCAL)
                core += (
                    (2 * j1(v) / v) ** 2
                    * np.pi
                    / 4
                    * (PITCH * DIAMETER / (wave * FOCAL)) ** 2
                    / 900
                )
    edge = (WIDTH**2 + 1) ** ((SLOPE + 2) / 2) - WIDTH ** (SLOPE + 2)
    total = 2 * np.pi * B0 * edge / (WIDTH**SLOPE * (SLOPE + 2))
    return ELECTRONS * ((1 - total) * core + B0 * (PITCH / FOCAL) ** 2 * scattered)


def main(path):
    draw = np.random.default_rng(20261)
    light = (
        draw.poisson(np.minimum(mean_light(), 1e9))
        + OFFSET
        + draw.normal(0, READ_NOISE, (SIZE, SIZE))
    )
    numbers = np.clip(np.round(np.minimum(light, WELL) * GAIN), 0, 2**BITS - 1)
    Image.fromarray(numbers.astype(np.uint16)).save(path, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1])
