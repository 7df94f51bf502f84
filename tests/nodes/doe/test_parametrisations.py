"""Reliefs that learn: pixelwise and by the UNet; and those read from files."""

import math

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from torch.testing import assert_close

from neusee.nodes import ParameterError, doe, optics
from neusee.nodes.doe import PARAMETRISATIONS, HeightNet
from neusee.nodes.doe._parametrisations import network_height, new_network, pupil_coordinates
from neusee.nodes.resampling import enlarge

STOP = optics.stop(samples=64, pitch=5e-6, diameter=320e-6)


def seeded(seed=1):
    return torch.Generator().manual_seed(seed)


def suppression(height):
    """Peak over the clear peak at 550 nm on the natural grid, twice padded; differentiable."""
    line = torch.arange(64) - 31.5
    open_ = (line[:, None] ** 2 + line**2 <= 32**2).double()
    field = torch.polar(open_, 2 * math.pi / 550e-9 * 0.4599 * height.double())
    intensity = torch.fft.fft2(field, s=(128, 128)).abs().square() / open_.sum() ** 2
    return intensity.pow(8).sum().pow(1 / 8)


@pytest.mark.parametrize("suffix", [".npy", ".safetensors"])
def test_a_height_that_is_complex_is_refused_before_the_run_and_in_it(tmp_path, suffix):
    file, height = (
        tmp_path / f"mask{suffix}",
        torch.full((64, 64), 1e-6 + 1e-6j, dtype=torch.complex64),
    )
    if suffix == ".npy":
        np.save(file, height.numpy())
    else:
        save_file({"height": height}, file)
    with pytest.raises(
        ParameterError,
        match=rf"mask{suffix} holds values of type .*64: save the heights as real num",
    ):
        doe.pixelwise.hooks.preflight(stop=STOP, file=file)
    with pytest.raises(ParameterError, match="save the heights as real numbers, in m"):
        doe.pixelwise(STOP, file=file, rng=seeded())


@pytest.mark.parametrize("name", ["pixelwise", "unet"])
def test_start_is_seeded_bounded_and_far_from_flat(name):
    node, params = getattr(doe, name), {} if name == "pixelwise" else {"width": 8, "grid": 32}
    height = node(STOP, **params, rng=seeded())
    assert_close(height, node(STOP, **params, rng=seeded()), rtol=0, atol=0)
    assert not torch.equal(height, node(STOP, **params, rng=seeded(2)))
    assert height.dtype == torch.float32
    assert height.shape == (64, 64)
    assert float(height.min()) >= 0
    assert float(height.max()) <= 1.2e-6
    assert float(height.std()) > 0.1e-6
    assert float(suppression(height)) < 0.9 * float(suppression(torch.zeros(64, 64)))


def test_start_from_a_random_relief_has_a_slope_and_a_flat_one_has_none():
    steep = doe.pixelwise(STOP, rng=seeded()).requires_grad_()
    flat = torch.zeros(64, 64, requires_grad=True)
    found = [
        torch.autograd.grad(suppression(height), height)[0].abs().max() for height in (steep, flat)
    ]
    assert float(found[0]) > 1e3 * float(found[1])


def test_pixelwise_start_is_the_same_at_every_sampling():
    coarse = doe.pixelwise(optics.stop(samples=27, pitch=9e-6, diameter=243e-6), rng=seeded())
    fine = doe.pixelwise(optics.stop(samples=81, pitch=3e-6, diameter=243e-6), rng=seeded())
    assert_close(fine[1::3, 1::3], coarse, rtol=1e-4, atol=1e-12)


def test_pixelwise_features_have_the_asked_scale():
    fields = torch.stack(
        [doe.pixelwise(STOP, depth=1.0, scale=0.2, rng=seeded(k)).double() for k in range(200)]
    )
    fields = torch.logit(fields) / 1.5
    assert float(fields.square().mean()) == pytest.approx(1, rel=0.1)
    step = 10
    along = float((fields[:, :, step:] * fields[:, :, :-step]).mean() / fields.square().mean())
    assert along == pytest.approx(math.exp(-((step / 64 / 0.2) ** 2)), abs=0.05)


@pytest.mark.parametrize("suffix", ["npy", "safetensors"])
def test_pixelwise_reads_a_file(tmp_path, suffix):
    relief = np.random.default_rng(3).uniform(0, 2e-6, (64, 64)).astype("float32")
    file = tmp_path / f"relief.{suffix}"
    if suffix == "npy":
        np.save(file, relief)
    else:
        save_file({"height": torch.from_numpy(relief), "other": torch.zeros(2)}, file)
    params = {"file": file, "depth": 1.2e-6, "scale": 0.1}
    (note,) = doe.pixelwise.hooks.preflight(stop=STOP, **params)
    assert "states no pitch" in note
    assert "5 um apart" in note
    assert_close(
        doe.pixelwise(STOP, **params, rng=seeded()), torch.from_numpy(relief), rtol=0, atol=0
    )


def test_pixelwise_refuses_a_file_that_does_not_fit(tmp_path):
    np.save(tmp_path / "small.npy", np.zeros((32, 32)))
    params = {"depth": 1.2e-6, "scale": 0.1}
    with pytest.raises(ParameterError, match=r"\(32, 32\).*\(64, 64\).*samples to 32") as caught:
        doe.pixelwise.hooks.preflight(stop=STOP, **params, file=tmp_path / "small.npy")
    assert caught.value.parameter == "file"
    np.save(tmp_path / "low.npy", np.full((64, 64), -1e-9))
    with pytest.raises(ValueError, match="must be finite and at least 0"):
        doe.pixelwise(STOP, **params, file=tmp_path / "low.npy", rng=seeded())
    (tmp_path / "relief.txt").write_text("0")
    with pytest.raises(ParameterError, match=r"npy, \.safetensors or grey"):
        doe.pixelwise.hooks.preflight(stop=STOP, **params, file=tmp_path / "relief.txt")
    for name in ("bad.npy", "bad.safetensors"):
        (tmp_path / name).write_text("no relief")
        with pytest.raises(ParameterError, match="cannot be read"):
            doe.pixelwise.hooks.preflight(stop=STOP, **params, file=tmp_path / name)
    save_file({"a": torch.zeros(1), "b": torch.zeros(1)}, tmp_path / "two.safetensors")
    with pytest.raises(ParameterError, match="a, b"):
        doe.pixelwise.hooks.preflight(stop=STOP, **params, file=tmp_path / "two.safetensors")


def test_unet_has_eight_convolutions_and_the_paper_inputs():
    net = HeightNet()
    layers = [m for m in net.modules() if isinstance(m, torch.nn.Conv2d)]
    assert len(layers) == 8
    assert layers[0].in_channels == 2
    assert net.last.out_channels == 1


def test_unet_starts_orthogonal_with_zero_biases():
    net = new_network(4, 16, seeded())
    rows = net.down[2].weight.flatten(1)
    assert_close(rows @ rows.T, 2 * torch.eye(len(rows)), rtol=0, atol=1e-5)
    assert all(
        not p.any()
        for name, p in net.named_parameters()
        if name.endswith("bias") and "last" not in name
    )


@pytest.mark.parametrize("samples", [1, 7, 64])
def test_unet_works_at_any_sampling(samples):
    height = doe.unet(
        optics.stop(samples=samples, pitch=1e-6, diameter=samples * 1e-6),
        width=2,
        grid=9,
        rng=seeded(),
    )
    assert height.shape == (samples, samples)
    assert bool(torch.isfinite(height).all())


def test_unet_learns_through_the_resampling():
    net = new_network(2, 6, seeded()).double()
    weight = net.down[0].weight.detach().clone().requires_grad_()

    def relief(kernel):
        logits = torch.func.functional_call(
            net, {"down.0.weight": kernel}, (pupil_coordinates(6).double(),)
        )
        return torch.sigmoid(enlarge(logits, 11, 11))

    assert torch.autograd.gradcheck(relief, (weight,), fast_mode=True)


def test_unet_suppresses_after_a_few_steps():
    net = new_network(4, 32, seeded())
    optimiser = torch.optim.Adam(net.parameters(), 3e-3)
    losses = []
    for _ in range(25):
        loss = suppression(network_height(net, 64, 32, 2.4e-6))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.7 * losses[0]


def test_unet_loads_its_own_weights_and_no_others(tmp_path):
    net = new_network(4, 32, seeded(9))
    save_file(net.state_dict(), tmp_path / "net.safetensors")
    params = {"max_height": 1.2e-6, "grid": 32, "weights": tmp_path / "net.safetensors"}
    assert doe.unet.hooks.preflight(**params, width=4) == []
    loaded = doe.unet(STOP, **params, width=4, rng=seeded())
    assert_close(loaded, network_height(net, 64, 32, 1.2e-6).detach(), rtol=0, atol=0)
    with pytest.raises(ParameterError, match="width 8") as caught:
        doe.unet.hooks.preflight(**params, width=8)
    assert caught.value.parameter == "weights"
    (tmp_path / "text.safetensors").write_text("no")
    with pytest.raises(ParameterError, match="is not a safetensors file"):
        doe.unet.hooks.preflight(**params | {"weights": tmp_path / "text.safetensors"}, width=4)


def test_pixelwise_reads_levels_of_a_grey_picture(tmp_path):
    levels = np.random.default_rng(1).integers(0, 65536, (64, 64), dtype=np.uint16)
    Image.fromarray(levels).save(tmp_path / "deep.png")
    Image.fromarray((levels >> 8).astype(np.uint8)).save(tmp_path / "shallow.png")
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(tmp_path / "coloured.png")
    (tmp_path / "broken.png").write_bytes((tmp_path / "deep.png").read_bytes()[:30])
    for name, top in (("deep", 65535), ("shallow", 255)):
        found = doe.pixelwise(STOP, file=tmp_path / f"{name}.png", depth=5e-6, rng=seeded())
        wanted = (
            torch.from_numpy((levels if top > 255 else levels >> 8).astype(np.float64)) * 5e-6 / top
        )
        assert_close(found.double(), wanted, rtol=1e-6, atol=0)
    for name, said in (("coloured", "not grey"), ("broken", "cannot be read")):
        with pytest.raises(ParameterError, match=said):
            doe.pixelwise.hooks.preflight(
                stop=STOP, depth=5e-6, scale=0.1, file=tmp_path / f"{name}.png"
            )


@pytest.mark.parametrize(
    ("name", "params"), [("half_rings", {"waves": (9.0,)}), ("cubic", {"waves": 3.0})]
)
def test_every_sample_of_a_formula_can_be_freed(name, params):
    start = getattr(doe, name)(STOP, **params)
    freed = PARAMETRISATIONS[f"doe.{name}"](STOP, params, seeded())
    moved = freed(STOP).detach() - start
    # a piston
    assert_close(moved, torch.full_like(moved, float(moved.mean())), rtol=1e-3, atol=1e-10)
    slope = torch.autograd.grad(suppression(freed(STOP)), freed.logits)[0]
    assert float(slope.abs().max()) > 0
    height = freed(STOP).detach()
    assert float(height.min()) > 0
    assert float(height.max()) < freed.max_height


def test_a_network_in_double_precision_draws_in_double_precision():
    net = new_network(4, 16, seeded(3))
    single = network_height(net, 24, 16, 1.2e-6)
    double = network_height(net.double(), 24, 16, 1.2e-6)
    assert double.dtype == torch.float64
    assert_close(single.double(), double, rtol=1e-5, atol=1e-12)
