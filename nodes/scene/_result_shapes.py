"""Shapes of the pictures that the scene nodes read or draw."""

from pathlib import Path
from typing import Any

from torch import Tensor

from neusee.nodes.scene._exr_picture import exr
from neusee.nodes.scene._hyperspectral import hyperspectral
from neusee.nodes.scene._photograph import photograph
from neusee.nodes.scene._test_targets import targets
from neusee.nodes.shape_rules import blank
from neusee.nodes.values import Bands

Size = tuple[int, int]


@targets.shape
def _(*, shape: Size, **params: Any) -> Tensor:
    return blank(3, *shape)


@photograph.shape
def _(*, file: Path, shape: Size | None = None) -> Tensor:
    return blank(3, *(shape or _header(file)))


@exr.shape
def _(*, file: Path, shape: Size | None = None, **params: Any) -> Tensor:
    return blank(3, *(shape or _exr_header(file)))


@hyperspectral.shape
def _(bands: Bands, *, shape: Size | None = None, **params: Any) -> Tensor:
    if shape is None:
        raise LookupError("the size of the file is not known before it is read")
    return blank(len(bands.centres), *shape)


def _picture(result: Tensor, *inputs: Any, file: Path, **params: Any) -> tuple[float, float]:
    """Return the work of reading a picture, which is held in whole before it is cropped."""
    size = float(file.stat().st_size)
    try:
        y, x = _exr_header(file) if file.suffix.lower() == ".exr" else _header(file)
    except (OSError, RuntimeError, ValueError):
        return 4 * size, 4 * size + result.numel()
    return 12.0 * y * x, float(3 * y * x + 3 * result.numel())


photograph.work(_picture)
exr.work(_picture)


def _header(file: Path) -> Size:
    from PIL import Image

    with Image.open(file) as picture:
        return picture.height, picture.width


def _exr_header(file: Path) -> Size:
    import OpenEXR

    low, high = OpenEXR.File(str(file), header_only=True).header()["dataWindow"]
    return int(high[1] - low[1]) + 1, int(high[0] - low[0]) + 1
