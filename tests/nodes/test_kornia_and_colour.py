"""Where a node does what kornia or colour-science does too: the difference that matters, each
with a third witness.
"""

import itertools
import math
import subprocess
import sys

import colour
import kornia
import numpy as np
import pytest
import scipy.constants
import torch
from colour.io.fichet2021 import match_groups_to_nm
from PIL import Image
from skimage.metrics import structural_similarity

from neusee.nodes import constants
from neusee.nodes.losses import charbonnier
from neusee.nodes.metrics import quality
from neusee.nodes.resampling import enlarge, resize
from neusee.nodes.scene import Photographs, framed_scene, spectral_channels
from neusee.nodes.sensor import crop
from neusee.nodes.spectra import bands, illuminant, lift_mallett, light, paints, render

NM = 1e-9
SCENE = bands(start=400 * NM, stop=700 * NM, count=31)


def drawn(*shape, dtype=torch.float64):
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(1))


# --- kornia ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("light", [0.0, 1e-6])
def test_dark_pictures_are_as_alike_as_scikit_image_says(light):
    """The term 1e-12 that kornia adds to the denominator counts beside the constants of SSIM,
    1e-4 times 9e-4.
    """
    estimate, truth = light * drawn(2, 3, 16, 16)
    how = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "win_size": 11}
    _, exact = structural_similarity(
        estimate.numpy(), truth.numpy(), channel_axis=0, data_range=1.0, full=True, **how
    )
    exact = exact[:, 5:-5, 5:-5].mean()
    theirs = kornia.metrics.ssim(estimate[None], truth[None], 11, padding="valid").mean()
    assert float(quality(estimate, truth, domain="linear").ssim) == pytest.approx(exact, abs=1e-9)
    assert abs(float(theirs) - exact) > 1e-5


def test_equal_pictures_have_a_psnr_that_can_be_averaged():
    picture = drawn(3, 16, 16)
    assert float(kornia.metrics.psnr(picture, picture, 1.0)) == math.inf
    assert float(quality(picture, picture).psnr) == pytest.approx(200.0)


def test_charbonnier_is_an_absolute_difference_where_that_of_kornia_is_a_square():
    small = 1e-2
    estimate, truth = (
        torch.full((3, 4, 4), small, dtype=torch.float64),
        torch.zeros(3, 4, 4, dtype=torch.float64),
    )
    assert float(charbonnier(estimate, truth)) == pytest.approx(
        math.sqrt(small**2 + 1e-6), rel=1e-12
    )
    theirs = kornia.losses.charbonnier_loss(estimate, truth, reduction="mean")
    assert float(theirs) == pytest.approx(small**2 / 2, rel=1e-4)


@pytest.mark.parametrize(("size", "window"), [(8, 5), (9, 4)])
def test_a_window_of_the_other_parity_has_whole_pixels_and_keeps_the_axis(size, window):
    image = drawn(1, size, size)
    theirs = kornia.geometry.transform.center_crop(image[None], (window, window))[0]
    axis = image[0, size // 2, size // 2]
    assert crop(image, shape=(window, window))[0, window // 2, window // 2] == axis
    assert torch.isin(framed_scene(image, (window, size)), image).all()
    assert not torch.isin(theirs, image).any(), "kornia interpolates between four pixels"
    sliced = kornia.augmentation.CenterCrop((window, window), cropping_mode="slice")(image[None])[0]
    assert (sliced[0, window // 2, window // 2] == axis) == (size % 2 == 1)


def test_a_smaller_picture_is_that_of_pillow_where_kornia_blurs_by_a_gaussian():
    picture = drawn(1, 60, 60)
    pillow = np.array(
        Image.fromarray(picture[0].float().numpy()).resize((20, 20), Image.Resampling.BICUBIC)
    )
    theirs = kornia.geometry.transform.resize(
        picture, (20, 20), interpolation="bicubic", antialias=True
    )
    np.testing.assert_allclose(resize(picture, 20, 20)[0], pillow, atol=1e-6)
    assert float((theirs[0] - torch.from_numpy(pillow)).abs().max()) > 0.02


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_the_gradient_of_a_larger_picture_is_deterministic_on_cuda():
    picture = drawn(1, 9, 7).requires_grad_()
    exact = torch.autograd.grad(enlarge(picture, 40, 31).square().sum(), picture)[0]
    there = picture.detach().cuda().requires_grad_()
    torch.use_deterministic_algorithms(True)
    try:
        found = torch.autograd.grad(enlarge(there, 40, 31).square().sum(), there)[0]
        theirs = kornia.geometry.transform.resize(there, (40, 31), interpolation="bicubic")
        with pytest.raises(RuntimeError, match="deterministic"):
            theirs.square().sum().backward()
    finally:
        torch.use_deterministic_algorithms(False)
    torch.testing.assert_close(found.cpu(), exact, rtol=1e-12, atol=1e-12)


def test_crops_and_flips_of_training_leave_the_random_stream_of_torch_alone(tmp_path):
    Image.fromarray(np.arange(20 * 30 * 3, dtype=np.uint8).reshape(20, 30, 3)).save(
        tmp_path / "a.png"
    )
    photographs, before = Photographs.under(tmp_path), torch.get_rng_state()
    cuts = [photographs.crop((8, 8), 5, index) for index in (*range(8), *range(8))]
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(one, two) for one, two in zip(cuts[:8], cuts[8:], strict=True))
    kornia.augmentation.RandomCrop((8, 8))(torch.zeros(1, 3, 20, 30))
    assert not torch.equal(torch.get_rng_state(), before)


# --- colour-science -------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:Aligning")
def test_white_is_white_on_the_bands_of_the_scene():
    """The definition: a reflectance of 1 is (1, 1, 1). Integration by colour-science tints white
    on 31 bands.
    """
    white = torch.ones(31, 1, 1, dtype=torch.float64)
    assert (render(white, SCENE) - 1).abs().max() < 1e-12
    shape = colour.SpectralShape(400, 700, 10)
    xyz = colour.sd_to_XYZ(
        colour.SpectralDistribution(np.ones(31), shape.wavelengths),
        illuminant=colour.SDS_ILLUMINANTS["D65"],
        method="Integration",
    )
    theirs = colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB @ xyz / 100
    assert np.abs(theirs - 1).max() > 1e-4


def test_lamps_keep_the_energy_of_their_lines_where_colour_science_samples_points():
    fine = np.linspace(545 * NM, 555 * NM, 100_001)
    table = light("FL11")
    exact = np.interp(fine, table.wavelengths.numpy(), table.values[0].numpy()).mean()
    sampled = colour.SDS_ILLUMINANTS["FL11"][550]
    assert float(table.over(SCENE)[0, 15]) == pytest.approx(exact, rel=1e-5)
    assert abs(sampled / exact - 1) > 0.05
    assert float(illuminant(SCENE, kind="FL11")[15] / table.over(SCENE)[0, 15]) == pytest.approx(
        1 / float(table.over(SCENE).mean())
    )


def test_charts_are_known_beyond_their_ends_and_agree_with_colour_science_between():
    table = paints()[-1]
    wavelengths, values = table.wavelengths.numpy(), table.values[0].numpy()
    theirs = colour.LinearInterpolator(wavelengths, values)
    inside = torch.linspace(float(wavelengths[0]), float(wavelengths[-1]), 57, dtype=torch.float64)
    np.testing.assert_allclose(table.at(inside)[0], theirs(inside.numpy()), atol=1e-12)
    with pytest.raises(ValueError, match="interpolation range"):
        theirs(wavelengths[-1] + 1 * NM)
    assert float(table.at(torch.tensor([wavelengths[-1] + 1 * NM]))[0, 0]) == values[-1]


def test_a_picture_is_lifted_at_once_and_with_a_gradient_where_colour_science_lifts_a_pixel():
    rgb = drawn(3, 2, 2).requires_grad_()
    whole = bands(start=380 * NM, stop=780 * NM, count=81)
    cube = lift_mallett(rgb, whole)
    for y, x in itertools.product(range(2), range(2)):
        theirs = colour.recovery.RGB_to_sd_Mallett2019(rgb[:, y, x].detach().numpy())
        np.testing.assert_allclose(cube[:, y, x].detach(), theirs.values, atol=1e-12)
    assert torch.autograd.gradcheck(lambda x: lift_mallett(x, whole), (rgb,))
    with pytest.raises(ValueError):  # noqa: PT011 - numpy's own words
        colour.recovery.RGB_to_sd_Mallett2019(rgb.detach().numpy())


def test_names_of_spectral_channels_are_read_as_by_colour_science():
    prefixes = ("", "da", *"pnumcdhkMGTPEZY")
    numbers = {"m": ("5,5", "550", "1e-3"), "Hz": ("545,07", "5e2", "3")}
    for prefix, unit in itertools.product(prefixes, numbers):
        for number in numbers[unit]:
            [(found, name)] = spectral_channels([f"T.{number}{prefix}{unit}"]).items()
            assert name == f"T.{number}{prefix}{unit}"
            assert found == pytest.approx(match_groups_to_nm(number, prefix, unit) * NM, rel=1e-14)


@pytest.mark.slow
def test_names_are_read_without_the_import_of_colour_science():
    code = "from neusee.nodes.scene._exr import spectral_channels as s; s(['T.550,0nm'])"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {code}; print('colour' in sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "False"


def test_constants_have_all_digits_of_the_si_where_colour_science_rounds():
    assert scipy.constants.h == constants.PLANCK
    assert constants.SPEED_OF_LIGHT == scipy.constants.c == colour.constants.CONSTANT_LIGHT_SPEED
    assert abs(colour.constants.CONSTANT_PLANCK / scipy.constants.h - 1) > 1e-8
