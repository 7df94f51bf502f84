"""A stop that is learnt with the mask: its gradient, its price in light, and the recipe that
repeats the result.
"""

import json

import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import load_file

import neusee
from neusee.nodes import losses
from neusee.workflows import load
from neusee.workflows.recipe.blocks.train_block import MaskTraining
from neusee.workflows.store.result_store import Store
from neusee.workflows.training import design_run
from neusee.workflows.training import mask_optimisers as gradient_descent
from neusee.workflows.training.design_run import design, mask_figures
from neusee.workflows.training.design_terms import Terms

SMALL = [
    "optics.samples=48",
    "optics.pitch=168 um",
    "optics.window=[48, 48]",
    "optics.bands=3",
    "doe=shaded",
    "scene.shape=[48, 48]",
    "sensor.shape=[32, 32]",
    "lasers.green.angle=[0 mrad, 0 mrad]",
]


@pytest.fixture(scope="module")
def recipe():
    return load("first_light", SMALL)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("cache"))


def how(**values):
    given = {"bands": None, "limit": 0.03, "weights": {"lsr": 0, "bsr": 0, "filtered_error": 1}, "learn_stop": True,
             "kind": "polynomial", "degree": 4, "waves": 0.5}  # fmt: skip
    return MaskTraining.model_validate({**given, **values})


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["polynomial", "streak"])
def test_the_loss_falls_with_mask_and_stop_and_the_recipe_repeats_it(
    kind, recipe, store, tmp_path, monkeypatch
):
    monkeypatch.setattr(design_run, "design_pictures", lambda *_: {})
    given, said = how(kind=kind, iterations=12, learning_rate=0.1), []
    terms = Terms(recipe, given, store)
    start = gradient_descent.shape_of(terms, 0)
    before = float(terms.total(gradient_descent._parts(terms, start)).detach())
    folder = design(recipe, given, store, tmp_path, said.append)
    found = json.loads((folder / "mask.json").read_text())
    assert found["loss"] < before
    assert 0.1 < found["stop"] < 0.95
    assert f"learnt stop: {found['stop']:.3g} of the diameter of the lens" in said
    height = load_file(folder / "mask.safetensors")["height"]
    again = load("first_light", [*SMALL, f"doe.diameter={found['stop']!r}"])
    figures = mask_figures(Terms(again, how(learn_stop=False), store), height)
    assert figures["bands"]["lsr"] == pytest.approx(found["bands"]["lsr"])
    assert figures["protected"]["rows"] == found["protected"]["rows"]
    assert figures["protected"]["stop"] == found["stop"]
    assert f"a stop of {found['stop']:.3g} and a grey filter" in " ".join(
        next(folder.glob("*.html")).read_text().split()
    )


def test_the_light_that_a_stop_takes_lowers_signal_and_noise(recipe, store):
    half = load("first_light", [*SMALL, "doe.diameter=0.5", "doe.transmittance=0.8"])
    terms, flat = Terms(half, how(learn_stop=False), store), torch.zeros(48, 48)
    passed = float(terms.passed()["transmittance"])
    assert passed == pytest.approx(0.8 * 0.25, rel=0.05)
    expected = losses.filtered_error(
        neusee.run(half, store=store, outputs=["psf[mask]"])["psf[mask]"],
        *terms.seen(),
        light=30,
        read_noise=10.5,
        limit=0.03,
        transmittance=passed,
        power=16.0,
    )
    assert float(terms.parts(flat)["filtered_error"]) == pytest.approx(float(expected), abs=1e-6)


def test_a_stop_has_a_gradient_in_light_and_in_peak(recipe, store):
    terms = Terms(recipe, how(), store)
    shape = gradient_descent.shape_of(terms, 0)
    values, slopes = [], []
    for step in (0.0, 0.1, -0.2):
        shape.round.logit.data += step
        loss = terms.total(gradient_descent._parts(terms, shape))
        values.append(float(loss.detach()))
        slopes.append(float(torch.autograd.grad(loss, shape.round.logit)[0]))
    assert slopes[0] == pytest.approx((values[1] - values[2]) / 0.2, rel=0.1)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (
            {"limit": None, "weights": {"lsr": 1}},
            "learn_stop = true: only weights.filtered_error and",
        ),
        (
            {"kind": "five_half_rings"},
            "learn_stop = true: a mask of the kind five_half_rings has no gradient",
        ),
        ({"degree": 1}, "greater than or equal to 2"),
        ({"wavelength_spread": "-1 nm"}, "greater than or equal to 0"),
        ({"direction_spread": "-1 mrad"}, "greater than or equal to 0"),
    ],
)
def test_settings_that_cannot_be_are_refused(values, said):
    with pytest.raises(ValidationError, match=said):
        how(**values)
