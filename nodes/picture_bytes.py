"""Bytes that pictures take in memory, from the headers of PNG, JPEG, TIFF and OpenEXR files."""

import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from neusee.nodes import ParameterError
from neusee.nodes.input_size import needs, opened

__depends__ = ["unaffected:file"]  #: the size of an open file
_IN_MEMORY = {"1": 1, "L": 1, "P": 1, "LA": 4, "I;16": 2, "I;16B": 2, "I;16L": 2}  #: bytes of a pixel of Pillow
_COEFFICIENTS = 6  #: bytes of a pixel of a JPEG that is stored in several scans
_WIDTH, _HEIGHT, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_LENGTH = 256, 257, 258, 277, 322, 323
_TIFF_TAGS = frozenset((_WIDTH, _HEIGHT, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_LENGTH))
_TIFF_SIZES = {1: "B", 3: "H", 4: "I", 16: "Q"}  #: of the types of a TIFF tag that are whole numbers
_EXR_SIZES = {0: 4, 1: 2, 2: 4}  #: bytes of a number, by the type of the channel
_MULTIPART, _DEEP = 1 << 12, 1 << 11
_LONGEST = 1 << 20  #: bytes of a list of channels, at most


def picture_needs(file: Path, image: Any, beside: float, parameter: str = "file") -> None:
    """Ask for the memory of the first picture that Pillow has opened, with ``beside`` bytes for each of its pixels."""
    each = _IN_MEMORY.get(image.mode, 4) + beside
    each += _COEFFICIENTS if image.format in ("JPEG", "MPO") else 0
    needs(each * image.width * image.height, file, f"{image.width} x {image.height} pixels", parameter)


def pages_need(file: Path, image: Any, copies: float, beside: float = 0.0, parameter: str = "file") -> None:
    """Ask for the memory of all pages of a file that Pillow has opened.

    There are ``copies`` of the numbers of each page, and ``beside`` bytes for each of its pixels.
    """
    if image.format == "TIFF":
        tiff_needs(file, copies, beside, parameter)
        return
    pages, size = int(getattr(image, "n_frames", 1)), image.width * image.height
    each = copies * _IN_MEMORY.get(image.mode, 4) + beside
    needs(pages * size * each, file, f"{pages} pages of {image.width} x {image.height} pixels", parameter)


# --- TIFF -------------------------------------------------------------------------------------------------------------


class Page(NamedTuple):
    """The size of a page of a TIFF file."""

    width: int
    height: int
    sample: int  #: bits of a sample
    samples: int  #: of a pixel
    tile: int  #: pixels of a tile; 0 for strips

    @property
    def bytes(self) -> float:
        return self.samples * max(self.sample, 8) / 8 * max(self.width * self.height, self.tile)


def tiff_needs(file: Path, copies: float, beside: float = 0.0, parameter: str = "file", first: bool = False) -> None:
    """Ask for the memory of all pages of a TIFF file, or of the ``first`` one, as `pages_need` does."""
    count, total, page = 0, 0.0, Page(0, 0, 8, 1, 0)
    with opened(file, parameter) as raw, suppress(struct.error):  # the reader says what a damaged file lacks
        for page in tiff_pages(raw):
            count += 1
            total += copies * page.bytes + beside * page.width * page.height
            if first:
                break
    needs(total, file, f"{count} page{'s' * (count != 1)} of {page.width} x {page.height} pixels", parameter)


def tiff_pages(raw: BinaryIO) -> Iterator[Page]:
    """Yield the size of each page of an open TIFF file, in its order; end where a page was there before."""
    head = raw.read(16)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None:
        return
    big = struct.unpack(f"{order}H", head[2:4])[0] == 43
    (place,) = struct.unpack(f"{order}Q", head[8:16]) if big else struct.unpack(f"{order}I", head[4:8])
    seen, most = set[int](), os.fstat(raw.fileno()).st_size
    while 0 < place < most and place not in seen:
        seen.add(place)
        page, place = _tiff_page(raw, place, order, big)
        yield page


def _tiff_page(raw: BinaryIO, place: int, order: str, big: bool) -> tuple[Page, int]:
    """Return the page whose directory begins at ``place``, and the place of the next directory."""
    counting, entry, address = ("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")
    raw.seek(place)
    (count,) = struct.unpack(f"{order}{counting}", raw.read(8 if big else 2))
    form = struct.Struct(f"{order}{entry}")
    found: dict[int, int] = {}
    for _ in range(min(count, 65536)):
        tag, kind, length, value = form.unpack(raw.read(form.size))
        if tag in _TIFF_TAGS and kind in _TIFF_SIZES:
            found[tag] = _tiff_number(raw, order, _TIFF_SIZES[kind], length, value)
    after = raw.read(8 if big else 4)
    (following,) = struct.unpack(f"{order}{address}", after) if len(after) == (8 if big else 4) else (0,)
    page = Page(
        found.get(_WIDTH, 0),
        found.get(_HEIGHT, 0),
        found.get(_BITS, 8),
        found.get(_SAMPLES, 1),
        found.get(_TILE_WIDTH, 0) * found.get(_TILE_LENGTH, 0),
    )
    return page, following


def _tiff_number(raw: BinaryIO, order: str, kind: str, length: int, value: bytes) -> int:
    """Return the first number of a tag, which stands in the entry or where the entry says."""
    size = struct.calcsize(f"{order}{kind}")
    if size * length > len(value):
        back = raw.tell()
        raw.seek(int.from_bytes(value, "little" if order == "<" else "big"))
        value = raw.read(size)
        raw.seek(back)
    return int(struct.unpack(f"{order}{kind}", value[:size])[0])


# --- OpenEXR ----------------------------------------------------------------------------------------------------------


class ExrPart(NamedTuple):
    """What the header of a part of an OpenEXR file says of its size."""

    width: int
    height: int
    channels: Mapping[str, int]  #: bytes of a pixel by name
    deep: bool

    @property
    def bytes(self) -> int:
        return self.width * self.height * sum(self.channels.values())


def exr_needs(file: Path | str, beside: float = 8.0, parameter: str = "file") -> None:
    """Ask for the memory of an OpenEXR file: all channels of all parts, which the library reads at once.

    ``beside`` are the bytes for each value of the largest part that the caller makes of them. A part with deep samples
    is refused, because its header does not say how many there are.
    """
    with opened(file, parameter) as raw:
        try:
            parts = list(exr_part_sizes(raw))
        except (struct.error, ValueError):
            return  # the library says what a damaged file lacks
    if any(part.deep for part in parts):
        raise ParameterError(parameter, f"{file} has deep samples, several a pixel: flatten the picture")
    values = max((part.width * part.height * len(part.channels) for part in parts), default=0)
    largest = max(parts, key=lambda part: part.bytes, default=ExrPart(0, 0, {}, False))
    what = f"{largest.width} x {largest.height} pixels in {len(largest.channels)} channels"
    what += f", and {len(parts) - 1} other parts" if len(parts) > 1 else ""
    needs(sum(part.bytes for part in parts) + beside * values, file, what, parameter)


def exr_part_sizes(raw: BinaryIO) -> Iterator[ExrPart]:
    """Yield the size of each part of an open OpenEXR file, from its headers; nothing for another file."""
    magic, version = struct.unpack("<iI", raw.read(8))
    if magic != 20000630:
        return
    most = os.fstat(raw.fileno()).st_size
    while True:
        found = _exr_attributes(raw, most)
        if not found:
            return
        left, top, right, bottom = struct.unpack("<4i", found.get("dataWindow", b""))
        channels = dict(_exr_channels(found.get("channels", b"")))
        deep = bool(version & _DEEP) or found.get("type", b"").startswith(b"deep")
        yield ExrPart(max(right - left + 1, 0), max(bottom - top + 1, 0), channels, deep)
        if not version & _MULTIPART:
            return


def _exr_attributes(raw: BinaryIO, most: int) -> dict[str, bytes]:
    """Return the attributes of a header that say its size; nothing at the end of the headers."""
    found: dict[str, bytes] = {}
    while name := _exr_text(raw):
        _exr_text(raw)  # the type
        (size,) = struct.unpack("<i", raw.read(4))
        if not 0 <= size <= most - raw.tell():
            raise ValueError("an attribute is longer than the file")
        if name in ("dataWindow", "channels", "type") and size <= _LONGEST:
            found[name] = raw.read(size)
        else:
            raw.seek(size, os.SEEK_CUR)
    return found


def _exr_text(raw: BinaryIO) -> str:
    """Read a text that ends with a zero; raise ValueError for one that is no name."""
    letters = bytearray()
    while (letter := raw.read(1)) != b"\0":
        letters += letter
        if not letter or len(letters) > 255:
            raise ValueError("a name that does not end")
    return letters.decode("latin-1")


def _exr_channels(data: bytes) -> Iterator[tuple[str, int]]:
    place = 0
    while place < len(data) and data[place]:
        end = data.index(b"\0", place)
        (kind,) = struct.unpack_from("<i", data, end + 1)
        yield data[place:end].decode("latin-1"), _EXR_SIZES.get(kind, 4)
        place = end + 17
