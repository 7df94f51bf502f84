"""Readers of frames from image files, which keep the numbers of the camera unchanged."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neusee.nodes.array_bytes import fits_needs, npy_needs, refuse_packed
from neusee.nodes.input_size import head_of, refuse_other_than_file
from neusee.nodes.picture_bytes import exr_needs, pages_need

_GREY = ("L", "I", "I;16", "I;16B", "I;16L", "F")  #: pixel modes that Pillow reads without conversion
FITS = (".fits", ".fit", ".fts")  #: suffixes
_TOP = 1 << 24  #: DN; above any converter
_WHOLE = 11  #: bytes of a number while it is compared with a whole number: 8, and 3 of flags


def read(file: Path) -> NDArray[np.int32]:
    """Read the frames of a file, (frame, y, x) int32; raise ValueError for a file without raw frames."""
    reader = readable(file)
    refuse_other_than_file(file)
    stack = reader(file)
    if stack.ndim not in (2, 3) or not stack.size:
        raise ValueError(f"{file}: shape {stack.shape} is neither (y, x) nor (frame, y, x): give raw frames")
    with np.errstate(invalid="ignore"):
        whole = stack.astype(np.int64)
    bad = (whole != stack) | (whole < 0) | (whole >= _TOP)
    if bad.any():
        raise ValueError(f"{file} holds {stack[bad][0]}, not a digital number: give raw frames, whole numbers "
                         f"from 0 to {_TOP - 1}")  # fmt: skip
    return whole.astype(np.int32).reshape(-1, *stack.shape[-2:])


def readable(file: Path) -> Callable[[Path], NDArray[Any]]:
    """Return the function that reads files of this suffix; raise ValueError for an unknown suffix."""
    suffix = file.suffix.lower()
    if suffix in FITS and importlib.util.find_spec("astropy") is None:
        raise ValueError(f"{file.name} needs astropy: pip install 'neusee[fits]'")
    if suffix not in _READERS:
        raise ValueError(
            f"{file.name}: frames cannot be read from {suffix or 'such files'}: give {', '.join(_READERS)}"
        )
    return _READERS[suffix]


def _picture(file: Path) -> NDArray[Any]:
    from PIL import Image, ImageSequence, UnidentifiedImageError

    try:
        with Image.open(file) as image:
            pages_need(file, image, 2.0, _WHOLE)
            pages = [_page(file, page) for page in ImageSequence.Iterator(image)]
    except UnidentifiedImageError:
        raise ValueError(f"{file} is not a readable picture: save the frame as 16-bit grey PNG") from None
    if len({page.shape for page in pages}) > 1:
        raise ValueError(f"{file}: the pages of the file differ in size: give frames of one size")
    return np.stack(pages)


def _page(file: Path, page: Any) -> NDArray[Any]:
    refuse_page(file, page)
    return np.array(page)


def refuse_page(file: Path, page: Any) -> None:
    """Raise ValueError for a page of a picture file that does not hold raw grey numbers."""
    depth = head_of(file, 25)[24:] if page.format == "PNG" else b"\x08"
    if page.mode not in _GREY or page.format not in ("PNG", "TIFF") or depth not in (b"\x08", b"\x10"):
        raise ValueError(f"{file} is {page.format} with pixels of kind {page.mode}, not raw grey of 8 or 16 bits: save "
                         "one channel as PNG or TIFF, without colour and without lossy compression")  # fmt: skip


def _exr(file: Path) -> NDArray[Any]:
    import OpenEXR

    exr_needs(file, 4 + _WHOLE)
    with OpenEXR.File(str(file), separate_channels=True) as opened:
        channels = opened.channels()
        if len(channels) != 1:
            raise ValueError(f"{file} has the channels {', '.join(channels)}: save one channel alone")
        return np.array(next(iter(channels.values())).pixels)


def _fits(file: Path) -> NDArray[Any]:
    """Read the first image of a FITS file, with the zero point and scale of the header applied."""
    from astropy.io import fits

    shape, bits = fits_header(file)
    fits_needs(file, shape, bits)
    with fits.open(file) as opened:
        return np.array(_first_image(file, opened).data)


def _npy(file: Path) -> NDArray[Any]:
    npy_needs(file, 1.0, _WHOLE)
    values: NDArray[Any] = np.load(file, allow_pickle=False)
    return values


def fits_header(file: Path) -> tuple[tuple[int, ...], int]:
    """Return the shape of the first image of a FITS file, and the bits of its numbers; only headers are read."""
    from astropy.io import fits

    refuse_packed(file)
    with fits.open(file) as opened:
        image = _first_image(file, opened)
        return tuple(image.shape), int(image.header["BITPIX"])


def fits_image(file: Path) -> tuple[tuple[int, ...], int, bool]:
    """Return the shape of the first image of a FITS file, its last byte, and True if it may hold other than counts.

    The type of the numbers and their scale tell whether they may be fractions, negative or too large for a converter.

    Only headers are read. Raises ValueError for a file without an image.
    """
    from astropy.io import fits

    refuse_packed(file)
    with fits.open(file) as opened:
        image = _first_image(file, opened)
        header, about = image.header, image.fileinfo()
        bits, zero = int(header["BITPIX"]), float(header.get("BZERO", 0))
        least = zero - (2 ** (bits - 1) if bits > 8 else 0)  # eight bits have no sign
        scaled = float(header.get("BSCALE", 1)) != 1 or zero % 1 != 0 or "BLANK" in header
        doubtful = scaled or bits < 0 or least < 0 or least + 2**bits > _TOP
        packed = isinstance(image, fits.CompImageHDU)  # its blocks of 2880 bytes, of which the last one may be short
        size = about["datSpan"] - 2879 if packed else math.prod(image.shape) * abs(bits) // 8
        return tuple(image.shape), int(about["datLoc"] + size), doubtful


def _first_image(file: Path, opened: Any) -> Any:
    image = next((part for part in opened if getattr(part, "is_image", False) and part.shape), None)
    if image is None:
        raise ValueError(f"{file} holds no image: give a FITS file with an image")
    return image


_READERS: dict[str, Callable[[Path], NDArray[Any]]] = {
    ".png": _picture,
    ".tif": _picture,
    ".tiff": _picture,
    ".exr": _exr,
    ".npy": _npy,
    **dict.fromkeys(FITS, _fits),
}
