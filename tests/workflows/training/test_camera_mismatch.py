"""A camera that differs from what its restorer is told: the truth is drawn, and belief stays
that of the recipe.
"""

import numpy as np
import pytest
import torch

from neusee.nodes import restore
from neusee.nodes.scene import Photographs
from neusee.workflows import RecipeError, Store, load
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import TOLD
from neusee.workflows.training.held_out import HELD_OUT
from neusee.workflows.training.resumable_loop import TrainingSession
from neusee.workflows.training.run_training import train
from neusee.workflows.training.training_pictures import PictureSource, Shared, TrainingStream
from tests.workflows.training.noise_photographs import noise_photograph
from tests.workflows.training.test_warm_start import TINY

CAMERA = [*TINY, "doe=half_ring", "train.picture=restored", "train.laser_free=0"]
DRAWN = (
    "optics.defocus=normal(0 waves, 0.1 waves)",
    "lasers.drawn.wavelength=normal(0 nm, 2 nm)",
    "lasers.drawn.angle=normal(0 urad, 13 urad)",
)

pytestmark = pytest.mark.usefixtures("one_thread")


def differing(*laws):
    return [f"+train.mismatch.{law}" for law in laws]


@pytest.fixture(scope="module")
def photograph(tmp_path_factory):
    file = tmp_path_factory.mktemp("photographs") / "one.png"
    noise_photograph().save(file)
    return file


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


def stream(words, photograph, store, held_out=()):
    recipe = load("train_small", words)
    return TrainingStream(
        recipe,
        recipe.training,
        PictureSource(Photographs((photograph,)), store, held_out=held_out),
        recipe,
    )


# --- what is simulated and what is told -----------------------------------------------------------


def test_laws_of_zero_width_leave_every_bit(photograph, store):
    plain = stream(CAMERA, photograph, store)
    words = differing(
        "optics.defocus=0 waves", "lasers.drawn.wavelength=0 nm", "lasers.drawn.angle=0 rad"
    )
    moved = stream([*CAMERA, *words], photograph, store)
    assert (plain.psf, moved.psf) == ("psf[mask]", f"{TOLD}psf[mask]")
    for number in range(2):
        one, other = plain({}, 2, number), moved({}, 2, number)
        assert all(torch.equal(x, other.tensors[name]) for name, x in one.tensors.items())


CERTAIN = [
    *CAMERA,
    "lasers={beam: {wavelength: 532 nm, fwhm: 10 nm, strength: 300, angle: [0.1 mrad, 0.2 mrad]}}",
    "sensor.exposure=0.1 s",
    "sensor.dark_current=0.002 e-",
    "sensor.offset=375 e-",
    "sensor.read_noise=10.5 e-",
    "sensor.c1=0",
    "sensor.c2=1",
    "sensor.background=0.5",
]
BIAS = (
    "optics.defocus=0.3 waves",
    "lasers.beam.wavelength=4 nm",
    "lasers.beam.angle=13 urad",
    "sensor.offset=1 e-",
)
BY_HAND = [
    "optics.defocus=0.3 waves",
    "sensor.offset=376 e-",
    "lasers.beam.wavelength=536 nm",
    "lasers.beam.angle=[0.113 mrad, 0.213 mrad]",
]


def test_the_frame_is_that_of_the_true_camera_and_the_filter_knows_the_other(photograph, store):
    """Two recipes by hand: one takes the frame, the other tells PSF and glare; the filter is
    called by itself.
    """
    mixed = stream([*CERTAIN, *differing(*BIAS)], photograph, store)
    theta, noise, _ = mixed._drawn(2, 0)
    camera, belief = (load("train_small", [*CERTAIN, *more]) for more in (BY_HAND, []))
    frame = as_function(
        camera, "scene", outputs=["raw[mask]", "clipped[mask]", "matrix"], store=store
    )
    taken = frame({"scene": theta["scene"]}, noise)
    signal = as_function(belief, "raw[mask]", outputs=["signal[mask]"])(
        {"raw[mask]": taken["raw[mask]"]}
    )
    told = run(
        belief, store, ["psf[mask]", "laser_photons[mask,beam]", "illuminant", "responses", "bands"]
    ).values
    channels = restore.wiener(
        signal["signal[mask]"],
        told["psf[mask]"],
        told["illuminant"],
        told["responses"],
        told["bands"],
        taken["clipped[mask]"],
        [told["laser_photons[mask,beam]"]],
        **belief.steps["deconvolved"].params,
    )
    expected = restore.colour(channels, taken["matrix"], **belief.steps["restored"].params)
    found, scale = mixed({}, 2, 0).picture[0], float(expected.abs().max())
    assert float((found - expected).abs().max()) <= 1e-5 * scale
    knows = stream([*CERTAIN, *BY_HAND], photograph, store)({}, 2, 0).picture[0]
    assert float((found - knows).abs().max()) > 1e-2 * scale


def test_the_truth_is_drawn_by_its_law_and_belief_is_not(photograph, store):
    samples = stream([*CAMERA, *differing(*DRAWN)], photograph, store)
    drawn = [samples._drawn(2, number)[0] for number in range(300)]
    defocus = np.array([theta["pupil[mask].defocus"] for theta in drawn])
    assert defocus.std() == pytest.approx(0.1, rel=0.15)
    assert [theta["laser_pupil[mask,drawn].defocus"] for theta in drawn] == list(defocus)
    off = np.array(
        [
            theta["line[drawn].wavelength"] - theta[f"{TOLD}line[drawn].wavelength"]
            for theta in drawn
        ]
    )
    assert off.std() == pytest.approx(2e-9, rel=0.15)
    angles = np.array([theta["laser_psf[mask,drawn].angle"] for theta in drawn])
    assert angles.std(0) == pytest.approx([13e-6, 13e-6], rel=0.15)
    assert abs(np.corrcoef(angles.T)[0, 1]) < 0.2
    recipe = samples._simulate.recipe
    assert recipe.steps[f"{TOLD}pupil[mask]"].params["defocus"] == 0
    assert recipe.steps[f"{TOLD}laser_psf[mask,drawn]"].params["angle"] == (0.0, 0.0)
    assert not any(
        name.startswith(TOLD) for name in drawn[0] if name.endswith(("defocus", "angle"))
    )


def test_held_out_pictures_have_the_same_draws_at_every_validation(photograph, store):
    samples = stream([*CAMERA, *differing(*DRAWN)], photograph, store, [photograph] * 2)
    first, again = samples({}, HELD_OUT, 1), samples({}, HELD_OUT, 1)
    assert torch.equal(first.picture, again.picture)
    assert first.drawn == again.drawn
    assert (
        samples._drawn(HELD_OUT, 0)[2]["mismatch optics.defocus"]
        != first.drawn["mismatch optics.defocus"]
    )


def test_a_factor_multiplies_what_the_recipe_draws(photograph, store):
    samples = stream([*CAMERA, *differing("sensor.exposure=lognormal(1, 1.1)")], photograph, store)
    theta, _, drawn = samples._drawn(2, 5)
    true = drawn["sensor.exposure"] * drawn["mismatch sensor.exposure"]
    assert theta["scene_photons[mask].exposure"] == true != drawn["sensor.exposure"]
    assert theta["matrix.exposure"] == drawn["sensor.exposure"]


DUSTY = [
    "flare=dirty_windshield",
    "dirt={dust: 0, scratches: 0, grease: 0 waves, smudges: 0, dents: 0 waves}",
    "ghosts.energy=0",
]


def test_dirt_that_nobody_knows_is_another_in_every_picture_and_is_told_clean(photograph, store):
    samples = stream(
        [*CAMERA, *DUSTY, *differing("dirt.grease=uniform(0 waves, 0.1 waves)")], photograph, store
    )
    recipe = samples._simulate.recipe
    assert recipe.steps["pupil[mask]"].wires["dirt"] == "dirt"
    assert recipe.steps[f"{TOLD}pupil[mask]"].wires["dirt"] is None, (
        "a told window that is clean has no effect"
    )
    assert "dirt" in samples._simulate.live, "it is computed for each picture"


def test_the_height_error_is_drawn_for_the_camera_alone(photograph, store):
    words = [*CAMERA, "+height_error=smooth"]
    plain = stream(words, photograph, store)
    law = differing("height_error.rms=uniform(0 nm, 40 nm)", "height_error.depth=normal(0, 0.02)")
    rough = stream([*words, *law], photograph, store)
    assert {"made", f"{TOLD}made"} <= rough._simulate.recipe.steps.keys()
    assert rough._simulate.recipe.steps[f"{TOLD}made"].params["rms"] == 0
    assert ("made" in rough._simulate.live, f"{TOLD}made" in rough._simulate.live) == (
        True,
        False,
    )
    off = [float((plain({}, 2, n).picture - rough({}, 2, n).picture).abs().max()) for n in range(2)]
    assert min(off) > 1e-3


# --- pools and trainings --------------------------------------------------------------------------


@pytest.mark.slow
def test_a_pool_of_another_law_is_another_pool(tmp_path, photograph):
    def counts(*laws, seed=7):
        words = [
            *CAMERA,
            "train.picture=developed[mask]",
            "train.pool=1",
            f"seed={seed}",
            *differing(*laws),
        ]
        samples = stream(words, photograph, Store(tmp_path))
        samples({}, 2, 0)
        return samples.pool_counts["simulated"]

    assert counts(DRAWN[0]) == 1
    assert counts(DRAWN[0]) == 0
    assert counts("optics.defocus=normal(0 waves, 0.2 waves)") == 1
    assert counts(DRAWN[0], seed=8) == 1
    assert counts() == 1


@pytest.mark.slow
def test_a_mask_is_trained_for_what_is_told_of_it(tmp_path, photograph):
    words = [
        *TINY,
        "doe=unet",
        "doe.grid=32",
        "train.learn=height",
        "train.stages.1.iterations=1",
        "train.stages.1.batch=1",
        "train.stages.1.adversarial=0",
        "train.picture=restored",
    ]
    made = ["+height_error=smooth", *differing("height_error.rms=uniform(0 nm, 20 nm)")]
    recipe = load("train_small", [*words, *differing(*DRAWN), *made])
    found = train(
        recipe, TrainingSession(Store(tmp_path), tmp_path / "runs", lambda line: None), (1, 2)
    )
    assert (found / "mask.safetensors").is_file()
    other = train(
        load("train_small", words),
        TrainingSession(Store(tmp_path), tmp_path / "runs", lambda line: None),
        (1,),
    )
    assert other != found


# --- mistakes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("law", "said"),
    [
        (
            "optics.defocuss=normal(0 waves, 0.1 waves)",
            "the recipe has no value optics.defocuss; did you mean",
        ),
        (
            "optics.defocus=normal(0 nm, 1 nm)",
            "added to optics.defocus, whose unit is waves, not m",
        ),
        ("optics.defocus=lognormal(1, 2)", "optics.defocus is 0, and 0 times lognormal"),
        (
            "sensor.offset=lognormal(1 e-, 2)",
            "lognormal multiplies sensor.offset: write the distribution without the unit e-",
        ),
        (
            "optics.defocus=normal(0 waves, 0 waves)",
            "the standard deviation must be greater than 0",
        ),
        ("optics.defocus=maybe", "maybe is neither a number nor a quantity"),
        ("optics.aberrations=normal(0 nm, 1 nm)", "neither a number nor a quantity"),
        ("mask.levels=normal(0, 1)", "mask.levels is null, so no distribution can vary it"),
    ],
)
def test_a_law_that_no_value_can_have_is_one_located_mistake_of_the_recipe(law, said):
    with pytest.raises(RecipeError) as error:
        load("train_small", [*TINY, *differing(law)])
    (one,) = error.value.diagnostics
    assert str(one.mark).startswith("argument")
    assert one.path.startswith(f"train.mismatch.{law.partition('=')[0]}")
    assert said in one.message


@pytest.mark.parametrize(
    ("laws", "said"),
    [
        (
            ["dirt.grease=uniform(-1 waves, 0.1 waves)", "sensor.offset=1 e-"],
            "greater than or equal to 0",
        ),
        (["restore.balance=normal(0, 0.1)"], "no step before the frame reads it"),
    ],
)
def test_what_no_camera_can_have_is_a_mistake_before_any_work(tmp_path, laws, said):
    recipe = load("train_small", [*CAMERA, *DUSTY, "ghosts.count=0", *differing(*laws)])
    with pytest.raises(RecipeError, match=said):
        train(recipe, TrainingSession(Store(tmp_path), tmp_path / "runs", lambda line: None), (2,))
    assert not (tmp_path / "runs").exists()


def test_the_packaged_laws_are_those_of_the_guide():
    recipe = load("train_small", [*CAMERA, "+mismatch=usual"])
    assert recipe.training.mismatch == dict(law.split("=") for law in DRAWN)
    assert list(recipe.uncertain.mismatch) == [law.partition("=")[0] for law in DRAWN]


def test_a_design_that_is_told_unchanged_shares_one_gradient_with_the_camera():
    """The told mask without an error is the same tensor as the mask; the gradient of both is the
    sum.
    """
    height = torch.tensor([1.0, 2.0], requires_grad=True)
    design = 3 * height
    shared = Shared.of({"fabricated": design, f"{TOLD}made": design})
    (shared.values["fabricated"].sum() + 10 * shared.values[f"{TOLD}made"].sum()).backward()
    shared.back()
    assert height.grad.tolist() == [33.0, 33.0]
