"""Every number of a node and of a block of settings has a least and a greatest value."""

import math
from typing import Annotated, Literal, get_type_hints

import pytest
from pydantic import Field, ValidationError

from neusee.nodes import node
from neusee.nodes.calibrate import Traceability
from neusee.nodes.parameters import ParameterModel
from neusee.nodes.units import (
    Electrons,
    NumberRange,
    PixelPitch,
    Wavelength,
    in_words,
    number_ranges,
)
from neusee.workflows.recipe.blocks import safety_block, settings_block, train_block
from neusee.workflows.recipe.blocks import train_block as train_lift_block
from neusee.workflows.recipe.node_families import all_nodes

# imported, so that models exist
BLOCKS = (settings_block, safety_block, train_block, train_lift_block, Traceability)


def models(base=ParameterModel):
    """Yield every model of settings of the package."""
    for model in base.__subclasses__():
        if model.__module__.startswith("neusee.") and model.model_fields:
            yield model
        yield from models(model)


def is_open(found):
    return found.least is None or found.greatest is None


def test_every_number_of_a_node_has_two_bounds():
    hints = {
        f"{name}.{parameter}": node.hints[parameter]
        for name, node in all_nodes()
        for parameter in node.params.model_fields
    }
    assert sum(bool(list(number_ranges(hint))) for hint in hints.values()) > 300
    assert [name for name, hint in hints.items() if any(map(is_open, number_ranges(hint)))] == []


def test_every_number_of_a_block_has_two_bounds():
    hints = {
        f"{model.__name__}.{name}": hint
        for model in models()
        for name, hint in get_type_hints(model, include_extras=True).items()
        if name in model.model_fields
    }
    assert {
        "Laser.power",
        "SensorFacts.full_well",
        "Stage.iterations",
        "Rates.weights",
        "Lamp.drift",
    } <= hints.keys()
    assert [name for name, hint in hints.items() if any(map(is_open, number_ranges(hint)))] == []


@pytest.mark.parametrize(
    ("hint", "ranges"),
    [
        (Annotated[float, Field(gt=0, le=2)], [(0, 2, "")]),
        (Annotated[Electrons, Field(ge=1)] | None, [(1, 1e12, "e-")]),
        (tuple[PixelPitch, Annotated[int, Field(ge=3)]], [(1e-7, 1e-2, "m"), (3, None, "")]),
        (dict[Annotated[int, Field(ge=1, le=9)], Wavelength], [(1, 9, ""), (1e-7, 2e-5, "m")]),
        (Literal["a"] | bool | str | None, []),
        (float, [(None, None, "")]),
    ],
)
def test_ranges_are_read_from_annotations(hint, ranges):
    assert list(number_ranges(hint)) == [NumberRange(*each) for each in ranges]


@pytest.mark.parametrize(
    ("number", "si", "words"),
    [(1e-2, "m", "10 mm"), (20e-6, "m", "20 um"), (1e4, "m", "10 km"), (1e12, "e-", "1e+12 e-"), (0.25, "", "0.25"),
     (1e-12, "s", "1 ps"), (1e6, "DN/e-", "1e+06 DN/e-"), (1e-21, "J", "1e-21 J")],
)  # fmt: skip
def test_a_bound_is_told_in_the_unit_of_a_reader(number, si, words):
    assert in_words(number, si) == words


@node()
def counted(
    *,
    count: Annotated[int, Field(ge=1, le=9)],
    share: Annotated[float, Field(ge=0, le=1)],
    on: bool = True,
):
    return count * share


@pytest.mark.parametrize(
    "wrong",
    [
        {"count": True},
        {"share": False},
        {"share": math.nan},
        {"share": math.inf},
        {"count": 10},
        {"count": 1.5},
    ],
)
def test_truth_values_and_numbers_that_are_not_finite_are_refused(wrong):
    right = {"count": 1, "share": 0.5, "on": False}
    assert counted.params.model_validate(right).share == 0.5
    with pytest.raises(ValidationError):
        counted.params.model_validate(right | wrong)


def test_the_settings_of_an_own_node_are_not_those_of_the_package():
    assert counted.params.__module__ == __name__
    assert counted.params not in set(models())
