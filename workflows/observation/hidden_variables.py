"""Variables of the environment that libraries do not have while own code runs, because no key
counts them.

A key has the variables that own code names or declares. What a library reads on its own, such as a
backend or a folder of settings, no key has: it finds the variable unset, whatever the environment
says, unless the code declares it, ``depends=["env:NAME"]``. Own code itself always finds the truth,
and what it reads without a declaration is noted.
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
from neusee.workflows.observation.known_variables import OF_WINDOWS, is_known

ALL = "(all of them)"  #: in place of a name, where code asks for all variables
_IMPORT = "<frozen importlib"  #: begins the name of the file of Python's own import


@dataclass
class Asked:
    """Variables that code asked for and no key has."""

    #: set, and hidden from the library that asked
    of_libraries: dict[str, None] = field(default_factory=dict)
    of_own_code: dict[str, None] = field(default_factory=dict)  #: set or not


class _Shown(dict[bytes, bytes]):
    """The variables that libraries have; who asks for another one decides whether it is found."""

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
        """Return a hidden variable to own code and to neusee; raise `KeyError` to a library."""
        who, text = _who_asks(), os.fsdecode(name)
        if who == "library" and name in self.hidden and text not in OF_WINDOWS:
            self._asked.of_libraries[text] = None
        if (
            who == "own"
            and not is_shown(text, self._declared)
            and ALL not in self._asked.of_own_code
        ):
            self._asked.of_own_code[text] = None
        if who == "library" or name not in self.hidden:
            raise KeyError(name)
        return self.hidden[name]

    def __iter__(self) -> Iterator[bytes]:
        """Yield the names of all variables to own code and to neusee, and of those that are not
        hidden to a library.
        """
        who = _who_asks()
        if who == "own":
            self._asked.of_own_code[ALL] = None
        return iter([*self.keys(), *(() if who == "library" else self.hidden)])


def is_shown(name: str, declared: frozenset[str]) -> bool:
    """Return True for a variable that each library has."""
    return name in declared or is_known(name)


def hide_for_good(declared: frozenset[str]) -> Asked:
    """Hide variables from libraries in the rest of this process, a fork; return what will be asked
    for.

    Libraries of C do not find them either.
    """
    asked = Asked()
    shown = _show_few(declared, asked)
    posix = sys.modules.get("posix")
    for name in shown.hidden:
        os.unsetenv(name)
        if posix is not None:
            posix.environ.pop(name, None)
    return asked


@contextmanager
def hidden_while_importing(declared: frozenset[str]) -> Iterator[Asked]:
    """Hide variables from the libraries of Python that the ``with`` block imports."""
    asked, before = Asked(), _data(os.environ)
    shown = _show_few(declared, asked)
    try:
        yield asked
    finally:
        _set_data(
            {**shown.hidden, **shown}
            | {name: value for name, value in before.items() if name in shown.hidden}
        )


def _show_few(declared: frozenset[str], asked: Asked) -> _Shown:
    shown = _Shown(_data(os.environ), declared, asked)
    _set_data(shown)
    return shown


def _data(environ: os._Environ[str]) -> dict[bytes, bytes]:
    return environ._data  # type: ignore[attr-defined, no-any-return]


def _set_data(data: dict[bytes, bytes]) -> None:
    os.environ._data = data  # type: ignore[attr-defined]
    os.environb._data = data  # type: ignore[attr-defined]


# --- who asks -------------------------------------------------------------------------------------


def _who_asks() -> str:
    """Return whose code asks: the nearest that is not of the standard library is ``own``,
    ``library`` or ``neusee``.

    A module of the standard library that asks while it is imported counts as a library.
    """
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
    if file.startswith("<"):
        return "python"
    path = _real(file)
    if _is_of_python(path):
        return "python"
    if is_of_neusee(path):
        return "neusee"
    return "library" if is_installed(path) else "own"


def _real(file: str) -> str:
    """Return the real path of a file; an observed call does not look for it itself."""
    watch = python_watch.watch_here()
    if watch is None:
        return os.path.realpath(file)
    before = watch.trust(True)
    try:
        return os.path.realpath(file)
    finally:
        watch.trust(before)


def _is_of_python(path: str) -> bool:
    inside = any(path.startswith(f"{folder}{os.sep}") for folder in _standard())
    return inside and "site-packages" not in path and "dist-packages" not in path
