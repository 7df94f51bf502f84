"""The block `safety` of a recipe: what it reads, and one located line for each mistake, before
any work.
"""

import pytest

from neusee.workflows import RecipeError, load

#: what is wrong, the changes of the recipe safety_pointer, the path of the value, and words of the
#: message
MISTAKES = [
    ("no distance", ["~lasers.pointer.distance"], "lasers.pointer", "needs distance"),
    ("no power", ["~lasers.pointer.power"], "lasers.pointer.power", "no power: give power, or pulse_energy"),
    ("no width", ["~lasers.pointer.divergence"], "lasers.pointer.divergence", "give divergence, or waist"),
    ("negative divergence", ["lasers.pointer.divergence=-1 mrad"], "lasers.pointer.divergence", "greater than 0"),
    ("divergence drawn below 0", ["lasers.pointer.divergence=normal(1 mrad, 0.5 mrad)"], None,
     "of this distribution lies outside the allowed values"),
    ("waist against divergence", ["+lasers.pointer.waist=0.1 mm"], "lasers.pointer.divergence",
     "no beam has less than 1"),
    ("M2 against both", ["+lasers.pointer.waist=2 mm", "+lasers.pointer.m_squared=1"], "lasers.pointer.m_squared",
     "leave one of the three out"),
    ("M2 below 1", ["+lasers.pointer.m_squared=0.5"], "lasers.pointer.m_squared", "greater than or equal to 1"),
    ("pulse longer than its period", ["+lasers.pointer.repetition_rate=1 kHz", "+lasers.pointer.pulse_duration=2 ms"],
     "lasers.pointer.pulse_duration", "does not fit into the period"),
    ("pulse without duration", ["+lasers.pointer.pulse_energy=1 mJ"], "lasers.pointer.pulse_energy",
     "give pulse_duration"),
    ("power against energy", ["+lasers.pointer.pulse_energy=1 mJ", "+lasers.pointer.pulse_duration=1 us",
     "+lasers.pointer.repetition_rate=1 kHz"], "lasers.pointer.power", "leave one of the three out"),
    ("power without a unit", ["lasers.pointer.power=0.005"], "lasers.pointer.power", "needs a unit"),
    ("distance of 0", ["lasers.pointer.distance=0 m"], "lasers.pointer.distance", "greater than 0"),
    ("unknown law of haze", ["+lasers.pointer.visibility=5 km", "+lasers.pointer.haze=fog"], "lasers.pointer.haze",
     "'kim'"),
    ("visibility of 0", ["+lasers.pointer.visibility=0 km"], "lasers.pointer.visibility", "greater than 0"),
    ("misspelt value of a laser", ["+lasers.pointer.visiblity=5 km"], "lasers.pointer.visiblity", "unknown"),
    ("no such laser", ["+safety.laser=green"], "safety.laser", "the recipe has no laser green; there are: pointer"),
    ("two lasers", ["+lasers.other={wavelength: 638 nm}"], "safety", "write safety.laser=NAME"),
    ("saturation without QE", ["~safety.sensor.quantum_efficiency"], "safety", "dazzle needs quantum_efficiency"),
    ("QE above 1", ["safety.sensor.quantum_efficiency=65"], "safety.sensor.quantum_efficiency",
     "less than or equal to 1"),
    ("no lens", ["~safety.lens"], "safety", "needs lens"),
    ("unknown setting", ["+safety.sensor.pitch=3 um"], "safety.sensor.pitch", "did you mean pixel_pitch?"),
    ("distances in the wrong order", ["+safety.distances=[1 km, 1 m]"], "safety.distances",
     "the shorter distance first"),
    ("filter above 1", ["safety.protection.filter=2"], "safety.protection.filter", "less than or equal to 1"),
    ("share of the picture of 0", ["safety.dazzle.share=0"], "safety.dazzle.share", "greater than 0"),
    ("no bonus above 1", ["+safety.damage.small_spot_exponent=2"], "safety.damage.small_spot_exponent", "less than or"),
    ("no such table", ["+safety.damage.file=lost.csv"], "safety.damage.file", "no such file"),
    ("too many draws", ["+safety.draws=1000000"], "safety.draws", "less than or equal to 10000"),
    ("no such option", ["safety=5"], "safety", "no option 5 in safety; there are: camera, masked_dazzle"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "path", "words"), [m[1:] for m in MISTAKES], ids=[m[0] for m in MISTAKES]
)
def test_a_mistake_is_one_located_line(changes, path, words):
    from neusee.workflows.safety.safety_estimate import estimate

    with pytest.raises(RecipeError) as error:
        estimate(load("safety_pointer", changes))
    (found,) = error.value.diagnostics
    assert words in found.message
    assert found.mark.file.startswith(("argument", "safety_pointer.yaml"))
    assert path is None or found.path.startswith(path)


def test_a_recipe_without_the_block_says_what_to_add():
    from neusee.workflows.safety.safety_estimate import estimate

    with pytest.raises(RecipeError, match="add the block safety, as in the recipe safety_pointer"):
        estimate(load("train_small"))


def test_a_mask_that_is_no_step_is_found_before_anything_runs():
    from neusee.workflows.safety.safety_estimate import estimate

    with pytest.raises(RecipeError, match=r"safety\.protection\.mask +no step 'lsr'"):
        estimate(load("safety_pointer", ["safety.protection.mask=lsr"]))


def test_a_block_that_is_no_mapping_is_a_mistake():
    with pytest.raises(RecipeError, match=r"safety +must be a mapping of settings, not a number"):
        load("safety_car_lidar_1550", ["safety=5"])


def test_null_is_no_estimate_and_a_run_needs_no_block():
    assert (
        load("safety_car_lidar_1550", ["safety=null", "lasers.lidar={wavelength: 1550 nm}"]).safety
        is None
    )
    assert load("laser_free").safety is None


@pytest.mark.slow
def test_the_questions_are_added_to_a_camera():
    from neusee.workflows.safety.safety_estimate import prepare

    changes = ["laser=pointer", "+safety=camera", "safety.protection.mask=null"]
    recipe = load("first_light", changes)
    assert recipe.safety.settings.lens.diameter == pytest.approx(8.0784e-3, rel=1e-12)
    assert recipe.safety.settings.lens.transmittance == 1.0
    assert recipe.safety.settings.sensor.full_well == 25500
    assert prepare(recipe, None).safety.settings.lens.diameter == pytest.approx(540 * 14.96e-6)
    with pytest.raises(RecipeError, match=r"lasers\.green +needs distance"):
        load("first_light", ["+safety=camera"])


def test_a_value_knows_where_a_reference_leads():
    found = load("safety_pointer", ["optics.transmittance=normal(0.9, 0.01)"]).safety
    assert found.settings.lens.transmittance == 0.9
    assert found.values["lens.transmittance"].name == "optics.transmittance"
    assert found.values["laser.power"].name == "lasers.pointer.power"
    assert found.values["sensor.full_well"].name == "safety.sensor.full_well"


def test_a_table_of_thresholds_is_found_beside_the_recipe_and_its_mistakes_are_located(tmp_path):
    spans = "wavelength from (nm),wavelength to (nm),duration from (s),duration to (s)"
    rows = f"device,damage,{spans},threshold (kW/cm2),source\n"
    (tmp_path / "mine.csv").write_text(f"{rows}CMOS,point,500,600,0.1,10,40,my bench\n")
    recipe = load("safety_pointer", ["+safety.damage.file=mine.csv"], tmp_path)
    (law,) = recipe.safety.laws
    assert (law.median, law.source) == (pytest.approx(4e8), "my bench")
    assert str(tmp_path / "mine.csv") in recipe.config.to_yaml()
    (tmp_path / "mine.csv").write_text(f"{rows}CMOS,point,500,600,0.1,10,forty,my bench\n")
    with pytest.raises(RecipeError, match=r"argument 1 +safety\.damage\.file +mine\.csv:2"):
        load("safety_pointer", ["+safety.damage.file=mine.csv"], tmp_path)
