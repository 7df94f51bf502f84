"""The page of a study: what is in its cells, what its colours say, and that it stands alone."""

import base64
import re
from html.parser import HTMLParser

import pytest

from neusee.workflows.report.study_report import (
    Marked,
    Section,
    cell_text,
    marked_column,
    page,
    with_uncertainty,
)

PNG = b"\x89PNG\r\n\x1a\n and what follows"


class Cells(HTMLParser):
    """Every table cell with its classes, every picture, and every address that would be fetched."""

    def __init__(self, text):
        super().__init__()
        self.cells, self.pictures, self.fetched, self._class = [], [], [], None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self._class = found.get("class") or "" if tag == "td" else None
        if tag == "img":
            self.pictures.append(found["src"])
        self.fetched += [
            found[a] for a in ("src", "href") if not found.get(a, "#").startswith(("#", "data:"))
        ]

    def handle_data(self, data):
        if self._class is not None:
            self.cells.append((data, self._class))
            self._class = None


ROWS = (("dark", 1.23456e-4), ("<one>", None))


def made(rows=ROWS, **options):
    section = Section("Cases", "One.\n\nTwo <b>.", ("case", "error"), rows, **options)
    return page("Study of x", "It holds.", [section], {"neusee": "0.1", "seeds": [1, 2]})


def test_cells_hold_numbers_to_three_digits_and_marks_as_classes():
    rows = [("dark", Marked(1.23456e-4, "fail")), (Marked("<one>", "pass"), None)]
    found = Cells(made(rows)).cells
    assert found[:4] == [("dark", ""), ("0.000123", "n fail"), ("<one>", "pass"), ("–", "n")]
    assert ("1, 2", "key") in found


def test_a_column_is_marked_row_by_row_and_an_unmarked_cell_looks_as_before():
    assert made(marked_column(ROWS, 1, [None, None])) == made()
    found = Cells(made(marked_column(ROWS, 1, ["warn", None]))).cells
    assert found[:4] == [("dark", ""), ("0.000123", "n warn"), ("<one>", ""), ("–", "n")]
    with pytest.raises(ValueError, match="shorter"):
        marked_column(ROWS, 1, ["warn"])


def test_the_page_carries_its_picture_and_fetches_nothing():
    text = made(picture=PNG)
    found = Cells(text)
    assert [base64.b64decode(p.split(",")[1]) for p in found.pictures] == [PNG]
    assert found.fetched == []
    assert not re.search(r"@import|url\(|<script|https?:", text)


def test_text_is_escaped_and_a_blank_line_begins_a_paragraph():
    text = made()
    assert "<p>One.</p>\n<p>Two &lt;b&gt;.</p>" in text
    assert "<b>" not in text


def contrast(ink, paper):
    def luminance(colour):
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    light, dark = sorted((luminance(ink), luminance(paper)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def test_every_ink_is_read_on_its_ground_in_light_and_in_dark():
    schemes = [
        dict(re.findall(r"--([\w-]+): (#\w{6})", block))
        for block in re.findall(r":root \{(.*?)\}", made(), re.S)
    ]
    assert len(schemes) == 2
    for colours in schemes:
        pairs = [("ink", "paper"), ("soft", "paper"), ("link", "paper")]
        pairs += [(f"{kind}-ink", kind) for kind in ("good", "watch", "bad")]
        assert min(contrast(colours[a], colours[b]) for a, b in pairs) >= 4.5  # WCAG 2.1, level AA


@pytest.mark.parametrize(
    ("value", "text"), [(3, "3"), (True, "yes"), (2.0, "2"), (1e-9, "1e-09"), ("a", "a")]
)
def test_what_a_cell_says(value, text):
    assert cell_text(value) == text


def test_words_between_backticks_are_code_and_a_sign_stays_beside_its_word():
    text = page("t", "of `a` and `<b>`", [Section("s", "", ("c",), [(Marked("yes", "pass"),)])], {})
    assert "<p>of <code>a</code> and <code>&lt;b&gt;</code></p>" in text
    assert 'td.pass::before { content: "✓\\a0"; }' in text


def test_every_table_scrolls_within_its_box():
    text = page("t", "", [Section("s", "", ("c",), [("yes",)])], {"a": 1})
    assert text.count("<table") == text.count('<div class="scroll"><table') == 2


def test_a_dash_stands_below_the_numbers_of_its_column():
    text = page("t", "", [Section("s", "", ("a", "b"), [(1.0, "x"), (None, None)])], {})
    assert '<tr><td class="n">–</td><td>–</td></tr>' in text


def test_a_figure_has_a_text_that_says_what_it_shows():
    section = Section("Curves", "The middle 90 % of the draws. Less.\n\nMore.", picture=b"PNG")
    assert '<img alt="Figure: Curves. The middle 90 % of the draws."' in page(
        "a", "b", [section], {}
    )


def test_provenance_is_text_without_braces_and_without_empty_rows():
    text = page(
        "a", "b", [], {"versions": {"python": "3.12", "torch": 2.5}, "command": "", "seeds": [1, 2]}
    )
    assert re.findall(r"<th>(\w+)</th><td class=\"key\">(.*?)</td>", text) == [
        ("versions", "python 3.12, torch 2.5"),
        ("seeds", "1, 2"),
    ]


def test_a_long_heading_of_a_column_of_numbers_wraps():
    style = page("a", "b", [], {}).partition("</style>")[0]
    assert not re.search(r"th\.n[^{}]*\{[^}]*nowrap", style)


def test_a_number_does_not_break_at_its_hyphen():
    rows = [["2.62099e-05", "-0.01", "a sentence with e-05", "2026-11-23_first_light_3d8a5701"]]
    text = page("a", "b", [Section("h", "", tuple("wxyz"), rows)], {})
    assert re.findall(r"<td( class=\"one\")?>", text) == [' class="one"', ' class="one"', "", ""]
    assert "td.one { white-space: nowrap; }" in text


def test_a_long_name_may_go_on_in_a_new_line_and_a_number_may_not():
    rows = [["developed_quality[mask]", "raw[plain]", "a < b_c", "-1.2345678901234567e-05"]]
    text = page("a", "b", [Section("h", "", tuple("wxyz"), rows)], {})
    assert (
        "<td>developed_<wbr>quality<wbr>[mask]</td><td>raw[plain]</td><td>a &lt; b_c</td>" in text
    )
    assert text.count("<wbr>") == 2


def test_a_mapping_inside_a_mapping_has_brackets():
    text = page(
        "a", "b", [], {"settings": {"weights": {"lsr": 2, "bsr": 1}, "at": "", "slopes": [4, 48]}}
    )
    assert "weights (lsr 2, bsr 1), at –, slopes (4, 48)" in text


@pytest.mark.parametrize(
    ("mean", "sd", "said"),
    [
        (10.4961, 0.0203, "10.496 ± 0.020"),
        (390.05, 0.59, "390.05 ± 0.59"),
        (25502.3, 39.4, "25502 ± 39"),
        (1132.96, 394.0, "1130 ± 390"),
        (0.76956, 0.00226, "0.7696 ± 0.0023"),
        (1.0, 0.0, "1 ± 0"),
        (float("nan"), float("inf"), "nan ± inf"),
        (3e9, 2.1e8, "3e+09 ± 2.1e+08"),
    ],
)
def test_digits_stand_beside_their_deviation(mean, sd, said):
    assert with_uncertainty(mean, sd) == said
