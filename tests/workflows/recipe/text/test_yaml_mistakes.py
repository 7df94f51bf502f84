"""Texts that are not YAML: the place at which a reader finds the mistake, and the sentence."""

import pytest
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError, YAMLStreamError

from neusee.workflows.graph.errors import Location, RecipeError
from neusee.workflows.recipe.text.yaml_values import directive_mistake, explained, parse

MISTAKES = [
    # a quote or a bracket that never closes, or closes lines later
    ('scene: "abc\nfoo: 1\n', 1, 8, "a quote opens here and never closes"),
    ("a: 1\nscene: 'abc\nfoo: 'b'\n", 2, 8, "the quote that opens here closes only in line 3"),
    ("a: 1\nlist: [1, 2\nb: 3\n", 2, 7, "the [ that opens here is not closed, or lacks a comma"),
    ("map: {a: 1\nb: 3\n", 1, 6, "the { that opens here is not closed, or lacks a comma"),
    # a key without a space behind its colon, or without a colon
    (
        "seed:7\nextends: first_light\n",
        1,
        1,
        "seed:7 needs a space after the colon: write `seed: 7`",
    ),
    ("a: 1\nseed:7\nb: 2\n", 2, 1, "seed:7 needs a space after the colon: write `seed: 7`"),
    (
        "sensor:\n  bits:12\n  gain: 3\n",
        2,
        3,
        "bits:12 needs a space after the colon: write `bits: 12`",
    ),
    ("sensor:\n  bits: 12\n  gain:3\n  well: 2\n", 3, 3, "gain:3 needs a space after the colon"),
    ("list:\n - x\n - y:3\n   z: 4\n", 3, 4, "y:3 needs a space after the colon: write `y: 3`"),
    ("sensor\n  bits: 12\n", 1, 1, "sensor has no colon: write `key: value`"),
    # a wrong indent: the line fits no block above, or continues the value above
    (
        "name: first\n  seed: 1\n",
        2,
        3,
        "a wrong indent: with this indent the line continues the value",
    ),
    (
        "note: hello\n  world\n  again: 5\n",
        3,
        3,
        "a wrong indent: with this indent the line continues the value in line 1",
    ),
    (
        "a: 1\nsensor:\n  bits: 12\n    gain: 3\n",
        4,
        5,
        "a wrong indent: with this indent the line continues the value",
    ),
    (
        "sensor:\n  bits: 12\n gain: 3\n",
        3,
        2,
        "a wrong indent: no line above in the same block has the 1 spaces",
    ),
    # several keys on one line
    ("a: b: c\n", 1, 5, "a second ':' in this line"),
    # a tab
    ("sensor:\n\tbits: 12\n", 2, 1, "a tab: indent YAML with spaces"),
]


@pytest.mark.parametrize(("text", "line", "column", "message"), MISTAKES)
def test_a_mistake_stands_where_a_reader_finds_it(text, line, column, message):
    with pytest.raises((YAMLError, YAMLStreamError)) as raised:
        YAML(typ="safe", pure=True).load(text)
    mistake = explained(raised.value, text)
    assert (mistake.line + 1, mistake.column + 1) == (line, column)
    assert message in mistake.message


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("%YAML 1.3\n---\na: 1\n", 1, "recipes are YAML 1.2, not 1.3"),
        ("# a note\n%YAML 1.1\n---\na: 1\n", 2, "recipes are YAML 1.2, not 1.1"),
        (
            "%TAG ! tag:example.org,2000:\n---\na: 1\n",
            1,
            "the directive %TAG has no meaning in a recipe",
        ),
    ],
)
def test_a_directive_of_another_kind_is_refused_at_its_line(text, line, message):
    mistake = directive_mistake(text)
    assert mistake.line + 1 == line
    assert message in mistake.message


@pytest.mark.parametrize("text", ["a: 1\n", "%YAML 1.2\n---\na: 1\n", "\ufeffa: 1\n%b: 2\n", ""])
def test_a_text_of_yaml_1_2_has_no_mistake(text):
    assert directive_mistake(text) is None


#: texts that the parser reads otherwise than YAML 1.2 has them, or though they are none
READ_OTHERWISE = {
    "a: {?b: 1}": (1, 6, "quote a name that begins with ? within brackets"),
    "a: [?b]": (1, 6, "quote a name that begins with ? within brackets"),
    "a: ! 12": (1, 4, "a ! without a name: remove it, and quote a text that looks like a number"),
    'a: !!int "3"': (1, 4, "the tag !!int does not fit this value: remove the tag"),
    "a: !!int 3.5": (1, 4, "the tag !!int does not fit"),
    "a: !!float b": (1, 4, "the tag !!float does not fit"),
    "a: !!bool yes": (1, 4, "the tag !!bool does not fit"),
    "a: !!null x": (1, 4, "the tag !!null does not fit"),
    "a: !!timestamp 2001-01-01": (1, 4, "the tag !!timestamp does not fit"),
    "a: !!seq {b: 1}": (1, 4, "the tag !!seq does not fit"),
    'a: "b"# c': (1, 4, "a comment needs a space before its #"),
    "a: [b]# c": (1, 4, "a comment needs a space before its #"),
    "a: [b,\nc]": (1, 4, "indent line 2, which is part of this value, with more spaces"),
    'a: "b\nc"': (1, 4, "indent line 2, which is part of this value"),
    'a: "b\n\tc"': (1, 4, "indent line 2, which is part of this value"),
    "a:\n  b: {c: [1,\n  2]}": (2, 6, "indent line 3, which is part of this value"),
    "- a: 'b\n  c'": (1, 6, "indent line 2, which is part of this value"),
}
READ_ALIKE = {
    "a: {? b : 1}": {"a": {"b": 1}},
    "a: &b !!str 12 # c": {"a": "12"},
    "a: !!int 3": {"a": 3},
    "a: !!float 3.5": {"a": 3.5},
    "a: !!bool true": {"a": True},
    "a: !!null ~": {"a": None},
    "!!map\na: !!seq [1]": {"a": [1]},
    'a: "b" # c': {"a": "b"},
    "a: [\n  b, # c\n# d\n]": {"a": ["b"]},
    "{a:\n1}": {"a": 1},
    "a: &b\n  c: 'd\n    e'\nf: *b": {"a": {"c": "d e"}, "f": {"c": "d e"}},
    "a: |\n  x\n   ": {"a": "x\n \n"},
    "a: |+\n   ": {"a": "\n"},
}


def test_a_text_is_read_as_yaml_1_2_has_it_or_refused_with_its_place():
    wrong = {}
    for text, (line, column, message) in READ_OTHERWISE.items():
        with pytest.raises(RecipeError) as caught:
            parse(text, Location("a.yaml", 1, 1))
        [problem] = caught.value.diagnostics
        place = (problem.mark.line, problem.mark.column)
        if place != (line, column) or not problem.message.startswith(message):
            wrong[text] = place, problem.message
    for text, expected in READ_ALIKE.items():
        value = parse(text, Location("a.yaml", 1, 1)).plain
        if repr(value) != repr(expected):
            wrong[text] = value
    assert not wrong
