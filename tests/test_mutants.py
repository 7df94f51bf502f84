"""The table of mutants: each fault can still be made, and the tests that must find it are still there."""

import importlib.util
from pathlib import Path

import pytest

SPEC = importlib.util.spec_from_file_location("mutants", Path(__file__).with_name("mutants.py"))
mutants = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(mutants)

each = pytest.mark.parametrize("mutant", mutants.MUTANTS, ids=lambda m: f"{m.file}: {m.old}")


@each
def test_the_old_text_of_a_mutant_stands_exactly_once_in_its_file(mutant):
    assert mutants.places(mutant) == 1
    assert mutant.new != mutant.old


@each
def test_the_tests_of_a_mutant_exist(mutant):
    for test in mutant.tests.split():
        file, _, name = test.partition("::")
        text = (mutants.ROOT / file).read_text(encoding="utf-8")
        assert not name or f"\ndef {name.partition('[')[0]}(" in text, test


def test_no_mutant_is_there_twice():
    assert len({(m.file, m.old, m.new) for m in mutants.MUTANTS}) == len(mutants.MUTANTS)
