"""A key that is found among known keys is the key that would be computed anew, whatever has
changed in between.
"""

import random
from dataclasses import replace
from types import SimpleNamespace

import pytest

from neusee.nodes import node
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys import code_digest as known_keys
from neusee.workflows.keys.cache_key import key_of
from neusee.workflows.keys.code_digest import KnownKeys

CODE = SimpleNamespace(of=lambda node, classes=(): f"code of {node.path}")


@node()
def joined(one=None, other=None, *, by: float = 0.0):
    return by


@node()
def drawn(*, by: float = 0.0, rng=None):
    return by


def step(by, node=joined, **wires):
    return Step("a", node, {"by": by}, wires, Location("test.yaml", 1, 1), {})


@pytest.fixture
def computed(monkeypatch):
    """The names of the steps whose keys were computed."""
    names = []
    monkeypatch.setattr(
        known_keys, "key_of", lambda step, *rest: names.append(step.name) or key_of(step, *rest)
    )
    return names


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (0.0, -0.0),
        (1, 1.0),
        (1, True),
        (True, 1.0),
        ("1", 1),
        (0.25, 0.5),
        ((0.0,), (-0.0,)),
        ((1,), (True,)),
    ],
)
def test_values_that_are_equal_but_not_written_alike_have_keys_of_their_own(before, after):
    known = KnownKeys(CODE)
    found = [known.of(step(by), {}, 7, "cpu") for by in (before, after, before)]
    assert found == [key_of(step(by), {}, 7, CODE) for by in (before, after, before)]
    assert found[0] != found[1]


def test_a_key_is_computed_once_for_steps_that_are_alike(computed):
    known = KnownKeys(CODE)
    first = known.of(step(0.5), {}, 7, "cpu")
    assert known.of(step(float("0.5")), {}, 7, "cpu") == first
    assert computed == ["a"]


def test_the_same_steps_at_other_inputs_seeds_and_devices_have_other_keys():
    changes = [
        (step(0.5, one="b"), {"b": "k1"}, 7, "cpu"),
        (step(0.5, one="b"), {"b": "k2"}, 7, "cpu"),
        (step(0.5, other="b"), {"b": "k2"}, 7, "cpu"),
        (step(0.5, drawn), {}, 7, "cpu"),
        (step(0.5, drawn), {}, 8, "cpu"),
        (step(0.5, drawn), {}, 8, "cuda:1"),
    ]
    known, draw = KnownKeys(CODE), random.Random(3)
    for one, keys, seed, device in draw.choices(changes, k=60):
        assert known.of(one, keys, seed, device) == key_of(one, keys, seed, CODE, device)
    assert len({known.of(*each)[0] for each in changes}) == len(changes)


def test_a_file_is_read_again_each_time(tmp_path):
    path = tmp_path / "picture.png"
    path.write_bytes(b"one")
    known, same = KnownKeys(CODE), step(path)
    first = known.of(same, {}, 7, "cpu")
    path.write_bytes(b"another")
    assert known.of(same, {}, 7, "cpu")[0] != first[0]
    assert known.of(replace(same, params={"by": [path]}), {}, 7, "cpu")[0] != first[0]
