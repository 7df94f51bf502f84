"""Photographs: the sRGB curve, 16 bits, orientation, what is refused, and the frame."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from neusee.nodes import ParameterError
from neusee.nodes.scene import _photograph, _picture_changes, framed_scene, photograph


def saved(folder, array, name="a.png", **how):
    Image.fromarray(array).save(folder / name, **how)
    return folder / name


def linear(code):
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def words(folder, array):
    from kornia_rs.io import write_image_png_u16

    write_image_png_u16(str(folder / "w.png"), array, "rgb")
    return folder / "w.png"


def random8(*shape):
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


def test_decodes_every_8_bit_code_by_the_closed_form(tmp_path):
    codes = np.repeat(np.arange(256, dtype=np.uint8).reshape(16, 16, 1), 3, axis=2)
    result = photograph(file=saved(tmp_path, codes))
    assert result.shape == (3, 16, 16)
    assert result.dtype == torch.float32
    np.testing.assert_allclose(result[1].numpy(), linear(codes[..., 1] / 255), atol=3e-7)


def test_usual_form_agrees_with_reference(tmp_path):
    path = saved(tmp_path, random8(31, 23, 3))
    usual, slow = (
        photograph(file=path, shape=(12, 12)),
        photograph.hooks.reference(file=path, shape=(12, 12)),
    )
    torch.testing.assert_close(usual.double(), slow, rtol=photograph.rtol, atol=1e-7)


def test_keeps_all_16_bits_of_colour(tmp_path):
    codes = np.arange(5 * 7 * 3, dtype=np.uint16).reshape(5, 7, 3) * 601 + 3
    result = photograph(file=words(tmp_path, codes))
    np.testing.assert_allclose(result.numpy(), linear(codes.transpose(2, 0, 1) / 65535), atol=3e-7)
    assert len(torch.unique(result)) == codes.size


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_grey_becomes_three_equal_channels(tmp_path, kind):
    top = np.iinfo(kind).max
    codes = (np.linspace(0, 1, 12).reshape(3, 4) * top).astype(kind)
    result = photograph(file=saved(tmp_path, codes))
    np.testing.assert_allclose(
        result.numpy(), np.repeat(linear(codes / top)[None], 3, 0), atol=3e-7
    )


def test_palette_is_its_colours(tmp_path):
    image = Image.fromarray(random8(6, 7, 3)).quantize(8)
    image.save(tmp_path / "p.png")
    expected = linear(np.asarray(image.convert("RGB")) / 255)
    assert photograph.hooks.preflight(file=tmp_path / "p.png") == []
    np.testing.assert_allclose(
        photograph(file=tmp_path / "p.png").permute(1, 2, 0).numpy(), expected, atol=3e-7
    )


@pytest.mark.parametrize("turned", range(1, 9))
@pytest.mark.parametrize("bits", [8, 16])
def test_turns_upright_by_exif(tmp_path, turned, bits):
    from PIL import ImageOps

    upright = random8(4, 6, 3)
    exif = Image.Exif()
    exif[0x0112] = turned
    back = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}  # Pillow's names of the inverse operations
    held = Image.fromarray(upright)
    held = held if turned == 1 else held.transpose(Image.Transpose(back[turned]))
    path = tmp_path / "e.png"
    held.save(path, exif=exif)
    assert np.array_equal(np.asarray(ImageOps.exif_transpose(Image.open(path))), upright)
    if bits == 16:
        values = _photograph._sixteen_bit_codes(
            words(tmp_path, np.asarray(held).astype(np.uint16)), turned
        )
        assert np.array_equal(values, upright)
    else:
        np.testing.assert_allclose(
            photograph(file=path).permute(1, 2, 0).numpy(), linear(upright / 255), atol=3e-7
        )
        assert len(photograph.hooks.preflight(file=path)) == (turned != 1)


def test_jpeg_is_read_close_to_what_was_saved(tmp_path):
    smooth = np.repeat(np.linspace(0, 255, 64).astype(np.uint8)[None, :, None], 64, 0).repeat(3, 2)
    result = photograph(file=saved(tmp_path, smooth, "a.jpg", quality=98))
    assert np.abs(result.permute(1, 2, 0).numpy() - linear(smooth / 255)).max() < 0.02


def test_one_pixel_is_a_picture(tmp_path):
    path = saved(tmp_path, np.full((1, 1, 3), 128, np.uint8))
    assert photograph(file=path).shape == (3, 1, 1)
    assert photograph.hooks.preflight(file=path, shape=(3, 2)) != []
    torch.testing.assert_close(
        photograph(file=path, shape=(3, 2)), torch.full((3, 3, 2), float(linear(128 / 255)))
    )


def _float_tiff(folder):
    return saved(folder, np.ones((3, 3), np.float32), "f.tif")


def _alpha(folder):
    return saved(folder, random8(3, 3, 4))


def _cmyk(folder):
    Image.fromarray(random8(8, 8, 3)).convert("CMYK").save(folder / "c.jpg")
    return folder / "c.jpg"


def _clear_palette(folder):
    Image.fromarray(random8(6, 7, 3)).quantize(8).save(folder / "p.png", transparency=0)
    return folder / "p.png"


def _text(folder):
    (folder / "t.png").write_text("no picture")
    return folder / "t.png"


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (_float_tiff, "TIFF"),
        (_alpha, "transparency"),
        (_cmyk, "CMYK"),
        (_clear_palette, "transparency"),
        (_text, "not a readable picture"),
    ],
)
def test_refuses_before_the_run_with_the_fix(tmp_path, made, words):
    with pytest.raises(ParameterError, match=words) as error:
        photograph.hooks.preflight(file=made(tmp_path))
    assert error.value.parameter == "file"
    assert "PNG" in str(error.value) or "png" in str(error.value)


def test_a_foreign_profile_is_named(tmp_path):
    from PIL import ImageCms

    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("XYZ")).tobytes()
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    assert (
        "profile"
        in photograph.hooks.preflight(file=saved(tmp_path, random8(4, 4, 3), icc_profile=lab))[0]
    )
    assert (
        photograph.hooks.preflight(file=saved(tmp_path, random8(4, 4, 3), icc_profile=srgb)) == []
    )


@settings(max_examples=40, deadline=None)
@given(*(st.integers(1, 70) for _ in range(4)))
def test_frame_has_the_shape_and_no_overshoot(y, x, to_y, to_x):
    scene = torch.rand(3, y, x, generator=torch.Generator().manual_seed(y * x))
    result = framed_scene(scene, (to_y, to_x))
    assert result.shape == (3, to_y, to_x)
    assert float(result.min()) >= float(scene.min()) - 1e-6
    assert float(result.max()) <= float(scene.max()) + 1e-6
    size = _picture_changes.covering_size((y, x), (to_y, to_x))
    assert size[0] >= to_y
    assert size[1] >= to_x


def test_frame_without_scaling_cuts_the_centre():
    scene = torch.arange(3 * 6 * 4.0).reshape(3, 6, 4)
    assert torch.equal(framed_scene(scene, (2, 4)), scene[:, 2:4, :])
    assert framed_scene(scene, None) is scene


def test_frame_averages_in_linear_light(tmp_path):
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 255
    middle = photograph(file=saved(tmp_path, stripes), shape=(8, 8))[:, 2:6, 2:6]
    assert abs(float(middle.mean()) - 0.5) < 0.02  # averaging codes would give 0.21


def test_the_sample_picture_is_read_as_it_is(request):
    path = request.config.rootpath / "recipes/samples/china.jpg"
    assert path.stat().st_size < 300_000
    assert photograph.hooks.preflight(file=path, shape=(384, 384)) == []
    assert 0.3 < float(photograph(file=path, shape=(384, 384)).mean()) < 0.5
