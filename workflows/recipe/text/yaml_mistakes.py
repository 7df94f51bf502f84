"""Sentences and places for a text that is not YAML, where a reader finds the mistake and not where the parser stops."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError, YAMLStreamError
from ruamel.yaml.tokens import ScalarToken

_VERSION = re.compile(r"%YAML\s+(\S+)\s*(#.*)?")


@dataclass(frozen=True)
class YamlMistake:
    """Place of a mistake in a text, counted from 0, and a sentence with the fix."""

    line: int
    column: int
    message: str


def directive_mistake(text: str) -> YamlMistake | None:
    """Return the mistake of a directive before the document, or None; a recipe is YAML 1.2, and has no tags.

    A parser of YAML 1.1 reads ``on`` as true and ``010`` as eight, so that a version is never ignored.
    """
    for number, line in enumerate(text.removeprefix("\ufeff").splitlines()):
        if not line.startswith("%"):
            if line.strip() and not line.lstrip().startswith("#"):
                return None
            continue
        version = _VERSION.fullmatch(line.rstrip())
        if version is None:
            name = line.split()[0]
            return YamlMistake(number, 0, f"the directive {name} has no meaning in a recipe: remove this line")
        if version[1] != "1.2":
            fix = "remove this line, and see that the file means the same in YAML 1.2 (on is a word, 010 is ten)"
            return YamlMistake(number, version.start(1), f"recipes are YAML 1.2, not {version[1]}: {fix}")
    return None


def explained(error: Exception, text: str) -> YamlMistake:
    """Return the mistake for an error that the YAML parser raised for a text."""
    if not isinstance(error, MarkedYAMLError) or not error.problem:
        return YamlMistake(*_first_control_character(text), "is not YAML: an invalid character")
    places = (_open_quote, _missing_space, _text_goes_on, _open_bracket)
    for mistake in (place(error, text) for place in places):
        if mistake is not None:
            return mistake
    line, column = _problem_place(error, text)
    lines = text.splitlines() or [""]
    here = lines[min(line, len(lines) - 1)]
    return YamlMistake(line, column, _sentence(error.problem, here, column))


def _problem_place(error: MarkedYAMLError, text: str) -> tuple[int, int]:
    mark = error.problem_mark
    return (mark.line, mark.column) if mark else _first_control_character(text)


def _open_quote(error: MarkedYAMLError, text: str) -> YamlMistake | None:
    """Return the mistake of a quote that is not closed in its line, at the place where it opens."""
    if "quoted scalar" in str(error.context) and error.context_mark and "end of stream" in str(error.problem):
        return YamlMistake(error.context_mark.line, error.context_mark.column, "a quote opens here and never closes")
    stop = _problem_place(error, text)[0]
    long = [token for token in _tokens(text) if _is_quoted_over_lines(token) and token.end_mark.line <= stop]
    if not long or long[-1].end_mark.line != stop:
        return None
    start = long[-1].start_mark
    message = f"the quote that opens here closes only in line {long[-1].end_mark.line + 1}: close it in its line"
    return YamlMistake(start.line, start.column, message)


def _is_quoted_over_lines(token: Any) -> bool:
    quoted = isinstance(token, ScalarToken) and token.style in ("'", '"')
    return quoted and bool(token.end_mark.line > token.start_mark.line)


def _tokens(text: str) -> Iterator[Any]:
    """Yield the tokens of a text up to the first that is no YAML."""
    try:
        yield from YAML(typ="safe", pure=True).scan(text)
    except (YAMLError, YAMLStreamError):
        return


def _missing_space(error: MarkedYAMLError, text: str) -> YamlMistake | None:
    """Return the mistake of a key without a space behind its colon, or of a line that is neither key nor value."""
    if "could not find expected ':'" not in str(error.problem) or not error.context_mark:
        return None
    return _unfinished_key(text, error.context_mark.line, error.context_mark.column)


def _unfinished_key(text: str, line: int, column: int) -> YamlMistake:
    """Return the mistake of a key at a place that no colon with a space follows."""
    written = (text.splitlines() or [""])[line][column:].split(" #")[0].strip()
    key, colon, value = written.partition(":")
    fix = f"write `{key}: {value}`" if colon and value else "write `key: value`"
    reason = "needs a space after the colon" if colon and value else "has no colon"
    return YamlMistake(line, column, f"{_short(written)} {reason}: {fix}")


def _text_goes_on(error: MarkedYAMLError, text: str) -> YamlMistake | None:
    """Return the mistake of a key that YAML reads as more of the text before it, which began on an earlier line.

    The text before is a key without a space behind its colon, such as ``seed:7``, or a value, and then the indent of
    the later key is wrong.
    """
    if "mapping values are not allowed" not in str(error.problem):
        return None
    line, column = _problem_place(error, text)
    before = "\n".join([*text.splitlines()[:line], text.splitlines()[line][:column]])
    scalars = [token for token in _tokens(before) if isinstance(token, ScalarToken)]
    if not scalars or scalars[-1].start_mark.line == line:
        return None
    start = scalars[-1].start_mark
    if not text.splitlines()[start.line][: start.column].strip(" -"):
        return _unfinished_key(text, start.line, start.column)
    indent = column - len(text.splitlines()[line][:column].lstrip())
    message = f"a wrong indent: as it stands, this line is more of the value in line {start.line + 1}"
    return YamlMistake(line, indent, message)


def _open_bracket(error: MarkedYAMLError, text: str) -> YamlMistake | None:
    """Return the mistake of a list or mapping in brackets that goes on past its line, where the bracket opens."""
    mark = error.context_mark
    if mark is None or not str(error.context).startswith("while parsing a flow"):
        return None
    if _problem_place(error, text)[0] == mark.line:
        return None
    bracket = (text.splitlines() or [""])[mark.line][mark.column : mark.column + 1]
    return YamlMistake(mark.line, mark.column, f"the {bracket} that opens here is not closed, or lacks a comma")


def _sentence(problem: str, here: str, column: int) -> str:
    """Return what to do about a problem of the parser in the line ``here``."""
    if "\\t" in problem or "\t" in here[: column + 1]:
        return "a tab: indent YAML with spaces"
    if re.search(r"[^\"']\$\{", here) and "expected" in problem:
        return 'inside { } or [ ], quote a reference: "${…}"'
    if re.search(r"\[[^\]]*\w\[", here) and "'['" in problem:
        return 'inside [ ], quote a name with brackets: "psf[mask]"'
    if "mapping values are not allowed" in problem:
        return "a second ':' on this line, or a wrong indent: quote the text, or begin a new line"
    if "but found another document" in problem:
        return "a second document (---): a recipe must be a single document"
    if "cannot start any token" in problem:
        return f"a text cannot begin with {here[column : column + 1]}: quote the text"
    if "expected '<document start>'" in problem:
        return "a line --- must follow %YAML: write it, or remove %YAML"
    if alias := re.search(r"found undefined alias '(.*)'", problem):
        return f"no value above has the anchor &{alias[1]}: refer to values with ${{…}}"
    if "expected <block end>" in problem:
        return _wrong_indent(problem, here)
    return f"is not YAML: {problem}"


def _wrong_indent(problem: str, here: str) -> str:
    """Return the sentence for a line that belongs to no mapping or list that is open, because of its indent."""
    indent = len(here) - len(here.lstrip(" "))
    if problem.endswith(("'<scalar>'", "'<alias>'", "'<tag>'")):
        return "text after the end of a value: quote the whole value, or begin a new line"
    return f"a wrong indent: the {indent} spaces before this line are those of no line above in the same block"


def _short(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:39]}…"


def _first_control_character(text: str) -> tuple[int, int]:
    """Return the line and column of the first control character in a text."""
    match = re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\ud800-\udfff\ufffe\uffff]", text)
    before = text[: match.start()] if match else ""
    return before.count("\n"), len(before.rpartition("\n")[2])
