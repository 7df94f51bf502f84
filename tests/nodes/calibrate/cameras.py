"""Real cameras, simulated: a lamp that drifts from level to level, pixels that differ, a
response that bends.
"""

import csv

import torch

from neusee.nodes.calibrate import levels, reduce
from neusee.nodes.values import Levels

COLUMNS = ("photons", "exposure_s", "pixels", "mean", "variance")
#: DN/e-, e- per photon, e-
TRUTH = {"gain": 0.25, "quantum_efficiency": 0.5, "temporal_dark_noise": 12.0}


def measured(
    seed, *, lit=30, darks=6, lamp=0.015, prnu=0.01, bent=0.0, power=3, size=96, **changed
):
    """Levels of pairs of frames: numbers are y (1 - bent (y/4095)**power) of y = K e + 60 DN, 12
    bit.
    """
    rng = torch.Generator().manual_seed(seed)
    truth = {**TRUTH, **changed}
    unlike = 1 + prnu * torch.randn(size, size, generator=rng, dtype=torch.float64)
    # photons: the last levels saturate
    brightest = 4300 / truth["gain"] / truth["quantum_efficiency"]
    parts = []
    for i in range(darks + lit):
        photons = 0.0 if i < darks else brightest * (i - darks + 1) / lit
        exposure = 1e-3 * (1 + 10 * i) if i < darks else 1e-3
        light = photons * (1 + lamp * float(torch.randn(1, generator=rng)))
        # e-, 40 e-/s in the dark
        mean = truth["quantum_efficiency"] * light * unlike + 40 * exposure
        frames = torch.stack([_frame(mean, rng, truth, bent, power) for _ in range(2)])
        parts.append(reduce(frames, photons=photons, exposure=exposure, scatter="temporal"))
    return levels(parts)


def _frame(mean, rng, truth, bent, power):
    electrons = torch.poisson(mean, generator=rng)
    electrons += truth["temporal_dark_noise"] * torch.randn(
        mean.shape, generator=rng, dtype=torch.float64
    )
    y = truth["gain"] * electrons
    y = y * (1 - bent * (y.clamp_min(0) / 4095) ** power)
    return (y + 60).round().clamp(0, 4095)


def written(found, file):
    """A table of levels; of numbers that are piled up it says no more than the moments."""
    with file.open("w", newline="") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        writer.writerow(COLUMNS)
        rows = torch.stack(
            [found.photons, found.exposure, found.pixels / 2, found.mean, found.variance], 1
        )
        for photons, exposure, pixels, mean, variance in rows.tolist():
            writer.writerow(
                [f"{photons:.2f}", f"{exposure:.4g}", int(pixels), f"{mean:.6f}", f"{variance:.6f}"]
            )
    return file


def tabled(seed, file, *, pixels, lamp=0.015, bent=0.0, power=3, lit=26, darks=6):
    """A table of moments as frames of so many pixels would give them, drawn from their own laws."""
    rng = torch.Generator().manual_seed(seed)
    gain, efficiency, noise = (
        TRUTH[name] for name in ("gain", "quantum_efficiency", "temporal_dark_noise")
    )
    photons = torch.cat([torch.zeros(darks), torch.linspace(1000, 29000, lit)]).double()
    exposure = torch.cat([1e-3 + 1e-2 * torch.arange(darks), torch.full((lit,), 1e-3)]).double()
    normal = (torch.randn(darks + lit, generator=rng, dtype=torch.float64) for _ in range(3))
    electrons = efficiency * photons * (1 + lamp * next(normal)) + 40 * exposure
    short = bent * (gain * electrons / 4095) ** power
    variance = (gain * (1 - (power + 1) * short)) ** 2 * (noise**2 + electrons) + 1 / 12
    mean = 60 + gain * electrons * (1 - short) + next(normal) * (variance / (2 * pixels)).sqrt()
    one = torch.full_like(mean, pixels)
    variance = variance * (1 + next(normal) * (2 / pixels) ** 0.5)
    none = torch.zeros(0, dtype=torch.float64)
    return written(
        Levels(photons, exposure, 2 * one, mean, variance, one, none.long(), none, none), file
    )
