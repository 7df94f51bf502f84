"""The example of dead pixels in a raw frame, and the words on the dazzled area, of one estimate
of a laboratory.
"""

import functools

import numpy as np
import pytest

import neusee
from neusee.workflows import Store, load
from neusee.workflows.safety.run_safety import document
from neusee.workflows.safety.safety_estimate import estimate
from neusee.workflows.safety.safety_page import report
from neusee.workflows.safety.safety_text import lines, paragraphs

pytestmark = pytest.mark.usefixtures("without_remedies")
SMALL = [
    "safety.draws=100",
    "optics.samples=512",
    "optics.window=[192, 192]",
    "wide.window=[603, 603]",
    "safety.dazzle.share=0.002",
    "safety.protection.stop=null",
    "safety.distances=[0.1 m, 100 km]",
]
DEVICE = "device,damage,wavelength from (nm),wavelength to (nm),duration from (ns),duration to (ns)"


@pytest.fixture(scope="module")
def found(tmp_path_factory, without_remedies):
    """Estimates of the recipe with a table of thresholds, given as damage and J/cm2, and other
    changes.
    """
    folder = tmp_path_factory.mktemp("dead")
    store = Store(folder / "store")

    @functools.cache
    def estimated(changes):
        return estimate(load("safety_laboratory", [*SMALL, *changes]), store)

    def compute(laws, *changes, device="CMOS"):
        rows = [
            f"{device},{damage},500,600,1,100,{joules},{damage}" for damage, joules in laws.items()
        ]
        name = "_".join([device, *(f"{damage}{joules}" for damage, joules in laws.items())])
        (folder / f"{name}.csv").write_text(
            "\n".join([f"{DEVICE},threshold (J/cm2),source", *rows]) + "\n"
        )
        table = f"safety.damage.file={folder / name}.csv", f"safety.damage.device={device}"
        return estimated((*table, *changes))

    return compute


def expected_point(found, joules):
    """Pixels of 3.45 um in which a sample of the plain spot, 0.37 um apart, exceeds a limit at 2
    m.
    """
    step = "laser_psf[plain,reflection]"
    spot = neusee.run(found.recipe, outputs=[step])[step]
    light = spot.intensity[0].double().numpy()
    peak = next(each for each in found.findings if each.option == "plain lens").exposure.value
    y, x = np.nonzero(light / light.max() * peak >= joules * 1e4)
    middle = light.shape[0] // 2
    return {
        (round((a - middle) * 0.37 / 3.45), round((b - middle) * 0.37 / 3.45))
        for a, b in zip(y, x, strict=True)
    }


@pytest.mark.slow
def test_points_are_white_where_the_light_exceeds_the_limit_at_the_distance_of_the_recipe(found):
    estimated = found({"point": 1.0})
    plain, mask = estimated.dead
    assert (plain.option, plain.distance, plain.kinds) == ("plain lens", 2.0, ("point",))
    half = plain.frame.shape[0] // 2
    white = {(int(y) - half, int(x) - half) for y, x in np.argwhere(plain.frame > 0.9)}
    assert white == expected_point(estimated, 1.0)
    assert plain.pixels == len(white) > 20
    assert mask.kinds == ("point",)
    assert set(np.unique(np.round(plain.frame, 3))) == {0.4, 0.999}


@pytest.mark.slow
def test_lines_crosses_and_lost_frames_are_drawn_and_a_ccd_has_white_columns(found):
    quick = "safety.dazzle=null"
    row = found({"line": 1e3}, quick).dead[0].frame
    assert (row[row.shape[0] // 2] == 0).all()
    assert (row[0] == 0.4).all()
    cross = found({"cross": 1e3}, quick).dead[0].frame
    assert (cross[len(cross) // 2] == 0).all()
    assert (cross[:, len(cross) // 2] == 0).all()
    column = found({"line": 1e3}, quick, device="CCD").dead[0].frame
    assert (column[:, len(column) // 2] > 0.9).all()
    assert (found({"frame": 1e3}, quick).dead[0].frame == 0).all()
    lost = found({"frame": 1e3, "line": 1e3}, quick).dead[0]
    assert lost.kinds == ("line", "frame")
    np.testing.assert_array_equal(lost.frame, row)


@pytest.mark.slow
def test_without_damage_here_the_largest_distance_of_damage_is_drawn_and_without_any_none(found):
    far = found({"point": 10.0}, "safety.dazzle=null", "lasers.reflection.distance=50 km")
    plain = next(
        each
        for each in far.findings
        if each.option == "plain lens" and each.limit.effect == "damage"
    )
    assert far.dead[0].distance == pytest.approx(plain.zones.zones[-1].far.value, rel=0.03)
    assert far.dead[0].pixels >= 1
    assert far.dead[1].kinds == ()
    assert (far.dead[1].frame == 0.4).all()

    assert found({"point": 1e9}).dead == ()


@pytest.mark.slow
def test_the_words_say_how_much_the_mask_enlarges_the_dazzled_area(found):
    estimated = found({"point": 1.0}, "lasers.reflection.pulse_energy=2 nJ")
    plain, mask = (each for each in estimated.dazzled if "filter" not in each.option)
    assert mask.times == pytest.approx(mask.pixels.value / plain.pixels.value)
    assert mask.times > 1
    text = " ".join(" ".join(lines(paragraphs(estimated))).split())
    assert "The mask enlarges the dazzled area." in text
    assert f"{mask.times:.3g} times as many" in text
    limits = {f.option: f.at_lens.value for f in estimated.findings if f.limit.effect == "dazzle"}
    assert f"{limits['plain lens'] / limits['mask']:.3g} times less light" in text
    said = document(estimated)["dazzled"]
    assert said[1]["times_plain_lens"] == mask.times


def test_the_curve_crosses_the_stated_share_at_the_limit_of_dazzle(found):
    estimated = found({"point": 1.0})
    for each in estimated.dazzled:
        limit = next(
            f for f in estimated.findings if f.option == each.option and f.limit.effect == "dazzle"
        )
        known = each.curve > 0
        share = np.exp(
            np.interp(
                np.log(limit.at_lens.value), np.log(each.at_lens[known]), np.log(each.curve[known])
            )
        )
        assert share == pytest.approx(0.002, rel=0.02), each.option
        assert (np.diff(each.curve[known]) >= 0).all()


@pytest.mark.slow
def test_the_page_shows_the_dazzled_area_and_the_example_or_says_why_there_is_none(found):
    page = report(found({"point": 1.0}))
    assert {"dazzle", "dead_pixels"} <= set(page.pictures)
    words = " ".join(each.text for each in page.sections)
    assert "An example pattern and no prediction" in words
    assert "Lens scatter 0.5 %, assumed" in words

    page = report(found({"point": 1e9}))
    assert "dead_pixels" not in page.pictures
    assert any(
        "at no distance does a judged part of the light" in each.text for each in page.sections
    )
