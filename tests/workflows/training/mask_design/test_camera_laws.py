"""What a mask design does not know for certain: draws, the average in the end, and the worst
peak.
"""

import math

import pytest
import torch

import neusee
from neusee.nodes import losses, metrics
from neusee.workflows import load
from neusee.workflows.recipe.blocks.train_block import DesignError, MaskTraining
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.design_run import against_stops
from neusee.workflows.training.design_terms import NOMINAL, CameraLaws, Terms

SMALL = [
    "optics.samples=48",
    "optics.pitch=168 um",
    "optics.window=[48, 48]",
    "optics.bands=3",
    "scene.shape=[48, 48]",
    "sensor.shape=[32, 32]",
    "lasers.green.angle=[0 mrad, 0 mrad]",
    "doe=cubic",
    "doe.waves=2",
]
HALF = 0.5 * 2.9e-6 / 0.11  #: half a pixel


@pytest.fixture(scope="module")
def recipe():
    return load("first_light", SMALL)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("cache"))


def how(**values):
    given = {"bands": None, "limit": 0.03, "weights": {"lsr": 0, "bsr": 0, "filtered_error": 1}}
    return MaskTraining.model_validate({**given, **values})


def test_points_give_the_mean_of_any_polynomial_of_degree_3():
    laws = CameraLaws((0.5, 2e-9, 1e-5, 1e-5), {}, {}, 0)
    points = laws.points()
    assert len(points) == 9
    for powers, mean in (
        ((0, 0, 0, 0), 1),
        ((2, 0, 0, 0), 1),
        ((0, 0, 0, 2), 1),
        ((1, 2, 0, 0), 0),
        ((3, 0, 0, 0), 0),
    ):
        found = sum(
            w * math.prod(x**k for x, k in zip(state, powers, strict=True)) for state, w in points
        )
        assert found == pytest.approx(mean, abs=1e-12)
    assert CameraLaws((0, 0, 0, 0), {}, {}, 0).points() == [(NOMINAL, 1.0)]


def test_draws_are_those_of_a_normal_law_and_of_the_seed():
    laws = CameraLaws((0.5, 2e-9, 1e-5, 1e-5), {}, {}, 7)
    drawn = torch.tensor([laws.drawn(k) for k in range(2000)])
    assert float(drawn.mean(0).abs().max()) < 4 / math.sqrt(2000)
    assert bool((torch.corrcoef(drawn.T) - torch.eye(4)).abs().max() < 0.1)
    assert drawn.std(0).tolist() == pytest.approx([1] * 4, rel=0.08)
    assert laws.drawn(5) == laws.drawn(5)


def test_a_direction_moves_the_peak_and_not_the_picture_and_a_wavelength_both(recipe, store):
    terms = Terms(recipe, how(direction_spread=f"{HALF} rad", wavelength_spread="5 nm"), store)
    height = neusee.run(recipe, store=store, outputs=["height"])["height"]
    with torch.no_grad():
        here, beside, longer = (
            terms.psf(height, None, s) for s in (NOMINAL, (0, 0, 1.0, 1.0), (0, 1.0, 0, 0))
        )
        by_hand = load("first_light", [*SMALL, f"steps.psf.with.angle=[{HALF} rad, {HALF} rad]"])
        expected = neusee.run(by_hand, store=store, outputs=["psf[mask]"])["psf[mask]"]
        assert float((beside.intensity - expected.intensity).abs().max()) < 1e-6 * float(
            expected.intensity.max()
        )
        seen = terms.seen()
        error = [
            float(losses.filtered_error(x, *seen, light=30, read_noise=10.5))
            for x in (here, beside)
        ]
        assert error[1] == pytest.approx(error[0], abs=2e-3)
        assert float(metrics.lsr(beside).max()) != pytest.approx(
            float(metrics.lsr(here).max()), rel=0.01
        )
        ratio = ((terms.bands.centres + 5e-9) / terms.bands.centres) ** -2
        assert (longer.cut_off / here.cut_off).square().tolist() == pytest.approx(
            ratio.tolist(), rel=1e-9
        )
        # a wider spot loses less to the pixel
        averaged = (1 - longer.clear_peak / here.clear_peak) / (1 - ratio)
        assert bool(((averaged > 0.8) & (averaged < 1)).all())
    wide = Terms(recipe, how(direction_spread=f"{HALF} rad"), store)
    states = [state for state, _ in wide.laws.points()]
    each = [float(wide._parts(height, None, state, None)["filtered_error"]) for state in states]
    assert len({round(x, 7) for x in each}) > 1
    assert float(wide.parts(height)["filtered_error"]) == pytest.approx(
        each[0] / 3 + sum(each[1:]) / 6, abs=1e-5
    )


@pytest.mark.slow
def test_the_filter_holds_the_worst_peak_of_the_laws(recipe, store):
    terms = Terms(recipe, how(direction_spread=f"{HALF} rad"), store)
    height = neusee.run(recipe, store=store, outputs=["height"])["height"]
    found = against_stops(terms, height)
    with torch.no_grad():
        worst = max(
            float(metrics.lsr(terms.psf(height, None, state)).max())
            for state, _ in terms.laws.points()
        )
        certain = float(metrics.lsr(terms.psf(height)).max())
    assert worst > 1.005 * certain
    assert found["lsr"] == pytest.approx(worst)
    assert found["filter"] == pytest.approx(0.03 / worst)
    plain = against_stops(Terms(recipe, how(), store), height)
    assert found["rows"][1]["filtered_error"] > plain["rows"][1]["filtered_error"]


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (
            {"direction_spread": "1 mrad", "psf": "mtf[mask]"},
            "direction_spread: mtf.mask. has no angle",
        ),
        (
            {"defocus_spread": "1 waves", "psf": "mtf[mask]"},
            "defocus_spread: the pupil of mtf.mask. has no defocus",
        ),
        ({"learn_stop": True}, "learn_stop: the pupil of psf.mask. has no shade .* use doe=shaded"),
    ],
)
def test_what_the_recipe_does_not_have_is_told_with_the_setting(values, said, recipe, store):
    with pytest.raises(DesignError, match=said):
        Terms(recipe, how(**values), store)
