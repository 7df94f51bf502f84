"""Check for cycles among the steps, without recursion."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from neusee.workflows.graph.diagnostics import Diagnostic, Location
from neusee.workflows.graph.recipe_graph import Step

_MOST = 12  #: steps of a cycle that a message names


def cycles(steps: Mapping[str, Step], marks: Mapping[str, Location]) -> Iterator[Diagnostic]:
    """Yield one diagnostic for each cycle, with the lines of its steps."""
    seen: set[frozenset[str]] = set()
    for loop in _loops({name: [s for s in step.sources if s in steps] for name, step in steps.items()}):
        names = list(dict.fromkeys(name.partition("[")[0] for name in loop))
        if frozenset(names) in seen:
            continue
        seen.add(frozenset(names))
        start = min(range(len(names)), key=lambda n: marks[names[n]])
        names = names[start:] + names[:start]
        few = names if len(names) <= _MOST else [*names[: _MOST - 1], f"({len(names) - _MOST} more)", names[-1]]
        where = _places([marks[name] for name in names[:_MOST]])
        yield Diagnostic(marks[names[0]], "steps", f"cycle: {' -> '.join([*few, names[0]])} ({where})")


def _places(marks: list[Location]) -> str:
    if len({mark.file for mark in marks}) > 1:
        return ", ".join(f"{mark.file}:{mark.line}" for mark in marks)
    return f"line{'s' * (len(marks) > 1)} {', '.join(str(mark.line) for mark in marks)}"


def _loops(sources: Mapping[str, list[str]]) -> Iterator[list[str]]:
    """Yield each cycle that a walk from sink to source closes, in the direction of the data."""
    done: set[str] = set()
    for root in sources:
        path: dict[str, Iterator[str]] = {} if root in done else {root: iter(sources[root])}
        while path:
            name = next(reversed(path))
            source = next(path[name], None)
            if source is None:
                done.add(name)
                path.popitem()
            elif source in path:
                names = list(path)
                yield names[names.index(source) :][::-1]
            elif source not in done:
                path[source] = iter(sources[source])
