"""Draw recipes/samples/night.exr again, bit for bit: a wet street at night, scene-linear, for high
dynamic range.

    python tests/nodes/scene/make_night.py recipes/samples/night.exr

Only +, -, *, / and square roots of float64 go into it, so that every machine rounds alike.
"""

import sys
from pathlib import Path

import numpy as np

SIZE = 384
HORIZON = 214
LAMPS = (
    (58, 96, 320.0, 5.0),
    (98, 176, 130.0, 3.4),
    (250, 176, 90.0, 3.0),
    (318, 84, 480.0, 6.0),
)  # x, y, peak, radius
SODIUM = np.array([1.0, 0.58, 0.20])
WINDOW = np.array([1.0, 0.72, 0.38])
SKY = np.array([0.25, 0.42, 1.0])
STONE = np.array([0.9, 0.85, 1.0])


def night() -> np.ndarray:
    """The picture, (y, x, 3) float16, linear sRGB."""
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    upper = sky(y) + houses(y, x) + lamps(y, x)
    return coarse(np.where((y < HORIZON)[..., None], upper, road(y, x, upper)).astype(np.float16))


def coarse(light: np.ndarray) -> np.ndarray:
    """Round to 7 of the 10 bits of the mantissa, steps of 0.8 %, so that the file stays small."""
    return ((light.view(np.uint16) + np.uint16(4)) & np.uint16(0xFFF8)).view(np.float16)


def sky(y: np.ndarray) -> np.ndarray:
    """A sky that brightens towards the horizon."""
    return ((0.002 + 0.010 * (y / HORIZON) * (y / HORIZON))[..., None]) * SKY


def houses(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Two rows of houses with windows, some of them lit."""
    result = np.zeros((SIZE, SIZE, 3))
    for block, (left, right, roof) in enumerate(
        ((0, 92, 40), (92, 150, 84), (236, 296, 96), (296, 384, 28))
    ):
        wall = (x >= left) & (x < right) & (y >= roof) & (y < HORIZON)
        result[wall] = 0.012 * STONE
        column, row = (x - left - 8) % 20, (y - roof - 12) % 26
        number = np.floor((x - left - 8) / 20) * 7 + np.floor((y - roof - 12) / 26) * 3 + block
        whole = (x - column + 11 <= right - 4) & (y - row + 15 <= HORIZON - 4)
        pane = wall & whole & (column < 11) & (row < 15) & (x >= left + 8) & (y >= roof + 12)
        bar = (np.abs(column - 5) < 0.6) | (np.abs(row - 7) < 0.6)
        result[pane] = 0.004 * SKY
        lit = pane & ((number % 3 == 0) | (number % 7 == 2)) & ~bar
        result[lit] = ((2.0 + number % 5)[..., None] * WINDOW)[lit]
    return result


def lamps(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Street lamps on posts: a bright head, and the haze around it."""
    result = np.zeros((SIZE, SIZE, 3))
    for column, row, peak, radius in LAMPS:
        away = (x - column) * (x - column) + (y - row) * (y - row)
        head = np.clip(radius + 0.5 - np.sqrt(away), 0.0, 1.0) * peak
        haze = 0.0012 * peak * (radius * radius) / (away / 9.0 + radius * radius)
        post = (np.abs(x - column) < radius / 4) & (y > row) & (y < HORIZON)
        result += (head + haze * ~post)[..., None] * SODIUM
    return result


def road(y: np.ndarray, x: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Wet asphalt: what stands above it, mirrored, drawn out towards the viewer and broken up by
    ripples.
    """
    depth = np.maximum(y - HORIZON, 0.0)
    grain = scattered(y, x) - 0.5
    rows = np.arange(SIZE)
    total = np.zeros((SIZE, SIZE, 3))
    # the slopes of the ripples smear the mirror image upwards and a little sideways
    for step in range(25):
        slope = (step - 12) / 12.0
        source = np.clip(
            HORIZON - 1 - depth * (1.0 + 0.55 * slope) - 6.0 * grain, 0, HORIZON - 1
        ).astype(int)
        across = np.clip(rows[None, :] + slope * 2.0 * grain + 0.0 * y, 0, SIZE - 1).astype(int)
        total += upper[source, across] * (1.0 - slope * slope)
    gloss = 0.030 + 0.10 / (1.0 + depth / 24.0)
    asphalt = 0.010 * (1.0 + 0.8 * grain)
    pools = sum(
        (
            0.0010 * p / (1.0 + ((x - c) * (x - c) + 6.0 * depth * depth) / 2500.0)
            for c, _, p, _ in LAMPS
        ),
        0.0 * x,
    )
    marks = (np.abs(x - SIZE / 2) < 2.0 + depth / 30.0) & (depth % 44.0 < 4.0 + depth / 6.0)
    paint = np.where(marks, 5.0, 1.0)
    lit = (pools * (0.5 + 0.5 * grain))[..., None] * SODIUM
    return (
        gloss[..., None] * total / 16.0 + (asphalt[..., None] * SKY + lit * 0.35) * paint[..., None]
    )


def scattered(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Noise in [0, 1) from whole numbers alone, wider across than along."""
    cell = (np.floor(x / 3) * 374761393 + np.floor(y / 2) * 668265263).astype(
        np.uint64
    ) & np.uint64(0xFFFFFFFF)
    cell = ((cell ^ (cell >> np.uint64(13))) * np.uint64(1274126177)) & np.uint64(0xFFFFFFFF)
    return ((cell ^ (cell >> np.uint64(16))) & np.uint64(0xFFFF)).astype(np.float64) / 65536.0


def write(path: Path) -> None:
    import OpenEXR

    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290),
        "comments": "A wet street at night, drawn by tests/nodes/scene/make_night.py; CC0 1.0",
    }
    OpenEXR.File(header, {"RGB": night()}).write(str(path))


if __name__ == "__main__":
    write(Path(sys.argv[1]))
