"""On an accelerator: the same physics, steps on both devices, and memory that was measured
there.
"""

import pytest
import torch

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.store.result_store import Store

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
SMALL = [
    "optics.samples=256",
    "optics.pitch=30 um",
    "optics.window=[128, 128]",
    "sensor.shape=[96, 96]",
    "scene.shape=[128, 128]",
    "restore=null",
    "steps.restored_quality=null",
    "outputs=[raw, lsr]",
]


def small(*more):
    return load("first_light", [*SMALL, *more])


def test_the_optics_agree_with_those_of_the_cpu(tmp_path):
    outputs = ("psf[mask]", "image[mask]", "lsr[mask]")
    there = run(small(), Store(tmp_path / "gpu"), outputs, device="cuda:0")
    here = run(small(), Store(tmp_path / "cpu"), outputs)
    assert there.keys["image[mask]"] == here.keys["image[mask]"], (
        "the device is no part of a key without noise"
    )
    for name in ("psf[mask]", "image[mask]"):
        a, b = there.values[name], here.values[name]
        a, b = (a.intensity.cpu(), b.intensity) if name.startswith("psf") else (a.cpu(), b)
        assert float((a - b).abs().max() / b.abs().max()) < 1e-5
    assert there.done["psf[mask]"].device == "cuda:0"
    assert (there.done["image[mask]"].peak or 0) > 0


def test_a_cpu_beside_the_accelerator_gives_what_the_accelerator_gives(tmp_path):
    outputs = ("raw[mask]", "raw[plain]")
    one = run(small(), Store(tmp_path / "one"), outputs, device="cuda:0")
    both = run(small(), Store(tmp_path / "both"), outputs, device="cuda:0,cpu")
    assert one.keys == both.keys
    for name in outputs:
        assert float((one.values[name] - both.values[name]).abs().double().mean()) < 0.01


def test_a_step_goes_where_its_hint_says(tmp_path):
    result = run(
        small("steps.image.device=cpu"), Store(tmp_path), ("image[mask]",), device="cuda:0,cpu"
    )
    assert result.done["image[mask]"].device == "cpu"
    assert result.done["psf[mask]"].device == "cuda:0"


def test_every_output_of_a_whole_recipe_is_computed_there(tmp_path):
    """Also the numbers at its end, such as the brightest pixel, which once mixed both devices."""
    words = [
        word for word in SMALL if not word.startswith(("restore", "steps.restored", "outputs"))
    ]
    there = run(load("first_light", words), Store(tmp_path / "gpu"), device="cuda:0")
    here = run(load("first_light", words), Store(tmp_path / "cpu"))
    assert there.values.keys() == here.values.keys()
    one, other = (float(x.values["peak[mask]"].irradiance) for x in (there, here))
    assert abs(one / other - 1) < 1e-4
    psnr = [float(x.values["restored_quality"].psnr) for x in (there, here)]
    assert abs(psnr[0] - psnr[1]) < 0.2, "the noise is another one"
