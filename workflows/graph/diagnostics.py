"""Diagnostics: the location of a value in a recipe, and one located line for each mistake."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True, order=True)
class Location:
    """A place in a file (lines and columns count from 1), or an argument such as ``argument 2`` (line 0)."""

    file: str  #: as the user knows the file: ``first_light.yaml``, ``sensor/neusee.yaml``
    line: int = 0
    column: int = 0
    folder: str = field(default=".", compare=False)  #: folder to which a relative path written here is relative

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file


@dataclass(frozen=True, slots=True, order=True)
class Diagnostic:
    """One mistake: its location, the path of the value, and the message with the fix."""

    mark: Location
    path: str
    message: str


class RecipeError(ValueError):
    """Error for a recipe that cannot be run; ``str`` gives one line for each mistake, in the order of the files."""

    def __init__(self, diagnostics: Iterable[Diagnostic]) -> None:
        self.diagnostics = tuple(sorted(set(diagnostics)))
        super().__init__(_table(self.diagnostics))


def _table(diagnostics: tuple[Diagnostic, ...]) -> str:
    where = max((len(str(p.mark)) for p in diagnostics), default=0)
    what = min(max((len(p.path) for p in diagnostics), default=0), 40)
    return "\n".join(f"{p.mark!s:<{where}}   {p.path:<{what}}   {p.message}" for p in diagnostics)


def nearest(name: str, among: Iterable[str]) -> str:
    """Return ``did you mean gain?``, else a list of the names, else ``there are none``."""
    names = sorted(set(map(str, among)))
    close = difflib.get_close_matches(str(name), names, 1, 0.6)
    if close:
        return f"did you mean {close[0]}?"
    return f"there are: {', '.join(names[:12])}{', …' if len(names) > 12 else ''}" if names else "there are none"
