"""Band files: files with one spectral band each, shared by all stored results that contain the
band.

A band file (a blob) holds the bytes of a slice and a trailer with type, shape, format version,
name, signature, checksum and the trailer's length. The bytes begin at the start of the file, so
that slices of whole memory pages are mapped side by side into one address range, which gives a
contiguous tensor without a copy. The maps are private: a write to the tensor changes no file.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import mmap
import os
import sys
import weakref
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedReader
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import torch
import xxhash
from torch import Tensor

from neusee.workflows.keys.sealed_files import (
    FORMAT,
    NotRead,
    OtherFormat,
    check_signature,
    may_change,
    secrets,
    signature,
)
from neusee.workflows.store.metadata import is_band, is_checksum, is_shape
from neusee.workflows.store.shared_folder import Disk, open_now

_SMALL = 4096  #: bytes up to which a blob is not synced to disk: a torn blob fails its checksum
_WRITERS = 8
_FIXED = 0x10  #: MAP_FIXED of Linux and macOS
_LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform in ("linux", "darwin") else None
_PIECE = 1 << 18  #: bytes of a file that are read at once
_UNREADABLE = (FileNotFoundError, ValueError, LookupError, TypeError, AttributeError, RuntimeError)
_TAIL = 1024  #: bytes at the end of a band file that contain its trailer
_DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in vars(torch).values()
    if isinstance(dtype, torch.dtype)
}

if _LIBC is not None:
    _LIBC.mmap.restype = ctypes.c_void_p
    _LIBC.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    _LIBC.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]


class Damaged(ValueError):
    """Error for a band file that is missing or damaged, so that its spectral band must be
    computed again.
    """


@dataclass(frozen=True, slots=True, eq=False)
class Stacked:
    """A tensor whose slices along the first axis are stored in one band file each."""

    tensor: Tensor
    names: tuple[str, ...]  #: one name for each slice; slices with equal names are equal


class Blob(NamedTuple):
    """Type, shape, checksum and signature of a spectral band, as stored at the end of its band
    file.
    """

    dtype: torch.dtype
    shape: tuple[int, ...]
    xxh3: str
    name: str = ""
    sign: str = ""

    @property
    def nbytes(self) -> int:
        return prod(self.shape) * self.dtype.itemsize


class Blobs:
    """Folder of the band files of a store of results; a written band file never changes.

    The path of a band file is ``bands/<first two letters of the name>/<name>``.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._folder = os.fspath(root)
        self._disk = Disk(root.parent)
        self._lost: set[str] = set()  # damaged files that the user may have no permission to move

    def has(self, name: str) -> bool:
        """Return True if the band file ``name`` exists, without reading the file."""
        return name not in self._lost and os.path.exists(self.path(name))

    def about(self, name: str) -> Blob:
        """Return the type, shape and checksum of a stored band; raise `Damaged` if its file is
        missing or damaged.
        """
        try:
            with open(self.path(name), "rb", opener=open_now) as file:
                return _trailer(file.fileno(), name)[0]
        except (OSError, *_UNREADABLE) as error:
            raise self._damaged(name, error) from None

    def write(self, name: str, x: Tensor) -> str:
        """Write the band ``x`` unless its file exists; return the checksum (xxh3) of the stored
        band.
        """
        if self.has(name):
            with suppress(Damaged):
                blob = self.about(name)
                if secrets():  # a forged band must not be part of what is signed
                    self.read([name], (1, *blob.shape), blob.dtype)
                return blob.xxh3
        band_bytes, trailer = bytes_of(x), _kind(x.dtype, tuple(x.shape), name)
        # the signature covers the bytes and the trailer without itself
        trailer = _signed(
            trailer, signature("band", name, _sha256(band_bytes, trailer)) if secrets() else ""
        )
        xxh3 = _checksum(band_bytes, trailer)
        with self._disk.temporary(name) as (temporary, file):
            # the order that `_trailer` reads, from the end of the file
            for piece in (band_bytes, trailer, xxh3.encode(), len(trailer).to_bytes(4, "little")):
                file.write(piece)
            file.flush()
            if len(band_bytes) > _SMALL:
                os.fsync(file.fileno())
            return self._named(name, temporary) or xxh3

    def write_all(self, names: Sequence[str], slices: Sequence[Tensor]) -> list[str]:
        """Write several bands in parallel, because a disk syncs many files in little more time
        than one file.
        """
        with ThreadPoolExecutor(_WRITERS) as pool:
            return list(pool.map(self.write, names, slices))

    def _named(self, name: str, temporary: str) -> str | None:
        """Rename a complete temporary file to the name of its band, or return the checksum of
        the file of that name.
        """
        self._disk.make_folder(self._folder)
        # a link fails where a file has the name: the first writer wins, unless its file is damaged
        if name in self._lost or not self._disk.link(temporary, self.path(name)):
            if name not in self._lost:
                with suppress(Damaged):
                    return self.about(name).xxh3
            self._disk.rename(temporary, self.path(name))
            self._lost.discard(name)
        return None

    def read(
        self,
        names: Sequence[str],
        shape: Sequence[int],
        dtype: torch.dtype,
        verify: bool = True,
        xxh3: Sequence[str] | None = None,
    ) -> Tensor:
        """Return one contiguous tensor whose slices along the first axis are the stored bands
        ``names``.

        The files are mapped if a slice consists of whole memory pages, otherwise copied. ``verify``
        compares the checksum of every byte; ``xxh3`` lists the expected checksums. Raises `Damaged`
        for a missing or damaged file, which then counts as missing.
        """
        if wrong_names := [name for name in names if not is_band(name)]:
            raise Damaged(f"{wrong_names[0]!r} is not the name of a band")
        expected = [
            Blob(dtype, tuple(shape[1:]), xxh3[i] if xxh3 else "", name)
            for i, name in enumerate(names)
        ]
        bytes_of_slice = expected[0].nbytes if expected else 0
        if not bytes_of_slice:
            return torch.empty(*shape, dtype=dtype)
        self._need_kind(names[0], expected[0])  # before memory is reserved
        # only whole pages can be mapped side by side
        if _LIBC is not None and bytes_of_slice % mmap.PAGESIZE == 0:
            with suppress(OSError):  # a file system or a limit that allows no maps
                # one range of addresses, into which each file is mapped
                space = _reserve(len(names) * bytes_of_slice)
                self._fill(
                    names, expected, memoryview(space).cast("B"), ctypes.addressof(space), verify
                )
                return torch.frombuffer(space, dtype=dtype).reshape(*shape)
        # copies, where the files cannot be mapped
        x = torch.empty(*shape, dtype=dtype)
        self._fill(names, expected, bytes_of(x), None, verify)
        return x

    def _need_kind(self, name: str, expected: Blob) -> None:
        """Raise `Damaged` if a stored band has another type or shape than the ``expected`` one."""
        stored = self.about(name)
        if stored[:2] != expected[:2]:
            text = f"it holds {stored.dtype} {stored.shape}, not {expected.dtype} {expected.shape}"
            raise self._damaged(name, ValueError(text))

    def _fill(
        self,
        names: Sequence[str],
        expected: Sequence[Blob],
        into: memoryview,
        address: int | None,
        verify: bool,
    ) -> None:
        """Load stored bands side by side into memory; map the files if an ``address`` is given,
        else read the files.
        """
        bytes_of_slice = expected[0].nbytes
        for i, (name, blob) in enumerate(zip(names, expected, strict=True)):
            try:
                with open(self.path(name), "rb", opener=open_now) as file:
                    map_address = address and address + i * bytes_of_slice
                    _load(
                        file,
                        blob,
                        into[i * bytes_of_slice : (i + 1) * bytes_of_slice],
                        map_address,
                        verify,
                    )
            except (OSError, *_UNREADABLE) as error:
                # no map is possible here; `read` copies instead
                if address is not None and not isinstance(error, _UNREADABLE):
                    raise
                raise self._damaged(name, error) from None

    def path(self, name: str) -> str:
        """Return the path of the band file ``name``."""
        return f"{self._folder}/{name[:2]}/{name}"

    def _damaged(self, name: str, error: Exception) -> Damaged:
        """Move a damaged band file to the folder ``bad/`` of the store for inspection; return
        the error to raise.
        """
        self._lost.add(name)
        # the file itself is not to blame where the system failed, or for another format
        if not isinstance(error, OSError | NotRead) and is_band(name):
            self._disk.put_aside(self.path(name))
        return Damaged(f"the band {name} is damaged or missing: {error}")


def bytes_of(x: Tensor) -> memoryview:
    """Return the bytes of a tensor, without a copy if the tensor is contiguous and on the CPU."""
    # torch may only note that a tensor is conjugated or negative
    flat = x.detach().cpu().resolve_conj().resolve_neg().contiguous().reshape(-1)
    # a single element is contiguous whatever its stride, but cannot be viewed as bytes
    if flat.stride() != (1,):
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.uint8).numpy().data


def dtype_of(name: str) -> torch.dtype:
    """Return the torch dtype with a name such as ``float32``; raise `ValueError` for an unknown
    name.
    """
    if name not in _DTYPES:
        raise ValueError(f"{name!r} is not a dtype of torch")
    return _DTYPES[name]


def _kind(dtype: torch.dtype, shape: tuple[int, ...], name: str) -> bytes:
    """Return the unsigned trailer of a band file: type, shape, format version and name as JSON."""
    return json.dumps([str(dtype).removeprefix("torch."), list(shape), FORMAT, name]).encode()


def _signed(kind: bytes, sign: str) -> bytes:
    """Return a trailer with the signature as its fifth entry."""
    # in place of the bracket at the end
    return kind[:-1] + f', "{sign}"]'.encode()


def _checksum(data: memoryview, kind: bytes) -> str:
    """Return the checksum (xxh3) of the bytes of a band and its trailer."""
    digest = xxhash.xxh3_128(data)
    digest.update(kind)
    return digest.hexdigest()


def _checksum_read(file: BufferedReader, size: int, kind: bytes) -> str:
    """Return the checksum of the first bytes of a file, read piece by piece."""
    digest, buffer, bytes_left = xxhash.xxh3_128(), memoryview(bytearray(min(_PIECE, size))), size
    file.seek(0)
    while bytes_left and (count := file.readinto(buffer[:bytes_left])):
        digest.update(buffer[:count])
        bytes_left -= count
    digest.update(kind)
    return digest.hexdigest()


def _sha256(data: memoryview, kind: bytes) -> bytes:
    """Return the SHA-256 of the bytes of a band and its trailer, which a signature covers."""
    digest = hashlib.sha256(data)
    digest.update(kind)
    return digest.digest()


def _trailer(file: int, name: str) -> tuple[Blob, bytes]:
    """Return what the end of the band file ``name`` says, and the part of it that the checksum
    covers.

    Raises `OtherFormat` for a file of another version, and `ValueError` for a wrong size or name.
    """
    size = os.fstat(file).st_size
    file_end = os.pread(file, _TAIL, max(0, size - _TAIL))
    # at the end: trailer, 32 digits of its checksum, 4 bytes with its length
    trailer_length = int.from_bytes(file_end[-4:], "little")
    trailer_and_checksum = file_end[-36 - trailer_length : -4]
    # the file is shorter than its trailer says
    if len(trailer_and_checksum) != trailer_length + 32:
        raise ValueError("the trailer of the band file is missing or cut short")
    dtype, shape, stated_name, sign = _fields_of_trailer(trailer_and_checksum[:trailer_length])
    xxh3 = trailer_and_checksum[trailer_length:].decode(errors="replace")
    if (
        stated_name != name
        or not isinstance(sign, str)
        or not is_shape(shape)
        or not is_checksum(xxh3)
    ):
        raise ValueError(
            f"the band file belongs to the band {stated_name!r}, or its trailer is not what was"
            " written"
        )
    blob = Blob(dtype_of(str(dtype)), tuple(shape), xxh3, name, sign)
    if size != blob.nbytes + trailer_length + 36:
        raise ValueError(
            f"the band file has {size} bytes instead of {blob.nbytes + trailer_length + 36} bytes"
        )
    return blob, trailer_and_checksum[:trailer_length]


def _fields_of_trailer(text: bytes) -> tuple[Any, Any, Any, Any]:
    """Return type, shape, name and signature that the trailer of a band file states."""
    fields = json.loads(text)
    if not isinstance(fields, list) or len(fields) < 2:
        raise ValueError("the trailer of the band file is not what was written")
    if fields[2:3] != [FORMAT] or len(fields) != 5:
        raise OtherFormat(
            # the first version stated type and shape alone
            f"its format is version {fields[2] if len(fields) > 2 else 1!r}, not version {FORMAT}"
        )
    dtype, shape, _, stated_name, sign = fields
    return dtype, shape, stated_name, sign


def _load(
    file: BufferedReader, expected: Blob, into: memoryview, address: int | None, verify: bool
) -> None:
    """Load a band file into memory; raise `ValueError` if the file holds another band or damaged
    bytes.

    It is mapped to ``address``, if that is given and nobody else could change the file after its
    check.
    """
    blob, trailer = _trailer(file.fileno(), expected.name)
    _refuse_other_band(blob, expected)
    # who may write the file could change it after its check
    is_copied = address is None or may_change(file.fileno())
    # a map is looked into once the file was read: where a device fails, a read raises an error and
    # ends no process
    checksum = "" if is_copied or not verify else _checksum_read(file, blob.nbytes, trailer)
    if address is not None:
        _map(None if is_copied else file.fileno(), address, blob.nbytes)
    if is_copied and file.readinto(into) != len(into):
        raise ValueError("the band file was truncated while it was read")
    if verify:
        _refuse_changed_bytes(blob, checksum or _checksum(into, trailer))
    _check_signed(blob, into)


def _refuse_other_band(blob: Blob, expected: Blob) -> None:
    """Raise `ValueError` if a band file has another type, shape or checksum than expected."""
    # type and shape
    if blob[:2] != expected[:2]:
        raise ValueError(
            f"the band file holds {blob.dtype} {blob.shape}, not {expected.dtype} {expected.shape}"
        )
    if expected.xxh3 and blob.xxh3 != expected.xxh3:
        raise ValueError(
            "the band file holds a different band than the band that was written with this result"
        )


def _refuse_changed_bytes(blob: Blob, checksum: str) -> None:
    if checksum != blob.xxh3:
        raise ValueError("checksum mismatch: the stored bytes have changed since they were written")


def _check_signed(blob: Blob, data: memoryview) -> None:
    """Check the signature of a band, where this store has a secret to sign with."""
    if secrets():
        unsigned_trailer = _kind(blob.dtype, blob.shape, blob.name)
        check_signature(blob.sign, "band", blob.name, _sha256(data, unsigned_trailer))


def _reserve(size: int) -> Any:
    """Reserve ``size`` bytes of the address space, which are released when the returned array is
    deleted.
    """
    assert _LIBC is not None
    map_flags = mmap.MAP_PRIVATE | mmap.MAP_ANON
    # 0: no access until files are mapped there
    address = _LIBC.mmap(None, size, 0, map_flags, -1, 0)
    if address in (None, ctypes.c_void_p(-1).value):
        raise OSError(
            ctypes.get_errno(), "the address space has no free range for the band files of a tensor"
        )
    reserved = (ctypes.c_char * size).from_address(address)
    # a thread may use it until the very end
    weakref.finalize(reserved, _LIBC.munmap, address, size).atexit = False
    return reserved


def _map(file: int | None, address: int, size: int) -> None:
    """Map a file, or empty memory if it is None, to an address."""
    assert _LIBC is not None
    access, map_flags = (
        mmap.PROT_READ | mmap.PROT_WRITE,
        mmap.MAP_PRIVATE | _FIXED | (mmap.MAP_ANON if file is None else 0),
    )
    if _LIBC.mmap(address, size, access, map_flags, -1 if file is None else file, 0) != address:
        raise OSError(ctypes.get_errno(), "the band file cannot be mapped into memory")
