"""Height maps of one's own: five kinds of files, their units and pitch, resampling with a known
error, and mistakes.
"""

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image, PngImagePlugin
from safetensors.torch import save_file
from scipy.io import savemat
from torch.testing import assert_close

from neusee.nodes import ParameterError, doe, optics

STOP = optics.stop(samples=64, pitch=1e-4, diameter=6.4e-3)
STATED = {"pupil_pitch": 1e-4}  #: the pitch of the pupil as a recipe writes it
HEIGHT = np.random.default_rng(5).uniform(0, 3e-6, (64, 64)).astype(np.float32)


def seeded():
    return torch.Generator().manual_seed(0)


def read(file, **params):
    assert doe.pixelwise.hooks.preflight(stop=STOP, file=file, **STATED, **params) == []
    return doe.pixelwise(STOP, file=file, **params, rng=seeded())


def refused(file, stop=STOP, **params):
    with pytest.raises(ParameterError) as error:
        doe.pixelwise.hooks.preflight(stop=stop, file=file, **params)
    return error.value.parameter, str(error.value)


def saved(folder, kind, height, **stated):
    """Write a height map with what its header states, such as unit="1 um"."""
    file = folder / f"map.{kind}"
    if kind == "npy":
        np.save(file, height)
    elif kind == "safetensors":
        save_file(
            {"height": torch.from_numpy(height), "more": torch.zeros(2)},
            file,
            metadata=stated or None,
        )
    elif kind == "exr":
        OpenEXR.File(dict(stated), {"height": height, "more": height * 0}).write(str(file))
    elif kind == "mat":
        savemat(file, {"height": height, **stated})
    else:
        chunks = PngImagePlugin.PngInfo()
        for word, text in stated.items():
            chunks.add_text(word, text)
        Image.fromarray(height).save(file, pnginfo=chunks)
    return file


# --- units ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["npy", "safetensors", "exr", "mat"])
def test_every_kind_of_file_gives_the_same_heights(tmp_path, kind):
    assert_close(read(saved(tmp_path, kind, HEIGHT)), torch.from_numpy(HEIGHT), rtol=0, atol=0)
    in_microns = (HEIGHT.astype(np.float64) * 1e6).astype(np.float32)
    found = read(saved(tmp_path, kind, in_microns), unit=1e-6)
    assert_close(found, torch.from_numpy(HEIGHT), rtol=2e-7, atol=0)
    if kind != "npy":
        assert_close(read(saved(tmp_path, kind, in_microns, unit="1 um")), found, rtol=0, atol=0)


def test_a_picture_states_the_height_of_white(tmp_path):
    levels = np.random.default_rng(2).integers(0, 65536, (64, 64), dtype=np.uint16)
    found = read(saved(tmp_path, "png", levels, depth="2.5 um"))
    np.testing.assert_allclose(found.numpy(), levels / 65535 * 2.5e-6, rtol=1e-6)
    assert_close(read(saved(tmp_path, "png", levels), depth=2.5e-6), found, rtol=0, atol=0)
    (note,) = doe.pixelwise.hooks.preflight(
        stop=STOP, file=saved(tmp_path, "png", levels), **STATED
    )
    assert (
        note
        == "map.png: white counts as 1.2 um high, because nothing states its height: give depth"
    )


@pytest.mark.parametrize("shape", [(), (0, 0), (1, 64), (3, 64, 64)])
@pytest.mark.parametrize("pitch", [None, 1e-3])
def test_an_array_without_two_axes_is_no_map(tmp_path, shape, pitch):
    np.save(tmp_path / "map.npy", np.zeros(shape))
    assert refused(tmp_path / "map.npy", pitch=pitch)[1].endswith("save a map with two axes")


@pytest.mark.parametrize("order", [">f8", "<f4", ">i4", "longdouble"])
def test_the_byte_order_of_a_file_does_not_matter(tmp_path, order):
    np.save(tmp_path / "map.npy", np.arange(4096).reshape(64, 64).astype(order))
    assert_close(read(tmp_path / "map.npy", unit=1e-9), torch.arange(4096.0).reshape(64, 64) * 1e-9)


@pytest.mark.parametrize("kind", ["safetensors", "exr", "mat", "png"])
def test_the_recipe_and_the_header_must_agree(tmp_path, kind):
    word = "depth" if kind == "png" else "unit"
    height = HEIGHT if kind != "png" else np.ones((64, 64), np.uint16)
    file = saved(tmp_path, kind, height, **{word: "1 um"})
    assert doe.pixelwise.hooks.preflight(stop=STOP, file=file, **STATED, **{word: 1e-6}) == []
    assert refused(file, **{word: 1e-9}) == (
        word,
        f"0.001 um, but the header of map.{kind} says 1 um: leave one of them out",
    )


# --- resampling -----------------------------------------------------------------------------------


def wave(shape, pitch, period=4e-3):
    """A smooth surface whose samples are ``pitch`` apart, centred on the axis."""
    v, u = ((np.arange(n) - (n - 1) / 2) * pitch for n in shape)
    return 1e-6 * (
        2
        + np.sin(2 * np.pi * u[None, :] / period + 0.3)
        * np.cos(2 * np.pi * v[:, None] / period - 0.7)
    )


@pytest.mark.parametrize(
    ("shape", "pitch"), [((48, 48), 1.4e-4), ((33, 50), 2e-4), ((130, 131), 5e-5)]
)
def test_a_map_with_its_own_pitch_is_resampled_and_its_error_is_told(tmp_path, shape, pitch):
    np.save(tmp_path / "map.npy", wave(shape, pitch))
    params = {"file": tmp_path / "map.npy", "pitch": pitch}
    found = doe.pixelwise(STOP, **params, rng=seeded())
    _, told = doe.pixelwise.hooks.check(found, STOP, **params)
    sizes = " x ".join(map(str, shape))
    assert told.text.startswith(
        f"map.npy resampled from {sizes} samples {pitch * 1e6:g} um apart, rms error "
    )
    u = (np.arange(64) - 31.5) * 1e-4
    clear = np.hypot(*np.meshgrid(u, u)) <= 3.2e-3
    off = np.sqrt(np.mean((found.double().numpy() - wave((64, 64), 1e-4))[clear] ** 2))
    assert 0.7 < float(told.text.split()[-2]) * 1e-9 / off < 1.4
    # h^2 / 8 of the curvature of both sines
    assert off < 0.2 * (2 * np.pi / 4e-3) ** 2 * pitch**2 * 1e-6


def test_a_finer_map_loses_detail_and_says_so(tmp_path):
    np.save(tmp_path / "map.npy", wave((256, 256), 2.5e-5))
    (note,) = doe.pixelwise.hooks.preflight(stop=STOP, file=tmp_path / "map.npy", pitch=2.5e-5)
    assert note.startswith(
        "map.npy: the map has 4 samples for each sample of the pupil, so that its finest detail is"
    )
    assert note.endswith("set samples to 256 to keep it")


def test_a_plane_is_resampled_exactly_and_centred(tmp_path):
    """A tilted plane with an even and an odd number of samples: its height at the axis is the
    mean of the plane.
    """
    v, u = np.arange(41.0)[:, None], np.arange(70.0)
    np.save(tmp_path / "map.npy", 1e-8 * (v + u))
    found = doe.pixelwise(STOP, file=tmp_path / "map.npy", pitch=1.7e-4, rng=seeded())
    x = (torch.arange(64, dtype=torch.float64) - 31.5) * (1e-4 / 1.7e-4)
    assert_close(found.double(), 1e-8 * ((x + 20)[:, None] + (x + 34.5)), rtol=1e-6, atol=0)


def test_steps_are_kept_by_the_nearest_sample(tmp_path):
    steps = np.where(np.arange(40) < 20, 0.0, 1e-6)[None, :].repeat(40, 0)
    np.save(tmp_path / "map.npy", steps)
    found = doe.pixelwise(
        STOP, file=tmp_path / "map.npy", pitch=2e-4, between="nearest", rng=seeded()
    )
    assert_close(
        found,
        torch.from_numpy(np.where(np.arange(64) < 32, 0, 1e-6)).float().expand(64, 64),
        rtol=0,
        atol=0,
    )
    parameter, text = refused(tmp_path / "map.npy", pitch=2e-4)
    assert parameter == "file"
    assert "the height jumps by 1 um of 1 um from column 19 to 20, at row " in text
    assert text.endswith("unwrap a wrapped map, or set between: nearest to keep the steps")


def test_a_step_outside_the_clear_aperture_is_no_step(tmp_path):
    x = (np.arange(80) - 39.5) * 1e-4
    height = wave((80, 80), 1e-4) * (np.hypot(x[:, None], x) < 3.5e-3)
    np.save(tmp_path / "map.npy", height)
    assert (
        doe.pixelwise.hooks.preflight(stop=STOP, file=tmp_path / "map.npy", pitch=1.0001e-4) == []
    )


# --- mistakes -------------------------------------------------------------------------------------


def test_a_wrapped_map_is_refused_before_it_is_resampled(tmp_path):
    np.save(tmp_path / "map.npy", (wave((48, 48), 1.4e-4) * 3) % 1.2e-6)
    assert (
        "linear interpolation makes a ramp: unwrap"
        in refused(tmp_path / "map.npy", pitch=1.4e-4)[1]
    )


@pytest.mark.parametrize(("shape", "pitch"), [((48, 48), 1.3e-4), ((64, 60), 1e-4)])
def test_a_map_smaller_than_the_pupil_is_refused(tmp_path, shape, pitch):
    np.save(tmp_path / "map.npy", np.zeros(shape))
    parameter, text = refused(tmp_path / "map.npy", pitch=pitch)
    assert parameter == "pitch"
    assert "smaller than the clear aperture of 6.4 mm: give a larger map, or a pitch of" in text


def test_a_map_that_is_not_square_needs_its_pitch(tmp_path):
    np.save(tmp_path / "map.npy", np.zeros((64, 60)))
    assert (
        "(64, 60), not the pupil grid (64, 64): state its pitch" in refused(tmp_path / "map.npy")[1]
    )


@pytest.mark.parametrize("kind", ["npy", "safetensors", "exr"])
def test_sixteen_bit_floats_are_refused(tmp_path, kind):
    parameter, text = refused(saved(tmp_path, kind, (HEIGHT * 1e6).astype(np.float16)), unit=1e-6)
    assert parameter == "file"
    assert "16-bit floats" in text
    assert text.endswith("save 32-bit floats")


@pytest.mark.parametrize("kind", ["npy", "mat"])
def test_complex_heights_are_refused(tmp_path, kind):
    assert "values of type complex" in refused(saved(tmp_path, kind, HEIGHT * np.complex64(1)))[1]


def test_the_place_of_what_is_not_finite_is_told(tmp_path):
    height = HEIGHT.copy()
    height[3, 7] = height[9, 9] = np.nan
    text = refused(saved(tmp_path, "npy", height))[1]
    assert text.startswith(
        "map.npy: 2 heights are NaN or infinite, the first in row 3, column 7, but every height"
    )


def test_heights_without_their_unit_are_refused(tmp_path):
    assert refused(saved(tmp_path, "npy", HEIGHT * 1e6))[1].endswith(
        "state the unit of the file, such as unit: 1 um"
    )


@pytest.mark.parametrize(
    ("text", "said"), [("10", "needs a unit"), ("10 K", "wrong unit"), ("-1 um", "above 0")]
)
def test_a_header_with_a_wrong_length_is_refused(tmp_path, text, said):
    parameter, message = refused(saved(tmp_path, "mat", HEIGHT, pitch=text))
    assert parameter == "file"
    assert f"map.mat: pitch = {text} in the header" in message
    assert said in message


def test_a_matlab_file_of_version_7_3_is_refused_with_the_command_that_saves_another(tmp_path):
    (tmp_path / "map.mat").write_bytes(
        b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b" ") + b"\x89HDF\r\n\x1a\n"
    )
    assert refused(tmp_path / "map.mat")[1].endswith(
        "save it in MATLAB by save('map.mat', 'height', '-v7')"
    )


@pytest.mark.parametrize("kind", ["mat", "exr", "npy", "safetensors", "png"])
def test_bytes_that_are_no_height_map_are_refused(tmp_path, kind):
    (tmp_path / f"map.{kind}").write_bytes(b"no height map at all")
    assert refused(tmp_path / f"map.{kind}")[0] == "file"


def test_several_variables_need_a_name(tmp_path):
    savemat(tmp_path / "map.mat", {"a": HEIGHT, "b": HEIGHT})
    assert (
        "map.mat holds a, b: name the tensor of the height map 'height'"
        in refused(tmp_path / "map.mat")[1]
    )


def test_grey_levels_have_no_unit(tmp_path):
    file = saved(tmp_path, "png", np.ones((64, 64), np.uint16))
    assert refused(file, unit=1e-6) == (
        "unit",
        "map.png holds grey levels: give depth, the height of white",
    )


# --- the size of a map is never changed without a word --------------------------------------------


def test_a_map_without_a_pitch_is_refused_on_a_stretched_pupil(tmp_path):
    """540 samples of 14.96 um became a mask of 25 mm when the lens did."""
    np.save(tmp_path / "map.npy", np.zeros((64, 64)))
    parameter, text = refused(tmp_path / "map.npy", pupil_pitch=3e-5)
    assert parameter == "pitch"
    assert (
        "states no pitch, and the samples of the pupil are 100 um apart and written as 30 um: give"
        " pitch" in text
    )
    for fitting in (1e-4, 1.0004e-4):
        assert (
            doe.pixelwise.hooks.preflight(stop=STOP, file=tmp_path / "map.npy", pupil_pitch=fitting)
            == []
        )
    (note,) = doe.pixelwise.hooks.preflight(stop=STOP, file=tmp_path / "map.npy")
    assert (
        note
        == "map.npy states no pitch: its samples count as those of the pupil, 100 um apart, 6.4 mm"
        " wide"
    )
    found = doe.pixelwise(STOP, file=tmp_path / "map.npy", rng=seeded())
    checks = doe.pixelwise.hooks.check(found, STOP, file=tmp_path / "map.npy")
    assert checks[-1].text == "map.npy: 64 x 64 samples, 100 um apart, 6.4 mm wide"


def test_a_map_with_a_pitch_keeps_its_size_on_another_pupil(tmp_path):
    """A ring of 1 mm stays a ring of 1 mm in a lens of half the diameter."""
    at = (np.arange(640) - 319.5) * 1e-5
    ring = (np.abs(np.hypot(at[:, None], at) - 1e-3) < 1e-4).astype(np.float64) * 1e-6
    np.save(tmp_path / "map.npy", ring)
    half = optics.stop(samples=320, diameter=3.2e-3)
    options = {
        "file": tmp_path / "map.npy",
        "pitch": 1e-5,
        "pupil_pitch": 2e-5,
        "between": "nearest",
    }
    found = doe.pixelwise(half, **options, rng=seeded())
    np.testing.assert_array_equal(found.numpy(), ring[160:-160, 160:-160].astype(np.float32))


def test_a_designed_mask_states_its_pitch(tmp_path):
    save_file(
        {"height": torch.zeros(8, 8)}, tmp_path / "mask.safetensors", doe.size_metadata(14.96e-6)
    )
    height, pitch = doe.height_map(tmp_path / "mask.safetensors")
    assert height.shape == (8, 8)
    assert pitch == pytest.approx(14.96e-6, rel=1e-11)
