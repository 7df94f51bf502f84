"""Rows of a table as one test: what its message says, and that each row has its own fixtures."""

import pytest

pytest_plugins = "pytester"

TABLE = """
import pytest

@pytest.fixture
def counter():
    yield []

@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_is_odd(number, counter, tmp_path):
    assert counter == [] and not list(tmp_path.iterdir())
    counter.append(number)
    (tmp_path / "made").touch()
    assert number % 2 == 1

@pytest.mark.usefixtures("counter")
@pytest.mark.parametrize("number", [1, 2])
def test_is_skipped(number):
    if number == 2:
        pytest.skip("not here")

@pytest.mark.parametrize("number", [1, 2])
def test_has_no_fixture(number, nowhere):
    pass

@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2])
def test_slow(number):
    pass
"""
HOOKS = """
import pytest
from tests.conftest import pytest_runtest_protocol
from tests import grouped_rows

@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    items[:] = grouped_rows.grouped(items)

def pytest_configure(config):
    config.addinivalue_line("markers", "slow: slow")
"""


@pytest.fixture
def ended(pytester):
    pytester.makepyfile(TABLE)
    pytester.makeconftest(HOOKS)
    return pytester.runpytest


def test_a_table_is_one_test_that_names_the_rows_which_fail(ended):
    result = ended()
    result.assert_outcomes(failed=1, passed=3, errors=1)
    result.stdout.fnmatch_lines(["2 of 4 rows failed in call", "2", "4"])
    result.stdout.fnmatch_lines(["*assert (2 % 2) == 1*", "*assert (4 % 2) == 1*"])
    result.stdout.fnmatch_lines(["2 of 2 rows failed in setup"])


def test_a_row_can_be_asked_for_by_its_name(ended):
    result = ended("test_a_row_can_be_asked_for_by_its_name.py::test_is_odd[2]")
    result.assert_outcomes(failed=1)


def test_a_row_that_is_skipped_fails_nothing(ended):
    ended("-k", "test_is_skipped").assert_outcomes(passed=1)
    ended("-k", "test_is_skipped and 2").assert_outcomes(skipped=1)
