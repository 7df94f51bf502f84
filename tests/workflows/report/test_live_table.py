"""A table on a terminal: whatever its height, the terminal has printed it once when it is
finished.
"""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from neusee.workflows.report.console import ProgressTable

HEIGHT, WIDTH = 12, 60
_CODES = re.compile(r"\x1b\[(\d*)A|\x1b\[2K|\x1b\[[?\d;]*[a-zA-Z]|[\r\n]|[^\x1b\r\n]+")


class Rows(ProgressTable):
    """A table that gets one row after another."""

    header, widths = ("step", "state"), (8, 8)

    def __init__(self) -> None:
        super().__init__("live")
        self.names: list[str] = []

    def live_rows(self):
        return [((name, "run"), "run") for name in self.names]

    def caption(self) -> str:
        return ""


def screened(written: str) -> list[str]:
    """Return every line that a terminal holds after this output, those that left its screen too."""
    lines, row, top = [""], 0, 0
    for code in _CODES.finditer(written):
        text = code[0]
        if code[1] is not None:
            row = max(top, row - int(code[1] or 1))
        elif text == "\x1b[2K":
            lines[row] = ""
        elif text == "\n":
            row += 1
            lines += [""] * (row + 1 - len(lines))
            top = max(top, len(lines) - HEIGHT)
        elif not text.startswith(("\x1b", "\r")):
            lines[row] += text
    return [line.strip() for line in lines]


@pytest.fixture
def terminal(monkeypatch):
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=WIDTH, height=HEIGHT, color_system=None)
    monkeypatch.setattr("rich.live.get_console", lambda: console)
    return out


@pytest.mark.parametrize("count", [3, HEIGHT - 4, 40])
def test_each_row_is_printed_once_however_often_the_table_is_drawn(terminal, count):
    with Rows() as shown:
        for i in range(count):
            shown.names.append(f"step-{i:02}")
            shown._live.refresh()
            # the newest row is in sight
            assert shown.names[-1] in "".join(screened(terminal.getvalue())[-HEIGHT:])
    lines = screened(terminal.getvalue())
    assert [line.split()[0] for line in lines if line.startswith("step-")] == shown.names
    assert sum(line.startswith("step ") for line in lines) == 1


def test_the_screen_of_this_test_keeps_what_leaves_it():
    text = "".join(f"{i}\r\n" for i in range(30)) + "\x1b[1A" * 30 + "\x1b[2Ktop\r\n"
    lines = screened(text)
    assert lines[:3] == ["0", "1", "2"]
    assert lines.index("top") == 31 - HEIGHT
