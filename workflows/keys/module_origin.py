"""Origin of an imported module: Python itself, an installed distribution with its version, or a
source file.

The digest covers a module of an installed distribution by the version alone. A module of the
user, of an editable install, or of a package that has nodes is covered by its source.
"""

from __future__ import annotations

import functools
import importlib.machinery
import importlib.util
import os
import re
import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

Kind = Literal["python", "distribution", "source", "binary", "folder", "absent", "nowhere"]
_STANDARD = tuple({sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib")})
_INSTALLED = frozenset({"site-packages", "dist-packages"})
_fixed: dict[str, Origin] = {}  #: origins of packages that do not change while a process runs
#: names in the folders of packages, as they were at the last `look_again`
_listed: dict[str, frozenset[str]] = {}
_ENDS = (".py", *importlib.machinery.EXTENSION_SUFFIXES)
#: names of distributions by module, where both names differ
distributions_of: dict[str, list[str]] = {}
#: distributions whose version ends with the build, such as ``+cu124``, which depends on the device
_BUILD_IN_VERSION = frozenset({"torch"})


class Origin(NamedTuple):
    """Where the code of a module is from."""

    kind: Kind
    path: Path | None = None  #: the source file, or the compiled module
    version: str = ""  #: name and version of a distribution


def origin_of(module: str, packages: frozenset[str]) -> Origin:
    """Return the origin of a module without importing it; installed ``packages`` count by their
    source.
    """
    top_package = module.partition(".")[0]
    counts_by_source = top_package in packages
    # the origin of Python and of installed packages stays the same
    if top_package in _fixed and not counts_by_source:
        return _fixed[top_package]
    if _is_of_python(top_package):
        return _fixed.setdefault(top_package, Origin("python"))
    if module != top_package and not counts_by_source:
        package = origin_of(top_package, packages)
        if package.kind == "distribution":
            return package
    file = _stated_or_searched(module, top_package)
    if file is None:
        return _without_file(module, top_package, counts_by_source)
    version = "" if counts_by_source else _version_at(file, top_package)
    if version:
        return _fixed.setdefault(top_package, Origin("distribution", None, version))
    return _of_file(Path(file))


def _is_of_python(top: str) -> bool:
    """Return True for a module of the standard library, unless another file of the same name hides
    it.
    """
    if top in ("builtins", "__future__"):
        return True
    return top in sys.stdlib_module_names and not _shadowed(top)


def _stated_or_searched(module: str, top: str) -> str | None:
    """Return the path of the file of a module. For an installed package, its own ``__file__`` is
    taken.
    """
    if module == top:
        file: str | None = getattr(sys.modules.get(module), "__file__", None)
        if file is not None and _is_installed(file):
            return file
    return module_path(module)


def _version_at(file: str, top: str) -> str:
    """Return name and version of the distribution that contains a file, or an empty text."""
    return version_of(top) if _is_installed(file) else ""


def _of_file(path: Path) -> Origin:
    """Return the origin of a module with a file of its own: source or compiled."""
    return Origin("source", path) if path.suffix == ".py" else Origin("binary", path)


def _is_installed(file: str) -> bool:
    """Return True if a file is in a folder of distributions, such as one that ``pip install
    --target`` filled.
    """
    return any(
        _holds_distributions(str(folder))
        for folder in Path(file).parents
        # only folders that imports search
        if str(folder) in sys.path
    ) or (not _INSTALLED.isdisjoint(Path(file).parts))


@functools.cache
def _holds_distributions(folder: str) -> bool:
    """Return True for a folder of installed packages."""
    if not _INSTALLED.isdisjoint(Path(folder).parts):
        return True
    return os.path.isdir(folder) and any(name.endswith(".dist-info") for name in os.listdir(folder))


def module_path(module: str) -> str | None:
    """Return the path of the file of a module, or None. A loaded module states its file; for any
    other module the file is searched.
    """
    if module in sys.modules:
        file = getattr(sys.modules[module], "__file__", None)
        return file if file and os.path.isfile(file) else None
    parent, _, name = module.rpartition(".")
    if not parent:
        spec = _spec(module)
        if spec is None or not spec.has_location or not os.path.isfile(spec.origin or ""):
            return None
        return spec.origin
    # the first folder that contains the module
    return next(filter(None, (_file_in(folder, name) for folder in _folders_above(module))), None)


def source_file(module: str) -> Path | None:
    """Return the source file of a module without importing the module, or None if there is no
    source file.
    """
    path = module_path(module)
    return Path(path) if path else None


def module_file(folder: str | Path, names: Sequence[str]) -> Path | None:
    """Return the source file of a module or package below a folder, or None if there is no such
    file.

    ``names`` are the parts of the module's name.
    """
    stem = os.path.join(folder, *names)
    files = (f"{stem}.py", os.path.join(stem, "__init__.py"))
    return next((Path(file) for file in files if os.path.isfile(file)), None)


def version_of(top: str) -> str:
    """Return name and version of the distribution that contains a top-level module, or an empty
    text.
    """
    return ", ".join(map(released, distributions_with(top)))


def distributions_with(top: str) -> list[str]:
    """Return the names of the distributions that contain a top-level module."""
    if released(top):
        return [top]
    if top not in distributions_of or not all(map(released, distributions_of[top])):
        distributions_of[top] = _distributions(top)
    return distributions_of[top]


def released(name: str) -> str:
    """Return name and version of an installed distribution, or an empty text."""
    version = _releases().get(plain(name), ("", ""))[0]
    if name in _BUILD_IN_VERSION:
        version = version.partition("+")[0]
    return version and f"{name} {version}"


def metadata_folder(name: str) -> str:
    """Return the folder with the metadata of an installed distribution, or an empty text."""
    return _releases().get(plain(name), ("", ""))[1]


def metadata_text(name: str, file: str) -> bytes:
    """Return the bytes of a metadata file of an installed distribution; empty if it has no such
    file.
    """
    return _text(metadata_folder(name), file)


def plain(name: str) -> str:
    """Return the normalised name of a distribution: lower case, with ``_`` for each separator."""
    return re.sub(r"[-_.]+", "_", name).lower()


@functools.cache
def _releases() -> dict[str, tuple[str, str]]:
    """Return version and metadata folder of each installed distribution, taken from the names of
    these folders.
    """
    releases: dict[str, tuple[str, str]] = {}
    for folder in _metadata():
        # the folder "name-version.dist-info"
        name, _, version = os.path.basename(folder).removesuffix(".dist-info").partition("-")
        releases.setdefault(plain(name), (version, folder))
    return releases


def _metadata() -> Iterator[str]:
    """Yield the folder with the metadata of each installed distribution."""
    for folder in filter(os.path.isdir, sys.path):
        if _holds_distributions(folder):
            yield from (
                os.path.join(folder, name)
                for name in os.listdir(folder)
                if name.endswith(".dist-info")
            )


def _distributions(top: str) -> list[str]:
    """Return the names of the distributions that contain a top-level module."""
    # a line of RECORD for a file in the package, or for the module as one file
    line_of_module = re.compile(
        rb'^"?%s(/|\.py,|\.[^/,]*(so|pyd),)' % re.escape(top.encode()), re.MULTILINE
    )
    folders = [folder for folder in _metadata() if _contains(folder, top, line_of_module)]
    names = (
        re.search(
            r"^Name: *(.*?)\s*$", _text(folder, "METADATA").decode(errors="replace"), re.MULTILINE
        )
        for folder in folders
    )
    return sorted({name[1] for name in names if name})


def _contains(folder: str, top: str, inside: re.Pattern[bytes]) -> bool:
    """Return True if a distribution lists a top-level module, or has a file inside it."""
    names = _text(folder, "top_level.txt").decode(errors="replace").split()
    return top in names if names else inside.search(_text(folder, "RECORD")) is not None


def _text(folder: str, name: str) -> bytes:
    """Return the bytes of a file in a folder; empty if it cannot be read."""
    try:
        with open(os.path.join(folder, name), "rb") as file:
            return file.read()
    except OSError:
        return b""


def contents(module: str) -> Mapping[str, Any]:
    """Return the attributes of a loaded module without calling its own code; ``sys.modules`` may
    contain any object.
    """
    return getattr(sys.modules[module], "__dict__", {})


def _without_file(module: str, top: str, counts_by_source: bool) -> Origin:
    """Return the origin of a module without a file: a folder of modules, a module made at run time,
    or a missing module.
    """
    if module in sys.modules:
        return _loaded_without_file(module, top, counts_by_source)
    if module == top:
        spec = _spec(module)
        if spec is None:
            return Origin("absent")
        return Origin("nowhere") if spec.has_location else Origin("folder")
    above_are_folders = all(map(os.path.isdir, _folders_above(module)))
    return Origin("absent") if above_are_folders else Origin("nowhere")


def _loaded_without_file(module: str, top: str, counts_by_source: bool) -> Origin:
    """Return the origin of a loaded module without a file: a folder of modules, or a module that a
    package made at run time.
    """
    module_attributes = contents(module)
    if module_attributes.get("__path__") is not None and not module_attributes.get("__file__"):
        return Origin("folder")
    # a package that counts by its source has no version here; a top-level module without a file was
    # made by no package
    version = "" if counts_by_source or module == top else version_of(top)
    return Origin("distribution", None, version) if version else Origin("nowhere")


def _folders_above(module: str) -> list[str]:
    """Return the folders of the package that contains a module."""
    parent = module.rpartition(".")[0]
    return list(contents(parent).get("__path__", ())) if parent in sys.modules else _folders(parent)


def _folders(package: str) -> list[str]:
    """Return the folders of a package that is not loaded."""
    parent, _, name = package.rpartition(".")
    if not parent:
        spec = _spec(package)
        return list(spec.submodule_search_locations or ()) if spec is not None else []
    paths = [os.path.join(folder, name) for folder in _folders_above(package)]
    return list(filter(os.path.isdir, paths))


def _spec(top: str) -> importlib.machinery.ModuleSpec | None:
    """Return the import spec of a top-level module, or None."""
    try:
        return importlib.util.find_spec(top)
    except (ValueError, ImportError):
        return None


def _file_in(folder: str, name: str) -> str | None:
    """Return the file of a module in a folder, or None."""
    if folder not in _listed:
        names = os.listdir(folder) if os.path.isdir(folder) else []
        _listed[folder] = frozenset(names)
    if name in _listed[folder]:
        file = module_file(folder, [name])
        if file is not None:
            return str(file)
    # this also finds compiled modules
    return next(
        (os.path.join(folder, name + end) for end in _ENDS if name + end in _listed[folder]), None
    )


def look_again() -> None:
    """Forget the listings of folders, because there may be new files."""
    _listed.clear()


def _shadowed(top: str) -> bool:
    """Return True if the loaded module with a name of the standard library comes from a file
    outside of the standard library.
    """
    file = getattr(sys.modules.get(top), "__file__", None)
    return bool(file) and (not str(file).startswith(_STANDARD) or _is_installed(str(file)))


_releases()  # now, because a process may lose the right to read the folders later
