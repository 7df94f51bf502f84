"""The lens of an estimate is that of the recipe, however its diameter is written; another one is
refused.
"""

import math

import pytest

from neusee.workflows import RecipeError, Store, load
from neusee.workflows.safety.safety_estimate import estimate, prepare

#: the peak behind the plain lens alone: no mask, and no light beside the peak
ALONE = ["safety.protection={}", "safety.dazzle=null"]
pytestmark = pytest.mark.usefixtures("without_remedies")
FOCAL, WAVELENGTH, POWER, DIVERGENCE, DISTANCE = 0.11, 532e-9, 5e-3, 1e-3, 1e4
CAMERA = [
    "laser=pointer", f"lasers.pointer.distance={DISTANCE} m", "+safety=camera", "safety.draws=100", "doe=flat",
    "optics.samples=640", "optics.bands=3", "optics.window=[64, 64]", "scene.shape=[96, 96]", "sensor.shape=[64, 64]",
    "lasers.pointer.angle=[0 mrad, 0 mrad]",
]  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


def peak(diameter):
    """Return the peak in W/m2 of a beam that overfills a clear lens: E (pi D^2 / 4)^2 / (lambda
    f)^2.
    """
    width = math.hypot(WAVELENGTH / (math.pi * DIVERGENCE / 2), DIVERGENCE / 2 * DISTANCE)
    return (
        2 * POWER / (math.pi * width**2) * (math.pi * diameter**2 / 4 / (WAVELENGTH * FOCAL)) ** 2
    )


def judged(recipe, store):
    """Return the exposure and the limit on the sensor of the first law of damage behind the
    plain lens.
    """
    found = estimate(recipe, store)
    first = next(
        f for f in found.findings if f.option == "plain lens" and f.limit.effect == "damage"
    )
    return first.exposure.value, first.at_sensor.value


def override(folder, diameter):
    return load("first_light", [*CAMERA, *ALONE, f"optics.diameter={diameter}"], folder)


def own_recipe(folder, diameter):
    names = (
        "scene: china, illuminant: daylight, lift: lmmse, optics: small, sensor: small, flare:"
        " clean"
    )
    options = [
        f"{{{each}}}"
        for each in (
            *names.split(", "),
            "restore: wiener",
            "reading: coherent",
            "laser: pointer",
            "doe: flat",
        )
    ]
    defaults = "\n".join(f"  - {each}" for each in ("camera: neusee", *options))
    (folder / "mine.yaml").write_text(
        f"defaults:\n{defaults}\noutputs: [peak]\noptics: {{diameter: {diameter}}}\n"
    )
    return load(str(folder / "mine.yaml"), [*CAMERA[1:], *ALONE], folder)


def own_group(folder, diameter):
    (folder / "optics").mkdir()
    lens = (
        f"optics:\n  focal_length: 0.11 m\n  diameter: {diameter}\n  samples: 640\n  pitch: 3.74"
        " um\n"
    )
    rest = (
        "  shortest: 400 nm\n  longest: 700 nm\n  bands: 3\n  window: [64, 64]\n  defocus: 0"
        " waves\n"
    )
    rest += "  aberrations: {}\n  pixel: point\n  border: reflect\n"
    mask = "mask: {material: fused silica, wrap_at: null, levels: null, max_height: null}\n"
    (folder / "optics" / "mine.yaml").write_text(f"# My lens.\n{lens}{rest}{mask}")
    return load(
        "first_light",
        ["optics=mine", *(word for word in CAMERA if "optics" not in word), *ALONE],
        folder,
    )


def from_python(folder, diameter):
    return load("first_light", [*CAMERA, *ALONE], folder, optics={"diameter": diameter})


def drawn(folder, diameter):
    return load(
        "first_light",
        [*CAMERA, *ALONE, f'optics.diameter="lognormal({diameter}, 1.05)"'.replace('"', "")],
        folder,
    )


WRITTEN = [override, own_recipe, own_group, from_python, drawn]


@pytest.mark.parametrize("written", WRITTEN)
@pytest.mark.parametrize("diameter", ["4 mm", "25 mm"])
def test_the_peak_is_that_of_the_diameter_as_written(tmp_path, store, written, diameter):
    """A lens of 25 mm was judged as one of 8.08 mm: 92 times too little at the peak."""
    exposure, _ = judged(written(tmp_path, diameter), store)
    assert exposure == pytest.approx(peak(float(diameter.split()[0]) * 1e-3), rel=1e-3)


def test_the_ratio_to_the_threshold_grows_with_the_fourth_power_of_the_diameter(tmp_path, store):
    ratios = []
    for millimetres in (5, 8.0784, 11, 25):
        exposure, limit = judged(
            load("first_light", [*CAMERA, *ALONE, f"optics.diameter={millimetres} mm"]), store
        )
        ratios.append(exposure / limit / millimetres**4)
    assert ratios == pytest.approx([ratios[0]] * 4, rel=1e-3)


@pytest.mark.parametrize(
    ("recipe", "changes", "path", "message"),
    [
        ("first_light", ["reading.aperture=inscribed", "optics.diameter=25 mm", "optics.pitch=12.6225 um"],
         "optics.diameter", r"has 8\.078 mm, but the lens of the estimate 25 mm"),
        ("first_light", ["reading.aperture=clipped", "optics.diameter=11 mm", "optics.pitch=12.6225 um"],
         "optics.diameter", r"clips its disc to a square of 8\.078 mm"),
        ("first_light", ["safety.lens.diameter=25 mm"], "safety.lens.diameter", r"has 8\.078 mm, .* 25 mm"),
        ("first_light", ["safety.protection.stop=9 mm"], "safety.protection.stop", "blocks nothing"),
        ("safety_pointer", ["safety.lens.diameter=25 mm"], "safety.lens.diameter", "has 12 mm, .* 25 mm"),
        ("safety_pointer", ["safety.lens.focal_length=25 mm"], "safety.lens.focal_length", "has a focal length of 50 mm, .* 25 mm"),
        ("safety_pointer", ["safety.protection.stop=20 mm"], "safety.protection.stop", "blocks nothing"),
    ],
)  # fmt: skip
def test_another_lens_than_that_of_the_steps_is_refused(tmp_path, recipe, changes, path, message):
    """Each was estimated without a word: for the smaller of both lenses, or with the mask of
    another lens.
    """
    words = CAMERA if recipe == "first_light" else ["safety.draws=100", "optics.samples=256"]
    with pytest.raises(RecipeError, match=message) as error:
        prepare(load(recipe, [*words, *changes], tmp_path), None)
    assert error.value.diagnostics[0].path == path
