"""Band files: one file for each slice of a stack of bands, shared by every result that contains the slice.

A blob holds the bytes of a slice and a trailer: type and shape, checksum and the trailer's length. The bytes begin
at the start of the file, so that slices of whole memory pages are mapped side by side into one address range, which
gives a contiguous tensor without a copy. The maps are private: a write to the tensor changes no file.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import sys
import weakref
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import torch
import xxhash
from torch import Tensor

from neusee.workflows.store.shared_folder import Disk

_SMALL = 4096  #: bytes up to which a blob is not synced to disk: a torn blob fails its checksum
_WRITERS = 8
_FIXED = 0x10  #: MAP_FIXED of Linux and macOS
_LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform in ("linux", "darwin") else None
_UNREADABLE = (FileNotFoundError, ValueError, LookupError, TypeError, AttributeError)

if _LIBC is not None:
    _LIBC.mmap.restype = ctypes.c_void_p
    _LIBC.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    _LIBC.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]


class Damaged(ValueError):
    """Error for a blob that is missing or differs from the blob that was written; the band must be recomputed."""


@dataclass(frozen=True, slots=True, eq=False)
class Stacked:
    """A tensor whose slices along the first axis are stored as one blob each."""

    tensor: Tensor
    names: tuple[str, ...]  #: one name for each slice; equal names are equal slices


class Blob(NamedTuple):
    """Content of the trailer of a blob."""

    dtype: torch.dtype
    shape: tuple[int, ...]
    xxh3: str

    @property
    def nbytes(self) -> int:
        return prod(self.shape) * self.dtype.itemsize


class Blobs:
    """The folder ``bands`` of a store, ``<2>/<name>``. A name stands for one content: written once, never changed."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._folder = os.fspath(root)
        self._disk = Disk(root.parent)
        self._lost: set[str] = set()  # damaged blobs, which the user may not be allowed to move away

    def has(self, name: str) -> bool:
        """Return True if a blob of this name exists, without reading its bytes."""
        return name not in self._lost and os.path.exists(self._path(name))

    def about(self, name: str) -> Blob:
        """Return type, shape and checksum of a blob; raise `Damaged` where the trailer cannot be read."""
        try:
            with open(self._path(name), "rb") as file:
                return _trailer(file.fileno())[0]
        except (OSError, *_UNREADABLE) as error:
            raise self._damaged(name, error) from None

    def write(self, name: str, x: Tensor) -> str:
        """Write ``x`` unless the blob exists; return the xxh3 of the stored blob. Raises `OSError` on a full disk."""
        if self.has(name):
            with suppress(Damaged):
                return self.about(name).xxh3
        data, kind = bytes_of(x), _kind(x.dtype, tuple(x.shape))
        xxh3 = _checksum(data, kind)
        with self._disk.temporary(name) as (part, file):
            for piece in (data, kind, xxh3.encode(), len(kind).to_bytes(4, "little")):
                file.write(piece)
            file.flush()
            if len(data) > _SMALL:
                os.fsync(file.fileno())
            return self._named(name, part) or xxh3

    def write_all(self, names: Sequence[str], slices: Sequence[Tensor]) -> list[str]:
        """Write several blobs in parallel: a disk syncs many files in little more time than one file."""
        with ThreadPoolExecutor(_WRITERS) as pool:
            return list(pool.map(self.write, names, slices))

    def _named(self, name: str, part: str) -> str | None:
        """Rename a complete blob to its name; return the checksum of an existing blob of that name, else None."""
        self._disk.make_folder(self._folder)
        if name in self._lost or not self._disk.link(part, self._path(name)):
            if name not in self._lost:
                with suppress(Damaged):
                    return self.about(name).xxh3
            self._disk.rename(part, self._path(name))
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
        """Return one contiguous tensor of ``shape`` whose slices along the first axis are the blobs ``names``.

        The blobs are mapped where a slice is whole memory pages, else copied. ``verify`` compares the checksum of every
        byte; ``xxh3`` lists the expected checksums. Raises `Damaged`; a damaged blob then counts as missing.
        """
        wanted = [Blob(dtype, tuple(shape[1:]), xxh3[i] if xxh3 else "") for i in range(len(names))]
        size = wanted[0].nbytes if wanted else 0
        if not size:
            return torch.empty(*shape, dtype=dtype)
        if _LIBC is not None and size % mmap.PAGESIZE == 0:
            with suppress(OSError):  # a file system or a limit that allows no maps
                space = _reserve(len(names) * size)
                self._fill(names, wanted, memoryview(space).cast("B"), ctypes.addressof(space), verify)
                return torch.frombuffer(space, dtype=dtype).reshape(*shape)
        x = torch.empty(*shape, dtype=dtype)
        self._fill(names, wanted, bytes_of(x), None, verify)
        return x

    def _fill(
        self, names: Sequence[str], wanted: Sequence[Blob], into: memoryview, address: int | None, verify: bool
    ) -> None:
        """Place blobs side by side: map the files where an ``address`` is given, else read them."""
        size = wanted[0].nbytes
        for i, (name, want) in enumerate(zip(names, wanted, strict=True)):
            try:
                with open(self._path(name), "rb", buffering=0) as file:
                    at = address and address + i * size
                    _load(file.fileno(), want, into[i * size : (i + 1) * size], at, verify)
            except _UNREADABLE as error:
                raise self._damaged(name, error) from None
            except OSError as error:
                if address is None:
                    raise self._damaged(name, error) from None
                raise

    def _path(self, name: str) -> str:
        return f"{self._folder}/{name[:2]}/{name}"

    def _damaged(self, name: str, error: Exception) -> Damaged:
        """Move a damaged blob to the folder ``bad/`` of the store for inspection; return the error to raise."""
        self._lost.add(name)
        if not isinstance(error, OSError):
            with suppress(OSError):
                self._disk.make_folder(f"{self._disk.folder}/bad")
                os.replace(self._path(name), f"{self._disk.folder}/bad/{name}")
        return Damaged(f"the band {name} is damaged or missing: {error}")


def bytes_of(x: Tensor) -> memoryview:
    """Return the bytes of a tensor, without a copy where the tensor is contiguous and on the CPU."""
    flat = x.detach().cpu().resolve_conj().resolve_neg().contiguous().reshape(-1)
    if flat.stride() != (1,):  # a single element is contiguous whatever its stride, but cannot be viewed as bytes
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.uint8).numpy().data


def dtype_of(name: str) -> torch.dtype:
    """Return ``torch.float32`` for ``"float32"``; raise `ValueError` for a name that torch does not know."""
    found = getattr(torch, name, None)
    if not isinstance(found, torch.dtype):
        raise ValueError(f"{name!r} is not a dtype of torch")
    return found


def _kind(dtype: torch.dtype, shape: tuple[int, ...]) -> bytes:
    return json.dumps([str(dtype).removeprefix("torch."), list(shape)]).encode()


def _checksum(data: memoryview, kind: bytes) -> str:
    found = xxhash.xxh3_128(data)
    found.update(kind)
    return found.hexdigest()


def _trailer(file: int) -> tuple[Blob, bytes]:
    """Return the content of a blob's trailer after comparing the file size; raise `ValueError` where they disagree."""
    size = os.fstat(file).st_size
    tail = os.pread(file, 512, max(0, size - 512))
    length = int.from_bytes(tail[-4:], "little")
    body = tail[-36 - length : -4]
    if len(body) != length + 32:
        raise ValueError("the trailer is missing or cut short")
    dtype, shape = json.loads(body[:length])
    blob = Blob(dtype_of(dtype), tuple(int(n) for n in shape), body[length:].decode())
    if size != blob.nbytes + length + 36:
        raise ValueError(f"the file has {size} bytes instead of the {blob.nbytes + length + 36} that were written")
    return blob, body[:length]


def _load(file: int, want: Blob, into: memoryview, address: int | None, verify: bool) -> None:
    """Load the slice of a file into its place; raise `ValueError` where the file holds another slice."""
    blob, kind = _trailer(file)
    if blob[:2] != want[:2]:
        raise ValueError(f"the file holds {blob.dtype} {blob.shape} instead of {want.dtype} {want.shape}")
    if want.xxh3 and blob.xxh3 != want.xxh3:
        raise ValueError("the file holds another band than the one written with this result")
    if address is None:
        _read_all(file, into)
    else:
        _map(file, address, blob.nbytes)
    if verify and _checksum(into, kind) != blob.xxh3:
        raise ValueError("checksum mismatch: the stored bytes have changed since they were written")


def _read_all(file: int, into: memoryview) -> None:
    done = 0
    while done < len(into):
        read = os.preadv(file, [into[done:]], done)
        if not read:
            raise ValueError("the file was truncated while being read")
        done += read


def _reserve(size: int) -> Any:
    """Return an array over a reserved address range of ``size`` bytes, which is released with the array."""
    assert _LIBC is not None
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANON
    address = _LIBC.mmap(None, size, 0, flags, -1, 0)
    if address in (None, ctypes.c_void_p(-1).value):
        raise OSError(ctypes.get_errno(), "no address range is free")
    space = (ctypes.c_char * size).from_address(address)
    weakref.finalize(space, _LIBC.munmap, address, size).atexit = False  # a thread may use it until the very end
    return space


def _map(file: int, address: int, size: int) -> None:
    """Map the beginning of a file to an address inside a range of `_reserve`."""
    assert _LIBC is not None
    access = mmap.PROT_READ | mmap.PROT_WRITE
    if _LIBC.mmap(address, size, access, mmap.MAP_PRIVATE | _FIXED, file, 0) != address:
        raise OSError(ctypes.get_errno(), "the file cannot be mapped")
