"""Overexposed pictures of a point source, simulated in NumPy, and the posterior of their scatter without an engine."""

from functools import cache

import numpy as np
import torch

from neusee.nodes import calibrate
from neusee.nodes.calibrate._scatter._point_source import _Camera, reduce_rings
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.recipe.loading import load

CAMERA = {"gain": 0.5, "offset": 100.0, "full_well": 20000.0, "read_noise": 5.0, "bits": 14}
LENS = {"focal_length": 0.05, "diameter": 5e-3, "pixel_pitch": 5e-6, "wavelength": 550e-9}
TRUTH = {"b0": 15.0, "l": 0.004, "s": -2.5, "electrons": 3e9, "background": 0.0}
PRIOR = {"b0": (15.0, 1.5), "l": (0.004, 1.3), "s": (-2.5, 0.2), "electrons": (3e9, 1.05), "background": (0.0, 5.0)}


def picture(truth, draw, size=128, centre=None):
    """Simulate the digital numbers of one exposure: the wing of a round aperture, and scatter, on 9 points a pixel."""
    b0, l, s, electrons, background = (truth[name] for name in TRUTH)  # noqa: E741
    y0, x0 = centre or ((size - 1) / 2, (size - 1) / 2)
    pitch, focal, mean = LENS["pixel_pitch"], LENS["focal_length"], np.zeros((size, size))
    total = 2 * np.pi * b0 * ((l**2 + 1) ** (s / 2 + 1) - l ** (s + 2)) / (l**s * (s + 2))
    fringe = LENS["wavelength"] * focal / LENS["diameter"] / pitch
    for dy in (-1 / 3, 0, 1 / 3):
        for dx in (-1 / 3, 0, 1 / 3):
            square = (np.arange(size)[:, None] - y0 + dy) ** 2 + (np.arange(size)[None] - x0 + dx) ** 2
            scattered = b0 * (pitch / focal) ** 2 * (1 + square * (pitch / focal / l) ** 2) ** (s / 2)
            mean += ((1 - total) * fringe / np.pi**3 / np.maximum(square, 1) ** 1.5 + scattered) / 9
    light = draw.poisson(np.clip(electrons * mean + background, 0, 1e8))
    held = np.minimum(light + CAMERA["offset"] + draw.normal(0, CAMERA["read_noise"], light.shape), CAMERA["full_well"])
    return np.clip(np.round(held * CAMERA["gain"]), 0, 2 ** CAMERA["bits"] - 1)


def rings_of(frame, centre=None):
    return reduce_rings(frame[None].astype(float), _Camera(**CAMERA), centre)


@cache
def recipe():
    return load("calibrate_stray_light")


def problem_of(rings, prior=PRIOR):
    """Return the posterior of rings as `neusee calibrate` has it, with the node called directly."""
    held = {"core": 1.0, "scatter": 0.0}
    believed = calibrate.stray_prior(**prior)
    coordinates = calibrate.ScatterCoordinates.of(believed, {**TRUTH, **held})
    fixed = {**LENS, "gain": CAMERA["gain"], "read_noise": CAMERA["read_noise"], **coordinates.held}

    def weigh(parameters, told):
        named = {name.removeprefix("density."): x for name, x in parameters.items()}
        return {"density": calibrate.stray_light(rings, **fixed | named, told=told)}

    return SensorPosterior(
        recipe(), "density", "", coordinates, rings, lambda p: weigh(p, False), lambda p: weigh(p, True)
    )


def drawn_truth(coordinates, seed):
    drawn = coordinates.draw(1, torch.Generator().manual_seed(seed))
    return {**TRUTH, **{name: float(x) for name, x in drawn.items()}}
