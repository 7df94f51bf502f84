"""Environment variables: which of them need no declaration, and how the others are hidden from
libraries while code of the user runs.

A key covers the variables that code of the user declares. It does not cover what a library reads by
itself, such as the name of a backend. So a library finds such a variable unset, whatever its value,
unless it is declared: ``depends=["env:NAME"]``. Code of the user always finds the true value, and a
variable that it reads without a declaration is noted.
"""

from __future__ import annotations

import functools
import os
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from neusee.workflows.observation import python_watch
from neusee.workflows.observation.covered_paths import is_installed, is_of_neusee

# --- known variables ------------------------------------------------------------------------------

# Variables that affect no result, or whose effect is covered by keys.


_COUNTED = ("OMP", "MKL", "OPENBLAS", "NUMEXPR")
_OF_LOCALE = ("ALL", "CTYPE", "NUMERIC", "TIME", "COLLATE", "MESSAGES", "MONETARY")
OF_THREADS = (*(f"{name}_NUM_THREADS" for name in _COUNTED), "VECLIB_MAXIMUM_THREADS")
OF_LANGUAGES = ("LANG", "LANGUAGE", *(f"LC_{name}" for name in _OF_LOCALE))
_USER_VARIABLES = ("HOME", "USER", "LOGNAME", "USERNAME")
_FOLDER_VARIABLES = ("PATH", "VIRTUAL_ENV", "TMPDIR", "TZ", "TZDIR", "LOCPATH")
_KNOWN_NAMES = frozenset({*_FOLDER_VARIABLES, *OF_THREADS, *OF_LANGUAGES, *_USER_VARIABLES})
_OF_PROGRAMS = (
    "LD_",
    "DYLD_",
    "PYTHON",
    "CONDA",
    "XDG_",
    "NEUSEE_",
    "GLIBC_",
    "MALLOC_",
    "TORCH",
    "PYTORCH",
)
_OF_DEVICES = ("CUDA", "NVIDIA", "HIP", "ROCM", "OMP_", "GOMP_", "KMP_", "MKL_", "OPENBLAS_")
#: variables of terminals and windows, which many libraries read
_TERMINALS = ("COLUMNS", "LINES", "TERM", "COLORTERM", "NO_COLOR", "FORCE_COLOR", "CI", "PWD")
OF_WINDOWS = frozenset({*_TERMINALS, "DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND"})


def is_known(name: str) -> bool:
    """Return True for a variable that affects no result, or whose effect is covered by keys."""
    return name in _KNOWN_NAMES or name.startswith((*_OF_PROGRAMS, *_OF_DEVICES))


# --- hidden variables -----------------------------------------------------------------------------

ALL = "(all of them)"  #: stands for the name if code reads all variables
_IMPORT = "<frozen importlib"  #: beginning of the file name of Python's own import code


@dataclass
class Asked:
    """Variables that code has read and that no key covers."""

    #: variables that are set, and were hidden from the library that read them
    of_libraries: dict[str, None] = field(default_factory=dict)
    #: variables that code of the user read, set or not
    of_own_code: dict[str, None] = field(default_factory=dict)


class _Shown(dict[bytes, bytes]):
    """The variables that libraries can read. A hidden variable is found or not depending on whose
    code reads it.
    """

    def __init__(
        self, environment: Mapping[bytes, bytes], declared: frozenset[str], asked: Asked
    ) -> None:
        super().__init__(
            {
                name: value
                for name, value in environment.items()
                if is_shown(os.fsdecode(name), declared)
            }
        )
        self.hidden = {name: value for name, value in environment.items() if name not in self}
        self._declared, self._asked = declared, asked

    def __missing__(self, name: bytes) -> bytes:
        """Return the value of a hidden variable to code of the user and of neusee; raise `KeyError`
        for a library.
        """
        asker, variable = _who_asks(), os.fsdecode(name)
        # hidden variables of terminals and windows are not reported
        if asker == "library" and name in self.hidden and variable not in OF_WINDOWS:
            self._asked.of_libraries[variable] = None
        # once all variables have been read, single names add nothing
        if (
            asker == "own"
            and not is_shown(variable, self._declared)
            and ALL not in self._asked.of_own_code
        ):
            self._asked.of_own_code[variable] = None
        if asker == "library" or name not in self.hidden:
            raise KeyError(name)
        return self.hidden[name]

    def __iter__(self) -> Iterator[bytes]:
        """Yield the names of all variables to code of the user and of neusee; for a library, omit
        the hidden ones.
        """
        asker = _who_asks()
        if asker == "own":
            self._asked.of_own_code[ALL] = None
        return iter([*self.keys(), *(() if asker == "library" else self.hidden)])


def is_shown(name: str, declared: frozenset[str]) -> bool:
    """Return True for a variable that every library can read."""
    return name in declared or is_known(name)


def hide_for_good(declared: frozenset[str]) -> Asked:
    """Hide variables from libraries in the rest of this process, which was forked; return the
    record of later reads.

    C libraries do not find them either.
    """
    asked_variables = Asked()
    shown = _show_few(declared, asked_variables)
    posix = sys.modules.get("posix")
    for name in shown.hidden:
        os.unsetenv(name)
        # a new import of `os` would read this dict
        if posix is not None:
            posix.environ.pop(name, None)
    return asked_variables


@contextmanager
def hidden_while_importing(declared: frozenset[str]) -> Iterator[Asked]:
    """Hide variables from the Python libraries that the ``with`` block imports."""
    asked_variables, environment_before = Asked(), _data(os.environ)
    shown_variables = _show_few(declared, asked_variables)
    try:
        yield asked_variables
    finally:
        _set_data(
            # variables set meanwhile are kept; hidden variables get their earlier values
            {**shown_variables.hidden, **shown_variables}
            | {
                name: value
                for name, value in environment_before.items()
                if name in shown_variables.hidden
            }
        )


def _show_few(declared: frozenset[str], asked: Asked) -> _Shown:
    """Make only the declared and the known variables visible to libraries; return them, together
    with the hidden ones.
    """
    shown = _Shown(_data(os.environ), declared, asked)
    _set_data(shown)
    return shown


def _data(environ: os._Environ[str]) -> dict[bytes, bytes]:
    """Return the dict behind ``os.environ``."""
    return environ._data  # type: ignore[attr-defined, no-any-return]


def _set_data(data: dict[bytes, bytes]) -> None:
    """Set the dict behind ``os.environ`` and ``os.environb``."""
    os.environ._data = data  # type: ignore[attr-defined]
    os.environb._data = data  # type: ignore[attr-defined]


# --- who asks -------------------------------------------------------------------------------------


def _who_asks() -> str:
    """Return whose code reads a variable: ``own`` (the user's), ``library`` or ``neusee``.
    Functions of the standard library count as their caller.

    A module of the standard library that reads a variable at its import counts as a library.
    """
    # frame 0 is this function, 1 the method of `_Shown`, 2 its caller
    frame = sys._getframe(2)
    while frame is not None:
        if frame.f_code.co_filename.startswith(_IMPORT):
            return "library"
        owner = _owner(frame.f_code.co_filename)
        if owner != "python":
            return owner
        frame = frame.f_back  # type: ignore[assignment]
    return "neusee"


@functools.cache
def _standard() -> tuple[str, ...]:
    """Return the folders of the standard library."""
    return tuple({_real(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")})


@functools.cache
def _owner(file: str) -> str:
    """Return to whom the code in a file belongs: python, neusee, library or own (the user's)."""
    # code without a file, such as the methods of a dataclass
    if file.startswith("<"):
        return "python"
    path = _real(file)
    if _is_of_python(path):
        return "python"
    if is_of_neusee(path):
        return "neusee"
    return "library" if is_installed(path) else "own"


def _real(file: str) -> str:
    """Return the real path of a file. During an observed call, this lookup is not recorded."""
    watch = python_watch.watch_here()
    if watch is None:
        return os.path.realpath(file)
    was_trusted = watch.trust(True)
    try:
        return os.path.realpath(file)
    finally:
        watch.trust(was_trusted)


def _is_of_python(path: str) -> bool:
    """Return True for a file of the standard library."""
    is_in_library = any(path.startswith(f"{folder}{os.sep}") for folder in _standard())
    return is_in_library and "site-packages" not in path and "dist-packages" not in path
