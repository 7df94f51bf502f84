"""Content of installed packages that code of a user imports: which files have they, and what do they import?

A version does not say which files a package has: a helper that is installed again under the same version, or edited in
place, is other code. The packages that neusee itself declares count by their version alone, because their wheels differ
between platforms and devices, and machines share results. Any other package counts by the content of its files, with
the packages that it requires. Byte code, scripts and metadata do not count, so machines with equal wheels agree.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import sys
import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import xxhash

from neusee.nodes.import_times import import_time
from neusee.workflows.keys import module_origin
from neusee.workflows.keys.code_memo import Parts, known_contents
from neusee.workflows.keys.regular_file import opened

#: distributions that neusee declares for its users, in pyproject.toml, in the form of `plain`
BY_VERSION = frozenset(
    {
        *("arviz", "astropy", "colour_science", "dask", "dask_jobqueue", "deepinv", "distributed", "emcee", "fsspec"),
        *("h5netcdf", "h5py", "jinja2", "kornia", "kornia_rs", "matplotlib", "numpy", "onnx", "onnxscript"),
        *("openexr", "pillow", "pydantic", "rich", "ruamel_yaml", "safetensors", "scipy", "tensorboard"),
        *("torch", "typer", "xarray", "xxhash"),
    }
)
_SETTLED = 2_000_000_000  #: ns after a change of a file in which a second change may not change its time stamp
_REQUIRED = re.compile(r"^Requires-Dist: *([\w.-]+)(.*)$", re.MULTILINE)
_OF_AN_EXTRA = re.compile(r";.*\bextra *==")
_PROGRAM = "neusee"
_LEFT_OUT = (".pyc", ".pyo", ".pyi", ".pth")


class Content(NamedTuple):
    """The digest of the files of a distribution, and when the newest of them was changed (ns)."""

    digest: str
    changed: int


class Counted(NamedTuple):
    """What the packages behind an imported module add to a digest."""

    parts: Parts
    edited: str  #: a package whose files were changed after its import, or nothing


def counted(module: str, version: str) -> Counted:
    """Return what an imported module of an installed package adds: its distributions, and those that they require.

    ``version`` is what the module counts by if neusee declares its package.
    """
    top = module.partition(".")[0]
    names = module_origin.distributions_with(top)
    if not names or BY_VERSION.issuperset(map(module_origin.plain, names)):
        return Counted({f"package {top}": {"version": version}}, "")
    return _counted(top, version)


@functools.cache
def _counted(top: str, version: str) -> Counted:
    """Return what a top-level module of a package adds that neusee does not declare, as it was when first asked."""
    own = [module_origin.plain(name) for name in module_origin.distributions_with(top)]
    found = {name: _content(name, top) for name in own}
    parts = {f"package {top}": {"version": version, "content": _joined(found.values())}}
    edited = top in sys.modules and max(each.changed for each in found.values()) > import_time(top)
    for name in sorted(_required(own)):
        about = {"version": module_origin.released(name)}
        if name not in BY_VERSION:
            about["content"] = _content(name, name).digest
        parts.setdefault(f"package {name}", about)
    return Counted(parts, top if edited else "")


def _joined(contents: Iterable[Content]) -> str:
    return " ".join(each.digest for each in contents)


def _required(names: Iterable[str]) -> set[str]:
    """Return the installed distributions that some distributions require, directly or not, without their extras.

    What a package that neusee declares requires does not count, as it does not where a node imports that package.
    """
    first = set(names)
    found, todo = set(first), [*first]
    while todo:
        text = module_origin.metadata_text(todo.pop(), "METADATA").decode(errors="replace").partition("\n\n")[0]
        for name, rest in _REQUIRED.findall(text):
            each = module_origin.plain(name)
            if each in found or _OF_AN_EXTRA.search(rest) or each == _PROGRAM or not module_origin.released(each):
                continue
            found.add(each)
            todo += [] if each in BY_VERSION else [each]
    return found - first


def _content(name: str, top: str) -> Content:
    """Return the digest of the files of a distribution; ``top`` is its module if no record lists its files.

    A digest is noted with the stamps of the files, so that the next process reads none of them.
    """
    files = sorted(_files(name, top).items())
    stamps = [(path, _stamp(file)) for path, file in files]
    changed = max((max(stamp[-2:]) for _, stamp in stamps if stamp), default=0)
    mark = xxhash.xxh3_128_hexdigest(repr([name, stamps]).encode(errors="replace"))
    if mark in known_contents:
        return Content(known_contents[mark], changed)
    text = xxhash.xxh3_128()
    for path, file in files:
        text.update(path.encode(errors="replace") + b"\0" + _digest_of(file) + b"\n")
    if time.time_ns() - changed > _SETTLED:
        known_contents[mark] = text.hexdigest()
    return Content(text.hexdigest(), changed)


def _files(name: str, top: str) -> dict[str, str]:
    """Return the path of each file that the code of a distribution may be or read, by its path in the distribution.

    The files are those of the record of its installation, and modules that stand in its packages without a record.
    """
    site = os.path.dirname(module_origin.metadata_folder(name))
    found = [*_recorded(module_origin.metadata_text(name, "RECORD").decode(errors="replace"))]
    if found:
        folders = {path.rpartition("/")[0] for path in found if path.endswith("/__init__.py")}
        for package in sorted(each for each in folders if each.rpartition("/")[0] not in folders):
            found += filter(_is_module, _below(site, package))
    else:
        found += [each for each in os.listdir(site) if each.partition(".")[0] == top and _is_module(each)]
        found += _below(site, top)
    return {path: os.path.join(site, path) for path in found}


def _recorded(record: str) -> Iterator[str]:
    """Yield the files of a record: not metadata, byte code, or scripts outside of the folder of packages."""
    for line in record.splitlines():
        path = line.rsplit(",", 2)[0].strip('"').replace("\\", "/")
        outside = path.startswith(("..", "/")) or path.partition("/")[0].endswith((".dist-info", ".data"))
        if path and not outside and not path.endswith(_LEFT_OUT):
            yield path


def _below(site: str, package: str) -> Iterator[str]:
    """Yield the files in the folder of a package, as a record names them."""
    for folder, inside, files in os.walk(os.path.join(site, package)):
        inside[:] = [each for each in inside if each != "__pycache__"]
        where = os.path.relpath(folder, site)
        yield from (f"{where}/{file}" for file in files if not file.endswith(_LEFT_OUT))


def _is_module(file: str) -> bool:
    return file.endswith((".py", ".so", ".pyd"))


def _stamp(file: str) -> tuple[int, ...]:
    """Return what changes whenever a file is changed, last the times of its content and entry; nothing if missing."""
    try:
        stat = os.stat(file)
    except OSError:
        return ()
    return stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns


def _digest_of(file: str) -> bytes:
    try:
        with opened(file) as content:
            return hashlib.file_digest(content, xxhash.xxh3_128).digest()
    except OSError:
        return b"missing"
