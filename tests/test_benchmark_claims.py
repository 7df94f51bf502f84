"""The page of speed beside peers: intervals of its ratios, and its rows."""

import re
import sys
from pathlib import Path

import pytest
from scipy.stats import binom

from neusee import recipes

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from paired_times import Comparison, median_ranks
from stored_results import FOLDER, page, stored, tables_of

PAGE = Path(recipes.__file__).parent / "guide" / "benchmarks.md"
RESULTS = Path(__file__).parent / "benchmarks" / "RESULTS.md"


@pytest.mark.parametrize("count", [6, 9, 10, 20, 101])
def test_the_interval_of_a_median_is_the_narrowest_that_holds_it_often_enough(count):
    """The median lies below the value of rank k with the probability of at most k of ``count``
    fair coins.
    """
    low, high = median_ranks(count)
    assert high == count - 1 - low
    assert 1 - 2 * binom.cdf(low, count, 0.5) >= 0.95
    assert 1 - 2 * binom.cdf(low + 1, count, 0.5) < 0.95


def test_a_ratio_is_of_the_same_turn():
    """A turn in which all take ten times as long changes nothing."""
    found = Comparison("x", {"neusee": [1.0, 10.0, 1.0], "peer": [2.0, 20.0, 2.0]}, {}, 0.0)
    assert found.ratio("peer") == (2.0, 2.0, 2.0)


def test_every_ratio_of_the_page_lies_in_its_interval():
    rows = re.findall(
        r"\| ([0-9.]+) \(([0-9.]+) to ([0-9.]+)\) \|", PAGE.read_text(encoding="utf-8")
    )
    assert rows
    for row in rows:
        middle, low, high = map(float, row)
        assert low <= middle <= high


def test_the_results_have_the_tables_of_the_page():
    """One writer makes both, so that neither is edited by hand."""
    part = re.compile(r"^## ([^\n]+)\n\n<!-- claim \w+ -->\n(.*?)<!-- end -->", re.M | re.S)
    sections = part.findall(PAGE.read_text(encoding="utf-8"))
    assert len(sections) >= 2
    of_page = [table for title, text in sections for table in tables_of(text, title)]
    assert stored("claims")["tables"] == of_page


def test_the_measured_page_is_what_the_script_writes_from_the_documents():
    assert RESULTS.read_text(encoding="utf-8") == page()


def test_a_row_of_a_measured_table_has_a_cell_for_each_column():
    documents = [stored(path.stem) for path in FOLDER.glob("*.json")]
    assert len(documents) > 40
    for document in documents:
        for table in document["tables"]:
            assert re.fullmatch(r"\d{4}-\d\d-\d\d", table["date"])
            widths = {len(row) for row in table.get("rows", [])}
            assert widths <= {len(table.get("columns", []))}, document["heading"]
