"""Pictures of several cameras in turn: those of recipes that have one of the cameras each."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from neusee import recipes
from neusee.nodes.scene import Photographs
from neusee.workflows import RecipeError, Store, load
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.training.held_out import Split, means_by_photograph
from neusee.workflows.training.process_mesh import Mesh, MeshError
from neusee.workflows.training.run_training import inputs_of
from neusee.workflows.training.training_pictures import (
    HELD_OUT,
    PictureSource,
    SeveralCameras,
    Shared,
    TrainingStream,
    require_alone,
)
from tests.workflows.training.noise_photographs import noise_photograph
from tests.workflows.training.test_posed_pictures import POSED
from tests.workflows.training.test_warm_start import trained

pytestmark = pytest.mark.usefixtures("one_thread")
WORDS = [*POSED, "train.pool=3", "+mismatch=usual", "sensor.read_noise=uniform(5 e-, 12 e-)"]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    noise_photograph().save(folder / "one.png")
    np.save(folder / "mask.npy", np.random.default_rng(3).uniform(0, 1e-6, (48, 48)))
    return folder


@pytest.mark.slow
def test_picture_n_is_of_camera_n_and_a_held_out_photograph_is_seen_by_every_camera(
    files, tmp_path
):
    """The references are recipes with the words of a camera as arguments, and a stream that
    knows one camera.
    """
    store, photographs = Store(tmp_path), Photographs((files / "one.png",))
    masked = ["doe=pixelwise", f"doe.file={files / 'mask.npy'}"]
    others = [["doe=flat", "sensor.background=loguniform(0.02, 0.5)"], masked]
    recipe = load("train_small", [*WORDS, f"train.cameras={json.dumps(others)}"])
    mixed = SeveralCameras(
        recipe, recipe.training, PictureSource(photographs, store, held_out=photographs.paths)
    )

    def alone(words, stage, number):
        other = load("train_small", [*WORDS, *words])
        held_out = photographs.paths * 3
        stream = TrainingStream(
            other, other.training, PictureSource(photographs, store, held_out=held_out), other
        )
        return stream({}, stage, number)

    found = dict(mixed.batch(Shared.of({}), 2, 1, 3))  # the last is the first of the pool again
    judged = dict(mixed.batch(Shared.of({}), HELD_OUT, 0, 3))
    for number, words in enumerate([[], *others]):
        for sample, stage in ((found[(number - 1) % 3], 2), (judged[number], HELD_OUT)):
            expected = alone(words, stage, number)
            assert sample.drawn == expected.drawn
            assert torch.equal(sample.truth, expected.truth)
            assert torch.equal(sample.picture, expected.picture)
            assert torch.equal(sample.given[0].psf, expected.given[0].psf)
    assert not torch.equal(judged[0].given[0].psf, judged[1].given[0].psf)
    assert mixed.pool_counts["simulated"] == 3


def test_a_photograph_counts_once_whatever_the_number_of_its_pictures():
    found = {
        "0 a": 1.0,
        "1 a": 3.0,
        "2 a": 5.0,
        "3 a": 9.0,
        "0 b": 2.0,
        "1 b": 2.0,
        "2 b": 4.0,
        "3 b": 4.0,
    }
    assert means_by_photograph(found, 2) == {"0 a": 2.0, "1 a": 7.0, "0 b": 2.0, "1 b": 4.0}
    assert means_by_photograph(found, 1) == found


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train.cameras=[[doe=nothing]]"], r"argument \d+.*nothing"),
        (["train.cameras=[[sensor.well=3]]"], r"argument \d+.*unknown"),
        (
            ["train.cameras=[[doe=flat, train.pool=3]]"],
            r"train\.cameras\.0.*train\.pool=3 does not set a parameter of a camera",
        ),
        (
            ["train.cameras=[[doe=flat]]", "train.learn=height"],
            "need a mask that is not trained: write learn: null",
        ),
    ],
)
def test_cameras_that_cannot_be_are_refused(words, message):
    kind = ["train.network={kind: unet, width: 4}", "train.picture=developed[mask]"]
    with pytest.raises(RecipeError, match=message):
        load("train_small", [*POSED, *kind, *words])


def test_a_file_of_a_camera_is_sought_beside_the_recipe_and_counts_by_its_content(files, tmp_path):
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "mine.npy").write_bytes((files / "mask.npy").read_bytes())
    text = (Path(recipes.__file__).parent / "train_small.yaml").read_text()
    block = "train:\n  cameras:\n    - [doe=pixelwise, doe.file=masks/mine.npy]\n"
    (tmp_path / "mine.yaml").write_text(text.replace("train:\n", block, 1))
    recipe = load(tmp_path / "mine.yaml", POSED)
    assert recipe.cameras[0].steps["height"].params["file"] == tmp_path / "masks" / "mine.npy"
    assert recipe.cameras[0].cameras == ()

    def key():
        split = Split(Photographs((files / "one.png",)))
        return inputs_of(
            recipe, recipe.training, split, None, Code(Store(tmp_path / "store").code_memo)
        ).key

    before = key()
    np.save(tmp_path / "masks" / "mine.npy", np.zeros((48, 48)))
    assert key() != before


def test_several_processes_are_refused():
    recipe = load("train_small", [*POSED, "train.cameras=[[doe=flat]]"])
    with pytest.raises(MeshError, match="runs in a single process"):
        require_alone(recipe, Mesh(2))


@pytest.mark.slow
def test_a_training_of_two_cameras_validates_and_is_not_that_of_one(tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    for i in range(2):
        noise_photograph(40 + 20 * i, i).save(folder / f"{i}.png")
    words = [*POSED, f"train.photographs={folder}", "train.held_out=0.5", "train.validate_every=1"]
    found = trained([*words, "train.cameras=[[doe=flat]]"], tmp_path)
    rows = list(csv.DictReader((found / "losses.csv").read_text().splitlines()))
    assert len(rows) == 2
    assert all(float(row["held_out_PSNR"]) > 0 for row in rows)
    assert trained(words, tmp_path) != found


def test_pooled_pictures_of_several_cameras_are_turned_too():
    class Stream:
        def __init__(self, mask):
            self.mask = mask

        def __call__(self, seen, stage, number):
            return f"picture {number} behind {self.mask}"

        def turned(self, sample, stage, number):
            return f"turned {sample}"

    mixed = SeveralCameras.__new__(SeveralCameras)
    mixed.repeats, mixed._pool, mixed._streams = 2, 3, [Stream("ring"), Stream("flat")]
    found = [sample for _, sample in mixed.batch(Shared.of({}), 2, 2, 2)]
    assert found == ["turned picture 2 behind ring", "turned picture 3 behind ring"]
