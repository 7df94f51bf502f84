"""Shapes of the pictures that the scene nodes read or draw."""

from pathlib import Path
from typing import Any

from torch import Tensor

from neusee.nodes.scene._exr import exr, picture_size
from neusee.nodes.scene._hyperspectral import Layout, hyperspectral, rows_and_columns
from neusee.nodes.scene._photograph import photograph, read_header
from neusee.nodes.scene._picture_changes import grey, is_large
from neusee.nodes.scene._test_targets import targets
from neusee.nodes.shape_rules import blank, like_first
from neusee.nodes.values import Bands

Size = tuple[int, int]

grey.shape(like_first)


@targets.shape
def _(*, shape: Size, **params: Any) -> Tensor:
    return blank(3, *shape)


@photograph.shape
def _(*, file: Path, shape: Size | None = None, **params: Any) -> Tensor:
    return blank(3, *(shape or read_header(file)[2]))


@exr.shape
def _(*, file: Path, shape: Size | None = None, part: str | None = None, **params: Any) -> Tensor:
    return blank(3, *(shape or picture_size(file, part)))


@hyperspectral.shape
def _(
    bands: Bands,
    *,
    file: Path,
    variable: str | None = None,
    layout: Layout = "y x band",
    shape: Size | None = None,
    **params: Any,
) -> Tensor:
    return blank(len(bands.centres), *(shape or rows_and_columns(file, variable, layout)))


def _picture(result: Tensor, *inputs: Any, file: Path, **params: Any) -> tuple[float, float]:
    """Return memory and operations of reading a picture, which is read completely before the
    crop.
    """
    file_bytes = float(file.stat().st_size)
    try:
        y, x = (
            picture_size(file, params.get("part"))
            if file.suffix.lower() == ".exr"
            else read_header(file)[2]
        )
    except (OSError, RuntimeError, ValueError):
        return 4 * file_bytes, 4 * file_bytes + result.numel()
    # three float32 numbers per pixel
    return 12.0 * y * x, float(3 * y * x + 3 * result.numel())


@photograph.work
def _(result: Tensor, *inputs: Any, file: Path, **params: Any) -> tuple[float, float]:
    """Return the memory of the decoded picture, and the operations; a large picture needs less
    memory per pixel.
    """
    memory, operations = _picture(result, *inputs, file=file, **params)
    pixels = memory / 12
    if result.numel() == 3 * pixels:  # not scaled: the law counts the result 2.76 times
        return (0.0 if is_large(pixels) else 16.0 * pixels), operations
    return (10.0 if is_large(pixels) else 60.0) * pixels, operations


exr.work(_picture)
