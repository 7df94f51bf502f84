"""The store: a folder of results by key, ``<2>/<key>.safetensors`` beside ``<key>.json``.

The JSON says what a result is: the recipe of its key, its layout, facts, checks, seconds
and versions. Small results stand in it whole; of others it may be all that there is, a
receipt. Every byte is covered by a checksum that is compared on each load; an entry that
fails is put aside with one warning and counts as missing. A result gets its name only when
it is complete, so a killed process leaves no half of one. Where the folder cannot be
written, a run warns once and goes on.
"""

from __future__ import annotations

import os
import random
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from neusee.workflows import _sidecar
from neusee.workflows._disk import Disk
from neusee.workflows._journal import Journal
from neusee.workflows._lease import Lease, Leases
from neusee.workflows._sidecar import UNREADABLE, About, is_kept
from neusee.workflows._speeds import Speeds

if TYPE_CHECKING:
    from torch import Tensor

Verify = Literal["always", "sampled", "never"]
INLINE = 4096  #: bytes of tensors up to which a result stands in its JSON
_SAMPLED = 1 / 20  #: of the loads under ``sampled`` that are verified although the file has not been touched
_USED = 3600.0  #: s after which a use is written down again
_draw = random.Random()


def default_root() -> Path:
    """``$NEUSEE_CACHE``, else ``cache/`` of the checkout around us, else ``~/.cache/neusee``."""
    if named := os.environ.get("NEUSEE_CACHE"):
        return Path(named)
    here = Path.cwd()
    for folder in (here, *here.parents):
        project = folder / "pyproject.toml"
        if (folder / "cache").is_dir() and project.is_file() and 'name = "neusee"' in project.read_text("utf-8"):
            return folder / "cache"
    return Path.home() / ".cache" / "neusee"


class Store:
    """Results by key. Every way in which a folder can fail is a missing result, never a wrong one."""

    def __init__(
        self, root: Path | str | None = None, *, verify: Verify | None = None, budget: int | None = None
    ) -> None:
        """``verify`` and ``budget`` (bytes): None takes ``$NEUSEE_CACHE_VERIFY`` and ``$NEUSEE_CACHE_BUDGET``.

        ``always`` compares the checksum of every payload that is loaded; ``sampled`` only where
        its file is not the one that was written, untouched, and one time in twenty; ``never`` none.
        What stands in the JSON is always compared, and the size of every payload.
        """
        self.root = default_root() if root is None else Path(root)
        self.verify = _verify(verify)
        self.disk = Disk(self.root)
        self.journal = Journal(self.disk)
        self.code_memo = self.root / "code.json"
        self._leases = Leases(self.disk)
        self._speeds = Speeds(self.disk)
        self._known: dict[str, About] = {}
        self._lost: set[str] = set()  # damaged, and perhaps not to be moved away
        self._used: set[str] = set()
        self._warned = False

    def has(self, key: str) -> bool:
        """Whether there is a value; its payload is not read."""
        about = self.about(key)
        return about is not None and is_kept(about)

    def about(self, key: str) -> About | None:
        """What is known of a result, without reading it; ``kept`` in it says whether there is a value too."""
        if key in self._known and is_kept(self._known[key]):
            return self._known[key]
        if key in self._lost:
            return None
        try:
            about = self._read(key)
        except UNREADABLE as error:
            if os.path.exists(self.disk.path(key, "json")):
                self._put_aside(key, error)
            return None
        self._known[key] = about
        return about

    def get(self, key: str) -> Any:
        """The value, or `KeyError` where there is none that can be trusted."""
        about = self.about(key)
        while about is not None and is_kept(about):
            try:
                value = self._load(key, about)
            except UNREADABLE as error:
                before, about = about, self._again(key)
                if about == before:
                    self._put_aside(key, error)
                    break
            else:
                self._use(key)
                return value
        raise KeyError(key)

    def put(self, key: str, value: Any, about: About) -> bool:
        """Keep a value with what is ``about`` it; False, after one warning, where the folder takes none."""
        return self._try(self._write, key, value, about)

    def note(self, key: str, about: About) -> bool:
        """Keep what is ``about`` a result without its value, unless there is a value or such a receipt already."""
        return self._try(self._write_receipt, key, about)

    def entries(self) -> Iterator[tuple[str, About]]:
        """Every result's key and what is known of it, in the order of the keys; receipts too."""
        for key in _sidecar.names(self.disk):
            about = self.about(key)
            if about is not None:
                yield key, about

    def claim(self, key: str) -> Lease | None:
        """The right to compute ``key``; None while another live process has it.

        Who was refused asks again from time to time; whoever gets the lease late looks first
        whether the value has come meanwhile.
        """
        return self._leases.claim(key)

    def read_seconds(self, size: float) -> float:
        """What loading ``size`` bytes takes, as this store's own loads did."""
        return self._speeds.seconds("read", size)

    def write_seconds(self, size: float) -> float:
        """What keeping ``size`` bytes takes, as this store's own writes did."""
        return self._speeds.seconds("write", size)

    def _read(self, key: str) -> About:
        """What stands beside a result, if its payload has its size."""
        about = _sidecar.read(self.disk, key)
        try:
            stat = about.get("payload") and os.stat(self.disk.path(key, "safetensors"))
        except FileNotFoundError:
            again = _sidecar.read(self.disk, key)
            if is_kept(again):
                raise
            return again
        if stat and stat.st_size != about["payload"]["size"]:
            raise ValueError(f"its payload has not the {about['payload']['size']} bytes that were written")
        return about

    def _again(self, key: str) -> About | None:
        """What stands beside a result now; None where somebody has removed it."""
        self._known.pop(key, None)
        with suppress(*UNREADABLE):
            self._known[key] = _sidecar.read(self.disk, key)
        return self._known.get(key)

    def _load(self, key: str, about: About) -> Any:
        from neusee.workflows import _codec

        began, path = time.perf_counter(), self.disk.path(key, "safetensors")
        payload = about["payload"]
        if not payload:
            return _codec.unpack(about["layout"], [_codec.from_text(*t) for t in about["tensors"]])
        stamp = _stamp(path)
        if stamp[1] != payload["size"]:
            raise ValueError(f"its payload has not the {payload['size']} bytes that were written")
        check = self._checks(stamp, payload)
        value = _codec.unpack(about["layout"], _codec.read(path, payload["xxh3"] if check else None))
        if check:
            self._speeds.learn("read", payload["size"], time.perf_counter() - began)
        return value

    def _checks(self, stamp: list[int], payload: About) -> bool:
        """Whether this load compares the checksum."""
        if self.verify != "sampled":
            return self.verify == "always"
        return stamp != payload.get("stamp") or _draw.random() < _SAMPLED

    def _use(self, key: str) -> None:
        """Write down, in the time of the description's last change, that a value was of use."""
        if key not in self._used:
            self._used.add(key)
            path = self.disk.path(key, "json")
            with suppress(OSError):
                if abs(time.time() - os.stat(path).st_mtime) > _USED:
                    os.utime(path)

    def _try(self, write: Callable[..., None], key: str, *what: Any) -> bool:
        """Write; once more where what it needs was removed meanwhile."""
        try:
            try:
                write(key, *what)
            except FileNotFoundError:
                self.disk.forget()
                write(key, *what)
        except OSError as error:
            if not self._warned:
                warnings.warn(f"{self.root} cannot be written ({error}): results are not kept", stacklevel=4)
            self._warned = True
            return False
        return True

    def _write(self, key: str, value: Any, about: About) -> None:
        from neusee.workflows import _codec

        began = time.perf_counter()
        layout, tensors = _codec.pack(value)
        size = sum(t.nbytes for t in tensors)
        entry = {"key": key, **about, "layout": layout, "bytes": size, "payload": None, "kept": True}
        if size <= INLINE:
            entry["tensors"] = [_codec.to_text(t) for t in tensors]
            self._write_about(key, entry)
        else:
            self._write_payload(key, entry, tensors)
            self._speeds.learn("write", size, time.perf_counter() - began)
        self._lost.discard(key)
        self.journal.append(key, entry)

    def _write_payload(self, key: str, entry: About, tensors: list[Tensor]) -> None:
        """Write all of it before it gets a name; of two processes with one key the first one's stays."""
        from neusee.workflows import _codec

        with self.disk.temporary(key) as (part, file):
            xxh3 = _codec.write(file, tensors)
            file.flush()
            os.fsync(file.fileno())
            entry["payload"] = {"size": file.tell(), "xxh3": xxh3}
            self._adopt(key, entry, part)

    def _adopt(self, key: str, entry: About, part: str) -> None:
        """Name a complete payload and then what describes it, unless another process was first."""
        path = self.disk.path(key, "safetensors")
        with self.disk.lock():
            if key in self._lost or not self._stays(key):
                self.disk.rename(part, path)
                entry["payload"]["stamp"] = _stamp(path)
                self._write_about(key, entry)

    def _stays(self, key: str) -> bool:
        """Whether another process has already kept this value."""
        try:
            return is_kept(_sidecar.read(self.disk, key))
        except UNREADABLE:
            return os.path.exists(self.disk.path(key, "json"))

    def _write_about(self, key: str, entry: About) -> None:
        """A torn entry fails its seal, so this small file need not wait for the disk."""
        path = self.disk.path(key, "json")
        with self.disk.temporary(key) as (part, file):
            file.write(_sidecar.seal(entry))
            file.flush()
            if not self.disk.link(part, path):
                self.disk.rename(part, path)
        self._known[key] = entry

    def _write_receipt(self, key: str, about: About) -> None:
        """What has the name already stays: it tells no less."""
        entry = _sidecar.receipt({"key": key, **about})
        if self.about(key) is None:
            with self.disk.temporary(key) as (part, file):
                file.write(_sidecar.seal(entry))
                file.flush()
                if self.disk.link(part, self.disk.path(key, "json")):
                    self._known[key] = entry
        self.journal.append(key, entry)

    def _put_aside(self, key: str, error: Exception) -> None:
        """Move a damaged entry to ``bad/``, where someone may look at it; what another user owns stays."""
        self._known.pop(key, None)
        self._lost.add(key)
        unreadable = isinstance(error, OSError) and not isinstance(error, FileNotFoundError)
        for suffix in () if unreadable else ("json", "safetensors"):
            with suppress(OSError):
                self.disk.make_folder(f"{self.disk.folder}/bad")
                os.replace(self.disk.path(key, suffix), f"{self.disk.folder}/bad/{key}.{suffix}")
        if not os.path.lexists(self.disk.path(key, "json")):
            self._lost.discard(key)
        warnings.warn(f"the stored result {key} is damaged ({error}): it is put aside", stacklevel=4)


def _verify(wanted: str | None) -> str:
    """The mode that was asked for, here or in the environment."""
    name = "verify" if wanted else "NEUSEE_CACHE_VERIFY"
    found = wanted or os.environ.get("NEUSEE_CACHE_VERIFY") or "always"
    if found not in get_args(Verify):
        raise ValueError(f"{name} is {found!r}: write {', '.join(get_args(Verify)[:-1])} or {get_args(Verify)[-1]}")
    return found


def _stamp(path: str) -> list[int]:
    """What changes when somebody writes to a file."""
    stat = os.stat(path)
    return [stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]
