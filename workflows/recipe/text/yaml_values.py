"""Values of YAML 1.2 with their locations, and sentences for a text that is not YAML."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError, YAMLStreamError
from ruamel.yaml.nodes import CollectionNode, MappingNode, Node, ScalarNode
from ruamel.yaml.tokens import ScalarToken

from neusee.workflows.graph.errors import CONTROL, Diagnostic, Location, RecipeError, visible
from neusee.workflows.keys.sealed_files import NotRegular, opened
from neusee.workflows.recipe.text.other_spellings import (
    ADVICE_ON_HEADER,
    advice_on_key,
    package_line,
)

# --- yaml mistakes --------------------------------------------------------------------------------

# Sentences and places for a text that is not YAML, where a reader finds the mistake and not where
# the parser stops.


_VERSION = re.compile(r"%YAML\s+(\S+)\s*(#.*)?")


@dataclass(frozen=True)
class YamlMistake:
    """Place of a mistake in a text, counted from 0, and a sentence with the fix."""

    line: int
    column: int
    message: str


def directive_mistake(text: str) -> YamlMistake | None:
    """Return the mistake of a directive before the document, or None; a recipe is YAML 1.2, and has
    no tags.

    A parser of YAML 1.1 reads ``on`` as true and ``010`` as eight, so that a version is never
    ignored.
    """
    for number, line in enumerate(text.removeprefix("\ufeff").splitlines()):
        if not line.startswith("%"):
            if line.strip() and not line.lstrip().startswith("#"):
                return None
            continue
        version = _VERSION.fullmatch(line.rstrip())
        if version is None:
            name = line.split()[0]
            return YamlMistake(
                number, 0, f"the directive {name} has no meaning in a recipe: remove this line"
            )
        if version[1] != "1.2":
            advice = (
                "remove this line, and check that the values mean the same in YAML 1.2 (on is a"
                " word, 010 is ten)"
            )
            return YamlMistake(
                number, version.start(1), f"recipes are YAML 1.2, not {version[1]}: {advice}"
            )
    return None


def explained(error: Exception, text: str) -> YamlMistake:
    """Return the mistake for an error that the YAML parser raised for a text."""
    if not isinstance(error, MarkedYAMLError) or not error.problem:
        return YamlMistake(*_first_control_character(text), "is not YAML: an invalid character")
    explanations = (_open_quote, _missing_space, _text_goes_on, _open_bracket)
    for mistake in (explanation(error, text) for explanation in explanations):
        if mistake is not None:
            return mistake
    line, column = _problem_place(error, text)
    lines = text.splitlines() or [""]
    line_text = lines[min(line, len(lines) - 1)]
    return YamlMistake(line, column, _sentence(error.problem, line_text, column))


def _problem_place(error: MarkedYAMLError, text: str) -> tuple[int, int]:
    """Return line and column of the problem, from 0.

    If the parser gives none, they are those of the first control character.
    """
    mark = error.problem_mark
    return (mark.line, mark.column) if mark else _first_control_character(text)


def _open_quote(error: MarkedYAMLError, text: str) -> YamlMistake | None:
    """Return the mistake of a quote that is not closed in its line, at the place where it opens."""
    if (
        "quoted scalar" in str(error.context)
        and error.context_mark
        and "end of stream" in str(error.problem)
    ):
        return YamlMistake(
            error.context_mark.line,
            error.context_mark.column,
            "a quote opens here and never closes",
        )
    problem_line = _problem_place(error, text)[0]
    quotes_over_lines = [
        token
        for token in _tokens(text)
        if _is_quoted_over_lines(token) and token.end_mark.line <= problem_line
    ]
    if not quotes_over_lines or quotes_over_lines[-1].end_mark.line != problem_line:
        return None
    start = quotes_over_lines[-1].start_mark
    message = (
        "the quote that opens here closes only in line"
        f" {quotes_over_lines[-1].end_mark.line + 1}: close the quote in the same line"
    )
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
    """Return the mistake of a key without a space behind its colon, or of a line that is neither
    key nor value.
    """
    if "could not find expected ':'" not in str(error.problem) or not error.context_mark:
        return None
    return _unfinished_key(text, error.context_mark.line, error.context_mark.column)


def _unfinished_key(text: str, line: int, column: int) -> YamlMistake:
    """Return the mistake of a key that no colon with a space follows."""
    key_and_value = (text.splitlines() or [""])[line][column:].split(" #")[0].strip()
    key, colon, value = key_and_value.partition(":")
    advice = f"write `{key}: {value}`" if colon and value else "write `key: value`"
    reason = "needs a space after the colon" if colon and value else "has no colon"
    return YamlMistake(line, column, f"{_short(key_and_value)} {reason}: {advice}")


def _text_goes_on(error: MarkedYAMLError, text: str) -> YamlMistake | None:
    """Return the mistake of a key that YAML reads as a continuation of a text from an earlier line.

    The text before is a key without a space behind its colon, such as ``seed:7``, or a value, and
    then the indent of the later key is wrong.
    """
    if "mapping values are not allowed" not in str(error.problem):
        return None
    line, column = _problem_place(error, text)
    text_before = "\n".join([*text.splitlines()[:line], text.splitlines()[line][:column]])
    scalars = [token for token in _tokens(text_before) if isinstance(token, ScalarToken)]
    if not scalars or scalars[-1].start_mark.line == line:
        return None
    value_start = scalars[-1].start_mark
    # nothing but list dashes before it: the value begins its line, so that it is a key without its
    # space
    if not text.splitlines()[value_start.line][: value_start.column].strip(" -"):
        return _unfinished_key(text, value_start.line, value_start.column)
    indent = column - len(text.splitlines()[line][:column].lstrip())
    message = (
        "a wrong indent: with this indent the line continues the value in line"
        f" {value_start.line + 1}"
    )
    return YamlMistake(line, indent, message)


def _open_bracket(error: MarkedYAMLError, text: str) -> YamlMistake | None:
    """Return the mistake of a list or mapping in brackets that goes on past its line, where the
    bracket opens.
    """
    mark = error.context_mark
    if mark is None or not str(error.context).startswith("while parsing a flow"):
        return None
    if _problem_place(error, text)[0] == mark.line:
        return None
    bracket = (text.splitlines() or [""])[mark.line][mark.column : mark.column + 1]
    return YamlMistake(
        mark.line, mark.column, f"the {bracket} that opens here is not closed, or lacks a comma"
    )


#: what to do, by a phrase in the problem of the parser
_SENTENCES = {
    "mapping values are not allowed": (
        "a second ':' in this line, or a wrong indent: quote the text, or begin a new line"
    ),
    "but found another document": "a second document (---): a recipe must be a single document",
    "expected '<document start>'": "a line --- must follow %YAML: write this line, or remove %YAML",
}


def _sentence(problem: str, here: str, column: int) -> str:
    """Return what to do about a problem of the parser in the line ``here``."""
    if "\\t" in problem or "\t" in here[: column + 1]:
        return "a tab: indent YAML with spaces"
    if advice := _advice_on_brackets(problem, here):
        return advice
    for phrase, sentence in _SENTENCES.items():
        if phrase in problem:
            return sentence
    if "cannot start any token" in problem:
        return f"a text cannot begin with {here[column : column + 1]}: quote the text"
    if alias := re.search(r"found undefined alias '(.*)'", problem):
        return f"no earlier value has the anchor &{alias[1]}: refer to values with ${{…}}"
    if "expected <block end>" in problem:
        return _wrong_indent(problem, here)
    return f"is not YAML: {problem}"


def _advice_on_brackets(problem: str, here: str) -> str:
    """Return what to quote within brackets in the line ``here``, or an empty text."""
    if re.search(r"[^\"']\$\{", here) and "expected" in problem:
        return 'inside { } or [ ], quote a reference: "${…}"'
    if re.search(r"\[[^\]]*\w\[", here) and "'['" in problem:
        return 'inside [ ], quote a name with brackets: "psf[mask]"'
    return ""


def _wrong_indent(problem: str, here: str) -> str:
    """Return the message for a line whose indent fits no open mapping or list."""
    indent = len(here) - len(here.lstrip(" "))
    if problem.endswith(("'<scalar>'", "'<alias>'", "'<tag>'")):
        return "text after the end of a value: quote the whole value, or begin a new line"
    return f"a wrong indent: no line above in the same block has the {indent} spaces of this line"


def _short(text: str) -> str:
    """Return a text with at most 40 characters, an ellipsis included."""
    return text if len(text) <= 40 else f"{text[:39]}…"


def _first_control_character(text: str) -> tuple[int, int]:
    """Return the line and column of the first control character in a text."""
    match = re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\ud800-\udfff\ufffe\uffff]", text)
    text_before = text[: match.start()] if match else ""
    return text_before.count("\n"), len(text_before.rpartition("\n")[2])


# --- yaml values ----------------------------------------------------------------------------------

# Values of YAML 1.2 with their locations: ``1e3`` is a number, ``on`` is a string, and ``010`` is
# the number ten.


Where = tuple[str | int, ...]  #: path of a value: keys and indices from the top of a recipe

_TAG = "tag:yaml.org,2002:"
_INT = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_LACKS_SPACE = re.compile(r"[\w.-]+:\S.*")
_PROPERTIES = re.compile(r"(?:[&!]\S*\s+)*(?:[&!]\S*)?")  #: anchor and tag before a value
_NULLS = ("", "~", "null", "Null", "NULL")
_BOOLEANS = ("true", "True", "TRUE", "false", "False", "FALSE")
_MOST_VALUES = 1_000_000  #: largest number of values in one file
_MOST_BYTES = 4_000_000  #: bytes of one file; 20 000 steps take about half of them
_DIGITS = 400  #: of a whole number, at most
_MOST_ALIASED_VALUES = 100_000  #: largest number of values from aliases in one file


@dataclass(frozen=True, slots=True, eq=False)
class Value:
    """A scalar, a list or a mapping from YAML, with the locations of its key and of the value."""

    data: Any  #: None, bool, int, float, str, list[Value] or dict[str | int, Value]
    mark: Location
    key: Location
    path: Where

    @property
    def name(self) -> str:
        return dotted(self.path)

    @property
    def plain(self) -> Any:
        """Return a YAML value as plain Python data, without the locations in the file."""
        if isinstance(self.data, dict):
            return {key: value.plain for key, value in self.data.items()}
        return [value.plain for value in self.data] if isinstance(self.data, list) else self.data

    @property
    def items(self) -> dict[Any, Value]:
        """Return the values in a YAML mapping or list by key or index; return an empty dict for
        a scalar.
        """
        if isinstance(self.data, dict):
            return self.data
        return dict(enumerate(self.data)) if isinstance(self.data, list) else {}

    def child(self, name: str | int) -> Value | None:
        """Return the value at a key or an index of a mapping or a list; an index may be written
        as a string.
        """
        items = self.items
        if name not in items and isinstance(name, str) and name.isdecimal():
            name = int(name)
        return (
            items[name]
            if name in items
            else next((value for key, value in items.items() if str(key) == str(name)), None)
        )

    def below(self, path: Iterable[str | int]) -> Value | None:
        """Return the value at a path of keys below this YAML value, or None if the path does not
        exist.
        """
        value: Value | None = self
        for name in path:
            value = value.child(name) if value else None
        return value

    def replaced(self, key: str | int, child: Value | None) -> Value:
        """Return a copy of a mapping or a list with ``child`` at a key, or without the key if
        ``child`` is None.
        """
        items = {
            item_key: value
            for item_key, value in self.items.items()
            if child is not None or item_key != key
        }
        if child is not None:
            items[key] = child
        if isinstance(self.data, list):
            return replace(
                self,
                data=[
                    replace(value, path=(*self.path, i)) for i, value in enumerate(items.values())
                ],
            )
        return replace(self, data=items)

    def without(self, key: str) -> Value:
        """Return a copy of a mapping without ``key``, or the mapping itself if it does not have
        the key.
        """
        return self.replaced(key, None) if key in self.items else self

    def leaves(self) -> Iterator[Value]:
        """Yield the scalars, lists and empty mappings in a mapping, at any depth and in order."""
        if not isinstance(self.data, dict) or not self.data:
            yield self
            return
        for value in self.data.values():
            yield from value.leaves()


@dataclass(frozen=True, slots=True)
class Document:
    """A YAML file: its top-level mapping, and its title, which is a comment in the first line."""

    root: Value
    title: str


def dotted(path: Where) -> str:
    return ".".join(map(str, path))


def read(path: Path, shown: str) -> Document:
    """Return the content of a YAML file; error messages name the file as ``shown``.

    Raises one `RecipeError` with all mistakes of the file.
    """
    try:
        with opened(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > _MOST_BYTES:
                message = (
                    f"the file has {size} bytes, more than the limit of {_MOST_BYTES}: split the"
                    " recipe into groups"
                )
                raise RecipeError([Diagnostic(Location(shown), "", message)])
            text = file.read(_MOST_BYTES).decode("utf-8-sig")
    except NotRegular as error:
        raise RecipeError([Diagnostic(Location(shown), "", str(error))]) from None
    except UnicodeDecodeError as error:
        valid_text = error.object[: error.start].decode("utf-8", "replace")
        mark = Location(shown, valid_text.count("\n") + 1, len(valid_text.rpartition("\n")[2]) + 1)
        raise RecipeError(
            [Diagnostic(mark, "", f"the byte 0x{error.object[error.start]:02x} is not UTF-8")]
        ) from None
    except OSError as error:
        raise RecipeError(
            [Diagnostic(Location(shown), "", f"the file cannot be read: {error.strerror}")]
        ) from None
    return _document(text, shown, str(path.parent))


@lru_cache(maxsize=256)
def _document(text: str, shown: str, folder: str) -> Document:
    """Return the mapping and the title in the text of a file; the result is cached."""
    root = parse(text, Location(shown, 1, 1, folder))
    if not isinstance(root.data, dict):
        problem = "the file is empty" if root.data is None else f"the file contains {kind(root)}"
        raise RecipeError(
            [Diagnostic(Location(shown, 1, 1), "", f"{problem}: write a mapping, `key: value`")]
        )
    line = package_line(text)
    if line is not None:
        raise RecipeError([Diagnostic(Location(shown, line + 1, 1), "", ADVICE_ON_HEADER)])
    return Document(root, title_of(text.lstrip()))


def title_of(text: str) -> str:
    """Return the title of a recipe: its first line without ``#``; empty if that is no comment."""
    first_line = text.partition("\n")[0].strip()
    return visible(first_line.lstrip("# ")) if first_line.startswith("#") else ""


def parse(text: str, start: Location, path: Where = ()) -> Value:
    """Return the values in a YAML text; ``start`` is the location of the text in a file, or an
    argument.
    """
    if text.rpartition("\n")[2].isspace():
        text += "\n"  # or the parser reads a last line of spaces as text of a block scalar
    builder = _Builder(start, text)
    if mistake := directive_mistake(text):
        raise RecipeError([_diagnostic(mistake, start, path)])
    try:
        node = YAML(typ="safe", pure=True).compose(text)
        value = (
            Value(None, start, start, path) if node is None else builder.value(node, path, start)
        )
    except RecursionError:
        raise RecipeError(
            [Diagnostic(start, dotted(path), "the YAML text is nested too deeply")]
        ) from None
    except (YAMLError, YAMLStreamError) as error:
        raise RecipeError([_diagnostic(explained(error, text), start, path)]) from None
    if builder.diagnostics:
        raise RecipeError(builder.diagnostics)
    return value


def _diagnostic(mistake: YamlMistake, start: Location, path: Where) -> Diagnostic:
    """Return the diagnostic for a mistake in a YAML text that begins at ``start``."""
    mark = (
        Location(start.file, mistake.line + 1, mistake.column + 1, start.folder)
        if start.line
        else start
    )
    return Diagnostic(mark, dotted(path), mistake.message)


def kind(value: Value) -> str:
    """Return the kind of a YAML value in words, such as ``a list``."""
    names = {
        dict: "a mapping",
        list: "a list",
        str: "a string",
        bool: "true or false",
        type(None): "nothing",
    }
    return names.get(type(value.data), "a number")


class _Builder:
    """Builder of the values in one YAML text; an alias becomes a copy of the value to which it
    refers.
    """

    def __init__(self, start: Location, text: str) -> None:
        self.start, self.text = start, text
        self.diagnostics: list[Diagnostic] = []
        self.built: dict[int, Value] = {}
        self.open: set[int] = set()
        self.size: dict[int, int] = {}
        self.aliased = 0  # number of values that come from aliases
        # of the block in which a value stands: -1 at the top, None within brackets
        self.column: int | None = -1

    def value(self, node: Node, path: Where, key: Location) -> Value:
        mark, tag = self._mark(node), (node.tag or "").replace(_TAG, "!!")
        if tag not in _KNOWN_TAGS:
            return self._refuse(mark, path, f"unknown YAML tag {tag}: remove the tag")
        # an alias is the same node again
        if id(node) in self.built:
            self.aliased += self.size[id(node)]
            self._refuse_many(self.aliased, _MOST_ALIASED_VALUES, mark, path)
            return replace(_moved(self.built[id(node)], path), key=key)
        if id(node) in self.open:
            message = "a YAML alias refers to the value that contains the alias"
            return self._refuse(mark, path, message)
        if fault := self._fault(node, tag):
            return self._refuse(mark, path, fault)
        if isinstance(node, ScalarNode):
            return Value(_scalar(node), mark, key, path)
        return self._collection(node, mark, key, path)

    def _collection(self, node: Node, mark: Location, key: Location, path: Where) -> Value:
        """Return the list or the mapping of a node."""
        outer_column = self.column
        self.column = None if _is_enclosed(node) else self._column(node)
        self.open.add(id(node))
        data: dict[str | int, Value] | list[Value]
        if isinstance(node, MappingNode):
            data = self._mapping(node, path)
        else:
            data = self._list(node, path)
        self.open.discard(id(node))
        self.column = outer_column
        value = self.built[id(node)] = Value(data, mark, key, path)
        self._weigh(node, value)
        return value

    def _column(self, node: Node) -> int:
        """Return the column of a block; -1, as of the top, where an anchor or a tag hides it."""
        is_hidden = self.text[node.start_mark.index] in "&!"
        return -1 if is_hidden else int(node.start_mark.column)

    def _fault(self, node: Node, tag: str) -> str:
        """Return what is wrong with a value that the parser reads differently from YAML 1.2, or
        that could harm a reader; or an empty text.
        """
        fault = _fault(str(node.value)) if isinstance(node, ScalarNode) else ""
        return fault or self._tag_fault(node, tag) or self._end_fault(node)

    def _tag_fault(self, node: Node, tag: str) -> str:
        """Return what is wrong with the tag that a text writes before a value."""
        properties = _PROPERTIES.match(self.text, node.start_mark.index)
        tags = [
            word for word in (properties[0].split() if properties else ()) if word.startswith("!")
        ]
        if not tags:
            return ""
        if tags == ["!"]:
            return "a ! without a name: remove it, and quote a text that looks like a number"
        return "" if _fits(node, tag) else f"the tag {tag} does not fit this value: remove the tag"

    def _end_fault(self, node: Node) -> str:
        """Return what is wrong with the lines of a value in quotes or brackets, and with what
        follows it.
        """
        if not _is_enclosed(node):
            return ""
        end_index = node.end_mark.index
        if self.text[end_index : end_index + 1] == "#":
            return "a comment needs a space before its #, after this value"
        if self.column is None:  # the check of the enclosing brackets covers all their lines
            return ""
        # many write a closing bracket, or a comment, under the key
        exempt_starts = "]}#" if isinstance(node, CollectionNode) else ""
        lines = self.text[node.start_mark.index : end_index].split("\n")
        # lines count from 1, and the first line of the value is left out
        for number, line in enumerate(lines[1:], node.start_mark.line + 2):
            text = line.strip()
            indent = len(line) - len(line.lstrip(" "))
            if text and indent <= self.column and text[0] not in exempt_starts:
                return f"indent line {number}, which is part of this value, with more spaces"
        return ""

    def _mapping(self, node: MappingNode, path: Where) -> dict[str | int, Value]:
        """Return the values of a mapping by key; report wrong, repeated and misspelt keys."""
        data: dict[str | int, Value] = {}
        is_advised = False  # one message for the keys of one object
        for key_node, value_node in node.value:
            mark, key = self._mark(key_node), _key(key_node)
            advice = advice_on_key(key, not path) if key is not None else ""
            if advice:
                if not is_advised:
                    self._refuse(mark, (*path, str(key)), advice)
                is_advised = True
            elif fault := self._key_fault(key_node, key):
                self._refuse(mark, path, fault)
            elif _lacks_space(key, value_node):
                name, _, text = str(key).partition(":")
                message = f"needs a space after the colon: write `{name}: {text}`"
                self._refuse(mark, (*path, name), message)
            elif key in data:
                line = data[key].key.line
                message = f"given twice, first in line {line}" if line else "given twice"
                self._refuse(mark, (*path, key), message)
            elif key is not None:
                data[key] = self.value(value_node, (*path, key), mark)
        return data

    def _key_fault(self, node: Node, key: str | int | None) -> str:
        """Return what is wrong with the key of a mapping, or an empty text."""
        start = node.start_mark.index
        if self.text[max(0, start - 1) : start] == "?":
            return "quote a name that begins with ? within brackets"
        fault = _fault(str(node.value)) if isinstance(node, ScalarNode) else ""
        if fault:
            return f"a key {fault}"
        if key == "<<":
            return "merge keys (<<) are not part of YAML 1.2: refer to values with ${…}"
        return "the key of a mapping must be a name or a whole number" if key is None else ""

    def _list(self, node: Node, path: Where) -> list[Value]:
        return [
            self.value(child, (*path, i), self._mark(child)) for i, child in enumerate(node.value)
        ]

    def _weigh(self, node: Node, value: Value) -> None:
        """Count the values in a YAML list or mapping; raise `RecipeError` if aliases produce too
        many values.
        """
        is_mapping = isinstance(node, MappingNode)
        children = list(chain.from_iterable(node.value)) if is_mapping else node.value
        self.size[id(node)] = 1 + sum(self.size.get(id(child), 1) for child in children)
        self._refuse_many(self.size[id(node)], _MOST_VALUES, value.mark, value.path)

    def _refuse_many(self, count: int, limit: int, mark: Location, path: Where) -> None:
        """Raise `RecipeError` if a value has more values than a limit."""
        if count > limit:
            raise RecipeError(
                [
                    Diagnostic(
                        mark, dotted(path), f"aliases expand this value to more than {limit} values"
                    )
                ]
            )

    def _mark(self, node: Node) -> Location:
        """Return the place of a node: its line and column in a file.

        A text that is an argument has one place for all of it.
        """
        if not self.start.line:
            return self.start
        return Location(
            self.start.file, node.start_mark.line + 1, node.start_mark.column + 1, self.start.folder
        )

    def _refuse(self, mark: Location, path: Where, message: str) -> Value:
        """Report a mistake and return an empty value in place of the wrong one."""
        self.diagnostics.append(Diagnostic(mark, dotted(path), message))
        return Value(None, mark, mark, path)


def _moved(value: Value, path: Where) -> Value:
    """Return a copy of a YAML value, and of all values within it, with another path."""
    data = value.data
    if isinstance(data, dict):
        data = {key: _moved(child, (*path, key)) for key, child in data.items()}
    elif isinstance(data, list):
        data = [_moved(child, (*path, i)) for i, child in enumerate(data)]
    return replace(value, data=data, path=path)


_KNOWN_TAGS = {
    f"!!{name}"
    for name in ("str", "int", "float", "bool", "null", "map", "seq", "timestamp", "merge", "value")
}


def _fault(text: str) -> str:
    """Return what is wrong with the text of a scalar that would harm a reader or the program, or
    an empty text.
    """
    if control_character := CONTROL.search(text):
        return f"has the control character {visible(control_character[0])}: remove it"
    if len(text) > _DIGITS and _INT.fullmatch(text):
        return f"has {len(text)} digits, more than the limit of {_DIGITS}"
    return ""


def _scalar(node: ScalarNode) -> Any:
    """Return the data of a scalar: null, a boolean, a number or a text.

    A quoted scalar is always a text.
    """
    text, tag = str(node.value), (node.tag or "").removeprefix(_TAG)
    if tag == "null" and node.style is None:
        return None
    if tag == "bool" and node.style is None:
        return text.lower() == "true"
    return number(text) if tag in ("int", "float") and node.style is None else text


def _fits(node: Node, tag: str) -> bool:
    """Return True if the explicit tag of a value is ``!!str`` or the type that the value has
    without it.
    """
    if isinstance(node, MappingNode):
        return tag == "!!map"
    if not isinstance(node, ScalarNode):
        return tag == "!!seq"
    return tag == "!!str" or (node.style is None and _has_type(str(node.value), tag))


def _has_type(text: str, tag: str) -> bool:
    """Return True if an unquoted text has the type of a tag."""
    has_type_of_tag = {
        "!!int": lambda: _INT.fullmatch(text) is not None,
        "!!float": lambda: not isinstance(number(text), str),
        "!!bool": lambda: text in _BOOLEANS,
        "!!null": lambda: text in _NULLS,
    }
    return tag in has_type_of_tag and has_type_of_tag[tag]()


def number(text: str) -> int | float | str:
    """Return the number that a text represents in YAML 1.2, or the text itself if it is not a
    number.
    """
    if _INT.fullmatch(text):
        return int(text, 0 if text[:2] in ("0o", "0x") else 10)
    if _FLOAT.fullmatch(text):
        return float(text)
    unsigned = text.lstrip("+-").lower()
    if unsigned in (".inf", ".nan"):
        return -math.inf if text[0] == "-" and unsigned == ".inf" else float(unsigned[1:])
    return text


def _is_enclosed(node: Node) -> bool:
    """Return True for a value in quotes or in brackets."""
    if isinstance(node, ScalarNode):
        return node.style in ("'", '"')
    return isinstance(node, CollectionNode) and bool(node.flow_style)


def _lacks_space(key: str | int | None, value: Node) -> bool:
    """Return True for a key such as ``seed:7`` without a value, in which a space is missing."""
    is_empty = isinstance(value, ScalarNode) and value.style is None and str(value.value) == ""
    return is_empty and isinstance(key, str) and _LACKS_SPACE.fullmatch(key) is not None


def _key(node: Node) -> str | int | None:
    """Return the key of a YAML mapping as a name or a whole number, or None for another kind of
    key.
    """
    if not isinstance(node, ScalarNode):
        return None
    key = _scalar(node)
    return key if isinstance(key, str | int) and not isinstance(key, bool) and key != "" else None
