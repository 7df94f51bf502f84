"""Bytes that arrays take in memory, from the headers of .npy, .npz, .mat, .safetensors, .pt and HDF5 files."""

import json
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from neusee.nodes import ParameterError
from neusee.nodes.input_size import SMALL, in_bytes, needs, opened

__depends__ = ["unaffected:file"]  #: the size of an open file
_MAT_MATRIX, _MAT_COMPRESSED, _MAT_INT32 = 14, 15, 5  #: types of elements
_MAT_COMPLEX = 0x0800
#: bytes of a value by the class of an array; a cell, a struct or a sparse array has none
_MAT_CLASSES = {4: 4, 6: 8, 7: 4, 8: 1, 9: 1, 10: 2, 11: 2, 12: 4, 13: 4, 14: 8, 15: 8}
#: errors of an archive that is damaged or none, whose reader says what is wrong
_BROKEN = (
    zipfile.BadZipFile,
    ValueError,
    EOFError,
    SyntaxError,
    OSError,
    NotImplementedError,
    RuntimeError,
    zlib.error,
)
_CHUNK = 1 << 18  #: bytes that are decompressed at once to count them
_HEADER = 100_000_000  #: bytes of the header of a .safetensors file, at most, as its library has it


def npy_needs(file: Path | str, copies: float, beside: float = 0.0, parameter: str = "file") -> None:
    """Ask for the memory of a .npy file: ``copies`` of its numbers, and ``beside`` bytes for each of them.

    Raises ParameterError for a file that is shorter than its header says.
    """
    with opened(file, parameter) as raw:
        try:
            shape, dtype = _npy_header(raw)
        except (ValueError, EOFError, SyntaxError, TypeError):
            return  # NumPy says what a damaged file lacks
        there = os.fstat(raw.fileno()).st_size - raw.tell()
    count = math.prod(map(int, shape))
    if not dtype.hasobject and count * dtype.itemsize > there:
        text = f"its header states {in_bytes(count * dtype.itemsize)} of numbers, and {in_bytes(there)} follow"
        raise ParameterError(parameter, f"{file} cannot be read: {text}: copy or save the file again")
    needs(count * (copies * dtype.itemsize + beside), file, _numbers(shape, dtype), parameter)


def _numbers(shape: tuple[int, ...], dtype: Any) -> str:
    return f"{' x '.join(map(str, shape)) or 'one'} numbers of type {dtype}"


def _npy_header(raw: Any) -> tuple[tuple[int, ...], "np.dtype[Any]"]:
    version = np.lib.format.read_magic(raw)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(raw)
    return shape, dtype


# --- archives ---------------------------------------------------------------------------------------------------------


def npz_needs(file: Path | str, copies: float, beside: float = 0.0, parameter: str = "file") -> None:
    """Ask for the memory of all arrays in a .npz file, as `npy_needs` does.

    Raises ParameterError for an array of more bytes than the archive states for it.
    """
    archive_needs(file, copies, parameter)
    total, count = 0.0, 0
    for name, there, shape, dtype in _npz_headers(file, parameter):
        size = math.prod(map(int, shape))
        if not dtype.hasobject and size * dtype.itemsize > there:
            text = f"its array {name} states {_numbers(shape, dtype)}, and {in_bytes(there)} follow"
            raise ParameterError(parameter, f"{file} cannot be read: {text}: copy or save the file again")
        total, count = total + size * (copies * dtype.itemsize + beside), count + 1
    needs(total, file, f"{count} arrays", parameter)


def _npz_headers(file: Path | str, parameter: str) -> list[tuple[str, int, tuple[int, ...], "np.dtype[Any]"]]:
    """Return name, stated bytes, shape and type of each array in a .npz file, as far as its headers can be read."""
    found = []
    with opened(file, parameter) as raw, suppress(*_BROKEN), zipfile.ZipFile(raw) as archive:
        for entry in archive.infolist():
            with archive.open(entry) as inner:
                found.append((entry.filename, entry.file_size, *_npy_header(inner)))
    return found


def archive_needs(file: Path | str, copies: float, parameter: str = "file") -> None:
    """Ask for the memory of all that a zip archive holds when it is decompressed, such as a .pt, .pt2 or .npz file.

    Readers of archives stop at the size that the archive states for each file. Any other file counts as it is.
    """
    sizes = list[int]()
    with opened(file, parameter) as raw:
        packed = os.fstat(raw.fileno()).st_size
        needs(copies * packed, file, f"a file of {in_bytes(packed)}", parameter)
        with suppress(*_BROKEN), zipfile.ZipFile(raw) as archive:
            sizes = [entry.file_size for entry in archive.infolist()]
    what = f"{len(sizes)} files of {in_bytes(sum(sizes))} in {in_bytes(packed)}"
    needs(copies * sum(sizes), file, what, parameter)


# --- .safetensors -----------------------------------------------------------------------------------------------------


def safetensors_need(file: Path | str, copies: float = 1.0, parameter: str = "file") -> None:
    """Ask for the memory of all tensors in a .safetensors file, and of its header.

    Raises ParameterError for a file whose header states more bytes than the file has.
    """
    with opened(file, parameter) as raw:
        size, first = os.fstat(raw.fileno()).st_size, raw.read(8)
        length = int.from_bytes(first, "little")
        if len(first) < 8 or length > min(size - 8, _HEADER):
            text = f"{in_bytes(length)} of header, and the file has {in_bytes(size)}"
            raise _not_whole(file, text, parameter)
        needs(16.0 * length + copies * size, file, f"tensors of {in_bytes(size)}", parameter)
        stated = _last_byte(raw.read(length))
    if stated > size - 8 - length:
        text = f"{in_bytes(stated)} of tensors, and {in_bytes(size - 8 - length)} follow"
        raise _not_whole(file, text, parameter)


def _not_whole(file: Path | str, why: str, parameter: str) -> ParameterError:
    text = f"{Path(file).name} is not a safetensors file and cannot be read: its header states {why}"
    return ParameterError(parameter, f"{text}: copy or save the file again")


def _last_byte(header: bytes) -> int:
    """Return the byte at which the tensors end, or 0 for a header that the library refuses."""
    try:
        return max((int(entry["data_offsets"][1]) for entry in _entries(json.loads(header))), default=0)
    except (ValueError, TypeError, LookupError, RecursionError):
        return 0


def _entries(header: Any) -> Iterator[Any]:
    return (entry for name, entry in header.items() if name != "__metadata__")


# --- .mat -------------------------------------------------------------------------------------------------------------


def mat_needs(file: Path | str, copies: float = 2.0, together: bool = False, parameter: str = "file") -> None:
    """Ask for the memory of the largest variable in a .mat file, or of all variables ``together``.

    There are ``copies`` of the numbers as they are stored or as they are read, whichever are more. Compressed variables
    are decompressed in small parts to be counted, because a part of one can state more than the variable does.
    """
    with opened(file, parameter) as raw:
        size = os.fstat(raw.fileno()).st_size
        total, most, asked = 0.0, 0.0, float(SMALL)
        for begins, each in _mat_sizes(raw, size):
            total = total + each if together or not begins else each
            most = max(most, total)
            if copies * most > asked:
                needs(copies * most, file, f"variables of {in_bytes(most)} or more", parameter)
                asked = copies * most + SMALL
    needs(copies * most, file, f"variables of {in_bytes(most)}", parameter)


def _mat_sizes(raw: BinaryIO, size: int) -> Iterator[tuple[bool, int]]:
    """Yield the bytes of each variable of a file of version 5 or older, compressed ones in parts.

    The first value is True where a variable begins.
    """
    head = raw.read(128)
    order = {b"IM": "<", b"MI": ">"}.get(head[126:128])
    if order is None:
        yield True, size  # version 4 has no compression
        return
    while len(tag := raw.read(8)) == 8:
        kind, length = struct.unpack(f"{order}II", tag)
        after = raw.tell() + length
        if kind == _MAT_COMPRESSED:
            stored, stated = 0, 0
            for part in _inflated(raw, length):
                stated = stated or _mat_stated(part[8:], order)
                before, stored = stored, stored + len(part)
                yield before == 0, max(stored, stated) - (max(before, stated) if before else 0)
        elif kind == _MAT_MATRIX:
            yield True, max(min(length, size), _mat_stated(raw.read(min(length, 4096)), order))
        else:
            return  # scipy says what is damaged
        raw.seek(after)


def _mat_stated(part: bytes, order: str) -> int:
    """Return the bytes of the numbers of a variable as they are read, from its flags and dimensions; 0 if unknown."""
    if len(part) < 24:
        return 0
    flags, _, kind, length = struct.unpack(f"{order}8x4I", part[:24])
    each = _MAT_CLASSES.get(flags & 0xFF, 0) * (2 if flags & _MAT_COMPLEX else 1)
    if kind != _MAT_INT32 or not each or length > len(part) - 24:
        return 0
    return each * math.prod(int(n) for n in struct.unpack(f"{order}{length // 4}i", part[24 : 24 + length // 4 * 4]))


def _inflated(raw: BinaryIO, length: int) -> Iterator[bytes]:
    """Yield each part of a compressed variable of ``length`` bytes."""
    stream, left, packed = zlib.decompressobj(), length, b""
    with suppress(zlib.error):  # scipy says what is damaged
        while not stream.eof:
            packed = packed or raw.read(min(left, _CHUNK))
            if not packed:
                return
            left -= 0 if stream.unconsumed_tail else len(packed)
            yield stream.decompress(packed, _CHUNK)
            packed = stream.unconsumed_tail


# --- FITS and HDF5, whose libraries read headers alone ----------------------------------------------------------------


def fits_needs(file: Path | str, shape: tuple[int, ...], bits: int, parameter: str = "file") -> None:
    """Ask for the memory of an image of a FITS file: its numbers, scaled to float64, and the copy of the caller."""
    count = math.prod(map(int, shape))
    needs(count * (abs(bits) / 8 + 16), file, f"{' x '.join(map(str, shape))} numbers of {abs(bits)} bits", parameter)


def refuse_packed(file: Path | str, parameter: str = "file") -> None:
    """Raise ParameterError for a file that is compressed as a whole, which a library would unpack without a limit."""
    with opened(file, parameter) as raw:
        head = raw.read(6)
    if head.startswith((b"\x1f\x8b", b"BZh", b"PK\x03\x04", b"\xfd7zXZ", b"\x1f\x9d")):
        raise ParameterError(parameter, f"{file} is compressed as a whole: unpack it, such as by gunzip")


def hdf5_needs(file: Path | str, groups: Any, copies: float = 1.0) -> None:
    """Ask for the memory of all data in the opened ``groups`` of an HDF5 file, from their shapes and types."""
    total = 0.0
    for group in groups:
        for each in group.values():
            if hasattr(each, "shape"):
                total += math.prod(map(int, each.shape)) * each.dtype.itemsize
    needs(copies * total, file, f"data of {in_bytes(total)}")
