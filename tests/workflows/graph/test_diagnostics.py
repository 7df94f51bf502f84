"""Text of mistakes: a list of known names is printed once, however many mistakes end with it."""

from __future__ import annotations

from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError, nearest

NAMES = ("axicon", "flat", "vortex")


def mistakes(count, among=NAMES):
    return [
        Diagnostic(
            Location("argument 2"), f"doe={n:03}", f"no option {n} in doe; {nearest(str(n), among)}"
        )
        for n in range(count)
    ]


def test_one_list_of_names_is_printed_once():
    lines = str(RecipeError(mistakes(300))).splitlines()
    assert len(lines) == 300
    assert sum("axicon, flat, vortex" in line for line in lines) == 1
    assert lines[0].endswith("no option 0 in doe; there are: axicon, flat, vortex")
    assert lines[1].endswith("doe=001   no option 1 in doe; see the names above")


def test_each_mistake_keeps_its_own_message_and_each_list_is_printed():
    error = RecipeError([*mistakes(2), *mistakes(4, ("night", "road"))[2:]])
    assert all("there are: " in d.message for d in error.diagnostics)
    assert str(error).count("axicon, flat, vortex") == str(error).count("night, road") == 1
    assert str(RecipeError(mistakes(2, ("one",)))).count("there are: one") == 2
