"""Data files of a run: other programs read back every number, and a file never looks whole
before it is.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from neusee.nodes.values import Bands, Psf
from neusee.workflows.report import data_exports
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.result_store import Store


def noise(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(sum(shape)))


def bands(count: int) -> Bands:
    ones = torch.ones(count, dtype=torch.float64)
    return Bands(torch.linspace(400e-9, 700e-9, count, dtype=torch.float64), ones * 10e-9, ones)


def channels(path: Path) -> dict[str, np.ndarray]:
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels.copy() for name, channel in file.channels().items()}


@pytest.mark.parametrize("planes", [1, 3])
def test_a_png_of_16_bits_comes_back(planes, tmp_path, monkeypatch):
    monkeypatch.setattr(data_exports, "_AT_ONCE", 500)  # several blocks of lines
    image = (noise(planes, 37, 53) * 65535).round()
    image[:, :2, :2] = torch.tensor([0.0, 65535.0])
    data_exports.png16(path := tmp_path / "x.png", image=image)
    if planes == 3:
        from kornia_rs.io import read_image_png_u16

        found = torch.from_numpy(
            np.asarray(read_image_png_u16(str(path), "rgb")).astype(np.int64)
        ).permute(2, 0, 1)
    else:
        from PIL import Image

        found = torch.from_numpy(np.array(Image.open(path)).astype(np.int64))[None]
    assert torch.equal(found.double(), image.double())


@pytest.mark.parametrize(
    "image", [torch.full((3, 2, 2), torch.nan), torch.full((3, 2, 2), 65536.0), noise(2, 4, 4)]
)
def test_a_png_refuses_what_it_cannot_hold(image, tmp_path):
    with pytest.raises(ValueError, match="16-bit PNG"):
        data_exports.png16(tmp_path / "x.png", image=image)
    assert not list(tmp_path.iterdir())


def test_pictures_come_back_from_openexr(tmp_path):
    image = noise(3, 19, 7) * 1e6
    data_exports.exr(tmp_path / "x.exr", image=image)
    data_exports.exr(tmp_path / "grey.exr", image=image[:1])
    found = channels(tmp_path / "x.exr")
    assert [torch.equal(torch.from_numpy(found[c]), image[i]) for i, c in enumerate("RGB")] == [
        True
    ] * 3
    assert torch.equal(torch.from_numpy(channels(tmp_path / "grey.exr")["Y"]), image[0])


def test_a_stack_keeps_its_tails_and_half_floats_lose_them(tmp_path):
    tails = 10.0 ** -torch.arange(31.0).reshape(31, 1, 1).expand(31, 5, 3)
    psf = Psf(tails, torch.ones(31, dtype=torch.float64))
    data_exports.spectral(tmp_path / "x.exr", cube=psf, bands=bands(31))
    data_exports.spectral(tmp_path / "half.exr", cube=psf, bands=bands(31), half=True)
    full, half = (channels(tmp_path / name) for name in ("x.exr", "half.exr"))
    assert torch.equal(torch.stack([torch.from_numpy(full[name]) for name in sorted(full)]), tails)
    assert [float(half[name].max()) > 0 for name in sorted(half)] == [True] * 8 + [False] * 23
    with pytest.raises(ValueError, match="half floats"):
        data_exports.spectral(tmp_path / "y.exr", cube=tails * 1e5, bands=bands(31), half=True)


def test_outputs_are_read_by_safetensors(tmp_path):
    from safetensors.torch import load_file

    psf = Psf(noise(3, 4, 5), torch.ones(3, dtype=torch.float64))
    data_exports.safetensors(
        path := tmp_path / "x", path=noise(2, 3).bool(), psf=psf, raw=noise(4, 6).t()
    )
    found = load_file(path)
    of_psf = {f"psf.{field}" for field in ("intensity", "clear_peak", "cut_off", "averaged")}
    assert found.keys() == {"path", "raw", *of_psf}
    assert torch.equal(found["raw"], noise(4, 6).t())
    assert torch.equal(found["psf.intensity"], psf.intensity)
    assert found["path"].dtype == torch.bool


def test_a_file_that_is_cut_short_is_not_there(tmp_path):
    shelf = DerivedFiles(Store(tmp_path))

    def dies(path: Path) -> None:
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        shelf.keep("ab" * 16, ".exr", "x", dies)
    assert shelf.find("ab" * 16, ".exr") is None
    assert not [name for _, _, names in os.walk(tmp_path / "files") for name in names]


def test_a_full_disk_leaves_the_file_in_a_temporary_folder(tmp_path):
    shelf = DerivedFiles(Store(tmp_path / "cache"))

    def full(path: Path) -> None:
        if path.is_relative_to(tmp_path):
            raise OSError(28, "No space left on device")
        path.write_bytes(b"whole")

    with pytest.warns(UserWarning, match="No space left"):
        path = shelf.keep("ab" * 16, ".exr", "x", full)
    assert path.read_bytes() == b"whole"
    assert not path.is_relative_to(tmp_path)
    assert shelf.keep("cd" * 16, ".exr", "x", full).parent.parent == path.parent.parent
    del shelf
    assert not path.exists()  # the folder goes with it
