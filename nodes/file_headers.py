"""Memory needed for arrays and pictures, determined from the headers of their files."""

import json
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from neusee.nodes import ParameterError
from neusee.nodes.input_files import SMALL, in_bytes, needs, opened

# --- array bytes ----------------------------------------------------------------------------------

# Memory needed for arrays, from the headers of .npy, .npz, .mat, .safetensors, .pt and HDF5 files.


__depends__ = ["unaffected:file"]  #: only the size of an open file is read
_MAT_MATRIX, _MAT_COMPRESSED, _MAT_INT32 = 14, 15, 5  #: types of data elements in a .mat file
_MAT_COMPLEX = 0x0800
#: bytes per value, by array class; cell, struct and sparse arrays are not listed
_MAT_CLASSES = {4: 4, 6: 8, 7: 4, 8: 1, 9: 1, 10: 2, 11: 2, 12: 4, 13: 4, 14: 8, 15: 8}
#: errors for a damaged archive or a file that is no archive; the reader of the file reports them
_ARCHIVE_ERRORS = (
    zipfile.BadZipFile,
    ValueError,
    EOFError,
    SyntaxError,
    OSError,
    NotImplementedError,
    RuntimeError,
    zlib.error,
)
_CHUNK_BYTES = 1 << 18  #: bytes decompressed at once to count them
#: largest header of a .safetensors file in bytes, the limit of its library
_HEADER_BYTES = 100_000_000


def npy_needs(file: Path | str, copies: float, beside: float = 0.0) -> None:
    """Check that memory suffices to read a .npy file: ``copies`` of its values, plus ``beside``
    bytes per value.

    Raises ParameterError for a file that is shorter than its header states.
    """
    with opened(file) as open_file:
        try:
            shape, dtype = _npy_header(open_file)
        except (ValueError, EOFError, SyntaxError, TypeError):
            return  # NumPy reports what is wrong with a damaged file
        bytes_after = os.fstat(open_file.fileno()).st_size - open_file.tell()
    count = math.prod(map(int, shape))
    if not dtype.hasobject and count * dtype.itemsize > bytes_after:
        text = (
            f"its header states {in_bytes(count * dtype.itemsize)} of numbers, and"
            f" {in_bytes(bytes_after)} follow"
        )
        raise ParameterError("file", f"{file} cannot be read: {text}: copy or save the file again")
    needs(count * (copies * dtype.itemsize + beside), file, _numbers(shape, dtype))


def _numbers(shape: tuple[int, ...], dtype: Any) -> str:
    """Return shape and data type of an array as text for messages."""
    return f"{' x '.join(map(str, shape)) or 'one'} numbers of type {dtype}"


def _npy_header(raw: Any) -> tuple[tuple[int, ...], "np.dtype[Any]"]:
    """Return shape and data type of the array in an open .npy file, from its header."""
    version = np.lib.format.read_magic(raw)
    read_header = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, _, dtype = read_header(raw)
    return shape, dtype


# --- archives -------------------------------------------------------------------------------------


def npz_needs(
    file: Path | str, copies: float, beside: float = 0.0, parameter: str = "file"
) -> None:
    """Check that memory suffices to read all arrays of a .npz file, as `npy_needs` does.

    Raises ParameterError for an array that needs more bytes than the archive has for it.
    """
    archive_needs(file, copies, parameter)
    total, array_count = 0.0, 0
    for name, after, shape, dtype in _npz_headers(file, parameter):
        size = math.prod(map(int, shape))
        if not dtype.hasobject and size * dtype.itemsize > after:
            text = f"its array {name} states {_numbers(shape, dtype)}, and {in_bytes(after)} follow"
            raise ParameterError(
                parameter, f"{file} cannot be read: {text}: copy or save the file again"
            )
        total, array_count = total + size * (copies * dtype.itemsize + beside), array_count + 1
    needs(total, file, f"{array_count} arrays", parameter)


def _npz_headers(
    file: Path | str, parameter: str
) -> list[tuple[str, int, tuple[int, ...], "np.dtype[Any]"]]:
    """Return name, stated bytes, shape and data type of each array in a .npz file, as far as its
    headers can be read.
    """
    headers = []
    with (
        opened(file, parameter) as open_file,
        suppress(*_ARCHIVE_ERRORS),
        zipfile.ZipFile(open_file) as archive,
    ):
        for entry in archive.infolist():
            with archive.open(entry) as member:
                headers.append((entry.filename, entry.file_size, *_npy_header(member)))
    return headers


def archive_needs(file: Path | str, copies: float, parameter: str = "file") -> None:
    """Check that memory suffices for the decompressed content of a zip archive, such as a .pt, .pt2
    or .npz file.

    Readers of archives stop at the size that the archive states for each member. For a file that is
    no archive, its own size counts.
    """
    sizes = list[int]()
    with opened(file, parameter) as open_file:
        file_size = os.fstat(open_file.fileno()).st_size
        needs(copies * file_size, file, f"a file of {in_bytes(file_size)}", parameter)
        with suppress(*_ARCHIVE_ERRORS), zipfile.ZipFile(open_file) as archive:
            sizes = [entry.file_size for entry in archive.infolist()]
    content = f"{len(sizes)} files of {in_bytes(sum(sizes))} in {in_bytes(file_size)}"
    needs(copies * sum(sizes), file, content, parameter)


# --- .safetensors ---------------------------------------------------------------------------------


def safetensors_need(file: Path | str, copies: float = 1.0, parameter: str = "file") -> None:
    """Check that memory suffices for all tensors of a .safetensors file and for its header.

    Raises ParameterError for a file whose header states more bytes than the file has.
    """
    with opened(file, parameter) as open_file:
        size, length_bytes = os.fstat(open_file.fileno()).st_size, open_file.read(8)
        length = int.from_bytes(length_bytes, "little")
        if len(length_bytes) < 8 or length > min(size - 8, _HEADER_BYTES):
            text = f"{in_bytes(length)} of header, and the file has {in_bytes(size)}"
            raise _error_of_header(file, text, parameter)
        # a parsed header needs about 16 bytes of memory per byte
        needs(16.0 * length + copies * size, file, f"tensors of {in_bytes(size)}", parameter)
        end_of_tensors = _end_of_tensors(open_file.read(length))
    if end_of_tensors > size - 8 - length:
        text = f"{in_bytes(end_of_tensors)} of tensors, and {in_bytes(size - 8 - length)} follow"
        raise _error_of_header(file, text, parameter)


def _error_of_header(file: Path | str, why: str, parameter: str) -> ParameterError:
    """Return the error for a .safetensors file whose header does not fit the file; ``why`` says
    what it states.
    """
    text = (
        f"{Path(file).name} is not a safetensors file and cannot be read: its header states {why}"
    )
    return ParameterError(parameter, f"{text}: copy or save the file again")


def _end_of_tensors(header: bytes) -> int:
    """Return the offset at which the tensors end, in bytes after the header, or 0 for a header that
    the library refuses.
    """
    try:
        return max(
            (int(entry["data_offsets"][1]) for entry in _tensor_entries(json.loads(header))),
            default=0,
        )
    except (ValueError, TypeError, LookupError, RecursionError):
        return 0


def _tensor_entries(header: Any) -> Iterator[Any]:
    """Return the header entry of each tensor."""
    return (entry for name, entry in header.items() if name != "__metadata__")


# --- .mat -----------------------------------------------------------------------------------------


def mat_needs(
    file: Path | str, copies: float = 2.0, together: bool = False, parameter: str = "file"
) -> None:
    """Check that memory suffices for the largest variable in a .mat file, or for all variables if
    ``together``.

    ``copies`` of the values are counted, in the stored or the loaded type, whichever is larger.
    Compressed variables are decompressed in small parts to count their bytes, because their content
    may be larger than their header states.
    """
    with opened(file, parameter) as open_file:
        size = os.fstat(open_file.fileno()).st_size
        total, largest, asked_bytes = 0.0, 0.0, float(SMALL)
        for begins_variable, size_of_part in _mat_variable_bytes(open_file, size):
            total = total + size_of_part if together or not begins_variable else size_of_part
            largest = max(largest, total)
            # check again only after a growth by `SMALL`, because each check takes time
            if copies * largest > asked_bytes:
                needs(
                    copies * largest, file, f"variables of {in_bytes(largest)} or more", parameter
                )
                asked_bytes = copies * largest + SMALL
    needs(copies * largest, file, f"variables of {in_bytes(largest)}", parameter)


def _mat_variable_bytes(raw: BinaryIO, size: int) -> Iterator[tuple[bool, int]]:
    """Yield the bytes of each variable of a .mat file of version 5 or older, in parts for
    compressed variables.

    The first value is True where a variable begins.
    """
    header = raw.read(128)
    # the last two bytes of the header give the byte order
    byte_order = {b"IM": "<", b"MI": ">"}.get(header[126:128])
    if byte_order is None:
        yield True, size  # version 4 has no compression
        return
    while len(tag_bytes := raw.read(8)) == 8:
        kind, length = struct.unpack(f"{byte_order}II", tag_bytes)
        next_element = raw.tell() + length
        if kind == _MAT_COMPRESSED:
            inflated_bytes, stated_bytes = 0, 0
            for piece in _inflated(raw, length):
                stated_bytes = stated_bytes or _mat_stated_bytes(piece[8:], byte_order)
                bytes_before, inflated_bytes = inflated_bytes, inflated_bytes + len(piece)
                # first the stated bytes, then the bytes beyond them
                yield (
                    bytes_before == 0,
                    max(inflated_bytes, stated_bytes)
                    - (max(bytes_before, stated_bytes) if bytes_before else 0),
                )
        elif kind == _MAT_MATRIX:
            yield (
                True,
                max(min(length, size), _mat_stated_bytes(raw.read(min(length, 4096)), byte_order)),
            )
        else:
            return  # scipy says what is damaged
        raw.seek(next_element)


def _mat_stated_bytes(piece: bytes, order: str) -> int:
    """Return the bytes of the loaded values of a variable, from its flags and dimensions; 0 if
    unknown.
    """
    if len(piece) < 24:
        return 0
    # 16 bytes of tag and flags, then the tag of the dimensions
    flags, _, kind, length = struct.unpack(f"{order}8x4I", piece[:24])
    bytes_per_value = _MAT_CLASSES.get(flags & 0xFF, 0) * (2 if flags & _MAT_COMPLEX else 1)
    if kind != _MAT_INT32 or not bytes_per_value or length > len(piece) - 24:
        return 0
    return bytes_per_value * math.prod(
        int(n) for n in struct.unpack(f"{order}{length // 4}i", piece[24 : 24 + length // 4 * 4])
    )


def _inflated(raw: BinaryIO, length: int) -> Iterator[bytes]:
    """Yield the decompressed parts of a variable of ``length`` compressed bytes."""
    decompressor, bytes_left, compressed = zlib.decompressobj(), length, b""
    with suppress(zlib.error):  # scipy says what is damaged
        while not decompressor.eof:
            compressed = compressed or raw.read(min(bytes_left, _CHUNK_BYTES))
            if not compressed:
                return
            bytes_left -= 0 if decompressor.unconsumed_tail else len(compressed)
            yield decompressor.decompress(compressed, _CHUNK_BYTES)
            compressed = decompressor.unconsumed_tail


# --- FITS and HDF5, whose libraries read headers alone --------------------------------------------


def fits_needs(file: Path | str, shape: tuple[int, ...], bits: int) -> None:
    """Check that memory suffices for an image of a FITS file: stored values, values scaled to
    float64, and a copy of the caller.
    """
    number_count = math.prod(map(int, shape))
    needs(
        # 8 bytes for the scaled float64 and 8 for the copy
        number_count * (abs(bits) / 8 + 16),
        file,
        f"{' x '.join(map(str, shape))} numbers of {abs(bits)} bits",
    )


def refuse_packed(file: Path | str) -> None:
    """Raise ParameterError for a file that is compressed as a whole, which its library would
    decompress without a limit of size.
    """
    with opened(file) as open_file:
        magic_bytes = open_file.read(6)
    # magic bytes of gzip, bzip2, zip, xz and compress
    if magic_bytes.startswith((b"\x1f\x8b", b"BZh", b"PK\x03\x04", b"\xfd7zXZ", b"\x1f\x9d")):
        raise ParameterError(
            "file", f"{file} is compressed as a whole: unpack it, such as by gunzip"
        )


def hdf5_needs(file: Path | str, groups: Any) -> None:
    """Check that memory suffices for all data in the open ``groups`` of an HDF5 file, from their
    shapes and data types.
    """
    total = 0.0
    for group in groups:
        for data in group.values():
            if hasattr(data, "shape"):
                total += math.prod(map(int, data.shape)) * data.dtype.itemsize
    needs(total, file, f"data of {in_bytes(total)}")


# --- picture bytes --------------------------------------------------------------------------------

# Memory needed for pictures, from the headers of PNG, JPEG, TIFF and OpenEXR files.


#: bytes per pixel, by Pillow mode
_BYTES_OF_PIXEL = {"1": 1, "L": 1, "P": 1, "LA": 4, "I;16": 2, "I;16B": 2, "I;16L": 2}
_JPEG_BYTES = 6  #: additional bytes per pixel of a JPEG stored in several scans
_WIDTH, _HEIGHT, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_LENGTH = 256, 257, 258, 277, 322, 323
_TIFF_TAGS = frozenset((_WIDTH, _HEIGHT, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_LENGTH))
#: `struct` format of each integer type of a TIFF tag
_TIFF_SIZES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_EXR_SIZES = {0: 4, 1: 2, 2: 4}  #: bytes per value, by type of the channel
_MULTIPART, _DEEP = 1 << 12, 1 << 11
_CHANNEL_LIST_BYTES = 1 << 20  #: largest list of channels in bytes


def picture_needs(file: Path, image: Any, beside: float) -> None:
    """Check that memory suffices for the first picture of a file that Pillow has opened, plus
    ``beside`` bytes per pixel.
    """
    bytes_a_pixel = _BYTES_OF_PIXEL.get(image.mode, 4) + beside
    bytes_a_pixel += _JPEG_BYTES if image.format in ("JPEG", "MPO") else 0
    needs(
        bytes_a_pixel * image.width * image.height, file, f"{image.width} x {image.height} pixels"
    )


def pages_need(file: Path, image: Any, copies: float, beside: float = 0.0) -> None:
    """Check that memory suffices for all pages of a file that Pillow has opened.

    For each page, ``copies`` of its values and ``beside`` bytes per pixel are counted.
    """
    if image.format == "TIFF":
        tiff_needs(file, copies, beside)
        return
    pages, pixels_a_page = int(getattr(image, "n_frames", 1)), image.width * image.height
    bytes_a_pixel = copies * _BYTES_OF_PIXEL.get(image.mode, 4) + beside
    needs(
        pages * pixels_a_page * bytes_a_pixel,
        file,
        f"{pages} pages of {image.width} x {image.height} pixels",
    )


# --- TIFF -----------------------------------------------------------------------------------------


class Page(NamedTuple):
    """The size of a page of a TIFF file."""

    width: int
    height: int
    sample: int  #: bits per sample
    samples: int  #: of a pixel
    tile: int  #: pixels of a tile; 0 for strips

    @property
    def bytes(self) -> float:
        return self.samples * max(self.sample, 8) / 8 * max(self.width * self.height, self.tile)


def tiff_needs(file: Path, copies: float, beside: float = 0.0, first: bool = False) -> None:
    """Check that memory suffices for all pages of a TIFF file, or only for the ``first`` one, as
    `pages_need` does.
    """
    count, total, page = 0, 0.0, Page(0, 0, 8, 1, 0)
    # the reader reports what is wrong with a damaged file
    with opened(file) as open_file, suppress(struct.error):
        for page in tiff_pages(open_file):
            count += 1
            total += copies * page.bytes + beside * page.width * page.height
            if first:
                break
    needs(total, file, f"{count} page{'s' * (count != 1)} of {page.width} x {page.height} pixels")


def tiff_pages(raw: BinaryIO) -> Iterator[Page]:
    """Yield the size of each page of an open TIFF file, in order; stop if a directory repeats."""
    header = raw.read(16)
    byte_order = {b"II": "<", b"MM": ">"}.get(header[:2])
    if byte_order is None:
        return
    # the version is 42, or 43 for BigTIFF with 64-bit addresses
    is_big_tiff = struct.unpack(f"{byte_order}H", header[2:4])[0] == 43
    (directory_start,) = (
        struct.unpack(f"{byte_order}Q", header[8:16])
        if is_big_tiff
        else struct.unpack(f"{byte_order}I", header[4:8])
    )
    visited_directories, file_size = set[int](), os.fstat(raw.fileno()).st_size
    while 0 < directory_start < file_size and directory_start not in visited_directories:
        visited_directories.add(directory_start)
        page, directory_start = _tiff_page(raw, directory_start, byte_order, is_big_tiff)
        yield page


def _tiff_page(raw: BinaryIO, place: int, order: str, big: bool) -> tuple[Page, int]:
    """Return the page whose directory begins at the offset ``place``, and the offset of the next
    directory.
    """
    count_format, entry_format, address_format = ("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")
    raw.seek(place)
    count_struct, entry_struct, address_struct = (
        struct.Struct(f"{order}{form}") for form in (count_format, entry_format, address_format)
    )
    (count,) = count_struct.unpack(raw.read(count_struct.size))
    values: dict[int, int] = {}
    for _ in range(min(count, 65536)):
        tag, value_type, length, value = entry_struct.unpack(raw.read(entry_struct.size))
        if tag in _TIFF_TAGS and value_type in _TIFF_SIZES:
            values[tag] = _tiff_number(raw, order, _TIFF_SIZES[value_type], length, value)
    address_bytes = raw.read(address_struct.size)
    next_directory = 0
    if len(address_bytes) == address_struct.size:
        (next_directory,) = address_struct.unpack(address_bytes)
    page = Page(
        values.get(_WIDTH, 0),
        values.get(_HEIGHT, 0),
        values.get(_BITS, 8),
        values.get(_SAMPLES, 1),
        values.get(_TILE_WIDTH, 0) * values.get(_TILE_LENGTH, 0),
    )
    return page, next_directory


def _tiff_number(raw: BinaryIO, order: str, kind: str, length: int, value: bytes) -> int:
    """Return the first value of a tag, stored in its entry or at the offset that the entry
    gives.
    """
    value_size = struct.calcsize(f"{order}{kind}")
    if value_size * length > len(value):
        position = raw.tell()
        raw.seek(int.from_bytes(value, "little" if order == "<" else "big"))
        value = raw.read(value_size)
        raw.seek(position)
    return int(struct.unpack(f"{order}{kind}", value[:value_size])[0])


# --- OpenEXR --------------------------------------------------------------------------------------


class ExrPart(NamedTuple):
    """The size of a part of an OpenEXR file, from its header."""

    width: int
    height: int
    channels: Mapping[str, int]  #: bytes per pixel, by name of the channel
    deep: bool

    @property
    def bytes(self) -> int:
        return self.width * self.height * sum(self.channels.values())


def exr_needs(file: Path | str, beside: float = 8.0) -> None:
    """Check that memory suffices for an OpenEXR file: all channels of all parts, which the library
    reads at once.

    ``beside`` is the number of bytes that the caller needs per value of the largest part. A part
    with deep samples is refused, because its header does not state their number.
    """
    with opened(file) as open_file:
        try:
            part_sizes = list(exr_part_sizes(open_file))
        except (struct.error, ValueError):
            return  # the library reports what is wrong with a damaged file
    if any(exr_part.deep for exr_part in part_sizes):
        raise ParameterError(
            "file", f"{file} has deep samples, several a pixel: flatten the picture"
        )
    values = max(
        (exr_part.width * exr_part.height * len(exr_part.channels) for exr_part in part_sizes),
        default=0,
    )
    largest = max(part_sizes, key=lambda exr_part: exr_part.bytes, default=ExrPart(0, 0, {}, False))
    content = f"{largest.width} x {largest.height} pixels in {len(largest.channels)} channels"
    content += f", and {len(part_sizes) - 1} other parts" if len(part_sizes) > 1 else ""
    needs(sum(exr_part.bytes for exr_part in part_sizes) + beside * values, file, content)


def exr_part_sizes(raw: BinaryIO) -> Iterator[ExrPart]:
    """Yield the size of each part of an open OpenEXR file, from its headers; nothing for a file of
    another format.
    """
    magic_number, version = struct.unpack("<iI", raw.read(8))
    if magic_number != 20000630:
        return
    file_size = os.fstat(raw.fileno()).st_size
    while True:
        attributes = _exr_attributes(raw, file_size)
        if not attributes:
            return
        # the data window includes both of its ends
        left, top, right, bottom = struct.unpack("<4i", attributes.get("dataWindow", b""))
        channels = dict(_exr_channels(attributes.get("channels", b"")))
        deep = bool(version & _DEEP) or attributes.get("type", b"").startswith(b"deep")
        yield ExrPart(max(right - left + 1, 0), max(bottom - top + 1, 0), channels, deep)
        if not version & _MULTIPART:
            return


def _exr_attributes(raw: BinaryIO, end: int) -> dict[str, bytes]:
    """Return the attributes of a header that determine its size; empty at the end of the
    headers.
    """
    attributes: dict[str, bytes] = {}
    while name := _exr_text(raw):
        _exr_text(raw)  # the type
        (size,) = struct.unpack("<i", raw.read(4))
        if not 0 <= size <= end - raw.tell():
            raise ValueError("an attribute is longer than the file")
        if name in ("dataWindow", "channels", "type") and size <= _CHANNEL_LIST_BYTES:
            attributes[name] = raw.read(size)
        else:
            raw.seek(size, os.SEEK_CUR)
    return attributes


def _exr_text(raw: BinaryIO) -> str:
    """Read a zero-terminated name; raise ValueError if it is longer than 255 bytes."""
    letters = bytearray()
    while (letter := raw.read(1)) != b"\0":
        letters += letter
        if not letter or len(letters) > 255:
            raise ValueError("a name that does not end")
    return letters.decode("latin-1")


def _exr_channels(data: bytes) -> Iterator[tuple[str, int]]:
    """Yield name and bytes per pixel of each channel in a channel list."""
    position = 0
    while position < len(data) and data[position]:
        name_end = data.index(b"\0", position)
        (number_type,) = struct.unpack_from("<i", data, name_end + 1)
        yield data[position:name_end].decode("latin-1"), _EXR_SIZES.get(number_type, 4)
        # the end of the name, then type, pLinear and samplings: 1 + 4 + 4 + 4 + 4 bytes
        position = name_end + 17
