"""What a run prints: a live table on a terminal, plain lines elsewhere, then the numbers.

Items of one step, such as ``spot[mask,green]`` and its like, share a line, and steps that
nothing needed are one line together.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from neusee.workflows.graph.step_record import Event, StepRecord
from neusee.workflows.report.run_page import shape_of, unit_of
from neusee.workflows.report.tolerance_spent import said_of_economies

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe

HEADER = ("step", "where", "state", "seconds", "output", "check")
_WIDTHS = (0, 5, 10, 9, 28, 0)


@dataclass
class Family:
    """The items of one step: how many there are, and those that are done."""

    name: str
    members: list[str]
    unit: str
    done: list[StepRecord] = field(default_factory=list)
    begun: bool = False

    @property
    def awake(self) -> list[StepRecord]:
        """The done ones that were looked at."""
        return [d for d in self.done if d.state != "not needed"]

    def cells(self) -> tuple[str, ...]:
        """The row of this family, by `HEADER`."""
        done, many = self.awake, len(self.members) > 1
        name = f"{self.name} ×{len(self.members)}" if many else self.members[0]
        if not done:
            return (name, "", "…" if self.begun else "", "", "", "")
        ran = sum(d.seconds for d in done if d.state == "run")
        last = max(done, key=lambda d: (d.facts is not None, self.members.index(d.step)))
        told = next((d for d in done if any(not c.ok for c in d.checks)), last)
        shape = shape_of(last)
        check = "; ".join(("" if c.ok else "LOOK: ") + c.text for c in told.checks)
        why = next((d.why for d in done if d.state in ("run", "left out") and d.why), "")
        check = f"{check}  ({why})" if check and why else check or why
        return (
            name,
            told.device,
            self.state(),
            f"{ran:.3f}" if ran else "",
            f"{shape} {self.unit}".strip() if shape else "",
            check,
        )

    def state(self) -> str:
        """``run``, ``cached``, ``left out``, or how many of each."""
        states = [d.state for d in self.awake]
        if len(set(states)) == 1:
            return states[0]
        return ", ".join(f"{states.count(s)} {s}" for s in dict.fromkeys(states))


class Plain:
    """One line a step, printed when its last item is done."""

    def __init__(self, recipe: Recipe, names: Iterable[str]) -> None:
        self.families = families(recipe, names)
        self.wide = max((len(f.cells()[0]) for f in self.families.values()), default=0)

    def __enter__(self) -> Plain:
        print(_line(HEADER, self.wide))
        return self

    def __exit__(self, *error: object) -> None:
        asleep = sum(d.state == "not needed" for f in self.families.values() for d in f.done)
        if asleep:
            print(f"  {asleep} steps were not looked at: what needs them is in the cache")

    def watch(self, event: Event) -> None:
        """Take one event of the engine."""
        family = note(self.families, event)
        if event.done is not None and family.awake and len(family.done) == len(family.members):
            print(_line(family.cells(), self.wide))


class Live:
    """A table that fills as the steps are done."""

    def __init__(self, recipe: Recipe, names: Iterable[str]) -> None:
        from rich.live import Live as RichLive

        self.families = families(recipe, names)
        self.live = RichLive(self, refresh_per_second=8, vertical_overflow="visible")

    def __rich__(self) -> Any:
        from rich import box
        from rich.table import Table

        rows = [f for f in self.families.values() if f.begun or f.awake]
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")
        for name in HEADER:
            table.add_column(name, justify="right" if name == "seconds" else "left", overflow="fold")
        for family in rows:
            cells = family.cells()
            style = {"run": "bold", "cached": "cyan", "left out": "dim"}.get(cells[2], "")
            table.add_row(*cells, style="red" if "LOOK" in cells[5] else style)
        asleep = sum(d.state == "not needed" for f in self.families.values() for d in f.done)
        if asleep:
            table.caption = f"{asleep} steps were not looked at: what needs them is in the cache"
        return table

    def __enter__(self) -> Live:
        self.live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.live.stop()

    def watch(self, event: Event) -> None:
        """Take one event of the engine."""
        note(self.families, event)


class Silent:
    """Nothing at all: for ``--json`` and ``--quiet``."""

    def __enter__(self) -> Silent:
        return self

    def __exit__(self, *error: object) -> None:
        return None

    def watch(self, event: Event) -> None:
        """Take one event of the engine."""


def screen(recipe: Recipe, names: Iterable[str], silent: bool) -> Plain | Live | Silent:
    """The display that fits where the output goes."""
    if silent:
        return Silent()
    return Live(recipe, names) if sys.stdout.isatty() else Plain(recipe, names)


def families(recipe: Recipe, names: Iterable[str]) -> dict[str, Family]:
    """Steps by the name before their bracket, in running order."""
    found: dict[str, Family] = {}
    for name in names:
        short = name.partition("[")[0]
        unit = unit_of(recipe.steps[name].node.__doc__ or "")
        found.setdefault(short, Family(short, [], unit)).members.append(name)
    return found


def note(families: dict[str, Family], event: Event) -> Family:
    """Write an event down in its family; a run that leaves out less the second time has steps again, and others."""
    short = event.step.partition("[")[0]
    family = families.setdefault(short, Family(short, [], ""))
    if event.step not in family.members:
        family.members.append(event.step)
    if event.done is None:
        family.begun = True
    else:
        family.done = [*(d for d in family.done if d.step != event.step), event.done]
    return family


def opening(recipe: Recipe, command: str) -> list[str]:
    """The lines before anything runs: what was checked, and what there is to say of it."""
    values = sum(len(step.params) for step in recipe.steps.values())
    nodes = len({step.node.path for step in recipe.steps.values()})
    lines = [f"neusee {command}: {recipe.title or recipe.name}"]
    lines.append(f"checked  {len(recipe.steps)} steps of {nodes} nodes, {values} parameters: all right")
    lines += [f"note     {line}" for line in recipe.notes]
    return lines


def closing(doc: Mapping[str, Any], path: str, again: Sequence[str]) -> list[str]:
    """The lines after everything ran: what was left out, the table, the verdict, where the page is, what to try."""
    lines = [said_of_economies(doc["spent"])] if doc["spent"]["economies"] else []
    lines += [said_of_left_out(doc)] if doc["left_out"] else []
    rows = [[row["name"], *row["cells"]] for row in doc["table"]["rows"]]
    lines += ["", *aligned([["", *doc["table"]["columns"]], *rows])] if rows else []
    lines += [f"  {line}" for line in doc["table"]["legend"]]
    lines += ["", f"{doc['verdict']}  ({doc['counts']}, {doc['seconds']:.2f} s)"]
    for e in doc["expected"]:
        if not e["ok"]:
            lines.append(
                f"  missed: {e['name']} = {e['found']:.5g}, expected {e['wanted']:.5g} ± {100 * e['rtol']:.2g} %"
            )
    return [*lines, f"report   {path}", "", "next", *[f"  {line}" for line in again]]


def said_of_left_out(doc: Mapping[str, Any]) -> str:
    """One line that names what was left out and what that may change."""
    named: dict[str, float] = {}
    for row in doc["left_out"]:
        short = row["step"].partition("[")[0]
        named[short] = max(named.get(short, 0.0), row["bound"] or 0.0)
    each = ", ".join(f"{name} (at most {bound:.1e})" for name, bound in named.items())
    return f"left out {each}; tolerance {doc['tolerance']:g}"


def next_commands(recipe: Recipe) -> list[str]:
    """Three commands that work on this recipe."""
    has, name = recipe.config.settings, recipe.name
    tries = [
        (f'neusee run {name} sensor.read_noise="20 e-"', "only what follows is run", "sensor.read_noise" in has),
        (f"neusee run {name} doe=vortex", "another mask", "height" in recipe.steps),
        (f"neusee plan {name}", "what would run, and for how long", True),
        ("neusee nodes optics.psf", "what a step computes, and its source", True),
        ("neusee recipes", "what else there is", True),
    ]
    shown = [(command, why) for command, why, fits in tries if fits][:3]
    wide = max(len(command) for command, _ in shown)
    return [f"{command:<{wide}}   # {why}" for command, why in shown]


def aligned(rows: Sequence[Sequence[str]], right: bool = True) -> list[str]:
    """Rows as lines of equal columns; the first column is text, the others numbers."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [
            f"{(c or '–') if i and right else c:{'>' if i and right else '<'}{widths[i]}}" for i, c in enumerate(row)
        ]
        lines.append("  " + "   ".join(cells).rstrip())
    return lines


def _line(cells: Sequence[str], wide: int) -> str:
    """One plain line; the columns keep their places while the cells fit."""
    widths = (wide, *_WIDTHS[1:])
    padded = [
        f"{c:>{w}}" if name == "seconds" else f"{c:<{w}}" for c, w, name in zip(cells, widths, HEADER, strict=True)
    ]
    return "  " + "  ".join(padded).rstrip()
