"""A camera in NumPy alone, which shares no code with the nodes, and faults that can be planted in
its frames.

``Camera(seed, **faults).levels()`` gives (name, photons, exposure, frames) of darks and lit levels.
Faults are numbers or arrays by the names of `FAULTS`; without one the camera is clean: Poisson
light, Gaussian read noise, rounding.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.fft import dctn, idctn

FAULTS = {
    "mixing": "share of a pixel that its four neighbours give and take",
    "dsnu": "e-, pixels in the dark",
    "prnu": "relative, pixels in light",
    "lag": "share of a frame that stays in the next",
    "telegraph": "share of the pixels with jumps of 60 e-",
    "stuck": "bit that is always 0",
    "black": (
        "standard deviations of the dark above its mean at which the black is cut, and set to 0"
    ),
    "rows": "e-, noise that a whole row shares",
    "columns": "e-, noise that a whole column shares",
    "coloured": (
        "share of the read noise of a pixel that the next pixel of its row has with the other sign"
    ),
    "compression": "DN, step of the cosines of blocks of 8 x 8 pixels",
    "drift": "relative change of the lamp within a pair",
    "lamp": "relative scatter of the lamp from level to level",
    "hot": "share of the pixels with 2000 e-/s of dark current",
    "knee": "share of the range above which the response is a half",
    "truncation": "1 for numbers that are cut, not rounded",
    "uneven": "relative difference of the light from side to side",
}


@dataclass
class Camera:
    """A camera of 12 bits, 0.125 DN/e-, 8 e- of read noise, and half an electron a photon."""

    seed: int
    size: int = 96
    lit: int = 12
    darks: int = 4
    gain: float = 0.125
    noise: float = 8.0
    efficiency: float = 0.5
    offset: float = 100.0
    bits: int = 12
    frames: int = 2
    faults: dict = field(default_factory=dict)

    def levels(self):
        """Frames of all levels, as (name, photons, exposure, (frame, y, x) int32)."""
        rng = np.random.default_rng(self.seed)
        shape = (self.size, self.size)
        self._dsnu = self._of("dsnu") * rng.standard_normal(shape)
        self._prnu = 1 + self._of("prnu") * rng.standard_normal(shape)
        self._prnu *= 1 + self._of("uneven") * np.linspace(-0.5, 0.5, self.size)
        self._hot = 2000 * (rng.random(shape) < self._of("hot"))
        self._jumping = rng.random(shape) < self._of("telegraph")
        brightest = 0.85 * (2**self.bits - 1 - self.offset) / self.gain / self.efficiency
        found = []
        for i in range(self.darks + self.lit):
            dark = i < self.darks
            photons = 0.0 if dark else brightest * (i - self.darks + 1) / self.lit
            exposure = 1e-3 * 10 ** (i / 2) if dark else 1e-3
            name = f"dark {i}" if dark else f"lit {i - self.darks}"
            found.append((name, photons, exposure, self._stack(rng, photons, exposure)))
        return found

    def _of(self, name):
        return float(self.faults.get(name, 0.0))

    def _stack(self, rng, photons, exposure):
        light = photons * (1 + self._of("lamp") * rng.standard_normal())
        steps = 1 + self._of("drift") * np.arange(self.frames)
        mean = self.efficiency * light * self._prnu
        before = self._electrons(rng, mean, exposure)
        stack = []
        for step in steps:
            electrons = self._electrons(rng, mean * step, exposure)
            electrons = (1 - self._of("lag")) * electrons + self._of("lag") * before
            stack.append(self._numbers(rng, electrons))
            before = electrons
        return np.stack(stack)

    def _electrons(self, rng, mean, exposure):
        shape = (self.size, self.size)
        electrons = rng.poisson(mean + (5 + self._hot) * exposure) + self.noise * self._read(
            rng.standard_normal(shape)
        )
        electrons += self._dsnu + 60 * (self._jumping & (rng.random(shape) < 0.5))
        electrons += self._of("rows") * rng.standard_normal((self.size, 1))
        return electrons + self._of("columns") * rng.standard_normal((1, self.size))

    def _read(self, white):
        share = self._of("coloured")
        return (white - share * np.roll(white, 1, 1)) / np.sqrt(1 + share**2)

    def _numbers(self, rng, electrons):
        m = self._of("mixing")
        if m:
            around = sum(np.roll(electrons, step, axis) for step in (1, -1) for axis in (0, 1)) / 4
            electrons = (1 - m) * electrons + m * around
        y, top = self.gain * electrons, 2.0**self.bits - 1 - self.offset
        if "knee" in self.faults:
            knee = self._of("knee") * top
            y = np.where(y > knee, knee + (y - knee) / 2, y)
        y = y + self.offset
        if self._of("compression"):
            y = self._compressed(y)
        number = np.floor(y) if self._of("truncation") else np.rint(y)
        if "black" in self.faults:
            number = number - np.rint(self.offset + self._of("black") * self.gain * self.noise)
        number = np.clip(number, 0, 2**self.bits - 1).astype(np.int32)
        if "stuck" in self.faults:
            number &= ~(1 << int(self.faults["stuck"]))
        return number

    def _compressed(self, y):
        n, step = self.size // 8, self._of("compression")
        blocks = y.reshape(n, 8, n, 8).transpose(0, 2, 1, 3)
        cosines = np.rint(dctn(blocks, axes=(2, 3), norm="ortho") / step) * step
        return idctn(cosines, axes=(2, 3), norm="ortho").transpose(0, 2, 1, 3).reshape(y.shape)
