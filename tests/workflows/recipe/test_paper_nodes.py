"""Parameters of nodes that exist for readings of the paper, each against its formula in NumPy."""

import numpy as np
import pytest
import torch

import neusee
from neusee.nodes import losses, metrics, sensor, spectra
from neusee.nodes.values import Psf
from neusee.workflows import Store, load


def rng(seed):
    return torch.Generator().manual_seed(seed)


def test_the_mean_of_the_dark_current_is_drawn_for_each_exposure():
    dark = torch.zeros(64, 64)
    counts = [
        sensor.dark_current(dark, mean=40.0, mean_of="exposure", rng=rng(s)) for s in range(200)
    ]
    means = np.array([float(x.mean()) for x in counts])
    assert means.mean() == pytest.approx(40, abs=5 * 20 / np.sqrt(200))
    assert means.std() == pytest.approx(20, rel=0.25)
    within = np.mean(
        [float(x.var()) / max(float(x.mean()), 1.0) for x in counts if float(x.mean()) > 5]
    )
    assert within == pytest.approx(1, rel=0.02)  # Poisson within an exposure
    usual = [float(sensor.dark_current(dark, mean=40.0, rng=rng(s)).mean()) for s in range(20)]
    assert np.std(usual) < 0.5


def test_the_dark_current_is_left_out_only_below_a_bound_that_holds_for_every_draw():
    from neusee.nodes import TensorStats

    stats = TensorStats.of(torch.full((8, 8), 1e4))
    bound = sensor.dark_current.hooks.skip_bound
    for seed in range(50):
        added = sensor.dark_current(
            torch.zeros(400, 400), mean=2.0, mean_of="exposure", rng=rng(seed)
        )
        rms = float(added.double().square().mean().sqrt())
        assert rms / 1e4 < 1.01 * bound(stats, mean=2.0, full_well=None, mean_of="exposure")


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_the_reconstruction_loss_is_a_mean_or_the_printed_sum(reduction):
    a, b = (np.random.default_rng(s).random((3, 9, 8)) for s in (0, 1))
    pixels = np.sqrt((a - b) ** 2 + 1e-6)
    frequencies = np.abs(np.fft.fft2(a) - np.fft.fft2(b))
    wanted = (
        (pixels.mean(), frequencies.mean() / np.sqrt(72))
        if reduction == "mean"
        else (pixels.sum(), frequencies.sum())
    )
    given = torch.from_numpy(a), torch.from_numpy(b)
    assert float(losses.charbonnier(*given, reduction=reduction)) == pytest.approx(
        wanted[0], rel=1e-12
    )
    assert float(losses.fft_l1(*given, reduction=reduction)) == pytest.approx(wanted[1], rel=1e-12)


def test_the_printed_ratio_of_a_background_is_one_of_peaks():
    plain = torch.zeros(2, 8, 8)
    plain[:, 4, 4] = torch.tensor([2.0, 0.0])
    blurred = torch.zeros(2, 8, 8)
    blurred[0, 3:5, 4] = 1.0
    assert metrics.peak_bsr(blurred, plain).tolist() == [0.5, 1.0]
    assert blurred.sum() == plain.sum()  # no light is lost
    with pytest.raises(ValueError, match="differ in shape: use one scene for both"):
        metrics.peak_bsr(blurred, plain[:, :4])


def test_the_gradient_of_the_contrast_near_its_floor_is_that_of_float64():
    """A blur whose contrast falls to the floor, where round-off of single precision turned the
    gradient.
    """
    line = torch.exp(-0.5 * ((torch.arange(64) - 32) / 3.0) ** 2)
    kernel = line[:, None] * line
    found = []
    for dtype in (torch.float32, torch.float64):
        x = kernel.to(dtype).clone().requires_grad_()
        losses.contrast(Psf(x[None], torch.tensor([0.11], dtype=torch.float64))).backward()
        found.append(x.grad.double())
    assert float((found[0] - found[1]).abs().max() / found[1].abs().max()) < 1e-6


def test_camera_grain_is_equal_in_every_precision():
    picture = torch.rand(3, 6, 7, generator=rng(0))
    single, double = (spectra.grain(x, rng=rng(3)) for x in (picture, picture.double()))
    assert double.dtype == torch.float64
    torch.testing.assert_close(single.double(), double, rtol=0, atol=1e-6)


SMALL = [
    "optics.samples=64",
    "optics.pitch=126.2 um",
    "optics.bands=3",
    "optics.window=[32, 32]",
    "scene.shape=[32, 32]",
    "sensor.shape=[32, 32]",
    "doe=half_ring",
    "doe.waves=[2]",
    "lasers.green.angle=[0 mrad, 0 mrad]",
    "outputs=[photons]",
]


@pytest.mark.parametrize(("reading", "ratio"), [("coherent", 2.0), ("as_printed", 1.0)])
def test_a_longer_exposure_collects_more_light_unless_as_printed(tmp_path, reading, ratio):
    words = [
        *SMALL,
        *(["reading.saturating_exposure=${sensor.exposure}"] if reading == "as_printed" else []),
    ]
    usual, longer = (
        neusee.run(
            load("first_light", [*words, f"sensor.exposure={seconds} s"]), store=Store(tmp_path)
        )
        for seconds in (0.1, 0.2)
    )
    for arm in ("plain", "mask"):
        assert float(
            longer[f"photons[{arm}]"].sum() / usual[f"photons[{arm}]"].sum()
        ) == pytest.approx(ratio, rel=1e-4)


def test_a_laboratory_counts_every_photon_in_every_reading():
    recipe = load("calibrate", ["reading=as_printed"])
    assert {s.params["mean_shift"] for s in recipe.steps.values() if "mean_shift" in s.params} == {
        0.0
    }
