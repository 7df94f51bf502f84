"""The order of a set of texts differs between processes: code that takes it is found by its
form.
"""

import pytest

from neusee.workflows.keys.source_summary import summarise

TAKEN = {
    "a list": "x = list({'a', 'b'})",
    "a loop": "for x in set(words):\n    print(x)",
    "a comprehension": "x = [y for y in {w for w in words}]",
    "a name": "def f():\n    names = {'a'} | other\n    return [x for x in names]",
    "a constant of the module": "NAMES = {'a', 'b'}\n\n\ndef f():\n    return tuple(NAMES)",
    "a union": "def f(a):\n    both = set(a)\n    return list(both.union(a))",
    "a text": "x = ''.join({'a', 'b'})",
    "a star": "x = [*{'a', 'b'}]",
    "any one": "x = {'a', 'b'}.pop()",
    "the first one": "x = next(iter(frozenset(words)))",
    "a hash": "x = hash('a')",
    "the method of a hash": "x = ('a', 'b').__hash__()",
    "inside of a sum": "x = sum(f(list(set(w))) for w in words)",
}
FREE = {
    "sorted": "x = sorted({'a', 'b'})",
    "sorted, of a list": "x = sorted(list(set(words)))",
    "length": "x = len(set(words))",
    "any": "x = any(y for y in {'a', 'b'})",
    "numbers": "for x in {1, 2.5}:\n    print(x)",
    "a range": "x = list(set(range(3)))",
    "membership": "x = 'a' in {'a', 'b'}",
    "a hash of a class": "class A:\n    def __hash__(self):\n        return hash((1, 'a'))",
    "a part of a set of sets": (
        "many = {x for x in y}\nfor one in sorted(many):\n    print(list(one))"
    ),
    "a table": "for x in {'a': 1}:\n    print(x)",
    "a function of that name": "def hash(x):\n    return 1\n\n\ny = hash('a')",
}


def found(code):
    return [
        item.text for item in summarise(code.encode(), own=True).constructs if item.kind == "hash"
    ]


@pytest.mark.parametrize("kind", TAKEN)
def test_an_order_that_the_hash_seed_decides_is_found(kind):
    assert len(found(TAKEN[kind])) == 1


@pytest.mark.parametrize("kind", FREE)
def test_an_order_that_decides_nothing_is_not(kind):
    assert found(FREE[kind]) == []
