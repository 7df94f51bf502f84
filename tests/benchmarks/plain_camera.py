"""A camera in NumPy alone for simulation-based calibration: no code of the nodes, frames pixel by
pixel.

``frames`` simulates the pixels of one level; ``table`` writes means and temporal variances of pairs
for the recipe `calibrate_camera`; ``frames_recipe`` writes the frames themselves, and a recipe of
`calibrate.density`. The response bends by bend and twist, y = K e (1 + bend x + twist x**2), with x
= y / top, or by a cube, which is none of the models of the response.
"""

import csv
from dataclasses import dataclass

import numpy as np


@dataclass
class PlainCamera:
    """Constants of a camera and its laboratory; the defaults are an ideal camera of 12 bits."""

    gain: float = 0.25  #: DN/e-
    quantum_efficiency: float = 0.5
    dark_signal: float = 60.0  #: DN, of the shortest exposure
    temporal_dark_noise: float = 12.0  #: e-
    dark_current: float = 40.0  #: e-/s
    scatter: float = 0.0  #: relative scatter of the variances from level to level
    lamp: float = 0.0  #: relative scatter of the light from level to level
    drift: float = 0.0  #: DN, scatter of the dark signal from level to level
    bend: float = 0.0
    twist: float = 0.0
    cube: float = 0.0  #: share by which a cubic response falls short at the largest number
    truncates: bool = False  #: numbers are cut and not rounded
    well: float = np.inf  #: e-, of the electrons before read noise
    full: float = np.inf  #: e-, of electrons, offset and read noise together
    first: float = 1e-3  #: s, exposure that counts as none for the dark current
    top: float = 2750.0  #: DN above the dark, of the brightest level that is used
    bits: int = 12

    def frames(self, rng, photons, exposure, size=96, count=2):
        """Frames (frame, y, x) of one level as whole numbers."""
        light = photons * (1 + self.lamp * rng.standard_normal())
        mean = self.quantum_efficiency * light + self.dark_current * (exposure - self.first)
        shape = (count, size, size)
        electrons = np.minimum(rng.poisson(max(mean, 0.0), shape), self.well)
        electrons = electrons + self.temporal_dark_noise * rng.standard_normal(shape)
        electrons = np.minimum(electrons, self.full)
        centre = electrons.mean()
        electrons = centre + (electrons - centre) * np.exp(
            0.5 * self.scatter * rng.standard_normal()
        )
        y = self._response(electrons) + self.dark_signal + self.drift * rng.standard_normal()
        number = np.floor(y) if self.truncates else np.rint(y)
        return np.clip(number, 0, 2**self.bits - 1).astype(np.int64)

    def _response(self, electrons):
        line = self.gain * electrons
        if self.cube:
            return line * (1 - self.cube * (np.maximum(line, 0) / (2**self.bits - 1)) ** 3)
        y = line
        for _ in range(8):  # a contraction, for terms of a few percent
            x = y / self.top
            y = line * (1 + self.bend * x + self.twist * x**2)
        return y

    def series(self, lit=20, darks=6, beyond=1.6):
        """Photons and exposures of dark levels up to 0.1 s, and of lit levels up to ``beyond``
        times the used range.
        """
        dark = [(0.0, 1e-3 + 0.02 * i) for i in range(darks)]
        brightest = self.top / self.gain / self.quantum_efficiency
        return dark + [(brightest * beyond * (i + 1) / lit, 1e-3) for i in range(lit)]


def moments(stack):
    """Mean and temporal variance of a pair, without the difference of the means (EMVA 1288,
    6.6), in integers.
    """
    a, b = stack[0].astype(float), stack[1].astype(float)
    apart = a - b
    return stack.mean(), 0.5 * ((apart**2).mean() - apart.mean() ** 2) * apart.size / (
        apart.size - 1
    )


def table(camera, seed, file, *, size=96, **series):
    """Write the table of one measurement for the recipe `calibrate_camera`; return the path."""
    rng = np.random.default_rng(seed)
    with open(file, "w", newline="") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        writer.writerow(["photons", "exposure_s", "pixels", "mean", "variance"])
        for photons, exposure in camera.series(**series):
            mean, variance = moments(camera.frames(rng, photons, exposure, size=size))
            writer.writerow(
                [
                    repr(float(photons)),
                    repr(float(exposure)),
                    size * size,
                    repr(float(mean)),
                    repr(float(variance)),
                ]
            )
    return file


RECIPE = """# A measurement with the camera of a benchmark: pixels alike, frames from files.
defaults: []
rounding: nearest
sensor: {gain: 0.25 DN/e-, offset: 240 e-, read_noise: 12 e-, dark_current: 40 e-, full_well: 14000 e-,
         quantum_efficiency: 0.5, bits: 12}
steps:
  frames: {node: calibrate.frames, each: levels, with: {files: "${item.files}"}}
  level:
    node: calibrate.reduce
    each: levels
    from: frames
    with: {photons: "${item.photons}", exposure: "${item.exposure}"}
  levels: {node: calibrate.levels, from: level}
  sufficient: {node: calibrate.sufficient, from: levels}
  prior:
    node: calibrate.prior
    with:
      gain: ["${sensor.gain}", 2]
      offset: ["${sensor.offset}", 100 e-]
      read_noise: ["${sensor.read_noise}", 2]
      dark_current: ["${sensor.dark_current}", 10]
      full_well: ["${sensor.full_well}", 2]
      quantum_efficiency: ["${sensor.quantum_efficiency}", 2]
  density:
    node: calibrate.density
    from: {levels: sufficient}
    with:
      gain: "${sensor.gain}"
      quantum_efficiency: "${sensor.quantum_efficiency}"
      offset: "${sensor.offset}"
      read_noise: "${sensor.read_noise}"
      dark_current: "${sensor.dark_current}"
      dark_exposure: 1 s
      full_well: "${sensor.full_well}"
      arrivals: poisson
      rounding: "${rounding}"
      bits: "${sensor.bits}"
outputs: [levels, density]
levels:
"""


def frames_recipe(camera, seed, folder, *, size=96, **series):
    """Write the frames of one measurement as .npy and a recipe that reads them; return the path
    of the recipe.
    """
    rng, text = np.random.default_rng(seed), RECIPE
    for i, (photons, exposure) in enumerate(camera.series(**series)):
        path = folder / f"level_{i:02d}.npy"
        np.save(path, camera.frames(rng, photons, exposure, size=size))
        text += (
            f"  l{i:02d}: {{files: {path}, photons: {float(photons)!r}, exposure:"
            f" {float(exposure)!r} s}}\n"
        )
    recipe = folder / "measurement.yaml"
    recipe.write_text(text)
    return recipe
