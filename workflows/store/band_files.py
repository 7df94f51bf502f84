"""Slices of stacks, one file a band, shared by every result that has the band; and one tensor over many of them.

A blob is a slice's bytes and, behind them, a trailer: what it is, its checksum, the trailer's length. The bytes begin
at the start of the file, so that files whose slices are whole pages are mapped side by side into one range of
addresses: a contiguous tensor without a copy. The maps are private: what is written to the tensor reaches no file.
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

_SMALL = 4096  #: bytes up to which a blob need not wait for the disk: a torn one fails its checksum
_WRITERS = 8
_FIXED = 0x10  #: MAP_FIXED of Linux and macOS
_LIBC = ctypes.CDLL(None, use_errno=True) if sys.platform in ("linux", "darwin") else None
_UNREADABLE = (FileNotFoundError, ValueError, LookupError, TypeError, AttributeError)

if _LIBC is not None:
    _LIBC.mmap.restype = ctypes.c_void_p
    _LIBC.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    _LIBC.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]


class Damaged(ValueError):
    """A blob is missing, or is not what was written: whoever needs it must do without."""


@dataclass(frozen=True, slots=True, eq=False)
class Stacked:
    """A tensor whose slices along the first axis are stored as one blob each."""

    tensor: Tensor
    names: tuple[str, ...]  #: one a slice; equal names are equal slices


class Blob(NamedTuple):
    """What the trailer of a blob says."""

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
        self._lost: set[str] = set()  # damaged, and perhaps not to be moved away

    def has(self, name: str) -> bool:
        """Whether there is a blob of this name; its bytes are not read."""
        return name not in self._lost and os.path.exists(self._path(name))

    def about(self, name: str) -> Blob:
        """Type, shape and checksum of a blob; raises `Damaged`."""
        try:
            with open(self._path(name), "rb") as file:
                return _trailer(file.fileno())[0]
        except (OSError, *_UNREADABLE) as error:
            raise self._damaged(name, error) from None

    def write(self, name: str, x: Tensor) -> str:
        """Keep ``x`` unless there is such a blob; the xxh3 of what is there now. Raises `OSError` where none fits."""
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
        """Write several at a time: a disk syncs many files in little more time than one."""
        with ThreadPoolExecutor(_WRITERS) as pool:
            return list(pool.map(self.write, names, slices))

    def _named(self, name: str, part: str) -> str | None:
        """Give a complete blob its name; the xxh3 of another that had it first."""
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
        """One contiguous tensor of ``shape`` whose slices along the first axis are the blobs ``names``.

        Mapped where a slice is whole pages, else copied. ``verify``: compare the checksum of every byte. ``xxh3``:
        the checksums that the blobs must have. Raises `Damaged`, and counts that blob as missing from then on.
        """
        wanted = [Blob(dtype, tuple(shape[1:]), xxh3[i] if xxh3 else "") for i in range(len(names))]
        size = wanted[0].nbytes if wanted else 0
        if not size:
            return torch.empty(*shape, dtype=dtype)
        if _LIBC is not None and size % mmap.PAGESIZE == 0:
            with suppress(OSError):  # a file system or a limit that takes no maps
                space = _reserve(len(names) * size)
                self._fill(names, wanted, memoryview(space).cast("B"), ctypes.addressof(space), verify)
                return torch.frombuffer(space, dtype=dtype).reshape(*shape)
        x = torch.empty(*shape, dtype=dtype)
        self._fill(names, wanted, bytes_of(x), None, verify)
        return x

    def _fill(
        self, names: Sequence[str], wanted: Sequence[Blob], into: memoryview, address: int | None, verify: bool
    ) -> None:
        """Put blobs side by side: mapped where there is an ``address``, else read."""
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
        """Move a damaged blob to the store's ``bad/``, where someone may look at it."""
        self._lost.add(name)
        if not isinstance(error, OSError):
            with suppress(OSError):
                self._disk.make_folder(f"{self._disk.folder}/bad")
                os.replace(self._path(name), f"{self._disk.folder}/bad/{name}")
        return Damaged(f"the band {name} is damaged or missing: {error}")


def bytes_of(x: Tensor) -> memoryview:
    """The bytes of a tensor, without a copy where it is contiguous and on the CPU."""
    flat = x.detach().cpu().resolve_conj().resolve_neg().contiguous().reshape(-1)
    if flat.stride() != (1,):  # a single element is contiguous whatever its stride, and yet cannot be seen as bytes
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.uint8).numpy().data


def dtype_of(name: str) -> torch.dtype:
    """``torch.float32`` of ``"float32"``; raises `ValueError`."""
    found = getattr(torch, name, None)
    if not isinstance(found, torch.dtype):
        raise ValueError(f"{name!r} is no type of tensors")
    return found


def _kind(dtype: torch.dtype, shape: tuple[int, ...]) -> bytes:
    return json.dumps([str(dtype).removeprefix("torch."), list(shape)]).encode()


def _checksum(data: memoryview, kind: bytes) -> str:
    found = xxhash.xxh3_128(data)
    found.update(kind)
    return found.hexdigest()


def _trailer(file: int) -> tuple[Blob, bytes]:
    """What a blob says of itself, once its size agrees; raises `ValueError`."""
    size = os.fstat(file).st_size
    tail = os.pread(file, 512, max(0, size - 512))
    length = int.from_bytes(tail[-4:], "little")
    body = tail[-36 - length : -4]
    if len(body) != length + 32:
        raise ValueError("it has no end")
    dtype, shape = json.loads(body[:length])
    blob = Blob(dtype_of(dtype), tuple(int(n) for n in shape), body[length:].decode())
    if size != blob.nbytes + length + 36:
        raise ValueError(f"it has {size} bytes, not the {blob.nbytes + length + 36} that were written")
    return blob, body[:length]


def _load(file: int, want: Blob, into: memoryview, address: int | None, verify: bool) -> None:
    """Put the slice in a file in its place; raises `ValueError` where it is not the one that is wanted."""
    blob, kind = _trailer(file)
    if blob[:2] != want[:2]:
        raise ValueError(f"it holds {blob.dtype} {blob.shape}, not {want.dtype} {want.shape}")
    if want.xxh3 and blob.xxh3 != want.xxh3:
        raise ValueError("it holds something else than was written with this result")
    if address is None:
        _read_all(file, into)
    else:
        _map(file, address, blob.nbytes)
    if verify and _checksum(into, kind) != blob.xxh3:
        raise ValueError("its bytes are not those that were written")


def _read_all(file: int, into: memoryview) -> None:
    done = 0
    while done < len(into):
        read = os.preadv(file, [into[done:]], done)
        if not read:
            raise ValueError("it was cut while it was read")
        done += read


def _reserve(size: int) -> Any:
    """An array over ``size`` bytes of addresses with nothing behind them yet; they go when the array goes."""
    assert _LIBC is not None
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANON
    address = _LIBC.mmap(None, size, 0, flags, -1, 0)
    if address in (None, ctypes.c_void_p(-1).value):
        raise OSError(ctypes.get_errno(), "no range of addresses is free")
    space = (ctypes.c_char * size).from_address(address)
    weakref.finalize(space, _LIBC.munmap, address, size).atexit = False  # a thread may use it to the very end
    return space


def _map(file: int, address: int, size: int) -> None:
    """Put the beginning of a file at an address that `_reserve` gave."""
    assert _LIBC is not None
    access = mmap.PROT_READ | mmap.PROT_WRITE
    if _LIBC.mmap(address, size, access, mmap.MAP_PRIVATE | _FIXED, file, 0) != address:
        raise OSError(ctypes.get_errno(), "the file cannot be mapped")
