"""Figure of the graph of a recipe: one box for each step, in the colour of its state: run, cached or left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from neusee.workflows.graph.recipe_graph import in_order
from neusee.workflows.report.figures.style import canvas, drawn

#: fill colour and legend text of each state; a dashed outline marks a left-out step without colour
LOOKS = {
    "run": ("#F7C9A9", "run"),
    "cached": ("#BFDDF0", "from the cache"),
    "left out": ("#FFFFFF", "left out: within the tolerance"),
}
_WIDTH, _HEIGHT = 1.75, 0.66  #: inches, space for a box
_INSIDE = 0.92  #: width of a box, as a share of its space
_LETTER = 5.7  #: points, mean width of a letter in a box


@drawn
def graph(*, sources: Mapping[str, Iterable[str]], states: Mapping[str, str]) -> Any:
    """Draw the graph of a recipe: a box for each step, below the boxes of the steps whose results the step reads."""
    wires, looks, counts = grouped(sources, states)
    places = layout(wires)
    columns = max((x for x, _ in places.values()), default=0.0) + 1
    rows = max((y for _, y in places.values()), default=0) + 1
    width = min(max(_WIDTH * columns, 6.0), 15.0)
    letters = int(72 * _INSIDE * (width - 0.2) / columns / _LETTER)
    figure, axes = canvas(width, _HEIGHT * rows + 0.7)
    ax = axes[0, 0]
    for name, befores in wires.items():
        for before in befores:
            _edge(ax, places[before], places[name])
    for name, (x, y) in places.items():
        text = broken(name, letters, f" ×{counts[name]}" if counts[name] > 1 else "")
        _box(ax, x, y, text, looks[name])
    ax.set(xlim=(-0.6, columns - 0.4), ylim=(rows - 0.5, -0.5))
    ax.axis("off")
    _legend(figure, looks.values())
    return figure


def grouped(
    sources: Mapping[str, Iterable[str]], states: Mapping[str, str]
) -> tuple[dict[str, list[str]], dict[str, str], Counter[str]]:
    """Return the sources, the state and the number of copies (such as ``psf[mask]``) of each step of a recipe.

    The state is ``run`` if any copy of the step ran.
    """
    family = {name: name.partition("[")[0] for name in sources}
    wires: dict[str, list[str]] = {f: [] for f in family.values()}
    looks: dict[str, str] = {}
    for name, befores in sources.items():
        mine = family[name]
        wires[mine] += [f for f in dict.fromkeys(family[b] for b in befores) if f not in (*wires[mine], mine)]
        state = states[name] if states.get(name) in LOOKS else "cached"
        looks[mine] = "run" if "run" in (state, looks.get(mine)) else state
    return wires, looks, Counter(family.values())


def layout(wires: Mapping[str, list[str]]) -> dict[str, tuple[float, int]]:
    """Return the position (x, row) of each step in the figure of a graph, below and near the sources of the step."""
    depth = _depths(wires)
    rows: dict[int, list[str]] = {}
    for name, row in depth.items():
        rows.setdefault(row, []).append(name)
    widest = max((len(r) for r in rows.values()), default=1)
    places: dict[str, tuple[float, int]] = {}
    for row in sorted(rows):
        wish = {n: _mean([places[b][0] for b in wires[n] if b in places], (widest - 1) / 2) for n in rows[row]}
        names = sorted(rows[row], key=lambda n: wish[n])
        start = min(max(_mean(list(wish.values()), 0.0) - (len(names) - 1) / 2, 0.0), widest - len(names))
        places |= {name: (start + i, row) for i, name in enumerate(names)}
    return places


def _depths(wires: Mapping[str, list[str]]) -> dict[str, int]:
    """Return the row of each step in the figure of a graph, just above the first step that reads the result."""
    order = in_order(wires, wires)
    depth: dict[str, int] = {}
    for name in order:
        depth[name] = max((depth[b] + 1 for b in wires[name]), default=0)
    first: dict[str, int] = {}
    for name in reversed(order):
        depth[name] = first.get(name, depth[name] + 1) - 1
        for b in wires[name]:
            first[b] = min(first.get(b, depth[name]), depth[name])
    return depth


def _mean(values: list[float], other: float) -> float:
    return sum(values) / len(values) if values else other


def _edge(ax: Any, start: tuple[float, int], end: tuple[float, int]) -> None:
    from matplotlib.patches import FancyArrowPatch

    bend = 0.0 if end[1] - start[1] == 1 else 0.12 if end[0] <= start[0] else -0.12
    path: dict[str, Any] = {"connectionstyle": f"arc3,rad={bend}", "arrowstyle": "-|>", "mutation_scale": 9}
    a, b = (start[0], start[1] + 0.27), (end[0], end[1] - 0.27)
    ax.add_artist(FancyArrowPatch(a, b, color="#8a8a8a", linewidth=0.9, shrinkA=0, shrinkB=0, zorder=1, **path))


def _box(ax: Any, x: float, y: float, text: str, look: str) -> None:
    from matplotlib.patches import FancyBboxPatch

    style: dict[str, Any] = {"boxstyle": "round,pad=0.0,rounding_size=0.08", "mutation_aspect": 1.6, "zorder": 2}
    style |= {"facecolor": LOOKS[look][0], "edgecolor": "#444444", "linestyle": "--" if look == "left out" else "-"}
    ax.add_artist(FancyBboxPatch((x - _INSIDE / 2, y - 0.26), _INSIDE, 0.52, **style))
    ax.text(x, y, text, ha="center", va="center", fontsize=9.5, zorder=3, linespacing=1.15)


def broken(name: str, letters: int, copies: str = "") -> str:
    """Return the name of a step on at most two lines of ``letters``, shortened in the middle if it is still longer."""
    if len(name + copies) <= letters:
        return name + copies
    cuts = [i + 1 for i, sign in enumerate(name[:-1]) if sign in "_. " and i < letters]
    at = cuts[-1] if cuts else letters
    room = max(letters - len(copies), 3)
    first, rest = name[:at].rstrip(), name[at:]
    return (
        f"{first}\n{rest if len(rest) <= room else rest[: room // 2] + '…' + rest[-(room - room // 2 - 1) :]}{copies}"
    )


def _legend(figure: Any, looks: Iterable[str]) -> None:
    from matplotlib.patches import Patch

    used = [k for k in LOOKS if k in set(looks)]
    patches = [Patch(facecolor=LOOKS[k][0], edgecolor="#444444", label=LOOKS[k][1]) for k in used]
    figure.legend(handles=patches, loc="outside upper center", ncols=len(patches), fontsize=10)
