"""The check of a file of raw frames before the run, which reads the pixels only if their type has other than counts."""

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from neusee.nodes import ParameterError
from neusee.nodes.array_bytes import npy_needs
from neusee.nodes.calibrate._frames._image_files import FITS, fits_image, read, refuse_page
from neusee.nodes.input_files import VALUES, once_per_version
from neusee.nodes.input_size import refuse_other_than_file
from neusee.nodes.picture_bytes import pages_need

_STRIP_STARTS, _STRIP_LENGTHS = 273, 279  #: TIFF tags


@once_per_version
def frame_problem(file: Path) -> str:
    """Return a message for a file that is damaged or holds no raw frames, as far as headers show it, else nothing."""
    check = _CHECKS.get(file.suffix.lower())
    try:
        refuse_other_than_file(file)
        return check(file) if check else ""
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        return str(error) if isinstance(error, ValueError) else f"{file} is damaged ({error}): copy the file again"


def _picture(file: Path) -> str:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(file) as image:
            refuse_page(file, image)
            pages_need(file, image, 2.0)
            ends = zip(*(_numbers(image, tag) for tag in (_STRIP_STARTS, _STRIP_LENGTHS)), strict=False)
            if image.format == "PNG":
                image.verify()
            elif (last := max(map(sum, ends), default=0)) > file.stat().st_size:
                return f"{file} is damaged (its pixels end at byte {last}, after its end): copy the file again"
            elif image.mode in ("I", "F"):
                read(file)
    except UnidentifiedImageError:
        return f"{file} is not a readable picture: save the frame as 16-bit grey PNG"
    except Image.DecompressionBombError:
        return f"{file} states more pixels than can be read: give frames of one sensor"
    return ""


def _numbers(image: Any, tag: int) -> tuple[int, ...]:
    return tuple(getattr(image, "tag_v2", {}).get(tag, ()))


def _numpy(file: Path) -> str:
    npy_needs(file, 1.0)
    head = np.load(file, mmap_mode="r", allow_pickle=False)
    if head.dtype.kind not in "uif":
        return f"{file} holds values of type {head.dtype}: save raw frames as whole numbers"
    doubtful = head.dtype.kind != "u" or head.dtype.itemsize > 2
    return _too_large(file, head.shape) or _wrong_numbers(file, head.shape, doubtful)


def _fits(file: Path) -> str:
    """Return a message for a FITS file without an image, cut short, too large, or with other than whole numbers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # astropy warns of a file that is cut short, which is refused here
        shape, end, doubtful = fits_image(file)
    if end > (size := file.stat().st_size):
        return f"{file} is damaged (its image ends at byte {end}, after its end at {size}): copy the file again"
    return _too_large(file, shape) or _wrong_numbers(file, shape, doubtful)


def _too_large(file: Path, shape: tuple[int, ...]) -> str:
    count = math.prod(map(int, shape))
    if count <= VALUES:
        return ""
    return f"{file} has {count} values, more than the limit of {VALUES}: divide the frames among several files"


def _wrong_numbers(file: Path, shape: tuple[int, ...], doubtful: bool) -> str:
    """Return a message for an array that is no stack of frames, or holds no digital numbers, else an empty text.

    Numbers of a type that has counts of a converter alone, such as uint16, are not read before the run.
    """
    if doubtful or len(shape) not in (2, 3) or not math.prod(shape):
        try:
            read(file)
        except ValueError as error:
            return str(error)
    return ""


def _exr(file: Path) -> str:
    from neusee.nodes.scene._spectral_exr import exr_header

    try:
        _, names, size = exr_header(file)
    except ParameterError as error:
        return str(error)
    if len(names) != 1:
        return f"{file} has the channels {', '.join(names)}: save one channel alone"
    return _wrong_numbers(file, size, True)


_CHECKS: dict[str, Callable[[Path], str]] = {
    ".png": _picture,
    ".tif": _picture,
    ".tiff": _picture,
    ".npy": _numpy,
    ".exr": _exr,
    **dict.fromkeys(FITS, _fits),
}
