"""A gain says its unit: DN/e- or e-/DN, and inside the program it is K of EMVA 1288."""

import re
import typing

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from neusee.nodes import calibrate, metrics, restore, sensor
from neusee.nodes.units import Gain, read_any, read_quantity, read_written

NODES = (
    sensor.digitize,
    sensor.photon_transfer,
    metrics.saturated,
    restore.electrons,
    restore.clipped,
    calibrate.expose,
    calibrate.density,
    calibrate.camera,
)


@given(st.floats(1e-6, 1e6))
def test_a_gain_in_either_unit_is_one_number(k):
    assert read_quantity(f"{k!r} DN/e-", "DN/e-") == k
    assert read_quantity(f"{k!r} e-/DN", "DN/e-") == 1.0 / k
    assert read_any(f"{k!r} e-/DN") == (1.0 / k, "DN/e-")
    assert read_written(f"{k!r} e-/DN") == (k, "DN/e-", True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.37", "needs a unit: write 0.37 e-/DN or 0.37 DN/e-"),
        (0.37, "needs a unit: write 0.37 e-/DN or 0.37 DN/e-"),
        ("0.37 e-", "has the wrong unit 'e-': write one of DN/e-, e-/DN"),
        ("0 e-/DN", "must be greater than 0"),
        ("0 DN/e-", "greater than or equal to 0.000000001"),
        ("-1 e-/DN", "greater than or equal to 0.000000001"),
        ("1e999 e-/DN", "must be finite"),
    ],
)
def test_a_gain_that_is_none_is_refused(text, message):
    with pytest.raises(ValidationError, match=re.escape(message)):
        TypeAdapter(Gain).validate_python(text)


@pytest.mark.parametrize("node", NODES, ids=lambda node: node.path)
def test_every_gain_is_that_one(node):
    assert node.hints["gain"] == Gain
    assert "gain_unit" not in node.params.model_fields


@pytest.mark.parametrize(
    "node", [calibrate.prior, calibrate.camera_prior], ids=lambda node: node.path
)
def test_what_is_believed_of_a_gain_has_its_unit(node):
    (pair,) = (hint for hint in typing.get_args(node.hints["gain"]) if hint is not type(None))
    assert typing.get_args(pair)[0] == Gain
