"""The table of mutants: each fault can still be made, and the tests that must find it are still
there.
"""

import importlib.util
from pathlib import Path

SPEC = importlib.util.spec_from_file_location("mutants", Path(__file__).with_name("mutants.py"))
mutants = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(mutants)


def test_the_old_text_of_a_mutant_stands_exactly_once_in_its_file():
    found = [(m.file, m.old, mutants.places(m)) for m in mutants.MUTANTS]
    assert not [row for row in found if row[2] != 1]
    assert not [m for m in mutants.MUTANTS if m.new == m.old]


def test_the_tests_of_a_mutant_exist():
    named = sorted({test for mutant in mutants.MUTANTS for test in mutant.tests.split()})
    assert len(named) > 100
    assert not [test for test in named if not exists(test)]


def exists(test):
    """Return whether a file of tests, or a test in it, is there."""
    file, _, name = test.partition("::")
    path = mutants.ROOT / file
    there = path.is_file()
    return (
        there and f"\ndef {name.partition('[')[0]}(" in "\n" + path.read_text("utf-8")
        if name
        else there
    )


def test_no_mutant_is_there_twice():
    assert len({(m.file, m.old, m.new) for m in mutants.MUTANTS}) == len(mutants.MUTANTS)
