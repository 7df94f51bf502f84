"""Pictures of a training of the unrolled filter: the filter's own, with the problem that it
solved.
"""

import pytest
import torch

from neusee.nodes import restore
from neusee.nodes.scene import Photographs
from neusee.workflows import RecipeError, Store, load
from neusee.workflows.engine.runner import run
from neusee.workflows.training.training_pictures import PictureSource, TrainingStream
from tests.workflows.training.noise_photographs import noise_photograph
from tests.workflows.training.test_warm_start import TINY, trained

OTHER = [*TINY, "doe=half_ring", "train.picture=restored", "train.pool=2"]
POSED = [*OTHER, "train.network={kind: unrolled, width: 2, steps: 1}"]

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def photograph(tmp_path_factory):
    file = tmp_path_factory.mktemp("photographs") / "one.png"
    noise_photograph().save(file)
    return file


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


def stream(words, photograph, store):
    recipe = load("train_small", words)
    return TrainingStream(
        recipe, recipe.training, PictureSource(Photographs((photograph,)), store), recipe
    )


def test_the_picture_is_that_of_any_network_behind_the_filter_and_the_problem_has_it_as_its_answer(
    photograph, store
):
    posed, other = stream(POSED, photograph, store), stream(OTHER, photograph, store)
    one, same = posed({}, 2, 0), other({}, 2, 0)
    assert one.drawn == same.drawn
    assert torch.equal(one.truth, same.truth)
    assert torch.allclose(one.picture, same.picture, rtol=0, atol=1e-5)
    assert same.given == ()
    problem, matrix = one.given
    told = restore.colour(problem.answer * problem.scale + problem.mean, matrix)
    assert torch.allclose(told, one.picture[0], rtol=0, atol=1e-4)


INFORMED = [*OTHER, "train.network={kind: informed, width: 2}"]


def test_what_the_informed_network_sees_is_turned_with_the_picture(photograph, store):
    one = stream([*INFORMED, "train.augment.pooled=turned_mask"], photograph, store)
    sample = one({}, 2, 0)
    known, matrix = sample.given
    assert torch.allclose(
        restore.colour(known.answer * known.scale + known.mean, matrix),
        sample.picture[0],
        atol=1e-4,
    )
    number = next(
        n for n in range(2, 99, 2) if not torch.equal(one.turned(sample, 2, n).truth, sample.truth)
    )
    other = one.turned(sample, 2, number)
    seen, own = other.given
    assert torch.equal(own, matrix)
    assert torch.allclose(
        restore.colour(seen.answer * seen.scale + seen.mean, own), other.picture[0], atol=1e-4
    )
    assert torch.equal(seen.maps[:3], seen.answer)
    assert torch.allclose(seen.deviation.sum((1, 2)), known.deviation.sum((1, 2)), rtol=1e-5)


@pytest.mark.slow
def test_the_store_gives_back_the_bits_of_picture_and_problem(photograph, store):
    first, again = (stream(POSED, photograph, store)({}, 2, 1) for _ in range(2))
    assert len(first.tensors) == 13
    assert all(torch.equal(x, again.tensors[name]) for name, x in first.tensors.items())
    assert type(again.given[0]) is type(first.given[0])


@pytest.mark.slow
def test_under_a_mismatch_the_problem_is_that_of_the_recipe(photograph, store):
    plain = stream(POSED, photograph, store)({}, 2, 0)
    moved = stream([*POSED, "+train.mismatch.optics.defocus=0.3 waves"], photograph, store)(
        {}, 2, 0
    )
    assert torch.equal(moved.given[0].psf, plain.given[0].psf)
    assert not torch.equal(moved.given[0].picture, plain.given[0].picture)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("train.patch=[8, 8]", "restores a whole picture behind a fixed mask: write patch: null"),
        ("train.export=[pt2]", "torch.export and ONNX cannot represent the filter"),
        ("train.augment.pooled=turned_mask", "write augment.pooled: none"),
        (
            "train.network={kind: unet, steps: 3}",
            "these options belong to the network unrolled, not to unet",
        ),
    ],
)
def test_settings_that_the_network_cannot_have_are_refused(word, message):
    with pytest.raises(RecipeError, match=message):
        load("train_small", [*POSED, word])


def test_a_training_on_another_picture_than_that_of_the_filter_is_refused(photograph, store):
    with pytest.raises(
        ValueError, match=r"train.picture.*the network unrolled starts from the Wiener filter"
    ):
        stream([*POSED, "train.picture=developed[mask]"], photograph, store)


@pytest.mark.slow
def test_a_recipe_takes_the_trained_network(tmp_path):
    weights = trained([*POSED, "train.rates.weights=1e-2"], tmp_path) / "network.safetensors"
    camera = [word for word in TINY if not word.startswith("train.")]
    words = [*camera, "doe=half_ring", "laser=none", "outputs=[restored]"]
    taken = [
        "restore=unrolled",
        f"restore.weights={weights}",
        "restore.width=2",
        "restore.unrolled=1",
    ]
    told, found = (
        run(load("first_light", [*words, *more]), Store(tmp_path))["restored"]
        for more in ([], taken)
    )
    assert torch.isfinite(found).all()
    assert not torch.equal(found, told)
