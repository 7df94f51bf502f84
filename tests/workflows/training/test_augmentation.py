"""Changed scenes of a training: before the camera, from the seed alone, and never of held-out
photographs.
"""

import json
from pathlib import Path

import pytest
import torch

from neusee.nodes.scene import Change, Photographs, symmetry
from neusee.workflows import RecipeError, Store, load
from neusee.workflows.training.training_pictures import PictureSource, Shared, TrainingStream
from tests.workflows.training.noise_photographs import noise_photograph
from tests.workflows.training.test_warm_start import TINY, trained

ALL = ["train.augment.symmetries=all", "train.augment.exposure=2", "train.augment.colour=0.3"]
POOLED = ["train.pool=2", "train.augment.pooled=turned_mask"]

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def photograph(tmp_path_factory):
    file = tmp_path_factory.mktemp("photographs") / "one.png"
    noise_photograph().save(file)
    return file


def stream(words, photograph, folder):
    recipe = load("train_small", [*TINY, *words])
    source = PictureSource(Photographs((photograph,)), Store(folder), held_out=(photograph,))
    return TrainingStream(recipe, recipe.training, source, recipe)


def test_the_camera_sees_the_changed_scene_and_held_out_ones_as_they_are(tmp_path, photograph):
    plain, changed = (stream(words, photograph, tmp_path) for words in ([], ALL))
    for number in range(6):
        theta, noise, drawn = changed._drawn(2, number)
        change = Change.drawn((7, 2, number, 3), True, 2.0, 0.3)
        crop = Photographs((photograph,)).crop((32, 32), 7, (2, number))
        assert torch.equal(theta["scene"], change.of(crop, (32, 32)))
        other, same_noise, same = plain._drawn(2, number)
        assert torch.equal(other["scene"], crop)
        assert (noise, drawn) == (same_noise, same), (
            "laser, sensor and noise are those without changes"
        )
        assert all(theta[name] == x for name, x in other.items() if name != "scene")
    assert torch.equal(changed._drawn(3, 0)[0]["scene"], plain._drawn(3, 0)[0]["scene"])


def test_a_pooled_pair_is_turned_together_and_otherwise_each_time(tmp_path, photograph):
    plain, turned = (stream(words, photograph, tmp_path) for words in (POOLED[:1], POOLED))
    none = Shared.of({})
    seen = set()
    for number in range(8):
        ((_, expected),), ((_, found),) = (
            list(s.batch(none, 2, number, 1)) for s in (plain, turned)
        )
        for name in ("picture", "truth"):
            assert torch.equal(
                getattr(found, name), symmetry(getattr(expected, name), (7, 2, number, 4))
            )
        seen.add(found.truth.numpy().tobytes())
    assert len(seen) > 4, "two pooled pictures, each turned in several ways"
    again = stream(POOLED, photograph, tmp_path)
    assert torch.equal(next(again.batch(none, 2, 7, 1))[1].picture, found.picture), (
        "as after a stop"
    )
    for kept in (plain, turned):
        ((_, held),) = kept.batch(none, 3, 0, 1)
        assert torch.equal(held.picture, kept({}, 3, 0).picture), "a held-out picture is not turned"


@pytest.mark.slow
def test_a_training_says_that_it_turns_its_pool_and_needs_a_pool_for_it(tmp_path):
    lines = []
    folder = trained(POOLED, tmp_path, lines)
    assert any("as behind a mask and a sensor that turn" in line for line in lines)
    assert (
        json.loads((folder / "training.json").read_text())["train"]["augment"]["pooled"]
        == "turned_mask"
    )
    assert Path(trained([], tmp_path)) != folder
    with pytest.raises(RecipeError, match="there is no pool whose pictures could be turned"):
        load("train_small", [*TINY, POOLED[1]])
