"""Results that need only short steps are made before those that need a long one."""

from __future__ import annotations

from neusee.nodes import node
from neusee.workflows.engine.runner import shortest_first
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step


@node()
def one_in_order(*inputs: float) -> float:
    """Return a number.

    Shapes: (). Units: none. Error: exact. Raises: nothing. Source: none.
    """
    return 1.0


def recipe(**sources: str) -> Recipe:
    here = Location("small.yaml", 1, 1)
    steps = {
        name: Step(
            name, one_in_order, {}, {f"i{n}": s for n, s in enumerate(read.split())}, here, {}
        )
        for name, read in sources.items()
    }
    return Recipe("small", "small", 0, 0.0, tuple(steps), steps)


GRAPH = {
    "scene": "",
    "psf": "",
    "image": "scene psf",
    "restored": "image",
    "quality": "restored",
    "peak": "psf",
}
SECONDS = {"scene": 0.1, "psf": 0.5, "image": 0.3, "restored": 2.0, "quality": 0.1, "peak": 0.01}


def ordered(first, others, seconds=SECONDS):
    return shortest_first(recipe(**GRAPH), GRAPH, first, others, seconds)


def test_short_steps_come_before_the_long_one_that_is_needed_first():
    assert ordered(["restored"], ["peak", "quality"]) == ["peak", "restored"]


def test_what_rests_on_the_longest_step_waits():
    assert ordered(["image"], ["quality", "restored"]) == ["image"]


def test_steps_that_are_needed_first_are_never_left_out():
    assert ordered(["restored", "quality"], ["scene"]) == ["scene", "restored", "quality"]


def test_a_result_that_is_there_counts_nothing():
    assert ordered(["image"], ["peak"], {"image": 0.3, "peak": 0.01}) == ["peak", "image"]


def test_equal_steps_keep_their_order():
    assert ordered(["image", "restored"], ["scene"], {}) == ["image", "restored"]
