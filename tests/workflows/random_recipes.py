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
    """The recipe of a seed, and the changes that made it; its tolerance is between 1e-5 and
    1e-1.
    """
    rng = random.Random(seed)
    changes = [*_optics(rng), *_scene(rng), *_lasers(rng), *_sensor(rng)]
    changes += [
        f"tolerance={10 ** rng.uniform(-5, -1):.3g}",
        f"seed={rng.randrange(1000)}",
        "~restore",
    ]
    changes += ["steps.restored_quality=null", "outputs=[raw, lsr, bsr]"]
    # 150 nm wide, they leave its table
    if "optics.bands=3" in changes and "illuminant=equal_energy" in changes:
        changes.append("optics.bands=5")
    changes += [f"{name}={value}" for name, value in more.items()]
    return load("first_light", changes), changes


def draw_large(seed, size=LARGE):
    """The recipe of a seed with larger pictures, raw and developed, and a tolerance between 1e-4
    and 3e-2.
    """
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
        changes += [
            f"lasers.{named}.strength={strength}",
            f"lasers.{named}.angle=[0.1 mrad, -0.2 mrad]",
        ]
    return changes


def _sensor(rng):
    read_noise, dark, offset = (
        rng.choice(of) for of in ((0, 2, 10.5, 100), (0, 0.002, 1, 30), (0, 390))
    )
    changes = [
        f"sensor.read_noise={read_noise} e-",
        f"sensor.dark_current={dark} e-",
        f"sensor.offset={offset} e-",
        f"sensor.background={rng.choice((0, 0.01, 0.7, 2))}",
        f"sensor.exposure={10 ** rng.uniform(-6, 2):.3g} s",
    ]
    full_well = rng.choice((100, 2000, 25500, 100000))
    # a smaller well records no light
    room = 600 if full_well <= max(read_noise, dark + offset) else full_well
    return [*changes, f"sensor.full_well={room} e-", f"sensor.bits={rng.choice((8, 12, 16))}"]


# Recipes over every shipped group, for the errors that a run states.

MASKS = (
    "axicon", "axicon_and_filter", "axicon_and_notch", "axicon_and_stop", "cubic", "demonstration", "five_half_rings",
    "flat", "grey_filter", "half_ring", "notch", "pixelwise", "small_stop", "spiral_axicon", "stop_and_filter", "unet",
    "vortex", "zernike",
)  # fmt: skip
SENSORS = ("neusee", "night", "small")
FLARES = ("clean", "dirty_stray_light", "dirty_windshield", "stray_light")
ALL_LASERS = ("drawn", "green", "none", "pointer", "red", "six", "violet")
CAMERAS = ("CIE 1931", "Nikon 5100", "Sigma SDMerill")
OUTPUTS = (
    "[raw, developed]",
    "[raw, photons, developed]",
    "[raw, photons, developed]",
    "[photons, charge, read]",
    "[raw, lsr, bsr]",
    "[raw, developed, developed_quality]",
)


def any_changes(seed):
    """Return the changes of `plain_lens` that make the recipe of a seed, over all shipped
    groups.
    """
    rng = random.Random(f"any {seed}")
    groups = _any_groups(rng)
    changes = [*groups, *_any_optics(rng, "laser=six" in groups), *_any_sensor(rng)]
    changes += [f"tolerance={10 ** rng.uniform(-5, -1):.6g}", f"seed={rng.randrange(1000)}"]
    changes += [
        f"outputs={rng.choice(OUTPUTS)}",
        f"estimates={rng.choice(('true', 'true', 'true', 'false'))}",
    ]
    return changes


def draw_any(seed):
    """Return the recipe of a seed over all shipped groups; raises `RecipeError` where a group
    refuses the others.
    """
    return load("plain_lens", any_changes(seed))


def _any_groups(rng):
    mask, flare, laser = rng.choice(MASKS), rng.choice(FLARES), rng.choice(ALL_LASERS)
    groups = [
        f"scene={rng.choice(SCENES)}",
        f"doe={mask}",
        f"flare={flare}",
        f"laser={laser}",
        "optics=small",
    ]
    groups += [f"sensor={rng.choice(SENSORS)}", f"lift={rng.choice(LIFTS)}"]
    groups += [f"illuminant={rng.choice(('daylight', 'a', 'equal_energy'))}"]
    groups += [f"reading={rng.choice(('coherent', 'coherent', 'coherent', 'as_printed'))}"]
    if "stray" in flare:
        groups += [f"stray_light.surfaces.lens.b0={10 ** rng.uniform(-5, 0):.4g}"]
        groups += [f"stray_light.surfaces.lens.l={10 ** rng.uniform(-3, -1):.4g}"]
        groups += [f"stray_light.strength={rng.choice((1, 1, 3, 100))}"]
    if laser == "drawn":
        groups += ["lasers.drawn.angle=[0.3 mrad, -0.5 mrad]"]
    if mask == "demonstration":
        groups += ["steps.height.with.between=nearest"]
    if laser in ("green", "red", "violet"):
        groups += [f"lasers.{laser}.strength={rng.choice((0, 1e-6, 1e-3, 1, 1e3, 1e6))}"]
        groups += [
            f"lasers.{laser}.angle=[{rng.uniform(-1, 1):.3f} mrad, {rng.uniform(-1, 1):.3f} mrad]"
        ]
    return groups


def _any_optics(rng, far):
    """Return optics of small size; a laser ``far`` from the axis needs more samples of the
    pupil.
    """
    samples, bands = 270 if far else rng.choice((64, 90, 135)), rng.choice((5, 7, 11, 16, 31))
    rows, columns = rng.choice(SIDES), rng.choice(SIDES)
    high, wide = (rng.randint(20, side) for side in (rows, columns))
    changes = [
        f"optics.samples={samples}",
        f"optics.pitch={8100 / samples} um",
        "optics.diameter=8 mm",
    ]
    changes += [
        f"optics.window=[{rng.choice(SIDES)}, {rng.choice(SIDES)}]",
        f"optics.bands={bands}",
    ]
    changes += [
        f"optics.border={rng.choice(('zero', 'reflect'))}",
        f"scene.shape=[{rows}, {columns}]",
    ]
    changes += [
        f"optics.defocus={rng.choice((0, 0, 0.5, 3))} waves",
        f"sensor.shape=[{high}, {wide}]",
    ]
    return changes


def _any_sensor(rng):
    changes = [f"sensor.read_noise={rng.choice((0, 2, rng.uniform(0.5, 100))):.4g} e-"]
    changes += [
        f"sensor.dark_current={rng.choice((0, 0.002, 1, 30))} e-",
        f"sensor.offset={rng.choice((0, 60, 390))} e-",
    ]
    changes += [f"sensor.background={rng.choice((0.01, rng.random(), rng.random(), 2)):.5g}"]
    changes += [
        f"sensor.exposure={10 ** rng.uniform(-4, 1):.4g} s",
        f"sensor.full_well={rng.choice((2000, 12000, 25500))} e-",
    ]
    changes += [f"sensor.bits={rng.choice((8, 12, 16))}", f"sensor.camera={rng.choice(CAMERAS)}"]
    changes += [f"sensor.arrivals={rng.choice(('gaussian', 'gaussian', 'gaussian', 'poisson'))}"]
    return changes
