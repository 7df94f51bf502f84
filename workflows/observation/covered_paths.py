"""Paths that a step may read without a taint: the program, Python with its packages, and files of
the system.

The key covers the versions of packages. The system is no input: each entry states the reason.
"""

from __future__ import annotations

import functools
import itertools
import os
import site
import sys
import sysconfig
import tempfile
from collections.abc import Iterable
from pathlib import Path

import neusee.nodes
from neusee.workflows.keys.sealed_files import bytes_of

#: folders and files of the system that libraries read by themselves, each with the reason why no
#: result depends on it
SYSTEM = {
    "/proc": "processes and memory, as the machine is now",
    "/sys": "processors and devices, as the machine is now",
    "/dev/null": "holds nothing",
    "/dev/zero": "holds zeros",
    "/dev/full": "holds zeros",
    "/dev/tty": "the terminal",
    "/dev/pts": "terminals",
    "/dev/ptmx": "terminals",
    "/dev/nvidia*": "the graphics processor, which the key names by its kind",
    "/dev/kfd": "the graphics processor",
    "/dev/dri": "the graphics processor",
    "/dev/infiniband": "links between graphics processors",
    **dict.fromkeys(
        ("/bin", "/sbin", "/lib*", "/usr/bin", "/usr/sbin"), "installed programs and libraries"
    ),
    **dict.fromkeys(
        ("/usr/lib*", "/usr/include", "/usr/local/lib*", "/usr/local/bin"), "installed libraries"
    ),
    "/usr/local/include": "installed libraries",
    **dict.fromkeys(("/usr/local/cuda*", "/System", "/Library/Frameworks"), "installed libraries"),
    "/usr/share": "time zones, languages, fonts and tables of installed programs",
    "/etc/ld.so.*": "where the libraries are",
    "/etc/alternatives": "which of several installed programs has a name",
    **dict.fromkeys(("/etc/localtime", "/etc/timezone"), "the time zone"),
    "/etc/locale*": "the language",
    **dict.fromkeys(("/etc/nsswitch.conf", "/etc/passwd", "/etc/group"), "names of users"),
    **dict.fromkeys(("/run/nscd", "/run/systemd/userdb"), "names of users, asked of a process"),
    **dict.fromkeys(
        ("/etc/hosts", "/etc/host.conf", "/etc/resolv.conf", "/etc/gai.conf"),
        "a connection is a taint",
    ),
    **dict.fromkeys(
        ("/etc/ssl", "/etc/pki", "/etc/crypto-policies"), "settings of ciphers, read with hashlib"
    ),
    "/etc/mime.types": "names of kinds of files",
    "/etc/fonts": "settings of fonts",
    "/etc/OpenCL": "where the driver of the graphics processor is",
    "/etc/nvidia*": "settings of the driver of the graphics processor",
    **dict.fromkeys(("/etc/os-release", "/etc/debian_version"), "the name of the system"),
}

#: files in the folders above that contain random numbers
CHANCE = ("/dev/random", "/dev/urandom", "/dev/hwrng", "/proc/sys/kernel/random")
_OF_PYTHON = (
    "lib",
    "lib64",
    "bin",
    "include",
    "share",
    "ssl",
    "conda-meta",
    "DLLs",
    "Library",
    "pyvenv.cfg",
)


@functools.cache
def program() -> tuple[str, ...]:
    """Return the real paths of the code of neusee, and of Python with its packages.

    A virtual environment may be made in the folder of a project, so only its parts count, not its
    whole folder.
    """
    prefixes = {sys.prefix, sys.base_prefix, sys.exec_prefix, sys.base_exec_prefix}
    parts_of_python = itertools.starmap(os.path.join, itertools.product(prefixes, _OF_PYTHON))
    paths = sysconfig.get_paths()
    package_folders = [paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    # the standard library as one file, for a Python built in this way
    zipped_library = os.path.join(
        sys.base_prefix, "lib", f"python{sys.version_info[0]}{sys.version_info[1]}.zip"
    )
    return (
        *_neusee(),
        *_real([*parts_of_python, *package_folders, zipped_library, site.getusersitepackages()]),
    )


@functools.cache
def _neusee() -> tuple[str, ...]:
    """Return the real paths of the code of the program itself."""
    package_files = [
        Path(neusee.__file__ or "").parent / name
        for name in ("__init__.py", "__main__.py", "__pycache__")
    ]
    return _real([*map(Path, neusee.nodes.__path__), Path(__file__).parents[1], *package_files])


def is_of_neusee(path: str) -> bool:
    """Return True for a file of the program."""
    return _is_below(path, _neusee())


def _cache() -> Path:
    """Return the cache folder of the user."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def decides(path: str) -> bool:
    """Return True for a file of settings that may change what a library does at its import.

    False in the cache folder, where libraries keep what they can make again, such as a list of
    fonts. False also if all lines are empty or comments, as in the file that dask writes for its
    user.
    """
    if _is_below(path, _real([_cache()])):
        return False
    try:
        return any(
            line.strip() and not line.lstrip().startswith(b"#")
            for line in bytes_of(path).splitlines()
        )
    except OSError:
        return True


def caches() -> tuple[str, ...]:
    """Return the folders in which libraries keep code compiled for this machine; no result depends
    on them.
    """
    home_folder, cache_folder = Path.home(), _cache()
    stated_folders = [
        os.environ[name] for name in ("CUDA_CACHE_PATH", "TRITON_CACHE_DIR") if os.environ.get(name)
    ]
    # the first is `folder` of neusee.nodes.cpp_library
    return _real(
        [
            cache_folder / "neusee" / "build",
            cache_folder / "torch" / "kernels",
            home_folder / ".nv",
            home_folder / ".triton",
            *stated_folders,
        ]
    )


def looked_at() -> tuple[str, ...]:
    """Return folders that always exist: the working folder, the folder of temporary files, and the
    home folder.
    """
    return _real([os.getcwd(), tempfile.gettempdir(), Path.home()])


@functools.cache
def _of_distributions(folder: str) -> bool:
    """Return True for a folder of installed packages, such as ``pip install --target`` fills."""
    try:
        return any(name.endswith(".dist-info") for name in os.listdir(folder))
    except OSError:
        return False


def is_installed(path: str) -> bool:
    """Return True for a file of the program, of Python, or of an installed package."""
    if _is_below(path, program()):
        return True
    return any(
        _is_below(path, [os.path.realpath(folder)])
        for folder in sys.path
        if folder and _of_distributions(folder)
    )


def is_of_system(path: str) -> bool:
    """Return True for a file of the system that no result depends on."""
    if is_chance(path):
        return False
    if any(_is_below(path, [entry]) for entry in _plain_entries()):
        return True
    return any(path.startswith(entry) for entry in _starts()) or _is_searched_library(path)


def is_chance(path: str) -> bool:
    """Return True for a file that contains random numbers."""
    return _is_below(path, CHANCE)


def _is_searched_library(path: str) -> bool:
    """Return True for the path of a library, existing or not, in a folder that ``LD_LIBRARY_PATH``
    lists.
    """
    folders = filter(None, os.environ.get("LD_LIBRARY_PATH", "").split(":"))
    return ".so" in os.path.basename(path) and _is_below(path, _real(folders))


def is_searched_program(path: str) -> bool:
    """Return True for the path of a program, existing or not, in a folder that ``PATH`` lists. A
    search there is no taint; running the program is one.
    """
    return os.path.dirname(path) in _real(
        filter(None, os.environ.get("PATH", "").split(os.pathsep))
    )


@functools.cache
def _plain_entries() -> tuple[str, ...]:
    """Return the entries of `SYSTEM` that name one file or folder."""
    return tuple(entry for entry in SYSTEM if not entry.endswith("*"))


@functools.cache
def _starts() -> tuple[str, ...]:
    """Return the beginnings of the paths in `SYSTEM` that end with a star."""
    return tuple(entry[:-1] for entry in SYSTEM if entry.endswith("*"))


def _is_below(path: str, folders: Iterable[str]) -> bool:
    """Return True if a path is one of the folders, or lies in one of them."""
    return any(path == folder or path.startswith(f"{folder}/") for folder in folders)


def _real(paths: Iterable[str | Path]) -> tuple[str, ...]:
    """Return the real path of each path, each once."""
    return tuple(dict.fromkeys(os.path.realpath(path) for path in paths))
