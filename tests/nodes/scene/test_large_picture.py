"""Large pictures: the same light as in one piece, in bands of rows, and within the memory that
is stated.
"""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from neusee.nodes import ParameterError, input_files
from neusee.nodes.scene import _picture_changes, exr, framed_scene, photograph

SIZES = [
    ((101, 67), (8, 8)), ((101, 67), (30, 50)), ((67, 101), (67, 100)), ((50, 60), (75, 75)), ((50, 60), (50, 60)),
    ((50, 60), None), ((64, 1), (8, 1)), ((1, 64), (1, 5)), ((333, 222), (7, 3)), ((40, 41), (39, 40)),
]  # fmt: skip


def light(codes):
    return torch.from_numpy(np.ascontiguousarray(codes.transpose(2, 0, 1)))


@pytest.mark.parametrize(("size", "shape"), SIZES)
@pytest.mark.parametrize("band", [1, 500])
def test_bands_of_rows_give_the_light_of_the_whole_picture(monkeypatch, size, shape, band):
    """Kornia resamples the whole picture in float64; a band of one row is the smallest there is."""
    monkeypatch.setattr(_picture_changes, "_LARGE_PIXELS", 0)
    monkeypatch.setattr(_picture_changes, "_BAND_PIXELS", band)
    codes = np.random.default_rng(0).random((*size, 3), dtype=np.float32)
    result = _picture_changes.linear_light(codes, light, shape)
    assert result.dtype == torch.float32
    torch.testing.assert_close(
        result.double(),
        framed_scene(light(codes).double(), shape),
        rtol=0,
        atol=2e-7,
    )


@pytest.mark.parametrize(
    ("node", "name"), [(photograph, "a.png"), (exr, "a.exr"), (exr, "grey.exr")]
)
def test_a_file_gives_the_same_light_in_bands(monkeypatch, tmp_path, node, name):
    values = np.random.default_rng(0).random((40, 60, 3), dtype=np.float32) - 0.1 * (node is exr)
    if node is exr:
        import OpenEXR

        channels = {
            c: values[..., i].copy() for i, c in enumerate("RGB" if name == "a.exr" else "Y")
        }
        OpenEXR.File({}, channels).write(str(tmp_path / name))
    else:
        Image.fromarray((255 * values).astype(np.uint8)).save(tmp_path / name)
    whole = [node(file=tmp_path / name, shape=shape) for shape in (None, (16, 20))]
    told = node.hooks.check(whole[0], file=tmp_path / name)
    monkeypatch.setattr(_picture_changes, "_LARGE_PIXELS", 0)
    monkeypatch.setattr(_picture_changes, "_BAND_PIXELS", 300)
    for one, shape in zip(whole, (None, (16, 20)), strict=True):
        torch.testing.assert_close(node(file=tmp_path / name, shape=shape), one, rtol=0, atol=2e-6)
    assert node.hooks.check(whole[0], file=tmp_path / name) == told
    assert node is photograph or "values were negative" in told[0].text


@pytest.mark.slow
def test_a_picture_at_the_limit_takes_less_than_one_and_a_half_gigabytes(tmp_path):
    """64 million pixels, at the size of the file and for a scene of 8 x 8 pixels: 3.4 GB and
    minutes before.
    """
    side = 8000
    assert side * side == input_files.PIXELS
    Image.new("RGB", (side, side), (90, 120, 200)).save(tmp_path / "a.png", compress_level=1)
    code = """
import sys
from pathlib import Path
from neusee.nodes.scene import photograph
file, shape = Path(sys.argv[1]), (8, 8) if sys.argv[2] == "small" else None
assert photograph.hooks.preflight(file=file, shape=shape) == []
picture = photograph(file=file, shape=shape)
(peak,) = (line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(1024 * float(peak.split()[1]))  # ru_maxrss would begin at the peak of the process that started this one
assert picture.shape == (3, *(shape or (8000, 8000)))
for channel, code in zip(picture[:, :8, :8], (90, 120, 200)):  # the curve of sRGB, IEC 61966-2-1
    assert float((channel - ((code / 255 + 0.055) / 1.055) ** 2.4).abs().max()) < 1e-6
"""
    # glibc keeps what is freed, as it does now and then by itself
    kept = {"MALLOC_MMAP_THRESHOLD_": str(1 << 30)}
    for size in ("whole", "small"):  # a process each
        words = [sys.executable, "-c", code, tmp_path / "a.png", size]
        done = subprocess.run(words, capture_output=True, text=True, env={**os.environ, **kept})
        assert done.returncode == 0, done.stderr
        assert float(done.stdout) < 1.5e9
    Image.new("1", (side + 1, side)).save(tmp_path / "b.png", compress_level=1)
    with pytest.raises(
        ParameterError, match=r"b\.png has 8001 x 8000 pixels, more than the limit of 64 million"
    ):
        photograph.hooks.preflight(file=tmp_path / "b.png")
