"""A table on a terminal that is drawn again several times a second and is never taller than the
screen.

A terminal cannot draw over lines that have left the screen, so a taller table would be printed at
each refresh.
"""

from __future__ import annotations

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.live import Live
from rich.segment import Segment

_HEAD = 3  #: lines above the first row: a blank line, the names of the columns and a rule


class LiveTable(Live):
    """A table that is drawn again eight times a second: its last rows while it changes, all of
    its rows at the end.
    """

    def __init__(self, table: RenderableType) -> None:
        super().__init__(
            get_renderable=lambda: LastRows(table) if self.is_started else table,
            refresh_per_second=8,
            vertical_overflow="visible",
        )

    def start(self, refresh: bool = False) -> None:
        """Start to draw, in a thread with a name of this program."""
        super().start(refresh)
        if self._refresh_thread is not None:
            self._refresh_thread.name = "neusee table"


class LastRows:
    """The names of the columns of a table, and as many of its last lines as the screen has room
    for.
    """

    def __init__(self, table: RenderableType) -> None:
        self.table = table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        lines = console.render_lines(self.table, options, pad=False)
        # at least one row is shown
        hidden_lines = len(lines) - max(console.size.height, _HEAD + 1)
        for line in (
            lines if hidden_lines <= 0 else [*lines[:_HEAD], *lines[_HEAD + hidden_lines :]]
        ):
            yield from line
            yield Segment.line()
