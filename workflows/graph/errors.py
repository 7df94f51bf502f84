"""Errors of a recipe and of its run: each mistake with its location and the fix, and the failure
of a step.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Step


UNREAD = "unread"  #: code of a value to which no step refers
_BEFORE_NAMES = "there are: "  #: text before a list of known names


#: invisible characters that act on a terminal: they move the cursor, clear the screen, or reverse
#: the text
CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def visible(text: str) -> str:
    """Return a text with escapes such as ``\\x1b`` in place of characters that act on
    a terminal.
    """
    return CONTROL.sub(lambda match: ascii(match[0])[1:-1], text)


def shortened(text: str, characters: int) -> str:
    """Return a text cut to a number of characters; an ellipsis stands for the rest."""
    return text if len(text) <= characters else f"{text[: characters - 1]}…"


@dataclass(frozen=True, slots=True, order=True)
class Location:
    """Location of a recipe value: line and column in a file, counted from 1, or an argument of a
    command (line 0).
    """

    file: str  #: as shown to the user: ``first_light.yaml``, ``sensor/neusee.yaml``, ``argument 2``
    line: int = 0
    column: int = 0
    #: folder to which paths in the file are relative
    folder: str = field(default=".", compare=False)

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file


@dataclass(frozen=True, slots=True, order=True)
class Diagnostic:
    """One mistake in a recipe: its location, the path of the wrong value, and a message with the
    fix.
    """

    mark: Location
    path: str
    message: str
    #: kind of the mistake for programs, such as `UNREAD`
    code: str = field(default="", compare=False)


class RecipeError(ValueError):
    """Error for a recipe that cannot be run; the text of the error has one line for each
    mistake, in file order.
    """

    def __init__(self, diagnostics: Iterable[Diagnostic]) -> None:
        self.diagnostics = tuple(sorted(_of_values_once(set(diagnostics))))
        super().__init__(visible(_table(self.diagnostics)))


def _of_values_once(diagnostics: set[Diagnostic]) -> Iterator[Diagnostic]:
    """Yield the mistakes, without that of a setting whose value has the same mistake in a step: `a`
    beside `a = -1 m`.
    """
    mistakes_of_steps = {
        (mistake.mark, mistake.path.partition(" = ")[0])
        for mistake in diagnostics
        if " = " in mistake.path
    }
    yield from (
        mistake for mistake in diagnostics if (mistake.mark, mistake.path) not in mistakes_of_steps
    )


def _table(diagnostics: tuple[Diagnostic, ...]) -> str:
    """Return mistakes as lines with aligned columns: place, path, message."""
    mark_width = max((len(str(mistake.mark)) for mistake in diagnostics), default=0)
    # a long path does not push all messages to the right
    path_width = min(max((len(mistake.path) for mistake in diagnostics), default=0), 40)
    rows = zip(diagnostics, _lists_once(mistake.message for mistake in diagnostics), strict=True)
    return "\n".join(
        f"{mistake.mark!s:<{mark_width}}   {mistake.path:<{path_width}}   {message}"
        for mistake, message in rows
    )


def _lists_once(messages: Iterable[str]) -> Iterator[str]:
    """Yield messages, with a list of known names in the first message alone if many messages end
    with this list.
    """
    told_names = set[str]()
    for message in messages:
        text_before, separator, names = message.partition(_BEFORE_NAMES)
        yield (
            f"{text_before}see the names above"
            if separator and "," in names and names in told_names
            else message
        )
        told_names.add(names)


def nearest(name: str, among: Iterable[str]) -> str:
    """Return a hint with the known name most similar to ``name``, or with a list of known names
    if none is similar.
    """
    names = sorted(set(map(str, among)))
    # the best one, if 0.6 of its letters agree
    similar_names = difflib.get_close_matches(str(name), names, 1, 0.6)
    if similar_names:
        return f"did you mean {similar_names[0]}?"
    return (
        f"{_BEFORE_NAMES}{', '.join(names[:12])}{', …' if len(names) > 12 else ''}"
        if names
        else "there are none"
    )


# --- a step that failed in a run ------------------------------------------------------------------


class RunError(RuntimeError):
    """Error of a failed step, with the step, its node, its location in the recipe, its inputs
    and the cause.
    """

    def __init__(self, step: Step, inputs: Sequence[Any], cause: BaseException) -> None:
        self.step, self.cause = step.name, cause
        shapes = ", ".join(
            f"{name} {_shape(value)}" for name, value in zip(step.node.inputs, inputs, strict=False)
        )
        super().__init__(
            f"{step.mark}   {step.name} ({step.node.path}): {type(cause).__name__}: {cause}"
            + (f"\n  inputs: {shapes}" if shapes else "")
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # another process can make such an error from its texts
        can_be_sent = type(self.cause).__module__ == "builtins" and all(
            isinstance(argument, str) for argument in self.cause.args
        )
        return _unpickled, (self.step, str(self), self.cause if can_be_sent else repr(self.cause))


def _unpickled(step: str, text: str, cause: BaseException | str) -> RunError:
    """Return the `RunError` of another process, which keeps its text but not the traceback of
    its cause.
    """
    error = RunError.__new__(RunError, text)
    RuntimeError.__init__(error, text)
    error.step, error.cause = (
        step,
        cause if isinstance(cause, BaseException) else RuntimeError(cause),
    )
    return error


def _shape(value: Any) -> str:
    """Return the shape and type of an input as text."""
    from torch import Tensor  # the reader of a recipe needs its errors, but no torch

    if isinstance(value, Tensor):
        return f"{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}"
    if isinstance(value, list | tuple):
        return f"{type(value).__name__}[{', '.join(_shape(item) for item in value)}]"
    return "absent" if value is None else type(value).__name__
