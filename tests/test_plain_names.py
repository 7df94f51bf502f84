"""A binding says which quantity or thing it is: words that fit any binding are rare."""

import ast
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = sorted([*ROOT.glob("nodes/**/*.py"), *ROOT.glob("workflows/**/*.py")])
#: words that say nothing of what they name
EMPTY = frozenset(
    [
        "found",
        "told",
        "each",
        "rest",
        "how",
        "one",
        "those",
        "there",
        "known",
        "kept",
        "given",
        "wanted",
        "at",
        "whole",
        "part",
        "thing",
        "what",
        "more",
        "most",
        "least",
        "gone",
        "seen",
        "used",
        "chosen",
        "fresh",
    ]
)
LARGEST_SHARE = 0.01  #: of all bindings


def bindings(tree):
    """Yield the name of each variable and parameter that a file binds."""
    for item in ast.walk(tree):
        if isinstance(item, ast.Name) and isinstance(item.ctx, ast.Store):
            yield item.id
        elif isinstance(item, ast.arg):
            yield item.arg


def empty_words(texts):
    """Return how often each empty word is a binding, and the number of all bindings."""
    names = Counter(name for text in texts for name in bindings(ast.parse(text)))
    return {word: names[word] for word in EMPTY if names[word]}, names.total()


def test_few_bindings_have_a_name_that_fits_any():
    empty, total = empty_words(path.read_text(encoding="utf-8") for path in FILES)
    assert sum(empty.values()) <= LARGEST_SHARE * total, sorted(empty.items())


def test_an_empty_word_is_counted_wherever_it_is_bound():
    text = "def f(found, *, rest):\n    for each in found:\n        rest.part = kept = each\n"
    empty, total = empty_words([text])
    assert empty == {"found": 1, "rest": 1, "each": 1, "kept": 1}
    assert total == 4
