"""OpenEXR scenes: primaries, negatives, brightness, what is refused."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from neusee.nodes import ParameterError
from neusee.nodes.scene import exr

OpenEXR = pytest.importorskip("OpenEXR")
DATA = Path(__file__).parents[3] / "../shared/data/exr"
needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason="the OpenEXR sample pictures are not beside the project"
)
AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)


def saved(folder, channels, **header):
    path = folder / "a.exr"
    about = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(about, channels).write(str(path))
    return path


def planes(*values, kind=np.float32):
    return dict(zip("RGB", (np.full((2, 3), v, kind) for v in values), strict=True))


def test_without_primaries_values_are_srgb(tmp_path):
    path = saved(tmp_path, planes(0.25, 1025.0, 2.0, kind=np.float16))
    assert exr.hooks.preflight(file=path) == []
    assert exr(file=path)[:, 0, 0].tolist() == [0.25, 1025.0, 2.0]
    assert exr(file=path, white=4.0)[:, 1, 2].tolist() == [0.0625, 256.25, 0.5]


def test_names_do_not_depend_on_their_order_in_the_file(tmp_path):
    channels = {
        "Z": np.ones((2, 3), np.float32),
        "A": np.ones((2, 3), np.float32),
        **planes(1.0, 2.0, 3.0),
    }
    assert exr(file=saved(tmp_path, channels))[:, 0, 0].tolist() == [1.0, 2.0, 3.0]


def test_ap0_as_colour_science_says(tmp_path):
    import colour

    rgb = np.array([0.4, 0.2, 0.1])
    result = exr(file=saved(tmp_path, planes(*rgb), chromaticities=AP0), negatives="keep")[
        :, 0, 0
    ].numpy()
    spaces = colour.RGB_COLOURSPACES["ACES2065-1"], colour.RGB_COLOURSPACES["sRGB"]
    expected = colour.RGB_to_RGB(rgb, *spaces, chromatic_adaptation_transform="Bradford")
    np.testing.assert_allclose(result, expected, atol=2e-4)


@pytest.mark.parametrize(
    "primaries",
    [
        AP0,
        (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3),
        (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.31, 0.32),
    ],
)
def test_white_stays_white(tmp_path, primaries):
    path = saved(tmp_path, planes(0.5, 0.5, 0.5), chromaticities=primaries)
    np.testing.assert_allclose(exr(file=path)[:, 0, 0].numpy(), 0.5, atol=2e-4)


def test_xyz_primaries_are_xyz(tmp_path):
    import colour

    xyz = np.array([0.3, 0.4, 0.2])
    header = {
        "chromaticities": (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3),
        "adoptedNeutral": np.array([0.3127, 0.329], np.float32),
    }
    result = exr(file=saved(tmp_path, planes(*xyz), **header), negatives="keep")[:, 0, 0].numpy()
    # white of equal energy scales X, Y, Z alike, and the header says that D65 is neutral already
    expected = colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB @ xyz
    np.testing.assert_allclose(result, expected, rtol=2e-3)


#: of CIE X, Y, Z, without a matrix of colour-science: IEC 61966-2-1, clause 5.2
XYZ_TO_SRGB = [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]


def test_channels_x_y_and_z_are_cie_xyz(tmp_path):
    xyz = np.array([0.3, 0.4, 0.2])
    path = saved(
        tmp_path, dict(zip("XYZ", (np.full((2, 3), v, np.float32) for v in xyz), strict=True))
    )
    assert exr.hooks.preflight(file=path) == []
    result = exr(file=path, negatives="keep")[:, 1, 2].numpy()
    np.testing.assert_allclose(result, XYZ_TO_SRGB @ xyz, atol=3e-4)


@pytest.mark.parametrize(
    ("header", "white"),
    [
        ({"adoptedNeutral": np.array([0.3457, 0.3585], np.float32)}, (0.3457, 0.3585)),
        ({"chromaticities": (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)}, (1 / 3, 1 / 3)),
        ({}, (0.3127, 0.3290)),
    ],
)
def test_the_white_of_xyz_in_the_header_becomes_the_white_of_srgb(tmp_path, header, white):
    x, y = white
    xyz = (x / y, 1.0, (1 - x - y) / y)
    path = saved(
        tmp_path,
        dict(zip("XYZ", (np.full((2, 3), v, np.float32) for v in xyz), strict=True)),
        **header,
    )
    np.testing.assert_allclose(exr(file=path, negatives="keep").numpy(), 1.0, atol=1e-3)


def test_the_part_with_the_picture_is_found_or_chosen_by_name(tmp_path):
    about = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    depth = OpenEXR.Part({**about, "name": "depth"}, {"Z": np.ones((2, 3), np.float32)})
    left, right = (
        OpenEXR.Part({**about, "name": n}, planes(v, v, v))
        for n, v in (("left", 0.25), ("right", 0.5))
    )
    OpenEXR.File([depth, right]).write(str(tmp_path / "a.exr"))
    assert float(exr(file=tmp_path / "a.exr").max()) == 0.5
    OpenEXR.File([depth, left, right]).write(str(tmp_path / "b.exr"))
    assert float(exr(file=tmp_path / "b.exr", part="left").max()) == 0.25
    with pytest.raises(ParameterError, match="in the parts left, right: set part"):
        exr.hooks.preflight(file=tmp_path / "b.exr")
    with pytest.raises(ParameterError, match="the channels Z, but"):
        exr.hooks.preflight(file=tmp_path / "b.exr", part="depth")


def test_luminance_alone_is_grey_and_said(tmp_path):
    path = saved(tmp_path, {"Y": np.array([[0.5, 2.0]], np.float32)})
    assert "luminance" in exr.hooks.preflight(file=path)[0]
    assert exr(file=path).tolist() == [[[0.5, 2.0]]] * 3


def test_refuses_missing_channels_with_those_it_has(tmp_path):
    path = saved(tmp_path, {"R": np.ones((2, 2), np.float32), "depth": np.ones((2, 2), np.float32)})
    with pytest.raises(ParameterError, match="R, depth"):
        exr.hooks.preflight(file=path)


def test_refuses_what_is_no_exr(tmp_path):
    (tmp_path / "a.exr").write_text("text")
    with pytest.raises(ParameterError, match="OpenEXR"):
        exr.hooks.preflight(file=tmp_path / "a.exr")


def test_refuses_values_that_are_not_finite(tmp_path):
    path = saved(tmp_path, planes(1.0, np.inf, 1.0))
    with pytest.raises(ValueError, match="6 values"):
        exr(file=path)


def test_negatives_are_clipped_and_counted_or_kept(tmp_path):
    path = saved(tmp_path, planes(-0.25, 1.0, 1.0))
    assert float(exr(file=path).min()) == 0
    assert float(exr(file=path, negatives="keep").min()) == -0.25
    assert "6 of 18 values were negative" in exr.hooks.check(exr(file=path), file=path)[0].text


def test_one_pixel_and_a_frame(tmp_path):
    path = saved(tmp_path, {c: np.full((1, 1), 7.0, np.float32) for c in "RGB"})
    assert "enlarged 4.00" in exr.hooks.preflight(file=path, shape=(4, 2))[0]
    assert torch.equal(exr(file=path, shape=(4, 2)), torch.full((3, 4, 2), 7.0))


@needs_data
def test_carrots_as_colour_science_says():
    import colour

    with OpenEXR.File(str(DATA / "Carrots.exr"), separate_channels=True) as file:
        held = np.stack([file.channels()[c].pixels for c in "RGB"], -1).astype(float)
    spaces = colour.RGB_COLOURSPACES["ACES2065-1"], colour.RGB_COLOURSPACES["sRGB"]
    expected = colour.RGB_to_RGB(held, *spaces, chromatic_adaptation_transform="Bradford")
    result = exr(file=DATA / "Carrots.exr", negatives="keep").permute(1, 2, 0).numpy()
    np.testing.assert_allclose(result, expected, atol=5e-4)


@needs_data
@pytest.mark.parametrize(
    ("name", "peak"), [("Desk", 233.75), ("GoldenGate", 685.5), ("BrightRings", 1025.0)]
)
def test_bright_light_survives(name, peak):
    scene = exr(file=DATA / f"{name}.exr")
    assert float(scene.max()) == peak
    assert float(scene.min()) >= 0


def drawn():
    """The script that draws the sample, as a module."""
    spec = importlib.util.spec_from_file_location(
        "make_night", Path(__file__).with_name("make_night.py")
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.night()


def test_the_street_at_night_is_drawn_again_bit_for_bit(request):
    path = request.config.rootpath / "recipes/samples/night.exr"
    assert path.stat().st_size < 300_000
    with OpenEXR.File(str(path)) as file:
        assert np.array_equal(file.channels()["RGB"].pixels, drawn())
    scene = exr(file=path)
    assert float(scene.max()) > 300
    assert float(scene.median()) < 0.1
    assert float(scene.min()) > 0
