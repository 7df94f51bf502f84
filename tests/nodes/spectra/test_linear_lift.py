"""The two linear lifts: known figures, colours that come back, gradients, what is refused."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.scene import hyperspectral
from neusee.nodes.spectra import bands, lift_lmmse, lift_mallett, to_srgb

NM = 1e-9
SCENE = bands(start=400 * NM, stop=700 * NM, count=31)
CAVE = Path(__file__).parents[3] / "../shared/data/hyperspectral/cave_balloons_256x256x31_u16.mat"
LIFTS = [lift_lmmse, lift_mallett]


def colours(y=9, x=7, seed=0):
    return torch.rand(3, y, x, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def back(cube, samples=SCENE):
    return torch.einsum("cb,byx->cyx", to_srgb(samples.centres), cube.double())


@pytest.mark.skipif(not CAVE.is_file(), reason="the CAVE scene is not beside the project")
@pytest.mark.parametrize(
    ("lift", "psnr", "mrae"), [(lift_lmmse, 33.3, 0.147), (lift_mallett, 31.0, 0.185)]
)
def test_measured_scene_is_recovered_as_well_as_known(lift, psnr, mrae):
    truth = hyperspectral(SCENE, file=CAVE, start=400 * NM, stop=700 * NM).double()
    off = lift(back(truth), SCENE) - truth
    assert -10 * math.log10(float(off.square().mean())) == pytest.approx(psnr, abs=0.1)
    lit = truth >= 1e-2
    assert float((off.abs()[lit] / truth[lit]).mean()) == pytest.approx(mrae, abs=0.003)


@pytest.mark.parametrize("lift", LIFTS)
def test_usual_form_agrees_with_reference(lift):
    rgb = colours().float()
    torch.testing.assert_close(
        lift(rgb, SCENE).double(), lift.hooks.reference(rgb, SCENE), rtol=lift.rtol, atol=1e-6
    )


def test_mallett_is_the_basis_of_colour_science():
    from colour.recovery import RGB_to_sd_Mallett2019

    rgb = [0.2, 0.5, 0.8]
    sd = RGB_to_sd_Mallett2019(np.array(rgb))
    cube = lift_mallett(torch.tensor(rgb, dtype=torch.float64)[:, None, None], SCENE)[:, 0, 0]
    np.testing.assert_allclose(cube.numpy(), [sd[nm] for nm in range(400, 701, 10)], atol=1e-12)


@pytest.mark.parametrize(("lift", "limit"), [(lift_lmmse, 1e-12), (lift_mallett, 6e-3)])
def test_colours_come_back_where_nothing_was_clipped(lift, limit):
    rgb = 0.4 + 0.2 * colours()
    assert float((back(lift(rgb, SCENE)) - rgb).abs().max()) < limit


@pytest.mark.parametrize("samples", [(400, 700, 7), (420, 680, 14), (380, 780, 81)])
def test_lmmse_reproduces_colours_on_other_bands(samples):
    start, stop, count = samples
    other = bands(start=start * NM, stop=stop * NM, count=count)
    rgb = 0.4 + 0.2 * colours()
    assert float((back(lift_lmmse(rgb, other), other) - rgb).abs().max()) < 1e-9
    assert lift_mallett(rgb, other).shape == (count, 9, 7)


@pytest.mark.parametrize(
    ("lift", "first", "limit"), [(lift_mallett, 0, 0.01), (lift_lmmse, 2, 0.13)]
)
def test_white_is_nearly_flat(lift, first, limit):
    """White paint absorbs violet, and so does the LMMSE white: 0.62 at 400 nm, 0.84 at 410 nm."""
    cube = lift(torch.ones(3, 1, 1), SCENE)[:, 0, 0]
    assert float((cube[first:] - 1).abs().max()) < limit
    assert cube[:first].tolist() == pytest.approx([0.62, 0.84][:first], abs=0.01)


@pytest.mark.parametrize("lift", LIFTS)
@settings(max_examples=30, deadline=None)
@given(
    y=st.integers(1, 9),
    x=st.integers(1, 9),
    scale=st.sampled_from([0.0, 1e-40, 1e-6, 1.0, 1e3, 1e30]),
)
def test_any_shape_and_brightness_gives_no_negative_light(lift, y, x, scale):
    rgb = (torch.rand(3, y, x, generator=torch.Generator().manual_seed(y + x)) * 2 - 0.5) * scale
    cube = lift(rgb, SCENE)
    assert cube.shape == (31, y, x)
    assert cube.dtype == torch.float32
    assert float(cube.min()) >= 0
    assert bool(torch.isfinite(cube).all())


@pytest.mark.parametrize("lift", LIFTS)
def test_bright_light_scales(lift):
    rgb = colours()
    torch.testing.assert_close(lift(1000 * rgb, SCENE), 1000 * lift(rgb, SCENE), rtol=1e-12, atol=0)


@pytest.mark.parametrize("lift", LIFTS)
def test_gradients(lift):
    rgb = (0.3 + 0.5 * colours(2, 2)).requires_grad_()
    assert torch.autograd.gradcheck(lambda c: lift(c, SCENE), (rgb,))


@pytest.mark.parametrize("lift", LIFTS)
def test_check_says_what_was_clipped(lift):
    deep_blue = torch.tensor([0.0, 0.0, 1.0])[:, None, None]
    red = torch.tensor([1.0, -0.5, 0.0])[:, None, None]
    good, bad = (lift.hooks.check(lift(c, SCENE), c, SCENE) for c in (deep_blue, red))
    assert "negative" in good[1].text
    assert not bad[1].ok


@pytest.mark.parametrize("lift", LIFTS)
def test_refuses_wrong_shapes_and_bands(lift):
    with pytest.raises(ValueError, match=r"\(31, 2, 2\).*\(3, y, x\)"):
        lift(torch.ones(31, 2, 2), SCENE)
    with pytest.raises(ValueError, match="380 to 780 nm"):
        lift(torch.ones(3, 2, 2), bands(start=350 * NM, stop=700 * NM, count=36))


def test_lmmse_refuses_bands_that_cannot_carry_colour():
    for start, stop, count in ((500, 600, 2), (550, 550.001, 3)):
        with pytest.raises(ValueError, match="three colours"):
            lift_lmmse(torch.ones(3, 2, 2), bands(start=start * NM, stop=stop * NM, count=count))


@pytest.mark.slow
@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="reads the peak of a process from /proc"
)
def test_full_size_holds_one_cube_and_no_second():
    """In a process of its own, which has no freed memory of other tests to use again."""
    code = """
import torch
from neusee.nodes.spectra import bands, lift_lmmse

def peak():
    (line,) = (line for line in open("/proc/self/status") if line.startswith("VmHWM"))
    return 1024 * float(line.split()[1])

rgb, scene = torch.rand(3, 2048, 2048), bands(start=400e-9, stop=700e-9, count=31)
lift_lmmse(rgb[:, :2, :2], scene)
before = peak()
cube = lift_lmmse(rgb, scene)
print((peak() - before) / (4 * cube.numel()))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert 0.9 < float(done.stdout) < 1.3
