"""A recipe's camera as a physics of deepinv: the tests of deepinv's own operators, a clipped
likelihood, restorations.

Where torchvision is missing, a stand-in takes its place: see
`tests/deepinv_without_torchvision.py`.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from scipy import stats

import neusee
from neusee.nodes.metrics import quality
from neusee.workflows import as_physics, load
from neusee.workflows.store.result_store import Store
from tests.deepinv_without_torchvision import deepinv_or_skip

deepinv = deepinv_or_skip()

SMALL = {
    "scene": {"shape": [64, 64]},
    "sensor": {"shape": [48, 40]},
    "optics": {"samples": 128, "pitch": "63.11 um", "window": [48, 48], "bands": 5},
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


@pytest.fixture(scope="module")
def recipe():
    """A camera behind half rings, with a laser that clips a few pixels."""
    return load("first_light", lasers={"green": {"strength": 1e5}}, **SMALL)


@pytest.fixture
def physics(recipe, store):
    return as_physics(recipe, store=store)


@pytest.fixture
def double(recipe, store):
    return as_physics(recipe, store=store, dtype=torch.float64)


@pytest.fixture(autouse=True)
def _quiet():
    """deepinv warns of its own next version, and of torch's."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.manual_seed(0)
        yield


def test_some_pixels_clipped_and_most_did_not(physics):
    assert 0.0005 < 1 - float(physics.mask.mean()) < 0.2


@pytest.mark.parametrize(("dtype", "most"), [(torch.float32, 1e-6), (torch.float64, 1e-12)])
def test_the_adjointness_test_of_deepinv_passes(physics, double, dtype, most):
    camera = physics if dtype == torch.float32 else double
    assert float(camera.adjointness_test(num_samples=64, dtype=dtype)) < most


def test_the_norm_that_deepinv_computes_is_that_of_a_dense_matrix(double):
    patch = torch.zeros_like(double.mask)
    patch[1, 10:26, 8:24] = 1.0  # a camera with 256 pixels, so that the matrix is small
    double.update(mask=patch)
    norm = double.compute_norm(
        torch.randn(1, *double.img_size).double(), 2000, 1e-9, verbose=False, squared=False
    )
    rows = torch.zeros(256, *double.frame.shape[1:], dtype=torch.float64)
    rows[:, 1, 10:26, 8:24] = torch.eye(256, dtype=torch.float64).reshape(256, 16, 16)
    matrix = double.A_adjoint(rows)[:, 1].flatten(1)
    exact = torch.linalg.eigvalsh(matrix @ matrix.T)[-1].sqrt()
    assert float(norm) == pytest.approx(float(exact), rel=2e-3)
    assert 0.1 < float(exact) <= 1 + 1e-9


@pytest.mark.parametrize("solver", ["CG", "lsqr"])
def test_the_pseudo_inverse_of_deepinv_gives_the_frame_again(recipe, store, solver):
    lens = as_physics(recipe, arm="plain", store=store, dtype=torch.float64)
    frame = lens.A(torch.rand(2, *lens.img_size).double())
    scene = lens.A_dagger(frame, solver=solver, max_iter=250, tol=1e-10)
    assert float((lens.A(scene) - frame).norm() / frame.norm()) < 1e-3


def test_the_proximal_step_of_deepinv_solves_its_equation(double):
    frame, start = double.frame, torch.rand(1, *double.img_size).double()
    found = double.prox_l2(start, frame, gamma=3.0, max_iter=60, tol=1e-12)
    slope = 3.0 * double.A_adjoint(double.A(found) - frame) + found - start
    assert float(slope.norm() / start.norm()) < 1e-6


def test_batches_types_and_transforms(physics):
    scenes = torch.rand(3, *physics.img_size)
    whole = physics.A(scenes)
    assert whole.shape == (3, *physics.frame.shape[1:])
    torch.testing.assert_close(torch.func.vmap(physics.A)(scenes), whole)
    torch.testing.assert_close(torch.func.jvp(physics.A, (scenes,), (scenes,))[1], whole)
    torch.testing.assert_close(
        torch.func.vjp(physics.A, scenes)[1](whole)[0], physics.A_adjoint(whole)
    )
    slope = torch.func.grad(lambda x: 0.5 * (physics.A(x) - physics.frame).square().sum())(scenes)
    torch.testing.assert_close(
        slope, physics.A_adjoint(whole - physics.frame), rtol=1e-4, atol=2e-5
    )
    assert (
        physics.A(scenes.double()).dtype == physics.A_adjoint(whole.double()).dtype == torch.float64
    )
    assert physics.double().A(scenes.double()).dtype == torch.float64


def test_the_blur_is_that_of_the_recipe(double, recipe, store):
    """A frame of the recipe without noise, from an independent sum over the scene of one
    channel's PSF.
    """
    result = neusee.run(
        recipe,
        store=store,
        outputs=[f"{name}" for name in ("psf[mask]", "illuminant", "responses", "bands")],
    )
    share = np.array(
        result["responses"] * result["illuminant"] * result["bands"].centres, dtype=float
    )
    kernel = np.tensordot(
        share[1] / share[1].sum(), result.numpy("psf[mask]").intensity.astype(float), 1
    )
    scene = torch.zeros(1, *double.img_size, dtype=torch.float64)
    top, left = double.blur.corner()
    scene[0, 1, top + 20, left + 15] = 1.0
    found = double.blur.seen(scene)[0, 1].numpy() * double.frame_unit / double.unit
    # the axis of the PSF at sample 24 of 48
    placed = kernel[24 - 20 : 24 - 20 + 48, 24 - 15 : 24 - 15 + 40]
    seen = placed[:44, :39]
    np.testing.assert_allclose(found[:44, :39], seen, atol=2e-3 * kernel.max())


def test_a_frame_in_electrons_is_the_signal_where_it_did_not_clip(physics, recipe, store):
    signal, clipped = (
        neusee.run(recipe, store=store, outputs=[name])[name]
        for name in ("signal[mask]", "clipped[mask]")
    )
    found = physics.electrons(physics.frame)[0]
    torch.testing.assert_close(found[~clipped], signal[~clipped], rtol=1e-5, atol=0.01)
    assert not physics.frame[0][clipped].any()
    assert torch.equal(physics.mask, (~clipped).float())


def test_the_even_scene_has_the_mean_of_the_frame(double):
    even = double.even()
    assert even.shape == (1, *double.img_size)
    assert torch.equal(even, even[..., :1, :1].expand_as(even))
    found, wanted = double.A(even).mean((-2, -1)), double.frame.mean((-2, -1))
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=0)


def test_known_glare_is_taken_away_from_the_frame_and_added_to_its_noise(recipe, store):
    glare = torch.full((3, 64, 64), 500.0)
    plain, with_glare = (
        as_physics(recipe, store=store),
        as_physics(recipe, store=store, glare=glare),
    )
    away = (plain.frame - with_glare.frame) * plain.frame_unit
    torch.testing.assert_close(away[0], 500.0 * plain.mask, rtol=1e-4, atol=0.01)
    for camera, electrons in ((plain, 0.25), (with_glare, 500.0)):
        camera.update(mask=torch.ones_like(camera.mask))
        dark = torch.zeros(40, *camera.img_size)
        measured = camera(dark, seed=1) * camera.frame_unit
        variance = electrons + 10.5**2 + 0.37**2 / 12
        assert float(measured.var()) == pytest.approx(variance, rel=0.05 if electrons > 1 else 0.02)
        # clipped at 0 e-: +0.1 e-
        assert abs(float(measured.mean())) < 5 * (variance / measured.numel()) ** 0.5 + 0.15
    with pytest.raises(
        ValueError, match=r"glare \(64, 64\) must be \(channel, y, x\) with the 3 channels"
    ):
        as_physics(recipe, store=store, glare=glare[0])


def test_noise_is_the_same_for_the_same_seed_and_the_mask_of_a_simulated_frame_is_found(physics):
    bright = torch.full((2, *physics.img_size), 0.3)
    top, _ = physics.blur.corner()
    bright[..., top + 20 : top + 24, :] = 2000.0
    first, other = physics(bright, seed=4), physics(bright, seed=4)
    assert torch.equal(first, other)
    assert not torch.equal(first, physics(bright, seed=5))
    physics.update(mask=torch.ones_like(physics.mask))
    mask = physics.unclipped(physics(bright, seed=4))
    assert 0 < float((1 - mask).mean()) < 1


# --- the likelihood -------------------------------------------------------------------------------


def test_the_likelihood_is_the_sum_of_scipys_densities_and_tails(double):
    scenes = torch.rand(2, *double.img_size).double()
    y = double.frame.expand(2, -1, -1, -1)
    found = double.likelihood(scale=1.0).fn(scenes, y, double)
    # dark electrons of the recipe
    expected = (double.blur.seen(scenes) * double.frame_unit).numpy() + 0.002
    measured, known = y.numpy() * double.frame_unit + 0.002, double.mask.bool().numpy()
    sigma = np.sqrt(np.maximum(expected, 0) + 10.5**2 + 0.37**2 / 12)
    level = (int(25500 / 0.37 - 0.5) if 25500 / 0.37 < 65535 else 65535) - 0.5
    tails = -stats.norm.logsf((level * 0.37 - 390.0 - expected) / sigma)
    whole = np.where(known, -stats.norm.logpdf(measured, expected, sigma), tails).sum((1, 2, 3))
    np.testing.assert_allclose(found, whole, rtol=1e-10)


@pytest.mark.parametrize("floor", [0.0, 0.2])
def test_the_gradient_of_the_likelihood_is_that_of_finite_differences(double, floor):
    likelihood, scene = (
        double.likelihood(floor, scale=1.0),
        0.3 + torch.rand(1, *double.img_size).double(),
    )
    way = torch.randn_like(scene)

    def value(t):
        return likelihood.fn(scene + t * way, double.frame, double)

    coarse, fine = ((value(h) - value(-h)) / (2 * h) for h in (2e-5, 1e-5))
    along = (likelihood.grad(scene, double.frame, double) * way).sum()
    assert float(along) == pytest.approx(float((4 * fine - coarse) / 3), rel=1e-6)


def test_a_dark_pixel_counts_as_in_the_least_squares_of_deepinv(double):
    """At the scale that is taken by default, and with a floor above the whole frame, both
    gradients are equal.
    """
    double.update(mask=torch.ones_like(double.mask))
    scene = torch.rand(1, *double.img_size).double()
    found = double.likelihood(floor=1e3).grad(scene, double.frame, double)
    torch.testing.assert_close(
        found, deepinv.optim.L2().grad(scene, double.frame, double), rtol=1e-9, atol=1e-12
    )


def test_a_clipped_pixel_pulls_up_and_never_down(double):
    double.update(mask=torch.zeros_like(double.mask))
    dark, bright = (
        torch.zeros(1, *double.img_size).double(),
        torch.full((1, *double.img_size), 3e3).double(),
    )
    likelihood = double.likelihood()
    # descent adds light
    assert (double.blur.seen(likelihood.grad(dark, double.frame, double)) < 0).all()
    assert float(likelihood.grad(bright, double.frame, double).abs().max()) < 1e-9


# --- restoration ----------------------------------------------------------------------------------


def test_eight_lines_restore_a_picture_better_than_the_raw_frame(store):
    from deepinv.optim import HQS, L2, TVPrior

    recipe = load("first_light", laser="none", **SMALL)
    camera = as_physics(recipe, store=store)
    restore = HQS(
        data_fidelity=L2(), prior=TVPrior(n_it_max=20), stepsize=30.0, lambda_reg=1e-4, max_iter=20
    )
    with torch.no_grad():
        picture = camera.colour(restore(camera.frame, camera, init=camera.even()))[0]
    truth = neusee.run(recipe, store=store, outputs=["truth"])["truth"]
    raw = neusee.run(recipe, store=store, outputs=["developed[mask]"])["developed[mask]"]
    assert float(quality(picture, truth).psnr) > float(quality(raw, truth).psnr) + 1.0


def test_a_denoiser_with_weights_from_a_local_file_restores(physics, tmp_path):
    """DRUNet with made-up weights: pretrained weights from a file take the same way, and no
    download happens.
    """
    from deepinv.models import DRUNet
    from deepinv.optim import HQS, L2, PnP

    sizes = {"in_channels": 3, "out_channels": 3, "nc": (4, 4, 4, 4), "nb": 1}
    torch.manual_seed(1)
    made = DRUNet(**sizes, pretrained=None)
    torch.save(made.state_dict(), tmp_path / "drunet.pth")
    torch.manual_seed(2)
    denoiser = DRUNet(**sizes, pretrained=str(tmp_path / "drunet.pth")).eval()
    for name, value in made.state_dict().items():
        assert torch.equal(denoiser.state_dict()[name], value)
    restore = HQS(data_fidelity=L2(), prior=PnP(denoiser), stepsize=1.0, g_param=0.02, max_iter=2)
    with torch.no_grad():
        scene = restore(physics.frame, physics)
    assert scene.shape == (1, *physics.img_size)
    assert scene.isfinite().all()


def test_the_clipped_likelihood_restores_light_that_a_mask_alone_does_not_see(store):
    """A bright patch that clips everywhere within: the tail asks for light there, the mask for
    nothing.
    """
    from deepinv.optim import FISTA, L2, TVPrior

    camera = as_physics(load("first_light", laser="none", doe="flat", **SMALL), store=store)
    scene = torch.full((1, *camera.img_size), 0.2)
    top, left = camera.blur.corner()
    patch = (..., slice(top + 16, top + 32), slice(left + 12, left + 28))
    scene[patch] = 1.5
    camera.update(mask=torch.ones_like(camera.mask))
    frame = camera(scene, seed=3)
    camera.update(mask=camera.unclipped(frame))
    assert 0.05 < 1 - float(camera.mask.mean()) < 0.3
    prior = {"prior": TVPrior(n_it_max=10), "lambda_reg": 1e-4, "stepsize": 1.0, "max_iter": 60}
    with torch.no_grad():
        blind = FISTA(data_fidelity=L2(), **prior)(frame * camera.mask, camera)
        knowing = FISTA(data_fidelity=camera.likelihood(floor=0.2), **prior)(frame, camera)
    assert float(knowing[patch].mean()) > float(blind[patch].mean()) + 0.2
    assert float(knowing[patch].mean()) > 0.9
