import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neusee.workflows.graph.errors import CONTROL, Location, RecipeError
from neusee.workflows.graph.final_values import flow
from neusee.workflows.recipe.text.yaml_values import parse, read

TOP = Location("f.yaml", 1, 1)


def plain(text):
    return parse(text, TOP).plain


def refused(text):
    with pytest.raises(RecipeError) as caught:
        parse(text, TOP)
    return "\n".join(
        " / ".join(filter(None, (str(p.mark), p.path, p.message))) for p in caught.value.diagnostics
    )


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e3", 1000.0),
        ("1.0e3", 1000.0),
        ("532e-9", 532e-9),
        ("5.32e-7", 5.32e-7),
        ("010", 10),
        ("0o10", 8),
        ("0x1F", 31),
        ("on", "on"),
        ("yes", "yes"),
        ("true", True),
        ("TRUE", True),
        ("~", None),
        ("null", None),
        ("", None),
        (".5", 0.5),
        ("-1.", -1.0),
        (".inf", math.inf),
        ("-.inf", -math.inf),
        ("1_000", "1_000"),
        ("1:30", "1:30"),
        ("2026-01-01", "2026-01-01"),
        ("20 e-", "20 e-"),
        ('"1e3"', "1e3"),
        ("!!str 1e3", "1e3"),
        ("'null'", "null"),
        ("0b11", "0b11"),
    ],
)
def test_a_scalar_means_what_yaml_1_2_says(text, value):
    got = plain(f"a: {text}")["a"]
    assert got == value
    assert type(got) is type(value)


def test_nan_is_a_number():
    assert math.isnan(plain("a: .nan")["a"])


def test_every_value_and_every_key_knows_where_it_stands():
    value = parse("a: 1\nb:\n  c: [x, {d: 2}]\n  7: e\n", TOP)
    c = value.items["b"].items["c"]
    assert (str(c.key), str(c.mark), c.path) == ("f.yaml:3:3", "f.yaml:3:6", ("b", "c"))
    d = c.items[1].items["d"]
    assert (str(d.key), str(d.mark), d.path) == ("f.yaml:3:11", "f.yaml:3:14", ("b", "c", 1, "d"))
    assert value.items["b"].items[7].path == ("b", 7)


def test_a_key_that_stands_twice_is_refused_at_the_second():
    assert refused("a: 1\nb: {x: 1}\na: 2\n") == "f.yaml:3:1 / a / given twice, first in line 1"
    assert refused("b:\n  x: 1\n  x: 1\n") == "f.yaml:3:3 / b.x / given twice, first in line 2"


def test_two_duplicates_are_two_problems():
    assert refused("a: 1\na: 2\nb: 1\nb: 2\n").count("given twice") == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a:\n\tb: 1\n", "f.yaml:2:1 / a tab: indent YAML with spaces"),
        ("a: {b: ${c.d}}\n", 'f.yaml:1:9 / inside { } or [ ], quote a reference: "${…}"'),
        ("a: [1,\n", "expected"),
        ("a: [raw, psf[mask]]\n", 'inside [ ], quote a name with brackets: "psf[mask]"'),
        ("a: b: c\n", "f.yaml:1:5 / a second ':' in this line"),
        ("a: 1\n---\nb: 1\n", "a second document"),
        ("a: *nothing\n", "no earlier value has the anchor &nothing"),
        ("a: !!python/object:os.system ls\n", "unknown YAML tag !!python/object:os.system"),
        ("a: !mine 1\n", "unknown YAML tag !mine"),
        ("b: &x {c: 1}\na: {<<: *x}\n", "f.yaml:2:5 / a / merge keys"),
        ("? [a, b]\n: 1\n", "the key of a mapping must be a name or a whole number"),
        ("1.5: a\n", "the key of a mapping must be a name or a whole number"),
        ("a: \x01\n", "f.yaml:1:4"),
        ("a: &x {b: *x}\n", "a YAML alias refers to the value that contains the alias"),
        ("a: &x [*x]\n", "a YAML alias refers to the value that contains the alias"),
        ("a: " + "[" * 5000, "the YAML text is nested too deeply"),
    ],
)
def test_what_is_no_recipe_gets_a_located_message(text, message):
    assert message in refused(text)


def test_an_alias_is_the_same_value_again():
    value = parse("a: &x {b: 1}\nc: *x\n", TOP)
    assert value.plain == {"a": {"b": 1}, "c": {"b": 1}}
    assert value.items["c"].path == ("c",)
    assert [leaf.path for leaf in value.leaves()] == [("a", "b"), ("c", "b")]
    assert str(value.items["c"].key) == "f.yaml:2:1"


def test_a_bomb_of_aliases_is_refused_at_once():
    rows = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    rows += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 20)]
    # 10^20 values would take for ever
    assert "aliases expand this value to more than" in refused("\n".join(rows))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "f.yaml:1:1 the file is empty: write a mapping, `key: value`"),
        (b"# a title alone\n", "f.yaml:1:1 the file is empty: write a mapping, `key: value`"),
        (b"- 1\n- 2\n", "f.yaml:1:1 the file contains a list: write a mapping, `key: value`"),
        (b"hello\n", "f.yaml:1:1 the file contains a string: write a mapping, `key: value`"),
        (b"a: 1\nb: caf\xe9\n", "f.yaml:2:7 the byte 0xe9 is not UTF-8"),
        (None, "f.yaml the file cannot be read: No such file or directory"),
    ],
)
def test_a_file_that_cannot_be_read_gets_one_message(tmp_path, content, message):
    path = tmp_path / "f.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecipeError) as caught:
        read(path, "f.yaml")
    assert " ".join(str(caught.value).split()) == message


def test_the_title_is_the_first_line_if_that_is_a_comment(tmp_path):
    (tmp_path / "a.yaml").write_text("# What it shows.\n# more\na: 1\n")
    (tmp_path / "b.yaml").write_text("a: 1\n# not this\n")
    assert read(tmp_path / "a.yaml", "a").title == "What it shows."
    assert read(tmp_path / "b.yaml", "b").title == ""


def test_a_byte_order_mark_is_no_part_of_the_first_key(tmp_path):
    (tmp_path / "a.yaml").write_bytes(b"\xef\xbb\xbfa: 1\n")
    assert read(tmp_path / "a.yaml", "a").root.plain == {"a": 1}


letters = st.characters(codec="utf-8").filter(lambda letter: not CONTROL.search(letter))
scalars = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(letters)
trees = st.recursive(
    scalars,
    lambda t: (
        st.lists(t, max_size=4) | st.dictionaries(st.text("abc%:#é ", min_size=1), t, max_size=4)
    ),
)


@given(trees)
def test_what_is_written_out_reads_back_the_same(tree):
    assert plain(f"a: {flow(tree)}") == {"a": tree}
