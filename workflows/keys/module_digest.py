"""Digest of one module, from its source or its installed package, and sealed files that store such
digests.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import os
import re
import sys
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import Any, NamedTuple

import xxhash
from pydantic import TypeAdapter

from neusee.nodes.import_times import import_time
from neusee.workflows.keys import module_origin
from neusee.workflows.keys.cache_key import Stamp, file_stamp
from neusee.workflows.keys.module_origin import distributions_of
from neusee.workflows.keys.sealed_files import (
    bytes_of,
    opened,
    seal_file,
    seal_record,
    secrets,
    unseal_file,
    unseal_record,
    write_shared,
)
from neusee.workflows.keys.source_summary import Summary

# --- code memo ------------------------------------------------------------------------------------

# Sealed files about code: the summaries of source files, so that a run from the cache parses no
# source.
#
# A file is ignored and written again if it is damaged, has another format, or lacks the required
# signature.


#: modules that summarise a source file
_SUMMARISING = ("source_syntax", "unfollowed_constructs", "source_summary")
#: digest of the code that summarises a source file, so that an older summary is not used
EDITION = xxhash.xxh3_64_hexdigest(
    b"".join(Path(__file__).with_name(f"{n}.py").read_bytes() for n in _SUMMARISING)
)
_KEPT = 1000  #: greatest number of summaries in the file
#: stamps of the files of digests that this process has read or written and that are intact
_right: dict[Path, Stamp] = {}

#: digests of definitions, versions or contents, by module or other dependency and by name
Parts = dict[str, dict[str, str]]


class Outline(NamedTuple):
    """Digest of the syntax of a source file of the program, and the import statements at its top
    level.
    """

    digest: str
    imports: list[tuple[str, list[str]]]  #: of ``from a import b``: the module and the names


#: outlines of source files of the program, by the edition and the digest of the source
outlines: dict[str, Outline] = {}
#: digests of the files of packages, by the digest of the stamps of the files
known_contents: dict[str, str] = {}


class _Known(NamedTuple):
    """Notes on packages and on the program, stored beside the summaries."""

    distributions: dict[str, list[str]]
    outlines: dict[str, Outline]
    contents: dict[str, str]


_SUMMARIES = TypeAdapter(dict[str, Summary])
_KNOWN = TypeAdapter(_Known)
_PARTS = TypeAdapter(Parts)
_saved: dict[Path, int] = {}  #: number of outlines plus number of package digests in each memo


def read_memo(memo: Path) -> dict[str, Summary]:
    """Return the saved summaries of source files, or an empty dict if their file is missing or
    damaged.
    """
    _saved[memo] = 0
    try:
        memory, summaries = _read(memo.name, bytes_of(memo), secrets())
    except (OSError, ValueError):
        return {}
    for module, distributions in memory.distributions.items():
        distributions_of.setdefault(module, distributions)
    for name, outline in memory.outlines.items():
        outlines.setdefault(name, outline)
    for stamps, content in memory.contents.items():
        known_contents.setdefault(stamps, content)
    _saved[memo] = len(memory.outlines) + len(memory.contents)
    return dict(summaries)


@functools.lru_cache(4)
def _read(name: str, raw: bytes, signed_by: tuple[bytes, ...]) -> tuple[_Known, dict[str, Summary]]:
    """Return the content of a memo. A process decodes the same bytes once for each set of
    secrets.
    """
    # three lines: the seal, the notes on packages and on the program, the summaries
    seal_line, _, content = raw.partition(b"\n")
    notes_json, summaries_json = unseal_file("sources", name, seal_line, content).split(b"\n", 1)
    return _KNOWN.validate_json(notes_json), _SUMMARIES.validate_json(summaries_json)


def is_complete(memo: Path) -> bool:
    """Return True if a memo contains all outlines and package digests that this process has
    read.
    """
    return _saved.get(memo, 0) >= len(outlines) + len(known_contents)


def write_memo(memo: Path, summaries: Mapping[str, Summary]) -> None:
    """Save the newest summaries of source files; do nothing if the folder cannot be written."""
    newest_outlines = dict(list(outlines.items())[-_KEPT:])
    newest_contents = dict(list(known_contents.items())[-_KEPT:])
    _saved[memo] = len(outlines) + len(known_contents)
    outlines_and_contents = _KNOWN.dump_json(
        _Known(distributions_of, newest_outlines, newest_contents)
    )
    summaries_json = json.dumps(dict(list(summaries.items())[-_KEPT:])).encode()
    content = b"\n".join([outlines_and_contents, summaries_json])
    write_shared(
        memo, b"\n".join([seal_file("sources", memo.name, content), content]), memo.parent / "tmp"
    )


def read_parts(root: Path, code: str) -> Parts:
    """Return the digest of each definition that the digest ``code`` covers; an empty dict if the
    record is missing or damaged.
    """
    try:
        record = unseal_record("definitions", bytes_of(root / "code" / f"{code}.json"))
        return _PARTS.validate_python(record) if record.pop("key", "") == f"code/{code}" else {}
    except (OSError, ValueError):
        return {}


def write_parts(root: Path, code: str, parts: Parts) -> None:
    """Save the digest of each definition that the digest ``code`` covers, unless an undamaged
    record exists.
    """
    path = root / "code" / f"{code}.json"
    with suppress(OSError):
        stamp = file_stamp(path)
        # an intact record exists
        if _right.get(path) == stamp or read_parts(root, code):
            _right[path] = stamp
            return
    write_shared(path, seal_record("definitions", {**parts, "key": f"code/{code}"}), root / "tmp")


# --- installed content ----------------------------------------------------------------------------

# Content of the installed packages that code of a user imports: which files does a package have,
# and which packages does it require?
#
# A version does not determine the files of a package: a helper package that is installed again
# under the same version, or edited in place, is other code. The packages that neusee itself
# declares count by their version alone, because their wheels differ between platforms and devices,
# and machines share results. Any other package counts by the content of its files, together with
# the packages that it requires. Byte code, scripts and metadata do not count, so machines with
# equal wheels get equal digests.


#: distributions that neusee declares for its users, in pyproject.toml, in the form of `plain`
BY_VERSION = frozenset(
    {
        *(
            "arviz",
            "astropy",
            "colour_science",
            "dask",
            "dask_jobqueue",
            "deepinv",
            "distributed",
            "emcee",
            "fsspec",
        ),
        *(
            "h5netcdf",
            "h5py",
            "jinja2",
            "kornia",
            "kornia_rs",
            "matplotlib",
            "numpy",
            "onnx",
            "onnxscript",
        ),
        *(
            "openexr",
            "pillow",
            "pydantic",
            "rich",
            "ruamel_yaml",
            "safetensors",
            "scipy",
            "tensorboard",
        ),
        *("torch", "typer", "xarray", "xxhash"),
    }
)
#: time (ns) after a change of a file during which a second change may leave its time stamp as it is
_SETTLED = 2_000_000_000
_REQUIRED = re.compile(r"^Requires-Dist: *([\w.-]+)(.*)$", re.MULTILINE)
_OF_AN_EXTRA = re.compile(r";.*\bextra *==")
_PROGRAM = "neusee"
_LEFT_OUT = (".pyc", ".pyo", ".pyi", ".pth")


class Content(NamedTuple):
    """The digest of the files of a distribution, and the time of the newest change of a file
    (ns).
    """

    digest: str
    changed: int


class Counted(NamedTuple):
    """The contribution to a digest of the packages behind an imported module."""

    parts: Parts
    edited: str  #: name of a package whose files were changed after its import, or an empty text


def counted(module: str, version: str) -> Counted:
    """Return the contribution of an imported module of an installed package: its distributions, and
    the distributions that they require.

    ``version`` alone counts if neusee declares the package.
    """
    top_package = module.partition(".")[0]
    distributions = module_origin.distributions_with(top_package)
    if not distributions or BY_VERSION.issuperset(map(module_origin.plain, distributions)):
        return Counted({f"package {top_package}": {"version": version}}, "")
    return _counted(top_package, version)


@functools.cache
def _counted(top: str, version: str) -> Counted:
    """Return the contribution of a top-level module whose package neusee does not declare. The
    first result holds for the whole process.
    """
    own_distributions = [
        module_origin.plain(name) for name in module_origin.distributions_with(top)
    ]
    content_of = {name: _content(name, top) for name in own_distributions}
    package_parts = {
        f"package {top}": {"version": version, "content": _joined(content_of.values())}
    }
    newest_change = max(content.changed for content in content_of.values())
    # the process still computes with the files as they were at the import
    edited_package = top if top in sys.modules and newest_change > import_time(top) else ""
    for name in sorted(_required(own_distributions)):
        version_and_content = {"version": module_origin.released(name)}
        if name not in BY_VERSION:
            version_and_content["content"] = _content(name, name).digest
        package_parts.setdefault(f"package {name}", version_and_content)
    return Counted(package_parts, edited_package)


def _joined(contents: Iterable[Content]) -> str:
    """Return the digests of some distributions as one text."""
    return " ".join(content.digest for content in contents)


def _required(names: Iterable[str]) -> set[str]:
    """Return the installed distributions that some distributions require, directly or indirectly,
    without optional extras.

    The requirements of a package that neusee declares do not count, just as when a node imports
    that package.
    """
    given_names = set(names)
    distributions, names_left = set(given_names), [*given_names]
    while names_left:
        # the fields end at the first empty line, where the description begins
        metadata_head = (
            module_origin.metadata_text(names_left.pop(), "METADATA")
            .decode(errors="replace")
            .partition("\n\n")[0]
        )
        for name, marker in _REQUIRED.findall(metadata_head):
            requirement = module_origin.plain(name)
            if (
                requirement in distributions
                or _OF_AN_EXTRA.search(marker)
                or requirement == _PROGRAM
                or not module_origin.released(requirement)
            ):
                continue
            distributions.add(requirement)
            if requirement not in BY_VERSION:
                names_left.append(requirement)
    return distributions - given_names


def _content(name: str, top: str) -> Content:
    """Return the digest of the files of a distribution. ``top`` is the name of its module, used if
    no record lists its files.

    The digest is stored under the stamps of the files, so that the next process need not read them.
    """
    files = sorted(_files(name, top).items())
    stamps = [(path, _content_stamp(file)) for path, file in files]
    # the last two numbers of a stamp are its times in ns
    newest_change = max((max(stamp[-2:]) for _, stamp in stamps if stamp), default=0)
    stamp_digest = xxhash.xxh3_128_hexdigest(repr([name, stamps]).encode(errors="replace"))
    if stamp_digest in known_contents:
        return Content(known_contents[stamp_digest], newest_change)
    hasher = xxhash.xxh3_128()
    for path, file in files:
        hasher.update(path.encode(errors="replace") + b"\0" + _digest_of(file) + b"\n")
    # a file that has just changed may change again within its stamp
    if time.time_ns() - newest_change > _SETTLED:
        known_contents[stamp_digest] = hasher.hexdigest()
    return Content(hasher.hexdigest(), newest_change)


def _files(name: str, top: str) -> dict[str, str]:
    """Return the full path of each file that may be code of a distribution or be read by it, by the
    path within the distribution.

    These are the files in the record of its installation, and modules that lie in its packages
    without a record.
    """
    package_folder = os.path.dirname(module_origin.metadata_folder(name))
    record_text = module_origin.metadata_text(name, "RECORD").decode(errors="replace")
    recorded_paths = list(_recorded(record_text))
    if recorded_paths:
        paths = [*recorded_paths, *_modules_in_packages(package_folder, recorded_paths)]
    else:
        modules = [entry for entry in os.listdir(package_folder) if entry.partition(".")[0] == top]
        paths = [*filter(_is_module, modules), *_below(package_folder, top)]
    return {path: os.path.join(package_folder, path) for path in paths}


def _modules_in_packages(site: str, recorded: Iterable[str]) -> Iterator[str]:
    """Yield the modules in the folders of the recorded packages, whether they are recorded or
    not.
    """
    folders = {path.rpartition("/")[0] for path in recorded if path.endswith("/__init__.py")}
    outermost = [folder for folder in folders if folder.rpartition("/")[0] not in folders]
    for package in sorted(outermost):
        yield from filter(_is_module, _below(site, package))


def _recorded(record: str) -> Iterator[str]:
    """Yield the files that a record lists, without metadata, byte code, and scripts outside of the
    folder of packages.
    """
    for line in record.splitlines():
        # "path,hash,size", where the path may have commas
        path = line.rsplit(",", 2)[0].strip('"').replace("\\", "/")
        is_no_code = path.startswith(("..", "/")) or path.partition("/")[0].endswith(
            (".dist-info", ".data")
        )
        if path and not is_no_code and not path.endswith(_LEFT_OUT):
            yield path


def _below(site: str, package: str) -> Iterator[str]:
    """Yield the files in the folder of a package, with paths as a record writes them."""
    for folder, subfolders, files in os.walk(os.path.join(site, package)):
        # changed in place, so that os.walk skips these folders
        subfolders[:] = [subfolder for subfolder in subfolders if subfolder != "__pycache__"]
        relative_folder = os.path.relpath(folder, site)
        yield from (f"{relative_folder}/{file}" for file in files if not file.endswith(_LEFT_OUT))


def _is_module(file: str) -> bool:
    """Return True for a file of Python source or a compiled module."""
    return file.endswith((".py", ".so", ".pyd"))


def _content_stamp(file: str) -> Stamp:
    """Return numbers that change whenever a file changes, the times of content and entry last; an
    empty tuple for a missing file.
    """
    try:
        return file_stamp(file)
    except OSError:
        return ()


def _digest_of(file: str) -> bytes:
    """Return the digest of the content of a file, or ``b"missing"``."""
    try:
        with opened(file) as content:
            return hashlib.file_digest(content, xxhash.xxh3_128).digest()
    except OSError:
        return b"missing"


# --- loaded source --------------------------------------------------------------------------------

# Source of a loaded module. Its file is read once, and a warning reports a file that was edited
# after the import.
#
# Python runs the code that it loaded, whatever the file contains later. So the first reading holds
# for the whole process.


_edited_since: set[str] = set()  #: loaded modules whose source was edited after the import
#: import spec, source and digest of the source at the first reading, by module
_frozen: dict[str, tuple[Any, bytes, str]] = {}
_said: set[tuple[str, str]] = set()  #: module and text of the warnings that this process has given


def source_of(module: str, path: Path) -> tuple[bytes, str]:
    """Return the source of a module and its xxh3 digest; a loaded module is read only once.

    Warn if the source was edited after the import of the module.
    """
    spec = getattr(sys.modules.get(module), "__spec__", None)
    # the same spec: the module was not loaded again since
    if module in _frozen and _frozen[module][0] is spec and spec is not None:
        return _frozen[module][1:]
    source = path.read_bytes()
    source_and_digest = source, xxhash.xxh3_128_hexdigest(source)
    _edited_since.discard(module)
    # a loaded module: the first reading holds
    if spec is not None:
        _frozen[module] = (spec, *source_and_digest)
        if _edited(module, spec, path):
            _edited_since.add(module)
            say_once(
                module, f"{path} was edited after its import: restart Python to reuse new results"
            )
    return source_and_digest


def edited_since(module: str) -> bool:
    """Return True if the source of a loaded module was edited after the import."""
    return module in _edited_since


def imported(module: str) -> bool:
    """Import a module that a function would import later, so that its values count now. Return True
    if it is loaded.
    """
    if module not in sys.modules:
        with suppress(Exception):
            importlib.import_module(module)
    return module in sys.modules


def compiled_as_written(module: str) -> bool:
    """Return True if the loader of a module compiles the source unchanged; a loader that rewrites
    assertions does not.
    """
    return type(getattr(sys.modules.get(module), "__loader__", None)) is SourceFileLoader


def say_once(module: str, text: str) -> None:
    """Warn that results of a module are not stored, once for each module and text."""
    if (module, text) not in _said:
        _said.add((module, text))
        warnings.warn(text, stacklevel=2)


def _edited(module: str, spec: Any, path: Path) -> bool:
    """Return True if a source file was changed after the import of its module began, or after
    Python wrote its byte code.
    """
    file_status = os.stat(path)
    # the file was changed after the import
    if file_status.st_ctime_ns > import_time(module):
        return True
    try:
        with open(spec.cached or "", "rb") as file:
            # the head of byte code: magic number, flags, time and size of the source
            byte_code_head = file.read(16)
        writable = os.access(os.path.dirname(spec.cached), os.W_OK) and not sys.dont_write_bytecode
    except OSError:
        return False
    # the form in which byte code states time and size of its source, 4 bytes each
    source_stamp = b"".join(
        (int(n) & 0xFFFFFFFF).to_bytes(4, "little")
        for n in (file_status.st_mtime, file_status.st_size)
    )
    # bytes 4 to 8 are 0: the byte code names its source by a stamp and not by a digest
    return writable and byte_code_head[4:8] == bytes(4) and byte_code_head[8:] != source_stamp


# --- module look ----------------------------------------------------------------------------------

# The contribution of one module to the digest of a node, and the digest of a module with all
# modules that it imports.


OURS = frozenset({"neusee"})  #: packages that are followed by source for a node of neusee
#: names that are used of each module; an empty name stands for the whole module
Names = dict[str, set[str]]


class Look(NamedTuple):
    """The contribution of one module to a digest, and the modules that it leads to."""

    parts: Parts
    imports: Names
    summary: Summary | None = None  #: None unless the module counts by its source
    path: Path | None = None
    state: str = ""
    #: reason for each loaded object that no digest can cover, such as a generator, by name
    changing: Mapping[str, str] = {}
    private: bool = False  #: True if the loaded code is not that of the file


class Whole(NamedTuple):
    """The digest of a module with all modules that it imports."""

    code: str
    looks: dict[str, Look]
    names: Names
    parts: Parts


def parts_of(looks: dict[str, Look]) -> Parts:
    parts: Parts = {}
    for look in looks.values():
        parts.update(look.parts)
    return parts


def digest_of(look: Look, documents: bool) -> list[Any]:
    """Return the contribution of a module to the digest of a node; with ``documents`` its
    docstrings count.
    """
    if look.summary is None:
        return [look.parts]
    syntax_digest = look.summary.whole if documents else look.summary.tree
    declared_parts = {
        name: content
        for name, content in look.parts.items()
        if name.startswith(("file ", "environment "))
    }
    return [syntax_digest, look.state, declared_parts]


def installed_look(module: str, version: str, packages: frozenset[str]) -> Look:
    """Return the contribution of a module of an installed package. Without a version the package
    counts as not installed.
    """
    if not version or packages == OURS:
        return Look(
            {f"package {module.partition('.')[0]}": {"version": version or "not installed"}}, {}
        )
    package = counted(module, version)
    if package.edited:
        say_once(
            module,
            f"the package {package.edited} was changed after its import: restart Python to store"
            " results",
        )
    return Look(package.parts, {}, private=bool(package.edited))
