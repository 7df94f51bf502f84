"""A table that fills while work goes on: live on a terminal, one line after another elsewhere, or not shown at all."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, Literal, Self

Mode = Literal["silent", "plain", "live"]
_STYLES = {"run": "bold", "cached": "cyan", "left out": "dim", "failed": "red"}  #: by state


def mode_for(silent: bool) -> Mode:
    """Return how a table is shown: live only where the output goes to a terminal."""
    return "silent" if silent else "live" if sys.stdout.isatty() else "plain"


class ProgressTable(ABC):
    """A table on the screen for as long as its ``with`` block lasts."""

    header: Sequence[str]
    widths: Sequence[int]  #: least widths of the columns of plain lines
    numbers: Sequence[str] = ()  #: columns that are aligned right

    def __init__(self, mode: Mode) -> None:
        self.mode = mode

    @abstractmethod
    def live_rows(self) -> Iterable[tuple[Sequence[str], str]]:
        """Return the rows of a live table, each with its state."""

    @abstractmethod
    def caption(self) -> str:
        """Return the line below a live table."""

    def __enter__(self) -> Self:
        if self.mode == "live":
            from rich.live import Live

            self._live = Live(self, refresh_per_second=8, vertical_overflow="visible")
            self._live.start()
        self.show_row(self.header)
        return self

    def __exit__(self, *error: object) -> None:
        if self.mode == "live":
            self._live.stop()

    def show_row(self, cells: Sequence[str]) -> None:
        """Print a row that will not change; a live table shows its rows by itself."""
        if self.mode != "plain":
            return
        columns = zip(self.header, cells, self.widths, strict=True)
        padded = [f"{cell:{'>' if name in self.numbers else '<'}{width}}" for name, cell, width in columns]
        print("  " + "  ".join(padded).rstrip(), flush=True)

    def show_error(self, plain: Iterable[str], live: str) -> None:
        """Print what went wrong: lines below the last plain row, or a text above a live table."""
        if self.mode == "plain":
            print(*plain, sep="\n", flush=True)
        elif self.mode == "live":
            self._live.console.print(live, style="red", markup=False, highlight=False)

    def __rich__(self) -> Any:
        from rich import box
        from rich.table import Table

        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold", caption=self.caption() or None)
        for name in self.header:
            table.add_column(name, justify="right" if name in self.numbers else "left", overflow="fold")
        for cells, state in self.live_rows():
            table.add_row(*cells, style=_STYLES.get(state, ""))
        return table
