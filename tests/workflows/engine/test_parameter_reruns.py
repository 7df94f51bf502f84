"""Which steps run, and which pictures are drawn, after a change of each parameter of a recipe:
these, and no more.
"""

from __future__ import annotations

import pytest

from neusee.workflows import load
from neusee.workflows.engine.resolve_keys import resolve
from neusee.workflows.engine.runner import run
from neusee.workflows.engine.wanted_steps import steps_of, wanted
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.report.contents import Missing, is_table
from neusee.workflows.report.run_pictures import arguments_of, figure_files, key_of_file
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

SMALL = [
    "optics.samples=64",
    "optics.pitch=120 um",
    "optics.window=[32, 32]",
    "optics.bands=5",
    "sensor.shape=[48, 48]",
    "scene.shape=[64, 64]",
]
#: a recipe with a name of its own, and changes of the shipped one
BASES = {
    "first_light": ("first_light", []),
    "dirty": ("paper_table1", []),
    "few bands": ("half_ring", ["outputs=[raw]"]),
}

# What follows from a change, the last steps first. A name stands for all copies of a step, and for
# the step of the rival with the same work.
RESTORED = "deconvolved restored restored_quality"
DEVELOPED = f"signal developed developed_quality {RESTORED}"
FRAME = f"raw saturated clipped {DEVELOPED}"
CONVERTED = f"digital {FRAME}"
READ = f"read well {CONVERTED}"
ELECTRONS = f"charge dark {READ}"
PHOTONS = f"photons {ELECTRONS}"
SCENE = f"level matrix scene_photons peak {PHOTONS}"
SPOT = f"spot laser_photons peak {PHOTONS}"
IMAGE = f"image {SCENE}"
PSF = f"psf lsr outside bsr spectral {IMAGE}"
LASER_PSF = f"laser_psf {SPOT}"
LASER_PUPIL = f"laser_pupil laser_spectral {LASER_PSF}"
PUPIL = f"pupil {PSF} {LASER_PUPIL}"
LINE = f"line wavefront light laser_index laser_responses rival_level rival_matrix {LASER_PUPIL}"
RESPONSES = f"responses responses.wells laser_responses spectral spot laser_photons {IMAGE}"
RADIANCE = f"radiance radiance.mixture bsr {IMAGE}"
BANDS = (
    "bands illuminant responses responses.wells index white cube cube.mixture pupil"
    f" {RADIANCE} {PSF}"
)
GHOSTS = f"ghosts ghost_photons {PHOTONS}"
OPTICS = "overview psf stability suppression"
#: what a mask does not change
MASK = f"{PUPIL} rival_level rival_matrix -level -matrix -[plain"

#: by change: the steps that run, and the pictures that are drawn
FIRST_LIGHT = {
    "sensor.read_noise=20 e-": (f"transfer {READ}", "overview sensor"),
    "sensor.offset=300 e-": (f"transfer {READ}", "overview sensor"),
    "sensor.gain=0.5 e-/DN": (f"transfer {CONVERTED}", "overview sensor"),
    "sensor.bits=15": (f"transfer {CONVERTED}", "overview sensor"),
    "reading.rounding=truncation": (f"transfer {CONVERTED}", "overview sensor"),
    "reading.offset_subtracted=false": (DEVELOPED, "overview"),
    "sensor.c1=0.1": (ELECTRONS, "overview"),
    "sensor.arrivals=poisson": (f"transfer {ELECTRONS}", "overview sensor"),
    # only behind the grey filter is the dark current not left out
    "sensor.dark_current=0.003 e-": (
        "transfer rival_dark rival_read rival_well rival_digital rival_raw rival_saturated"
        " rival_clipped rival_signal rival_deconvolved rival_restored rival_quality",
        "sensor",
    ),
    "sensor.quantum_efficiency=0.5": (f"transfer {SPOT} {SCENE}", "overview sensor"),
    "sensor.full_well=20000 e-": (f"transfer {SPOT} {SCENE}", "overview sensor"),
    "sensor.exposure=0.05 s": (
        f"matrix scene_photons laser_photons peak {PHOTONS}",
        "overview",
    ),
    "sensor.background=0.5": (SCENE, "overview"),
    "sensor.camera=Nikon 5100": (RESPONSES, "overview spectra"),
    "sensor.shape=[40, 40]": (f"truth {FRAME}", "overview"),
    "sensor.pixel_pitch=2.8 um": (
        f"{PSF} {LASER_PSF} direction laser_spectral",
        OPTICS,
    ),
    "lasers.green.strength=100": (f"light {SPOT}", "overview"),
    "lasers.green.angle=[0 rad, 0 rad]": (f"direction {LASER_PSF}", "overview"),
    "lasers.green.wavelength=550 nm": (LINE, "overview spectra"),
    "illuminant.temperature=5000 K": (
        f"illuminant spectral {RADIANCE}",
        "overview spectra suppression",
    ),
    "scene.file=recipes/samples/overexposed_point.png": (
        f"scene truth cube cube.mixture {RADIANCE}",
        "overview spectra suppression",
    ),
    "+optics.transmittance=0.9": ("", ""),
    "optics.focal_length=0.12 m": (
        f"{PSF} {LASER_PSF} direction laser_spectral",
        OPTICS,
    ),
    "optics.defocus=0.1 waves": (PUPIL, f"height {OPTICS}"),
    "optics.border=zero": (IMAGE, "overview stability"),
    "optics.window=[30, 30]": (f"psf lsr outside bsr {IMAGE}", OPTICS),
    "optics.bands=6": (BANDS, f"height spectra {OPTICS}"),
    "mask.max_height=20 um": (f"fabricated {MASK}", "height overview psf suppression"),
    "doe.orientation=90 deg": (
        f"height fabricated {MASK}",
        "height overview psf suppression",
    ),
    "restore.balance=2": (RESTORED, "overview"),
    "reading.damage_multiple=1e5": ("peak", ""),
    "seed=8": (f"transfer {ELECTRONS}", "overview sensor"),
}
DIRTY = {
    "dirt.dust=20": (f"dirt {PUPIL} {GHOSTS}", f"height {OPTICS}"),
    "ghosts.energy=2e-4": (GHOSTS, "overview"),
    "lasers.green.strength=1e5": (f"light {SPOT} {GHOSTS}", "overview"),
    "sensor.read_noise=20 e-": (f"transfer {READ}", "overview sensor"),
}
FEW_BANDS = {
    "sensor.quantum_efficiency=0.5": (f"{SPOT} {SCENE}", ""),
    "lasers.green.strength=1e6": (f"light {SPOT}", ""),
}
TABLE = {"first_light": FIRST_LIGHT, "dirty": DIRTY, "few bands": FEW_BANDS}
ROWS = [(base, change) for base in TABLE for change in TABLE[base]]


class KeepsAll(Store):
    """A store in which everything pays, so that what may be read is read."""

    def write_seconds(self, size):
        return 0.0

    def read_seconds(self, size):
        return 0.0


def recipe_of(base, *changes):
    name, own_changes = BASES[base]
    recipe = load(name, [*SMALL, *own_changes, *changes])
    return with_substitutions(recipe, wanted(recipe))


def keys_of(recipe, store):
    """Return the keys of all steps and of all pictures of a recipe."""
    code = Code(store.code_memo)
    keys = resolve(recipe, steps_of(recipe), store, code=code).keys
    pictures = {}
    for file in figure_files():
        try:
            sources = arguments_of(file.needs, recipe, keys, code, store)
        except Missing:
            continue
        if not file.only_tables or any(is_table(source.make({})) for source in sources.values()):
            pictures[file.name] = key_of_file(file, sources)
    return keys, pictures


@pytest.fixture(scope="module")
def bases(tmp_path_factory):
    """Return by recipe its store after a run, and the keys of its steps and pictures."""
    computed = {}
    for base in BASES:
        store = KeepsAll(tmp_path_factory.mktemp("store"))
        recipe = recipe_of(base)
        run(recipe, store, wanted(recipe))
        computed[base] = (store, *keys_of(recipe, store))
    return computed


def changed(new_keys, keys):
    """Return the steps whose results the run of the base has not computed."""
    return {step for step in new_keys if new_keys[step] not in keys.values()}


def copies(names, steps):
    """Return the steps that names stand for: copies, cheaper forms, and those of the rival.

    A name after a minus is that of a step, or a part of the names of steps, that is left out.
    """
    words = names.split()
    left_out = [word[1:] for word in words if word[0] == "-"]
    families = {*words, *("quality" for word in words if word == "restored_quality")}
    return {
        step
        for step in steps
        if families & {step.partition("[")[0], step.partition("[")[0].removeprefix("rival_")}
        and not any(step == name or (name[0] == "[" and name in step) for name in left_out)
    }


@pytest.mark.parametrize(("base", "change"), ROWS)
def test_a_changed_parameter_reruns_these_steps_and_draws_these_pictures(bases, base, change):
    store, keys, pictures = bases[base]
    recipe = recipe_of(base, change)
    new_keys, new_pictures = keys_of(recipe, store)
    named, drawn = TABLE[base][change]
    assert changed(new_keys, keys) == copies(named, new_keys)
    assert {name for name in new_pictures if new_pictures[name] != pictures.get(name)} == {
        *drawn.split()
    }


@pytest.mark.parametrize(
    "change", ["sensor.read_noise=20 e-", "sensor.quantum_efficiency=0.5", "sensor.shape=[40, 40]"]
)
def test_a_run_computes_what_its_keys_say(bases, change):
    store, keys, _ = bases["first_light"]
    recipe = recipe_of("first_light", change)
    new_keys = keys_of(recipe, store)[0]
    done = run(recipe, KeepsAll(store.root), wanted(recipe)).done
    ran = {step for step, record in done.items() if record.state == "run"}
    assert ran == {step for step in changed(new_keys, keys) if done[step].state != "left out"}
