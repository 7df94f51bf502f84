"""What the header of a file of frames says: size, bits of a number, exposure and light."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neusee.nodes.array_bytes import npy_needs, refuse_packed
from neusee.nodes.calibrate._frames._damaged_frames import frame_problem
from neusee.nodes.calibrate._frames._image_files import FITS, fits_image, read, readable
from neusee.nodes.input_files import once_per_version
from neusee.nodes.picture_bytes import exr_needs, pages_need

_EXIF, _EXPOSURE, _DESCRIPTION = 0x8769, 33434, 270  #: tags of TIFF and Exif
_TIMES = ("exposuretime", "exptime", "exposure", "integrationtime")  #: keys of an exposure, in seconds without a unit
_LIGHTS = ("photons", "photonsperpixel")
_SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
_NUMBER = re.compile(r"\s*([-+]?[\d.]+(?:e[-+]?\d+)?)\s*(s|ms|us|µs|μs|ns)?\s*", re.IGNORECASE)
_FRACTION = re.compile(r"\s*(\d+)\s*[/⁄]\s*([1-9]\d*(?:\.\d+)?)\s*(s|sec)?\s*", re.IGNORECASE)  #: 1/200 s
_PAIR = re.compile(
    r"([A-Za-z _]+?)\s*[=:]\s*(\d+\s*[/⁄]\s*\d[\d.]*\s*s?|[-+.\deE]+\s*(?:ms|us|µs|μs|ns|s)?)(?![A-Za-z/⁄\d])"
)


class FrameHeader(NamedTuple):
    """What the header of a file of frames says; None for what it does not say."""

    frames: int
    shape: tuple[int, int]  #: (y, x)
    bits: int  #: of a number in the file
    exposure: float | None  #: s
    photons: float | None  #: per pixel and exposure


@once_per_version
def frame_header(file: Path) -> FrameHeader:
    """Return what the header of a file of raw frames says; raise ValueError for a file without raw frames.

    Exposure and light are read from Exif, TIFF descriptions, texts of a PNG, FITS keywords and attributes of OpenEXR.

    Shapes: scalars.
    Units:  exposure s, as Exif, FITS and OpenEXR have it without a unit; photons per pixel and exposure.
    Raises: ValueError for an unknown kind of file, a damaged file, colour, and numbers that are not counts.
    """
    readable(file)
    if problem := frame_problem(file):
        raise ValueError(problem)
    suffix = file.suffix.lower()
    count, shape, bits, said = _HEADERS.get(suffix, _fits if suffix in FITS else _plain)(file)
    found = {re.sub(r"[^a-z]", "", str(key).lower()): value for key, value in said.items()}
    light = next((_number(found[key], False) for key in _LIGHTS if key in found), None)
    return FrameHeader(count, shape, bits, next((_number(found[key]) for key in _TIMES if key in found), None), light)


def _number(value: Any, is_time: bool = True) -> float | None:
    match = _NUMBER.fullmatch(str(value))
    try:
        number = float(match[1]) if match else float(value)
    except (TypeError, ValueError):
        return _fraction(value) if is_time else None
    if not is_time:
        return number if number >= 0 else None
    unit = (match[2] or "").lower() if match else ""
    return number * _SECONDS[unit] if number > 0 else None


def _fraction(value: Any) -> float | None:
    """Return the seconds of a text such as ``1/200 s``."""
    match = _FRACTION.fullmatch(str(value))
    return float(match[1]) / float(match[2]) or None if match else None


_Found = tuple[int, tuple[int, int], int, Mapping[str, Any]]


def _picture(file: Path) -> _Found:
    from PIL import Image

    with Image.open(file) as image:
        pages_need(file, image, 1.0, 0.0)
        exif = image.getexif()
        said: dict[str, Any] = {**_texts(image.info), **_described(str(exif.get(_DESCRIPTION, "")))}
        for tags in (exif, exif.get_ifd(_EXIF)):
            if _EXPOSURE in tags:
                said["exposuretime"] = float(tags[_EXPOSURE])
        bits = 8 if image.mode == "L" else 16 if image.mode.startswith("I;16") or image.format == "PNG" else 32
        return int(getattr(image, "n_frames", 1)), (image.height, image.width), bits, said


def _texts(info: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(key): value for key, value in info.items() if isinstance(value, str | int | float)}


def _described(text: str) -> dict[str, str]:
    """Return the pairs such as ``ExposureTime=0.01 s`` in a text."""
    return {key.strip(): value for key, value in _PAIR.findall(text)}


def _fits(file: Path) -> _Found:
    from astropy.io import fits

    refuse_packed(file)
    with fits.open(file) as opened:
        header = next(part.header for part in opened if getattr(part, "is_image", False) and part.shape)
        said = {key: header[key] for key in header if key and isinstance(header[key], int | float | str)}
        bits = abs(int(header["BITPIX"]))
    shape = fits_image(file)[0]
    return *_stack(shape), bits, said


def _exr(file: Path) -> _Found:
    import OpenEXR

    exr_needs(file)
    with OpenEXR.File(str(file), separate_channels=True) as opened:
        header = dict(opened.header())
        shape = next(iter(opened.channels().values())).pixels.shape
    said = {"exposuretime" if key == "expTime" else key: value for key, value in header.items()}
    return *_stack(shape), 32, said


def _plain(file: Path) -> _Found:
    npy_needs(file, 1.0)
    head = np.load(file, mmap_mode="r", allow_pickle=False)
    return *_stack(head.shape), 8 * head.dtype.itemsize, {}


def _stack(shape: tuple[int, ...]) -> tuple[int, tuple[int, int]]:
    return (1 if len(shape) == 2 else int(shape[0])), (int(shape[-2]), int(shape[-1]))


def frame_means(file: Path) -> list[tuple[float, float]]:
    """Return the mean of each frame of a file and its standard error by the scatter of the pixels, DN."""
    return [(float(x.mean(dtype=np.float64)), float(x.std(dtype=np.float64)) / x.size**0.5) for x in read(file)]


def frame_divisor(file: Path) -> int:
    """Return the greatest common divisor of the numbers of a file of frames; 0 for numbers that are all 0."""
    return int(np.gcd.reduce(np.unique(read(file))))


_HEADERS = {".png": _picture, ".tif": _picture, ".tiff": _picture, ".exr": _exr, ".npy": _plain}
