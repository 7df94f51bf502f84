"""What recipes tell a Wiener filter: ghosts are glare wherever there are some, and lasers known
roughly have laws.
"""

import pytest

from neusee.workflows import load

WIENER = ("wiener", "wiener_uncertain", "neusee", "demonstration", "richardson_lucy")


@pytest.mark.parametrize("restorer", WIENER)
def test_the_ghosts_of_a_dirty_windshield_are_told(restorer):
    step = load("dirty_windshield", [f"restore={restorer}"]).steps["deconvolved"]
    assert step.wires["ghosts"] == ("ghost_photons[mask,green]",)
    roughly = restorer in ("wiener_uncertain", "neusee", "demonstration")
    assert step.params.get("doubt", 0) == (None if roughly else 0)  # None: found from the frame


@pytest.mark.parametrize("restorer", WIENER)
def test_a_clean_window_has_no_ghosts(restorer):
    assert not load("first_light", [f"restore={restorer}"]).steps["deconvolved"].wires["ghosts"]


def test_the_laws_of_a_laser_reach_its_patterns():
    recipe = load(
        "six_lasers", ["restore=wiener_uncertain", "restore.pixels=0.25", "restore.wavelength=3 nm"]
    )
    patterns = recipe.steps["deconvolved"].wires["nearby"]
    assert len(patterns) == len(recipe.steps["deconvolved"].wires["glare"]) == 6
    laws = {"pixels": 0.25, "wavelength": 3e-9, "defocus": 0.1}
    for name, glare in zip(patterns, recipe.steps["deconvolved"].wires["glare"], strict=True):
        step = recipe.steps[name]
        assert step.wires["glare"] == glare
        assert {law: step.params[law] for law in laws} == pytest.approx(laws)


def test_a_search_is_told_nothing_of_the_laser_but_the_frame():
    recipe = load("first_light", ["restore=search"])
    before, told = ["deconvolved"], set()
    while before:
        name = before.pop()
        told.add(name)
        if name != "raw[mask]":  # the frame
            wires = recipe.steps[name].wires.values()
            before += [
                each for wire in wires for each in ([wire] if isinstance(wire, str) else wire or ())
            ]
    assert {"search", "found_glare[first]", "found_nearby[third]", "raw[mask]"} <= told
    assert not [
        name
        for name in told
        if "green" in name or name.startswith(("line", "laser", "direction", "light"))
    ]
    assert recipe.steps["deconvolved"].wires["glare"] == tuple(
        f"found_glare[{n}]" for n in ("first", "second", "third")
    )
