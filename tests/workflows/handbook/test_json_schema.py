import functools
import re
from pathlib import Path

import pytest

import neusee.recipes
from neusee.workflows.graph.errors import Location
from neusee.workflows.handbook.json_schema import REFERENCE, schema
from neusee.workflows.recipe.text.yaml_values import parse

_schema = functools.cache(schema)  #: of the toy nodes, for all tests: it takes half a second


@pytest.fixture
def of_toys(toy):
    return _schema()


def branches(field):
    """What a parameter may be, but for a reference."""
    options = [b for b in field["anyOf"] if b != REFERENCE]
    assert len(options) == len(field["anyOf"]) - 1
    return options


def test_a_quantity_is_a_number_with_one_of_its_units(of_toys):
    (pitch,) = branches(of_toys["$defs"]["toy.pupil"]["properties"]["pitch"])
    for good in ("3.74 um", "3.74um", "1e-6 m", "+2 mm", ".5 µm"):
        assert re.search(pitch["pattern"], good)
    for bad in ("3.74", "3.74 px", "-3.74 um", "um", "1 s", "x 3 um"):
        assert not re.search(pitch["pattern"], bad)
    (diameter,) = branches(of_toys["$defs"]["toy.pupil"]["properties"]["diameter"])
    assert re.search(diameter["pattern"], "-3.74 um")


def test_numbers_and_words_have_their_ranges(of_toys):
    fields = of_toys["$defs"]["toy.digitize"]["properties"]
    assert branches(fields["bits"]) == [{"minimum": 1, "maximum": 10**9, "type": "integer"}]
    assert branches(fields["rounding"])[0]["enum"] == ["nearest", "floor"]
    assert branches(of_toys["$defs"]["toy.gather"]["properties"]["share"])[0]["maximum"] == 1


def test_a_step_is_told_by_its_node(of_toys):
    rules = {rule["then"]["title"]: rule for rule in of_toys["$defs"]["step"]["allOf"]}
    rule = rules["toy.psf"]
    assert rule["if"] == {"properties": {"node": {"const": "toy.psf"}}, "required": ["node"]}
    assert rule["then"]["properties"]["with"] == {"$ref": "#/$defs/toy.psf"}
    assert list(rule["then"]["properties"]["from"]["properties"]) == ["pupil"]
    assert of_toys["$defs"]["toy.psf"]["additionalProperties"] is False


def test_the_packaged_options_are_offered():
    options = schema()["properties"]["defaults"]["items"]["anyOf"][0]["properties"]
    assert options["reading"]["anyOf"][0] == {"enum": ["as_printed", "coherent"]}


@pytest.fixture
def errors(of_toys):
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    validator = jsonschema.Draft202012Validator(of_toys)
    return lambda text: [
        e.message for e in validator.iter_errors(parse(text, Location("f.yaml", 1, 1)).plain)
    ]


@pytest.mark.slow
def test_the_schema_is_a_schema(of_toys):
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    jsonschema.Draft202012Validator.check_schema(of_toys)


def test_a_right_recipe_has_no_error(errors):
    step = '{node: toy.psf, each: [x, y], from: b, with: {shape: "${x.y}"}}'
    assert errors(f"defaults: [doe: axicon]\nsteps: {{a: {step}, b: null}}") == []


def test_an_option_names_the_option_that_it_changes(errors):
    assert errors("defaults: [small]\noptics: {bands: 5}") == []
    assert len(errors("defaults: [3]")) == 1


@pytest.mark.parametrize(
    "step",
    [
        "{node: toy.psf, from: a, with: {shap: [1, 1]}}",
        "{node: toy.psf, from: a, with: {shape: [1, 0]}}",
        "{node: toy.psf, from: a, with: {wavelength: 550}}",
        "{node: toy.psf, from: {pupl: a}}",
        "{node: toy.pfs, from: a}",
        "{node: toy.digitize, from: a, with: {rounding: up}}",
        "{node: toy.psf, form: a}",
    ],
)
def test_a_mistake_is_one_error(errors, step):
    assert len(errors(f"steps: {{a: {step}}}")) == 1


def test_every_packaged_file_is_right(errors):
    folder = Path(neusee.recipes.__path__[0])
    wrong = {
        p.name: found
        for p in folder.rglob("*.yaml")
        if (found := errors(p.read_text(encoding="utf-8")))
    }
    assert wrong == {}
