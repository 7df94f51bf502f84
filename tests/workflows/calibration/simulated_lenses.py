"""Overexposed pictures of a point source, by NumPy and SciPy alone, and the posterior of their
scatter.
"""

from functools import cache

import numpy as np
from scipy.special import j1

from neusee.nodes import calibrate
from neusee.nodes.calibrate import PointCamera, reduce_rings
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.recipe.loading import load

CAMERA = {"gain": 0.5, "offset": 100.0, "full_well": 20000.0, "read_noise": 5.0, "bits": 14}
LENS = {"focal_length": 0.05, "diameter": 5e-3, "pixel_pitch": 5e-6, "wavelength": 550e-9}
TRUTH = {"b0": 15.0, "l": 0.004, "s": -2.5, "electrons": 3e9, "background": 0.0}
PRIOR = {"b0": (15.0, 1.5), "l": (0.004, 1.3), "s": (-2.5, 0.2), "electrons": (3e9, 1.05), "background": (0.0, 5.0),
         "scatter": (0.005, 3.0)}  # fmt: skip


POINTS = (np.arange(6) + 0.5) / 6 - 0.5  #: in a pixel, along each axis; at least six for a fringe


def airy_light(size, centre, lens, band=20e-9):
    """Return the share of the light in each pixel of a round aperture, mean over a band, on 36
    points a pixel.
    """
    radius = np.linspace(0, 1.5 * size, 60 * size) + 1e-9
    scale = (
        lens["diameter"]
        / (lens["wavelength"] + np.linspace(-0.5, 0.5, 9) * band)
        / lens["focal_length"]
    )
    scale *= lens["pixel_pitch"]
    v = np.pi * radius * scale[:, None]
    line = (np.pi / 4 * scale[:, None] ** 2 * (2 * j1(v) / v) ** 2).mean(0)
    return over_pixels(lambda r: np.interp(r, radius, line), size, centre)


def over_pixels(law, size, centre):
    """Return the mean of a function of the distance from the source, in pixels, over each pixel."""
    y, x = (np.arange(size) - c for c in centre)
    return (
        sum(law(np.hypot((y + dy)[:, None], (x + dx)[None])) for dy in POINTS for dx in POINTS)
        / len(POINTS) ** 2
    )


def scattered(b0, l, s, size, centre, scale):  # noqa: E741
    """Return what one surface scatters into each pixel, and in all; ``scale`` is the direction
    cosine of a pixel.
    """
    log = np.linspace(np.log(l) - 14, 0, 4001)
    ring = b0 * (1 + np.exp(2 * (log - np.log(l)))) ** (s / 2) * np.exp(2 * log)
    total = 2 * np.pi * ((ring[1:] + ring[:-1]) / 2 * np.diff(log)).sum()
    return (
        over_pixels(lambda r: scale**2 * b0 * (1 + (scale / l * r) ** 2) ** (s / 2), size, centre),
        total,
    )


def picture(truth, draw, size=128, centre=None, lens=LENS, more=(), band=20e-9):
    """Simulate the digital numbers of one exposure of a point source through a lens that scatters.

    Airy pattern of the band and scatter, both integrated over the pixels; photon noise, read noise,
    well, converter. ``more`` are further surfaces: b0, l, s and the radius of the beam on each, as
    a share of that of the pupil.
    """
    centre = centre or ((size - 1) / 2, (size - 1) / 2)
    light, left = np.zeros((size, size)), 1.0
    for *surface, beam in ((truth["b0"], truth["l"], truth["s"], 1.0), *more):
        veil, total = scattered(
            *surface, size, centre, lens["pixel_pitch"] / lens["focal_length"] / beam
        )
        light, left = light + left * veil, left * (1 - total)
    mean = (
        truth["electrons"] * (left * airy_light(size, centre, lens, band) + light)
        + truth["background"]
    )
    electrons = (
        draw.poisson(np.clip(mean, 0, 1e8))
        + CAMERA["offset"]
        + draw.normal(0, CAMERA["read_noise"], mean.shape)
    )
    return np.clip(
        np.round(np.minimum(electrons, CAMERA["full_well"]) * CAMERA["gain"]),
        0,
        2 ** CAMERA["bits"] - 1,
    )


def rings_of(frame, centre=None):
    return reduce_rings(frame[None].astype(float), PointCamera(**CAMERA), centre)


@cache
def recipe():
    return load("calibrate_stray_light")


def problem_of(rings, prior=PRIOR, lens=LENS, scatter=0.005):
    """Return the posterior of rings as `neusee calibrate` has it, with the node called directly."""
    held = {"core": 1.0, "scatter": scatter}
    believed = calibrate.stray_prior(**prior)
    coordinates = calibrate.ScatterCoordinates.of(believed, {**TRUTH, **held})
    coordinates = coordinates.seen_by(rings, lens)
    fixed = {**lens, "gain": CAMERA["gain"], "read_noise": CAMERA["read_noise"], **coordinates.held}

    def weigh(parameters, told):
        named = {name.removeprefix("density."): x for name, x in parameters.items()}
        return {"density": calibrate.stray_light(rings, **fixed | named, told=told)}

    return SensorPosterior(
        recipe(),
        "density",
        "",
        coordinates,
        rings,
        lambda p: weigh(p, False),
        lambda p: weigh(p, True),
    )


def recipe_prior():
    """Return the prior of the recipe `calibrate_stray_light`, which is wide."""
    given = recipe().steps["prior"].params
    return {name: tuple(pair) for name, pair in given.items() if pair is not None}


def drawn_truth(draw, wider=1.0, shift=0.0, prior=PRIOR):
    """Draw a lens from the prior, or from one that is ``wider`` or moved by ``shift`` standard
    deviations.
    """
    truth = dict(TRUTH)
    for name in TRUTH:
        centre, width = prior[name]
        away = wider * draw.normal() + (shift if name in ("b0", "l", "s") else 0.0)
        truth[name] = centre + away * width if name in ("s", "background") else centre * width**away
    return truth


def drawn_camera(seed, prior, size=128):
    """Return a lens drawn from the prior, its place and pixels, and the rings of its picture.

    Lenses that scatter all light, and pictures without saturated pixels, are drawn again.
    """
    draw = np.random.default_rng([16, seed])
    while True:
        truth, lens = (
            drawn_truth(draw, prior=prior),
            {**LENS, "pixel_pitch": draw.uniform(4e-6, 6.5e-6)},
        )
        centre = tuple((size - 1) / 2 + draw.uniform(-0.5, 0.5, 2))
        band = draw.uniform(10e-9, 40e-9)
        if (
            truth["s"] >= 0
            or scattered(truth["b0"], truth["l"], truth["s"], 2, (0, 0), 1.0)[1] >= 1
        ):
            continue
        try:
            return truth, lens, rings_of(picture(truth, draw, size, centre, lens, band=band))
        except ValueError:
            continue
