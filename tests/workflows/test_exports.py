"""Files of a run: what is written is what is read back, bit for bit."""

from __future__ import annotations

import struct
import zlib

import pytest
import torch

from neusee.nodes.values import Bands, Psf
from neusee.workflows import _exports


def test_sixteen_bit_png_holds_every_bit():
    image = torch.randint(0, 65536, (3, 4, 7), generator=torch.Generator().manual_seed(0)).float()
    content = _exports.png16(image)
    assert struct.unpack(">IIBB", content[16:26]) == (7, 4, 16, 2)
    start = content.index(b"IDAT")
    size = struct.unpack(">I", content[start - 4 : start])[0]
    lines = zlib.decompress(content[start + 4 : start + 4 + size])
    rows = [struct.unpack(">21H", lines[r * 43 + 1 : (r + 1) * 43]) for r in range(4)]
    assert torch.equal(torch.tensor(rows).reshape(4, 7, 3).permute(2, 0, 1).float(), image)


@pytest.mark.parametrize("image", [torch.zeros(4, 2, 2), torch.full((3, 2, 2), 65536.0), -torch.ones(3, 2, 2)])
def test_sixteen_bit_png_refuses_what_it_cannot_hold(image):
    with pytest.raises(ValueError, match="16-bit PNG"):
        _exports.png16(image)


def test_spectral_exr_reads_back_with_its_wavelengths(tmp_path):
    from neusee.nodes.scene._spectral_exr import read_spectral

    centres = torch.tensor([400e-9, 550e-9, 700e-9], dtype=torch.float64)
    bands, cube = Bands(centres, torch.full_like(centres, 1e-8), torch.ones_like(centres)), torch.rand(3, 5, 6)
    for value in (cube, Psf(cube, centres)):
        (tmp_path / "a.exr").write_bytes(_exports.spectral(value, bands))
        found, wavelengths, _ = read_spectral(tmp_path / "a.exr")
        assert torch.equal(found, cube)
        assert torch.allclose(wavelengths, centres, rtol=1e-12)


def test_rgb_exr_reads_back_as_it_was(tmp_path):
    import OpenEXR

    image = torch.rand(3, 5, 6)
    (tmp_path / "a.exr").write_bytes(_exports.exr(image))
    pixels = OpenEXR.File(str(tmp_path / "a.exr")).channels()["RGB"].pixels
    assert torch.equal(torch.tensor(pixels).permute(2, 0, 1), image)
