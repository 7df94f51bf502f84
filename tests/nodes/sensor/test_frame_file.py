"""A frame is read as the numbers that a file holds, in every format, and refused if it does not
fit.
"""

import struct
import zlib

import numpy as np
import pytest
import torch
from kornia_rs import io
from PIL import Image

from neusee.nodes import ParameterError
from neusee.nodes.sensor import frame

SHAPE = (6, 9)
THREE = torch.ones(3, 5, dtype=torch.float64)


def numbers(top=65535, channels=3):
    return np.random.default_rng(1).integers(0, top + 1, (*SHAPE, channels))


def png8(path, values):
    Image.fromarray(values.astype(np.uint8).squeeze()).save(path)


def exr(path, values):
    import OpenEXR

    planes = (
        {"RGB": values.astype(np.float32)}
        if values.shape[-1] == 3
        else {"Y": values[..., 0].astype(np.float32)}
    )
    OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write(str(path))


WRITERS = {
    "a.png": (16, lambda path, x: io.write_image_png_u16(str(path), x.astype(np.uint16), "rgb")),
    "b.png": (8, png8),
    "c.tif": (16, lambda path, x: io.write_image_tiff_u16(str(path), x.astype(np.uint16), "rgb")),
    "d.tiff": (8, lambda path, x: io.write_image_tiff_u8(str(path), x.astype(np.uint8), "rgb")),
    "e.exr": (12, exr),
    "f.npy": (16, np.save),
    "g.npy": (16, lambda path, x: np.save(path, x.transpose(2, 0, 1).astype(np.float64))),
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_numbers_of_every_format_are_unchanged(name, tmp_path):
    bits, write = WRITERS[name]
    values = numbers(2**bits - 1)
    write(tmp_path / name, values)
    found = frame(
        THREE, file=tmp_path / name, shape=SHAPE, bits=bits, curve="linear" if bits == 8 else None
    )
    assert found.dtype == torch.float32
    np.testing.assert_array_equal(found.numpy(), values.transpose(2, 0, 1))


def test_a_camera_of_one_channel_takes_a_grey_frame(tmp_path):
    values = numbers(channels=1)
    Image.fromarray(values[..., 0].astype(np.uint16)).save(tmp_path / "grey.png")
    np.save(tmp_path / "grey.npy", values[..., 0])
    for name in ("grey.png", "grey.npy"):
        found = frame(THREE[:1], file=tmp_path / name, shape=SHAPE)
        np.testing.assert_array_equal(found.numpy(), values.transpose(2, 0, 1))


def changed(at, value, kind=np.float64):
    values = numbers(4095).astype(kind)
    values[at] = value
    return values


BAD = {
    "one channel": (numbers(4095, 1), "raw colour filter array, which is not handled yet"),
    "four channels": (numbers(4095, 4), "4 channels, but the camera has 3"),
    "another size": (numbers(4095)[:-1], r"5 x 9 pixels \(y, x\), but sensor.shape is \[6, 9\]"),
    "too large": (changed((0, 0, 0), 4096), "4096 DN, but 12 bits end at 4095"),
    "below 0": (changed((0, 0, 0), -3), "holds -3, below 0"),
    "a fraction": (changed((0, 0, 0), 0.5), "holds 0.5, no whole number"),
    "NaN": (changed((0, 0, 0), np.nan), "1 values that are not finite"),
    "no picture": (np.full((*SHAPE, 3), 7), "the same number, 7, in every pixel"),
    "complex": (np.ones((*SHAPE, 3), complex), r"complex128 of shape \(6, 9, 3\)"),
    "four axes": (np.ones((1, 1, *SHAPE)), r"give numbers of shape \(y, x\)"),
    "nothing": (np.ones((0, 9, 3)), "give numbers of shape"),
}


@pytest.mark.parametrize("case", BAD)
def test_an_array_that_does_not_fit_is_refused_before_the_run(case, tmp_path):
    values, message = BAD[case]
    np.save(tmp_path / "bad.npy", values)
    given = {"file": tmp_path / "bad.npy", "shape": SHAPE, "bits": 12}
    for call in (
        lambda: frame.hooks.preflight(responses=THREE, **given),
        lambda: frame(THREE, **given),
    ):
        with pytest.raises(ParameterError, match=message) as error:
            call()
        assert error.value.parameter == "file"
        assert "\n" not in str(error.value)


FILES = {
    "palette.png": (
        lambda path: Image.new("P", SHAPE[::-1]).save(path),
        "has a palette, transparency",
    ),
    "alpha.png": (
        lambda path: Image.new("RGBA", SHAPE[::-1]).save(path),
        "has a palette, transparency",
    ),
    "text.png": (lambda path: path.write_text("no picture"), "no PNG file, whatever its name says"),
    "cut.tif": (lambda path: path.write_bytes(b"II*\0garbage"), "cannot be read as grey or RGB"),
    "cut.npy": (lambda path: path.write_bytes(b"\x93NUMPY\x01"), "damaged or no picture"),
    "cut.exr": (lambda path: path.write_bytes(b"v/1\x01cut"), "damaged or no picture"),
    "shot.jpg": (
        lambda path: Image.new("RGB", SHAPE[::-1]).save(path),
        "no frame that can be read: give .png",
    ),
    "eight.png": (lambda path: png8(path, numbers(255)), "has 8 bits, but sensor.bits is 12"),
}


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_another_form_is_refused_before_the_run(name, tmp_path):
    write, message = FILES[name]
    write(tmp_path / name)
    with pytest.raises(ParameterError, match=message) as error:
        frame.hooks.preflight(responses=THREE, file=tmp_path / name, shape=SHAPE, bits=12)
    assert "\n" not in str(error.value)


def chunk(kind, data):
    return struct.pack(">I4s", len(data), kind) + data + struct.pack(">I", zlib.crc32(kind + data))


def with_chunk(kind, data):
    """A frame of 16 bits in a PNG with one more chunk."""

    def write(path):
        io.write_image_png_u16(str(path), numbers().astype(np.uint16), "rgb")
        whole = path.read_bytes()
        path.write_bytes(whole[:33] + chunk(kind, data) + whole[33:])

    return write


def tiff_with_profile(name):
    """A TIFF of 16 bits by hand: a directory of ten entries, the pixels, and a colour profile."""

    def write(path):
        pixels, profile = numbers().astype("<u2").tobytes(), b"acsp" + name + bytes(40)
        first = 8 + 2 + 12 * 10 + 4
        depths, strip, icc = first, first + 6, first + 6 + len(pixels)
        entries = [(256, 3, 1, SHAPE[1]), (257, 3, 1, SHAPE[0]), (258, 3, 3, depths), (259, 3, 1, 1), (262, 3, 1, 2),
                   (273, 4, 1, strip), (277, 3, 1, 3), (278, 3, 1, SHAPE[0]), (279, 4, 1, len(pixels)),
                   (34675, 7, len(profile), icc)]  # fmt: skip
        listed = b"".join(struct.pack("<HHII", *entry) for entry in entries)
        head = b"II*\0" + struct.pack("<IH", 8, len(entries)) + listed + bytes(4)
        path.write_bytes(head + struct.pack("<3H", 16, 16, 16) + pixels + profile)

    return write


SIGNS = {
    "eight.png": (
        8,
        lambda path: png8(path, numbers(255)),
        "has 8 bits, as pictures with a tone curve",
    ),
    "eight.tif": (8, WRITERS["d.tiff"][1], "has 8 bits"),
    "eight.npy": (8, np.save, "has 8 bits"),
    "bytes.npy": (12, lambda path, x: np.save(path, x.astype(np.uint8)), "has 8 bits"),
    "stretched.npy": (
        16,
        lambda path, x: np.save(path, x.astype(np.uint16) * 257),
        "only multiples of 257",
    ),
    "moved.npy": (
        16,
        lambda path, x: np.save(path, x.astype(np.uint16) * 256),
        "only multiples of 256",
    ),
    "srgb.png": (16, with_chunk(b"sRGB", b"\0"), "says of itself that it is sRGB encoded"),
    "gamma.png": (
        16,
        with_chunk(b"gAMA", struct.pack(">I", 45455)),
        r"a tone curve with the gamma 2\.2",
    ),
    "code.png": (
        16,
        with_chunk(b"cICP", bytes([1, 13, 0, 1])),
        "transfer characteristic 13 of ITU-T H.273",
    ),
    "profile.png": (
        16,
        with_chunk(b"iCCP", b"Display P3\0\0" + zlib.compress(b"x")),
        "colour profile Display P3",
    ),
    "profile.tif": (16, tiff_with_profile(b"sRGB IEC61966-2.1"), "has a colour profile"),
}


@pytest.mark.parametrize("name", SIGNS)
def test_a_file_with_a_sign_of_a_tone_curve_needs_a_statement(name, tmp_path):
    bits, write, sign = SIGNS[name]
    (
        write(tmp_path / name, numbers(255))
        if name.endswith("npy") or name == "eight.tif"
        else write(tmp_path / name)
    )
    given = {"responses": THREE, "file": tmp_path / name, "shape": SHAPE, "bits": bits}
    with pytest.raises(ParameterError, match=sign) as error:
        frame.hooks.preflight(**given)
    assert error.value.parameter == "file"
    assert "linear in the light" in str(error.value)
    assert "state frame.curve=linear" in str(error.value)
    assert frame.hooks.preflight(**given, curve="linear") == []


LINEAR = {
    "plain.png": WRITERS["a.png"][1],
    "linear.png": lambda path, x: with_chunk(b"gAMA", struct.pack(">I", 100000))(path),
    # 12 bits at the upper end
    "moved.npy": lambda path, x: np.save(path, (x.astype(np.uint16) // 16) * 16),
    "linear.tif": lambda path, x: tiff_with_profile(b"Linear sRGB")(path),
}


@pytest.mark.parametrize("name", LINEAR)
def test_a_frame_of_the_converter_needs_no_statement(name, tmp_path):
    LINEAR[name](tmp_path / name, numbers())
    assert frame.hooks.preflight(responses=THREE, file=tmp_path / name, shape=SHAPE, bits=16) == []


def test_a_png_that_is_cut_is_refused(tmp_path):
    io.write_image_png_u16(str(tmp_path / "cut.png"), numbers().astype(np.uint16), "rgb")
    whole = (tmp_path / "cut.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ParameterError, match="damaged or no picture"):
        frame.hooks.preflight(file=tmp_path / "cut.png", shape=SHAPE)
