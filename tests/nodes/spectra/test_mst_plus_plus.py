"""MST++: its published shape, its checkpoints, and that nobody looks at an untrained one by
mistake.
"""

import pytest
import torch

from neusee.nodes import ParameterError
from neusee.nodes.spectra import MSTPlusPlus, bands, lift_mst_plus_plus

NM = 1e-9
SCENE = bands(start=400 * NM, stop=700 * NM, count=31)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def made_up():
    """A state dict that anyone can write down."""
    state = {}
    with torch.device("meta"):
        names = MSTPlusPlus().state_dict()
    for i, (name, tensor) in enumerate(names.items()):
        count = torch.arange(tensor.numel(), dtype=torch.float64)
        inputs = max(tensor.numel() / tensor.shape[0], 1)
        state[name] = (
            (torch.cos(0.7 * (i + 1) * count + i) / inputs**0.5).float().reshape(tensor.shape)
        )
    return state


@pytest.fixture(autouse=True)
def one_thread():
    """Hundreds of tiny tensors: a second thread only waits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def picture():
    return torch.rand(3, 6, 7, generator=generator(3))


def test_has_the_published_parameters_and_names():
    with torch.device("meta"):
        network = MSTPlusPlus()
    state = network.state_dict()
    assert sum(p.numel() for p in network.parameters()) == 1_619_625
    assert len(state) == 227
    assert state["body.1.bottleneck.blocks.0.0.rescale"].shape == (4, 1, 1)
    assert state["body.2.decoder_layers.0.0.bias"].shape == (62,)
    assert state["body.0.encoder_layers.1.0.blocks.0.1.fn.net.2.weight"].shape == (248, 1, 3, 3)
    assert state["body.0.decoder_layers.1.2.blocks.0.1.norm.weight"].shape == (31,)


def test_computes_what_the_published_code_computes():
    """Numbers of the authors' code in float64, with these very weights and this picture."""
    network = MSTPlusPlus().requires_grad_(False).double()
    network.load_state_dict(made_up())
    rgb = torch.sin(torch.arange(3 * 13 * 10, dtype=torch.float64)).reshape(1, 3, 13, 10) / 2 + 0.5
    result = network(rgb)[0]
    assert result.shape == (31, 13, 10)
    assert float(result[0, 0, 0]) == pytest.approx(-0.20206438450046535, rel=1e-9)
    assert float(result[15, 6, 5]) == pytest.approx(0.024600508068804094, rel=1e-9)
    assert float(result[30, 12, 9]) == pytest.approx(-0.05197792449454343, rel=1e-9)
    assert float(result.std()) == pytest.approx(0.1437820405367592, rel=1e-9)


@pytest.mark.parametrize("form", ["bare.pth", "wrapped.pth", "module.pth", "bare.safetensors"])
def test_checkpoint_loads_from_every_container(tmp_path, picture, form):
    from safetensors.torch import save_file

    state, path = made_up(), tmp_path / form
    if form.endswith("safetensors"):
        save_file(state, path)
    elif form == "bare.pth":
        torch.save(state, path)
    else:
        prefix = "module." if form == "module.pth" else ""
        named = {prefix + name: tensor for name, tensor in state.items()}
        torch.save({"epoch": 7, "iter": 9, "state_dict": named, "optimizer": {"lr": 1e-4}}, path)
    assert lift_mst_plus_plus.hooks.preflight(weights=path) == []
    result = lift_mst_plus_plus(picture, SCENE, weights=path, rng=generator())
    network = MSTPlusPlus().requires_grad_(False)
    network.load_state_dict(state)
    low, high = picture.min(), picture.max()
    expected = network(((picture - low) / (high - low))[None])[0] * (high - low) + low
    torch.testing.assert_close(result, expected.clamp_min(0))
    assert float(result.min()) == 0


def test_a_checkpoint_that_does_not_fit_is_refused_before_the_run(tmp_path):
    state = made_up()
    state.pop("conv_in.weight")
    torch.save(state, tmp_path / "less.pth")
    torch.save({**made_up(), "extra": torch.ones(1)}, tmp_path / "more.pth")
    torch.save({**made_up(), "conv_out.weight": torch.ones(31, 31, 1, 1)}, tmp_path / "other.pth")
    torch.save([1, 2], tmp_path / "list.pth")
    (tmp_path / "text.pth").write_text("not a checkpoint")
    for name, words in (
        ("less", "conv_in.weight"),
        ("more", "extra"),
        ("other", "conv_out.weight"),
        ("list", "not a state dict"),
        ("text", "no tensors"),
    ):
        with pytest.raises(ParameterError, match=words) as error:
            lift_mst_plus_plus.hooks.preflight(weights=tmp_path / f"{name}.pth")
        assert error.value.parameter == "weights"


class Trap:
    """Runs code where a pickle is trusted."""

    def __reduce__(self):
        return (print, ("code ran",))


def test_a_pickle_with_code_is_not_run(tmp_path, capsys):
    torch.save({"state_dict": Trap()}, tmp_path / "trap.pth")
    with pytest.raises(ParameterError, match="safely"):
        lift_mst_plus_plus.hooks.preflight(weights=tmp_path / "trap.pth")
    assert "code ran" not in capsys.readouterr().out


def test_refuses_to_run_untrained_unless_told(picture):
    with pytest.raises(ParameterError, match="untrained: allow"):
        lift_mst_plus_plus.hooks.preflight()
    with pytest.raises(ValueError, match="untrained: allow"):
        lift_mst_plus_plus(picture, SCENE, rng=generator())
    assert "no meaning" in lift_mst_plus_plus.hooks.preflight(untrained="allow")[0]
    cube = lift_mst_plus_plus(picture, SCENE, untrained="allow", rng=generator())
    assert not lift_mst_plus_plus.hooks.check(cube, picture, SCENE, untrained="allow")[-1].ok


def test_untrained_weights_come_from_the_given_stream_alone(picture):
    torch.manual_seed(1)
    before = torch.get_rng_state()
    one, same, other = (
        lift_mst_plus_plus(picture, SCENE, untrained="allow", rng=generator(seed))
        for seed in (0, 0, 1)
    )
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    assert torch.equal(torch.get_rng_state(), before)


def test_radiometry_survives(picture):
    """Scaling and lifting the light by a constant scales and lifts the spectra."""
    usual = lift_mst_plus_plus(picture.double(), SCENE, untrained="allow", rng=generator())
    brighter = lift_mst_plus_plus(
        7 * picture.double() + 100, SCENE, untrained="allow", rng=generator()
    )
    lit = usual > 0
    torch.testing.assert_close(brighter[lit], (7 * usual + 100)[lit], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (3, 2), (8, 8), (9, 17)])
def test_any_size(shape):
    rgb = torch.rand(3, *shape, generator=generator())
    cube = lift_mst_plus_plus(rgb, SCENE, untrained="allow", rng=generator())
    assert cube.shape == (31, *shape)
    assert float(cube.min()) >= 0
    assert bool(torch.isfinite(cube).all())


def test_a_picture_of_one_value_is_a_flat_spectrum():
    cube = lift_mst_plus_plus(
        torch.full((3, 4, 4), 0.25), SCENE, untrained="allow", rng=generator()
    )
    assert torch.equal(cube, torch.full((31, 4, 4), 0.25))


def test_gradient_reaches_the_picture_and_not_the_weights(picture):
    rgb = picture.clone().requires_grad_()
    lift_mst_plus_plus(rgb, SCENE, untrained="allow", rng=generator()).sum().backward()
    assert float(rgb.grad.abs().max()) > 0


def test_refuses_other_bands(picture):
    with pytest.raises(ValueError, match="31 bands from 400 to 700 nm"):
        lift_mst_plus_plus(
            picture,
            bands(start=400 * NM, stop=700 * NM, count=16),
            untrained="allow",
            rng=generator(),
        )
    with pytest.raises(ValueError, match="380 to 680"):
        lift_mst_plus_plus(
            picture,
            bands(start=380 * NM, stop=680 * NM, count=31),
            untrained="allow",
            rng=generator(),
        )
