"""The axes of a sweep as they are written, and the points that they make."""

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.sweeps.axes import MOST, Axis, points, read_axes, read_words, split, values_of

PLAIN = st.text("abcxyz019.-_ ", min_size=1, max_size=8).map(str.strip).filter(bool)
QUOTED = st.text("ab,[]{}() '", max_size=8).map(lambda t: f'"{t}"')
NESTED = st.lists(PLAIN | QUOTED, max_size=4).map(lambda items: f"[{', '.join(items)}]")
NUMBERS = st.decimals(-1000, 1000, allow_nan=False, places=3)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("1,2,3", ["1", "2", "3"]),
        ("5 e-, 10 e-,20 e-", ["5 e-", "10 e-", "20 e-"]),
        ("axicon,vortex", ["axicon", "vortex"]),
        ("[1, 2],[3, 4]", ["[1, 2]", "[3, 4]"]),
        ("[1, 2]", ["[1, 2]"]),
        ("{a: 1, b: 2}", ["{a: 1, b: 2}"]),
        ("'a, b',c", ["'a, b'", "c"]),
        ('"a \\", b",c', ['"a \\", b"', "c"]),
        ("'it''s, so',c", ["'it''s, so'", "c"]),
        ("it's,so", ["it's", "so"]),
        ("spot[mask,green],spot[plain,green]", ["spot[mask,green]", "spot[plain,green]"]),
        ("${a.b},${c.d}", ["${a.b}", "${c.d}"]),
        ("range(4)", ["0", "1", "2", "3"]),
        ("range(0, 10, 2)", ["0", "2", "4", "6", "8"]),
        ("range(10, 0, -3)", ["10", "7", "4", "1"]),
        ("range(0, 0.5, 0.1)", ["0", "0.1", "0.2", "0.3", "0.4"]),
        ("range(1 um, 2 um, 0.5 um)", ["1 um", "1.5 um"]),
        ("linspace(450 nm, 650 nm, 5)", ["450 nm", "500 nm", "550 nm", "600 nm", "650 nm"]),
        ("linspace(1, 0, 3)", ["1", "0.5", "0"]),
        ("linspace(7, 9, 1)", ["7"]),
        ("logspace(1e2, 1e6, 5)", ["100", "1000", "10000", "100000", "1000000"]),
        ("logspace(8 e-, 1 e-, 4)", ["8 e-", "4 e-", "2 e-", "1 e-"]),
        ("0 e-, linspace(5 e-, 15 e-, 3)", ["0 e-", "5 e-", "10 e-", "15 e-"]),
        ("log(3)", ["log(3)"]),
    ],
)
def test_values_as_they_are_written(text, values):
    assert values_of(text) == values


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("1,,2", "a value is missing before or after a comma"),
        ("1,2,", "a value is missing before or after a comma"),
        ("[1,2", "a bracket is not closed: ] is missing"),
        ("range()", "range: write range(stop)"),
        ("range(5, 1)", "range: the range is empty"),
        ("range(0, 1, 0)", "range: the step of a range must not be 0"),
        ("range(1e9)", f"range: the range has 1000000000 values: an axis has at most {MOST}"),
        ("range(0, 1, 1e-300)", "range: the range has too many values"),
        ("range(1e999)", "range: 1e999 is not a number"),
        ("range(a, b)", "range: a is not a number"),
        (
            "linspace(1 nm, 2 um, 3)",
            "linspace: write all numbers in the same unit instead of nm, um",
        ),
        (
            "linspace(1, 2 um, 3)",
            "linspace: write all numbers in the same unit instead of none, um",
        ),
        (
            "linspace(1, 2)",
            "linspace: write the first value, the last value and the number of values",
        ),
        (
            "linspace(1, 2, 2.5)",
            "linspace: the number of values must be a whole number of at least 1, not 2.5",
        ),
        ("linspace(1, 2, 0)", "linspace: the range is empty"),
        (
            "logspace(0, 1, 3)",
            "logspace: the first and the last value of a logarithmic range must be positive",
        ),
        ("linspce(1, 2, 3)", "there is no range function linspce; did you mean linspace?"),
    ],
)
def test_what_is_no_list_of_values_is_refused_with_the_fix(text, told):
    with pytest.raises(ValueError, match=r"^") as caught:
        values_of(text)
    assert str(caught.value).startswith(told)


@given(st.lists(PLAIN.filter(lambda t: "(" not in t) | QUOTED | NESTED, min_size=1, max_size=6))
def test_only_commas_outside_quotes_and_brackets_split(parts):
    assert split(",".join(parts)) == parts


@given(NUMBERS, NUMBERS, st.integers(2, 50))
def test_linspace_is_exact_to_the_last_bit(start, stop, count):
    values = [float(v) for v in values_of(f"linspace({start}, {stop}, {count})")]
    exact = [
        Fraction(start) + (Fraction(stop) - Fraction(start)) * i / (count - 1) for i in range(count)
    ]
    assert values == [float(x) for x in exact]


@given(NUMBERS, NUMBERS, NUMBERS.filter(bool))
def test_range_stops_before_its_end(start, stop, step):
    count = math.ceil((Fraction(stop) - Fraction(start)) / Fraction(step))
    if not 1 <= count <= 2000:
        return
    values = [float(v) for v in values_of(f"range({start}, {stop}, {step})")]
    assert values == [float(Fraction(start) + i * Fraction(step)) for i in range(count)]
    assert (values[-1] < float(stop)) if step > 0 else (values[-1] > float(stop))


@given(st.floats(1e-9, 1e9), st.floats(1e-9, 1e9), st.integers(2, 40))
def test_logspace_has_its_ends_and_equal_ratios(start, stop, count):
    values = [float(v) for v in values_of(f"logspace({start!r}, {stop!r}, {count})")]
    ratio = math.log(stop / start) / (count - 1)
    assert (values[0], values[-1]) == (start, stop)
    assert [math.log(v / start) for v in values] == pytest.approx(
        [i * ratio for i in range(count)], abs=1e-12
    )


# --- arguments and points -------------------------------------------------------------------------


def refused(call):
    with pytest.raises(RecipeError) as caught:
        call()
    return [f"{p.mark} | {p.path} | {p.message}" for p in caught.value.diagnostics]


def test_what_is_one_value_is_the_same_at_every_point(tmp_path):
    found = read_words(["a=1,2", "b=7", "~c", "+d=8", "e=[1, 2]", "f='x, y'"], tmp_path)
    assert [isinstance(x, Axis) for x in found] == [True, False, False, False, False, False]
    assert [p.shown for p in points(found)] == ["a=1", "a=2"]
    assert [o.text for o in points(found)[1].overrides] == [
        "a=2",
        "b=7",
        "~c",
        "+d=8",
        "e=[1, 2]",
        "f='x, y'",
    ]


def test_the_last_axis_is_the_fastest_and_points_count_from_one(tmp_path):
    found = points(read_words(["a=1,2", "b=x,y,z"], tmp_path))
    assert [p.number for p in found] == [1, 2, 3, 4, 5, 6]
    assert [p.place for p in found] == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]
    assert found[3].shown == "a=2, b=x"


def test_paired_axes_run_together(tmp_path):
    found = points(read_words(["a=1,2", "b=x,y"], tmp_path), paired=True)
    assert [p.shown for p in found] == ["a=1, b=x", "a=2, b=y"]


def test_paired_axes_of_unequal_length_name_both(tmp_path):
    arguments = read_words(["a=1,2", "b=range(3)"], tmp_path, first=2)
    told = (
        "argument 3 | b | has 3 values, and a (argument 2) has 2: give paired axes the same number"
        " of values"
    )
    assert refused(lambda: points(arguments, paired=True)) == [told]


def test_every_wrong_argument_is_named_at_once(tmp_path):
    told = refused(
        lambda: read_words(
            ["a=1,,2", "b=2", "c", "+d=1,2", "e=range(0)", "f=1,[:"], tmp_path, first=2
        )
    )
    assert [line.partition(" | ")[0] for line in told] == [f"argument {n}" for n in (2, 4, 5, 6, 7)]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["a=1"],
            "sweep |  | the sweep has no axis: write a=1,2 or a='linspace(450 nm, 650 nm, 5)'",
        ),
        (["a=1,2", "a=3,4"], "argument 2 | a | axis a is also in argument 1: remove one"),
        (["a=1,2,1"], "argument 1 | a | the value 1 appears twice on the axis: remove one"),
        (
            ["a=range(1000)", "b=range(1000)"],
            "sweep |  | a sweep of 1000000 points is too long: at most 100000 points",
        ),
    ],
)
def test_axes_that_make_no_sweep(tmp_path, words, told):
    assert refused(lambda: points(read_words(words, tmp_path))) == [told]


def test_axes_as_python_values(tmp_path):
    found = read_axes(
        {"a": [1, 2.5], "b": ("5 e-", "no, yes"), "c": "range(2)", "d": [[1, 2]]}, tmp_path
    )
    assert [[c.value for c in axis.coordinates] for axis in found] == [
        [1, 2.5],
        ["5 e-", "no, yes"],
        [0, 1],
        [[1, 2]],
    ]
    assert [c.shown for c in found[3].coordinates] == ["[1, 2]"]


def test_axes_of_arrays(tmp_path):
    import torch

    (axis,) = read_axes({"a": torch.tensor([0.5, 1.5])}, tmp_path)
    assert [c.value for c in axis.coordinates] == [0.5, 1.5]


@pytest.mark.parametrize(
    ("axes", "told"),
    [
        ({"a": []}, "axis a | a | the axis has an empty list of values: give at least one value"),
        ({"a": 3}, "axis a | a | give the axis a list of values, not int"),
        ({"+a": [1]}, "axis +a | +a | write the name of an axis without + or ~"),
        ({"a": "1,,2"}, "axis a | a=1,,2 | a value is missing before or after a comma"),
    ],
)
def test_axes_of_python_that_are_none(tmp_path, axes, told):
    assert refused(lambda: read_axes(axes, tmp_path)) == [told]
