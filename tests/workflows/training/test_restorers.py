"""The paper's camera with a network in place of Wiener: by one word of a recipe, and a file of
weights.
"""

from functools import partial

import pytest
import torch
from safetensors.torch import save_file
from torch.testing import assert_close

from neusee.nodes.restore import FFTMamba, NAFNet, UNet, start_network
from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.store.result_store import Store

SMALL = [
    "optics.samples=180",
    "optics.pitch=44.88 um",
    "optics.window=[48, 48]",
    "optics.bands=5",
    "scene.shape=[48, 48]",
    "sensor.shape=[22, 30]",
    "laser=none",
    "outputs=[developed, restored, restored_quality]",
]
MAKE = {
    "fft_mamba": partial(FFTMamba, 2, 1, 2),
    "unet": partial(UNet, 2),
    "nafnet": partial(NAFNet, 2),
}
FEW = {"fft_mamba": ["steps.restored.with.blocks=1", "steps.restored.with.states=2"]}
every_network = pytest.mark.parametrize("name", MAKE)


def small(name, *changes):
    return load(
        "first_light", [*SMALL, f"restore={name}", "restore.width=2", *FEW.get(name, []), *changes]
    )


@pytest.mark.slow
@every_network
def test_a_recipe_names_its_network_and_the_picture_goes_through_it(name, tmp_path):
    store = Store(tmp_path / "store")
    for seed in (0, 1):
        net = start_network(MAKE[name], torch.Generator().manual_seed(seed))
        # other weights in a file of the same name
        save_file(net.state_dict(), tmp_path / "trained.safetensors")
        found = run(small(name, f"restore.weights={tmp_path / 'trained.safetensors'}"), store)
        with torch.no_grad():
            wanted = net(found["developed[mask]"][None])[0]
        assert wanted.shape == (3, 22, 30)
        assert_close(
            found["restored"], wanted, rtol=2e-6, atol=2e-6
        )  # weights lie elsewhere, by which some processors round
        assert not torch.equal(wanted, found["developed[mask]"])


@every_network
def test_without_weights_a_recipe_is_refused_where_they_are_to_be_given(name):
    with pytest.raises(RecipeError) as caught:
        small(name)
    (problem,) = caught.value.diagnostics
    assert str(problem.mark) == f"restore/{name}.yaml:{'3:12' if name == 'fft_mamba' else '2:20'}"
    assert problem.path == "restore.weights = None"
    assert problem.message.endswith(
        "give the .safetensors file of its weights, or choose restore: wiener"
    )


def test_weights_of_another_width_are_refused_before_the_run(tmp_path):
    save_file(
        start_network(partial(UNet, 3), torch.Generator()).state_dict(),
        tmp_path / "wide.safetensors",
    )
    with pytest.raises(
        RecipeError, match=r"wide.safetensors: down.0.0.bias is \(3,\), this network \(width 2\)"
    ):
        small("unet", f"restore.weights={tmp_path / 'wide.safetensors'}")
