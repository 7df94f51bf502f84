"""Files of raw frames: readers, the check before the run, and the values in their headers."""

from __future__ import annotations

import importlib.util
import math
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neusee.nodes import ParameterError
from neusee.nodes.file_headers import exr_needs, fits_needs, npy_needs, pages_need, refuse_packed
from neusee.nodes.input_files import VALUES, head_of, once_per_version, refuse_other_than_file
from neusee.nodes.scene._exr import exr_header

# --- image files ----------------------------------------------------------------------------------

# Readers of frames from image files, which keep the numbers of the camera unchanged.


#: pixel modes that Pillow reads without conversion
_GREY_MODES = ("L", "I", "I;16", "I;16B", "I;16L", "F")
FITS = (".fits", ".fit", ".fts")  #: suffixes
#: DN, 2^24: above the range of any converter, and the limit of exact whole numbers in float32
LARGEST_NUMBER = 1 << 24
#: bytes per pixel value during the check for whole numbers: 8 for an int64, and 3 for masks
_BYTES_COMPARED = 11


def read_frames(file: Path) -> NDArray[np.int32]:
    """Read the frames of a file, (frame, y, x) int32; raise ValueError for a file without raw
    frames.
    """
    reader = reader_of(file)
    refuse_other_than_file(file)
    stack = reader(file)
    if stack.ndim not in (2, 3) or not stack.size:
        raise ValueError(
            f"{file}: shape {stack.shape} is neither (y, x) nor (frame, y, x): give raw frames"
        )
    with np.errstate(invalid="ignore"):
        numbers = stack.astype(np.int64)
    not_digital = (numbers != stack) | (numbers < 0) | (numbers >= LARGEST_NUMBER)
    if not_digital.any():
        raise ValueError(
            f"{file} holds {stack[not_digital][0]}, not a digital number: give raw frames, whole"
            f" numbers from 0 to {LARGEST_NUMBER - 1}"
        )
    return numbers.astype(np.int32).reshape(-1, *stack.shape[-2:])


def reader_of(file: Path) -> Callable[[Path], NDArray[Any]]:
    """Return the function that reads files of this suffix; raise ValueError for an unknown
    suffix.
    """
    suffix = file.suffix.lower()
    if suffix in FITS and importlib.util.find_spec("astropy") is None:
        raise ValueError(f"{file.name} needs astropy: pip install 'neusee[fits]'")
    if suffix not in _READERS:
        raise ValueError(
            f"{file.name}: frames cannot be read from {suffix or 'such files'}: give"
            f" {', '.join(_READERS)}"
        )
    return _READERS[suffix]


def _read_picture(file: Path) -> NDArray[Any]:
    """Read the pages of a PNG or TIFF file as frames (frame, y, x); raise ValueError for colour,
    other depths and pages of different sizes.
    """
    from PIL import Image, ImageSequence, UnidentifiedImageError

    try:
        with Image.open(file) as image:
            pages_need(file, image, 2.0, _BYTES_COMPARED)
            pages = [_read_page(file, page) for page in ImageSequence.Iterator(image)]
    except UnidentifiedImageError:
        raise ValueError(
            f"{file} is not a readable picture: save the frame as 16-bit grey PNG"
        ) from None
    if len({page.shape for page in pages}) > 1:
        raise ValueError(f"{file}: the pages of the file differ in size: give frames of one size")
    return np.stack(pages)


def _read_page(file: Path, page: Any) -> NDArray[Any]:
    refuse_page(file, page)
    return np.array(page)


def refuse_page(file: Path, page: Any) -> None:
    """Raise ValueError for a page of a picture file that does not hold raw grey numbers."""
    depth = head_of(file, 25)[24:] if page.format == "PNG" else b"\x08"
    if (
        page.mode not in _GREY_MODES
        or page.format not in ("PNG", "TIFF")
        or depth not in (b"\x08", b"\x10")
    ):
        raise ValueError(
            f"{file} is {page.format} with pixels of kind {page.mode}, not raw grey of 8 or 16"
            " bits: save one channel as PNG or TIFF, without colour and without lossy compression"
        )


def _read_exr(file: Path) -> NDArray[Any]:
    """Read an OpenEXR file with a single channel, (y, x); raise ValueError for several channels."""
    import OpenEXR

    exr_needs(file, 4 + _BYTES_COMPARED)
    with OpenEXR.File(str(file), separate_channels=True) as opened_file:
        channels = opened_file.channels()
        if len(channels) != 1:
            raise ValueError(
                f"{file} has the channels {', '.join(channels)}: save one channel alone"
            )
        return np.array(next(iter(channels.values())).pixels)


def _read_fits(file: Path) -> NDArray[Any]:
    """Read the first image of a FITS file, with the zero point and scale of the header applied."""
    from astropy.io import fits

    shape, bits = fits_header(file)
    fits_needs(file, shape, bits)
    with fits.open(file) as opened_file:
        return np.array(_first_image(file, opened_file).data)


def _read_npy(file: Path) -> NDArray[Any]:
    npy_needs(file, 1.0, _BYTES_COMPARED)
    values: NDArray[Any] = np.load(file, allow_pickle=False)
    return values


def fits_header(file: Path) -> tuple[tuple[int, ...], int]:
    """Return the shape of the first image of a FITS file and its BITPIX (bits per value, negative
    for floating point); only headers are read.
    """
    from astropy.io import fits

    refuse_packed(file)
    with fits.open(file) as opened_file:
        image = _first_image(file, opened_file)
        return tuple(image.shape), int(image.header["BITPIX"])


def fits_image(file: Path) -> tuple[tuple[int, ...], int, bool]:
    """Return the shape of the first image of a FITS file, the position of its end in the file in
    bytes, and True if it may hold values that are not digital numbers.

    The data type and the scale in the header show whether values may be fractional, negative or too
    large for a converter.

    Only headers are read. Raises ValueError for a file without an image.
    """
    from astropy.io import fits

    refuse_packed(file)
    with fits.open(file) as opened_file:
        image = _first_image(file, opened_file)
        header, positions = image.header, image.fileinfo()
        bits, zero = int(header["BITPIX"]), float(header.get("BZERO", 0))
        # FITS values of eight bits are unsigned
        lowest = zero - (2 ** (bits - 1) if bits > 8 else 0)
        is_scaled = float(header.get("BSCALE", 1)) != 1 or zero % 1 != 0 or "BLANK" in header
        may_hold_others = is_scaled or bits < 0 or lowest < 0 or lowest + 2**bits > LARGEST_NUMBER
        # FITS data fill blocks of 2880 bytes; the last block may be cut short
        packed = isinstance(image, fits.CompImageHDU)
        image_bytes = (
            positions["datSpan"] - 2879 if packed else math.prod(image.shape) * abs(bits) // 8
        )
        return tuple(image.shape), int(positions["datLoc"] + image_bytes), may_hold_others


def _first_image(file: Path, opened: Any) -> Any:
    """Return the first header-data unit of an open FITS file that has an image; raise ValueError if
    there is none.
    """
    image = next((unit for unit in opened if getattr(unit, "is_image", False) and unit.shape), None)
    if image is None:
        raise ValueError(f"{file} holds no image: give a FITS file with an image")
    return image


_READERS: dict[str, Callable[[Path], NDArray[Any]]] = {
    ".png": _read_picture,
    ".tif": _read_picture,
    ".tiff": _read_picture,
    ".exr": _read_exr,
    ".npy": _read_npy,
    **dict.fromkeys(FITS, _read_fits),
}


# --- damaged frames -------------------------------------------------------------------------------

# The check of a file of raw frames before the run; it reads the pixels only if their data type
# allows values that are not digital numbers.


_STRIP_STARTS, _STRIP_LENGTHS = 273, 279  #: TIFF tags


@once_per_version
def frame_problem(file: Path) -> str:
    """Return an error message for a file that is damaged or holds no raw frames, as far as its
    header shows, else an empty text.
    """
    check = _CHECKS.get(file.suffix.lower())
    try:
        refuse_other_than_file(file)
        return check(file) if check else ""
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        return (
            str(error)
            if isinstance(error, ValueError)
            else f"{file} is damaged ({error}): copy the file again"
        )


def _check_picture(file: Path) -> str:
    """Return an error message for a PNG or TIFF file that is damaged, cut short, or not raw grey
    with digital numbers, else an empty text.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(file) as image:
            refuse_page(file, image)
            pages_need(file, image, 2.0)
            strips = zip(
                *(_tag_numbers(image, tag) for tag in (_STRIP_STARTS, _STRIP_LENGTHS)), strict=False
            )
            # the checksums of a PNG; for a TIFF, the end of the last strip against the size of the
            # file
            if image.format == "PNG":
                image.verify()
            elif (end_of_pixels := max(map(sum, strips), default=0)) > file.stat().st_size:
                return (
                    f"{file} is damaged (its pixels end at byte {end_of_pixels}, after its end):"
                    " copy the file again"
                )
            elif image.mode in ("I", "F"):
                read_frames(file)
    except UnidentifiedImageError:
        return f"{file} is not a readable picture: save the frame as 16-bit grey PNG"
    except Image.DecompressionBombError:
        return f"{file} states more pixels than can be read: give frames of one sensor"
    return ""


def _tag_numbers(image: Any, tag: int) -> tuple[int, ...]:
    """Return the values of a TIFF tag; empty for a file that is no TIFF."""
    return tuple(getattr(image, "tag_v2", {}).get(tag, ()))


def _check_npy(file: Path) -> str:
    """Return an error message for a .npy file that is too large or does not hold digital numbers,
    else an empty text.
    """
    npy_needs(file, 1.0)
    array = np.load(file, mmap_mode="r", allow_pickle=False)
    if array.dtype.kind not in "uif":
        return f"{file} holds values of type {array.dtype}: save raw frames as whole numbers"
    may_hold_others = array.dtype.kind != "u" or array.dtype.itemsize > 2
    return _too_large(file, array.shape) or _wrong_numbers(file, array.shape, may_hold_others)


def _check_fits(file: Path) -> str:
    """Return an error message for a FITS file that has no image, is cut short, is too large, or
    does not hold digital numbers, else an empty text.
    """
    with warnings.catch_warnings():
        # astropy warns of a file that is cut short, which is refused here
        warnings.simplefilter("ignore")
        shape, end_of_image, may_hold_others = fits_image(file)
    if end_of_image > (size := file.stat().st_size):
        return (
            f"{file} is damaged (its image ends at byte {end_of_image}, after its end at {size}):"
            " copy the file again"
        )
    return _too_large(file, shape) or _wrong_numbers(file, shape, may_hold_others)


def _too_large(file: Path, shape: tuple[int, ...]) -> str:
    """Return an error message for an array of more values than can be read, else an empty text."""
    count = math.prod(map(int, shape))
    if count <= VALUES:
        return ""
    return (
        f"{file} has {count} values, more than the limit of {VALUES}: divide the frames among"
        " several files"
    )


def _wrong_numbers(file: Path, shape: tuple[int, ...], doubtful: bool) -> str:
    """Return an error message for an array that is no stack of frames or does not hold digital
    numbers, else an empty text.

    The pixels are read only if ``doubtful``: a data type such as uint16 can hold nothing but
    digital numbers.
    """
    if doubtful or len(shape) not in (2, 3) or not math.prod(shape):
        try:
            read_frames(file)
        except ValueError as error:
            return str(error)
    return ""


def _check_exr(file: Path) -> str:
    """Return an error message for an OpenEXR file that cannot be read, has several channels, or
    does not hold digital numbers, else an empty text.
    """
    try:
        _, names, size = exr_header(file)
    except ParameterError as error:
        return str(error)
    if len(names) != 1:
        return f"{file} has the channels {', '.join(names)}: save one channel alone"
    return _wrong_numbers(file, size, True)


_CHECKS: dict[str, Callable[[Path], str]] = {
    ".png": _check_picture,
    ".tif": _check_picture,
    ".tiff": _check_picture,
    ".npy": _check_npy,
    ".exr": _check_exr,
    **dict.fromkeys(FITS, _check_fits),
}


# --- frame headers --------------------------------------------------------------------------------

# The values in the header of a file of frames: size, bits per value, exposure and light.


_EXIF, _EXPOSURE, _DESCRIPTION = 0x8769, 33434, 270  #: tags of TIFF and Exif
#: header keys of the exposure time; a value without a unit is in seconds
_TIMES = ("exposuretime", "exptime", "exposure", "integrationtime")
_LIGHTS = ("photons", "photonsperpixel")
_SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
_NUMBER = re.compile(r"\s*([-+]?[\d.]+(?:e[-+]?\d+)?)\s*(s|ms|us|µs|μs|ns)?\s*", re.IGNORECASE)
#: 1/200 s
_FRACTION = re.compile(r"\s*(\d+)\s*[/⁄]\s*([1-9]\d*(?:\.\d+)?)\s*(s|sec)?\s*", re.IGNORECASE)
_PAIR = re.compile(
    r"([A-Za-z"
    r" _]+?)\s*[=:]\s*"
    r"(\d+\s*[/⁄]\s*\d[\d.]*\s*s?|[-+.\deE]+\s*(?:ms|us|µs|μs|ns|s)?)(?![A-Za-z/⁄\d])"
)


class FrameHeader(NamedTuple):
    """The values in the header of a file of frames; None for a value that is not there."""

    frames: int
    shape: tuple[int, int]  #: (y, x)
    bits: int  #: bits per value in the file
    exposure: float | None  #: s
    photons: float | None  #: per pixel and exposure


@once_per_version
def frame_header(file: Path) -> FrameHeader:
    """Return the values in the header of a file of raw frames; raise ValueError for a file without
    raw frames.

    Exposure and light are read from Exif, TIFF descriptions, texts of a PNG, FITS keywords and
    attributes of OpenEXR.

    Shapes: scalars.
    Units:  exposure s, as Exif, FITS and OpenEXR have it without a unit; photons per pixel and
            exposure.
    Raises: ValueError for an unknown kind of file, a damaged file, colour, and numbers that are not
            counts.
    """
    reader_of(file)
    if problem := frame_problem(file):
        raise ValueError(problem)
    suffix = file.suffix.lower()
    count, shape, bits, stated = _HEADERS[suffix](file)
    # `Exposure Time`, `ExposureTime` and `EXPOSURE_TIME` are one key
    values = {re.sub(r"[^a-z]", "", str(key).lower()): value for key, value in stated.items()}
    exposure = next((_header_number(values[key]) for key in _TIMES if key in values), None)
    photons = next((_header_number(values[key], False) for key in _LIGHTS if key in values), None)
    return FrameHeader(count, shape, bits, exposure, photons)


def _header_number(value: Any, is_time: bool = True) -> float | None:
    """Return a header value as a number: a time in seconds, or a number of photons if ``is_time``
    is False. None for a text without a number, a time that is not above 0, and a negative number of
    photons.
    """
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


_HeaderValues = tuple[int, tuple[int, int], int, Mapping[str, Any]]


def _header_of_picture(file: Path) -> _HeaderValues:
    """Return the number of frames, their size (y, x), the bits per value and the header values of a
    PNG or TIFF file.
    """
    from PIL import Image

    with Image.open(file) as image:
        pages_need(file, image, 1.0, 0.0)
        exif = image.getexif()
        stated: dict[str, Any] = {
            **_texts(image.info),
            **_pairs_in(str(exif.get(_DESCRIPTION, ""))),
        }
        for tags in (exif, exif.get_ifd(_EXIF)):
            if _EXPOSURE in tags:
                stated["exposuretime"] = float(tags[_EXPOSURE])
        frames = int(getattr(image, "n_frames", 1))
        return frames, (image.height, image.width), _bits_of(image.mode, image.format), stated


def _bits_of(mode: str, kind: str | None) -> int:
    """Return the bits per pixel of a picture, from its Pillow mode and format."""
    if mode == "L":
        return 8
    return 16 if mode.startswith("I;16") or kind == "PNG" else 32


def _texts(info: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(key): value for key, value in info.items() if isinstance(value, str | int | float)}


def _pairs_in(text: str) -> dict[str, str]:
    """Return the pairs of key and value in a text, such as ``ExposureTime=0.01 s``."""
    return {key.strip(): value for key, value in _PAIR.findall(text)}


def _header_of_fits(file: Path) -> _HeaderValues:
    """Return the number of frames, their size (y, x), the bits per value and the header values of a
    FITS file.
    """
    from astropy.io import fits

    refuse_packed(file)
    with fits.open(file) as opened_file:
        header = next(
            unit.header for unit in opened_file if getattr(unit, "is_image", False) and unit.shape
        )
        stated = {
            key: header[key] for key in header if key and isinstance(header[key], int | float | str)
        }
        bits = abs(int(header["BITPIX"]))
    shape = fits_image(file)[0]
    return *_count_and_size(shape), bits, stated


def _header_of_exr(file: Path) -> _HeaderValues:
    """Return the number of frames, their size (y, x), the bits per value (32) and the header values
    of an OpenEXR file.
    """
    import OpenEXR

    exr_needs(file)
    with OpenEXR.File(str(file), separate_channels=True) as opened_file:
        header = dict(opened_file.header())
        shape = next(iter(opened_file.channels().values())).pixels.shape
    stated = {"exposuretime" if key == "expTime" else key: value for key, value in header.items()}
    return *_count_and_size(shape), 32, stated


def _header_of_npy(file: Path) -> _HeaderValues:
    npy_needs(file, 1.0)
    array = np.load(file, mmap_mode="r", allow_pickle=False)
    return *_count_and_size(array.shape), 8 * array.dtype.itemsize, {}


def _count_and_size(shape: tuple[int, ...]) -> tuple[int, tuple[int, int]]:
    """Return the number of frames and the size (y, x) of an array (y, x) or (frame, y, x)."""
    return (1 if len(shape) == 2 else int(shape[0])), (int(shape[-2]), int(shape[-1]))


def frame_means(file: Path) -> list[tuple[float, float]]:
    """Return the mean of each frame of a file in DN, and the standard error of the mean from the
    scatter of the pixels.
    """
    return [
        (float(x.mean(dtype=np.float64)), float(x.std(dtype=np.float64)) / x.size**0.5)
        for x in read_frames(file)
    ]


def frame_divisor(file: Path) -> int:
    """Return the greatest common divisor of all pixel values of a file of frames; 0 if all are
    0.
    """
    return int(np.gcd.reduce(np.unique(read_frames(file))))


_HEADERS = {
    ".png": _header_of_picture,
    ".tif": _header_of_picture,
    ".tiff": _header_of_picture,
    ".exr": _header_of_exr,
    ".npy": _header_of_npy,
    **dict.fromkeys(FITS, _header_of_fits),
}
