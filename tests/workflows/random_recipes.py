"""Recipes drawn at random: scenes, elements, lasers and sensors of all kinds, in a small camera."""

import random

from neusee.workflows import load

SCENES = ("china", "edge", "points", "siemens", "night")
ELEMENTS = ("axicon", "cubic", "five_half_rings", "flat", "half_ring", "spiral_axicon", "vortex")
LASERS = ("none", "green", "red", "violet")
LIFTS = ("lmmse", "mallett")
SIDES = (48, 64, 75, 97)
LARGE = (  # large enough for PSFs of few bands
    "optics.samples=256",
    f"optics.pitch={8078.4 / 256} um",
    "optics.window=[256, 256]",
    "scene.shape=[256, 256]",
    "sensor.shape=[200, 200]",
)


def draw(seed, **more):
    """The recipe of a seed, and the changes that made it; its tolerance is between 1e-5 and 1e-1."""
    rng = random.Random(seed)
    changes = [*_optics(rng), *_scene(rng), *_lasers(rng), *_sensor(rng)]
    changes += [f"tolerance={10 ** rng.uniform(-5, -1):.3g}", f"seed={rng.randrange(1000)}", "~restore"]
    changes += ["steps.restored_quality=null", "outputs=[raw, lsr, bsr]"]
    if "optics.bands=3" in changes and "illuminant=equal_energy" in changes:  # 150 nm wide, they leave its table
        changes.append("optics.bands=5")
    changes += [f"{name}={value}" for name, value in more.items()]
    return load("first_light", changes), changes


def draw_large(seed, size=LARGE):
    """The recipe of a seed with larger pictures, raw and developed, and a tolerance between 1e-4 and 3e-2."""
    changes = [c for c in draw(seed)[1] if not c.startswith(("tolerance", "outputs"))]
    tolerance = 10 ** random.Random(-1 - seed).uniform(-4, -1.523)
    bands = ["optics.bands=31"] if random.Random(-1000 - seed).random() < 0.7 else []
    chosen = [*changes, *size, *bands, "outputs=[raw, developed]", f"tolerance={tolerance:.3g}"]
    return load("first_light", chosen)


def _optics(rng):
    samples = rng.choice((135, 180, 270))
    window = rng.choice(SIDES)
    return [
        f"optics.samples={samples}",
        f"optics.pitch={8078.4 / samples} um",
        f"optics.window=[{window}, {rng.choice(SIDES)}]",
        f"optics.bands={rng.choice((3, 5, 7, 11, 16, 31))}",
        f"optics.border={rng.choice(('zero', 'reflect'))}",
        f"optics.defocus={rng.choice((0, 0, 0.5, 3))} waves",
        f"doe={rng.choice(ELEMENTS)}",
        f"flare={rng.choice(('clean', 'clean', 'dirty_windshield'))}",
    ]


def _scene(rng):
    side = rng.choice(SIDES)
    return [
        f"scene={rng.choice(SCENES)}",
        f"scene.shape=[{side}, {side}]",
        f"sensor.shape=[{rng.randint(20, 48)}, {rng.randint(20, 48)}]",
        f"lift={rng.choice(LIFTS)}",
        f"illuminant={rng.choice(('daylight', 'a', 'equal_energy'))}",
    ]


def _lasers(rng):
    laser = rng.choice(LASERS)
    named = {"green": "green", "red": "red", "violet": "violet"}.get(laser)
    changes = [f"laser={laser}"]
    if named:
        strength = rng.choice((0, 1e-6, 1e-3, 1, 1e3, 1e6))
        changes += [f"lasers.{named}.strength={strength}", f"lasers.{named}.angle=[0.1 mrad, -0.2 mrad]"]
    return changes


def _sensor(rng):
    return [
        f"sensor.read_noise={rng.choice((0, 2, 10.5, 100))} e-",
        f"sensor.dark_current={rng.choice((0, 0.002, 1, 30))} e-",
        f"sensor.offset={rng.choice((0, 390))} e-",
        f"sensor.background={rng.choice((0, 0.01, 0.7, 2))}",
        f"sensor.exposure={10 ** rng.uniform(-6, 2):.3g} s",
        f"sensor.full_well={rng.choice((100, 2000, 25500, 100000))} e-",
        f"sensor.bits={rng.choice((8, 12, 16))}",
    ]
