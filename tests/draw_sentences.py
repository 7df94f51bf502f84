#!/usr/bin/env python
"""A random draw of the project's sentences for a reader who does not know the code:
`tests/draw_sentences.py [SEED]`.

Prints 60 openings of docstrings, 30 messages and 10 sentences of the README, numbered. The reader
marks each sentence as plain, odd (a second reading is needed) or a riddle; the aim is 85 plain
sentences and at most 2 riddles. This is no test: pytest does not collect the file.
"""

import ast
import random
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCSTRINGS, MESSAGES, README_SENTENCES = 60, 30, 10
#: calls whose text a user reads
_SPEAKERS = {"warn", "Diagnostic", "Check", "_fail", "_problem", "_refuse"}
_LOCATED = {"Diagnostic", "_fail", "_problem", "_refuse"}  #: calls whose last text is the message
_Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def sources() -> Iterator[ast.Module]:
    """Yield the syntax tree of every module in nodes/ and workflows/."""
    for room in ("nodes", "workflows"):
        for path in sorted((ROOT / room).rglob("*.py")):
            yield ast.parse(path.read_text(encoding="utf-8"))


def openings(tree: ast.Module) -> Iterator[str]:
    """Yield the first sentence of each docstring."""
    for item in ast.walk(tree):
        if isinstance(item, _Documented) and (text := ast.get_docstring(item)):
            yield re.split(
                r"(?<=[.!?])\s", " ".join(text.partition("\n\n")[0].split()), maxsplit=1
            )[0]


def messages(tree: ast.Module) -> Iterator[str]:
    """Yield each message: the texts given to a raised exception, a warning, a diagnostic or a
    check.
    """
    for item in ast.walk(tree):
        if isinstance(item, ast.Raise) and isinstance(item.exc, ast.Call):
            yield from _texts(item.exc)
        elif isinstance(item, ast.Call) and _name(item.func) in _SPEAKERS:
            yield from _texts(item)


def _name(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def _texts(call: ast.Call) -> Iterator[str]:
    """Yield the arguments of a call that are texts of two words or more; a diagnostic ends with
    its message.
    """
    for argument in call.args[-1:] if _name(call.func) in _LOCATED else call.args:
        text = _text(argument)
        if len(text.split()) > 1 and re.search("[a-z]{2} ", re.sub(r"\{[^}]*\}", "", text)):
            yield text


def _text(item: ast.expr) -> str:
    """Return a string as its reader sees it, with the expressions of an f-string as {name}."""
    if isinstance(item, ast.Constant):
        return " ".join(item.value.split()) if isinstance(item.value, str) else ""
    if isinstance(item, ast.JoinedStr):
        parts = (
            str(p.value) if isinstance(p, ast.Constant) else f"{{{_label(p)}}}" for p in item.values
        )
        return " ".join("".join(parts).split())
    return _text(item.left) + _text(item.right) if isinstance(item, ast.BinOp) else ""


def _label(part: ast.expr) -> str:
    assert isinstance(part, ast.FormattedValue)
    return ast.unparse(part.value)


def readme_sentences() -> list[str]:
    """Return the sentences of the README, without code blocks, tables and headings."""
    text = re.sub(
        r"```.*?```", "", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL
    )
    text = re.sub(r"^ {4}\S.*$", "", text, flags=re.MULTILINE)
    blocks = re.split(r"\n\s*\n|\n(?=\s*[-*] )", text)
    prose = (
        " ".join(block.split())
        for block in blocks
        if not block.lstrip().startswith(("|", "#", "!", "<"))
    )
    sentences = (sentence for block in prose for sentence in re.split(r"(?<=[.!?])\s", block))
    return [sentence for sentence in sentences if len(sentence.split()) > 3]


def draw(seed: int) -> list[str]:
    """Return the drawn sentences: docstring openings, then messages, then sentences of the
    README.
    """
    trees = list(sources())
    kinds = (
        (sorted({text for tree in trees for text in openings(tree)}), DOCSTRINGS),
        (sorted({text for tree in trees for text in messages(tree)}), MESSAGES),
        (sorted(set(readme_sentences())), README_SENTENCES),
    )
    chance = random.Random(seed)
    return [text for texts, count in kinds for text in chance.sample(texts, min(count, len(texts)))]


if __name__ == "__main__":
    for number, sentence in enumerate(draw(int(sys.argv[1]) if len(sys.argv) > 1 else 0), 1):
        print(f"{number:3d}. {sentence}")
