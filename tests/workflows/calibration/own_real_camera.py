"""A real camera in NumPy alone: it shares no line with the project, whose calibration it judges.

A lens that vignettes, a lamp that flickers from frame to frame and drifts from level to level,
pixels that differ in gain, offset and read noise, hot pixels, a well of its own, and a converter.
What a camera may do to its numbers afterwards (smoothing, lag, compression, interpolation of
colours) is planted by name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

#: luminance table of ITU-T T.81, annex K.1
LUMINANCE = np.array([
    [16, 11, 10, 16, 24, 40, 51, 61],
    [12, 12, 14, 19, 26, 58, 60, 55],
    [14, 13, 16, 24, 40, 57, 69, 56],
    [14, 17, 22, 29, 51, 87, 80, 62],
    [18, 22, 37, 56, 68, 109, 103, 77],
    [24, 35, 55, 64, 81, 104, 113, 92],
    [49, 64, 78, 87, 103, 121, 120, 101],
    [72, 92, 95, 98, 112, 100, 103, 99],
])  # fmt: skip


@dataclass
class Shot:
    """The frames of one light level."""

    name: str
    photons: float  #: mean of a pixel in one exposure, as the photometer of the laboratory has it
    exposure: float  #: s
    frames: np.ndarray  #: (frame, y, x) uint16


@dataclass
class RealCamera:
    """A monochrome camera on a test bench; by default nothing is wrong with it and little is
    real.
    """

    seed: int
    size: tuple[int, int] = (128, 128)  #: (y, x)
    gain: float = 0.25  #: DN/e-
    efficiency: float = 0.5
    read_noise: float = 6.0  #: e-, root mean square over the pixels
    read_spread: float = 0.0  #: relative standard deviation of the read noise over the pixels
    well: float = 14_000.0  #: e-
    well_spread: float = 0.0  #: relative standard deviation over the pixels
    offset: float = 100.0  #: DN
    bits: int = 12
    shift: int = 0  #: bits by which numbers are shifted to the left in the file
    lit: int = 16
    brightest: float = 1.1  #: electrons of the brightest level over the well
    dark_times: tuple[float, ...] = (0.005, 0.02, 0.1, 0.4)  #: s
    exposure: float = 0.005  #: s, of the lit levels
    frames: int = 2
    current: float = 20.0  #: e-/s
    prnu: float = 0.0
    dsnu: float = 0.0  #: e-
    vignetting: float = 0.0  #: fall of the light from the middle to the corners
    flicker: float = 0.0  #: relative standard deviation of the lamp from frame to frame
    lamp: float = 0.0  #: relative standard deviation of the lamp from level to level
    hot: float = 0.0  #: share of hot pixels
    hot_current: float = 20_000.0  #: e-/s, median of hot pixels
    bend: float = 0.0  #: share of the response that is missing at the well
    smoothing: float = 0.0  #: share of a pixel that is the mean of its 3 x 3 neighbourhood
    sharpening: float = 0.0
    lag: float = 0.0  #: share of a frame that stays in the next one
    quality: int = 0  #: of the compression of ITU-T T.81; 0 for none
    #: efficiency of red, green and blue over `efficiency`
    mosaic: tuple[float, float, float] | None = None
    demosaiced: bool = False  #: green of a mosaic, interpolated between four neighbours
    median: bool = False

    def shots(self) -> list[Shot]:
        """Expose all levels, the dark ones first."""
        self._random = np.random.default_rng(self.seed)
        rng = self._random
        y, x = (np.linspace(-1, 1, n) for n in self.size)
        radius = (y[:, None] ** 2 + x[None, :] ** 2) / 2
        self._light = 1 - self.vignetting * radius
        self._light /= self._light.mean()
        self._response = 1 + self.prnu * rng.standard_normal(self.size)
        self._response /= self._response.mean()
        self._fixed = self.dsnu * rng.standard_normal(self.size)
        width = np.sqrt(np.log1p(self.read_spread**2))
        self._read = np.exp(width * rng.standard_normal(self.size))
        self._read *= self.read_noise / np.sqrt(np.mean(self._read**2))
        self._wells = self.well * (1 + self.well_spread * rng.standard_normal(self.size))
        hot = rng.random(self.size) < self.hot
        self._current = self.current + hot * self.hot_current * np.exp(
            0.7 * rng.standard_normal(self.size)
        )
        self.hot_pixels = hot
        shots = [
            Shot(f"dark_{1e3 * t:g}ms", 0.0, t, self._exposed(0.0, t)) for t in self.dark_times
        ]
        for i in range(self.lit):
            photons = self.brightest * self.well / self.efficiency * (i + 1) / self.lit
            shots.append(
                Shot(f"lit_{i:02d}", photons, self.exposure, self._exposed(photons, self.exposure))
            )
        return shots

    def _exposed(self, photons: float, time: float) -> np.ndarray:
        level = 1 + self.lamp * self._random.standard_normal()
        before = self._electrons(photons * level, time) if self.lag else None
        frames = []
        for _ in range(self.frames):
            now = self._electrons(photons * level, time)
            if before is not None:
                now = (1 - self.lag) * now + self.lag * before
                before = now
            frames.append(self._converted(now))
        return np.stack(frames)

    def _electrons(self, photons: float, time: float) -> np.ndarray:
        lamp = 1 + self.flicker * self._random.standard_normal()
        mean = photons * lamp * self.efficiency * self._light * self._response * self._colours()
        return np.minimum(self._random.poisson(mean + self._current * time), self._wells)

    def _colours(self) -> np.ndarray:
        colours = np.ones(self.size)
        if self.mosaic is not None:
            red, green, blue = self.mosaic
            colours[:] = green
            colours[::2, ::2], colours[1::2, 1::2] = red, blue
        return colours

    def _converted(self, electrons: np.ndarray) -> np.ndarray:
        noisy = electrons + self._fixed + self._read * self._random.standard_normal(self.size)
        signal = self.gain * noisy
        signal = signal * (1 - self.bend * electrons / self.well) + self.offset
        if self.smoothing:
            signal = (1 - self.smoothing) * signal + self.smoothing * _box(signal)
        if self.sharpening:
            signal = (1 + self.sharpening) * signal - self.sharpening * _box(signal)
        if self.demosaiced:
            signal = _green(signal)
        if self.median:
            signal = np.median([np.roll(signal, s, (0, 1)) for s in _AROUND], 0)
        top = 2**self.bits - 1
        numbers = np.clip(np.rint(signal), 0, top)
        if self.quality:
            numbers = np.clip(
                np.rint(_compressed(numbers, self.quality, 2.0 ** (self.bits - 8))), 0, top
            )
        return numbers.astype(np.uint16) << self.shift

    def without(self, **changed: object) -> RealCamera:
        """Return a camera that differs by its fields."""
        return replace(self, **changed)


_AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]


def _box(picture: np.ndarray) -> np.ndarray:
    return np.mean([np.roll(picture, step, (0, 1)) for step in _AROUND], 0)


def _green(picture: np.ndarray) -> np.ndarray:
    """Keep the pixels of a checkerboard, and take the mean of four neighbours for the others."""
    four = np.mean(
        [np.roll(picture, step, (0, 1)) for step in ((0, 1), (0, -1), (1, 0), (-1, 0))], 0
    )
    rows, columns = np.indices(picture.shape)
    return np.where((rows + columns) % 2, picture, four)


def _compressed(picture: np.ndarray, quality: int, scale: float) -> np.ndarray:
    """Round the cosines of blocks of 8 x 8 pixels as JPEG does; ``scale`` is the step of a
    number of 8 bits.
    """
    factor = 5000 / quality if quality < 50 else 200 - 2 * quality
    steps = np.maximum(1, np.floor((LUMINANCE * factor + 50) / 100)) * scale
    k = np.arange(8)
    basis = np.cos(np.pi / 8 * k[:, None] * (k[None, :] + 0.5)) / 2
    basis[0] /= np.sqrt(2)
    high, wide = (n // 8 * 8 for n in picture.shape)
    blocks = picture[:high, :wide].reshape(high // 8, 8, wide // 8, 8).transpose(0, 2, 1, 3)
    cosines = np.rint(basis @ blocks @ basis.T / steps) * steps
    out = picture.astype(float).copy()
    out[:high, :wide] = (basis.T @ cosines @ basis).transpose(0, 2, 1, 3).reshape(high, wide)
    return out
