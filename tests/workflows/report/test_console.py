"""What is printed while steps run: items share a line, states are told apart, sleepers are one
line.
"""

from __future__ import annotations

import io
from types import SimpleNamespace

import pytest
import torch

from neusee.nodes import Check, TensorStats, node
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Event, Recipe, Step, StepRecord
from neusee.workflows.report import console as console_room
from neusee.workflows.report.terminal_text import commands_to_try


@node()
def charge(x: torch.Tensor) -> torch.Tensor:
    """Count. Units: result e-."""
    return x


charge.__doc__ = "Count.\n\n    Units:  photons; result e-.\n"
NAMES = ["spot[mask,green]", "spot[mask,red]", "raw"]


def recipe() -> Recipe:
    steps = {
        name: Step(name, charge, {}, {"x": None}, Location("a.yaml", 1, 1), {}) for name in NAMES
    }
    return Recipe("r", "", 1, 0.0, ("raw",), steps)


def done(step: str, state: str, seconds: float = 0.25, ok: bool = True) -> Event:
    facts = TensorStats((3, 4, 5), "float32", 0.0, 1.0, 1.0, 1, True)
    return Event(step, StepRecord(step, state, "", seconds, "k", facts, (Check("peak 3", ok),)))


def test_items_share_a_line_that_comes_when_the_last_is_done(capsys):
    with console_room.RunTable(recipe(), NAMES, "plain") as shown:
        shown.watch(Event(NAMES[0], None))
        shown.watch(done(NAMES[0], "run"))
        assert "spot" not in capsys.readouterr().out
        shown.watch(done(NAMES[1], "cached"))
        out = capsys.readouterr().out
        shown.watch(done("raw", "not needed"))
    assert " ".join(out.split()) == "spot ×2 cpu 1 run, 1 cached 0.250 3 × 4 × 5 e- peak 3"
    rest = capsys.readouterr().out
    assert "raw" not in rest
    assert "1 step was not needed" in rest


def test_a_copy_that_was_not_needed_is_not_said_to_have_run(capsys):
    with console_room.RunTable(recipe(), NAMES, "plain") as shown:
        shown.watch(done(NAMES[0], "not needed", 0.0))
        shown.watch(done(NAMES[1], "run"))
    out = " ".join(capsys.readouterr().out.split())
    assert "spot ×2 cpu 1 not needed, 1 run 0.250" in out


@pytest.mark.parametrize(
    ("there", "suggested"), [("doe.vortex", "axicon"), ("doe.half_rings", "vortex")]
)
def test_the_mask_to_try_next_is_not_the_mask_of_the_run(there, suggested):
    made = SimpleNamespace(
        config=SimpleNamespace(settings={}),
        steps={"height": SimpleNamespace(node=SimpleNamespace(path=there))},
    )
    first = commands_to_try(made, ["first_light", "doe=x"], lambda words: True)[0]
    assert first.split("#")[0].split() == ["neusee", "run", "first_light", f"doe={suggested}"]


def test_a_check_that_does_not_hold_is_shown_of_all_items(capsys):
    with console_room.RunTable(recipe(), NAMES, "plain") as shown:
        shown.watch(done(NAMES[0], "run"))
        shown.watch(done(NAMES[1], "run", ok=False))
    assert "LOOK: peak 3" in capsys.readouterr().out


@pytest.mark.parametrize("width", [60, 120])
def test_the_live_table_shows_what_has_begun(width):
    from rich.console import Console

    shown = console_room.RunTable(recipe(), NAMES, "live")
    out = io.StringIO()
    console = Console(file=out, width=width)
    shown.watch(Event("raw", None))
    console.print(shown)
    assert "raw" in out.getvalue()
    assert "…" in out.getvalue()
    assert "spot" not in out.getvalue()
    shown.watch(done("raw", "left out"))
    console.print(shown)
    assert "left out" in out.getvalue()


def test_nothing_is_printed_where_silence_was_asked_for(capsys):
    with console_room.RunTable(recipe(), NAMES, console_room.mode_for(silent=True)) as shown:
        shown.watch(done("raw", "run"))
    assert capsys.readouterr().out == ""


def test_left_out_steps_are_named_once_with_the_largest_bound():
    rows = [
        {"step": f"dark[{i}]", "bound": b, "estimated": False}
        for i, b in (("a", 1e-5), ("b", 3e-5))
    ]
    rows.append({"step": "psf[a]", "bound": 2e-4, "estimated": True})
    line = console_room.left_out_line(
        {"left_out": rows, "spent": {"left_out": rows}, "tolerance": 1e-3}
    )
    assert line == "left out dark (at most 3.0e-05), psf (estimated 2.0e-04); tolerance 0.001"
