"""Frames out of files: every number as it was written, and a clear refusal of what is no raw
frame.
"""

import importlib.util
import struct
import zlib

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from pydantic import ValidationError

from neusee.nodes import ParameterError
from neusee.nodes.calibrate import _frame_files, frames

NUMBERS = np.array([[0, 1, 255, 256], [32767, 32768, 65534, 65535]], np.uint16)


def png(path, numbers):
    Image.fromarray(numbers).save(path)
    return path


def exr(path, numbers, names=("Y",)):
    import OpenEXR

    OpenEXR.File({}, dict.fromkeys(names, numbers.astype(np.float32))).write(str(path))
    return path


def fits(path, numbers):
    from astropy.io import fits as astropy

    astropy.PrimaryHDU(numbers).writeto(path)
    return path


def npy(path, numbers):
    np.save(path, numbers)
    return path


def tiff(path, numbers):
    tifffile.imwrite(path, numbers)
    return path


def png_of_four_bits():
    """Two grey pixels of 4 bits: 3 and 9. Pillow scales them to 8."""

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", 2, 1, 4, 0, 0, 0, 0)
    parts = (
        chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\x00\x39")) + chunk(b"IEND", b"")
    )
    return b"\x89PNG\r\n\x1a\n" + parts


def read(*files):
    return frames(files=frames.params.model_validate({"files": [str(f) for f in files]}).files)


@pytest.mark.parametrize("write", [png, tiff, exr, fits, npy], ids=lambda w: w.__name__)
def test_sixteen_bits_survive(tmp_path, write):
    if write is fits:
        pytest.importorskip("astropy")
    kind = {png: "png", tiff: "TIF", exr: "exr", fits: "fits", npy: "npy"}[write]
    found = read(write(tmp_path / f"a.{kind}", NUMBERS))
    assert found.dtype == torch.int32
    assert found.tolist() == [NUMBERS.tolist()]


@pytest.mark.parametrize("write", [png, tiff, npy], ids=lambda w: w.__name__)
def test_eight_bits_are_not_scaled(tmp_path, write):
    kind = {png: "png", tiff: "tif", npy: "npy"}[write]
    numbers = np.arange(256, dtype=np.uint8).reshape(16, 16)
    assert read(write(tmp_path / f"a.{kind}", numbers)).tolist() == [numbers.tolist()]


def test_big_endian_tiff_and_many_pages(tmp_path):
    stack = np.stack([NUMBERS, NUMBERS[::-1], NUMBERS[:, ::-1]])
    tifffile.imwrite(tmp_path / "a.tif", stack, byteorder=">", photometric="minisblack")
    assert read(tmp_path / "a.tif").tolist() == stack.tolist()


def test_a_stack_in_one_array_is_as_many_frames(tmp_path):
    stack = np.stack([NUMBERS, NUMBERS[::-1]])
    assert read(npy(tmp_path / "a.npy", stack)).tolist() == stack.tolist()


def test_folders_patterns_and_lists_mean_the_same_files(tmp_path):
    for i, name in enumerate(["c", "a", "b"]):
        png(tmp_path / f"{name}.png", NUMBERS[:, i : i + 2].copy())
    (tmp_path / ".hidden").write_text("x")
    listed = read(*(tmp_path / f"{n}.png" for n in "abc"))
    assert listed[0].tolist() == NUMBERS[:, 1:3].tolist()
    assert torch.equal(read(tmp_path), listed)
    assert torch.equal(read(tmp_path / "*.png"), listed)
    assert torch.equal(read(tmp_path / "[ab].png", tmp_path / "c.png"), listed)


@pytest.mark.parametrize("missing", ["nothing.png", "*.tif", "empty"])
def test_what_is_not_there_is_refused(tmp_path, missing):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValidationError, match="no such file, and no folder or pattern"):
        read(tmp_path / missing)


def test_frames_of_other_sizes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"b\.png is \(2, 2\), but .*a\.png is \(2, 4\)"):
        read(png(tmp_path / "a.png", NUMBERS), png(tmp_path / "b.png", NUMBERS[:, :2].copy()))


def test_colour_and_loss_are_refused(tmp_path):
    grey = Image.fromarray(np.zeros((4, 4), np.uint8))
    grey.convert("RGB").save(tmp_path / "rgb.png")
    grey.save(tmp_path / "loss.jpg")
    (tmp_path / "loss.jpg").rename(tmp_path / "loss.png")
    Image.fromarray(np.zeros((4, 4), bool)).save(tmp_path / "one.png")
    grey.convert("P").save(tmp_path / "table.png")
    for name in ("rgb", "loss", "one", "table"):
        with pytest.raises(ValueError, match=f"{name}.png is (PNG|JPEG) with pixels of kind"):
            read(tmp_path / f"{name}.png")
    (tmp_path / "four.png").write_bytes(png_of_four_bits())
    with pytest.raises(
        ValueError, match=r"four\.png is PNG with pixels of kind L, not raw grey of 8 or 16 bits"
    ):
        read(tmp_path / "four.png")
    exr(tmp_path / "rgb.exr", NUMBERS, ("R", "G", "B"))
    with pytest.raises(ValueError, match="save one channel alone"):
        read(tmp_path / "rgb.exr")


@pytest.mark.parametrize("bad", [0.5, -1.0, float("nan"), float("inf"), 2.0**24])
def test_numbers_that_no_converter_gives_are_refused(tmp_path, bad):
    with pytest.raises(ValueError, match=r"a\.npy holds .*not a digital number"):
        read(npy(tmp_path / "a.npy", np.array([[1.0, bad]])))


def signed_fits(path, numbers):
    return fits(path, numbers.astype(np.int16))


def packed_fits(path, numbers):
    from astropy.io import fits as astropy

    astropy.HDUList([astropy.PrimaryHDU(), astropy.CompImageHDU(numbers.astype(np.int16))]).writeto(
        path
    )
    return path


SHORT = (signed_fits, packed_fits)  #: 16 bits, which do not hold the largest of the numbers below
WRONG = [
    (w, bad)
    for w in (fits, *SHORT, npy, tiff)
    for bad in (-1, -32768, 2**24)
    if bad < 2**15 or w not in SHORT
]


@pytest.mark.parametrize(("write", "bad"), WRONG)
def test_whole_numbers_that_no_converter_gives_are_found_before_the_run(tmp_path, write, bad):
    """Types with a sign, and those of 32 bits, may hold such numbers; the numbers of other types
    are not read.
    """
    if "fits" in write.__name__:
        pytest.importorskip("astropy")
    kind = {npy: "npy", tiff: "tif"}.get(write, "fits")
    numbers = np.full((4, 5), 7, np.int32)
    numbers[2, 3] = bad
    with pytest.raises(
        ParameterError, match=rf"a\.{kind} holds {bad}(\.0)?, not a digital number: give raw frames"
    ):
        frames.hooks.preflight(files=(write(tmp_path / f"a.{kind}", numbers),))
    numbers[2, 3] = 7
    assert frames.hooks.preflight(files=(write(tmp_path / f"b.{kind}", numbers),)) == []


@pytest.mark.parametrize("write", [fits, npy, tiff])
def test_numbers_of_a_type_that_only_counts_are_not_read_before_the_run(
    tmp_path, write, monkeypatch
):
    if write is fits:
        pytest.importorskip("astropy")
    monkeypatch.setattr(_frame_files, "read_frames", lambda file: pytest.fail(f"{file} is read"))
    kind = {npy: "npy", tiff: "tif", fits: "fits"}[write]
    assert frames.hooks.preflight(files=(write(tmp_path / f"a.{kind}", NUMBERS),)) == []


@pytest.mark.parametrize("shape", [(4,), (0, 4), (1, 2, 3, 4)])
def test_other_shapes_are_refused(tmp_path, shape):
    with pytest.raises(ValueError, match="neither"):
        read(npy(tmp_path / "a.npy", np.zeros(shape)))


def test_a_kind_that_is_not_read_is_refused_before_the_run(tmp_path):
    (tmp_path / "a.raw").write_bytes(b"1")
    with pytest.raises(
        ParameterError, match=r"a\.raw: frames cannot be read from \.raw: give \.png"
    ):
        frames.hooks.preflight(files=(tmp_path / "a.raw",))
    assert frames.hooks.preflight(files=(png(tmp_path / "a.png", NUMBERS),)) == []


def test_fits_without_astropy_says_what_to_install(tmp_path, monkeypatch):
    known = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "astropy" else known(name, *a)
    )
    with pytest.raises(ParameterError, match=r"pip install 'neusee\[fits\]'"):
        frames.hooks.preflight(files=(tmp_path / "a.fits",))


def test_the_check_says_the_range(tmp_path):
    found = read(png(tmp_path / "a.png", NUMBERS))
    assert frames.hooks.check(found)[0].text == "1 frames of 2 x 4, 0 to 65535 DN"
